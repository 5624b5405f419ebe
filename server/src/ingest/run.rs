//! The life of an ingest: opening, running, losing and opening again.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::clock::ServerClock;
use super::error::IngestError;
use super::gop::{Memory, Unsuited, Verdict};
use super::open::{self, Opened};
use super::pictures::Stream;
use super::session::{self, End, Outcome, Session};
use super::shared::{Counters, Shared, count};
use super::timeline::Timeline;
use super::watch::Watch;
use super::{IngestConfig, IngestCounters, IngestEvent, Sink, Source, decode, gop, synthetic};

/// First and longest wait before a lost source is tried again.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(250), Duration::from_secs(8));

/// A running ingest. Dropping it stops it without waiting.
pub struct IngestHandle {
    watch: Watch,
    counters: Arc<Counters>,
    thread: Option<JoinHandle<Result<(), IngestError>>>,
    name: String,
}

impl IngestHandle {
    /// Asks all threads to end; they do so as soon as the sink returns.
    pub fn stop(&self) {
        self.watch.stop();
    }

    /// What was survived so far.
    #[must_use]
    pub fn counters(&self) -> IngestCounters {
        self.counters.snapshot()
    }

    /// True once the source is over, has failed for good, or was stopped, and all events were delivered.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Waits for the end.
    ///
    /// # Errors
    /// What ended a file for good; being stopped and the end of a file are none.
    pub fn join(mut self) -> Result<(), IngestError> {
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) => {
                Err(IngestError::Thread { input: self.name.clone(), detail: "the ingest thread panicked; this is a bug".to_owned() })
            }
            None => Ok(()),
        }
    }
}

impl Drop for IngestHandle {
    fn drop(&mut self) {
        // After `join` there is nothing to stop.
        self.watch.stop();
    }
}

/// Starts an ingest on threads of its own. They end when the file ends, when stopped, or when the handle is dropped; the sink is dropped then.
///
/// # Errors
/// At once for what cannot heal by itself: a missing or unreadable file, not a video, no video stream, a codec,
/// size or projection that is not supported, a flag that means nothing for the source, a port in use, an unknown synthetic source.
/// Network sources are tried for ever instead.
pub fn spawn(config: IngestConfig, clock: ServerClock, sink: impl Sink + 'static) -> Result<IngestHandle, IngestError> {
    config.check()?;
    init()?;
    let name = config.source.to_string();
    let watch = Watch::new();
    let counters = Arc::new(Counters::default());
    let prepared = prepare(&config, &name, &watch)?;
    let shared = Arc::new(Shared::new(name.clone(), Box::new(sink), clock, Arc::clone(&counters), watch.clone()));
    let thread = std::thread::Builder::new()
        .name("ingest".to_owned())
        .spawn(move || match prepared {
            Prepared::File(file) => run_file(&shared, &config, *file),
            Prepared::Address => {
                run_address(&shared, &config);
                Ok(())
            }
            Prepared::Synthetic(source) => synthetic::run(&shared, source),
        })
        .map_err(|error| IngestError::Thread { input: name.clone(), detail: error.to_string() })?;
    Ok(IngestHandle { watch, counters, thread: Some(thread), name })
}

enum Prepared {
    File(Box<PreparedFile>),
    Address,
    Synthetic(Box<dyn synthetic::FrameSource>),
}

struct PreparedFile {
    opened: Opened,
    stream: Stream,
    /// Why the packets cannot pass through, from a look into the file.
    unsuited: Option<Unsuited>,
}

fn prepare(config: &IngestConfig, name: &str, watch: &Watch) -> Result<Prepared, IngestError> {
    match &config.source {
        Source::File(_) => {
            let mut scanned = open::open(&config.source, config.silence, watch)?;
            let stream = session::describe(config, name, &scanned)?;
            decode::VideoDecoder::new(name, &stream.parameters)?;
            let unsuited = gop::look_ahead(&mut scanned.input, &scanned.video);
            // Opening anew is surer than seeking back: not every demuxer finds its start again.
            let opened = open::open(&config.source, config.silence, watch)?;
            Ok(Prepared::File(Box::new(PreparedFile { opened, stream, unsuited })))
        }
        Source::Url(address) => open::check_port(address).map(|()| Prepared::Address),
        Source::Synthetic(text) => synthetic::parse(text).map(Prepared::Synthetic),
    }
}

fn run_file(shared: &Arc<Shared>, config: &IngestConfig, file: PreparedFile) -> Result<(), IngestError> {
    let mut timeline = Timeline::default();
    let session = Session::start(shared, &mut timeline, config, file.opened, file.stream, file.unsuited)?;
    let outcome = session.run(config.looped);
    match outcome.end {
        Ok(End::Over) if outcome.video_packets == 0 => {
            Err(IngestError::NotAVideo { input: shared.name.clone(), detail: "no video packet could be read".to_owned() })
        }
        other => other.map(|_| ()),
    }
}

fn run_address(shared: &Arc<Shared>, config: &IngestConfig) {
    let listening = matches!(&config.source, Source::Url(address) if address.listening);
    let mut timeline = Timeline::default();
    let mut memory = Memory::default();
    let mut backoff = BACKOFF.0;
    let mut ran = false;
    while !shared.watch.stopped() {
        if listening {
            tracing::info!(input = shared.name, "waiting for a push");
        }
        let Outcome { end, video_packets, parameters, verdict } = run_once(shared, config, &mut timeline, &memory, ran);
        if shared.watch.stopped() {
            return;
        }
        if video_packets > 0 {
            ran = true;
            backoff = BACKOFF.0;
        }
        if let Some(parameters) = &parameters {
            memory.learn(parameters, verdict);
        }
        let reason = match end {
            // Nobody came: the socket is made anew, and nothing was lost.
            Err(IngestError::Unreachable { .. }) if listening && shared.watch.timed_out() => continue,
            Ok(_) => IngestError::Lost { input: shared.name.clone(), detail: "the sender ended it".to_owned() }.to_string(),
            Err(error) => error.to_string(),
        };
        // A peer that left may come back at once.
        let retry_in = if listening && video_packets > 0 { Duration::ZERO } else { backoff };
        shared.sink.event(IngestEvent::Interrupted { reason, retry_in });
        if !retry_in.is_zero() {
            shared.watch.sleep_until(Instant::now() + retry_in);
            backoff = (backoff * 2).min(BACKOFF.1);
        }
    }
}

fn run_once(shared: &Arc<Shared>, config: &IngestConfig, timeline: &mut Timeline, memory: &Memory, again: bool) -> Outcome {
    let failed = |error| Outcome { end: Err(error), video_packets: 0, parameters: None, verdict: Verdict::Open };
    let opened = match open::open(&config.source, config.silence, &shared.watch) {
        Ok(opened) => opened,
        Err(error) => return failed(error),
    };
    timeline.reopen();
    if again {
        count(&shared.counters.reconnects);
    }
    tracing::info!(input = shared.name, again, "the source is open");
    let known = memory.recall(&opened.video.parameters);
    let session =
        session::describe(config, &shared.name, &opened).and_then(|stream| Session::start(shared, timeline, config, opened, stream, known));
    match session {
        Ok(session) => session.run(false),
        Err(error) => failed(error),
    }
}

/// Prepares FFmpeg once for the process and keeps it from writing to the terminal: what it has to say comes back as errors.
pub(super) fn init() -> Result<(), IngestError> {
    ffmpeg_next::init().map_err(|error| IngestError::Thread { input: "FFmpeg".to_owned(), detail: error.to_string() })?;
    ffmpeg_next::log::set_level(ffmpeg_next::log::Level::Fatal);
    Ok(())
}
