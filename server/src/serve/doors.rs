//! Where viewers come in: our own listener, a relay, or both.

use std::net::{IpAddr, SocketAddr, UdpSocket};

use anyhow::Context;
use moq_net::{Pattern, Patterns};
use mr360_protocol::join::JoinUrl;
use mr360_protocol::track;
use mr360_protocol::transport::{Certificate, Dialer, LinkEvent, Listener, Roles};

use super::args::Settings;

/// Opens the doors and prints a `join: URL` line on standard output for each.
///
/// # Errors
/// When the address cannot be listened on, the certificate cannot be used, or QUIC cannot be set up.
pub(super) fn open(settings: &Settings, origin: &moq_net::origin::Producer) -> anyhow::Result<()> {
    // What a peer may publish to us: users of this room, and nothing that looks like a broadcast of ours.
    let users = Pattern::subtree(track::user_path(&settings.room, "").trim_end_matches('/')).context("room name")?;
    let users = origin.scope("", &Patterns::from(users))?;
    let roles = Roles { publish: Some(origin.consume()), subscribe: Some(users) };
    if let Some(address) = settings.listen {
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
        announce(&JoinUrl { endpoint, room: settings.room.clone(), fingerprint });
        tokio::spawn(listener.serve(roles.clone()));
    }
    if let Some(relay) = &settings.publish {
        let dialer = Dialer::new(relay.endpoint.clone(), relay.fingerprint)?;
        announce(&JoinUrl { room: settings.room.clone(), ..relay.clone() });
        tokio::spawn(async move {
            let fault = dialer.run(roles, log_link).await;
            tracing::error!(%fault, "no longer published to the relay");
        });
    }
    Ok(())
}

#[expect(clippy::print_stdout, reason = "the join URL is this command's output")]
fn announce(join: &JoinUrl) {
    println!("join: {join}");
}

fn log_link(event: LinkEvent) {
    match event {
        LinkEvent::Up(version) => tracing::info!(version, "published to the relay"),
        LinkEvent::Down { fault, retry_in } => tracing::warn!(%fault, ?retry_in, "relay lost; trying again"),
    }
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
