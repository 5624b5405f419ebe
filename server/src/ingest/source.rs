//! Where a stream comes from, as the user writes it.
//!
//! - `synthetic:NAME` or `synthetic:NAME?size=1280x640&fps=30`: rendered by the program itself.
//! - `SCHEME://…`: a stream. To wait for a push instead of pulling, add `listen=1` to the query of an rtmp, srt or rtsp
//!   URL, for example `rtmp://0.0.0.0:1935/live/KEY?listen=1`; srt's own `mode=listener` means the same. Both are taken out of the
//!   URL and become the protocol's option. All else in the URL reaches the protocol as it is.
//! - anything else: a file.

use std::fmt;
use std::path::{Path, PathBuf};

use super::error::IngestError;

/// Schemes that ingest opens. FFmpeg offers more (`concat:`, `subfile:`, devices); those reach files and hardware
/// that a stream's address has no business with.
const SCHEMES: [&str; 9] = ["rtmp", "rtmps", "srt", "rtsp", "rtsps", "http", "https", "udp", "rtp"];

/// Where a stream comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// A local file, paced to real time.
    File(PathBuf),
    /// A stream over the network, opened again for ever.
    Url(Address),
    /// A picture source of the program's own: a name and its parameters, as in `plaza?size=1280x640&fps=30`.
    Synthetic(String),
}

/// Address of a network stream.
#[derive(Clone, PartialEq, Eq)]
pub struct Address {
    /// For FFmpeg, without the listening parameter.
    pub(super) url: String,
    pub(super) scheme: String,
    pub(super) host: String,
    pub(super) port: Option<u16>,
    /// Wait for a push instead of pulling.
    pub(super) listening: bool,
}

impl Source {
    /// Reads a source as the user writes it.
    ///
    /// # Errors
    /// [`IngestError`] for a missing, empty or unreadable file, a directory, and a URL that cannot be one. Nothing is opened yet.
    pub fn parse(text: &str) -> Result<Self, IngestError> {
        if let Some(name) = text.strip_prefix("synthetic:") {
            return Ok(Self::Synthetic(name.to_owned()));
        }
        if text.contains("://") {
            return Address::parse(text).map(Self::Url);
        }
        check_file(Path::new(text))?;
        Ok(Self::File(PathBuf::from(text)))
    }
}

impl fmt::Display for Source {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(out, "{}", path.display()),
            Self::Url(address) => address.fmt(out),
            Self::Synthetic(name) => write!(out, "synthetic:{name}"),
        }
    }
}

/// Refuses what is not a readable, non-empty regular file.
pub(super) fn check_file(path: &Path) -> Result<(), IngestError> {
    let input = path.display().to_string();
    // FFmpeg takes paths as text.
    if path.to_str().is_none_or(|text| text.contains('\0')) {
        return Err(IngestError::Unreadable { input, detail: "the path is not plain UTF-8".to_owned() });
    }
    let metadata = match std::fs::metadata(path) {
        Ok(metadata) => metadata,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Err(IngestError::MissingFile { input }),
        Err(error) => return Err(IngestError::Unreadable { input, detail: error.to_string() }),
    };
    if !metadata.is_file() {
        return Err(IngestError::NotAFile { input });
    }
    if metadata.len() == 0 {
        return Err(IngestError::EmptyFile { input });
    }
    std::fs::File::open(path).map_err(|error| IngestError::Unreadable { input, detail: error.to_string() })?;
    Ok(())
}

impl Address {
    fn parse(text: &str) -> Result<Self, IngestError> {
        let bad = |detail: &str| IngestError::BadUrl { input: redact(text), detail: detail.to_owned() };
        if text.chars().any(|c| c.is_control() || c.is_whitespace()) {
            return Err(bad("it contains a space or a control character"));
        }
        let (scheme, rest) = text.split_once("://").ok_or_else(|| bad("it has no scheme"))?;
        let scheme = scheme.to_ascii_lowercase();
        if !SCHEMES.contains(&scheme.as_str()) {
            return Err(bad(&format!("scheme {scheme} is not offered")));
        }
        let authority = rest.split(['/', '?']).next().unwrap_or_default();
        let (host, port) = split_authority(authority).map_err(bad)?;
        let (url, listening) = take_listening(&scheme, rest).map_err(bad)?;
        let bare = matches!(scheme.as_str(), "udp" | "rtp") || listening;
        if host.is_empty() && !bare {
            return Err(bad("it names no host"));
        }
        if port.is_none() && matches!(scheme.as_str(), "udp" | "rtp" | "srt") {
            return Err(bad("it names no port"));
        }
        Ok(Self { url: format!("{scheme}://{url}"), host, port, listening, scheme })
    }

    /// The port that a listener takes.
    pub(super) fn listening_port(&self) -> Option<u16> {
        self.listening.then(|| self.port.unwrap_or(if self.scheme.starts_with("rtsp") { 554 } else { 1935 }))
    }
}

/// Without user, password, query and stream key, for logs and errors.
impl fmt::Display for Address {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}", redact(&self.url))
    }
}

impl fmt::Debug for Address {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "Address({self}, listening: {})", self.listening)
    }
}

