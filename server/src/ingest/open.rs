//! Opening a source so that nothing can hang for ever.

use std::path::Path;
use std::time::Duration;

use ffmpeg_next::codec::{Id, Parameters};
use ffmpeg_next::{Dictionary, Error, Rational, decoder, format, media};

use super::error::IngestError;
use super::layout::SphericalMetadata;
use super::raw;
use super::source::{Address, Source, check_file};
use super::watch::Watch;

/// Longest wait for a file to show its formats; it may lie on a network drive.
const FILE_PATIENCE: Duration = Duration::from_secs(15);
/// Time to show its formats that an answering stream has besides: twice `analyzeduration`, and as much again for handshakes.
const PROBE_PATIENCE: Duration = Duration::from_secs(5);
/// Longest wait for a push before the listening socket is made anew, which sheds peers that connected and stalled.
const LISTEN_PATIENCE: Duration = Duration::from_secs(60);
/// Frames a second where the source does not say.
const DEFAULT_RATE: f64 = 30.0;

/// An open source and the streams that are broadcast.
pub(super) struct Opened {
    pub(super) input: format::context::Input,
    pub(super) video: VideoStream,
    pub(super) audio: Option<AudioStream>,
}

pub(super) struct VideoStream {
    pub(super) index: usize,
    pub(super) time_base: Rational,
    pub(super) parameters: Parameters,
    pub(super) frame_rate: f64,
    pub(super) spherical: SphericalMetadata,
}

pub(super) struct AudioStream {
    pub(super) index: usize,
    pub(super) time_base: Rational,
    pub(super) parameters: Parameters,
}

/// Opens a file or URL and picks its video and audio. A URL that stays silent for longer than `silence` is given up.
pub(super) fn open(source: &Source, silence: Duration, watch: &Watch) -> Result<Opened, IngestError> {
    let name = source.to_string();
    let input = match source {
        Source::File(path) => open_file(path, watch)?,
        Source::Url(address) => open_address(address, silence, watch)?,
        Source::Synthetic(_) => return Err(IngestError::NotAVideo { input: name, detail: "synthetic sources are not opened".to_owned() }),
    };
    pick_streams(input, &name)
}

fn open_file(path: &Path, watch: &Watch) -> Result<format::context::Input, IngestError> {
    check_file(path)?;
    watch.begin(FILE_PATIENCE);
    let interrupt = watch.clone();
    format::input_with_interrupt(path, move || interrupt.interrupts()).map_err(|error| {
        let input = path.display().to_string();
        if watch.stopped() { IngestError::Stopped { input } } else { IngestError::NotAVideo { input, detail: error.to_string() } }
    })
}

fn open_address(address: &Address, silence: Duration, watch: &Watch) -> Result<format::context::Input, IngestError> {
    let attempt = |options| {
        watch.begin(if address.listening { LISTEN_PATIENCE } else { silence.saturating_add(PROBE_PATIENCE) });
        let interrupt = watch.clone();
        format::input_with_interrupt_and_dictionary(&address.url, move || interrupt.interrupts(), options)
    };
    let opened = match attempt(options(address)) {
        // FFmpeg turns to UDP only where the server answers 461; some refuse TCP as a request that they do not understand.
        Err(Error::HttpBadRequest | Error::HttpOther4xx) if address.scheme == "rtsp" && !address.listening => {
            let mut over_udp = options(address);
            over_udp.set("rtsp_transport", "udp");
            attempt(over_udp)
        }
        first => first,
    };
    opened.map_err(|error| open_error(address, watch, error))
}

fn open_error(address: &Address, watch: &Watch, error: Error) -> IngestError {
    let input = address.to_string();
    if watch.stopped() {
        return IngestError::Stopped { input };
    }
    if watch.timed_out() {
        let detail = if address.listening { "nobody pushed" } else { "no answer in time" };
        return IngestError::Unreachable { input, detail: detail.to_owned() };
    }
    match error {
        Error::Other { errno: ffmpeg_next::error::EADDRINUSE } => {
            IngestError::PortInUse { input, port: address.listening_port().or(address.port).unwrap_or(0) }
        }
        error => IngestError::Unreachable { input, detail: error.to_string() },
    }
}

