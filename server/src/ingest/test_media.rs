//! Media made at test time.

use std::path::{Path, PathBuf};
use std::process::Command;

use ffmpeg_next::format::Pixel;
use ffmpeg_next::{Rational, color};

use super::raw::VideoParameters;

/// Untagged 8-bit video of this size.
pub(super) fn parameters(width: u32, height: u32) -> VideoParameters {
    VideoParameters {
        width,
        height,
        sample_aspect: Rational(1, 1),
        reorder: 0,
        pixel: Pixel::YUV420P,
        primaries: color::Primaries::Unspecified,
        transfer: color::TransferCharacteristic::Unspecified,
        matrix: color::Space::Unspecified,
        range: color::Range::Unspecified,
    }
}

/// Runs the ffmpeg program with these arguments, separated by blanks, and the output's path.
pub(super) fn make(dir: &Path, name: &str, arguments: &str) -> PathBuf {
    let path = dir.join(name);
    let output = Command::new("ffmpeg")
        .args(["-hide_banner", "-loglevel", "error", "-y"])
        .args(arguments.split_whitespace())
        .arg(&path)
        .output()
        .expect("the ffmpeg program is installed");
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    path
}

/// Arguments for `seconds` of moving picture at 30 frames a second.
pub(super) fn picture(width: u32, height: u32, seconds: f64) -> String {
    format!("-f lavfi -i testsrc2=size={width}x{height}:rate=30:duration={seconds}")
}

/// Arguments for a tone beside it.
pub(super) fn tone(seconds: f64) -> String {
    format!("-f lavfi -i sine=frequency=440:sample_rate=48000:duration={seconds}")
}
