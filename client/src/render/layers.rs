//! Views side by side in the layers of one texture, drawn one after the other or, where there are two, by one pass.

use anyhow::anyhow;

use super::running;
use crate::Failure;
use crate::camera::Camera;
use crate::environment::Environment;
use crate::gpu::Gpu;
use crate::view::{FrameReport, Renderer, View};

/// Whether two views are drawn by one pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Multiview {
    /// Where the GPU draws two layers at once.
    #[default]
    Auto,
    /// Or not at all.
    On,
    /// Each by passes of its own.
    Off,
}

impl Multiview {
    /// Has frames of so many views drawn this way.
    pub(super) fn set_up(self, gpu: &Gpu, renderer: &mut Renderer, views: usize) -> Result<(), Failure> {
        if self == Self::Off || views != 2 || renderer.use_multiview(gpu).map_err(running)? || self == Self::Auto {
            return Ok(());
        }
        Err(Failure::Running(anyhow!("--multiview on: this GPU or its driver does not draw two layers at once; use auto")))
    }
}

/// A texture to draw views to and to read them from.
pub(super) struct Layers {
    pub(super) texture: wgpu::Texture,
    each: Vec<wgpu::TextureView>,
    all: wgpu::TextureView,
    size: (u32, u32),
}

impl Layers {
    pub(super) fn new(gpu: &Gpu, size: (u32, u32), count: usize, format: wgpu::TextureFormat) -> Self {
        let count = count.max(1) as u32;
        let texture = layered_target(gpu, size, count, format);
        let view = |dimension, base_array_layer, layers| {
            let (dimension, array_layer_count) = (Some(dimension), Some(layers));
            texture.create_view(&wgpu::TextureViewDescriptor { dimension, base_array_layer, array_layer_count, ..Default::default() })
        };
        let each = (0..count).map(|layer| view(wgpu::TextureViewDimension::D2, layer, 1)).collect();
        let all = view(wgpu::TextureViewDimension::D2Array, 0, count);
        Self { each, all, texture, size }
    }

    /// Records a frame with one view a layer.
    pub(super) fn render(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        environment: &mut Environment,
        renderer: &mut Renderer,
        cameras: &[Camera],
    ) -> FrameReport {
        let view = |(camera, target): (&Camera, _)| View { camera: *camera, target, size: self.size };
        let views: Vec<View<'_>> = cameras.iter().zip(&self.each).map(view).collect();
        match <&[View<'_>; 2]>::try_from(views.as_slice()) {
            Ok(eyes) => renderer.render_eyes(gpu, encoder, environment, (eyes, &self.all)),
            Err(_) => renderer.render(gpu, encoder, environment, &views),
        }
    }
}

fn layered_target(gpu: &Gpu, (width, height): (u32, u32), layers: u32, format: wgpu::TextureFormat) -> wgpu::Texture {
    gpu.device.create_texture(&wgpu::TextureDescriptor {
        label: Some("picture"),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: layers },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    })
}

/// A texture to draw a picture to and to read it from.
#[cfg(test)]
pub(crate) fn target(gpu: &Gpu, size: (u32, u32), format: wgpu::TextureFormat) -> wgpu::Texture {
    layered_target(gpu, size, 1, format)
}
