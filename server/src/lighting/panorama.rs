//! The working panorama: a small linear map of the whole sphere, made from a frame by area averaging.
//!
//! RGB frames are decoded pixel by pixel and averaged as radiance, rows weighted by their solid angle: linear input
//! keeps its energy exactly. For video that would cost many times the rest of the estimate, so codes are averaged first
//! and become radiance afterwards. The mean of a convex curve is above the curve of the mean: averaging 2×2 pixels of sixteen
//! 512×256 panoramas before decoding them took 0.5 to 26 % off their irradiance, 4 % in the median, with white at the 95th
//! percentile and a steep lift. Display-referred video that is not lifted is nearly a square law, for which mean
//! and variance of the codes are enough ([`RadianceTable::decode_means`]). Steeper curves, of a lift or of PQ and HLG,
//! have each texel made of `supersample`² blocks which are decoded one by one.

use std::f32::consts::TAU;

use glam::Vec3;
use mr360_protocol::light::Lift;
use mr360_protocol::video::Colour;
use mr360_shaders::equirect::pixel_solid_angle_sr;

use super::LightError;
use super::radiance::{Planes, RadianceTable};
use super::rgb::{RgbSampler, RgbView};
use super::sampling::{Grid, VideoSampler, VideoView};
use crate::frame::{Frame, Pixels};

/// Blocks in either direction whose decoding one by one is no better than decoding their mean and variance at once.
const BLOCKS_IN_MEANS: u32 = 2;

/// Directions and solid angles of a working panorama's texels, by row and by column.
pub(super) struct Geometry {
    /// Solid angle of one texel of each row.
    pub(super) solid_angle_sr: Vec<f32>,
    /// Latitude φ at each row's centre.
    pub(super) latitude: Vec<f32>,
    /// (sin φ, cos φ) at each row's centre.
    pub(super) sin_cos_latitude: Vec<(f32, f32)>,
    /// Longitude λ at each column's centre.
    pub(super) longitude: Vec<f32>,
    /// sin λ and cos λ at each column's centre.
    pub(super) sin_cos_longitude: [Vec<f32>; 2],
}

impl Geometry {
    /// Geometry of a panorama of this size.
    pub(super) fn new(size: Grid) -> Self {
        let (width, height) = (size.width, size.height);
        let longitude: Vec<f32> = (0..width).map(|i| ((i as f32 + 0.5) / width as f32 - 0.5) * TAU).collect();
        let latitude: Vec<f32> = (0..height).map(|j| (0.5 - (j as f32 + 0.5) / height as f32) * TAU / 2.0).collect();
        let of_longitude = |f: fn(f32) -> f32| longitude.iter().map(|l| f(*l)).collect();
        Self {
            solid_angle_sr: (0..height).map(|row| pixel_solid_angle_sr(row, width, height)).collect(),
            sin_cos_latitude: latitude.iter().map(|l| l.sin_cos()).collect(),
            sin_cos_longitude: [of_longitude(f32::sin), of_longitude(f32::cos)],
            latitude,
            longitude,
        }
    }

    /// Unit direction of a texel's centre.
    pub(super) fn direction(&self, row: usize, column: usize) -> Vec3 {
        let (sin_latitude, cos_latitude) = self.sin_cos_latitude[row];
        Vec3::new(cos_latitude * self.sin_cos_longitude[0][column], sin_latitude, -cos_latitude * self.sin_cos_longitude[1][column])
    }
}

/// Rows of texels that were just made and are in the cache still.
pub(super) struct Rows<'a> {
    /// Of the whole panorama.
    pub(super) geometry: &'a Geometry,
    /// Whether they are true HDR.
    pub(super) hdr: bool,
    /// The first one.
    pub(super) first: usize,
    /// How many there are.
    pub(super) count: usize,
    /// Their radiance.
    channels: [&'a [f32]; 3],
}

