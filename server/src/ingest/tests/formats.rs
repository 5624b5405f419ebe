//! Codecs, containers, projections and colours.

use mr360_protocol::video::{Matrix, Primaries, Transfer};

use super::*;
use crate::ingest::test_media::{make, picture, tone};

#[test]
fn h264_with_aac_passes_through_and_every_frame_is_decoded() {
    let dir = tempfile::tempdir().unwrap();
    let media = format!("{} {} {X264} -g 15 -c:a aac", picture(256, 128, 1.0), tone(1.0));
    let (outcome, counters) = Outcome::whole(file(&make(dir.path(), "a.mp4", &media)));
    outcome.check();
    let (video, audio) = &outcome.started[0];
    assert_eq!((video.codec, video.width, video.height, video.stereo), (VideoCodec::H264, 256, 128, StereoLayout::Mono));
    assert_eq!(video.transcoded_because, None);
    assert!((video.frame_rate - 30.0).abs() < 0.01);
    let audio = audio.as_ref().unwrap();
    assert_eq!((audio.codec, audio.sample_rate, &audio.description[..2]), (AudioCodec::Aac, 48_000, &[0x11, 0x88][..]));
    assert_eq!((outcome.video.len(), outcome.frames.len(), outcome.started.len()), (30, 30, 1));
    assert_eq!(outcome.video.iter().filter(|unit| unit.keyframe).count(), 2);
    assert!(outcome.audio.len() > 45);
    assert_eq!(counters, IngestCounters::default());
}

#[test]
fn hevc_and_av1_pass_through() {
    let dir = tempfile::tempdir().unwrap();
    let hevc = "-c:v libx265 -preset ultrafast -pix_fmt yuv420p -x265-params bframes=0:keyint=10:log-level=none";
    let av1 = "-c:v libaom-av1 -cpu-used 8 -usage realtime -g 10 -pix_fmt yuv420p";
    for (name, codec, arguments) in [
        ("a.mp4", VideoCodec::Hevc, hevc),
        ("a.ts", VideoCodec::Hevc, hevc),
        ("b.mp4", VideoCodec::Av1, av1),
        ("b.mkv", VideoCodec::Av1, av1),
    ] {
        let media = make(dir.path(), name, &format!("{} {arguments}", picture(256, 128, 0.7)));
        let (outcome, counters) = Outcome::whole(file(&media));
        outcome.check();
        assert_eq!((outcome.started[0].0.codec, &outcome.started[0].0.transcoded_because), (codec, &None), "{name}");
        assert_eq!((outcome.video.len(), outcome.frames.len()), (21, 21), "{name}");
        assert_eq!(counters, IngestCounters::default(), "{name}");
        for unit in outcome.video.iter().filter(|unit| unit.keyframe) {
            match codec {
                VideoCodec::Av1 => assert!(unit.data.windows(2).any(|pair| pair[0] == 0x0a && pair[1] < 32), "{name}: sequence header"),
                _ => assert!(unit.data.windows(5).any(|part| part[..4] == [0, 0, 1, 0x42]), "{name}: SPS"),
            }
        }
    }
}

#[test]
fn reordered_rare_keyframes_and_foreign_codecs_are_transcoded() {
    let dir = tempfile::tempdir().unwrap();
    for (name, arguments, reason) in [
        ("b.mp4", "-c:v libx264 -preset veryfast -bf 2 -pix_fmt yuv420p", "reordered"),
        ("long.mp4", &format!("{X264} -g 900 -sc_threshold 0"), "apart"),
        ("vp9.webm", "-c:v libvpx-vp9 -deadline realtime -cpu-used 8", "VP9"),
        ("mjpeg.avi", "-c:v mjpeg -q:v 3 -pix_fmt yuvj444p", "MJPEG"),
    ] {
        let media = make(dir.path(), name, &format!("{} {arguments}", picture(128, 64, 2.5)));
        let (outcome, counters) = Outcome::whole(file(&media));
        outcome.check();
        let (video, _) = &outcome.started[0];
        assert!(video.transcoded_because.as_ref().is_some_and(|because| because.contains(reason)), "{name}: {video:?}");
        assert_eq!((video.codec, outcome.started.len()), (VideoCodec::H264, 1), "{name}: {:?}", outcome.started);
        assert_eq!(video.colour.full_range, name == "mjpeg.avi");
        assert_eq!((outcome.video.len(), outcome.frames.len()), (75, 75), "{name}");
        assert!(outcome.video.iter().filter(|unit| unit.keyframe).count() >= 3, "{name}");
        assert_eq!(counters, IngestCounters::default(), "{name}");
    }
}

