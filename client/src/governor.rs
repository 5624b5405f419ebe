//! How much a frame may cost: what is left out while frames take longer than the display gives them, and when it comes back.
//!
//! What a frame needs is decided from scene and light ([`Plan`]); a [`Tier`] bounds that, and the [`Governor`] chooses the tier from what frames
//! have cost. Time is an argument.

use std::fmt;

use mr360_protocol::clock::ClientTime;

use crate::view::Plan;
use crate::view::plan::MAX_SHADOWS;

/// Frames after a change that say nothing: pipelines are made, and the GPU's times are still those of frames before.
const SETTLE: u32 = 8;
/// What a frame over the budget counts for; one within it takes back 1. More than one in four is too many: what the video's rate costs falls on
/// one display frame in three.
const OVER: u32 = 3;
/// A step down follows from this count on: after ten frames when all are over.
const OVERLOADED: u32 = 10 * OVER;
/// A frame's cost is the largest of so many, which holds one that a picture came with.
const RECENT: usize = 4;
/// Frames whose mean is what a tier costs.
const MEAN: f32 = 32.0;
/// A step up needs the tier above to fit with this share of the budget left to spare.
const SPARE: f32 = 0.2;
/// For so long, microseconds.
const CALM_US: u64 = 2_000_000;
/// A step up that has to be taken back within this time doubles the next wait, microseconds.
const REGRET_US: u64 = 10_000_000;
/// Longest wait, microseconds.
const LONGEST_CALM_US: u64 = 64_000_000;
/// What a frame may count for at most, budgets: one that hung says little of the next.
const LARGEST: f32 = 4.0;

/// How much is left out: 0 nothing, [`Tier::LOWEST`] all that can be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Hash)]
pub struct Tier(u8);

/// Bounds on what a frame does. Never below what a scene needs to look right: the strongest light keeps its shadow, reflections are late but
/// there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Most lights that cast shadows, 1 to [`MAX_SHADOWS`].
    pub shadows: usize,
    /// Reflections follow every so manieth picture.
    pub reflections_every: u32,
    /// Objects shade each other and the ground beneath them from the sky.
    pub occlusion: bool,
    /// Samples a pixel of objects and ground.
    pub samples: u32,
    /// Glossy ground and place mirror objects.
    pub mirrors: bool,
}

impl Tier {
    /// Nothing is left out.
    pub const FULL: Self = Self(0);
    /// All that can be is left out.
    pub const LOWEST: Self = Self(4);

    /// How many there are.
    pub const COUNT: usize = Self::LOWEST.0 as usize + 1;

    /// A tier by its number.
    #[must_use]
    pub fn new(number: u8) -> Option<Self> {
        (number <= Self::LOWEST.0).then_some(Self(number))
    }

    /// Its number.
    #[must_use]
    pub fn number(self) -> u8 {
        self.0
    }

    /// What it leaves in.
    #[must_use]
    pub fn limits(self) -> Limits {
        let (shadows, reflections_every, occlusion, samples) = match self.0 {
            0 => (MAX_SHADOWS, 1, true, 4),
            1 => (2, 2, true, 4),
            2 => (1, 4, true, 4),
            3 => (1, 4, false, 4),
            _ => (1, 4, false, 1),
        };
        // What stands on them is shaded from them in the same tiers.
        Limits { shadows, reflections_every, occlusion, samples, mirrors: occlusion }
    }
}

impl fmt::Display for Tier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {}", self.0, Self::LOWEST.0)
    }
}

/// A tier that was left because it cost too much.
struct Left {
    tier: Tier,
    /// What frames cost there, microseconds.
    cost_us: f32,
    /// What was done there.
    plan: Plan,
    /// What frames cost at first in the tier below, microseconds, once known.
    below_us: Option<f32>,
}

/// Mean of the recent frames' largest costs since something changed.
#[derive(Default)]
struct Mean {
    frames: f32,
    value_us: f32,
    recent_us: [f32; RECENT],
}

impl Mean {
    fn push(&mut self, cost_us: f32) {
        self.recent_us.rotate_right(1);
        self.recent_us[0] = cost_us;
        let largest = self.recent_us.iter().copied().fold(0.0, f32::max);
        self.frames = (self.frames + 1.0).min(MEAN);
        self.value_us += (largest - self.value_us) / self.frames;
    }

    fn settled(&self) -> Option<f32> {
        (self.frames >= MEAN).then_some(self.value_us)
    }
}

/// Chooses the tier.
pub struct Governor {
    /// Microseconds a frame; `None` for a tier that stays.
    budget_us: Option<f32>,
    tier: Tier,
    left: Vec<Left>,
    settling: u32,
    overload: u32,
    mean: Mean,
    calm_since: Option<ClientTime>,
    calm_us: u64,
    stepped_up: Option<ClientTime>,
}

impl Governor {
    /// One that keeps a tier whatever frames cost.
    #[must_use]
    pub fn fixed(tier: Tier) -> Self {
        Self {
            budget_us: None,
            tier,
            left: Vec::new(),
            settling: 0,
            overload: 0,
            mean: Mean::default(),
            calm_since: None,
            calm_us: CALM_US,
            stepped_up: None,
        }
    }

