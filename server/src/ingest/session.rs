//! One opening of a source: from its packets to access units, sound, and work for the picture thread.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ffmpeg_next::codec::Parameters;
use ffmpeg_next::{Error, Packet};

use super::audio::AudioPath;
use super::bitstream::AccessUnits;
use super::colour::{Tags, nearest_supported};
use super::encode::Coded;
use super::error::IngestError;
use super::gop::{self, GopWatch, Unsuited, Verdict};
use super::layout::{self, Projection};
use super::open::Opened;
use super::pictures::{self, Job, Pictures, Stream};
use super::raw::{self, VideoParameters};
use super::shared::{Shared, count};
use super::timeline::{Lane, Timeline, micros, shown};
use super::{IngestConfig, Source, VideoInfo};

/// Refused reads in a row after which a source counts as lost.
pub(super) const MAX_BAD_READS: u32 = 100;
/// A file that lags behind real time by more than this is paced from there on.
const PACE_SLIP: Duration = Duration::from_millis(500);

/// How a session ended without an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    /// The file or stream is over.
    Over,
    /// Ingest was asked to stop.
    Stopped,
}

/// What came of one opening.
pub(super) struct Outcome {
    pub(super) end: Result<End, IngestError>,
    pub(super) video_packets: u64,
    /// The video's, where it was opened at all.
    pub(super) parameters: Option<Parameters>,
    /// Whether its packets suited live playback.
    pub(super) verdict: Verdict,
}

/// One opening of a source.
pub(super) struct Session<'a> {
    shared: &'a Arc<Shared>,
    timeline: &'a mut Timeline,
    opened: Opened,
    stream: Stream,
    pictures: Pictures,
    /// Present while packets pass through.
    units: Option<AccessUnits>,
    gop: GopWatch,
    silence: Duration,
    audio: Option<AudioPath>,
    pacer: Option<Pacer>,
    /// No packet is handed on before a keyframe.
    awaits_keyframe: bool,
    /// No packet is decoded before a keyframe, as the decoder was too slow.
    decoder_lags: bool,
    format: Option<(u32, u32, i32)>,
    last_dts_us: Option<i64>,
    video_packets: u64,
}

/// Layout and decoding needs of an opened source, checked.
pub(super) fn describe(config: &IngestConfig, name: &str, opened: &Opened) -> Result<Stream, IngestError> {
    let video = raw::video_parameters(&opened.video.parameters);
    let flags = config.layout_flags();
    let layout = layout::decide(name, flags, &opened.video.spherical, &video)?;
    Ok(Stream {
        parameters: opened.video.parameters.clone(),
        spherical: opened.video.spherical.clone(),
        flags,
        layout,
        frame_rate: opened.video.frame_rate,
        max_width: config.max_width,
    })
}

impl<'a> Session<'a> {
    /// Announces the formats and starts the picture thread. `known` is what a look into the file, or an earlier opening, has shown.
    pub(super) fn start(
        shared: &'a Arc<Shared>,
        timeline: &'a mut Timeline,
        config: &IngestConfig,
        opened: Opened,
        stream: Stream,
        known: Option<Unsuited>,
    ) -> Result<Self, IngestError> {
        let video = raw::video_parameters(&stream.parameters);
        let (audio, audio_info) = open_audio(&shared.name, &opened);
        let because = transcode_reason(&stream, &video, &opened, known);
        let pictures = Pictures::start(shared, stream.clone())?;
        let mut session = Self {
            shared,
            timeline,
            pictures,
            units: None,
            gop: GopWatch::default(),
            silence: config.silence,
            audio,
            pacer: is_paced(&config.source).then(Pacer::default),
            awaits_keyframe: true,
            decoder_lags: false,
            format: None,
            last_dts_us: None,
            video_packets: 0,
            stream,
            opened,
        };
        match because {
            Some(reason) => session.transcode(reason, audio_info)?,
            None => {
                let codec = gop::broadcast_codec(session.stream.parameters.id());
                let units = codec.map(|codec| AccessUnits::new(codec, &session.stream.parameters)).transpose();
                let units = units.map_err(|error| IngestError::NotAVideo { input: shared.name.clone(), detail: error.to_string() })?;
                session.units = units;
                tracing::info!(input = shared.name, ?codec, width = video.width, height = video.height, "video passes through");
                if let Some(info) = passthrough_info(&session.stream, &video) {
                    shared.announce(info, audio_info);
                }
            }
        }
        Ok(session)
    }

