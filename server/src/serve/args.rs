//! Flags and configuration file of `serve`, made into one set of settings.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use mr360_protocol::join::{DEFAULT_ROOM, JoinUrl, without_secrets};
use mr360_protocol::track::{MAX_ROOM_CHARS, is_valid_room};
use serde::de::Error;
use serde::{Deserialize, Deserializer};
use url::Url;

use crate::analyze::StereoArg;
use crate::ingest::{IngestConfig, Projection, Source};
use crate::lighting::MethodSpec;

/// Default address: every interface, the port that MoQ relays use.
const DEFAULT_LISTEN: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::UNSPECIFIED), 4443);
/// Largest configuration file that is read.
const MAX_CONFIG_BYTES: u64 = 1024 * 1024;

/// Host a live broadcast.
#[derive(Debug, Clone, Default, Args, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub struct ServeArgs {
    /// A file, a URL (rtmp, srt, rtsp, http, udp, rtp; add ?listen=1 to wait for a push), or synthetic:plaza.
    #[arg(long, value_name = "URL|FILE|synthetic:NAME")]
    pub source: Option<String>,
    /// Start a file again when it ends.
    #[arg(long = "loop")]
    #[serde(rename = "loop")]
    pub looped: bool,
    /// The objects of the session.
    #[arg(long, value_name = "SCENE.toml")]
    pub scene: Option<PathBuf>,
    /// Address for viewers, UDP; port 0 takes any free one [default: 0.0.0.0:4443, or none with --publish].
    #[arg(long, value_name = "ADDR", value_parser = parse_listen)]
    #[serde(deserialize_with = "deserialize_listen")]
    pub listen: Option<SocketAddr>,
    /// Host name or address in the printed join URL [default: this host's own address].
    #[arg(long, value_name = "NAME")]
    pub host: Option<String>,
    /// Name of the room [default: live].
    #[arg(long, value_name = "NAME")]
    pub room: Option<String>,
    /// Publish to a MoQ relay; add #sha256=FINGERPRINT for a self-signed one.
    #[arg(long, value_name = "RELAY_URL")]
    pub publish: Option<String>,
    /// Where viewers reach what --publish takes, with a token of theirs where one is needed [default: RELAY_URL without its query, which may
    /// hold the publisher's].
    #[arg(long, value_name = "RELAY_URL")]
    pub viewers_url: Option<String>,
    /// Light method.
    #[arg(long, value_name = "NAME[:N]", help = format!("Light method: {} [default: {}]", MethodSpec::usage(), MethodSpec::default()))]
    pub method: Option<MethodSpec>,
    /// Where the eyes' views lie [default: what the source says].
    #[arg(long, value_enum)]
    pub stereo: Option<StereoArg>,
    /// equirect, cubemap, eac, dual-fisheye or dual-fisheye:DEGREES [default: what the source says].
    #[arg(long, value_name = "NAME")]
    pub projection: Option<Projection>,
    /// Transcode wider video down to this many columns.
    #[arg(long, value_name = "COLUMNS")]
    pub max_width: Option<u32>,
    /// Own certificate chain, PEM; needs --key.
    #[arg(long, value_name = "FILE", requires = "key")]
    pub certificate: Option<PathBuf>,
    /// Key of the own certificate, PEM.
    #[arg(long, value_name = "FILE", requires = "certificate")]
    pub key: Option<PathBuf>,
    /// Folder that keeps the self-signed certificate [default: the user's data folder].
    #[arg(long, value_name = "FOLDER")]
    pub state: Option<PathBuf>,
    /// Write one CSV row a frame.
    #[arg(long, value_name = "OUT.csv")]
    pub stats: Option<PathBuf>,
    /// TOML file with any of these settings, named as the flags; flags win.
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub config: Option<PathBuf>,
}

/// A relay to publish to.
pub(super) struct Relay {
    pub(super) endpoint: Url,
    pub(super) fingerprint: Option<[u8; 32]>,
    /// What viewers are given: no token of the publisher's in it.
    pub(super) join: JoinUrl,
}

/// What holds, checked.
pub(super) struct Settings {
    pub(super) ingest: IngestConfig,
    pub(super) scene: Option<PathBuf>,
    pub(super) listen: Option<SocketAddr>,
    pub(super) host: Option<String>,
    pub(super) room: String,
    pub(super) publish: Option<Relay>,
    pub(super) method: MethodSpec,
    pub(super) certificate: Option<(PathBuf, PathBuf)>,
    pub(super) state: PathBuf,
    pub(super) stats: Option<PathBuf>,
}

