//! The GGX lobe's albedo as a texture, the same for every frame.

use half::f16;
use mr360_shaders::brdf::{ALBEDO_COLUMNS, ALBEDO_ROWS, albedo_table};

use crate::gpu::Gpu;

/// [`albedo_table`] in half floats, which hold values below 1 to 0.0005, and how to look it up.
pub(crate) struct AlbedoTable {
    pub(crate) view: wgpu::TextureView,
    pub(crate) sampler: wgpu::Sampler,
}

impl AlbedoTable {
    pub(crate) fn new(gpu: &Gpu) -> Self {
        let size = wgpu::Extent3d { width: ALBEDO_COLUMNS as u32, height: ALBEDO_ROWS as u32, depth_or_array_layers: 1 };
        let texture = gpu.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("albedo"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rg16Float,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        let texels: Vec<f16> = albedo_table().iter().flat_map(|texel| texel.to_array().map(f16::from_f32)).collect();
        let rows = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(size.width * 4), rows_per_image: None };
        gpu.queue.write_texture(texture.as_image_copy(), bytemuck::cast_slice(&texels), rows, size);
        let sampler = gpu.device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("albedo"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        Self { view: texture.create_view(&wgpu::TextureViewDescriptor::default()), sampler }
    }
}
