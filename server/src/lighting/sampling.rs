//! Area averages of code values: a frame's left eye brought to a grid of blocks, each the exact area average
//! (fractional pixels at the edges included) of the codes under it.
//!
//! A row of blocks is made in two passes. Downwards, whole source rows are added with integer weights that sum
//! to [`unit()`], so that a 16-bit sum cannot overflow and eight pixels are added at a time. Across, a running sum
//! of that row is read at the block edges.

use ffmpeg_next::format::Pixel;
use glam::{Mat3, Vec3};
use mr360_protocol::video::{Colour, StereoLayout};
use mr360_shaders::colour::rgb_from_yuv;

use super::LightError;
use super::radiance::Planes;
use crate::frame::SUPPORTED_PIXELS;

/// Where a block begins in the source: a pixel and how much of it lies before the edge.
#[derive(Clone, Copy)]
struct Edge {
    pixel: u32,
    fraction: f32,
}

/// Edges of `blocks` equal blocks over `pixels` pixels.
#[derive(Default)]
pub(super) struct Edges {
    edges: Vec<Edge>,
    pixels: u32,
}

impl Edges {
    /// Recomputes the edges if the sizes have changed.
    pub(super) fn fit(&mut self, pixels: u32, blocks: u32) {
        if self.pixels == pixels && self.edges.len() == blocks as usize + 1 {
            return;
        }
        self.pixels = pixels;
        self.edges.clear();
        self.edges.extend((0..=blocks).map(|block| {
            let scaled = u64::from(block) * u64::from(pixels);
            let pixel = scaled / u64::from(blocks);
            Edge { pixel: pixel as u32, fraction: (scaled % u64::from(blocks)) as f32 / blocks as f32 }
        }));
    }

    fn inverse_width(&self) -> f32 {
        (self.edges.len() - 1) as f32 / self.pixels as f32
    }

    /// Averages `row`, one value a pixel, over each block.
    pub(super) fn average(&self, row: &[f32], out: &mut [f32]) {
        let inverse = self.inverse_width();
        let at = |pixel: u32| row.get(pixel as usize).copied().unwrap_or(0.0);
        for (out, edges) in out.iter_mut().zip(self.edges.windows(2)) {
            let (from, to) = (edges[0], edges[1]);
            let whole: f32 = row.get(from.pixel as usize..to.pixel as usize).unwrap_or_default().iter().sum();
            *out = (whole + to.fraction * at(to.pixel) - from.fraction * at(from.pixel)) * inverse;
        }
    }
}

/// Rows and weights of block row `block` of `blocks` over `pixels` rows: integers that sum to `unit`.
fn row_weights(block: u32, blocks: u32, pixels: u32, unit: u16) -> impl Iterator<Item = (u32, u16)> {
    let scale = f64::from(pixels) / f64::from(blocks);
    let (start, end) = (f64::from(block) * scale, f64::from(block + 1) * scale);
    let covered = move |until: f64| ((until.clamp(start, end) - start) / (end - start) * f64::from(unit)).round() as u16;
    let (first, last) = (start.floor() as u32, (end.ceil() as u32).min(pixels));
    (first..last).map(move |row| (row, covered(f64::from(row + 1)) - covered(f64::from(row))))
}

/// One plane of a video frame, left eye only.
#[derive(Clone, Copy)]
struct Plane<'a> {
    data: &'a [u8],
    stride: usize,
    width: u32,
    height: u32,
    wide: bool,
}

impl Plane<'_> {
    fn row(&self, row: u32) -> &[u8] {
        let start = row as usize * self.stride;
        self.data.get(start..start + self.width as usize * if self.wide { 2 } else { 1 }).unwrap_or_default()
    }
}

/// Left eye of a video frame.
pub(super) struct VideoView<'a> {
    planes: [Plane<'a>; 3],
    rgb_from_yuv: Mat3,
    offset: Vec3,
    wide: bool,
}

impl<'a> VideoView<'a> {
    /// The left eye's view of `video`.
    ///
    /// # Errors
    /// For a pixel format outside [`SUPPORTED_PIXELS`], one that contradicts `colour`, or an empty frame.
    pub(super) fn new(video: &'a ffmpeg_next::frame::Video, colour: Colour, stereo: StereoLayout) -> Result<Self, LightError> {
        let format = video.format();
        if !SUPPORTED_PIXELS.contains(&format) {
            return Err(LightError::UnsupportedPixels { format: format!("{format:?}") });
        }
        let wide = matches!(format, Pixel::YUV420P10LE | Pixel::YUV422P10LE | Pixel::YUV444P10LE);
        if (colour.bit_depth == 10) != wide {
            return Err(LightError::BitDepth { format: format!("{format:?}"), bit_depth: colour.bit_depth });
        }
        let (eye_width, eye_height) = stereo.eye_size(video.width(), video.height());
        if eye_width == 0 || eye_height == 0 {
            return Err(LightError::Empty { width: video.width(), height: video.height() });
        }
        let plane = |index: usize| {
            // An eye's chroma is cut like its luma, rounded up so that an odd last column keeps its sample.
            let (whole_width, whole_height) = (video.plane_width(index), video.plane_height(index));
            let part = |eye: u32, whole: u32, plane: u32| {
                (u64::from(eye) * u64::from(plane)).div_ceil(u64::from(whole)).clamp(1, u64::from(plane)) as u32
            };
            Plane {
                data: video.data(index),
                stride: video.stride(index),
                width: part(eye_width, video.width(), whole_width),
                height: part(eye_height, video.height(), whole_height),
                wide,
            }
        };
        let (rgb_from_yuv, offset) = rgb_from_yuv(colour);
        Ok(Self { planes: [plane(0), plane(1), plane(2)], rgb_from_yuv, offset, wide })
    }

