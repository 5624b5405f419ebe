//! RGBA8 to 4:2:0, BT.709, limited range.

use ffmpeg_next::frame::Video;
use mr360_shaders::colour::LUMA;

/// Luma weights of BT.709.
const KR: f32 = LUMA.x;
const KB: f32 = LUMA.z;
const KG: f32 = 1.0 - KR - KB;

/// Writes `rgba` (`width`×`height`, tightly packed) into an even-sized YUV420P frame; a missing last column or row repeats its neighbour.
pub(super) fn fill(frame: &mut Video, rgba: &[u8], width: usize, height: usize) {
    let texel = |x: usize, y: usize| {
        let at = (y.min(height - 1) * width + x.min(width - 1)) * 4;
        [f32::from(rgba[at]), f32::from(rgba[at + 1]), f32::from(rgba[at + 2])]
    };
    let (even_width, even_height) = (width.next_multiple_of(2), height.next_multiple_of(2));
    let stride = frame.stride(0);
    for (y, row) in frame.data_mut(0).chunks_mut(stride).take(even_height).enumerate() {
        for (x, out) in row.iter_mut().take(even_width).enumerate() {
            *out = luma(texel(x, y));
        }
    }
    for plane in [1, 2] {
        let stride = frame.stride(plane);
        for (y, row) in frame.data_mut(plane).chunks_mut(stride).take(even_height / 2).enumerate() {
            for (x, out) in row.iter_mut().take(even_width / 2).enumerate() {
                let four = [texel(2 * x, 2 * y), texel(2 * x + 1, 2 * y), texel(2 * x, 2 * y + 1), texel(2 * x + 1, 2 * y + 1)];
                let mean = [0, 1, 2].map(|c| four.iter().map(|t| t[c]).sum::<f32>() * 0.25);
                *out = chroma(mean, plane);
            }
        }
    }
}

fn weighted([r, g, b]: [f32; 3]) -> f32 {
    KR * r + KG * g + KB * b
}

fn luma(rgb: [f32; 3]) -> u8 {
    (16.0 + weighted(rgb) * (219.0 / 255.0)).round() as u8
}

/// Plane 1 is Cb, 2 is Cr.
fn chroma(rgb: [f32; 3], plane: usize) -> u8 {
    let (primary, weight) = if plane == 1 { (rgb[2], KB) } else { (rgb[0], KR) };
    (128.0 + (primary - weighted(rgb)) / (2.0 * (1.0 - weight)) * (224.0 / 255.0)).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use ffmpeg_next::format::Pixel;

    #[test]
    fn the_corners_of_the_cube_have_their_codes() {
        // ITU-R BT.709, 100 % colour bars.
        for (rgb, codes) in [
            ([255, 255, 255], [235, 128, 128]),
            ([0, 0, 0], [16, 128, 128]),
            ([255, 0, 0], [63, 102, 240]),
            ([0, 255, 0], [173, 42, 26]),
            ([0, 0, 255], [32, 240, 118]),
        ] {
            let rgba = [rgb[0], rgb[1], rgb[2], 255].repeat(3 * 3);
            let mut frame = Video::new(Pixel::YUV420P, 4, 4);
            fill(&mut frame, &rgba, 3, 3);
            assert_eq!([frame.data(0)[0], frame.data(1)[0], frame.data(2)[0]], codes);
            let last = frame.stride(0) * 3 + 3;
            assert_eq!(frame.data(0)[last], codes[0]);
        }
    }
}
