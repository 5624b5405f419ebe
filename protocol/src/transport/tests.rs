use std::time::Duration;

use moq_net::{Timestamp, track};

use super::*;

struct Served {
    address: std::net::SocketAddr,
    fingerprint: [u8; 32],
    origin: moq_net::origin::Producer,
    _folder: tempfile::TempDir,
}

fn serve() -> Served {
    let folder = tempfile::tempdir().unwrap();
    let certificate = Certificate::load_or_make(folder.path()).unwrap();
    let fingerprint = certificate.fingerprint().unwrap();
    let listener = Listener::bind("127.0.0.1:0".parse().unwrap(), certificate).unwrap();
    let (address, origin) = (listener.address(), origin());
    tokio::spawn(listener.serve(Roles { publish: Some(origin.consume()), subscribe: None }));
    Served { address, fingerprint, origin, _folder: folder }
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

#[tokio::test]
async fn nobody_there_is_reported_and_tried_again() {
    // A bound socket that never answers keeps the port from anyone else.
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let dialer = Dialer::new(endpoint(silent.local_addr().unwrap()), Some([0; 32])).unwrap();
    let (sender, mut events) = tokio::sync::mpsc::unbounded_channel();
    let link = tokio::spawn(dialer.run(Roles::default(), move |event| drop(sender.send(event))));
    let event = events.recv().await.unwrap();
    assert!(matches!(event, LinkEvent::Down { retry_in, .. } if retry_in == Duration::from_millis(250)), "{event:?}");
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
fn the_certificate_is_kept_and_a_damaged_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let first = Certificate::load_or_make(folder.path()).unwrap().fingerprint();
    assert_eq!(Certificate::load_or_make(folder.path()).unwrap().fingerprint(), first);
    std::fs::write(folder.path().join("certificate.pem"), "mud").unwrap();
    assert!(matches!(Certificate::load_or_make(folder.path()), Err(CertificateError::Pem { .. })));
}
