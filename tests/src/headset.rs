//! A headset's frames while the network loses datagrams, the server stands still, or the decoder is fed large frames: nothing within a frame
//! waits for any of these. And what a headset of today would ask of a GPU, from the work that a frame is.
//!
//! The headset is Monado's null compositor, 20 frames a second of 320×240 pixels an eye, on a machine without a GPU: times are of this
//! machine; what is told is how they compare, and that no wait of seconds shows in them.

mod demand;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, ensure};

use crate::boxes::{Boxes, Row};
use crate::chart::{Axis, Scale, number};
use crate::figures::save;
use crate::impair::Impaired;
use crate::process::{Program, Signal};
use crate::samples::{Samples, percentile};
use crate::sandbox::{Sandbox, Server};
use crate::table::Table;
use crate::xr::XrRuntime;

/// Frames left out at the start: pipelines and textures are made in them.
const WARM_UP: usize = 20;
/// Longest that a run may take beyond its frames.
const OVERHEAD: Duration = Duration::from_secs(600);
/// How often and how long the server stands still.
const STALLS: u32 = 3;
const STALL: Duration = Duration::from_secs(3);
/// Share of datagrams that the bad network loses, each way.
const LOSS: f64 = 0.05;
const SEED: u64 = 20_240_229;

/// What to run.
#[derive(Debug, Clone)]
pub struct Options {
    /// Frames of each run.
    pub frames: u32,
    /// What the server broadcasts, but in the run with large frames.
    pub source: String,
    /// What it broadcasts there.
    pub large: String,
    /// What stands in it.
    pub scene: PathBuf,
    /// Folder that the results go into; made where it is missing.
    pub out: PathBuf,
}

/// What goes wrong in a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Trouble {
    None,
    Loss,
    Stalls,
    LargeFrames,
}

impl Trouble {
    const ALL: [Self; 4] = [Self::None, Self::Loss, Self::Stalls, Self::LargeFrames];

    fn name(self) -> String {
        match self {
            Self::None => "calm".to_owned(),
            Self::Loss => format!("{} % of datagrams lost", number(LOSS * 100.0)),
            Self::Stalls => format!("server stands still, {STALLS} × {} s", STALL.as_secs()),
            Self::LargeFrames => "large frames".to_owned(),
        }
    }
}

/// What a run measured.
#[derive(Debug, Clone, PartialEq)]
struct Run {
    name: String,
    /// From the runtime's call to handing over, milliseconds.
    frames_ms: Vec<f64>,
    poses_ms: Vec<f64>,
    /// Within frames, for the GPU.
    waits: f64,
    missed: f64,
    /// Pictures of the video shown.
    pictures: usize,
    passes: Vec<(String, f64)>,
}

/// Runs the bench and writes `headset.csv`, `headset.md` and the charts `headset-{frames,poses}.svg`.
///
/// # Errors
/// When no runtime is installed, a program fails or writes no statistics, or the results cannot be written.
pub fn run(options: &Options) -> Result<()> {
    ensure!(options.frames as usize > 2 * WARM_UP, "--frames wants more than {}: the first {WARM_UP} are left out", 2 * WARM_UP);
    let mut runs = Vec::new();
    for trouble in Trouble::ALL {
        eprintln!("headset: {}", trouble.name());
        let run = measure(options, trouble).with_context(|| format!("run: {}", trouble.name()))?;
        eprintln!("headset: {} waits, frames p50 {} ms", run.waits, number(percentile(&run.frames_ms, 0.5).unwrap_or(0.0)));
        runs.push(run);
    }
    write(options, &runs)
}

