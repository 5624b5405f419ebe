//! The camera's exposure and white balance from frame to frame, and scene cuts, from a coarse panorama.
//!
//! What all of the picture does at once is the camera's doing (or cannot be told from it): the gain of a channel is
//! the median, over texels that are neither clipped nor black, of the ratio to a slowly renewed reference. Medians of
//! ratios to the last frame would do in a single step, but their errors add up over the frames; against a reference they do
//! not. What changes in a large part of the picture beyond the gain is a cut.

use glam::{DVec3, Vec2, Vec3};
use mr360_shaders::colour::{LUMA, luminance};
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};
use pulp::{Arch, Simd, WithSimd};

use super::super::cells::Cells;
use super::super::elementary::ln;
use super::super::panorama::Panorama;
use super::super::radiance::Planes;

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
    radiance: Planes,
    directions: Vec<(Vec3, f32)>,
}

impl Coarse {
    /// Averages a panorama whose sides are multiples of 64 and 32, or repeats the texels of a smaller one.
    pub(in super::super) fn take(&mut self, panorama: &Panorama) {
        if panorama.size.width < COLUMNS as u32 {
            self.repeat(panorama);
            return;
        }
        self.look();
        let cells = self.cells.get_or_insert_with(|| Cells::new(panorama.size, panorama.size.width / COLUMNS as u32));
        cells.take(panorama);
        self.radiance.iter_mut().zip(&cells.channels).for_each(|(plane, cells)| plane.clone_from(cells));
    }

    /// Averages cells that hold mean radiance, `columns` in a row and half as many rows: powers of two. Of fewer than are needed, each is repeated.
    pub(in super::super) fn take_cells(&mut self, radiance: &Planes, columns: usize) {
        self.look();
        let rows = columns / 2;
        let side = (columns / COLUMNS).max(1);
        self.radiance.iter_mut().for_each(|plane| plane.resize(COLUMNS * ROWS, 0.0));
        for row in 0..ROWS {
            let first = row * rows / ROWS;
            let cell_sr = |row: usize| pixel_solid_angle_sr(row as u32, columns as u32, rows as u32);
            let whole: f32 = (first..first + side).map(cell_sr).sum::<f32>() * side as f32;
            for below in 0..side {
                let (share, cells) = (cell_sr(first + below) / whole, (first + below) * columns..(first + below + 1) * columns);
                for (plane, channel) in self.radiance.iter_mut().zip(cells_of(cells, radiance)) {
                    add_row(&mut plane[row * COLUMNS..(row + 1) * COLUMNS], channel, share, below == 0);
                }
            }
        }
    }

    /// Takes a panorama that is smaller than this.
    fn repeat(&mut self, panorama: &Panorama) {
        let (width, height) = (panorama.size.width as usize, panorama.size.height as usize);
        self.look();
        let under = |texel: usize| texel / COLUMNS * height / ROWS * width + texel % COLUMNS * width / COLUMNS;
        for (plane, channel) in self.radiance.iter_mut().zip(&panorama.channels) {
            plane.clear();
            plane.extend((0..COLUMNS * ROWS).map(|texel| channel[under(texel)]));
        }
    }

    /// Works out where the texels look, once.
    fn look(&mut self) {
        if self.directions.is_empty() {
            self.directions.extend((0..COLUMNS * ROWS).map(|texel| {
                let (row, column) = (texel / COLUMNS, texel % COLUMNS);
                let uv = Vec2::new((column as f32 + 0.5) / COLUMNS as f32, (row as f32 + 0.5) / ROWS as f32);
                (direction_from_uv(uv), pixel_solid_angle_sr(row as u32, COLUMNS as u32, ROWS as u32))
            }));
        }
    }

    /// Irradiance that the texels within an angle of a direction give on a surface facing them; `cosine` is the angle's.
    pub(super) fn within(&self, direction: Vec3, cosine: f32) -> DVec3 {
        let near = self.directions.iter().enumerate().filter(|(_, (middle, _))| middle.dot(direction) >= cosine);
        near.map(|(texel, (_, solid_angle_sr))| (self.at(texel) * *solid_angle_sr).as_dvec3()).sum()
    }

