//! The truth scenes drawn by three.js in a headless browser; `tests/peers/three_scene.mjs` says how.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::Geometry;
use mr360_protocol::scene_file::SceneFile;
use serde::Serialize;

use super::programs::View;

/// Travels inside this program, so that it works wherever the program lies.
const SCRIPT: &str = include_str!("../../peers/three_scene.mjs");

/// One picture to draw.
#[derive(Serialize)]
pub(super) struct Job {
    pub(super) panorama: PathBuf,
    /// What `mr360-server analyze --json` printed.
    pub(super) light: PathBuf,
    pub(super) out: PathBuf,
    width: u32,
    height: u32,
    fov_y_deg: f32,
    pitch_deg: f32,
    ground_y: f32,
    objects: Vec<Object>,
}

#[derive(Serialize)]
struct Object {
    #[serde(skip_serializing_if = "Option::is_none")]
    shape: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<PathBuf>,
    position: [f32; 3],
    rotation: [f32; 4],
    scale: [f32; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    material: Option<Material>,
}

#[derive(Serialize)]
struct Material {
    base_color: [f32; 3],
    roughness: f32,
    metallic: f32,
}

impl Job {
    /// A scene's file in a panorama under its light.
    ///
    /// # Errors
    /// When the scene cannot be read.
    pub(super) fn new(scene: &Path, (panorama, light, out): (PathBuf, PathBuf, PathBuf), view: View) -> Result<Self> {
        let mut models: Vec<(AssetId, PathBuf)> = Vec::new();
        let scene = SceneFile::load(scene)?.resolve(|model| {
            let id = AssetId::of(model.as_os_str().as_encoded_bytes());
            models.push((id, model.to_owned()));
            Ok::<_, std::convert::Infallible>(id)
        })?;
        let mut objects = Vec::new();
        for object in &scene.objects {
            let (shape, model) = match object.geometry {
                Geometry::Shape(shape) => (Some(format!("{shape:?}").to_lowercase()), None),
                Geometry::Model(id) => (None, models.iter().find(|(known, _)| *known == id).map(|(_, path)| path.clone())),
            };
            let transform = object.transform;
            let material = object.material.as_ref();
            objects.push(Object {
                shape,
                model,
                position: transform.position.to_array(),
                rotation: transform.rotation.to_array(),
                scale: transform.scale.to_array(),
                material: material.map(|m| Material { base_color: m.base_color, roughness: m.roughness, metallic: m.metallic }),
            });
        }
        let (width, height) = view.size;
        let (fov_y_deg, pitch_deg, ground_y) = (view.fov_y_deg, view.pitch_deg, scene.ground_y);
        Ok(Self { panorama, light, out, width, height, fov_y_deg, pitch_deg, ground_y, objects })
    }
}

/// Draws all jobs and returns three.js's version.
///
/// # Errors
/// When Node or the browser does not start, there is no three.js in the folder, or a picture fails.
pub(super) fn draw(node: &Path, folder: &Path, chromium: &Path, jobs: &[Job]) -> Result<String> {
    let hint = || {
        let (folder, node, chromium) = (folder.display(), node.display(), chromium.display());
        format!(
            "--three {folder}: wants a folder in which `npm install three` was run, Node 20 or newer (--node {node}) and Chromium (--chromium {chromium})"
        )
    };
    run(node, folder, chromium, &serde_json::to_vec(jobs)?, jobs.len()).with_context(hint)
}

fn run(node: &Path, folder: &Path, chromium: &Path, jobs: &[u8], count: usize) -> Result<String> {
    ensure!(folder.is_dir(), "no such folder");
    let mut command = Command::new(node);
    command.args(["--input-type=module", "-e", SCRIPT]).arg(folder).arg(chromium).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = command.spawn()?;
    // A child that ends without reading breaks the pipe; what it said tells why.
    let sent = child.stdin.take().map_or(Ok(()), |mut stdin| stdin.write_all(jobs));
    let output = child.wait_with_output()?;
    let said = String::from_utf8_lossy(&output.stdout);
    let mut lines = said.lines();
    let version = lines.next().unwrap_or_default();
    if let Some(fault) = said.lines().find(|line| line.starts_with("failed")) {
        bail!("{fault}");
    }
    sent?;
    let done = lines.filter(|line| *line == "ok").count();
    ensure!(output.status.success() && done == count, "it drew {done} of {count} pictures and ended with {}", output.status);
    Ok(version.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_says_what_stands_where() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("SCENE.toml");
        let text = "ground_y = -1.5\n[[object]]\nshape = \"sphere\"\nposition = [1.0, 2.0, 3.0]\nscale = 0.5\nrotation_deg = [0.0, 90.0, 0.0]\n\
                    material = { base_color = [0.5, 0.25, 1.0], roughness = 0.5, metallic = 1.0 }\n[[object]]\nmodel = \"a.glb\"\n";
        std::fs::write(&scene, text).unwrap();
        let view = View { size: (64, 36), fov_y_deg: 45.0, pitch_deg: -14.0 };
        let job = Job::new(&scene, ("p.exr".into(), "l.json".into(), "o.png".into()), view).unwrap();
        let json = serde_json::to_value(&job).unwrap();
        assert_eq!((json["width"].as_u64(), json["ground_y"].as_f64(), json["out"].as_str()), (Some(64), Some(-1.5), Some("o.png")));
        assert_eq!(json["objects"][0]["shape"], "sphere");
        assert_eq!(json["objects"][0]["material"]["base_color"], serde_json::json!([0.5, 0.25, 1.0]));
        assert!((json["objects"][0]["rotation"][1].as_f64().unwrap() - 0.5_f64.sqrt()).abs() < 1e-6);
        assert_eq!(json["objects"][1]["model"].as_str(), folder.path().join("a.glb").to_str());
    }

    #[test]
    fn what_is_missing_is_named() {
        let folder = tempfile::tempdir().unwrap();
        for (node, folder) in [("/no/such/node", folder.path()), ("/bin/false", folder.path()), ("node", Path::new("/no/such/folder"))] {
            let error = format!("{:#}", draw(Path::new(node), folder, Path::new("chromium"), &[]).unwrap_err());
            assert!(error.contains(&folder.display().to_string()) && error.contains("npm install three"), "{error}");
        }
    }
}