#[test]
fn hdr_keeps_its_colour_passed_through_and_transcoded() {
    let dir = tempfile::tempdir().unwrap();
    for (transfer, tag) in [(Transfer::Pq, "smpte2084"), (Transfer::Hlg, "arib-std-b67")] {
        for bframes in [0, 2] {
            let arguments = format!(
                "{} -c:v libx265 -preset ultrafast -pix_fmt yuv420p10le -color_primaries bt2020 -color_trc {tag} -colorspace bt2020nc \
                 -x265-params bframes={bframes}:keyint=10:b-adapt=0:log-level=none:colorprim=bt2020:transfer={tag}:colormatrix=bt2020nc",
                picture(128, 64, 0.7)
            );
            let (outcome, _) = Outcome::whole(file(&make(dir.path(), "hdr.mp4", &arguments)));
            outcome.check();
            let (video, _) = outcome.started.last().unwrap();
            let colour = Colour { primaries: Primaries::Bt2020, matrix: Matrix::Bt2020, transfer, full_range: false, bit_depth: 10 };
            assert_eq!((video.codec, video.colour), (VideoCodec::Hevc, colour));
            assert_eq!(video.transcoded_because.is_some(), bframes > 0);
            assert_eq!((outcome.frames.len(), outcome.started.len()), (21, 1));
        }
    }
}

#[test]
fn foreign_sound_becomes_opus_and_opus_stays() {
    let dir = tempfile::tempdir().unwrap();
    for (name, codec) in [("a.mkv", "libmp3lame"), ("b.mkv", "libopus"), ("c.mkv", "pcm_s16le -ac 6")] {
        let arguments = format!("{} {} {X264} -g 15 -c:a {codec}", picture(128, 64, 1.0), tone(1.0));
        let (outcome, counters) = Outcome::whole(file(&make(dir.path(), name, &arguments)));
        outcome.check();
        let audio = outcome.started[0].1.as_ref().unwrap();
        assert_eq!((audio.codec, audio.sample_rate), (AudioCodec::Opus, 48_000), "{name}");
        assert!(audio.description.starts_with(b"OpusHead\x01"), "{name}");
        assert!((45..=53).contains(&outcome.audio.len()), "{name}: {}", outcome.audio.len());
        assert_eq!(counters, IngestCounters::default(), "{name}");
        // Sound begins with the picture, but for the codec's priming.
        assert!(outcome.audio[0].pts_us.abs_diff(outcome.video[0].pts_us) < 60_000, "{name}");
    }
}

#[test]
fn a_loop_goes_on_without_a_gap() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {} {X264} -g 15 -c:a aac", picture(128, 64, 0.5), tone(0.5)));
    let (handle, receiver) = start(IngestConfig { looped: true, ..file(&media) });
    let outcome = Outcome::collect(&receiver, |outcome| outcome.video.len() >= 40 && outcome.frames.len() >= 40);
    handle.stop();
    outcome.check();
    assert_eq!((outcome.started.len(), handle.counters()), (1, IngestCounters::default()));
    let steps = outcome.video.windows(2).map(|pair| pair[1].pts_us - pair[0].pts_us);
    // Sound may last a frame of its own longer than the picture.
    assert!(steps.clone().all(|step| (30_000..90_000).contains(&step)), "{:?}", steps.collect::<Vec<_>>());
    handle.join().unwrap();
}

#[test]
fn projections_and_widths_are_brought_to_equirect() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "a.mp4", &format!("{} {X264} -g 15", picture(384, 256, 0.3)));
    for (projection, stereo, size) in [
        (Projection::Cubemap, StereoLayout::Mono, (512, 256)),
        (Projection::Eac, StereoLayout::Mono, (512, 256)),
        (Projection::DualFisheye { fov_deg: 190.0 }, StereoLayout::Mono, (384, 192)),
        (Projection::Cubemap, StereoLayout::TopBottom, (512, 512)),
    ] {
        let config = IngestConfig { projection: Some(projection), stereo: Some(stereo), ..file(&media) };
        let (outcome, _) = Outcome::whole(config);
        outcome.check();
        let (video, _) = &outcome.started[0];
        assert_eq!(((video.width, video.height), video.stereo), (size, stereo), "{projection:?}");
        assert!(video.transcoded_because.as_ref().is_some_and(|because| because.contains("projection")));
        assert!(outcome.frames.len() == 9 && outcome.frames.iter().all(|frame| frame.1 == size && frame.2 == stereo));
    }
    let (outcome, _) = Outcome::whole(IngestConfig { max_width: Some(192), ..file(&media) });
    assert_eq!((outcome.started[0].0.width, outcome.frames[0].1), (192, (192, 128)));
}

#[test]
fn decoding_for_analysis_gives_every_frame_unpaced() {
    let dir = tempfile::tempdir().unwrap();
    let media = make(dir.path(), "b.mp4", &format!("{} -c:v libx264 -bf 2 -pix_fmt yuv444p", picture(128, 64, 20.0)));
    let frames: Vec<_> = decode_frames(&Source::File(media), DecodeOptions::default()).unwrap().map(Result::unwrap).collect();
    assert_eq!((frames.len(), frames[0].pts_us, frames[0].size()), (600, 0, (128, 64)));
    assert!(frames.windows(2).all(|pair| (33_000..34_000).contains(&(pair[1].pts_us - pair[0].pts_us))));
    let card = Source::parse("synthetic:testcard?size=64x32&fps=10").unwrap();
    let third = decode_frames(&card, DecodeOptions::default()).unwrap().nth(2).unwrap().unwrap();
    let Pixels::Video(picture, _) = &third.pixels else { panic!("not video") };
    assert_eq!((third.pts_us, testcard::read_number(picture.data(0), picture.stride(0), 64, 32)), (200_000, Some(2)));
}
