//! The working panorama: a small linear map of the whole sphere, made from a frame by area averaging.
//!
//! Order of the steps: codes are averaged over blocks first and become radiance afterwards, because decoding
//! every pixel of a 3840×1920 frame costs several times the rest of the estimate. The mean of a convex curve is
//! above the curve of the mean, so this loses energy where a block holds both dark and bright pixels. Each texel
//! is therefore made of `supersample`² blocks which are decoded one by one and averaged as radiance. Linear
//! input has no curve: it is averaged directly, rows weighted by their solid angle, and keeps its energy exactly.

use std::f32::consts::TAU;

use glam::Vec3;
use mr360_protocol::light::{Lift, MAX_MAGNITUDE};
use mr360_protocol::video::{Colour, StereoLayout, Transfer};
use mr360_shaders::equirect::pixel_solid_angle_sr;

use super::LightError;
use super::radiance::{Planes, RadianceTable};
use super::sampling::{Edges, Grid, VideoSampler, VideoView};
use crate::frame::{Frame, Pixels};

/// Largest finite radiance that is believed: over a hundred times the sun's disc over a display white of
/// 203 cd/m², and far from where sums of texels leave the range of `f32`.
const LARGEST_RADIANCE: f32 = 1e9;

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
    /// sin λ, cos λ, sin 2λ, cos 2λ at each column's centre.
    pub(super) harmonics: [Vec<f32>; 4],
}

impl Geometry {
    fn new(size: Grid) -> Self {
        let (width, height) = (size.width, size.height);
        let longitude: Vec<f32> = (0..width).map(|i| ((i as f32 + 0.5) / width as f32 - 0.5) * TAU).collect();
        let latitude: Vec<f32> = (0..height).map(|j| (0.5 - (j as f32 + 0.5) / height as f32) * TAU / 2.0).collect();
        let of_longitude = |f: fn(f32) -> f32| longitude.iter().map(|l| f(*l)).collect();
        Self {
            solid_angle_sr: (0..height).map(|row| pixel_solid_angle_sr(row, width, height)).collect(),
            sin_cos_latitude: latitude.iter().map(|l| l.sin_cos()).collect(),
            harmonics: [
                of_longitude(f32::sin),
                of_longitude(f32::cos),
                of_longitude(|l| (2.0 * l).sin()),
                of_longitude(|l| (2.0 * l).cos()),
            ],
            latitude,
            longitude,
        }
    }

    /// Unit direction of a texel's centre.
    pub(super) fn direction(&self, row: usize, column: usize) -> Vec3 {
        let (sin_latitude, cos_latitude) = self.sin_cos_latitude[row];
        Vec3::new(cos_latitude * self.harmonics[0][column], sin_latitude, -cos_latitude * self.harmonics[1][column])
    }
}

/// A linear panorama of fixed size, refilled from frame to frame without allocating.
pub(super) struct Panorama {
    /// Its size.
    pub(super) size: Grid,
    /// Where its texels look.
    pub(super) geometry: Geometry,
    /// Radiance, row by row from the top; finite and not negative.
    pub(super) channels: Planes,
    /// Source values of the last frame that were not finite, negative or too large to be light.
    pub(super) mended: u64,
    lift: Lift,
    table: RadianceTable,
    video: VideoSampler,
    edges: Edges,
    /// Codes of one row of blocks.
    blocks: Planes,
    /// One source row after vertical averaging, RGB input only.
    source_row: Planes,
}

impl Panorama {
    /// An empty panorama that applies `lift` to LDR frames.
    pub(super) fn new(size: Grid, lift: Lift) -> Self {
        let texels = size.width as usize * size.height as usize;
        Self {
            size,
            geometry: Geometry::new(size),
            channels: std::array::from_fn(|_| vec![0.0; texels]),
            mended: 0,
            lift,
            table: RadianceTable::new(lift, Colour::default()),
            video: VideoSampler::default(),
            edges: Edges::default(),
            blocks: Planes::default(),
            source_row: Planes::default(),
        }
    }

    /// The lift that the last frame was given; HDR frames are given none.
    pub(super) fn lift(&self) -> Lift {
        self.table.lift()
    }

    /// One row of a channel.
    pub(super) fn row(&self, channel: usize, row: usize) -> &[f32] {
        let width = self.size.width as usize;
        &self.channels[channel][row * width..(row + 1) * width]
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
        self.mended = 0;
        match &frame.pixels {
            Pixels::Video(video, colour) => {
                let view = VideoView::new(video, *colour, frame.stereo)?;
                self.fill(*colour, |video, _, row, grid, codes| video.codes(&view, row, grid, codes));
            }
            Pixels::Rgb { width, height, texels, transfer } => {
                let view = RgbView::new((*width, *height), texels, frame.stereo)?;
                let linear = *transfer == Transfer::Linear;
                let colour = Colour { transfer: *transfer, ..Colour::default() };
                let mut source_row = std::mem::take(&mut self.source_row);
                let mut mended = 0;
                self.fill(colour, |_, edges, row, grid, codes| {
                    mended += view.average_rows(row, grid.height * grid.supersample, linear, &mut source_row);
                    edges.fit(view.width, grid.width * grid.supersample);
                    for (source, out) in source_row.iter().zip(codes) {
                        edges.average(source, out);
                    }
                });
                (self.source_row, self.mended) = (source_row, mended);
            }
        }
        Ok(())
    }

