//! Sources that connect, send, and fall silent.

use std::sync::atomic::{AtomicUsize, Ordering};

use super::senders::{Answer, Sender, Web, free_port, free_udp_ports};
use super::*;
use crate::ingest::test_media::{make, picture};

/// Short for the test's sake, and longer than a busy machine holds up a sender.
const SILENCE: Duration = Duration::from_millis(1500);

fn silent_for(source: &str) -> IngestConfig {
    IngestConfig { silence: SILENCE, ..IngestConfig::new(Source::parse(source).unwrap()) }
}

#[test]
fn a_pulled_source_that_falls_silent_is_given_up_and_tried_again_with_growing_patience() {
    let dir = tempfile::tempdir().unwrap();
    let media = std::fs::read(make(dir.path(), "a.ts", &format!("{} {X264} -g 10", picture(128, 64, 0.5)))).unwrap();
    let tries = AtomicUsize::new(0);
    let web = Web::start(move |_| match tries.fetch_add(1, Ordering::Relaxed) {
        0 => Answer::Stalled(media.clone()),
        1 | 2 => Answer::NotFound,
        _ => Answer::Whole(media.clone()),
    });
    let (handle, receiver) = start(IngestConfig { silence: Duration::from_millis(400), ..silent_for(&web.url("live.ts")) });
    let lost = Outcome::collect(&receiver, |outcome| outcome.interrupted.len() == 3);
    lost.check();
    let (reasons, waits): (Vec<_>, Vec<_>) = lost.interrupted.into_iter().unzip();
    assert!(reasons[0].contains("live.ts: the stream ended (no data for 400ms)"), "{reasons:?}");
    assert!(reasons[1].contains("cannot be opened") && reasons[2].contains("cannot be opened"), "{reasons:?}");
    assert_eq!(waits, [250, 500, 1000].map(Duration::from_millis));
    assert_eq!(handle.counters().reconnects, 0);
    let again = Outcome::collect(&receiver, |outcome| !outcome.video.is_empty());
    assert!(again.interrupted.is_empty() && again.started.is_empty());
    assert_eq!(handle.counters().reconnects, 1);
    handle.stop();
    handle.join().unwrap();
}

/// What an interrupted read ends with differs from protocol to protocol; what it is called must not.
#[test]
fn pushes_that_fall_silent_are_given_up_whatever_the_protocol() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {X264} -g 15", picture(128, 64, 20.0)));
    let cases = [
        (format!("rtmp://127.0.0.1:{}/live/key", free_port()), "?listen=1", "-c copy -f flv"),
        (format!("srt://127.0.0.1:{}", free_udp_ports()), "?mode=listener", "-c copy -f mpegts"),
        (format!("rtsp://127.0.0.1:{}/live", free_port()), "?listen=1", "-c copy -f rtsp -rtsp_transport tcp"),
        (format!("udp://127.0.0.1:{}", free_udp_ports()), "", "-c copy -f mpegts"),
    ];
    std::thread::scope(|scope| {
        for (target, listen, arguments) in &cases {
            let media = &media;
            scope.spawn(move || {
                let (handle, receiver) = start(silent_for(&format!("{target}{listen}")));
                let push = Sender::start(media, arguments, target);
                Outcome::collect(&receiver, |outcome| outcome.video.len() >= 20);
                push.fall_silent();
                let lost = Outcome::collect(&receiver, |outcome| !outcome.interrupted.is_empty());
                assert!(lost.interrupted[0].0.contains("no data for 1.5s"), "{target}: {:?}", lost.interrupted);
                drop(push);
                let _again = Sender::start(media, arguments, target);
                Outcome::collect(&receiver, |outcome| outcome.video.len() >= 20);
                assert!(handle.counters().reconnects >= 1, "{target}");
                handle.stop();
                handle.join().unwrap();
            });
        }
    });
}
