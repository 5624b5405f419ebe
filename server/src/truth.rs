//! `mr360-server truth`: what a synthetic place knows of itself, for tests and comparisons.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;

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
/// For a source that has no truth, wrong options, and output that cannot be written.
pub fn run(args: &TruthArgs) -> anyhow::Result<()> {
    let name = args.source.strip_prefix("synthetic:").unwrap_or(&args.source);
    let (name, query) = name.split_once('?').unwrap_or((name, ""));
    if name != "plaza" {
        bail!("{}: only synthetic:plaza knows its truth", args.source);
    }
    let config = PlazaConfig::from_query(query)?;
    let mut plaza = Plaza::new(config, |_| {})?;
    let mut out = std::io::stdout().lock();
    plaza.write_truth_json(args.frame, &mut out).and_then(|()| out.flush()).context("standard output: cannot be written")?;
    if let Some(path) = &args.radiance {
        let (width, height) = (plaza.config().width, plaza.config().height);
        let texels = plaza.radiance(args.frame).into_iter().flatten().collect();
        let image = image::Rgb32FImage::from_raw(width, height, texels).context("the place rendered fewer pixels than it has")?;
        image.save(path).with_context(|| format!("{}: cannot be written; check folder, ending and free space", path.display()))?;
    }
    Ok(())
}
