//! The floor under the time of every method.

use super::LightError;
use super::directional::SIZE;
use super::sampling::{Grid, VideoSampler, VideoView};
use crate::frame::{Frame, Pixels};

/// Reads every pixel of a video frame and averages its codes over the default's working panorama, and nothing else: no method, but what a
/// method's time is held against.
#[derive(Default)]
pub struct Averaging {
    video: VideoSampler,
}

impl Averaging {
    /// Averages the left eye's view of a video frame and returns the mean of its luma, in [0, 1], rows weighted alike; of frames of texels 0, they have no
    /// planes to average.
    ///
    /// # Errors
    /// For an empty frame, or a pixel format that ingest should have converted.
    pub fn take(&mut self, frame: &Frame) -> Result<f32, LightError> {
        let Pixels::Video(video, colour) = &frame.pixels else { return Ok(0.0) };
        let view = VideoView::new(video, *colour, frame.stereo)?;
        let grid = Grid { supersample: 1, ..SIZE };
        let mut sum = 0.0;
        for row in 0..grid.height {
            let codes = self.video.row(&view, row, grid, false);
            sum += codes.luma.iter().sum::<f32>();
        }
        let most = if colour.bit_depth == 10 { 1023.0 } else { 255.0 };
        Ok(sum / (grid.width * grid.height) as f32 / most)
    }
}

#[cfg(test)]
mod tests {
    use ffmpeg_next::format::Pixel;
    use mr360_protocol::video::{Colour, StereoLayout};

    use super::*;

    #[test]
    fn the_mean_is_that_of_every_pixel() {
        let mut video = ffmpeg_next::frame::Video::new(Pixel::YUV420P, 1280, 640);
        let mut expected = 0.0;
        for plane in 0..3 {
            let (stride, width) = (video.stride(plane), video.plane_width(plane) as usize);
            for (row, line) in video.data_mut(plane).chunks_mut(stride).enumerate() {
                line.iter_mut().enumerate().for_each(|(column, code)| *code = ((row * 7 + column * 13) % 219) as u8);
                if plane == 0 && row < 640 {
                    expected += line[..width].iter().map(|code| f64::from(*code)).sum::<f64>() / (1280.0 * 640.0 * 255.0);
                }
            }
        }
        let frame = Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Video(video, Colour::default()) };
        let got = Averaging::default().take(&frame).unwrap();
        assert!((f64::from(got) - expected).abs() < 1e-5, "{got} {expected}");
    }
}
