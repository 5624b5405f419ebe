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
mod tests;
