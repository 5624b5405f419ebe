//! Damaged files through the program itself: it recovers or says what is wrong, by the exit codes of the command line's contract, and never crashes.
#![expect(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test throughout; clippy knows test functions alone")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Name and arguments of ffmpeg: every container and codec with a demuxer, a parser and a decoder of its own.
const CLIPS: [(&str, &str); 8] = [
    ("h264.mp4", "-c:v libx264 -preset ultrafast -bf 0 -g 10 -pix_fmt yuv420p -c:a aac -movflags faststart"),
    ("h264.ts", "-c:v libx264 -preset ultrafast -g 10 -pix_fmt yuv420p -c:a aac"),
    ("h264.flv", "-c:v libx264 -preset ultrafast -bf 0 -g 10 -pix_fmt yuv420p -c:a aac"),
    ("hevc.mkv", "-c:v libx265 -preset ultrafast -pix_fmt yuv420p10le -x265-params keyint=10:log-level=none -c:a libopus"),
    ("av1.mp4", "-c:v libaom-av1 -cpu-used 8 -usage realtime -g 10 -pix_fmt yuv420p -c:a libopus"),
    ("vp9.webm", "-c:v libvpx-vp9 -deadline realtime -cpu-used 8 -g 10 -c:a libopus"),
    ("mjpeg.avi", "-c:v mjpeg -pix_fmt yuvj420p -c:a pcm_s16le"),
    ("mpeg4.mov", "-c:v mpeg4 -g 10 -c:a aac"),
];
/// Done, failed while running, wrong input.
const CODES: [i32; 3] = [0, 1, 2];
const SEEDS: u64 = 6;

fn make(folder: &Path, name: &str, arguments: &str) -> Vec<u8> {
    let path = folder.join(name);
    let mut command = Command::new("ffmpeg");
    command.args("-hide_banner -nostdin -loglevel error -y -f lavfi -i testsrc2=size=128x64:rate=20:duration=1".split(' '));
    command.args("-f lavfi -i sine=frequency=440:sample_rate=48000:duration=1".split(' ')).args(arguments.split(' ')).arg(&path);
    let output = command.output().expect("the ffmpeg program is installed");
    assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    std::fs::read(path).unwrap()
}

/// The file with 2, 8, 32 … of its bits flipped, or cut off after some share of it.
fn damaged(whole: &[u8], seed: u64) -> [Vec<u8>; 2] {
    let mut random = (seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mut next = move || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random >> 8
    };
    let mut flipped = whole.to_vec();
    for _ in 0..2 << (2 * seed) {
        let place = next() as usize % flipped.len();
        flipped[place] ^= 1 << (next() & 7);
    }
    [flipped, whole[..1 + next() as usize % (whole.len() - 1)].to_vec()]
}

/// Runs the program; one that hangs is ended, with code 124.
fn server(folder: &Path, arguments: &[&str], file: &Path) -> Output {
    let mut command = Command::new("timeout");
    command.args(["60", env!("CARGO_BIN_EXE_mr360-server")]).args(arguments).arg(file).current_dir(folder).env("HOME", folder);
    for variable in ["XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"] {
        command.env(variable, folder);
    }
    command.output().unwrap()
}

/// Ended by the contract, and with an error that names the file where it failed.
fn check(output: &Output, what: &str, file: &Path) -> i32 {
    let said = String::from_utf8_lossy(&output.stderr);
    let code = output.status.code().unwrap_or_else(|| panic!("{what}: {}\n{said}", output.status));
    assert!(CODES.contains(&code) && !said.contains("panicked"), "{what}: code {code}\n{said}");
    let named = said.lines().any(|line| line.starts_with("error: ") && line.contains(file.to_str().unwrap()));
    assert_eq!(named, code != 0, "{what}: code {code}\n{said}");
    code
}

fn for_each_damage(folder: &Path, clips: &[(&str, &str)], seeds: u64, mut run: impl FnMut(&str, PathBuf)) {
    for (name, arguments) in clips {
        let whole = make(folder, name, arguments);
        for seed in 0..seeds {
            for (kind, bytes) in ["flipped", "cut"].into_iter().zip(damaged(&whole, seed)) {
                let path = folder.join(format!("{kind}-{seed}-{name}"));
                std::fs::write(&path, bytes).unwrap();
                run(&format!("{kind} {seed} {name}"), path);
            }
        }
    }
}

#[test]
fn damaged_files_are_analysed_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (mut lit, mut codes) = (0, [0; 3]);
    for_each_damage(folder.path(), &CLIPS, SEEDS, |what, path| {
        let output = server(folder.path(), &["analyze", "--json", "--frames", "8"], &path);
        codes[check(&output, what, &path) as usize] += 1;
        for line in String::from_utf8_lossy(&output.stdout).lines() {
            let frame: serde_json::Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{what}: {error}: {line}"));
            assert!(frame["sh"].as_array().is_some_and(|sh| [9, 25].contains(&sh.len())), "{what}");
            lit += 1;
        }
    });
    // Most damage is survived, and some cannot be.
    assert!(lit > 200 && codes[0] > codes[2] && codes[2] > 0, "{lit} frames, exit codes {codes:?}");
}

#[test]
fn damaged_files_are_broadcast_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut paths = Vec::new();
    for_each_damage(folder.path(), &CLIPS[..5], 2, |what, path| paths.push((what.to_owned(), path)));
    // Files are played in real time, so all at once.
    std::thread::scope(|scope| {
        for (what, path) in &paths {
            let folder = folder.path();
            scope.spawn(move || check(&server(folder, &["serve", "--listen", "127.0.0.1:0", "--source"], path), what, path));
        }
    });
}
