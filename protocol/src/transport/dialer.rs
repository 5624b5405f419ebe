//! Connects to a server or relay, and again whenever the connection is lost.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::{DigitallySignedStruct, SignatureScheme};
use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use tokio::sync::watch;
use url::Url;
use web_transport_quinn::proto::ConnectRequest;

use crate::join::without_secrets;

use super::certificate::fingerprint;
use super::{ALPN_H3, Closer, Roles, closer, crypto_provider, subprotocols, transport_config};

/// First wait before a new try; doubles up to [`MAX_BACKOFF`].
const MIN_BACKOFF: Duration = Duration::from_millis(250);
/// Longest wait before a new try.
const MAX_BACKOFF: Duration = Duration::from_secs(4);
/// A handshake that takes longer has failed.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// Whom to trust and where to go.
pub struct Dialer {
    client: web_transport_quinn::Client,
    socket: quinn::Endpoint,
    endpoint: Url,
    /// False when the system's authorities decide.
    pinned: bool,
    ending: watch::Sender<bool>,
}

/// Why there is no connection. URLs are shown without what may be secret in them.
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum DialError {
    /// No UDP socket, or TLS could not be set up.
    #[error("cannot set up QUIC: {0}")]
    Setup(String),
    /// The certificate is not the one that the join URL names. Trying again will not help.
    #[error("{url}: the server's certificate has fingerprint {got}, the join URL says {expected}; ask the host for the current join URL")]
    WrongFingerprint {
        /// The endpoint.
        url: String,
        /// Of the certificate seen, hexadecimal.
        got: String,
        /// Of the join URL, hexadecimal.
        expected: String,
    },
    /// Nobody vouches for the certificate, and the join URL does not name it. Trying again will not help.
    #[error(
        "{url}: nobody this system trusts vouches for the server's certificate ({fault}), and the URL lacks sha256=; \
         give the whole join URL, in quotes where it holds a & or ?"
    )]
    Untrusted {
        /// The endpoint.
        url: String,
        /// What TLS said.
        fault: String,
    },
    /// The host's name cannot be resolved, and never could.
    #[error("{url}: there is no address for the host name {host:?}; check its spelling, and that this machine can resolve names")]
    UnknownHost {
        /// The endpoint.
        url: String,
        /// The name.
        host: String,
    },
    /// The host ended the session in order.
    #[error("{url}: the host has ended the broadcast")]
    HostEnded {
        /// The endpoint.
        url: String,
    },
    /// This side asked for the end, see [`Dialer::closer`].
    #[error("{url}: the connection was ended by this program")]
    Closed {
        /// The endpoint.
        url: String,
    },
    /// Not reachable, or it refused.
    #[error("{url}: {fault}")]
    Connect {
        /// The endpoint.
        url: String,
        /// What happened.
        fault: String,
    },
}

/// What becomes of the link.
#[derive(Debug, Clone)]
pub enum LinkEvent {
    /// Connected, speaking this MoQ version.
    Up(String),
    /// The connection was lost; tried again after the wait.
    Down {
        /// What happened.
        fault: DialError,
        /// Until the next try.
        retry_in: Duration,
    },
    /// An attempt to connect failed, at first or after a loss; tried again after the wait.
    Failed {
        /// What happened.
        fault: DialError,
        /// Until the next try.
        retry_in: Duration,
    },
}

