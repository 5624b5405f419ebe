//! One server, more and more viewers: what their light's age and the server's work become.
//!
//! Every viewer is a whole headless client that decodes and renders, on the machine of the server. Where they want
//! more than its cores, ages grow by their own work; the table therefore names the cores and what the viewers took.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};

use crate::chart::{Axis, Chart, Mark, Scale, Series, number};
use crate::figures::{Quantiles, frame_rate, quantiles_ms, save};
use crate::process::Program;
use crate::samples::Samples;
use crate::sandbox::Sandbox;
use crate::table::Table;
use crate::usage;

/// Rows of a viewer's first second are left out: caches, shaders and the playout buffer fill in it.
const WARM_UP_US: f64 = 1e6;
/// Longest that starting and ending a viewer may take beyond the time it is asked to watch.
const OVERHEAD: Duration = Duration::from_secs(180);
const SERVER_STATS: &str = "server.csv";

/// What to run.
#[derive(Debug, Clone)]
pub struct Options {
    /// Numbers of viewers, one run each.
    pub viewers: Vec<usize>,
    /// How long each viewer watches, seconds.
    pub seconds: u32,
    /// As for `mr360-server serve --source`.
    pub source: String,
    /// Size of each viewer's picture, `WIDTHxHEIGHT`.
    pub size: String,
    /// Folder that the results go into; made where it is missing.
    pub out: PathBuf,
}

/// What one run measured. Times in milliseconds, over the frames of all viewers together.
#[derive(Debug, Clone, PartialEq)]
struct Run {
    viewers: usize,
    frames: usize,
    frames_per_second: f64,
    light_age: Quantiles,
    video_age: Quantiles,
    /// Cores: 1.0 is one core all the time.
    server_cores: f64,
    server_peak_bytes: u64,
    /// Payload, bytes a second of broadcast time; by track.
    track_rates: BTreeMap<String, f64>,
}

/// Runs the bench and writes `network.csv`, `network.md` and the charts `network-{age,cpu,memory}.svg`.
///
/// # Errors
/// When a program fails, writes no statistics, or the results cannot be written.
pub fn run(options: &Options) -> Result<()> {
    ensure!(options.viewers.iter().all(|&count| count > 0) && !options.viewers.is_empty(), "--viewers wants numbers from 1 on");
    ensure!(options.seconds > 1, "--seconds wants 2 or more: the first second is left out");
    fs::create_dir_all(&options.out).with_context(|| format!("--out {}: cannot be made", options.out.display()))?;
    let mut runs = Vec::new();
    for (at, &viewers) in options.viewers.iter().enumerate() {
        eprintln!("network: run {} of {}: {viewers} viewers for {} s", at + 1, options.viewers.len(), options.seconds);
        let run = measure(options, viewers).with_context(|| format!("run with {viewers} viewers"))?;
        eprintln!(
            "network: light age p50 {} ms, p95 {} ms; server {} cores",
            number(run.light_age.p50),
            number(run.light_age.p95),
            number(run.server_cores)
        );
        runs.push(run);
    }
    write(options, &runs)
}

fn measure(options: &Options, count: usize) -> Result<Run> {
    let sandbox = Sandbox::new()?;
    let mut server = sandbox.serve(&options.source, &["--listen", "127.0.0.1:0", "--stats", SERVER_STATS])?;
    let seconds = options.seconds.to_string();
    let started = Instant::now();
    let cpu_before = usage::cpu_time(server.program.id())?;
    let mut viewers: Vec<Program> = (1..=count)
        .map(|number| {
            let stats = viewer_stats(number);
            let arguments = ["--mode", "headless", "--size", &options.size, "--duration", &seconds, "--stats", &stats];
            sandbox.join(&format!("viewer {number}"), &server.join_url, &arguments)
        })
        .collect::<Result<_>>()?;
    let within = Duration::from_secs(options.seconds.into()) + OVERHEAD;
    for viewer in &mut viewers {
        let status = viewer.wait_for_exit(within)?;
        ensure!(status.success(), "a viewer ended with {status}; its output:\n{}", viewer.output());
    }
    let cpu = usage::cpu_time(server.program.id())?.saturating_sub(cpu_before);
    let server_cores = cpu.as_secs_f64() / started.elapsed().as_secs_f64();
    let server_peak_bytes = usage::memory(server.program.id())?.peak;
    server.program.finish(OVERHEAD)?;

    let samples = (1..=count).map(|number| Samples::load(&sandbox.path(&viewer_stats(number)))).collect::<Result<Vec<_>>>()?;
    let samples = samples.iter().map(|viewer| viewer.after("arrived_us", WARM_UP_US)).collect::<Result<Vec<_>>>()?;
    Ok(Run {
        viewers: count,
        frames: samples.iter().map(Samples::len).sum(),
        frames_per_second: frame_rate(&samples)?,
        light_age: quantiles_ms(&samples, "light_age_us")?,
        video_age: quantiles_ms(&samples, "video_age_us")?,
        server_cores,
        server_peak_bytes,
        track_rates: track_rates(&Samples::load(&sandbox.path(SERVER_STATS))?)?,
    })
}

