//! Light, measured: accuracy against time for every method on true panoramas, speed on one live frame, what the working resolution and the number
//! of lights cost and bring, stability over time, and the share of a core that large live frames take.
//!
//! Accuracy: `radiance_map` finds and splits the panoramas, `exposure` makes frames of them, `truth` says what is true,
//! `irradiance`, `score` and `rendered` measure, `race` runs every method and the peers in turn, `oracle` says what knowing the hidden energy is worth and
//! `features` what the default's own features could give, `report` writes it down and `fronts` draws it; `bounds` holds it all against what is asked. `speed` races live frames (`video_frame`) against the paper written plainly (`plain`) and
//! in OpenCV, `resolution` varies the working panorama, `light_count` the number of lights, `stability` runs sequences, `large_frames` is the last part. `peer` speaks with the programs of others, which
//! `opencv` and `three` start.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};

use self::bounds::Bound;
use crate::figures::save;
use crate::sandbox::media_folder;

mod bounds;
mod exposure;
mod features;
mod fronts;
mod irradiance;
mod large_frames;
mod light_count;
mod opencv;
mod oracle;
mod peer;
mod plain;
mod race;
mod radiance_map;
mod rendered;
mod report;
mod resolution;
mod score;
mod speed;
mod stability;
mod three;
mod truth;
mod video_frame;

/// Folder of the panoramas that `deploy/fetch-media` brings, among the media.
const PANORAMAS: &str = "hdr";

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Accuracy and time of every method on panoramas.
    Accuracy,
    /// Time of every method on one live frame, against other implementations of the paper.
    Speed,
    /// Error and time of methods over the size of their working panorama.
    Resolution,
    /// Error over the number of lights.
    Lights,
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
    /// Folder with three.js among its `node_modules`, to race its light probe.
    pub three: Option<PathBuf>,
    /// Node to run three.js in.
    pub node: PathBuf,
    /// Columns and rows of large frames, 2:1.
    pub size: (u32, u32),
    /// Large frames measured, besides the first, which fills buffers and tables.
    pub frames: u32,
    /// Method for large frames, as for `mr360-server analyze --method`.
    pub method: String,
    /// Folder that the results go into; made where it is missing.
    pub out: PathBuf,
}

/// What a part comes to.
struct Section {
    text: String,
    /// Of the default method.
    bounds: Vec<Bound>,
}

impl From<String> for Section {
    fn from(text: String) -> Self {
        Self { text, bounds: Vec::new() }
    }
}

/// Runs the bench and writes `lighting.md` and, where a part has bounds, `lighting-bounds.csv`; of accuracy `lighting-accuracy.csv` and a chart an exposure; of speed `lighting-speed.csv` and
/// `lighting-speed.svg`; of resolution `lighting-resolution.csv` and a chart an exposure; of lights `lighting-lights.csv` and a chart an exposure; of stability `lighting-stability.csv`,
/// `lighting-stability-curves.csv` and a chart a sequence; of large frames `lighting.csv` and the chart `lighting-time.svg`.
///
/// # Errors
/// When panoramas or the clip are missing or unusable, a program fails, or the results cannot be written.
pub fn run(options: &Options) -> Result<()> {
    ensure!(options.frames > 0 && options.rounds > 0, "--frames and --rounds want 1 or more");
    fs::create_dir_all(&options.out).with_context(|| format!("--out {}: cannot be made", options.out.display()))?;
    let (mut sections, mut bounds) = (Vec::new(), Vec::new());
    for part in &options.parts {
        let section = match part {
            Part::Accuracy => accuracy(options)?,
            Part::Speed => speed::run(options, &panoramas(options)?, start_opencv(options)?.as_mut())?,
            Part::Resolution => resolution::run(options, &panoramas(options)?)?.into(),
            Part::Lights => light_count::run(options, &panoramas(options)?)?.into(),
            Part::Stability => stability::run(options)?,
            Part::LargeFrames => large_frames::run(options)?.into(),
        };
        sections.push(section.text);
        bounds.extend(section.bounds);
    }
    if !bounds.is_empty() {
        save(&options.out, "lighting-bounds.csv", &bounds::table(&bounds).csv())?;
        sections.insert(0, bounds::markdown(&bounds));
        eprint!("{}", bounds::overview(&bounds));
    }
    save(&options.out, "lighting.md", &format!("# Lighting\n\n{}", sections.join("\n")))
}

/// The panoramas that are measured on.
fn panoramas(options: &Options) -> Result<Vec<PathBuf>> {
    radiance_map::find(&options.panoramas.clone().map_or_else(|| media_folder(PANORAMAS), Ok)?)
}

/// A panorama's file name without its ending.
fn name(path: &Path) -> String {
    path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// The OpenCV peer, where there is a Python for it.
fn start_opencv(options: &Options) -> Result<Option<peer::Peer>> {
    options.python.as_deref().map(opencv::start).transpose()
}

/// The three.js peer, where there is a folder for it.
fn start_three(options: &Options) -> Result<Option<peer::Peer>> {
    options.three.as_deref().map(|folder| three::start(&options.node, folder)).transpose()
}

/// How far the definition of the dominant light moves under grain, where there is one.
fn restless_deg(files: &[PathBuf]) -> Result<Vec<f64>> {
    let normals = irradiance::Normals::new();
    let of = |path: &PathBuf| {
        let map = radiance_map::RadianceMap::load(path)?;
        Ok(truth::Truth::of(&map, &normals).restlessness_deg(&map))
    };
    files.iter().filter_map(|path| of(path).transpose()).collect()
}

/// Races all methods and returns the section of the summary.
fn accuracy(options: &Options) -> Result<Section> {
    let files = panoramas(options)?;
    let (opencv, three) = (start_opencv(options)?, start_three(options)?);
    let of_opencv = match &opencv {
        Some(peer) => {
            format!("`{}` is the paper's method written with {}, fed 8-bit frames; it reads no HDR.", opencv::NAME, peer.version())
        }
        None => "OpenCV was not raced: `--python` names a Python that has numpy and opencv-contrib-python-headless.".to_owned(),
    };
    let of_three = match &three {
        Some(peer) => format!(
            "`{}` is the light probe of {}, made of a cube map a quarter as wide as the panorama, of 8 bits or of floats; filling the cube map is not \
             timed.",
            three::NAME,
            peer.version()
        ),
        None => "three.js was not raced: `--three` names a folder in which `npm install three` was run.".to_owned(),
    };
    let of_peers = format!("{of_opencv} {of_three}");
    eprintln!("lighting: {of_peers}");
    let mut peers: Vec<peer::Peer> = opencv.into_iter().chain(three).collect();
    let rows = race::run(&files, &race::methods()?, &mut peers, options.rounds)?;
    eprint!("{}", report::overview(&rows));
    save(&options.out, "lighting-accuracy.csv", &report::csv(&rows))?;
    for exposure in exposure::Exposure::ALL {
        save(&options.out, &fronts::chart_name(exposure), &fronts::chart(&rows, exposure)?)?;
    }
    let fitted = match &options.python {
        Some(python) => {
            eprintln!("lighting: fitting the features to these panoramas");
            features::fit(python, &files)?
        }
        None => Vec::new(),
    };
    Ok(Section {
        text: report::markdown(&rows, &of_peers, options.rounds),
        bounds: bounds::of_accuracy(&rows, &fitted, &restless_deg(&files)?),
    })
}