    /// Reads until the source ends.
    pub(super) fn run(mut self, looped: bool) -> Outcome {
        let end = loop {
            let before = self.video_packets;
            match self.read_through() {
                Ok(End::Over) if looped && self.video_packets > before => {
                    if let Err(error) = self.rewind() {
                        break Err(error);
                    }
                }
                Ok(End::Over) if looped => {
                    let detail = "no video packet could be read".to_owned();
                    break Err(IngestError::NotAVideo { input: self.shared.name.clone(), detail });
                }
                other => break other,
            }
        };
        self.pictures.finish();
        Outcome {
            end: self.shared.take_failure().map_or(end, Err),
            video_packets: self.video_packets,
            parameters: Some(self.stream.parameters),
            verdict: self.gop.verdict(),
        }
    }

    fn read_through(&mut self) -> Result<End, IngestError> {
        let mut bad = 0;
        let mut silent = false;
        loop {
            if self.shared.watch.stopped() {
                return Ok(End::Stopped);
            }
            if !silent {
                self.shared.watch.allow(self.silence);
            }
            let mut packet = Packet::empty();
            match packet.read(&mut self.opened.input) {
                Ok(()) => (bad, silent) = (0, false),
                Err(_) if self.shared.watch.stopped() => return Ok(End::Stopped),
                Err(_) if self.shared.watch.timed_out() => return Err(self.lost(&format!("no data for {:?}", self.silence))),
                Err(Error::Eof) => return Ok(End::Over),
                Err(Error::Other { errno }) if errno == ffmpeg_next::error::EAGAIN && !self.shared.watch.interrupts() => {
                    silent = true;
                    self.shared.watch.sleep_until(Instant::now() + Duration::from_millis(5));
                    continue;
                }
                Err(Error::InvalidData) if bad < MAX_BAD_READS => {
                    (bad, silent) = (bad + 1, false);
                    count(&self.shared.counters.corrupt_packets);
                    continue;
                }
                Err(error) => return Err(self.lost(&error.to_string())),
            }
            if !self.packet(packet)? {
                return Ok(End::Stopped);
            }
        }
    }

    fn lost(&self, detail: &str) -> IngestError {
        IngestError::Lost { input: self.shared.name.clone(), detail: detail.to_owned() }
    }

    /// Back to the start of the file; timestamps go on.
    fn rewind(&mut self) -> Result<(), IngestError> {
        self.opened.input.seek(i64::MIN, ..).map_err(|error| self.lost(&format!("cannot start again: {error}")))?;
        self.timeline.repeat();
        self.gop.restart();
        self.last_dts_us = None;
        self.awaits_keyframe = true;
        self.pictures.push(Job::Seek);
        Ok(())
    }

    /// False when stopped.
    fn packet(&mut self, packet: Packet) -> Result<bool, IngestError> {
        if packet.is_corrupt() {
            count(&self.shared.counters.corrupt_packets);
        }
        if packet.stream() == self.opened.video.index {
            self.video_packets += 1;
            return self.video(packet);
        }
        if self.opened.audio.as_ref().is_some_and(|audio| audio.index == packet.stream()) {
            return Ok(self.sound(packet));
        }
        Ok(true)
    }

    fn video(&mut self, mut packet: Packet) -> Result<bool, IngestError> {
        let step_us = self.step_us();
        let time_base = self.opened.video.time_base;
        let dts_us = packet.dts().or(packet.pts()).map(|dts| micros(dts, time_base));
        let dts_us = dts_us.unwrap_or_else(|| self.last_dts_us.map_or(0, |last| last + step_us));
        self.last_dts_us = Some(dts_us);
        let offset = self.offset(Lane::Video, dts_us, step_us);
        let pts_us = mended(self.shared, packet.pts().map(|pts| micros(pts, time_base)), dts_us, step_us) + offset;
        if !self.pace(dts_us + offset) {
            return Ok(false);
        }
        if self.awaits_keyframe && !packet.is_key() {
            return Ok(true);
        }
        self.awaits_keyframe = false;
        packet.set_pts(Some(pts_us));
        packet.set_dts(Some(dts_us + offset));
        let unsuited = self.gop.observe(packet.is_key(), pts_us);
        if self.units.is_some() {
            match unsuited {
                None => return self.pass_through(packet, pts_us).map(|()| true),
                Some(unsuited) => {
                    let audio = self.audio.as_ref().map(|audio| audio.info.clone());
                    self.transcode(unsuited.to_string(), audio)?;
                }
            }
        }
        Ok(self.pictures.push(Job::Packet(packet, self.shared.clock.now())))
    }

