//! Projection of a working panorama onto the spherical harmonics, exact for texels of even radiance.
//!
//! Along a row the latitude is constant, so each basis function of band l is a trigonometric polynomial of the longitude
//! of degree l. A row is reduced to its moments against 1, sin mλ and cos mλ; what each moment gives to each
//! coefficient is integrated once, over the rows' height and the texels' width. No error of quadrature is left: an even
//! sky has no other coefficient than the first.

use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};
use mr360_protocol::light::SH25;
use mr360_shaders::sh::{band, basis25};

use super::panorama::Panorama;
use super::sampling::Grid;

/// Values that are summed side by side.
const LANES: usize = 8;
/// 1, and sin mλ and cos mλ for every m up to 4.
const MOST_MOMENTS: usize = 9;
/// Longitudes at which a basis function is read to find its polynomial: twice the highest degree and one more would do.
const READINGS: usize = 16;
/// Nodes and weights of Gauss and Legendre's rule over [−1, 1].
const GAUSS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];

/// Tables for one size of panorama.
pub(super) struct Series {
    /// sin λ, cos λ, sin 2λ, … at each column's centre.
    harmonics: Vec<Vec<f32>>,
    /// For each row and coefficient, the weight of every moment.
    weights: Vec<f64>,
    coefficients: usize,
}

impl Series {
    /// Tables for the first `coefficients`, at most 25, of a panorama of this size.
    pub(super) fn new(size: Grid, coefficients: usize) -> Self {
        let degree = band(coefficients.clamp(1, SH25) - 1);
        let longitude = |column: u32| ((f64::from(column) + 0.5) / f64::from(size.width) - 0.5) * TAU;
        let harmonic = |k: usize| (0..size.width).map(|column| moment_basis(k, longitude(column)) as f32).collect();
        let rows = (0..size.height).flat_map(|row| (0..coefficients).map(move |i| (row, i)));
        Self {
            harmonics: (1..=2 * degree).map(harmonic).collect(),
            weights: rows.flat_map(|(row, i)| row_weights(size, row, i).into_iter().take(1 + 2 * degree)).collect(),
            coefficients,
        }
    }

    /// Writes the coefficients of the panorama's radiance into `sh`, which is as long as the tables are deep.
    pub(super) fn project(&self, panorama: &Panorama, sh: &mut [Vec3]) {
        let moments = 1 + self.harmonics.len();
        let mut sums = [DVec3::ZERO; SH25];
        for (row, weights) in self.weights.chunks_exact(moments * self.coefficients).enumerate() {
            let mut of_row = [DVec3::ZERO; MOST_MOMENTS];
            for channel in 0..3 {
                let values = panorama.row(channel, row);
                of_row[0][channel] = sum(values);
                for (moment, harmonic) in of_row[1..].iter_mut().zip(&self.harmonics) {
                    moment[channel] = dot(values, harmonic);
                }
            }
            for (total, weights) in sums.iter_mut().zip(weights.chunks_exact(moments)) {
                *total += weights.iter().zip(of_row).map(|(weight, moment)| moment * *weight).sum::<DVec3>();
            }
        }
        sh.iter_mut().zip(sums).for_each(|(out, sum)| *out = sum.as_vec3());
    }
}

/// 1, sin λ, cos λ, sin 2λ, cos 2λ, …
fn moment_basis(k: usize, longitude: f64) -> f64 {
    let angle = k.div_ceil(2) as f64 * longitude;
    if k % 2 == 1 { angle.sin() } else { angle.cos() }
}

