//! One live frame on one core: the time of every method against the paper's, plainly written and in OpenCV.
//!
//! All are given the same 1280×640 frame of each panorama, 8 bits with white at the 95th percentile. Methods read it as ingest delivers it,
//! planar 4:2:0; the plain implementation reads it as packed 8-bit R'G'B', which it is not charged for; OpenCV races once with each.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use mr360_server::lighting::{Averaging, LightMethod, MethodSpec, StepTimes};

use super::bounds::{Best, Bound, Limit};
use super::exposure::Exposure;
use super::peer::Peer;
use super::race::FRAME_US;
use super::radiance_map::RadianceMap;
use super::video_frame::{SIZE, VideoFrame};
use super::{Options, Section, name, opencv, plain};
use crate::boxes::{self, Boxes};
use crate::chart::{Axis, Scale, number};
use crate::figures::save;
use crate::samples::percentile;
use crate::table::Table;

/// Columns of the working map of the peers.
const WORKING_WIDTH: usize = 512;
/// How the frames are exposed.
const EXPOSURE: Exposure = Exposure::Ldr(95);
/// Name of OpenCV's run on planar frames.
const OPENCV_PLANAR: &str = "opencv-mr360, planar";

/// Name of what every method does at least.
const FLOOR: &str = "reading and averaging the pixels";
/// The method that does least besides: no lights, nothing recovered, nothing followed.
const PLAINEST: &str = "sh:9";

/// Somebody's times over one panorama's frame.
#[derive(Debug, Clone, PartialEq)]
struct Times {
    name: String,
    panorama: String,
    rounds_ms: Vec<f64>,
}

impl Times {
    fn median(&self) -> f64 {
        percentile(&self.rounds_ms, 0.5).unwrap_or(f64::NAN)
    }
}

/// Races, writes `lighting-speed.csv` and the chart `lighting-speed.svg`, and returns the section of the summary.
///
/// # Errors
/// When a panorama cannot be used, a method or a peer fails, or the results cannot be written.
pub(super) fn run(options: &Options, files: &[PathBuf], mut opencv: Option<&mut Peer>) -> Result<Section> {
    let mut specs: Vec<MethodSpec> = MethodSpec::all().collect();
    specs.push("sh:25".parse()?);
    if let Some(peer) = &mut opencv {
        peer.set(&format!("size {WORKING_WIDTH}"))?;
    }
    let mut times: Vec<Times> = Vec::new();
    for (place, path) in files.iter().enumerate() {
        eprintln!("lighting: speed on {} ({} of {})", name(path), place + 1, files.len());
        times.extend(race(path, &specs, opencv.as_deref_mut(), options.rounds).with_context(|| path.display().to_string())?);
    }
    save(&options.out, "lighting-speed.csv", &csv(&times))?;
    save(&options.out, "lighting-speed.svg", &chart(&times)?)?;
    Ok(Section { text: markdown(&times, opencv.is_some(), options.rounds), bounds: bounds(&times) })
}

/// Round by round everybody once, after a round that warms up, so that whatever else the machine does meets all of them alike, and nobody
/// finds in the caches what the others have pushed out. Peers are handed the frame anew each time, which is not timed.
fn race(path: &Path, specs: &[MethodSpec], mut opencv: Option<&mut Peer>, rounds: u32) -> Result<Vec<Times>> {
    let map = RadianceMap::load(path)?;
    let mut video = VideoFrame::of(&map, EXPOSURE.scale(&map)?)?;
    let mut methods: Vec<(MethodSpec, Box<dyn LightMethod>)> = specs.iter().map(|spec| (*spec, spec.make())).collect();
    let mut averaging = Averaging::default();
    let peers: &[&str] = if opencv.is_some() { &[opencv::NAME, OPENCV_PLANAR] } else { &[] };
    let names =
        specs.iter().map(ToString::to_string).chain([FLOOR].iter().chain(peers).chain(&[plain::NAME]).map(|name| (*name).to_owned()));
    let mut times: Vec<Times> = names.map(|name| Times { name, panorama: super::name(path), rounds_ms: Vec::new() }).collect();
    for round in 0..=rounds {
        video.frame.pts_us = u64::from(round) * FRAME_US;
        let mut elapsed_ms = Vec::with_capacity(times.len());
        for (spec, method) in &mut methods {
            let started = Instant::now();
            let estimated = method.estimate(&video.frame, &mut StepTimes::default()).map(|_| ());
            elapsed_ms.push(started.elapsed().as_secs_f64() * 1e3);
            estimated.with_context(|| spec.to_string())?;
        }
        let started = Instant::now();
        std::hint::black_box(averaging.take(&video.frame)?);
        elapsed_ms.push(started.elapsed().as_secs_f64() * 1e3);
        if let Some(peer) = &mut opencv {
            peer.frame(&video.codes, SIZE.0)?;
            elapsed_ms.push(peer.run()?);
            peer.send("planes", SIZE.0, SIZE.1, &video.planes)?;
            elapsed_ms.push(peer.run()?);
        }
        let started = Instant::now();
        std::hint::black_box(plain::estimate(&video.codes, SIZE.0, WORKING_WIDTH));
        elapsed_ms.push(started.elapsed().as_secs_f64() * 1e3);
        if round > 0 {
            times.iter_mut().zip(elapsed_ms).for_each(|(times, ms)| times.rounds_ms.push(ms));
        }
    }
    Ok(times)
}