impl ServeArgs {
    /// Reads the configuration file, lets flags win, and checks everything that can be checked without opening the source.
    pub(super) fn settle(self) -> anyhow::Result<Settings> {
        let merged = match &self.config {
            Some(path) => read_config(path)?.overruled_by(self),
            None => self,
        };
        let Some(source) = &merged.source else {
            bail!("no source; give --source FILE, --source URL or --source synthetic:plaza");
        };
        let room = merged.room.unwrap_or_else(|| DEFAULT_ROOM.to_owned());
        if !is_valid_room(&room) {
            bail!("--room {room:?}: not 1 to {MAX_ROOM_CHARS} of a-z A-Z 0-9 - _");
        }
        let publish = relay(merged.publish.as_deref(), merged.viewers_url.as_deref(), &room)?;
        let certificate = match (merged.certificate, merged.key) {
            (Some(chain), Some(key)) => Some((chain, key)),
            (None, None) => None,
            _ => bail!("certificate and key belong together; give both or neither"),
        };
        let ingest = IngestConfig {
            looped: merged.looped,
            stereo: merged.stereo.map(Into::into),
            projection: merged.projection,
            max_width: merged.max_width,
            ..IngestConfig::new(Source::parse(source)?)
        };
        Ok(Settings {
            ingest,
            scene: merged.scene,
            listen: merged.listen.or_else(|| publish.is_none().then_some(DEFAULT_LISTEN)),
            host: merged.host,
            room,
            publish,
            method: merged.method.unwrap_or_default(),
            certificate,
            state: match merged.state {
                Some(folder) => folder,
                None => default_state()?,
            },
            stats: merged.stats,
        })
    }

    fn overruled_by(self, flags: Self) -> Self {
        Self {
            source: flags.source.or(self.source),
            looped: flags.looped || self.looped,
            scene: flags.scene.or(self.scene),
            listen: flags.listen.or(self.listen),
            host: flags.host.or(self.host),
            room: flags.room.or(self.room),
            publish: flags.publish.or(self.publish),
            viewers_url: flags.viewers_url.or(self.viewers_url),
            method: flags.method.or(self.method),
            stereo: flags.stereo.or(self.stereo),
            projection: flags.projection.or(self.projection),
            max_width: flags.max_width.or(self.max_width),
            certificate: flags.certificate.or(self.certificate),
            key: flags.key.or(self.key),
            state: flags.state.or(self.state),
            stats: flags.stats.or(self.stats),
            config: flags.config,
        }
    }
}

fn relay(publish: Option<&str>, viewers: Option<&str>, room: &str) -> anyhow::Result<Option<Relay>> {
    let Some(publish) = publish else {
        if viewers.is_some() {
            bail!("--viewers-url is of a relay; give --publish, too");
        }
        return Ok(None);
    };
    let JoinUrl { endpoint, fingerprint, .. } = publish.parse().context("--publish")?;
    let shown = match viewers {
        Some(url) => {
            let given: JoinUrl = url.parse().context("--viewers-url")?;
            JoinUrl { fingerprint: given.fingerprint.or(fingerprint), ..given }
        }
        None => JoinUrl { endpoint: without_secrets(&endpoint), fingerprint, room: String::new() },
    };
    Ok(Some(Relay { endpoint, fingerprint, join: JoinUrl { room: room.to_owned(), ..shown } }))
}

fn parse_listen(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        "not an IP address with a port; write 0.0.0.0:4443 for every interface, 127.0.0.1:0 for this machine alone and any free port, \
         or [::]:4443"
            .to_owned()
    })
}

fn deserialize_listen<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<SocketAddr>, D::Error> {
    let text = String::deserialize(deserializer)?;
    parse_listen(&text).map(Some).map_err(|fault| D::Error::custom(format!("listen = {text:?}: {fault}")))
}

fn read_config(path: &Path) -> anyhow::Result<ServeArgs> {
    let name = || format!("--config {}", path.display());
    if std::fs::metadata(path).with_context(name)?.len() > MAX_CONFIG_BYTES {
        bail!("--config {}: more than {MAX_CONFIG_BYTES} bytes", path.display());
    }
    let text = std::fs::read_to_string(path).with_context(name)?;
    toml::from_str(&text).with_context(name)
}

