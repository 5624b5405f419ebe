//! This user's own broadcast: wishes for the scene.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

use mr360_protocol::codec::Message;
use mr360_protocol::scene::{Action, Intent};
use mr360_protocol::track;
use tokio::sync::{mpsc, watch};

/// A group holds this many intents at most, far below the transport's 8192 frames; a drag that is longer goes on in the next.
const INTENTS_PER_GROUP: usize = 4096;

/// Sends wishes; the server decides.
#[derive(Clone)]
pub struct User {
    intents: mpsc::Sender<Intent>,
    sequence: Arc<AtomicU64>,
}

impl User {
    pub(super) fn new(intents: mpsc::Sender<Intent>) -> Self {
        // The time of day: above all that an earlier run under the same name can have counted to.
        let start = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let start = u64::try_from(start.as_micros()).unwrap_or_default();
        Self { intents, sequence: Arc::new(AtomicU64::new(start)) }
    }

    /// Sends one wish. Never blocks; while no broadcast is followed wishes are lost.
    pub fn wish(&self, action: Action) {
        let sequence = self.sequence.fetch_add(1, Ordering::Relaxed) + 1;
        // A receiver that has ended takes no more wishes, and its end was reported.
        if let Err(mpsc::error::TrySendError::Full(lost)) = self.intents.try_send(Intent { sequence, action }) {
            tracing::debug!(?lost, "too many wishes wait; the newest is dropped");
        }
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
    mut intents: mpsc::Receiver<Intent>,
    mut followed: watch::Receiver<Followed>,
) {
    let path = track::user_path(&room, &user);
    loop {
        let Ok(current) = followed.wait_for(|followed| *followed > 0).await.map(|followed| *followed) else { return };
        while intents.try_recv().is_ok() {}
        let result = tokio::select! {
            result = publish_drags(&origin, &path, &mut intents) => result,
            // An error: nothing will be followed any more.
            changed = followed.wait_for(|followed| *followed != current) => match changed {
                Ok(_) => continue,
                Err(_) => return,
            },
        };
        match result {
            Ok(()) => return,
            Err(error) => tracing::warn!(%error, "wishes for the scene cannot be sent to this broadcast"),
        }
        if followed.wait_for(|followed| *followed != current).await.is_err() {
            return;
        }
    }
}

/// Until there is nobody left who wishes. A group is a drag: it ends with the release, and the newest holds nothing that is over once the
/// next has begun.
async fn publish_drags(origin: &moq_net::origin::Producer, path: &str, intents: &mut mpsc::Receiver<Intent>) -> anyhow::Result<()> {
    let broadcast = origin.create_broadcast(path)?;
    let track = broadcast.create_track(track::INTENT, track::scene_info())?;
    broadcast.announce(moq_net::origin::Route::default())?;
    let mut group: Option<moq_net::group::Producer> = None;
    let mut written = 0;
    while let Some(intent) = intents.recv().await {
        let mut drag = match group.take() {
            Some(drag) => drag,
            None => track.append_group()?,
        };
        drag.write_frame(moq_net::Timestamp::now(), intent.to_wire()?)?;
        written += 1;
        if matches!(intent.action, Action::Release(_)) || written == INTENTS_PER_GROUP {
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
    use mr360_protocol::scene::ObjectId;
    use mr360_protocol::transport;

    async fn read(group: &mut moq_net::group::Consumer) -> Option<Action> {
        let frame = group.read_frame().await.unwrap()?;
        Some(Intent::from_wire(&frame.payload).unwrap().action)
    }

    #[tokio::test]
    async fn a_group_is_a_drag_and_a_new_broadcast_knows_nothing_of_the_old() {
        let origin = transport::origin();
        let (sender, intents) = mpsc::channel(8);
        let (followed, is_followed) = watch::channel(1);
        let user = User::new(sender);
        let publishing = tokio::spawn(publish(origin.clone(), "live".to_owned(), "ann".to_owned(), intents, is_followed));
        let path = track::user_path("live", "ann");
        let first = origin.consume().routed_broadcast(&path).await.unwrap();
        let mut track = first.track(track::INTENT).unwrap().subscribe(track::intent_subscription()).await.unwrap();
        let (object, other) = (ObjectId(1), ObjectId(2));
        for action in [Action::Grab(object), Action::Release(object), Action::Grab(other)] {
            user.wish(action);
        }
        let mut drag = track.recv_group().await.unwrap().unwrap();
        assert_eq!(read(&mut drag).await, Some(Action::Grab(object)));
        assert_eq!(read(&mut drag).await, Some(Action::Release(object)));
        assert_eq!(read(&mut drag).await, None);
        let mut drag = track.recv_group().await.unwrap().unwrap();
        assert_eq!(read(&mut drag).await, Some(Action::Grab(other)));

        followed.send(2).unwrap();
        first.closed().await;
        let second = origin.consume().routed_broadcast(&path).await.unwrap();
        let mut track = second.track(track::INTENT).unwrap().subscribe(track::intent_subscription()).await.unwrap();
        user.wish(Action::Release(other));
        let mut drag = track.recv_group().await.unwrap().unwrap();
        assert_eq!(read(&mut drag).await, Some(Action::Release(other)));
        publishing.abort();
    }

    #[test]
    fn a_later_run_counts_on_from_an_earlier_one() {
        let sequence = || {
            let (sender, mut intents) = mpsc::channel(8);
            let user = User::new(sender);
            (0..3).for_each(|_| user.wish(Action::Release(ObjectId(1))));
            std::iter::from_fn(|| intents.try_recv().ok()).map(|intent| intent.sequence).collect::<Vec<_>>()
        };
        let start = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_micros() as u64;
        let counted = sequence();
        assert!(counted.is_sorted_by(|a, b| a < b) && counted[0] > start, "{counted:?} after {start}");
    }
}