    fn mean_luminance(&self) -> f32 {
        let sum: f32 =
            self.directions.iter().enumerate().map(|(texel, (_, solid_angle_sr))| luminance(self.at(texel)) * solid_angle_sr).sum();
        sum / (4.0 * std::f32::consts::PI)
    }

    fn at(&self, texel: usize) -> Vec3 {
        Vec3::from_array([0, 1, 2].map(|channel: usize| self.radiance[channel][texel]))
    }
}

/// A row of cells of each plane.
fn cells_of(cells: std::ops::Range<usize>, planes: &Planes) -> [&[f32]; 3] {
    planes.each_ref().map(|plane| &plane[cells.clone()])
}

/// Adds a row of cells by their share to the texels that they are in, or to nothing; fewer cells than texels are repeated.
fn add_row(texels: &mut [f32], cells: &[f32], share: f32, first: bool) {
    if first {
        texels.fill(0.0);
    }
    // Nearly always two cells a texel: pairs are added many at once.
    if cells.len() == 2 * texels.len() {
        for (texel, [a, b]) in texels.iter_mut().zip(cells.as_chunks().0) {
            *texel += share * (a + b);
        }
    } else if cells.len() > texels.len() {
        let side = cells.len() / texels.len();
        texels.iter_mut().zip(cells.chunks_exact(side)).for_each(|(texel, cells)| *texel += share * cells.iter().sum::<f32>());
    } else {
        let count = texels.len();
        (0..).zip(texels).for_each(|(texel, sum)| *sum += share * cells[texel * cells.len() / count]);
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

    #[inline(always)]
    fn holds(self, value: f32) -> bool {
        (value > self.floor) & (value < self.ceiling)
    }

    #[inline(always)]
    fn clamp(self, value: f32) -> f32 {
        let value = if value > self.floor { value } else { self.floor };
        if value < self.ceiling { value } else { self.ceiling }
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
pub(super) struct Exposure {
    arch: Arch,
    /// Logarithm of radiance over gain, channel by channel; not a number where the texel has not been within the range yet.
    reference: Planes,
    /// Luminance of the last frame; empty if there is none.
    before: Vec<f32>,
    gain: DVec3,
    /// Logarithm of this frame's radiance, channel by channel, and its luminance.
    logarithms: Planes,
    luminance: Vec<f32>,
    /// Logarithms of ratios as integers of the same order.
    ratios: Vec<i32>,
}

impl Default for Exposure {
    fn default() -> Self {
        let texels = || vec![0.0; COLUMNS * ROWS];
        Self {
            arch: Arch::new(),
            reference: std::array::from_fn(|_| vec![f32::NAN; COLUMNS * ROWS]),
            before: Vec::with_capacity(COLUMNS * ROWS),
            gain: DVec3::ZERO,
            logarithms: std::array::from_fn(|_| texels()),
            luminance: texels(),
            ratios: vec![0; COLUMNS * ROWS],
        }
    }
}

impl Exposure {
    /// Forgets everything: the next frame has gain 1.
    pub(super) fn reset(&mut self) {
        self.reference.iter_mut().for_each(|reference| reference.fill(f32::NAN));
        self.before.clear();
        self.gain = DVec3::ZERO;
    }

    /// Compares a frame with those before it, `dt_s` after the last one.
    pub(super) fn measure(&mut self, coarse: &Coarse, hdr: bool, dt_s: f64) -> Change {
        let share = (1.0 - (-dt_s / RENEWAL_S).exp()) as f32;
        self.arch.dispatch(Measure { exposure: self, coarse, range: Range::of(coarse, hdr), share })
    }
}

/// [`Exposure::measure`] for whatever vectors there are; `share` is what the reference takes on of this frame.
struct Measure<'a> {
    exposure: &'a mut Exposure,
    coarse: &'a Coarse,
    range: Range,
    share: f32,
}

impl WithSimd for Measure<'_> {
    type Output = Change;

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) -> Change {
        self.take();
        let gain = DVec3::new(self.channel_gain(0), self.channel_gain(1), self.channel_gain(2));
        let step = (gain - self.exposure.gain).dot(LUMA.as_dvec3()) as f32;
        let cut = !self.exposure.before.is_empty() && self.changed_share(step) > CUT_SHARE;
        self.exposure.gain = gain;
        self.renew();
        Change { gain, cut }
    }
}

