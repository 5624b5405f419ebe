//! Area averages of a plane of samples over a grid of equal cells, fractions of pixels at the cells' edges included, and
//! the averages of the samples' squares.
//!
//! Eight rows of cells are made at a time. Downwards, whole rows of pixels are added, several pixels at once. Across, a
//! ratio such as 1280:512 has another pattern of weights in every cell, which no vector unit likes; so the eight rows are
//! turned into columns first, and what is added at once are the same pixels of eight rows. All of it are plain loops over
//! arrays of eight, compiled for the widest vectors that the processor has (`pulp`). No sum is fused with its product, so
//! that every processor finds the same light. 8-bit samples take a shorter way where the ratio allows it ([`super::taps`]).

use pulp::Arch;

use super::taps::Taps;
use super::transpose::{SIDE, Transpose, WithTranspose, dispatch};

/// Rows of cells that are made at a time.
const BAND: usize = SIDE;
/// Pixels of a row that are added downwards before they are turned: little enough to stay in the fastest cache, and an odd number of its lines,
/// lest the eight rows compete for the same places in it.
const STRIP: usize = 656;
/// Source rows that are added in one go.
pub(super) const MOST_AT_ONCE: usize = 4;

/// For each of a number of equal cells along an axis: which pixels lie in it, and with what share of its length.
#[derive(Debug, Default)]
pub(super) struct Shares {
    first: Vec<u32>,
    /// `each` shares a cell, those of pixels outside it zero.
    shares: Vec<f32>,
    each: usize,
    pixels: u32,
}

impl Shares {
    /// Recomputes the shares if the sizes have changed.
    pub(super) fn fit(&mut self, pixels: u32, cells: u32) {
        if self.pixels == pixels && self.first.len() == cells as usize {
            return;
        }
        self.pixels = pixels;
        let length = f64::from(pixels) / f64::from(cells);
        // A cell that begins within a pixel ends within one, too.
        let each = pixels.min(pixels.div_ceil(cells) + 1);
        self.each = each as usize;
        self.first.clear();
        self.shares.clear();
        for cell in 0..cells {
            let edge = |cell: u32| f64::from(cell) * length;
            let first = ((u64::from(cell) * u64::from(pixels) / u64::from(cells)) as u32).min(pixels - each);
            self.first.push(first);
            self.shares.extend((first..first + each).map(|pixel| {
                let inside = f64::from(pixel + 1).min(edge(cell + 1)) - f64::from(pixel).max(edge(cell));
                (inside.max(0.0) / length) as f32
            }));
        }
    }

    /// First pixel of a cell and the shares from it on, without those that are zero.
    pub(super) fn of(&self, cell: usize) -> (usize, &[f32]) {
        let shares = self.shares.get(cell * self.each..(cell + 1) * self.each).unwrap_or_default();
        let skipped = shares.iter().take_while(|share| **share <= 0.0).count();
        let kept = shares.iter().rposition(|share| *share > 0.0).map_or(skipped, |last| last + 1);
        (self.first.get(cell).map_or(0, |first| *first as usize) + skipped, &shares[skipped..kept.max(skipped)])
    }

    /// Averages `row`, one value a pixel, over each cell.
    pub(super) fn average(&self, row: &[f32], out: &mut [f32]) {
        for ((out, first), shares) in out.iter_mut().zip(&self.first).zip(self.shares.chunks_exact(self.each.max(1))) {
            let values = row.get(*first as usize..).unwrap_or_default();
            *out = values.iter().zip(shares).map(|(value, share)| value * share).sum();
        }
    }
}

/// One plane of samples, row by row.
#[derive(Clone, Copy)]
pub(super) struct Plane<'a> {
    pub(super) data: &'a [u8],
    /// Bytes from row to row.
    pub(super) stride: usize,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Samples are ten bits in two bytes, low byte first, instead of one byte.
    pub(super) wide: bool,
}

impl Plane<'_> {
    /// Bytes of a row; none beyond the last.
    #[inline(always)]
    pub(super) fn row(&self, row: usize) -> &[u8] {
        let start = row * self.stride;
        self.data.get(start..start + self.width as usize * if self.wide { 2 } else { 1 }).unwrap_or_default()
    }
}

/// One value for each pixel of a strip, of eight rows.
type Strip = [[f32; STRIP]; BAND];
/// One value for each of eight rows.
type Column = [f32; BAND];

/// Averages over the cells of a row, and the buffers for them; reused from frame to frame.
pub(super) struct Averages {
    arch: Arch,
    taps: Taps,
    columns: Shares,
    rows: Shares,
    strips: Box<[Strip; 2]>,
    /// Averages of samples and of squares downwards, one column of eight a pixel.
    turned: [Vec<Column>; 2],
    /// The same across, one column of eight a cell, a multiple of eight cells.
    cells: Vec<Column>,
    /// The same row by row: eight rows, or one by [`Taps`].
    averages: [Vec<f32>; 2],
    width: usize,
    /// Which of those rows is meant.
    row: usize,
}

