//! Streams over the network, and sources that misbehave while they run.

use std::net::UdpSocket;
use std::sync::Mutex;

use super::senders::{Sender, free_port};
use super::*;
use crate::ingest::test_media::{make, picture, tone};

#[test]
fn a_push_over_rtmp_is_taken_and_the_next_one_too() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {} {X264} -g 15 -c:a aac", picture(256, 128, 1.5), tone(1.5)));
    let port = free_port();
    let source = Source::parse(&format!("rtmp://127.0.0.1:{port}/live/key?listen=1")).unwrap();
    let (handle, receiver) = start(IngestConfig::new(source));
    let url = format!("rtmp://127.0.0.1:{port}/live/key");
    let first = Sender::start(&media, "-c copy -f flv", &url);
    let mut outcome = Outcome::collect(&receiver, |outcome| outcome.interrupted.len() == 1);
    drop(first);
    let _second = Sender::start(&media, "-c copy -f flv", &url);
    let again = Outcome::collect(&receiver, |outcome| outcome.video.len() >= 20 && outcome.frames.len() >= 20 && !outcome.audio.is_empty());
    outcome.check();
    assert!(outcome.video.len() >= 40 && outcome.audio.len() > 50, "{} {}", outcome.video.len(), outcome.audio.len());
    assert!(again.started.is_empty(), "the same formats are not announced again");
    assert_eq!(handle.counters().reconnects, 1);
    outcome.video.extend(again.video);
    outcome.frames.extend(again.frames);
    outcome.check();
    handle.stop();
    handle.join().unwrap();
}

#[test]
fn a_push_with_rare_keyframes_is_transcoded_from_the_moment_it_shows_and_the_next_one_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let rare = make(dir.path(), "a.mp4", &format!("{} {X264} -g 900 -sc_threshold 0", picture(256, 128, 2.6)));
    let other = make(dir.path(), "b.mp4", &format!("{} {X264} -g 15", picture(128, 64, 0.7)));
    let port = free_port();
    let url = format!("rtmp://127.0.0.1:{port}/live/key");
    let (handle, receiver) = start(IngestConfig::new(Source::parse(&format!("{url}?listen=1")).unwrap()));
    let push = |media: &Path| {
        let _push = Sender::start(media, "-c copy -f flv", &url);
        let outcome = Outcome::collect(&receiver, |outcome| outcome.interrupted.len() == 1);
        let transcoded: Vec<bool> = outcome.started.iter().map(|(video, _)| video.transcoded_because.is_some()).collect();
        (outcome, transcoded)
    };
    let (outcome, transcoded) = push(&rare);
    outcome.check();
    assert_eq!(transcoded, [false, true]);
    assert!(outcome.video.len() >= 70, "{}", outcome.video.len());
    // The same sender again: still what was announced last, and the encoder's keyframes, a second apart, instead of the source's.
    let (outcome, transcoded) = push(&rare);
    assert!(transcoded.is_empty(), "{:?}", outcome.started);
    let keys: Vec<u64> = outcome.video.iter().filter(|unit| unit.keyframe).map(|unit| unit.pts_us).collect();
    assert!(keys.len() >= 3 && keys[1] - keys[0] < 1_100_000, "{keys:?}");
    // Another one has not earned that.
    assert_eq!(push(&other).1, [false]);
    handle.stop();
    handle.join().unwrap();
}

#[test]
fn transport_streams_over_udp_and_srt_bring_aac_without_adts() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {} {X264} -g 15 -c:a aac", picture(256, 128, 4.0), tone(4.0)));
    for scheme in ["udp", "srt"] {
        let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let listen = if scheme == "srt" { "?mode=listener" } else { "" };
        let source = Source::parse(&format!("{scheme}://127.0.0.1:{port}{listen}")).unwrap();
        let (handle, receiver) = start(IngestConfig::new(source));
        let _push = Sender::start(&media, "-c copy -f mpegts", &format!("{scheme}://127.0.0.1:{port}"));
        let enough = |outcome: &Outcome| outcome.video.len() >= 20 && outcome.frames.len() >= 15 && outcome.audio.len() > 20;
        let outcome = Outcome::collect(&receiver, enough);
        outcome.check();
        let audio = outcome.started[0].1.as_ref().unwrap();
        assert_eq!((audio.codec, &audio.description[..]), (AudioCodec::Aac, &[0x11, 0x88][..]), "{scheme}");
        assert!(outcome.audio.iter().all(|packet| !packet.data.starts_with(&[0xff, 0xf1])), "{scheme}");
        handle.stop();
        handle.join().unwrap();
    }
}

