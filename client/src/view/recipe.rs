//! How pipelines of the view passes are put together.

use std::num::NonZeroU32;

use mr360_shaders::layout::{Detail, Vertex};

use super::pipelines::DEPTH_FORMAT;
use crate::gpu::Gpu;

/// What differs between the pipelines.
#[derive(Clone)]
pub(super) struct Recipe<'a> {
    pub(super) label: &'a str,
    pub(super) vertex: &'a str,
    /// Entry point, and what it colours, if anything.
    pub(super) fragment: Option<(&'a str, Option<wgpu::TextureFormat>)>,
    pub(super) layouts: &'a [Option<&'a wgpu::BindGroupLayout>],
    pub(super) mesh: bool,
    /// The mesh has a second vertex buffer.
    pub(super) detailed: bool,
    pub(super) blend: bool,
    /// A second target.
    pub(super) beside: Option<wgpu::TextureFormat>,
    /// Seen in a mirror, what turned one way turns the other.
    pub(super) mirrored: bool,
    pub(super) cull: Option<wgpu::Face>,
    pub(super) depth: Option<wgpu::DepthStencilState>,
    pub(super) samples: u32,
    /// That a pass draws, 1 or 2.
    pub(super) views: u32,
    /// Of the fragment shader.
    pub(super) constants: &'a [(&'a str, f64)],
}

pub(super) fn build(gpu: &Gpu, module: &wgpu::ShaderModule, recipe: &Recipe<'_>) -> wgpu::RenderPipeline {
    let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(recipe.label),
        bind_group_layouts: recipe.layouts,
        immediate_size: 0,
    });
    let attributes = wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3, 2 => Float32x2];
    let details = wgpu::vertex_attr_array![3 => Float32x4, 4 => Float32x2, 5 => Unorm16x4];
    let buffer = |size: usize, attributes| {
        Some(wgpu::VertexBufferLayout { array_stride: size as u64, step_mode: wgpu::VertexStepMode::Vertex, attributes })
    };
    let mesh = [buffer(size_of::<Vertex>(), &attributes), buffer(size_of::<Detail>(), &details)];
    let buffers = match (recipe.mesh, recipe.detailed) {
        (false, _) => &mesh[..0],
        (true, false) => &mesh[..1],
        (true, true) => &mesh[..],
    };
    let blend = recipe.blend.then_some(wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING);
    let formats = recipe.fragment.and_then(|(_, format)| format).into_iter().chain(recipe.beside);
    let targets: Vec<_> = formats.map(|format| Some(wgpu::ColorTargetState { blend, ..format.into() })).collect();
    let strip = !recipe.mesh && recipe.vertex != "vs_fullscreen";
    let front_face = if recipe.mirrored { wgpu::FrontFace::Cw } else { wgpu::FrontFace::Ccw };
    let topology = if strip { wgpu::PrimitiveTopology::TriangleStrip } else { wgpu::PrimitiveTopology::TriangleList };
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(recipe.label),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module,
            entry_point: Some(recipe.vertex),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers,
        },
        primitive: wgpu::PrimitiveState { topology, front_face, cull_mode: recipe.cull, ..wgpu::PrimitiveState::default() },
        depth_stencil: recipe.depth.clone(),
        multisample: wgpu::MultisampleState { count: recipe.samples, ..wgpu::MultisampleState::default() },
        fragment: recipe.fragment.map(|(entry, _)| wgpu::FragmentState {
            module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions { constants: recipe.constants, ..Default::default() },
            targets: &targets,
        }),
        multiview_mask: multiview_mask(recipe.views),
        cache: None,
    })
}

/// Of a pass that draws so many views; none for one.
pub(super) fn multiview_mask(views: u32) -> Option<NonZeroU32> {
    NonZeroU32::new((1 << views) - 1).filter(|_| views > 1)
}

pub(super) fn depth(compare: wgpu::CompareFunction, bias: wgpu::DepthBiasState) -> wgpu::DepthStencilState {
    wgpu::DepthStencilState {
        format: DEPTH_FORMAT,
        depth_write_enabled: Some(true),
        depth_compare: Some(compare),
        stencil: wgpu::StencilState::default(),
        bias,
    }
}

/// Nothing lies before it, which depth is reversed for.
pub(super) fn nearer() -> wgpu::DepthStencilState {
    depth(wgpu::CompareFunction::Greater, wgpu::DepthBiasState::default())
}

pub(super) fn caster_depth() -> wgpu::DepthStencilState {
    depth(wgpu::CompareFunction::Less, wgpu::DepthBiasState::default())
}
