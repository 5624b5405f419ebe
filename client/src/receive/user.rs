//! This user's own broadcast: wishes for the scene.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use mr360_protocol::codec::Message;
use mr360_protocol::intent::{Action, HOLD_AGAIN_US, Intent};
use mr360_protocol::scene::{MAX_OBJECTS, ObjectId};
use mr360_protocol::track;
use tokio::sync::{mpsc, watch};

/// A group holds this many intents at most, far below the transport's 8192 frames; a drag that is longer goes on in the next.
const INTENTS_PER_GROUP: usize = 4096;

/// Wishes that wait to be sent, in the order of their sequence numbers. Of each object at most a release, a grab, a move and a release
/// wait, or its removal, so that however long nobody sends, none that takes hold or lets go is lost, and memory is bounded by the scene's
/// objects.
#[derive(Debug)]
struct Queue {
    /// Of the last wish.
    sequence: u64,
    /// Whether somebody sends; what is wished while nobody does is lost.
    open: bool,
    waiting: VecDeque<Intent>,
    /// What the user holds.
    held: BTreeSet<ObjectId>,
}

impl Queue {
    /// Takes a wish, in place of those that wait and are overtaken by it.
    fn push(&mut self, action: Action) {
        self.sequence += 1;
        if !self.open {
            return;
        }
        let Some(object) = action.object() else {
            // More than fit into a scene would be refused.
            if self.waiting.iter().filter(|waiting| waiting.action.object().is_none()).count() < MAX_OBJECTS {
                self.waiting.push_back(Intent { sequence: self.sequence, action });
            }
            return;
        };
        match action {
            Action::Release(..) | Action::Remove(_) => self.held.remove(&object),
            _ => self.held.insert(object),
        };
        if matches!(action, Action::Remove(_)) {
            self.waiting.retain(|waiting| waiting.action.object() != Some(object));
        }
        let of_it = |waiting: &Intent| waiting.action.object() == Some(object);
        let mut of_object = (0..self.waiting.len()).rev().filter(|i| self.waiting.get(*i).is_some_and(of_it));
        let (last, before) = (of_object.next(), of_object.next());
        let waits = |index: Option<usize>| index.and_then(|index| self.waiting.get(index)).map(|waiting| &waiting.action);
        let overtaken = match (&action, waits(last)) {
            (Action::Move(..), Some(Action::Move(..))) | (Action::Grab(_), Some(Action::Grab(_))) => last,
            (Action::Release(..), Some(Action::Release(..))) => last,
            // A drag that waits whole goes on: let go of and taken hold of again it would be the same.
            (Action::Grab(_), Some(Action::Release(..))) if matches!(waits(before), Some(Action::Grab(_) | Action::Move(..))) => {
                self.forget(last);
                return;
            }
            _ => None,
        };
        self.forget(overtaken);
        // At the end, where its number belongs: a lower one that comes later is dropped by the server.
        self.waiting.push_back(Intent { sequence: self.sequence, action });
    }

    /// Says again what is held, where nothing else is to be said of it: a server lets go of what it does not hear of.
    fn say_again(&mut self) {
        for object in self.held.clone() {
            if !self.waiting.iter().any(|waiting| waiting.action.object() == Some(object)) {
                self.push(Action::Grab(object));
            }
        }
    }

    fn forget(&mut self, waiting: Option<usize>) {
        if let Some(index) = waiting {
            self.waiting.remove(index);
        }
    }
}

/// Sends wishes; the server decides.
#[derive(Clone)]
pub struct User {
    queue: Arc<Mutex<Queue>>,
    /// Holds one ring at most: that something waits need not be said twice.
    bell: mpsc::Sender<()>,
}

/// The other end of [`User`].
pub(super) struct Wishes {
    queue: Arc<Mutex<Queue>>,
    bell: mpsc::Receiver<()>,
    /// When to say again what is held.
    again: tokio::time::Instant,
}

