//! The paper's method (Rhee et al. 2017) written with OpenCV, as a process that is raced with our methods.
//!
//! `tests/peers/opencv_mr360.py` says how it works and what it is asked for.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, ensure};
use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift};
use serde::Deserialize;

use super::score::Light;

/// Travels inside this program, so that it works wherever the program lies.
const SCRIPT: &str = include_str!("../../peers/opencv_mr360.py");
/// Most bytes of an answer: 64 lights and 9 coefficients take some 10 kB.
const MOST_ANSWER: u64 = 1 << 20;

/// Name in tables.
pub(super) const NAME: &str = "opencv-mr360";

/// The running peer. Ended when dropped.
pub(super) struct Peer {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    version: String,
}

#[derive(Deserialize)]
struct Answer {
    sh: Vec<[f32; 3]>,
    lights: Vec<AnsweredLight>,
}

#[derive(Deserialize)]
struct AnsweredLight {
    direction: [f32; 3],
    irradiance: [f32; 3],
    solid_angle_sr: f32,
}

impl Peer {
    /// Starts it with a Python that has NumPy and OpenCV.
    ///
    /// # Errors
    /// When Python does not start, or lacks one of them.
    pub(super) fn start(python: &Path) -> Result<Self> {
        let mut command = Command::new(python);
        // One thread for everything that NumPy and OpenCV might spread over several.
        command.args(["-c", SCRIPT]).env("OMP_NUM_THREADS", "1").env("OPENBLAS_NUM_THREADS", "1");
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("--python {}: does not start", python.display()))?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else { anyhow::bail!("the peer has no pipes") };
        let mut peer = Self { child, to, from: BufReader::new(from), version: String::new() };
        peer.version = peer.answer().with_context(|| {
            format!("--python {}: the peer did not start, see above; install numpy and opencv-contrib-python-headless", python.display())
        })?;
        Ok(peer)
    }

    /// Of OpenCV, as it says itself.
    pub(super) fn version(&self) -> &str {
        &self.version
    }

    /// Hands over the frame that is measured from now on, 8-bit sRGB.
    ///
    /// # Errors
    /// When the peer has ended.
    pub(super) fn take(&mut self, codes: &[[u8; 3]], width: usize) -> Result<()> {
        let height = codes.len() / width.max(1);
        writeln!(self.to, "frame {width} {height}").context("the OpenCV peer has ended, see above")?;
        self.to.write_all(codes.as_flattened()).context("the OpenCV peer has ended, see above")?;
        ensure!(self.answer()? == "ok", "the OpenCV peer took no frame");
        Ok(())
    }

    /// Estimates the light once and returns the milliseconds that it took, pipes not included.
    ///
    /// # Errors
    /// When the peer has ended.
    pub(super) fn run(&mut self) -> Result<f64> {
        let answer = self.ask("run")?;
        answer.parse().with_context(|| format!("the OpenCV peer answered {answer:?}"))
    }

    /// The light that the last run found.
    ///
    /// # Errors
    /// When the peer has ended, or its answer is none.
    pub(super) fn light(&mut self) -> Result<Light> {
        let answer = self.ask("light")?;
        parse(&answer).with_context(|| format!("the OpenCV peer answered {answer:?}"))
    }

    fn ask(&mut self, question: &str) -> Result<String> {
        writeln!(self.to, "{question}").and_then(|()| self.to.flush()).context("the OpenCV peer has ended, see above")?;
        self.answer()
    }

    fn answer(&mut self) -> Result<String> {
        self.to.flush().context("the OpenCV peer has ended, see above")?;
        let mut line = String::new();
        (&mut self.from).take(MOST_ANSWER).read_line(&mut line).context("the OpenCV peer does not speak UTF-8")?;
        ensure!(line.ends_with('\n'), "the OpenCV peer has ended, see above");
        Ok(line.trim_end().to_owned())
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended by itself, and nobody is left to be told.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn parse(answer: &str) -> Result<Light> {
    let Answer { sh, lights } = serde_json::from_str(answer)?;
    let lights = lights.into_iter().zip(0..).map(|(light, id)| DirectionalLight {
        id,
        direction: Vec3::from(light.direction),
        irradiance: Vec3::from(light.irradiance),
        solid_angle_sr: light.solid_angle_sr,
    });
    Ok(Light { lift: Lift::InverseToneMap, sh: sh.into_iter().map(Vec3::from).collect(), lights: lights.collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_are_read() {
        let answer = r#"{"sh": [[1, 2, 3]], "lights": [{"direction": [0, 1, 0], "irradiance": [3, 2, 1], "solid_angle_sr": 0.5}]}"#;
        let light = parse(answer).unwrap();
        assert_eq!(
            (light.sh[0], light.lights[0].direction, light.lights[0].irradiance),
            (Vec3::new(1.0, 2.0, 3.0), Vec3::Y, Vec3::new(3.0, 2.0, 1.0))
        );
        assert!(parse("Traceback").is_err());
    }

    #[test]
    fn a_python_that_is_not_there_or_no_python_is_named() {
        let error = format!("{:#}", Peer::start(Path::new("/no/such/python")).err().unwrap());
        assert!(error.contains("/no/such/python") && error.contains("--python"), "{error}");
        let error = format!("{:#}", Peer::start(Path::new("/bin/false")).err().unwrap());
        assert!(error.contains("/bin/false") && error.contains("opencv-contrib-python-headless"), "{error}");
    }
}
