//! What the codes of a picture mean, from the tags of the stream.

use ffmpeg_next::color::{Primaries as P, Range as R, Space as S, TransferCharacteristic as T};
use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use mr360_protocol::video::{Colour, Matrix, Primaries, Transfer};

use super::raw::VideoParameters;

/// Colour tags as FFmpeg names them, with what guesses need.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tags {
    pub(super) pixel: Pixel,
    pub(super) primaries: P,
    pub(super) transfer: T,
    pub(super) matrix: S,
    pub(super) range: R,
    pub(super) height: u32,
}

impl Tags {
    pub(super) fn of_stream(video: &VideoParameters) -> Self {
        Self {
            pixel: video.pixel,
            primaries: video.primaries,
            transfer: video.transfer,
            matrix: video.matrix,
            range: video.range,
            height: video.height,
        }
    }

    pub(super) fn of_frame(frame: &frame::Video) -> Self {
        Self {
            pixel: frame.format(),
            primaries: frame.color_primaries(),
            transfer: frame.color_transfer_characteristic(),
            matrix: frame.color_space(),
            range: frame.color_range(),
            height: frame.height(),
        }
    }

    /// The colour of pictures with these tags once they are in `target`, one of the supported formats.
    ///
    /// What is not specified is guessed: HDR transfers imply BT.2020, at least 720 rows BT.709, fewer BT.601 (of 525 lines up to
    /// 480 rows, of 625 above); BT.709 transfer; limited range unless the pixel format says full. RGB has no YUV matrix: it is converted with BT.709's to limited range.
    pub(super) fn colour(&self, target: Pixel) -> Colour {
        let transfer = match self.transfer {
            T::SMPTE2084 => Transfer::Pq,
            T::ARIB_STD_B67 => Transfer::Hlg,
            T::Linear => Transfer::Linear,
            T::IEC61966_2_1 => Transfer::Srgb,
            T::Unspecified if is_rgb(self.pixel) => Transfer::Srgb,
            _ => Transfer::Bt709,
        };
        let hdr = matches!(transfer, Transfer::Pq | Transfer::Hlg);
        let primaries = match self.primaries {
            P::BT2020 => Primaries::Bt2020,
            P::BT470BG => Primaries::Bt601Pal,
            P::SMPTE170M | P::SMPTE240M => Primaries::Bt601Ntsc,
            P::Unspecified | P::Reserved | P::Reserved0 => match self.matrix {
                S::BT2020NCL | S::BT2020CL => Primaries::Bt2020,
                S::BT709 => Primaries::Bt709,
                _ if hdr => Primaries::Bt2020,
                _ if self.height >= 720 || is_rgb(self.pixel) => Primaries::Bt709,
                _ if self.height > 480 => Primaries::Bt601Pal,
                _ => Primaries::Bt601Ntsc,
            },
            _ => Primaries::Bt709,
        };
        let matrix = match self.matrix {
            _ if is_rgb(self.pixel) => Matrix::Bt709,
            S::BT709 => Matrix::Bt709,
            S::BT470BG | S::SMPTE170M => Matrix::Bt601,
            S::BT2020NCL | S::BT2020CL => Matrix::Bt2020,
            _ if primaries == Primaries::Bt2020 => Matrix::Bt2020,
            _ if self.height >= 720 => Matrix::Bt709,
            _ => Matrix::Bt601,
        };
        let full_range = !is_rgb(self.pixel) && (self.range == R::JPEG || is_full_range(self.pixel));
        Colour { primaries, matrix, transfer, full_range, bit_depth: bit_depth(target) }
    }
}

/// The tags that say this colour, for an encoder.
pub(super) fn tags_of(colour: Colour, pixel: Pixel, height: u32) -> Tags {
    Tags {
        pixel,
        height,
        primaries: match colour.primaries {
            Primaries::Bt709 => P::BT709,
            Primaries::Bt601Pal => P::BT470BG,
            Primaries::Bt601Ntsc => P::SMPTE170M,
            Primaries::Bt2020 => P::BT2020,
        },
        transfer: match colour.transfer {
            Transfer::Bt709 => T::BT709,
            Transfer::Srgb => T::IEC61966_2_1,
            Transfer::Linear => T::Linear,
            Transfer::Pq => T::SMPTE2084,
            Transfer::Hlg => T::ARIB_STD_B67,
        },
        matrix: match colour.matrix {
            Matrix::Bt601 => S::SMPTE170M,
            Matrix::Bt709 => S::BT709,
            Matrix::Bt2020 => S::BT2020NCL,
        },
        range: if colour.full_range { R::JPEG } else { R::MPEG },
    }
}

/// The supported format that loses least.
pub(super) fn nearest_supported(pixel: Pixel) -> Pixel {
    let Some(descriptor) = pixel.descriptor() else { return Pixel::YUV420P };
    let chroma = if is_rgb(pixel) { (0, 0) } else { (descriptor.log2_chroma_w(), descriptor.log2_chroma_h()) };
    let deep = bit_depth(pixel) > 8;
    match (chroma, deep) {
        _ if is_full_range(pixel) => Pixel::YUVJ420P,
        _ if descriptor.nb_components() < 3 && deep => Pixel::YUV420P10LE,
        _ if descriptor.nb_components() < 3 => Pixel::YUV420P,
        ((0, 0), false) => Pixel::YUV444P,
        ((0, 0), true) => Pixel::YUV444P10LE,
        ((1, 0), false) => Pixel::YUV422P,
        ((1, 0), true) => Pixel::YUV422P10LE,
        (_, false) => Pixel::YUV420P,
        (_, true) => Pixel::YUV420P10LE,
    }
}