fn redact(url: &str) -> String {
    let shown = url.split('?').next().unwrap_or_default();
    let Some((scheme, rest)) = shown.split_once("://") else { return shown.to_owned() };
    let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
    let host = authority.rsplit('@').next().unwrap_or_default();
    // rtmp://HOST/APP/KEY: who has the key may publish in the sender's place.
    let application = if scheme.to_ascii_lowercase().starts_with("rtmp") { path.match_indices('/').nth(1) } else { None };
    match application.filter(|(at, _)| at + 1 < path.len()) {
        Some((at, _)) => format!("{scheme}://{host}{}/…", &path[..at]),
        None => format!("{scheme}://{host}{path}"),
    }
}

fn split_authority(authority: &str) -> Result<(String, Option<u16>), &'static str> {
    let place = authority.rsplit('@').next().unwrap_or_default();
    // An IPv6 address stands in brackets and has colons of its own.
    let (host, port) = if let Some(inner) = place.strip_prefix('[') {
        let (host, after) = inner.split_once(']').ok_or("the IPv6 address is not closed by ]")?;
        (host, after.strip_prefix(':'))
    } else {
        place.split_once(':').map_or((place, None), |(host, port)| (host, Some(port)))
    };
    let port = port.map(|port| port.parse::<u16>().ok().filter(|&port| port != 0).ok_or("the port is not 1 to 65535")).transpose()?;
    Ok((host.to_owned(), port))
}

/// Takes `listen=1` or `mode=listener` out of the query.
fn take_listening(scheme: &str, rest: &str) -> Result<(String, bool), &'static str> {
    let Some((place, query)) = rest.split_once('?') else { return Ok((rest.to_owned(), false)) };
    let mut listening = false;
    let mut kept = Vec::new();
    for pair in query.split('&') {
        match pair {
            "listen=1" | "listen" => listening = true,
            "listen=0" => {}
            "mode=listener" if scheme == "srt" => listening = true,
            _ => kept.push(pair),
        }
    }
    if listening && !matches!(scheme, "rtmp" | "srt" | "rtsp") {
        return Err("only rtmp, srt and rtsp can listen for a push; udp and rtp always receive");
    }
    let query = if kept.is_empty() { String::new() } else { format!("?{}", kept.join("&")) };
    Ok((format!("{place}{query}"), listening))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> Address {
        match Source::parse(text) {
            Ok(Source::Url(address)) => address,
            other => panic!("{text}: {other:?}"),
        }
    }

    #[test]
    fn listening_leaves_the_url() {
        let push = address("rtmp://0.0.0.0:1935/live/KEY?listen=1");
        assert_eq!((push.url.as_str(), push.listening, push.listening_port()), ("rtmp://0.0.0.0:1935/live/KEY", true, Some(1935)));
        let push = address("srt://:9000?mode=listener&latency=120000");
        assert_eq!((push.url.as_str(), push.listening, push.port), ("srt://:9000?latency=120000", true, Some(9000)));
        let pull = address("rtmp://host/live/KEY?token=a");
        assert_eq!((pull.url.as_str(), pull.listening, pull.listening_port()), ("rtmp://host/live/KEY?token=a", false, None));
    }

    #[test]
    fn hosts_and_ports() {
        assert_eq!(address("udp://@:1234").port, Some(1234));
        assert_eq!(address("srt://[::1]:9000").host, "::1");
        assert_eq!(address("rtsp://user:secret@camera:8554/live").to_string(), "rtsp://camera:8554/live");
        assert_eq!(address("rtmp://host/live/KEY").to_string(), "rtmp://host/live/…");
        assert_eq!(address("rtmps://host/app").to_string(), "rtmps://host/app");
        assert_eq!(address("https://host/live/show.m3u8").to_string(), "https://host/live/show.m3u8");
        assert_eq!(format!("{:?}", address("srt://h:1?passphrase=secret")), "Address(srt://h:1, listening: false)");
    }

    #[test]
    fn bad_urls_are_refused_with_the_reason() {
        for (text, reason) in [
            ("gopher://host/x", "scheme gopher"),
            ("concat://a|b", "scheme concat"),
            ("rtmp:///live/x", "no host"),
            ("rtmp://host:99999/live", "port"),
            ("rtmp://host:0/live", "port"),
            ("srt://host", "no port"),
            ("rtsp://[::1/x", "closed by ]"),
            ("http://host/x.m3u8?listen=1", "only rtmp, srt and rtsp"),
            ("rtmp://host/a b", "space"),
        ] {
            let error = Source::parse(text).unwrap_err();
            assert!(matches!(error, IngestError::BadUrl { .. }) && error.to_string().contains(reason), "{text}: {error}");
        }
    }

    #[test]
    fn files_are_checked_before_they_are_opened() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name).display().to_string();
        assert!(matches!(Source::parse(&at("none.mp4")), Err(IngestError::MissingFile { .. })));
        assert!(matches!(Source::parse(&at("")), Err(IngestError::NotAFile { .. })));
        std::fs::write(at("empty.mp4"), b"").unwrap();
        assert!(matches!(Source::parse(&at("empty.mp4")), Err(IngestError::EmptyFile { .. })));
        std::fs::write(at("some.mp4"), b"x").unwrap();
        assert!(matches!(Source::parse(&at("some.mp4")), Ok(Source::File(_))));
        assert_eq!(Source::parse("synthetic:plaza?fps=30").unwrap(), Source::Synthetic("plaza?fps=30".to_owned()));
    }
}
