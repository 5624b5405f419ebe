//! Where along a wide source the light mostly comes from.
//!
//! A sun is small, and the centroid of its region is its direction. A window or a tube is not, and a viewer takes its brightest part for the light.
//! That part is the middle of the brightest cap of [`CAP_RAD`], but along an even tube one cap outdoes another by less than the grain of a frame, and
//! their order would change from frame to frame. So every cap has a say, by e more for each [`GRAIN`] that it is brighter: caps that differ by less than
//! grain share alike, and the direction moves smoothly with what the frame shows.

use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};

use super::panorama::Geometry;
use super::regions::Run;

/// Radius of a cap, radians: 2.5°, as wide as what is called one light.
pub(super) const CAP_RAD: f64 = 2.5 * PI / 180.0;
/// Relative difference of two caps at which one counts by e more: the deviation of the mean of a cap's forty texels under a grain of 2.5 % each.
const GRAIN: f64 = 0.004;
/// Parts of a row's height over which a cap's width is averaged.
const PARTS: usize = 8;
/// Caps that count by less than e to this power are left out.
const LEAST: f64 = -12.0;

/// Finds the brightest part of regions of one size of panorama, without allocating.
pub(super) struct Brightest {
    width: usize,
    rows: usize,
    /// For each row those within a cap around one of its texels, and how many columns it covers there to either side of the middle, in the mean
    /// over the row's height: caps of whole texels would be brighter and darker by how their edges fall on a source's.
    reaches: Vec<Vec<(usize, f64)>>,
    /// `width + 1` for every row: luminance times solid angle of all texels before this one.
    before: Vec<f64>,
    /// Of the texels of a region.
    caps: Vec<f64>,
}

impl Brightest {
    /// For the upper half of panoramas of this geometry.
    pub(super) fn new(geometry: &Geometry) -> Self {
        let (width, rows) = (geometry.longitude.len(), geometry.latitude.len() / 2);
        let latitude = |row: f64| (0.5 - row / (2 * rows) as f64) * PI;
        let reach = |of: usize, row: usize| {
            let (of_sine, of_cosine) = latitude(of as f64 + 0.5).sin_cos();
            // Where a cap about latitude φ ends at φ': cos Δλ = (cos r − sin φ·sin φ') / (cos φ·cos φ').
            let columns = |part: usize| {
                let (sine, cosine) = latitude(row as f64 + (part as f64 + 0.5) / PARTS as f64).sin_cos();
                ((CAP_RAD.cos() - sine * of_sine) / (cosine * of_cosine)).clamp(-1.0, 1.0).acos() / TAU * width as f64
            };
            let mean = (0..PARTS).map(columns).sum::<f64>() / PARTS as f64;
            (mean > 0.0).then_some((row, mean))
        };
        let reaches = (0..rows).map(|of| (0..rows).filter_map(|row| reach(of, row)).collect()).collect();
        Self { width, rows, reaches, before: vec![0.0; (width + 1) * rows], caps: Vec::with_capacity(width * rows) }
    }

    /// Direction of the brightest part of a region whose runs these are, from the luminance of the upper half.
    pub(super) fn of(&mut self, geometry: &Geometry, luminance: &[f32], runs: &[Run]) -> DVec3 {
        let Some((first, last)) = runs.first().zip(runs.last()) else { return DVec3::Y };
        let rows = self.reaches[first.row as usize].first().map_or(0, |(row, _)| *row)
            ..self.reaches[last.row as usize].last().map_or(self.rows, |(row, _)| row + 1);
        for row in rows {
            let texel_sr = f64::from(geometry.solid_angle_sr[row]);
            let texels = &luminance[row * self.width..(row + 1) * self.width];
            let mut sum = 0.0;
            for (before, texel) in self.before[row * (self.width + 1)..].iter_mut().zip([0.0].iter().chain(texels)) {
                sum += f64::from(*texel) * texel_sr;
                *before = sum;
            }
        }
        let texels = || runs.iter().flat_map(|run| run.columns().map(move |column| (run.row as usize, column)));
        self.caps.clear();
        let (before, reaches, width) = (&self.before, &self.reaches, self.width);
        self.caps.extend(texels().map(|(row, column)| {
            reaches[row].iter().map(|(row, reach)| around(&before[row * (width + 1)..(row + 1) * (width + 1)], column, *reach)).sum::<f64>()
        }));
        let most = self.caps.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        let mut sum = DVec3::ZERO;
        for ((row, column), cap) in texels().zip(&self.caps) {
            let exponent = (cap / most - 1.0) / GRAIN;
            if exponent > LEAST {
                let direction: Vec3 = geometry.direction(row, column);
                sum += direction.as_dvec3() * (exponent.exp() * f64::from(geometry.solid_angle_sr[row]));
            }
        }
        sum.try_normalize().unwrap_or(DVec3::Y)
    }
}

