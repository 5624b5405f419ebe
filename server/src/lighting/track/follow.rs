//! Following one quantity: still while it only wavers, at once when it really changes.
//!
//! Deviations from the prediction up to a gate are noise and are averaged: double exponential smoothing, a level and a
//! trend, so that a steady ramp is followed without lag. Deviations beyond the gate that keep their side for two
//! observations are a change: level and trend are fitted to them afresh. A quantity that swings (a lamp that beats
//! with the frame rate) changes sides instead; one that has swung lately must stay on one side for longer than any of
//! its swings, or leave their range. A Kalman filter would need a model of the noise, which a codec changes from scene to scene, and its
//! gain forgets neither the swing nor the jump; the one-euro filter follows every swing whose speed exceeds its cutoff.

use glam::DVec3;

/// Time constant of the smoothing. Noise of single frames keeps about a quarter of its amplitude at 30 frames a
/// second, a beat of 10 Hz a sixteenth, and an error within the gate is gone after a second.
const CALM_S: f64 = 0.6;
/// Swings are remembered for this long after the last of them: a beat that is slower than a Hz may be followed.
const MEMORY_S: f64 = 1.0;
/// What turns back within this time was no change but half a swing: half a period of 4 Hz and the two observations
/// that made it a change.
const TURN_S: f64 = 0.15;
/// What exceeds the swings by this factor is none of them.
const BEYOND_SWINGS: f64 = 2.0;
/// A trend says nothing about what happened in a gap longer than this, whether it is one long frame or many without an observation.
const HORIZON_S: f64 = 0.1;

/// How a quantity is followed, in its own unit.
pub(super) struct Manner {
    /// Deviations up to this are noise.
    pub(super) gate: f64,
    /// Deviations beyond this must persist before they are believed.
    pub(super) leap: f64,
    /// Largest believable trend, per second.
    pub(super) fastest: f64,
    /// Whether swings are suppressed; where they are not, they are followed.
    pub(super) suppress_swings: bool,
}

/// Deviations in a row, beyond the gate and to one side.
#[derive(Debug, Clone, Copy)]
struct Run {
    /// How many.
    length: u32,
    /// The largest.
    size: f64,
    /// The first.
    deviation: DVec3,
    /// The observation with which it began.
    observed: DVec3,
    /// How long ago that was.
    age_s: f64,
}

/// Runs that came to nothing.
#[derive(Debug, Clone, Copy)]
struct Swings {
    /// Length of the longest.
    length: u32,
    /// Largest deviation.
    size: f64,
    /// Time since the last.
    age_s: f64,
}

/// State of one followed quantity of three components.
#[derive(Debug, Clone, Copy)]
pub(super) struct Follower {
    level: DVec3,
    /// Per second.
    trend: DVec3,
    /// The last observation.
    last: DVec3,
    age_s: f64,
    /// Time since then that was coasted over.
    unseen_s: f64,
    run: Option<Run>,
    swings: Swings,
    /// A run that has just been taken for a change, and how long ago.
    believed: Option<(Run, f64)>,
}

impl Follower {
    /// Begins with an observation.
    pub(super) fn new(observed: DVec3) -> Self {
        Self {
            level: observed,
            trend: DVec3::ZERO,
            last: observed,
            age_s: 0.0,
            unseen_s: 0.0,
            run: None,
            swings: Swings { length: 0, size: 0.0, age_s: f64::INFINITY },
            believed: None,
        }
    }

    /// The followed value.
    pub(super) fn value(&self) -> DVec3 {
        self.level
    }

    /// What it is expected to be in `dt_s` seconds.
    pub(super) fn predicted(&self, dt_s: f64) -> DVec3 {
        self.level + self.trend * dt_s.min((HORIZON_S - self.unseen_s).max(0.0))
    }

    /// Takes on a value at once, as after a change that is known for one.
    pub(super) fn jump(&mut self, observed: DVec3) {
        (self.level, self.trend, self.last) = (observed, DVec3::ZERO, observed);
        (self.run, self.believed, self.unseen_s) = (None, None, 0.0);
    }

    /// Goes on without an observation: along the trend, which is forgotten on the way and ends at the horizon.
    pub(super) fn coast(&mut self, dt_s: f64) {
        self.level = self.predicted(dt_s);
        self.trend *= (-dt_s / HORIZON_S).exp();
        self.run = None;
        self.unseen_s += dt_s;
        self.age(dt_s);
    }

    /// Brings the value back onto the unit sphere, for directions.
    pub(super) fn normalize(&mut self) {
        self.level = self.level.try_normalize().unwrap_or(self.last);
    }