impl Rows<'_> {
    /// One channel of all of them.
    #[inline(always)]
    pub(super) fn channel(&self, channel: usize) -> &[f32] {
        self.channels[channel]
    }

    /// One channel of the row with this index in the panorama.
    #[inline(always)]
    pub(super) fn row(&self, channel: usize, row: usize) -> &[f32] {
        let (width, row) = (self.width(), row - self.first);
        &self.channels[channel][row * width..(row + 1) * width]
    }

    /// Texels in a row.
    #[inline(always)]
    pub(super) fn width(&self) -> usize {
        self.geometry.longitude.len()
    }
}

/// A linear panorama of fixed size, refilled from frame to frame without allocating.
pub(super) struct Panorama {
    /// Its size.
    pub(super) size: Grid,
    /// Where its texels look.
    pub(super) geometry: Geometry,
    /// Radiance, row by row from the top; finite and not negative. Rows that are not kept hold nothing.
    pub(super) channels: Planes,
    /// Rows of LDR video from here on are shown once and not kept.
    kept: usize,
    /// The same of the last frame, whatever it was.
    kept_of_frame: usize,
    /// Rows that are not kept, as many as are shown at once.
    passing: Planes,
    /// Source values of the last frame that were not finite, negative or too large to be light.
    pub(super) mended: u64,
    lift: Lift,
    table: RadianceTable,
    video: VideoSampler,
    /// Codes, then radiance, of one row of blocks of a video frame.
    blocks: Planes,
    rgb: RgbSampler,
}

impl Panorama {
    /// An empty panorama that applies `lift` to LDR frames.
    pub(super) fn new(size: Grid, lift: Lift) -> Self {
        let texels = size.width as usize * size.height as usize;
        Self {
            size,
            geometry: Geometry::new(size),
            channels: std::array::from_fn(|_| vec![0.0; texels]),
            kept: size.height as usize,
            kept_of_frame: size.height as usize,
            passing: Planes::default(),
            mended: 0,
            lift,
            table: RadianceTable::new(lift, Colour::default()),
            video: VideoSampler::default(),
            blocks: Planes::default(),
            rgb: RgbSampler::default(),
        }
    }

    /// Keeps the upper half alone of LDR video: what is written and not read again pushes out of the caches what is needed there.
    pub(super) fn keep_upper_half(mut self) -> Self {
        self.kept = self.size.height as usize / 2;
        self
    }

    /// The lift that the last frame was given; HDR frames are given none.
    pub(super) fn lift(&self) -> Lift {
        self.table.lift()
    }

    /// Whether the last frame was true HDR.
    pub(super) fn is_hdr(&self) -> bool {
        self.table.is_hdr()
    }

    /// One row of a channel.
    pub(super) fn row(&self, channel: usize, row: usize) -> &[f32] {
        let width = self.size.width as usize;
        &self.channels[channel][row * width..(row + 1) * width]
    }

    /// How many rows of the last frame are kept.
    pub(super) fn kept_rows(&self) -> usize {
        self.kept_of_frame
    }

