//! What users wish for. The server decides.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::codec::{Message, WireError, ensure_in_range};
use crate::scene::{MAX_LIBRARY, MAX_OBJECTS, ObjectId, Transform};

/// Nothing is thrown faster on any axis, metres a second: about what a hand can do, and what a fixed step can follow.
pub const MAX_SPEED_M_S: f32 = 20.0;
/// Nothing is let go of spinning faster about any axis, radians a second.
pub const MAX_SPIN_RAD_S: f32 = 40.0;

/// Most objects that one user holds at a time: two hands hold two, a script may want some more.
pub const MAX_HELD: usize = 8;
/// Most objects of a scene that one user has put there: an eighth of a full scene, so that nobody fills it alone.
pub const MAX_PUT: usize = MAX_OBJECTS / 8;
/// A user puts and removes so many objects at once, then as many again as time passes: more than fingers do.
pub const PUT_BURST: u32 = 32;
/// One more for each of these, microseconds.
pub const PUT_INTERVAL_US: u64 = 250_000;
/// A viewer says again what its user holds after so long, microseconds.
pub const HOLD_AGAIN_US: u64 = 1_000_000;
/// What nobody has said to be held for so long is let go of, microseconds: a release that was lost holds nothing for ever.
pub const HOLD_LOST_US: u64 = 10_000_000;

/// How often something may be done (the generic cell rate algorithm, ITU-T I.371, annex A).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Rate {
    /// When all that was done would have been due at an even pace, microseconds.
    due_us: u64,
}

impl Rate {
    /// Whether it may be done now, which then counts: up to `burst` times at once, and once every [`PUT_INTERVAL_US`].
    pub fn take(&mut self, now_us: u64, burst: u32) -> bool {
        let due = self.due_us.max(now_us);
        let free = due - now_us <= u64::from(burst.saturating_sub(1)) * PUT_INTERVAL_US;
        if free {
            self.due_us = due.saturating_add(PUT_INTERVAL_US);
        }
        free
    }
}

/// A user's wish; the server decides.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Intent {
    /// Rises with every intent of this user, also over a restart of their program (it begins at the time of day). Of those of one object a
    /// lower one that comes late is dropped, and what is put is put once.
    pub sequence: u64,
    /// What is wished for.
    pub action: Action,
}

/// What a user may wish for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Action {
    /// Take hold of an object: until released it follows this user alone.
    Grab(ObjectId),
    /// Put the object here, in this size.
    Move(ObjectId, Transform),
    /// Let go, in this motion.
    Release(ObjectId, Motion),
    /// Add an item of the library.
    Put {
        /// Its index in the library.
        item: u16,
        /// Where, and in which size.
        transform: Transform,
    },
    /// Take an object away.
    Remove(ObjectId),
}

/// How something moves.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Motion {
    /// Of its origin, metres a second in the world, each at most [`MAX_SPEED_M_S`].
    pub linear: Vec3,
    /// About its origin, radians a second along the world's axes, each at most [`MAX_SPIN_RAD_S`].
    pub angular: Vec3,
}

impl Motion {
    /// At rest.
    pub const STILL: Self = Self { linear: Vec3::ZERO, angular: Vec3::ZERO };

    /// The nearest motion within bounds; what is not finite is still.
    #[must_use]
    pub fn bounded(self) -> Self {
        let within = |v: Vec3, most: f32| if v.is_finite() { v.clamp(Vec3::splat(-most), Vec3::splat(most)) } else { Vec3::ZERO };
        Self { linear: within(self.linear, MAX_SPEED_M_S), angular: within(self.angular, MAX_SPIN_RAD_S) }
    }

    fn validate(&self, message: &'static str) -> Result<(), WireError> {
        let within = |v: Vec3, most: f32| v.is_finite() && v.abs().max_element() <= most;
        ensure_in_range(within(self.linear, MAX_SPEED_M_S), message, "linear", || format!("{}, within ±{MAX_SPEED_M_S} m/s", self.linear))?;
        ensure_in_range(within(self.angular, MAX_SPIN_RAD_S), message, "angular", || {
            format!("{}, within ±{MAX_SPIN_RAD_S} rad/s", self.angular)
        })
    }
}

