//! Fetches the models that a scene names, checks their hashes, and reads them.

use std::collections::HashSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use mr360_protocol::asset::{AssetId, MAX_ASSET_BYTES, MAX_ASSETS};
use mr360_protocol::scene::{Change, Geometry, SceneMessage};
use mr360_protocol::track;
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;

use super::Event;
use super::asset_cache::AssetCache;
use crate::scene::model::{LoadedModel, Model};

/// Fetched and read at once: each may take hundreds of megabytes meanwhile.
const CONCURRENT: usize = 2;

/// Waits between tries: they double.
#[derive(Debug, Clone, Copy)]
struct Backoff {
    first: Duration,
    longest: Duration,
}

const BACKOFF: Backoff = Backoff { first: Duration::from_secs(1), longest: Duration::from_secs(60) };

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

/// Fetches each asset once, in the background; what fails is tried again until the broadcast ends.
pub(super) struct AssetFetcher {
    source: Source,
    events: mpsc::Sender<Event>,
    wanted: HashSet<AssetId>,
    permits: Arc<Semaphore>,
    tasks: JoinSet<()>,
    backoff: Backoff,
}

impl AssetFetcher {
    pub(super) fn new(broadcast: moq_net::broadcast::Consumer, cache: impl AsRef<Path>, events: mpsc::Sender<Event>) -> Self {
        let source = Source { broadcast, cache: AssetCache::new(cache.as_ref()) };
        let permits = Arc::new(Semaphore::new(CONCURRENT));
        Self { source, events, wanted: HashSet::new(), permits, tasks: JoinSet::new(), backoff: BACKOFF }
    }

    /// Starts to fetch what the message names and was not asked for before.
    pub(super) fn want(&mut self, message: &SceneMessage) {
        let ids = match message {
            SceneMessage::Snapshot { scene, .. } => scene.assets(),
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
            let (source, events, permits) = (self.source.clone(), self.events.clone(), Arc::clone(&self.permits));
            self.tasks.spawn(deliver(source, id, events, permits, self.backoff));
        }
    }
}

/// Fetches one asset until it is here. The first failure is reported, later ones are like it.
async fn deliver(source: Source, id: AssetId, events: mpsc::Sender<Event>, permits: Arc<Semaphore>, backoff: Backoff) {
    let mut wait = backoff.first;
    loop {
        let fetched = {
            // The semaphore is never closed. Its permit is free while this asset waits for its next try.
            let _permit = permits.acquire().await;
            source.fetch(id).await
        };
        let sent = match fetched {
            Ok(asset) => {
                // A closed queue: nobody wants it any more.
                let _ = events.send(Event::Asset { id, bytes: asset.bytes, model: asset.model }).await;
                return;
            }
            Err(error) if wait == backoff.first => events.send(Event::AssetFailed(id, error)).await,
            Err(error) => {
                tracing::debug!("{error}; trying again");
                Ok(())
            }
        };
        if sent.is_err() {
            return;
        }
        tokio::time::sleep(wait).await;
        wait = (wait * 2).min(backoff.longest);
    }
}

/// A model, read.
struct Asset {
    bytes: usize,
    model: LoadedModel,
}

impl Asset {
    fn read(bytes: &Bytes) -> Self {
        Self { bytes: bytes.len(), model: Model::parse(bytes).map(Arc::new) }
    }
}

/// Where assets come from.
#[derive(Clone)]
struct Source {
    broadcast: moq_net::broadcast::Consumer,
    cache: AssetCache,
}

impl Source {
    /// Files, hashes of 31 MiB and glTF would hold up every track of the network's thread: they go elsewhere.
    async fn fetch(&self, id: AssetId) -> Result<Asset, AssetError> {
        let cache = self.cache.clone();
        if let Some(asset) = aside(id, move || Ok(cache.load(id).as_ref().map(Asset::read))).await? {
            return Ok(asset);
        }
        let bytes = self.receive(id).await?;
        let cache = self.cache.clone();
        aside(id, move || {
            let got = AssetId::of(&bytes);
            if got != id {
                return Err(AssetError::WrongHash { id, got });
            }
            cache.store(id, &bytes);
            Ok(Asset::read(&bytes))
        })
        .await
    }

    async fn receive(&self, id: AssetId) -> Result<Bytes, AssetError> {
        let fault = |fault: String| AssetError::Fetch { id, fault };
        let received = async {
            let mut track = self.broadcast.track(&id.track())?.subscribe(track::asset_subscription()).await?;
            match track.recv_group().await? {
                Some(mut group) => group.read_frame().await,
                None => Ok(None),
            }
        };
        let frame = received.await.map_err(|error: moq_net::Error| fault(error.to_string()))?;
        let bytes = frame.ok_or_else(|| fault("the track is empty".to_owned()))?.payload;
        if bytes.len() > MAX_ASSET_BYTES { Err(AssetError::TooLarge { id, bytes: bytes.len() as u64 }) } else { Ok(bytes) }
    }
}

/// Runs on a thread that may block.
async fn aside<T: Send + 'static>(id: AssetId, work: impl FnOnce() -> Result<T, AssetError> + Send + 'static) -> Result<T, AssetError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|error| Err(AssetError::Fetch { id, fault: error.to_string() }))
}

#[cfg(test)]
mod tests {
    use mr360_protocol::codec::Message as _;
    use mr360_protocol::scene::{Object, ObjectId, Scene, Transform};
    use mr360_protocol::transport;

    use super::*;

    fn scene(id: AssetId) -> SceneMessage {
        let object = Object {
            id: ObjectId(1),
            geometry: Geometry::Model(id),
            transform: Transform::default(),
            material: None,
            animation: Default::default(),
        };
        let message = SceneMessage::Snapshot { at_us: 0, scene: Scene { objects: vec![object], ..Scene::default() } };
        message.to_wire().unwrap();
        message
    }

    #[test]
    fn what_came_damaged_is_fetched_again_and_kept() {
        let folder = tempfile::tempdir().unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let origin = transport::origin();
            let broadcast = origin.create_broadcast("test").unwrap();
            let model = b"no glTF, but itself";
            let id = AssetId::of(model);
            let mut track = broadcast.create_track(id.track(), track::asset_info()).unwrap();
            track.write_frame(moq_net::Timestamp::now(), Bytes::from_static(b"damaged")).unwrap();
            let (events, mut received) = mpsc::channel(4);
            let mut fetcher = AssetFetcher::new(broadcast.consume(), folder.path(), events);
            fetcher.backoff = Backoff { first: Duration::from_millis(1), longest: Duration::from_millis(2) };
            fetcher.want(&scene(id));
            assert!(matches!(received.recv().await, Some(Event::AssetFailed(of, AssetError::WrongHash { .. })) if of == id));
            track.write_frame(moq_net::Timestamp::now(), Bytes::from_static(model)).unwrap();
            let Some(Event::Asset { id: of, bytes, model: Err(_) }) = received.recv().await else { panic!("no asset") };
            assert_eq!((of, bytes), (id, model.len()));
            assert_eq!(AssetCache::new(folder.path()).load(id).as_deref(), Some(&model[..]));
        });
    }
}
