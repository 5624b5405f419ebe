//! Every method on sequences of known light, on still scenes through a real codec, and on the real clip.
//!
//! `measures` say how good a method is, `curves` draw what it does over time, `coded` are the scenes through the codec, `report` writes
//! everything down.

use anyhow::{Context, Result, ensure};
use mr360_server::frame::Frame;
use mr360_server::lighting::sequences::{self, Varies};
use mr360_server::lighting::{LightMethod, MethodSpec, StepTimes};

use self::measures::{Measures, Moment, Shown};
use super::{Options, Section};
use crate::figures::save;
use crate::sandbox::{Sandbox, media};

mod coded;
mod curves;
mod measures;
#[cfg(test)]
mod measures_tests;
mod report;

/// The real clip, among the media.
const CLIP: &str = "congo_2048.mp4";
/// Length of the still scenes.
const STILL_S: u32 = 10;
/// Frames that are held at once.
const HELD: usize = 30;

/// What one method said of a sequence.
#[derive(Debug, Clone)]
struct Run {
    /// As `--method` names it.
    method: String,
    moments: Vec<Moment>,
    measures: Measures,
}

/// What all methods said of a sequence.
#[derive(Debug, Clone)]
struct Watched {
    sequence: String,
    runs: Vec<Run>,
}

/// Runs every method over every sequence, writes `lighting-stability.csv`, `lighting-stability-curves.csv` and a chart a sequence, and returns the
/// section of the summary.
///
/// # Errors
/// When the clip was not fetched, ffmpeg or a method fails, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<Section> {
    let clip = media(CLIP)?;
    let specs = methods()?;
    let sequences = sequences::all();
    let still = [
        (report::CODED, "still.mp4", coded::CLEAR),
        (report::BRIGHT, "bright.mp4", coded::BRIGHT),
        (report::DARK, "dark.mp4", coded::DARK),
    ];
    let count = sequences.len() + still.len() + 1;
    let progress = |place: usize, name: &str| eprintln!("lighting: {name} ({place} of {count})");
    let mut all = Vec::new();
    for (place, sequence) in sequences.iter().enumerate() {
        progress(place + 1, sequence.name);
        let shots = sequence.shots().map(|shot| Ok((shot.frame, Some(Shown::of_truth(&shot.truth)))));
        all.push(watch(sequence.name, &specs, shots, sequence.steps_s, sequence.varies)?);
    }
    let sandbox = Sandbox::new()?;
    for (name, file, weather) in still {
        progress(all.len() + 1, name);
        let (clip, truth) = (coded::encode(&sandbox, file, &weather, STILL_S)?, coded::truth(&weather));
        let shots = coded::frames(&clip)?.map(|frame| Ok((frame?, Some(truth.clone()))));
        all.push(watch(name, &specs, shots, &[], Varies::Else)?);
    }
    progress(count, report::REAL);
    all.push(watch(report::REAL, &specs, coded::frames(&clip)?.map(|frame| Ok((frame?, None))), &[], Varies::Else)?);
    save(&options.out, "lighting-stability.csv", &report::csv(&all))?;
    save(&options.out, "lighting-stability-curves.csv", &curves::csv(&all))?;
    for watched in &all {
        save(&options.out, &curves::chart_name(&watched.sequence), &curves::chart(watched)?)?;
    }
    Ok(Section { text: report::markdown(&all), bounds: report::bounds(&all) })
}

/// Every method with its default parameter, and SH's larger set.
fn methods() -> Result<Vec<MethodSpec>> {
    let larger = "sh:25".parse().context("the bench asks for \"sh:25\"")?;
    Ok(MethodSpec::all().chain([larger]).collect())
}

/// Runs every method, each on a thread of its own, over frames and what is true of them.
fn watch(
    sequence: &str,
    specs: &[MethodSpec],
    mut frames: impl Iterator<Item = Result<(Frame, Option<Shown>)>>,
    steps_s: &[f32],
    varies: Varies,
) -> Result<Watched> {
    let mut watchers: Vec<(MethodSpec, Box<dyn LightMethod>, Vec<Moment>)> =
        specs.iter().map(|spec| (*spec, spec.make(), Vec::new())).collect();
    loop {
        let held = frames.by_ref().take(HELD).collect::<Result<Vec<_>>>().with_context(|| sequence.to_owned())?;
        if held.is_empty() {
            break;
        }
        std::thread::scope(|scope| {
            let threads: Vec<_> =
                watchers.iter_mut().map(|(_, method, moments)| scope.spawn(|| look(method.as_mut(), &held, moments))).collect();
            threads.into_iter().try_for_each(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })
        .with_context(|| sequence.to_owned())?;
    }
    ensure!(watchers.iter().all(|(_, _, moments)| moments.len() > 1), "{sequence}: fewer than two frames");
    let run = |(spec, _, moments): (MethodSpec, Box<dyn LightMethod>, Vec<Moment>)| Run {
        method: spec.to_string(),
        measures: Measures::of(&moments, steps_s, varies),
        moments,
    };
    Ok(Watched { sequence: sequence.to_owned(), runs: watchers.into_iter().map(run).collect() })
}

fn look(method: &mut dyn LightMethod, frames: &[(Frame, Option<Shown>)], moments: &mut Vec<Moment>) -> Result<()> {
    let mut steps = StepTimes::default();
    for (frame, truth) in frames {
        steps.clear();
        let estimate = Shown::of_estimate(method.estimate(frame, &mut steps)?);
        moments.push(Moment { time_s: frame.pts_us as f64 * 1e-6, estimate, truth: truth.clone() });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bounds for a still scene with sensor noise through H.264 at 8 Mbit/s; the bench runs ten seconds of it.
    #[test]
    fn a_still_scene_through_the_codec_is_still() {
        let sandbox = Sandbox::new().unwrap();
        let clip = coded::encode(&sandbox, "still.mp4", &coded::CLEAR, 3).unwrap();
        let bits = std::fs::metadata(&clip).unwrap().len() * 8;
        // The rate is used up: nothing was smoothed away for want of noise.
        assert!((18_000_000..27_000_000).contains(&bits), "{bits}");
        let truth = coded::truth(&coded::CLEAR);
        let shots = coded::frames(&clip).unwrap().map(|frame| Ok((frame?, Some(truth.clone()))));
        let watched = watch("still", &[MethodSpec::default()], shots, &[], Varies::Else).unwrap();
        let Run { measures, moments, .. } = &watched.runs[0];
        assert_eq!((moments.len(), measures.found, measures.events_per_s), (90, Some(1.0), 0.0), "{measures:?}");
        // The clouds beside the sun are part of what is clipped.
        assert!(measures.wander_rms_deg.unwrap() <= 0.1 && measures.off_rms_deg.unwrap() <= 1.0, "{measures:?}");
        assert!(measures.strength_variation.unwrap() <= 0.01 && measures.level_variation <= 0.01, "{measures:?}");
    }
}
