//! The scene track: groups of one snapshot and the deltas after it.

use mr360_protocol::clock::ServerTime;
use mr360_protocol::codec::Message;
use mr360_protocol::scene::{Change, Scene, SceneMessage};

/// A group grows to this many deltas before a new one starts with a snapshot: late joiners read at most this
/// many, and a group stays far below the transport's 8192 frames.
const DELTAS_PER_GROUP: usize = 256;

/// Publishes the shared scene.
pub struct SceneTrack {
    track: moq_net::track::Producer,
    group: Option<moq_net::group::Producer>,
    deltas: usize,
}

impl SceneTrack {
    pub(super) fn new(track: moq_net::track::Producer) -> Self {
        Self { track, group: None, deltas: 0 }
    }

    /// Publishes the changes that made `scene` at `at`; as a snapshot where a new group is due.
    ///
    /// # Errors
    /// When the scene breaks its own bounds or the track is closed.
    pub fn publish(&mut self, scene: &Scene, changes: Vec<Change>, at: ServerTime) -> anyhow::Result<()> {
        let now = moq_net::Timestamp::now();
        if let Some(group) = self.group.as_mut().filter(|_| self.deltas < DELTAS_PER_GROUP) {
            group.write_frame(now, SceneMessage::Delta { revision: scene.revision, at_us: at.0, changes }.to_wire()?)?;
            self.deltas += 1;
            return Ok(());
        }
        if let Some(full) = self.group.take() {
            full.finish()?;
        }
        let mut group = self.track.append_group()?;
        group.write_frame(now, SceneMessage::Snapshot { at_us: at.0, scene: scene.clone() }.to_wire()?)?;
        self.group = Some(group);
        self.deltas = 0;
        Ok(())
    }
}
