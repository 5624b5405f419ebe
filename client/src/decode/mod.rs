//! Compressed video in, planar pictures out, on a thread of its own.
//!
//! The way in never blocks: when the decoder cannot keep up, units are dropped up to the next keyframe and counted.
//! The way out blocks the decoder, so that a full playout buffer holds back compressed units instead of pictures.

mod codec;
mod hardware;
mod outbox;
mod pictures;
#[cfg(test)]
mod tests;
mod worker;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use bytes::Bytes;
use mr360_protocol::clock::ClientTime;
use mr360_protocol::video::{Colour, StereoLayout};

pub use self::codec::{Codec, DecodeError};
pub use self::outbox::{NobodyListens, PictureReceiver, PictureSender, outbox};

use crate::picture::Picture;
use crate::sync::ClientClock;

/// Largest width and height decoded, pixels.
pub const MAX_SIDE: u32 = 8192;
/// Largest access unit, bytes: the largest frame that the transport delivers.
pub const MAX_UNIT_BYTES: usize = 32 << 20;
/// Units that wait for the decoder: two seconds at 30 frames/s, and all of a late joiner's first group.
const QUEUED_UNITS: usize = 64;
/// Pictures between the decoder and the frame loop; the rest of the buffering is the playout's.
const QUEUED_PICTURES: usize = 2;

/// What the catalog says of the coded video.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VideoFormat {
    /// Codec of the access units.
    pub codec: Codec,
    /// Columns of the whole frame; 0 when not known. The bitstream has the last word.
    pub width: u32,
    /// Rows of the whole frame; 0 when not known.
    pub height: u32,
    /// What the codes mean. The bit depth follows the bitstream.
    pub colour: Colour,
    /// Where the eyes' views lie.
    pub stereo: StereoLayout,
}

/// One coded frame: H.264 or HEVC in Annex B, or an AV1 temporal unit.
#[derive(Debug, Clone)]
pub struct AccessUnit {
    /// Microseconds since the start of the broadcast.
    pub pts_us: u64,
    /// Decoding can start here.
    pub keyframe: bool,
    /// The bitstream.
    pub data: Bytes,
    /// When its last byte was here.
    pub arrived: ClientTime,
}

/// A picture and its times.
pub struct Decoded {
    /// The picture, with exactly the pts of its access unit.
    pub picture: Picture,
    /// When the access unit arrived.
    pub arrived: ClientTime,
    /// When the picture left the decoder.
    pub decoded: ClientTime,
    /// How long the decoder stood still meanwhile because nobody took its pictures, microseconds.
    pub held_us: u64,
}

/// Whether to try the GPU's decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Hardware {
    /// Try what FFmpeg offers for the codec, fall back to software.
    #[default]
    Prefer,
    /// Software only.
    Never,
}

/// A count that one thread raises and others read.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// The count so far.
    #[must_use]
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }

    fn add(&self, count: u64) {
        self.0.fetch_add(count, Ordering::Relaxed);
    }
}

/// What happened to the access units, since the start.
#[derive(Debug, Default)]
pub struct DecodeCounters {
    /// Access units handed in.
    pub units: Counter,
    /// Pictures that came out.
    pub pictures: Counter,
    /// Units that the decoder refused, and pictures that could not be used.
    pub errors: Counter,
    /// Units dropped because no keyframe preceded them, at the start or after an error.
    pub unanchored: Counter,
    /// Units dropped because the decoder could not keep up.
    pub backlog: Counter,
    /// Pictures that were ready but gave way to newer ones, because the frame loop could not keep up.
    pub superseded: Counter,
    /// Time that the decoder stood still because nobody took its pictures, microseconds.
    blocked_us: Counter,
}

/// What travels to the thread.
struct Input {
    unit: AccessUnit,
    format: VideoFormat,
    /// [`DecodeCounters::blocked_us`] when the unit was handed in.
    blocked_before_us: u64,
}

