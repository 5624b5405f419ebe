//! A curve of four numbers through the gains of all clipped cells.

use glam::{DMat4, DVec3, DVec4, Vec3};
use mr360_protocol::light::{MAX_GAIN_LN, MAX_GAIN_SLOPE};

/// Weight of the assumption that there is no slope, in weights of all cells: a single light has none.
const LEVEL: f64 = 0.01;

/// Mean and slope of the logarithm of the gain: the plane over the directions that fits the cells' logarithms best, cells weighted by the
/// geometric mean of what they show and what they hide, moved up or down so that all of them together hide as much as they should.
pub(super) fn through(excess_ln: &[f32], clipped_flux: &[f32], directions: &[Vec3]) -> (f32, Vec3) {
    let cells = || {
        let all = excess_ln.iter().zip(clipped_flux).zip(directions);
        all.filter(|((_, flux), _)| **flux > 0.0).map(|((ln, flux), direction)| (f64::from(*ln), f64::from(*flux), *direction))
    };
    let (mut normal, mut right, mut total) = (DMat4::ZERO, DVec4::ZERO, 0.0);
    for (ln, flux, direction) in cells() {
        let weight = flux * (0.5 * ln).exp();
        let basis = DVec4::from((1.0, direction.as_dvec3()));
        normal += DMat4::from_cols(basis * basis.x, basis * basis.y, basis * basis.z, basis * basis.w) * weight;
        right += basis * (ln * weight);
        total += weight;
    }
    if total <= 0.0 {
        return (0.0, Vec3::ZERO);
    }
    normal += DMat4::from_diagonal(DVec4::new(0.0, LEVEL, LEVEL, LEVEL) * total);
    let most = f64::from(MAX_GAIN_SLOPE);
    let fitted = normal.inverse() * right;
    let slope = DVec3::new(fitted.y, fitted.z, fitted.w).clamp(DVec3::splat(-most), DVec3::splat(most)).as_vec3();
    let (mut hidden, mut drawn) = (0.0, 0.0);
    for (ln, flux, direction) in cells() {
        hidden += flux * ln.exp();
        drawn += flux * f64::from(slope.dot(direction)).exp();
    }
    (((hidden / drawn).ln() as f32).clamp(-MAX_GAIN_LN, MAX_GAIN_LN), slope)
}
