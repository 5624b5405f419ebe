//! Every method on every panorama through every exposure: light, score and time.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use glam::DVec3;
use mr360_protocol::light::Lift;
use mr360_server::lighting::{LightMethod, MethodSpec, StepTimes};

use super::exposure::{Exposure, Taken};
use super::irradiance::Normals;
use super::name;
use super::oracle::{self, Oracle};
use super::peer::Peer;
use super::radiance_map::{Half, RadianceMap};
use super::rendered::{self, Stage};
use super::score::{self, Light, Score};
use super::truth::Truth;
use crate::samples::percentile;

/// Numbers of lights in the sweeps.
pub(super) const SWEPT_LIGHTS: [usize; 7] = [1, 2, 4, 8, 16, 32, 64];
/// Methods that are swept.
pub(super) const SWEPT: [&str; 3] = ["median-cut", "variance-cut", "k-means"];
/// Time between the frames of a race: a method that follows its lights is to do so.
pub(super) const FRAME_US: u64 = 33_333;
/// The paper's method, in whose time others are told.
pub(super) const REFERENCE: &str = "mr360";

/// One method on one panorama through one exposure.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    /// As `--method` names it, parameter included, or the peer's name.
    pub(super) method: String,
    /// File name without its ending.
    pub(super) panorama: String,
    /// Where it belongs.
    pub(super) half: Half,
    /// How it was shown.
    pub(super) exposure: Exposure,
    /// Errors.
    pub(super) score: Score,
    /// Errors of rendered pictures.
    pub(super) rendered: rendered::Errors,
    /// Number of lights; none of an oracle.
    pub(super) lights: Option<usize>,
    /// Bytes of the message; none where it cannot be sent.
    pub(super) wire_bytes: Option<usize>,
    /// [`score::quantisation`] of that message.
    pub(super) quantisation: Option<f64>,
    /// Median over the rounds; none of an oracle.
    pub(super) time_ms: Option<f64>,
    /// That over [`REFERENCE`]'s on the same frame.
    pub(super) time_ratio: Option<f64>,
}

/// The methods with their default parameters and SH's larger set, then the sweeps of those that take a number of lights.
///
/// # Errors
/// When the server no longer knows one of them.
pub(super) fn methods() -> Result<Vec<MethodSpec>> {
    let swept = SWEPT.iter().flat_map(|name| SWEPT_LIGHTS.iter().map(move |lights| format!("{name}:{lights}")));
    let mut specs: Vec<MethodSpec> = MethodSpec::all().collect();
    for name in std::iter::once("sh:25".to_owned()).chain(swept) {
        let spec = name.parse().with_context(|| format!("the bench asks for {name:?}"))?;
        if !specs.contains(&spec) {
            specs.push(spec);
        }
    }
    Ok(specs)
}

