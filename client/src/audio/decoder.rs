//! Decodes packets and brings them to the device's rate and layout.

use bytes::Bytes;
use ffmpeg_next as ffmpeg;
use ffmpeg_next::ChannelLayout;
use ffmpeg_next::codec::{Context, Id};
use ffmpeg_next::format::sample::{Sample, Type};
use ffmpeg_next::software::resampling;

use super::{AudioCodec, AudioFormat};

/// Largest header of a codec, bytes.
const MAX_DESCRIPTION_BYTES: usize = 64 * 1024;
/// Largest packet, bytes: Opus packets stay below 62 kB, AAC's below 7 kB.
const MAX_PACKET_BYTES: usize = 64 * 1024;
/// Highest sample rate, Hz.
const MAX_RATE: u32 = 192_000;
/// Most channels.
const MAX_CHANNELS: u32 = 8;
/// Packed 32-bit floats.
const FLOAT: Sample = Sample::F32(Type::Packed);

/// Why audio cannot be decoded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AudioError {
    /// A value of the catalog is out of range.
    #[error("audio {field} of {value} refused, {range} expected; the source's audio is broken or not supported")]
    OutOfRange {
        /// Which value.
        field: &'static str,
        /// What it was.
        value: u64,
        /// What is allowed.
        range: &'static str,
    },
    /// FFmpeg was built without a decoder.
    #[error("{codec:?} audio cannot be decoded: this FFmpeg has no decoder for it; install one that has")]
    NoDecoder {
        /// The codec.
        codec: AudioCodec,
    },
    /// FFmpeg failed.
    #[error("{codec:?} decoder cannot be opened ({fault}); the catalog's description of the audio may be broken")]
    Ffmpeg {
        /// The codec.
        codec: AudioCodec,
        /// FFmpeg's error.
        fault: ffmpeg::Error,
    },
}

/// A decoder and a resampler.
pub(super) struct AudioDecoder {
    decoder: ffmpeg::decoder::Audio,
    resampler: Option<(resampling::Context, Input)>,
    rate: u32,
    layout: ChannelLayout,
    errors: u64,
}

/// What the resampler was made for.
#[derive(PartialEq, Clone, Copy)]
struct Input {
    format: Sample,
    channels: i32,
    rate: u32,
}

/// Refuses what is out of range before anything is allocated for it.
pub(super) fn check(format: &AudioFormat) -> Result<(), AudioError> {
    let check = |ok, field, value, range| if ok { Ok(()) } else { Err(AudioError::OutOfRange { field, value, range }) };
    check((1..=MAX_RATE).contains(&format.sample_rate), "sample rate", u64::from(format.sample_rate), "1 to 192000 Hz")?;
    check((1..=MAX_CHANNELS).contains(&format.channels), "channels", u64::from(format.channels), "1 to 8")?;
    let description = format.description.as_ref().map_or(0, Bytes::len);
    check(description <= MAX_DESCRIPTION_BYTES, "description", description as u64, "at most 65536 bytes")
}

impl AudioDecoder {
    /// `rate` in Hz and `channels` (1 or 2) are the device's.
    pub(super) fn open(format: &AudioFormat, rate: u32, channels: usize) -> Result<Self, AudioError> {
        check(format)?;
        let codec = format.codec;
        let id = match codec {
            AudioCodec::Aac => Id::AAC,
            AudioCodec::Opus => Id::OPUS,
        };
        let found = ffmpeg::decoder::find(id).ok_or(AudioError::NoDecoder { codec })?;
        let mut context = Context::new_with_codec(found);
        describe(&mut context, format).map_err(|fault| AudioError::Ffmpeg { codec, fault })?;
        let mut decoder = context.decoder();
        decoder.set_packet_time_base((1, 1_000_000));
        let decoder = decoder.open_as(found).and_then(|opened| opened.audio()).map_err(|fault| AudioError::Ffmpeg { codec, fault })?;
        let layout = if channels == 1 { ChannelLayout::MONO } else { ChannelLayout::STEREO };
        Ok(Self { decoder, resampler: None, rate, layout, errors: 0 })
    }

    pub(super) fn errors(&self) -> u64 {
        self.errors
    }

    /// Hands (pts, interleaved samples) to `sink`. Errors are counted; sound goes on with the next packet.
    pub(super) fn decode(&mut self, pts_us: u64, packet: &Bytes, mut sink: impl FnMut(u64, &[f32])) {
        if let Err(error) = self.try_decode(pts_us, packet, &mut sink) {
            self.errors += 1;
            if self.errors == 1 {
                tracing::warn!("audio packet cannot be decoded ({error}); it becomes silence, further ones are only counted");
            }
        }
    }

