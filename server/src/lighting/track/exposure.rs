//! The camera's exposure and white balance from frame to frame, and scene cuts, from a coarse panorama.
//!
//! What all of the picture does at once is the camera's doing (or cannot be told from it): the gain of a channel is
//! the median, over texels that are neither clipped nor black, of the ratio to a slowly renewed reference. Medians of
//! ratios to the last frame would do in a single step, but their errors add up over the frames; against a reference they do
//! not. What changes in a large part of the picture beyond the gain is a cut.

use glam::{DVec3, Vec2, Vec3};
use mr360_shaders::colour::{LUMA, luminance};
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};

use super::super::cells::Cells;
use super::super::panorama::Panorama;

/// Columns of the coarse panorama.
const COLUMNS: usize = 64;
/// Rows of it: texels of 5.6°, wide against a camera's shake.
const ROWS: usize = 32;
/// Rows that take part: latitudes up to 61°. Above and below, texels are slivers, and stitched cameras fill the poles in.
const FIRST_ROW: usize = 5;
/// Time in which the reference takes on what changes in the scene itself.
const RENEWAL_S: f64 = 1.0;
/// Least number of texels for a median, a twentieth of those that take part.
const LEAST_TEXELS: usize = 70;
/// A texel has changed from this logarithmic difference on, 28 %: several times the grain of a dark 8-bit texel.
const CHANGED: f32 = 0.25;
/// Share of changed texels that makes a cut. People, cars and a turning camera change the texels at their edges only; two
/// unrelated pictures differ by more than [`CHANGED`] in well over half of theirs.
const CUT_SHARE: f64 = 0.35;

/// A panorama of 64×32 texels.
#[derive(Default)]
pub(in super::super) struct Coarse {
    cells: Option<Cells>,
    radiance: Vec<Vec3>,
    directions: Vec<(Vec3, f32)>,
}

impl Coarse {
    /// Averages a panorama whose sides are multiples of 64 and 32, or repeats the texels of a smaller one.
    pub(in super::super) fn take(&mut self, panorama: &Panorama) {
        if panorama.size.width < COLUMNS as u32 {
            self.repeat(panorama);
            return;
        }
        let cells = self.cells.get_or_insert_with(|| Cells::new(panorama.size, panorama.size.width / COLUMNS as u32));
        cells.take(panorama);
        if self.directions.is_empty() {
            let directions = |row: usize| (0..COLUMNS).map(move |column| (row, column));
            self.directions.extend(
                (0..ROWS)
                    .flat_map(directions)
                    .map(|(row, column)| (cells.geometry.direction(row, column), cells.geometry.solid_angle_sr[row])),
            );
        }
        self.radiance.clear();
        self.radiance.extend((0..COLUMNS * ROWS).map(|cell| cells.radiance(cell)));
    }

    /// Takes a panorama that is smaller than this.
    fn repeat(&mut self, panorama: &Panorama) {
        let (width, height) = (panorama.size.width as usize, panorama.size.height as usize);
        if self.directions.is_empty() {
            self.directions.extend((0..COLUMNS * ROWS).map(|texel| {
                let (row, column) = (texel / COLUMNS, texel % COLUMNS);
                let uv = Vec2::new((column as f32 + 0.5) / COLUMNS as f32, (row as f32 + 0.5) / ROWS as f32);
                (direction_from_uv(uv), pixel_solid_angle_sr(row as u32, COLUMNS as u32, ROWS as u32))
            }));
        }
        let under = |texel: usize| texel / COLUMNS * height / ROWS * width + texel % COLUMNS * width / COLUMNS;
        self.radiance.clear();
        self.radiance.extend((0..COLUMNS * ROWS).map(|texel| panorama.radiance(under(texel))));
    }

