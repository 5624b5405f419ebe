//! RGB frames brought to a working panorama: decoded pixel by pixel and averaged as radiance, rows weighted by their solid angle.

use mr360_protocol::light::MAX_MAGNITUDE;
use mr360_protocol::video::StereoLayout;

use super::LightError;
use super::averages::Shares;
use super::radiance::{Planes, RadianceTable};
use super::sampling::Grid;

/// Left eye of an RGB frame.
pub(super) struct RgbView<'a> {
    texels: &'a [[f32; 3]],
    stride: usize,
    width: u32,
    height: u32,
}

impl<'a> RgbView<'a> {
    /// The left eye's view of these texels.
    ///
    /// # Errors
    /// For an empty frame, or texels that do not fill it.
    pub(super) fn new((width, height): (u32, u32), texels: &'a [[f32; 3]], stereo: StereoLayout) -> Result<Self, LightError> {
        let (eye_width, eye_height) = stereo.eye_size(width, height);
        if eye_width == 0 || eye_height == 0 {
            return Err(LightError::Empty { width, height });
        }
        if u64::from(width) * u64::from(height) != texels.len() as u64 {
            return Err(LightError::TexelCount { width, height, texels: texels.len() });
        }
        Ok(Self { texels, stride: width as usize, width: eye_width, height: eye_height })
    }

    fn row(&self, row: u32) -> &[[f32; 3]] {
        let first = row as usize * self.stride;
        self.texels.get(first..first + self.width as usize).unwrap_or_default()
    }
}

/// Buffers for sampling RGB frames; reused from frame to frame.
#[derive(Default)]
pub(super) struct RgbSampler {
    columns: Shares,
    /// One source row as radiance.
    decoded: Planes,
    /// The average of the source rows under one row of texels.
    averaged: Planes,
}

impl RgbSampler {
    /// Writes the radiance of row `row` of a panorama of this size into `out`; rows come in any order. Returns how many source values were
    /// mended.
    pub(super) fn take_row(&mut self, view: &RgbView<'_>, row: u32, size: Grid, table: &RadianceTable, out: [&mut [f32]; 3]) -> u64 {
        self.columns.fit(view.width, size.width);
        let mended = self.average_rows(view, row, size.height, table);
        self.averaged.iter().zip(out).for_each(|(averaged, out)| self.columns.average(averaged, out));
        mended
    }

    /// Averages the source rows under row `row` of `rows` into `averaged`, weighted by the solid angle that they
    /// share with it. Returns how many source values were mended.
    fn average_rows(&mut self, view: &RgbView<'_>, row: u32, rows: u32, table: &RadianceTable) -> u64 {
        for plane in self.averaged.iter_mut().chain(&mut self.decoded) {
            plane.clear();
            plane.resize(view.width as usize, 0.0);
        }
        let scale = f64::from(view.height) / f64::from(rows);
        let (start, end) = (f64::from(row) * scale, f64::from(row + 1) * scale);
        let height = |row: f64| ((0.5 - row / f64::from(view.height)) * std::f64::consts::PI).sin();
        let mut mended = 0;
        for source in start.floor() as u32..(end.ceil() as u32).min(view.height) {
            let (from, to) = (f64::from(source).max(start), f64::from(source + 1).min(end));
            let weight = ((height(from) - height(to)) / (height(start) - height(end))) as f32;
            let faults = self.decode_row(view.row(source), table);
            // A row shared by several rows of texels is counted in the one where it begins.
            mended += if from == f64::from(source) { faults } else { 0 };
            for (sum, decoded) in self.averaged.iter_mut().zip(&self.decoded) {
                sum.iter_mut().zip(decoded).for_each(|(sum, radiance)| *sum += weight * radiance);
            }
        }
        mended
    }

    fn decode_row(&mut self, source: &[[f32; 3]], table: &RadianceTable) -> u64 {
        let mut faults = 0;
        for (channel, plane) in self.decoded.iter_mut().enumerate() {
            for (out, texel) in plane.iter_mut().zip(source) {
                *out = mend(texel[channel], table.is_linear());
                faults += u64::from(*out != texel[channel]);
            }
        }
        table.decode(&mut self.decoded);
        faults
    }
}

/// A source value that can be light. Negative values are compression rings and not-a-number is no measurement:
/// both become 0. What is brighter than a client's half floats can show becomes the largest of them, infinity too.
fn mend(value: f32, linear: bool) -> f32 {
    // `max` and `min` return the number when the other side is none.
    value.max(0.0).min(if linear { MAX_MAGNITUDE } else { 1.0 })
}