/// See [`HOLD_AGAIN_US`].
const HOLD_AGAIN: Duration = Duration::from_micros(HOLD_AGAIN_US);

/// A user whose first wish has the number after `start`, and the wishes.
pub(super) fn user(start: u64) -> (User, Wishes) {
    let queue = Arc::new(Mutex::new(Queue { sequence: start, open: false, waiting: VecDeque::new(), held: BTreeSet::new() }));
    let (ring, bell) = mpsc::channel(1);
    (User { queue: Arc::clone(&queue), bell: ring }, Wishes { queue, bell, again: tokio::time::Instant::now() + HOLD_AGAIN })
}

/// Where a run that begins now counts from, the time of day in microseconds: above all that an earlier run under the same name can have
/// counted to.
pub(super) fn count_from(now: SystemTime) -> u64 {
    let since = now.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_micros()).unwrap_or_default()
}

fn lock(queue: &Mutex<Queue>) -> MutexGuard<'_, Queue> {
    // A panic elsewhere leaves the queue whole: it is changed by single calls.
    queue.lock().unwrap_or_else(PoisonError::into_inner)
}

impl User {
    /// Sends one wish. Never blocks. While wishes wait, a move takes the place of an earlier one of the same object; while no broadcast is
    /// followed they are lost.
    pub fn wish(&self, action: Action) {
        lock(&self.queue).push(action);
        // Full: it has rung. Closed: nobody sends any more, and that end was reported.
        let _ = self.bell.try_send(());
    }
}

impl Wishes {
    /// Takes wishes from now on, and none of before.
    fn open(&self) {
        let mut queue = lock(&self.queue);
        queue.waiting.clear();
        queue.held.clear();
        queue.open = true;
    }

    /// Lets wishes go from now on.
    fn close(&self) {
        let mut queue = lock(&self.queue);
        queue.waiting.clear();
        queue.held.clear();
        queue.open = false;
    }

    /// The next wish; none when there is nobody left who wishes. A future that is dropped takes nothing with it.
    async fn next(&mut self) -> Option<Intent> {
        loop {
            let next = lock(&self.queue).waiting.pop_front();
            if next.is_some() {
                return next;
            }
            match tokio::time::timeout_at(self.again, self.bell.recv()).await {
                Ok(rung) => rung?,
                Err(_) => {
                    lock(&self.queue).say_again();
                    self.again = tokio::time::Instant::now() + HOLD_AGAIN;
                }
            }
        }
    }
}

impl Drop for Wishes {
    fn drop(&mut self) {
        self.close();
    }
}

/// Which of the room's broadcasts is followed, counted from 1; 0 while there is none.
pub(super) type Followed = u64;

/// Publishes the wishes for each of the room's broadcasts on a broadcast of its own, so that none is ever delivered to a later one: a
/// server that comes back would replay a drag of long ago.
pub(super) async fn publish(
    origin: moq_net::origin::Producer,
    room: String,
    user: String,
    mut wishes: Wishes,
    mut followed: watch::Receiver<Followed>,
) {
    let path = track::user_path(&room, &user);
    loop {
        let Ok(current) = followed.wait_for(|followed| *followed > 0).await.map(|followed| *followed) else { return };
        wishes.open();
        let result = tokio::select! {
            result = publish_drags(&origin, &path, &mut wishes) => result,
            // An error: nothing will be followed any more.
            changed = followed.wait_for(|followed| *followed != current) => match changed {
                Ok(_) => {
                    wishes.close();
                    continue;
                }
                Err(_) => return,
            },
        };
        match result {
            Ok(()) => return,
            Err(error) => tracing::warn!(%error, "wishes for the scene cannot be sent to this broadcast"),
        }
        wishes.close();
        if followed.wait_for(|followed| *followed != current).await.is_err() {
            return;
        }
    }
}

