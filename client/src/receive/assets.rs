//! Fetches the models that a scene names, checks their hashes, and keeps them on disk.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use mr360_protocol::asset::{AssetId, MAX_ASSET_BYTES, MAX_ASSETS};
use mr360_protocol::scene::{Change, Geometry, SceneMessage};
use mr360_protocol::track;
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;

use super::Event;

/// Fetched at once: each may take 31 MiB of memory.
const CONCURRENT: usize = 2;

/// Why a model could not be had.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AssetError {
    /// Not published, or the link broke.
    #[error("asset {id}: {fault}")]
    Fetch {
        /// The asset.
        id: AssetId,
        /// What happened.
        fault: String,
    },
    /// The bytes are not what the name says.
    #[error("asset {id}: its bytes have SHA-256 {got}; the server or a relay has damaged it")]
    WrongHash {
        /// The asset.
        id: AssetId,
        /// The hash of what came.
        got: AssetId,
    },
    /// Larger than allowed.
    #[error("asset {id}: {bytes} bytes, at most {MAX_ASSET_BYTES}")]
    TooLarge {
        /// The asset.
        id: AssetId,
        /// Its size.
        bytes: u64,
    },
}

/// Assets on disk, each in a file named by its hash. A cache: every failure means only that it is fetched again.
#[derive(Debug, Clone)]
pub struct AssetCache {
    folder: PathBuf,
}

impl AssetCache {
    /// A cache in this folder.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// The asset, if it is there and whole.
    #[must_use]
    pub fn load(&self, id: AssetId) -> Option<Bytes> {
        let path = self.path(id);
        if std::fs::metadata(&path).ok()?.len() > MAX_ASSET_BYTES as u64 {
            return None;
        }
        let bytes = std::fs::read(&path).ok()?;
        if AssetId::of(&bytes) == id {
            return Some(bytes.into());
        }
        tracing::warn!(path = %path.display(), "cached asset is damaged; fetching it again");
        None
    }

    /// Keeps the asset. A file is written aside and renamed, so that a crash or a full disk leaves no half.
    pub fn store(&self, id: AssetId, bytes: &[u8]) {
        let (path, partial) = (self.path(id), self.folder.join(format!("{id}.{}.partial", std::process::id())));
        let written = std::fs::create_dir_all(&self.folder)
            .and_then(|()| std::fs::write(&partial, bytes))
            .and_then(|()| std::fs::rename(&partial, &path));
        if let Err(error) = written {
            tracing::warn!(path = %path.display(), %error, "asset not cached");
            // It may never have been made.
            let _ = std::fs::remove_file(&partial);
        }
    }

    fn path(&self, id: AssetId) -> PathBuf {
        self.folder.join(id.to_string())
    }
}

/// Fetches each asset once, in the background.
pub(super) struct AssetFetcher {
    broadcast: moq_net::broadcast::Consumer,
    cache: AssetCache,
    events: mpsc::Sender<Event>,
    wanted: HashSet<AssetId>,
    permits: Arc<Semaphore>,
    tasks: JoinSet<()>,
}

impl AssetFetcher {
    pub(super) fn new(broadcast: moq_net::broadcast::Consumer, cache: PathBuf, events: mpsc::Sender<Event>) -> Self {
        let permits = Arc::new(Semaphore::new(CONCURRENT));
        Self { broadcast, cache: AssetCache { folder: cache }, events, wanted: HashSet::new(), permits, tasks: JoinSet::new() }
    }

    /// Starts to fetch what the message names and was not asked for before.
    pub(super) fn want(&mut self, message: &SceneMessage) {
        let ids = match message {
            SceneMessage::Snapshot(scene) => scene.assets(),
            SceneMessage::Delta { changes, .. } => changes
                .iter()
                .filter_map(|change| match change {
                    Change::Put(object) => match object.geometry {
                        Geometry::Model(id) => Some(id),
                        Geometry::Shape(_) => None,
                    },
                    Change::Move(..) | Change::Remove(_) => None,
                })
                .collect(),
        };
        for id in ids {
            if self.wanted.len() >= MAX_ASSETS || !self.wanted.insert(id) {
                continue;
            }
            let (broadcast, cache, events, permits) =
                (self.broadcast.clone(), self.cache.clone(), self.events.clone(), Arc::clone(&self.permits));
            self.tasks.spawn(async move {
                // The semaphore is never closed.
                let _permit = permits.acquire_owned().await;
                let event = match fetch(&broadcast, &cache, id).await {
                    Ok(bytes) => Event::Asset(id, bytes),
                    Err(error) => Event::AssetFailed(id, error),
                };
                // A closed queue: nobody wants it any more.
                let _ = events.send(event).await;
            });
        }
    }
}

async fn fetch(broadcast: &moq_net::broadcast::Consumer, cache: &AssetCache, id: AssetId) -> Result<Bytes, AssetError> {
    if let Some(bytes) = cache.load(id) {
        return Ok(bytes);
    }
    let fault = |fault: String| AssetError::Fetch { id, fault };
    let received = async {
        let mut track = broadcast.track(&id.track())?.subscribe(track::asset_subscription()).await?;
        match track.recv_group().await? {
            Some(mut group) => group.read_frame().await,
            None => Ok(None),
        }
    };
    let frame = received.await.map_err(|error: moq_net::Error| fault(error.to_string()))?;
    let bytes = frame.ok_or_else(|| fault("the track is empty".to_owned()))?.payload;
    if bytes.len() > MAX_ASSET_BYTES {
        return Err(AssetError::TooLarge { id, bytes: bytes.len() as u64 });
    }
    let got = AssetId::of(&bytes);
    if got != id {
        return Err(AssetError::WrongHash { id, got });
    }
    cache.store(id, &bytes);
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cache_returns_what_is_whole_alone() {
        let folder = tempfile::tempdir().unwrap();
        let cache = AssetCache::new(folder.path());
        let id = AssetId::of(b"model");
        assert_eq!(cache.load(id), None);
        cache.store(id, b"model");
        assert_eq!(cache.load(id).as_deref(), Some(&b"model"[..]));
        std::fs::write(cache.path(id), b"mouldy").unwrap();
        assert_eq!(cache.load(id), None);
    }

    #[test]
    fn a_cache_that_cannot_be_written_is_no_error() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, b"").unwrap();
        AssetCache::new(&file).store(AssetId::of(b"x"), b"x");
    }
}
