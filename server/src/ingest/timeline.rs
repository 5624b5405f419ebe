//! From the source's timestamps to microseconds since the start of the broadcast.
//!
//! A source is anchored to the server's clock when its first packet comes in and keeps its own pace from there. Where it
//! jumps it is anchored again, and video and audio follow the same jump, so that they stay together.

use ffmpeg_next::Rational;

/// Further than this forward is a jump, microseconds.
const JUMP_US: i64 = 2_000_000;
/// Further than this backward is a jump; less is jitter of the muxer, microseconds.
const BACKWARD_US: i64 = 100_000;

/// Reordering shows a picture at most this long, or [`REORDERED`] frames where those last longer, after or before its decoding; more is a stray
/// timestamp, microseconds.
const REORDER_US: i64 = 1_000_000;
/// Frames that H.264 and HEVC may hold back at most.
const REORDERED: i64 = 16;

/// Which stream a timestamp belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lane {
    Video,
    Audio,
}

#[derive(Debug, Clone, Copy)]
struct Mapping {
    /// Output minus input.
    offset: i64,
    last_in: i64,
    last_out: i64,
    step: i64,
}

/// Maps decode timestamps; the presentation timestamp shares the offset.
#[derive(Debug, Default)]
pub(super) struct Timeline {
    lanes: [Option<Mapping>; 2],
    /// The newest anchor, and the input timestamp it was made for.
    anchor: Option<(i64, i64)>,
    /// Ends of all output so far.
    end: i64,
    jumps: u64,
}

impl Timeline {
    /// Offset to add to a packet's timestamps. `dts_us` in the source's time, `step_us` its duration, `now_us` the server's clock.
    pub(super) fn offset(&mut self, lane: Lane, dts_us: i64, step_us: i64, now_us: i64) -> i64 {
        let index = lane as usize;
        let step = step_us.clamp(1, JUMP_US);
        let offset = match (self.lanes[index], self.anchor) {
            (None, None) => self.anchor_at(dts_us, now_us.max(self.end)),
            (None, Some((offset, _))) => self.join(offset, dts_us, now_us),
            (Some(last), _) => {
                let moved = dts_us.saturating_sub(last.last_in);
                if (-BACKWARD_US..=JUMP_US + last.step).contains(&moved) { last.offset } else { self.jump(index, last, dts_us, now_us) }
            }
        };
        let out = dts_us.saturating_add(offset);
        self.lanes[index] = Some(Mapping { offset, last_in: dts_us, last_out: out, step });
        self.end = self.end.max(out.saturating_add(step));
        offset
    }

    /// The other stream's first packet: on the anchor, unless its clock is another one altogether.
    fn join(&mut self, offset: i64, dts_us: i64, now_us: i64) -> i64 {
        let out = dts_us.saturating_add(offset);
        if (out - now_us.max(self.end)).abs() <= 5 * JUMP_US { offset } else { now_us.saturating_sub(dts_us) }
    }

    fn jump(&mut self, index: usize, last: Mapping, dts_us: i64, now_us: i64) -> i64 {
        let near = |offset: i64| dts_us.saturating_add(offset).saturating_sub(last.last_out).saturating_abs() <= JUMP_US;
        // The other stream has jumped already, or this one comes back from a stray timestamp.
        let other = self.lanes[1 - index].map(|other| other.offset);
        let known = self.anchor.map(|(offset, _)| offset).into_iter().chain(other).find(|&offset| offset != last.offset && near(offset));
        if let Some(offset) = known {
            return offset;
        }
        self.jumps += 1;
        self.anchor_at(dts_us, now_us.max(last.last_out.saturating_add(last.step)))
    }

    fn anchor_at(&mut self, dts_us: i64, out_us: i64) -> i64 {
        let offset = out_us.saturating_sub(dts_us);
        self.anchor = Some((offset, dts_us));
        offset
    }

    /// The file starts again from its first timestamp: it goes on where it ended.
    pub(super) fn repeat(&mut self) {
        self.lanes = [None; 2];
        if let Some((_, first)) = self.anchor {
            self.anchor = Some((self.end.saturating_sub(first), first));
        }
    }

    /// The source was opened anew: its timestamps mean something else now.
    pub(super) fn reopen(&mut self) {
        self.lanes = [None; 2];
        self.anchor = None;
    }

    /// Jumps that were mended, taken out.
    pub(super) fn take_jumps(&mut self) -> u64 {
        std::mem::take(&mut self.jumps)
    }
}

/// When a packet is shown, in the time of its `dts_us`, and whether its own timestamp was a stray one that is beyond the reach of reordering: then
/// that is when it is decoded. What keeps timestamps rising would hold back all that follows until a stray one's time. `step_us` is the duration
/// of a frame.
pub(super) fn shown(pts_us: Option<i64>, dts_us: i64, step_us: i64) -> (i64, bool) {
    let reach = REORDER_US.max(step_us.clamp(1, JUMP_US) * REORDERED);
    match pts_us {
        Some(pts) if pts.saturating_sub(dts_us).saturating_abs() > reach => (dts_us, true),
        pts => (pts.unwrap_or(dts_us), false),
    }
}