    /// From sums of weighted rows to codes in [0, 1].
    fn code_scale(&self) -> f32 {
        1.0 / (f32::from(unit(self.wide)) * if self.wide { 1023.0 } else { 255.0 })
    }
}

/// Texels in each direction that share one average of the chroma; panoramas have even sizes.
const CHROMA_TEXELS: u32 = 2;

/// Texels of a panorama, even in number, and blocks of each in either direction.
#[derive(Clone, Copy)]
pub(super) struct Grid {
    /// Texels across.
    pub(super) width: u32,
    /// Texels down.
    pub(super) height: u32,
    /// Blocks a texel in each direction.
    pub(super) supersample: u32,
}

/// What the weights of a block's rows sum to: with it, the largest code still fits 16 bits.
fn unit(wide: bool) -> u16 {
    if wide { 64 } else { 256 }
}

/// Buffers for sampling video; reused from frame to frame.
#[derive(Default)]
pub(super) struct VideoSampler {
    luma_edges: Edges,
    chroma_edges: Edges,
    sums: Vec<u16>,
    running: Vec<u32>,
    chroma: [Vec<f32>; 2],
    /// What the chroma adds to R', G' and B' of every block of the current row of texels.
    tint: Planes,
}

impl VideoSampler {
    /// Writes the R'G'B' codes of block row `row` of the grid into `codes`. Rows come in order, from 0 on.
    ///
    /// Luma is averaged by block, chroma by [`CHROMA_TEXELS`]: it is coded at half the resolution, and what is lost
    /// by averaging before decoding is lost to contrast, which is in the luma.
    pub(super) fn codes(&mut self, view: &VideoView<'_>, row: u32, grid: Grid, codes: &mut Planes) {
        let blocks = CHROMA_TEXELS * grid.supersample;
        if row.is_multiple_of(blocks) {
            self.tint_row(view, row / blocks, grid);
        }
        let [luma, ..] = &view.planes;
        self.luma_edges.fit(luma.width, grid.width * grid.supersample);
        sum_rows(luma, row, grid.height * grid.supersample, unit(view.wide), &mut self.sums);
        let [red, green, blue] = codes;
        let scale = view.rgb_from_yuv.x_axis * view.code_scale();
        across(&self.sums, &mut self.running, &self.luma_edges, scale.x, red);
        for (out, tint) in [green, blue].into_iter().zip(&self.tint[1..]) {
            out.iter_mut().zip(red.iter()).zip(tint).for_each(|((out, luma), tint)| *out = luma + tint);
        }
        red.iter_mut().zip(&self.tint[0]).for_each(|(out, tint)| *out += tint);
    }

    fn tint_row(&mut self, view: &VideoView<'_>, row: u32, grid: Grid) {
        let [_, planes @ ..] = &view.planes;
        for (plane, out) in planes.iter().zip(&mut self.chroma) {
            self.chroma_edges.fit(plane.width, grid.width / CHROMA_TEXELS);
            out.resize((grid.width / CHROMA_TEXELS) as usize, 0.0);
            sum_rows(plane, row, grid.height / CHROMA_TEXELS, unit(view.wide), &mut self.sums);
            across(&self.sums, &mut self.running, &self.chroma_edges, view.code_scale(), out);
        }
        let m = view.rgb_from_yuv;
        let shift = m * -view.offset;
        let repeat = (CHROMA_TEXELS * grid.supersample) as usize;
        for (channel, tint) in self.tint.iter_mut().enumerate() {
            let (from_cb, from_cr, shift) = (m.y_axis[channel], m.z_axis[channel], shift[channel]);
            tint.resize((grid.width * grid.supersample) as usize, 0.0);
            for ((blocks, cb), cr) in tint.chunks_exact_mut(repeat).zip(&self.chroma[0]).zip(&self.chroma[1]) {
                blocks.fill(from_cb * cb + from_cr * cr + shift);
            }
        }
    }
}

/// Values that are summed in one step of the running sum.
const STEP: usize = 4;

