//! The light of a frame: a few directional lights and the spherical harmonics of the rest.
//!
//! Every method goes the same way: a small linear working panorama (the lift applied), a threshold, regions,
//! lights taken out of the panorama, SH of what is left. Lights plus SH hold the panorama's energy.

use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift, SH9};

use crate::frame::Frame;

mod candidates;
#[cfg(test)]
mod closed_forms;
mod directional;
mod harmonics;
mod iorns;
mod mr360;
mod panorama;
mod radiance;
mod recovery;
mod regions;
mod sampling;
pub mod sequences;
#[cfg(test)]
mod stability;
mod steps;
mod track;

pub use directional::{Directional, MOST_LIGHTS};
pub use iorns::Iorns;
pub use mr360::Mr360;
pub use steps::StepTimes;

use panorama::Panorama;

/// Light of one frame, before it has a time.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Estimate {
    /// The lift that was applied: the method's own, or none where the frame was true HDR.
    pub lift: Lift,
    /// Radiance outside the lights, real SH, 9 coefficients, not convolved.
    pub sh: Vec<Vec3>,
    /// Strongest first; `id` is the rank in this frame, or lasts from frame to frame where the method follows lights.
    pub lights: Vec<DirectionalLight>,
    /// Source values that were not finite, negative or too large to be light and were mended.
    pub mended: u64,
}

impl Estimate {
    /// Takes over what the panorama holds once its lights are out.
    fn project(&mut self, panorama: &Panorama, projection: fn(&Panorama, &mut [Vec3; SH9])) {
        let mut sh = [Vec3::ZERO; SH9];
        projection(panorama, &mut sh);
        self.sh.clear();
        self.sh.extend_from_slice(&sh);
        self.lift = panorama.lift();
        self.mended = panorama.mended;
    }
}

/// Why a frame has no light.
#[derive(Debug, thiserror::Error)]
pub enum LightError {
    /// The frame has a layout that the sampler does not read.
    #[error("decoded frame: pixel format {format} is not planar YUV of 8 or 10 bits; convert it to yuv420p before lighting")]
    UnsupportedPixels {
        /// FFmpeg's name of the format.
        format: String,
    },
    /// The frame's colour contradicts its pixel format.
    #[error("decoded frame: pixel format {format} does not hold {bit_depth}-bit samples; describe its colour by its own bit depth")]
    BitDepth {
        /// FFmpeg's name of the format.
        format: String,
        /// Bits a sample according to the colour.
        bit_depth: u8,
    },
    /// One eye's view has no pixels.
    #[error("decoded frame: {width}×{height} leaves no pixels for the left eye; check the stereo layout")]
    Empty {
        /// Columns of the whole frame.
        width: u32,
        /// Rows of the whole frame.
        height: u32,
    },
    /// The texels do not fill the frame.
    #[error("decoded frame: {texels} texels do not fill {width}×{height}; give one texel a pixel")]
    TexelCount {
        /// Columns of the whole frame.
        width: u32,
        /// Rows of the whole frame.
        height: u32,
        /// Texels present.
        texels: usize,
    },
}

/// A way to find the light of a frame. Methods keep their buffers: frames after the first of a size and colour
/// are estimated without allocating.
pub trait LightMethod: Send {
    /// The name that selects the method.
    fn name(&self) -> &'static str;

    /// How the method lifts LDR video; HDR video is used as it is, see [`Estimate::lift`].
    fn lift(&self) -> Lift;

    /// Estimates the light of `frame` and adds the time of each step to `steps`.
    ///
    /// # Errors
    /// [`LightError`] for a frame that cannot be read; the next frame may be fine.
    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError>;
}

/// Names of all methods.
pub const METHODS: [&str; 3] = ["directional", "mr360", "iorns"];
/// The method that runs unless another is asked for.
pub const DEFAULT_METHOD: &str = "directional";

/// No method of that name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("light method {name:?} is unknown; use one of {}", METHODS.join(", "))]
pub struct UnknownMethod {
    /// The name that was asked for.
    pub name: String,
}

/// Makes the method of this name.
///
/// # Errors
/// [`UnknownMethod`], which lists the names.
pub fn method(name: &str) -> Result<Box<dyn LightMethod>, UnknownMethod> {
    match name {
        "directional" => Ok(Box::new(Directional::default())),
        "mr360" => Ok(Box::new(Mr360::default())),
        "iorns" => Ok(Box::new(Iorns::default())),
        _ => Err(UnknownMethod { name: name.to_owned() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_listed_method_exists_under_its_name() {
        for name in METHODS {
            assert_eq!(method(name).unwrap().name(), name);
        }
        assert!(METHODS.contains(&DEFAULT_METHOD));
        let error = method("magic").err().unwrap().to_string();
        assert!(METHODS.iter().all(|name| error.contains(name)), "{error}");
    }
}
