//! A moving test card whose pictures tell their own number.

use ffmpeg_next::frame;

use super::synthetic::{FrameSource, Parameters};

/// Bits of the picture's number that are drawn.
const BITS: u32 = 32;
/// Luma of a drawn one and zero.
const LEVELS: (u8, u8) = (235, 16);
/// 75 % bars of BT.709 in limited range: white, yellow, cyan, green, magenta, red, blue (SMPTE RP 219).
const BARS: [[u8; 3]; 7] = [[180, 128, 128], [168, 44, 136], [145, 147, 44], [133, 63, 52], [63, 193, 204], [51, 109, 212], [28, 212, 120]];

/// Colour bars that turn once in eight seconds, above a row of blocks that spells the picture's number.
pub struct TestCard {
    width: u32,
    height: u32,
    frame_rate: f64,
}

impl TestCard {
    pub(super) fn new(parameters: &Parameters) -> Self {
        Self { width: parameters.width, height: parameters.height, frame_rate: parameters.frame_rate }
    }
}

impl FrameSource for TestCard {
    fn info(&self) -> (u32, u32, f64) {
        (self.width, self.height, self.frame_rate)
    }

    fn frame(&mut self, index: u64, out: &mut frame::Video) {
        let turn = index as f64 / (8.0 * self.frame_rate);
        for plane in [0, 1, 2] {
            let (width, height) = (out.plane_width(plane) as usize, out.plane_height(plane) as usize);
            let row: Vec<u8> = (0..width)
                .map(|x| {
                    let u = ((x as f64 + 0.5) / width as f64 + turn).fract();
                    let bar = BARS[(u * BARS.len() as f64) as usize % BARS.len()];
                    bar[plane]
                })
                .collect();
            let stride = out.stride(plane);
            for line in out.data_mut(plane).chunks_mut(stride).take(height) {
                line[..width].copy_from_slice(&row);
            }
        }
        self.number(index, out);
    }
}

impl TestCard {
    /// Blocks in the lowest eighth, least bit first; grey, so that only luma tells.
    fn number(&self, index: u64, out: &mut frame::Video) {
        for plane in [0, 1, 2] {
            let (width, height) = (out.plane_width(plane) as usize, out.plane_height(plane) as usize);
            let stride = out.stride(plane);
            for line in out.data_mut(plane).chunks_mut(stride).take(height).skip(height - height / 8) {
                for (x, sample) in line[..width].iter_mut().enumerate() {
                    let bit = x * BITS as usize / width;
                    *sample = match plane {
                        0 if index >> bit & 1 == 1 => LEVELS.0,
                        0 => LEVELS.1,
                        _ => 128,
                    };
                }
            }
        }
    }
}

/// Reads the number back from the luma rows of a test card, whatever it has been through.
///
/// `luma` holds `height` rows of `stride` samples, of which `width` are the picture. `None` if the picture is too small for the blocks.
#[must_use]
pub fn read_number(luma: &[u8], stride: usize, width: usize, height: usize) -> Option<u64> {
    let row = luma.get(height.checked_sub(height / 16 + 1)? * stride..)?.get(..width)?;
    let block = width / BITS as usize;
    if block == 0 {
        return None;
    }
    let mut number = 0;
    for bit in 0..BITS as usize {
        let middle = (2 * bit + 1) * width / (2 * BITS as usize);
        number |= u64::from(*row.get(middle)? > 125) << bit;
    }
    Some(number)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::synthetic::render;

    #[test]
    fn number_is_drawn_and_read() {
        for (width, height) in [(64, 32), (256, 128), (1000, 500)] {
            let mut card = TestCard { width, height, frame_rate: 30.0 };
            for index in [0, 1, 77, 0xdead_beef] {
                let picture = render(&mut card, index);
                let read = read_number(picture.data(0), picture.stride(0), width as usize, height as usize);
                assert_eq!(read, Some(index), "{width}x{height}");
            }
        }
    }
}
