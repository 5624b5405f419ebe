//! Averages of 8-bit samples over a grid of cells by whole-number weights: several times as fast as by fractions.
//!
//! The ratio of pixels to cells is a fraction of small whole numbers for nearly all video, 5 : 2 for 1280 pixels on 512 cells. A cell then
//! holds its pixels by whole numbers of that fraction's parts, and sums of 8-bit samples by such weights, and of their squares, are exact in
//! integers. Sixteen pixels are picked and weighted by three instructions that no compiler makes of a loop; where the processor has them,
//! they are named one by one. Downwards, rows are added by their shares in single precision, none fused with its product, so that
//! every processor finds the same light.

use pulp::{Arch, Simd, WithSimd};

use super::averages::{MOST_AT_ONCE, Plane, Shares};

/// Pixels that are picked from together.
const WINDOW: usize = 16;
/// Larger weights would overflow sums of two 16-bit products.
const MOST_WEIGHT: u32 = 64;
/// Sums of four pixels each that are made at once, from two windows.
const AT_ONCE: usize = 8;
/// Bytes that are brought nearer in one go: a small part of any second-level cache.
const FETCHED: usize = 65_536;
/// Bytes that come into the caches together.
const CACHE_LINE: usize = 64;
/// Pixels of one sum.
const PIXELS: usize = 4;

/// Which pixels make eight sums, and by what weights.
#[derive(Debug, Clone, Copy)]
struct Eight {
    /// First pixel of each window.
    first: [usize; 2],
    /// Where in its window each pixel is.
    places: [[u8; WINDOW]; 2],
    /// At most [`MOST_WEIGHT`].
    weights: [[u8; WINDOW]; 2],
}

/// Weights of the pixels of a row in each of its cells; refitted without allocating where the sizes stay.
#[derive(Debug, Default)]
pub(super) struct Taps {
    sizes: (u32, u32),
    eights: Vec<Eight>,
    /// Sums of a cell, side by side: 1, 2 or 4.
    sums: usize,
    /// What a cell's weights add up to.
    whole: f32,
}

impl Taps {
    /// Recomputes the weights if the sizes have changed. Returns whether there are any: not for rows shorter than a window, nor where the ratio has no
    /// small terms or a cell more pixels than a window.
    pub(super) fn fit(&mut self, pixels: u32, cells: u32) -> bool {
        if self.sizes != (pixels, cells) {
            self.sizes = (pixels, cells);
            self.eights.clear();
            if self.compute(pixels, cells).is_none() {
                self.eights.clear();
            }
        }
        !self.eights.is_empty()
    }

    fn compute(&mut self, pixels: u32, cells: u32) -> Option<()> {
        let divisor = greatest_common_divisor(pixels, cells);
        // In parts of which a pixel has `parts` and a cell `whole`.
        let (parts, whole) = (cells / divisor, pixels / divisor);
        if pixels < WINDOW as u32 || cells == 0 || parts > MOST_WEIGHT {
            return None;
        }
        self.whole = whole as f32;
        let pixels_of = |cell: u32| {
            let (start, end) = (u64::from(cell) * u64::from(whole), u64::from(cell + 1) * u64::from(whole));
            ((start / u64::from(parts)) as usize, end.div_ceil(u64::from(parts)) as usize)
        };
        let most = (0..cells.min(parts)).map(|cell| pixels_of(cell).1 - pixels_of(cell).0).max()?;
        let taps = most.next_power_of_two().max(PIXELS);
        if taps > WINDOW {
            return None;
        }
        self.sums = taps / PIXELS;
        let in_window = (WINDOW / taps) as u32;
        for window in (0..cells.div_ceil(in_window)).step_by(2) {
            let mut eight = Eight { first: [0; 2], places: [[0; WINDOW]; 2], weights: [[0; WINDOW]; 2] };
            for half in 0..2 {
                let first_cell = (window + half) * in_window;
                let cells = first_cell..(first_cell + in_window).min(cells);
                let first = pixels_of(first_cell).0.min(pixels as usize - WINDOW);
                let half = half as usize;
                for (cell, tap) in cells.zip((0..).step_by(taps)) {
                    let (start, end) = pixels_of(cell);
                    for (pixel, tap) in (start..end).zip(tap..) {
                        let part = |edge: u32| u64::from(edge) * u64::from(whole);
                        let of_pixel = (pixel as u64 * u64::from(parts), (pixel as u64 + 1) * u64::from(parts));
                        let weight = of_pixel.1.min(part(cell + 1)) - of_pixel.0.max(part(cell));
                        *eight.places[half].get_mut(tap)? =
                            u8::try_from(pixel - first).ok().filter(|place| usize::from(*place) < WINDOW)?;
                        *eight.weights[half].get_mut(tap)? = weight as u8;
                    }
                    eight.first[half] = first;
                }
            }
            self.eights.push(eight);
        }
        Some(())
    }

