//! How the sphere lies in the picture: projection and stereo, from flags, metadata, or the picture's shape.

use ffmpeg_next::Rational;
use ffmpeg_next::codec::packet::side_data::Type;
use ffmpeg_next::format::stream::Stream;
use mr360_protocol::video::StereoLayout;

use super::error::IngestError;
use super::raw::VideoParameters;

/// Fewest columns.
pub(super) const MIN_WIDTH: u32 = 16;
/// Fewest rows.
pub(super) const MIN_HEIGHT: u32 = 8;
/// Most columns or rows.
pub(super) const MAX_SIDE: u32 = 8192;

/// How the sphere is drawn in one eye's picture.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Deserialize)]
#[serde(try_from = "String")]
pub enum Projection {
    /// Longitude across, latitude down. Broadcast as it is.
    #[default]
    Equirect,
    /// Six faces, three by two: right, left, up above down, front, back.
    Cubemap,
    /// Equi-angular cubemap, three by two, as in YouTube's files.
    Eac,
    /// Two fisheye circles side by side, equidistant: the front lens at the left, the back lens at the right, both upright.
    DualFisheye {
        /// Field of view of each lens, degrees, in (0, 360).
        fov_deg: f32,
    },
}

/// Field of view of a fisheye lens that is not told: that of the common two-lens cameras.
const DEFAULT_FISHEYE_DEG: f32 = 190.0;

impl std::str::FromStr for Projection {
    type Err = String;

    /// Reads `equirect`, `cubemap`, `eac` or `dual-fisheye[:DEGREES]`.
    fn from_str(text: &str) -> Result<Self, String> {
        let (name, degrees) = text.split_once(':').map_or((text, None), |(name, degrees)| (name, Some(degrees)));
        match (name, degrees) {
            ("equirect", None) => Ok(Self::Equirect),
            ("cubemap", None) => Ok(Self::Cubemap),
            ("eac", None) => Ok(Self::Eac),
            ("dual-fisheye", None) => Ok(Self::DualFisheye { fov_deg: DEFAULT_FISHEYE_DEG }),
            ("dual-fisheye", Some(degrees)) => match degrees.parse() {
                Ok(fov_deg) if fov_deg > 0.0 && fov_deg < 360.0 => Ok(Self::DualFisheye { fov_deg }),
                _ => Err(format!("{degrees:?} is not a field of view in degrees, more than 0 and less than 360")),
            },
            _ => Err(format!("{text:?} is not a projection; use equirect, cubemap, eac or dual-fisheye[:DEGREES]")),
        }
    }
}

impl TryFrom<String> for Projection {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

/// What the user states; it overrules metadata.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct LayoutFlags {
    /// Stereo layout, if stated.
    pub(super) stereo: Option<StereoLayout>,
    /// Projection, if stated.
    pub(super) projection: Option<Projection>,
}

/// The layout that holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Layout {
    pub(super) stereo: StereoLayout,
    pub(super) projection: Projection,
}

/// Spherical metadata of a stream.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct SphericalMetadata {
    projection: Option<Result<Projection, String>>,
    stereo: Option<Result<StereoLayout, String>>,
}

impl SphericalMetadata {
    pub(super) fn of(stream: &Stream<'_>) -> Self {
        let mut metadata = Self::default();
        for side_data in stream.side_data() {
            match side_data.kind() {
                Type::DataSpherical => metadata.projection = projection_of(side_data.data()),
                Type::Stereo3d => metadata.stereo = stereo_of(side_data.data()),
                _ => {}
            }
        }
        metadata
    }
}

/// Fields of a C struct of 32-bit values (AVSphericalMapping, AVStereo3D; both are such since FFmpeg 3.1).
fn field(data: &[u8], index: usize) -> Option<u32> {
    let bytes = data.get(index * 4..index * 4 + 4)?;
    Some(u32::from_ne_bytes(bytes.try_into().ok()?))
}

