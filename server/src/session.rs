//! The shared session: users publish intents, the server alone changes the scene.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use mr360_protocol::codec::Message;
use mr360_protocol::scene::{Action, Change, Intent, MAX_CHANGES, MAX_NAME_CHARS, MAX_USERS, ObjectId, Scene, SceneMessage, Transform};
use mr360_protocol::track;
use tokio::sync::mpsc;

use crate::broadcast::SceneTrack;

/// Changes are gathered for this long and published as one delta, the last place of each object alone:
/// at 60 Hz nobody sees the difference, and a flood of intents costs no more than a trickle.
const TICK: Duration = Duration::from_micros(16_667);
/// Intents waiting to be merged, over all users; a user who sends more than is read waits.
const INTENT_QUEUE: usize = 1024;

/// A user who left is remembered for this long: what is delivered again after a reconnect is then known as old.
const REMEMBERED: Duration = Duration::from_secs(30);
/// Before a user whose intents ended, though the user did not leave, is read anew.
const READ_AGAIN: Duration = Duration::from_millis(100);

/// Who holds what, and the scene itself. No I/O: [`run`] feeds it.
#[derive(Debug)]
pub struct Session {
    scene: Scene,
    /// The user who moves an object, as long as they hold it.
    holders: HashMap<ObjectId, String>,
    /// Highest sequence number seen of each user, and when the user left.
    sequences: HashMap<String, (u64, Option<Instant>)>,
    /// Places to publish with the next delta.
    moved: BTreeMap<ObjectId, Transform>,
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
    pub fn new(scene: Scene) -> Self {
        Self { scene, holders: HashMap::new(), sequences: HashMap::new(), moved: BTreeMap::new() }
    }

    /// The scene as it stands.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Takes in what a user wishes for. A move takes hold of an object that nobody holds.
    ///
    /// # Errors
    /// [`Refusal`], and nothing has changed.
    pub fn intent(&mut self, user: &str, intent: &Intent) -> Result<(), Refusal> {
        let (Action::Grab(object) | Action::Move(object, _) | Action::Release(object)) = intent.action;
        if self.sequences.get(user).is_some_and(|(last, _)| intent.sequence <= *last) {
            return Err(Refusal::Stale);
        }
        if self.scene.object(object).is_none() {
            return Err(Refusal::NoSuchObject(object));
        }
        if let Some(holder) = self.holders.get(&object).filter(|holder| *holder != user) {
            return Err(Refusal::Held { object, holder: holder.clone() });
        }
        self.sequences.insert(user.to_owned(), (intent.sequence, None));
        match &intent.action {
            Action::Grab(_) => drop(self.holders.insert(object, user.to_owned())),
            Action::Release(_) => drop(self.holders.remove(&object)),
            Action::Move(_, transform) => {
                self.holders.insert(object, user.to_owned());
                self.moved.insert(object, *transform);
            }
        }
        Ok(())
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
        self.holders.retain(|_, holder| holder != user);
    }

    /// Applies what has gathered and returns it, at most [`MAX_CHANGES`] at a time.
    pub fn tick(&mut self) -> Option<Vec<Change>> {
        let mut changes = Vec::new();
        while let Some((object, transform)) = (changes.len() < MAX_CHANGES).then(|| self.moved.pop_first()).flatten() {
            changes.push(Change::Move(object, transform));
        }
        if changes.is_empty() {
            return None;
        }
        let delta = SceneMessage::Delta { revision: self.scene.revision + 1, changes: changes.clone() };
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

enum Event {
    Intent(String, Intent),
    Left(String),
}

/// Runs the session until the origin closes: publishes the scene, follows users as they come and go.
pub async fn run(scene: Scene, mut track: SceneTrack, origin: moq_net::origin::Consumer, room: String) {
    let mut session = Session::new(scene);
    if let Err(error) = track.publish(session.scene(), Vec::new()) {
        tracing::error!(%error, "the scene cannot be published");
        return;
    }
    let (sender, mut events) = mpsc::channel(INTENT_QUEUE);
    let users = tokio::spawn(follow_users(origin, room, sender));
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
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
                && let Err(error) = track.publish(session.scene(), changes)
            {
                tracing::error!(%error, "a scene update was not published");
            },
        }
    }
    users.abort();
}