fn measure(options: &Options, trouble: Trouble) -> Result<Run> {
    let sandbox = Sandbox::new()?;
    let source = if trouble == Trouble::LargeFrames { &options.large } else { &options.source };
    let scene = options.scene.to_str().context("--scene: not a path in UTF-8")?;
    let mut server = sandbox.serve(source, &["--scene", scene, "--listen", "127.0.0.1:0"])?;
    let mut runtime = XrRuntime::new(&sandbox, "xr")?;
    runtime.start()?;
    let (url, network) = match trouble {
        Trouble::Loss => {
            let (url, network) = impaired(&server.join_url)?;
            (url, Some(network))
        }
        _ => (server.join_url.clone(), None),
    };
    let (csv, frames) = (sandbox.path("headset.csv"), options.frames.to_string());
    let stats = csv.to_str().context("the sandbox is not a path in UTF-8")?;
    let mut viewer = runtime.join(&sandbox, "viewer", &url, &["--mode", "xr", "--mute", "--frames", &frames, "--stats", stats])?;
    if trouble == Trouble::Stalls {
        stall(&mut server, &viewer)?;
    }
    let status = viewer.wait_for_exit(OVERHEAD)?;
    ensure!(status.success(), "the viewer ended with {status}; its output:\n{}", viewer.output());
    if let Some(network) = network {
        ensure!(network.lost() > 0, "the bad network lost nothing");
    }
    read(trouble.name(), &Samples::load(&csv)?)
}

/// The same URL by way of a bad network.
fn impaired(url: &str) -> Result<(String, Impaired)> {
    let (_, rest) = url.split_once("//").context("a join URL has an address")?;
    let (address, _) = rest.split_once('/').context("a join URL has a path")?;
    let server: SocketAddr = address.parse().with_context(|| format!("{address}: not an address and a port"))?;
    let network = Impaired::start(server, LOSS, SEED)?;
    Ok((url.replacen(address, &format!("127.0.0.1:{}", network.port()), 1), network))
}

fn stall(server: &mut Server, viewer: &Program) -> Result<()> {
    viewer.wait_for_text("first picture after", OVERHEAD)?;
    for _ in 0..STALLS {
        std::thread::sleep(STALL);
        server.program.signal(Signal::Stop)?;
        std::thread::sleep(STALL);
        server.program.signal(Signal::Continue)?;
    }
    Ok(())
}

fn read(name: String, samples: &Samples) -> Result<Run> {
    let after = |column: &str| -> Result<Vec<f64>> { Ok(samples.column(column)?.into_iter().skip(WARM_UP).flatten().collect()) };
    let ms = |column: &str| -> Result<Vec<f64>> { Ok(after(column)?.into_iter().map(|us| us / 1e3).collect()) };
    let missed = after("missed_frames")?;
    let mut pictures = after("pts_us")?;
    pictures.dedup();
    let passes = samples.columns().iter().filter_map(|column| Some((column, column.strip_prefix("gpu_")?.strip_suffix("_ms")?)));
    let passes = passes.map(|(column, pass)| Ok((pass.to_owned(), percentile(&after(column)?, 0.5))));
    let passes: Vec<(String, Option<f64>)> = passes.collect::<Result<_>>()?;
    Ok(Run {
        name,
        frames_ms: ms("frame_us")?,
        poses_ms: ms("pose_to_photon_us")?,
        waits: after("gpu_waits")?.iter().sum(),
        missed: missed.last().copied().unwrap_or(0.0) - missed.first().copied().unwrap_or(0.0),
        pictures: pictures.len(),
        passes: passes.into_iter().filter_map(|(pass, ms)| Some((pass, ms?))).collect(),
    })
}

