//! Reads hang's video and audio tracks.

use hang::catalog::{AudioCodec as HangAudio, AudioConfig, PRIORITY, VideoCodec as HangVideo, VideoConfig};
use moq_mux::catalog::hang::Container;
use moq_mux::container::Frame;
use mr360_protocol::track;
use mr360_protocol::video::CatalogSection;
use tokio::sync::mpsc;

use super::Event;
use crate::audio::{AudioCodec, AudioFormat};
use crate::decode::{AccessUnit, Codec, VideoFormat};
use crate::sync::ClientClock;

type Reader = moq_mux::container::Consumer<Container>;

pub(super) async fn read_video(
    broadcast: moq_net::broadcast::Consumer,
    name: String,
    config: VideoConfig,
    section: CatalogSection,
    events: mpsc::Sender<Event>,
    clock: ClientClock,
) {
    let codec = match &config.codec {
        HangVideo::H264(_) => Codec::H264,
        HangVideo::H265(_) => Codec::Hevc,
        HangVideo::AV1(_) => Codec::Av1,
        other => {
            // A closed queue: nobody is left to be told.
            let _ = events.send(Event::Refused(format!("video track {name}: codec {other} is not supported"))).await;
            return;
        }
    };
    let format = VideoFormat {
        codec,
        width: config.coded_width.unwrap_or(0),
        height: config.coded_height.unwrap_or(0),
        colour: section.colour,
        stereo: section.stereo,
    };
    if events.send(Event::Video(format)).await.is_err() {
        return;
    }
    let container = Container::try_from(&config);
    let event = move |frame: Frame| {
        let pts_us = frame.timestamp.as_micros() as u64;
        Event::Unit(AccessUnit { pts_us, keyframe: frame.keyframe, data: frame.payload, arrived: clock.now() })
    };
    log_end(&name, read(&broadcast, &name, container, PRIORITY.video, &events, event).await);
}

pub(super) async fn read_audio(broadcast: moq_net::broadcast::Consumer, name: String, config: AudioConfig, events: mpsc::Sender<Event>) {
    let codec = match &config.codec {
        HangAudio::AAC(_) => AudioCodec::Aac,
        HangAudio::Opus => AudioCodec::Opus,
        other => {
            // A closed queue: nobody is left to be told.
            let _ = events.send(Event::Refused(format!("audio track {name}: codec {other} is not supported"))).await;
            return;
        }
    };
    let format =
        AudioFormat { codec, sample_rate: config.sample_rate, channels: config.channel_count, description: config.description.clone() };
    if events.send(Event::Audio(Some(format))).await.is_err() {
        return;
    }
    let container = Container::try_from(&config);
    let event = |frame: Frame| Event::AudioPacket { pts_us: frame.timestamp.as_micros() as u64, data: frame.payload };
    log_end(&name, read(&broadcast, &name, container, PRIORITY.audio, &events, event).await);
}

/// Sends every frame as an event until the track ends or nobody takes them.
async fn read(
    broadcast: &moq_net::broadcast::Consumer,
    name: &str,
    container: Result<Container, moq_mux::Error>,
    priority: u8,
    events: &mpsc::Sender<Event>,
    event: impl Fn(Frame) -> Event,
) -> Result<(), moq_mux::Error> {
    let track = broadcast.track(name)?.subscribe(track::media_subscription(priority)).await?;
    let mut reader = Reader::new(track, container?);
    while let Some(frame) = reader.read().await? {
        if events.send(event(frame)).await.is_err() {
            break;
        }
    }
    Ok(())
}

fn log_end(name: &str, result: Result<(), moq_mux::Error>) {
    match result {
        Ok(()) => tracing::info!(track = name, "track ended"),
        Err(error) => tracing::warn!(track = name, %error, "track broke off"),
    }
}
