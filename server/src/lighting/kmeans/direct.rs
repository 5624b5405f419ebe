//! Direct light: what stands out of a panorama, taken out of it texel by texel and channel by channel.

use glam::Vec3;
use mr360_shaders::colour::LUMA;

use crate::lighting::panorama::Panorama;

/// Share of the light that is direct, τ of Rohmer et al. 2015, Section 4.2. Section 6.7 used 0.75 to 0.98 where the
/// lamps were few and small; a smaller share means smaller lights.
const DIRECT_SHARE: f64 = 0.75;
/// Relative margin over the mean from which a value stands out: rounding does not make an even sky direct.
const ROUNDING_MARGIN: f64 = 1e-3;
/// Bins of the histogram: exponent and upper four bits of the mantissa of a positive number, 4 to 6 % a bin.
const BIN_SHIFT: u32 = 19;
const BINS: usize = 1 << (31 - BIN_SHIFT);

/// The direct texels in the panorama's order; buffers are reused and hold any panorama of the size they were made for.
pub(super) struct DirectTexels {
    pub(super) directions: Directions,
    /// Direct radiance.
    pub(super) radiance: Vec<Vec3>,
    pub(super) solid_angle_sr: Vec<f32>,
    /// Luminance times solid angle of this texel and all before it.
    pub(super) cumulative: Vec<f64>,
    /// How many texels there are up to and with each row.
    pub(super) row_ends: Vec<usize>,
    histogram: Box<[f64; BINS]>,
}

/// Unit vectors, component by component, so that several are compared at a time.
#[derive(Debug, Clone, Default)]
pub(super) struct Directions {
    pub(super) x: Vec<f32>,
    pub(super) y: Vec<f32>,
    pub(super) z: Vec<f32>,
}

impl Directions {
    pub(super) fn with_capacity(capacity: usize) -> Self {
        let [x, y, z] = std::array::from_fn(|_| Vec::with_capacity(capacity));
        Self { x, y, z }
    }

    pub(super) fn len(&self) -> usize {
        self.x.len()
    }

    pub(super) fn clear(&mut self) {
        [&mut self.x, &mut self.y, &mut self.z].into_iter().for_each(Vec::clear);
    }

    pub(super) fn push(&mut self, direction: Vec3) {
        self.x.push(direction.x);
        self.y.push(direction.y);
        self.z.push(direction.z);
    }

    pub(super) fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.x[i], self.y[i], self.z[i])
    }
}

impl DirectTexels {
    /// Buffers for panoramas of at most `texels` texels in `rows` rows.
    pub(super) fn new(texels: usize, rows: usize) -> Self {
        Self {
            directions: Directions::with_capacity(texels),
            radiance: Vec::with_capacity(texels),
            solid_angle_sr: Vec::with_capacity(texels),
            cumulative: Vec::with_capacity(texels),
            row_ends: Vec::with_capacity(rows),
            histogram: Box::new([0.0; BINS]),
        }
    }

    /// Takes the direct light out of the panorama: in each channel (Figure 6) the values that are not below its threshold.
    pub(super) fn take_out_of(&mut self, panorama: &mut Panorama) {
        let thresholds = Vec3::from_array(std::array::from_fn(|channel| threshold(panorama, channel, &mut self.histogram)));
        self.directions.clear();
        self.radiance.clear();
        self.solid_angle_sr.clear();
        self.cumulative.clear();
        self.row_ends.clear();
        let (width, mut total) = (panorama.size.width as usize, 0.0);
        for row in 0..panorama.size.height as usize {
            let solid_angle_sr = panorama.geometry.solid_angle_sr[row];
            for column in 0..width {
                let texel = row * width + column;
                let radiance = panorama.radiance(texel);
                let stands_out = radiance.cmpge(thresholds);
                if !stands_out.any() {
                    continue;
                }
                let direct = Vec3::select(stands_out, radiance, Vec3::ZERO);
                panorama.set_radiance(texel, radiance - direct);
                total += f64::from(direct.dot(LUMA) * solid_angle_sr);
                self.directions.push(panorama.geometry.direction(row, column));
                self.radiance.push(direct);
                self.solid_angle_sr.push(solid_angle_sr);
                self.cumulative.push(total);
            }
            self.row_ends.push(self.radiance.len());
        }
    }
}

