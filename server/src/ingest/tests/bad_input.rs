//! Every bad input has its clear error, or is survived.

use std::net::TcpListener;

use super::*;
use crate::ingest::test_media::{make, picture, tone};

fn refused(config: IngestConfig) -> IngestError {
    match spawn(config, ServerClock::start(), |_| {}) {
        Ok(_) => panic!("was accepted"),
        Err(error) => error,
    }
}

#[test]
fn what_is_no_video_is_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str, content: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    };
    assert!(matches!(refused(IngestConfig::new(Source::File(dir.path().join("none.mp4")))), IngestError::MissingFile { .. }));
    assert!(matches!(refused(IngestConfig::new(Source::File(dir.path().to_path_buf()))), IngestError::NotAFile { .. }));
    assert!(matches!(refused(IngestConfig::new(Source::File(at("zero.mp4", b"")))), IngestError::EmptyFile { .. }));
    let text = at("text.mp4", &b"This is not a video at all. ".repeat(200));
    assert!(matches!(refused(file(&text)), IngestError::NotAVideo { .. }));
    let media = std::fs::read(make(dir.path(), "a.mp4", &format!("{} {X264}", picture(128, 64, 1.0)))).unwrap();
    // Its index stands at the end.
    let truncated = at("truncated.mp4", &media[..media.len() / 2]);
    assert!(matches!(refused(file(&truncated)), IngestError::NotAVideo { .. }));
    let sound = make(dir.path(), "sound.mp4", &format!("{} -c:a aac", tone(0.3)));
    let error = refused(file(&sound));
    assert!(matches!(error, IngestError::NoVideoStream { .. }) && error.to_string().contains("sound.mp4"), "{error}");
    let position = media.windows(4).rposition(|word| word == b"avc1").unwrap();
    let mut unknown = media;
    unknown[position..position + 4].copy_from_slice(b"zzzz");
    assert!(matches!(refused(file(&at("unknown.mp4", &unknown))), IngestError::UnsupportedCodec { .. }));
}

#[test]
fn sizes_at_and_beyond_the_bounds() {
    let dir = tempfile::tempdir().unwrap();
    for (width, height) in [(1, 1), (8, 64), (8256, 64)] {
        let arguments = format!("-f lavfi -i color=size=64x64:rate=30:duration=0.1 -vf scale={width}:{height} -pix_fmt gray -c:v ffv1");
        let error = refused(file(&make(dir.path(), "a.mkv", &arguments)));
        assert!(matches!(error, IngestError::UnsupportedSize { .. }), "{width}x{height}: {error}");
    }
    // Odd and not 2:1, but whole.
    let (outcome, _) = Outcome::whole(file(&make(dir.path(), "odd.mkv", &format!("{} -frames:v 3 -c:v ffv1", picture(129, 67, 0.1)))));
    outcome.check();
    assert_eq!((outcome.started[0].0.width, outcome.started[0].0.height, outcome.video.len()), (128, 66, 3));
}

#[test]
fn damage_is_survived_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let whole = std::fs::read(make(dir.path(), "a.ts", &format!("{} {} {X264} -g 10 -c:a aac", picture(128, 64, 1.0), tone(1.0)))).unwrap();
    let damaged = dir.path().join("damaged.ts");
    let mut corrupt = 0;
    for seed in 0..6u64 {
        let mut bytes = whole.clone();
        let mut random = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        // The first packets stay, so that it is known for a video.
        let from = bytes.len() / 5;
        for _ in 0..40 << seed {
            random ^= random << 13;
            random ^= random >> 7;
            random ^= random << 17;
            let place = from + (random >> 8) as usize % (bytes.len() - from);
            bytes[place] ^= 1 << (random & 7);
        }
        std::fs::write(&damaged, bytes).unwrap();
        let (handle, receiver) = start(file(&damaged));
        let outcome = Outcome::collect(&receiver, |_| false);
        assert!(!outcome.video.is_empty(), "{seed}");
        assert!(outcome.video.windows(2).all(|pair| pair[0].pts_us < pair[1].pts_us));
        corrupt += handle.counters().corrupt_packets;
        drop(handle.join());
    }
    assert!(corrupt > 0);
}