    /// Rows from `first` on.
    pub(super) fn rows(&self, first: usize, count: usize) -> Rows<'_> {
        let width = self.size.width as usize;
        let channels = if first < self.kept_of_frame {
            self.channels.each_ref().map(|channel| &channel[first * width..(first + count) * width])
        } else {
            self.passing.each_ref().map(|channel| &channel[..count * width])
        };
        Rows { geometry: &self.geometry, hdr: self.is_hdr(), first, count, channels }
    }

    /// Radiance of the texel with this index.
    pub(super) fn radiance(&self, texel: usize) -> Vec3 {
        Vec3::new(self.channels[0][texel], self.channels[1][texel], self.channels[2][texel])
    }

    /// Sets the radiance of the texel with this index.
    pub(super) fn set_radiance(&mut self, texel: usize, radiance: Vec3) {
        for (channel, value) in self.channels.iter_mut().zip(radiance.to_array()) {
            channel[texel] = value;
        }
    }

    /// Takes in the left eye's view of a frame.
    ///
    /// # Errors
    /// For an empty frame, a pixel format that ingest should have converted, or texels that do not fill the frame.
    pub(super) fn take(&mut self, frame: &Frame) -> Result<(), LightError> {
        self.take_by_rows(frame, self.size.height as usize, |_| {})
    }

    /// The same, and shows every `count` rows to `see` as soon as they are there; the panorama's height, and that of what is kept of it, are multiples of that.
    ///
    /// # Errors
    /// As [`Panorama::take`].
    pub(super) fn take_by_rows(&mut self, frame: &Frame, count: usize, see: impl FnMut(&Rows<'_>)) -> Result<(), LightError> {
        self.mended = 0;
        match &frame.pixels {
            Pixels::Video(video, colour) => {
                let view = VideoView::new(video, *colour, frame.stereo)?;
                self.prepare(*colour);
                self.kept_of_frame = if self.is_hdr() { self.size.height as usize } else { self.kept };
                self.take_video(&view, count, see);
            }
            Pixels::Rgb { width, height, texels, transfer } => {
                let view = RgbView::new((*width, *height), texels, frame.stereo)?;
                self.prepare(Colour { transfer: *transfer, ..Colour::default() });
                self.kept_of_frame = self.size.height as usize;
                self.take_rgb(&view, count, see);
            }
        }
        Ok(())
    }

    fn prepare(&mut self, colour: Colour) {
        if !self.table.is_for(self.lift, colour) {
            self.table = RadianceTable::new(self.lift, colour);
        }
    }

    fn take_video(&mut self, view: &VideoView<'_>, count: usize, mut see: impl FnMut(&Rows<'_>)) {
        let means = self.table.knows_means();
        let supersample = if means { self.size.supersample.div_ceil(BLOCKS_IN_MEANS) } else { self.size.supersample };
        let grid = Grid { supersample, ..self.size };
        let (width, supersample) = (grid.width as usize, supersample as usize);
        let kept = self.kept_of_frame;
        self.blocks.iter_mut().for_each(|plane| plane.resize(width * supersample, 0.0));
        if kept < grid.height as usize {
            self.passing.iter_mut().for_each(|plane| plane.resize(width * count, 0.0));
        }
        for block_row in 0..grid.height * grid.supersample {
            let codes = self.video.row(view, block_row, grid, means);
            let (row, part) = (block_row as usize / supersample, block_row as usize % supersample);
            let (planes, place) = if row < kept { (&mut self.channels, row) } else { (&mut self.passing, row % count) };
            let mut texels = planes.each_mut().map(|channel| &mut channel[place * width..(place + 1) * width]);
            if means && supersample == 1 {
                self.table.decode_means(&codes, texels);
            } else {
                if means {
                    self.table.decode_means(&codes, self.blocks.each_mut().map(|plane| &mut plane[..]));
                } else {
                    codes.write(&mut self.blocks);
                    self.table.decode(&mut self.blocks);
                }
                texels.iter_mut().zip(&self.blocks).for_each(|(texels, blocks)| gather(texels, blocks, supersample, part == 0));
            }
            if part + 1 == supersample && (row + 1).is_multiple_of(count) {
                see(&self.rows(row + 1 - count, count));
            }
        }
    }

    fn take_rgb(&mut self, view: &RgbView<'_>, count: usize, mut see: impl FnMut(&Rows<'_>)) {
        let width = self.size.width as usize;
        for row in 0..self.size.height as usize {
            let texels = row * width..(row + 1) * width;
            let out = self.channels.each_mut().map(|channel| &mut channel[texels.clone()]);
            self.mended += self.rgb.take_row(view, row as u32, self.size, &self.table, out);
            if (row + 1).is_multiple_of(count) {
                see(&self.rows(row + 1 - count, count));
            }
        }
    }
}

