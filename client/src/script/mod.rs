//! What a user did, as a file: one JSON object a line, each with its time. Recorded in a session, played in another, it ends in the same
//! state. A session records wishes, whatever they came from; lines of hands are written by programs, as tests are.
//!
//! ```json
//! {"at_us":0,"hands":{"hands":[{"grip":{"position":[0,0,0],"orientation":[0,0,0,1]},"select":1},{}],"head":{…}}}
//! {"at_us":500000,"action":{"Release":[1,{"linear":[0,2,-3],"angular":[0,0,0]}]}}
//! ```

mod player;
mod recorder;

pub use player::Player;
pub use recorder::Recorder;

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use mr360_protocol::clock::ClientTime;
use mr360_protocol::codec::Message;
use mr360_protocol::intent::{Action, Intent};
use serde::{Deserialize, Serialize};

use crate::hands::{HandInput, HandsInput, Pose};

/// Largest file that is played.
const MAX_BYTES: u64 = 256 * 1024 * 1024;
/// Longest line: a hundred times what both hands take.
const MAX_LINE_BYTES: usize = 64 * 1024;
/// Most deeds of a script: three hours of hands at 90 Hz.
const MAX_DEEDS: usize = 1_000_000;
/// Latest deed, microseconds: a day.
const MAX_AT_US: u64 = 24 * 3_600 * 1_000_000;

/// Why a script cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScriptError {
    /// Not readable, or too long.
    #[error("{path}: {fault}; check the path and its permissions")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        fault: String,
    },
    /// Cannot be created.
    #[error("{path}: cannot be written: {fault}")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's word.
        fault: String,
    },
    /// Not a script.
    #[error("{path}, line {line}: {fault}; record it anew with --record-input")]
    Line {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        fault: String,
    },
}

/// One line of the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    at_us: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    hands: Option<BothHands>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    action: Option<Action>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BothHands {
    hands: [HandInput; 2],
    head: Pose,
}

/// Something that was done.
#[derive(Debug, Clone, PartialEq)]
// A script is of one kind or the other, and mostly of hands.
#[allow(clippy::large_enum_variant)]
pub enum Deed {
    /// Hands of a frame; what they came to is for the player to find.
    Hands(HandsInput),
    /// A wish, as of mouse and keys, and its time.
    Action(ClientTime, Action),
}

impl Deed {
    /// Since the script's beginning.
    #[must_use]
    pub fn at(&self) -> ClientTime {
        match self {
            Self::Hands(input) => input.now,
            Self::Action(at, _) => *at,
        }
    }

    fn read(line: &str) -> Result<Self, String> {
        let Line { at_us, hands, action } = serde_json::from_str(line).map_err(|error| error.to_string())?;
        if at_us > MAX_AT_US {
            return Err(format!("at_us is out of range: {at_us}, at most {MAX_AT_US}"));
        }
        let at = ClientTime(at_us);
        match (hands, action) {
            (Some(BothHands { hands, head }), None) => Ok(Self::Hands(HandsInput { hands, head, now: at, scale: 1.0 })),
            (None, Some(action)) => {
                let intent = Intent { sequence: 0, action };
                intent.validate().map_err(|error| error.to_string())?;
                Ok(Self::Action(at, intent.action))
            }
            _ => Err("neither hands nor an action, or both".to_owned()),
        }
    }

    fn line(&self) -> Line {
        let (at_us, hands, action) = match self.clone() {
            Self::Hands(HandsInput { hands, head, now, .. }) => (now.0, Some(BothHands { hands, head }), None),
            Self::Action(at, action) => (at.0, None, Some(action)),
        };
        Line { at_us, hands, action }
    }
}

