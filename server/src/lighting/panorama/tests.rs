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
                    panorama.row(channel, row).iter().map(|v| f64::from(*v)).sum::<f64>() * f64::from(panorama.geometry.solid_angle_sr[row])
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