/// Sum over what lies within `reach` columns of the middle of `column`, around the seam too, from a row's sums before each texel and after the last.
fn around(before: &[f64], column: usize, reach: f64) -> f64 {
    let (width, all) = (before.len() - 1, before[before.len() - 1]);
    if 2.0 * reach >= width as f64 {
        return all;
    }
    // Places are counted from one turn before the row's first texel.
    let until = |place: f64| {
        let (turns, at) = (place as usize / width, place as usize % width);
        all * turns as f64 + before[at] + (before[at + 1] - before[at]) * place.fract()
    };
    let middle = (column + width) as f64 + 0.5;
    until(middle + reach) - until(middle - reach)
}

#[cfg(test)]
mod tests {
    use glam::Vec2;
    use mr360_shaders::equirect::direction_from_uv;

    use super::super::regions::{Regions, Topology};
    use super::*;
    use crate::lighting::sampling::Grid;

    const SIZE: Grid = Grid { width: 512, height: 256, supersample: 1 };
    /// Each texel is drawn by so many points either way.
    const POINTS: usize = 4;

    /// The brightest part of what is brighter than 1 under this luminance of a direction, times that of a texel.
    fn found(luminance: impl Fn(Vec3) -> f32, grain: impl Fn(usize) -> f32) -> Vec3 {
        let geometry = Geometry::new(SIZE);
        let mean = |row: usize, column: usize| {
            let at = |point: usize| (point as f32 + 0.5) / POINTS as f32;
            let uv = |point: usize| Vec2::new((column as f32 + at(point % POINTS)) / 512.0, (row as f32 + at(point / POINTS)) / 256.0);
            let points = (0..POINTS * POINTS).map(|point| luminance(direction_from_uv(uv(point))));
            points.sum::<f32>() / (POINTS * POINTS) as f32
        };
        let texels: Vec<f32> = (0..512 * 128).map(|texel| mean(texel / 512, texel % 512) * grain(texel)).collect();
        let mut regions = Regions::new(512, 128);
        regions.find(512, &texels, Topology::Panorama, |luminance| luminance > 1.0);
        assert_eq!(regions.len(), 1);
        Brightest::new(&geometry).of(&geometry, &texels, regions.runs(0)).as_vec3()
    }

    /// In a tube of 20° by 6° with its middle at `middle`, along `along`: how far along, degrees.
    fn along_tube(middle: Vec3, along: Vec3, direction: Vec3) -> Option<f32> {
        let across = middle.cross(along);
        let far = direction.dot(along).atan2(direction.dot(middle)).to_degrees();
        (direction.dot(across).abs() < 3.0f32.to_radians().sin() && far.abs() < 10.0).then_some(far)
    }

    #[test]
    fn of_an_even_tube_it_is_near_the_middle_whatever_the_grain() {
        let middle = Vec3::new(0.3, 0.8, 0.5).normalize();
        let along = middle.any_orthonormal_vector();
        let tube = |direction: Vec3| along_tube(middle, along, direction).map_or(0.1, |_| 50.0);
        let still = found(tube, |_| 1.0);
        // Texels draw the tube's sides unevenly.
        assert!(still.angle_between(middle).to_degrees() < 2.0, "{still}");
        for seed in 1..4usize {
            let grain = |texel: usize| 1.0 + 0.02 * ((texel.wrapping_mul(seed * 7919 + 104_729) % 101) as f32 / 50.0 - 1.0);
            let moved = found(tube, grain);
            assert!(moved.angle_between(still).to_degrees() < 1.5, "{moved} {still}");
        }
    }

    #[test]
    fn of_a_tube_it_is_the_brightest_part() {
        for middle in [Vec3::new(0.3, 0.8, 0.5), Vec3::new(0.1, 1.0, 0.0), Vec3::new(0.02, 0.5, 0.9)] {
            let middle = middle.normalize();
            let along = middle.any_orthonormal_vector();
            // 8 % brighter 4° off the middle, and less the farther from there.
            let glow = |far: f32| 50.0 * (1.0 + 0.08 * (-((far - 4.0) / 5.0).powi(2)).exp());
            let got = found(|direction| along_tube(middle, along, direction).map_or(0.1, glow), |_| 1.0);
            let far = got.dot(along).atan2(got.dot(middle)).to_degrees();
            assert!((far - 4.0).abs() < 1.0, "{middle}: {far}");
        }
    }
}
