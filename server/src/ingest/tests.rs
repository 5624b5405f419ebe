//! Whole ingests, on media made by the ffmpeg program.

use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant};

use mr360_protocol::video::StereoLayout;

use super::test_media::{make, picture, tone};
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
    interrupted: usize,
}

impl Outcome {
    fn take(&mut self, event: IngestEvent) {
        match event {
            IngestEvent::Started(video, audio) => self.started.push((video, audio)),
            IngestEvent::Video(unit) => self.video.push(unit),
            IngestEvent::Audio(packet) => self.audio.push(packet),
            IngestEvent::Interrupted { .. } => self.interrupted += 1,
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

#[test]
fn h264_with_aac_passes_through_and_every_frame_is_decoded() {
    let dir = tempfile::tempdir().unwrap();
    let media = format!("{} {} {X264} -g 15 -c:a aac", picture(256, 128, 1.0), tone(1.0));
    let (outcome, counters) = Outcome::whole(file(&make(dir.path(), "a.mp4", &media)));
    outcome.check();
    let (video, audio) = &outcome.started[0];
    assert_eq!((video.codec, video.width, video.height, video.stereo), (VideoCodec::H264, 256, 128, StereoLayout::Mono));
    assert_eq!(video.transcoded_because, None);
    assert!((video.frame_rate - 30.0).abs() < 0.01);
    let audio = audio.as_ref().unwrap();
    assert_eq!((audio.codec, audio.sample_rate, &audio.description[..2]), (AudioCodec::Aac, 48_000, &[0x11, 0x88][..]));
    assert_eq!((outcome.video.len(), outcome.frames.len(), outcome.started.len()), (30, 30, 1));
    assert_eq!(outcome.video.iter().filter(|unit| unit.keyframe).count(), 2);
    assert!(outcome.audio.len() > 45);
    assert_eq!(counters, IngestCounters::default());
}

/// A port that was free a moment ago.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

struct Push(Child);

impl Push {
    /// Pushes a file in real time, trying until somebody listens.
    fn start(path: &Path, arguments: &str, url: &str) -> Self {
        let script = format!(
            "for i in $(seq 100); do ffmpeg -hide_banner -loglevel quiet -re -i '{}' {arguments} '{url}' </dev/null && exit 0; sleep 0.1; done",
            path.display()
        );
        Self(Command::new("sh").args(["-c", &script]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    }
}

impl Drop for Push {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

#[test]
fn a_push_over_rtmp_is_taken_and_the_next_one_too() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {} {X264} -g 15 -c:a aac", picture(256, 128, 1.5), tone(1.5)));
    let port = free_port();
    let source = Source::parse(&format!("rtmp://127.0.0.1:{port}/live/key?listen=1")).unwrap();
    let (handle, receiver) = start(IngestConfig::new(source));
    let url = format!("rtmp://127.0.0.1:{port}/live/key");
    let first = Push::start(&media, "-c copy -f flv", &url);
    let mut outcome = Outcome::collect(&receiver, |outcome| outcome.interrupted == 1);
    drop(first);
    let _second = Push::start(&media, "-c copy -f flv", &url);
    let again = Outcome::collect(&receiver, |outcome| outcome.video.len() >= 20 && outcome.frames.len() >= 20 && !outcome.audio.is_empty());
    outcome.check();
    assert!(outcome.video.len() >= 40 && outcome.audio.len() > 50, "{} {}", outcome.video.len(), outcome.audio.len());
    assert!(again.started.is_empty(), "the same formats are not announced again");
    assert_eq!(handle.counters().reconnects, 1);
    outcome.video.extend(again.video);
    outcome.frames.extend(again.frames);
    outcome.check();
    handle.stop();
    handle.join().unwrap();
}