    fn pass_through(&mut self, mut packet: Packet, pts_us: i64) -> Result<(), IngestError> {
        let ingested = self.shared.clock.now();
        let keyframe = packet.is_key();
        let mut for_decoder = packet.clone();
        let Some(units) = &mut self.units else { return Ok(()) };
        let unit = match units.convert(&mut packet) {
            Ok(Some(unit)) => unit,
            Ok(None) => return Ok(()),
            Err(error) => {
                count(&self.shared.counters.corrupt_packets);
                tracing::debug!(input = self.shared.name, %error, "an access unit could not be read");
                return Ok(());
            }
        };
        if let Some(format) = unit.format
            && let Some(reason) = self.check_format(format)?
        {
            let audio = self.audio.as_ref().map(|audio| audio.info.clone());
            self.transcode(reason, audio)?;
            self.pictures.push(Job::Packet(for_decoder, ingested));
            return Ok(());
        }
        let stamp = i64::try_from(self.shared.rise_video(pts_us)).unwrap_or(i64::MAX);
        for_decoder.set_pts(Some(stamp));
        for_decoder.set_dts(Some(stamp));
        self.shared.send_coded(Coded { pts_us: stamp, keyframe, data: unit.data }, ingested);
        self.decode(for_decoder, keyframe, ingested)
    }

    /// Hands a packet on for light; where the decoder lags, none until the next keyframe.
    fn decode(&mut self, packet: Packet, keyframe: bool, ingested: mr360_protocol::clock::ServerTime) -> Result<(), IngestError> {
        if self.decoder_lags && !keyframe {
            count(&self.shared.counters.frames_without_light);
            return Ok(());
        }
        self.decoder_lags = !self.pictures.try_push(Job::Packet(packet, ingested));
        if self.decoder_lags {
            count(&self.shared.counters.frames_without_light);
            if let Some(error) = self.shared.take_failure() {
                return Err(error);
            }
        }
        Ok(())
    }

    /// Announces the formats anew where a keyframe's headers differ from what was announced, or tells why it cannot pass any more.
    fn check_format(&mut self, format: (u32, u32, i32)) -> Result<Option<String>, IngestError> {
        let announced = self.shared.announced().map(|(video, _)| (video.width, video.height));
        let changed = self.format.replace(format).is_some_and(|known| known != format);
        if !changed && announced == Some((format.0, format.1)) {
            return Ok(None);
        }
        let video = VideoParameters { width: format.0, height: format.1, ..raw::video_parameters(&self.stream.parameters) };
        self.stream.layout = layout::decide(&self.shared.name, self.stream.flags, &self.stream.spherical, &video)?;
        if let Some(reason) = too_wide(&self.stream, video.width) {
            return Ok(Some(reason));
        }
        if let Some(info) = passthrough_info(&self.stream, &video) {
            self.shared.announce(info, self.audio.as_ref().map(|audio| audio.info.clone()));
        }
        Ok(None)
    }

    /// From the next packet on the video is transcoded.
    fn transcode(&mut self, reason: String, audio: Option<super::AudioInfo>) -> Result<(), IngestError> {
        tracing::warn!(input = self.shared.name, reason, "video is transcoded");
        self.units = None;
        let video = raw::video_parameters(&self.stream.parameters);
        let size = self.format.map_or((video.width, video.height), |(width, height, _)| (width, height));
        let encoding = pictures::encoding(&self.stream, &Tags::of_stream(&video), size);
        encoding.check(&self.shared.name)?;
        self.shared.announce(pictures::video_info(&encoding, self.stream.layout, Some(reason.clone())), audio);
        self.pictures.push(Job::Encode(reason));
        Ok(())
    }

    /// False when stopped. Sound that cannot be read is left out.
    fn sound(&mut self, mut packet: Packet) -> bool {
        let (Some(path), Some(stream)) = (&mut self.audio, &self.opened.audio) else { return true };
        let Some(dts) = packet.dts().or(packet.pts()) else { return true };
        let dts_us = micros(dts, stream.time_base);
        let step_us = micros(packet.duration(), stream.time_base);
        let offset = self.timeline.offset(Lane::Audio, dts_us, step_us, i64::try_from(self.shared.clock.now().0).unwrap_or(i64::MAX));
        // Sound is never reordered, however long its packets claim to be.
        let pts_us = mended(self.shared, packet.pts().map(|pts| micros(pts, stream.time_base)), dts_us, 0) + offset;
        packet.set_pts(Some(pts_us));
        packet.set_dts(Some(dts_us + offset));
        match path.convert(&packet, pts_us) {
            Ok(sounds) => {
                for sound in sounds {
                    self.shared.send_sound(sound.pts_us, sound.data);
                }
            }
            Err(error) => {
                count(&self.shared.counters.corrupt_packets);
                tracing::debug!(input = self.shared.name, %error, "a sound packet could not be read");
            }
        }
        self.pace(dts_us + offset)
    }