fn write(options: &Options, runs: &[Run]) -> Result<()> {
    let table = table(runs);
    let cores = std::thread::available_parallelism().map_or_else(|_| "an unknown number of".to_owned(), |n| n.to_string());
    let passes = runs.first().map_or(&[][..], |run| &run.passes[..]);
    let summary = format!(
        "# Headset\n\n`mr360-bench headset`: Monado's null compositor, {} frames a run, the first {WARM_UP} left out; source `{}`, large frames `{}`. Server, runtime \
         and viewer share one machine with {cores} cores, which draws in software.\n\n{}\n\
         A frame is timed from the runtime's call for it to handing it over: a wait for a server that stands still would show as up to {} ms. Waits are counted where a picture of the headset \
         was still read by the runtime; network and decoder are only ever looked at, never waited for.\n\n![Frames](headset-frames.svg)\n\n![Poses](headset-poses.svg)\n\n{}",
        options.frames,
        options.source,
        options.large,
        table.markdown(),
        STALL.as_millis(),
        demand::markdown(passes),
    );
    let chart = |title: &str, label: &str, values: &dyn Fn(&Run) -> Vec<f64>| Boxes {
        title: title.to_owned(),
        axis: Axis { label: label.to_owned(), scale: Scale::Log },
        rows: runs
            .iter()
            .map(|run| Row { name: run.name.clone(), values: values(run), marked: run.name == Trouble::None.name() })
            .collect(),
    };
    for (name, content) in [
        ("headset.csv", table.csv()),
        ("headset.md", summary),
        ("headset-frames.svg", chart("Frames, from call to handing over", "ms", &|run| run.frames_ms.clone()).svg()?),
        ("headset-poses.svg", chart("From reading a pose to its photons", "ms", &|run| run.poses_ms.clone()).svg()?),
    ] {
        save(&options.out, name, &content)?;
    }
    Ok(())
}

fn table(runs: &[Run]) -> Table {
    let mut table = Table::new(&[
        "run",
        "frames",
        "pictures",
        "waits",
        "missed intervals",
        "frame p50 ms",
        "frame p95 ms",
        "frame max ms",
        "pose to photon p50 ms",
        "pose to photon p95 ms",
    ]);
    for run in runs {
        let quantile = |values: &[f64], q| percentile(values, q).map_or_else(String::new, number);
        let counts = [run.name.clone(), run.frames_ms.len().to_string(), run.pictures.to_string(), number(run.waits), number(run.missed)];
        let frames = [0.5, 0.95, 1.0].map(|q| quantile(&run.frames_ms, q));
        table.push(counts.into_iter().chain(frames).chain([0.5, 0.95].map(|q| quantile(&run.poses_ms, q))));
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(frames: usize) -> Samples {
        let rows: String = (0..frames)
            .map(|at| {
                format!("{at},{},{},0,{},{},{}\n", at / 2 * 33_333, 8_000 + at, 40_000, at / 10, if at % 2 == 0 { "1.5" } else { "" })
            })
            .collect();
        Samples::parse(&format!("frame,pts_us,frame_us,gpu_waits,pose_to_photon_us,missed_frames,gpu_objects_ms\n{rows}"), "s").unwrap()
    }

    #[test]
    fn a_run_is_read_after_its_warm_up() {
        let run = read("calm".to_owned(), &samples(40)).unwrap();
        assert_eq!((run.frames_ms.len(), run.pictures, run.waits, run.missed), (20, 10, 0.0, 1.0));
        assert_eq!((run.frames_ms[0], run.poses_ms[0]), (8.02, 40.0));
        assert_eq!(run.passes, [("objects".to_owned(), 1.5)]);
    }

    #[test]
    fn results_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let options = Options {
            frames: 40,
            source: "synthetic:plaza".to_owned(),
            large: "synthetic:plaza?size=4096x2048".to_owned(),
            scene: PathBuf::new(),
            out: folder.path().to_owned(),
        };
        let runs = Trouble::ALL.map(|trouble| read(trouble.name(), &samples(40)).unwrap());
        write(&options, &runs).unwrap();
        let summary = std::fs::read_to_string(folder.path().join("headset.md")).unwrap();
        assert!(summary.contains("| calm | 20 | 10 | 0 | 1 |") && summary.contains("2×2064×2208"), "{summary}");
        assert_eq!(std::fs::read_to_string(folder.path().join("headset.csv")).unwrap().lines().count(), 5);
        for chart in ["headset-frames.svg", "headset-poses.svg"] {
            assert!(folder.path().join(chart).is_file(), "{chart}");
        }
        assert!(run(&Options { frames: 40, ..options }).is_err(), "only the warm-up");
    }

    #[test]
    fn the_bad_network_stands_between_viewer_and_server() {
        let (url, network) = impaired("https://127.0.0.1:4443/#room=live,sha256=00").unwrap();
        assert_eq!(url, format!("https://127.0.0.1:{}/#room=live,sha256=00", network.port()));
        assert!(impaired("https://example/").is_err());
    }
}