async fn follow_users(origin: moq_net::origin::Consumer, room: String, events: mpsc::Sender<Event>) {
    let prefix = track::user_path(&room, "");
    let mut users: HashMap<String, tokio::task::JoinHandle<()>> = HashMap::new();
    let mut announced = origin.announced();
    while let Some(update) = announced.next().await {
        let path = update.prefix.to_string();
        let Some(user) = path.strip_prefix(&prefix).filter(|user| is_valid_user(user)).map(str::to_owned) else { continue };
        if !update.kind.is_active() {
            if let Some(reader) = users.remove(&user) {
                reader.abort();
                // Until it has ended it may still hand on an intent, which would take hold of an object for a user who is gone.
                let _ = reader.await;
                // The session has ended with its receiver; so does this loop at the next announcement.
                let _ = events.send(Event::Left(user)).await;
            }
            continue;
        }
        if users.contains_key(&user) {
            // The same viewer on a new connection, or another one under the same name: its reader goes on with whoever is left.
            tracing::info!(user, "announced again; one connection of a name is heard at a time");
            continue;
        }
        if users.len() >= MAX_USERS {
            tracing::warn!(user, "refused: a session holds at most {MAX_USERS} users");
            continue;
        }
        tracing::info!(user, "user joined the session");
        let (origin, events, name) = (origin.clone(), events.clone(), user.clone());
        users.insert(
            user,
            tokio::spawn(async move {
                // A connection that is replaced by another one of the same name ends the track, but the user is still announced.
                while !events.is_closed() {
                    match read_intents(&origin, &path, &name, &events).await {
                        Ok(()) => tracing::debug!(user = name, "the user's intents ended; reading them anew"),
                        Err(error) => tracing::debug!(user = name, %error, "the user's intents broke off; reading them anew"),
                    }
                    tokio::time::sleep(READ_AGAIN).await;
                }
            }),
        );
    }
}

async fn read_intents(
    origin: &moq_net::origin::Consumer,
    path: &str,
    user: &str,
    events: &mpsc::Sender<Event>,
) -> Result<(), moq_net::Error> {
    let broadcast = origin.request_broadcast(path).await?;
    let mut track = broadcast.track(track::INTENT)?.subscribe(track::intent_subscription()).await?;
    while let Some(mut group) = track.recv_group().await? {
        while let Some(frame) = group.read_frame().await? {
            match Intent::from_wire(&frame.payload) {
                Ok(intent) => {
                    if events.send(Event::Intent(user.to_owned(), intent)).await.is_err() {
                        return Ok(());
                    }
                }
                Err(error) => tracing::warn!(user, %error, "intent dropped"),
            }
        }
    }
    Ok(())
}

