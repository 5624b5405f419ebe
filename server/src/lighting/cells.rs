//! A working panorama in coarse: the mean radiance of squares of its texels.

#[cfg(test)]
use glam::Vec3;
use pulp::{Arch, Simd, WithSimd};

use super::panorama::{Geometry, Panorama};
use super::radiance::Planes;
use super::sampling::Grid;

/// Rows of texels that are added in one go; the sides of squares are powers of two.
const AT_ONCE: usize = 4;

/// Means over squares of texels, weighted by solid angle; refilled from frame to frame without allocating.
pub(super) struct Cells {
    columns: usize,
    /// Mean radiance, row by row from the top.
    pub(super) channels: Planes,
    arch: Arch,
    side: usize,
    /// Share of each row of texels in its cell's solid angle, over the texels of a row.
    shares: Vec<f32>,
    /// Weighted sums of one row of cells, a value a column of texels.
    sums: Vec<f32>,
}

impl Cells {
    /// For panoramas of this size, squares of `side` × `side` texels; both sides of the panorama are multiples of `side`.
    pub(super) fn new(size: Grid, side: u32) -> Self {
        let side = side.max(1);
        let (columns, rows) = (size.width / side, size.height / side);
        let texels = Geometry::new(size);
        let shares = texels.solid_angle_sr.chunks_exact(side as usize).flat_map(|rows| {
            let whole = rows.iter().sum::<f32>() * side as f32;
            rows.iter().map(move |texel_sr| texel_sr / whole)
        });
        Self {
            columns: columns as usize,
            channels: std::array::from_fn(|_| vec![0.0; columns as usize * rows as usize]),
            arch: Arch::new(),
            side: side as usize,
            shares: shares.collect(),
            sums: vec![0.0; size.width as usize],
        }
    }

    /// Takes in a panorama of the size given to [`Cells::new`].
    pub(super) fn take(&mut self, panorama: &Panorama) {
        self.arch.dispatch(Take { cells: self, panorama });
    }

    /// Mean radiance of the cell with this index.
    #[cfg(test)]
    pub(super) fn radiance(&self, cell: usize) -> Vec3 {
        Vec3::new(self.channels[0][cell], self.channels[1][cell], self.channels[2][cell])
    }
}

/// [`Cells::take`] for whatever vectors there are.
struct Take<'a> {
    cells: &'a mut Cells,
    panorama: &'a Panorama,
}

impl WithSimd for Take<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Cells { columns, channels, side, shares, sums, .. } = self.cells;
        // From the bottom up: whoever read the panorama before has left its last rows in the cache.
        for (row, shares) in shares.chunks_exact(*side).enumerate().rev() {
            for (channel, cells) in channels.iter_mut().enumerate() {
                for (i, shares) in shares.chunks(AT_ONCE).enumerate() {
                    let first = row * *side + i * AT_ONCE;
                    let texels = |k: usize| self.panorama.row(channel, first + k);
                    match *shares {
                        [a] => add_rows([texels(0)], [a], i > 0, sums),
                        [a, b] => add_rows([texels(0), texels(1)], [a, b], i > 0, sums),
                        [a, b, c, d] => add_rows([texels(0), texels(1), texels(2), texels(3)], [a, b, c, d], i > 0, sums),
                        _ => {}
                    }
                }
                gather(sums, *side, &mut cells[row * *columns..(row + 1) * *columns]);
            }
        }
    }
}

/// Adds rows of texels by their shares to what the sums hold, or to nothing.
#[inline(always)]
fn add_rows<const ROWS: usize>(rows: [&[f32]; ROWS], shares: [f32; ROWS], further: bool, sums: &mut [f32]) {
    let texels = rows.iter().fold(sums.len(), |texels, row| texels.min(row.len()));
    let rows = rows.map(|row| &row[..texels]);
    for (texel, sum) in sums[..texels].iter_mut().enumerate() {
        let mut weighted = if further { *sum } else { 0.0 };
        for row in 0..ROWS {
            weighted += shares[row] * rows[row][texel];
        }
        *sum = weighted;
    }
}

/// Adds up every `side` of the sums.
#[inline(always)]
fn gather(sums: &[f32], side: usize, cells: &mut [f32]) {
    match side {
        4 => {
            for (cell, [a, b, c, d]) in cells.iter_mut().zip(sums.as_chunks().0) {
                *cell = (a + b) + (c + d);
            }
        }
        8 => {
            for (cell, [a, b, c, d, e, f, g, h]) in cells.iter_mut().zip(sums.as_chunks().0) {
                *cell = ((a + b) + (c + d)) + ((e + f) + (g + h));
            }
        }
        side => {
            for (cell, texels) in cells.iter_mut().zip(sums.chunks_exact(side)) {
                *cell = texels.iter().sum();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::Lift;

    use super::*;

    #[test]
    fn cells_hold_the_energy_of_their_texels() {
        for side in [1, 2, 4, 8] {
            let size = Grid { width: 64, height: 32, supersample: 1 };
            let mut panorama = Panorama::new(size, Lift::Linear);
            for texel in 0..64 * 32 {
                panorama.set_radiance(texel, Vec3::new((texel * 7919 % 101) as f32, (texel / 64) as f32, 1.0));
            }
            let mut cells = Cells::new(size, side);
            // Twice: nothing of the first frame may stay.
            cells.take(&panorama);
            cells.take(&panorama);
            let geometry = Geometry::new(Grid { width: 64 / side, height: 32 / side, supersample: 1 });
            let side = side as usize;
            for cell in 0..cells.channels[0].len() {
                let (row, column) = (cell / cells.columns, cell % cells.columns);
                let (mut energy, mut solid_angle_sr) = (Vec3::ZERO, 0.0);
                for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (row * side + y, column * side + x))) {
                    energy += panorama.radiance(y * 64 + x) * panorama.geometry.solid_angle_sr[y];
                    solid_angle_sr += panorama.geometry.solid_angle_sr[y];
                }
                let got = cells.radiance(cell) * geometry.solid_angle_sr[row];
                assert!((got - energy).abs().max_element() < 1e-5 * energy.max_element(), "{side} {cell}: {got} against {energy}");
                assert!((geometry.solid_angle_sr[row] / solid_angle_sr - 1.0).abs() < 1e-5);
            }
        }
    }
}
