//! Light that clipping took from an LDR frame, as far as the rest of the frame gives it away.
//!
//! A camera that shows a place well clips its sun, lamps and windows to display white. What they really held follows, within a factor of
//! three or so, from where they stand, how large they are, how bright their surroundings are and how bright the ground is beneath them:
//! [`excess`] makes of these four the logarithm of hidden over shown luminance, cell by cell. [`curve`] draws a smooth curve through the
//! cells, four numbers a frame, so that a viewer can lift its own copy of the video in the same way ([`Lift::Recovered`](mr360_protocol::light::Lift));
//! over thirty-five panoramas the irradiance of the curve is as near to the truth as that of the cells. A frame without clipped texels is left as it is, and true HDR
//! never comes here.
//!
//! How sure all this is, is said with it: [`Recovered::sigma`].

use glam::Vec3;
use mr360_protocol::light::{MAX_TINT_LN, Recovery, SH25};
use mr360_shaders::colour::recovery_tint;
use pulp::{Arch, Simd, WithSimd};

use super::luminance::Luminance;
use super::panorama::{Panorama, Rows};
use super::radiance::Planes;
use super::sampling::Grid;
use super::series::Series;

mod blur;
mod cells;
mod curve;
mod excess;
mod places;
#[cfg(test)]
mod tests;

use super::vectors::{arch_for_rows, load, repeat_sides, store, vectors};
use blur::Blur;
use cells::Cells;
use places::{Blurred, Places};

/// Half widths of the blurs, degrees: the rim of a clipped region; its size; its surroundings.
const RIM_DEG: f32 = 2.8;
const SIZE_DEG: f32 = 8.4;
const SURROUNDINGS_DEG: f32 = 22.5;
/// Share of blue's contrast to green on the rim that what is hidden has; red has all of it.
const BLUE_SHARE: f32 = 0.7;

/// What was recovered.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Recovered {
    /// The curve by which the panorama was lifted.
    pub(super) curve: Recovery,
    /// Luminous flux added, as a share of all that there is now.
    pub(super) hidden_share: f32,
    /// Standard deviation of the logarithm of that flux.
    pub(super) sigma: f32,
}

/// Recovers frame after frame of one size without allocating.
pub(super) struct Recoverer {
    cells: Cells,
    blur: Blur,
    size: Vec<f32>,
    rim: Vec<f32>,
    shown: Vec<f32>,
    open: Vec<f32>,
    places: Places,
    /// What the curve says at each cell that holds anything clipped; left from earlier frames elsewhere.
    gains: Vec<f32>,
    /// The same at each column of texels, along one row of cells.
    gains_of_row: Vec<f32>,
    /// Of the cells.
    series: Series,
    arch: Arch,
}

impl Recoverer {
    /// For panoramas of this size.
    pub(super) fn new(size: Grid) -> Self {
        let cells = Cells::new(size);
        let count = cells.columns * cells.rows;
        let field = || vec![0.0; count];
        Self {
            blur: Blur::new(cells.columns, &cells.solid_angle_sr, &cells.latitude),
            size: field(),
            rim: field(),
            shown: field(),
            open: field(),
            places: Places::new(count),
            gains: field(),
            gains_of_row: vec![0.0; size.width as usize],
            series: Series::new(Grid { width: cells.columns as u32, height: cells.rows as u32, supersample: 1 }, SH25),
            arch: arch_for_rows(size.width as usize),
            cells,
        }
    }

    /// Begins a panorama.
    pub(super) fn begin(&mut self) {
        self.cells.begin();
    }

    /// How many rows of texels are seen at once.
    pub(super) fn rows_at_once(&self) -> usize {
        self.cells.side
    }

    /// Sees the next rows of a linear panorama, whose display white is 1, and writes their luminance.
    pub(super) fn see(&mut self, rows: &Rows<'_>, luminance: &mut Luminance) {
        self.cells.take(rows, luminance.part(rows.first));
    }

    /// Writes the coefficients of the panorama as it was seen. What is shown is white at most, and even over a cell to within a thousandth.
    pub(super) fn project(&self, sh: &mut [Vec3; SH25]) {
        self.series.project_planes(&self.cells.radiance, sh);
    }

    /// Adds the coefficients of what was recovered: a few bright texels, each where it is; `texels` is the panorama's.
    pub(super) fn project_hidden(&self, texels: &Series, recovered: &Recovered, sh: &mut [Vec3; SH25]) {
        let hidden = texels.project_rows(self.brightened_rows().map(|row| (row, self.row_of(&self.cells.lit, row))));
        let tint = recovery_tint(&recovered.curve);
        sh.iter_mut().zip(hidden).for_each(|(sum, hidden)| *sum += tint * hidden as f32);
    }

