//! How well frames keep to the display's intervals. Times are the runtime's, nanoseconds.

/// Counts display intervals that no frame was made for.
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// When the frame before is displayed.
    last_ns: Option<i64>,
    missed: u64,
}

impl Pace {
    /// A frame is made that is displayed at `display_ns`, on a display that shows one every `period_ns`.
    pub(super) fn displays_at(&mut self, display_ns: i64, period_ns: i64) {
        if let Some(last_ns) = self.last_ns.filter(|last| period_ns > 0 && display_ns > *last) {
            // Rounded: predictions wander by a part of the period.
            let intervals = (display_ns - last_ns).saturating_add(period_ns / 2) / period_ns;
            self.missed += u64::try_from(intervals - 1).unwrap_or(0);
        }
        self.last_ns = Some(display_ns);
    }

    /// The headset shows nothing for a while: that is nobody's miss.
    pub(super) fn rests(&mut self) {
        self.last_ns = None;
    }

    pub(super) fn missed(&self) -> u64 {
        self.missed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_between_two_frames_are_missed_ones() {
        let mut pace = Pace::default();
        let at = |pace: &mut Pace, intervals: f64| pace.displays_at((intervals * 11_111_111.0) as i64, 11_111_111);
        for intervals in [100.0, 101.0, 102.1, 102.9] {
            at(&mut pace, intervals);
        }
        assert_eq!(pace.missed(), 0);
        at(&mut pace, 106.0);
        assert_eq!(pace.missed(), 2);
        // Asleep.
        pace.rests();
        at(&mut pace, 900.0);
        at(&mut pace, 901.0);
        assert_eq!(pace.missed(), 2);
        // A runtime that predicts nonsense counts nothing.
        pace.displays_at(0, 0);
        pace.displays_at(i64::MAX, 0);
        pace.displays_at(5, i64::MAX);
        assert_eq!(pace.missed(), 2);
    }
}