fn default_state() -> anyhow::Result<PathBuf> {
    let folders = directories::ProjectDirs::from("", "", "mr360").context("no home folder; give --state FOLDER")?;
    Ok(folders.data_dir().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settle(args: ServeArgs) -> Result<Settings, String> {
        args.settle().map_err(|error| format!("{error:#}"))
    }

    fn plaza() -> ServeArgs {
        ServeArgs { source: Some("synthetic:plaza".to_owned()), ..ServeArgs::default() }
    }

    #[test]
    fn flags_win_over_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("serve.toml");
        std::fs::write(&file, "source = \"synthetic:plaza\"\nroom = \"hall\"\nloop = true\nstereo = \"top-bottom\"\nmethod = \"sh:25\"")
            .unwrap();
        let settings = settle(ServeArgs { config: Some(file), room: Some("stage".to_owned()), ..ServeArgs::default() }).unwrap();
        assert_eq!(settings.room, "stage");
        assert!(settings.ingest.looped);
        assert_eq!(settings.method.to_string(), "sh:25");
        assert_eq!(settings.ingest.stereo, Some(mr360_protocol::video::StereoLayout::TopBottom));
    }

    #[test]
    fn faults_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("serve.toml");
        std::fs::write(&file, "sauce = 1").unwrap();
        let method = folder.path().join("method.toml");
        std::fs::write(&method, "method = \"k-means:65\"").unwrap();
        let listen = folder.path().join("listen.toml");
        std::fs::write(&listen, "listen = \"4443\"").unwrap();
        let cases = [
            (ServeArgs::default(), "no source"),
            (ServeArgs { room: Some("a/b".to_owned()), ..plaza() }, "--room"),
            (ServeArgs { publish: Some("relay".to_owned()), ..plaza() }, "--publish"),
            (ServeArgs { viewers_url: Some("https://relay/".to_owned()), ..plaza() }, "--publish"),
            (ServeArgs { config: Some(listen), ..plaza() }, "127.0.0.1:0"),
            (ServeArgs { key: Some("k.pem".into()), ..plaza() }, "belong together"),
            (ServeArgs { config: Some(file), ..plaza() }, "sauce"),
            (ServeArgs { config: Some(method), ..plaza() }, "k-means[:1-64]"),
            (ServeArgs { config: Some("/nowhere.toml".into()), ..plaza() }, "/nowhere.toml"),
            (ServeArgs { source: Some("/nowhere.mp4".to_owned()), ..ServeArgs::default() }, "/nowhere.mp4"),
        ];
        for (args, names) in cases {
            let error = settle(args).err().unwrap();
            assert!(error.contains(names), "{error}");
        }
    }

    #[test]
    fn an_address_to_listen_on_has_an_example() {
        assert_eq!(parse_listen("[::1]:0"), Ok("[::1]:0".parse().unwrap()));
        for text in ["4443", "localhost:0", "0.0.0.0", ""] {
            let error = parse_listen(text).unwrap_err();
            assert!(error.contains("0.0.0.0:4443"), "{error}");
        }
    }

    #[test]
    fn the_publishers_token_is_not_the_viewers() {
        let publish = Some("https://relay:4443/anon?jwt=secret".to_owned());
        let relay = |viewers_url: Option<&str>| {
            let args = ServeArgs {
                publish: publish.clone(),
                viewers_url: viewers_url.map(str::to_owned),
                room: Some("hall".to_owned()),
                ..plaza()
            };
            settle(args).unwrap().publish.unwrap()
        };
        assert_eq!(relay(None).endpoint.query(), Some("jwt=secret"));
        assert_eq!(relay(None).join.to_string(), "https://relay:4443/anon#room=hall");
        assert_eq!(relay(Some("https://edge/?jwt=theirs")).join.to_string(), "https://edge/?jwt=theirs#room=hall");
    }

    #[test]
    fn a_relay_replaces_the_listener_unless_both_are_asked_for() {
        let relay = ServeArgs { publish: Some("https://relay:4443/".to_owned()), ..plaza() };
        assert_eq!(settle(relay.clone()).unwrap().listen, None);
        let both = ServeArgs { listen: Some("127.0.0.1:0".parse().unwrap()), ..relay };
        assert!(settle(both).unwrap().listen.is_some());
        assert_eq!(settle(plaza()).unwrap().listen, Some(DEFAULT_LISTEN));
    }
}
