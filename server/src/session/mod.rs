//! The shared session: users publish intents, the server alone changes the scene, and moves what nobody holds.

#[cfg(test)]
mod tests;
mod users;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Bound;
use std::time::{Duration, Instant};

use mr360_protocol::intent::{Action, Intent, Motion};
use mr360_protocol::scene::{
    Change, LibraryItem, MAX_CHANGES, MAX_OBJECTS, MAX_USERS, Object, ObjectId, Playback, Scene, SceneMessage, Transform,
};
use tokio::sync::mpsc;

use crate::broadcast::SceneTrack;
use crate::ingest::ServerClock;
use crate::physics::{Forms, Physics, STEP_S};
use users::{Event, follow_users};

/// Intents waiting to be merged, over all users; a user who sends more than is read waits.
const INTENT_QUEUE: usize = 1024;
/// A user who left is remembered for this long: what is delivered again after a reconnect is then known as old.
const REMEMBERED: Duration = Duration::from_secs(30);

/// What a session begins with.
#[derive(Debug, Default)]
pub struct Opening {
    /// As its author wrote it.
    pub scene: Scene,
    /// Objects that stay where they are put.
    pub fixed_objects: BTreeSet<ObjectId>,
    /// Items of the library that do, by index.
    pub fixed_items: BTreeSet<u16>,
    /// What they are to physics.
    pub forms: Forms,
}

/// Who holds what, and the scene itself. No I/O and no clock but the ticks: [`run`] feeds it.
pub struct Session {
    /// As the viewers have it.
    scene: Scene,
    /// As it is. What is not published yet differs from `scene`.
    objects: BTreeMap<ObjectId, Object>,
    physics: Physics,
    fixed_items: BTreeSet<u16>,
    /// Of the next object that is put; never given twice, so that a late wish meets no stranger.
    next_id: u32,
    /// The user who moves an object, as long as they hold it.
    holders: HashMap<ObjectId, String>,
    /// Highest sequence number seen of each user, and when the user left.
    sequences: HashMap<String, (u64, Option<Instant>)>,
    /// To publish with the next deltas.
    unpublished: BTreeMap<ObjectId, Unpublished>,
    /// The last object that was published: where more moves than one delta holds, all have their turn.
    published: ObjectId,
}

/// What viewers do not know of an object yet.
enum Unpublished {
    /// That it is there.
    Put,
    /// Where it is.
    Moved,
    /// That it is gone.
    Removed,
}

/// Why an intent changed nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// Overtaken by a later one of the same user.
    #[error("came late")]
    Stale,
    /// No such object.
    #[error("object {} does not exist", .0.0)]
    NoSuchObject(ObjectId),
    /// No such item.
    #[error("the library has no item {0}")]
    NoSuchItem(u16),
    /// No room for another object.
    #[error("a scene holds at most {MAX_OBJECTS} objects; remove some first")]
    Full,
    /// Another user has it.
    #[error("object {} is held by {holder}", .object.0)]
    Held {
        /// The object.
        object: ObjectId,
        /// Who holds it.
        holder: String,
    },
}

impl Session {
    /// A session over this scene.
    #[must_use]
    pub fn new(opening: Opening) -> Self {
        let Opening { scene, fixed_objects, fixed_items, forms } = opening;
        Self {
            physics: Physics::new(&scene, |id| fixed_objects.contains(&id), forms),
            objects: scene.objects.iter().map(|object| (object.id, object.clone())).collect(),
            next_id: scene.objects.last().map_or(1, |last| last.id.0.saturating_add(1)),
            scene,
            fixed_items,
            holders: HashMap::new(),
            sequences: HashMap::new(),
            unpublished: BTreeMap::new(),
            published: ObjectId(0),
        }
    }

    /// The scene as the viewers have it.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Takes in what a user wishes for. A move takes hold of an object that nobody holds.
    ///
    /// # Errors
    /// [`Refusal`], and nothing has changed.
    pub fn intent(&mut self, user: &str, intent: &Intent) -> Result<(), Refusal> {
        if self.sequences.get(user).is_some_and(|(last, _)| intent.sequence <= *last) {
            return Err(Refusal::Stale);
        }
        match &intent.action {
            Action::Put { item, transform } => self.put(*item, *transform)?,
            Action::Grab(object) => self.take_hold(user, *object)?,
            Action::Move(object, transform) => {
                self.take_hold(user, *object)?;
                self.physics.move_to(*object, *transform);
                self.moved(*object, *transform);
            }
            Action::Release(object, motion) => {
                self.ensure_free_for(user, *object)?;
                self.let_go(*object, *motion);
            }
            Action::Remove(object) => {
                self.ensure_free_for(user, *object)?;
                self.remove(*object);
            }
        }
        self.sequences.insert(user.to_owned(), (intent.sequence, None));
        Ok(())
    }

    fn ensure_free_for(&self, user: &str, object: ObjectId) -> Result<(), Refusal> {
        if !self.objects.contains_key(&object) {
            return Err(Refusal::NoSuchObject(object));
        }
        match self.holders.get(&object).filter(|holder| *holder != user) {
            Some(holder) => Err(Refusal::Held { object, holder: holder.clone() }),
            None => Ok(()),
        }
    }

    fn take_hold(&mut self, user: &str, object: ObjectId) -> Result<(), Refusal> {
        self.ensure_free_for(user, object)?;
        if self.holders.insert(object, user.to_owned()).is_none() {
            self.physics.hold(object);
        }
        Ok(())
    }