    /// Rows of texels that recovery may have brightened.
    fn brightened_rows(&self) -> impl Iterator<Item = usize> {
        let (side, width) = (self.cells.side, self.gains_of_row.len());
        let rows = self.cells.hot.chunks_exact(width).enumerate().filter(|(_, hot)| hot.contains(&true));
        rows.flat_map(move |(row, _)| row * side..(row + 1) * side)
    }

    fn row_of<'a>(&self, texels: &'a [f32], row: usize) -> &'a [f32] {
        let width = self.gains_of_row.len();
        &texels[row * width..(row + 1) * width]
    }

    /// Mean radiance of the panorama's cells, as it is now, and how many make a row.
    pub(super) fn cells(&self) -> (&Planes, usize) {
        (&self.cells.radiance, self.cells.columns)
    }

    /// Brightens the clipped texels of a panorama that was seen, and their luminance. None when there are none.
    pub(super) fn recover(&mut self, panorama: &mut Panorama, luminance: &mut Luminance) -> Option<Recovered> {
        if self.cells.clipped_sr <= 0.0 {
            return None;
        }
        self.describe();
        let tint_ln = self.arch.dispatch(RimSums { recoverer: self }).tint_ln();
        let (gain_ln, slope) = curve::through(self.arch, &mut self.places);
        let curve = Recovery { gain_ln, slope, tint_ln };
        let hidden = self.brighten(panorama, luminance, &curve);
        let hidden_share = (hidden / (hidden + self.cells.flux)) as f32;
        let clipped_share = (self.cells.clipped_sr / (4.0 * std::f64::consts::PI)) as f32;
        Some(Recovered { curve, hidden_share, sigma: excess::sigma(self.cells.ground_ln(), clipped_share, hidden_share) })
    }

    /// Degree to which each texel of the last panorama is clipped in all channels, in [0, 1].
    pub(super) fn clipped(&self) -> &[f32] {
        &self.cells.clipped
    }

    /// How much of what lies around each texel of the last panorama, within [`RIM_DEG`], is clipped.
    pub(super) fn density(&self) -> Density<'_> {
        Density { share: &self.rim, columns: self.cells.columns, side: self.cells.side }
    }

    /// Logarithm of hidden over shown luminance of every cell that holds any clipped texel.
    fn describe(&mut self) {
        let cells = &self.cells;
        self.blur.run(&cells.clipped_share, SIZE_DEG, &mut self.size);
        self.blur.run(&cells.clipped_share, RIM_DEG, &mut self.rim);
        self.blur.run(&cells.shown, SURROUNDINGS_DEG, &mut self.shown);
        self.blur.run(&cells.open_share, SURROUNDINGS_DEG, &mut self.open);
        self.places.take(self.arch, cells, &Blurred { size: &self.size, shown: &self.shown, open: &self.open });
    }

    /// Adds what the curve says; returns the luminous flux added. The curve is read once a cell: over its 2.8° the error of that averages out.
    fn brighten(&mut self, panorama: &mut Panorama, luminance: &mut Luminance, curve: &Recovery) -> f64 {
        curve::gains(self.arch, &mut self.places, curve);
        for (cell, gain) in self.places.cells.iter().zip(&self.places.exponentials) {
            self.gains[*cell as usize] = *gain;
        }
        let tint = recovery_tint(curve);
        let Places { cells, exponentials, clipped_flux, .. } = &self.places;
        for ((cell, gain), flux) in cells.iter().zip(exponentials).zip(clipped_flux) {
            let cell = *cell as usize;
            let added = gain * flux / self.cells.solid_angle_sr[cell / self.cells.columns];
            for channel in 0..3 {
                self.cells.radiance[channel][cell] += tint[channel] * added;
            }
        }
        self.arch.dispatch(Brighten { recoverer: self, panorama, luminance, tint })
    }
}

/// A field over the cells, read at texels.
#[derive(Clone, Copy)]
pub(super) struct Density<'a> {
    share: &'a [f32],
    columns: usize,
    /// Texels along one side of a cell.
    side: usize,
}

impl Density<'_> {
    /// Along columns of a row of texels, between the middles of the cells, so that it has no steps.
    pub(super) fn along(&self, row: usize, columns: std::ops::Range<usize>, out: &mut [f32]) {
        let (side, in_row, rows) = (self.side, self.columns, self.share.len() / self.columns);
        // The cell whose middle comes next, and how far it is from the middle before, in half texels: middles of texels are odd.
        let place = |texel: usize| ((2 * texel + 1 + side) / (2 * side), (2 * texel + 1 + side) % (2 * side));
        let share = |halves: usize| halves as f32 / (2 * side) as f32;
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let (below, down) = place(row);
        let [upper, lower] = [below.saturating_sub(1), below.min(rows - 1)].map(|row| &self.share[row * in_row..(row + 1) * in_row]);
        let at = |cell: usize| mix(upper[cell % in_row], lower[cell % in_row], share(down));
        let (mut right, mut across) = place(columns.start);
        let (mut a, mut b) = (at(right + in_row - 1), at(right));
        for out in out.iter_mut().take(columns.len()) {
            *out = mix(a, b, share(across));
            across += 2;
            if across >= 2 * side {
                (right, across) = (right + 1, across - 2 * side);
                (a, b) = (b, at(right));
            }
        }
    }
}

