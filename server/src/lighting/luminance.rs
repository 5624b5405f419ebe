//! Luminance of the upper hemisphere and what is bright in it.

use mr360_shaders::colour::LUMA;
use pulp::{Arch, Simd, WithSimd};

use super::panorama::{Geometry, Rows};
use super::vectors::{load, store, vectors};

/// Luminance texel by texel, and sums over every few rows; refilled from frame to frame without allocating.
pub(super) struct Luminance {
    width: usize,
    /// Rows that share their sums.
    at_once: usize,
    texels: Vec<f32>,
    sums: Vec<Sums>,
    /// Of all texels.
    solid_angle_sr: f64,
    arch: Arch,
}

/// Of the luminance of some rows.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    /// Luminance times solid angle.
    pub(super) energy: f64,
    /// Luminance squared times solid angle.
    pub(super) squares: f64,
    pub(super) peak: f32,
}

/// Rows that share their sums.
pub(super) struct Part<'a> {
    pub(super) texels: &'a mut [f32],
    pub(super) sums: &'a mut Sums,
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
    /// For the upper half of panoramas of this geometry, of which `at_once` rows are seen at once.
    pub(super) fn new(geometry: &Geometry, at_once: usize) -> Self {
        let (width, rows) = (geometry.longitude.len(), geometry.latitude.len() / 2);
        let solid_angle_sr = geometry.solid_angle_sr[..rows].iter().map(|texel_sr| f64::from(*texel_sr)).sum::<f64>() * width as f64;
        Self {
            width,
            at_once,
            texels: vec![0.0; width * rows],
            sums: vec![Sums::default(); rows / at_once.max(1)],
            solid_angle_sr,
            arch: Arch::new(),
        }
    }

    /// Takes in rows of a panorama, if they are of its upper half.
    pub(super) fn see(&mut self, rows: &Rows<'_>) {
        let (arch, width) = (self.arch, self.width);
        if let Some(part) = self.part(rows.first) {
            arch.dispatch(See { rows, part, width });
        }
    }

    /// The rows from this one on; none of the lower half.
    #[inline(always)]
    pub(super) fn part(&mut self, first_row: usize) -> Option<Part<'_>> {
        let (part, texels) = (first_row / self.at_once, self.at_once * self.width);
        let sums = self.sums.get_mut(part)?;
        Some(Part { texels: self.texels.get_mut(part * texels..(part + 1) * texels)?, sums })
    }

    /// Row by row from the top.
    pub(super) fn texels(&self) -> &[f32] {
        &self.texels
    }

    /// Over all rows.
    pub(super) fn statistics(&self) -> Statistics {
        let (mut energy, mut squares, mut peak) = (0.0, 0.0, 0.0f32);
        for sums in &self.sums {
            energy += sums.energy;
            squares += sums.squares;
            peak = peak.max(sums.peak);
        }
        let mean = energy / self.solid_angle_sr;
        let deviation = (squares / self.solid_angle_sr - mean * mean).max(0.0).sqrt();
        Statistics { mean, deviation, peak: f64::from(peak), energy }
    }
}

/// Luminance of several texels.
#[inline(always)]
pub(super) fn of<S: Simd>(simd: S, red: S::f32s, green: S::f32s, blue: S::f32s) -> S::f32s {
    let [of_red, of_green, of_blue] = [simd.splat_f32s(LUMA.x), simd.splat_f32s(LUMA.y), simd.splat_f32s(LUMA.z)];
    let sum = simd.add_f32s(simd.mul_f32s(of_red, red), simd.mul_f32s(of_green, green));
    simd.add_f32s(sum, simd.mul_f32s(of_blue, blue))
}

/// [`Luminance::see`] for whatever vectors there are.
struct See<'a, 'b> {
    rows: &'a Rows<'b>,
    part: Part<'a>,
    width: usize,
}

impl WithSimd for See<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { rows, part, width } = self;
        let (zero, mut peak) = (simd.splat_f32s(0.0), simd.splat_f32s(0.0));
        *part.sums = Sums::default();
        for (row, texels) in part.texels.chunks_exact_mut(width).enumerate() {
            let row = rows.first + row;
            let (mut sum, mut squares) = (zero, zero);
            let (red, green, blue) = (rows.row(0, row), rows.row(1, row), rows.row(2, row));
            for vector in 0..vectors::<S>(width) {
                let luminance = of(simd, load(simd, red, vector), load(simd, green, vector), load(simd, blue, vector));
                store(simd, texels, vector, luminance);
                sum = simd.add_f32s(sum, luminance);
                squares = simd.add_f32s(squares, simd.mul_f32s(luminance, luminance));
                peak = simd.max_f32s(peak, luminance);
            }
            let texel_sr = f64::from(rows.geometry.solid_angle_sr[row]);
            part.sums.energy += texel_sr * f64::from(simd.reduce_sum_f32s(sum));
            part.sums.squares += texel_sr * f64::from(simd.reduce_sum_f32s(squares));
        }
        part.sums.peak = simd.reduce_max_f32s(peak);
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
        let mut luminance = Luminance::new(&panorama.geometry, 2);
        // The last two are of the lower half. Twice: nothing of the first frame may stay.
        for first in [0, 2, 4, 6, 0, 2] {
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