fn sum_rows(plane: &Plane<'_>, row: u32, rows: u32, unit: u16, sums: &mut Vec<u16>) {
    sums.clear();
    // At least one more than the pixels, so that the last edge has a (weightless) pixel to its right.
    sums.resize((plane.width as usize + 1).next_multiple_of(STEP), 0);
    // Wrapping only tells the compiler that there is no overflow to check: the weights rule it out.
    let product = |code: u16, weight: u16| code.wrapping_mul(weight);
    let mut weights = row_weights(row, rows, plane.height, unit);
    while let Some((first, first_weight)) = weights.next() {
        // Two rows at a time halve the traffic of the sums.
        let (second, second_weight) = weights.next().unwrap_or((first, 0));
        let (first, second) = (plane.row(first), plane.row(second));
        if plane.wide {
            let code = |bytes: &[u8]| u16::from_le_bytes([bytes[0], bytes[1]]) & 1023;
            for ((sum, a), b) in sums.iter_mut().zip(first.chunks_exact(2)).zip(second.chunks_exact(2)) {
                *sum = sum.wrapping_add(product(code(a), first_weight)).wrapping_add(product(code(b), second_weight));
            }
        } else {
            for ((sum, a), b) in sums.iter_mut().zip(first).zip(second) {
                *sum = sum.wrapping_add(product((*a).into(), first_weight)).wrapping_add(product((*b).into(), second_weight));
            }
        }
    }
}

/// Averages `sums`, a multiple of [`STEP`] long, over the blocks between `edges`.
fn across(sums: &[u16], running: &mut Vec<u32>, edges: &Edges, scale: f32, out: &mut [f32]) {
    running.resize(sums.len(), 0);
    let mut total = 0u32;
    for (running, sums) in running.chunks_exact_mut(STEP).zip(sums.chunks_exact(STEP)) {
        let [a, b, c, d] = [sums[0], sums[1], sums[2], sums[3]].map(u32::from);
        let ab = a.wrapping_add(b);
        running[0] = total;
        running[1] = total.wrapping_add(a);
        running[2] = total.wrapping_add(ab);
        running[3] = total.wrapping_add(ab.wrapping_add(c));
        total = total.wrapping_add(ab.wrapping_add(c.wrapping_add(d)));
    }
    let scale = scale * edges.inverse_width();
    let running = &running[..sums.len()];
    let last = sums.len() - 1;
    let read = |edge: &Edge| {
        let pixel = (edge.pixel as usize).min(last);
        (running[pixel], edge.fraction * f32::from(sums[pixel]))
    };
    let mut edges = edges.edges.iter();
    let mut left = edges.next().map_or((0, 0.0), read);
    for (out, edge) in out.iter_mut().zip(edges) {
        let right = read(edge);
        // The difference of two running sums over one block fits a signed integer, which converts faster.
        *out = (right.0.wrapping_sub(left.0) as i32 as f32 + right.1 - left.1) * scale;
        left = right;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_weights_sum_to_the_unit_and_cover_every_row() {
        for (blocks, pixels) in [(256, 1920), (256, 960), (300, 1920), (512, 1920), (256, 100), (256, 1), (16, 8192)] {
            for unit in [64, 256] {
                let mut covered = vec![0.0; pixels as usize];
                for block in 0..blocks {
                    let mut sum = 0;
                    for (row, weight) in row_weights(block, blocks, pixels, unit) {
                        covered[row as usize] += f64::from(weight) / f64::from(unit) * f64::from(pixels) / f64::from(blocks);
                        sum += weight;
                    }
                    assert_eq!(sum, unit, "block {block} of {blocks} over {pixels}");
                }
                // Each of the blocks that share a row rounds its weight by at most half a unit step.
                let blocks_per_row = f64::from(blocks) / f64::from(pixels);
                let tolerance = (1.0 + blocks_per_row) / f64::from(unit) / blocks_per_row.min(1.0);
                assert!(covered.iter().all(|c| (c - 1.0).abs() <= tolerance + 1e-9), "{blocks} over {pixels}");
            }
        }
    }

    #[test]
    fn averages_take_fractions_of_pixels() {
        let mut edges = Edges::default();
        edges.fit(5, 2);
        let mut out = [0.0; 2];
        edges.average(&[1.0, 2.0, 4.0, 8.0, 16.0], &mut out);
        assert!((out[0] - 5.0 / 2.5).abs() < 1e-5 && (out[1] - 26.0 / 2.5).abs() < 1e-5, "{out:?}");
        edges.fit(1, 2);
        edges.average(&[3.0], &mut out);
        assert_eq!(out, [3.0; 2]);
    }

    #[test]
    fn integer_and_float_averages_agree() {
        let source: Vec<u16> = (0..37).map(|i| (i * 7919 % 251) as u16 * 256).chain([0; 3]).collect();
        let floats: Vec<f32> = source.iter().map(|v| f32::from(*v)).collect();
        let mut edges = Edges::default();
        edges.fit(37, 10);
        let (mut a, mut b, mut running) = ([0.0; 10], [0.0; 10], Vec::new());
        edges.average(&floats[..37], &mut a);
        across(&source, &mut running, &edges, 1.0, &mut b);
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-2), "{a:?} {b:?}");
    }
}
