//! A peer that speaks MoQ and nothing else: reads tracks and publishes bytes, without a picture.
//!
//! What it waits for is its clock: "after 30 more lights" means the same on a fast and on a busy machine.

use std::future::Future;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use mr360_protocol::codec::Message;
use mr360_protocol::join::JoinUrl;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::SceneMessage;
use mr360_protocol::track;
use mr360_protocol::transport::{self, Dialer, Roles};
use tokio::runtime::Runtime;

/// Longest wait for anything: far more than a busy machine takes, so that a test that fails says so.
pub const LONG: Duration = Duration::from_secs(90);

/// Connected for as long as it lives; a lost connection is made anew.
pub struct Probe {
    runtime: Runtime,
    room: String,
    received: moq_net::origin::Producer,
    published: moq_net::origin::Producer,
}

impl Probe {
    /// Dials a join URL.
    ///
    /// # Errors
    /// When the URL is none or QUIC cannot be set up.
    pub fn join(url: &str) -> Result<Self> {
        let join: JoinUrl = url.parse()?;
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let guard = runtime.enter();
        let (received, published) = (transport::origin(), transport::origin());
        let dialer = Dialer::new(join.endpoint.clone(), join.fingerprint)?;
        let roles = Roles { publish: Some(published.consume()), subscribe: Some(received.clone()) };
        runtime.spawn(dialer.run(roles, |_| {}));
        drop(guard);
        Ok(Self { runtime, room: join.room, received, published })
    }

    /// Where it publishes to the server.
    #[must_use]
    pub fn published(&self) -> &moq_net::origin::Producer {
        &self.published
    }

    /// Name of the room.
    #[must_use]
    pub fn room(&self) -> &str {
        &self.room
    }

    /// Runs `work` with the room's broadcast, within [`LONG`].
    ///
    /// # Errors
    /// What `work` says, or that time is over.
    pub fn with_broadcast<T, F: Future<Output = Result<T>>>(
        &self,
        what: &str,
        work: impl FnOnce(moq_net::broadcast::Consumer) -> F,
    ) -> Result<T> {
        self.run(what, async {
            let broadcast = self.received.consume().routed_broadcast(&track::broadcast_path(&self.room)).await?;
            work(broadcast).await
        })
    }

    /// Runs `work` within [`LONG`].
    ///
    /// # Errors
    /// What `work` says, or that time is over.
    pub fn run<T>(&self, what: &str, work: impl Future<Output = Result<T>>) -> Result<T> {
        let timed = async { tokio::time::timeout(LONG, work).await };
        self.runtime.block_on(timed).with_context(|| format!("probe: {LONG:?} passed before {what}"))?
    }

    /// The next `count` lights, through as many broadcasts as it takes.
    ///
    /// # Errors
    /// When they do not come within [`LONG`], or one cannot be read.
    pub fn lights(&self, count: usize) -> Result<Vec<LightFrame>> {
        self.run(&format!("{count} lights"), async {
            let mut lights = Vec::with_capacity(count);
            loop {
                let broadcast = self.received.consume().routed_broadcast(&track::broadcast_path(&self.room)).await?;
                // A broadcast that ends is followed by the next one of its room.
                match read_lights(&broadcast, count, &mut lights).await {
                    Ok(()) if lights.len() == count => return Ok(lights),
                    Ok(()) | Err(ReadFault::Transport) => drop(broadcast.closed().await),
                    Err(ReadFault::Light(fault)) => bail!("{fault}"),
                }
            }
        })
    }

    /// Pts of the newest light after `count` more have come, microseconds.
    ///
    /// # Errors
    /// As [`Probe::lights`].
    pub fn pts_after(&self, count: usize) -> Result<u64> {
        self.lights(count)?.last().map(|light| light.pts_us).context("no light was asked for")
    }

    /// Reads the scene track from its newest snapshot until `found` makes something of a message.
    ///
    /// # Errors
    /// When none does within [`LONG`], or one cannot be read.
    pub fn scene<T>(&self, what: &str, mut found: impl FnMut(&SceneMessage) -> Option<T>) -> Result<T> {
        self.with_broadcast(what, |broadcast| async move {
            let mut scene = broadcast.track(track::SCENE)?.subscribe(track::scene_subscription()).await?;
            while let Some(mut group) = scene.recv_group().await? {
                while let Some(frame) = group.read_frame().await? {
                    if let Some(result) = found(&SceneMessage::from_wire(&frame.payload)?) {
                        return Ok(result);
                    }
                }
            }
            bail!("the scene track ended")
        })
    }
}

enum ReadFault {
    Transport,
    Light(String),
}

impl From<moq_net::Error> for ReadFault {
    fn from(_: moq_net::Error) -> Self {
        Self::Transport
    }
}

async fn read_lights(broadcast: &moq_net::broadcast::Consumer, count: usize, lights: &mut Vec<LightFrame>) -> Result<(), ReadFault> {
    let mut light = broadcast.track(track::LIGHT)?.subscribe(track::light_subscription()).await?;
    while lights.len() < count {
        let Some(mut group) = light.recv_group().await? else { return Ok(()) };
        // A group that the transport gave up costs its own frame alone.
        let Ok(Some(frame)) = group.read_frame().await else { continue };
        lights.push(LightFrame::from_wire(&frame.payload).map_err(|error| ReadFault::Light(error.to_string()))?);
    }
    Ok(())
}
