//! What the default's own features could give: its regression fitted by `tests/peers/fit_recovery.py` to the very panoramas that it is then measured on.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use serde::Deserialize;

use super::bounds::Fitted;
use super::exposure::Exposure;
use super::name;
use super::radiance_map::RadianceMap;

/// Travels inside this program, so that it works wherever the program lies.
const SCRIPT: &str = include_str!("../../peers/fit_recovery.py");
/// Percentiles whose bounds are about recovered light.
const PERCENTILES: [u8; 2] = [95, 99];

/// A line of the script's.
#[derive(Deserialize)]
struct Line {
    panorama: String,
    percentile: u8,
    absolute: f64,
    scale_invariant: f64,
}

/// Fits and measures; about a minute.
///
/// # Errors
/// When a panorama cannot be used, or Python or one of its packages is missing.
pub(super) fn fit(python: &Path, files: &[PathBuf]) -> Result<Vec<Fitted>> {
    let folder = tempfile::tempdir().context("a folder for the panoramas cannot be made")?;
    for path in files {
        let file = folder.path().join(name(path)).with_added_extension("npy");
        fs::write(&file, npy(&RadianceMap::load(path)?)).with_context(|| file.display().to_string())?;
    }
    let percentiles = PERCENTILES.map(|percentile| percentile.to_string()).join(",");
    let mut command = Command::new(python);
    command.args(["-c", SCRIPT]).arg(folder.path()).args(["--in-sample", &percentiles]);
    // One thread for everything that NumPy might spread over several.
    command.env("OMP_NUM_THREADS", "1").env("OPENBLAS_NUM_THREADS", "1").stderr(Stdio::piped()).stdin(Stdio::null());
    let hint = || format!("--python {}: wants a Python with numpy and opencv-contrib-python-headless", python.display());
    let output = command.output().with_context(hint)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{}: {}", hint(), said.lines().last().unwrap_or("it said nothing"));
    parse(&String::from_utf8_lossy(&output.stdout))
}

fn parse(text: &str) -> Result<Vec<Fitted>> {
    let fitted = |line: &str| {
        let Line { panorama, percentile, absolute, scale_invariant } =
            serde_json::from_str(line).with_context(|| format!("the fit said {line:?}"))?;
        Ok(Fitted { panorama, exposure: Exposure::Ldr(percentile), absolute, scale_invariant })
    };
    text.lines().filter(|line| !line.trim().is_empty()).map(fitted).collect()
}

/// NumPy's file format, version 1.0: single precision, rows of columns of R, G and B.
fn npy(map: &RadianceMap) -> Vec<u8> {
    let mut head = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}, 3), }}", map.height, map.width);
    // Magic, version and length take ten bytes, all of the head a multiple of 64, and it ends with its line.
    let padding = 63 - (head.len() + 10) % 64;
    let _ = writeln!(head, "{:padding$}", "");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((head.len() as u16).to_le_bytes());
    bytes.extend(head.as_bytes());
    bytes.extend(map.texels().iter().flat_map(glam::Vec3::to_array).flat_map(f32::to_le_bytes));
    bytes
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn a_panorama_becomes_what_numpy_reads() {
        for height in [2, 64, 1000] {
            let map = RadianceMap::of(height, |_| Vec3::new(1.0, 2.0, 3.0));
            let bytes = npy(&map);
            let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
            assert!((length + 10).is_multiple_of(64) && bytes[9 + length] == b'\n', "{length}");
            assert!(std::str::from_utf8(&bytes[10..10 + length]).unwrap().contains(&format!("({height}, {}, 3)", 2 * height)));
            assert_eq!(bytes.len() - 10 - length, 2 * height * height * 12);
            assert_eq!(bytes[10 + length..22 + length], [1.0f32, 2.0, 3.0].map(f32::to_le_bytes).concat());
        }
    }

    #[test]
    fn what_the_fit_says_is_read_and_a_python_that_is_not_there_is_named() {
        let text = "{\"panorama\": \"a\", \"percentile\": 99, \"absolute\": 0.05, \"scale_invariant\": 0.07}\n";
        let expected = Fitted { panorama: "a".to_owned(), exposure: Exposure::Ldr(99), absolute: 0.05, scale_invariant: 0.07 };
        assert_eq!(parse(text).unwrap(), [expected]);
        assert!(parse("Traceback").unwrap_err().to_string().contains("Traceback"));
        for wrong in ["/no/such/python", "/bin/false"] {
            let error = format!("{:#}", fit(Path::new(wrong), &[]).unwrap_err());
            assert!(error.contains(wrong) && error.contains("numpy"), "{error}");
        }
    }
}
