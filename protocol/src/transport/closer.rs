//! Ends every connection of an endpoint in order.

use std::time::Duration;

use tokio::sync::watch;

/// MoQ application code of a session whose host ends it in order.
pub(super) const HOST_ENDED: u16 = 1;
/// Longest wait for peers to hear of the end.
const FAREWELL: Duration = Duration::from_secs(1);

/// Says goodbye to all peers of a listener or dialer, so that they need not find out by silence.
#[derive(Clone)]
pub struct Closer {
    endpoint: quinn::Endpoint,
    /// Sessions that watch it end themselves and say why: QUIC's own close does not get past WebTransport.
    ending: watch::Sender<bool>,
}

impl Closer {
    pub(super) fn new(endpoint: &quinn::Endpoint, ending: &watch::Sender<bool>) -> Self {
        Self { endpoint: endpoint.clone(), ending: ending.clone() }
    }

    /// Ends every session, waits until the peers have been told, a second at most, and closes what is left.
    pub async fn close(self) {
        self.ending.send_replace(true);
        if tokio::time::timeout(FAREWELL, self.endpoint.wait_idle()).await.is_err() {
            tracing::debug!("some peers were not told of the end");
        }
        self.endpoint.close(0u32.into(), b"");
    }
}

/// Whether a session was ended by a host with [`HOST_ENDED`].
pub(super) fn is_in_order(closed: &moq_net::Error) -> bool {
    matches!(closed.session(), Some(moq_net::SessionError::App(HOST_ENDED)))
}

/// Resolves once the end is asked for.
pub(super) async fn asked(ending: &mut watch::Receiver<bool>) {
    // An error: nobody is left who could serve a session.
    let _ = ending.wait_for(|ending| *ending).await;
}

/// Runs a session to its end, or until the host asks for it.
pub(super) async fn run(
    session: &moq_net::Session,
    driver: moq_net::Driver<web_transport_quinn::Session>,
    ending: &mut watch::Receiver<bool>,
) -> moq_net::Error {
    let mut driving = std::pin::pin!(moq_net::time::run(driver));
    tokio::select! {
        end = &mut driving => return end,
        () = asked(ending) => session.abort(moq_net::Error::Session(moq_net::SessionError::App(HOST_ENDED))),
    }
    driving.await
}