/// What each moment of row `row` gives to coefficient `i`.
fn row_weights(size: Grid, row: u32, i: usize) -> [f64; MOST_MOMENTS] {
    let half_height = PI / f64::from(size.height) / 2.0;
    let centre = PI / 2.0 - (f64::from(row) + 0.5) * 2.0 * half_height;
    let mut weights = [0.0; MOST_MOMENTS];
    for (node, weight) in GAUSS {
        let (y, c) = (centre + node * half_height).sin_cos();
        let readings: [(f64, f64); READINGS] = std::array::from_fn(|k| {
            let longitude = k as f64 / READINGS as f64 * TAU;
            let (sin, cos) = longitude.sin_cos();
            (longitude, f64::from(basis25(DVec3::new(c * sin, y, -c * cos).as_vec3())[i]))
        });
        for (k, out) in weights.iter_mut().enumerate() {
            let mean = readings.iter().map(|(longitude, value)| value * moment_basis(k, *longitude)).sum::<f64>() / READINGS as f64;
            *out += weight * half_height * c * mean;
        }
    }
    let width = TAU / f64::from(size.width);
    for (k, out) in weights.iter_mut().enumerate() {
        // The mean of sin² or cos² is a half; a texel's integral of either is its value at the centre times this.
        let m = k.div_ceil(2) as f64;
        *out *= if k == 0 { width } else { 2.0 * 2.0 * (m * width / 2.0).sin() / m };
    }
    weights
}

fn sum(values: &[f32]) -> f64 {
    let mut lanes = [0.0f32; LANES];
    let chunks = values.chunks_exact(LANES);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(lane, value)| *lane += value);
    }
    lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>() + f64::from(rest)
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut lanes = [0.0f32; LANES];
    let (left, right) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest: f32 = left.remainder().iter().zip(right.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in left.zip(right) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += a * b;
        }
    }
    lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>() + f64::from(rest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::harmonics::project9;
    use mr360_protocol::light::{Lift, SH9};

    /// 30 columns leave a remainder of six beside the lanes.
    fn filled(size: Grid) -> Panorama {
        let mut panorama = Panorama::new(size, Lift::Linear);
        for texel in 0..(size.width * size.height) as usize {
            let (row, column) = (texel / size.width as usize, texel % size.width as usize);
            panorama.set_radiance(texel, Vec3::new((row * 7 + column * 3) as f32 % 5.0, column as f32 * 0.1, row as f32 * 0.3));
        }
        panorama
    }

    #[test]
    fn coefficients_are_the_integral_over_every_texel() {
        let size = Grid { width: 30, height: 14, supersample: 1 };
        let panorama = filled(size);
        let mut got = [Vec3::ZERO; SH25];
        Series::new(size, SH25).project(&panorama, &mut got);
        // Each texel by 12×12 parts, whose own error is 1/144 of a texel's.
        let fine = Grid { width: 360, height: 168, supersample: 1 };
        let geometry = &Panorama::new(fine, Lift::Linear).geometry;
        let mut expected = [DVec3::ZERO; SH25];
        for (row, column) in (0..168).flat_map(|row| (0..360).map(move |column| (row, column))) {
            let energy = panorama.radiance(row / 12 * 30 + column / 12).as_dvec3() * f64::from(geometry.solid_angle_sr[row]);
            for (sum, basis) in expected.iter_mut().zip(basis25(geometry.direction(row, column))) {
                *sum += energy * f64::from(basis);
            }
        }
        for (got, expected) in got.iter().zip(expected) {
            // Coefficients reach 10; the parts' midpoints are off by (15°/12)²/24·l² or 1e-4 of them.
            assert!((got.as_dvec3() - expected).abs().max_element() < 2e-3, "{got} against {expected}");
        }
    }

    #[test]
    fn nine_coefficients_are_the_first_of_25_and_agree_with_the_sum_over_centres() {
        let size = Grid { width: 64, height: 32, supersample: 1 };
        let panorama = filled(size);
        let (mut nine, mut all, mut centres) = ([Vec3::ZERO; SH9], [Vec3::ZERO; SH25], [Vec3::ZERO; SH9]);
        Series::new(size, SH9).project(&panorama, &mut nine);
        Series::new(size, SH25).project(&panorama, &mut all);
        project9(&panorama, &mut centres);
        assert!(nine.iter().zip(all).all(|(a, b)| (*a - b).abs().max_element() < 1e-4));
        // Centres are good to 0.3 % of the mean.
        assert!(nine.iter().zip(centres).all(|(a, b)| (*a - b).abs().max_element() < 3e-3 * nine[0].max_element()), "{nine:?} {centres:?}");
    }
}