impl Default for Averages {
    fn default() -> Self {
        Self {
            arch: Arch::new(),
            taps: Taps::default(),
            columns: Shares::default(),
            rows: Shares::default(),
            strips: Box::new([[[0.0; STRIP]; BAND]; 2]),
            turned: Default::default(),
            cells: Vec::new(),
            averages: Default::default(),
            width: 0,
            row: 0,
        }
    }
}

impl Averages {
    /// Averages `plane` over the cells of row `row` of a grid of `columns` × `rows` cells. With `squares`, the samples' squares too. Rows come in
    /// order, from 0 on.
    pub(super) fn take(&mut self, plane: &Plane<'_>, row: usize, (columns, rows): (u32, u32), squares: bool) {
        self.rows.fit(plane.height, rows);
        self.width = columns as usize;
        if !plane.wide && self.taps.fit(plane.width, columns) {
            self.row = 0;
            let [means, of_squares] = &mut self.averages;
            self.taps.average(self.arch, plane, &self.rows, row, [means, of_squares], squares);
            return;
        }
        self.row = row % BAND;
        if self.row == 0 {
            self.take_band(plane, row, squares);
        }
    }

    /// Averages eight rows from `first_row` on; the last ones may be fewer.
    fn take_band(&mut self, plane: &Plane<'_>, first_row: usize, squares: bool) {
        self.columns.fit(plane.width, self.width as u32);
        let (pixels, cells) = ((plane.width as usize).next_multiple_of(BAND), self.width.next_multiple_of(BAND));
        self.cells.resize(cells, [0.0; BAND]);
        for (turned, averages) in self.turned.iter_mut().zip(&mut self.averages) {
            turned.resize(pixels, [0.0; BAND]);
            averages.resize(cells * BAND, 0.0);
        }
        dispatch(self.arch, Take { averages: self, plane, first_row, squares });
    }

    /// Averages of the samples under the row that was taken last.
    pub(super) fn means(&self) -> &[f32] {
        self.of(0)
    }

    /// Averages of the squares of the samples under that row.
    pub(super) fn squares(&self) -> &[f32] {
        self.of(1)
    }

    fn of(&self, power: usize) -> &[f32] {
        let start = self.row * self.width.next_multiple_of(BAND);
        self.averages[power].get(start..start + self.width).unwrap_or_default()
    }
}

/// [`Averages::take_band`] for whatever vectors there are: all that it calls is inlined, so that all of it gets them.
struct Take<'a, 'b> {
    averages: &'a mut Averages,
    plane: &'a Plane<'b>,
    first_row: usize,
    squares: bool,
}

impl WithTranspose for Take<'_, '_> {
    #[inline(always)]
    fn with<T: Transpose>(self, transpose: T) {
        match (self.plane.wide, self.squares) {
            (false, false) => self.run::<1, false>(transpose, |[sample]| f32::from(sample)),
            (false, true) => self.run::<1, true>(transpose, |[sample]| f32::from(sample)),
            (true, false) => self.run::<2, false>(transpose, ten_bits),
            (true, true) => self.run::<2, true>(transpose, ten_bits),
        }
    }
}

#[inline(always)]
fn ten_bits(bytes: [u8; 2]) -> f32 {
    f32::from(u16::from_le_bytes(bytes) & 1023)
}

impl Take<'_, '_> {
    #[inline(always)]
    fn run<const BYTES: usize, const SQUARES: bool>(self, transpose: impl Transpose, sample: impl Fn([u8; BYTES]) -> f32 + Copy) {
        let Averages { columns, rows, strips, turned, averages, cells, .. } = self.averages;
        let [means, squares] = strips.as_mut();
        let width = self.plane.width as usize;
        for start in (0..width).step_by(STRIP) {
            let end = (start + STRIP).min(width);
            for row in 0..BAND {
                let (first, shares) = rows.of(self.first_row + row);
                let pixels = |row: usize| {
                    let (pixels, _) = self.plane.row(first + row).as_chunks::<BYTES>();
                    pixels.get(start..end).unwrap_or_default()
                };
                add_downwards::<BYTES, SQUARES>(pixels, shares, sample, &mut means[row], &mut squares[row]);
            }
            turn(transpose, means, &mut turned[0][start..]);
            if SQUARES {
                turn(transpose, squares, &mut turned[1][start..]);
            }
        }
        for power in 0..1 + usize::from(SQUARES) {
            add_across(&turned[power], columns, cells);
            turn_back(transpose, cells, &mut averages[power]);
        }
    }
}

