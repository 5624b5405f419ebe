//! This user's own broadcast: wishes for the scene.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use mr360_protocol::codec::Message;
use mr360_protocol::scene::{Action, Intent};
use mr360_protocol::track;
use tokio::sync::mpsc;

/// A group holds this many intents before the next starts, far below the transport's 8192 frames.
const INTENTS_PER_GROUP: usize = 4096;

/// Sends wishes; the server decides.
#[derive(Clone)]
pub struct User {
    intents: mpsc::Sender<Intent>,
    sequence: Arc<AtomicU64>,
}

impl User {
    pub(super) fn new(intents: mpsc::Sender<Intent>) -> Self {
        Self { intents, sequence: Arc::default() }
    }

    /// Sends one wish. Never blocks; while the link is down wishes wait for it, the first few hundred.
    pub fn wish(&self, action: Action) {
        let sequence = self.sequence.fetch_add(1, Ordering::Relaxed) + 1;
        // A receiver that has ended takes no more wishes, and its end was reported.
        if let Err(mpsc::error::TrySendError::Full(lost)) = self.intents.try_send(Intent { sequence, action }) {
            tracing::debug!(?lost, "too many wishes wait; the newest is dropped");
        }
    }
}

pub(super) async fn publish(origin: moq_net::origin::Producer, room: String, user: String, mut intents: mpsc::Receiver<Intent>) {
    let result: anyhow::Result<()> = async {
        let broadcast = origin.create_broadcast(track::user_path(&room, &user))?;
        let track = broadcast.create_track(track::INTENT, track::scene_info())?;
        broadcast.announce(moq_net::origin::Route::default())?;
        loop {
            let mut group = track.append_group()?;
            for _ in 0..INTENTS_PER_GROUP {
                let Some(intent) = intents.recv().await else { return Ok(()) };
                group.write_frame(moq_net::Timestamp::now(), intent.to_wire()?)?;
            }
            group.finish()?;
        }
    }
    .await;
    if let Err(error) = result {
        tracing::warn!(%error, "wishes for the scene can no longer be sent");
    }
}