/// The decoder's thread and the way to it.
pub struct VideoDecoder {
    input: Option<SyncSender<Input>>,
    format: Option<VideoFormat>,
    /// After units were dropped, everything up to the next keyframe is undecodable.
    waits_for_keyframe: bool,
    counters: Arc<DecodeCounters>,
    thread: Option<JoinHandle<()>>,
}

impl VideoDecoder {
    /// Starts the thread; pictures come out of the receiver. Dropping the receiver ends the thread.
    ///
    /// # Errors
    /// [`DecodeError::Thread`] when the system gives no thread.
    pub fn start(clock: ClientClock, hardware: Hardware) -> Result<(Self, PictureReceiver), DecodeError> {
        Self::start_with(clock, hardware, QUEUED_PICTURES)
    }

    fn start_with(clock: ClientClock, hardware: Hardware, capacity: usize) -> Result<(Self, PictureReceiver), DecodeError> {
        let (input, units) = sync_channel(QUEUED_UNITS);
        let (output, pictures) = outbox(capacity);
        let counters = Arc::new(DecodeCounters::default());
        let shared = Arc::clone(&counters);
        let thread = std::thread::Builder::new()
            .name("decode".to_owned())
            .spawn(move || worker::Worker::new(clock, hardware, output, shared).run(&units))
            .map_err(|error| DecodeError::Thread { detail: error.to_string() })?;
        Ok((Self { input: Some(input), format: None, waits_for_keyframe: true, counters, thread: Some(thread) }, pictures))
    }

    /// Announces the format of the units that follow; a change makes a new decoder, at the next keyframe.
    ///
    /// # Errors
    /// [`DecodeError::TooLarge`] and [`DecodeError::NoDecoder`]; the format before stays in force.
    pub fn set_format(&mut self, format: VideoFormat) -> Result<(), DecodeError> {
        codec::check_size(format.width, format.height)?;
        codec::find(format.codec)?;
        if self.format != Some(format) {
            self.format = Some(format);
            self.waits_for_keyframe = true;
        }
        Ok(())
    }

    /// Hands in the next unit in decoding order. Never blocks.
    ///
    /// # Errors
    /// [`DecodeError::NoFormat`] before [`VideoDecoder::set_format`], [`DecodeError::UnitTooLarge`], and
    /// [`DecodeError::Stopped`] once nobody takes pictures any more. A full queue is no error: it is counted.
    pub fn push(&mut self, unit: AccessUnit) -> Result<(), DecodeError> {
        let format = self.format.ok_or(DecodeError::NoFormat)?;
        if unit.data.len() > MAX_UNIT_BYTES {
            self.waits_for_keyframe = true;
            return Err(DecodeError::UnitTooLarge { bytes: unit.data.len() });
        }
        self.counters.units.add(1);
        // To FFmpeg an empty packet means the end of the stream.
        if unit.data.is_empty() {
            self.counters.errors.add(1);
            self.waits_for_keyframe = true;
            return Ok(());
        }
        if self.waits_for_keyframe && !unit.keyframe {
            self.counters.unanchored.add(1);
            return Ok(());
        }
        let blocked_before_us = self.counters.blocked_us.get();
        let input = self.input.as_ref().ok_or(DecodeError::Stopped)?;
        match input.try_send(Input { unit, format, blocked_before_us }) {
            Ok(()) => self.waits_for_keyframe = false,
            Err(TrySendError::Full(_)) => {
                self.counters.backlog.add(1);
                self.waits_for_keyframe = true;
            }
            Err(TrySendError::Disconnected(_)) => return Err(DecodeError::Stopped),
        }
        Ok(())
    }

    /// What happened so far; stays readable after the decoder is gone.
    #[must_use]
    pub fn counters(&self) -> Arc<DecodeCounters> {
        Arc::clone(&self.counters)
    }

    /// Hands out the pictures still inside and ends the thread. The receiver must be drained meanwhile, or dropped.
    pub fn finish(mut self) {
        self.input = None;
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the decoder's thread ended by a panic");
        }
    }
}
