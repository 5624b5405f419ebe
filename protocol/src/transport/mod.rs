//! MoQ over WebTransport over QUIC (quinn): certificates, a listener for viewers, a dialer that reconnects.
//!
//! What is published and subscribed goes through moq-net [origins](moq_net::origin); a session only joins two of them.

mod certificate;
mod closer;
mod dialer;
mod listener;

pub use certificate::{Certificate, CertificateError};
pub use closer::Closer;
pub use dialer::{DialError, Dialer, LinkEvent};
pub use listener::{ListenError, Listener};

use std::sync::Arc;
use std::time::Duration;

/// ALPN of HTTP/3, which carries WebTransport.
const ALPN_H3: &[u8] = b"h3";
/// A peer that is silent for this long is gone. Short, since a killed server says nothing; one that ends in order does, see [`Closer`].
const IDLE_TIMEOUT: Duration = Duration::from_secs(5);
/// Sent when there is nothing else to send.
const KEEP_ALIVE: Duration = Duration::from_secs(1);
/// Most bytes of groups kept for late joiners and slow readers. A second of 8K video takes about 10 MB.
const CACHE_BYTES: u64 = 256 * 1024 * 1024;
/// Groups that nobody reads are dropped after this time.
const CACHE_EXPIRY: Duration = Duration::from_secs(10);

/// What a session takes from us and gives to us.
#[derive(Clone, Default)]
pub struct Roles {
    /// Broadcasts that the peer may read.
    pub publish: Option<moq_net::origin::Consumer>,
    /// Where the peer's broadcasts go, scoped to what it may publish.
    pub subscribe: Option<moq_net::origin::Producer>,
}

/// An origin with a bounded cache, and its driver running on the ambient runtime.
#[must_use]
pub fn origin() -> moq_net::origin::Producer {
    let mut config = moq_net::origin::Config::default();
    config.pool = moq_net::cache::Pool::new(moq_net::cache::Config::default().with_capacity(CACHE_BYTES).with_expiry(CACHE_EXPIRY));
    let (producer, driver) = moq_net::origin::Producer::new(config);
    tokio::spawn(moq_net::time::run(driver));
    producer
}

fn transport_config() -> Arc<quinn::TransportConfig> {
    let mut config = quinn::TransportConfig::default();
    // Fits quinn's range: a constant of five seconds.
    config.max_idle_timeout(IDLE_TIMEOUT.try_into().ok());
    config.keep_alive_interval(Some(KEEP_ALIVE));
    // One stream a group: light alone opens one for every video frame, and a stalled reader holds its own open.
    config.max_concurrent_uni_streams(4096u32.into());
    config.max_concurrent_bidi_streams(1024u32.into());
    Arc::new(config)
}

fn crypto_provider() -> Arc<rustls::crypto::CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

/// MoQ versions as WebTransport subprotocols, best first.
fn subprotocols() -> Vec<String> {
    moq_net::Versions::all().alpns().into_iter().map(str::to_owned).collect()
}

#[cfg(test)]
mod tests;