/// Energy about the clipped regions, where lens and sensor spread their light: its colour is that of what is hidden.
struct Rim([f64; 3]);

impl Rim {
    fn tint_ln(&self) -> [f32; 2] {
        let [red, green, blue] = self.0.map(|energy| (energy + excess::LEAST_RIM) as f32);
        [((red / green).ln(), 1.0), ((blue / green).ln(), BLUE_SHARE)].map(|(ln, share)| share * ln.clamp(-MAX_TINT_LN, MAX_TINT_LN))
    }
}

/// Sums up a [`Rim`].
struct RimSums<'a> {
    recoverer: &'a Recoverer,
}

impl WithSimd for RimSums<'_> {
    type Output = Rim;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Rim {
        let Recoverer { cells, rim, .. } = self.recoverer;
        let mut energy = [0.0; 3];
        for (energy, open) in energy.iter_mut().zip(&cells.open_rgb) {
            for (open, rim) in open.chunks_exact(cells.columns).zip(rim.chunks_exact(cells.columns)) {
                let mut sum = simd.splat_f32s(0.0);
                for vector in 0..vectors::<S>(cells.columns) {
                    sum = simd.add_f32s(sum, simd.mul_f32s(load(simd, open, vector), load(simd, rim, vector)));
                }
                *energy += f64::from(simd.reduce_sum_f32s(sum));
            }
        }
        Rim(energy)
    }
}

/// Adds the gains times what is clipped to a panorama, and leaves what was added in its place.
struct Brighten<'a> {
    recoverer: &'a mut Recoverer,
    panorama: &'a mut Panorama,
    luminance: &'a mut Luminance,
    /// Of luminance 1.
    tint: Vec3,
}

impl WithSimd for Brighten<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let Recoverer { cells, gains, gains_of_row, .. } = self.recoverer;
        let kept = self.panorama.kept_rows();
        let Panorama { channels, geometry, .. } = self.panorama;
        let tint = [simd.splat_f32s(self.tint.x), simd.splat_f32s(self.tint.y), simd.splat_f32s(self.tint.z)];
        let width = gains_of_row.len();
        let mut hidden = 0.0;
        for (row, gains) in gains.chunks_exact(cells.columns).enumerate() {
            let hot = &cells.hot[row * width..][..vectors::<S>(width)];
            if !hot.contains(&true) {
                continue;
            }
            repeat_sides(gains, cells.side, gains_of_row);
            let mut upper = self.luminance.part(row * cells.side);
            let mut peak = simd.splat_f32s(0.0);
            for texel_row in row * cells.side..(row + 1) * cells.side {
                let texels = texel_row * width..(texel_row + 1) * width;
                let zero = simd.splat_f32s(0.0);
                let (mut of_row, mut squares) = (zero, zero);
                for (patch, hot) in hot.iter().enumerate() {
                    if !hot {
                        continue;
                    }
                    let added = simd.mul_f32s(load(simd, &cells.lit[texels.clone()], patch), load(simd, gains_of_row, patch));
                    store(simd, &mut cells.lit[texels.clone()], patch, added);
                    of_row = simd.add_f32s(of_row, added);
                    for (channel, tint) in channels.iter_mut().zip(&tint).filter(|_| texel_row < kept) {
                        let row = &mut channel[texels.clone()];
                        let radiance = simd.add_f32s(load(simd, row, patch), simd.mul_f32s(added, *tint));
                        store(simd, row, patch, radiance);
                    }
                    if let Some(part) = &mut upper {
                        let first = (texel_row - row * cells.side) * width;
                        let row = &mut part.texels[first..first + width];
                        let shown = load(simd, row, patch);
                        let luminance = simd.add_f32s(shown, added);
                        store(simd, row, patch, luminance);
                        squares = simd.add_f32s(squares, simd.mul_f32s(simd.add_f32s(shown, luminance), added));
                        peak = simd.max_f32s(peak, luminance);
                    }
                }
                let texel_sr = f64::from(geometry.solid_angle_sr[texel_row]);
                let energy = f64::from(simd.reduce_sum_f32s(of_row)) * texel_sr;
                hidden += energy;
                if let Some(part) = &mut upper {
                    part.sums.energy += energy;
                    part.sums.squares += f64::from(simd.reduce_sum_f32s(squares)) * texel_sr;
                }
            }
            if let Some(part) = &mut upper {
                part.sums.peak = part.sums.peak.max(simd.reduce_max_f32s(peak));
            }
        }
        hidden
    }
}