/// Races `specs` and the peers over `files`, each frame `rounds` times after a warm-up.
///
/// # Errors
/// When a panorama cannot be used or a method or a peer fails.
pub(super) fn run(files: &[PathBuf], specs: &[MethodSpec], peers: &mut [Peer], rounds: u32) -> Result<Vec<Row>> {
    let (normals, stage) = (Normals::new(), Stage::new());
    let mut rows = Vec::new();
    for (place, path) in files.iter().enumerate() {
        let panorama = name(path);
        eprintln!("lighting: {panorama} ({} of {})", place + 1, files.len());
        let map = RadianceMap::load(path)?;
        let truth = Truth::of(&map, &normals);
        let mut takes = takes(&map).with_context(|| path.display().to_string())?;
        let maps: Vec<&RadianceMap> = std::iter::once(&map).chain(takes.iter().flat_map(Take::maps)).collect();
        let mut pictures = stage.under_all(&maps).into_iter();
        let truly = pictures.next().unwrap_or_default();
        for Take { exposure, taken, answers } in &mut takes {
            let exposure = *exposure;
            let raced = race(taken, &map, specs, peers, rounds).with_context(|| path.display().to_string())?;
            let reference = raced.iter().find(|entrant| entrant.method == REFERENCE).map_or(f64::NAN, Entrant::time_ms);
            let blank = |method: &str, score, rendered| Row {
                method: method.to_owned(),
                panorama: panorama.clone(),
                half: Half::of_place(place),
                exposure,
                score,
                rendered,
                lights: None,
                wire_bytes: None,
                quantisation: None,
                time_ms: None,
                time_ratio: None,
            };
            let mut mirrors = Mirrors { stage: &stage, taken: &*taken, map: &map, known: Vec::new() };
            rows.extend(raced.iter().map(|entrant| {
                let score = Score::of(&entrant.light, &truth, taken.scale, &normals);
                let wire = entrant.light.over_the_wire().ok();
                Row {
                    lights: Some(entrant.light.lights.len()),
                    wire_bytes: wire.as_ref().map(|(bytes, _)| *bytes),
                    quantisation: wire.map(|(_, received)| score::quantisation(&entrant.light, &received, &normals)),
                    time_ms: Some(entrant.time_ms()),
                    time_ratio: Some(entrant.time_ms() / reference),
                    ..blank(
                        &entrant.method,
                        score,
                        rendered::errors(&stage.under(&entrant.light, mirrors.of(entrant.light.lift)), &truly, taken.scale),
                    )
                }
            }));
            rows.extend(answers.iter().zip(&mut pictures).map(|((oracle, answer), pictures)| {
                let score = Score::of_oracle(answer, &truth, taken.scale, &normals);
                blank(oracle.name(), score, rendered::errors(&pictures, &truly, taken.scale))
            }));
        }
    }
    Ok(rows)
}

/// What the mirror shows of a panorama through one exposure: the same for all methods that lift alike.
struct Mirrors<'a> {
    stage: &'a Stage,
    taken: &'a Taken,
    map: &'a RadianceMap,
    known: Vec<(Lift, Vec<DVec3>)>,
}

impl Mirrors<'_> {
    fn of(&mut self, lift: Lift) -> &[DVec3] {
        let place = self.known.iter().position(|(known, _)| *known == lift).unwrap_or_else(|| {
            self.known.push((lift, self.stage.mirror(&self.taken.lifted(lift, self.map))));
            self.known.len() - 1
        });
        &self.known[place].1
    }
}

/// A panorama through one exposure, and what the oracles say of it.
struct Take {
    exposure: Exposure,
    taken: Taken,
    answers: Vec<(Oracle, oracle::Answer)>,
}

impl Take {
    /// The oracles' panoramas.
    fn maps(&self) -> impl Iterator<Item = &RadianceMap> {
        self.answers.iter().map(|(_, answer)| &answer.map)
    }
}

/// The panorama through every exposure.
fn takes(map: &RadianceMap) -> Result<Vec<Take>> {
    let take = |exposure: Exposure| {
        let taken = exposure.take(map)?;
        let answer = |codes: &Vec<[u8; 3]>| Vec::from(Oracle::ALL.map(|oracle| (oracle, oracle.answer(map, taken.scale, codes))));
        let answers = taken.codes.as_ref().map(answer).unwrap_or_default();
        Ok(Take { exposure, taken, answers })
    };
    Exposure::ALL.into_iter().map(take).collect()
}

/// A method, what it found and how long each round took.
#[derive(Default)]
struct Entrant {
    method: String,
    light: Light,
    times_ms: Vec<f64>,
}

impl Entrant {
    fn time_ms(&self) -> f64 {
        percentile(&self.times_ms, 0.5).unwrap_or(f64::NAN)
    }
}