#[test]
fn a_listener_and_an_unreachable_source_stop_at_once() {
    let listening = Source::parse(&format!("rtmp://127.0.0.1:{}/live/x?listen=1", free_port())).unwrap();
    let (handle, _receiver) = start(IngestConfig::new(listening));
    handle.stop();
    handle.join().unwrap();
    let nobody = Source::parse(&format!("rtmp://127.0.0.1:{}/live/x", free_port())).unwrap();
    let (handle, receiver) = start(IngestConfig::new(nobody));
    let outcome = Outcome::collect(&receiver, |outcome| outcome.interrupted.len() == 2);
    assert!(outcome.video.is_empty());
    handle.stop();
    handle.join().unwrap();
}

#[test]
fn slow_light_loses_pictures_and_holds_up_no_packet() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {X264} -g 15", picture(256, 128, 1.5)));
    let (sender, receiver) = mpsc::channel();
    let (release, gate) = mpsc::channel::<()>();
    let gate = Mutex::new(gate);
    let sink = move |event: IngestEvent| {
        if let IngestEvent::Frame(..) = event {
            // Light hangs until the video is over.
            let _ = gate.lock().unwrap().recv();
        }
        drop(sender.send(event));
    };
    let handle = spawn(file(&media), ServerClock::start(), sink).unwrap();
    let outcome = Outcome::collect(&receiver, |outcome| outcome.video.len() == 45);
    assert!(outcome.frames.is_empty());
    drop(release);
    let rest = Outcome::collect(&receiver, |_| false);
    let lost = handle.counters().frames_without_light;
    assert_eq!(rest.frames.len() as u64 + lost, 45);
    // Eight wait and one is in light's hands; the decoder may have been a few pictures behind the broadcast.
    assert!(rest.frames.len() >= 9 && lost > 0, "{} {lost}", rest.frames.len());
    handle.join().unwrap();
}

#[test]
fn a_change_of_size_is_announced_once() {
    let dir = tempfile::tempdir().unwrap();
    let small = make(dir.path(), "small.ts", &format!("{} {X264} -g 15", picture(128, 64, 0.5)));
    let large = make(dir.path(), "large.ts", &format!("{} {X264} -g 15 -output_ts_offset 0.5", picture(256, 128, 0.5)));
    let joined = dir.path().join("joined.ts");
    std::fs::write(&joined, [std::fs::read(small).unwrap(), std::fs::read(large).unwrap()].concat()).unwrap();
    let (outcome, counters) = Outcome::whole(file(&joined));
    outcome.check();
    assert_eq!(outcome.started.iter().map(|(video, _)| video.width).collect::<Vec<_>>(), [128, 256]);
    assert_eq!(counters.format_changes, 1);
    assert!(outcome.frames.iter().any(|frame| frame.1 == (256, 128)));
    // Transcoded, it is the encoder that changes.
    let (outcome, counters) = Outcome::whole(IngestConfig { max_width: Some(200), ..file(&joined) });
    assert_eq!(outcome.started.last().map(|(video, _)| (video.width, video.height)), Some((200, 100)));
    assert_eq!(counters.format_changes, 1);
}

