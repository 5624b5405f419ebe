//! An ordinary MoQ player: hang's own catalog and container reader, which know nothing of light.

use anyhow::{Context, Result, ensure};
use hang::catalog::{AudioCodec, VideoCodec};
use moq_mux::catalog::hang::Container;
use mr360_protocol::track;
use mr360_tests::clips;
use mr360_tests::probe::Probe;
use mr360_tests::sandbox::Sandbox;

/// H.264 NAL unit types, ITU-T H.264 table 7-1.
const SLICE: u8 = 1;
const IDR: u8 = 5;
const SPS: u8 = 7;
const PPS: u8 = 8;

#[test]
fn hangs_own_reader_plays_the_plain_video() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let clip = clips::stereo(&sandbox, "clip.mp4", 500)?;
    let arguments = ["--loop", "--listen", "127.0.0.1:0", "--stereo", "top-bottom"];
    let server = sandbox.serve(&clip.display().to_string(), &arguments)?;
    let probe = Probe::join(&server.join_url)?;
    let (video, audio) = probe.with_broadcast("two GOPs of video, and sound", |broadcast| async move {
        let mut catalogs = hang::Catalog::<()>::subscribe(&broadcast).await?;
        let catalog = loop {
            let catalog = catalogs.next().await?.context("the catalog ended")?;
            if !catalog.video.renditions.is_empty() && !catalog.audio.renditions.is_empty() {
                break catalog;
            }
        };
        let (name, config) = catalog.video.renditions.iter().next().context("no video")?;
        ensure!(matches!(config.codec, VideoCodec::H264(_)), "video codec {}", config.codec);
        ensure!((config.coded_width, config.coded_height) == (Some(320), Some(320)), "{config:?}");
        let video = read(&broadcast, name, Container::try_from(config)?, 2 * clips::GOP).await?;
        let (name, config) = catalog.audio.renditions.iter().next().context("no audio")?;
        ensure!(matches!(config.codec, AudioCodec::AAC(_)) && config.sample_rate == 44_100, "{config:?}");
        let audio = read(&broadcast, name, Container::try_from(config)?, 20).await?;
        Ok((video, audio))
    })?;
    let keyframe = video.first().context("no frame")?;
    ensure!(keyframe.keyframe && [SPS, PPS, IDR].iter().all(|kind| nal_types(&keyframe.payload).contains(kind)), "no keyframe first");
    for frame in &video {
        let types = nal_types(&frame.payload);
        ensure!(types.contains(&if frame.keyframe { IDR } else { SLICE }), "a frame (key: {}) of NAL units {types:?}", frame.keyframe);
    }
    ensure!(video.is_sorted_by(|a, b| a.timestamp < b.timestamp), "video goes back in time");
    ensure!(audio.iter().all(|packet| !packet.payload.is_empty()), "empty audio packets");
    Ok(())
}

async fn read(
    broadcast: &moq_net::broadcast::Consumer,
    name: &str,
    container: Container,
    count: usize,
) -> Result<Vec<moq_mux::container::Frame>> {
    let track = broadcast.track(name)?.subscribe(track::media_subscription(100)).await?;
    let mut reader = moq_mux::container::Consumer::new(track, container);
    let mut frames = Vec::with_capacity(count);
    while frames.len() < count {
        frames.push(reader.read().await?.with_context(|| format!("track {name} ended"))?);
    }
    Ok(frames)
}

/// Types of the NAL units of an Annex B access unit.
fn nal_types(unit: &[u8]) -> Vec<u8> {
    unit.windows(4).filter(|window| window[..3] == [0, 0, 1]).map(|window| window[3] & 0x1f).collect()
}
