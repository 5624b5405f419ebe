//! A scene in a viewer beside its server: how soon the first picture comes, how many follow, what each pass takes, how old the light is.

use std::time::Duration;

use anyhow::{Context, Result, ensure};

use super::Options;
use crate::chart::{Axis, Chart, Mark, Scale, Series, number};
use crate::figures::{Quantiles, frame_rate, quantiles_ms, save};
use crate::samples::{Samples, percentile};
use crate::sandbox::Sandbox;
use crate::table::Table;

/// Rows of a viewer's first second are left out of all but the first picture: caches and the playout buffer fill in it.
const WARM_UP_US: f64 = 1e6;
/// Longest that a viewer may take.
const PATIENCE: Duration = Duration::from_secs(600);

/// What one viewer measured.
#[derive(Debug, Clone, PartialEq)]
struct Run {
    name: &'static str,
    /// From the program's start, seconds.
    first_picture_s: f64,
    /// From the arrival of its data, milliseconds.
    first_after_arrival_ms: f64,
    frames_per_second: f64,
    light_age: Quantiles,
    /// Name and times in milliseconds by when they were presented, seconds; only passes that ran.
    passes: Vec<(String, Vec<(f64, f64)>)>,
}

/// Runs both viewers, writes `render.csv`, `render-passes.csv` and the chart `render-passes.svg`, and returns the section of the summary.
///
/// # Errors
/// When a program fails, writes no statistics, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    ensure!(options.frames > 60, "--frames wants more than 60: the first second is left out");
    let sandbox = Sandbox::new()?;
    let scene = options.scene.canonicalize().with_context(|| format!("--scene {}", options.scene.display()))?;
    let scene = scene.to_str().context("--scene: the path is not UTF-8")?;
    let mut server = sandbox.serve(&options.source, &["--listen", "127.0.0.1:0", "--scene", scene])?;
    let mut runs = Vec::new();
    // One after the other, so that neither takes the other's cores: the first comes with the server, the second to a broadcast on air.
    for name in ["early", "late"] {
        eprintln!("render: {name} viewer, {} frames", options.frames);
        let (stats, frames) = (format!("{name}.csv"), options.frames.to_string());
        let arguments = ["--mode", "headless", "--size", &options.size, "--frames", &frames, "--stats", &stats];
        let mut viewer = sandbox.join(name, &server.join_url, &arguments)?;
        let status = viewer.wait_for_exit(PATIENCE)?;
        ensure!(status.success(), "the viewer ended with {status}; its output:\n{}", viewer.output());
        runs.push(measure(name, &Samples::load(&sandbox.path(&stats))?)?);
    }
    server.program.finish(PATIENCE)?;
    write(options, &runs)
}

fn measure(name: &'static str, samples: &Samples) -> Result<Run> {
    let first = |column| samples.column(column)?.into_iter().flatten().next().context("no frame was presented");
    let (presented, arrived) = (first("presented_us")?, first("arrived_us")?);
    let warm = [samples.after("presented_us", WARM_UP_US)?];
    let times: Vec<f64> = warm[0].column("presented_us")?.into_iter().flatten().map(|us| us / 1e6).collect();
    let mut passes = Vec::new();
    for column in warm[0].columns() {
        let Some(pass) = column.strip_prefix("gpu_").and_then(|rest| rest.strip_suffix("_ms")) else { continue };
        let measured = times.iter().zip(warm[0].column(column)?).filter_map(|(at, ms)| Some((*at, ms?)));
        passes.push((pass.replace('_', " "), measured.collect::<Vec<_>>()));
    }
    passes.retain(|(_, measured)| !measured.is_empty());
    Ok(Run {
        name,
        first_picture_s: presented / 1e6,
        first_after_arrival_ms: (presented - arrived) / 1e3,
        frames_per_second: frame_rate(&warm)?,
        light_age: quantiles_ms(&warm, "light_age_us")?,
        passes,
    })
}