/// Names in the order of the race.
fn names(times: &[Times]) -> Vec<&str> {
    let mut names: Vec<&str> = Vec::new();
    for times in times {
        if !names.contains(&times.name.as_str()) {
            names.push(&times.name);
        }
    }
    names
}

fn of<'a>(times: &'a [Times], name: &'a str) -> impl Iterator<Item = &'a Times> {
    times.iter().filter(move |times| times.name == name)
}

/// How many times as long `peer` took as `name`, panorama by panorama.
fn ratios(times: &[Times], name: &str, peer: &str) -> Vec<f64> {
    of(times, name).filter_map(|own| Some(of(times, peer).find(|peer| peer.panorama == own.panorama)?.median() / own.median())).collect()
}

fn csv(times: &[Times]) -> String {
    let mut table = Table::new(&["name", "panorama", "p50_ms", "least_ms", "most_ms", "plain_over_this", "opencv_over_this"]);
    for own in times {
        let over = |peer: &str| {
            let peer = of(times, peer).find(|peer| peer.panorama == own.panorama);
            peer.map(|peer| format!("{:.3}", peer.median() / own.median())).unwrap_or_default()
        };
        let quantile = |q| percentile(&own.rounds_ms, q).map(|ms| format!("{ms:.4}")).unwrap_or_default();
        let cells =
            [own.name.clone(), own.panorama.clone(), quantile(0.5), quantile(0.0), quantile(1.0), over(plain::NAME), over(opencv::NAME)];
        table.push(cells);
    }
    table.csv()
}

fn chart(times: &[Times]) -> Result<String> {
    let row = |name: &&str| boxes::Row {
        name: (*name).to_owned(),
        values: of(times, name).flat_map(|times| times.rounds_ms.iter().copied()).collect(),
        marked: [plain::NAME, opencv::NAME, OPENCV_PLANAR, FLOOR].contains(name),
    };
    Boxes {
        title: format!("One {}×{} frame, one core", SIZE.0, SIZE.1),
        axis: Axis { label: "time / ms, over panoramas and rounds".to_owned(), scale: Scale::Log },
        rows: names(times).iter().map(row).collect(),
    }
    .svg()
}

fn markdown(times: &[Times], opencv_raced: bool, rounds: u32) -> String {
    let mut table = Table::new(&["", "working map", "p50 ms", "p95 ms", "plain / this", "OpenCV / this", "OpenCV, planar / this"]);
    for name in names(times) {
        let all: Vec<f64> = of(times, name).flat_map(|times| times.rounds_ms.iter().copied()).collect();
        let quantile = |q| percentile(&all, q).map(number).unwrap_or_default();
        // The least ratio of a panorama stands beside the median.
        let over = |peer: &str| {
            let ratios = ratios(times, name, peer);
            let (median, least) = (percentile(&ratios, 0.5), percentile(&ratios, 0.0));
            median.zip(least).map(|(median, least)| format!("{median:.1} ({least:.1})")).unwrap_or_default()
        };
        let spec = name.parse::<MethodSpec>();
        let width = if name == FLOOR {
            MethodSpec::default().usual_width()
        } else {
            spec.map_or(Some(WORKING_WIDTH as u32), MethodSpec::usual_width)
        };
        let map = width.map_or_else(|| "its own".to_owned(), |width| format!("{width}×{}", width / 2));
        table.push([name.to_owned(), map, quantile(0.5), quantile(0.95), over(plain::NAME), over(opencv::NAME), over(OPENCV_PLANAR)]);
    }
    let peers = if opencv_raced {
        format!(
            "`{}` is the paper's method in OpenCV, table-driven, on one thread, on frames that are R'G'B' already; `{OPENCV_PLANAR}` reads the planes that \
             the methods read.",
            opencv::NAME
        )
    } else {
        "OpenCV was not raced: `--python` names a Python that has numpy and opencv-contrib-python-headless.".to_owned()
    };
    format!(
        "## Speed\n\nOne {}×{} frame, {}, yuv420p, of every panorama; {rounds} rounds after a warm-up; everything on one thread, {}. Ratios are median (least) \
         over the panoramas of the medians over the rounds. {peers} `{}` is the paper's method straight from its equations in double precision, on \
         frames that are R'G'B' already. `{FLOOR}` is no method: it makes code averages of the default's working map and stops there.\n\n{}\n![Speed](lighting-speed.svg)\n",
        SIZE.0,
        SIZE.1,
        EXPOSURE.title(),
        cores(),
        plain::NAME,
        table.markdown(),
    )
}

