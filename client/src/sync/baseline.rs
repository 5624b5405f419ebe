//! From pts to client time: the least (arrival − pts) of late, by a filter that follows the source's clock.

use std::collections::VecDeque;

use mr360_protocol::clock::ClientTime;

/// The least is taken over this long: jitter and loss leave some arrivals undelayed, microseconds.
const WINDOW_US: u64 = 4_000_000;
/// Arrivals within the window that can matter, at most: far above 120 frames/s.
const MAX_HELD: usize = 1_024;
/// The baseline rises by one microsecond in this many: slower clocks than this do not exist, faster changes would be seen.
const RISE_DIVISOR: u64 = 100;

/// Client time of pts 0 for undelayed arrivals. Falls at once, rises slowly.
#[derive(Default)]
pub(super) struct Baseline {
    /// (arrival − pts, arrival), both increasing: what may yet be the least of the window.
    held: VecDeque<(i64, ClientTime)>,
    /// The baseline, and until when it has risen.
    current: Option<(i64, ClientTime)>,
}

impl Baseline {
    /// Takes in an arrival.
    pub(super) fn observe(&mut self, pts_us: u64, arrived: ClientTime) {
        let difference = signed(arrived.0).saturating_sub(signed(pts_us));
        while self.held.back().is_some_and(|(held, _)| *held >= difference) {
            self.held.pop_back();
        }
        self.held.push_back((difference, arrived));
        let too_old = |at: ClientTime| at.0.saturating_add(WINDOW_US) < arrived.0;
        while self.held.len() > MAX_HELD || self.held.front().is_some_and(|(_, at)| too_old(*at)) {
            self.held.pop_front();
        }
        let least = self.held.front().map_or(difference, |(least, _)| *least);
        self.current = Some(match self.current {
            Some((current, since)) if least > current => {
                let rise = arrived.0.saturating_sub(since.0) / RISE_DIVISOR;
                // What was too short for a whole microsecond counts the next time.
                let risen = if rise > 0 { arrived } else { since };
                (current.saturating_add_unsigned(rise).min(least), risen)
            }
            _ => (least, arrived),
        });
    }

    /// Client time at which an access unit of this pts arrives when nothing holds it up; `None` before the first.
    pub(super) fn expected(&self, pts_us: u64) -> Option<ClientTime> {
        let (current, _) = self.current?;
        Some(ClientTime(u64::try_from(signed(pts_us).saturating_add(current)).unwrap_or(0)))
    }

    /// Client time minus pts, microseconds.
    pub(super) fn offset_us(&self) -> Option<i64> {
        self.current.map(|(current, _)| current)
    }
}

fn signed(time_us: u64) -> i64 {
    i64::try_from(time_us).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_delay_counts() {
        let mut baseline = Baseline::default();
        assert_eq!(baseline.expected(5), None);
        for (pts, arrived) in [(1_000, 6_000), (2_000, 5_500), (3_000, 9_900)] {
            baseline.observe(pts, ClientTime(arrived));
        }
        // The second is still the least of the window.
        assert_eq!(baseline.offset_us(), Some(3_500));
        assert_eq!(baseline.expected(3_000), Some(ClientTime(6_500)));
        // A late joiner's pts is ahead of its clock.
        baseline.observe(90_000_000, ClientTime(10_000));
        assert_eq!(baseline.offset_us(), Some(-89_990_000));
        assert_eq!(baseline.expected(89_980_000), Some(ClientTime(0)));
    }

    #[test]
    fn a_slow_source_clock_is_followed() {
        let mut baseline = Baseline::default();
        // 3,000 ppm slow, 30 frames/s, for five minutes.
        let arrival = |i: u64| 1_000_000 + i * 33_433;
        (0..9_000).for_each(|i| baseline.observe(i * 33_333, ClientTime(arrival(i))));
        let behind = arrival(8_999) - baseline.expected(8_999 * 33_333).unwrap().0;
        // The drift over the window, 100 µs for each of its 120 frames.
        assert!((11_000..=13_000).contains(&behind), "{behind}");
        assert!(baseline.held.len() <= 121);
    }
}
