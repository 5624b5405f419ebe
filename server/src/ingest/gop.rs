//! Whether coded video suits live playback as it is.

use std::fmt;

use ffmpeg_next::codec::Parameters;
use ffmpeg_next::{Packet, format};

use super::VideoCodec;
use super::open::VideoStream;
use super::raw;
use super::timeline::micros;

/// Longest distance of keyframes: a viewer who joins waits as long at most.
const MAX_GOP_US: i64 = 2_000_000;
/// Timestamps of containers are rounded, and frame rates are not exact.
const TOLERANCE_US: i64 = 60_000;
/// How far into a file is looked before it is played.
const LOOK_AHEAD_US: i64 = 12_000_000;
/// Bounds the look ahead in files whose timestamps stand still.
const LOOK_AHEAD_PACKETS: usize = 20_000;

/// Codecs that are broadcast as they come.
pub(super) fn broadcast_codec(id: ffmpeg_next::codec::Id) -> Option<VideoCodec> {
    match id {
        ffmpeg_next::codec::Id::H264 => Some(VideoCodec::H264),
        ffmpeg_next::codec::Id::HEVC => Some(VideoCodec::Hevc),
        ffmpeg_next::codec::Id::AV1 => Some(VideoCodec::Av1),
        _ => None,
    }
}

/// What is known before the first packet: codec and reordering.
pub(super) fn unsuited(stream: &VideoStream) -> Option<String> {
    let video = raw::video_parameters(&stream.parameters);
    if broadcast_codec(stream.parameters.id()).is_none() {
        return Some(format!("codec {:?} is not one that viewers decode", stream.parameters.id()));
    }
    (video.reorder > 0).then(|| format!("its frames are reordered over {} frames", video.reorder))
}

/// What packets show against live playback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unsuited {
    Reordered,
    RareKeyframes,
}

/// Ends the sentence "video is transcoded because …".
impl fmt::Display for Unsuited {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reordered => write!(out, "its frames are reordered"),
            Self::RareKeyframes => write!(out, "its keyframes are more than {} s apart", MAX_GOP_US / 1_000_000),
        }
    }
}

/// What is known of a source's packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Verdict {
    /// Too few of them were seen.
    #[default]
    Open,
    /// They suit live playback.
    Suited,
    /// They do not.
    Unsuited(Unsuited),
}

/// Watches packets in coded order.
#[derive(Debug, Default)]
pub(super) struct GopWatch {
    last_key_us: Option<i64>,
    last_pts_us: Option<i64>,
    verdict: Verdict,
}

impl GopWatch {
    /// What this packet shows against live playback, if it does.
    pub(super) fn observe(&mut self, keyframe: bool, pts_us: i64) -> Option<Unsuited> {
        let unsuited = self.judge(keyframe, pts_us);
        if let Some(unsuited) = unsuited {
            self.verdict = Verdict::Unsuited(unsuited);
        }
        unsuited
    }

    fn judge(&mut self, keyframe: bool, pts_us: i64) -> Option<Unsuited> {
        if self.last_pts_us.is_some_and(|last| pts_us < last) {
            return Some(Unsuited::Reordered);
        }
        self.last_pts_us = Some(pts_us);
        let since = pts_us - *self.last_key_us.get_or_insert(pts_us);
        if keyframe {
            // The first whole GOP that is short enough speaks for the source.
            if since > 0 && since <= MAX_GOP_US + TOLERANCE_US && self.verdict == Verdict::Open {
                self.verdict = Verdict::Suited;
            }
            self.last_key_us = Some(pts_us);
            return None;
        }
        (since > MAX_GOP_US + TOLERANCE_US).then_some(Unsuited::RareKeyframes)
    }

    /// What all packets so far have shown.
    pub(super) fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// Timestamps start anew; what was shown stays.
    pub(super) fn restart(&mut self) {
        *self = Self { verdict: self.verdict, ..Self::default() };
    }
}

/// Keeps a source's verdict while it comes and goes, so that a source that has to be transcoded is so from its first packet on.
#[derive(Default)]
pub(super) struct Memory(Option<(Fingerprint, Unsuited)>);

/// What a sender that is set up differently is told apart by.
#[derive(PartialEq)]
struct Fingerprint {
    codec: ffmpeg_next::codec::Id,
    size: (u32, u32),
    headers: Vec<u8>,
}

