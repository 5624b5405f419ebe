//! The shared session: users publish intents, the server alone changes the scene, and moves what nobody holds.

mod known;
mod pace;
#[cfg(test)]
mod tests;
mod users;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Bound;
use std::time::{Duration, Instant};

use mr360_protocol::intent::{Action, HOLD_LOST_US, Intent, MAX_HELD, MAX_PUT, Motion, PUT_BURST, PUT_INTERVAL_US};
use mr360_protocol::scene::{
    Change, FIRST_LOCAL_ID, LibraryItem, MAX_CHANGES, MAX_OBJECTS, Object, ObjectId, Playback, Scene, SceneMessage, Transform,
};
use tokio::sync::mpsc;

use crate::broadcast::SceneTrack;
use crate::ingest::ServerClock;
use crate::physics::{Forms, Physics, STEP_S};
use known::Users;
use pace::Pace;
use users::{Event, follow_users};

/// Intents waiting to be merged, over all users; a user who sends more than is read waits.
const INTENT_QUEUE: usize = 1024;
/// A step's length, microseconds: the session knows no other time.
const STEP_US: u64 = (STEP_S * 1e6) as u64;

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
    /// Who moves an object, as long as they hold it.
    holders: HashMap<ObjectId, Holder>,
    /// Who put an object that was not there from the beginning.
    put_by: HashMap<ObjectId, String>,
    users: Users,
    /// Steps since the beginning.
    ticks: u64,
    /// To publish with the next deltas.
    unpublished: BTreeMap<ObjectId, Unpublished>,
    /// The last object that was published: where more moves than one delta holds, all have their turn.
    published: ObjectId,
}

/// A user with an object in hand.
struct Holder {
    user: String,
    /// When they last wished for something with it, microseconds.
    heard_us: u64,
}