impl Action {
    /// The object that it is about; none for one that is yet to be.
    #[must_use]
    pub fn object(&self) -> Option<ObjectId> {
        match self {
            Self::Grab(object) | Self::Move(object, _) | Self::Release(object, _) | Self::Remove(object) => Some(*object),
            Self::Put { .. } => None,
        }
    }
}

impl Message for Intent {
    const NAME: &'static str = "intent";
    /// 2: a release carries a motion; items of the library are put, objects removed.
    const VERSION: u8 = 2;

    fn validate(&self) -> Result<(), WireError> {
        match &self.action {
            Action::Move(_, transform) => transform.validate(Self::NAME),
            Action::Release(_, motion) => motion.validate(Self::NAME),
            Action::Put { item, transform } => {
                ensure_in_range(usize::from(*item) < MAX_LIBRARY, Self::NAME, "item", || format!("{item}, below {MAX_LIBRARY}"))?;
                transform.validate(Self::NAME)
            }
            Action::Grab(_) | Action::Remove(_) => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CUBE: ObjectId = ObjectId(1);

    #[test]
    fn a_rate_allows_a_burst_and_then_an_even_pace() {
        let mut rate = Rate::default();
        let burst = |rate: &mut Rate, now| (0..100).filter(|_| rate.take(now, PUT_BURST)).count();
        assert_eq!(burst(&mut rate, 5_000_000), PUT_BURST as usize);
        assert_eq!(burst(&mut rate, 5_000_000 + PUT_INTERVAL_US - 1), 0);
        assert_eq!(burst(&mut rate, 5_000_000 + 3 * PUT_INTERVAL_US), 3);
        assert_eq!(burst(&mut rate, 90_000_000), PUT_BURST as usize);
        assert!(!Rate { due_us: u64::MAX }.take(0, PUT_BURST));
    }

    #[test]
    fn every_range_is_guarded() {
        let refused = |action| Intent { sequence: 1, action }.to_wire().unwrap_err().to_string();
        let far = Transform { position: Vec3::splat(f32::NAN), ..Transform::default() };
        assert!(refused(Action::Move(CUBE, far)).contains("position"));
        assert!(refused(Action::Put { item: 0, transform: far }).contains("position"));
        assert!(refused(Action::Put { item: MAX_LIBRARY as u16, transform: Transform::default() }).contains("item"));
        for linear in [Vec3::X * (MAX_SPEED_M_S * 1.01), Vec3::Y * f32::NAN, Vec3::Z * f32::NEG_INFINITY] {
            assert!(refused(Action::Release(CUBE, Motion { linear, ..Motion::STILL })).contains("linear"));
        }
        let spin = Vec3::Y * (MAX_SPIN_RAD_S * 1.01);
        assert!(refused(Action::Release(CUBE, Motion { angular: spin, ..Motion::STILL })).contains("angular"));
    }

    #[test]
    fn what_is_bounded_is_not_refused() {
        let wild = Motion { linear: Vec3::new(1e9, -1e9, 1.0), angular: Vec3::new(f32::NAN, 0.0, 0.0) };
        let bounded = wild.bounded();
        assert_eq!(bounded, Motion { linear: Vec3::new(MAX_SPEED_M_S, -MAX_SPEED_M_S, 1.0), angular: Vec3::ZERO });
        let intent = Intent { sequence: 1, action: Action::Release(CUBE, bounded) };
        assert_eq!(Intent::from_wire(&intent.to_wire().unwrap()).unwrap(), intent);
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(mut bytes in proptest::collection::vec(any::<u8>(), 1..400)) {
            bytes[0] = Intent::VERSION;
            let _ = Intent::from_wire(&bytes);
        }
    }
}
