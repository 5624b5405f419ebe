//! How good an estimate is, in every measure.

use anyhow::Result;
use glam::{DVec3, Vec3};
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame};
use mr360_server::lighting::Estimate;

use super::irradiance::Normals;
use super::oracle;
use super::radiance_map::LUMA;
use super::truth::{self, Truth};

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
    /// Its message on the light track: how many bytes it has, and what comes out of them.
    ///
    /// # Errors
    /// When a value is out of the wire's range.
    pub(super) fn over_the_wire(&self) -> Result<(usize, Self)> {
        let Self { lift, sh, lights } = self.clone();
        let wire = LightFrame { pts_us: WIRE_TIME_US, published_us: WIRE_TIME_US, lift, sh, lights }.to_wire()?;
        let LightFrame { lift, sh, lights, .. } = LightFrame::from_wire(&wire)?;
        Ok((wire.len(), Self { lift, sh, lights }))
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
        let irradiance = normals.lit_by(&light.sh, &light.lights);
        let strongest = light.strongest().map(|light| light.direction);
        Self::of_parts(&irradiance, strongest, light.direct_share(), truth, scale, normals)
    }

    /// Of an oracle's answer.
    pub(super) fn of_oracle(answer: &oracle::Answer, truth: &Truth, scale: f32, normals: &Normals) -> Self {
        let irradiance = truth::irradiances(&answer.map, normals);
        Self::of_parts(&irradiance, answer.strongest, truth::direct_share(&answer.map), truth, scale, normals)
    }

    fn of_parts(estimate: &[DVec3], strongest: Option<Vec3>, direct_share: f64, truth: &Truth, scale: f32, normals: &Normals) -> Self {
        let expected = truth.scaled_irradiance(scale);
        let off = |direction: Vec3| match strongest {
            None => Dominant::NoLight,
            Some(found) => Dominant::OffDeg(f64::from(found.cross(direction).length().atan2(found.dot(direction)).to_degrees())),
        };
        Self {
            absolute: normals.absolute_error(estimate, &expected),
            scale_invariant: normals.scale_invariant_error(estimate, &expected),
            colour_deg: normals.colour_error_deg(estimate, &expected),
            dominant: truth.dominant.map_or(Dominant::Absent, off),
            direct: direct_share - truth.direct_share,
        }
    }
}

/// What the wire did to the irradiance: the absolute error of what came out of it against what went in.
pub(super) fn quantisation(light: &Light, received: &Light, normals: &Normals) -> f64 {
    let lit = |light: &Light| normals.lit_by(&light.sh, &light.lights);
    normals.absolute_error(&lit(received), &lit(light))
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use glam::Quat;

    use super::*;
    use crate::lighting::radiance_map::RadianceMap;

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
    fn an_oracle_that_knows_everything_makes_no_error() {
        let normals = Normals::new();
        let map = RadianceMap::of(64, |d| Vec3::splat(if d.dot(Vec3::new(0.6, 0.8, 0.0)) > 0.995 { 200.0 } else { 1.0 }));
        let truth = Truth::of(&map, &normals);
        let twice = map.with_texels(map.texels().iter().map(|texel| *texel * 2.0).collect());
        let score = Score::of_oracle(&oracle::Answer { map: twice, strongest: truth.dominant }, &truth, 2.0, &normals);
        assert!(score.absolute < 1e-6 && score.scale_invariant < 1e-6 && score.direct.abs() < 1e-6, "{score:?}");
        assert!(matches!(score.dominant, Dominant::OffDeg(off) if off < 1e-4), "{score:?}");
    }

    #[test]
    fn bytes_and_error_are_those_of_the_wire() {
        let of = |lights: usize| Light { sh: even(1.0), lights: vec![light(Vec3::Y, 1.0); lights], ..Light::default() };
        let bytes = |lights: usize| of(lights).over_the_wire().map(|(bytes, _)| bytes);
        assert!(bytes(3).unwrap() > bytes(2).unwrap() && bytes(65).is_err());
        let normals = Normals::new();
        let (_, received) = of(2).over_the_wire().unwrap();
        // Far below anything that a method gets wrong.
        assert!(quantisation(&of(2), &received, &normals) < 5e-3);
        assert!(quantisation(&of(2), &of(2), &normals) == 0.0);
        // An irradiance of π everywhere; a light of 1 adds its cosine, a quarter of it on average.
        assert!((quantisation(&of(0), &of(1), &normals) - 0.25 / std::f64::consts::PI).abs() < 1e-3);
    }
}