impl Fingerprint {
    fn of(parameters: &Parameters) -> Self {
        let video = raw::video_parameters(parameters);
        Self { codec: parameters.id(), size: (video.width, video.height), headers: raw::extradata(parameters).to_vec() }
    }
}

impl Memory {
    /// What stands against passing these packets through.
    pub(super) fn recall(&self, parameters: &Parameters) -> Option<Unsuited> {
        self.0.as_ref().filter(|(known, _)| *known == Fingerprint::of(parameters)).map(|&(_, unsuited)| unsuited)
    }

    /// Takes in what an opening has shown. One that was too short to show anything changes nothing; one whose packets suited
    /// clears the source, as its sender may have been set right without changing its headers.
    pub(super) fn learn(&mut self, parameters: &Parameters, verdict: Verdict) {
        match verdict {
            Verdict::Open => {}
            Verdict::Suited => self.0 = None,
            Verdict::Unsuited(unsuited) => self.0 = Some((Fingerprint::of(parameters), unsuited)),
        }
    }
}

/// Reads the beginning of a file for the reason why it does not suit live playback. Leaves `input` somewhere behind its start.
/// A file that is still being written, such as a live playlist, is not read: looking ahead would be waiting.
pub(super) fn look_ahead(input: &mut format::context::Input, stream: &VideoStream) -> Option<Unsuited> {
    if input.duration() <= 0 && input.format().name() == "hls" {
        return None;
    }
    let mut watch = GopWatch::default();
    let mut first = None;
    for _ in 0..LOOK_AHEAD_PACKETS {
        let mut packet = Packet::empty();
        if packet.read(input).is_err() {
            return None;
        }
        if packet.stream() != stream.index {
            continue;
        }
        let Some(pts) = packet.pts().or(packet.dts()) else { continue };
        let pts_us = micros(pts, stream.time_base);
        if let Some(unsuited) = watch.observe(packet.is_key(), pts_us) {
            return Some(unsuited);
        }
        if pts_us - *first.get_or_insert(pts_us) > LOOK_AHEAD_US {
            return None;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_seconds_pass_and_more_do_not() {
        let mut watch = GopWatch::default();
        for frame in 0..300 {
            assert_eq!(watch.observe(frame % 60 == 0, frame * 33_367), None, "{frame}");
        }
        let mut watch = GopWatch::default();
        let refused = (0..300).find(|&frame| watch.observe(frame % 75 == 0, frame * 33_333).is_some());
        assert_eq!(refused, Some(62));
    }

    #[test]
    fn reordering_is_seen() {
        let mut watch = GopWatch::default();
        assert_eq!(watch.observe(true, 0), None);
        assert_eq!(watch.observe(false, 99_999), None);
        assert_eq!(watch.observe(false, 33_333), Some(Unsuited::Reordered));
        assert_eq!(watch.verdict(), Verdict::Unsuited(Unsuited::Reordered));
    }

    #[test]
    fn a_verdict_needs_a_whole_gop() {
        let verdict = |frames, gop| {
            let mut watch = GopWatch::default();
            for frame in 0..frames {
                watch.observe(frame % gop == 0, frame * 33_333);
            }
            watch.verdict()
        };
        assert_eq!(verdict(15, 15), Verdict::Open);
        assert_eq!(verdict(16, 15), Verdict::Suited);
        assert_eq!(verdict(60, 90), Verdict::Open);
        assert_eq!(verdict(70, 90), Verdict::Unsuited(Unsuited::RareKeyframes));
        // What was seen once is not taken back by the short GOPs of a scene with many cuts.
        assert_eq!(verdict(91, 90), Verdict::Unsuited(Unsuited::RareKeyframes));
    }

    #[test]
    fn a_verdict_is_kept_until_the_source_changes_or_is_cleared() {
        let mut context = ffmpeg_next::codec::Context::new().encoder().video().unwrap();
        let mut parameters = |width| {
            context.set_width(width);
            context.set_height(64);
            Parameters::from(&context)
        };
        let (one, other) = (parameters(128), parameters(256));
        let mut memory = Memory::default();
        assert_eq!(memory.recall(&one), None);
        memory.learn(&one, Verdict::Unsuited(Unsuited::RareKeyframes));
        memory.learn(&one, Verdict::Open);
        assert_eq!((memory.recall(&one), memory.recall(&other)), (Some(Unsuited::RareKeyframes), None));
        memory.learn(&one, Verdict::Suited);
        assert_eq!(memory.recall(&one), None);
    }
}
