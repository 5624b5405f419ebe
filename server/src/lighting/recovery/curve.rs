//! A curve of four numbers through the gains of all clipped cells.

use glam::{DMat4, DVec3, DVec4, Vec3};
use mr360_protocol::light::{MAX_GAIN_LN, MAX_GAIN_SLOPE, Recovery};
use pulp::{Arch, Simd, WithSimd};

use super::places::Places;
use crate::lighting::elementary::exp;

/// Weight of the assumption that there is no slope, in weights of all cells: a single light has none.
const LEVEL: f64 = 0.01;

/// Mean and slope of the logarithm of the gain: the plane over the directions that fits the cells' logarithms best, cells weighted by the
/// geometric mean of what they show and what they hide, moved up or down so that all of them together hide as much as they should.
pub(super) fn through(arch: Arch, places: &mut Places) -> (f32, Vec3) {
    arch.dispatch(Through { places })
}

/// Leaves the gain of each place under a curve in its exponential: [`Recovery::gain`] of many.
pub(super) fn gains(arch: Arch, places: &mut Places, curve: &Recovery) {
    arch.dispatch(Exponentials { places, level: curve.gain_ln, slope: curve.slope, most: MAX_GAIN_LN });
}

struct Through<'a> {
    places: &'a mut Places,
}

impl WithSimd for Through<'_> {
    type Output = (f32, Vec3);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> (f32, Vec3) {
        let Places { excess_ln, clipped_flux, directions: [x, y, z], exponentials, .. } = &mut *self.places;
        for (root, ln) in exponentials.iter_mut().zip(excess_ln.iter()) {
            *root = exp(0.5 * ln);
        }
        // One half of a symmetric matrix, row by row.
        let (mut normal, mut right, mut hidden) = ([0.0; 10], [0.0; 4], 0.0);
        for (((((root, flux), ln), x), y), z) in exponentials.iter().zip(clipped_flux.iter()).zip(excess_ln).zip(x).zip(y).zip(z) {
            let (root, ln, basis) = (f64::from(*root), f64::from(*ln), [1.0, f64::from(*x), f64::from(*y), f64::from(*z)]);
            let weight = f64::from(*flux) * root;
            hidden += weight * root;
            let [a, b, c, d] = [weight, weight * basis[1], weight * basis[2], weight * basis[3]];
            let products = [a, b, c, d, b * basis[1], b * basis[2], b * basis[3], c * basis[2], c * basis[3], d * basis[3]];
            for i in 0..10 {
                normal[i] += products[i];
            }
            for i in 0..4 {
                right[i] += products[i] * ln;
            }
        }
        let Some(slope) = slope(&normal, right) else { return (0.0, Vec3::ZERO) };
        Exponentials { places: &mut *self.places, level: 0.0, slope, most: f32::INFINITY }.with_simd(simd);
        let mut drawn = 0.0;
        for (gain, flux) in self.places.exponentials.iter().zip(&self.places.clipped_flux) {
            drawn += f64::from(gain * flux);
        }
        (((hidden / drawn).ln() as f32).clamp(-MAX_GAIN_LN, MAX_GAIN_LN), slope)
    }
}

/// Solves for the slope; none where there is nothing to fit.
fn slope(normal: &[f64; 10], right: [f64; 4]) -> Option<Vec3> {
    let [total, x, y, z, xx, xy, xz, yy, yz, zz] = *normal;
    let level = LEVEL * total;
    let normal = DMat4::from_cols(
        DVec4::new(total, x, y, z),
        DVec4::new(x, xx + level, xy, xz),
        DVec4::new(y, xy, yy + level, yz),
        DVec4::new(z, xz, yz, zz + level),
    );
    let most = f64::from(MAX_GAIN_SLOPE);
    let fitted = (total > 0.0).then(|| normal.inverse() * DVec4::from_array(right))?;
    Some(DVec3::new(fitted.y, fitted.z, fitted.w).clamp(DVec3::splat(-most), DVec3::splat(most)).as_vec3())
}

/// e^(level + slope·direction) of each place, at most e^most.
struct Exponentials<'a> {
    places: &'a mut Places,
    level: f32,
    slope: Vec3,
    most: f32,
}

impl WithSimd for Exponentials<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Places { directions: [x, y, z], exponentials, .. } = self.places;
        for (((out, x), y), z) in exponentials.iter_mut().zip(x).zip(y).zip(z) {
            let ln = self.level + (self.slope.x * *x + self.slope.y * *y + self.slope.z * *z);
            *out = exp(if ln < self.most { ln } else { self.most });
        }
    }
}