    /// Averages row `row` of the cells into the first list, and the samples' squares, if they are wanted, into the second. `rows` are the shares of the
    /// plane's rows; the columns' are those that were fitted last.
    pub(super) fn average(
        &self,
        arch: Arch,
        plane: &Plane<'_>,
        rows: &Shares,
        row: usize,
        [means, squares]: [&mut Vec<f32>; 2],
        with_squares: bool,
    ) {
        for sums in [&mut *means, &mut *squares] {
            sums.resize(self.eights.len() * AT_ONCE, 0.0);
        }
        let work = Average { taps: self, plane, rows, row, means, squares, with_squares };
        match arch {
            #[cfg(target_arch = "x86_64")]
            Arch::V4(simd) => Simd::vectorize(simd, With(work, *simd)),
            #[cfg(target_arch = "x86_64")]
            Arch::V3(simd) => Simd::vectorize(simd, With(work, simd)),
            arch => arch.dispatch(With(work, Plain)),
        }
    }
}

fn greatest_common_divisor(a: u32, b: u32) -> u32 {
    if b == 0 { a.max(1) } else { greatest_common_divisor(b, a % b) }
}

/// A processor's way to pick, weight and add.
trait Weigh: Copy {
    /// Sums of the weighted pixels, and of their weighted squares, over rows by their shares.
    fn sums<const ROWS: usize, const SQUARES: bool>(
        self,
        windows: [[[u8; WINDOW]; 2]; ROWS],
        shares: [f32; ROWS],
        eight: &Eight,
    ) -> [[f32; AT_ONCE]; 2];
}

/// For processors without a way of their own.
#[derive(Clone, Copy)]
struct Plain;

impl Weigh for Plain {
    #[inline(always)]
    fn sums<const ROWS: usize, const SQUARES: bool>(
        self,
        windows: [[[u8; WINDOW]; 2]; ROWS],
        shares: [f32; ROWS],
        eight: &Eight,
    ) -> [[f32; AT_ONCE]; 2] {
        let mut sums = [[0.0; AT_ONCE]; 2];
        for (windows, share) in windows.iter().zip(shares) {
            let [means, squares] = &mut sums;
            for (sum, (mean_sum, square_sum)) in means.iter_mut().zip(squares).enumerate() {
                let (half, first) = (sum / PIXELS, sum % PIXELS * PIXELS);
                let (mut mean, mut square) = (0, 0);
                for tap in first..first + PIXELS {
                    let sample = i32::from(windows[half][usize::from(eight.places[half][tap]) % WINDOW]);
                    let weighted = sample * i32::from(eight.weights[half][tap]);
                    (mean, square) = (mean + weighted, square + weighted * sample);
                }
                *mean_sum += share * mean as f32;
                *square_sum += share * square as f32;
            }
        }
        sums
    }
}

