//! From the join URL to access units, light and scene: the network side of the client.
//!
//! [`Receiver::start`] runs on a runtime of its own; nothing that draws ever waits for it. Everything arrives
//! as [`Event`]s on one bounded channel: a client that does not drain it holds up its own subscriptions alone,
//! and the transport then drops its stale groups.

mod asset_cache;
mod assets;
mod follow;
mod media;
mod user;

pub use asset_cache::AssetCache;
pub use assets::AssetError;
pub use user::User;

use bytes::Bytes;
use mr360_protocol::asset::AssetId;
use mr360_protocol::clock::ClientTime;
use mr360_protocol::join::JoinUrl;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::SceneMessage;
use mr360_protocol::transport::{self, DialError, Dialer, LinkEvent, Roles};
use tokio::sync::{mpsc, watch};

use crate::audio::AudioFormat;
use crate::decode::{AccessUnit, VideoFormat};
use crate::scene::model::LoadedModel;
use crate::sync::ClientClock;

/// Events waiting to be taken: three seconds of a busy broadcast.
const EVENT_QUEUE: usize = 512;

/// What the network brings.
#[derive(Debug)]
pub enum Event {
    /// The link came up or went down; it mends itself.
    Link(LinkEvent),
    /// The broadcast was found, at first or anew: times start again.
    Joined,
    /// The room is open, its source has not come yet.
    AwaitingSource,
    /// The format of the access units that follow.
    Video(VideoFormat),
    /// A coded frame.
    Unit(AccessUnit),
    /// The format of the audio packets that follow; `None` when there is no audio any more.
    Audio(Option<AudioFormat>),
    /// A coded audio packet.
    AudioPacket {
        /// Microseconds since the start of the broadcast.
        pts_us: u64,
        /// The packet.
        data: Bytes,
    },
    /// The light of one frame.
    Light {
        /// Decoded.
        frame: LightFrame,
        /// Size on the wire, bytes.
        bytes: usize,
        /// When it was here.
        arrived: ClientTime,
    },
    /// A snapshot or delta of the scene.
    Scene(SceneMessage),
    /// A model that the scene names, verified and read.
    Asset {
        /// Its name.
        id: AssetId,
        /// Its size, bytes.
        bytes: usize,
        /// The model, or why it cannot be drawn.
        model: LoadedModel,
    },
    /// A model that could not be had yet; its objects are left out until it comes.
    AssetFailed(AssetId, AssetError),
    /// A message that was refused; the session goes on.
    Refused(String),
    /// Nothing more will come.
    Ended(ReceiveError),
}

/// Why nothing more will come.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// QUIC could not be set up, or the certificate is the wrong one.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// No such room.
    #[error("{url}: there is no room {room:?}; {there}; check the join URL with the host")]
    NoRoom {
        /// The endpoint.
        url: String,
        /// The room asked for.
        room: String,
        /// What is there.
        there: String,
    },
    /// Never connected.
    #[error("{0}; is the server running, and is the address reachable over UDP?")]
    Unreachable(String),
    /// Another program's broadcast, or another version of ours.
    #[error("room {room:?}: {fault}")]
    Incompatible {
        /// The room.
        room: String,
        /// What was wrong and what to do.
        fault: String,
    },
}

/// Where the client keeps what it need not fetch twice, and who it is.
#[derive(Debug, Clone)]
pub struct Config {
    /// Join URL.
    pub join: JoinUrl,
    /// Folder of the asset cache.
    pub cache: std::path::PathBuf,
    /// Name of this user in the session.
    pub user: String,
}

/// The running network side.
pub struct Receiver {
    runtime: Option<tokio::runtime::Runtime>,
    user: User,
}

impl Receiver {
    /// Connects and follows the room until dropped.
    ///
    /// # Errors
    /// When the runtime or QUIC cannot be set up.
    pub fn start(config: Config, clock: ClientClock) -> anyhow::Result<(Self, mpsc::Receiver<Event>)> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name("receive").enable_all().build()?;
        let (events, receiver) = mpsc::channel(EVENT_QUEUE);
        let (user, wishes) = user::user(user::count_from(std::time::SystemTime::now()));
        let guard = runtime.enter();
        let dialer = Dialer::new(config.join.endpoint.clone(), config.join.fingerprint)?;
        let (broadcasts, ours) = (transport::origin(), transport::origin());
        drop(guard);
        let roles = Roles { publish: Some(ours.consume()), subscribe: Some(broadcasts.clone()) };
        let (following, followed) = watch::channel(0);
        runtime.spawn(user::publish(ours, config.join.room.clone(), config.user.clone(), wishes, followed));
        runtime.spawn(run(config, dialer, roles, broadcasts, events, following, clock));
        Ok((Self { runtime: Some(runtime), user }, receiver))
    }

    /// A handle that sends the user's wishes.
    #[must_use]
    pub fn user(&self) -> User {
        self.user.clone()
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn run(
    config: Config,
    dialer: Dialer,
    roles: Roles,
    broadcasts: moq_net::origin::Producer,
    events: mpsc::Sender<Event>,
    following: watch::Sender<user::Followed>,
    clock: ClientClock,
) {
    let (up, is_up) = watch::channel(follow::Link::default());
    let link_events = events.clone();
    let link = dialer.run(roles, move |event| {
        up.send_modify(|link| link.observe(&event));
        // A full queue means that the client is busy; the log of the link is the first thing it can miss.
        let _ = link_events.try_send(Event::Link(event));
    });
    let end = tokio::select! {
        fault = link => fault.into(),
        fault = follow::run(&config, broadcasts.consume(), is_up, &events, &following, clock) => fault,
    };
    // Nobody is left to be told when this fails.
    let _ = events.send(Event::Ended(end)).await;
}
