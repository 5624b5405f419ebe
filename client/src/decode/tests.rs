use std::process::Command;
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

use super::*;
use crate::picture::Samples;

/// Room for every picture of a test: none gives way to a newer one, however slow the machine is.
const ALL: usize = 1_000;
/// Longer than any decoder takes on any machine: only a broken one runs into it.
const PATIENCE: Duration = Duration::from_secs(60);

/// Access units of a clip that the `ffmpeg` tool encodes: (keyframe, Annex B).
fn clip(size: &str, frames: u32, encoder: &[&str]) -> Vec<(bool, Bytes)> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("clip.mkv");
    let mut command = Command::new("ffmpeg");
    command.args(["-v", "error", "-f", "lavfi", "-i", &format!("testsrc2=size={size}:rate=30"), "-frames:v", &frames.to_string()]);
    command.args(encoder).arg(&path);
    assert!(command.status().unwrap().success());
    // Matroska holds length-prefixed units: the filter brings them to Annex B.
    let annex_b = folder.path().join("clip.nut");
    let filter = if encoder.contains(&"libx265") { "hevc_mp4toannexb" } else { "h264_mp4toannexb" };
    let status =
        Command::new("ffmpeg").args(["-v", "error", "-i"]).arg(&path).args(["-c", "copy", "-bsf:v", filter]).arg(&annex_b).status();
    assert!(status.unwrap().success());
    let mut input = ffmpeg_next::format::input(&annex_b).unwrap();
    input.packets().map(|(_, packet)| (packet.is_key(), Bytes::copy_from_slice(packet.data().unwrap()))).collect()
}

const X264: [&str; 8] = ["-c:v", "libx264", "-preset", "ultrafast", "-tune", "zerolatency", "-g", "10"];

fn format(codec: Codec) -> VideoFormat {
    VideoFormat { codec, width: 0, height: 0, colour: Colour::default(), stereo: StereoLayout::Mono }
}

/// Not evenly spaced, so that a pts made up by the decoder would be noticed.
fn pts_of(index: usize) -> u64 {
    5_000_017 + index as u64 * 33_333 + (index as u64 % 7) * 11
}

fn unit(index: usize, keyframe: bool, data: Bytes) -> AccessUnit {
    AccessUnit { pts_us: pts_of(index), keyframe, data, arrived: ClientTime(index as u64) }
}

/// Pushes units with room for the queue, then takes every picture.
fn decode(decoder: VideoDecoder, pictures: &PictureReceiver) -> Vec<Decoded> {
    let finisher = std::thread::spawn(move || decoder.finish());
    let all = std::iter::from_fn(|| pictures.recv_timeout(PATIENCE).ok()).collect();
    finisher.join().unwrap();
    all
}

fn started(codec: Codec) -> (VideoDecoder, PictureReceiver) {
    let (mut decoder, pictures) = VideoDecoder::start_with(ClientClock::start(), Hardware::Prefer, ALL).unwrap();
    decoder.set_format(format(codec)).unwrap();
    (decoder, pictures)
}

#[test]
fn every_unit_gives_its_picture_with_its_pts() {
    let units = clip("322x162", 25, &X264);
    let (mut decoder, pictures) = started(Codec::H264);
    for (i, (keyframe, data)) in units.iter().enumerate() {
        decoder.push(unit(i, *keyframe, data.clone())).unwrap();
    }
    let counters = decoder.counters();
    let all = decode(decoder, &pictures);
    assert_eq!(all.iter().map(|d| d.picture.pts_us).collect::<Vec<_>>(), (0..25).map(pts_of).collect::<Vec<_>>());
    assert_eq!(all.iter().map(|d| d.arrived.0).collect::<Vec<_>>(), (0..25).collect::<Vec<_>>());
    assert_eq!((counters.units.get(), counters.pictures.get(), counters.errors.get()), (25, 25, 0));
    let Samples::Yuv { planes, .. } = &all[0].picture.samples else { panic!("not YUV") };
    assert_eq!((all[0].picture.width, all[0].picture.height), (322, 162));
    assert_eq!(
        planes.each_ref().map(|p| (p.width, p.height, p.data.len())),
        [(322, 162, 322 * 162), (161, 81, 161 * 81), (161, 81, 161 * 81)]
    );
    // testsrc2 is colourful: its chroma is not grey.
    assert!(planes[1].data.iter().any(|s| s.abs_diff(128) > 60));
}

#[test]
fn low_delay_hands_out_each_picture_before_the_next_unit() {
    let units = clip("64x32", 4, &X264);
    let (mut decoder, pictures) = started(Codec::H264);
    for (i, (keyframe, data)) in units.iter().enumerate() {
        decoder.push(unit(i, *keyframe, data.clone())).unwrap();
        // Blocks for ever, and so fails the run, if the decoder held the picture back.
        assert_eq!(pictures.recv_timeout(PATIENCE).unwrap().picture.pts_us, pts_of(i));
    }
}

#[test]
fn ten_bit_hevc_keeps_its_bits() {
    let units = clip(
        "128x64",
        3,
        &["-pix_fmt", "yuv420p10le", "-c:v", "libx265", "-preset", "ultrafast", "-x265-params", "log-level=none:bframes=0"],
    );
    let (mut decoder, pictures) = started(Codec::Hevc);
    for (i, (keyframe, data)) in units.iter().enumerate() {
        decoder.push(unit(i, *keyframe, data.clone())).unwrap();
    }
    let all = decode(decoder, &pictures);
    assert_eq!(all.len(), 3);
    let Samples::Yuv { planes, colour } = &all[0].picture.samples else { panic!("not YUV") };
    assert_eq!((colour.bit_depth, planes[0].stride, planes[0].data.len()), (10, 256, 256 * 64));
}