/// Adds a row of blocks to a row of texels, `supersample` blocks a texel.
fn gather(texels: &mut [f32], blocks: &[f32], supersample: usize, first: bool) {
    if first {
        texels.fill(0.0);
    }
    let share = 1.0 / (supersample * supersample) as f32;
    match supersample {
        1 => texels.copy_from_slice(blocks),
        2 => texels.iter_mut().zip(blocks.chunks_exact(2)).for_each(|(texel, pair)| *texel += (pair[0] + pair[1]) * share),
        n => texels.iter_mut().zip(blocks.chunks_exact(n)).for_each(|(texel, run)| *texel += run.iter().sum::<f32>() * share),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ffmpeg_next::format::Pixel;
    use mr360_protocol::light::MAX_MAGNITUDE;
    use mr360_protocol::video::{Matrix, Primaries, StereoLayout, Transfer};

    const SIZE: Grid = Grid { width: 16, height: 8, supersample: 1 };

    fn rgb(width: u32, height: u32, transfer: Transfer, texel: impl Fn(u32, u32) -> [f32; 3]) -> Frame {
        let texels = (0..height).flat_map(|j| (0..width).map(move |i| (i, j))).map(|(i, j)| texel(i, j)).collect();
        Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Rgb { width, height, texels, transfer } }
    }

    /// A video frame whose planes hold `code(plane, x, y)`.
    fn video(format: Pixel, width: u32, height: u32, colour: Colour, code: impl Fn(usize, u32, u32) -> u16) -> Frame {
        let mut video = ffmpeg_next::frame::Video::new(format, width, height);
        for plane in 0..3 {
            let (stride, columns, rows) = (video.stride(plane), video.plane_width(plane), video.plane_height(plane));
            let wide = colour.bit_depth == 10;
            for (x, y) in (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y))) {
                let value = code(plane, x, y).to_le_bytes();
                let at = y as usize * stride + x as usize * if wide { 2 } else { 1 };
                video.data_mut(plane)[at] = value[0];
                if wide {
                    video.data_mut(plane)[at + 1] = value[1];
                }
            }
        }
        Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Video(video, colour) }
    }

    fn taken(frame: &Frame, lift: Lift, supersample: u32) -> Panorama {
        let mut panorama = Panorama::new(Grid { supersample, ..SIZE }, lift);
        panorama.take(frame).unwrap();
        panorama
    }

    #[test]
    fn linear_input_keeps_its_energy_at_any_size() {
        for (width, height) in [(64, 32), (37, 19), (7, 5), (1, 1)] {
            let texel = |i: u32, j: u32| if (i, j) == (width / 3, height / 4) { [6e4, 5.0, 1.0] } else { [0.1, 0.2, 0.3] };
            let panorama = taken(&rgb(width, height, Transfer::Linear, texel), Lift::InverseToneMap, 2);
            for channel in 0..3 {
                let truth: f64 = (0..height)
                    .flat_map(|j| (0..width).map(move |i| (i, j)))
                    .map(|(i, j)| f64::from(texel(i, j)[channel]) * f64::from(pixel_solid_angle_sr(j, width, height)))
                    .sum();
                let got: f64 = (0..8)
                    .map(|row| {
                        panorama.row(channel, row).iter().map(|v| f64::from(*v)).sum::<f64>()
                            * f64::from(panorama.geometry.solid_angle_sr[row])
                    })
                    .sum();
                assert!((got / truth - 1.0).abs() < 1e-5, "{width}×{height}: {got} against {truth}");
            }
        }
    }

    #[test]
    fn impossible_pixels_are_mended_and_counted() {
        let bad = [f32::NAN, f32::NEG_INFINITY, f32::INFINITY, -0.5, 1e30];
        let frame = rgb(16, 8, Transfer::Linear, |i, j| if j == 3 && i < 5 { [bad[i as usize], 0.5, 0.5] } else { [0.5; 3] });
        let panorama = taken(&frame, Lift::Linear, 1);
        assert_eq!(panorama.row(0, 3)[..5], [0.0, 0.0, MAX_MAGNITUDE, 0.0, MAX_MAGNITUDE]);
        assert_eq!(panorama.mended, 5);
        let over = rgb(16, 8, Transfer::Srgb, |_, _| [1.5, 0.5, 1.0]);
        assert_eq!(taken(&over, Lift::Linear, 1).mended, 128);
        // Rows shared by several rows of texels are counted once.
        let small = rgb(4, 3, Transfer::Linear, |_, _| [-1.0, 0.0, 0.0]);
        assert_eq!(taken(&small, Lift::Linear, 1).mended, 12);
    }

    #[test]
    fn stereo_frames_show_the_left_eye() {
        for (stereo, width, height) in [(StereoLayout::TopBottom, 64, 64), (StereoLayout::SideBySide, 128, 32)] {
            let left = |x: u32, y: u32, scale: u32| match stereo {
                StereoLayout::TopBottom => y < 32 / scale,
                _ => x < 64 / scale,
            };
            let mut frame = rgb(width, height, Transfer::Linear, |x, y| [if left(x, y, 1) { 0.25 } else { 4.0 }; 3]);
            frame.stereo = stereo;
            assert!(taken(&frame, Lift::Linear, 1).channels.iter().flatten().all(|v| (v - 0.25).abs() < 1e-6), "{stereo:?}");
            let mut frame = video(Pixel::YUV420P, width, height, Colour::default(), |plane, x, y| {
                let (dark, bright) = if plane == 0 { (60, 230) } else { (128, 20) };
                if left(x, y, if plane == 0 { 1 } else { 2 }) { dark } else { bright }
            });
            frame.stereo = stereo;
            let panorama = taken(&frame, Lift::Linear, 2);
            let expected = (44.0f32 / 219.0).powf(2.4);
            assert!(panorama.channels.iter().flatten().all(|v| (v / expected - 1.0).abs() < 4e-3), "{stereo:?} {:?}", panorama.channels);
        }
    }

    #[test]
    fn bit_depths_and_subsamplings_agree() {
        let scene = |plane: usize, x: u32, width: u32| [40 + 180 * x / width, 100 + 40 * x / width, 150 - 30 * x / width][plane] as u16;
        let reference = taken(&video(Pixel::YUV444P, 64, 32, Colour::default(), |p, x, _| scene(p, x, 64)), Lift::Linear, 1);
        for (format, wide, chroma) in [
            (Pixel::YUV444P10LE, true, 64),
            (Pixel::YUV422P10LE, true, 32),
            (Pixel::YUV420P10LE, true, 32),
            (Pixel::YUV420P, false, 32),
            (Pixel::YUV422P, false, 32),
        ] {
            let colour = Colour { bit_depth: if wide { 10 } else { 8 }, ..Colour::default() };
            let frame = video(format, 64, 32, colour, |p, x, _| scene(p, x, if p == 0 { 64 } else { chroma }) * if wide { 4 } else { 1 });
            let panorama = taken(&frame, Lift::Linear, 1);
            for (a, b) in reference.channels.iter().flatten().zip(panorama.channels.iter().flatten()) {
                // Half-resolution chroma rounds its codes down at other places: at most one step of 255.
                assert!((a - b).abs() < 0.04 * a.max(0.05), "{format:?}: {a} against {b}");
            }
        }
    }

    #[test]
    fn every_block_of_video_has_its_own_colour() {
        // As large as the texels that share their chroma, 4×4 pixels.
        let code = |plane: usize, c: u32, r: u32| [60 + 20 * r + 5 * c, 100 + 10 * r + 3 * c, 150 + 4 * c - 8 * r][plane] as u16;
        let colour = Colour::default();
        let (rgb_from_yuv, offset) = mr360_shaders::colour::rgb_from_yuv(colour);
        let panorama = taken(&video(Pixel::YUV444P, 32, 16, colour, |plane, x, y| code(plane, x / 4, y / 4)), Lift::Linear, 1);
        for (row, column) in (0..8).flat_map(|row| (0..16).map(move |column| (row, column))) {
            let yuv = Vec3::from_array([0, 1, 2].map(|plane| f32::from(code(plane, column / 2, row / 2)) / 255.0));
            let rgb = (rgb_from_yuv * (yuv - offset)).clamp(Vec3::ZERO, Vec3::ONE);
            let expected = mr360_shaders::colour::radiance_from_code(Lift::Linear, colour, Vec3::Y, rgb);
            let got = panorama.radiance((row * 16 + column) as usize);
            // Half a table step.
            assert!((got - expected).abs().max_element() < 2e-3, "{row} {column}: {got} against {expected}");
        }
        // Codes above white are white.
        let over = taken(&video(Pixel::YUV444P, 32, 16, colour, |plane, _, _| [255, 128, 128][plane]), Lift::Linear, 1);
        assert!(over.channels.iter().flatten().all(|v| (v - 1.0).abs() < 2e-3), "{}", over.radiance(0));
    }

    #[test]
    fn pq_and_hlg_video_are_true_hdr() {
        for (transfer, code, expected) in
            [(Transfer::Pq, 0.580_6, 1.0), (Transfer::Pq, 0.75, 4.85), (Transfer::Hlg, 0.75, 1.0), (Transfer::Hlg, 1.0, 4.926)]
        {
            let colour = Colour { primaries: Primaries::Bt2020, matrix: Matrix::Bt2020, transfer, full_range: true, bit_depth: 10 };
            let luma = (code * 1023.0f32).round() as u16;
            let frame = video(Pixel::YUV420P10LE, 32, 16, colour, |plane, _, _| if plane == 0 { luma } else { 512 });
            let panorama = taken(&frame, Lift::InverseToneMap, 2);
            assert_eq!(panorama.lift(), Lift::Linear);
            // One 10-bit step is 1 % in PQ.
            assert!(
                panorama.channels.iter().flatten().all(|v| (v / expected - 1.0).abs() < 0.015),
                "{transfer:?} {code}: {:?}",
                panorama.radiance(9)
            );
        }
    }

    #[test]
    fn pixels_are_decoded_before_they_are_averaged() {
        // Each texel half black, half white: radiance one half, code one half would be 0.19.
        let stripes = |across: u32, down: u32| {
            video(Pixel::YUV444P, 32, 16, Colour::default(), move |p, x, y| [16 + 219 * ((x * across + y * down) % 2) as u16, 128, 128][p])
        };
        let is = |panorama: Panorama, expected: f32| panorama.channels.iter().flatten().all(|v| (v - expected).abs() < 1e-3);
        for (across, down) in [(1, 0), (0, 1), (1, 1)] {
            assert!((1..=2).all(|supersample| is(taken(&stripes(across, down), Lift::Linear, supersample), 0.5)));
            // What is lifted needs blocks as small as the stripes: (10 + 1.8)/2, or half of 10·2⁻¹⁰ + 1.8.
            assert!(is(taken(&stripes(across, down), Lift::InverseToneMap, 2), 5.9));
            assert!(is(taken(&stripes(across, down), Lift::InverseToneMap, 1), 0.905));
        }
        assert!(is(taken(&rgb(32, 8, Transfer::Bt709, |i, _| [(i % 2) as f32; 3]), Lift::Linear, 1), 0.5));
    }

    /// Largest error of a texel and error of all texels together, both as shares of the picture's mean, for a picture of 2.5×2.5 pixels a
    /// texel; against decoding every pixel in double precision.
    fn error_of_means(transfer: Transfer, luma: impl Fn(u32, u32) -> u16 + Copy) -> (f64, f64) {
        let colour = Colour { transfer, ..Colour::default() };
        let frame = video(Pixel::YUV420P, 40, 20, colour, |plane, x, y| if plane == 0 { luma(x, y) } else { 128 });
        let panorama = taken(&frame, Lift::Linear, 2);
        let light = |x: u32, y: u32| {
            let code = ((f64::from(luma(x, y)) - 16.0) / 219.0).clamp(0.0, 1.0);
            if transfer == Transfer::Bt709 {
                code.powf(2.4)
            } else if code <= 0.040_45 {
                code / 12.92
            } else {
                ((code + 0.055) / 1.055).powf(2.4)
            }
        };
        let overlap = |texel: u32, pixel: u32| {
            (f64::from(pixel + 1).min(2.5 * f64::from(texel + 1)) - f64::from(pixel).max(2.5 * f64::from(texel))).max(0.0)
        };
        let (mut worst, mut all, mut got_all) = (0.0f64, 0.0f64, 0.0f64);
        for (row, column) in (0..8).flat_map(|row| (0..16).map(move |column| (row, column))) {
            let pixels = (0..20).flat_map(|y| (0..40).map(move |x| (x, y)));
            let truth: f64 = pixels.map(|(x, y)| light(x, y) * overlap(column, x) * overlap(row, y) / 6.25).sum();
            let got = f64::from(panorama.radiance((row * 16 + column) as usize).y);
            worst = worst.max((got - truth).abs());
            (all, got_all) = (all + truth, got_all + got);
        }
        (worst * 128.0 / all, (got_all / all - 1.0).abs())
    }

    #[test]
    fn mean_and_variance_of_the_codes_stand_for_all_their_pixels() {
        let noise = |x: u32, y: u32| ((x * 7919 + y * 104_729) ^ (x * y * 31)) % 220;
        for transfer in [Transfer::Bt709, Transfer::Srgb] {
            // The power itself is good to 2.7e-4.
            let (worst, all) = error_of_means(transfer, |_, _| 150);
            assert!(worst < 3e-4 && all < 3e-4, "flat: {worst} {all}");
            let (worst, all) = error_of_means(transfer, |x, y| 100 + (noise(x, y) % 20) as u16);
            assert!(worst < 3e-4 && all < 3e-4, "grain: {worst} {all}");
            // Beyond the variance, the codes' skewness counts: ℓ‴/6 of the third moment.
            let (worst, all) = error_of_means(transfer, |x, y| 16 + noise(x, y) as u16);
            assert!(worst < 0.06 && all < 5e-3, "texture: {worst} {all}");
            let (worst, all) = error_of_means(transfer, |x, y| if 3 * x + 2 * y > 70 { 235 } else { 40 });
            assert!(worst < 0.05 && all < 5e-4, "edge: {worst} {all}");
            // The most skewed: one white pixel on dark grey loses a sixth of its light, a hundredth of the picture's.
            let (_, all) = error_of_means(transfer, |x, y| if (x, y) == (13, 7) { 235 } else { 60 });
            assert!(all < 0.01, "speck: {all}");
        }
    }

    #[test]
    fn frames_that_cannot_be_read_are_refused() {
        let refused = |frame: &Frame| Panorama::new(SIZE, Lift::Linear).take(frame).unwrap_err();
        assert!(matches!(refused(&rgb(0, 0, Transfer::Linear, |_, _| [0.0; 3])), LightError::Empty { .. }));
        let mut short = rgb(16, 8, Transfer::Linear, |_, _| [0.0; 3]);
        let Pixels::Rgb { texels, .. } = &mut short.pixels else { unreachable!() };
        texels.pop();
        assert!(matches!(refused(&short), LightError::TexelCount { texels: 127, .. }));
        let mut flat = rgb(16, 1, Transfer::Linear, |_, _| [0.0; 3]);
        flat.stereo = StereoLayout::TopBottom;
        assert!(matches!(refused(&flat), LightError::Empty { .. }));
        let nv12 = ffmpeg_next::frame::Video::new(Pixel::NV12, 16, 8);
        let nv12 = Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Video(nv12, Colour::default()) };
        assert!(matches!(refused(&nv12), LightError::UnsupportedPixels { .. }));
        let deep = video(Pixel::YUV420P10LE, 16, 8, Colour { bit_depth: 10, ..Colour::default() }, |_, _, _| 0);
        let Pixels::Video(video, _) = deep.pixels else { unreachable!() };
        let wrong = Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Video(video, Colour::default()) };
        assert!(matches!(refused(&wrong), LightError::BitDepth { bit_depth: 8, .. }));
    }
}
