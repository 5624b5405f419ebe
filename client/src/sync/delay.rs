//! How late to play out: as late as nearly all pictures and lights need, no later.

use std::collections::VecDeque;

use mr360_protocol::clock::ClientTime;

/// Least delay, microseconds: about a frame of a 60 Hz display.
pub const MIN_DELAY_US: u64 = 20_000;
/// Most delay, microseconds: what comes later than this is shown when it comes.
pub const MAX_DELAY_US: u64 = 500_000;
/// Before anything was observed, microseconds.
const START_US: u64 = 50_000;
/// Kept above the percentile, microseconds.
const MARGIN_US: u64 = 5_000;
/// Arrivals that the percentile is taken over: four seconds at 30 frames/s.
const WINDOW: usize = 128;
/// Share of arrivals that must be in time, percent.
const PERCENTILE: usize = 95;
/// The delay shrinks by one microsecond in this many: a speed-up of 1 % is not seen.
const SHRINK_DIVISOR: u64 = 100;

/// The last arrivals' excess over the least one.
#[derive(Default)]
struct Window(VecDeque<u64>);

impl Window {
    fn push(&mut self, excess_us: u64) {
        if self.0.len() == WINDOW {
            self.0.pop_front();
        }
        self.0.push_back(excess_us);
    }

    fn percentile(&self) -> u64 {
        let mut sorted: Vec<u64> = self.0.iter().copied().collect();
        sorted.sort_unstable();
        let rank = (sorted.len() * PERCENTILE).div_ceil(100).saturating_sub(1);
        sorted.get(rank).copied().unwrap_or(0)
    }
}

/// The adaptive delay: grows at once, shrinks slowly.
pub(super) struct PlayoutDelay {
    pictures: Window,
    lights: Window,
    current_us: u64,
    updated: Option<ClientTime>,
}

impl Default for PlayoutDelay {
    fn default() -> Self {
        Self { pictures: Window::default(), lights: Window::default(), current_us: START_US, updated: None }
    }
}

impl PlayoutDelay {
    /// Takes in by how much a picture was ready later than the least delay allows.
    pub(super) fn observe_picture(&mut self, excess_us: u64, now: ClientTime) {
        self.pictures.push(excess_us);
        self.update(now);
    }

    /// Takes in by how much a light arrived later than its picture would at the earliest.
    pub(super) fn observe_light(&mut self, excess_us: u64, now: ClientTime) {
        self.lights.push(excess_us);
        self.update(now);
    }

    /// Microseconds.
    pub(super) fn current_us(&self) -> u64 {
        self.current_us
    }

    fn update(&mut self, now: ClientTime) {
        let wanted = (self.pictures.percentile().max(self.lights.percentile()).saturating_add(MARGIN_US)).clamp(MIN_DELAY_US, MAX_DELAY_US);
        let since = self.updated.unwrap_or(now);
        let elapsed_us = now.0.saturating_sub(since.0);
        self.current_us = wanted.max(self.current_us.saturating_sub(elapsed_us / SHRINK_DIVISOR));
        // Moves on only when the shrinkage was a whole microsecond or more, so that small steps add up.
        if self.updated.is_none() || elapsed_us >= SHRINK_DIVISOR {
            self.updated = Some(now.max(since));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grows_at_once_and_shrinks_by_a_hundredth_of_the_time() {
        let mut delay = PlayoutDelay::default();
        assert_eq!(delay.current_us(), START_US);
        for i in 0..WINDOW as u64 {
            delay.observe_picture(80_000, ClientTime(i * 1_000));
        }
        assert_eq!(delay.current_us(), 85_000);
        let begin = WINDOW as u64 * 1_000 - 1_000;
        for i in 1..=1_000_u64 {
            delay.observe_picture(0, ClientTime(begin + i * 1_000));
        }
        // The percentile falls below 80 ms once 95 % of the window is new: 122 arrivals, 121 ms; then 1 % of the 879 ms left.
        assert_eq!(delay.current_us(), 85_000 - 8_790);
        for i in 1_001..=10_000_u64 {
            delay.observe_light(0, ClientTime(begin + i * 1_000));
        }
        assert_eq!(delay.current_us(), MIN_DELAY_US);
    }

    #[test]
    fn one_straggler_changes_nothing_and_late_light_counts() {
        let mut delay = PlayoutDelay::default();
        for i in 0..WINDOW as u64 {
            delay.observe_picture(if i == 60 { 400_000 } else { 1_000 }, ClientTime(i * 33_000));
        }
        assert!(delay.current_us() < START_US);
        for i in 0..8 {
            delay.observe_light(120_000, ClientTime(5_000_000 + i));
        }
        assert_eq!(delay.current_us(), 125_000);
        delay.observe_light(u64::MAX, ClientTime(5_000_100));
        assert_eq!(delay.current_us(), MAX_DELAY_US);
    }
}