    fn let_go(&mut self, object: ObjectId, motion: Motion) {
        if self.holders.remove(&object).is_some() {
            self.physics.release(object, motion);
        }
    }

    fn put(&mut self, item: u16, transform: Transform) -> Result<(), Refusal> {
        let LibraryItem { geometry, material, .. } = self.scene.library.get(usize::from(item)).ok_or(Refusal::NoSuchItem(item))?.clone();
        // The highest number is given to nobody, so that the next is never the first again.
        if self.objects.len() >= MAX_OBJECTS || self.next_id == u32::MAX {
            return Err(Refusal::Full);
        }
        let object = Object { id: ObjectId(self.next_id), geometry, transform, material, animation: Playback::First };
        self.next_id += 1;
        self.physics.add(&object, self.fixed_items.contains(&item));
        self.unpublished.insert(object.id, Unpublished::Put);
        self.objects.insert(object.id, object);
        Ok(())
    }

    fn remove(&mut self, object: ObjectId) {
        self.holders.remove(&object);
        self.physics.remove(object);
        self.objects.remove(&object);
        // Of one that was never published nobody needs to know.
        match self.unpublished.remove(&object) {
            Some(Unpublished::Put) => {}
            _ => drop(self.unpublished.insert(object, Unpublished::Removed)),
        }
    }

    fn moved(&mut self, object: ObjectId, transform: Transform) {
        if let Some(known) = self.objects.get_mut(&object) {
            known.transform = transform;
            self.unpublished.entry(object).or_insert(Unpublished::Moved);
        }
    }

    /// Lets go of what a user held who leaves at `now`. Their sequence number is kept for half a minute, so that none of their old intents
    /// counts when it is delivered again.
    pub fn leave(&mut self, user: &str, now: Instant) {
        self.sequences.retain(|_, (_, left)| left.is_none_or(|left| now.saturating_duration_since(left) < REMEMBERED));
        if self.sequences.len() > 2 * MAX_USERS {
            // More come and go than can be remembered: those who are here count.
            self.sequences.retain(|_, (_, left)| left.is_none());
        }
        if let Some((_, left)) = self.sequences.get_mut(user) {
            *left = Some(now);
        }
        let mut held: Vec<_> = self.holders.iter().filter(|(_, holder)| *holder == user).map(|(object, _)| *object).collect();
        held.sort_unstable();
        for object in held {
            self.let_go(object, Motion::STILL);
        }
    }

    /// Nothing moves, and all is published: nothing changes any more before somebody wishes for something.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        self.physics.at_rest() && self.unpublished.is_empty()
    }

    /// Moves what moves by itself on by one step, and returns what has changed since the last tick, at most [`MAX_CHANGES`] at a time:
    /// of each object the last place alone, so that a flood of intents costs no more than a trickle.
    pub fn tick(&mut self) -> Option<Vec<Change>> {
        for (object, transform) in self.physics.step() {
            self.moved(object, transform);
        }
        let after = (Bound::Excluded(self.published), Bound::Unbounded);
        let in_turn: Vec<_> = (self.unpublished.range(after).chain(self.unpublished.range(..=self.published)))
            .map(|(object, _)| *object)
            .take(MAX_CHANGES)
            .collect();
        self.published = *in_turn.last()?;
        let change = |object: ObjectId| match (self.unpublished.remove(&object)?, self.objects.get(&object)) {
            (Unpublished::Put, Some(known)) => Some(Change::Put(known.clone())),
            (Unpublished::Moved, Some(known)) => Some(Change::Move(object, known.transform)),
            _ => Some(Change::Remove(object)),
        };
        let changes: Vec<_> = in_turn.into_iter().filter_map(change).collect();
        let delta = SceneMessage::Delta { revision: self.scene.revision + 1, at_us: 0, changes: changes.clone() };
        match self.scene.apply(&delta) {
            Ok(()) => Some(changes),
            Err(error) => {
                // Intents are checked against the scene before they gather, so this is a fault of ours.
                tracing::error!(%error, "gathered changes do not fit the scene");
                None
            }
        }
    }
}

/// Runs the session until the origin closes: publishes the scene, follows users as they come and go.
pub async fn run(opening: Opening, mut track: SceneTrack, origin: moq_net::origin::Consumer, room: String, clock: ServerClock) {
    let mut session = Session::new(opening);
    if let Err(error) = track.publish(session.scene(), Vec::new(), clock.now()) {
        tracing::error!(%error, "the scene cannot be published");
        return;
    }
    let (sender, mut events) = mpsc::channel(INTENT_QUEUE);
    let users = tokio::spawn(follow_users(origin, room, sender));
    let mut tick = tokio::time::interval(Duration::from_secs_f32(STEP_S));
    // A late step does not make the next one late, too: what falls keeps its pace.
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            event = events.recv() => match event {
                Some(Event::Intent(user, intent)) => {
                    if let Err(refusal) = session.intent(&user, &intent) {
                        tracing::debug!(user, %refusal, "intent refused");
                    }
                }
                Some(Event::Left(user)) => {
                    tracing::info!(user, "user left the session");
                    session.leave(&user, Instant::now());
                }
                None => break,
            },
            _ = tick.tick() => if let Some(changes) = session.tick()
                && let Err(error) = track.publish(session.scene(), changes, clock.now())
            {
                tracing::error!(%error, "a scene update was not published");
            },
        }
    }
    users.abort();
}
