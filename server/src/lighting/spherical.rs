//! Spherical harmonics alone, of display-linear radiance: the floor that any method with lights has to beat.

use mr360_protocol::light::Lift;

use super::panorama::Panorama;
use super::sampling::Grid;
use super::series::Series;
use super::{Estimate, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// Averaging over texels of 2.8° takes 0.2 % off band 4 and 0.06 % off band 2.
pub(super) const SIZE: Grid = Grid { width: 128, height: 64, supersample: 4 };

/// The method; see the module.
pub(super) struct SphericalHarmonics {
    name: String,
    panorama: Panorama,
    series: Series,
    estimate: Estimate,
}

impl SphericalHarmonics {
    /// Bands 0 to 2 for 9 coefficients, 0 to 4 for 25.
    pub(super) fn new(coefficients: usize) -> Self {
        Self::with_size(SIZE, coefficients)
    }

    /// On a working panorama of another size, twice as wide as high; see [`super::MethodSpec::make_at`].
    pub(super) fn with_size(size: Grid, coefficients: usize) -> Self {
        Self {
            name: format!("sh:{coefficients}"),
            panorama: Panorama::new(size, Lift::Linear),
            series: Series::new(size, coefficients),
            estimate: Estimate::default(),
        }
    }
}

impl LightMethod for SphericalHarmonics {
    fn name(&self) -> &str {
        &self.name
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.panorama.take(frame))?;
        steps.time("sh", || self.estimate.project(&self.panorama, &self.series));
        Ok(&self.estimate)
    }
}