/// Until there is nobody left who wishes. A group is a drag: it ends with the release, or with what is put or removed, and the newest holds nothing that is over once the
/// next has begun.
async fn publish_drags(origin: &moq_net::origin::Producer, path: &str, wishes: &mut Wishes) -> anyhow::Result<()> {
    let broadcast = origin.create_broadcast(path)?;
    let track = broadcast.create_track(track::INTENT, track::scene_info())?;
    broadcast.announce(moq_net::origin::Route::default())?;
    let mut group: Option<moq_net::group::Producer> = None;
    let mut written = 0;
    while let Some(intent) = wishes.next().await {
        let mut drag = match group.take() {
            Some(drag) => drag,
            None => track.append_group()?,
        };
        drag.write_frame(moq_net::Timestamp::now(), intent.to_wire()?)?;
        written += 1;
        if matches!(intent.action, Action::Release(..) | Action::Put { .. } | Action::Remove(_)) || written == INTENTS_PER_GROUP {
            drag.finish()?;
            written = 0;
        } else {
            group = Some(drag);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use mr360_protocol::intent::Motion;
    use mr360_protocol::scene::{ObjectId, Transform};
    use mr360_protocol::transport;

    fn release(object: ObjectId) -> Action {
        Action::Release(object, Motion::STILL)
    }

    async fn read(group: &mut moq_net::group::Consumer) -> Option<Action> {
        let frame = group.read_frame().await.unwrap()?;
        Some(Intent::from_wire(&frame.payload).unwrap().action)
    }

    #[tokio::test]
    async fn a_group_is_a_drag_and_a_new_broadcast_knows_nothing_of_the_old() {
        let origin = transport::origin();
        let (user, wishes) = user(0);
        let (followed, is_followed) = watch::channel(1);
        let publishing = tokio::spawn(publish(origin.clone(), "live".to_owned(), "ann".to_owned(), wishes, is_followed));
        let path = track::user_path("live", "ann");
        let first = origin.consume().routed_broadcast(&path).await.unwrap();
        let mut track = first.track(track::INTENT).unwrap().subscribe(track::intent_subscription()).await.unwrap();
        let (object, other) = (ObjectId(1), ObjectId(2));
        for action in [Action::Grab(object), release(object), Action::Grab(other)] {
            user.wish(action);
        }
        let mut drag = track.recv_group().await.unwrap().unwrap();
        assert_eq!(read(&mut drag).await, Some(Action::Grab(object)));
        assert_eq!(read(&mut drag).await, Some(release(object)));
        assert_eq!(read(&mut drag).await, None);
        let mut drag = track.recv_group().await.unwrap().unwrap();
        assert_eq!(read(&mut drag).await, Some(Action::Grab(other)));

        followed.send(2).unwrap();
        first.closed().await;
        let second = origin.consume().routed_broadcast(&path).await.unwrap();
        let mut track = second.track(track::INTENT).unwrap().subscribe(track::intent_subscription()).await.unwrap();
        user.wish(release(other));
        let mut drag = track.recv_group().await.unwrap().unwrap();
        assert_eq!(read(&mut drag).await, Some(release(other)));
        publishing.abort();
    }

    fn waiting(wishes: &Wishes) -> Vec<Intent> {
        lock(&wishes.queue).waiting.iter().cloned().collect()
    }

    fn at(x: f32) -> Transform {
        Transform { position: glam::Vec3::new(x, 0.0, 0.0), ..Transform::default() }
    }

    #[test]
    fn a_drag_that_nobody_sends_keeps_its_grab_its_last_place_and_its_release() {
        let (user, wishes) = user(0);
        wishes.open();
        let (object, other) = (ObjectId(1), ObjectId(2));
        user.wish(Action::Grab(object));
        for step in 0..5000u16 {
            user.wish(Action::Move(object, at(step.into())));
            user.wish(Action::Move(other, at(-f32::from(step))));
        }
        user.wish(release(object));
        let actions: Vec<_> = waiting(&wishes).into_iter().map(|intent| intent.action).collect();
        let expected = [Action::Grab(object), Action::Move(object, at(4999.0)), Action::Move(other, at(-4999.0)), release(object)];
        assert_eq!(actions, expected);
        assert!(waiting(&wishes).is_sorted_by(|a, b| a.sequence < b.sequence));
    }

    #[test]
    fn what_waits_is_bounded_and_ends_as_was_wished() {
        let (user, wishes) = user(0);
        wishes.open();
        let object = ObjectId(1);
        user.wish(release(object));
        for step in 0..1000u16 {
            user.wish(Action::Grab(object));
            user.wish(Action::Move(object, at(step.into())));
            user.wish(release(object));
        }
        let actions: Vec<_> = waiting(&wishes).into_iter().map(|intent| intent.action).collect();
        let expected = [release(object), Action::Grab(object), Action::Move(object, at(999.0)), release(object)];
        assert_eq!(actions, expected);
        // Nobody sends any more.
        drop(wishes);
        user.wish(Action::Grab(object));
        assert!(lock(&user.queue).waiting.is_empty());
    }

    #[test]
    fn what_is_held_is_said_again_until_it_is_let_go_of() {
        let (user, wishes) = user(0);
        wishes.open();
        let [held, moved, dropped] = [ObjectId(1), ObjectId(2), ObjectId(3)];
        for action in [Action::Grab(held), Action::Move(moved, at(1.0)), Action::Grab(dropped), release(dropped)] {
            user.wish(action);
        }
        let again = |queue: &Mutex<Queue>| {
            lock(queue).waiting.clear();
            lock(queue).say_again();
            // Twice is once.
            lock(queue).say_again();
            lock(queue).waiting.iter().map(|intent| intent.action.clone()).collect::<Vec<_>>()
        };
        assert_eq!(again(&wishes.queue), [Action::Grab(held), Action::Grab(moved)]);
        user.wish(Action::Remove(held));
        assert_eq!(again(&wishes.queue), [Action::Grab(moved)]);
        // Another broadcast knows of no hold.
        wishes.open();
        assert!(again(&wishes.queue).is_empty());
    }

    #[test]
    fn what_is_put_and_removed_waits_bounded() {
        let (user, wishes) = user(0);
        wishes.open();
        let object = ObjectId(1);
        user.wish(Action::Put { item: 0, transform: at(1.0) });
        user.wish(Action::Grab(object));
        user.wish(Action::Move(object, at(2.0)));
        user.wish(Action::Remove(object));
        user.wish(Action::Put { item: 0, transform: at(1.0) });
        let put = Action::Put { item: 0, transform: at(1.0) };
        let actions: Vec<_> = waiting(&wishes).into_iter().map(|intent| intent.action).collect();
        assert_eq!(actions, [put.clone(), Action::Remove(object), put.clone()]);
        (0..2 * MAX_OBJECTS).for_each(|_| user.wish(put.clone()));
        assert_eq!(waiting(&wishes).len(), MAX_OBJECTS + 1);
    }

    #[test]
    fn a_later_run_counts_on_from_an_earlier_one() {
        let began = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let sequences = |began: SystemTime, wishes: u32| {
            let (user, waiting_wishes) = user(count_from(began));
            waiting_wishes.open();
            (0..wishes).for_each(|object| user.wish(release(ObjectId(object))));
            waiting(&waiting_wishes).iter().map(|intent| intent.sequence).collect::<Vec<_>>()
        };
        let earlier = sequences(began, 1000);
        assert_eq!((earlier[0], earlier.len()), (1_700_000_000_000_001, 1000));
        assert!(earlier.is_sorted_by(|a, b| a < b));
        // It wished a thousand times in a second.
        let later = sequences(began + Duration::from_secs(1), 3);
        assert!(later[0] > earlier[999], "{later:?}");
    }
}
