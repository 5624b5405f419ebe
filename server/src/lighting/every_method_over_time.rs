//! Every method of the registry over time: what holds of all of them, whatever each is good at.

use super::sequences::{self, Sequence};
use super::stability::{Row, energy, largest_steps};
use super::test_skies::estimate_with;
use super::{LightMethod, MethodSpec};

/// Every method with its default parameter, and SH's larger set.
fn methods() -> Vec<Box<dyn LightMethod>> {
    MethodSpec::all().chain(["sh:25".parse().unwrap()]).map(MethodSpec::make).collect()
}

/// What every method says of the first frames of a sequence.
fn run(sequence: &Sequence, frames: usize) -> Vec<(String, Vec<Row>)> {
    let mut all: Vec<_> = methods().into_iter().map(|method| (method, Vec::new())).collect();
    for shot in sequence.shots().take(frames) {
        for (method, rows) in &mut all {
            let estimate = estimate_with(method.as_mut(), &shot.frame);
            rows.push(Row { time_s: shot.frame.pts_us as f64 * 1e-6, truth: shot.truth.clone(), estimate });
        }
    }
    all.into_iter().map(|(method, rows)| (method.name().to_owned(), rows)).collect()
}

#[test]
fn every_sequence_gives_sound_light_that_holds_its_energy() {
    for sequence in sequences::all() {
        // Soundness needs no fluent motion.
        let sequence = sequence.thinned(12);
        let all = run(&sequence, usize::MAX);
        for (name, rows) in &all {
            // What the default recovers and how it follows is its own affair within reason. Of the others the first of a lift stands for all, up
            // to the 32×16 texels of `iorns`, which are averaged before they are lifted.
            let alike = |other: &str, others: &[Row]| match name.as_str() {
                "directional" => other == "sh:9",
                _ => other != "directional" && others[0].estimate.lift == rows[0].estimate.lift,
            };
            let (least, most) = match name.as_str() {
                "directional" => (0.1, 20.0),
                "iorns" => (0.9, 1.1),
                _ => (0.97, 1.03),
            };
            let (_, reference) = all.iter().find(|(other, others)| alike(other, others)).unwrap();
            for (row, same) in rows.iter().zip(reference) {
                let context = format!("{}, {name}, {} s", sequence.name, row.time_s);
                let mut ids: Vec<u32> = row.estimate.lights.iter().map(|light| light.id).collect();
                ids.sort_unstable();
                ids.dedup();
                assert_eq!(ids.len(), row.estimate.lights.len(), "{context}");
                let ratio = energy(&row.estimate) / energy(&same.estimate);
                assert!(ratio > least && ratio < most, "{context}: {ratio}");
            }
        }
    }
}

#[test]
fn no_method_makes_light_jump_where_the_scene_is_steady() {
    for (sequence, frames, most) in [
        (sequences::still(), 30, 0.01),
        (sequences::overcast(), 30, 0.01),
        // Grain of four codes puts one texel in forty on the ramp between shown and clipped.
        (sequences::even_overcast(), 30, 0.02),
        (sequences::faulty_frame(), 60, 0.02),
        (sequences::people(), 45, 0.02),
        (sequences::shake(), 45, 0.02),
        (sequences::over_the_seam(), 75, 0.02),
    ] {
        for (name, rows) in run(&sequence, frames) {
            let (_, all) = largest_steps(&rows);
            assert!(all < most, "{}, {name}: {all}", sequence.name);
        }
    }
}
