//! When steps are due.

use std::time::{Duration, Instant};

use mr360_protocol::clock::ServerTime;

use crate::physics::STEP_S;

/// So many steps at most are made up for at once; of a longer halt the time is lost, and everything is later by it.
const MAX_STEPS: u32 = 4;

/// An even pace of [`STEP_S`].
pub(super) struct Pace {
    next: Instant,
}

impl Pace {
    pub(super) fn start(now: Instant) -> Self {
        Self { next: now }
    }

    /// Of what times the steps are that are to be made now, oldest first; `clock` is the server's time at `now`. All count from this one
    /// moment: the steps themselves take time, and by the clock after the first the others would be too late.
    pub(super) fn times(&mut self, now: Instant, clock: ServerTime) -> Vec<ServerTime> {
        self.due(now).into_iter().map(|late| ServerTime(clock.0.saturating_sub(late.as_micros() as u64))).collect()
    }

    /// How long ago the steps were due that are to be made now, oldest first: what falls keeps its pace where this is asked late.
    fn due(&mut self, now: Instant) -> Vec<Duration> {
        let step = Duration::from_secs_f32(STEP_S);
        let mut due = Vec::new();
        while self.next <= now && due.len() < MAX_STEPS as usize {
            due.push(now - self.next);
            self.next += step;
        }
        if self.next <= now {
            self.next = now + step;
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_steps_are_of_their_own_times() {
        let begin = Instant::now();
        let (step, second) = (Duration::from_micros(16_666), 1_000_000);
        let mut pace = Pace::start(begin);
        assert_eq!(pace.times(begin, ServerTime(second)), [ServerTime(second)]);
        // Three are due, the last just now; each is a step after the one before, to the rounding of microseconds.
        let times = pace.times(begin + Duration::from_millis(51), ServerTime(second + 51_000));
        let expected: Vec<_> = (1..4).map(|n| second + n * step.as_micros() as u64).collect();
        assert!(times.len() == 3 && times.iter().zip(&expected).all(|(time, expected)| time.0.abs_diff(*expected) <= 3), "{times:?}");
        // Never before the broadcast's beginning.
        assert_eq!(pace.times(begin + Duration::from_millis(80), ServerTime(0)).first(), Some(&ServerTime(0)));
    }

    #[test]
    fn steps_are_made_up_for_and_long_halts_are_not() {
        let begin = Instant::now();
        let step = Duration::from_secs_f32(STEP_S);
        let mut pace = Pace::start(begin);
        assert_eq!(pace.due(begin), [Duration::ZERO]);
        assert!(pace.due(begin + step / 2).is_empty());
        // Two steps and a half later: both are made, each for its own time.
        assert_eq!(pace.due(begin + step * 5 / 2), [step * 3 / 2, step / 2]);
        let made: usize = (3..63).map(|n| pace.due(begin + step * n + step / 3).len()).sum();
        assert_eq!(made, 60, "a second has as many steps, however late each is");
        // A halt of a minute.
        let late = begin + Duration::from_secs(60);
        assert_eq!(pace.due(late).len(), MAX_STEPS as usize);
        assert!(pace.due(late + step / 2).is_empty());
        assert_eq!(pace.due(late + step), [Duration::ZERO]);
    }
}
