//! Still panoramas from files: OpenEXR and Radiance HDR as linear light, PNG and JPEG as sRGB.

use std::io::{BufReader, Seek};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageError, ImageFormat, ImageReader, Limits};
use mr360_protocol::video::{StereoLayout, Transfer};

use crate::frame::{Frame, Pixels};

/// Most columns of an image.
pub const MAX_WIDTH: u32 = 16_384;
/// Most rows of an image.
pub const MAX_HEIGHT: u32 = 8_192;
/// Most bytes that a decoder may ask for: an image of the largest size in single-precision RGBA.
const MAX_ALLOCATION: u64 = MAX_WIDTH as u64 * MAX_HEIGHT as u64 * 16;

/// Why an image was not loaded.
#[derive(Debug, thiserror::Error)]
pub enum ImageFileError {
    /// The file cannot be opened or read.
    #[error("image {path:?}: cannot be read: {fault}; check the path and its permissions")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        fault: std::io::Error,
    },
    /// Neither EXR, HDR, PNG nor JPEG.
    #[error("image {path:?}: not an OpenEXR, Radiance HDR, PNG or JPEG file; convert it to one of these")]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// Larger than anything this program works on.
    #[error("image {path:?}: {width}×{height} pixels, at most {MAX_WIDTH}×{MAX_HEIGHT}; scale it down")]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// Damaged, or a variant that the decoder does not know.
    #[error("image {path:?}: cannot be decoded: {fault}; write it again, EXR files as RGB scanlines")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        fault: ImageError,
    },
}

/// Whether `path` names a still image by its extension: .exr, .hdr, .png, .jpg or .jpeg.
#[must_use]
pub fn is_image(path: &Path) -> bool {
    let extension = path.extension().and_then(|extension| extension.to_str());
    extension.is_some_and(|extension| ["exr", "hdr", "png", "jpg", "jpeg"].iter().any(|known| extension.eq_ignore_ascii_case(known)))
}

/// Loads a panorama as a mono [`Frame`] at time 0. The content decides the format, not the name; alpha is ignored.
///
/// # Errors
/// [`ImageFileError`] for a file that cannot be read, is no image of a known format, is damaged or too large.
pub fn load(path: &Path) -> Result<Frame, ImageFileError> {
    let io = |fault| ImageFileError::Io { path: path.to_owned(), fault };
    let malformed = |fault| match fault {
        ImageError::IoError(fault) if fault.kind() != std::io::ErrorKind::UnexpectedEof && fault.raw_os_error().is_some() => io(fault),
        fault => ImageFileError::Malformed { path: path.to_owned(), fault },
    };
    let mut file = BufReader::new(std::fs::File::open(path).map_err(io)?);
    let format = ImageReader::new(&mut file).with_guessed_format().map_err(io)?.format();
    let transfer = match format {
        Some(ImageFormat::OpenExr | ImageFormat::Hdr) => Transfer::Linear,
        Some(ImageFormat::Png | ImageFormat::Jpeg) => Transfer::Srgb,
        _ => return Err(ImageFileError::UnknownFormat { path: path.to_owned() }),
    };
    let Some(format) = format else { return Err(ImageFileError::UnknownFormat { path: path.to_owned() }) };
    file.rewind().map_err(io)?;
    // Asked before decoding, so that the size is named and nothing is allocated for it.
    let (width, height) = ImageReader::with_format(&mut file, format).into_dimensions().map_err(malformed)?;
    if width > MAX_WIDTH || height > MAX_HEIGHT {
        return Err(ImageFileError::TooLarge { path: path.to_owned(), width, height });
    }
    file.rewind().map_err(io)?;
    let mut reader = ImageReader::with_format(file, format);
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_WIDTH), Some(MAX_HEIGHT));
    limits.max_alloc = Some(MAX_ALLOCATION);
    reader.limits(limits);
    let picture = reader.decode().map_err(malformed)?;
    let (width, height) = (picture.width(), picture.height());
    Ok(Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Rgb { width, height, texels: texels(picture), transfer } })
}