/// Reads a whole script.
///
/// # Errors
/// [`ScriptError`] naming the file and the line.
pub fn load(path: &Path) -> Result<Vec<Deed>, ScriptError> {
    let read = |fault: String| ScriptError::Read { path: path.to_owned(), fault };
    let file = fs::File::open(path).map_err(|error| read(error.to_string()))?;
    // What is no file of the disk, as a pipe, tells no length before it is read.
    let mut rest = BufReader::new(file.take(MAX_BYTES + 1));
    let (mut deeds, mut bytes) = (Vec::<Deed>::new(), 0);
    for line in 1.. {
        let wrong = |fault: String| ScriptError::Line { path: path.to_owned(), line, fault };
        let mut text = Vec::new();
        let length = (&mut rest).take(MAX_LINE_BYTES as u64 + 2).read_until(b'\n', &mut text).map_err(|error| wrong(error.to_string()))?;
        if length == 0 {
            break;
        }
        bytes += length as u64;
        if bytes > MAX_BYTES || deeds.len() >= MAX_DEEDS {
            return Err(read(format!("longer than {MAX_BYTES} bytes or {MAX_DEEDS} deeds")));
        }
        let text = text.strip_suffix(b"\n").unwrap_or(&text);
        if text.len() > MAX_LINE_BYTES {
            return Err(wrong(format!("more than {MAX_LINE_BYTES} bytes")));
        }
        let text = std::str::from_utf8(text).map_err(|error| wrong(error.to_string()))?;
        if text.trim().is_empty() {
            continue;
        }
        let deed = Deed::read(text).map_err(wrong)?;
        if deeds.last().is_some_and(|last| last.at() > deed.at()) {
            return Err(wrong("its time lies before that of the line above".to_owned()));
        }
        deeds.push(deed);
    }
    Ok(deeds)
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};
    use mr360_protocol::intent::Motion;
    use mr360_protocol::scene::{ObjectId, Transform};

    use super::*;

    fn deeds() -> Vec<Deed> {
        let pose = Pose { position: Vec3::new(0.1, 1.0 / 3.0, -1e-7), orientation: Quat::from_rotation_y(0.3) };
        let hand = HandInput { grip: Some(pose), select: 0.7, menu: true, ..HandInput::default() };
        let moved = Transform { position: Vec3::new(1.0 / 7.0, -0.0, 3e-38), ..Transform::default() };
        let motion = Motion { linear: Vec3::new(1.0, 2.0, 3.1), angular: Vec3::ZERO };
        vec![
            Deed::Hands(HandsInput { hands: [HandInput::default(), hand], head: pose, now: ClientTime(5), scale: 1.0 }),
            Deed::Action(ClientTime(7), Action::Grab(ObjectId(3))),
            Deed::Action(ClientTime(7), Action::Move(ObjectId(3), moved)),
            Deed::Action(ClientTime(9), Action::Release(ObjectId(3), motion)),
            Deed::Action(ClientTime(11), Action::Put { item: 2, transform: moved }),
            Deed::Action(ClientTime(12), Action::Remove(ObjectId(3))),
        ]
    }

    #[test]
    fn what_is_recorded_is_read_to_the_last_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("script.jsonl");
        let mut recorder = Recorder::create(&path).unwrap();
        for deed in deeds() {
            // Its time begins with the first deed.
            recorder.write(&match deed {
                Deed::Hands(input) => Deed::Hands(HandsInput { now: ClientTime(input.now.0 + 1_000), ..input }),
                Deed::Action(at, action) => Deed::Action(ClientTime(at.0 + 1_000), action),
            });
        }
        drop(recorder);
        let from_zero = |deed: Deed| match deed {
            Deed::Hands(input) => Deed::Hands(HandsInput { now: ClientTime(input.now.0 - 5), ..input }),
            Deed::Action(at, action) => Deed::Action(ClientTime(at.0 - 5), action),
        };
        assert_eq!(load(&path).unwrap(), deeds().into_iter().map(from_zero).collect::<Vec<_>>());
    }

    #[test]
    fn broken_scripts_are_refused_with_their_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("script.jsonl");
        let good = r#"{"at_us":5,"action":{"Grab":1}}"#;
        for (text, says) in [
            (format!("{good}\n{{"), "line 2"),
            (format!("{good}\n\n{{\"at_us\":4,\"action\":{{\"Grab\":1}}}}"), "line 3: its time"),
            ("{\"at_us\":5}".to_owned(), "neither hands nor an action"),
            ("{\"at_us\":5,\"action\":{\"Grab\":1},\"colour\":2}".to_owned(), "colour"),
            (r#"{"at_us":5,"action":{"Release":[1,{"linear":[1e9,0,0],"angular":[0,0,0]}]}}"#.to_owned(), "linear is out of range"),
            ("x".repeat(MAX_LINE_BYTES + 1), "line 1: more than"),
            (format!("{good}\n{{\"at_us\":{},\"action\":{{\"Grab\":1}}}}", u64::MAX), "line 2: at_us is out of range"),
        ] {
            fs::write(&path, text).unwrap();
            let error = load(&path).unwrap_err().to_string();
            assert!(error.contains(says) && error.contains("script.jsonl"), "{says}: {error}");
        }
        // Endless, and of no length.
        #[cfg(unix)]
        assert!(load(Path::new("/dev/zero")).unwrap_err().to_string().contains("line 1: more than"));
        assert!(matches!(load(&folder.path().join("none")), Err(ScriptError::Read { .. })));
        assert!(matches!(Recorder::create(&folder.path().join("no/folder")), Err(ScriptError::Write { .. })));
    }
}
