//! Ends every connection of an endpoint in order.

use std::time::Duration;

use web_transport_quinn::proto::error_to_http3;

/// MoQ application code of a session whose host ends it in order.
pub(super) const HOST_ENDED: u16 = 1;
/// Longest wait for peers to hear of the end.
const FAREWELL: Duration = Duration::from_secs(1);

/// Says goodbye to all peers of a listener or dialer, so that they need not find out by silence.
#[derive(Clone)]
pub struct Closer(quinn::Endpoint);

impl Closer {
    pub(super) fn new(endpoint: &quinn::Endpoint) -> Self {
        Self(endpoint.clone())
    }

    /// Closes every connection, now and to come, and waits until the peers have been told, a second at most.
    pub async fn close(self) {
        let code = error_to_http3(moq_net::SessionError::App(HOST_ENDED).to_code());
        // WebTransport's codes lie far below the largest varint.
        let code = quinn::VarInt::from_u64(code).unwrap_or_default();
        self.0.close(code, b"the host ended the broadcast");
        if tokio::time::timeout(FAREWELL, self.0.wait_idle()).await.is_err() {
            tracing::debug!("some peers were not told of the end");
        }
    }
}
