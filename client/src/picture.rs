//! A decoded picture on its way to the GPU.

use mr360_protocol::video::{Colour, StereoLayout, Transfer};

/// One decoded equirect frame, both eyes.
pub struct Picture {
    /// Microseconds since the start of the broadcast.
    pub pts_us: u64,
    /// Columns of the whole frame.
    pub width: u32,
    /// Rows of the whole frame.
    pub height: u32,
    /// Where the eyes' views lie.
    pub stereo: StereoLayout,
    /// The samples.
    pub samples: Samples,
}

/// Samples of a picture.
pub enum Samples {
    /// Planar YUV.
    Yuv {
        /// Y, Cb, Cr.
        planes: [Plane; 3],
        /// What the codes mean. Samples of more than 8 bits take two bytes each, little-endian.
        colour: Colour,
    },
    /// Interleaved RGBA, four half floats a texel, BT.709 primaries, row by row from the top.
    Rgba16F {
        /// `width * height * 4` half floats.
        texels: Vec<half::f16>,
        /// How codes become light.
        transfer: Transfer,
    },
}

/// One plane of samples.
pub struct Plane {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: usize,
    /// The samples.
    pub data: bytes::Bytes,
}
