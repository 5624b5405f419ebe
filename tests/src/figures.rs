//! Figures that several benches draw from what viewers wrote, and the files they go to.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};

use crate::samples::{Samples, percentile};

/// Two quantiles of the same values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quantiles {
    /// Median.
    pub p50: f64,
    /// What one in twenty exceeds.
    pub p95: f64,
}

impl Quantiles {
    /// Those of `values`; `None` without values.
    #[must_use]
    pub fn of(values: &[f64]) -> Option<Self> {
        Some(Self { p50: percentile(values, 0.5)?, p95: percentile(values, 0.95)? })
    }
}

/// Quantiles of a column of microseconds, in milliseconds, over the rows of all viewers together.
///
/// # Errors
/// When a viewer lacks the column, or none has a value in it.
pub fn quantiles_ms(viewers: &[Samples], column: &str) -> Result<Quantiles> {
    let mut values = Vec::new();
    for viewer in viewers {
        values.extend(viewer.column(column)?.into_iter().flatten().map(|us| us / 1e3));
    }
    Quantiles::of(&values).with_context(|| format!("no viewer measured {column}"))
}

/// Median over the viewers of the frames each presented a second.
///
/// # Errors
/// When one presented fewer than two.
pub fn frame_rate(viewers: &[Samples]) -> Result<f64> {
    let rates = viewers.iter().map(|viewer| {
        let presented: Vec<f64> = viewer.column("presented_us")?.into_iter().flatten().collect();
        let (first, last) = presented.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &t| (lo.min(t), hi.max(t)));
        ensure!(presented.len() > 1 && last > first, "a viewer presented fewer than two frames after its first second");
        Ok((presented.len() - 1) as f64 * 1e6 / (last - first))
    });
    percentile(&rates.collect::<Result<Vec<_>>>()?, 0.5).context("no viewers")
}

/// Makes the folder of the results where it is missing, and makes sure that it can be written to.
///
/// # Errors
/// When it cannot.
pub fn open_folder(folder: &Path) -> Result<()> {
    let opened = fs::create_dir_all(folder).and_then(|()| tempfile::tempfile_in(folder));
    opened.map(drop).with_context(|| format!("--out {}: cannot be written to; choose another folder", folder.display()))
}

/// Writes one file of results.
///
/// # Errors
/// When it cannot be written.
pub fn save(folder: &Path, name: &str, content: &str) -> Result<()> {
    let path = folder.join(name);
    fs::write(&path, content).with_context(|| format!("{}: cannot be written", path.display()))?;
    eprintln!("wrote {}", path.display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_cannot_be_written_to_is_named() {
        let folder = tempfile::tempdir().unwrap();
        open_folder(&folder.path().join("new/results")).unwrap();
        // One cannot be made, the other cannot be written to even by root.
        for wrong in ["/proc/mr360", "/proc"] {
            assert!(open_folder(Path::new(wrong)).unwrap_err().to_string().contains(wrong));
        }
    }

    #[test]
    fn frame_rate_is_the_median_viewers() {
        let viewer = |step: u32| {
            let rows: String = (0..4).map(|n| format!("{}\n", n * step)).collect();
            Samples::parse(&format!("presented_us\n{rows}"), "v").unwrap()
        };
        assert_eq!(frame_rate(&[viewer(20_000), viewer(10_000), viewer(40_000)]).unwrap(), 50.0);
        assert!(frame_rate(&[viewer(0)]).is_err());
    }
}
