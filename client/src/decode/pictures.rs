//! From FFmpeg's frames to [`Picture`]s: one copy, into buffers that are used again.

use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use ffmpeg_next as ffmpeg;
use ffmpeg_next::format::Pixel;
use ffmpeg_next::software::scaling;
use mr360_protocol::video::{Colour, Matrix};

use super::{MAX_SIDE, VideoFormat};
use crate::picture::{Picture, Plane, Samples};

/// Buffers kept for use again: three planes for each picture between decoder and GPU.
const KEPT_BUFFERS: usize = 48;

/// Why a decoded frame cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum FrameError {
    #[error("decoded frame of {0}×{1}, each side must be 1 to {MAX_SIDE}")]
    Size(u32, u32),
    #[error("decoded frame without a presentation time")]
    NoPts,
    #[error("decoded frame with a broken layout of its planes")]
    Layout,
    #[error("conversion from {0:?} failed ({1})")]
    Conversion(Pixel, ffmpeg::Error),
}

/// Layout of a planar format that the renderer takes as it is.
struct Planar {
    bytes: u32,
    log2_chroma_width: u32,
    log2_chroma_height: u32,
    bit_depth: u8,
    /// The old full-range formats, which say so by their name.
    full_range: bool,
}

fn planar(format: Pixel) -> Option<Planar> {
    let (log2_chroma_width, log2_chroma_height, bit_depth, full_range) = match format {
        Pixel::YUV420P => (1, 1, 8, false),
        Pixel::YUV422P => (1, 0, 8, false),
        Pixel::YUV444P => (0, 0, 8, false),
        Pixel::YUVJ420P => (1, 1, 8, true),
        Pixel::YUVJ422P => (1, 0, 8, true),
        Pixel::YUVJ444P => (0, 0, 8, true),
        Pixel::YUV420P10LE => (1, 1, 10, false),
        Pixel::YUV422P10LE => (1, 0, 10, false),
        Pixel::YUV444P10LE => (0, 0, 10, false),
        _ => return None,
    };
    Some(Planar { bytes: if bit_depth > 8 { 2 } else { 1 }, log2_chroma_width, log2_chroma_height, bit_depth, full_range })
}

/// The planar format that loses least.
fn nearest_planar(format: Pixel) -> Pixel {
    let Some(descriptor) = format.descriptor() else { return Pixel::YUV420P };
    let chroma = if is_rgb(format) { (0, 0) } else { (descriptor.log2_chroma_w(), descriptor.log2_chroma_h()) };
    match (chroma, is_deep(format)) {
        ((0, _), false) => Pixel::YUV444P,
        ((0, _), true) => Pixel::YUV444P10LE,
        ((1, 0), false) => Pixel::YUV422P,
        ((1, 0), true) => Pixel::YUV422P10LE,
        (_, false) => Pixel::YUV420P,
        (_, true) => Pixel::YUV420P10LE,
    }
}

/// FFmpeg's flags and the depth of the first sample, bits.
#[expect(unsafe_code, reason = "ffmpeg-next's descriptor shows neither flags nor depths")]
fn flags_and_depth(format: Pixel) -> (u64, i32) {
    let Some(descriptor) = format.descriptor() else { return (0, 8) };
    // SAFETY: FFmpeg's descriptors are static and never change; the pointer of one that exists is valid.
    let descriptor = unsafe { &*descriptor.as_ptr() };
    (descriptor.flags, descriptor.comp[0].depth)
}

fn is_rgb(format: Pixel) -> bool {
    flags_and_depth(format).0 & ffmpeg::ffi::AV_PIX_FMT_FLAG_RGB as u64 != 0
}

/// More than 8 bits a sample.
fn is_deep(format: Pixel) -> bool {
    flags_and_depth(format).1 > 8
}

/// Turns frames into pictures.
pub(super) struct Pictures {
    pool: Pool,
    scaler: Option<scaling::Context>,
}

impl Pictures {
    pub(super) fn new() -> Self {
        Self { pool: Pool::default(), scaler: None }
    }

