//! The join URL: `https://HOST:PORT/PATH?QUERY#room=NAME,sha256=FINGERPRINT`.
//!
//! All that a MoQ endpoint needs (a relay's path and token included) stands before the fragment; the fragment
//! is for the viewer alone and never leaves it: the room, and the fingerprint of a self-signed certificate. A comma parts them, since an
//! ampersand ends a command where a URL is pasted into a shell without quotes; URLs with an ampersand there are read, too.

use std::fmt;
use std::str::FromStr;

use url::Url;

use crate::asset::parse_sha256;
use crate::track::{MAX_ROOM_CHARS, is_valid_room};

/// Room of a broadcast that was given no name.
pub const DEFAULT_ROOM: &str = "live";

/// A parsed join URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JoinUrl {
    /// Endpoint, without fragment.
    pub endpoint: Url,
    /// Room to join.
    pub room: String,
    /// SHA-256 of the server's certificate; `None` means that the system's authorities decide.
    pub fingerprint: Option<[u8; 32]>,
}

/// Why a text is not a join URL.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("join URL {url:?}: {fault}; expected https://HOST:PORT/#room=NAME,sha256=64-HEX-DIGITS as printed by mr360-server")]
pub struct JoinUrlError {
    url: String,
    fault: String,
}

impl FromStr for JoinUrl {
    type Err = JoinUrlError;

    fn from_str(text: &str) -> Result<Self, JoinUrlError> {
        let fail = |fault: String| JoinUrlError { url: without_query(text), fault };
        let mut endpoint = Url::parse(text).map_err(|error| fail(error.to_string()))?;
        if endpoint.scheme() != "https" {
            return Err(fail(format!("scheme {:?} is not https", endpoint.scheme())));
        }
        if endpoint.host().is_none() {
            return Err(fail("no host".to_owned()));
        }
        let mut room = DEFAULT_ROOM.to_owned();
        let mut fingerprint = None;
        let fragment = endpoint.fragment().unwrap_or_default().to_owned();
        for pair in fragment.split([',', '&']).filter(|pair| !pair.is_empty()) {
            match pair.split_once('=') {
                Some(("room", name)) if is_valid_room(name) => name.clone_into(&mut room),
                Some(("room", name)) => {
                    return Err(fail(format!("room {name:?} is not 1 to {MAX_ROOM_CHARS} of a-z A-Z 0-9 - _")));
                }
                Some(("sha256", hex)) => fingerprint = Some(parse_sha256(hex).map_err(|error| fail(error.to_string()))?),
                _ => return Err(fail(format!("unknown part {pair:?} after #"))),
            }
        }
        endpoint.set_fragment(None);
        Ok(Self { endpoint, room, fingerprint })
    }
}

/// An endpoint as logs and errors may show it: a query may hold a token, and so may what stands before the host.
#[must_use]
pub fn without_secrets(endpoint: &Url) -> Url {
    let mut shown = endpoint.clone();
    shown.set_query(None);
    // Refused only for URLs that have no host; those have no user either.
    let _ = shown.set_username("");
    let _ = shown.set_password(None);
    shown
}

/// The text without what stands between `?` and `#`.
fn without_query(text: &str) -> String {
    let (endpoint, fragment) = text.split_at(text.find('#').unwrap_or(text.len()));
    let shown = endpoint.split('?').next().unwrap_or_default();
    format!("{shown}{fragment}")
}

impl fmt::Display for JoinUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#room={}", self.endpoint, self.room)?;
        if let Some(fingerprint) = self.fingerprint {
            write!(f, ",sha256=")?;
            fingerprint.iter().try_for_each(|byte| write!(f, "{byte:02x}"))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip() {
        let text = format!("https://127.0.0.1:4443/anon?jwt=x#room=stage-1,sha256={}", "0a".repeat(32));
        let join: JoinUrl = text.parse().unwrap();
        assert_eq!(join.endpoint.as_str(), "https://127.0.0.1:4443/anon?jwt=x");
        assert_eq!(join.room, "stage-1");
        assert_eq!(join.fingerprint, Some([10; 32]));
        assert_eq!(join.to_string(), text);
    }

    #[test]
    fn a_printed_url_needs_no_quotes_and_older_ones_are_read() {
        let endpoint = "https://127.0.0.1:4443/".parse().unwrap();
        let join = JoinUrl { endpoint, room: "live".to_owned(), fingerprint: Some([10; 32]) };
        let text = join.to_string();
        // What POSIX shells take as it is, a # within a word included.
        assert!(text.bytes().all(|b| b.is_ascii_alphanumeric() || b"%+,-./:=@_#".contains(&b)), "{text}");
        assert_eq!(text.replace(',', "&").parse(), Ok(join));
    }

    #[test]
    fn tokens_are_not_shown() {
        let endpoint: Url = "https://user:secret@relay:4443/anon?jwt=secret".parse().unwrap();
        assert_eq!(without_secrets(&endpoint).as_str(), "https://relay:4443/anon");
        let error = "https://relay/?jwt=secret#colour=red".parse::<JoinUrl>().unwrap_err().to_string();
        assert!(error.contains("https://relay/#colour=red") && !error.contains("secret"), "{error}");
    }

    #[test]
    fn room_defaults() {
        let join: JoinUrl = "https://host/".parse().unwrap();
        assert_eq!((join.room.as_str(), join.fingerprint), (DEFAULT_ROOM, None));
    }

    #[test]
    fn faults_are_named() {
        for (text, fault) in [
            ("nonsense", "relative URL"),
            ("http://host/", "not https"),
            ("https://host/#room=a/b", "room"),
            ("https://host/#sha256=12", "64 hexadecimal"),
            ("https://host/#colour=red", "unknown part"),
        ] {
            let error = text.parse::<JoinUrl>().unwrap_err().to_string();
            assert!(error.contains(fault) && error.contains(text), "{error}");
        }
    }
}