fn write(options: &Options, runs: &[Run]) -> Result<String> {
    let mut table = Table::new(&["viewer", "first picture s", "after its data ms", "frames/s", "light age p50 ms", "light age p95 ms"]);
    let mut passes = Table::new(&["viewer", "pass", "p50 ms", "p95 ms"]);
    let mut series = Vec::new();
    for run in runs {
        let figures = [run.first_picture_s, run.first_after_arrival_ms, run.frames_per_second, run.light_age.p50, run.light_age.p95];
        table.push(std::iter::once(run.name.to_owned()).chain(figures.map(number)));
        for (pass, measured) in &run.passes {
            let times: Vec<f64> = measured.iter().map(|(_, ms)| *ms).collect();
            let quantile = |q| percentile(&times, q).map_or_else(String::new, number);
            passes.push([run.name.to_owned(), pass.clone(), quantile(0.5), quantile(0.95)]);
            series.push(Series { name: format!("{}, {pass}", run.name), points: measured.clone(), mark: Mark::Scatter });
        }
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let summary = format!(
        "## A viewer beside its server\n\nSource `{}`, the scene `{}` at {}, {} frames a viewer, all but the first picture without its \
         first second. Server and one viewer at a time share one machine with {cores} cores. The early viewer joins as soon as the server can be \
         joined and waits for its source; the late one joins a broadcast on air. First pictures count from the start of the viewer's program; the driver's \
         shader cache is empty for the early one and filled for the late one.\n\n{}\n\
         GPU time of each pass, where the driver tells it:\n\n{}\n",
        options.source,
        options.scene.file_name().unwrap_or_default().display(),
        options.size,
        options.frames,
        table.markdown(),
        passes.markdown(),
    );
    save(&options.out, "render.csv", &table.csv())?;
    save(&options.out, "render-passes.csv", &passes.csv())?;
    if series.is_empty() {
        return Ok(summary);
    }
    let axis = |label: &str| Axis { label: label.to_owned(), scale: Scale::Linear };
    let (x, y) = (axis("time since the viewer began / s"), axis("GPU time / ms"));
    let chart = Chart { title: "Time of each pass".to_owned(), x, y, series };
    save(&options.out, "render-passes.svg", &chart.svg()?)?;
    Ok(summary + "![Passes](render-passes.svg)\n")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn the_first_picture_counts_and_the_first_second_does_not() {
        let rows: String = (0..40)
            .map(|n| {
                let at = 2_000_000 + n * 50_000;
                format!("{},{at},{},,{}\n", at - 30_000, if n < 20 { 900_000 } else { 40_000 }, if n < 20 { 99.0 } else { 1.5 })
            })
            .collect();
        let head = "arrived_us,presented_us,light_age_us,gpu_shadow_1_ms,gpu_composite_ms\n";
        let run = measure("early", &Samples::parse(&format!("{head}{rows}"), "s").unwrap()).unwrap();
        assert_eq!((run.first_picture_s, run.first_after_arrival_ms, run.frames_per_second), (2.0, 30.0, 20.0));
        assert_eq!(run.light_age, Quantiles { p50: 40.0, p95: 40.0 });
        assert_eq!(run.passes.len(), 1);
        assert!(run.passes[0].0 == "composite" && run.passes[0].1.iter().all(|(_, ms)| *ms == 1.5));

        let folder = tempfile::tempdir().unwrap();
        let options = super::super::tests::options(folder.path());
        assert!(write(&options, &[run]).unwrap().contains("render-passes.svg"));
        let csv = fs::read_to_string(folder.path().join("render.csv")).unwrap();
        assert_eq!(csv.lines().nth(1), Some("early,2,30,20,40,40"));
        let passes = fs::read_to_string(folder.path().join("render-passes.csv")).unwrap();
        assert_eq!(passes.lines().nth(1), Some("early,composite,1.5,1.5"));
        assert!(folder.path().join("render-passes.svg").is_file());
    }
}
