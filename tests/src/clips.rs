//! Clips made by the `ffmpeg` command line tool when a test needs them: small, fully known, and nobody's copyright.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};

use crate::sandbox::Sandbox;

/// Frames between keyframes of [`stereo`], and frames a second: one GOP lasts a second.
pub const GOP: usize = 15;
/// Time of one GOP of [`stereo`], microseconds.
pub const GOP_US: u64 = 1_000_000;

/// Ten seconds of top-bottom stereo, 320×320 at 15 frames/s, H.264 without B frames, with sound: a grey pattern that moves, with
/// a white patch high up as its light, under noise that holds the bitrate near `kbits` kbit/s. Nothing in it has a colour.
///
/// # Errors
/// When ffmpeg is missing or fails.
pub fn stereo(sandbox: &Sandbox, name: &str, kbits: u32) -> Result<PathBuf> {
    // One eye's view: 2:1, moving, with noise in luma alone.
    let view = "gradients=size=320x160:rate=15:duration=10:c0=0x505050:c1=0xc0c0c0:speed=0.05:seed=7,format=yuv420p,\
                noise=c0s=60:c0f=t,drawbox=x=100:y=30:w=20:h=10:color=white:t=fill";
    make(
        sandbox,
        name,
        &format!(
            "-f lavfi -i {view} -f lavfi -i sine=frequency=440:sample_rate=44100:duration=10 \
             -filter_complex [0:v]split[left][copy];[copy]hflip[right];[left][right]vstack[v] -map [v] -map 1:a \
             -c:v libx264 -preset ultrafast -tune zerolatency -bf 0 -g {GOP} -sc_threshold 0 -pix_fmt yuv420p \
             -b:v {kbits}k -maxrate {kbits}k -bufsize {kbits}k -c:a aac -b:a 64k -ac 2"
        ),
    )
}

const MAKER: &str = "clips are made by the ffmpeg command line tool; run deploy/setup";
const QUIET: [&str; 5] = ["-hide_banner", "-nostdin", "-loglevel", "error", "-y"];

/// Runs `ffmpeg ARGUMENTS… NAME` and returns the path of the file it made in the sandbox. `arguments` are parted by white space.
///
/// # Errors
/// When ffmpeg is missing or fails.
pub fn make(sandbox: &Sandbox, name: &str, arguments: &str) -> Result<PathBuf> {
    write(sandbox, name, Command::new("ffmpeg").args(QUIET).args(arguments.split_whitespace()))
}

/// As [`make`], of a video that is repeated without end.
///
/// # Errors
/// When ffmpeg is missing or fails.
pub fn make_of(sandbox: &Sandbox, name: &str, video: &Path, arguments: &str) -> Result<PathBuf> {
    let mut command = Command::new("ffmpeg");
    command.args(QUIET).args(["-stream_loop", "-1", "-i"]).arg(video).args(arguments.split_whitespace());
    write(sandbox, name, &mut command)
}

/// As [`make`], of pictures of `width`×`height` RGB codes at `frame_rate`, which reach ffmpeg one by one. `arguments` say how they are encoded.
///
/// # Errors
/// When ffmpeg is missing or fails.
pub fn make_from(
    sandbox: &Sandbox,
    name: &str,
    (width, height): (u32, u32),
    frame_rate: u32,
    pictures: impl Iterator<Item = Vec<u8>>,
    arguments: &str,
) -> Result<PathBuf> {
    let path = sandbox.path(name);
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
    command.args(["-s", &format!("{width}x{height}"), "-r", &frame_rate.to_string(), "-i", "-"]);
    command.args(arguments.split_whitespace()).arg(&path);
    let mut encoder = command.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().context(MAKER)?;
    let mut input = encoder.stdin.take().context("ffmpeg has no standard input")?;
    // An encoder that has given up closes its input, and says why when it has ended.
    let sent = pictures.into_iter().try_for_each(|picture| input.write_all(&picture));
    drop(input);
    let output = encoder.wait_with_output().context("ffmpeg")?;
    ensure!(output.status.success(), "{}: ffmpeg failed: {}", path.display(), String::from_utf8_lossy(&output.stderr));
    sent.with_context(|| format!("{}: ffmpeg took no more pictures", path.display()))?;
    Ok(path)
}

fn write(sandbox: &Sandbox, name: &str, command: &mut Command) -> Result<PathBuf> {
    let path = sandbox.path(name);
    run(command.arg(&path), &path)?;
    Ok(path)
}

fn run(command: &mut Command, path: &Path) -> Result<()> {
    let output = command.output().context(MAKER)?;
    ensure!(output.status.success(), "{}: ffmpeg failed: {}", path.display(), String::from_utf8_lossy(&output.stderr));
    Ok(())
}

/// Every picture of a video as RGB codes, however unevenly they follow each other.
///
/// # Errors
/// When ffmpeg is missing or fails, or the pictures are not `width`×`height`.
pub fn pictures(video: &Path, (width, height): (u32, u32)) -> Result<Vec<image::RgbImage>> {
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-i"]).arg(video);
    command.args(["-vf", "scale=in_color_matrix=bt709", "-fps_mode", "passthrough", "-pix_fmt", "rgb24", "-f", "rawvideo", "-"]);
    let output = command.output().context("videos are read by the ffmpeg command line tool; run deploy/setup")?;
    ensure!(output.status.success(), "{}: ffmpeg failed: {}", video.display(), String::from_utf8_lossy(&output.stderr));
    let size = width as usize * height as usize * 3;
    ensure!(size > 0 && output.stdout.len().is_multiple_of(size), "{}: its pictures are not {width}×{height}", video.display());
    let picture = |bytes: &[u8]| image::RgbImage::from_raw(width, height, bytes.to_vec()).context("size was checked");
    output.stdout.chunks_exact(size).map(picture).collect()
}
