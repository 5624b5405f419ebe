//! Cells that hold anything clipped, listed, so that many are worked on at once and no others.

use pulp::{Arch, Simd, WithSimd};

use super::cells::Cells;
use super::excess::{self, Surroundings};
use crate::lighting::radiance::Planes;
use crate::lighting::vectors::all_zero;

/// The clipped cells of one frame; all lists are as long.
pub(super) struct Places {
    /// Their indices among the cells.
    pub(super) cells: Vec<u32>,
    /// Their middles, coordinate by coordinate.
    pub(super) directions: Planes,
    /// Luminous flux of their clipped channels as shown.
    pub(super) clipped_flux: Vec<f32>,
    /// Logarithm of hidden over shown luminance.
    pub(super) excess_ln: Vec<f32>,
    /// For whatever power of e is needed of each.
    pub(super) exponentials: Vec<f32>,
    size: Vec<f32>,
    shown: Vec<f32>,
    open: Vec<f32>,
}

/// Fields that are blurred over the cells.
pub(super) struct Blurred<'a> {
    /// Clipped share of the neighbourhood.
    pub(super) size: &'a [f32],
    /// Luminance of what is not clipped, and its share.
    pub(super) shown: &'a [f32],
    pub(super) open: &'a [f32],
}

impl Places {
    /// With room for this many.
    pub(super) fn new(cells: usize) -> Self {
        let list = || Vec::with_capacity(cells);
        Self {
            cells: Vec::with_capacity(cells),
            directions: std::array::from_fn(|_| list()),
            clipped_flux: list(),
            excess_ln: list(),
            exponentials: list(),
            size: list(),
            shown: list(),
            open: list(),
        }
    }

    /// Lists the clipped cells and works out what each hides.
    pub(super) fn take(&mut self, arch: Arch, cells: &Cells, blurred: &Blurred<'_>) {
        self.cells.clear();
        for (row, flux) in cells.clipped_flux.chunks_exact(cells.columns).enumerate().filter(|(_, flux)| !all_zero(flux)) {
            let clipped = flux.iter().enumerate().filter(|(_, flux)| **flux > 0.0);
            self.cells.extend(clipped.map(|(column, _)| (row * cells.columns + column) as u32));
        }
        let pick = |list: &mut Vec<f32>, field: &[f32]| {
            list.clear();
            list.extend(self.cells.iter().map(|cell| field[*cell as usize]));
        };
        self.directions.iter_mut().zip(&cells.directions).for_each(|(list, field)| pick(list, field));
        pick(&mut self.clipped_flux, &cells.clipped_flux);
        pick(&mut self.size, blurred.size);
        pick(&mut self.shown, blurred.shown);
        pick(&mut self.open, blurred.open);
        self.excess_ln.resize(self.cells.len(), 0.0);
        self.exponentials.resize(self.cells.len(), 0.0);
        arch.dispatch(Excess { places: self, ground_ln: cells.ground_ln() });
    }
}

/// [`excess::excess_ln`] of every place, for whatever vectors there are.
struct Excess<'a> {
    places: &'a mut Places,
    ground_ln: f32,
}

impl WithSimd for Excess<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let ground_ln = self.ground_ln;
        let Places { directions: [_, height, _], excess_ln, size, shown, open, .. } = self.places;
        for ((((out, size), height), shown), open) in excess_ln.iter_mut().zip(size).zip(height).zip(shown).zip(open) {
            let brightness_ln = excess::brightness_ln(*shown, *open);
            *out = excess::excess_ln(&Surroundings { size: *size, height: *height, ground_ln, brightness_ln });
        }
    }
}
