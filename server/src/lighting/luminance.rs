//! Luminance of the upper hemisphere and what is bright in it.

use mr360_shaders::colour::LUMA;
use pulp::{Arch, Simd, WithSimd};

use super::panorama::Rows;

/// Values that are added side by side, so that as many are added at a time as the vectors hold; the same on every processor.
const LANES: usize = 8;

/// Luminance texel by texel, and sums over every row; refilled from frame to frame without allocating.
pub(super) struct Luminance {
    width: usize,
    texels: Vec<f32>,
    rows: Vec<RowSums>,
    arch: Arch,
}

/// Of the luminance of a row.
#[derive(Debug, Clone, Copy, Default)]
struct RowSums {
    sum: f64,
    squares: f64,
    peak: f32,
    /// Solid angle of a texel.
    texel_sr: f64,
}

/// Luminance of the upper hemisphere, weighted by solid angle.
pub(super) struct Statistics {
    pub(super) mean: f64,
    deviation: f64,
    peak: f64,
    /// Luminance times solid angle, summed.
    pub(super) energy: f64,
}

impl Statistics {
    /// μ + 2σ, but never more than half way from the mean to the peak. The first rises past white when a fifth of
    /// the sky is clipped and no light would be left; the second keeps the clipped part above the threshold
    /// whatever its share. With a sun in the frame the first is the lower by far.
    pub(super) fn threshold(&self) -> f32 {
        (self.mean + 2.0 * self.deviation).min(0.5 * (self.mean + self.peak)) as f32
    }
}

impl Luminance {
    /// For the upper half of panoramas of this width, with this many rows.
    pub(super) fn new(width: usize, upper_rows: usize) -> Self {
        Self { width, texels: vec![0.0; width * upper_rows], rows: vec![RowSums::default(); upper_rows], arch: Arch::new() }
    }

    /// Takes in rows of a panorama, as far as they are of its upper half.
    pub(super) fn see(&mut self, rows: &Rows<'_>) {
        let texels = self.texels.chunks_exact_mut(self.width).zip(&mut self.rows).enumerate().skip(rows.first).take(rows.count);
        for (row, (texels, sums)) in texels {
            let texel_sr = f64::from(rows.geometry.solid_angle_sr[row]);
            let of_row = self.arch.dispatch(OfRow { channels: [rows.row(0, row), rows.row(1, row), rows.row(2, row)], texels });
            *sums = RowSums { texel_sr, ..of_row };
        }
    }

    /// Row by row from the top.
    pub(super) fn texels(&self) -> &[f32] {
        &self.texels
    }

    /// Over all rows that were seen.
    pub(super) fn statistics(&self) -> Statistics {
        let (mut first, mut second, mut solid_angle, mut peak) = (0.0, 0.0, 0.0, 0.0f32);
        for row in &self.rows {
            first += row.sum * row.texel_sr;
            second += row.squares * row.texel_sr;
            solid_angle += row.texel_sr * self.width as f64;
            peak = peak.max(row.peak);
        }
        let mean = first / solid_angle;
        let deviation = (second / solid_angle - mean * mean).max(0.0).sqrt();
        Statistics { mean, deviation, peak: f64::from(peak), energy: first }
    }
}

/// Luminance of a row, and its sums.
struct OfRow<'a> {
    channels: [&'a [f32]; 3],
    texels: &'a mut [f32],
}

impl WithSimd for OfRow<'_> {
    type Output = RowSums;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> RowSums {
        let [red, green, blue] = self.channels.map(|channel| channel.as_chunks::<LANES>().0);
        let (mut sums, mut squares, mut largest) = ([0.0f32; LANES], [0.0f32; LANES], [0.0f32; LANES]);
        for (((y, r), g), b) in self.texels.as_chunks_mut::<LANES>().0.iter_mut().zip(red).zip(green).zip(blue) {
            for i in 0..LANES {
                y[i] = LUMA.x * r[i] + LUMA.y * g[i] + LUMA.z * b[i];
                sums[i] += y[i];
                squares[i] += y[i] * y[i];
                largest[i] = if y[i] > largest[i] { y[i] } else { largest[i] };
            }
        }
        let total = |lanes: [f32; LANES]| lanes.iter().map(|v| f64::from(*v)).sum();
        RowSums { sum: total(sums), squares: total(squares), peak: largest.into_iter().fold(0.0, f32::max), texel_sr: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use mr360_protocol::light::Lift;

    use super::super::panorama::Panorama;
    use super::super::sampling::Grid;
    use super::*;

    #[test]
    fn statistics_are_those_of_the_upper_half() {
        let size = Grid { width: 16, height: 8, supersample: 1 };
        let mut panorama = Panorama::new(size, Lift::Linear);
        let value = |texel: usize| (texel * 7919 % 101) as f32 / 101.0;
        (0..128).for_each(|texel| panorama.set_radiance(texel, Vec3::new(value(texel), 0.5 * value(texel + 1), 2.0 - value(texel))));
        let mut luminance = Luminance::new(16, 4);
        // In pairs, of which the last two are of the lower half; one of them twice, as after it was changed.
        for first in [0, 2, 4, 6, 2] {
            luminance.see(&panorama.rows(first, 2));
        }
        let of = |texel: usize| f64::from(panorama.radiance(texel).dot(LUMA));
        let sr = |texel: usize| f64::from(panorama.geometry.solid_angle_sr[texel / 16]);
        let solid_angle: f64 = (0..64).map(sr).sum();
        let energy: f64 = (0..64).map(|texel| of(texel) * sr(texel)).sum();
        let mean = energy / solid_angle;
        let variance = (0..64).map(|texel| (of(texel) - mean).powi(2) * sr(texel)).sum::<f64>() / solid_angle;
        let peak = (0..64).map(of).fold(0.0, f64::max);
        let got = luminance.statistics();
        for (got, expected) in [(got.mean, mean), (got.deviation, variance.sqrt()), (got.peak, peak), (got.energy, energy)] {
            assert!((got / expected - 1.0).abs() < 1e-5, "{got} against {expected}");
        }
        assert!((0..64).all(|texel| (f64::from(luminance.texels()[texel]) - of(texel)).abs() < 1e-6));
    }
}