fn projection_of(data: &[u8]) -> Option<Result<Projection, String>> {
    Some(match field(data, 0)? {
        0 => Ok(Projection::Equirect),
        1 if field(data, 8).unwrap_or(0) == 0 => Ok(Projection::Cubemap),
        1 => Err("its cubemap has padded faces".to_owned()),
        2 if (4..8).all(|bound| field(data, bound).unwrap_or(0) == 0) => Ok(Projection::Equirect),
        2 => Err("it holds only a part of the sphere".to_owned()),
        other => Err(format!("its spherical metadata names projection {other}, which is not supported")),
    })
}

fn stereo_of(data: &[u8]) -> Option<Result<StereoLayout, String>> {
    let inverted = field(data, 1)? & 1 != 0;
    Some(match (field(data, 0)?, inverted) {
        (0, _) => Ok(StereoLayout::Mono),
        (1, false) => Ok(StereoLayout::SideBySide),
        (2, false) => Ok(StereoLayout::TopBottom),
        (1 | 2, true) => Err("its stereo metadata puts the right eye first".to_owned()),
        (other, _) => Err(format!("its stereo metadata names packing {other}, which is not supported")),
    })
}

/// Decides, and logs every assumption and every contradiction.
pub(super) fn decide(
    input: &str,
    flags: LayoutFlags,
    metadata: &SphericalMetadata,
    video: &VideoParameters,
) -> Result<Layout, IngestError> {
    check_size(input, video.width, video.height)?;
    let projection = match (flags.projection, &metadata.projection) {
        (Some(flag), stated) => {
            if stated.as_ref().is_some_and(|stated| !matches!(stated, Ok(same) if *same == flag)) {
                tracing::warn!(input, ?flag, metadata = ?stated, "the projection flag overrules the metadata");
            }
            flag
        }
        (None, Some(Ok(stated))) => *stated,
        (None, Some(Err(detail))) => return Err(IngestError::UnsupportedProjection { input: input.to_owned(), detail: detail.clone() }),
        (None, None) => Projection::Equirect,
    };
    if let Projection::DualFisheye { fov_deg } = projection
        && !(fov_deg > 0.0 && fov_deg < 360.0)
    {
        let detail = format!("a fisheye lens of {fov_deg}° is impossible");
        return Err(IngestError::UnsupportedProjection { input: input.to_owned(), detail });
    }
    let stereo = match (flags.stereo, &metadata.stereo) {
        (Some(flag), stated) => {
            if stated.as_ref().is_some_and(|stated| !matches!(stated, Ok(same) if *same == flag)) {
                tracing::warn!(input, ?flag, metadata = ?stated, "the stereo flag overrules the metadata");
            }
            flag
        }
        (None, Some(Ok(stated))) => *stated,
        (None, Some(Err(detail))) => return Err(IngestError::UnsupportedProjection { input: input.to_owned(), detail: detail.clone() }),
        (None, None) => guess_stereo(input, projection, metadata, video),
    };
    if projection == Projection::Equirect {
        let (width, height) = stereo.eye_size(video.width, video.height);
        if width != height * 2 {
            tracing::warn!(input, width, height, ?stereo, "one eye's picture is not 2:1; it is stretched over the whole sphere");
        }
    }
    Ok(Layout { stereo, projection })
}

/// Without any statement: a square equirect picture, as displayed, holds two 2:1 pictures one above the other.
fn guess_stereo(input: &str, projection: Projection, metadata: &SphericalMetadata, video: &VideoParameters) -> StereoLayout {
    let Rational(num, den) = video.sample_aspect;
    let pixel_aspect = if num > 0 && den > 0 { f64::from(num) / f64::from(den) } else { 1.0 };
    let aspect = f64::from(video.width) * pixel_aspect / f64::from(video.height.max(1));
    if projection == Projection::Equirect && (aspect - 1.0).abs() < 0.02 {
        tracing::warn!(input, "no stereo metadata and no flag: the picture is square, so top-bottom stereo is assumed");
        return StereoLayout::TopBottom;
    }
    if metadata.projection.is_none() {
        tracing::info!(input, ?projection, "no spherical metadata and no stereo flag: mono is assumed");
    }
    StereoLayout::Mono
}

