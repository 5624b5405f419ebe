//! Follows a room: finds its broadcast, reads its catalog, keeps a task on each track, and starts again
//! when the broadcast is replaced.

use std::time::Duration;

use hang::catalog::{AudioConfig, Catalog, VideoConfig};
use mr360_protocol::codec::Message;
use mr360_protocol::join::without_secrets;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::SceneMessage;
use mr360_protocol::track;
use mr360_protocol::transport::LinkEvent;
use mr360_protocol::video::{CatalogExtension, CatalogSection};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;

use super::assets::AssetFetcher;
use super::user::Followed;
use super::{Config, Event, ReceiveError, media};
use crate::sync::ClientClock;

/// A first connection that takes longer has failed: later ones are awaited for ever.
const FIRST_CONNECTION: Duration = Duration::from_secs(15);
/// Time for a room to be announced once the link is up.
const FIRST_ANNOUNCEMENT: Duration = Duration::from_secs(5);

/// State of the link.
#[derive(Debug, Clone, Default)]
pub(super) struct Link {
    up: bool,
    fault: Option<String>,
}

impl Link {
    pub(super) fn observe(&mut self, event: &LinkEvent) {
        match event {
            LinkEvent::Up(_) => *self = Self { up: true, fault: None },
            LinkEvent::Down { fault, .. } | LinkEvent::Failed { fault, .. } => *self = Self { up: false, fault: Some(fault.to_string()) },
        }
    }
}

/// Why a broadcast is no longer followed.
enum Left {
    /// It ended; its successor is awaited.
    Ended(String),
    /// It can never be followed.
    Fatal(ReceiveError),
    /// The client has gone.
    Unwanted,
}

/// Runs until the room proves impossible.
pub(super) async fn run(
    config: &Config,
    broadcasts: moq_net::origin::Consumer,
    mut link: watch::Receiver<Link>,
    events: &mpsc::Sender<Event>,
    following: &watch::Sender<Followed>,
    clock: ClientClock,
) -> ReceiveError {
    let room = &config.join.room;
    let path = track::broadcast_path(room);
    if let Err(fault) = first_contact(config, &broadcasts, &path, &mut link).await {
        return fault;
    }
    let mut number: Followed = 0;
    loop {
        number += 1;
        let broadcast = match broadcasts.routed_broadcast(&path).await {
            Ok(broadcast) => broadcast,
            Err(error) => return ReceiveError::Incompatible { room: room.clone(), fault: error.to_string() },
        };
        following.send_replace(number);
        let left = tokio::select! {
            left = follow(config, &broadcast, events, clock) => left,
            error = broadcast.closed() => Left::Ended(error.to_string()),
        };
        following.send_replace(0);
        match left {
            Left::Ended(why) => tracing::warn!(room, why, "the broadcast ended; waiting for it to come back"),
            Left::Fatal(error) => return error,
            Left::Unwanted => return ReceiveError::Unreachable("the client has stopped listening".to_owned()),
        }
        // A broadcast whose link died can be routed until the origin notices; do not spin on it.
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// Waits for link and room, each only so long the first time.
async fn first_contact(
    config: &Config,
    broadcasts: &moq_net::origin::Consumer,
    path: &str,
    link: &mut watch::Receiver<Link>,
) -> Result<(), ReceiveError> {
    if tokio::time::timeout(FIRST_CONNECTION, link.wait_for(|link| link.up)).await.is_err() {
        let fault = link.borrow().fault.clone().unwrap_or_else(|| format!("{}: no answer", without_secrets(&config.join.endpoint)));
        return Err(ReceiveError::Unreachable(fault));
    }
    if tokio::time::timeout(FIRST_ANNOUNCEMENT, broadcasts.routed_broadcast(path)).await.is_ok() {
        return Ok(());
    }
    let mut rooms = Vec::new();
    let mut announced = broadcasts.announced();
    while let Some(update) = announced.try_next() {
        let found = update.prefix.to_string();
        if let Some(room) = found.strip_prefix("mr360/").filter(|room| update.kind.is_active() && !room.contains('/')) {
            rooms.push(room.to_owned());
        }
    }
    let there = if rooms.is_empty() { "no room is open there".to_owned() } else { format!("open rooms: {}", rooms.join(", ")) };
    Err(ReceiveError::NoRoom { url: without_secrets(&config.join.endpoint).to_string(), room: config.join.room.clone(), there })
}

/// What the catalog said last of each track, so that an update restarts only what it changes.
#[derive(Default)]
struct Current {
    video: Option<(String, VideoConfig, CatalogSection)>,
    told_to_wait: bool,
    audio: Option<(String, AudioConfig)>,
    video_tasks: JoinSet<()>,
    audio_tasks: JoinSet<()>,
}

async fn follow(config: &Config, broadcast: &moq_net::broadcast::Consumer, events: &mpsc::Sender<Event>, clock: ClientClock) -> Left {
    let mut catalogs = match Catalog::<CatalogExtension>::subscribe(broadcast).await {
        Ok(catalogs) => catalogs,
        Err(error) => return Left::Ended(error.to_string()),
    };
    if events.send(Event::Joined).await.is_err() {
        return Left::Unwanted;
    }
    let mut data_tasks = JoinSet::new();
    let mut current = Current::default();
    loop {
        let catalog = match catalogs.next().await {
            Ok(Some(catalog)) => catalog,
            Ok(None) => return Left::Ended("its catalog ended".to_owned()),
            Err(error) => return Left::Ended(format!("catalog: {error}")),
        };
        let section = match check(&config.join.room, catalog.ext.mr360.as_ref()) {
            Ok(section) => section.clone(),
            Err(error) => return Left::Fatal(error),
        };
        if data_tasks.is_empty() {
            data_tasks.spawn(read_light(broadcast.clone(), section.light.clone(), events.clone(), clock));
            data_tasks.spawn(read_scene(broadcast.clone(), section.scene.clone(), config.cache.clone(), events.clone()));
        }
        current.update(broadcast, &catalog, &section, events, clock).await;
    }
}

fn check<'a>(room: &str, section: Option<&'a CatalogSection>) -> Result<&'a CatalogSection, ReceiveError> {
    let incompatible = |fault: String| ReceiveError::Incompatible { room: room.to_owned(), fault };
    let section = section.ok_or_else(|| incompatible("plain MoQ video without light; play it with an ordinary MoQ player".to_owned()))?;
    if section.version != CatalogSection::VERSION {
        return Err(incompatible(format!(
            "its catalog has version {}, this client speaks {}; use matching server and client versions",
            section.version,
            CatalogSection::VERSION
        )));
    }
    Ok(section)
}

