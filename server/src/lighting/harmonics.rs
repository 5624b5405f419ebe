//! Projection of a working panorama onto bands 0–2 of the spherical harmonics.
//!
//! Along a row the latitude is constant, so each of the nine basis functions is a sum of 1, sin λ, cos λ, sin 2λ
//! and cos 2λ: five dot products a row and channel instead of nine, and no basis to evaluate per texel.

use glam::{DVec3, Vec3};

use super::panorama::Panorama;

/// Values that are summed side by side.
const LANES: usize = 8;

/// Writes the nine coefficients of the panorama's radiance into `sh`.
pub(super) fn project9(panorama: &Panorama, sh: &mut [Vec3; 9]) {
    let geometry = &panorama.geometry;
    let mut sums = [DVec3::ZERO; 9];
    for (row, ((sin_latitude, cos_latitude), solid_angle_sr)) in geometry.sin_cos_latitude.iter().zip(&geometry.solid_angle_sr).enumerate()
    {
        let moments: [[f64; 5]; 3] = std::array::from_fn(|channel| moments(panorama.row(channel, row), &geometry.harmonics));
        let moment = |i: usize| DVec3::new(moments[0][i], moments[1][i], moments[2][i]) * f64::from(*solid_angle_sr);
        let (one, sin, cos, sin2, cos2) = (moment(0), moment(1), moment(2), moment(3), moment(4));
        let (y, c) = (f64::from(*sin_latitude), f64::from(*cos_latitude));
        // x = c·sin λ and z = −c·cos λ.
        let zz = (one + cos2) * (0.5 * c * c);
        let xx = (one - cos2) * (0.5 * c * c);
        sums[0] += one * 0.282_094_791_773_878_14;
        sums[1] += one * (0.488_602_511_902_919_9 * y);
        sums[2] -= cos * (0.488_602_511_902_919_9 * c);
        sums[3] += sin * (0.488_602_511_902_919_9 * c);
        sums[4] += sin * (1.092_548_430_592_079_2 * c * y);
        sums[5] -= cos * (1.092_548_430_592_079_2 * c * y);
        sums[6] += (3.0 * zz - one) * 0.315_391_565_252_520_05;
        sums[7] -= sin2 * (1.092_548_430_592_079_2 * 0.5 * c * c);
        sums[8] += (xx - one * (y * y)) * 0.546_274_215_296_039_6;
    }
    *sh = sums.map(|sum| sum.as_vec3());
}

/// Sums of a row times 1 and times each of the four harmonics.
fn moments(row: &[f32], harmonics: &[Vec<f32>; 4]) -> [f64; 5] {
    let mut lanes = [[0.0f32; LANES]; 5];
    let [sin, cos, sin2, cos2] = harmonics.each_ref().map(|h| h.chunks_exact(LANES));
    let remainder = row.len() - row.len() % LANES;
    for ((((values, sin), cos), sin2), cos2) in row.chunks_exact(LANES).zip(sin).zip(cos).zip(sin2).zip(cos2) {
        for i in 0..LANES {
            lanes[0][i] += values[i];
            lanes[1][i] += values[i] * sin[i];
            lanes[2][i] += values[i] * cos[i];
            lanes[3][i] += values[i] * sin2[i];
            lanes[4][i] += values[i] * cos2[i];
        }
    }
    let mut sums = lanes.map(|lanes| lanes.iter().map(|v| f64::from(*v)).sum::<f64>());
    for (column, value) in row.iter().enumerate().skip(remainder) {
        sums[0] += f64::from(*value);
        for (sum, harmonic) in sums[1..].iter_mut().zip(harmonics) {
            *sum += f64::from(value * harmonic[column]);
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::sampling::Grid;
    use mr360_protocol::light::Lift;
    use mr360_shaders::sh::basis9;

    #[test]
    fn rows_of_moments_equal_the_sum_over_texels() {
        // 30 columns leave a remainder of six beside the lanes.
        let mut panorama = Panorama::new(Grid { width: 30, height: 14, supersample: 1 }, Lift::Linear);
        let mut expected = [Vec3::ZERO; 9];
        for (row, column) in (0..14).flat_map(|row| (0..30).map(move |column| (row, column))) {
            let radiance = Vec3::new((row * 7 + column * 3) as f32 % 5.0, column as f32 * 0.1, row as f32 * 0.3);
            panorama.set_radiance(row * 30 + column, radiance);
            for (sum, basis) in expected.iter_mut().zip(basis9(panorama.geometry.direction(row, column))) {
                *sum += radiance * basis * panorama.geometry.solid_angle_sr[row];
            }
        }
        let mut sh = [Vec3::ZERO; 9];
        project9(&panorama, &mut sh);
        for (got, expected) in sh.iter().zip(expected) {
            // Single precision over 420 texels of radiance up to 5.
            assert!((*got - expected).abs().max_element() < 1e-4, "{sh:?} {expected:?}");
        }
    }
}