#[test]
fn a_jump_of_the_timestamps_is_mended() {
    let dir = tempfile::tempdir().unwrap();
    let first = make(dir.path(), "a.ts", &format!("{} {} {X264} -g 15 -c:a aac", picture(128, 64, 0.5), tone(0.5)));
    let second = make(dir.path(), "b.ts", &format!("{} {} {X264} -g 15 -c:a aac -output_ts_offset 600", picture(128, 64, 0.5), tone(0.5)));
    for (name, parts) in [("forward.ts", [&first, &second]), ("backward.ts", [&second, &first])] {
        let joined = dir.path().join(name);
        std::fs::write(&joined, parts.map(|part| std::fs::read(part).unwrap()).concat()).unwrap();
        let (outcome, counters) = Outcome::whole(file(&joined));
        outcome.check();
        let last = outcome.video.last().unwrap().pts_us - outcome.video[0].pts_us;
        assert!(last < 4_000_000, "{name}: {last}");
        assert!(counters.timestamp_jumps >= 1, "{name}: {counters:?}");
        let apart = outcome.audio.last().unwrap().pts_us.abs_diff(outcome.video.last().unwrap().pts_us);
        assert!(apart < 300_000, "{name}: sound and picture end {apart} µs apart");
    }
}

/// One packet in the middle is to be shown a quarter of an hour after its decoding; what follows must not wait for that time.
#[test]
fn a_stray_presentation_time_holds_up_nothing() {
    // Of 90 kHz; one sound a packet, as others have no timestamp of their own.
    const STRAY: &str = "setts=pts=if(eq(N\\,20)\\,PTS+81000000\\,PTS) -pes_payload_size 0";
    let dir = tempfile::tempdir().unwrap();
    for stream in ["v", "a"] {
        let arguments = format!("{} {} {X264} -g 15 -c:a aac -bsf:{stream} {STRAY}", picture(128, 64, 2.0), tone(2.0));
        let media = make(dir.path(), &format!("stray-{stream}.ts"), &arguments);
        for max_width in [None, Some(64)] {
            let (outcome, counters) = Outcome::whole(IngestConfig { max_width, ..file(&media) });
            outcome.check();
            let what = format!("{stream} {max_width:?}");
            assert!(outcome.video.len() >= 58, "{what}: {} access units", outcome.video.len());
            let video = outcome.video.last().unwrap().pts_us - outcome.video[0].pts_us;
            let audio = outcome.audio.last().unwrap().pts_us - outcome.audio[0].pts_us;
            assert!(video.abs_diff(1_966_667) < 50_000 && audio.abs_diff(2_000_000) < 100_000, "{what}: {video} and {audio} µs");
            assert!(counters.timestamp_jumps >= 1, "{what}: {counters:?}");
        }
        let frames = decode_frames(&Source::File(media), DecodeOptions::default()).unwrap().map(Result::unwrap);
        let last = frames.map(|frame| frame.pts_us).last().unwrap();
        assert!(last.abs_diff(1_966_667) < 50_000, "{stream}: {last}");
    }
}

#[test]
fn the_test_card_arrives_with_its_numbers() {
    let config = IngestConfig::new(Source::parse("synthetic:testcard?size=256x128&fps=60").unwrap());
    let numbers = std::sync::Arc::new(Mutex::new(Vec::new()));
    let seen = std::sync::Arc::clone(&numbers);
    let (sender, receiver) = mpsc::channel();
    let sink = move |event: IngestEvent| {
        if let IngestEvent::Frame(frame, _) = &event
            && let Pixels::Video(picture, _) = &frame.pixels
        {
            let number = testcard::read_number(picture.data(0), picture.stride(0), 256, 128);
            seen.lock().unwrap().push((number.unwrap(), frame.pts_us));
        }
        drop(sender.send(event));
    };
    let handle = spawn(config, ServerClock::start(), sink).unwrap();
    let outcome = Outcome::collect(&receiver, |outcome| outcome.video.len() > 70 && outcome.frames.len() > 40);
    handle.stop();
    handle.join().unwrap();
    outcome.check();
    let numbers = numbers.lock().unwrap();
    let (first, start_us) = numbers[0];
    for &(number, pts_us) in numbers.iter() {
        assert!((pts_us - start_us).abs_diff((number - first) * 1_000_000 / 60) <= 1);
    }
}
