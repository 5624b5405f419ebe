//! The light of one video frame: a few directional lights and the spherical harmonics of the rest.

use glam::Vec3;
use serde::{Deserialize, Serialize};

mod blend;
mod wire;

pub use blend::SAME_LIGHT_COS;

/// Weights of relative luminance in linear BT.709 and of luma in BT.709 R'G'B' (ITU-R BT.709).
pub const LUMA: Vec3 = Vec3::new(0.2126, 0.7152, 0.0722);
/// Number of SH coefficients for bands 0–2.
pub const SH9: usize = 9;
/// Number of SH coefficients for bands 0–4.
pub const SH25: usize = 25;
/// Most lights a frame may carry.
pub const MAX_LIGHTS: usize = 64;
/// Largest radiance, coefficient or irradiance that crosses the wire: the largest finite half float.
pub const MAX_MAGNITUDE: f32 = 65_504.0;

/// A light at infinity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DirectionalLight {
    /// Stays with the light from frame to frame where the method follows lights (`directional`, `k-means`); elsewhere it is the rank in this
    /// frame and says nothing of other frames.
    pub id: u32,
    /// Unit vector towards the light.
    pub direction: Vec3,
    /// Irradiance on a surface that faces the light, RGB, radiance·sr.
    pub irradiance: Vec3,
    /// Solid angle, in (0, 4π].
    pub solid_angle_sr: f32,
}

/// Largest logarithm of a gain that a [`Recovery`] may ask for: what a camera clips is at most some hundred times as bright as what it shows.
pub const MAX_GAIN_LN: f32 = 6.0;
/// Largest slope of that logarithm over the unit sphere.
pub const MAX_GAIN_SLOPE: f32 = 16.0;
/// Largest logarithm of a channel of [`Recovery::tint_ln`] over green.
pub const MAX_TINT_LN: f32 = 0.7;

/// How the video's code values become the radiance that the lights and the SH were taken from; a client
/// applies the same curve to its own decoded video for reflections.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub enum Lift {
    /// The video's own transfer function inverted; nothing above display white is made up.
    #[default]
    Linear,
    /// Inverse tone map of Iorns & Rhee 2015, Eq. 1–3, on the code values.
    InverseToneMap,
    /// Linear, and clipped channels made as bright as the frame lets one expect.
    Recovered(Recovery),
}

/// What clipping took from a frame, as a curve: a channel clipped by a degree in [0, 1] adds its luminance, times that degree, times the gain
/// of its direction, in one colour for the whole frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Recovery {
    /// Natural logarithm of the gain, mean over the sphere.
    pub gain_ln: f32,
    /// Its slope: what the scalar product with a unit direction adds.
    pub slope: Vec3,
    /// Colour of what is added, as logarithms of red and blue over green, each at most [`MAX_TINT_LN`] from zero.
    pub tint_ln: [f32; 2],
}

impl Recovery {
    /// Gain in a unit direction.
    #[must_use]
    pub fn gain(&self, direction: Vec3) -> f32 {
        (self.gain_ln + self.slope.dot(direction)).min(MAX_GAIN_LN).exp()
    }
}

/// All light of one video frame. No part of it is in both: what becomes a light is taken out of what the SH are made of.
///
/// Together they hold the energy that the method takes the frame to have. That is the energy of the video under [`lift`](Self::lift), up to the
/// rounding of the wire, except where a method says otherwise:
///
/// - `directional` keeps what it has seen of a light while the light is clipped, moves some of what clipping took to where the sun or a lamp
///   most likely is, and smooths exposure and lights over time: a frame's energy is then that of the smoothed exposure, 2 % off within its
///   noise and more for a frame or two after a jump.
/// - `mr360` multiplies each light of LDR video by 0.5 to 1.5 according to its size, as its paper asks for, and leaves the SH as they are.
/// - `iorns` and `sh` have no lights, and low-order SH hold the mean exactly but not the detail.
#[derive(Debug, Clone, PartialEq)]
pub struct LightFrame {
    /// Presentation time of the video frame this belongs to, and of no other.
    pub pts_us: u64,
    /// Server clock when the frame was handed to the transport, in microseconds since the broadcast began.
    pub published_us: u64,
    /// How radiance was made from code values.
    pub lift: Lift,
    /// Radiance, real SH, [`SH9`] or [`SH25`] coefficients, not convolved.
    pub sh: Vec<Vec3>,
    /// Strongest first.
    pub lights: Vec<DirectionalLight>,
}

impl LightFrame {
    /// Brings what is finite but above [`MAX_MAGNITUDE`] down to it: each light by itself, the SH together, so that
    /// colours and the shape of the SH stay. Returns how many were held back, the SH counted as one. A frame that is
    /// somewhat too dim lights a scene better than the last one that did fit.
    pub fn hold_to_range(&mut self) -> usize {
        let hold = |values: &mut [&mut Vec3]| {
            let largest = values.iter().map(|value| value.abs().max_element()).fold(0.0, f32::max);
            let over = largest.is_finite() && largest > MAX_MAGNITUDE;
            if over {
                let range = Vec3::splat(MAX_MAGNITUDE);
                // The product may be an ulp above the bound.
                values.iter_mut().for_each(|value| **value = (**value * (MAX_MAGNITUDE / largest)).clamp(-range, range));
            }
            usize::from(over)
        };
        let lights: usize = self.lights.iter_mut().map(|light| hold(&mut [&mut light.irradiance])).sum();
        let mut sh: Vec<&mut Vec3> = self.sh.iter_mut().collect();
        lights + hold(&mut sh)
    }
}
