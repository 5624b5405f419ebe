use std::time::Duration;

use moq_net::{Timestamp, track};

use super::*;

struct Served {
    address: std::net::SocketAddr,
    fingerprint: [u8; 32],
    origin: moq_net::origin::Producer,
    closer: Closer,
    _folder: tempfile::TempDir,
}

fn serve() -> Served {
    serve_at_most(1024)
}

fn serve_at_most(sessions: usize) -> Served {
    let folder = tempfile::tempdir().unwrap();
    let certificate = Certificate::load_or_make(folder.path()).unwrap();
    let fingerprint = certificate.fingerprint().unwrap();
    let listener = Listener::bind("127.0.0.1:0".parse().unwrap(), certificate).unwrap().with_max_sessions(sessions);
    let (address, origin, closer) = (listener.address(), origin(), listener.closer());
    tokio::spawn(listener.serve(Roles { publish: Some(origin.consume()), subscribe: None }));
    Served { address, fingerprint, origin, closer, _folder: folder }
}

fn endpoint(address: std::net::SocketAddr) -> url::Url {
    format!("https://{address}/").parse().unwrap()
}

#[tokio::test]
async fn a_frame_crosses_quic() {
    let served = serve();
    let broadcast = served.origin.create_broadcast("mr360/live").unwrap();
    let mut light = broadcast.create_track("light", track::Info::default()).unwrap();
    broadcast.announce(Default::default()).unwrap();

    let received = origin();
    let dialer = Dialer::new(endpoint(served.address), Some(served.fingerprint)).unwrap();
    let roles = Roles { publish: None, subscribe: Some(received.clone()) };
    let link = tokio::spawn(dialer.run(roles, |_| {}));
    let remote = received.consume().routed_broadcast("mr360/live").await.unwrap();
    let mut track = remote.track("light").unwrap().subscribe(None).await.unwrap();
    light.write_frame(Timestamp::now(), bytes::Bytes::from_static(b"noon")).unwrap();
    let mut group = track.recv_group().await.unwrap().unwrap();
    assert_eq!(group.read_frame().await.unwrap().unwrap().payload.as_ref(), b"noon");
    link.abort();
}

#[tokio::test]
async fn a_wrong_fingerprint_ends_the_dialer_and_names_both() {
    let served = serve();
    let dialer = Dialer::new(endpoint(served.address), Some([7; 32])).unwrap();
    let error = dialer.run(Roles::default(), |_| {}).await;
    let DialError::WrongFingerprint { got, expected, .. } = error else { panic!("{error}") };
    assert_eq!(expected, "07".repeat(32));
    assert_eq!(got, served.fingerprint.iter().map(|byte| format!("{byte:02x}")).collect::<String>());
}

/// What becomes of a dialer's link, event by event.
fn dial(dialer: Dialer, roles: Roles) -> (tokio::task::JoinHandle<DialError>, tokio::sync::mpsc::UnboundedReceiver<LinkEvent>) {
    let (sender, events) = tokio::sync::mpsc::unbounded_channel();
    (tokio::spawn(dialer.run(roles, move |event| drop(sender.send(event)))), events)
}

#[tokio::test]
async fn an_unknown_authority_without_a_fingerprint_ends_the_dialer_with_the_remedy() {
    let served = serve();
    // Any authority will do: it did not sign the server's certificate. So the test needs none of the system's.
    let mut endpoint = endpoint(served.address);
    endpoint.set_query(Some("jwt=secret"));
    let Ok(dialer) = Dialer::new(endpoint, None) else { return eprintln!("no certificate authorities here: skipped") };
    let error = dialer.run(Roles::default(), |_| {}).await;
    assert!(matches!(error, DialError::Untrusted { .. }), "{error}");
    let text = error.to_string();
    assert!(text.contains("lacks sha256=") && text.contains("UnknownIssuer") && !text.contains("secret"), "{text}");
}

#[tokio::test]
async fn a_host_name_that_was_never_resolved_ends_the_dialer() {
    let dialer = Dialer::new("https://nowhere.invalid:1/".parse().unwrap(), Some([0; 32])).unwrap();
    let error = dialer.run(Roles::default(), |event| panic!("{event:?}")).await;
    assert!(matches!(&error, DialError::UnknownHost { host, .. } if host == "nowhere.invalid"), "{error}");
}

#[tokio::test]
async fn a_host_that_ends_in_order_says_so() {
    let served = serve();
    let dialer = Dialer::new(endpoint(served.address), Some(served.fingerprint)).unwrap();
    let (link, mut events) = dial(dialer, Roles { publish: None, subscribe: Some(origin()) });
    assert!(matches!(events.recv().await, Some(LinkEvent::Up(_))));
    served.closer.close().await;
    let event = events.recv().await.unwrap();
    assert!(matches!(&event, LinkEvent::Down { fault: DialError::HostEnded { .. }, .. }), "{event:?}");
    link.abort();
}

