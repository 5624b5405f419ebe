//! The light of a frame: a few directional lights and the spherical harmonics of the rest.
//!
//! Every method begins with a small linear working panorama, the lift applied. Some take lights out of it and leave the
//! rest to SH, some know only lights or only SH: lights plus SH hold the panorama's energy in any case. [`MethodSpec`]
//! names them all.

use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift, SH25};

use crate::frame::Frame;

mod averages;
mod bright;
mod brightest;
mod candidates;
mod cells;
mod clipped;
#[cfg(test)]
mod clipped_forms;
#[cfg(test)]
mod closed_forms;
mod cuts;
mod directional;
mod elementary;
#[cfg(test)]
mod every_method;
#[cfg(test)]
mod every_method_over_time;
mod floor;
mod iorns;
mod kmeans;
mod light_sum;
mod luminance;
mod mr360;
mod panorama;
#[cfg(test)]
mod paper_forms;
mod radiance;
mod recovery;
mod regions;
mod rgb;
#[cfg(test)]
mod ringing;
mod sampling;
pub mod sequences;
mod series;
mod spec;
mod spherical;
#[cfg(test)]
mod stability;
mod steps;
mod taps;
#[cfg(test)]
mod test_skies;
mod track;
mod transpose;
mod vectors;

pub use directional::{Directional, MOST_LIGHTS};
pub use floor::Averaging;
pub use iorns::Iorns;
pub use mr360::Mr360;
pub use spec::{MethodError, MethodSpec};
pub use steps::StepTimes;

use panorama::Panorama;
use series::Series;

/// Light of one frame, before it has a time.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Estimate {
    /// The lift that was applied: the method's own, or none where the frame was true HDR.
    pub lift: Lift,
    /// Radiance outside the lights, real SH, 9 or 25 coefficients, not convolved.
    pub sh: Vec<Vec3>,
    /// Strongest first; `id` is the rank in this frame, or stays with the light where the method follows it.
    pub lights: Vec<DirectionalLight>,
    /// What the method made up for clipping; none where nothing was clipped or the method recovers nothing.
    pub hidden: Option<Hidden>,
    /// Source values that were not finite, negative or too large to be light and were mended.
    pub mended: u64,
}

/// Light that clipping took and the method estimated.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Hidden {
    /// Its share of the luminous flux of the whole frame, in [0, 1).
    pub share: f32,
    /// Standard deviation of the natural logarithm of its flux.
    pub sigma: f32,
}

impl Estimate {
    /// Takes over what the panorama holds once its lights are out.
    fn project(&mut self, panorama: &Panorama, series: &Series) {
        let mut sh = [Vec3::ZERO; SH25];
        let sh = &mut sh[..series.coefficients()];
        series.project(panorama, sh);
        self.take_over(panorama, sh);
    }

    /// Takes over these coefficients and what the panorama knows of its frame.
    fn take_over(&mut self, panorama: &Panorama, sh: &[Vec3]) {
        self.sh.clear();
        self.sh.extend_from_slice(sh);
        (self.lift, self.hidden) = (panorama.lift(), None);
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
    /// What selects the method, parameter included: its [`MethodSpec`] in words.
    fn name(&self) -> &str;

    /// Estimates the light of `frame` and adds the time of each step to `steps`.
    ///
    /// # Errors
    /// [`LightError`] for a frame that cannot be read; the next frame may be fine.
    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError>;
}
