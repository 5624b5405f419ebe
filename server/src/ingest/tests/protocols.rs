//! Every protocol of the README, in each direction, with the ffmpeg program at the other end.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::senders::{Answer, Sender, Web, free_port, free_udp_ports};
use super::*;
use crate::ingest::test_media::{make, picture, tone};

/// H.264 with AAC that passes through.
fn clip(dir: &Path, seconds: f64) -> PathBuf {
    make(dir, "a.mp4", &format!("{} {} {X264} -g 15 -c:a aac", picture(256, 128, seconds), tone(seconds)))
}

fn url(text: &str) -> IngestConfig {
    IngestConfig::new(Source::parse(text).unwrap())
}

/// Waits for picture, light's frames and sound.
fn comes(receiver: &Receiver<IngestEvent>) -> Outcome {
    Outcome::collect(receiver, |outcome| outcome.video.len() >= 20 && outcome.frames.len() >= 10 && outcome.audio.len() >= 20)
}

fn passes_through(outcome: &Outcome) {
    outcome.check();
    let (video, audio) = &outcome.started[0];
    assert_eq!((video.codec, video.width, video.height, &video.transcoded_because), (VideoCodec::H264, 256, 128, &None));
    let audio = audio.as_ref().unwrap();
    assert_eq!((audio.codec, audio.sample_rate, &audio.description[..2]), (AudioCodec::Aac, 48_000, &[0x11, 0x88][..]));
}

/// The source sends, ends, and sends again: the broadcast goes on by itself, with the formats that were announced.
fn comes_and_comes_again(source: &str, senders: [&dyn Fn() -> Sender; 2]) {
    let (handle, receiver) = start(url(source));
    let first = senders[0]();
    let mut outcome = comes(&receiver);
    passes_through(&outcome);
    let rest = Outcome::collect(&receiver, |outcome| !outcome.interrupted.is_empty());
    drop(first);
    let _second = senders[1]();
    let again = comes(&receiver);
    assert!(rest.started.is_empty() && again.started.is_empty(), "{source}: the same formats are not announced again");
    assert_eq!(handle.counters().reconnects, 1, "{source}");
    for part in [rest, again] {
        outcome.video.extend(part.video);
        outcome.frames.extend(part.frames);
        outcome.audio.extend(part.audio);
    }
    outcome.check();
    handle.stop();
    handle.join().unwrap();
}

#[test]
fn rtmp_is_pulled_and_pulled_again() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 1.5);
    let source = format!("rtmp://127.0.0.1:{}/live/key", free_port());
    let sender = || Sender::start(&media, "-c copy -f flv -listen 1", &source);
    comes_and_comes_again(&source, [&sender, &sender]);
}

#[test]
fn srt_is_pulled_and_pulled_again() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 1.5);
    let source = format!("srt://127.0.0.1:{}", free_udp_ports());
    let sender = || Sender::start(&media, "-c copy -f mpegts", &format!("{source}?mode=listener"));
    comes_and_comes_again(&source, [&sender, &sender]);
}

#[test]
fn srt_is_taken_and_taken_again() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 1.5);
    let target = format!("srt://127.0.0.1:{}", free_udp_ports());
    let sender = || Sender::start(&media, "-c copy -f mpegts", &target);
    comes_and_comes_again(&format!("{target}?mode=listener"), [&sender, &sender]);
}

#[test]
fn rtsp_is_taken_over_tcp_and_over_udp() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 2.0);
    let target = format!("rtsp://127.0.0.1:{}/live", free_port());
    let sender = |transport: &str| Sender::start(&media, &format!("-c copy -f rtsp -rtsp_transport {transport}"), &target);
    comes_and_comes_again(&format!("{target}?listen=1"), [&|| sender("tcp"), &|| sender("udp")]);
}

/// A server that knows UDP alone, and refuses TCP as a bad request.
#[test]
fn rtsp_is_pulled() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 6.0);
    let (pull, push, rtp) = (free_port(), free_port(), free_udp_ports());
    let mut server = Sender::script(&format!(
        "exec perl -MAnyEvent -MRTSP::Server -e '$| = 1; my $server = RTSP::Server->new(client_listen_address => \"127.0.0.1\", \
         source_listen_address => \"127.0.0.1\", client_listen_port => {pull}, source_listen_port => {push}, rtp_start_port => {rtp}); \
         $server->listen; print \"listening\\n\"; AnyEvent->condvar->recv'"
    ));
    // Debian's librtsp-server-perl, which deploy/setup installs.
    server.wait_for("listening");
    let _sender = Sender::start(&media, "-c copy -f rtsp", &format!("rtsp://127.0.0.1:{push}/live"));
    let (handle, receiver) = start(url(&format!("rtsp://127.0.0.1:{pull}/live")));
    passes_through(&comes(&receiver));
    handle.stop();
    handle.join().unwrap();
}

#[test]
fn rtp_brings_a_transport_stream() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 4.0);
    let source = format!("rtp://127.0.0.1:{}", free_udp_ports());
    let (handle, receiver) = start(url(&source));
    let _sender = Sender::start(&media, "-c copy -f rtp_mpegts", &source);
    passes_through(&comes(&receiver));
    handle.stop();
    handle.join().unwrap();
}

/// Half a second a segment, and a window of three: what comes after the first 45 pictures was not there when the stream was opened.
const LIVE_HLS: &str = "-c copy -f hls -hls_time 0.5 -hls_list_size 3";

#[test]
fn a_live_playlist_is_followed_over_http() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 4.0);
    let folder = dir.path().to_owned();
    let asked = Arc::new(AtomicUsize::new(0));
    let counter = Arc::clone(&asked);
    let web = Web::start(move |path| {
        counter.fetch_add(usize::from(path == "live.m3u8"), Ordering::Relaxed);
        std::fs::read(folder.join(path)).map_or(Answer::NotFound, Answer::Whole)
    });
    let playlist = dir.path().join("live.m3u8");
    let _sender = Sender::start(&media, &format!("{LIVE_HLS} -hls_flags delete_segments"), playlist.to_str().unwrap());
    let (handle, receiver) = start(url(&web.url("live.m3u8")));
    let outcome = Outcome::collect(&receiver, |outcome| outcome.video.len() >= 75 && outcome.frames.len() >= 60);
    passes_through(&outcome);
    assert!(asked.load(Ordering::Relaxed) > 2, "the playlist was read once and again");
    assert_eq!(handle.counters(), IngestCounters::default());
    handle.stop();
    handle.join().unwrap();
}

#[test]
fn a_local_playlist_is_played_while_it_is_written_and_after() {
    let dir = tempfile::tempdir().unwrap();
    let media = clip(dir.path(), 3.0);
    let playlist = dir.path().join("live.m3u8");
    let (from, to) = (media.display(), playlist.display());
    // Named a second time, the first version of the playlist is written.
    let mut sender = Sender::script(&format!("exec ffmpeg -hide_banner -nostdin -re -i '{from}' {LIVE_HLS} '{to}' 2>&1"));
    sender.wait_for("live.m3u8.tmp");
    sender.wait_for("live.m3u8.tmp");
    let (outcome, counters) = Outcome::whole(file(&playlist));
    passes_through(&outcome);
    assert!(outcome.video.len() > 60, "{} of 90 pictures, of which at most 45 were there at first", outcome.video.len());
    assert_eq!(counters, IngestCounters::default());
    let (outcome, _) = Outcome::whole(file(&playlist));
    passes_through(&outcome);
    assert_eq!(outcome.video.len(), 45, "the last three segments");
}
