//! Bounded, versioned encoding of our own messages: one version byte, then bincode.
//!
//! Every decode is bounded in size and refuses trailing bytes; the message's own `validate` then bounds
//! counts and ranges and refuses non-finite numbers.

use bincode::config::{Configuration, Limit, LittleEndian, Varint};
use bytes::Bytes;
use serde::{Serialize, de::DeserializeOwned};

/// Most bytes one of our own messages may take, encoded. Assets are raw bytes and have their own bound.
pub const MAX_MESSAGE_BYTES: usize = 256 * 1024;

/// Why a message could not be encoded or was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WireError {
    /// Written by a newer or older program.
    #[error("{message}: wire version {got}, this program speaks {expected}; use matching server and client versions")]
    UnknownVersion {
        /// Which kind of message.
        message: &'static str,
        /// The version found.
        got: u8,
        /// The version this program speaks.
        expected: u8,
    },
    /// Too short, too long, or not decodable.
    #[error("{message}: malformed ({detail}); the message is dropped")]
    Malformed {
        /// Which kind of message.
        message: &'static str,
        /// What was wrong.
        detail: String,
    },
    /// Decodable, but a value is outside its range.
    #[error("{message}: {field} is out of range ({detail}); the message is dropped")]
    OutOfRange {
        /// Which kind of message.
        message: &'static str,
        /// Which field.
        field: &'static str,
        /// What was wrong.
        detail: String,
    },
}

/// A message with a name, a version and range checks of its own.
pub trait Message: Serialize + DeserializeOwned {
    /// Name in error messages.
    const NAME: &'static str;
    /// Raised on every incompatible change.
    const VERSION: u8;

    /// Bounds counts and ranges; refuses non-finite numbers.
    ///
    /// # Errors
    /// [`WireError::OutOfRange`] naming the field.
    fn validate(&self) -> Result<(), WireError>;

    /// Encodes as one version byte followed by the body.
    ///
    /// # Errors
    /// When the message breaks its own bounds: what we would refuse to read, we refuse to send.
    fn to_wire(&self) -> Result<Bytes, WireError> {
        self.validate()?;
        let mut out = vec![Self::VERSION];
        bincode::serde::encode_into_std_write(self, &mut out, configuration()).map_err(|error| malformed::<Self>(error.to_string()))?;
        if out.len() > MAX_MESSAGE_BYTES {
            return Err(malformed::<Self>(format!("{} bytes, at most {MAX_MESSAGE_BYTES}", out.len())));
        }
        Ok(out.into())
    }

    /// Decodes what [`Message::to_wire`] wrote.
    ///
    /// # Errors
    /// [`WireError`] for an unknown version, malformed or trailing bytes, and values out of range.
    fn from_wire(wire: &[u8]) -> Result<Self, WireError> {
        if wire.len() > MAX_MESSAGE_BYTES {
            return Err(malformed::<Self>(format!("{} bytes, at most {MAX_MESSAGE_BYTES}", wire.len())));
        }
        let (&version, body) = wire.split_first().ok_or_else(|| malformed::<Self>("empty".to_owned()))?;
        if version != Self::VERSION {
            return Err(WireError::UnknownVersion { message: Self::NAME, got: version, expected: Self::VERSION });
        }
        let (message, used): (Self, usize) =
            bincode::serde::decode_from_slice(body, configuration()).map_err(|error| malformed::<Self>(error.to_string()))?;
        if used != body.len() {
            return Err(malformed::<Self>(format!("{} trailing bytes", body.len() - used)));
        }
        message.validate()?;
        Ok(message)
    }
}

fn malformed<M: Message>(detail: String) -> WireError {
    WireError::Malformed { message: M::NAME, detail }
}

fn configuration() -> Configuration<LittleEndian, Varint, Limit<MAX_MESSAGE_BYTES>> {
    bincode::config::standard().with_limit::<MAX_MESSAGE_BYTES>()
}

/// Fails with [`WireError::OutOfRange`] unless `ok`.
///
/// # Errors
/// The error it is asked for.
pub fn ensure_in_range(ok: bool, message: &'static str, field: &'static str, detail: impl FnOnce() -> String) -> Result<(), WireError> {
    if ok { Ok(()) } else { Err(WireError::OutOfRange { message, field, detail: detail() }) }
}
