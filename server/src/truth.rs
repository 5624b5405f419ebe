//! `mr360-server truth`: what a synthetic place knows of itself, for tests and comparisons.

use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use image::ImageFormat;
use mr360_protocol::failure::Failure;

use crate::plaza::{Plaza, PlazaConfig};

/// Print the truth about one frame of a synthetic source as JSON.
#[derive(Debug, Clone, Args)]
pub struct TruthArgs {
    /// As for serve: synthetic:plaza, with its options.
    #[arg(value_name = "synthetic:plaza[?KEY=VALUE&…]")]
    pub source: String,
    /// Which frame.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub frame: u64,
    /// Also write the frame's unclipped linear radiance.
    #[arg(long, value_name = "OUT.exr")]
    pub radiance: Option<PathBuf>,
}

/// Prints the truth: sun, irradiances, ground, movers with their masks, geometry.
///
/// # Errors
/// [`Failure::Input`] for a source that has no truth, wrong options, and a file that cannot be created; [`Failure::Running`] for output
/// that cannot be written. A reader that closes standard output is none.
pub fn run(args: &TruthArgs) -> Result<(), Failure<anyhow::Error>> {
    let mut plaza = plaza(&args.source).map_err(Failure::Input)?;
    let radiance = args.radiance.as_deref().map(create).transpose().map_err(Failure::Input)?;
    let mut out = BufWriter::new(io::stdout().lock());
    print(&mut plaza, args.frame, &mut out).map_err(Failure::Running)?;
    match radiance {
        Some(file) => write_radiance(&mut plaza, args.frame, file).map_err(Failure::Running),
        None => Ok(()),
    }
}

fn plaza(source: &str) -> anyhow::Result<Plaza> {
    let name = source.strip_prefix("synthetic:").unwrap_or(source);
    let (name, query) = name.split_once('?').unwrap_or((name, ""));
    if name != "plaza" {
        return Err(anyhow!("{source}: only synthetic:plaza knows its truth"));
    }
    PlazaConfig::from_query(query).and_then(|config| Plaza::new(config, |_| {})).with_context(|| source.to_owned())
}

fn print(plaza: &mut Plaza, frame: u64, out: &mut impl Write) -> anyhow::Result<()> {
    match plaza.write_truth_json(frame, &mut *out).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.context("standard output: cannot be written"),
    }
}

/// A picture that is created before the place is rendered, so that a wrong path costs no time.
struct Radiance<'a> {
    path: &'a Path,
    file: File,
}

fn create(path: &Path) -> anyhow::Result<Radiance<'_>> {
    if ImageFormat::from_path(path).ok() != Some(ImageFormat::OpenExr) {
        return Err(anyhow!("--radiance {}: linear radiance goes into an .exr file", path.display()));
    }
    let file = File::create(path).with_context(|| format!("--radiance {}: cannot be created; check the folder", path.display()))?;
    Ok(Radiance { path, file })
}

fn write_radiance(plaza: &mut Plaza, frame: u64, radiance: Radiance<'_>) -> anyhow::Result<()> {
    let (width, height) = (plaza.config().width, plaza.config().height);
    let texels = plaza.radiance(frame).into_iter().flatten().collect();
    let image = image::Rgb32FImage::from_raw(width, height, texels).context("the place rendered fewer pixels than it has")?;
    let mut out = BufWriter::new(radiance.file);
    let written = image.write_to(&mut out, ImageFormat::OpenExr).map_err(anyhow::Error::from).and_then(|()| Ok(out.flush()?));
    written.with_context(|| format!("--radiance {}: cannot be written; is there space?", radiance.path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str = "synthetic:plaza?size=64x32&movers=0";

    struct Closed;

    impl Write for Closed {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_leaves_keeps_nobody_from_the_radiance() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("place.exr");
        let mut place = plaza(SMALL).unwrap();
        print(&mut place, 0, &mut Closed).unwrap();
        write_radiance(&mut place, 0, create(&path).unwrap()).unwrap();
        assert_eq!(image::image_dimensions(&path).unwrap(), (64, 32));
    }

    #[test]
    fn what_the_user_got_wrong_is_input() {
        let input = |source: &str, radiance: Option<&str>| match run(&TruthArgs {
            source: source.to_owned(),
            frame: 0,
            radiance: radiance.map(Into::into),
        }) {
            Err(Failure::Input(error)) => format!("{error:#}"),
            other => panic!("{other:?}"),
        };
        assert!(input("synthetic:moon", None).contains("synthetic:moon"));
        assert_eq!(input("synthetic:plaza?hue=3", None).matches("synthetic:plaza").count(), 1);
        assert!(input(SMALL, Some("/nowhere/place.exr")).contains("/nowhere/place.exr"));
        assert!(input(SMALL, Some("place.txt")).contains(".exr"));
    }
}
