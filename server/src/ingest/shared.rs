//! What ingest's threads share: the sink, the clock, the counters, and what was announced.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use mr360_protocol::clock::ServerTime;

use super::clock::ServerClock;
use super::encode::Coded;
use super::error::IngestError;
use super::timeline::Rising;
use super::watch::Watch;
use super::{AccessUnit, AudioInfo, AudioPacket, IngestCounters, IngestEvent, Sink, VideoInfo};

/// Counters as they are raised.
#[derive(Default)]
pub(super) struct Counters {
    pub(super) reconnects: AtomicU64,
    pub(super) timestamp_jumps: AtomicU64,
    pub(super) format_changes: AtomicU64,
    pub(super) corrupt_packets: AtomicU64,
    pub(super) frames_without_light: AtomicU64,
}

impl Counters {
    pub(super) fn snapshot(&self) -> IngestCounters {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        IngestCounters {
            reconnects: read(&self.reconnects),
            timestamp_jumps: read(&self.timestamp_jumps),
            format_changes: read(&self.format_changes),
            corrupt_packets: read(&self.corrupt_packets),
            frames_without_light: read(&self.frames_without_light),
        }
    }
}

/// Raises a counter by one.
pub(super) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// Shared by all threads of one ingest.
pub(super) struct Shared {
    pub(super) name: String,
    pub(super) sink: Box<dyn Sink>,
    pub(super) clock: ServerClock,
    pub(super) counters: std::sync::Arc<Counters>,
    pub(super) watch: Watch,
    announced: Mutex<Option<(VideoInfo, Option<AudioInfo>)>>,
    video: Mutex<Rising>,
    audio: Mutex<Rising>,
    failure: Mutex<Option<IngestError>>,
}

impl Shared {
    pub(super) fn new(name: String, sink: Box<dyn Sink>, clock: ServerClock, counters: std::sync::Arc<Counters>, watch: Watch) -> Self {
        Self {
            name,
            sink,
            clock,
            counters,
            watch,
            announced: Mutex::default(),
            video: Mutex::default(),
            audio: Mutex::default(),
            failure: Mutex::default(),
        }
    }

    /// Announces the formats unless they are what was announced last.
    pub(super) fn announce(&self, video: VideoInfo, audio: Option<AudioInfo>) {
        let mut announced = lock(&self.announced);
        if announced.as_ref().is_some_and(|(known, sound)| *known == video && *sound == audio) {
            return;
        }
        if announced.as_ref().is_some_and(|(known, _)| (known.width, known.height) != (video.width, video.height)) {
            tracing::info!(input = self.name, width = video.width, height = video.height, "the picture's size has changed");
        }
        *announced = Some((video.clone(), audio.clone()));
        // Under the lock, so that announcements arrive in the order in which they were made.
        self.sink.event(IngestEvent::Started(video, audio));
    }

    /// The video and audio announced last.
    pub(super) fn announced(&self) -> Option<(VideoInfo, Option<AudioInfo>)> {
        lock(&self.announced).clone()
    }

    /// The least timestamp from `pts_us` on that still rises.
    pub(super) fn rise_video(&self, pts_us: i64) -> u64 {
        lock(&self.video).rise(pts_us)
    }

    /// Whether the timestamp is above all those of the video so far.
    pub(super) fn video_rises(&self, pts_us: i64) -> bool {
        lock(&self.video).rises(pts_us)
    }

    pub(super) fn send_sound(&self, pts_us: i64, data: bytes::Bytes) {
        let pts_us = lock(&self.audio).rise(pts_us);
        self.sink.event(IngestEvent::Audio(AudioPacket { pts_us, data }));
    }

    pub(super) fn send_coded(&self, coded: Coded, ingested: ServerTime) {
        let pts_us = u64::try_from(coded.pts_us).unwrap_or(0);
        self.sink.event(IngestEvent::Video(AccessUnit { pts_us, keyframe: coded.keyframe, data: coded.data, ingested }));
    }

    /// Keeps the error that ended a thread.
    pub(super) fn fail(&self, error: IngestError) {
        lock(&self.failure).get_or_insert(error);
    }

    pub(super) fn take_failure(&self) -> Option<IngestError> {
        lock(&self.failure).take()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
