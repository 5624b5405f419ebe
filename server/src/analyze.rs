//! `mr360-server analyze`: the light of every frame of a file or stream, one line a frame.

use std::fmt;
use std::io::{self, ErrorKind, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use mr360_protocol::failure::Failure;
use mr360_protocol::video::StereoLayout;
use serde::ser::{Serialize, SerializeMap, Serializer};

use crate::frame::Frame;
use crate::image_file;
use crate::lighting::{Estimate, LightMethod, MethodSpec, StepTimes};

/// Stereo layout as the command line names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StereoArg {
    /// One view for both eyes.
    Mono,
    /// Left eye above right eye.
    TopBottom,
    /// Left eye left of right eye.
    SideBySide,
}

impl From<StereoArg> for StereoLayout {
    fn from(stereo: StereoArg) -> Self {
        match stereo {
            StereoArg::Mono => Self::Mono,
            StereoArg::TopBottom => Self::TopBottom,
            StereoArg::SideBySide => Self::SideBySide,
        }
    }
}

/// Print the light of every frame of a file or stream.
#[derive(Debug, Clone, Args)]
pub struct AnalyzeArgs {
    /// A panorama (.exr and .hdr linear, .png and .jpg sRGB), a video file or a stream's URL.
    pub source: String,
    /// Light method.
    #[arg(long, value_name = "NAME[:N]", default_value_t, help = format!("Light method: {}", MethodSpec::usage()))]
    pub method: MethodSpec,
    /// Stop after this many frames.
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// One JSON object a frame instead of a line for people.
    #[arg(long)]
    pub json: bool,
    /// Where the eyes' views lie; read from the source's metadata unless given.
    #[arg(long, value_enum)]
    pub stereo: Option<StereoArg>,
}

/// Analyses `args.source` onto standard output. Still images are loaded here; everything else is opened by
/// `open_video`. A reader that closes standard output ends the command quietly.
///
/// # Errors
/// [`Failure::Input`] when the source cannot be opened; [`Failure::Running`] when a frame cannot be decoded or lit, or standard output
/// cannot be written.
pub fn run<E, I>(args: &AnalyzeArgs, open_video: impl FnOnce(&AnalyzeArgs) -> Result<I>) -> Result<(), Failure<anyhow::Error>>
where
    E: Into<anyhow::Error>,
    I: IntoIterator<Item = Result<Frame, E>>,
{
    let mut method = args.method.make();
    let out = io::BufWriter::new(io::stdout().lock());
    let path = Path::new(&args.source);
    if image_file::is_image(path) && !args.source.contains("://") {
        let frame = image_file::load(path).map_err(|error| Failure::Input(error.into()))?;
        analyze(args, method.as_mut(), [Ok::<_, anyhow::Error>(frame)], out)
    } else {
        analyze(args, method.as_mut(), open_video(args).map_err(Failure::Input)?, out)
    }
    .map_err(Failure::Running)
}

/// Lights every frame of `frames`, up to `args.frames`, and writes a line for each to `out` at once.
///
/// # Errors
/// When a frame cannot be decoded or lit, or `out` cannot be written; a broken pipe is no error.
pub fn analyze<E: Into<anyhow::Error>>(
    args: &AnalyzeArgs,
    method: &mut dyn LightMethod,
    frames: impl IntoIterator<Item = Result<Frame, E>>,
    mut out: impl Write,
) -> Result<()> {
    let mut steps = StepTimes::default();
    let name = method.name().to_owned();
    let limit = args.frames.map_or(usize::MAX, |frames| usize::try_from(frames).unwrap_or(usize::MAX));
    for frame in frames.into_iter().take(limit) {
        let mut frame = frame.map_err(Into::into)?;
        if let Some(stereo) = args.stereo {
            frame.stereo = stereo.into();
        }
        steps.clear();
        let started = Instant::now();
        let estimate = method.estimate(&frame, &mut steps).with_context(|| args.source.clone())?;
        let total = started.elapsed();
        let line = Line { pts_us: frame.pts_us, method: &name, estimate, total, steps: &steps };
        let written = if args.json { line.write_json(&mut out) } else { writeln!(out, "{line}") };
        match written.and_then(|()| out.flush()) {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => return Ok(()),
            written => written.context("standard output: cannot be written")?,
        }
    }
    Ok(())
}

/// One line of output.
struct Line<'a> {
    pts_us: u64,
    method: &'a str,
    estimate: &'a Estimate,
    total: Duration,
    steps: &'a StepTimes,
}

impl Line<'_> {
    fn write_json(&self, out: &mut impl Write) -> io::Result<()> {
        serde_json::to_writer(&mut *out, self).map_err(io::Error::from)?;
        writeln!(out)
    }
}

