//! Where viewers come in: our own listener, a relay, or both.

use std::io::Write;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context;
use moq_net::{Pattern, Patterns};
use mr360_protocol::join::JoinUrl;
use mr360_protocol::track;
use mr360_protocol::transport::{Certificate, Closer, DialError, Dialer, LinkEvent, Listener, Roles};
use tokio::task::JoinHandle;

use super::args::Settings;

/// Longest wait for the relay's dialer to return once its connection has been ended.
const RELAY_ENDS_WITHIN: Duration = Duration::from_secs(1);

/// Doors that are ready to be opened: port and certificate are ours, nobody is let in yet.
pub(super) struct Doors {
    room: String,
    listener: Option<(Listener, JoinUrl)>,
    relay: Option<(Dialer, JoinUrl)>,
}

/// Doors that are open.
pub(super) struct Open {
    closers: Vec<Closer>,
    relay: Option<JoinHandle<DialError>>,
    /// Without a listener nobody is served once the relay is lost for good.
    relay_alone: bool,
}

impl Doors {
    /// Binds the port and reads the certificates.
    ///
    /// # Errors
    /// When the address cannot be listened on, a certificate cannot be used, or QUIC cannot be set up.
    pub(super) fn prepare(settings: &Settings) -> anyhow::Result<Self> {
        let listener = settings.listen.map(|address| listen(settings, address)).transpose()?;
        let relay = match &settings.publish {
            Some(relay) => Some((Dialer::new(relay.endpoint.clone(), relay.fingerprint)?, relay.join.clone())),
            None => None,
        };
        Ok(Self { room: settings.room.clone(), listener, relay })
    }

    /// Lets viewers in and prints one `join: URL` line on standard output: at once for a listener, else when the relay is first reached.
    ///
    /// # Errors
    /// When the origin does not take users.
    pub(super) fn open(self, origin: &moq_net::origin::Producer) -> anyhow::Result<Open> {
        // What a peer may publish to us: users of this room, and nothing that looks like a broadcast of ours.
        let users = Pattern::subtree(track::user_path(&self.room, "").trim_end_matches('/')).context("room name")?;
        let users = origin.scope("", &Patterns::from(users))?;
        let roles = Roles { publish: Some(origin.consume()), subscribe: Some(users) };
        let mut closers = Vec::new();
        let (relay_alone, announced) = (self.listener.is_none(), AtomicBool::new(false));
        if let Some((listener, join)) = self.listener {
            closers.push(listener.closer());
            tokio::spawn(listener.serve(roles.clone()));
            announce(&join, &announced);
        }
        let relay = self.relay.map(|(dialer, join)| {
            closers.push(dialer.closer());
            tokio::spawn(dialer.run(roles, move |event| match event {
                LinkEvent::Up(version) => {
                    tracing::info!(version, %join, "published to the relay");
                    announce(&join, &announced);
                }
                LinkEvent::Down { fault, retry_in } => tracing::warn!(%fault, ?retry_in, "relay lost; trying again"),
                LinkEvent::Failed { fault, retry_in } => tracing::warn!(%fault, ?retry_in, "relay not reached; trying again"),
            }))
        });
        Ok(Open { closers, relay, relay_alone })
    }
}

impl Open {
    /// Resolves when the relay is lost for good and the broadcast cannot go on as asked for: there is no listener beside it.
    pub(super) async fn failed(&mut self) -> anyhow::Error {
        if let Some(relay) = &mut self.relay {
            let fault = relay.await;
            self.relay = None;
            let fault = match fault {
                Ok(fault) => anyhow::Error::from(fault),
                Err(error) => anyhow::Error::from(error),
            };
            if self.relay_alone {
                return fault.context("--publish");
            }
            tracing::error!("--publish: {fault:#}; going on with the listener alone");
        }
        std::future::pending().await
    }

