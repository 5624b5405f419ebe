//! A panorama as a frame of a live stream: 8-bit planar 4:2:0, BT.709 matrix, limited range, as ingest delivers it.

use anyhow::{Context, Result};
use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame::Video;
use glam::Vec3;
use mr360_protocol::video::{Colour, StereoLayout, Transfer};
use mr360_server::frame::{Frame, Pixels};
use mr360_shaders::colour::rgb_from_yuv;

use super::exposure::code;
use super::radiance_map::RadianceMap;

/// Columns and rows of the frames.
pub(super) const SIZE: (usize, usize) = (1280, 640);

/// The frame in every form that somebody reads.
pub(super) struct VideoFrame {
    /// What methods are given.
    pub(super) frame: Frame,
    /// The same as 8-bit sRGB, before it was made planar.
    pub(super) codes: Vec<[u8; 3]>,
    /// Y, Cb and Cr, row by row without padding.
    pub(super) planes: Vec<u8>,
}

impl VideoFrame {
    /// Of a panorama whose radiance times `scale` has display white at 1.
    ///
    /// # Errors
    /// When there is no memory for the frame.
    pub(super) fn of(map: &RadianceMap, scale: f32) -> Result<Self> {
        let (width, height) = SIZE;
        let at = |pixel: usize| ((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
        let codes: Vec<[u8; 3]> = (0..width * height)
            .map(|pixel| {
                let (x, y) = at(pixel);
                (bilinear(map, x / width as f32, y / height as f32) * scale).to_array().map(code)
            })
            .collect();
        let colour = Colour { transfer: Transfer::Srgb, ..Colour::default() };
        let planes = planes(&codes, width, colour);
        let video = video(&planes).context("a video frame cannot be made")?;
        Ok(Self { frame: Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Video(video, colour) }, codes, planes })
    }
}

/// Radiance between the centres of the pixels, around the seam.
fn bilinear(map: &RadianceMap, u: f32, v: f32) -> Vec3 {
    let (x, y) = (u * map.width as f32 - 0.5, (v * map.height as f32 - 0.5).clamp(0.0, map.height as f32 - 1.0));
    let (left, top) = (x.floor(), y.floor());
    let column = |offset: i64| (left as i64 + offset).rem_euclid(map.width as i64) as usize;
    let rows = [top as usize, (top as usize + 1).min(map.height - 1)];
    let line = |row: usize| {
        let texels = &map.texels()[row * map.width..(row + 1) * map.width];
        texels[column(0)].lerp(texels[column(1)], x - left)
    };
    line(rows[0]).lerp(line(rows[1]), y - top)
}

/// Planar 4:2:0 of 8-bit R'G'B'; the chroma of a block is that of its mean.
fn planes(codes: &[[u8; 3]], width: usize, colour: Colour) -> Vec<u8> {
    let (rgb_from_yuv, offset) = rgb_from_yuv(colour);
    let yuv_from_rgb = rgb_from_yuv.inverse();
    let yuv = |rgb: Vec3| ((yuv_from_rgb * (rgb / 255.0) + offset) * 255.0).round().clamp(Vec3::ZERO, Vec3::splat(255.0));
    let rgb = |code: &[u8; 3]| Vec3::from_array(code.map(f32::from));
    let mut planes: Vec<u8> = codes.iter().map(|code| yuv(rgb(code)).x as u8).collect();
    let blocks: Vec<Vec3> = codes
        .chunks_exact(2 * width)
        .flat_map(|rows| {
            let (above, below) = rows.split_at(width);
            above.chunks_exact(2).zip(below.chunks_exact(2)).map(|(a, b)| yuv(a.iter().chain(b).map(rgb).sum::<Vec3>() / 4.0))
        })
        .collect();
    planes.extend(blocks.iter().map(|block| block.y as u8));
    planes.extend(blocks.iter().map(|block| block.z as u8));
    planes
}

/// FFmpeg's frame of the planes; `None` where it has no memory for them.
fn video(planes: &[u8]) -> Option<Video> {
    let (width, height) = SIZE;
    let mut video = Video::new(Pixel::YUV420P, width as u32, height as u32);
    let (luma, chroma) = planes.split_at_checked(width * height)?;
    let (cb, cr) = chroma.split_at_checked(width * height / 4)?;
    for (plane, (source, columns)) in [(luma, width), (cb, width / 2), (cr, width / 2)].into_iter().enumerate() {
        let stride = video.stride(plane);
        for (row, source) in source.chunks_exact(columns).enumerate() {
            video.data_mut(plane).get_mut(row * stride..row * stride + columns)?.copy_from_slice(source);
        }
    }
    Some(video)
}

#[cfg(test)]
mod tests {
    use mr360_server::lighting::{MethodSpec, StepTimes};

    use super::*;

    #[test]
    fn a_frame_shows_methods_what_its_codes_say() {
        let map = RadianceMap::of(32, |direction| if direction.y > 0.0 { Vec3::new(0.5, 0.7, 0.9) } else { Vec3::splat(0.2) });
        let video = VideoFrame::of(&map, 1.0).unwrap();
        assert_eq!((video.codes.len(), video.planes.len()), (1280 * 640, 1280 * 960));
        let mut method = "sh:9".parse::<MethodSpec>().unwrap().make();
        let estimate = method.estimate(&video.frame, &mut StepTimes::default()).unwrap();
        // The mean over the sphere; steps of 8 bits and of the chroma are under 1 % here.
        let mean = estimate.sh[0] / (4.0 * std::f32::consts::PI).sqrt();
        assert!((mean / Vec3::new(0.35, 0.45, 0.55) - 1.0).abs().max_element() < 0.015, "{mean}");
        // Twice as dark under half the scale.
        let half = VideoFrame::of(&map, 0.5).unwrap();
        let dark = method.estimate(&half.frame, &mut StepTimes::default()).unwrap().sh[0] / (4.0 * std::f32::consts::PI).sqrt();
        assert!((dark / mean * 2.0 - 1.0).abs().max_element() < 0.02, "{dark}");
    }

    #[test]
    fn white_black_and_red_have_the_codes_of_the_standard() {
        let planes = planes(&[[255; 3], [255; 3], [0; 3], [0; 3], [255; 3], [255; 3], [0; 3], [0; 3]], 4, Colour::default());
        assert_eq!(planes, [235, 235, 16, 16, 235, 235, 16, 16, 128, 128, 128, 128]);
        // BT.709, limited range: 63, 102, 240.
        assert_eq!(super::planes(&[[255, 0, 0]; 4], 2, Colour::default()), [63, 63, 63, 63, 102, 240]);
    }

    #[test]
    fn what_lies_between_pixels_is_between_them() {
        let map = RadianceMap::of(2, |direction| Vec3::splat(if direction.x > 0.0 { 1.0 } else { 3.0 }));
        // Columns are −x, −x, +x, +x; the seam lies between the last and the first.
        for (u, expected) in [(0.125, 3.0), (0.5, 2.0), (0.625, 1.0), (0.0, 2.0), (0.4375, 2.5)] {
            assert!((bilinear(&map, u, 0.3).x - expected).abs() < 1e-5, "{u}");
        }
    }
}
