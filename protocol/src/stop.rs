//! The wish of a user or of a service manager that the program end in order.

/// Waits for Ctrl-C or a termination request.
pub async fn asked_to_stop() {
    let interrupt = tokio::signal::ctrl_c();
    #[cfg(unix)]
    if let Ok(mut terminate) = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate()) {
        tokio::select! {
            _ = interrupt => {}
            _ = terminate.recv() => {}
        }
        return;
    }
    // A handler that cannot be installed leaves the system's own: the process then simply ends.
    let _ = interrupt.await;
}
