//! Sound beside the video: AAC and Opus as they come, everything else as Opus.

use bytes::Bytes;
use ffmpeg_next::codec::{Context, Id, Parameters};
use ffmpeg_next::filter::{self, Graph};
use ffmpeg_next::{ChannelLayout, Dictionary, Error, Packet, Rational, decoder, encoder, format, frame};

use super::raw;
use super::{AudioCodec, AudioInfo};

/// Opus always runs at this rate here.
const OPUS_RATE: u32 = 48_000;
/// Samples of a 20 ms Opus frame.
const OPUS_FRAME: u32 = 960;
/// FFmpeg's profile numbers: MPEG-4 audio object type minus one.
const HE_AAC: [i32; 2] = [4, 28];
/// Sampling frequencies by their index (ISO/IEC 14496-3, table 1.18).
const AAC_RATES: [u32; 13] = [96_000, 88_200, 64_000, 48_000, 44_100, 32_000, 24_000, 22_050, 16_000, 12_000, 11_025, 8_000, 7_350];

/// A packet ready to broadcast; the timestamp is in the same microseconds as the input's.
pub(super) struct Sound {
    pub(super) pts_us: i64,
    pub(super) data: Bytes,
}

/// The way of one audio stream to the broadcast.
pub(super) struct AudioPath {
    pub(super) info: AudioInfo,
    way: Way,
}

enum Way {
    AsItIs,
    StripAdts,
    Transcode(Box<Transcoder>),
}

impl AudioPath {
    /// Decides how the stream is broadcast.
    ///
    /// # Errors
    /// The reason why it cannot be, as text for the log.
    pub(super) fn new(parameters: &Parameters) -> Result<Self, String> {
        let audio = raw::audio_parameters(parameters);
        let headers = raw::extradata(parameters);
        if audio.sample_rate == 0 || audio.channels == 0 {
            return Err("its format could not be read".to_owned());
        }
        let info = |codec, description| AudioInfo { codec, sample_rate: audio.sample_rate, channels: audio.channels, description };
        match parameters.id() {
            Id::AAC if !headers.is_empty() => Ok(Self { info: info(AudioCodec::Aac, Bytes::copy_from_slice(headers)), way: Way::AsItIs }),
            Id::AAC => {
                let description = audio_specific_config(audio.profile, audio.sample_rate, audio.channels)
                    .ok_or_else(|| format!("AAC with {} channels at {} Hz has no short description", audio.channels, audio.sample_rate))?;
                Ok(Self { info: info(AudioCodec::Aac, description), way: Way::StripAdts })
            }
            Id::OPUS => {
                let description = if headers.starts_with(b"OpusHead") {
                    Bytes::copy_from_slice(headers)
                } else {
                    opus_head(audio.channels, 0, audio.sample_rate)
                };
                Ok(Self { info: info(AudioCodec::Opus, description), way: Way::AsItIs })
            }
            other => {
                let transcoder = Transcoder::new(parameters).map_err(|error| format!("{other:?} cannot be made Opus: {error}"))?;
                tracing::info!(codec = ?other, "audio is transcoded to Opus, which viewers decode");
                let (channels, description) = (transcoder.channels, transcoder.head.clone());
                let info = AudioInfo { codec: AudioCodec::Opus, sample_rate: OPUS_RATE, channels, description };
                Ok(Self { info, way: Way::Transcode(Box::new(transcoder)) })
            }
        }
    }

    /// Takes a packet whose timestamps are in microseconds.
    pub(super) fn convert(&mut self, packet: &Packet, pts_us: i64) -> Result<Vec<Sound>, Error> {
        let Some(data) = packet.data().filter(|data| !data.is_empty()) else { return Ok(Vec::new()) };
        match &mut self.way {
            Way::AsItIs => Ok(vec![Sound { pts_us, data: Bytes::copy_from_slice(data) }]),
            Way::StripAdts => {
                let data = strip_adts(data).ok_or(Error::InvalidData)?;
                Ok(vec![Sound { pts_us, data: Bytes::copy_from_slice(data) }])
            }
            Way::Transcode(transcoder) => transcoder.convert(packet),
        }
    }
}

