//! Light that clipping took from an LDR frame, as far as the rest of the frame gives it away.
//!
//! A camera that shows a place well clips its sun, lamps and windows to display white. What they really held follows, within a factor of
//! three or so, from where they stand, how large they are, how bright their surroundings are and how bright the ground is beneath them:
//! [`excess`] makes of these four the logarithm of hidden over shown luminance, cell by cell. [`curve`] draws a smooth curve through the
//! cells, four numbers a frame, so that a viewer can lift its own copy of the video in the same way ([`Lift::Recovered`](mr360_protocol::light::Lift));
//! over thirty-five panoramas the irradiance of the curve is as near to the truth as that of the cells. A frame without clipped texels is left as it is, and true HDR
//! never comes here.
//!
//! How sure all this is, is said with it: [`Recovered::sigma`].

use mr360_protocol::light::{MAX_TINT_LN, Recovery};
use mr360_shaders::colour::{clipped_degree, luminance, recovery_tint};

use super::panorama::Panorama;
use super::sampling::Grid;

mod blur;
mod cells;
mod curve;
mod excess;
#[cfg(test)]
mod tests;

use blur::Blur;
use cells::Cells;
use excess::Surroundings;

/// Half widths of the blurs, degrees: the rim of a clipped region; its size; its surroundings.
const RIM_DEG: f32 = 2.8;
const SIZE_DEG: f32 = 8.4;
const SURROUNDINGS_DEG: f32 = 22.5;
/// Share of blue's contrast to green on the rim that what is hidden has; red has all of it.
const BLUE_SHARE: f32 = 0.7;

/// What was recovered.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Recovered {
    /// The curve by which the panorama was lifted.
    pub(super) curve: Recovery,
    /// Luminous flux added, as a share of all that there is now.
    pub(super) hidden_share: f32,
    /// Standard deviation of the logarithm of that flux.
    pub(super) sigma: f32,
}

/// Recovers frame after frame of one size without allocating.
pub(super) struct Recoverer {
    cells: Cells,
    blur: Blur,
    size: Vec<f32>,
    rim: Vec<f32>,
    shown: Vec<f32>,
    open: Vec<f32>,
    excess_ln: Vec<f32>,
}

impl Recoverer {
    /// For panoramas of this size.
    pub(super) fn new(size: Grid) -> Self {
        let cells = Cells::new(size);
        let count = cells.columns * cells.rows;
        let field = || vec![0.0; count];
        Self {
            blur: Blur::new(cells.columns, &cells.solid_angle_sr, &cells.latitude),
            size: field(),
            rim: field(),
            shown: field(),
            open: field(),
            excess_ln: field(),
            cells,
        }
    }

    /// Brightens the clipped texels of a linear panorama, whose display white is 1. None when there are none.
    pub(super) fn recover(&mut self, panorama: &mut Panorama) -> Option<Recovered> {
        self.cells.take(panorama);
        if self.cells.clipped_sr <= 0.0 {
            return None;
        }
        self.describe();
        let cells = &self.cells;
        let tint_ln = self.tint_ln();
        let (gain_ln, slope) = curve::through(&self.excess_ln, &cells.clipped_flux, &cells.directions);
        let curve = Recovery { gain_ln, slope, tint_ln };
        let hidden = self.brighten(panorama, &curve);
        let hidden_share = (hidden / (hidden + self.cells.flux)) as f32;
        let clipped_share = (self.cells.clipped_sr / (4.0 * std::f64::consts::PI)) as f32;
        Some(Recovered { curve, hidden_share, sigma: excess::sigma(self.cells.ground_ln(), clipped_share, hidden_share) })
    }

    /// Degree to which each texel of the last panorama is clipped in all channels, in [0, 1].
    pub(super) fn clipped(&self) -> &[f32] {
        &self.cells.clipped
    }

    /// Logarithm of hidden over shown luminance of every cell that holds any clipped texel.
    fn describe(&mut self) {
        let cells = &self.cells;
        self.blur.run(&cells.clipped_share, SIZE_DEG, &mut self.size);
        self.blur.run(&cells.clipped_share, RIM_DEG, &mut self.rim);
        self.blur.run(&cells.shown, SURROUNDINGS_DEG, &mut self.shown);
        self.blur.run(&cells.open_share, SURROUNDINGS_DEG, &mut self.open);
        let ground_ln = cells.ground_ln();
        for (cell, excess_ln) in self.excess_ln.iter_mut().enumerate() {
            if cells.clipped_flux[cell] > 0.0 {
                let surroundings = Surroundings {
                    size: self.size[cell],
                    height: cells.directions[cell].y,
                    ground_ln,
                    brightness_ln: excess::brightness_ln(self.shown[cell], self.open[cell]),
                };
                *excess_ln = excess::excess_ln(&surroundings);
            }
        }
    }

    /// Colour of what is hidden: that of the rim of the clipped regions, where lens and sensor spread their light.
    fn tint_ln(&self) -> [f32; 2] {
        let sum = |channel: usize| {
            let weighted = self.cells.open_rgb[channel].iter().zip(&self.rim).map(|(energy, rim)| f64::from(energy * rim));
            (weighted.sum::<f64>() + excess::LEAST_RIM) as f32
        };
        let [red, green, blue] = [0, 1, 2].map(sum);
        [((red / green).ln(), 1.0), ((blue / green).ln(), BLUE_SHARE)].map(|(ln, share)| share * ln.clamp(-MAX_TINT_LN, MAX_TINT_LN))
    }

    /// Adds what the curve says; returns the luminous flux added. The curve is read once a cell: over its 2.8° the error of that averages out.
    fn brighten(&self, panorama: &mut Panorama, curve: &Recovery) -> f64 {
        let tint = recovery_tint(curve);
        let cells = &self.cells;
        let width = panorama.size.width as usize;
        let mut hidden = 0.0;
        for (cell, _) in cells.clipped_flux.iter().enumerate().filter(|(_, flux)| **flux > 0.0) {
            let gain = curve.gain(cells.directions[cell]);
            let (row, column) = (cell / cells.columns * cells.side, cell % cells.columns * cells.side);
            for row in row..row + cells.side {
                let solid_angle_sr = f64::from(panorama.geometry.solid_angle_sr[row]);
                for texel in row * width + column..row * width + column + cells.side {
                    let radiance = panorama.radiance(texel);
                    let added = luminance(radiance * clipped_degree(radiance)) * gain;
                    hidden += f64::from(added) * solid_angle_sr;
                    panorama.set_radiance(texel, radiance + added * tint);
                }
            }
        }
        hidden
    }
}
