//! Rendering, measured: viewers beside their server, our pictures against path-traced truth and three.js, our shadows against path-traced
//! visibility, time against error, how time grows with what is drawn, and a race against Bevy.
//!
//! `viewers` runs the demo's scene, `truth` and `shadows` compare what the viewer draws with the references in `tests/references`, `methods` and
//! `growth` time the passes of one picture, `eyes` those of two, `bevy` races whole frames. `flip` is the metric, `sheet` puts pictures side by side, `three` has three.js draw the same scenes, `programs` runs
//! server and viewer to their end.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result};

use crate::figures::save;

mod bevy;
mod eyes;
pub mod flip;
mod growth;
mod methods;
mod programs;
mod shadows;
mod sheet;
mod three;
mod truth;
mod viewers;

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// A scene in a viewer beside its server: first picture, frame rate, time of every pass, age of the light.
    Viewers,
    /// Pictures against path-traced truth, beside three.js.
    Truth,
    /// Shadows against path-traced visibility.
    Shadows,
    /// Time against error of every way to look up reflections in every tier.
    Methods,
    /// Time of every pass over lights, objects, triangles, roughness, size and views.
    Growth,
    /// Both eyes by one pass against a pass an eye.
    Eyes,
    /// Race against Bevy, where its side was built.
    Bevy,
}

/// What to run.
#[derive(Debug, Clone)]
pub struct Options {
    /// What is measured.
    pub parts: Vec<Part>,
    /// For viewers, as for `mr360-server serve --source`.
    pub source: String,
    /// For viewers, as for `mr360-server serve --scene`.
    pub scene: PathBuf,
    /// Size of the viewers' pictures, `WIDTHxHEIGHT`.
    pub size: String,
    /// Frames that each viewer presents.
    pub frames: u32,
    /// Folder of the panoramas for truth; those of `deploy/fetch-media` unless given.
    pub panoramas: Option<PathBuf>,
    /// Folder with three.js among its `node_modules`, to draw its pictures anew instead of taking the kept ones.
    pub three: Option<PathBuf>,
    /// Node to run three.js's script in.
    pub node: PathBuf,
    /// Browser that three.js draws in.
    pub chromium: PathBuf,
    /// Bevy's side of the race, built in `tests/peers/bevy_scene`.
    pub bevy: Option<PathBuf>,
    /// Folder that the results go into; made where it is missing.
    pub out: PathBuf,
}

/// Runs the bench and writes `render.md`; of viewers `render.csv`, `render-passes.csv` and `render-passes.svg`; of truth `render-truth.csv` and
/// `render-truth.jpg`; of shadows `render-shadows.csv` and `render-shadows.png`; of methods `render-methods.csv` and `render-methods.svg`; of growth `render-growth.csv`
/// and `render-growth.svg`; of eyes `render-eyes.csv` and `render-eyes.svg`; of the race `render-bevy.csv` and both renderers' pictures.
///
/// # Errors
/// When panoramas or references are missing, a program fails, or the results cannot be written.
pub fn run(options: &Options) -> Result<()> {
    fs::create_dir_all(&options.out).with_context(|| format!("--out {}: cannot be made", options.out.display()))?;
    let mut sections = Vec::new();
    for part in &options.parts {
        sections.push(match part {
            Part::Viewers => viewers::run(options)?,
            Part::Truth => truth::run(options)?,
            Part::Shadows => shadows::run(options)?,
            Part::Methods => methods::run(options)?,
            Part::Growth => growth::run(options)?,
            Part::Eyes => eyes::run(options)?,
            Part::Bevy => bevy::run(options)?,
        });
    }
    save(&options.out, "render.md", &format!("# Rendering\n\n{}", sections.join("\n")))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    pub(super) fn options(out: &Path) -> Options {
        Options {
            parts: vec![Part::Viewers],
            source: "synthetic:plaza".to_owned(),
            scene: "SCENE.toml".into(),
            size: "640x360".to_owned(),
            frames: 100,
            panoramas: None,
            three: None,
            node: "node".into(),
            chromium: "chromium".into(),
            bevy: None,
            out: out.to_owned(),
        }
    }
}