fn is_valid_user(user: &str) -> bool {
    (1..=MAX_NAME_CHARS).contains(&user.len()) && user.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use mr360_protocol::scene::{Geometry, Object, Shape};

    fn session() -> Session {
        let object = |id| Object {
            id: ObjectId(id),
            geometry: Geometry::Shape(Shape::Cube),
            transform: Transform::default(),
            material: None,
            animation: Default::default(),
        };
        Session::new(Scene { objects: vec![object(1), object(2)], ..Scene::default() })
    }

    fn to(x: f32) -> Transform {
        Transform { position: Vec3::X * x, ..Transform::default() }
    }

    #[test]
    fn the_last_place_of_each_object_is_published() {
        let mut session = session();
        for (sequence, x) in [(1, 1.0), (2, 2.0), (3, 3.0)] {
            session.intent("ann", &Intent { sequence, action: Action::Move(ObjectId(1), to(x)) }).unwrap();
        }
        session.intent("bob", &Intent { sequence: 1, action: Action::Move(ObjectId(2), to(9.0)) }).unwrap();
        assert_eq!(session.tick(), Some(vec![Change::Move(ObjectId(1), to(3.0)), Change::Move(ObjectId(2), to(9.0))]));
        assert_eq!(session.tick(), None);
        assert_eq!((session.scene().revision, session.scene().objects[0].transform), (1, to(3.0)));
    }

    #[test]
    fn a_held_object_follows_its_holder_alone() {
        let mut session = session();
        session.intent("ann", &Intent { sequence: 1, action: Action::Grab(ObjectId(1)) }).unwrap();
        let steal = Intent { sequence: 1, action: Action::Move(ObjectId(1), to(5.0)) };
        assert_eq!(session.intent("bob", &steal), Err(Refusal::Held { object: ObjectId(1), holder: "ann".to_owned() }));
        session.leave("ann", Instant::now());
        session.intent("bob", &steal).unwrap();
        assert_eq!(session.tick(), Some(vec![Change::Move(ObjectId(1), to(5.0))]));
    }

    #[test]
    fn late_and_unknown_intents_change_nothing() {
        let mut session = session();
        session.intent("ann", &Intent { sequence: 5, action: Action::Move(ObjectId(1), to(1.0)) }).unwrap();
        assert_eq!(session.intent("ann", &Intent { sequence: 5, action: Action::Release(ObjectId(1)) }), Err(Refusal::Stale));
        let unknown = Intent { sequence: 6, action: Action::Grab(ObjectId(7)) };
        assert_eq!(session.intent("ann", &unknown), Err(Refusal::NoSuchObject(ObjectId(7))));
    }

    #[test]
    fn what_is_delivered_again_after_a_reconnect_is_old() {
        let mut session = session();
        let now = Instant::now();
        let drag = Intent { sequence: 7, action: Action::Move(ObjectId(1), to(1.0)) };
        session.intent("ann", &drag).unwrap();
        session.leave("ann", now);
        assert_eq!(session.intent("ann", &drag), Err(Refusal::Stale));
        session.intent("ann", &Intent { sequence: 8, action: Action::Release(ObjectId(1)) }).unwrap();
        session.leave("ann", now);
        session.leave("bob", now + REMEMBERED);
        assert!(session.sequences.is_empty(), "users who left are not remembered for ever");
    }

    /// A user's broadcast with one intent on it.
    fn publish(origin: &moq_net::origin::Producer, sequence: u64, x: f32) -> (moq_net::broadcast::Producer, moq_net::track::Producer) {
        let broadcast = origin.create_broadcast(track::user_path("live", "bob")).unwrap();
        let mut intents = broadcast.create_track(track::INTENT, track::scene_info()).unwrap();
        broadcast.announce(moq_net::origin::Route::default()).unwrap();
        let intent = Intent { sequence, action: Action::Move(ObjectId(1), to(x)) };
        intents.write_frame(moq_net::Timestamp::now(), intent.to_wire().unwrap()).unwrap();
        (broadcast, intents)
    }

    async fn sequence(events: &mut mpsc::Receiver<Event>) -> u64 {
        loop {
            match events.recv().await.unwrap() {
                Event::Intent(_, intent) => return intent.sequence,
                Event::Left(_) => {}
            }
        }
    }

    #[tokio::test]
    async fn a_user_is_heard_after_an_overlapping_reconnect() {
        let origin = mr360_protocol::transport::origin();
        let (sender, mut events) = mpsc::channel(16);
        let following = tokio::spawn(follow_users(origin.consume(), "live".to_owned(), sender));
        let first = publish(&origin, 1, 1.0);
        assert_eq!(sequence(&mut events).await, 1);
        let second = publish(&origin, 2, 2.0);
        drop(first);
        assert_eq!(sequence(&mut events).await, 2);
        drop(second);
        while !matches!(events.recv().await.unwrap(), Event::Left(user) if user == "bob") {}
        following.abort();
    }
}
