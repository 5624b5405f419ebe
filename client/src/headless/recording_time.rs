//! One time for a recording across the broadcasts that it sees.

use mr360_protocol::clock::ClientTime;

use crate::frame_loop::PictureTime;

/// Lays the pictures of one broadcast after those of the one before. Within a broadcast a picture keeps the video's own spacing, free of
/// the jitter of this machine; between two of them lies the time that really passed.
#[derive(Default)]
pub(super) struct RecordingTime {
    last: Option<Last>,
}

struct Last {
    shown: PictureTime,
    time_us: u64,
    at: ClientTime,
}

impl RecordingTime {
    /// Where a picture presented at `now` belongs, microseconds since the first one.
    pub(super) fn of(&mut self, shown: PictureTime, now: ClientTime) -> u64 {
        let time_us = match &self.last {
            None => 0,
            Some(last) if last.shown.epoch == shown.epoch => last.time_us.saturating_add(shown.pts_us.saturating_sub(last.shown.pts_us)),
            Some(last) => last.time_us.saturating_add(now.0.saturating_sub(last.at.0).max(1)),
        };
        self.last = Some(Last { shown, time_us, at: now });
        time_us
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_broadcast_follows_the_one_before_by_what_passed_between() {
        let mut time = RecordingTime::default();
        let shown = [(0, 9_000_000, 100), (0, 9_033_333, 39_000), (1, 5, 2_039_000), (1, 40_005, 2_100_000), (3, 40_005, 2_100_000)];
        let times = shown.map(|(epoch, pts_us, now)| time.of(PictureTime { epoch, pts_us }, ClientTime(now)));
        // 2 s between the broadcasts, then 40 ms of the second; the last begins at once and is still a picture of its own.
        assert_eq!(times, [0, 33_333, 2_033_333, 2_073_333, 2_073_334]);
    }
}
