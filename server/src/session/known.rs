//! What the session knows of each user: which wishes are old, and how much is left of what one user may do.

use std::collections::{BTreeSet, HashMap};
use std::time::{Duration, Instant};

use mr360_protocol::intent::{Action, Intent, PUT_BURST, Rate};
use mr360_protocol::scene::{MAX_USERS, ObjectId};

use super::Refusal;

/// A user who left is remembered for this long: what is delivered again after a reconnect is then known as old.
pub(super) const REMEMBERED: Duration = Duration::from_secs(30);
/// So many of a user's last puts are told from new ones; more never overtake each other.
const LAST_PUTS: usize = 64;

/// All users, those who left a moment ago included.
#[derive(Debug, Default)]
pub(super) struct Users(HashMap<String, Known>);

/// One user.
#[derive(Debug, Default)]
struct Known {
    /// Highest sequence number of each object that is there.
    of_objects: HashMap<ObjectId, u64>,
    puts: Puts,
    rate: Rate,
    left: Option<Instant>,
}

/// Sequence numbers of what was put: each counts once, in whatever order they come (a window as of RFC 4303, section 3.4.3).
#[derive(Debug, Default)]
struct Puts {
    seen: BTreeSet<u64>,
    /// All up to here are old.
    floor: u64,
}

impl Puts {
    fn is_new(&self, sequence: u64) -> bool {
        sequence > self.floor && !self.seen.contains(&sequence)
    }

    fn insert(&mut self, sequence: u64) {
        self.seen.insert(sequence);
        while self.seen.len() > LAST_PUTS {
            self.floor = self.seen.pop_first().unwrap_or(self.floor);
        }
    }
}

impl Users {
    /// Drags are streams of their own and may overtake each other: a wish is old by what was wished for its own object.
    ///
    /// # Errors
    /// [`Refusal::Stale`].
    pub(super) fn ensure_new(&self, user: &str, intent: &Intent) -> Result<(), Refusal> {
        let Some(known) = self.0.get(user) else { return Ok(()) };
        let new = match intent.action.object() {
            Some(object) => known.of_objects.get(&object).is_none_or(|last| intent.sequence > *last),
            None => known.puts.is_new(intent.sequence),
        };
        if new { Ok(()) } else { Err(Refusal::Stale) }
    }

    /// A wish that was granted.
    pub(super) fn granted(&mut self, user: &str, intent: &Intent) {
        let known = self.0.entry(user.to_owned()).or_default();
        known.left = None;
        match intent.action {
            Action::Remove(_) => {}
            Action::Put { .. } => known.puts.insert(intent.sequence),
            Action::Grab(object) | Action::Move(object, _) | Action::Release(object, _) => {
                known.of_objects.insert(object, intent.sequence);
            }
        }
    }

    /// A user is about to put or to remove something, `now_us` after the session's beginning.
    ///
    /// # Errors
    /// [`Refusal::TooFast`].
    pub(super) fn take(&mut self, user: &str, now_us: u64) -> Result<(), Refusal> {
        let free = self.0.entry(user.to_owned()).or_default().rate.take(now_us, PUT_BURST);
        if free { Ok(()) } else { Err(Refusal::TooFast) }
    }

    /// An object is gone, and its id is never given again.
    pub(super) fn forget(&mut self, object: ObjectId) {
        for known in self.0.values_mut() {
            known.of_objects.remove(&object);
        }
    }

    /// A user leaves at `now`. They are remembered for half a minute, so that none of their old intents counts when it is delivered again.
    pub(super) fn leave(&mut self, user: &str, now: Instant) {
        self.0.retain(|_, known| known.left.is_none_or(|left| now.saturating_duration_since(left) < REMEMBERED));
        if self.0.len() > 2 * MAX_USERS {
            // More come and go than can be remembered: those who are here count.
            self.0.retain(|_, known| known.left.is_none());
        }
        if let Some(known) = self.0.get_mut(user) {
            known.left = Some(now);
        }
    }

    #[cfg(test)]
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}