/// Sums of the pixels and of their squares over the rows of one row of cells, by their shares.
#[inline(always)]
fn add_downwards<'a, const BYTES: usize, const SQUARES: bool>(
    pixels: impl Fn(usize) -> &'a [[u8; BYTES]],
    shares: &[f32],
    sample: impl Fn([u8; BYTES]) -> f32 + Copy,
    means: &mut [f32; STRIP],
    squares: &mut [f32; STRIP],
) {
    for (i, shares) in shares.chunks(MOST_AT_ONCE).enumerate() {
        let row = |k: usize| pixels(i * MOST_AT_ONCE + k);
        if i == 0 {
            add_some_rows::<BYTES, SQUARES, true>(row, shares, sample, means, squares);
        } else {
            add_some_rows::<BYTES, SQUARES, false>(row, shares, sample, means, squares);
        }
    }
}

/// Up to [`MOST_AT_ONCE`] rows, the `FIRST` of a row of cells or further ones.
#[inline(always)]
fn add_some_rows<'a, const BYTES: usize, const SQUARES: bool, const FIRST: bool>(
    row: impl Fn(usize) -> &'a [[u8; BYTES]],
    shares: &[f32],
    sample: impl Fn([u8; BYTES]) -> f32,
    means: &mut [f32; STRIP],
    squares: &mut [f32; STRIP],
) {
    match *shares {
        [a] => add_rows::<_, _, SQUARES, FIRST>([row(0)], [a], sample, means, squares),
        [a, b] => add_rows::<_, _, SQUARES, FIRST>([row(0), row(1)], [a, b], sample, means, squares),
        [a, b, c] => add_rows::<_, _, SQUARES, FIRST>([row(0), row(1), row(2)], [a, b, c], sample, means, squares),
        [a, b, c, d] => add_rows::<_, _, SQUARES, FIRST>([row(0), row(1), row(2), row(3)], [a, b, c, d], sample, means, squares),
        _ => {}
    }
}

#[inline(always)]
fn add_rows<const BYTES: usize, const ROWS: usize, const SQUARES: bool, const FIRST: bool>(
    rows: [&[[u8; BYTES]]; ROWS],
    shares: [f32; ROWS],
    sample: impl Fn([u8; BYTES]) -> f32,
    means: &mut [f32; STRIP],
    squares: &mut [f32; STRIP],
) {
    let pixels = rows.iter().fold(STRIP, |pixels, row| pixels.min(row.len()));
    let rows = rows.map(|row| &row[..pixels]);
    for pixel in 0..pixels {
        let (mut mean, mut square) = if FIRST { (0.0, 0.0) } else { (means[pixel], squares[pixel]) };
        for row in 0..ROWS {
            let value = sample(rows[row][pixel]);
            let weighted = shares[row] * value;
            mean += weighted;
            square += weighted * value;
        }
        means[pixel] = mean;
        if SQUARES {
            squares[pixel] = square;
        }
    }
}

/// Turns the strip's eight rows into one column of eight for each pixel, as far as there is room.
#[inline(always)]
fn turn(transpose: impl Transpose, strip: &Strip, columns: &mut [Column]) {
    for (columns, start) in columns.as_chunks_mut::<BAND>().0.iter_mut().zip((0..STRIP).step_by(BAND)) {
        *columns = transpose.transposed(std::array::from_fn(|row| std::array::from_fn(|pixel| strip[row][start + pixel])));
    }
}

/// Averages of the turned pixels over each cell.
#[inline(always)]
fn add_across(pixels: &[Column], columns: &Shares, cells: &mut [Column]) {
    // Known counts make straight code; between them lie all ratios up to 4:1.
    match columns.each {
        2 => add_some_across::<2>(pixels, columns, cells),
        3 => add_some_across::<3>(pixels, columns, cells),
        4 => add_some_across::<4>(pixels, columns, cells),
        5 => add_some_across::<5>(pixels, columns, cells),
        each => {
            for ((cell, first), shares) in cells.iter_mut().zip(&columns.first).zip(columns.shares.chunks_exact(each.max(1))) {
                *cell = weighted(pixels.get(*first as usize..).unwrap_or_default().iter().zip(shares));
            }
        }
    }
}

#[inline(always)]
fn add_some_across<const EACH: usize>(pixels: &[Column], columns: &Shares, cells: &mut [Column]) {
    for ((cell, first), shares) in cells.iter_mut().zip(&columns.first).zip(columns.shares.as_chunks::<EACH>().0) {
        let Some(pixels) = pixels.get(*first as usize..).and_then(|pixels| pixels.first_chunk::<EACH>()) else { return };
        *cell = weighted(pixels.iter().zip(shares));
    }
}

