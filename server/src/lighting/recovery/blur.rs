//! A blur on the sphere, near enough to a Gaussian: two passes of a box whose width is an angle.

use pulp::{Arch, Simd, WithSimd};

use crate::lighting::transpose::{SIDE, Square, Transpose, WithTranspose, dispatch};
use crate::lighting::vectors::{all_zero, load, store, vectors};

/// Blurs fields of one size.
pub(super) struct Blur {
    columns: usize,
    /// Of one cell of each row.
    solid_angle_sr: Vec<f32>,
    /// Of each row's middle.
    cos_latitude: Vec<f32>,
    pass: Vec<f32>,
    /// Running sums along each of eight rows, once around and as far again as a box may reach; the first is zero.
    along: Vec<f32>,
    /// Running sums of every column.
    down: Vec<f32>,
    arch: Arch,
}

impl Blur {
    /// For fields of rows of this many cells, a multiple of eight; solid angle of one cell of each row, and the rows' latitudes.
    pub(super) fn new(columns: usize, solid_angle_sr: &[f32], latitude: &[f32]) -> Self {
        Self {
            columns,
            solid_angle_sr: solid_angle_sr.to_vec(),
            cos_latitude: latitude.iter().map(|latitude| latitude.cos().max(1e-3)).collect(),
            pass: vec![0.0; columns * latitude.len()],
            along: vec![0.0; SIDE * (2 * columns + 1)],
            down: vec![0.0; columns],
            arch: Arch::new(),
        }
    }

    /// Blurs `field` into `out` by a box that reaches this many degrees to either side, twice.
    pub(super) fn run(&mut self, field: &[f32], half_width_deg: f32, out: &mut [f32]) {
        let cells = (half_width_deg * self.columns as f32 / 360.0).round() as usize;
        let arch = self.arch;
        dispatch(arch, AlongRows { blur: self, field, cells });
        arch.dispatch(DownColumns { blur: self, cells, out });
        dispatch(arch, AlongRows { blur: self, field: out, cells });
        arch.dispatch(DownColumns { blur: self, cells, out });
    }
}

/// Means over a box as wide in every row, wrapped around; a row that the box does not fit into is made even.
struct AlongRows<'a> {
    blur: &'a mut Blur,
    field: &'a [f32],
    cells: usize,
}

impl WithTranspose for AlongRows<'_> {
    #[inline(always)]
    fn with<T: Transpose>(self, transpose: T) {
        let Blur { columns, cos_latitude, pass, along, .. } = self.blur;
        let columns = *columns;
        let groups = self.field.chunks(SIDE * columns).zip(pass.chunks_mut(SIDE * columns)).zip(cos_latitude.chunks(SIDE));
        for ((rows, out), cos_latitude) in groups {
            // Most of a frame is not clipped at all.
            if all_zero(rows) {
                out.fill(0.0);
                continue;
            }
            add_along(transpose, rows, columns, along);
            let sums = along.chunks_exact_mut(2 * columns + 1);
            for ((out, sums), cos_latitude) in out.chunks_exact_mut(columns).zip(sums).zip(cos_latitude) {
                let reach = (self.cells as f32 / cos_latitude).round() as usize;
                mean_along(sums, reach, out);
            }
        }
    }
}

/// Running sums of up to eight rows, with a zero before each. A sum waits for the one before it; eight rows wait together.
#[inline(always)]
fn add_along(transpose: impl Transpose, rows: &[f32], columns: usize, sums: &mut [f32]) {
    let mut values = rows.chunks_exact(columns);
    let values = std::array::from_fn::<_, SIDE, _>(|_| values.next().unwrap_or_default().as_chunks::<SIDE>().0);
    let mut sums = sums.chunks_exact_mut(2 * columns + 1);
    let mut sums = std::array::from_fn::<_, SIDE, _>(|_| sums.next().unwrap_or_default());
    sums.iter_mut().filter_map(|row| row.first_mut()).for_each(|first| *first = 0.0);
    let mut sums = sums.map(|row| row.get_mut(1..).unwrap_or_default().as_chunks_mut::<SIDE>().0);
    let mut sum = [0.0; SIDE];
    for group in 0..columns / SIDE {
        let square: Square = std::array::from_fn(|row| values[row].get(group).copied().unwrap_or_default());
        let mut square = transpose.transposed(square);
        for column in &mut square {
            for lane in 0..SIDE {
                sum[lane] += column[lane];
            }
            *column = sum;
        }
        for (row, values) in sums.iter_mut().zip(transpose.transposed(square)) {
            if let Some(place) = row.get_mut(group) {
                *place = values;
            }
        }
    }
}

/// Means over boxes from the running sums of a row.
#[inline(always)]
fn mean_along(sums: &mut [f32], reach: usize, out: &mut [f32]) {
    let columns = out.len();
    let width = 2 * reach + 1;
    let whole = sums[columns];
    if width >= columns {
        out.fill(whole / columns as f32);
        return;
    }
    let (once, again) = sums.split_at_mut(columns + 1);
    for (sum, from_start) in again.iter_mut().zip(&once[1..=width]) {
        *sum = whole + from_start;
    }
    let (before, after) = out.split_at_mut(reach);
    // The box that begins at the first cell has its middle `reach` cells on.
    for (out, start) in [(after, 0), (before, columns - reach)] {
        for ((out, from), to) in out.iter_mut().zip(&sums[start..]).zip(&sums[start + width..]) {
            *out = (to - from) * (1.0 / width as f32);
        }
    }
}

/// Means over a box down the columns, weighted by solid angle and cut at the poles.
struct DownColumns<'a> {
    blur: &'a mut Blur,
    cells: usize,
    out: &'a mut [f32],
}

impl WithSimd for DownColumns<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Blur { columns, solid_angle_sr, pass, down, .. } = self.blur;
        let (columns, rows, cells) = (*columns, solid_angle_sr.len(), self.cells);
        down.fill(0.0);
        for row in 0..cells.min(rows) {
            let share = solid_angle_sr[row];
            for (sum, value) in down.iter_mut().zip(&pass[row * columns..(row + 1) * columns]) {
                *sum += share * value;
            }
        }
        for (row, out) in self.out.chunks_exact_mut(columns).enumerate() {
            // Where the box is cut, nothing of whatever row enters or leaves.
            let (below, above) = (row + cells, row.checked_sub(cells + 1));
            let (entering, enters) = if below < rows { (below, solid_angle_sr[below]) } else { (0, 0.0) };
            let (leaving, leaves) = above.map_or((0, 0.0), |above| (above, solid_angle_sr[above]));
            let (entering, leaving) =
                (&pass[entering * columns..(entering + 1) * columns], &pass[leaving * columns..(leaving + 1) * columns]);
            let weight: f32 = solid_angle_sr[row.saturating_sub(cells)..(below + 1).min(rows)].iter().sum();
            let (enters, leaves, inverse) = (simd.splat_f32s(enters), simd.splat_f32s(leaves), simd.splat_f32s(1.0 / weight));
            for vector in 0..vectors::<S>(columns) {
                let sum = simd.add_f32s(load(simd, down, vector), simd.mul_f32s(enters, load(simd, entering, vector)));
                let sum = simd.sub_f32s(sum, simd.mul_f32s(leaves, load(simd, leaving, vector)));
                store(simd, down, vector, sum);
                store(simd, out, vector, simd.mul_f32s(sum, inverse));
            }
        }
    }
}