    /// Takes an observation, `dt_s > 0` after the last one or the last that was coasted over.
    pub(super) fn observe(&mut self, manner: &Manner, observed: DVec3, dt_s: f64) {
        let predicted = self.predicted(dt_s);
        let deviation = observed - predicted;
        let size = deviation.length();
        self.age(dt_s);
        let since_s = dt_s + std::mem::take(&mut self.unseen_s);
        if size <= manner.gate {
            self.end_run();
        } else if let Some(run) = self.run.as_mut().filter(|run| deviation.dot(run.deviation) > 0.0) {
            (run.length, run.size) = (run.length + 1, run.size.max(size));
        } else {
            self.end_run();
            self.run = Some(Run { length: 1, size, deviation, observed, age_s: 0.0 });
        }
        let run = self.run;
        match run {
            Some(run) if self.turned_back(manner, run) => (self.level, self.trend) = (0.5 * (predicted + observed), DVec3::ZERO),
            Some(run) if run.length >= self.patience(manner, size) => self.refit(manner, run, observed, since_s),
            _ => self.smooth(manner, predicted, deviation, since_s),
        }
        self.last = observed;
    }

    fn age(&mut self, dt_s: f64) {
        self.age_s += dt_s;
        self.swings.age_s += dt_s;
        self.run.iter_mut().for_each(|run| run.age_s += dt_s);
        self.believed.iter_mut().for_each(|(_, age_s)| *age_s += dt_s);
        self.believed = self.believed.filter(|(_, age_s)| *age_s <= TURN_S);
    }

    /// Whether a new run undoes what was just taken for a change; the middle of the two is the best guess then.
    fn turned_back(&mut self, manner: &Manner, run: Run) -> bool {
        let undone = self.believed.filter(|(change, _)| manner.suppress_swings && change.deviation.dot(run.deviation) < 0.0);
        if let Some((change, _)) = undone.filter(|_| run.length == 1) {
            self.believed = None;
            self.swung(Run { length: change.length + 1, ..change });
            return true;
        }
        false
    }

    /// How many deviations in a row make a change.
    fn patience(&self, manner: &Manner, size: f64) -> u32 {
        let swings = Some(self.swings.length).filter(|_| manner.suppress_swings && size <= BEYOND_SWINGS * self.swings.size);
        if size <= manner.leap { 1 } else { 1 + swings.filter(|_| self.swings.age_s <= MEMORY_S).unwrap_or(1).max(1) }
    }

    fn end_run(&mut self) {
        if let Some(run) = self.run.take() {
            self.swung(run);
        }
    }

    /// Remembers a run that came to nothing.
    fn swung(&mut self, run: Run) {
        let Swings { length, size, age_s } = self.swings;
        let (length, size) = if age_s > MEMORY_S { (0, 0.0) } else { (length, size) };
        self.swings = Swings { length: length.max(run.length), size: size.max(run.size), age_s: 0.0 };
    }

    /// A line through the run: level for a step, trend for a ramp.
    fn refit(&mut self, manner: &Manner, run: Run, observed: DVec3, since_s: f64) {
        let slope = if run.length > 1 { (observed - run.observed) / run.age_s } else { (observed - self.last) / since_s };
        (self.level, self.trend) = (observed, slope.clamp_length_max(manner.fastest));
        (self.believed, self.run) = (Some((run, 0.0)), None);
    }