    /// One that keeps frames within the display's interval, microseconds.
    #[must_use]
    pub fn automatic(interval_us: u32) -> Self {
        // The first frames make pipelines and textures.
        Self { budget_us: Some(interval_us.max(1) as f32), settling: 4 * SETTLE, ..Self::fixed(Tier::FULL) }
    }

    /// The display turns out to show a frame every so many microseconds. Says nothing to one that keeps its tier.
    pub fn set_interval(&mut self, interval_us: u32) {
        if let Some(budget_us) = &mut self.budget_us {
            *budget_us = interval_us.max(1) as f32;
        }
    }

    /// The tier of the next frame.
    #[must_use]
    pub fn tier(&self) -> Tier {
        self.tier
    }

    /// What a frame may take, microseconds; `None` when that does not matter.
    #[must_use]
    pub fn budget_us(&self) -> Option<f32> {
        self.budget_us
    }

    /// Takes in what a frame cost: the longer of the CPU's and the GPU's time. `plan` tells what a tier does with this scene under this light;
    /// tiers that leave out nothing of it are passed over. Returns the new tier when it changes.
    pub fn observe(&mut self, now: ClientTime, cost_us: u64, plan: &dyn Fn(Tier) -> Plan) -> Option<Tier> {
        let budget_us = self.budget_us?;
        if self.settling > 0 {
            self.settling -= 1;
            return None;
        }
        let cost_us = (cost_us as f32).min(LARGEST * budget_us);
        self.mean.push(cost_us);
        self.overload = if cost_us > budget_us { self.overload + OVER } else { self.overload.saturating_sub(1) };
        if self.overload >= OVERLOADED {
            self.overload = 0;
            return self.step_down(now, plan);
        }
        let mean_us = self.mean.settled()?;
        let above = self.left.last_mut()?;
        let below_us = *above.below_us.get_or_insert(mean_us);
        // The tier above costs by as much more as it did, unless it does something else by now: then only trying tells.
        let more = if plan(above.tier) == above.plan { above.cost_us / below_us.max(1.0) } else { 1.0 };
        if mean_us * more > (1.0 - SPARE) * budget_us {
            self.calm_since = None;
            return None;
        }
        let since = *self.calm_since.get_or_insert(now);
        (now.0.saturating_sub(since.0) >= self.calm_us).then(|| self.step_up(now)).flatten()
    }

    fn step_down(&mut self, now: ClientTime, plan: &dyn Fn(Tier) -> Plan) -> Option<Tier> {
        let here = plan(self.tier);
        let next = (self.tier.0 + 1..=Tier::LOWEST.0).map(Tier).find(|tier| plan(*tier) != here)?;
        if self.stepped_up.take().is_some_and(|at| now.0.saturating_sub(at.0) < REGRET_US) {
            self.calm_us = (2 * self.calm_us).min(LONGEST_CALM_US);
        } else {
            self.calm_us = CALM_US;
        }
        self.left.push(Left { tier: self.tier, cost_us: self.mean.value_us, plan: here, below_us: None });
        Some(self.change_to(next))
    }

    fn step_up(&mut self, now: ClientTime) -> Option<Tier> {
        let above = self.left.pop()?;
        self.stepped_up = Some(now);
        Some(self.change_to(above.tier))
    }

