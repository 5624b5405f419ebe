//! Models as content-addressed bytes: the name of an asset is the SHA-256 of what it holds.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Largest asset: what fits one MoQ group (32 MiB) with room for its framing.
pub const MAX_ASSET_BYTES: usize = 31 * 1024 * 1024;
/// Most assets one scene may name.
pub const MAX_ASSETS: usize = 64;

/// SHA-256 of an asset's bytes.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct AssetId([u8; 32]);

impl AssetId {
    /// The name of these bytes.
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }

    /// Name of the track that carries the asset.
    #[must_use]
    pub fn track(&self) -> String {
        format!("asset/{self}")
    }
}

impl fmt::Display for AssetId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for AssetId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "AssetId({self})")
    }
}

/// The text is not 64 hexadecimal digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a SHA-256 is 64 hexadecimal digits")]
pub struct NotSha256;

impl FromStr for AssetId {
    type Err = NotSha256;

    fn from_str(text: &str) -> Result<Self, NotSha256> {
        parse_sha256(text).map(Self)
    }
}

/// Reads 64 hexadecimal digits.
///
/// # Errors
/// [`NotSha256`] for anything else.
pub fn parse_sha256(text: &str) -> Result<[u8; 32], NotSha256> {
    let digits = text.as_bytes();
    if digits.len() != 64 {
        return Err(NotSha256);
    }
    let mut out = [0; 32];
    for (byte, pair) in out.iter_mut().zip(digits.chunks_exact(2)) {
        let nibble = |digit: u8| char::from(digit).to_digit(16).ok_or(NotSha256);
        *byte = u8::try_from(nibble(pair[0])? * 16 + nibble(pair[1])?).map_err(|_| NotSha256)?;
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn name_round_trips_and_is_sha256() {
        let id = AssetId::of(b"abc");
        assert_eq!(id.to_string(), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!(id.to_string().parse(), Ok(id));
        assert_eq!("xyz".parse::<AssetId>(), Err(NotSha256));
        assert_eq!("é".repeat(32).parse::<AssetId>(), Err(NotSha256));
    }
}