/// Texels that take part.
const MIDDLE: std::ops::Range<usize> = FIRST_ROW * COLUMNS..(ROWS - FIRST_ROW) * COLUMNS;

impl Measure<'_> {
    #[inline(always)]
    fn take(&mut self) {
        let Exposure { logarithms, luminance, .. } = &mut *self.exposure;
        let [red, green, blue] = &self.coarse.radiance;
        for (((luminance, r), g), b) in luminance.iter_mut().zip(red).zip(green).zip(blue) {
            *luminance = LUMA.x * r + LUMA.y * g + LUMA.z * b;
        }
        for (logarithms, radiance) in logarithms.iter_mut().zip([red, green, blue]) {
            for (logarithm, radiance) in logarithms.iter_mut().zip(radiance) {
                *logarithm = ln(*radiance);
            }
        }
    }

    #[inline(always)]
    fn channel_gain(&mut self, channel: usize) -> f64 {
        let Exposure { reference, logarithms, ratios, gain, .. } = &mut *self.exposure;
        let radiance = &self.coarse.radiance;
        let texels = radiance[channel][MIDDLE].iter().zip(&logarithms[channel][MIDDLE]).zip(&reference[channel][MIDDLE]);
        let mut count = 0;
        // Written wherever it belongs and kept where it counts: which texels do is no pattern that a processor could foresee.
        for ((radiance, logarithm), reference) in texels {
            ratios[count] = ordered(logarithm - reference);
            count += usize::from(self.range.holds(*radiance) & !reference.is_nan());
        }
        if count < LEAST_TEXELS { gain[channel] } else { f64::from(from_ordered(nth(&ratios[..count], count / 2))) }
    }

    /// Share of the informative texels that differ from the last frame's by more than the gain explains.
    #[inline(always)]
    fn changed_share(&self, gain_step: f32) -> f64 {
        let range = self.range;
        let (least, most) = ((gain_step - CHANGED).exp(), (gain_step + CHANGED).exp());
        let (mut changed, mut informative) = (0u32, 0u32);
        for (now, before) in self.exposure.luminance[MIDDLE].iter().zip(&self.exposure.before[MIDDLE]) {
            let (now, before) = (*now, *before);
            let ratio = range.clamp(now) / range.clamp(before);
            // A clamped value says only that the truth lies further out.
            let may_rise = (before <= range.floor) | (now >= range.ceiling);
            let may_fall = (before >= range.ceiling) | (now <= range.floor);
            let differs = ((ratio > most) & (may_rise | !may_fall)) | ((ratio < least) & !may_rise);
            let informs = range.holds(now) | range.holds(before) | ((now < range.floor) != (before < range.floor));
            // Sums that are checked for overflow are added one by one.
            informative = informative.wrapping_add(u32::from(informs));
            changed = changed.wrapping_add(u32::from(informs & differs));
        }
        if (informative as usize) < LEAST_TEXELS { 0.0 } else { f64::from(changed) / f64::from(informative) }
    }

    #[inline(always)]
    fn renew(&mut self) {
        let Exposure { reference, before, gain, logarithms, luminance, .. } = &mut *self.exposure;
        let radiance = &self.coarse.radiance;
        for channel in 0..3 {
            let gain = gain[channel] as f32;
            let texels = radiance[channel].iter().zip(&logarithms[channel]);
            for (reference, (radiance, logarithm)) in reference[channel].iter_mut().zip(texels) {
                let canonical = logarithm - gain;
                let known = if reference.is_nan() { canonical } else { *reference };
                let renewed = known + self.share * (canonical - known);
                *reference = if self.range.holds(*radiance) { renewed } else { *reference };
            }
        }
        before.clear();
        before.extend_from_slice(luminance);
    }
}