/// AudioSpecificConfig of what ADTS can carry: AAC-LC core, with SBR signalled implicitly (ISO/IEC 14496-3, 1.6.2.1).
fn audio_specific_config(profile: i32, sample_rate: u32, channels: u32) -> Option<Bytes> {
    let core_rate = if HE_AAC.contains(&profile) { sample_rate / 2 } else { sample_rate };
    let rate = u16::try_from(AAC_RATES.iter().position(|&known| known == core_rate)?).ok()?;
    let channels = match channels {
        1..=6 => u16::try_from(channels).ok()?,
        8 => 7,
        _ => return None,
    };
    let object_type: u16 = if (0..4).contains(&profile) { u16::try_from(profile).ok()? + 1 } else { 2 };
    Some(Bytes::copy_from_slice(&(object_type << 11 | rate << 7 | channels << 3).to_be_bytes()))
}

/// The raw frame behind an ADTS header, or the packet itself where there is none.
fn strip_adts(data: &[u8]) -> Option<&[u8]> {
    match data {
        [0xff, second, ..] if second & 0xf6 == 0xf0 => data.get(if second & 1 == 0 { 9 } else { 7 }..).filter(|frame| !frame.is_empty()),
        _ => Some(data),
    }
}

/// Identification header (RFC 7845, 5.1), channel mapping family 0.
fn opus_head(channels: u32, pre_skip: u16, input_rate: u32) -> Bytes {
    let mut head = b"OpusHead\x01".to_vec();
    head.push(u8::try_from(channels.min(2)).unwrap_or(2));
    head.extend_from_slice(&pre_skip.to_le_bytes());
    head.extend_from_slice(&input_rate.to_le_bytes());
    head.extend_from_slice(&[0, 0, 0]);
    head.into()
}

/// Any codec that FFmpeg decodes, to Opus in mono or stereo.
struct Transcoder {
    decoder: decoder::Audio,
    resampler: Option<(Heard, Graph)>,
    encoder: encoder::audio::Encoder,
    channels: u32,
    head: Bytes,
    /// Timestamp of the next sample that goes into the encoder.
    next_us: Option<i64>,
}

/// Format of decoded sound.
#[derive(PartialEq, Clone)]
struct Heard {
    rate: u32,
    sample: format::Sample,
    layout: u64,
}

impl Transcoder {
    fn new(parameters: &Parameters) -> Result<Self, Error> {
        let decoder = Context::from_parameters(parameters.clone())?.decoder().audio()?;
        let layout = if raw::audio_parameters(parameters).channels == 1 { ChannelLayout::MONO } else { ChannelLayout::STEREO };
        let codec = encoder::find_by_name("libopus").ok_or(Error::EncoderNotFound)?;
        let mut audio = Context::new_with_codec(codec).encoder().audio()?;
        audio.set_rate(48_000);
        audio.set_format(format::Sample::F32(format::sample::Type::Packed));
        audio.set_channel_layout(layout);
        audio.set_channels(layout.channels());
        audio.set_bit_rate(64_000 * usize::try_from(layout.channels()).unwrap_or(2));
        audio.set_time_base(Rational(1, 1_000_000));
        let encoder = audio.open_as_with(codec, Dictionary::from_iter([("frame_duration", "20")]))?;
        let channels = u32::try_from(layout.channels()).unwrap_or(2);
        let made = raw::encoder_extradata(&encoder);
        let head = if made.starts_with(b"OpusHead") { Bytes::copy_from_slice(made) } else { opus_head(channels, 312, OPUS_RATE) };
        Ok(Self { decoder, resampler: None, encoder, channels, head, next_us: None })
    }

    fn convert(&mut self, packet: &Packet) -> Result<Vec<Sound>, Error> {
        self.decoder.send_packet(packet)?;
        let mut sounds = Vec::new();
        let mut heard = frame::Audio::empty();
        while self.decoder.receive_frame(&mut heard).is_ok() {
            self.resample(&mut heard)?;
            self.encode(&mut sounds)?;
        }
        Ok(sounds)
    }