#[test]
fn flipped_bits_in_a_header_end_in_an_error_or_in_pictures() {
    let dir = tempfile::tempdir().unwrap();
    let whole = std::fs::read(make(dir.path(), "a.mp4", &format!("{} {X264} -movflags faststart", picture(64, 32, 0.1)))).unwrap();
    let damaged = dir.path().join("damaged.mp4");
    for place in (0..whole.len().min(900)).step_by(23) {
        let mut bytes = whole.clone();
        bytes[place] ^= 0x55;
        std::fs::write(&damaged, bytes).unwrap();
        let Ok(frames) = decode_frames(&Source::File(damaged.clone()), DecodeOptions::default()) else { continue };
        assert!(frames.take(50).count() < 50);
    }
}

#[test]
fn ports_in_use_and_unknown_names_are_refused_at_once() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let source = Source::parse(&format!("rtmp://127.0.0.1:{port}/live/x?listen=1")).unwrap();
    let error = refused(IngestConfig::new(source));
    assert!(matches!(error, IngestError::PortInUse { .. }) && error.to_string().contains(&port.to_string()), "{error}");
    let source = Source::parse("rtmp://192.0.2.1:1935/live/x?listen=1").unwrap();
    assert!(matches!(refused(IngestConfig::new(source)), IngestError::CannotListen { .. }));
    let source = Source::parse("synthetic:nowhere").unwrap();
    assert!(matches!(refused(IngestConfig::new(source)), IngestError::UnknownSynthetic { .. }));
}

#[test]
fn impossible_flags_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {X264}", picture(128, 64, 0.1)));
    let config = IngestConfig { projection: Some(Projection::DualFisheye { fov_deg: f32::NAN }), ..file(&media) };
    assert!(matches!(refused(config), IngestError::UnsupportedProjection { .. }));
    for columns in [0, 1, 15, 8193, u32::MAX] {
        let error = refused(IngestConfig { max_width: Some(columns), ..file(&media) });
        assert!(error.to_string().contains("16 to 8192"), "{error}");
    }
}

#[test]
fn flags_that_would_do_nothing_are_refused() {
    let synthetic = || IngestConfig::new(Source::parse("synthetic:testcard").unwrap());
    let stream = || IngestConfig::new(Source::parse("udp://127.0.0.1:9").unwrap());
    let cases = [
        (IngestConfig { looped: true, ..synthetic() }, "loop"),
        (IngestConfig { looped: true, ..stream() }, "loop"),
        (IngestConfig { stereo: Some(StereoLayout::TopBottom), ..synthetic() }, "stereo"),
        (IngestConfig { projection: Some(Projection::Eac), ..synthetic() }, "projection"),
        (IngestConfig { max_width: Some(64), ..synthetic() }, "max-width"),
    ];
    for (config, flag) in cases {
        let error = refused(config).to_string();
        assert!(error.contains(flag), "{flag}: {error}");
    }
    let options = DecodeOptions { stereo: Some(StereoLayout::TopBottom), projection: None };
    let error = decode_frames(&Source::parse("synthetic:testcard").unwrap(), options).err().unwrap();
    assert!(error.to_string().contains("stereo"), "{error}");
}

#[test]
fn a_file_of_noise_has_no_pictures_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let mut bytes = std::fs::read(make(dir.path(), "a.mp4", &format!("{} {X264} -movflags faststart", picture(64, 32, 0.5)))).unwrap();
    let media = bytes.windows(4).rposition(|word| word == b"mdat").unwrap() + 4;
    bytes[media..].fill(0xff);
    let noise = dir.path().join("noise.mp4");
    std::fs::write(&noise, bytes).unwrap();
    let mut frames = decode_frames(&Source::File(noise), DecodeOptions::default()).unwrap();
    let error = frames.next().unwrap().err().unwrap();
    assert!(error.to_string().contains("noise.mp4") && error.to_string().contains("no picture"), "{error}");
    assert!(frames.next().is_none());
}
