//! `mr360-server serve`: hosts a live broadcast.

mod args;
mod doors;
mod path;

pub use args::ServeArgs;

use std::time::Duration;

use anyhow::Context;
use mr360_protocol::failure::{Failure, say};
use mr360_protocol::scene_file::SceneFile;
use mr360_protocol::stop::asked_to_stop;
use mr360_protocol::transport;
use tokio::sync::oneshot;

use crate::broadcast::{Assets, Broadcast};
use crate::ingest::{self, IngestHandle, ServerClock};
use crate::physics::Forms;
use crate::session::{self, Opening};
use crate::stats::Stats;
use args::Settings;
use doors::{Doors, Open};
use path::DataPath;

/// How often the end of the source is looked for.
const POLL: Duration = Duration::from_millis(50);

/// Hosts until the source is over or the process is asked to stop.
///
/// # Errors
/// [`Failure::Input`] for wrong settings, an input that cannot be served, or an address that cannot be listened on: nothing was broadcast;
/// [`Failure::Running`] when the source or the only way to the viewers fails for good later.
pub async fn run(args: ServeArgs) -> Result<(), Failure<anyhow::Error>> {
    let on_air = start(args).await.map_err(Failure::Input)?;
    on_air.run().await.map_err(Failure::Running)
}

/// A broadcast under way.
struct OnAir {
    ingest: IngestHandle,
    /// Hears why the source's first format could not be put on air.
    format: oneshot::Receiver<anyhow::Error>,
    /// The source as the user named it.
    source: String,
    broadcast: Broadcast,
    session: tokio::task::JoinHandle<()>,
    stats: Stats,
    doors: Open,
}

/// Takes what can be taken by others or be wrong, builds the data path from its end to its source, then opens the doors.
async fn start(args: ServeArgs) -> anyhow::Result<OnAir> {
    let settings = args.settle()?;
    let clock = ServerClock::start();
    let stats = match &settings.stats {
        Some(file) => Stats::new(Some(file)).with_context(|| format!("--stats {}: cannot be written", file.display()))?,
        None => Stats::new(None)?,
    };
    let doors = Doors::prepare(&settings)?;
    let (opening, assets) = load_scene(&settings)?;

    let origin = transport::origin();
    let method = settings.method.make();
    let mut broadcast = Broadcast::create(&origin, &settings.room, method.name())?;
    broadcast.publish_assets(&assets)?;
    let session = tokio::spawn(session::run(opening, broadcast.scene()?, origin.consume(), settings.room.clone(), clock));

    let (path, format) = DataPath::new(broadcast.media(), broadcast.light()?, method, stats.clone(), clock);
    let config = settings.ingest.clone();
    let ingest = tokio::task::spawn_blocking(move || ingest::spawn(config, clock, path)).await??;
    let doors = doors.open(&origin)?;
    Ok(OnAir { ingest, format, source: settings.ingest.source.to_string(), broadcast, session, stats, doors })
}

impl OnAir {
    async fn run(self) -> anyhow::Result<()> {
        let Self { ingest, mut format, source, broadcast, session, stats, mut doors } = self;
        let mut failed = tokio::select! {
            () = asked_to_stop() => {
                tracing::info!("asked to stop");
                None
            }
            () = finished(&ingest) => {
                tracing::info!("the source is over");
                None
            }
            fault = doors.failed() => Some(fault),
            Ok(fault) = &mut format => Some(fault.context(source.clone())),
        };
        ingest.stop();
        let counters = ingest.counters();
        let end = tokio::task::spawn_blocking(move || ingest.join()).await?;
        session.abort();
        doors.close().await;
        drop(broadcast);
        say(stats.summary(counters));
        // A short file may be over before its format's fault was heard.
        if failed.is_none()
            && let Ok(fault) = format.try_recv()
        {
            failed = Some(fault.context(source));
        }
        match failed {
            Some(fault) => Err(fault),
            None => Ok(end?),
        }
    }
}

/// The scene of `--scene` with its models read in, or an empty one.
fn load_scene(settings: &Settings) -> anyhow::Result<(Opening, Assets)> {
    let mut assets = Assets::default();
    let mut opening = Opening::default();
    if let Some(path) = &settings.scene {
        let file = SceneFile::load(path)?;
        opening.scene = file.resolve(|model| assets.add(model))?;
        (opening.fixed_objects, opening.fixed_items) = (file.fixed_objects(), file.fixed_items());
    }
    opening.forms = Forms::read(&opening.scene, |id| assets.bytes(id));
    Ok((opening, assets))
}

async fn finished(ingest: &IngestHandle) {
    let mut poll = tokio::time::interval(POLL);
    while !ingest.is_finished() {
        poll.tick().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_port_is_taken_before_the_source_is_looked_at() {
        let folder = tempfile::tempdir().unwrap();
        let holder = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let taken = holder.local_addr().unwrap();
        let source = Some("synthetic:moon".to_owned());
        let args = ServeArgs { source, listen: Some(taken), state: Some(folder.path().to_owned()), ..ServeArgs::default() };
        let Err(Failure::Input(error)) = run(args).await else { panic!("a taken port was taken") };
        assert!(error.to_string().contains(&taken.to_string()), "{error:#}");
    }
}