impl Current {
    async fn update(
        &mut self,
        broadcast: &moq_net::broadcast::Consumer,
        catalog: &Catalog<CatalogExtension>,
        section: &CatalogSection,
        events: &mpsc::Sender<Event>,
        clock: ClientClock,
    ) {
        let video =
            section.video.as_ref().and_then(|name| Some((name.clone(), catalog.video.renditions.get(name)?.clone(), section.clone())));
        if !same_video(self.video.as_ref(), video.as_ref()) {
            self.video_tasks.abort_all();
            match &video {
                Some((name, config, section)) => {
                    self.video_tasks.spawn(media::read_video(
                        broadcast.clone(),
                        name.clone(),
                        config.clone(),
                        section.clone(),
                        events.clone(),
                        clock,
                    ));
                }
                None if self.told_to_wait => {}
                None => drop(events.send(Event::AwaitingSource).await),
            }
            self.told_to_wait = video.is_none();
        }
        self.video = video;
        let audio = catalog.audio.renditions.iter().next().map(|(name, config)| (name.clone(), config.clone()));
        if audio.as_ref().map(|(name, _)| name) != self.audio.as_ref().map(|(name, _)| name) {
            self.audio_tasks.abort_all();
            match &audio {
                Some((name, config)) => {
                    self.audio_tasks.spawn(media::read_audio(broadcast.clone(), name.clone(), config.clone(), events.clone()));
                }
                None => drop(events.send(Event::Audio(None)).await),
            }
        }
        self.audio = audio;
    }
}

/// Measured fields of a rendition (bitrate, jitter) change all the time and restart nothing.
fn same_video(old: Option<&(String, VideoConfig, CatalogSection)>, new: Option<&(String, VideoConfig, CatalogSection)>) -> bool {
    let key = |of: &(String, VideoConfig, CatalogSection)| {
        let (name, config, section) = of;
        (name.clone(), config.codec.clone(), config.coded_width, config.coded_height, section.stereo, section.colour)
    };
    old.is_some() && old.map(key) == new.map(key)
}

async fn read_light(broadcast: moq_net::broadcast::Consumer, name: String, events: mpsc::Sender<Event>, clock: ClientClock) {
    let result: Result<(), moq_net::Error> = async {
        let mut track = broadcast.track(&name)?.subscribe(track::light_subscription()).await?;
        while let Some(mut group) = track.recv_group().await? {
            // A group abandoned by the transport costs its own frame's light alone.
            let Ok(Some(frame)) = group.read_frame().await else { continue };
            let arrived = clock.now();
            let event = match LightFrame::from_wire(&frame.payload) {
                Ok(light) => Event::Light { frame: light, bytes: frame.payload.len(), arrived },
                Err(error) => Event::Refused(error.to_string()),
            };
            if events.send(event).await.is_err() {
                break;
            }
        }
        Ok(())
    }
    .await;
    if let Err(error) = result {
        tracing::info!(%error, "the light track ended");
    }
}

async fn read_scene(broadcast: moq_net::broadcast::Consumer, name: String, cache: std::path::PathBuf, events: mpsc::Sender<Event>) {
    let mut assets = AssetFetcher::new(broadcast.clone(), cache, events.clone());
    let result: Result<(), moq_net::Error> = async {
        let mut track = broadcast.track(&name)?.subscribe(track::scene_subscription()).await?;
        while let Some(mut group) = track.recv_group().await? {
            while let Ok(Some(frame)) = group.read_frame().await {
                let event = match SceneMessage::from_wire(&frame.payload) {
                    Ok(message) => {
                        assets.want(&message);
                        Event::Scene(message)
                    }
                    Err(error) => Event::Refused(error.to_string()),
                };
                if events.send(event).await.is_err() {
                    return Ok(());
                }
            }
        }
        Ok(())
    }
    .await;
    if let Err(error) = result {
        tracing::info!(%error, "the scene track ended");
    }
}
