//! A LightFrame as the renderer uses it.

use std::f32::consts::PI;

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

/// Squared sine of a quarter of the apex angle of the cone of this solid angle, which is Ω/4π: angles of small cones come
/// from it without the digits that 1 − cos θ loses. Held below a half angle of 80°: wider lights are no lights but sky.
fn sin2_half(solid_angle_sr: f32) -> f32 {
    (solid_angle_sr / (4.0 * PI)).clamp(0.0, 0.415)
}

/// Half the apex angle of the cone of this solid angle, radians.
fn half_angle(solid_angle_sr: f32) -> f32 {
    2.0 * sin2_half(solid_angle_sr).sqrt().asin()
}

/// Tangent of half the apex angle of the cone of this solid angle.
pub(crate) fn tan_radius(solid_angle_sr: f32) -> f32 {
    let sin2 = sin2_half(solid_angle_sr);
    2.0 * (sin2 * (1.0 - sin2)).sqrt() / (1.0 - 2.0 * sin2)
}

/// Half angles between which a light goes over from the highlights to the reflection map, radians. A narrow one is gone
/// between the map's coarser texels unless it comes back as a highlight, and the SH of the rest hardly know of it. A wide one
/// fills many texels, each with the radiance that it is to mirror, and leaves a hole in the rest where their SH ring below
/// zero. A light whose measured size wavers moves between the two without a step.
const WIDE: [f32; 2] = [7.0 * PI / 180.0, 9.0 * PI / 180.0];
/// A light's own spread is widened by this before it is cut out, for the blur of lens and codec around it.
const CUT_MARGIN: f32 = 1.5;

/// How a light is shared between the reflection map and its highlight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MapCut {
    /// Half angle over which the light is taken out of the map, radians.
    pub(crate) radius: f32,
    /// How much of it is taken out, and comes back as a highlight: in [0, 1].
    pub(crate) share: f32,
}

/// The cut of a light of this solid angle; share 0 for a wide one, which the map holds whole.
pub(crate) fn map_cut(solid_angle_sr: f32) -> MapCut {
    let half_angle = half_angle(solid_angle_sr);
    let kept = ((half_angle - WIDE[0]) / (WIDE[1] - WIDE[0])).clamp(0.0, 1.0);
    MapCut { radius: half_angle * CUT_MARGIN, share: 1.0 - kept * kept * (3.0 - 2.0 * kept) }
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

    /// In double precision, which 1 − cos θ needs.
    fn solid_angle(half_angle_deg: f64) -> f32 {
        (2.0 * std::f64::consts::PI * (1.0 - half_angle_deg.to_radians().cos())) as f32
    }

    #[test]
    fn cones_of_known_solid_angles() {
        // A thousandth of a degree, the sun's quarter of a degree, lamps, skies.
        for half_angle_deg in [0.001f64, 0.266, 1.0, 8.0, 45.0, 79.0] {
            let expected = half_angle_deg.to_radians().tan() as f32;
            let found = tan_radius(solid_angle(half_angle_deg));
            assert!((found / expected - 1.0).abs() < 1e-4, "{half_angle_deg}°: {found} against {expected}");
        }
        // The whole sphere is held at 80°.
        assert!((5.0..6.0).contains(&tan_radius(4.0 * PI)) && tan_radius(0.0) == 0.0);
    }

    #[test]
    fn only_narrow_lights_are_cut_out_of_reflections() {
        for half_angle_deg in [0.266, 1.0, 3.0, 6.9] {
            let cut = map_cut(solid_angle(half_angle_deg));
            assert_eq!(cut.share, 1.0, "{half_angle_deg}");
            assert!((f64::from(cut.radius).to_degrees() / (1.5 * half_angle_deg) - 1.0).abs() < 1e-4, "{half_angle_deg}: {cut:?}");
        }
        for half_angle_deg in [9.1, 30.0, 66.0, 180.0] {
            assert_eq!(map_cut(solid_angle(half_angle_deg)).share, 0.0, "{half_angle_deg}");
        }
    }

    #[test]
    fn a_light_that_grows_leaves_its_highlight_without_a_step() {
        let shares: Vec<f32> = (0..=400).map(|i| map_cut(solid_angle(6.0 + 0.01 * f64::from(i))).share).collect();
        // The steepest slope of a smooth step over 2° is 0.75 a degree.
        assert!(shares.windows(2).all(|pair| pair[1] <= pair[0] && pair[0] - pair[1] < 0.01 * 0.75 * 1.05));
        assert!((map_cut(solid_angle(8.0)).share - 0.5).abs() < 1e-3);
    }
}
