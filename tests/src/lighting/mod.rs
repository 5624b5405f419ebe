//! Light, measured: accuracy against time for every method on true panoramas, stability over time, and the share of a core that large live
//! frames take.
//!
//! Accuracy: `radiance_map` finds and splits the panoramas, `exposure` makes frames of them, `truth` says what is true,
//! `irradiance`, `score` and `rendered` measure, `race` runs every method and the `opencv` peer in turn, `report` writes it down.
//! `stability` and `large_frames` are the other parts.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result, ensure};

use crate::figures::save;
use crate::sandbox::media_folder;

mod exposure;
mod irradiance;
mod large_frames;
mod opencv;
mod race;
mod radiance_map;
mod rendered;
mod report;
mod score;
mod stability;
mod truth;

/// Folder of the panoramas that `deploy/fetch-media` brings, among the media.
const PANORAMAS: &str = "hdr";

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Accuracy and time of every method on panoramas.
    Accuracy,
    /// Stillness, lag and jumps of every method over time.
    Stability,
    /// Steps and share of a core of one method on large frames of the real clip.
    LargeFrames,
}

/// What to run.
#[derive(Debug, Clone)]
pub struct Options {
    /// What is measured.
    pub parts: Vec<Part>,
    /// Folder of .exr and .hdr panoramas; those of `deploy/fetch-media` unless given.
    pub panoramas: Option<PathBuf>,
    /// Rounds in which every method is timed, besides the one that warms up.
    pub rounds: u32,
    /// Python that has NumPy and OpenCV, to race OpenCV with.
    pub python: Option<PathBuf>,
    /// Columns and rows of large frames, 2:1.
    pub size: (u32, u32),
    /// Large frames measured, besides the first, which fills buffers and tables.
    pub frames: u32,
    /// Method for large frames, as for `mr360-server analyze --method`.
    pub method: String,
    /// Folder that the results go into; made where it is missing.
    pub out: PathBuf,
}

/// Runs the bench and writes `lighting.md`; of accuracy `lighting-accuracy.csv` and a chart an exposure; of stability
/// `lighting-stability.csv`, `lighting-stability-curves.csv` and a chart a sequence; of large frames `lighting.csv`
/// and the chart `lighting-time.svg`.
///
/// # Errors
/// When panoramas or the clip are missing or unusable, a program fails, or the results cannot be written.
pub fn run(options: &Options) -> Result<()> {
    ensure!(options.frames > 0 && options.rounds > 0, "--frames and --rounds want 1 or more");
    fs::create_dir_all(&options.out).with_context(|| format!("--out {}: cannot be made", options.out.display()))?;
    let mut sections = Vec::new();
    for part in &options.parts {
        sections.push(match part {
            Part::Accuracy => accuracy(options)?,
            Part::Stability => stability::run(options)?,
            Part::LargeFrames => large_frames::run(options)?,
        });
    }
    save(&options.out, "lighting.md", &format!("# Lighting\n\n{}", sections.join("\n")))
}

/// Races all methods and returns the section of the summary.
fn accuracy(options: &Options) -> Result<String> {
    let folder = options.panoramas.clone().map_or_else(|| media_folder(PANORAMAS), Ok)?;
    let files = radiance_map::find(&folder)?;
    let mut peer = options.python.as_deref().map(opencv::Peer::start).transpose()?;
    let of_peer = match &peer {
        Some(peer) => {
            format!("`{}` is the paper's method written with {}, fed 8-bit frames; it reads no HDR.", opencv::NAME, peer.version())
        }
        None => "OpenCV was not raced: `--python` names a Python that has numpy and opencv-contrib-python-headless.".to_owned(),
    };
    eprintln!("lighting: {of_peer}");
    let rows = race::run(&files, &race::methods()?, peer.as_mut(), options.rounds)?;
    eprint!("{}", report::overview(&rows));
    save(&options.out, "lighting-accuracy.csv", &report::csv(&rows))?;
    for exposure in exposure::Exposure::ALL {
        save(&options.out, &report::chart_name(exposure), &report::chart(&rows, exposure)?)?;
    }
    Ok(report::markdown(&rows, &of_peer, options.rounds))
}