    /// Tells everybody that the broadcast is over.
    pub(super) async fn close(self) {
        let farewells: Vec<_> = self.closers.into_iter().map(|closer| tokio::spawn(closer.close())).collect();
        for farewell in farewells {
            // A farewell that failed leaves its peers to notice the silence.
            let _ = farewell.await;
        }
        let Some(mut relay) = self.relay else { return };
        // Never aborted before it was asked: its task is the one that says goodbye to the relay.
        if tokio::time::timeout(RELAY_ENDS_WITHIN, &mut relay).await.is_err() {
            relay.abort();
            tracing::debug!("the relay was not told of the end");
        }
    }
}

fn listen(settings: &Settings, address: SocketAddr) -> anyhow::Result<(Listener, JoinUrl)> {
    let certificate = match &settings.certificate {
        Some((chain, key)) => Certificate::load(chain, key)?,
        None => Certificate::load_or_make(&settings.state)?,
    };
    let fingerprint = certificate.fingerprint();
    let listener = Listener::bind(address, certificate)?;
    let host = settings.host.clone().unwrap_or_else(|| reachable(listener.address()).to_string());
    let authority = if host.contains(':') && !host.starts_with('[') { format!("[{host}]") } else { host };
    let endpoint = format!("https://{authority}:{}/", listener.address().port());
    let endpoint = endpoint.parse().with_context(|| format!("--host {authority}: not a host name or address"))?;
    Ok((listener, JoinUrl { endpoint, room: settings.room.clone(), fingerprint }))
}

/// Prints the line once, whoever comes first; true for the first.
fn announce(join: &JoinUrl, announced: &AtomicBool) -> bool {
    if announced.swap(true, Ordering::Relaxed) {
        return false;
    }
    let mut out = std::io::stdout().lock();
    if let Err(error) = writeln!(out, "join: {join}").and_then(|()| out.flush()) {
        tracing::warn!(%error, %join, "the join URL could not be printed on standard output");
    }
    true
}

/// An address that others can reach a listener at: for one that listens everywhere, this host's own towards the world.
fn reachable(address: SocketAddr) -> IpAddr {
    if !address.ip().is_unspecified() {
        return address.ip();
    }
    // Connecting a UDP socket sends nothing; it only asks which way packets would go.
    let outward = UdpSocket::bind((IpAddr::from([0, 0, 0, 0]), 0))
        .and_then(|socket| socket.connect((IpAddr::from([192, 0, 2, 1]), 9)).and_then(|()| socket.local_addr()));
    outward.map_or(IpAddr::from([127, 0, 0, 1]), |address| address.ip())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::ServeArgs;
    use mr360_protocol::transport;

    #[tokio::test]
    async fn a_relay_of_the_wrong_fingerprint_ends_a_server_without_a_listener() {
        let folder = tempfile::tempdir().unwrap();
        let relay = Listener::bind("127.0.0.1:0".parse().unwrap(), Certificate::load_or_make(folder.path()).unwrap()).unwrap();
        let publish = format!("https://{}/?jwt=secret#sha256={}", relay.address(), "07".repeat(32));
        tokio::spawn(relay.serve(Roles::default()));
        let source = Some("synthetic:plaza".to_owned());
        let args = ServeArgs { source, publish: Some(publish), state: Some(folder.path().to_owned()), ..ServeArgs::default() };
        let doors = Doors::prepare(&args.settle().unwrap()).unwrap();
        let mut open = doors.open(&transport::origin()).unwrap();
        let error = format!("{:#}", open.failed().await);
        assert!(error.contains("--publish") && error.contains(&"07".repeat(32)) && !error.contains("secret"), "{error}");
    }

    #[test]
    fn the_line_is_printed_once() {
        let join = JoinUrl { endpoint: "https://host/".parse().unwrap(), room: "live".to_owned(), fingerprint: None };
        let announced = AtomicBool::new(false);
        assert!(announce(&join, &announced));
        assert!(!announce(&join, &announced));
    }
}