fn texels(picture: DynamicImage) -> Vec<[f32; 3]> {
    // The decoders of HDR formats give four or three floats; copying straight from them saves a third picture.
    match picture {
        DynamicImage::ImageRgba32F(picture) => picture.pixels().map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect(),
        other => other.into_rgb32f().pixels().map(|pixel| pixel.0).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Rgb, Rgb32FImage, RgbImage};

    fn loaded(path: &Path) -> (u32, u32, Vec<[f32; 3]>, Transfer) {
        match load(path).unwrap().pixels {
            Pixels::Rgb { width, height, texels, transfer } => (width, height, texels, transfer),
            Pixels::Video(..) => panic!("images are RGB"),
        }
    }

    #[test]
    fn linear_and_srgb_files_keep_their_values() {
        let folder = tempfile::tempdir().unwrap();
        let hdr = Rgb32FImage::from_fn(8, 4, |x, y| Rgb([x as f32 * 512.0, y as f32 * 0.25, 1.0]));
        for (name, tolerance) in [("a.exr", 0.0), ("a.HDR", 0.01)] {
            let path = folder.path().join(name);
            assert!(is_image(&path));
            hdr.save_with_format(&path, if name == "a.exr" { ImageFormat::OpenExr } else { ImageFormat::Hdr }).unwrap();
            let (width, height, texels, transfer) = loaded(&path);
            assert_eq!((width, height, transfer), (8, 4, Transfer::Linear));
            for (texel, pixel) in texels.iter().zip(hdr.pixels()) {
                // Radiance files share one exponent among the channels: 1 in 128 of the largest.
                let largest = pixel.0.iter().copied().fold(0.0, f32::max);
                assert!(texel.iter().zip(pixel.0).all(|(a, b)| (a - b).abs() <= tolerance * largest), "{name} {texel:?} {pixel:?}");
            }
        }
        let ldr = RgbImage::from_fn(8, 4, |x, _| Rgb([x as u8 * 30, 255, 0]));
        let path = folder.path().join("a.png");
        ldr.save(&path).unwrap();
        let (width, height, texels, transfer) = loaded(&path);
        assert_eq!((width, height, transfer), (8, 4, Transfer::Srgb));
        assert_eq!(texels[7], [210.0 / 255.0, 1.0, 0.0]);
        // A wrong extension does not matter, the content does.
        let renamed = folder.path().join("b.exr");
        std::fs::rename(&path, &renamed).unwrap();
        assert_eq!(loaded(&renamed).3, Transfer::Srgb);
    }

    #[test]
    fn bad_files_are_named_with_their_fault() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let failure = |name: &str| load(&path(name)).err().unwrap();
        assert!(matches!(failure("missing.png"), ImageFileError::Io { .. }));
        std::fs::write(path("empty.png"), []).unwrap();
        assert!(matches!(failure("empty.png"), ImageFileError::UnknownFormat { .. }));
        std::fs::write(path("text.jpg"), "hello").unwrap();
        assert!(matches!(failure("text.jpg"), ImageFileError::UnknownFormat { .. }));
        RgbImage::new(64, 32).save(path("whole.png")).unwrap();
        let whole = std::fs::read(path("whole.png")).unwrap();
        std::fs::write(path("cut.png"), &whole[..whole.len() / 2]).unwrap();
        let error = failure("cut.png");
        assert!(matches!(error, ImageFileError::Malformed { .. }), "{error:?}");
        assert!(error.to_string().contains("cut.png"), "{error}");
        // Causes are printed after the message: what the message says already is none.
        assert!(std::error::Error::source(&error).is_none() && std::error::Error::source(&failure("missing.png")).is_none());
        for cut in [16, 100, 300] {
            let path = path("cut.exr");
            Rgb32FImage::new(16, 8).save(&path).unwrap();
            let whole = std::fs::read(&path).unwrap();
            std::fs::write(&path, &whole[..cut]).unwrap();
            assert!(matches!(load(&path), Err(ImageFileError::Malformed { .. })), "cut at {cut}");
        }
        RgbImage::new(20_000, 1).save(path("wide.png")).unwrap();
        let error = failure("wide.png");
        assert!(matches!(error, ImageFileError::TooLarge { width: 20_000, .. }), "{error:?}");
        assert!(!is_image(&path("clip.mp4")) && !is_image(Path::new("rtmp://host/app")));
    }
}
