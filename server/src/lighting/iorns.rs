//! The method of Iorns & Rhee 2015: inverse tone map and a diffuse map, no lights. The paper's diffuse map of
//! 32×16 texels is carried here by the nine SH coefficients that make one.

use mr360_protocol::light::{Lift, SH9};

use super::panorama::Panorama;
use super::sampling::Grid;
use super::series::Series;
use super::{Estimate, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// The paper sums the diffuse map over a mip level of the tone-mapped frame. Blocks of 512×256 are tone-mapped
/// one by one and averaged to 64×32 texels, at which SH of bands 0–2 has converged.
const SIZE: Grid = Grid { width: 64, height: 32, supersample: 8 };

/// The paper's method; see the module.
pub struct Iorns {
    panorama: Panorama,
    series: Series,
    estimate: Estimate,
}

impl Default for Iorns {
    fn default() -> Self {
        Self { panorama: Panorama::new(SIZE, Lift::InverseToneMap), series: Series::new(SIZE, SH9), estimate: Estimate::default() }
    }
}

impl LightMethod for Iorns {
    fn name(&self) -> &'static str {
        "iorns"
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.panorama.take(frame))?;
        steps.time("sh", || self.estimate.project(&self.panorama, &self.series));
        Ok(&self.estimate)
    }
}

#[cfg(test)]
mod tests {
    use ffmpeg_next::format::Pixel;
    use mr360_protocol::video::{Colour, StereoLayout};

    use super::*;
    use crate::frame::Pixels;

    #[test]
    fn video_is_tone_mapped_at_512_columns() {
        // Columns of black and white: lifted one by one they give half of white's 11.8, averaged first 0.9.
        let mut video = ffmpeg_next::frame::Video::new(Pixel::YUV444P, 512, 256);
        for plane in 0..3 {
            let stride = video.stride(plane);
            for (at, code) in video.data_mut(plane).iter_mut().enumerate() {
                *code = if plane == 0 { 16 + 219 * (at % stride % 2) as u8 } else { 128 };
            }
        }
        let frame = Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Video(video, Colour::default()) };
        let mut method = Iorns::default();
        let estimate = method.estimate(&frame, &mut StepTimes::default()).unwrap();
        let mean = estimate.sh[0] / (4.0 * std::f32::consts::PI).sqrt();
        assert!((mean / 5.9 - 1.0).abs().max_element() < 4e-3, "{mean}");
    }
}