    /// Irradiance that the texels within an angle of a direction give on a surface facing them; `cosine` is the angle's.
    pub(super) fn within(&self, direction: Vec3, cosine: f32) -> DVec3 {
        let near = self.directions.iter().zip(&self.radiance).filter(|((middle, _), _)| middle.dot(direction) >= cosine);
        near.map(|((_, solid_angle_sr), radiance)| (*radiance * *solid_angle_sr).as_dvec3()).sum()
    }

    fn mean_luminance(&self) -> f32 {
        let sum: f32 =
            self.directions.iter().zip(&self.radiance).map(|((_, solid_angle_sr), radiance)| luminance(*radiance) * solid_angle_sr).sum();
        sum / (4.0 * std::f32::consts::PI)
    }
}

/// Radiance that is neither black nor clipped, and proportional to the exposure.
#[derive(Debug, Clone, Copy)]
struct Range {
    floor: f32,
    ceiling: f32,
}

impl Range {
    /// LDR video: below the floor an 8-bit step is over a tenth, above the ceiling some of a coarse texel may be clipped. True HDR has neither,
    /// only the black of the picture.
    fn of(coarse: &Coarse, hdr: bool) -> Self {
        if hdr {
            Self { floor: 1e-3 * coarse.mean_luminance().max(1e-9), ceiling: f32::INFINITY }
        } else {
            Self { floor: 0.01, ceiling: 0.7 }
        }
    }

    fn holds(self, value: f32) -> bool {
        value > self.floor && value < self.ceiling
    }

    fn clamp(self, value: f32) -> f32 {
        value.max(self.floor).min(self.ceiling)
    }
}

/// What a frame did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Change {
    /// Logarithm of the gain since the reference was laid down.
    pub(super) gain: DVec3,
    /// The scene is another one.
    pub(super) cut: bool,
}

/// Gain and cuts over time.
#[derive(Default)]
pub(super) struct Exposure {
    /// Logarithm of radiance over gain, channel by channel; none where the texel has not been within the range yet.
    reference: Vec<[Option<f32>; 3]>,
    /// Luminance of the last frame.
    before: Vec<f32>,
    gain: DVec3,
    ratios: Vec<f32>,
}

impl Exposure {
    /// Forgets everything: the next frame has gain 1.
    pub(super) fn reset(&mut self) {
        self.reference.clear();
        self.before.clear();
        self.gain = DVec3::ZERO;
    }

    /// Compares a frame with those before it, `dt_s` after the last one.
    pub(super) fn measure(&mut self, coarse: &Coarse, hdr: bool, dt_s: f64) -> Change {
        let range = Range::of(coarse, hdr);
        self.reference.resize(COLUMNS * ROWS, [None; 3]);
        let gain = DVec3::from_array([0, 1, 2].map(|channel| self.channel_gain(coarse, range, channel)));
        let cut = !self.before.is_empty() && self.changed_share(coarse, range, (gain - self.gain).dot(LUMA.as_dvec3()) as f32) > CUT_SHARE;
        self.gain = gain;
        self.renew(coarse, range, (1.0 - (-dt_s / RENEWAL_S).exp()) as f32);
        Change { gain, cut }
    }

    fn channel_gain(&mut self, coarse: &Coarse, range: Range, channel: usize) -> f64 {
        let middle = FIRST_ROW * COLUMNS..(ROWS - FIRST_ROW) * COLUMNS;
        self.ratios.clear();
        self.ratios.reserve(COLUMNS * ROWS);
        for (radiance, reference) in coarse.radiance[middle.clone()].iter().zip(&self.reference[middle]) {
            if let Some(reference) = reference[channel].filter(|_| range.holds(radiance[channel])) {
                self.ratios.push(radiance[channel].ln() - reference);
            }
        }
        if self.ratios.len() < LEAST_TEXELS {
            return self.gain[channel];
        }
        let half = self.ratios.len() / 2;
        f64::from(*self.ratios.select_nth_unstable_by(half, f32::total_cmp).1)
    }

