//! What can go wrong with a source. Every message names the input, the fault and the remedy.

use super::layout::{MAX_SIDE, MIN_HEIGHT, MIN_WIDTH};

/// Why a source cannot be used, or was lost.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IngestError {
    /// Nothing at that path.
    #[error("{input}: no such file; give an existing video file, a URL such as rtmp://HOST/APP/KEY, or synthetic:NAME")]
    MissingFile {
        /// The path as given.
        input: String,
    },
    /// The path is a directory or a device.
    #[error("{input}: not a regular file; give the video file itself")]
    NotAFile {
        /// The path as given.
        input: String,
    },
    /// The file cannot be read.
    #[error("{input}: cannot be read ({detail}); check its permissions")]
    Unreadable {
        /// The path as given.
        input: String,
        /// What the system said.
        detail: String,
    },
    /// A file of zero bytes.
    #[error("{input}: the file is empty; was the recording or the download cut off?")]
    EmptyFile {
        /// The path as given.
        input: String,
    },
    /// Not a URL that ingest can open.
    #[error("{input}: not a usable URL ({detail}); use SCHEME://HOST:PORT/PATH with one of rtmp, rtmps, srt, rtsp, http, https, udp, rtp")]
    BadUrl {
        /// The URL as given.
        input: String,
        /// What is wrong with it.
        detail: String,
    },
    /// No demuxer makes sense of it.
    #[error("{input}: not a video, or damaged beyond use ({detail}); check that ffprobe can read it")]
    NotAVideo {
        /// The input.
        input: String,
        /// What FFmpeg said.
        detail: String,
    },
    /// Only audio or data inside.
    #[error("{input}: has no video stream; give a source with 360° video")]
    NoVideoStream {
        /// The input.
        input: String,
    },
    /// No decoder for the video.
    #[error("{input}: video codec {codec} cannot be decoded by this FFmpeg; convert it to H.264 first")]
    UnsupportedCodec {
        /// The input.
        input: String,
        /// Name of the codec.
        codec: String,
    },
    /// The picture is too small or too large.
    #[error(
        "{input}: {width}×{height} pixels is outside {MIN_WIDTH}×{MIN_HEIGHT} to {MAX_SIDE}×{MAX_SIDE}; scale the video before sending it"
    )]
    UnsupportedSize {
        /// The input.
        input: String,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The spherical metadata asks for something that is not a whole sphere.
    #[error("{input}: {detail}; pad the video to a whole sphere, or state the projection by flag to overrule the metadata")]
    UnsupportedProjection {
        /// The input.
        input: String,
        /// What the metadata says.
        detail: String,
    },
    /// A flag is out of its range, or means nothing for this source.
    #[error("{input}: {detail}; leave the flag out or change it")]
    UselessFlag {
        /// The input.
        input: String,
        /// Which flag, and why.
        detail: String,
    },
    /// Another program listens there.
    #[error("{input}: port {port} is in use on this machine; stop the other program or choose another port")]
    PortInUse {
        /// The URL.
        input: String,
        /// The port.
        port: u16,
    },
    /// The address to listen on is not one of this machine, or not allowed.
    #[error("{input}: cannot listen there ({detail}); use 0.0.0.0 or an address of this machine, and a port above 1023")]
    CannotListen {
        /// The URL.
        input: String,
        /// What the system said.
        detail: String,
    },
    /// No synthetic source of that name.
    #[error("synthetic:{name}: no such synthetic source; known are {known}")]
    UnknownSynthetic {
        /// The name as given.
        name: String,
        /// The names there are.
        known: String,
    },
    /// A synthetic source's parameters are wrong.
    #[error("synthetic:{name}: {detail}; write it like synthetic:NAME?size=1280x640&fps=30")]
    BadSynthetic {
        /// The name as given.
        name: String,
        /// What is wrong.
        detail: String,
    },
    /// The connection could not be made.
    #[error("{input}: cannot be opened ({detail}); check the address and that the sender is running")]
    Unreachable {
        /// The URL.
        input: String,
        /// What FFmpeg said.
        detail: String,
    },
    /// The connection or the stream ended.
    #[error("{input}: the stream ended ({detail}); restart the sender")]
    Lost {
        /// The input.
        input: String,
        /// What FFmpeg said.
        detail: String,
    },
    /// The video must be transcoded and cannot be.
    #[error("{input}: cannot be transcoded to {codec} ({detail}); send H.264 or HEVC with keyframes at most 2 s apart and no B frames")]
    Encoder {
        /// The input.
        input: String,
        /// The encoder.
        codec: &'static str,
        /// What FFmpeg said.
        detail: String,
    },
    /// A decoded picture could not be brought to the form that is needed.
    #[error("{input}: pictures cannot be converted ({detail}); send 8 or 10 bit YUV")]
    Convert {
        /// The input.
        input: String,
        /// What FFmpeg said.
        detail: String,
    },
    /// The system refused a thread.
    #[error("{input}: no thread for ingest ({detail}); raise the process's limits")]
    Thread {
        /// The input.
        input: String,
        /// What the system said.
        detail: String,
    },
    /// Ingest was asked to stop.
    #[error("{input}: stopped")]
    Stopped {
        /// The input.
        input: String,
    },
}
