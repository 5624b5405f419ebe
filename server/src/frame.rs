//! A decoded panorama, as it passes from ingest to light.

use ffmpeg_next::format::Pixel;
use mr360_protocol::video::{Colour, StereoLayout, Transfer};

/// Pixel formats that [`Pixels::Video`] may hold; ingest converts everything else to one of these.
pub const SUPPORTED_PIXELS: [Pixel; 7] =
    [Pixel::YUV420P, Pixel::YUVJ420P, Pixel::YUV422P, Pixel::YUV444P, Pixel::YUV420P10LE, Pixel::YUV422P10LE, Pixel::YUV444P10LE];

/// One decoded equirect frame.
pub struct Frame {
    /// Microseconds since the start of the broadcast.
    pub pts_us: u64,
    /// Where the eyes' views lie.
    pub stereo: StereoLayout,
    /// The picture.
    pub pixels: Pixels,
}

/// Pixels of a frame.
pub enum Pixels {
    /// Planar YUV of one of [`SUPPORTED_PIXELS`], and what its codes mean.
    Video(ffmpeg_next::frame::Video, Colour),
    /// BT.709 primaries, row by row from the top, `width * height` long.
    Rgb {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Code values; linear radiance where the transfer is [`Transfer::Linear`].
        texels: Vec<[f32; 3]>,
        /// How codes become light.
        transfer: Transfer,
    },
}

impl Frame {
    /// Width and height in pixels of the whole frame, all eyes together.
    #[must_use]
    pub fn size(&self) -> (u32, u32) {
        match &self.pixels {
            Pixels::Video(video, _) => (video.width(), video.height()),
            Pixels::Rgb { width, height, .. } => (*width, *height),
        }
    }
}