/// What an encoder for broadcast takes: 4:2:0, of 10 bits where the light is HDR.
pub(super) fn broadcast_pixel(colour: Colour, source: Pixel) -> Pixel {
    match colour.transfer {
        Transfer::Pq | Transfer::Hlg => Pixel::YUV420P10LE,
        _ if is_full_range(source) => Pixel::YUVJ420P,
        _ => Pixel::YUV420P,
    }
}

pub(super) fn is_full_range(pixel: Pixel) -> bool {
    matches!(pixel, Pixel::YUVJ420P | Pixel::YUVJ422P | Pixel::YUVJ444P | Pixel::YUVJ440P | Pixel::YUVJ411P)
}

pub(super) fn is_rgb(pixel: Pixel) -> bool {
    pixel.descriptor().is_some_and(|descriptor| {
        let name = descriptor.name();
        ["rgb", "bgr", "gbr", "argb", "abgr", "0rgb", "0bgr", "pal8"].iter().any(|prefix| name.starts_with(prefix))
    })
}

/// 8, or 10 for anything deeper.
fn bit_depth(pixel: Pixel) -> u8 {
    let Some(descriptor) = pixel.descriptor() else { return 8 };
    let samples = match (descriptor.log2_chroma_w(), descriptor.log2_chroma_h()) {
        // Samples a pixel, doubled, by chroma subsampling.
        _ if descriptor.nb_components() < 3 => 2 * i32::from(descriptor.nb_components()),
        (0, 0) => 6,
        (1, 0) | (0, 1) => 4,
        _ => 3,
    };
    let alpha = if descriptor.nb_components() == 4 { 2 } else { 0 };
    if descriptor.bits_per_pixel() * 2 > (samples + alpha) * 8 { 10 } else { 8 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::SUPPORTED_PIXELS;
    use crate::ingest::test_media::parameters;

    fn tags(height: u32) -> Tags {
        Tags::of_stream(&parameters(height * 2, height))
    }

    #[test]
    fn unspecified_is_guessed_by_the_rows() {
        let colour = tags(1080).colour(Pixel::YUV420P);
        assert_eq!(colour, Colour::default());
        let colour = tags(576).colour(Pixel::YUV420P);
        assert_eq!((colour.matrix, colour.primaries), (Matrix::Bt601, Primaries::Bt601Pal));
        assert_eq!(tags(480).colour(Pixel::YUV420P).primaries, Primaries::Bt601Ntsc);
    }

    #[test]
    fn hdr_implies_bt2020_and_tags_win_over_guesses() {
        for (tag, transfer) in [(T::SMPTE2084, Transfer::Pq), (T::ARIB_STD_B67, Transfer::Hlg)] {
            let colour = Tags { transfer: tag, ..tags(480) }.colour(Pixel::YUV420P10LE);
            let expected = Colour { primaries: Primaries::Bt2020, matrix: Matrix::Bt2020, transfer, full_range: false, bit_depth: 10 };
            assert_eq!(colour, expected);
        }
        let colour = Tags { matrix: S::SMPTE170M, primaries: P::BT709, range: R::JPEG, ..tags(1080) }.colour(Pixel::YUV420P);
        assert_eq!((colour.matrix, colour.primaries, colour.full_range), (Matrix::Bt601, Primaries::Bt709, true));
        assert!(Tags { pixel: Pixel::YUVJ420P, ..tags(1080) }.colour(Pixel::YUVJ420P).full_range);
    }

    #[test]
    fn encoder_tags_read_back_as_the_same_colour() {
        for (transfer, matrix, primaries, full_range) in [
            (Transfer::Bt709, Matrix::Bt601, Primaries::Bt601Ntsc, true),
            (Transfer::Srgb, Matrix::Bt709, Primaries::Bt709, false),
            (Transfer::Hlg, Matrix::Bt2020, Primaries::Bt2020, false),
            (Transfer::Linear, Matrix::Bt601, Primaries::Bt601Pal, false),
        ] {
            let colour = Colour { primaries, matrix, transfer, full_range, bit_depth: 8 };
            assert_eq!(tags_of(colour, Pixel::YUV420P, 64).colour(Pixel::YUV420P), colour);
        }
    }

    #[test]
    fn nearest_keeps_depth_and_chroma() {
        for pixel in SUPPORTED_PIXELS {
            assert_eq!(nearest_supported(pixel), pixel);
        }
        for (pixel, nearest) in [
            (Pixel::NV12, Pixel::YUV420P),
            (Pixel::P010LE, Pixel::YUV420P10LE),
            (Pixel::YUV444P12LE, Pixel::YUV444P10LE),
            (Pixel::YUV422P16LE, Pixel::YUV422P10LE),
            (Pixel::YUVA420P, Pixel::YUV420P),
            (Pixel::YUYV422, Pixel::YUV422P),
            (Pixel::YUV410P, Pixel::YUV420P),
            (Pixel::GRAY8, Pixel::YUV420P),
            (Pixel::GRAY10LE, Pixel::YUV420P10LE),
            (Pixel::RGB24, Pixel::YUV444P),
            (Pixel::GBRP10LE, Pixel::YUV444P10LE),
            (Pixel::YUVJ444P, Pixel::YUVJ420P),
        ] {
            assert_eq!(nearest_supported(pixel), nearest, "{pixel:?}");
        }
    }
}
