//! From any source to access units and decoded frames, at the pace of the source.
//!
//! ```text
//! source ─► session (demux, timeline, pace) ─┬─ passes through ─► access units ─► sink
//!                                            ├─ sound ──────────────────────────► sink
//!                                            └─► pictures (decode, reform, encode) ─► access units, frames ─► sink
//! ```
//!
//! [`spawn`] starts it. Files end or loop, network sources are opened again for ever, and nothing of what comes in can end the process.

mod audio;
mod bitstream;
mod clock;
mod colour;
mod decode;
mod encode;
mod error;
mod frames;
mod gop;
mod layout;
mod open;
mod pictures;
mod queue;
mod raw;
mod reform;
mod run;
mod session;
mod shared;
mod source;
pub mod synthetic;
#[cfg(test)]
mod test_media;
pub mod testcard;
#[cfg(test)]
mod tests;
mod timeline;
mod watch;

use std::time::Duration;

use bytes::Bytes;
use mr360_protocol::clock::ServerTime;
use mr360_protocol::video::{Colour, StereoLayout};

pub use self::clock::ServerClock;
pub use self::error::IngestError;
pub use self::frames::{DecodeOptions, DecodedFrames, decode_frames};
pub use self::layout::Projection;
pub use self::run::{IngestHandle, spawn};
pub use self::source::{Address, Source};
use crate::frame::Frame;

/// What is ingested, and what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct IngestConfig {
    /// Where it comes from.
    pub source: Source,
    /// A file starts again when it ends.
    pub looped: bool,
    /// Stereo layout; overrules metadata.
    pub stereo: Option<StereoLayout>,
    /// Projection; overrules metadata. Anything but equirect is transcoded.
    pub projection: Option<Projection>,
    /// Wider video is transcoded down to this many columns.
    pub max_width: Option<u32>,
    /// Longest silence of a stream before it counts as lost. A stream that is being opened has some seconds more, and a listener waits
    /// for its push as long as it takes.
    pub silence: Duration,
}

/// Silence after which a stream counts as lost unless told otherwise: longer than the longest usual HLS segment takes to appear (6 s).
const SILENCE: Duration = Duration::from_secs(10);

impl IngestConfig {
    /// The source as it is, once.
    #[must_use]
    pub fn new(source: Source) -> Self {
        Self { source, looped: false, stereo: None, projection: None, max_width: None, silence: SILENCE }
    }

    /// Refuses what cannot hold, and what would do nothing without a word.
    fn check(&self) -> Result<(), IngestError> {
        let refuse = |detail: String| Err(IngestError::UselessFlag { input: self.source.to_string(), detail });
        let bounds = layout::MIN_WIDTH..=layout::MAX_SIDE;
        if let Some(columns) = self.max_width
            && !bounds.contains(&columns)
        {
            return refuse(format!("--max-width {columns} is not {} to {}", bounds.start(), bounds.end()));
        }
        if self.looped && !matches!(self.source, Source::File(_)) {
            return refuse("--loop repeats files; a stream is opened again by itself, and a synthetic source never ends".to_owned());
        }
        if !matches!(self.source, Source::Synthetic(_)) {
            return Ok(());
        }
        if self.max_width.is_some() {
            return refuse("--max-width is for video from outside; write the size as synthetic:NAME?size=1280x640".to_owned());
        }
        if self.stereo.is_some_and(|stereo| stereo != StereoLayout::Mono) {
            return refuse("--stereo does not apply, it is mono".to_owned());
        }
        if self.projection.is_some_and(|projection| projection != Projection::Equirect) {
            return refuse("--projection does not apply, it is equirect".to_owned());
        }
        Ok(())
    }

    fn layout_flags(&self) -> layout::LayoutFlags {
        layout::LayoutFlags { stereo: self.stereo, projection: self.projection }
    }
}

