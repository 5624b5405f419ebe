//! The GGX lobe as prefiltered maps have it: seen along the normal, so that it is round (Karis 2013).
//!
//! A direction at the angle θ from the lobe's axis counts by D(θ/2)·cos θ.

use std::f32::consts::{PI, TAU};

use glam::Vec3;

use crate::source::MIRROR_ALPHA;

/// GGX alpha of the finest prefiltered level. Each next level has half the texels along a side and a lobe wider by
/// [`PREFILTER_RATIO`], so that lobes span ever more texels.
pub const PREFILTER_ALPHA: f32 = 0.03;
/// From the alpha of one prefiltered level to that of the next.
pub const PREFILTER_RATIO: f32 = 2.3;
/// Prefiltered levels: up to alpha 0.84, roughness 0.92.
pub const PREFILTER_LEVELS: u32 = 5;
/// The finest prefiltered level that lobes of this perceptual roughness and wider ones look into; `None` for what is as good as a cone.
#[must_use]
pub fn finest_level(roughness: f32) -> Option<u32> {
    let alpha = roughness.clamp(0.0, 1.0).powi(2);
    // A thousandth, for the rounding of shaders.
    let level = (alpha / PREFILTER_ALPHA).log(PREFILTER_RATIO) - 1e-3;
    (alpha >= MIRROR_ALPHA).then(|| (level.floor().max(0.0) as u32).min(PREFILTER_LEVELS - 1))
}

/// Most taps of one texel.
pub const MAX_TAPS: usize = 64;

/// A direction of a lobe along z and the solid angle it stands for. Taken together with the weight z, these are the lobe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tap {
    /// Unit.
    pub direction: Vec3,
    /// Of the lobe's directions, shared evenly by D.
    pub solid_angle_sr: f32,
}

/// `count` directions of the lobe's upper half, spread as D of their half vectors is.
#[must_use]
pub fn taps(alpha: f32, count: usize) -> Vec<Tap> {
    let a2 = alpha * alpha;
    // The share of D whose reflections stay above the horizon.
    let above = 1.0 / (1.0 + a2);
    let golden_angle = PI * (3.0 - 5.0f32.sqrt());
    let tap = |i: usize| {
        let u = (i as f32 + 0.5) / count as f32 * above;
        let cos2 = (1.0 - u) / (1.0 + (a2 - 1.0) * u);
        let (z, d) = (2.0 * cos2 - 1.0, cos2 * (a2 - 1.0) + 1.0);
        let (sine, cosine) = (i as f32 * golden_angle % TAU).sin_cos();
        let ring = (1.0 - z * z).max(0.0).sqrt();
        // Along the normal, a quarter of D is the density of directions.
        let density = a2 / (PI * d * d) / 4.0 / above;
        Tap { direction: Vec3::new(ring * cosine, ring * sine, z), solid_angle_sr: 1.0 / (density * count as f32) }
    };
    (0..count).map(tap).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lobes_look_into_no_level_finer_than_their_own() {
        assert_eq!([0.0, 0.1, 0.15, 0.2, 0.27, 0.4, 1.0].map(finest_level), [None, None, Some(0), Some(0), Some(1), Some(2), Some(4)]);
        for level in 0..PREFILTER_LEVELS {
            let roughness = (PREFILTER_ALPHA * PREFILTER_RATIO.powi(level as i32)).sqrt();
            // Rounding must not take away the level that is its own.
            let found = [0.99, 1.0, 1.01].map(|by| finest_level(roughness * by).unwrap());
            assert!(found[0] <= level && found[1] <= level && found[2] == level, "{level}: {found:?}");
        }
    }

    /// D(θ/2)·cos θ, not normalised.
    fn kernel(alpha: f64, z: f64) -> f64 {
        let a2 = alpha * alpha;
        let d = 0.5 * (1.0 + z) * (a2 - 1.0) + 1.0;
        a2 / (d * d) * z
    }

    /// Mean of a function of the cosine under the lobe, by Simpson's rule in the half vector's uniform coordinate.
    fn mean(alpha: f64, f: impl Fn(f64) -> f64) -> f64 {
        let (mut sum, mut weight) = (0.0, 0.0);
        let steps = 200_000;
        for i in 0..steps {
            let z = (f64::from(i) + 0.5) / f64::from(steps);
            sum += kernel(alpha, z) * f(z);
            weight += kernel(alpha, z);
        }
        sum / weight
    }

    #[test]
    fn taps_have_the_lobes_moments() {
        for alpha in [0.05f32, 0.2, 0.8, 1.0] {
            let taps = taps(alpha, 64);
            let weight: f32 = taps.iter().map(|tap| tap.direction.z).sum();
            // What the lobe makes of SH bands 1 and 2: the zonal factors of its convolution.
            for legendre in [|z: f64| z, |z: f64| 1.5 * z * z - 0.5] {
                let found: f32 = taps.iter().map(|tap| tap.direction.z * legendre(f64::from(tap.direction.z)) as f32).sum::<f32>() / weight;
                let expected = mean(f64::from(alpha), legendre) as f32;
                assert!((found - expected).abs() < 0.005, "alpha {alpha}: {found} against {expected}");
            }
            // Directions to all sides.
            let middle: Vec3 = taps.iter().map(|tap| tap.direction * tap.direction.z).sum::<Vec3>() / weight;
            assert!(middle.truncate().length() < 0.02, "alpha {alpha}: {middle}");
            assert!(taps.iter().all(|tap| tap.direction.z > 0.0 && tap.solid_angle_sr > 0.0));
        }
    }

    #[test]
    fn solid_angles_of_a_narrow_lobe_fill_it() {
        // Half of D lies within tan²θ = α², a cone of π·4α² of mirror directions.
        let alpha = 0.05f32;
        let taps = taps(alpha, 64);
        let inner: f32 = taps.iter().take(32).map(|tap| tap.solid_angle_sr).sum();
        assert!((inner / (4.0 * PI * alpha * alpha) - 1.0).abs() < 0.03, "{inner}");
    }
}