    fn resample(&mut self, heard: &mut frame::Audio) -> Result<(), Error> {
        if heard.channel_layout().bits() == 0 {
            heard.set_channel_layout(ChannelLayout::default(i32::from(heard.channels())));
        }
        let format = Heard { rate: heard.rate(), sample: heard.format(), layout: heard.channel_layout().bits() };
        if !self.resampler.as_ref().is_some_and(|(known, _)| *known == format) {
            let graph = resampler(&format, self.channels)?;
            self.resampler = Some((format, graph));
        }
        // The encoder's clock runs on samples; it is set again where the source's differs by more than a frame.
        if let Some(pts) = heard.timestamp().or(heard.pts())
            && self.next_us.is_none_or(|next| (pts - next).abs() > 100_000)
        {
            self.next_us = Some(pts);
        }
        let (_, graph) = self.resampler.as_mut().ok_or(Error::Bug)?;
        graph.get("in").ok_or(Error::FilterNotFound)?.source().add(heard)
    }

    fn encode(&mut self, sounds: &mut Vec<Sound>) -> Result<(), Error> {
        let frame_us = i64::from(OPUS_FRAME) * 1_000_000 / i64::from(OPUS_RATE);
        loop {
            let mut samples = frame::Audio::empty();
            let (_, graph) = self.resampler.as_mut().ok_or(Error::Bug)?;
            if graph.get("out").ok_or(Error::FilterNotFound)?.sink().frame(&mut samples).is_err() {
                return Ok(());
            }
            let pts_us = self.next_us.unwrap_or(0);
            self.next_us = Some(pts_us + frame_us);
            samples.set_pts(Some(pts_us));
            self.encoder.send_frame(&samples)?;
            let mut packet = Packet::empty();
            while self.encoder.receive_packet(&mut packet).is_ok() {
                let (Some(pts), Some(data)) = (packet.pts(), packet.data()) else { continue };
                sounds.push(Sound { pts_us: pts, data: Bytes::copy_from_slice(data) });
            }
        }
    }
}

fn resampler(heard: &Heard, channels: u32) -> Result<Graph, Error> {
    let mut graph = Graph::new();
    let source = filter::find("abuffer").ok_or(Error::FilterNotFound)?;
    let sink = filter::find("abuffersink").ok_or(Error::FilterNotFound)?;
    let Heard { rate, sample, layout } = heard;
    let arguments = format!("time_base=1/1000000:sample_rate={rate}:sample_fmt={}:channel_layout=0x{layout:x}", sample.name());
    graph.add(&source, "in", &arguments)?;
    graph.add(&sink, "out", "")?;
    let layout = if channels == 1 { "mono" } else { "stereo" };
    let chain = format!("aresample={OPUS_RATE},aformat=sample_fmts=flt:channel_layouts={layout}");
    graph.output("in", 0)?.input("out", 0)?.parse(&chain)?;
    graph.validate()?;
    graph.get("out").ok_or(Error::FilterNotFound)?.sink().set_frame_size(OPUS_FRAME);
    Ok(graph)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptions_by_the_standards() {
        // AAC-LC, 48 kHz, stereo is the well-known 11 90.
        assert_eq!(audio_specific_config(1, 48_000, 2).unwrap()[..], [0x11, 0x90]);
        assert_eq!(audio_specific_config(1, 44_100, 2).unwrap()[..], [0x12, 0x10]);
        // HE-AAC at 48 kHz has a core of 24 kHz.
        assert_eq!(audio_specific_config(4, 48_000, 2).unwrap()[..], [0x13, 0x10]);
        assert!(audio_specific_config(1, 12_345, 2).is_none() && audio_specific_config(1, 48_000, 7).is_none());
        assert_eq!(opus_head(2, 312, 48_000)[..], *b"OpusHead\x01\x02\x38\x01\x80\xbb\x00\x00\x00\x00\x00");
    }

    #[test]
    fn adts_is_stripped_with_and_without_checksum() {
        assert_eq!(strip_adts(&[0xff, 0xf1, 0, 0, 0, 0, 0, 42]), Some(&[42][..]));
        assert_eq!(strip_adts(&[0xff, 0xf0, 0, 0, 0, 0, 0, 1, 1, 42]), Some(&[42][..]));
        assert_eq!(strip_adts(&[0x21, 0x10, 4]), Some(&[0x21, 0x10, 4][..]));
        assert_eq!(strip_adts(&[0xff, 0xf1, 0]), None);
    }
}