/// Takes what ingest hands on.
///
/// Calls come from several of ingest's threads at once, one for each kind of event, so that a sink that is slow with pictures
/// holds up no packet. It may block: behind a blocked [`IngestEvent::Video`] or [`IngestEvent::Audio`] the source waits, behind a blocked
/// [`IngestEvent::Frame`] pictures are dropped and counted.
pub trait Sink: Send + Sync {
    /// Takes one event.
    fn event(&self, event: IngestEvent);
}

impl<F: Fn(IngestEvent) + Send + Sync> Sink for F {
    fn event(&self, event: IngestEvent) {
        self(event);
    }
}

/// Codec of the broadcast video.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VideoCodec {
    /// Annex B access units with inline parameter sets at keyframes.
    H264,
    /// Annex B access units with inline parameter sets at keyframes.
    Hevc,
    /// Temporal units in low-overhead OBU format, sequence header at keyframes.
    Av1,
}

/// Codec of the broadcast audio.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AudioCodec {
    /// Raw AAC frames (no ADTS); `description` is the AudioSpecificConfig.
    Aac,
    /// Opus packets; `description` is the OpusHead.
    Opus,
}

/// The broadcast video, from its first access unit on.
#[derive(Debug, Clone, PartialEq)]
pub struct VideoInfo {
    /// Its codec.
    pub codec: VideoCodec,
    /// Columns of the coded equirect frame.
    pub width: u32,
    /// Rows of the coded equirect frame.
    pub height: u32,
    /// Frames a second, nominal.
    pub frame_rate: f64,
    /// Where the eyes' views lie.
    pub stereo: StereoLayout,
    /// What the codes mean.
    pub colour: Colour,
    /// Why the video is transcoded; `None` when packets pass through.
    pub transcoded_because: Option<String>,
}

#[cfg(test)]
impl VideoInfo {
    /// A small H.264 stream, for tests of what comes after ingest.
    pub(crate) fn small() -> Self {
        Self {
            codec: VideoCodec::H264,
            width: 256,
            height: 128,
            frame_rate: 10.0,
            stereo: StereoLayout::Mono,
            colour: Colour::default(),
            transcoded_because: None,
        }
    }
}

/// The broadcast audio.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AudioInfo {
    /// Its codec.
    pub codec: AudioCodec,
    /// Samples a second.
    pub sample_rate: u32,
    /// Channels.
    pub channels: u32,
    /// Codec description as the codec says.
    pub description: Bytes,
}

/// One coded video frame.
#[derive(Debug, Clone)]
pub struct AccessUnit {
    /// Microseconds since the start of the broadcast; rises strictly.
    pub pts_us: u64,
    /// Can be decoded on its own; starts a group.
    pub keyframe: bool,
    /// The coded bytes.
    pub data: Bytes,
    /// When the source's packet (or the synthetic frame) was taken in.
    pub ingested: ServerTime,
}

/// One coded audio packet.
#[derive(Debug, Clone)]
pub struct AudioPacket {
    /// Microseconds since the start of the broadcast, on the video's timeline.
    pub pts_us: u64,
    /// The coded bytes.
    pub data: Bytes,
}

/// What was survived, counted since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct IngestCounters {
    /// Times the source was opened again after it had been lost.
    pub reconnects: u64,
    /// Timestamps that jumped and were mended.
    pub timestamp_jumps: u64,
    /// Changes of the picture's size or pixel format.
    pub format_changes: u64,
    /// Packets that the demuxer or decoder refused.
    pub corrupt_packets: u64,
    /// Decoded frames that light was too slow for.
    pub frames_without_light: u64,
}

/// What ingest hands on. Calls come from ingest's own threads, in presentation order for each kind.
pub enum IngestEvent {
    /// The formats, before the first packet and again whenever they change.
    Started(VideoInfo, Option<AudioInfo>),
    /// A coded frame, ready to broadcast.
    Video(AccessUnit),
    /// The decoded picture of the access unit with the same `pts_us`, with the time when it was decoded.
    Frame(Frame, ServerTime),
    /// A coded audio packet.
    Audio(AudioPacket),
    /// The source was lost; ingest tries again by itself.
    Interrupted {
        /// Why, naming the source.
        reason: String,
        /// Until the next try.
        retry_in: Duration,
    },
}