    /// Takes a frame in system memory.
    pub(super) fn take(&mut self, frame: &ffmpeg::frame::Video, format: &VideoFormat) -> Result<Picture, FrameError> {
        let (width, height) = (frame.width(), frame.height());
        if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
            return Err(FrameError::Size(width, height));
        }
        let pts_us = frame.pts().and_then(|pts| u64::try_from(pts).ok()).ok_or(FrameError::NoPts)?;
        let (planes, colour) = match planar(frame.format()) {
            Some(layout) => (self.copy(frame, &layout)?, colour_of(format.colour, &layout)),
            None => self.convert(frame, format.colour)?,
        };
        Ok(Picture { pts_us, width, height, stereo: format.stereo, samples: Samples::Yuv { planes, colour } })
    }

    fn convert(&mut self, frame: &ffmpeg::frame::Video, colour: Colour) -> Result<([Plane; 3], Colour), FrameError> {
        let (from, width, height) = (frame.format(), frame.width(), frame.height());
        let to = nearest_planar(from);
        let layout = planar(to).ok_or(FrameError::Layout)?;
        let failed = |error| FrameError::Conversion(from, error);
        let fits = self.scaler.as_ref().is_some_and(|scaler| {
            let (input, output) = (scaler.input(), scaler.output());
            (input.format, input.width, input.height, output.format) == (from, width, height, to)
        });
        if !fits {
            self.scaler = Some(scaling::Context::get(from, width, height, to, width, height, scaling::Flags::BILINEAR).map_err(failed)?);
        }
        let scaler = self.scaler.as_mut().ok_or(FrameError::Layout)?;
        let mut converted = ffmpeg::frame::Video::empty();
        scaler.run(frame, &mut converted).map_err(failed)?;
        let mut colour = colour_of(colour, &layout);
        if is_rgb(from) {
            // swscale's default for RGB.
            (colour.matrix, colour.full_range) = (Matrix::Bt601, false);
        }
        Ok((self.copy(&converted, &layout)?, colour))
    }

    fn copy(&self, frame: &ffmpeg::frame::Video, layout: &Planar) -> Result<[Plane; 3], FrameError> {
        if frame.planes() < 3 {
            return Err(FrameError::Layout);
        }
        let plane = |index: usize| {
            let (dx, dy) = if index == 0 { (0, 0) } else { (layout.log2_chroma_width, layout.log2_chroma_height) };
            let (width, height) = (frame.width().div_ceil(1 << dx), frame.height().div_ceil(1 << dy));
            let row = (width * layout.bytes) as usize;
            let stride = frame.stride(index);
            // A negative line size would come out as a huge stride.
            if stride < row || stride > 8 * MAX_SIDE as usize {
                return Err(FrameError::Layout);
            }
            let rows = frame.data(index).chunks(stride).take(height as usize).map(|line| line.get(..row).unwrap_or(line));
            let data = self.pool.fill(row * height as usize, rows);
            if data.len() != row * height as usize {
                return Err(FrameError::Layout);
            }
            Ok(Plane { width, height, stride: row, data })
        };
        Ok([plane(0)?, plane(1)?, plane(2)?])
    }
}

fn colour_of(said: Colour, layout: &Planar) -> Colour {
    Colour { bit_depth: layout.bit_depth, full_range: said.full_range || layout.full_range, ..said }
}

/// Buffers that come back when their [`Bytes`] is dropped: fresh ones cost a page fault every 4 KiB.
#[derive(Default, Clone)]
struct Pool(Arc<Mutex<Vec<Vec<u8>>>>);

struct Pooled {
    buffer: Vec<u8>,
    pool: Pool,
}

impl Pool {
    fn fill<'a>(&self, capacity: usize, rows: impl Iterator<Item = &'a [u8]>) -> Bytes {
        let mut buffer = {
            let mut free = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            // The best fit, so that chroma does not take luma's buffers.
            let fit = (0..free.len()).filter(|i| free[*i].capacity() >= capacity).min_by_key(|i| free[*i].capacity());
            fit.map(|at| free.swap_remove(at)).unwrap_or_default()
        };
        buffer.clear();
        buffer.reserve(capacity);
        for row in rows {
            buffer.extend_from_slice(row);
        }
        Bytes::from_owner(Pooled { buffer, pool: self.clone() })
    }
}

impl AsRef<[u8]> for Pooled {
    fn as_ref(&self) -> &[u8] {
        &self.buffer
    }
}

impl Drop for Pooled {
    fn drop(&mut self) {
        let mut free = self.pool.0.lock().unwrap_or_else(PoisonError::into_inner);
        if free.len() >= KEPT_BUFFERS {
            // The oldest go first, so that those of an earlier size do not stay for ever.
            free.remove(0);
        }
        free.push(std::mem::take(&mut self.buffer));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_planar_format_keeps_depth_and_chroma() {
        for (from, to, rgb) in [
            (Pixel::NV12, Pixel::YUV420P, false),
            (Pixel::P010LE, Pixel::YUV420P10LE, false),
            (Pixel::YUV420P12LE, Pixel::YUV420P10LE, false),
            (Pixel::UYVY422, Pixel::YUV422P, false),
            (Pixel::YUV422P16LE, Pixel::YUV422P10LE, false),
            (Pixel::YUVA444P, Pixel::YUV444P, false),
            (Pixel::GBRP, Pixel::YUV444P, true),
            (Pixel::GBRAP12LE, Pixel::YUV444P10LE, true),
            (Pixel::RGB48LE, Pixel::YUV444P10LE, true),
            (Pixel::X2RGB10LE, Pixel::YUV444P10LE, true),
        ] {
            assert_eq!((nearest_planar(from), is_rgb(from)), (to, rgb), "{from:?}");
            assert!(planar(to).is_some());
        }
    }
}
