//! `--eyes`: one picture, or what two eyes see, side by side.

use anyhow::anyhow;
use glam::Vec3;

use super::{How, Still, TOO_FEW};
use crate::Failure;
use crate::camera::Camera;

/// Widest distance between the eyes, millimetres.
const MAX_IPD_MM: f32 = 200.0;

/// What is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Eyes {
    /// One picture.
    One,
    /// The left eye's picture and the right eye's beside it, each of the size asked for.
    SideBySide,
}

pub(super) fn parse_ipd(text: &str) -> Result<f32, String> {
    let millimetres = text.parse().ok().filter(|ipd| (0.0..=MAX_IPD_MM).contains(ipd));
    millimetres.ok_or_else(|| format!("from 0 to {MAX_IPD_MM} mm"))
}

impl Eyes {
    /// Size of the whole picture, where each eye's is of this size.
    pub(super) fn picture_size(self, (width, height): (u32, u32)) -> (u32, u32) {
        match self {
            Self::One => (width, height),
            Self::SideBySide => (2 * width, height),
        }
    }

    /// Draws it, from a head at the camera: rows packed from the top.
    pub(super) fn draw(
        self,
        still: &Still<'_>,
        how: How,
        (head, ipd_m): (&Camera, f32),
        size: (u32, u32),
        format: wgpu::TextureFormat,
    ) -> Result<Vec<u8>, Failure> {
        if self == Self::One {
            return still.draw_by(how, head, size, format);
        }
        let eye = |right_eye: bool| {
            let aside = if right_eye { 0.5 * ipd_m } else { -0.5 * ipd_m };
            let position = head.position + head.world_from_view * Vec3::X * aside;
            Camera { position, right_eye, ..*head }
        };
        let views = still.draw_views(how, &[eye(false), eye(true)], size, format)?;
        let [left, right] = <[Vec<u8>; 2]>::try_from(views).map_err(|_| Failure::Running(anyhow!(TOO_FEW)))?;
        let row = (left.len() / size.1.max(1) as usize).max(1);
        Ok(left.chunks(row).zip(right.chunks(row)).flat_map(|(left, right)| [left, right]).flatten().copied().collect())
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use half::f16;
    use mr360_protocol::scene::{Geometry, Material, Object, ObjectId, Scene, Shape, Transform};
    use mr360_protocol::video::{StereoLayout, Transfer};

    use super::*;
    use crate::gpu::Gpu;
    use crate::picture::{Picture, Samples};
    use crate::render::ambient_light;

    const SIZE: (u32, u32) = (160, 90);

    /// The left eye's view is dark and the right one's bright.
    fn stereo() -> Picture {
        let [dark, bright] = [0.25, 0.75].map(|value| [value, value, value, 1.0].map(f16::from_f32).repeat(32));
        let samples = Samples::Rgba16F { texels: [dark, bright].concat(), transfer: Transfer::Linear };
        Picture { pts_us: 0, width: 8, height: 8, stereo: StereoLayout::TopBottom, samples }
    }

    #[test]
    fn each_eye_has_its_own_video_and_sees_objects_from_its_place() {
        let gpu = Gpu::headless().unwrap();
        let picture = stereo();
        let light = ambient_light(&picture);
        let distance = 2.0;
        let ball = Object {
            id: ObjectId(1),
            geometry: Geometry::Shape(Shape::Sphere),
            transform: Transform { position: Vec3::NEG_Z * distance, scale: Vec3::splat(0.2), ..Transform::default() },
            material: Some(Material { base_color: [1.0, 0.0, 0.0], ..Material::default() }),
            animation: Default::default(),
        };
        let scene = Scene { ground_y: -100.0, objects: vec![ball], ..Scene::default() };
        let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene, assets: &HashMap::new() };
        let (head, ipd_m) = (Camera::looking(0.0, 0.0, 0.6), 0.064);
        let format = wgpu::TextureFormat::Rgba32Float;
        let bytes = Eyes::SideBySide.draw(&still, How::default(), (&head, ipd_m), SIZE, format).unwrap();
        let texels: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes);
        assert_eq!((Eyes::SideBySide.picture_size(SIZE), Eyes::One.picture_size(SIZE)), ((320, 90), SIZE));
        assert_eq!(texels.len(), 320 * 90 * 4);
        let mut middles = Vec::new();
        for (first, video) in [(0, 0.25), (160, 0.75)] {
            let row = &texels[(45 * 320 + first) * 4..][..160 * 4];
            assert_eq!((row[1], row[159 * 4 + 1]), (video, video));
            let dark: Vec<f32> = row.chunks_exact(4).map(|texel| (video - texel[1]).max(0.0)).collect();
            middles.push((0..160).map(|x| x as f32 * dark[x]).sum::<f32>() / dark.iter().sum::<f32>());
        }
        // The left eye sees it to the right: by IPD over distance, in pixels.
        let expected = ipd_m / distance * SIZE.1 as f32 / (2.0 * 0.3f32.tan());
        assert!((middles[0] - middles[1] - expected).abs() < 0.5, "{middles:?}, expected {expected} apart");
        let one = Eyes::One.draw(&still, How::default(), (&Camera { right_eye: true, ..head }, ipd_m), SIZE, format).unwrap();
        assert_eq!(bytemuck::pod_collect_to_vec::<u8, f32>(&one)[1], 0.75);
    }

    #[test]
    fn an_ipd_is_a_number_of_millimetres() {
        assert_eq!(parse_ipd("63.5"), Ok(63.5));
        for wrong in ["-1", "201", "nan", "64mm", ""] {
            assert!(parse_ipd(wrong).is_err(), "{wrong}");
        }
    }
}