    fn offset(&mut self, lane: Lane, dts_us: i64, step_us: i64) -> i64 {
        let now_us = i64::try_from(self.shared.clock.now().0).unwrap_or(i64::MAX);
        let offset = self.timeline.offset(lane, dts_us, step_us, now_us);
        for _ in 0..self.timeline.take_jumps() {
            count(&self.shared.counters.timestamp_jumps);
            tracing::warn!(input = self.shared.name, "the source's timestamps jumped and were mended");
        }
        offset
    }

    fn pace(&mut self, due_us: i64) -> bool {
        match &mut self.pacer {
            Some(pacer) => !self.shared.watch.sleep_until(pacer.due(due_us, Instant::now())),
            None => true,
        }
    }

    fn step_us(&self) -> i64 {
        (1_000_000.0 / self.stream.frame_rate) as i64
    }
}

/// When a packet is shown, in the source's time; a stray timestamp is mended and counted.
fn mended(shared: &Shared, pts_us: Option<i64>, dts_us: i64, step_us: i64) -> i64 {
    let (shown_us, stray) = shown(pts_us, dts_us, step_us);
    if stray {
        count(&shared.counters.timestamp_jumps);
        // No warning: a source that is wrong once is often wrong with every packet.
        tracing::debug!(input = shared.name, ?pts_us, dts_us, "a stray presentation time was mended");
    }
    shown_us
}

/// Files and HTTP come as fast as they can be read; everything else comes at its own pace.
fn is_paced(source: &Source) -> bool {
    match source {
        Source::File(_) => true,
        Source::Url(address) => address.scheme.starts_with("http"),
        Source::Synthetic(_) => false,
    }
}

fn open_audio(name: &str, opened: &Opened) -> (Option<AudioPath>, Option<super::AudioInfo>) {
    let audio = opened.audio.as_ref().and_then(|audio| {
        AudioPath::new(&audio.parameters)
            .inspect_err(|reason| tracing::warn!(input = name, reason, "the sound is left out; send AAC or Opus"))
            .ok()
    });
    let info = audio.as_ref().map(|audio| audio.info.clone());
    (audio, info)
}

fn transcode_reason(stream: &Stream, video: &VideoParameters, opened: &Opened, known: Option<Unsuited>) -> Option<String> {
    if stream.layout.projection != Projection::Equirect {
        return Some(format!("its projection is {:?}", stream.layout.projection));
    }
    too_wide(stream, video.width).or_else(|| gop::unsuited(&opened.video)).or_else(|| known.map(|unsuited| unsuited.to_string()))
}

fn too_wide(stream: &Stream, width: u32) -> Option<String> {
    let limit = stream.max_width.filter(|&limit| width > limit)?;
    Some(format!("it is {width} pixels wide, at most {limit} are wanted"))
}

fn passthrough_info(stream: &Stream, video: &VideoParameters) -> Option<VideoInfo> {
    let tags = Tags::of_stream(video);
    Some(VideoInfo {
        codec: gop::broadcast_codec(stream.parameters.id())?,
        width: video.width,
        height: video.height,
        frame_rate: stream.frame_rate,
        stereo: stream.layout.stereo,
        colour: tags.colour(nearest_supported(video.pixel)),
        transcoded_because: None,
    })
}

/// Paces packets to real time by their timestamps.
#[derive(Default)]
struct Pacer {
    anchor: Option<(Instant, i64)>,
}

impl Pacer {
    /// When a packet of this timestamp is due.
    fn due(&mut self, pts_us: i64, now: Instant) -> Instant {
        let (start, first_us) = *self.anchor.get_or_insert((now, pts_us));
        let due = start + Duration::from_micros(u64::try_from(pts_us - first_us).unwrap_or(0));
        if now.saturating_duration_since(due) > PACE_SLIP {
            self.anchor = Some((now, pts_us));
            return now;
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_follows_timestamps_and_forgives_a_stall() {
        let mut pacer = Pacer::default();
        let start = Instant::now();
        let after = |ms| start + Duration::from_millis(ms);
        assert_eq!(pacer.due(1_000_000, start), start);
        assert_eq!(pacer.due(1_040_000, after(3)), after(40));
        assert_eq!(pacer.due(900_000, after(3)), start);
        assert_eq!(pacer.due(1_080_000, after(10_000)), after(10_000));
        assert_eq!(pacer.due(1_120_000, after(10_001)), after(10_040));
    }
}