    /// Double exponential smoothing, of shorter memory while there is little to remember.
    fn smooth(&mut self, manner: &Manner, predicted: DVec3, deviation: DVec3, since_s: f64) {
        let discount = (-since_s / CALM_S.min(self.age_s)).exp();
        self.level = predicted + deviation * (1.0 - discount * discount);
        let trend = self.trend + deviation * ((1.0 - discount) * (1.0 - discount) / since_s);
        self.trend = trend.clamp_length_max(manner.fastest);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT_S: f64 = 1.0 / 30.0;
    const MANNER: Manner = Manner { gate: 0.02, leap: 0.02, fastest: 3.0, suppress_swings: true };

    /// The followed values of `signal(frame)`.
    fn follow(manner: &Manner, frames: usize, signal: impl Fn(usize) -> f64) -> Vec<f64> {
        let mut follower = Follower::new(DVec3::splat(signal(0)));
        (0..frames)
            .map(|frame| {
                if frame > 0 {
                    follower.observe(manner, DVec3::splat(signal(frame)), DT_S);
                }
                follower.value().x
            })
            .collect()
    }

    fn largest(values: impl IntoIterator<Item = f64>) -> f64 {
        values.into_iter().map(f64::abs).fold(0.0, f64::max)
    }

    #[test]
    fn a_step_is_taken_with_its_second_observation() {
        let values = follow(&MANNER, 40, |frame| f64::from(frame >= 20) * 0.5);
        assert!(values[19] == 0.0 && values[20] < 0.1 && values[21] == 0.5, "{values:?}");
        assert!(largest(values[21..].iter().map(|v| v - 0.5)) < 1e-9, "{values:?}");
    }

    #[test]
    fn a_single_outlier_is_not_taken() {
        let values = follow(&MANNER, 40, |frame| f64::from(frame == 20) * 0.5);
        // What smoothing lets through of one frame: 1 − θ², θ = exp(−1/18).
        assert!(largest(values) < 0.5 * 0.11, "a tenth");
    }

    #[test]
    fn a_ramp_is_followed_without_lag() {
        let slope = 0.693 * DT_S;
        let values = follow(&MANNER, 90, |frame| frame.saturating_sub(20) as f64 * slope);
        // The ramp shows in its second frame; from then on its line is known.
        assert!(largest(values.iter().enumerate().map(|(frame, v)| v - frame.saturating_sub(20) as f64 * slope)) < 2.0 * slope);
        assert!(largest(values[23..].iter().enumerate().map(|(frame, v)| v - (frame + 3) as f64 * slope)) < 1e-6);
    }

    #[test]
    fn a_beat_is_damped_and_a_step_within_it_still_seen() {
        for (phase, period) in [(0.3, 3.0), (0.9, 3.0), (0.0, 3.0), (0.2, 6.0)] {
            let beat = |frame: usize| 0.2 * (std::f64::consts::TAU * (frame as f64 + phase) / period).sin();
            let values = follow(&MANNER, 240, beat);
            let spread = largest(values[90..].iter().copied());
            // 10 Hz at 30 frames a second is what 50 Hz mains give; slower beats pass more.
            let damping = if period == 3.0 { 10.0 } else { 6.0 };
            assert!(spread < 0.2 / damping, "phase {phase} period {period}: {spread}");
            let values = follow(&MANNER, 240, |frame| beat(frame) + f64::from(frame >= 200) * 1.0);
            assert!(values[203] > 0.7, "{:?}", &values[198..210]);
        }
    }

    /// A follower that knows a ramp of this slope a second by heart.
    fn on_a_ramp(slope: f64) -> Follower {
        let mut follower = Follower::new(DVec3::ZERO);
        (1..=30).for_each(|frame| follower.observe(&MANNER, DVec3::splat(slope * f64::from(frame) * DT_S), DT_S));
        assert!((follower.trend.x / slope - 1.0).abs() < 1e-3, "{follower:?}");
        follower
    }

    #[test]
    fn a_jump_leaves_no_trend_and_nothing_to_turn_back_from() {
        let mut follower = on_a_ramp(0.7);
        follower.jump(DVec3::ONE);
        assert_eq!(follower.predicted(DT_S), DVec3::ONE);
        // A step up is believed, and then a jump is known for one: a step down after it is no half of a swing.
        let mut follower = Follower::new(DVec3::ZERO);
        (0..20).for_each(|_| follower.observe(&MANNER, DVec3::ZERO, DT_S));
        (0..2).for_each(|_| follower.observe(&MANNER, DVec3::splat(0.5), DT_S));
        follower.jump(DVec3::ONE);
        let mut fresh = Follower { age_s: follower.age_s, ..Follower::new(DVec3::ONE) };
        for follower in [&mut follower, &mut fresh] {
            follower.observe(&MANNER, DVec3::splat(0.6), DT_S);
        }
        assert_eq!(follower.value(), fresh.value());
    }

    #[test]
    fn what_is_out_of_sight_drifts_no_further_than_a_trend_can_tell() {
        let mut follower = on_a_ramp(0.7);
        let (start, age_s) = (follower.value().x, follower.age_s);
        let drift: Vec<f64> = (0..30)
            .map(|_| {
                follower.coast(DT_S);
                follower.value().x - start
            })
            .collect();
        assert!(drift.is_sorted() && (drift[0] - 0.7 * DT_S).abs() < 1e-3, "{drift:?}");
        assert!(drift[29] <= 0.7 * HORIZON_S + 1e-6 && drift[29] == drift[10], "{drift:?}");
        assert!(follower.trend.x < 1e-3 && (follower.age_s - age_s - 1.0).abs() < 1e-9, "{follower:?}");
        // Seen again near by, it is not taken for a movement within a single frame.
        follower.observe(&MANNER, DVec3::splat(follower.value().x + 0.01), DT_S);
        assert!(follower.trend.x.abs() < 0.3, "{follower:?}");
    }

    #[test]
    fn swings_are_followed_where_asked_for() {
        let manner = Manner { gate: 0.1, leap: 2.0, fastest: 100.0, suppress_swings: false };
        let shake = |frame: usize| (std::f64::consts::TAU * 2.0 * frame as f64 * DT_S).sin();
        let values = follow(&manner, 120, shake);
        assert!(largest(values.iter().enumerate().map(|(frame, v)| v - shake(frame))) <= 0.1 / 3f64.sqrt() + 1e-9);
    }
}
