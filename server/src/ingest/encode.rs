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

/// Most bits a second for each pixel a second. Platforms that take 1080p to 2160p uploads ask for 0.13 to 0.18 (8 Mbit/s for 1920×1080 at 30/s,
/// 35 to 45 for 3840×2160), and ours has no B frames to save with.
const MAX_BITS_PER_PIXEL: f64 = 0.15;
/// Small pictures take more bits a pixel, and below a megabit a second no link is the bottleneck.
const LEAST_RATE: f64 = 1_000_000.0;
/// Most seconds of the full rate that one picture may take: a keyframe then crosses a link of just that rate in half of the time
/// that viewers wait for media (500 ms, `protocol::track`), with the other half left for the network.
const LARGEST_PICTURE_S: f64 = 0.25;
/// No picture that x264 makes is larger than its rate buffer; x265 takes its own for a guide. With this share of the room it keeps to noise over half
/// of the range, even after a still picture; noise over all of it was measured up to 28 % above.
const X265_BUFFER: f64 = 0.4;

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

    /// Most bits a second, and most bits of one picture.
    fn limits(&self) -> (u64, u64) {
        let pixels_a_second = f64::from(self.width) * f64::from(self.height) * self.frame_rate.clamp(1.0, 240.0);
        let rate = (pixels_a_second * MAX_BITS_PER_PIXEL).max(LEAST_RATE);
        (rate as u64, (rate * LARGEST_PICTURE_S) as u64)
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
    let (rate, picture) = encoding.limits();
    let buffer = if encoding.codec() == VideoCodec::Hevc { (picture as f64 * X265_BUFFER) as u64 } else { picture };
    options.set("maxrate", &rate.to_string());
    options.set("bufsize", &buffer.to_string());
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise that no encoder can predict, the same each time.
    fn noise(encoding: &Encoding, random: &mut u64) -> frame::Video {
        let mut picture = frame::Video::new(encoding.pixel, encoding.width, encoding.height);
        // Ten bits in two bytes, in the middle half of their range: the upper byte is 1 or 2.
        let ten_bits = encoding.pixel == Pixel::YUV420P10LE;
        for plane in 0..3 {
            for (index, sample) in picture.data_mut(plane).iter_mut().enumerate() {
                *random ^= *random << 13;
                *random ^= *random >> 7;
                *random ^= *random << 17;
                *sample = if ten_bits && index % 2 == 1 { 1 + ((*random >> 32) as u8 & 1) } else { (*random >> 32) as u8 };
            }
        }
        picture
    }

    fn grey(encoding: &Encoding) -> frame::Video {
        let mut picture = frame::Video::new(encoding.pixel, encoding.width, encoding.height);
        for plane in 0..3 {
            // 128 in eight bits, and 2 · 256 + 2 in ten.
            picture.data_mut(plane).fill(if encoding.pixel == Pixel::YUV420P10LE { 2 } else { 128 });
        }
        picture
    }

    #[test]
    fn even_noise_keeps_to_the_rate_and_every_picture_to_its_share() {
        super::super::run::init().unwrap();
        let sdr = Encoding { width: 2048, height: 1024, pixel: Pixel::YUV420P, colour: Colour::default(), frame_rate: 30.0 };
        let pq = Colour { transfer: Transfer::Pq, bit_depth: 10, ..Colour::default() };
        let hdr = Encoding { width: 640, height: 320, pixel: Pixel::YUV420P10LE, colour: pq, ..sdr };
        assert_eq!((sdr.limits(), hdr.limits()), ((9_437_184, 2_359_296), (1_000_000, 250_000)));
        // Noise from the start, and noise at the second keyframe after a still second.
        for (encoding, still) in [(sdr, 0), (sdr, 30), (hdr, 0), (hdr, 30)] {
            let mut encoder = VideoEncoder::new(&encoding).unwrap();
            let mut coded = Vec::new();
            let mut random = 1;
            for index in 0..36 {
                let mut picture = if index < still { grey(&encoding) } else { noise(&encoding, &mut random) };
                picture.set_pts(Some(index * 33_333));
                coded.extend(encoder.encode(&mut picture).unwrap());
            }
            coded.extend(encoder.finish().unwrap());
            assert_eq!((coded.len(), coded.iter().filter(|unit| unit.keyframe).count()), (36, 2));
            let (rate, largest) = encoding.limits();
            let bits: Vec<u64> = coded.iter().map(|unit| unit.data.len() as u64 * 8).collect();
            let codec = encoding.codec();
            assert!(bits.iter().all(|&bits| bits <= largest), "{codec:?}: {bits:?} with {largest} at most");
            // What the buffer may hold comes on top of the rate.
            assert!(bits.iter().sum::<u64>() <= rate * 36 / 30 + largest, "{codec:?}: {bits:?}");
        }
    }
}