    /// Share of the informative texels that differ from the last frame's by more than the gain explains.
    fn changed_share(&self, coarse: &Coarse, range: Range, gain_step: f32) -> f64 {
        let (mut changed, mut informative) = (0usize, 0usize);
        let middle = FIRST_ROW * COLUMNS..(ROWS - FIRST_ROW) * COLUMNS;
        for (radiance, before) in coarse.radiance[middle.clone()].iter().zip(&self.before[middle]) {
            let (now, before) = (luminance(*radiance), *before);
            if !range.holds(now) && !range.holds(before) && (now < range.floor) == (before < range.floor) {
                continue;
            }
            informative += 1;
            let step = (range.clamp(now) / range.clamp(before)).ln() - gain_step;
            // A clamped value says only that the truth lies further out.
            let step = if before <= range.floor || now >= range.ceiling {
                step.max(0.0)
            } else if before >= range.ceiling || now <= range.floor {
                step.min(0.0)
            } else {
                step
            };
            changed += usize::from(step.abs() > CHANGED);
        }
        if informative < LEAST_TEXELS { 0.0 } else { changed as f64 / informative as f64 }
    }

    fn renew(&mut self, coarse: &Coarse, range: Range, share: f32) {
        let gain = self.gain.as_vec3();
        for (radiance, reference) in coarse.radiance.iter().zip(&mut self.reference) {
            for channel in 0..3 {
                if range.holds(radiance[channel]) {
                    let canonical = radiance[channel].ln() - gain[channel];
                    let known = reference[channel].get_or_insert(canonical);
                    *known += share * (canonical - *known);
                }
            }
        }
        self.before.clear();
        self.before.extend(coarse.radiance.iter().map(|radiance| luminance(*radiance)));
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::sampling::Grid;
    use super::*;
    use mr360_protocol::light::Lift;

    /// A textured place; `block` is how many texels one of its patches is wide.
    fn place(block: usize, gain: Vec3) -> Coarse {
        let mut panorama = Panorama::new(Grid { width: 128, height: 64, supersample: 1 }, Lift::Linear);
        for texel in 0..128 * 64 {
            let (row, column) = (texel / 128 / block, texel % 128 / block);
            panorama.set_radiance(texel, Vec3::new(0.05, 0.06, 0.07) * (1.0 + ((row * 7 + column * 13) % 11) as f32 / 5.0) * gain);
        }
        let mut coarse = Coarse::default();
        coarse.take(&panorama);
        coarse
    }

    #[test]
    fn the_gain_of_each_channel_is_measured_and_is_no_cut() {
        let mut exposure = Exposure::default();
        let first = exposure.measure(&place(8, Vec3::ONE), false, 0.0);
        assert_eq!(first, Change { gain: DVec3::ZERO, cut: false });
        for gain in [Vec3::new(1.2, 1.0, 0.7), Vec3::splat(0.5), Vec3::new(0.3, 0.5, 0.4)] {
            let change = exposure.measure(&place(8, gain), false, 1.0 / 30.0);
            assert!((change.gain - gain.as_dvec3().ln()).abs().max_element() < 1e-5, "{gain}: {change:?}");
            assert!(!change.cut, "{gain}");
        }
    }

    #[test]
    fn what_changes_in_a_small_part_is_neither_gain_nor_cut_and_another_place_is_a_cut() {
        let mut exposure = Exposure::default();
        exposure.measure(&place(8, Vec3::ONE), false, 0.0);
        let mut lit = place(8, Vec3::ONE);
        lit.radiance.chunks_mut(COLUMNS).for_each(|row| row[..COLUMNS / 4].iter_mut().for_each(|texel| *texel *= 2.0));
        let change = exposure.measure(&lit, false, 1.0 / 30.0);
        assert!(change.gain.abs().max_element() < 1e-5 && !change.cut, "{change:?}");
        assert!(exposure.measure(&place(6, Vec3::ONE), false, 1.0 / 30.0).cut);
    }
}
