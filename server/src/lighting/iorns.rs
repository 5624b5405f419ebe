//! The method of Iorns & Rhee 2015: inverse tone map and a diffuse map, no lights. The paper's diffuse map of
//! 32×16 texels is carried here by the nine SH coefficients that make one.

use mr360_protocol::light::Lift;

use super::harmonics::project9;
use super::panorama::Panorama;
use super::sampling::Grid;
use super::{Estimate, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// The paper sums the diffuse map over a mip level of the tone-mapped frame. Blocks of 512×256 are tone-mapped
/// one by one and averaged to 64×32 texels, at which SH of bands 0–2 has converged.
const SIZE: Grid = Grid { width: 64, height: 32, supersample: 8 };

/// The paper's method; see the module.
pub struct Iorns {
    panorama: Panorama,
    estimate: Estimate,
}

impl Default for Iorns {
    fn default() -> Self {
        Self { panorama: Panorama::new(SIZE, Lift::InverseToneMap), estimate: Estimate::default() }
    }
}

impl LightMethod for Iorns {
    fn name(&self) -> &'static str {
        "iorns"
    }

    fn lift(&self) -> Lift {
        Lift::InverseToneMap
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.panorama.take(frame))?;
        steps.time("sh", || self.estimate.project(&self.panorama, project9));
        Ok(&self.estimate)
    }
}