#[inline(always)]
fn weighted<'a>(pixels: impl Iterator<Item = (&'a Column, &'a f32)>) -> Column {
    let mut sums = [0.0; BAND];
    for (pixel, share) in pixels {
        for lane in 0..BAND {
            sums[lane] += share * pixel[lane];
        }
    }
    sums
}

/// Turns columns of eight back into eight rows.
#[inline(always)]
fn turn_back(transpose: impl Transpose, cells: &[Column], rows: &mut [f32]) {
    let mut rows = rows.chunks_exact_mut(cells.len());
    let mut rows = std::array::from_fn::<_, BAND, _>(|_| rows.next().unwrap_or_default().as_chunks_mut::<BAND>().0);
    let groups = rows.iter().fold(cells.len() / BAND, |groups, row| groups.min(row.len()));
    let (cells, _) = cells.as_chunks::<BAND>();
    rows.iter_mut().for_each(|row| *row = &mut std::mem::take(row)[..groups]);
    for (group, columns) in cells[..groups].iter().enumerate() {
        for (row, values) in rows.iter_mut().zip(transpose.transposed(*columns)) {
            row[group] = values;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_sum_to_one_and_cover_every_pixel() {
        for (cells, pixels) in [(256, 1920), (256, 960), (300, 1920), (512, 1280), (512, 1440), (256, 100), (256, 1), (16, 8192), (8, 8)] {
            let mut shares = Shares::default();
            shares.fit(pixels, cells);
            let mut covered = vec![0.0; pixels as usize];
            for cell in 0..cells as usize {
                let (first, shares) = shares.of(cell);
                assert!((shares.iter().sum::<f32>() - 1.0).abs() < 1e-6 && shares.iter().all(|share| *share > 0.0), "{cell} of {cells}");
                for (covered, share) in covered[first..].iter_mut().zip(shares) {
                    *covered += share * pixels as f32 / cells as f32;
                }
            }
            assert!(covered.iter().all(|covered| (covered - 1.0).abs() < 1e-4), "{cells} over {pixels}");
        }
    }

    #[test]
    fn averages_take_fractions_of_pixels() {
        let mut shares = Shares::default();
        shares.fit(5, 2);
        let mut out = [0.0; 2];
        shares.average(&[1.0, 2.0, 4.0, 8.0, 16.0], &mut out);
        assert!((out[0] - 5.0 / 2.5).abs() < 1e-6 && (out[1] - 26.0 / 2.5).abs() < 1e-5, "{out:?}");
        shares.fit(1, 2);
        shares.average(&[3.0], &mut out);
        assert_eq!(out, [3.0; 2]);
    }

    /// Every size class: up and down, whole and broken ratios, strips and bands that are not full, one and two bytes, by whole numbers and by fractions.
    #[test]
    fn averages_are_those_of_the_pixels_under_each_cell() {
        for (width, height, columns, rows) in [
            (37u32, 19u32, 10u32, 6u32),
            (160, 40, 64, 16),
            (100, 9, 170, 12),
            (1, 1, 4, 2),
            (530, 30, 8, 4),
            (240, 30, 64, 9),
            (64, 16, 8, 2),
            (96, 33, 6, 3),
        ] {
            for wide in [false, true] {
                let bytes = if wide { 2 } else { 1 };
                let stride = width as usize * bytes + 5;
                let code = |x: u32, y: u32| ((x * 7919 + y * 104_729) % if wide { 1024 } else { 256 }) as u16;
                let mut data = vec![0xaa; stride * height as usize];
                for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
                    let at = y as usize * stride + x as usize * bytes;
                    data[at..at + bytes].copy_from_slice(&code(x, y).to_le_bytes()[..bytes]);
                }
                let plane = Plane { data: &data, stride, width, height, wide };
                let mut averages = Averages::default();
                for row in 0..rows {
                    averages.take(&plane, row as usize, (columns, rows), true);
                    for column in 0..columns {
                        let overlap = |cell: u32, cells: u32, pixel: u32, pixels: u32| {
                            let length = f64::from(pixels) / f64::from(cells);
                            let (start, end) = (f64::from(cell) * length, f64::from(cell + 1) * length);
                            (f64::from(pixel + 1).min(end) - f64::from(pixel).max(start)).max(0.0) / length
                        };
                        let (mut mean, mut square) = (0.0, 0.0);
                        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
                            let share = overlap(column, columns, x, width) * overlap(row, rows, y, height);
                            mean += share * f64::from(code(x, y));
                            square += share * f64::from(code(x, y)).powi(2);
                        }
                        let got = [averages.means(), averages.squares()].map(|row| f64::from(row[column as usize]));
                        // Single precision over at most 1200 products.
                        assert!(
                            (got[0] - mean).abs() <= 1e-5 * mean && (got[1] - square).abs() <= 1e-5 * square,
                            "{got:?} {mean} {square}"
                        );
                    }
                }
            }
        }
    }
}
