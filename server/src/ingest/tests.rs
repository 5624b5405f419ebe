//! Whole ingests, on media made by the ffmpeg program.

mod bad_input;
mod directions;
mod formats;
mod live;
mod protocols;
mod senders;
mod silence;

use std::path::Path;
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant};

use mr360_protocol::video::StereoLayout;

use super::*;
use crate::frame::{Pixels, SUPPORTED_PIXELS};

/// A guard against hanging, not a measure of speed.
const PATIENCE: Duration = Duration::from_secs(60);
const X264: &str = "-c:v libx264 -preset ultrafast -pix_fmt yuv420p -bf 0";

fn file(path: &Path) -> IngestConfig {
    IngestConfig::new(Source::parse(path.to_str().unwrap()).unwrap())
}

fn start(config: IngestConfig) -> (IngestHandle, Receiver<IngestEvent>) {
    let (sender, receiver) = mpsc::channel();
    let handle = spawn(config, ServerClock::start(), move |event| drop(sender.send(event))).unwrap();
    (handle, receiver)
}

/// What came out of an ingest.
#[derive(Default)]
struct Outcome {
    started: Vec<(VideoInfo, Option<AudioInfo>)>,
    video: Vec<AccessUnit>,
    frames: Vec<(u64, (u32, u32), StereoLayout)>,
    audio: Vec<AudioPacket>,
    /// Reasons and waits.
    interrupted: Vec<(String, Duration)>,
}

impl Outcome {
    fn take(&mut self, event: IngestEvent) {
        match event {
            IngestEvent::Started(video, audio) => self.started.push((video, audio)),
            IngestEvent::Video(unit) => self.video.push(unit),
            IngestEvent::Audio(packet) => self.audio.push(packet),
            IngestEvent::Interrupted { reason, retry_in } => self.interrupted.push((reason, retry_in)),
            IngestEvent::Frame(frame, _) => {
                let Pixels::Video(pixels, colour) = &frame.pixels else { panic!("not video") };
                assert!(SUPPORTED_PIXELS.contains(&pixels.format()));
                assert_eq!(colour.bit_depth > 8, format!("{:?}", pixels.format()).contains("10"));
                self.frames.push((frame.pts_us, frame.size(), frame.stereo));
            }
        }
    }

    /// Until `enough`, or until the ingest ends.
    fn collect(receiver: &Receiver<IngestEvent>, mut enough: impl FnMut(&Self) -> bool) -> Self {
        let mut outcome = Self::default();
        let end = Instant::now() + PATIENCE;
        while !enough(&outcome) {
            match receiver.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(event) => outcome.take(event),
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
                Err(mpsc::RecvTimeoutError::Timeout) => panic!("nothing more came"),
            }
        }
        outcome
    }

    fn whole(config: IngestConfig) -> (Self, IngestCounters) {
        let (handle, receiver) = start(config);
        let outcome = Self::collect(&receiver, |_| false);
        let counters = handle.counters();
        handle.join().unwrap();
        (outcome, counters)
    }

    /// What holds for every broadcast.
    fn check(&self) {
        assert!(!self.started.is_empty(), "formats come first");
        assert!(self.video.first().is_some_and(|unit| unit.keyframe), "starts with a keyframe");
        assert!(self.video.windows(2).all(|pair| pair[0].pts_us < pair[1].pts_us), "timestamps rise strictly");
        assert!(self.audio.windows(2).all(|pair| pair[0].pts_us < pair[1].pts_us));
        assert!(self.frames.windows(2).all(|pair| pair[0].0 < pair[1].0));
        let sent: Vec<u64> = self.video.iter().map(|unit| unit.pts_us).collect();
        assert!(self.frames.iter().all(|frame| sent.binary_search(&frame.0).is_ok()), "pictures belong to access units");
        let mut key = 0;
        for unit in &self.video {
            if unit.keyframe {
                key = unit.pts_us;
                // An SPS, or an AV1 sequence header.
                assert!(unit.data.starts_with(&[0, 0, 0, 1]) || unit.data.starts_with(&[0, 0, 1]) || unit.data[0] >> 3 & 0xf <= 2);
            }
            assert!(unit.pts_us - key <= 2_060_000, "keyframes are close");
        }
    }
}
