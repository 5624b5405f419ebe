//! Opens FFmpeg's decoders.

use ffmpeg_next as ffmpeg;
use ffmpeg_next::codec::{Context, Flags, Id, threading};

use super::hardware::{self, Device};
use super::{Hardware, MAX_SIDE, MAX_UNIT_BYTES, VideoFormat};

/// Video codecs that a broadcast may carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Codec {
    /// H.264, Annex B.
    H264,
    /// HEVC, Annex B.
    Hevc,
    /// AV1, low-overhead OBUs.
    Av1,
}

impl Codec {
    fn id(self) -> Id {
        match self {
            Self::H264 => Id::H264,
            Self::Hevc => Id::HEVC,
            Self::Av1 => Id::AV1,
        }
    }

    /// Decoders by preference: FFmpeg's own AV1 decoder works with a GPU only, so software comes before it.
    fn software_names(self) -> &'static [&'static str] {
        match self {
            Self::H264 => &["h264"],
            Self::Hevc => &["hevc"],
            Self::Av1 => &["libdav1d", "libaom-av1"],
        }
    }
}

impl std::fmt::Display for Codec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::H264 => "H.264",
            Self::Hevc => "HEVC",
            Self::Av1 => "AV1",
        })
    }
}

/// Why video cannot be decoded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// FFmpeg was built without a decoder.
    #[error("{codec} video cannot be decoded: this FFmpeg has no decoder for it; install one that has, or broadcast H.264")]
    NoDecoder {
        /// The codec.
        codec: Codec,
    },
    /// Larger than any GPU texture that can be counted on.
    #[error("video of {width}×{height} is too large, at most {MAX_SIDE}×{MAX_SIDE}; let the source send a smaller size")]
    TooLarge {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// One access unit is beyond the bound.
    #[error("video access unit of {bytes} bytes refused, at most {MAX_UNIT_BYTES}; lower the source's bit rate")]
    UnitTooLarge {
        /// Its size.
        bytes: usize,
    },
    /// A unit came before any format.
    #[error("video came before its format; the catalog must be read first")]
    NoFormat,
    /// Nobody takes pictures any more.
    #[error("the decoder has stopped because its pictures are no longer taken")]
    Stopped,
    /// The system gave no thread.
    #[error("cannot start the decoder's thread ({detail}); close other programs")]
    Thread {
        /// What the system said.
        detail: String,
    },
    /// FFmpeg failed.
    #[error("{codec} decoder: {action} failed ({fault})")]
    Ffmpeg {
        /// The codec.
        codec: Codec,
        /// What was tried.
        action: &'static str,
        /// FFmpeg's error.
        fault: ffmpeg::Error,
    },
}

/// A decoder that was opened, and how.
pub(super) struct Opened {
    pub(super) decoder: ffmpeg::decoder::Video,
    pub(super) on_gpu: bool,
}

/// Refuses sizes beyond [`MAX_SIDE`]; 0 stands for unknown.
pub(super) fn check_size(width: u32, height: u32) -> Result<(), DecodeError> {
    if width > MAX_SIDE || height > MAX_SIDE { Err(DecodeError::TooLarge { width, height }) } else { Ok(()) }
}

/// The software decoder of a codec.
pub(super) fn find(codec: Codec) -> Result<ffmpeg::Codec, DecodeError> {
    codec.software_names().iter().find_map(|name| ffmpeg::decoder::find_by_name(name)).ok_or(DecodeError::NoDecoder { codec })
}

/// Opens a decoder: on the GPU when wanted and possible, else in software, with one line in the log that says which and why.
pub(super) fn open(format: &VideoFormat, hardware: Hardware) -> Result<Opened, DecodeError> {
    let codec = format.codec;
    let why_not = match hardware {
        Hardware::Never => "hardware decoding is switched off".to_owned(),
        Hardware::Prefer => match open_on_gpu(codec) {
            Ok((decoder, device)) => {
                tracing::info!(%codec, device, "video is decoded by the GPU where the stream allows");
                return Ok(Opened { decoder, on_gpu: true });
            }
            Err(why_not) => why_not,
        },
    };
    let software = find(codec)?;
    let decoder = open_with(software, None).map_err(|fault| DecodeError::Ffmpeg { codec, action: "opening", fault })?;
    tracing::info!(%codec, decoder = software.name(), reason = why_not, "video is decoded in software");
    Ok(Opened { decoder, on_gpu: false })
}

fn open_on_gpu(codec: Codec) -> Result<(ffmpeg::decoder::Video, String), String> {
    // The decoder with FFmpeg's own name carries the GPU back ends; for AV1 it is not the software one.
    let native = ffmpeg::decoder::find(codec.id()).into_iter().chain(ffmpeg::decoder::find_by_name("av1").filter(|_| codec == Codec::Av1));
    let mut refusals = Vec::new();
    for decoder in native {
        match Device::open_for(&decoder) {
            Ok(device) => {
                let name = device.name().to_owned();
                return open_with(decoder, Some(device))
                    .map(|opened| (opened, name))
                    .map_err(|error| format!("{}: {error}", decoder.name()));
            }
            Err(refusal) => refusals.push(refusal),
        }
    }
    Err(refusals.join("; "))
}

fn open_with(decoder: ffmpeg::Codec, device: Option<Device>) -> Result<ffmpeg::decoder::Video, ffmpeg::Error> {
    let mut context = Context::new_with_codec(decoder);
    context.set_flags(Flags::LOW_DELAY);
    // Frame threads would hold back as many pictures as there are threads.
    context.set_threading(threading::Config { kind: threading::Type::Slice, count: 0, ..threading::Config::default() });
    if let Some(device) = device {
        hardware::attach(&mut context, device);
    }
    let mut options = ffmpeg::Dictionary::new();
    options.set("max_pixels", &(u64::from(MAX_SIDE) * u64::from(MAX_SIDE)).to_string());
    let mut decoder_context = context.decoder();
    decoder_context.set_packet_time_base((1, 1_000_000));
    decoder_context.open_as_with(decoder, options)?.video()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_its_cause_once() {
        let error = DecodeError::Ffmpeg { codec: Codec::H264, action: "decoding", fault: ffmpeg::Error::Eof };
        // In its text; with all causes, as programs print errors, it would stand there again.
        assert!(std::error::Error::source(&error).is_none());
    }
}
