//! Whether coded video suits live playback as it is.

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

/// Watches packets in coded order.
#[derive(Debug, Default)]
pub(super) struct GopWatch {
    last_key_us: Option<i64>,
    last_pts_us: Option<i64>,
}

impl GopWatch {
    /// The reason why this packet does not suit live playback, if it does not.
    pub(super) fn observe(&mut self, keyframe: bool, pts_us: i64) -> Option<String> {
        if self.last_pts_us.is_some_and(|last| pts_us < last) {
            return Some("its frames are reordered".to_owned());
        }
        self.last_pts_us = Some(pts_us);
        if keyframe {
            self.last_key_us = Some(pts_us);
        }
        let since = pts_us - *self.last_key_us.get_or_insert(pts_us);
        (since > MAX_GOP_US + TOLERANCE_US).then(|| format!("its keyframes are more than {} s apart", MAX_GOP_US / 1_000_000))
    }

    /// Timestamps start anew.
    pub(super) fn reset(&mut self) {
        *self = Self::default();
    }
}

/// Reads the beginning of a file for the reason why it does not suit live playback. Leaves `input` somewhere behind its start.
pub(super) fn look_ahead(input: &mut format::context::Input, stream: &VideoStream) -> Option<String> {
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
        if let Some(reason) = watch.observe(packet.is_key(), pts_us) {
            return Some(reason);
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
        assert!(watch.observe(false, 33_333).is_some());
    }
}