    fn change_to(&mut self, tier: Tier) -> Tier {
        self.tier = tier;
        (self.settling, self.overload, self.mean, self.calm_since) = (SETTLE, 0, Mean::default(), None);
        tier
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const BUDGET_US: u32 = 11_111;

    /// A scene that has something for every tier to leave out.
    fn full(tier: Tier) -> Plan {
        Plan { objects: true, reflections: true, shadows: MAX_SHADOWS, ..Plan::default() }.within(tier)
    }

    /// Runs frames of a cost by tier and frame number, one a budget, and returns (frame, tier) of every change.
    fn run(
        governor: &mut Governor,
        frames: std::ops::Range<u64>,
        cost: impl Fn(u8, u64) -> u64,
        plan: &dyn Fn(Tier) -> Plan,
    ) -> Vec<(u64, u8)> {
        let mut changes = Vec::new();
        for frame in frames {
            let cost_us = cost(governor.tier().number(), frame);
            if let Some(tier) = governor.observe(ClientTime(frame * u64::from(BUDGET_US)), cost_us, plan) {
                assert_eq!(tier, governor.tier());
                changes.push((frame, tier.number()));
            }
        }
        changes
    }

    #[test]
    fn overload_steps_down_within_18_frames_and_stops_at_the_lowest() {
        let mut governor = Governor::automatic(BUDGET_US);
        let changes = run(&mut governor, 0..2_000, |_, _| 20_000, &full);
        // 32 frames of starting up, then ten over the budget; eight of settling before each further ten.
        assert_eq!(changes, [(41, 1), (59, 2), (77, 3), (95, 4)]);
    }

    #[test]
    fn a_slower_display_gives_more_time() {
        let mut governor = Governor::automatic(BUDGET_US);
        governor.set_interval(50_000);
        assert_eq!(run(&mut governor, 0..2_000, |_, _| 20_000, &full), []);
        governor.set_interval(BUDGET_US);
        assert!(!run(&mut governor, 2_000..2_100, |_, _| 20_000, &full).is_empty());
        let mut fixed = Governor::fixed(Tier::FULL);
        fixed.set_interval(1);
        assert_eq!(fixed.budget_us(), None);
    }

    #[test]
    fn single_slow_frames_change_nothing_and_one_in_three_does() {
        let mut governor = Governor::automatic(BUDGET_US);
        let slow = |every: u64| move |_: u8, frame: u64| if frame.is_multiple_of(every) { 30_000 } else { 9_000 };
        assert!(run(&mut governor, 0..5_000, slow(5), &full).is_empty());
        assert!(!run(&mut governor, 0..200, slow(3), &full).is_empty());
        let mut fixed = Governor::fixed(Tier::LOWEST);
        assert!(run(&mut fixed, 0..500, |_, _| 90_000, &full).is_empty() && fixed.tier() == Tier::LOWEST);
    }

    #[test]
    fn it_comes_back_when_the_tier_above_would_fit_and_no_sooner() {
        let mut governor = Governor::automatic(BUDGET_US);
        // Three quarters of the cost in the tier below; the load halves after 1,000 frames.
        let cost = |tier: u8, frame: u64| {
            let full = if frame < 1_000 { 14_000 } else { 7_000 };
            if tier == 0 { full } else { full * 3 / 4 }
        };
        let changes = run(&mut governor, 0..3_000, cost, &full);
        let [(41, 1), (back, 0)] = changes[..] else { panic!("{changes:?}") };
        // Two seconds of calm are 180 frames, after the mean has come below 8,889 / 14,000 of what it was: some of its 32.
        assert!((1_180..1_260).contains(&back), "{back}");
    }

    #[test]
    fn tiers_that_leave_out_nothing_of_a_scene_are_passed_over() {
        let diffuse = |tier: Tier| Plan { objects: true, ..Plan::default() }.within(tier);
        let changes = run(&mut Governor::automatic(BUDGET_US), 0..500, |_, _| 20_000, &diffuse);
        assert_eq!(changes.iter().map(|change| change.1).collect::<Vec<_>>(), [3, 4]);
        // A view without objects has nothing to leave out.
        assert!(run(&mut Governor::automatic(BUDGET_US), 0..500, |_, _| 20_000, &|_| Plan::default()).is_empty());
    }

    #[test]
    fn a_step_up_that_fails_is_tried_ever_more_rarely() {
        // The scene becomes another one whenever a tier is left, so that nothing is known of what that would cost by now.
        let mut governor = Governor::automatic(BUDGET_US);
        let other = std::cell::Cell::new(false);
        let restless = |tier: Tier| Plan { ground_hides: other.get(), ..full(tier) };
        let mut ups = Vec::new();
        for i in 0..30_000_u64 {
            let before = governor.tier();
            let cost_us = if before == Tier::FULL { 12_000 } else { 8_000 };
            match governor.observe(ClientTime(i * u64::from(BUDGET_US)), cost_us, &restless) {
                Some(tier) if tier < before => ups.push(i),
                Some(_) => other.set(!other.get()),
                None => {}
            }
        }
        let waits: Vec<u64> = ups.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(waits.len() >= 4 && waits.windows(2).take(4).all(|pair| pair[1] as f32 > 1.6 * pair[0] as f32), "{waits:?}");
    }

    #[test]
    fn the_lowest_tier_keeps_what_a_scene_needs() {
        for number in 0..=Tier::LOWEST.number() {
            let limits = Tier::new(number).unwrap().limits();
            assert!((1..=MAX_SHADOWS).contains(&limits.shadows) && limits.reflections_every >= 1 && matches!(limits.samples, 1 | 4));
        }
        assert_eq!(Tier::new(5), None);
        let lowest = full(Tier::LOWEST);
        assert!(lowest.objects && lowest.reflections && lowest.shadows == 1);
    }

    proptest! {
        #[test]
        fn a_constant_load_never_goes_back_and_forth(
            costs in proptest::array::uniform5(2_000_u64..30_000), noise in proptest::collection::vec(0.9..1.1f64, 97),
            every in 1..6u64, peak in 1.0..3.0f64,
        ) {
            let mut costs = costs;
            costs.sort_unstable_by(|a, b| b.cmp(a));
            // Every so manieth frame costs more, as those do that a picture comes with.
            let peak = |frame: u64| if frame.is_multiple_of(every) { peak } else { 1.0 };
            let cost = |tier: u8, frame: u64| (costs[usize::from(tier)] as f64 * noise[(frame % 97) as usize] * peak(frame)) as u64;
            let changes = run(&mut Governor::automatic(BUDGET_US), 0..20_000, cost, &full);
            prop_assert!(changes.windows(2).all(|pair| pair[1].1 > pair[0].1), "{:?}", changes);
        }
    }
}
