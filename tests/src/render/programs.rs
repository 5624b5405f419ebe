//! Server and viewer run to their end, one picture at a time.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};

use crate::sandbox::Sandbox;

/// From where a picture is taken; the camera stands where the panorama was taken, and looks along −z.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize)]
pub(super) struct View {
    /// Columns and rows.
    pub(super) size: (u32, u32),
    pub(super) fov_y_deg: f32,
    /// Upwards.
    pub(super) pitch_deg: f32,
}

/// Folder of the references of this name, which travel with the sources.
pub(super) fn references(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("references").join(name)
}

/// Runs a program to its end and returns what it wrote to stdout.
///
/// # Errors
/// When it does not start, or fails; with what it wrote to stderr.
pub(super) fn finish(command: &mut Command) -> Result<Vec<u8>> {
    let name = command.get_program().to_string_lossy().into_owned();
    let output = command.output().with_context(|| format!("{name}: cannot be started"))?;
    if !output.status.success() {
        bail!("{name} ended with {}; its output:\n{}", output.status, String::from_utf8_lossy(&output.stderr));
    }
    Ok(output.stdout)
}

/// The light of a panorama as the server estimates it, as a file of this name that the viewer reads.
///
/// # Errors
/// When the server fails or says nothing.
pub(super) fn light(sandbox: &Sandbox, panorama: &Path, name: &str) -> Result<PathBuf> {
    let said = finish(sandbox.server_command()?.args(["analyze", "--json"]).arg(panorama))?;
    ensure!(!said.is_empty(), "mr360-server analyze said nothing about {}", panorama.display());
    let path = sandbox.path(&format!("{name}.json"));
    std::fs::write(&path, said).with_context(|| format!("{}: cannot be written", path.display()))?;
    Ok(path)
}

/// `mr360-client render` of a scene, to be given an output.
///
/// # Errors
/// When the viewer has not been built.
pub(super) fn render(sandbox: &Sandbox, panorama: &Path, scene: &Path, light: &Path, view: View) -> Result<Command> {
    Ok(render_by(sandbox.client_command()?, panorama, scene, light, view))
}

/// The same by a command that is `mr360-client`, without arguments yet.
pub(super) fn render_by(mut command: Command, panorama: &Path, scene: &Path, light: &Path, view: View) -> Command {
    command.arg("render").arg("--panorama").arg(panorama).arg("--scene").arg(scene).arg("--light").arg(light);
    command.args(["--size", &format!("{}x{}", view.size.0, view.size.1)]);
    command.args(["--fov-y-deg", &view.fov_y_deg.to_string(), "--pitch-deg", &view.pitch_deg.to_string()]);
    command
}

/// GPU times of a picture by pass, milliseconds.
pub(super) type Passes = Vec<(String, f64)>;

/// What `--passes` wrote.
///
/// # Errors
/// Naming the file and what is wrong with it.
pub(super) fn load_passes(path: &Path) -> Result<Passes> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    parse_passes(&text).with_context(|| path.display().to_string())
}

fn parse_passes(text: &str) -> Result<Passes> {
    let mut lines = text.lines();
    ensure!(lines.next() == Some("pass,gpu_ms"), "--passes wrote another head: {text}");
    lines
        .map(|line| line.rsplit_once(',').and_then(|(name, ms)| Some((name.to_owned(), ms.parse().ok()?))).with_context(|| line.to_owned()))
        .collect()
}

/// A JSON file of the references.
///
/// # Errors
/// Naming the file and what is wrong with it.
pub(super) fn load_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    serde_json::from_str(&text).with_context(|| path.display().to_string())
}

/// A picture of the references or of a program, of the size wanted.
///
/// # Errors
/// Naming the file and what is wrong with it.
pub(super) fn load_picture(path: &Path, size: (u32, u32)) -> Result<image::DynamicImage> {
    let picture = image::open(path).with_context(|| path.display().to_string())?;
    let (width, height) = (picture.width(), picture.height());
    ensure!((width, height) == size, "{}: {width}×{height} pixels, not {}×{}", path.display(), size.0, size.1);
    Ok(picture)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_passes_are_read() {
        let passes = parse_passes("pass,gpu_ms\nshadow 1,0.5\nobjects, view 2,1.5\n").unwrap();
        assert_eq!(passes, [("shadow 1".to_owned(), 0.5), ("objects, view 2".to_owned(), 1.5)]);
        assert!(parse_passes("pass,gpu_ms\nshadow\n").is_err() && parse_passes("").is_err());
    }
}
