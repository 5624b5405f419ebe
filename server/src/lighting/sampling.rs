//! A video frame's left eye as averages of its codes over a grid of blocks: luma by block, chroma by 2×2 texels.

use ffmpeg_next::format::Pixel;
use glam::{Mat3, Vec3};
use mr360_protocol::video::{Colour, StereoLayout};
use mr360_shaders::colour::rgb_from_yuv;

use super::LightError;
use super::averages::{Averages, BAND, Plane};
use super::radiance::Planes;
use crate::frame::SUPPORTED_PIXELS;

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

    /// From samples to codes in [0, 1].
    fn code_scale(&self) -> f32 {
        1.0 / if self.wide { 1023.0 } else { 255.0 }
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

/// Codes of one row of blocks.
pub(super) struct CodeRow<'a> {
    /// Mean of the luma's samples.
    pub(super) luma: &'a [f32],
    /// Mean of their squares; empty unless asked for.
    pub(super) luma_squares: &'a [f32],
    /// What one step of the luma's samples adds to each of R', G' and B'.
    pub(super) luma_scale: f32,
    /// What else R', G' and B' are made of.
    pub(super) tint: &'a Planes,
}

impl CodeRow<'_> {
    /// Writes the means of the R'G'B' codes into `codes`.
    pub(super) fn write(&self, codes: &mut Planes) {
        for (codes, tint) in codes.iter_mut().zip(self.tint) {
            codes.iter_mut().zip(self.luma).zip(tint).for_each(|((code, luma), tint)| *code = luma * self.luma_scale + tint);
        }
    }
}

/// Buffers for sampling video; reused from frame to frame.
#[derive(Default)]
pub(super) struct VideoSampler {
    luma: Averages,
    chroma: [Averages; 2],
    tint: Planes,
}

impl VideoSampler {
    /// Codes of block row `row` of the grid; with `squares`, the means of the luma's squares too. Rows come in order, from 0 on.
    ///
    /// Luma is averaged by block, chroma by [`CHROMA_TEXELS`]: it is coded at half the resolution, and what is lost
    /// by averaging before decoding is lost to contrast, which is in the luma.
    pub(super) fn row(&mut self, view: &VideoView<'_>, row: u32, grid: Grid, squares: bool) -> CodeRow<'_> {
        let row = row as usize;
        let blocks = (CHROMA_TEXELS * grid.supersample) as usize;
        if row.is_multiple_of(blocks) {
            self.tint_row(view, row / blocks, grid);
        }
        let [luma, ..] = &view.planes;
        if row.is_multiple_of(BAND) {
            self.luma.take(luma, row / BAND, (grid.width * grid.supersample, grid.height * grid.supersample), squares);
        }
        CodeRow {
            luma: self.luma.means(row % BAND),
            luma_squares: if squares { self.luma.squares(row % BAND) } else { &[] },
            // The same for all three, in every matrix.
            luma_scale: view.rgb_from_yuv.x_axis.x * view.code_scale(),
            tint: &self.tint,
        }
    }

    fn tint_row(&mut self, view: &VideoView<'_>, row: usize, grid: Grid) {
        let [_, planes @ ..] = &view.planes;
        if row.is_multiple_of(BAND) {
            for (plane, chroma) in planes.iter().zip(&mut self.chroma) {
                chroma.take(plane, row / BAND, (grid.width / CHROMA_TEXELS, grid.height / CHROMA_TEXELS), false);
            }
        }
        let [cb, cr] = self.chroma.each_ref().map(|chroma| chroma.means(row % BAND));
        let (m, scale) = (view.rgb_from_yuv, view.code_scale());
        let shift = m * -view.offset;
        for (channel, tint) in self.tint.iter_mut().enumerate() {
            let (from_cb, from_cr, shift) = (m.y_axis[channel] * scale, m.z_axis[channel] * scale, shift[channel]);
            let codes = cb.iter().zip(cr).map(|(cb, cr)| from_cb * cb + from_cr * cr + shift);
            tint.resize((grid.width * grid.supersample) as usize, 0.0);
            // Nearly always one block a texel: pairs are written much faster than runs of any length.
            if grid.supersample == 1 {
                tint.as_chunks_mut().0.iter_mut().zip(codes).for_each(|(blocks, code)| *blocks = [code; CHROMA_TEXELS as usize]);
            } else {
                let repeat = (CHROMA_TEXELS * grid.supersample) as usize;
                tint.chunks_exact_mut(repeat).zip(codes).for_each(|(blocks, code)| blocks.fill(code));
            }
        }
    }
}