fn viewer_stats(number: usize) -> String {
    format!("viewer-{number}.csv")
}

/// Bytes a second of each track, from the server's columns named `TRACK_bytes` and the span of its `pts_us`.
fn track_rates(server: &Samples) -> Result<BTreeMap<String, f64>> {
    let pts: Vec<f64> = server.column("pts_us")?.into_iter().flatten().collect();
    let (first, last) = pts.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &t| (lo.min(t), hi.max(t)));
    ensure!(last > first, "the server's statistics span no time");
    // The last frame has its own duration, too.
    let seconds = (last - first) / 1e6 * pts.len() as f64 / (pts.len() - 1) as f64;
    let tracks = server.columns().iter().filter_map(|column| Some((column, column.strip_suffix("_bytes")?)));
    tracks.map(|(column, track)| Ok((track.to_owned(), server.column(column)?.into_iter().flatten().sum::<f64>() / seconds))).collect()
}

fn write(options: &Options, runs: &[Run]) -> Result<()> {
    let table = table(runs);
    let cores = std::thread::available_parallelism().map_or_else(|_| "an unknown number of".to_owned(), |n| n.to_string());
    let tracks = tracks_table(runs);
    let summary = format!(
        "# Network\n\n`mr360-bench network`: source `{}`, {} s a run, the first second of each viewer left out. Server and viewers \
         ({}, headless) share one machine with {cores} cores: ages include the wait for a core.\n\n{}\n\
         Payload of the tracks, as the server published it:\n\n{}\n![Age](network-age.svg)\n\n![CPU](network-cpu.svg)\n\n![Memory](network-memory.svg)\n",
        options.source,
        options.seconds,
        options.size,
        table.markdown(),
        tracks.markdown(),
    );
    for (name, content) in [
        ("network.csv", table.csv()),
        ("network.md", summary),
        ("network-age.svg", age_chart(runs).svg()?),
        ("network-cpu.svg", cpu_chart(runs).svg()?),
        ("network-memory.svg", memory_chart(runs).svg()?),
    ] {
        save(&options.out, name, &content)?;
    }
    Ok(())
}

fn table(runs: &[Run]) -> Table {
    let mut table = Table::new(&[
        "viewers",
        "frames",
        "frames/s a viewer",
        "light age p50 ms",
        "light age p95 ms",
        "video age p50 ms",
        "video age p95 ms",
        "server cores",
        "server peak MiB",
    ]);
    for run in runs {
        let counts = [run.viewers.to_string(), run.frames.to_string()];
        let figures = [
            run.frames_per_second,
            run.light_age.p50,
            run.light_age.p95,
            run.video_age.p50,
            run.video_age.p95,
            run.server_cores,
            mebibytes(run.server_peak_bytes),
        ];
        table.push(counts.into_iter().chain(figures.map(number)));
    }
    table
}

fn tracks_table(runs: &[Run]) -> Table {
    let mut table = Table::new(&["viewers", "track", "bytes/s", "share of video"]);
    for run in runs {
        let video = run.track_rates.get("video").copied().filter(|&rate| rate > 0.0);
        for (track, rate) in &run.track_rates {
            let share = video.map_or_else(String::new, |video| format!("{} %", number(rate / video * 100.0)));
            table.push([run.viewers.to_string(), track.clone(), number(rate.round()), share]);
        }
    }
    table
}