/// How many times as fast as others the default is, how many times as fast it would be if it only read and averaged the pixels, and how fast
/// SH alone are.
fn bounds(times: &[Times]) -> Vec<Bound> {
    let default = MethodSpec::default().to_string();
    let median = |name: &str, peer: &str| percentile(&ratios(times, name, peer), 0.5);
    let bound = |what: &str, peer: &str, least| Bound {
        what: format!("speed: {what}"),
        limit: Limit::AtLeast(least),
        all: median(&default, peer),
        halves: [None; 2],
        best: [FLOOR, PLAINEST].iter().filter_map(|name| Some(Best { name: (*name).to_owned(), figure: median(name, peer)? })).collect(),
    };
    let raced = |name: &str| of(times, name).next().is_some();
    let mut bounds = vec![bound("times as fast as the paper's equations, plainly written", plain::NAME, 10.0)];
    if raced(opencv::NAME) {
        bounds.push(bound("times as fast as OpenCV", opencv::NAME, 5.0));
    }
    bounds
}

/// Which cores this process and its peers may run on.
pub(super) fn cores() -> String {
    pinned(&std::fs::read_to_string("/proc/self/status").unwrap_or_default())
}

/// The same, from what the kernel says in `/proc/self/status`.
fn pinned(status: &str) -> String {
    let allowed = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).map(str::trim);
    match allowed {
        Some(core) if core.parse::<u32>().is_ok() => format!("pinned to core {core}"),
        Some(cores) => format!("free to move between cores {cores} (`taskset -c 0 mr360-bench …` pins it, peers included)"),
        None => "not known to be pinned".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn times(name: &str, panorama: &str, rounds_ms: &[f64]) -> Times {
        Times { name: name.to_owned(), panorama: panorama.to_owned(), rounds_ms: rounds_ms.to_vec() }
    }

    #[test]
    fn ratios_are_taken_panorama_by_panorama() {
        let all = [
            times("directional", "a", &[1.0, 2.0, 9.0]),
            times("directional", "b", &[4.0]),
            times(opencv::NAME, "a", &[10.0]),
            times(opencv::NAME, "b", &[8.0]),
            times(plain::NAME, "a", &[40.0]),
            times(plain::NAME, "b", &[40.0]),
        ];
        assert_eq!(ratios(&all, "directional", opencv::NAME), [5.0, 2.0]);
        let text = markdown(&all, true, 3);
        assert!(text.contains("| directional | 512×256 | 2 | 9 | 10.0 (10.0) | 2.0 (2.0) |  |"), "{text}");
        assert!(csv(&all).contains("directional,a,2.0000,1.0000,9.0000,20.000,5.000\n"), "{}", csv(&all));
        assert!(chart(&all).unwrap().contains("plain mr360: 40, 40, 40"));
        let bounds = bounds(&all);
        assert!(bounds[0].is_met() && bounds[0].all == Some(10.0) && !bounds[1].is_met() && bounds[1].all == Some(2.0), "{bounds:?}");
        assert!(markdown(&all[..2], false, 3).contains("OpenCV was not raced"));
    }

    #[test]
    fn a_process_knows_whether_it_is_pinned() {
        assert!(pinned("Threads:\t1\nCpus_allowed_list:\t3\n").contains("pinned to core 3"));
        assert!(pinned("Cpus_allowed_list:\t0-1\n").contains("taskset") && pinned("").contains("not known"));
    }

    #[test]
    fn a_panorama_is_raced_from_one_frame() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sky.exr");
        let map = RadianceMap::of(32, |direction| glam::Vec3::splat(1.0 + direction.y + 20.0 * f32::from(direction.x > 0.95)));
        let texels = map.texels().iter().flat_map(glam::Vec3::to_array).collect();
        image::Rgb32FImage::from_raw(64, 32, texels).unwrap().save(&path).unwrap();
        let raced = race(&path, &["sh:9".parse().unwrap()], None, 2).unwrap();
        assert_eq!(names(&raced), ["sh:9", FLOOR, plain::NAME]);
        assert!(raced.iter().all(|times| times.rounds_ms.len() == 2 && times.median() > 0.0 && times.panorama == "sky"));
    }
}