/// Refuses sizes that nothing downstream is made for.
pub(super) fn check_size(input: &str, width: u32, height: u32) -> Result<(), IngestError> {
    if width < MIN_WIDTH || height < MIN_HEIGHT || width > MAX_SIDE || height > MAX_SIDE {
        return Err(IngestError::UnsupportedSize { input: input.to_owned(), width, height });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::test_media::parameters;

    fn bytes(fields: &[u32]) -> Vec<u8> {
        fields.iter().flat_map(|field| field.to_ne_bytes()).collect()
    }

    fn metadata(projection: &[u32], stereo: &[u32]) -> SphericalMetadata {
        SphericalMetadata { projection: projection_of(&bytes(projection)), stereo: stereo_of(&bytes(stereo)) }
    }

    #[test]
    fn metadata_is_honoured_and_flags_overrule_it() {
        let stated = metadata(&[1, 0, 0, 0, 0, 0, 0, 0, 0], &[2, 0, 0]);
        let layout = decide("x", LayoutFlags::default(), &stated, &parameters(960, 640)).unwrap();
        assert_eq!(layout, Layout { stereo: StereoLayout::TopBottom, projection: Projection::Cubemap });
        let flags = LayoutFlags { stereo: Some(StereoLayout::Mono), projection: Some(Projection::Eac) };
        let layout = decide("x", flags, &stated, &parameters(960, 640)).unwrap();
        assert_eq!(layout, Layout { stereo: StereoLayout::Mono, projection: Projection::Eac });
    }

    #[test]
    fn shape_decides_only_when_nothing_is_stated() {
        let nothing = SphericalMetadata::default();
        let stereo = |video: &VideoParameters| decide("x", LayoutFlags::default(), &nothing, video).unwrap().stereo;
        assert_eq!(stereo(&parameters(1280, 640)), StereoLayout::Mono);
        assert_eq!(stereo(&parameters(1280, 1280)), StereoLayout::TopBottom);
        assert_eq!(stereo(&parameters(1920, 1080)), StereoLayout::Mono);
        let squeezed = VideoParameters { sample_aspect: Rational(9, 16), ..parameters(1920, 1080) };
        assert_eq!(stereo(&squeezed), StereoLayout::TopBottom);
        let stated = metadata(&[0; 9], &[0, 0, 0]);
        assert_eq!(decide("x", LayoutFlags::default(), &stated, &parameters(1280, 1280)).unwrap().stereo, StereoLayout::Mono);
    }

    #[test]
    fn partial_spheres_and_unknown_packings_are_refused_unless_flagged() {
        let part = metadata(&[2, 0, 0, 0, 1 << 30, 0, 1 << 30, 0, 0], &[0, 0, 0]);
        assert!(matches!(decide("x", LayoutFlags::default(), &part, &parameters(64, 32)), Err(IngestError::UnsupportedProjection { .. })));
        let flags = LayoutFlags { projection: Some(Projection::Equirect), ..LayoutFlags::default() };
        assert!(decide("x", flags, &part, &parameters(64, 32)).is_ok());
        for stereo in [[6, 0, 0], [2, 1, 0]] {
            assert!(decide("x", LayoutFlags::default(), &metadata(&[0; 9], &stereo), &parameters(64, 32)).is_err());
        }
        // Cut off structures say nothing.
        assert_eq!((projection_of(&[0, 0]), stereo_of(&[])), (None, None));
    }

    #[test]
    fn sizes_outside_the_bounds_are_refused() {
        for (width, height) in [(1, 1), (15, 8), (16, 7), (8193, 4096), (4096, 8193), (0, 0)] {
            assert!(matches!(check_size("x", width, height), Err(IngestError::UnsupportedSize { .. })), "{width}x{height}");
        }
        assert!(check_size("x", 16, 8).is_ok() && check_size("x", 8192, 8192).is_ok());
    }
}