#[cfg(target_arch = "x86_64")]
impl Weigh for pulp::x86::V3 {
    #[inline(always)]
    fn sums<const ROWS: usize, const SQUARES: bool>(
        self,
        windows: [[[u8; WINDOW]; 2]; ROWS],
        shares: [f32; ROWS],
        eight: &Eight,
    ) -> [[f32; AT_ONCE]; 2] {
        use std::arch::x86_64::__m256i;
        let (avx, avx2) = (self.avx, self.avx2);
        let (places, weights): (__m256i, __m256i) = (pulp::cast(eight.places), pulp::cast(eight.weights));
        let (zero, ones) = (avx._mm256_setzero_si256(), avx._mm256_set1_epi16(1));
        let wide_weights = (avx2._mm256_unpacklo_epi8(weights, zero), avx2._mm256_unpackhi_epi8(weights, zero));
        let (mut means, mut squares) = (avx._mm256_setzero_ps(), avx._mm256_setzero_ps());
        for row in 0..ROWS {
            let share = avx._mm256_set1_ps(shares[row]);
            let pixels = avx2._mm256_shuffle_epi8(pulp::cast(windows[row]), places);
            let sums = avx2._mm256_madd_epi16(avx2._mm256_maddubs_epi16(pixels, weights), ones);
            means = avx._mm256_add_ps(means, avx._mm256_mul_ps(share, avx._mm256_cvtepi32_ps(sums)));
            if SQUARES {
                let (low, high) = (avx2._mm256_unpacklo_epi8(pixels, zero), avx2._mm256_unpackhi_epi8(pixels, zero));
                let low = avx2._mm256_madd_epi16(low, avx2._mm256_mullo_epi16(low, wide_weights.0));
                let high = avx2._mm256_madd_epi16(high, avx2._mm256_mullo_epi16(high, wide_weights.1));
                let sums = avx2._mm256_hadd_epi32(low, high);
                squares = avx._mm256_add_ps(squares, avx._mm256_mul_ps(share, avx._mm256_cvtepi32_ps(sums)));
            }
        }
        [pulp::cast(means), pulp::cast(squares)]
    }
}

/// [`Taps::average`] by whatever way there is.
struct Average<'a, 'b> {
    taps: &'a Taps,
    plane: &'a Plane<'b>,
    rows: &'a Shares,
    row: usize,
    means: &'a mut [f32],
    squares: &'a mut [f32],
    with_squares: bool,
}

struct With<'a, 'b, W>(Average<'a, 'b>, W);

impl<W: Weigh> WithSimd for With<'_, '_, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self(work, way) = self;
        if work.with_squares { work.run::<W, true>(way) } else { work.run::<W, false>(way) }
    }
}

impl Average<'_, '_> {
    #[inline(always)]
    fn run<W: Weigh, const SQUARES: bool>(mut self, way: W) {
        self.fetch_ahead();
        let (first, shares) = self.rows.of(self.row);
        for (i, shares) in shares.chunks(MOST_AT_ONCE).enumerate() {
            let first = first + i * MOST_AT_ONCE;
            match *shares {
                [a] => self.add::<W, 1, SQUARES>(way, first, [a], i > 0),
                [a, b] => self.add::<W, 2, SQUARES>(way, first, [a, b], i > 0),
                [a, b, c] => self.add::<W, 3, SQUARES>(way, first, [a, b, c], i > 0),
                [a, b, c, d] => self.add::<W, 4, SQUARES>(way, first, [a, b, c, d], i > 0),
                _ => {}
            }
        }
        self.gather::<SQUARES>();
    }

    /// Brings the pixels of the next rows of cells nearer, now and then. Frames come from another core or from far out in the caches; sums wait for
    /// each of their pixels, while reads that nothing waits for overlap, the more of them the better.
    #[inline(always)]
    fn fetch_ahead(&self) {
        let Plane { data, stride, height, .. } = *self.plane;
        let (first, shares) = self.rows.of(self.row);
        let at_once = (FETCHED / (stride * shares.len()).max(1)).max(1);
        if !self.row.is_multiple_of(at_once) {
            return;
        }
        let last = match self.rows.of(self.row + at_once) {
            (_, []) => height as usize,
            (first, _) => first,
        };
        let mut bits = 0;
        for line in data.get(first * stride..(last * stride).min(data.len())).unwrap_or_default().chunks_exact(CACHE_LINE) {
            bits |= line[0];
        }
        std::hint::black_box(bits);
    }