/// Round by round every method once, so that whatever else the machine does meets all of them alike. The first round warms
/// up and is not counted. The light is that of the last round: what a still scene settles to.
fn race(taken: &mut Taken, map: &RadianceMap, specs: &[MethodSpec], peers: &mut [Peer], rounds: u32) -> Result<Vec<Entrant>> {
    let mut methods: Vec<Box<dyn LightMethod>> = specs.iter().map(|spec| spec.make()).collect();
    let mut entrants: Vec<Entrant> = specs.iter().map(|spec| Entrant { method: spec.to_string(), ..Entrant::default() }).collect();
    let mut guests = Vec::new();
    for peer in peers {
        // Some read 8 bits only.
        if peer.take(taken, map.texels(), map.width)? {
            guests.push((Entrant { method: peer.name().to_owned(), ..Entrant::default() }, peer));
        }
    }
    for round in 0..=rounds {
        taken.frame.pts_us = u64::from(round) * FRAME_US;
        for (method, entrant) in methods.iter_mut().zip(&mut entrants) {
            let started = Instant::now();
            let estimate = method.estimate(&taken.frame, &mut StepTimes::default()).with_context(|| entrant.method.clone())?;
            let elapsed_ms = started.elapsed().as_secs_f64() * 1e3;
            if round > 0 {
                entrant.times_ms.push(elapsed_ms);
            }
            if round == rounds {
                entrant.light = estimate.into();
            }
        }
        for (entrant, peer) in &mut guests {
            let elapsed_ms = peer.run()?;
            if round > 0 {
                entrant.times_ms.push(elapsed_ms);
            }
        }
    }
    for (mut entrant, peer) in guests {
        entrant.light = peer.light()?;
        entrants.push(entrant);
    }
    Ok(entrants)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::lighting::score::Dominant;

    #[test]
    fn every_method_of_the_server_is_raced_once() {
        let names: Vec<String> = methods().unwrap().iter().map(ToString::to_string).collect();
        for spec in MethodSpec::all() {
            assert_eq!(names.iter().filter(|name| **name == spec.to_string()).count(), 1, "{spec}");
        }
        assert!(names.contains(&REFERENCE.to_owned()) && names.contains(&"k-means:64".to_owned()) && names.contains(&"sh:25".to_owned()));
    }

    #[test]
    fn a_sun_in_an_even_sky_is_scored_through_every_exposure() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sun.exr");
        let to_sun = Vec3::new(0.3, 0.8, -0.5).normalize();
        let map = RadianceMap::of(128, |direction| match direction {
            d if d.dot(to_sun) > 4f32.to_radians().cos() => Vec3::splat(300.0),
            d if d.y > 0.0 => Vec3::new(0.9, 1.0, 1.2),
            _ => Vec3::splat(0.3),
        });
        let texels = map.texels().iter().flat_map(Vec3::to_array).collect();
        image::Rgb32FImage::from_raw(256, 128, texels).unwrap().save(&path).unwrap();
        let specs = ["directional", "mr360", "sh:9"].map(|name| name.parse().unwrap());
        let rows = run(&[path], &specs, &mut [], 2).unwrap();
        let oracle = |row: &&Row| row.method.starts_with("oracle:");
        // Of HDR there is nothing to guess.
        assert_eq!((rows.len(), rows.iter().filter(oracle).count()), (18, 6));
        for row in rows.iter().filter(oracle) {
            // White is the sky's own here, so that the sun cannot be told from it: nobody does well, and the oracles do best.
            let others = rows.iter().filter(|other| other.exposure == row.exposure && !oracle(other));
            assert!(row.time_ms.is_none() && others.map(|other| other.score.absolute).all(|error| error > row.score.absolute), "{row:?}");
        }
        for row in rows.iter().filter(|row| !oracle(row)) {
            let (hdr, lights) = (row.exposure == Exposure::Hdr, row.method != "sh:9");
            assert_eq!((row.panorama.as_str(), row.half), ("sun", Half::Tune), "{row:?}");
            match row.score.dominant {
                // A disc of 4° that stands alone, at a resolution of 1.4°.
                Dominant::OffDeg(off) => assert!(lights && (off < 1.0 || !hdr), "{row:?}"),
                // White at a percentile is the sky's own here: methods may see no sun in front of it.
                missed => assert!(!(lights && hdr) && missed == Dominant::NoLight, "{row:?}"),
            }
            // True HDR is met within a few per cent; harmonics of the clipped sky lack the sun, a third of all irradiance.
            assert!(!hdr || row.score.absolute < 0.05, "{row:?}");
            assert!(hdr || lights || row.score.absolute > 0.1, "{row:?}");
            assert!(row.time_ms > Some(0.0) && row.wire_bytes.is_some() && (row.method != REFERENCE || row.time_ratio == Some(1.0)));
            assert!(row.quantisation < Some(0.01), "{row:?}");
        }
    }
}