/// For people: time, step times, then each light's elevation, azimuth to the right of the centre, and irradiance.
impl fmt::Display for Line<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:9.3} s  {} {:6.2} ms", self.pts_us as f64 / 1e6, self.method, milliseconds(self.total))?;
        let ambient = self.estimate.sh.first().copied().unwrap_or_default() * 0.282_094_8;
        write!(f, "  ambient {:.3} {:.3} {:.3}", ambient.x, ambient.y, ambient.z)?;
        for light in &self.estimate.lights {
            let (direction, e) = (light.direction, light.irradiance);
            let elevation = direction.y.clamp(-1.0, 1.0).asin().to_degrees();
            let azimuth = direction.x.atan2(-direction.z).to_degrees();
            write!(f, "  light {} {elevation:.1}° up {azimuth:.1}° right {:.3} {:.3} {:.3}", light.id, e.x, e.y, e.z)?;
        }
        Ok(())
    }
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// The object of the command-line contract, fields in its order.
impl Serialize for Line<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(serde::Serialize)]
        struct Light {
            id: u32,
            direction: [f32; 3],
            irradiance: [f32; 3],
            solid_angle_sr: f32,
        }
        let sh: Vec<[f32; 3]> = self.estimate.sh.iter().map(|c| c.to_array()).collect();
        let lights: Vec<Light> = self
            .estimate
            .lights
            .iter()
            .map(|light| Light {
                id: light.id,
                direction: light.direction.to_array(),
                irradiance: light.irradiance.to_array(),
                solid_angle_sr: light.solid_angle_sr,
            })
            .collect();
        let mut object = serializer.serialize_map(None)?;
        object.serialize_entry("pts_secs", &(self.pts_us as f64 / 1e6))?;
        object.serialize_entry("method", self.method)?;
        object.serialize_entry("sh", &sh)?;
        object.serialize_entry("lights", &lights)?;
        object.serialize_entry("elapsed_ms", &ElapsedMs(self.total, self.steps))?;
        // Beyond the contract: without it reflections could not be lifted as the lights were.
        object.serialize_entry("lift", &self.estimate.lift)?;
        if let Some(hidden) = &self.estimate.hidden {
            object.serialize_entry("hidden", hidden)?;
        }
        object.end()
    }
}

/// Total and every step, in milliseconds.
struct ElapsedMs<'a>(Duration, &'a StepTimes);

impl Serialize for ElapsedMs<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut object = serializer.serialize_map(None)?;
        object.serialize_entry("total", &milliseconds(self.0))?;
        for (step, duration) in self.1.iter() {
            object.serialize_entry(step, &milliseconds(duration))?;
        }
        object.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Pixels;
    use mr360_protocol::video::Transfer;

    fn args(json: bool, frames: Option<u64>) -> AnalyzeArgs {
        AnalyzeArgs { source: "test".to_owned(), method: MethodSpec::default(), frames, json, stereo: None }
    }

    /// A dark sky with a bright spot in the middle of the right upper quarter.
    fn frames() -> impl Iterator<Item = Result<Frame>> {
        (0..5u64).map(|i| {
            let texels = (0..64 * 32).map(|texel| if texel == 8 * 64 + 48 { [50.0; 3] } else { [0.1; 3] }).collect();
            let pixels = Pixels::Rgb { width: 64, height: 32, texels, transfer: Transfer::Linear };
            Ok(Frame { pts_us: i * 40_000, stereo: StereoLayout::Mono, pixels })
        })
    }

    fn lines(args: &AnalyzeArgs) -> Vec<String> {
        let mut out = Vec::new();
        analyze(args, args.method.make().as_mut(), frames(), &mut out).unwrap();
        String::from_utf8(out).unwrap().lines().map(str::to_owned).collect()
    }

    #[test]
    fn json_lines_hold_the_contract() {
        let lines = lines(&args(true, Some(3)));
        assert_eq!(lines.len(), 3);
        let object: serde_json::Value = serde_json::from_str(&lines[2]).unwrap();
        assert_eq!(object["pts_secs"], 0.08);
        assert_eq!(object["method"], "directional");
        assert_eq!(object["sh"].as_array().unwrap().len(), 9);
        assert_eq!(object["sh"][0].as_array().unwrap().len(), 3);
        let light = &object["lights"][0];
        assert_eq!(light["id"], 0);
        assert!(light["direction"][0].as_f64().unwrap() > 0.6 && light["direction"][1].as_f64().unwrap() > 0.6);
        assert!(light["irradiance"][2].as_f64().unwrap() > 0.0 && light["solid_angle_sr"].as_f64().unwrap() > 0.0);
        let elapsed = object["elapsed_ms"].as_object().unwrap();
        let steps: f64 = elapsed.iter().filter(|(name, _)| *name != "total").map(|(_, ms)| ms.as_f64().unwrap()).sum();
        assert!(elapsed.len() > 3 && elapsed["total"].as_f64().unwrap() >= steps);
    }

    #[test]
    fn people_get_a_line_a_frame() {
        let lines = lines(&args(false, None));
        assert_eq!(lines.len(), 5);
        assert!(lines[0].contains("light 0") && lines[0].contains("up"), "{}", lines[0]);
    }

    #[test]
    fn a_broken_pipe_ends_quietly_and_a_full_disk_does_not() {
        struct Broken(ErrorKind);
        impl Write for Broken {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(self.0.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Err(self.0.into())
            }
        }
        for json in [true, false] {
            let mut method = MethodSpec::default().make();
            let mut run = |kind| analyze(&args(json, None), method.as_mut(), frames(), Broken(kind));
            assert!(run(ErrorKind::BrokenPipe).is_ok());
            assert!(run(ErrorKind::StorageFull).is_err());
        }
    }

    #[test]
    fn a_frame_that_cannot_be_decoded_is_an_error() {
        let failing = [Err(anyhow::anyhow!("broken packet"))];
        let mut method = MethodSpec::default().make();
        let error = analyze(&args(true, None), method.as_mut(), failing, Vec::new()).unwrap_err();
        assert!(error.to_string().contains("broken packet"));
    }
}