    /// Adds rows of pixels to what the sums hold, or to nothing.
    #[inline(always)]
    fn add<W: Weigh, const ROWS: usize, const SQUARES: bool>(&mut self, way: W, first: usize, shares: [f32; ROWS], further: bool) {
        let width = self.plane.width as usize;
        let mut rows: [&[u8]; ROWS] = [&[]; ROWS];
        for (row, pixels) in rows.iter_mut().enumerate() {
            // All as long, so that what is checked of one need not be checked of the others.
            let Some(whole) = self.plane.row(first + row).get(..width) else { return };
            *pixels = whole;
        }
        let shares = shares.map(|share| share / self.taps.whole);
        let means = self.means.as_chunks_mut::<AT_ONCE>().0.iter_mut();
        let squares = self.squares.as_chunks_mut::<AT_ONCE>().0.iter_mut();
        for ((eight, means), squares) in self.taps.eights.iter().zip(means).zip(squares) {
            let mut windows = [[[0; WINDOW]; 2]; ROWS];
            for (windows, row) in windows.iter_mut().zip(rows) {
                for (window, first) in windows.iter_mut().zip(eight.first) {
                    let Some(pixels) = row.get(first..).and_then(|row| row.first_chunk()) else { return };
                    *window = *pixels;
                }
            }
            let [sums, of_squares] = way.sums::<ROWS, SQUARES>(windows, shares, eight);
            // Written whole: single sums would be written one by one.
            *means = if further { added(means, &sums) } else { sums };
            if SQUARES {
                *squares = if further { added(squares, &of_squares) } else { of_squares };
            }
        }
    }

    /// Adds up the sums of each cell, where there are several.
    #[inline(always)]
    fn gather<const SQUARES: bool>(&mut self) {
        let sums = self.taps.sums;
        if sums > 1 {
            gather_side_by_side(self.means, sums);
            if SQUARES {
                gather_side_by_side(self.squares, sums);
            }
        }
    }
}

#[inline(always)]
fn added(a: &[f32; AT_ONCE], b: &[f32; AT_ONCE]) -> [f32; AT_ONCE] {
    std::array::from_fn(|sum| a[sum] + b[sum])
}

/// Adds up every `count` values, and writes what comes out from the start on.
#[inline(always)]
fn gather_side_by_side(values: &mut [f32], count: usize) {
    for cell in 0..values.len() / count {
        let mut sum = 0.0;
        for value in &values[cell * count..(cell + 1) * count] {
            sum += value;
        }
        values[cell] = sum;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn usual_sizes_have_weights_and_odd_ones_do_not() {
        for (pixels, cells) in
            [(1280, 512), (640, 256), (1440, 512), (1920, 512), (3840, 512), (7680, 512), (8192, 512), (512, 512), (256, 512), (64, 16)]
        {
            let mut taps = Taps::default();
            assert!(taps.fit(pixels, cells), "{pixels} on {cells}");
            let weights: Vec<u32> =
                taps.eights.iter().flat_map(|eight| eight.weights.as_flattened()).map(|weight| u32::from(*weight)).collect();
            let of_cells: Vec<u32> = weights.chunks_exact(taps.sums * PIXELS).map(|cell| cell.iter().sum()).collect();
            assert!(of_cells[..cells as usize].iter().all(|sum| *sum as f32 == taps.whole), "{pixels} on {cells}: {of_cells:?}");
        }
        for (pixels, cells) in [(1438, 512), (12, 4), (10_240, 512)] {
            assert!(!Taps::default().fit(pixels, cells), "{pixels} on {cells}");
        }
    }

    #[test]
    fn every_way_finds_the_same_sums() {
        let mut taps = Taps::default();
        for (pixels, cells) in [(160, 64), (180, 64), (480, 64), (960, 64), (17, 17)] {
            assert!(taps.fit(pixels, cells));
            let data: Vec<u8> = (0..pixels * 12).map(|i| (i * 7919 % 256) as u8).collect();
            let plane = Plane { data: &data, stride: pixels as usize, width: pixels, height: 12, wide: false };
            let mut rows = Shares::default();
            for cell_rows in [1, 5, 12] {
                rows.fit(12, cell_rows);
                for row in 0..cell_rows as usize {
                    let (mut means, mut squares) = (vec![0.0; 512], vec![0.0; 512]);
                    taps.average(Arch::new(), &plane, &rows, row, [&mut means, &mut squares], true);
                    let (mut plain, mut plain_squares) = (vec![0.0; means.len()], vec![0.0; means.len()]);
                    let work = Average {
                        taps: &taps,
                        plane: &plane,
                        rows: &rows,
                        row,
                        means: &mut plain,
                        squares: &mut plain_squares,
                        with_squares: true,
                    };
                    work.run::<Plain, true>(Plain);
                    assert!(means == plain && squares == plain_squares, "{pixels} on {cells}, row {row} of {cell_rows}");
                }
            }
        }
    }
}