#[tokio::test]
async fn a_dialer_that_is_closed_tells_its_peer_and_returns() {
    let folder = tempfile::tempdir().unwrap();
    let certificate = Certificate::load_or_make(folder.path()).unwrap();
    let fingerprint = certificate.fingerprint();
    let listener = Listener::bind("127.0.0.1:0".parse().unwrap(), certificate).unwrap();
    let dialer = Dialer::new(endpoint(listener.address()), fingerprint).unwrap();
    let closer = dialer.closer();
    let (link, mut events) = dial(dialer, Roles { publish: Some(origin().consume()), subscribe: None });
    let incoming = listener.endpoint.accept().await.unwrap();
    let (session, driver) = listener::accept(incoming, Roles { publish: None, subscribe: Some(origin()) }).await.unwrap();
    let driving = tokio::spawn(moq_net::time::run(driver));
    assert!(matches!(events.recv().await, Some(LinkEvent::Up(_))));
    closer.close().await;
    let told = session.closed().await;
    assert!(closer::is_in_order(&told), "{told}");
    let end = link.await.unwrap();
    assert!(matches!(end, DialError::Closed { .. }), "{end}");
    assert!(events.recv().await.is_none(), "an end that was asked for is no loss");
    driving.abort();
}

#[tokio::test]
async fn a_dialer_that_is_closed_before_or_between_connections_returns() {
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let dialer = Dialer::new(endpoint(silent.local_addr().unwrap()), Some([0; 32])).unwrap();
    let closer = dialer.closer();
    // Nothing was sent yet when it is closed.
    let (link, _events) = dial(dialer, Roles::default());
    closer.close().await;
    assert!(matches!(link.await.unwrap(), DialError::Closed { .. }));
    // Between two tries.
    let dialer = Dialer::new(endpoint(silent.local_addr().unwrap()), Some([0; 32])).unwrap();
    let closer = dialer.closer();
    let (link, mut events) = dial(dialer, Roles::default());
    assert!(matches!(events.recv().await, Some(LinkEvent::Failed { .. })));
    closer.close().await;
    assert!(matches!(link.await.unwrap(), DialError::Closed { .. }));
}

#[tokio::test]
async fn a_full_server_refuses_until_a_viewer_leaves() {
    let served = serve_at_most(1);
    let viewer = || dial(Dialer::new(endpoint(served.address), Some(served.fingerprint)).unwrap(), Roles::default());
    let (first, mut first_events) = viewer();
    assert!(matches!(first_events.recv().await, Some(LinkEvent::Up(_))));
    let (second, mut second_events) = viewer();
    let event = second_events.recv().await.unwrap();
    assert!(matches!(&event, LinkEvent::Failed { fault, .. } if fault.to_string().contains("refused")), "{event:?}");
    first.abort();
    while !matches!(second_events.recv().await.unwrap(), LinkEvent::Up(_)) {}
    second.abort();
}

#[tokio::test]
async fn nobody_there_is_reported_and_tried_again() {
    // A bound socket that never answers keeps the port from anyone else.
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let dialer = Dialer::new(endpoint(silent.local_addr().unwrap()), Some([0; 32])).unwrap();
    let (link, mut events) = dial(dialer, Roles::default());
    let event = events.recv().await.unwrap();
    assert!(matches!(event, LinkEvent::Failed { retry_in, .. } if retry_in == Duration::from_millis(250)), "{event:?}");
    link.abort();
}

#[tokio::test]
async fn a_taken_port_is_named() {
    let served = serve();
    let folder = tempfile::tempdir().unwrap();
    let error = Listener::bind(served.address, Certificate::load_or_make(folder.path()).unwrap()).err().unwrap().to_string();
    assert!(error.contains(&served.address.to_string()) && error.contains("--listen"), "{error}");
}

#[test]
fn servers_that_start_at_once_share_one_certificate() {
    let folder = tempfile::tempdir().unwrap();
    let made: Vec<_> = std::thread::scope(|scope| {
        let starts = (0..8).map(|_| scope.spawn(|| Certificate::load_or_make(folder.path()).unwrap().fingerprint()));
        let starts: Vec<_> = starts.collect();
        starts.into_iter().map(|start| start.join().unwrap()).collect()
    });
    assert!(made.iter().all(|fingerprint| fingerprint.is_some() && *fingerprint == made[0]), "{made:?}");
}

#[test]
fn the_certificate_is_kept_and_a_damaged_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let first = Certificate::load_or_make(folder.path()).unwrap().fingerprint();
    assert_eq!(Certificate::load_or_make(folder.path()).unwrap().fingerprint(), first);
    std::fs::write(folder.path().join("certificate.pem"), "mud").unwrap();
    assert!(matches!(Certificate::load_or_make(folder.path()), Err(CertificateError::Pem { .. })));
}

#[test]
fn half_a_state_folder_is_made_whole_or_named_with_the_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let made = Certificate::load_or_make(folder.path()).unwrap().fingerprint();
    let files =
        || std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(files(), ["certificate.pem", "key.pem", "lock"].map(Into::into).into());
    // A first start that was cut short: the key comes last.
    std::fs::remove_file(folder.path().join("key.pem")).unwrap();
    assert_ne!(Certificate::load_or_make(folder.path()).unwrap().fingerprint(), made);
    std::fs::remove_file(folder.path().join("certificate.pem")).unwrap();
    let error = Certificate::load_or_make(folder.path()).err().unwrap();
    assert!(matches!(error, CertificateError::Half { .. }), "{error}");
    let text = error.to_string();
    assert!(text.contains("certificate.pem is missing") && text.contains("delete"), "{text}");
}