/// Section 4.2: from the brightest values down, until they hold [`DIRECT_SHARE`] of the channel's light; found by a histogram
/// of the light over the logarithm of the value. Difference: no value up to the mean stands out, whatever the share.
fn threshold(panorama: &Panorama, channel: usize, histogram: &mut [f64; BINS]) -> f32 {
    histogram.fill(0.0);
    let rows = || (0..).zip(&panorama.geometry.solid_angle_sr).map(|(row, sr)| (panorama.row(channel, row), *sr));
    let total: f64 = rows().map(|(values, sr)| row_sum(values) * f64::from(sr)).sum();
    let floor = total / (4.0 * std::f64::consts::PI) * (1.0 + ROUNDING_MARGIN);
    // Black stands out of nothing.
    let floor = (floor as f32).max(f32::MIN_POSITIVE);
    for (values, sr) in rows() {
        for value in values.iter().filter(|value| **value >= floor) {
            histogram[bin(*value)] += f64::from(value * sr);
        }
    }
    let mut missing = DIRECT_SHARE * total;
    let reached = histogram.iter().rposition(|light| {
        missing -= light;
        missing <= 0.0
    });
    reached.map_or(floor, |bin| f32::from_bits((bin as u32) << BIN_SHIFT).max(floor))
}

fn bin(value: f32) -> usize {
    (value.to_bits() >> BIN_SHIFT) as usize & (BINS - 1)
}

fn row_sum(values: &[f32]) -> f64 {
    let mut lanes = [0.0f32; 8];
    let chunks = values.chunks_exact(8);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(lane, value)| *lane += value);
    }
    lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>() + f64::from(rest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::sampling::Grid;
    use mr360_protocol::light::Lift;

    const SIZE: Grid = Grid { width: 64, height: 32, supersample: 1 };

    fn direct_of(radiance: impl Fn(usize, usize) -> Vec3) -> (DirectTexels, Panorama) {
        let mut panorama = Panorama::new(SIZE, Lift::Linear);
        (0..64 * 32).for_each(|texel| panorama.set_radiance(texel, radiance(texel / 64, texel % 64)));
        let mut direct = DirectTexels::new(64 * 32, 32);
        direct.take_out_of(&mut panorama);
        (direct, panorama)
    }

    #[test]
    fn the_share_is_reached_and_not_by_much_exceeded() {
        // t⁴ over the columns, t from 0 to 1: the mean is 1/5, and what is above t holds 1 − t⁵ of the light.
        let (direct, rest) = direct_of(|_, column| Vec3::splat((column as f32 / 63.0).powi(4)));
        let left: f64 = (0..32).map(|row| row_sum(rest.row(0, row)) * f64::from(rest.geometry.solid_angle_sr[row])).sum();
        let taken = direct.cumulative.last().copied().unwrap();
        let share = taken / (taken + left);
        // One bin is at most 6 % in value, 1.5 % in t: that and a column hold less than 8 % of the light.
        assert!((0.75..0.83).contains(&share), "{share}");
        assert_eq!(direct.row_ends.len(), 32);
        assert_eq!(direct.row_ends[31], direct.radiance.len());
    }

    #[test]
    fn what_is_no_brighter_than_the_mean_stays() {
        assert_eq!(direct_of(|_, _| Vec3::new(0.3, 0.5, 0.7)).0.radiance.len(), 0);
        assert_eq!(direct_of(|_, _| Vec3::ZERO).0.radiance.len(), 0);
    }

    #[test]
    fn channels_are_separated_each_on_its_own() {
        // A deep blue lamp is dim in luminance but stands out in blue; its red and green are those around it.
        let (direct, rest) = direct_of(|row, column| Vec3::new(0.5, 0.5, if (row, column) == (9, 30) { 90.0 } else { 0.01 }));
        assert_eq!(direct.radiance, [Vec3::new(0.0, 0.0, 90.0)]);
        assert_eq!(rest.radiance(9 * 64 + 30), Vec3::new(0.5, 0.5, 0.0));
    }
}