/// What viewers do not know of an object yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
    /// Overtaken by a later one of the same user and object, or heard already.
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
    /// The user's hands are full.
    #[error("a user holds at most {MAX_HELD} objects; let go of one first")]
    TooManyHeld,
    /// The user has put enough.
    #[error("a user has at most {MAX_PUT} objects in a scene; remove some first")]
    TooManyPut,
    /// The user puts and removes too fast.
    #[error("a user puts and removes {PUT_BURST} objects at once and one more every {} ms; wait", PUT_INTERVAL_US / 1_000)]
    TooFast,
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
            put_by: HashMap::new(),
            users: Users::default(),
            ticks: 0,
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
        self.users.ensure_new(user, intent)?;
        match &intent.action {
            Action::Put { item, transform } => self.put(user, *item, *transform)?,
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
                self.users.take(user, self.now_us())?;
                self.remove(*object);
            }
        }
        self.users.granted(user, intent);
        Ok(())
    }

    /// Since the session's beginning, by its steps.
    fn now_us(&self) -> u64 {
        self.ticks.saturating_mul(STEP_US)
    }

    fn ensure_free_for(&self, user: &str, object: ObjectId) -> Result<(), Refusal> {
        if !self.objects.contains_key(&object) {
            return Err(Refusal::NoSuchObject(object));
        }
        match self.holders.get(&object).filter(|holder| holder.user != user) {
            Some(holder) => Err(Refusal::Held { object, holder: holder.user.clone() }),
            None => Ok(()),
        }
    }

    fn take_hold(&mut self, user: &str, object: ObjectId) -> Result<(), Refusal> {
        self.ensure_free_for(user, object)?;
        let heard_us = self.now_us();
        if let Some(holder) = self.holders.get_mut(&object) {
            holder.heard_us = heard_us;
            return Ok(());
        }
        if self.holders.values().filter(|holder| holder.user == user).count() >= MAX_HELD {
            return Err(Refusal::TooManyHeld);
        }
        self.holders.insert(object, Holder { user: user.to_owned(), heard_us });
        self.physics.hold(object);
        Ok(())
    }

    fn let_go(&mut self, object: ObjectId, motion: Motion) {
        if self.holders.remove(&object).is_some() {
            self.physics.release(object, motion);
        }
    }

    /// Lets go of all that is held so, in order.
    fn let_go_where(&mut self, lost: impl Fn(&Holder) -> bool) {
        let mut objects: Vec<_> = self.holders.iter().filter(|(_, holder)| lost(holder)).map(|(object, _)| *object).collect();
        objects.sort_unstable();
        for object in objects {
            self.let_go(object, Motion::STILL);
        }
    }

    fn put(&mut self, user: &str, item: u16, transform: Transform) -> Result<(), Refusal> {
        let LibraryItem { geometry, material, .. } = self.scene.library.get(usize::from(item)).ok_or(Refusal::NoSuchItem(item))?.clone();
        if self.objects.len() >= MAX_OBJECTS || self.next_id >= FIRST_LOCAL_ID {
            return Err(Refusal::Full);
        }
        if self.put_by.values().filter(|by| *by == user).count() >= MAX_PUT {
            return Err(Refusal::TooManyPut);
        }
        self.users.take(user, self.now_us())?;
        let object = Object { id: ObjectId(self.next_id), geometry, transform, material, animation: Playback::First };
        self.next_id += 1;
        self.physics.add(&object, self.fixed_items.contains(&item));
        self.put_by.insert(object.id, user.to_owned());
        self.unpublished.insert(object.id, Unpublished::Put);
        self.objects.insert(object.id, object);
        Ok(())
    }

    fn remove(&mut self, object: ObjectId) {
        self.holders.remove(&object);
        self.put_by.remove(&object);
        self.users.forget(object);
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

    /// Lets go of what a user held who leaves at `now`.
    pub fn leave(&mut self, user: &str, now: Instant) {
        self.users.leave(user, now);
        self.let_go_where(|holder| holder.user == user);
    }

    /// Nothing moves, and all is published: nothing changes any more before somebody wishes for something.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        self.physics.at_rest() && self.unpublished.is_empty()
    }

    /// Moves what moves by itself on by one step, and returns what has changed since the last tick, at most [`MAX_CHANGES`] at a time:
    /// of each object the last place alone, so that a flood of intents costs no more than a trickle.
    pub fn tick(&mut self) -> Option<Vec<Change>> {
        self.ticks += 1;
        let now_us = self.now_us();
        self.let_go_where(|holder| now_us - holder.heard_us > HOLD_LOST_US);
        for (object, transform) in self.physics.step() {
            self.moved(object, transform);
        }
        let in_turn = self.in_turn();
        if in_turn.is_empty() {
            return None;
        }
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
                tracing::error!(%error, "gathered changes do not fit the scene; gathering them anew");
                self.compare();
                None
            }
        }
    }

    /// The objects whose changes are due, at most [`MAX_CHANGES`]. What is removed comes first, and nothing else before all of that: what is
    /// put then finds room, since there are never more objects than a scene holds. The others have their turn.
    fn in_turn(&mut self) -> Vec<ObjectId> {
        let removed = |(object, change): (&ObjectId, &Unpublished)| (*change == Unpublished::Removed).then_some(*object);
        let others = |(object, change): (&ObjectId, &Unpublished)| (*change != Unpublished::Removed).then_some(*object);
        let mut in_turn: Vec<_> = self.unpublished.iter().filter_map(removed).take(MAX_CHANGES).collect();
        let after = (Bound::Excluded(self.published), Bound::Unbounded);
        let room = MAX_CHANGES - in_turn.len();
        let turn = self.unpublished.range(after).chain(self.unpublished.range(..=self.published)).filter_map(others).take(room);
        let turn: Vec<_> = turn.collect();
        self.published = turn.last().copied().unwrap_or(self.published);
        in_turn.extend(turn);
        in_turn
    }

    /// Gathers by what the published scene differs from the true one.
    fn compare(&mut self) {
        let gone = self.scene.objects.iter().filter(|known| !self.objects.contains_key(&known.id));
        let gone = gone.map(|known| (known.id, Unpublished::Removed)).collect::<BTreeMap<_, _>>();
        let differs = |object: &Object| match self.scene.object(object.id) {
            None => Some((object.id, Unpublished::Put)),
            Some(known) => (known.transform != object.transform).then_some((object.id, Unpublished::Moved)),
        };
        self.unpublished = self.objects.values().filter_map(differs).chain(gone).collect();
    }
}

/// Steps the session; on a thread of its own kind where that takes time, so that media never wait for it.
async fn step(mut session: Session) -> Result<(Session, Option<Vec<Change>>), tokio::task::JoinError> {
    if session.at_rest() {
        let changes = session.tick();
        return Ok((session, changes));
    }
    tokio::task::spawn_blocking(move || {
        let changes = session.tick();
        (session, changes)
    })
    .await
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
    // Begun before the ticks, so that each finds its step due.
    let mut pace = Pace::start(Instant::now());
    let mut tick = tokio::time::interval(Duration::from_secs_f32(STEP_S));
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    'session: loop {
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
            _ = tick.tick() => for at in pace.times(Instant::now(), clock.now()) {
                // Each step is of its own time, however late it is made.
                let changes;
                (session, changes) = match step(session).await {
                    Ok(stepped) => stepped,
                    Err(error) => {
                        tracing::error!(%error, "the session's physics ended; the scene stays as it is, report this");
                        break 'session;
                    }
                };
                if let Some(changes) = changes
                    && let Err(error) = track.publish(session.scene(), changes, at)
                {
                    tracing::error!(%error, "a scene update was not published");
                }
            },
        }
    }
    users.abort();
}
