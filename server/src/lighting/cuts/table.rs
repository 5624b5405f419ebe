//! Summed-area table of light and of the directions that it comes from.

use glam::DVec3;
use mr360_shaders::colour::LUMA;

use crate::lighting::panorama::Panorama;

/// Part of a panorama: rows `top..bottom`, columns `left..right`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Rectangle {
    pub(super) top: usize,
    pub(super) bottom: usize,
    pub(super) left: usize,
    pub(super) right: usize,
}

/// Light of some texels.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Moments {
    /// Luminance times solid angle.
    pub(super) energy: f64,
    /// Directions weighted by it.
    pub(super) moment: DVec3,
}

impl Moments {
    /// Σ w |d − c|² about the centroid c = Σ w d / Σ w of the directions d: as they have length 1, Σ w − |Σ w d|² / Σ w.
    pub(super) fn variance(&self) -> f64 {
        if self.energy > 0.0 { (self.energy - self.moment.length_squared() / self.energy).max(0.0) } else { 0.0 }
    }
}

/// The table; the buffer is reused.
#[derive(Default)]
pub(super) struct SummedArea {
    /// Energy and moment of all texels above and left of a corner, (columns + 1) × (rows + 1) corners.
    corners: Vec<[f64; 4]>,
    stride: usize,
}

impl SummedArea {
    /// Fills the table from a panorama.
    pub(super) fn fill(&mut self, panorama: &Panorama) {
        let (width, height) = (panorama.size.width as usize, panorama.size.height as usize);
        let geometry = &panorama.geometry;
        let [sin_longitude, cos_longitude] = &geometry.sin_cos_longitude;
        self.stride = width + 1;
        self.corners.resize(self.stride * (height + 1), [0.0; 4]);
        for row in 0..height {
            let (above, below) = self.corners[row * self.stride..(row + 2) * self.stride].split_at_mut(self.stride);
            let (sin_latitude, cos_latitude) = geometry.sin_cos_latitude[row];
            let (y, c) = (f64::from(sin_latitude), f64::from(cos_latitude));
            let luma = LUMA * geometry.solid_angle_sr[row];
            let [red, green, blue] = [0, 1, 2].map(|channel| panorama.row(channel, row));
            // Energy, and energy times the sine and the cosine of the longitude.
            let mut running = [0.0f64; 3];
            below[0] = [0.0; 4];
            let texels = red.iter().zip(green).zip(blue).zip(sin_longitude).zip(cos_longitude);
            for (((((r, g), b), sin), cos), (above, below)) in texels.zip(above[1..].iter().zip(&mut below[1..])) {
                let energy = f64::from(luma.x * r + luma.y * g + luma.z * b);
                running[0] += energy;
                running[1] += energy * f64::from(*sin);
                running[2] += energy * f64::from(*cos);
                *below = [above[0] + running[0], above[1] + c * running[1], above[2] + y * running[0], above[3] - c * running[2]];
            }
        }
    }

    /// Light within a rectangle, good to 1e-12 of the whole panorama's.
    pub(super) fn sum(&self, rectangle: Rectangle) -> Moments {
        let corner = |row: usize, column: usize| self.corners[row * self.stride + column];
        let Rectangle { top, bottom, left, right } = rectangle;
        let (a, b, c, d) = (corner(bottom, right), corner(top, right), corner(bottom, left), corner(top, left));
        let [energy, x, y, z] = std::array::from_fn(|i| (a[i] - b[i]) - (c[i] - d[i]));
        Moments { energy, moment: DVec3::new(x, y, z) }
    }
}