fn mebibytes(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

fn viewers_axis() -> Axis {
    Axis { label: "viewers".to_owned(), scale: Scale::Log }
}

fn series(name: &str, runs: &[Run], value: impl Fn(&Run) -> f64) -> Series {
    let points = runs.iter().map(|run| (run.viewers as f64, value(run))).collect();
    Series { name: name.to_owned(), points, mark: Mark::Line }
}

fn age_chart(runs: &[Run]) -> Chart {
    Chart {
        title: "Age of what viewers present".to_owned(),
        x: viewers_axis(),
        y: Axis { label: "age / ms".to_owned(), scale: Scale::Linear },
        series: vec![
            series("light, p50", runs, |run| run.light_age.p50),
            series("light, p95", runs, |run| run.light_age.p95),
            series("video, p50", runs, |run| run.video_age.p50),
            series("video, p95", runs, |run| run.video_age.p95),
        ],
    }
}

fn cpu_chart(runs: &[Run]) -> Chart {
    Chart {
        title: "Computing by the server".to_owned(),
        x: viewers_axis(),
        y: Axis { label: "cores".to_owned(), scale: Scale::Linear },
        series: vec![series("server", runs, |run| run.server_cores)],
    }
}

fn memory_chart(runs: &[Run]) -> Chart {
    Chart {
        title: "Memory of the server".to_owned(),
        x: viewers_axis(),
        y: Axis { label: "peak resident / MiB".to_owned(), scale: Scale::Linear },
        series: vec![series("server", runs, |run| mebibytes(run.server_peak_bytes))],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run_of(viewers: usize) -> Run {
        Run {
            viewers,
            frames: 10,
            frames_per_second: 30.0,
            light_age: Quantiles { p50: 20.0, p95: 30.0 },
            video_age: Quantiles { p50: 25.0, p95: 40.0 },
            server_cores: 0.5,
            server_peak_bytes: 64 << 20,
            track_rates: BTreeMap::from([("light".to_owned(), 3000.0), ("video".to_owned(), 400_000.0)]),
        }
    }

    #[test]
    fn rates_of_tracks_come_from_their_bytes_and_the_span() {
        // Three frames at 30 frames/s last 0.1 s.
        let server = Samples::parse("pts_us,light_ms,light_bytes,video_bytes\n0,1,10,100\n33333,1,10,\n66666,1,10,200\n", "s").unwrap();
        let rates = track_rates(&server).unwrap();
        assert_eq!(rates.len(), 2);
        // The microseconds are rounded, hence not exactly 300.
        assert!((rates["light"] - 300.0).abs() < 0.01 && (rates["video"] - 3000.0).abs() < 0.1, "{rates:?}");
    }

    #[test]
    fn results_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let options = Options {
            viewers: vec![1, 2],
            seconds: 5,
            source: "synthetic:plaza".to_owned(),
            size: "320x180".to_owned(),
            out: folder.path().to_owned(),
        };
        write(&options, &[run_of(1), run_of(2)]).unwrap();
        let summary = fs::read_to_string(folder.path().join("network.md")).unwrap();
        assert!(summary.contains("| 2 | 10 | 30 | 20 | 30 | 25 | 40 | 0.5 | 64 |"), "{summary}");
        assert!(summary.contains("| 1 | light | 3000 | 0.75 % |"), "{summary}");
        assert_eq!(fs::read_to_string(folder.path().join("network.csv")).unwrap().lines().count(), 3);
        for chart in ["network-age.svg", "network-cpu.svg", "network-memory.svg"] {
            assert!(folder.path().join(chart).is_file(), "{chart}");
        }
    }

    #[test]
    fn empty_plans_are_refused() {
        let options =
            |viewers, seconds| Options { viewers, seconds, source: String::new(), size: String::new(), out: PathBuf::from("/nowhere") };
        assert!(run(&options(vec![], 5)).is_err() && run(&options(vec![0], 5)).is_err() && run(&options(vec![1], 1)).is_err());
    }
}
