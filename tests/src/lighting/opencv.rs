//! The paper's method (Rhee et al. 2017) written with OpenCV, as a process that is raced with our methods.
//!
//! `tests/peers/opencv_mr360.py` says how it works and what it is asked for.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};
use mr360_protocol::light::Lift;

use super::peer::{Introduction, Peer};

/// Travels inside this program, so that it works wherever the program lies.
const SCRIPT: &str = include_str!("../../peers/opencv_mr360.py");

/// Name in tables.
pub(super) const NAME: &str = "opencv-mr360";

/// Starts it with a Python that has NumPy and OpenCV.
///
/// # Errors
/// When Python does not start, or lacks one of them.
pub(super) fn start(python: &Path) -> Result<Peer> {
    let mut command = Command::new(python);
    // One thread for everything that NumPy and OpenCV might spread over several.
    command.args(["-c", SCRIPT]).env("OMP_NUM_THREADS", "1").env("OPENBLAS_NUM_THREADS", "1");
    let introduction = Introduction { name: NAME, lift: Lift::InverseToneMap, reads_radiance: false };
    Peer::start(introduction, &mut command)
        .with_context(|| format!("--python {}: wants a Python with numpy and opencv-contrib-python-headless", python.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_python_that_is_not_there_or_no_python_is_named() {
        for wrong in ["/no/such/python", "/bin/false"] {
            let error = format!("{:#}", start(Path::new(wrong)).err().unwrap());
            assert!(error.contains(wrong) && error.contains("--python") && error.contains("opencv-contrib-python-headless"), "{error}");
        }
    }
}
