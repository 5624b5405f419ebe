//! What the catalog says of our video beyond what any MoQ player needs.

use serde::{Deserialize, Serialize};

/// Where the eyes' views lie in one equirect frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StereoLayout {
    /// One view for both eyes.
    #[default]
    Mono,
    /// Left eye above right eye.
    TopBottom,
    /// Left eye left of right eye.
    SideBySide,
}

impl StereoLayout {
    /// Rectangle of one eye's view as (offset u, offset v, scale u, scale v) in frame coordinates.
    #[must_use]
    pub fn eye_rect(self, right_eye: bool) -> [f32; 4] {
        let second = if right_eye { 0.5 } else { 0.0 };
        match self {
            Self::Mono => [0.0, 0.0, 1.0, 1.0],
            Self::TopBottom => [0.0, second, 1.0, 0.5],
            Self::SideBySide => [second, 0.0, 0.5, 1.0],
        }
    }

    /// Size in pixels of one eye's view in a frame of this size.
    #[must_use]
    pub fn eye_size(self, width: u32, height: u32) -> (u32, u32) {
        match self {
            Self::Mono => (width, height),
            Self::TopBottom => (width, height / 2),
            Self::SideBySide => (width / 2, height),
        }
    }
}

/// Colour of the coded video, by the names of ITU-T H.273.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub struct Colour {
    /// Colour primaries.
    pub primaries: Primaries,
    /// YUV matrix.
    pub matrix: Matrix,
    /// Transfer function.
    pub transfer: Transfer,
    /// True for full range, false for limited ("video") range.
    pub full_range: bool,
    /// Bits a sample: 8 or 10.
    pub bit_depth: u8,
}

impl Default for Colour {
    fn default() -> Self {
        Self { primaries: Primaries::Bt709, matrix: Matrix::Bt709, transfer: Transfer::Bt709, full_range: false, bit_depth: 8 }
    }
}

/// Colour primaries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Primaries {
    /// BT.709 and sRGB.
    Bt709,
    /// BT.601, 625 lines.
    Bt601Pal,
    /// BT.601, 525 lines.
    Bt601Ntsc,
    /// BT.2020.
    Bt2020,
}

/// YUV matrix coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Matrix {
    /// BT.601.
    Bt601,
    /// BT.709.
    Bt709,
    /// BT.2020, non-constant luminance.
    Bt2020,
}

/// Transfer function of the code values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transfer {
    /// BT.709 camera video, shown as BT.1886 says: a power of 2.4.
    Bt709,
    /// sRGB, piecewise.
    Srgb,
    /// Already linear.
    Linear,
    /// SMPTE ST 2084.
    Pq,
    /// Hybrid log-gamma.
    Hlg,
}

/// Root section `mr360` of the catalog: what our client needs beside the hang catalog.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CatalogSection {
    /// Raised on every incompatible change.
    pub version: u32,
    /// Layout of the equirect video.
    pub stereo: StereoLayout,
    /// Colour of the coded video.
    pub colour: Colour,
    /// Name of the video track that `stereo` and `colour` describe; `None` until the source has come.
    pub video: Option<String>,
    /// Name of the light method that runs.
    pub method: String,
    /// Name of the light track.
    pub light: String,
    /// Name of the scene track.
    pub scene: String,
}

impl CatalogSection {
    /// Version that this program speaks.
    pub const VERSION: u32 = 1;
}

/// The catalog's root sections beyond hang's own.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CatalogExtension {
    /// Ours; absent on a broadcast that is plain video.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mr360: Option<CatalogSection>,
}

impl moq_mux::catalog::hang::CatalogExt for CatalogExtension {}
