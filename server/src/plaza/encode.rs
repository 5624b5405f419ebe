//! Linear light to 8-bit limited-range BT.709 YUV 4:2:0.

use glam::Vec3;
use mr360_shaders::colour::LUMA;

const STEPS: usize = 4096;
/// BT.1886 without black lift: code = light^(1/2.4), the inverse of the project's decoding.
const INVERSE_GAMMA: f32 = 1.0 / 2.4;

/// One frame's planes, tightly packed.
#[derive(Clone)]
pub(super) struct Planes {
    pub(super) width: usize,
    pub(super) y: Vec<u8>,
    pub(super) u: Vec<u8>,
    pub(super) v: Vec<u8>,
}

/// Turns light into codes by a table over √light, where the curve is nearly straight.
pub(super) struct Encoder {
    table: Vec<f32>,
}

impl Encoder {
    pub(super) fn new() -> Self {
        Self { table: (0..=STEPS + 1).map(|i| (i as f32 / STEPS as f32).powf(2.0 * INVERSE_GAMMA)).collect() }
    }

    /// R'G'B' in [0, 1]; light above display white clips, as a camera's does.
    fn codes(&self, light: Vec3) -> Vec3 {
        light.map(|v| {
            let x = v.clamp(0.0, 1.0).sqrt() * STEPS as f32;
            let i = x as usize;
            self.table[i] + (self.table[i + 1] - self.table[i]) * (x - i as f32)
        })
    }

    /// Encodes the 2×2 block whose upper left pixel is (`x`, `y`), both even.
    pub(super) fn block(&self, planes: &mut Planes, x: usize, y: usize, light: [Vec3; 4]) {
        let mut mean = Vec3::ZERO;
        for (i, light) in light.into_iter().enumerate() {
            let codes = self.codes(light);
            mean += codes * 0.25;
            planes.y[(y + i / 2) * planes.width + x + i % 2] = (16.5 + 219.0 * codes.dot(LUMA)) as u8;
        }
        let luma = mean.dot(LUMA);
        let at = y / 2 * (planes.width / 2) + x / 2;
        planes.u[at] = (128.5 + 224.0 * (mean.z - luma) / 1.8556) as u8;
        planes.v[at] = (128.5 + 224.0 * (mean.x - luma) / 1.5748) as u8;
    }
}

impl Planes {
    pub(super) fn new(width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        Self { width: width as usize, y: vec![16; pixels], u: vec![128; pixels / 4], v: vec![128; pixels / 4] }
    }
}

/// Copies rows into a plane with another stride; what does not fit is left out.
pub(super) fn copy_rows(from: &[u8], width: usize, to: &mut [u8], stride: usize) {
    for (source, target) in from.chunks_exact(width).zip(to.chunks_mut(stride.max(1))) {
        if let Some(target) = target.get_mut(..width) {
            target.copy_from_slice(source);
        }
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::video::Colour;
    use mr360_shaders::colour::{decode_transfer, rgb_from_yuv};

    use super::*;

    #[test]
    fn decoding_gives_the_light_back() {
        let colour = Colour::default();
        let (matrix, offset) = rgb_from_yuv(colour);
        for light in [Vec3::splat(0.36), Vec3::new(0.6, 0.3, 0.2), Vec3::new(0.1, 0.2, 0.5), Vec3::ZERO, Vec3::ONE, Vec3::splat(50_000.0)] {
            let mut planes = Planes::new(2, 2);
            Encoder::new().block(&mut planes, 0, 0, [light; 4]);
            let yuv = Vec3::new(f32::from(planes.y[0]), f32::from(planes.u[0]), f32::from(planes.v[0])) / 255.0;
            let code = matrix * (yuv - offset);
            let expected = light.clamp(Vec3::ZERO, Vec3::ONE).map(|v| v.powf(1.0 / 2.4));
            // Half a step of each of Y, Cb and Cr, the worst of them 1.8556 / 224 / 2 in blue, together.
            assert!((code - expected).abs().max_element() < 0.007, "{light}: {code} {expected}");
            let back = decode_transfer(colour.transfer, code.clamp(Vec3::ZERO, Vec3::ONE));
            assert!((back - light.clamp(Vec3::ZERO, Vec3::ONE)).abs().max_element() < 0.02);
        }
    }
}
