//! How long each step of an estimate took.

use std::time::{Duration, Instant};

/// Most steps that one method may name.
const MAX_STEPS: usize = 12;

/// Named durations of one frame's estimate, in the order in which the steps first ran. Never allocates.
#[derive(Debug, Clone, Copy, Default)]
pub struct StepTimes {
    entries: [(&'static str, Duration); MAX_STEPS],
    len: usize,
}

impl StepTimes {
    /// Forgets all steps.
    pub fn clear(&mut self) {
        self.len = 0;
    }

    /// Runs `work` and adds its time to the step `name`.
    pub fn time<T>(&mut self, name: &'static str, work: impl FnOnce() -> T) -> T {
        let started = Instant::now();
        let result = work();
        self.add(name, started.elapsed());
        result
    }

    /// Adds `duration` to the step `name`. A name beyond the table's room is counted under the last one.
    pub fn add(&mut self, name: &'static str, duration: Duration) {
        let known = self.entries[..self.len].iter().position(|(known, _)| *known == name);
        let slot = known.unwrap_or(self.len).min(MAX_STEPS - 1);
        if slot == self.len {
            self.entries[slot] = (name, Duration::ZERO);
            self.len += 1;
        }
        self.entries[slot].1 += duration;
    }

    /// Steps and their times.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, Duration)> + '_ {
        self.entries[..self.len].iter().copied()
    }

    /// Time of all steps together.
    #[must_use]
    pub fn total(&self) -> Duration {
        self.iter().map(|(_, duration)| duration).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_add_up_and_keep_their_order() {
        let mut steps = StepTimes::default();
        for (name, ms) in [("sample", 3), ("sh", 1), ("sample", 4)] {
            steps.add(name, Duration::from_millis(ms));
        }
        assert_eq!(steps.iter().map(|(n, d)| (n, d.as_millis())).collect::<Vec<_>>(), [("sample", 7), ("sh", 1)]);
        assert_eq!(steps.total(), Duration::from_millis(8));
        steps.clear();
        assert_eq!(steps.iter().count(), 0);
    }

    #[test]
    fn more_names_than_room_lose_no_time() {
        let mut steps = StepTimes::default();
        let names = ["a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k", "l", "m", "n"];
        for name in names {
            steps.add(name, Duration::from_millis(1));
        }
        assert_eq!((steps.iter().count(), steps.total()), (MAX_STEPS, Duration::from_millis(names.len() as u64)));
    }
}