    fn try_decode(&mut self, pts_us: u64, packet: &Bytes, sink: &mut impl FnMut(u64, &[f32])) -> Result<(), ffmpeg::Error> {
        let pts = i64::try_from(pts_us).map_err(|_| ffmpeg::Error::InvalidData)?;
        if packet.is_empty() || packet.len() > MAX_PACKET_BYTES {
            return Err(ffmpeg::Error::InvalidData);
        }
        let mut coded = ffmpeg::Packet::copy(packet);
        coded.set_pts(Some(pts));
        self.decoder.send_packet(&coded)?;
        loop {
            let mut frame = ffmpeg::frame::Audio::empty();
            match self.decoder.receive_frame(&mut frame) {
                Ok(()) => self.resample(&mut frame, pts_us, sink)?,
                Err(ffmpeg::Error::Other { errno }) if errno == ffmpeg::error::EAGAIN => return Ok(()),
                Err(error) => return Err(error),
            }
        }
    }

    fn resample(&mut self, frame: &mut ffmpeg::frame::Audio, pts_us: u64, sink: &mut impl FnMut(u64, &[f32])) -> Result<(), ffmpeg::Error> {
        if frame.channel_layout().is_empty() {
            frame.set_channel_layout(ChannelLayout::default(i32::from(frame.channels())));
        }
        let input = Input { format: frame.format(), channels: i32::from(frame.channels()), rate: frame.rate() };
        if input.rate == 0 || input.rate > MAX_RATE {
            return Err(ffmpeg::Error::InvalidData);
        }
        if self.resampler.as_ref().is_none_or(|(_, made_for)| *made_for != input) {
            let context = resampling::Context::get(frame.format(), frame.channel_layout(), input.rate, FLOAT, self.layout, self.rate)?;
            self.resampler = Some((context, input));
        }
        let Some((resampler, _)) = self.resampler.as_mut() else { return Ok(()) };
        // What the resampler still holds comes out first: the samples belong that much earlier.
        let held_us = resampler.delay().map_or(0, |delay| delay.output.max(0) as u64 * 1_000_000 / u64::from(self.rate));
        let capacity = frame.samples() as u64 * u64::from(self.rate) / u64::from(input.rate) + 256;
        let mut converted = ffmpeg::frame::Audio::new(FLOAT, capacity as usize, self.layout);
        resampler.run(frame, &mut converted)?;
        let start = frame.pts().and_then(|pts| u64::try_from(pts).ok()).unwrap_or(pts_us);
        let bytes = converted.samples() * self.layout.channels().max(0) as usize * size_of::<f32>();
        let data = converted.data(0).get(..bytes).ok_or(ffmpeg::Error::InvalidData)?;
        let samples: Vec<f32> = data.as_chunks::<4>().0.iter().map(|bytes| f32::from_ne_bytes(*bytes)).collect();
        sink(start.saturating_sub(held_us), &samples);
        Ok(())
    }
}

/// Writes rate, channels and the codec's header into a context.
#[expect(unsafe_code, reason = "ffmpeg-next has no safe way to describe audio that did not come from a container")]
fn describe(context: &mut Context, format: &AudioFormat) -> Result<(), ffmpeg::Error> {
    use ffmpeg::ffi;
    // SAFETY: the context is valid and not open. The header is copied into memory of FFmpeg's own allocator, padded with zeros as
    // FFmpeg asks; the context owns and frees it. Rate and channels are within i32 by `check`.
    unsafe {
        let inner = &mut *context.as_mut_ptr();
        inner.sample_rate = format.sample_rate as i32;
        ffi::av_channel_layout_default(&mut inner.ch_layout, format.channels as i32);
        if let Some(description) = format.description.as_ref().filter(|description| !description.is_empty()) {
            let memory = ffi::av_mallocz(description.len() + ffi::AV_INPUT_BUFFER_PADDING_SIZE as usize).cast::<u8>();
            if memory.is_null() {
                return Err(ffmpeg::Error::Other { errno: ffmpeg::error::ENOMEM });
            }
            std::ptr::copy_nonoverlapping(description.as_ptr(), memory, description.len());
            inner.extradata = memory;
            inner.extradata_size = description.len() as i32;
        }
    }
    Ok(())
}
