//! Benches of MR360 live: CSV, SVG charts and a Markdown summary in one folder.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand, ValueEnum};
use mr360_protocol::failure::{self, Failure};
use mr360_tests::{figures, headset, lighting, network, render};

/// The demo's scene.
const SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/demo-scene/SCENE.toml");

/// Measures MR360 live from outside and writes tables and charts.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    bench: Bench,
}

#[derive(Subcommand)]
enum Bench {
    /// Light: accuracy against time of every method on HDR panoramas; speed on one live frame; sweep of the working resolution; stability over time; steps and share of one core for large frames of a clip.
    Lighting(Lighting),
    /// The demo's scene in a viewer beside its server; pictures against path-traced truth and three.js; shadows against path-traced visibility; time against error; growth of time; both eyes by one pass or two; a race against Bevy.
    Render(Render),
    /// One server and N headless viewers: age of light and video, the server's CPU and memory, bytes per track.
    Network(Network),
    /// A headset's frames while datagrams are lost, the server stands still or frames are large; what a headset of today would need.
    Headset(Headset),
    /// Every bench, with its defaults.
    All {
        /// Folder for the results; made where it is missing.
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
}

#[derive(Args)]
struct Lighting {
    /// Folder for the results; made where it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What is measured; everything unless given.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "accuracy,speed,resolution,stability,large-frames")]
    part: Vec<Part>,
    /// Folder of .exr and .hdr panoramas that all but large frames is measured on, instead of those that deploy/fetch-media brought.
    #[arg(long, value_name = "FOLDER")]
    panoramas: Option<PathBuf>,
    /// How often every method is timed on every frame.
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    rounds: u32,
    /// A Python with numpy and opencv-contrib-python-headless: races the paper's method written with OpenCV, too.
    #[arg(long, value_name = "PATH")]
    python: Option<PathBuf>,
    /// A folder in which `npm install three` was run: races three.js's light probe, too.
    #[arg(long, value_name = "FOLDER")]
    three: Option<PathBuf>,
    /// The Node that three.js is run in.
    #[arg(long, default_value = "node", value_name = "PATH")]
    node: PathBuf,
    /// Size of the large frames.
    #[arg(long, default_value = "3840x1920", value_name = "WxH", value_parser = parse_size)]
    size: (u32, u32),
    /// Large frames measured.
    #[arg(long, default_value_t = 150, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    frames: u32,
    /// Light method for the large frames.
    #[arg(long, default_value = "directional", value_name = "NAME")]
    method: String,
}

/// What `lighting` measures.
#[derive(Clone, Copy, ValueEnum)]
enum Part {
    /// Accuracy and time of every method on panoramas.
    Accuracy,
    /// Time of every method on one live frame, against the paper written plainly and in OpenCV.
    Speed,
    /// Error and time of methods over the size of their working panorama.
    Resolution,
    /// Error of irradiance and of a shadow over the number of lights.
    Lights,
    /// Stillness, lag and jumps of every method on sequences of known light, a still scene through a codec, and the real clip.
    Stability,
    /// Steps and share of a core of one method on large frames.
    LargeFrames,
}

impl From<Part> for lighting::Part {
    fn from(part: Part) -> Self {
        match part {
            Part::Accuracy => Self::Accuracy,
            Part::Speed => Self::Speed,
            Part::Resolution => Self::Resolution,
            Part::Lights => Self::Lights,
            Part::Stability => Self::Stability,
            Part::LargeFrames => Self::LargeFrames,
        }
    }
}

#[derive(Args)]
struct Render {
    /// Folder for the results; made where it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What is measured; everything but the race unless given.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "viewers,truth,shadows,methods,growth,eyes")]
    part: Vec<RenderPart>,
    /// What the server broadcasts to viewers.
    #[arg(long, default_value = "synthetic:plaza?size=1280x640", value_name = "URL|FILE|synthetic:NAME")]
    source: String,
    /// What stands in it.
    #[arg(long, default_value = SCENE, hide_default_value = true, value_name = "SCENE.toml")]
    scene: PathBuf,
    /// Size of the viewers' pictures.
    #[arg(long, default_value = "640x360", value_name = "WxH")]
    size: String,
    /// Frames that each viewer presents.
    #[arg(long, default_value_t = 300, value_name = "N", value_parser = clap::value_parser!(u32).range(61..=100_000))]
    frames: u32,
    /// Folder of the panoramas for truth, instead of those that deploy/fetch-media brought.
    #[arg(long, value_name = "FOLDER")]
    panoramas: Option<PathBuf>,
    /// A folder in which `npm install three` was run: draws three.js's pictures anew, in place of the kept ones.
    #[arg(long, value_name = "FOLDER")]
    three: Option<PathBuf>,
    /// The Node that runs three.js's script.
    #[arg(long, default_value = "node", value_name = "PATH")]
    node: PathBuf,
    /// The browser that three.js draws in.
    #[arg(long, default_value = "chromium", value_name = "PATH")]
    chromium: PathBuf,
    /// Bevy's side of the race: what `cargo build` makes in tests/peers/bevy_scene.
    #[arg(long, value_name = "PATH", required_if_eq("part", "bevy"))]
    bevy: Option<PathBuf>,
}

/// What `render` measures.
#[derive(Clone, Copy, ValueEnum)]
enum RenderPart {
    /// A scene in a viewer beside its server.
    Viewers,
    /// Pictures against path-traced truth, beside three.js.
    Truth,
    /// Shadows against path-traced visibility.
    Shadows,
    /// Time against error of every way to look up reflections in every tier.
    Methods,
    /// Time of every pass over lights, objects, triangles, roughness, size and views.
    Growth,
    /// Both eyes by one pass against a pass an eye, on the driver of the OpenXR runtime for tests.
    Eyes,
    /// Race against Bevy; wants --bevy.
    Bevy,
}

impl From<RenderPart> for render::Part {
    fn from(part: RenderPart) -> Self {
        match part {
            RenderPart::Viewers => Self::Viewers,
            RenderPart::Truth => Self::Truth,
            RenderPart::Shadows => Self::Shadows,
            RenderPart::Methods => Self::Methods,
            RenderPart::Growth => Self::Growth,
            RenderPart::Eyes => Self::Eyes,
            RenderPart::Bevy => Self::Bevy,
        }
    }
}

#[derive(Args)]
struct Network {
    /// Folder for the results; made where it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Numbers of viewers, one run each.
    #[arg(long, value_delimiter = ',', default_value = "1,2,4", value_name = "N,N,…")]
    viewers: Vec<usize>,
    /// How long each viewer watches.
    #[arg(long, default_value_t = 10, value_name = "SECONDS", value_parser = clap::value_parser!(u32).range(2..=3600))]
    seconds: u32,
    /// What the server broadcasts.
    #[arg(long, default_value = "synthetic:plaza?size=1280x640", value_name = "URL|FILE|synthetic:NAME")]
    source: String,
    /// Size of each viewer's picture.
    #[arg(long, default_value = "320x180", value_name = "WxH")]
    size: String,
}

#[derive(Args)]
struct Headset {
    /// Folder for the results; made where it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Frames of each run.
    #[arg(long, default_value_t = 300, value_name = "N", value_parser = clap::value_parser!(u32).range(61..=100_000))]
    frames: u32,
    /// What the server broadcasts.
    #[arg(long, default_value = "synthetic:testcard?size=1280x640", value_name = "URL|FILE|synthetic:NAME")]
    source: String,
    /// What it broadcasts where the decoder is fed large frames.
    #[arg(long, default_value = "synthetic:testcard?size=7680x3840&fps=15", value_name = "URL|FILE|synthetic:NAME")]
    large: String,
    /// What stands in it.
    #[arg(long, default_value = SCENE, hide_default_value = true, value_name = "SCENE.toml")]
    scene: PathBuf,
}

impl Bench {
    fn out(&self) -> &Path {
        match self {
            Self::Lighting(Lighting { out, .. })
            | Self::Render(Render { out, .. })
            | Self::Network(Network { out, .. })
            | Self::Headset(Headset { out, .. })
            | Self::All { out } => out,
        }
    }
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let side = |text: &str| text.parse().ok().filter(|side| (2..=8192).contains(side) && side % 2 == 0);
    let size = text.split_once('x').and_then(|(width, height)| Some((side(width)?, side(height)?)));
    size.ok_or_else(|| "a size is WIDTHxHEIGHT, both even, from 2 to 8192".to_owned())
}

fn run(bench: Bench) -> anyhow::Result<()> {
    match bench {
        Bench::Lighting(Lighting { out, part, panoramas, rounds, python, three, node, size, frames, method }) => {
            let parts = part.into_iter().map(Into::into).collect();
            lighting::run(&lighting::Options { parts, panoramas, rounds, python, three, node, size, frames, method, out })
        }
        Bench::Render(Render { out, part, source, scene, size, frames, panoramas, three, node, chromium, bevy }) => {
            let parts = part.into_iter().map(Into::into).collect();
            render::run(&render::Options { parts, source, scene, size, frames, panoramas, three, node, chromium, bevy, out })
        }
        Bench::Network(Network { out, viewers, seconds, source, size }) => {
            network::run(&network::Options { viewers, seconds, source, size, out })
        }
        Bench::Headset(Headset { out, frames, source, large, scene }) => {
            headset::run(&headset::Options { frames, source, large, scene, out })
        }
        Bench::All { out } => ["lighting", "render", "network", "headset"].iter().try_for_each(|name| run(with_defaults(name, &out)?)),
    }
}

/// A bench as its bare command line makes it.
fn with_defaults(name: &str, out: &Path) -> anyhow::Result<Bench> {
    let line = [OsStr::new("mr360-bench"), OsStr::new(name), OsStr::new("--out"), out.as_os_str()];
    Ok(Cli::try_parse_from(line)?.bench)
}

fn main() -> ExitCode {
    let bench = Cli::parse().bench;
    let ready = figures::open_folder(bench.out()).map_err(Failure::Input);
    failure::exit(ready.and_then(|()| run(bench).map_err(Failure::Running)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bench_runs_with_its_defaults() {
        for name in ["lighting", "render", "network", "headset"] {
            assert!(with_defaults(name, Path::new("results")).is_ok(), "{name}");
        }
        assert!(parse_size("3841x1920").is_err() && parse_size("3840").is_err());
    }
}
