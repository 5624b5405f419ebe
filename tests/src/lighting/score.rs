//! How good an estimate is, in every measure.

use anyhow::Result;
use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame};
use mr360_server::lighting::Estimate;

use super::irradiance::Normals;
use super::radiance_map::LUMA;
use super::truth::Truth;

/// Times on the wire as late in a broadcast as an hour: they take more bytes than those of its beginning.
const WIRE_TIME_US: u64 = 3_600_000_000;

/// What a method says of a frame.
#[derive(Debug, Clone, Default)]
pub(super) struct Light {
    /// How radiance was made from code values.
    pub(super) lift: Lift,
    /// Radiance outside the lights, real SH, 9 or 25 coefficients.
    pub(super) sh: Vec<Vec3>,
    /// Directional lights.
    pub(super) lights: Vec<DirectionalLight>,
}

impl From<&Estimate> for Light {
    fn from(estimate: &Estimate) -> Self {
        Self { lift: estimate.lift, sh: estimate.sh.clone(), lights: estimate.lights.clone() }
    }
}

impl Light {
    /// Bytes of its message on the light track.
    ///
    /// # Errors
    /// When a value is out of the wire's range.
    pub(super) fn wire_bytes(&self) -> Result<usize> {
        let Self { lift, sh, lights } = self.clone();
        Ok(LightFrame { pts_us: WIRE_TIME_US, published_us: WIRE_TIME_US, lift, sh, lights }.to_wire()?.len())
    }

    /// The light that gives a surface facing it the highest luminous irradiance.
    fn strongest(&self) -> Option<&DirectionalLight> {
        self.lights.iter().max_by(|a, b| a.irradiance.dot(LUMA).total_cmp(&b.irradiance.dot(LUMA)))
    }

    /// Share of the luminous irradiance on level ground that lights give.
    fn direct_share(&self) -> f64 {
        let given = |light: &DirectionalLight| f64::from(light.irradiance.dot(LUMA) * light.direction.y.max(0.0));
        let direct: f64 = self.lights.iter().map(given).sum();
        let rest = f64::from(mr360_shaders::sh::irradiance(&self.sh, Vec3::Y).dot(LUMA));
        if direct > 0.0 { direct / (direct + rest) } else { 0.0 }
    }
}

/// How well the dominant light was met.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Dominant {
    /// There is none.
    Absent,
    /// There is one, and the method says of no light.
    NoLight,
    /// The method's strongest light is so many degrees off.
    OffDeg(f64),
}

/// Errors of one estimate; 0 is perfect.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Score {
    /// [`Normals::absolute_error`].
    pub(super) absolute: f64,
    /// [`Normals::scale_invariant_error`].
    pub(super) scale_invariant: f64,
    /// [`Normals::colour_error_deg`].
    pub(super) colour_deg: f64,
    /// The dominant light's direction.
    pub(super) dominant: Dominant,
    /// Estimated less true share of lights in the irradiance on level ground.
    pub(super) direct: f64,
}

impl Score {
    /// Of `light` where `truth` is true of a panorama `scale` times as bright.
    pub(super) fn of(light: &Light, truth: &Truth, scale: f32, normals: &Normals) -> Self {
        let (estimate, expected) = (normals.lit_by(&light.sh, &light.lights), truth.scaled_irradiance(scale));
        let off = |direction: Vec3| match light.strongest() {
            None => Dominant::NoLight,
            Some(light) => {
                Dominant::OffDeg(f64::from(light.direction.cross(direction).length().atan2(light.direction.dot(direction)).to_degrees()))
            }
        };
        Self {
            absolute: normals.absolute_error(&estimate, &expected),
            scale_invariant: normals.scale_invariant_error(&estimate, &expected),
            colour_deg: normals.colour_error_deg(&estimate, &expected),
            dominant: truth.dominant.map_or(Dominant::Absent, off),
            direct: light.direct_share() - truth.direct_share,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use glam::Quat;

    use super::*;

    fn light(direction: Vec3, irradiance: f32) -> DirectionalLight {
        DirectionalLight { id: 0, direction, irradiance: Vec3::splat(irradiance), solid_angle_sr: 0.01 }
    }

    fn even(radiance: f32) -> Vec<Vec3> {
        let mut sh = vec![Vec3::ZERO; 9];
        sh[0] = Vec3::splat(radiance * (4.0 * PI).sqrt());
        sh
    }

    #[test]
    fn a_light_that_was_turned_is_off_by_the_turn() {
        let normals = Normals::new();
        let to_sun = Vec3::new(0.3, 0.8, -0.4).normalize();
        let true_light = Light { sh: even(1.0), lights: vec![light(Vec3::Y, 1.0), light(to_sun, 5.0)], ..Light::default() };
        let truth = Truth {
            irradiance: normals.lit_by(&true_light.sh, &true_light.lights),
            dominant: Some(to_sun),
            direct_share: true_light.direct_share(),
        };
        let perfect = Score::of(&true_light, &truth, 1.0, &normals);
        assert!(perfect.absolute < 1e-6 && perfect.scale_invariant < 1e-6 && perfect.colour_deg < 1e-6 && perfect.direct == 0.0);
        for degrees in [0.0f32, 0.5, 10.0, 90.0, 180.0] {
            let turned = Quat::from_axis_angle(to_sun.any_orthonormal_vector(), degrees.to_radians()) * to_sun;
            let estimate = Light { lights: vec![light(Vec3::Y, 1.0), light(turned, 5.0)], ..true_light.clone() };
            let Dominant::OffDeg(off) = Score::of(&estimate, &truth, 1.0, &normals).dominant else { panic!("there is a light") };
            assert!((off - f64::from(degrees)).abs() < 1e-3, "{off} for {degrees}");
        }
        // In a unit twice as large everything is half as bright, and directions and shares are what they were.
        let half = Score::of(&true_light, &truth, 2.0, &normals);
        assert!((half.absolute - 0.5).abs() < 1e-6 && half.scale_invariant < 1e-6 && half.direct == 0.0);
        let dark = Light { sh: even(1.0), ..Light::default() };
        assert_eq!(Score::of(&dark, &truth, 1.0, &normals).dominant, Dominant::NoLight);
        let absent = Truth { dominant: None, ..truth };
        assert_eq!(Score::of(&dark, &absent, 1.0, &normals).dominant, Dominant::Absent);
    }

    #[test]
    fn the_direct_share_counts_what_reaches_level_ground() {
        let lights = vec![light(Vec3::new(0.0, 0.6, 0.8), 5.0), light(-Vec3::Y, 100.0)];
        // 3 of 3 + π.
        let share = Light { sh: even(1.0), lights, ..Light::default() }.direct_share();
        assert!((share - 3.0 / (3.0 + std::f64::consts::PI)).abs() < 1e-6, "{share}");
        assert_eq!(Light { sh: even(1.0), ..Light::default() }.direct_share(), 0.0);
    }

    #[test]
    fn bytes_are_those_of_the_wire() {
        let of = |lights: usize| Light { sh: even(1.0), lights: vec![light(Vec3::Y, 1.0); lights], ..Light::default() }.wire_bytes();
        // An identifier below 251, two directions, three irradiances and a solid angle.
        assert_eq!(of(3).unwrap() - of(2).unwrap(), 13);
        assert!(of(65).is_err());
    }
}