    /// Fills the texels from rows of blocks that `codes_of_row` provides.
    fn fill(&mut self, colour: Colour, mut codes_of_row: impl FnMut(&mut VideoSampler, &mut Edges, u32, Grid, &mut Planes)) {
        if !self.table.is_for(self.lift, colour) {
            self.table = RadianceTable::new(self.lift, colour);
        }
        let supersample = if colour.transfer == Transfer::Linear { 1 } else { self.size.supersample };
        let grid = Grid { supersample, ..self.size };
        let width = grid.width as usize;
        self.blocks.iter_mut().for_each(|plane| plane.resize(width * supersample as usize, 0.0));
        for block_row in 0..grid.height * supersample {
            codes_of_row(&mut self.video, &mut self.edges, block_row, grid, &mut self.blocks);
            self.table.decode(&mut self.blocks);
            let row = (block_row / supersample) as usize;
            for (channel, blocks) in self.channels.iter_mut().zip(&self.blocks) {
                let texels = &mut channel[row * width..(row + 1) * width];
                gather(texels, blocks, supersample as usize, block_row % supersample == 0);
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

/// Left eye of an RGB frame.
struct RgbView<'a> {
    texels: &'a [[f32; 3]],
    stride: usize,
    width: u32,
    height: u32,
}

impl<'a> RgbView<'a> {
    fn new((width, height): (u32, u32), texels: &'a [[f32; 3]], stereo: StereoLayout) -> Result<Self, LightError> {
        let (eye_width, eye_height) = stereo.eye_size(width, height);
        if eye_width == 0 || eye_height == 0 {
            return Err(LightError::Empty { width, height });
        }
        if u64::from(width) * u64::from(height) != texels.len() as u64 {
            return Err(LightError::TexelCount { width, height, texels: texels.len() });
        }
        Ok(Self { texels, stride: width as usize, width: eye_width, height: eye_height })
    }

    /// Averages the source rows under block row `block` of `blocks` into `out`, weighted by the solid angle that
    /// they share with it. Returns how many source values were mended.
    fn average_rows(&self, block: u32, blocks: u32, linear: bool, out: &mut Planes) -> u64 {
        let width = self.width as usize;
        for plane in out.iter_mut() {
            plane.clear();
            plane.resize(width, 0.0);
        }
        let [red, green, blue] = out;
        let scale = f64::from(self.height) / f64::from(blocks);
        let (start, end) = (f64::from(block) * scale, f64::from(block + 1) * scale);
        let height = |row: f64| ((0.5 - row / f64::from(self.height)) * std::f64::consts::PI).sin();
        let mut mended = 0;
        for row in start.floor() as u32..(end.ceil() as u32).min(self.height) {
            let (from, to) = (f64::from(row).max(start), f64::from(row + 1).min(end));
            let weight = ((height(from) - height(to)) / (height(start) - height(end))) as f32;
            let first = row as usize * self.stride;
            let source = self.texels.get(first..first + width).unwrap_or_default();
            for (((texel, r), g), b) in source.iter().zip(red.iter_mut()).zip(green.iter_mut()).zip(blue.iter_mut()) {
                for (value, sum) in texel.iter().zip([r, g, b]) {
                    let fixed = mend(*value, linear);
                    mended += u64::from(fixed != *value && from == f64::from(row));
                    *sum += weight * fixed;
                }
            }
        }
        mended
    }
}

/// A source value that can be light. Negative values are compression rings and not-a-number is no measurement:
/// both become 0. Infinity is what an overflowing half float leaves behind: it becomes the largest half float.
fn mend(value: f32, linear: bool) -> f32 {
    if value == f32::INFINITY {
        return if linear { MAX_MAGNITUDE } else { 1.0 };
    }
    // `max` and `min` return the number when the other side is none.
    value.max(0.0).min(if linear { LARGEST_RADIANCE } else { 1.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ffmpeg_next::format::Pixel;
    use mr360_protocol::video::{Matrix, Primaries};

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
            let texel = |i: u32, j: u32| if (i, j) == (width / 3, height / 4) { [9e4, 5.0, 1.0] } else { [0.1, 0.2, 0.3] };
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
        assert_eq!(panorama.row(0, 3)[..5], [0.0, 0.0, MAX_MAGNITUDE, 0.0, LARGEST_RADIANCE]);
        assert_eq!(panorama.mended, 5);
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
        let reference = taken(&video(Pixel::YUV444P, 64, 32, Colour::default(), |p, x, _| scene(p, x, 64)), Lift::Highlights, 1);
        for (format, wide, chroma) in [
            (Pixel::YUV444P10LE, true, 64),
            (Pixel::YUV422P10LE, true, 32),
            (Pixel::YUV420P10LE, true, 32),
            (Pixel::YUV420P, false, 32),
            (Pixel::YUV422P, false, 32),
        ] {
            let colour = Colour { bit_depth: if wide { 10 } else { 8 }, ..Colour::default() };
            let frame = video(format, 64, 32, colour, |p, x, _| scene(p, x, if p == 0 { 64 } else { chroma }) * if wide { 4 } else { 1 });
            let panorama = taken(&frame, Lift::Highlights, 1);
            for (a, b) in reference.channels.iter().flatten().zip(panorama.channels.iter().flatten()) {
                // Half-resolution chroma rounds its codes down at other places: at most one step of 255.
                assert!((a - b).abs() < 0.04 * a.max(0.05), "{format:?}: {a} against {b}");
            }
        }
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
    fn blocks_are_decoded_before_they_are_averaged() {
        // Each texel half black, half white: radiance one half, code one half would be 0.19.
        let frame = rgb(32, 8, Transfer::Bt709, |i, _| [(i % 2) as f32; 3]);
        assert!(taken(&frame, Lift::Linear, 2).channels.iter().flatten().all(|v| (v - 0.5).abs() < 1e-3));
        assert!(taken(&frame, Lift::Linear, 1).channels.iter().flatten().all(|v| (v - 0.189).abs() < 1e-3));
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