#[test]
fn formats_that_the_renderer_does_not_take_are_converted() {
    let units = clip("64x32", 2, &["-pix_fmt", "gbrp", "-c:v", "libx264rgb", "-preset", "ultrafast", "-tune", "zerolatency"]);
    let (mut decoder, pictures) = started(Codec::H264);
    for (i, (keyframe, data)) in units.iter().enumerate() {
        decoder.push(unit(i, *keyframe, data.clone())).unwrap();
    }
    let all = decode(decoder, &pictures);
    assert_eq!(all.len(), 2);
    let Samples::Yuv { planes, colour } = &all[0].picture.samples else { panic!("not YUV") };
    assert_eq!((planes[1].width, planes[1].height), (64, 32));
    assert_eq!(colour.matrix, mr360_protocol::video::Matrix::Bt601);
}

#[test]
fn codec_and_size_may_change_midway() {
    let first = clip("64x32", 3, &X264);
    let second = clip("128x64", 3, &["-c:v", "libx265", "-preset", "ultrafast", "-x265-params", "log-level=none:bframes=0"]);
    let third = clip("96x48", 3, &X264);
    let (mut decoder, pictures) = started(Codec::H264);
    let mut index = 0;
    for (codec, units) in [(Codec::H264, first), (Codec::Hevc, second), (Codec::H264, third)] {
        decoder.set_format(format(codec)).unwrap();
        for (keyframe, data) in units {
            decoder.push(unit(index, keyframe, data)).unwrap();
            index += 1;
        }
    }
    let widths: Vec<_> = decode(decoder, &pictures).iter().map(|d| d.picture.width).collect();
    assert_eq!(widths, [64, 64, 64, 128, 128, 128, 96, 96, 96]);
}

#[test]
fn damage_is_counted_and_healed_by_the_next_keyframe() {
    let units = clip("128x64", 30, &X264);
    let (mut decoder, pictures) = started(Codec::H264);
    let counters = decoder.counters();
    // Without its keyframe nothing starts.
    decoder.push(unit(1, false, units[1].1.clone())).unwrap();
    assert_eq!(counters.unanchored.get(), 1);
    for (i, (keyframe, data)) in units.iter().enumerate() {
        let mut data = data.to_vec();
        if i == 10 {
            // A keyframe of noise: start codes, parameter sets and slice are gone.
            data.iter_mut().enumerate().for_each(|(at, byte)| *byte = (at as u32).wrapping_mul(2_654_435_761).to_le_bytes()[3]);
        }
        decoder.push(unit(i, *keyframe, data.into())).unwrap();
    }
    let shown: Vec<_> = decode(decoder, &pictures).iter().map(|d| d.picture.pts_us).collect();
    assert!(counters.errors.get() > 0);
    assert!((0..10).chain(20..30).all(|i| shown.contains(&pts_of(i))), "{shown:?}");
    assert!(!shown.contains(&pts_of(10)));
}

#[test]
fn random_bytes_never_end_the_decoder() {
    let good = clip("64x32", 1, &X264);
    let (mut decoder, pictures) = started(Codec::H264);
    let mut state = 1_u32;
    for i in 0..40 {
        let noise: Vec<u8> = (0..500)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        let data = [&[0, 0, 0, 1, 0x65][..], &noise].concat();
        decoder.push(unit(i, true, data.into())).unwrap();
    }
    decoder.push(unit(40, true, Bytes::new())).unwrap();
    decoder.push(unit(41, true, good[0].1.clone())).unwrap();
    assert!(decode(decoder, &pictures).iter().any(|d| d.picture.pts_us == pts_of(41)));
}

#[test]
fn bounds_are_refused_with_a_remedy() {
    let (mut decoder, pictures) = VideoDecoder::start_with(ClientClock::start(), Hardware::Never, ALL).unwrap();
    assert!(matches!(decoder.push(unit(0, true, Bytes::new())), Err(DecodeError::NoFormat)));
    let large = VideoFormat { width: 8193, height: 4096, ..format(Codec::H264) };
    assert!(decoder.set_format(large).unwrap_err().to_string().contains("8193×4096"));
    decoder.set_format(format(Codec::H264)).unwrap();
    let unit_bytes = Bytes::from(vec![0; MAX_UNIT_BYTES + 1]);
    assert!(matches!(decoder.push(unit(0, true, unit_bytes)), Err(DecodeError::UnitTooLarge { .. })));
    assert!(matches!(pictures.recv_timeout(Duration::ZERO), Err(RecvTimeoutError::Timeout)));
}

#[test]
fn a_full_queue_drops_up_to_the_next_keyframe() {
    let units = clip("64x32", 1, &X264);
    let (mut decoder, pictures) = VideoDecoder::start(ClientClock::start(), Hardware::Never).unwrap();
    decoder.set_format(format(Codec::H264)).unwrap();
    let counters = decoder.counters();
    // Nobody takes pictures, so that each holds the decoder up for a while: units come faster.
    let refused = (0..100_000).find(|i| {
        decoder.push(unit(*i, true, units[0].1.clone())).unwrap();
        counters.backlog.get() > 0
    });
    assert!(refused.unwrap() >= QUEUED_UNITS);
    decoder.push(unit(100_000, false, units[0].1.clone())).unwrap();
    assert_eq!(counters.unanchored.get(), 1);
    drop(pictures);
    decoder.finish();
}
