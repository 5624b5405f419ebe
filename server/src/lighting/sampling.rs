//! A video frame's left eye as averages of its codes over a grid of blocks: luma by block, chroma by 2×2 texels.

use ffmpeg_next::format::Pixel;
use glam::{Mat3, Vec3};
use mr360_protocol::video::{Colour, StereoLayout};
use mr360_shaders::colour::rgb_from_yuv;
use pulp::{Arch, Simd, WithSimd};

use super::LightError;
use super::averages::{Averages, Plane};
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
pub(super) struct VideoSampler {
    arch: Arch,
    luma: Averages,
    chroma: [Averages; 2],
    tint: Planes,
}

impl Default for VideoSampler {
    fn default() -> Self {
        Self { arch: Arch::new(), luma: Averages::default(), chroma: Default::default(), tint: Planes::default() }
    }
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
        self.luma.take(luma, row, (grid.width * grid.supersample, grid.height * grid.supersample), squares);
        CodeRow {
            luma: self.luma.means(),
            luma_squares: if squares { self.luma.squares() } else { &[] },
            // The same for all three, in every matrix.
            luma_scale: view.rgb_from_yuv.x_axis.x * view.code_scale(),
            tint: &self.tint,
        }
    }

    fn tint_row(&mut self, view: &VideoView<'_>, row: usize, grid: Grid) {
        let [_, planes @ ..] = &view.planes;
        for (plane, chroma) in planes.iter().zip(&mut self.chroma) {
            chroma.take(plane, row, (grid.width / CHROMA_TEXELS, grid.height / CHROMA_TEXELS), false);
        }
        let repeat = (CHROMA_TEXELS * grid.supersample) as usize;
        self.tint.iter_mut().for_each(|tint| tint.resize((grid.width * grid.supersample) as usize, 0.0));
        let [cb, cr] = self.chroma.each_ref().map(Averages::means);
        self.arch.dispatch(TintRow {
            cb,
            cr,
            rgb_from_yuv: view.rgb_from_yuv,
            offset: view.offset,
            scale: view.code_scale(),
            repeat,
            tint: &mut self.tint,
        });
    }
}

/// What the chroma of a row gives to R', G' and B', `repeat` times each.
struct TintRow<'a> {
    cb: &'a [f32],
    cr: &'a [f32],
    rgb_from_yuv: Mat3,
    offset: Vec3,
    scale: f32,
    repeat: usize,
    tint: &'a mut Planes,
}

impl WithSimd for TintRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { cb, cr, rgb_from_yuv: m, offset, scale, repeat, tint } = self;
        let shift = m * -offset;
        for (channel, tint) in tint.iter_mut().enumerate() {
            let (from_cb, from_cr, shift) = (m.y_axis[channel] * scale, m.z_axis[channel] * scale, shift[channel]);
            // Nearly always one block a texel: pairs are written much faster than runs of any length.
            if repeat == CHROMA_TEXELS as usize {
                for ((blocks, cb), cr) in tint.as_chunks_mut().0.iter_mut().zip(cb).zip(cr) {
                    *blocks = [from_cb * cb + from_cr * cr + shift; CHROMA_TEXELS as usize];
                }
            } else {
                for ((blocks, cb), cr) in tint.chunks_exact_mut(repeat).zip(cb).zip(cr) {
                    blocks.fill(from_cb * cb + from_cr * cr + shift);
                }
            }
        }
    }
}