/// A float as an integer: the order of the integers is that of the floats.
#[inline(always)]
fn ordered(value: f32) -> i32 {
    let bits = value.to_bits() as i32;
    bits ^ ((bits >> 31) & i32::MAX)
}

/// The float of an integer of [`ordered`], which is its own inverse.
#[inline(always)]
fn from_ordered(integer: i32) -> f32 {
    f32::from_bits((integer ^ ((integer >> 31) & i32::MAX)) as u32)
}

/// The value that `n` others come before. Halving what is left of all integers takes up to 32 looks at every value, many values at a time,
/// which is several times as fast as sorting some of them one by one.
#[inline(always)]
fn nth(values: &[i32], n: usize) -> i32 {
    let (mut first, mut last) = (i32::MAX, i32::MIN);
    for value in values {
        first = first.min(*value);
        last = last.max(*value);
    }
    while first < last {
        // The mean, rounded down; the sum itself may overflow.
        let middle = (first & last) + ((first ^ last) >> 1);
        let mut below = 0u32;
        for value in values {
            below = below.wrapping_add(u32::from(*value <= middle));
        }
        if below as usize > n {
            last = middle;
        } else {
            first = middle + 1;
        }
    }
    first
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
    fn cells_and_texels_make_the_same_coarse_panorama() {
        for width in [32, 64, 128, 256] {
            let size = Grid { width, height: width / 2, supersample: 1 };
            let mut panorama = Panorama::new(size, Lift::Linear);
            (0..(width * width / 2) as usize).for_each(|texel| {
                panorama.set_radiance(texel, Vec3::new((texel * 7919 % 101) as f32, (texel % 13) as f32, 1.0 + (texel / 50) as f32));
            });
            let (mut expected, mut got) = (Coarse::default(), Coarse::default());
            expected.take(&panorama);
            // Twice: nothing of the first frame may stay.
            (0..2).for_each(|_| got.take_cells(&panorama.channels, width as usize));
            for texel in 0..COLUMNS * ROWS {
                let (got, expected) = (got.at(texel), expected.at(texel));
                assert!((got - expected).abs().max_element() < 1e-5 * expected.max_element(), "{width}: {got} against {expected}");
            }
        }
    }

    #[test]
    fn the_nth_value_is_that_of_a_sorted_list() {
        let mut values: Vec<f32> = (0..1001).map(|i: i32| ((i * 7919 % 1009) as f32 - 500.0) * 1e-3).collect();
        values.extend([0.0, -0.0, 1e30, -1e30]);
        let integers: Vec<i32> = values.iter().map(|value| ordered(*value)).collect();
        values.sort_by(f32::total_cmp);
        for (n, value) in values.iter().enumerate() {
            assert_eq!(from_ordered(nth(&integers, n)).to_bits(), value.to_bits(), "{n}");
        }
    }

    #[test]
    fn what_changes_in_a_small_part_is_neither_gain_nor_cut_and_another_place_is_a_cut() {
        let mut exposure = Exposure::default();
        exposure.measure(&place(8, Vec3::ONE), false, 0.0);
        let mut lit = place(8, Vec3::ONE);
        lit.radiance
            .iter_mut()
            .flat_map(|plane| plane.chunks_mut(COLUMNS))
            .for_each(|row| row[..COLUMNS / 4].iter_mut().for_each(|texel| *texel *= 2.0));
        let change = exposure.measure(&lit, false, 1.0 / 30.0);
        assert!(change.gain.abs().max_element() < 1e-5 && !change.cut, "{change:?}");
        assert!(exposure.measure(&place(6, Vec3::ONE), false, 1.0 / 30.0).cut);
    }
}
