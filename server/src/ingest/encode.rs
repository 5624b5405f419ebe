//! Encoding pictures for live playback: no reordering, a keyframe at least every second, parameter sets inline.

use bytes::Bytes;
use ffmpeg_next::codec::Context;
use ffmpeg_next::format::Pixel;
use ffmpeg_next::{Dictionary, Error, Packet, Rational, encoder, frame, picture};
use mr360_protocol::video::{Colour, Transfer};

use super::VideoCodec;
use super::colour::tags_of;
use super::error::IngestError;
use super::raw;

/// Distance of keyframes, microseconds.
const GOP_US: i64 = 1_000_000;
/// Pictures of at least this many pixels are encoded with the fastest preset.
const FASTEST_FROM: u64 = 1920 * 960;

/// What is encoded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Encoding {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) pixel: Pixel,
    pub(super) colour: Colour,
    pub(super) frame_rate: f64,
}

impl Encoding {
    /// H.264, except that HDR needs the 10 bits of HEVC.
    pub(super) fn codec(&self) -> VideoCodec {
        if matches!(self.colour.transfer, Transfer::Pq | Transfer::Hlg) { VideoCodec::Hevc } else { VideoCodec::H264 }
    }

    fn encoder_name(&self) -> &'static str {
        if self.codec() == VideoCodec::Hevc { "libx265" } else { "libx264" }
    }

    /// Fails if this FFmpeg lacks the encoder.
    pub(super) fn check(&self, input: &str) -> Result<(), IngestError> {
        match encoder::find_by_name(self.encoder_name()) {
            Some(_) => Ok(()),
            None => Err(self.error(input, Error::EncoderNotFound)),
        }
    }

    pub(super) fn error(&self, input: &str, error: Error) -> IngestError {
        IngestError::Encoder { input: input.to_owned(), codec: self.encoder_name(), detail: error.to_string() }
    }
}

/// One encoded picture.
pub(super) struct Coded {
    pub(super) pts_us: i64,
    pub(super) keyframe: bool,
    pub(super) data: Bytes,
}

/// A video encoder; timestamps are in microseconds.
pub(super) struct VideoEncoder {
    encoder: encoder::video::Encoder,
    last_key_us: Option<i64>,
}

impl VideoEncoder {
    pub(super) fn new(encoding: &Encoding) -> Result<Self, Error> {
        let codec = encoder::find_by_name(encoding.encoder_name()).ok_or(Error::EncoderNotFound)?;
        let mut video = Context::new_with_codec(codec).encoder().video()?;
        video.set_width(encoding.width);
        video.set_height(encoding.height);
        video.set_format(encoding.pixel);
        video.set_time_base(Rational(1, 1_000_000));
        video.set_frame_rate(Some(Rational::from(encoding.frame_rate)));
        let gop = encoding.frame_rate.clamp(1.0, 240.0) as u32;
        video.set_gop(gop);
        video.set_max_b_frames(0);
        raw::tag_encoder(&mut video, &tags_of(encoding.colour, encoding.pixel, encoding.height));
        let encoder = video.open_as_with(codec, options(encoding, gop))?;
        Ok(Self { encoder, last_key_us: None })
    }

    /// Encodes one picture, which must have its timestamp.
    pub(super) fn encode(&mut self, picture: &mut frame::Video) -> Result<Vec<Coded>, Error> {
        let pts_us = picture.pts().ok_or(Error::InvalidData)?;
        // The encoder counts frames; a source slower than it says would get longer GOPs. And it obeys the type that the
        // picture had in the source, if that is left in place.
        let due = self.last_key_us.is_none_or(|last| pts_us - last >= GOP_US);
        picture.set_kind(if due { picture::Type::I } else { picture::Type::None });
        if due {
            self.last_key_us = Some(pts_us);
        }
        self.encoder.send_frame(picture)?;
        self.receive()
    }

    /// What is still inside.
    pub(super) fn finish(&mut self) -> Result<Vec<Coded>, Error> {
        self.encoder.send_eof()?;
        self.receive()
    }

    fn receive(&mut self) -> Result<Vec<Coded>, Error> {
        let mut coded = Vec::new();
        loop {
            let mut packet = Packet::empty();
            match self.encoder.receive_packet(&mut packet) {
                Ok(()) => {
                    let (Some(pts_us), Some(data)) = (packet.pts(), packet.data()) else { continue };
                    if packet.is_key() {
                        self.last_key_us = Some(pts_us);
                    }
                    coded.push(Coded { pts_us, keyframe: packet.is_key(), data: Bytes::copy_from_slice(data) });
                }
                Err(Error::Eof) => return Ok(coded),
                Err(Error::Other { errno }) if errno == ffmpeg_next::error::EAGAIN => return Ok(coded),
                Err(error) => return Err(error),
            }
        }
    }
}

fn options(encoding: &Encoding, gop: u32) -> Dictionary<'static> {
    let mut options = Dictionary::new();
    let fastest = u64::from(encoding.width) * u64::from(encoding.height) >= FASTEST_FROM;
    options.set("preset", if fastest || encoding.codec() == VideoCodec::Hevc { "ultrafast" } else { "veryfast" });
    options.set("tune", "zerolatency");
    options.set("crf", "23");
    options.set("forced-idr", "1");
    match encoding.codec() {
        VideoCodec::Hevc => {
            let parameters = format!("keyint={gop}:min-keyint=1:scenecut=0:bframes=0:repeat-headers=1:open-gop=0:log-level=none");
            options.set("x265-params", &parameters);
        }
        _ => options.set("x264-params", &format!("keyint={gop}:min-keyint=1:scenecut=0:bframes=0:repeat-headers=1:open-gop=0")),
    }
    options
}
