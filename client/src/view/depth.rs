//! Depth of finished views, for presenters that want it: a headset's compositor shows them from where the head has moved meanwhile.

use std::collections::HashMap;

use mr360_shaders::source::Module;

use super::pipelines::{DEPTH_FORMAT, Layouts, flag};
use super::resources::{VIEW_STRIDE, texture, texture_view};
use super::{Renderer, depth_attachment};
use crate::environment::texture_entry;
use crate::gpu::{Gpu, GpuError};

/// Pipelines that write a layer's depth to a whole picture.
pub(super) struct DepthPass {
    shader: wgpu::ShaderModule,
    /// By samples a pixel of the layer, and whether the background has a distance.
    made: HashMap<(u32, bool), wgpu::RenderPipeline>,
    /// In place of a layer where nothing was drawn.
    nothing: wgpu::TextureView,
}

impl DepthPass {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let bound = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::RENDER_ATTACHMENT;
        let nothing = texture_view(&texture(&gpu.device, ("no depth", 1), (1, 1), 1, 1, DEPTH_FORMAT, bound));
        Ok(Self { shader: gpu.shader(Module::Depth)?, made: HashMap::new(), nothing })
    }

    fn pipeline(&mut self, gpu: &Gpu, layouts: &Layouts, (samples, backed): (u32, bool)) -> &wgpu::RenderPipeline {
        self.made.entry((samples, backed)).or_insert_with(|| make(gpu, &self.shader, layouts, (samples, backed)))
    }
}

impl Renderer {
    /// Keeps the depth of what is drawn from the next frame on, or no longer, so that it can be written.
    pub fn set_keeps_depth(&mut self, keeps: bool) {
        self.keeps_depth = keeps;
    }

    /// Records the depth of the views that were recorded last, in their order, to targets of [`DEPTH_FORMAT`] and of their size: 1 at
    /// [`Camera::NEAR_M`](crate::camera::Camera::NEAR_M), 0 at infinity, where the panorama is seen unless it has a distance, and then of that.
    /// Blended surfaces have none.
    ///
    /// # Errors
    /// [`GpuError::Shader`] when the build lacks a shader file.
    pub fn write_depth(&mut self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, targets: &[&wgpu::TextureView]) -> Result<(), GpuError> {
        let mut pass_kind = match self.depth.take() {
            Some(kind) => kind,
            None => DepthPass::new(gpu)?,
        };
        for (at, target) in targets.iter().enumerate() {
            // Layers of both eyes are in one.
            let (layer, view) = if self.together { (self.layers.first(), at as u32) } else { (self.layers.get(at), 0) };
            let layer = layer.filter(|_| self.keeps_depth && self.drawn.get(at).copied().unwrap_or(false));
            let (depth, samples) = match layer {
                Some((_, layer)) => (layer.depth_of(view), self.samples),
                None => (pass_kind.nothing.clone(), 1),
            };
            let shown = layer.is_some() || self.backed;
            let group = shown.then(|| group(gpu, &depth, samples));
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("depth"),
                depth_stencil_attachment: Some(depth_attachment(target, 0.0, wgpu::StoreOp::Store)),
                ..wgpu::RenderPassDescriptor::default()
            });
            let Some(group) = group else { continue };
            pass.set_pipeline(pass_kind.pipeline(gpu, &self.layouts, (samples, self.backed)));
            pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
            pass.set_bind_group(1, &group, &[]);
            pass.draw(0..3, 0..1);
        }
        self.depth = Some(pass_kind);
        Ok(())
    }
}

/// Where the shader looks for a layer's depth.
fn layout(gpu: &Gpu, samples: u32) -> wgpu::BindGroupLayout {
    let multisampled = samples > 1;
    let ty = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Depth,
        view_dimension: wgpu::TextureViewDimension::D2,
        multisampled,
    };
    let entries = [wgpu::BindGroupLayoutEntry { ty, ..texture_entry(u32::from(!multisampled)) }];
    gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some("depth"), entries: &entries })
}

fn group(gpu: &Gpu, depth: &wgpu::TextureView, samples: u32) -> wgpu::BindGroup {
    let entries = [wgpu::BindGroupEntry { binding: u32::from(samples == 1), resource: wgpu::BindingResource::TextureView(depth) }];
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("depth"), layout: &layout(gpu, samples), entries: &entries })
}

fn make(gpu: &Gpu, shader: &wgpu::ShaderModule, layouts: &Layouts, (samples, backed): (u32, bool)) -> wgpu::RenderPipeline {
    let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("depth"),
        bind_group_layouts: &[Some(&layouts.frame), Some(&layout(gpu, samples))],
        immediate_size: 0,
    });
    let constants = [("PARALLAX", flag(backed)), ("SAMPLES", f64::from(samples))];
    let (entry, constants) = if samples > 1 { ("fs_depth_samples", &constants[..]) } else { ("fs_depth_single", &constants[..1]) };
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("depth"),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module: shader,
            entry_point: Some("vs_fullscreen"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH_FORMAT,
            depth_write_enabled: Some(true),
            depth_compare: Some(wgpu::CompareFunction::Always),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: shader,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
            targets: &[],
        }),
        multiview_mask: None,
        cache: None,
    })
}
