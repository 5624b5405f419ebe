//! Accepts viewers and serves them MoQ.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{Semaphore, watch};
use web_transport_quinn::Request;
use web_transport_quinn::proto::ConnectResponse;

use super::{ALPN_H3, Certificate, Closer, Roles, closer, crypto_provider, subprotocols, transport_config};

/// Handshakes under way at once; more are refused until some end, so that a flood costs bounded memory.
const MAX_HANDSHAKES: usize = 256;
/// Viewers connected at once; more are refused. Each costs buffers and streams of its own; for more than this there are relays.
const MAX_SESSIONS: usize = 1024;
/// A peer that has not finished its handshake by then is dropped.
const HANDSHAKE_TIMEOUT: std::time::Duration = std::time::Duration::from_secs(10);

/// A bound UDP port.
pub struct Listener {
    pub(super) endpoint: quinn::Endpoint,
    address: SocketAddr,
    max_sessions: usize,
    ending: watch::Sender<bool>,
}

/// Why nobody can be served.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ListenError {
    /// The certificate and the key do not work together.
    #[error("certificate refused: {0}; check that key and certificate belong together")]
    Certificate(String),
    /// The address is taken or not ours.
    #[error("cannot listen on {address}: {fault}; choose another address with --listen, or port 0 for any free one")]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The system's word.
        fault: String,
    },
}

impl Listener {
    /// Binds UDP `address`; port 0 takes any free one.
    ///
    /// # Errors
    /// [`ListenError`] naming the address or the certificate's fault.
    pub fn bind(address: SocketAddr, certificate: Certificate) -> Result<Self, ListenError> {
        let refused = |error: &dyn std::fmt::Display| ListenError::Certificate(error.to_string());
        let mut tls = rustls::ServerConfig::builder_with_provider(crypto_provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .and_then(|builder| builder.with_no_client_auth().with_single_cert(certificate.chain, certificate.key))
            .map_err(|error| refused(&error))?;
        tls.alpn_protocols = vec![ALPN_H3.to_vec()];
        let crypto = quinn::crypto::rustls::QuicServerConfig::try_from(tls).map_err(|error| refused(&error))?;
        let mut config = quinn::ServerConfig::with_crypto(Arc::new(crypto));
        config.transport_config(transport_config());
        let bind_error = |error: std::io::Error| ListenError::Bind { address, fault: error.to_string() };
        let endpoint = quinn::Endpoint::server(config, address).map_err(bind_error)?;
        let address = endpoint.local_addr().map_err(bind_error)?;
        Ok(Self { endpoint, address, max_sessions: MAX_SESSIONS, ending: watch::Sender::new(false) })
    }

    /// The address it is bound to.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends what this listener serves.
    #[must_use]
    pub fn closer(&self) -> Closer {
        Closer::new(&self.endpoint, &self.ending)
    }

    #[cfg(test)]
    pub(super) fn with_max_sessions(self, max_sessions: usize) -> Self {
        Self { max_sessions, ..self }
    }

    /// Serves everyone who comes, each on a task of its own, until dropped or closed.
    pub async fn serve(self, roles: Roles) {
        let handshakes = Arc::new(Semaphore::new(MAX_HANDSHAKES));
        let sessions = Arc::new(Semaphore::new(self.max_sessions));
        while let Some(incoming) = self.endpoint.accept().await {
            let peer = incoming.remote_address();
            let Ok(session_permit) = Arc::clone(&sessions).try_acquire_owned() else {
                tracing::warn!(%peer, "viewer refused: {} are connected, the most this server takes; publish to a relay for more", self.max_sessions);
                incoming.refuse();
                continue;
            };
            let Ok(handshake_permit) = Arc::clone(&handshakes).try_acquire_owned() else {
                incoming.refuse();
                continue;
            };
            let (roles, mut ending) = (roles.clone(), self.ending.subscribe());
            tokio::spawn(async move {
                let handshake = tokio::time::timeout(HANDSHAKE_TIMEOUT, accept(incoming, roles)).await;
                drop(handshake_permit);
                match handshake {
                    Ok(Ok((session, driver))) => {
                        tracing::info!(%peer, "viewer connected");
                        let end = closer::run(&session, driver, &mut ending).await;
                        // The driver may have failed on a stream; why the connection closed is known to the session.
                        if closer::is_in_order(&session.closed().await) {
                            tracing::info!(%peer, "peer gone: its host has ended the broadcast");
                        } else {
                            tracing::info!(%peer, %end, "viewer gone");
                        }
                    }
                    Ok(Err(fault)) => tracing::warn!(%peer, fault, "handshake failed"),
                    Err(_) => tracing::warn!(%peer, "handshake timed out"),
                }
                drop(session_permit);
            });
        }
    }
}

type Session = (moq_net::Session, moq_net::Driver<web_transport_quinn::Session>);

pub(super) async fn accept(incoming: quinn::Incoming, roles: Roles) -> Result<Session, String> {
    let connection = incoming.await.map_err(|error| error.to_string())?;
    let request = Request::accept(connection).await.map_err(|error| error.to_string())?;
    let ours = subprotocols();
    let Some(chosen) = ours.into_iter().find(|name| request.protocols.contains(name)) else {
        let offered = request.protocols.join(", ");
        // The peer is told by the status; that it did not take it changes nothing here.
        let _ = request.reject(http_status_bad_request()).await;
        return Err(format!("no common MoQ version; the peer offers [{offered}]"));
    };
    let session = request.respond(ConnectResponse::OK.with_protocol(chosen)).await.map_err(|error| error.to_string())?;
    let mut server = moq_net::Server::new();
    if let Some(publish) = roles.publish {
        server = server.with_publisher(publish);
    }
    if let Some(subscribe) = roles.subscribe {
        server = server.with_subscriber(subscribe);
    }
    server.accept(Instant::now(), session).await.map_err(|error| error.to_string())
}

fn http_status_bad_request() -> web_transport_quinn::http::StatusCode {
    web_transport_quinn::http::StatusCode::BAD_REQUEST
}
