//! A LightFrame as the renderer uses it.

use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame, SH9, SH25};
use mr360_shaders::colour::luminance;
use mr360_shaders::layout::SHADED_LIGHTS;
use mr360_shaders::sh::basis25;

/// Light of one video frame: at most [`SHADED_LIGHTS`] lights one by one, everything else in the SH.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameLight {
    /// How radiance was made from code values.
    pub lift: Lift,
    /// Radiance; those from `sh_count` on are 0.
    pub sh: [Vec3; SH25],
    /// 9 or 25.
    pub sh_count: usize,
    /// Strongest first.
    pub lights: Vec<DirectionalLight>,
}

impl Default for FrameLight {
    fn default() -> Self {
        Self { lift: Lift::Linear, sh: [Vec3::ZERO; SH25], sh_count: SH9, lights: Vec::new() }
    }
}

impl From<&LightFrame> for FrameLight {
    /// Lights beyond the strongest are folded into the SH, so that no energy is lost.
    fn from(frame: &LightFrame) -> Self {
        let mut sh = [Vec3::ZERO; SH25];
        for (to, from) in sh.iter_mut().zip(&frame.sh) {
            *to = *from;
        }
        let sh_count = if frame.sh.len() > SH9 { SH25 } else { SH9 };
        let mut lights = frame.lights.clone();
        lights.sort_by(|a, b| luminance(b.irradiance).total_cmp(&luminance(a.irradiance)));
        for light in lights.split_off(lights.len().min(SHADED_LIGHTS)) {
            // A distant light of irradiance E is radiance E·δ: its coefficients are E·Y(direction).
            for (c, basis) in sh.iter_mut().take(sh_count).zip(basis25(light.direction)) {
                *c += light.irradiance * basis;
            }
        }
        Self { lift: frame.lift, sh, sh_count, lights }
    }
}

/// Cosine of half the cone of this solid angle, kept below 80°: wider lights are no lights but sky.
pub(crate) fn cos_radius(solid_angle_sr: f32) -> f32 {
    (1.0 - solid_angle_sr / std::f32::consts::TAU).clamp(0.17, 1.0)
}

/// Half angle from which a light stays in the reflection map, radians. A narrower one is gone between the map's coarser
/// texels unless it comes back as a highlight, and the SH of the rest hardly know of it. A wider one fills many
/// texels, each with the radiance that it is to mirror, and leaves a hole in the rest where their SH ring below zero.
const WIDE: f32 = 8.0 * std::f32::consts::PI / 180.0;
/// A light's own spread is widened by this before it is cut out, for the blur of lens and codec around it.
const CUT_MARGIN: f32 = 1.5;

/// Half angle over which a light of this solid angle is cut out of the reflection map, radians; it then comes back as
/// a highlight. `None` for a wide one, which the map holds and which has no highlight where the map is seen.
pub(crate) fn cut_radius(solid_angle_sr: f32) -> Option<f32> {
    let radius = cos_radius(solid_angle_sr).acos();
    (radius < WIDE).then_some(radius * CUT_MARGIN)
}

/// Tangent of half the cone of this solid angle.
pub(crate) fn tan_radius(solid_angle_sr: f32) -> f32 {
    let cosine = cos_radius(solid_angle_sr);
    (1.0 - cosine * cosine).max(0.0).sqrt() / cosine
}

#[cfg(test)]
mod tests {
    use super::*;
    use mr360_shaders::sh::irradiance;

    #[test]
    fn weak_lights_keep_their_energy_in_the_sh() {
        let lights: Vec<_> = (0..20)
            .map(|i| DirectionalLight { id: i, direction: Vec3::Y, irradiance: Vec3::splat(1.0 + i as f32), solid_angle_sr: 0.01 })
            .collect();
        let total: f32 = lights.iter().map(|l| l.irradiance.x).sum();
        let frame = LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh: vec![Vec3::ZERO; 9], lights };
        let light = FrameLight::from(&frame);
        assert_eq!(light.lights.len(), SHADED_LIGHTS);
        assert_eq!(light.lights[0].irradiance.x, 20.0);
        let direct: f32 = light.lights.iter().map(|l| l.irradiance.x).sum();
        // The L1 + L2 series of a point light overestimates the facing irradiance: (1/4 + 1/2 + 5/16) of it.
        let folded = irradiance(&light.sh, Vec3::Y).x / (0.25 + 0.5 + 5.0 / 16.0);
        assert!((direct + folded - total).abs() < 1e-2 * total, "{direct} + {folded} against {total}");
    }

    #[test]
    fn cones_of_known_solid_angles() {
        // Half a degree across, the sun: 6.8e-5 sr.
        let radius: f32 = 0.266_f32.to_radians();
        let solid_angle = std::f32::consts::TAU * (1.0 - f64::from(radius).cos()) as f32;
        // 1 − cos loses digits in f32: 6 % of such a small angle.
        assert!((tan_radius(solid_angle) / radius.tan() - 1.0).abs() < 0.06);
    }

    #[test]
    fn only_narrow_lights_are_cut_out_of_reflections() {
        let solid_angle = |half_angle_deg: f32| std::f32::consts::TAU * (1.0 - half_angle_deg.to_radians().cos());
        for half_angle_deg in [1.0, 3.0, 7.9] {
            let cut = cut_radius(solid_angle(half_angle_deg)).unwrap().to_degrees();
            // 1 − cos of 1° has lost three of seven digits.
            assert!((cut / (1.5 * half_angle_deg) - 1.0).abs() < 1e-3, "{half_angle_deg}: {cut}");
        }
        for half_angle_deg in [8.1, 30.0, 66.0, 180.0] {
            assert_eq!(cut_radius(solid_angle(half_angle_deg)), None, "{half_angle_deg}");
        }
    }
}
