//! Panoramas as video holds them.

use anyhow::{Result, bail};
use glam::Vec3;
use half::f16;
use mr360_client::picture::{Picture, Plane, Samples};
use mr360_protocol::video::{Colour, Matrix, Primaries, StereoLayout, Transfer};
use mr360_shaders::colour::{bt709_from_primaries, decode_transfer, rgb_from_yuv};

const SDR: Colour =
    Colour { primaries: Primaries::Bt709, matrix: Matrix::Bt709, transfer: Transfer::Bt709, full_range: false, bit_depth: 8 };
const BT2100_PQ: Colour =
    Colour { primaries: Primaries::Bt2020, matrix: Matrix::Bt2020, transfer: Transfer::Pq, full_range: false, bit_depth: 10 };
const BT2100_HLG: Colour = Colour { transfer: Transfer::Hlg, ..BT2100_PQ };

/// 8 bits, and both kinds of HDR video.
pub(crate) const COLOURS: [(&str, Colour); 3] = [("sdr-8bit", SDR), ("pq-10bit", BT2100_PQ), ("hlg-10bit", BT2100_HLG)];

/// By which the right eye sees everything further left, columns of the panorama.
const PARALLAX: usize = 16;

fn linear(picture: &Picture) -> Result<Vec<Vec3>> {
    let Samples::Rgba16F { texels, transfer: Transfer::Linear } = &picture.samples else { bail!("the panorama is not linear") };
    Ok(texels.chunks_exact(4).map(|texel| Vec3::new(texel[0].to_f32(), texel[1].to_f32(), texel[2].to_f32())).collect())
}

/// Codes of grey from 0 to 1 of a transfer, and the light of each.
fn greys(transfer: Transfer) -> Vec<f32> {
    (0..=4096).map(|code| decode_transfer(transfer, Vec3::splat(code as f32 / 4096.0)).y).collect()
}

/// Planar 4:2:0; what is brighter than the codes reach is clipped.
pub(crate) fn coded(picture: &Picture, colour: Colour) -> Result<Picture> {
    let greys = greys(colour.transfer);
    let to_primaries = bt709_from_primaries(colour.primaries).inverse();
    let (matrix, offset) = rgb_from_yuv(colour);
    let yuv_from_rgb = matrix.inverse();
    let code = |light: f32| greys.partition_point(|grey| *grey < light).min(4096) as f32 / 4096.0;
    let yuv = |radiance: &Vec3| {
        let rgb = (to_primaries * *radiance).max(Vec3::ZERO);
        // HLG's display light hangs on luminance; colours are coded as greys of the same light are, which is right up to saturation.
        yuv_from_rgb * Vec3::new(code(rgb.x), code(rgb.y), code(rgb.z)) + offset
    };
    let samples: Vec<Vec3> = linear(picture)?.iter().map(yuv).collect();
    let (width, height) = (picture.width as usize, picture.height as usize);
    let (half_width, half_height) = (width / 2, height / 2);
    let luma: Vec<f32> = samples.iter().map(|sample| sample.x).collect();
    let block = |at: usize, channel: usize| {
        let (row, column) = (at / half_width * 2, at % half_width * 2);
        let four = [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(down, across)| samples[(row + down) * width + column + across][channel]);
        four.iter().sum::<f32>() / 4.0
    };
    let chroma = |channel: usize| (0..half_width * half_height).map(|at| block(at, channel)).collect::<Vec<_>>();
    let planes = [
        plane((width, height), &luma, colour.bit_depth),
        plane((half_width, half_height), &chroma(1), colour.bit_depth),
        plane((half_width, half_height), &chroma(2), colour.bit_depth),
    ];
    Ok(Picture {
        pts_us: 0,
        width: picture.width,
        height: picture.height,
        stereo: StereoLayout::Mono,
        samples: Samples::Yuv { planes, colour },
    })
}

fn plane((width, height): (usize, usize), samples: &[f32], bit_depth: u8) -> Plane {
    let largest = f32::from((1_u16 << bit_depth) - 1);
    let codes = samples.iter().map(|sample| (sample * largest).round().clamp(0.0, largest) as u16);
    let (stride, data): (usize, Vec<u8>) = if bit_depth > 8 {
        (2 * width, codes.flat_map(u16::to_le_bytes).collect())
    } else {
        (width, codes.map(|code| code as u8).collect())
    };
    Plane { width: width as u32, height: height as u32, stride, data: data.into() }
}

/// The panorama for the left eye above one for the right eye, which sees everything further left.
pub(crate) fn top_bottom(mono: &Picture) -> Result<Picture> {
    let Samples::Rgba16F { texels, transfer } = &mono.samples else { bail!("the panorama is not linear") };
    let row = mono.width as usize * 4;
    let shifted = texels.chunks_exact(row).flat_map(|row| [&row[PARALLAX * 4..], &row[..PARALLAX * 4]].concat());
    let texels: Vec<f16> = texels.iter().copied().chain(shifted).collect();
    let samples = Samples::Rgba16F { texels, transfer: *transfer };
    Ok(Picture { pts_us: 0, width: mono.width, height: 2 * mono.height, stereo: StereoLayout::TopBottom, samples })
}