impl Dialer {
    /// Prepares to connect to `endpoint`; with a fingerprint that very certificate is asked for, without one
    /// the system's authorities decide.
    ///
    /// # Errors
    /// [`DialError::Setup`] when there is no UDP socket or no trust store.
    pub fn new(endpoint: Url, expected: Option<[u8; 32]>) -> Result<Self, DialError> {
        let setup = |error: &dyn std::fmt::Display| DialError::Setup(error.to_string());
        let builder = rustls::ClientConfig::builder_with_provider(crypto_provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(|error| setup(&error))?;
        let mut tls = match expected {
            Some(expected) => {
                builder.dangerous().with_custom_certificate_verifier(Arc::new(PinnedCertificate { expected })).with_no_client_auth()
            }
            None => {
                let native = rustls_native_certs::load_native_certs();
                builder.with_root_certificates(trust_store(native.certs, &native.errors)?).with_no_client_auth()
            }
        };
        tls.alpn_protocols = vec![ALPN_H3.to_vec()];
        let crypto = quinn::crypto::rustls::QuicClientConfig::try_from(tls).map_err(|error| setup(&error))?;
        let mut config = quinn::ClientConfig::new(Arc::new(crypto));
        config.transport_config(transport_config());
        let any_v6 = (std::net::Ipv6Addr::UNSPECIFIED, 0).into();
        let any_v4 = (std::net::Ipv4Addr::UNSPECIFIED, 0).into();
        // A v6 socket reaches v4 hosts too; hosts without v6 have only the other.
        let socket = quinn::Endpoint::client(any_v6).or_else(|_| quinn::Endpoint::client(any_v4)).map_err(|error| setup(&error))?;
        let client = web_transport_quinn::Client::new(socket.clone(), config);
        Ok(Self { client, socket, endpoint, pinned: expected.is_some(), ending: watch::Sender::new(false) })
    }

    /// Ends the connection, whichever it is then, and [`Dialer::run`] with it.
    #[must_use]
    pub fn closer(&self) -> Closer {
        Closer::new(&self.socket, &self.ending)
    }

    /// Connects, serves the roles until the connection is lost, and connects again with backoff, for as long
    /// as the future is polled. Ends with [`DialError::Closed`] when its [closer](Self::closer) asks for it, whatever it
    /// is about then, and else only with what no retry can mend: [`DialError::WrongFingerprint`], [`DialError::Untrusted`], and, as long as
    /// it was never connected, [`DialError::UnknownHost`].
    pub async fn run(self, roles: Roles, mut event: impl FnMut(LinkEvent) + Send) -> DialError {
        let mut backoff = MIN_BACKOFF;
        let mut connected_once = false;
        let mut ending = self.ending.subscribe();
        loop {
            let connected = tokio::select! {
                // First of all, so that no connection is begun that nobody would end.
                biased;
                () = closer::asked(&mut ending) => return self.closed(),
                connected = self.connect(&roles) => connected,
            };
            let down = match connected {
                Ok((session, driver)) => {
                    (backoff, connected_once) = (MIN_BACKOFF, true);
                    event(LinkEvent::Up(session.version().to_string()));
                    let end = closer::run(&session, driver, &mut ending).await;
                    // The driver may have failed on a stream; why the connection closed is known to the session.
                    let closed = session.closed().await;
                    if *ending.borrow() {
                        return self.closed();
                    }
                    LinkEvent::Down { fault: self.end(&end, &closed), retry_in: backoff }
                }
                Err(fault @ (DialError::WrongFingerprint { .. } | DialError::Untrusted { .. })) => return fault,
                Err(fault @ DialError::UnknownHost { .. }) if !connected_once => return fault,
                Err(fault) => LinkEvent::Failed { fault, retry_in: backoff },
            };
            event(down);
            tokio::select! {
                () = closer::asked(&mut ending) => return self.closed(),
                () = tokio::time::sleep(backoff) => {}
            }
            backoff = (backoff * 2).min(MAX_BACKOFF);
        }
    }

    async fn connect(&self, roles: &Roles) -> Result<(moq_net::Session, moq_net::Driver<web_transport_quinn::Session>), DialError> {
        let request = ConnectRequest::new(self.endpoint.clone()).with_protocols(subprotocols());
        let connected = tokio::time::timeout(CONNECT_TIMEOUT, self.client.connect(request)).await;
        let session = connected.map_err(|_| self.fault("no answer".to_owned()))?.map_err(|error| self.connect_fault(&error))?;
        let mut client = moq_net::Client::new();
        if let Some(publish) = &roles.publish {
            client = client.with_publisher(publish.clone());
        }
        if let Some(subscribe) = &roles.subscribe {
            client = client.with_subscriber(subscribe.clone());
        }
        client.connect(Instant::now(), session).await.map_err(|error| self.fault(error.to_string()))
    }

    fn url(&self) -> String {
        without_secrets(&self.endpoint).to_string()
    }

    fn fault(&self, fault: String) -> DialError {
        DialError::Connect { url: self.url(), fault }
    }

    fn closed(&self) -> DialError {
        DialError::Closed { url: self.url() }
    }

    fn end(&self, end: &moq_net::Error, closed: &moq_net::Error) -> DialError {
        if closer::is_in_order(closed) { DialError::HostEnded { url: self.url() } } else { self.fault(end.to_string()) }
    }

    fn connect_fault(&self, error: &web_transport_quinn::ClientError) -> DialError {
        if let web_transport_quinn::ClientError::InvalidDnsName(host) = error {
            return DialError::UnknownHost { url: self.url(), host: host.clone() };
        }
        let text = error.to_string();
        // quinn hands the verifier's error on as text alone.
        let found = text.split_once(MISMATCH).and_then(|(_, rest)| {
            let mut words = rest.split_whitespace();
            Some((words.next()?.to_owned(), words.next()?.to_owned()))
        });
        match found {
            Some((got, expected)) => DialError::WrongFingerprint { url: self.url(), got, expected },
            None if !self.pinned && text.contains(UNTRUSTED) => DialError::Untrusted { url: self.url(), fault: text },
            None => self.fault(text),
        }
    }
}

/// The system's authorities as roots of trust.
fn trust_store(
    authorities: Vec<CertificateDer<'static>>,
    errors: &[rustls_native_certs::Error],
) -> Result<rustls::RootCertStore, DialError> {
    let mut roots = rustls::RootCertStore::empty();
    roots.add_parsable_certificates(authorities);
    let faults = errors.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ");
    if roots.is_empty() {
        let faults = if faults.is_empty() { "none is installed".to_owned() } else { faults };
        return Err(DialError::Setup(format!(
            "no certificate authorities to trust ({faults}); install the package ca-certificates, or give a URL with sha256="
        )));
    }
    if !faults.is_empty() {
        tracing::warn!(faults, "some certificate authorities of this system could not be read");
    }
    Ok(roots)
}

/// How rustls begins what it says of a certificate that it refuses; quinn hands it on as text alone.
const UNTRUSTED: &str = "invalid peer certificate";
/// Marks the verifier's refusal in the error text that comes back through QUIC.
const MISMATCH: &str = "certificate fingerprint mismatch: ";

/// Trusts the one certificate whose SHA-256 the join URL carries, whatever it says of names and dates.
#[derive(Debug)]
struct PinnedCertificate {
    expected: [u8; 32],
}

impl ServerCertVerifier for PinnedCertificate {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let got = fingerprint(end_entity);
        if got == self.expected {
            return Ok(ServerCertVerified::assertion());
        }
        Err(rustls::Error::General(format!("{MISMATCH}{} {} .", hex(&got), hex(&self.expected))))
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls12_signature(message, certificate, signed, &crypto_provider().signature_verification_algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls13_signature(message, certificate, signed, &crypto_provider().signature_verification_algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        crypto_provider().signature_verification_algorithms.supported_schemes()
    }
}

fn hex(bytes: &[u8; 32]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_system_without_authorities_is_an_error_with_its_causes() {
        let error = trust_store(Vec::new(), &[]).unwrap_err().to_string();
        assert!(error.contains("ca-certificates") && error.contains("sha256="), "{error}");
        let missing = rustls_native_certs::load_certs_from_paths(Some(std::path::Path::new("/nowhere.pem")), None);
        let error = trust_store(missing.certs, &missing.errors).unwrap_err().to_string();
        assert!(error.contains("/nowhere.pem"), "{error}");
    }
}