/// Options for low latency. `fflags=nobuffer` is not among them: it throws away the packets read while probing, and
/// with them the first keyframe. Probing is bounded instead; what it read is handed on at once.
fn options(address: &Address) -> Dictionary<'static> {
    let mut options = Dictionary::new();
    options.set("probesize", "4000000");
    options.set("analyzeduration", "1000000");
    match address.scheme.as_str() {
        "rtmp" | "rtmps" => {
            options.set("rtmp_live", "live");
            // The frame rate is in the stream's metadata; counting frames for it would cost most of a second.
            options.set("fpsprobesize", "0");
            if address.listening {
                options.set("listen", "1");
            }
        }
        "srt" => options.set("mode", if address.listening { "listener" } else { "caller" }),
        "rtsp" | "rtsps" if address.listening => options.set("rtsp_flags", "listen"),
        "rtsp" | "rtsps" => options.set("rtsp_flags", "prefer_tcp"),
        // A playlist may only lead to where a stream may come from, never to local files.
        "http" | "https" => options.set("protocol_whitelist", "http,https,tls,tcp,httpproxy,crypto,hls"),
        "udp" => options.set("overrun_nonfatal", "1"),
        _ => {}
    }
    options
}

/// Fails at once if the port of a listener is taken; FFmpeg would only find out on its own thread.
pub(super) fn check_port(address: &Address) -> Result<(), IngestError> {
    let Some(port) = address.listening_port() else { return Ok(()) };
    let host = if address.host.is_empty() { "0.0.0.0" } else { address.host.as_str() };
    let tried = if address.scheme == "srt" {
        std::net::UdpSocket::bind((host, port)).map(drop)
    } else {
        std::net::TcpListener::bind((host, port)).map(drop)
    };
    tried.map_err(|error| match error.kind() {
        std::io::ErrorKind::AddrInUse => IngestError::PortInUse { input: address.to_string(), port },
        _ => IngestError::CannotListen { input: address.to_string(), detail: error.to_string() },
    })
}

fn pick_streams(input: format::context::Input, name: &str) -> Result<Opened, IngestError> {
    let video = input.streams().best(media::Type::Video).ok_or_else(|| IngestError::NoVideoStream { input: name.to_owned() })?;
    // Cover art is a video stream to FFmpeg.
    if video.disposition().contains(format::stream::Disposition::ATTACHED_PIC) {
        return Err(IngestError::NoVideoStream { input: name.to_owned() });
    }
    let parameters = video.parameters().clone();
    if parameters.id() == Id::None || decoder::find(parameters.id()).is_none() {
        return Err(IngestError::UnsupportedCodec { input: name.to_owned(), codec: format!("{:?}", parameters.id()) });
    }
    let shape = raw::video_parameters(&parameters);
    if shape.width == 0 || shape.height == 0 {
        let detail = "no picture could be read".to_owned();
        return Err(IngestError::NotAVideo { input: name.to_owned(), detail });
    }
    let video = VideoStream {
        index: video.index(),
        time_base: video.time_base(),
        frame_rate: rate(video.avg_frame_rate()).or_else(|| rate(video.rate())).unwrap_or(DEFAULT_RATE),
        spherical: SphericalMetadata::of(&video),
        parameters,
    };
    let audio = input.streams().best(media::Type::Audio).map(|stream| AudioStream {
        index: stream.index(),
        time_base: stream.time_base(),
        parameters: stream.parameters().clone(),
    });
    Ok(Opened { input, video, audio })
}

fn rate(rate: Rational) -> Option<f64> {
    let value = f64::from(rate.0) / f64::from(rate.1);
    (1.0..=240.0).contains(&value).then_some(value)
}
