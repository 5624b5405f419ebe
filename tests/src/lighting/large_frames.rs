//! Light of large frames: the time of every step, and the share of one core that a live stream of them takes, with decoding beside it.
//!
//! The frames are those of the real clip, its left eye's view scaled up: its noise and its number of bright spots are a camera's.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use serde::Deserialize;

use super::Options;
use crate::chart::{Axis, Chart, Mark, Scale, Series, number};
use crate::clips;
use crate::figures::{Quantiles, save};
use crate::sandbox::{Sandbox, media};
use crate::table::Table;

/// Frames a second of the stream that shares of a core are reckoned for.
const FRAME_RATE: f64 = 30.0;
/// What `analyze` calls all steps together.
const TOTAL: &str = "total";

/// A line of `analyze --json`.
#[derive(Deserialize)]
struct Line {
    /// Milliseconds.
    elapsed_ms: BTreeMap<String, f64>,
}

/// Measures, writes `lighting.csv` and the chart `lighting-time.svg`, and returns the section of the summary.
///
/// # Errors
/// When the clip was not fetched, a program fails, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let clip = media("congo_2048.mp4")?;
    let sandbox = Sandbox::new()?;
    let (width, height) = options.size;
    eprintln!("lighting: making {} frames of {width}×{height}", options.frames + 1);
    let make = format!(
        "-an -vf crop=iw:ih/2:0:0,scale={width}:{height},fps={FRAME_RATE} -frames:v {} \
         -c:v libx264 -preset veryfast -crf 20 -bf 0 -g {FRAME_RATE} -pix_fmt yuv420p",
        options.frames + 1
    );
    let source = clips::make_of(&sandbox, "large.mp4", &clip, &make)?;
    eprintln!("lighting: measuring");
    let mut analyze = sandbox.server_command()?;
    analyze.args(["analyze", "--json", "--stereo", "mono", "--method", &options.method]).arg(&source);
    let output = analyze.output().context("mr360-server does not start")?;
    ensure!(output.status.success(), "mr360-server analyze: {}", String::from_utf8_lossy(&output.stderr));
    let lines = String::from_utf8(output.stdout).context("analyze printed no UTF-8")?;
    let lines = lines.lines().skip(1).map(|line| Ok(serde_json::from_str::<Line>(line)?.elapsed_ms)).collect::<Result<Vec<_>>>()?;
    ensure!(!lines.is_empty(), "analyze printed no second frame");
    write(options, &by_step(&lines), decoding_ms(&source)? / f64::from(options.frames + 1))
}

/// The times of each step, frame by frame.
fn by_step(lines: &[BTreeMap<String, f64>]) -> BTreeMap<String, Vec<f64>> {
    let mut steps: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for (step, time) in lines.iter().flatten() {
        steps.entry(step.clone()).or_default().push(*time);
    }
    steps
}

/// CPU time of decoding a whole file on one thread with FFmpeg, the library that the server decodes with.
fn decoding_ms(source: &Path) -> Result<f64> {
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-nostdin", "-benchmark", "-threads", "1", "-i"]).arg(source).args(["-f", "null", "-"]);
    let output = command.output().context("decoding is measured with the ffmpeg command line tool; run deploy/setup")?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{}: ffmpeg failed: {said}", source.display());
    cpu_ms(&said).with_context(|| format!("{}: ffmpeg told no CPU times: {said}", source.display()))
}

/// User and system time in what `ffmpeg -benchmark` says: `bench: utime=1.234s stime=0.056s rtime=0.789s`.
fn cpu_ms(said: &str) -> Option<f64> {
    let line = said.lines().find_map(|line| line.trim().strip_prefix("bench: utime="))?;
    let (user, rest) = line.split_once("s stime=")?;
    let (system, _) = rest.split_once('s')?;
    Some((user.parse::<f64>().ok()? + system.parse::<f64>().ok()?) * 1e3)
}

/// Per cent of one core.
fn share(ms: f64) -> String {
    number(ms * FRAME_RATE / 10.0)
}

fn write(options: &Options, steps: &BTreeMap<String, Vec<f64>>, decoding_ms: f64) -> Result<String> {
    let share_column = format!("% of a core at {FRAME_RATE} frames/s");
    let mut table = Table::new(&["step", "p50 ms", "p95 ms", &share_column]);
    for (step, times) in steps.iter().filter(|(step, _)| *step != TOTAL).chain(steps.get_key_value(TOTAL)) {
        let of = Quantiles::of(times).context("a step without a time")?;
        let name = if step == TOTAL { "light, all steps" } else { step };
        table.push([name.to_owned(), number(of.p50), number(of.p95), share(of.p50)]);
    }
    table.push(["decoding (mean, one thread)".to_owned(), number(decoding_ms), String::new(), share(decoding_ms)]);
    let chart = Chart {
        title: "Time of the light of a frame".to_owned(),
        x: Axis { label: "frame".to_owned(), scale: Scale::Linear },
        y: Axis { label: "time / ms".to_owned(), scale: Scale::Linear },
        series: steps
            .iter()
            .map(|(step, times)| Series {
                name: step.clone(),
                points: times.iter().enumerate().map(|(at, time)| (at as f64 + 1.0, *time)).collect(),
                mark: Mark::Scatter,
            })
            .collect(),
    };
    let (width, height) = options.size;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let summary = format!(
        "## Large frames\n\nMethod `{}`, {} frames of {width}×{height} after the first, H.264, on a machine with {cores} \
         cores. Light is one thread's wall time, decoding is CPU time.\n\n{}\n![Time](lighting-time.svg)\n",
        options.method,
        options.frames,
        table.markdown(),
    );
    save(&options.out, "lighting.csv", &table.csv())?;
    save(&options.out, "lighting-time.svg", &chart.svg()?)?;
    Ok(summary)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ffmpegs_cpu_times_are_read() {
        let said = "frame= 10\nbench: utime=1.250s stime=0.050s rtime=0.7s\nbench: maxrss=100kB\n";
        assert!((cpu_ms(said).unwrap() - 1300.0).abs() < 1e-9);
        assert_eq!(cpu_ms("frame= 10\n"), None);
    }

    #[test]
    fn results_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let options = Options {
            parts: Vec::new(),
            panoramas: None,
            rounds: 1,
            python: None,
            three: None,
            node: "node".into(),
            size: (3840, 1920),
            frames: 2,
            method: "directional".to_owned(),
            out: folder.path().to_owned(),
        };
        let line = |sample, total| BTreeMap::from([("sample".to_owned(), sample), (TOTAL.to_owned(), total)]);
        let section = write(&options, &by_step(&[line(1.0, 3.0), line(2.0, 4.0)]), 20.0).unwrap();
        let csv = std::fs::read_to_string(folder.path().join("lighting.csv")).unwrap();
        assert_eq!(
            csv.lines().skip(1).collect::<Vec<_>>(),
            ["sample,1,2,3", "\"light, all steps\",3,4,9", "\"decoding (mean, one thread)\",20,,60"]
        );
        assert!(folder.path().join("lighting-time.svg").is_file() && section.contains("| sample | 1 | 2 | 3 |"));
    }
}