/// A timestamp in microseconds.
pub(super) fn micros(timestamp: i64, time_base: Rational) -> i64 {
    let value = i128::from(timestamp) * i128::from(time_base.0) * 1_000_000 / i128::from(time_base.1.max(1));
    // Two centuries either way leave room to add and subtract.
    i64::try_from(value).unwrap_or(0).clamp(-(1 << 52), 1 << 52)
}

/// Keeps a stream of timestamps strictly rising.
#[derive(Debug, Default)]
pub(super) struct Rising {
    next: u64,
}

impl Rising {
    /// The timestamp itself, or the least one that still rises.
    pub(super) fn rise(&mut self, pts_us: i64) -> u64 {
        let out = u64::try_from(pts_us).unwrap_or(0).max(self.next);
        self.next = out + 1;
        out
    }

    /// Whether the timestamp rises by itself.
    pub(super) fn rises(&self, pts_us: i64) -> bool {
        u64::try_from(pts_us).is_ok_and(|pts| pts >= self.next)
    }
}

#[cfg(test)]
mod tests {
    use super::Lane::{Audio, Video};
    use super::*;

    const STEP: i64 = 33_333;

    fn out(timeline: &mut Timeline, lane: Lane, dts: i64, now: i64) -> i64 {
        dts + timeline.offset(lane, dts, STEP, now)
    }

    #[test]
    fn first_packet_is_anchored_to_the_clock_and_audio_follows() {
        let mut timeline = Timeline::default();
        assert_eq!(out(&mut timeline, Video, 5_000_000, 100), 100);
        assert_eq!(out(&mut timeline, Audio, 5_010_000, 900), 10_100);
        assert_eq!(out(&mut timeline, Video, 5_000_000 + STEP, 70_000), 100 + STEP);
        assert_eq!(timeline.take_jumps(), 0);
    }

    #[test]
    fn a_jump_is_counted_once_and_keeps_sound_with_picture() {
        for target in [900_000_000, -7_000_000] {
            let mut timeline = Timeline::default();
            out(&mut timeline, Video, 0, 0);
            out(&mut timeline, Audio, 0, 0);
            let video = out(&mut timeline, Video, target, 40_000);
            // Still before the jump.
            assert_eq!(out(&mut timeline, Audio, STEP, 40_000), STEP);
            let audio = out(&mut timeline, Audio, target + 10_000, 41_000);
            assert_eq!((video, audio), (40_000, 50_000));
            assert_eq!(timeline.take_jumps(), 1);
        }
    }

    #[test]
    fn a_stray_timestamp_does_not_shift_sound_against_picture() {
        let mut timeline = Timeline::default();
        out(&mut timeline, Video, 0, 0);
        out(&mut timeline, Audio, 0, 0);
        out(&mut timeline, Video, 99_000_000, STEP);
        assert_eq!(out(&mut timeline, Video, 2 * STEP, 2 * STEP), 2 * STEP);
    }

    #[test]
    fn a_repeated_file_goes_on_where_it_ended() {
        let mut timeline = Timeline::default();
        for frame in 0..3 {
            assert_eq!(out(&mut timeline, Video, 1_000_000 + frame * STEP, 500), 500 + frame * STEP);
        }
        timeline.repeat();
        assert_eq!(out(&mut timeline, Video, 1_000_000, 500), 500 + 3 * STEP);
        assert_eq!(timeline.take_jumps(), 0);
    }

    #[test]
    fn a_reopened_source_is_anchored_anew_and_never_goes_back() {
        let mut timeline = Timeline::default();
        out(&mut timeline, Video, 8_000_000, 0);
        timeline.reopen();
        assert_eq!(out(&mut timeline, Video, 0, 9_000_000), 9_000_000);
        timeline.reopen();
        assert_eq!(out(&mut timeline, Video, 0, 1), 9_000_000 + STEP);
    }

    #[test]
    fn reordered_pictures_keep_their_times_and_stray_ones_do_not() {
        assert_eq!(shown(None, 7, STEP), (7, false));
        for ahead in [-REORDER_US, -STEP, 0, 4 * STEP, REORDER_US] {
            assert_eq!(shown(Some(ahead), 0, STEP), (ahead, false));
        }
        for stray in [REORDER_US + 1, -REORDER_US - 1, 900_000_000, i64::MAX, i64::MIN] {
            assert_eq!(shown(Some(stray), 0, STEP), (0, true));
        }
        // Two frames a second, all that a codec may hold back.
        assert_eq!(shown(Some(8_000_000), 0, 500_000), (8_000_000, false));
    }

    #[test]
    fn rising_is_strict() {
        let mut rising = Rising::default();
        assert_eq!([-5, 0, 0, 10, 3].map(|pts| rising.rise(pts)), [0, 1, 2, 10, 11]);
        assert!(!rising.rises(11) && rising.rises(12) && !rising.rises(-1));
        assert_eq!(micros(90_000, Rational(1, 90_000)), 1_000_000);
        assert_eq!(micros(i64::MAX, Rational(i32::MAX, 1)), 0);
    }
}
