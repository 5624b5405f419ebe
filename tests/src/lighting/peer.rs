//! Light detection of others as a process that is raced with our methods.
//!
//! All peers speak the same lines on stdin and stdout: first they print what they are; "frame W H" is followed by 8-bit sRGB and answered
//! "ok"; "run" estimates once and is answered with its milliseconds; "light" is answered with the light as JSON. The scripts in
//! `tests/peers` say what else they take.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, ensure};
use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift};
use serde::Deserialize;

use super::exposure::Taken;
use super::score::Light;

/// Most bytes of an answer: 64 lights and 9 coefficients take some 10 kB.
const MOST_ANSWER: u64 = 1 << 20;

/// A running peer. Ended when dropped.
pub(super) struct Peer {
    name: &'static str,
    lift: Lift,
    reads_radiance: bool,
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    version: String,
}

/// What is known of a peer before it runs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Introduction {
    /// Name in tables.
    pub(super) name: &'static str,
    /// What it does to LDR frames.
    pub(super) lift: Lift,
    /// Whether it takes "radiance W H", followed by linear floats.
    pub(super) reads_radiance: bool,
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
    /// Starts it.
    ///
    /// # Errors
    /// When the program does not start, or ends before it has said what it is.
    pub(super) fn start(introduction: Introduction, command: &mut Command) -> Result<Self> {
        let Introduction { name, lift, reads_radiance } = introduction;
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().context("does not start")?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else { anyhow::bail!("the peer has no pipes") };
        let mut peer = Self { name, lift, reads_radiance, child, to, from: BufReader::new(from), version: String::new() };
        peer.version = peer.answer().context("the peer did not start, see above")?;
        Ok(peer)
    }

    /// Name in tables.
    pub(super) fn name(&self) -> &'static str {
        self.name
    }

    /// Of what it is made of, as it says itself.
    pub(super) fn version(&self) -> &str {
        &self.version
    }

    /// Hands over the frame that is measured from now on, in the form that it reads. Returns whether it reads such a frame.
    ///
    /// # Errors
    /// When the peer has ended.
    pub(super) fn take(&mut self, taken: &Taken, radiance: &[Vec3], width: usize) -> Result<bool> {
        match &taken.codes {
            Some(codes) => self.frame(codes, width).map(|()| true),
            None if self.reads_radiance => {
                let bytes: Vec<u8> = radiance.iter().flat_map(Vec3::to_array).flat_map(f32::to_le_bytes).collect();
                self.send("radiance", width, radiance.len() / width.max(1), &bytes).map(|()| true)
            }
            None => Ok(false),
        }
    }

    /// Hands over a frame of 8-bit sRGB.
    ///
    /// # Errors
    /// When the peer has ended.
    pub(super) fn frame(&mut self, codes: &[[u8; 3]], width: usize) -> Result<()> {
        self.send("frame", width, codes.len() / width.max(1), codes.as_flattened())
    }

    /// Hands over a picture of this kind.
    ///
    /// # Errors
    /// When the peer has ended, or does not take it.
    pub(super) fn send(&mut self, kind: &str, width: usize, height: usize, bytes: &[u8]) -> Result<()> {
        writeln!(self.to, "{kind} {width} {height}").and_then(|()| self.to.write_all(bytes)).with_context(|| self.gone())?;
        self.acknowledged()
    }

    /// Sets something that it takes, as its script says.
    ///
    /// # Errors
    /// When the peer has ended, or does not take it.
    pub(super) fn set(&mut self, line: &str) -> Result<()> {
        writeln!(self.to, "{line}").with_context(|| self.gone())?;
        self.acknowledged()
    }

    fn acknowledged(&mut self) -> Result<()> {
        let answer = self.answer()?;
        ensure!(answer == "ok", "{} answered {answer:?}", self.name);
        Ok(())
    }

    /// Estimates the light once and returns the milliseconds that it took, pipes not included.
    ///
    /// # Errors
    /// When the peer has ended.
    pub(super) fn run(&mut self) -> Result<f64> {
        let answer = self.ask("run")?;
        answer.parse().with_context(|| format!("{} answered {answer:?}", self.name))
    }

    /// The light that the last run found.
    ///
    /// # Errors
    /// When the peer has ended, or its answer is none.
    pub(super) fn light(&mut self) -> Result<Light> {
        let answer = self.ask("light")?;
        parse(&answer, self.lift).with_context(|| format!("{} answered {answer:?}", self.name))
    }

    fn ask(&mut self, question: &str) -> Result<String> {
        writeln!(self.to, "{question}").with_context(|| self.gone())?;
        self.answer()
    }

    fn answer(&mut self) -> Result<String> {
        self.to.flush().with_context(|| self.gone())?;
        let mut line = String::new();
        let answered = (&mut self.from).take(MOST_ANSWER).read_line(&mut line);
        answered.with_context(|| format!("{} does not speak UTF-8", self.name))?;
        ensure!(line.ends_with('\n'), self.gone());
        Ok(line.trim_end().to_owned())
    }

    fn gone(&self) -> String {
        format!("{} has ended, see above", self.name)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended by itself, and nobody is left to be told.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn parse(answer: &str, lift: Lift) -> Result<Light> {
    let Answer { sh, lights } = serde_json::from_str(answer)?;
    let lights = lights.into_iter().zip(0..).map(|(light, id)| DirectionalLight {
        id,
        direction: Vec3::from(light.direction),
        irradiance: Vec3::from(light.irradiance),
        solid_angle_sr: light.solid_angle_sr,
    });
    Ok(Light { lift, sh: sh.into_iter().map(Vec3::from).collect(), lights: lights.collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::exposure::Exposure;
    use crate::lighting::radiance_map::RadianceMap;

    fn introduction() -> Introduction {
        Introduction { name: "peer", lift: Lift::Linear, reads_radiance: false }
    }

    #[test]
    fn answers_are_read() {
        let answer = r#"{"sh": [[1, 2, 3]], "lights": [{"direction": [0, 1, 0], "irradiance": [3, 2, 1], "solid_angle_sr": 0.5}]}"#;
        let light = parse(answer, Lift::InverseToneMap).unwrap();
        assert_eq!(
            (light.sh[0], light.lights[0].direction, light.lights[0].irradiance),
            (Vec3::new(1.0, 2.0, 3.0), Vec3::Y, Vec3::new(3.0, 2.0, 1.0))
        );
        assert!(parse("Traceback", Lift::Linear).is_err());
    }

    #[test]
    fn a_peer_is_asked_line_by_line() {
        let script = r#"echo v1; while read -r what w h; do case $what in frame) head -c $((w*h*3)) >/dev/null; echo ok;;
            run) echo 2.5;; light) echo '{"sh": [[1, 1, 1]], "lights": []}';; *) echo no;; esac; done"#;
        // The shell reads a line byte by byte, so that the bytes of the frame are left for `head`.
        let mut peer = Peer::start(introduction(), Command::new("sh").args(["-c", script])).unwrap();
        assert_eq!((peer.name(), peer.version()), ("peer", "v1"));
        peer.frame(&[[1, 2, 3]; 8], 4).unwrap();
        assert_eq!((peer.run().unwrap(), peer.light().unwrap().sh), (2.5, vec![Vec3::ONE]));
        assert!(peer.set("size 512").unwrap_err().to_string().contains("peer answered"));
        let map = RadianceMap::of(2, |_| Vec3::ONE);
        let hdr = Exposure::Hdr.take(&map).unwrap();
        assert!(!peer.take(&hdr, map.texels(), map.width).unwrap());
        let ended = Peer::start(introduction(), &mut Command::new("false")).err().unwrap();
        assert!(format!("{ended:#}").contains("has ended"));
    }
}
