//! The reflection map: the left eye's panorama, lifted, without the narrow lights, with a full chain of mips.

use std::collections::HashMap;

use bytemuck::Zeroable;
use mr360_shaders::layout;
use mr360_shaders::source::Module;

use super::albedo::AlbedoTable;
use super::light::{FrameLight, map_cut};
use super::{VideoKind, sampler_entry, texture_entry};
use crate::gpu::{Gpu, GpuError};
use crate::view::timing::PassTimer;

/// Texels of the finest level. Cones finer than its texels are served from the video itself.
const WIDTH: u32 = 256;
const HEIGHT: u32 = 128;
const LEVELS: u32 = WIDTH.ilog2() + 1;
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;

pub(super) struct ReflectionMap {
    levels: Vec<wgpu::TextureView>,
    bind_group: wgpu::BindGroup,
    /// By the kind of video and the number of SH coefficients.
    lifts: HashMap<(VideoKind, usize), wgpu::RenderPipeline>,
    lift_shader: wgpu::ShaderModule,
    lift_layouts: [wgpu::BindGroupLayout; 2],
    lift_uniform: wgpu::Buffer,
    lift_group: wgpu::BindGroup,
    mip: wgpu::RenderPipeline,
    mip_groups: Vec<wgpu::BindGroup>,
}

/// Layout of group 2: the map and its sampler, the lobe's albedo and its sampler.
pub(crate) fn reflection_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("reflection"),
        entries: &[texture_entry(0), sampler_entry(1), texture_entry(2), sampler_entry(3)],
    })
}

impl ReflectionMap {
    pub(super) fn new(gpu: &Gpu, video_layout: &wgpu::BindGroupLayout) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("reflection"),
            size: wgpu::Extent3d { width: WIDTH, height: HEIGHT, depth_or_array_layers: 1 },
            mip_level_count: LEVELS,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let level = |base_mip_level| {
            texture.create_view(&wgpu::TextureViewDescriptor {
                base_mip_level,
                mip_level_count: Some(1),
                ..wgpu::TextureViewDescriptor::default()
            })
        };
        let levels: Vec<_> = (0..LEVELS).map(level).collect();
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("reflection"),
            address_mode_u: wgpu::AddressMode::Repeat,
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let albedo = AlbedoTable::new(gpu);
        let all = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let bind_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("reflection"),
            layout: &reflection_layout(device),
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&all) },
                wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::Sampler(&sampler) },
                wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::TextureView(&albedo.view) },
                wgpu::BindGroupEntry { binding: 3, resource: wgpu::BindingResource::Sampler(&albedo.sampler) },
            ],
        });
        let lift_layout = lift_layout(device);
        let mip_layout =
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some("mip"), entries: &[texture_entry(0)] });
        let lift_uniform = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("lift"),
            size: size_of::<layout::Lift>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let lift_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("lift"),
            layout: &lift_layout,
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: lift_uniform.as_entire_binding() }],
        });
        let mip_group = |finer| {
            let entries = &[wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(finer) }];
            device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("mip"), layout: &mip_layout, entries })
        };
        let mip_groups = levels.iter().take(levels.len() - 1).map(mip_group).collect();
        let lift_shader = gpu.shader(Module::EnvironmentLift)?;
        let lift_layouts = [lift_layout, video_layout.clone()];
        let mip = fullscreen(gpu, &gpu.shader(Module::EnvironmentMip)?, "fs_mip", &[Some(&mip_layout)], &[]);
        Ok(Self { levels, bind_group, lifts: HashMap::new(), lift_shader, lift_layouts, lift_uniform, lift_group, mip, mip_groups })
    }

    pub(super) fn bind_group(&self) -> &wgpu::BindGroup {
        &self.bind_group
    }

    pub(super) fn record(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        (kind, video): (VideoKind, &wgpu::BindGroup),
        eye_width: u32,
        light: &FrameLight,
        timer: &mut PassTimer,
    ) {
        gpu.queue.write_buffer(&self.lift_uniform, 0, bytemuck::bytes_of(&lift_uniform(eye_width, light)));
        let lift = self.lifts.entry((kind, light.sh_count)).or_insert_with(|| {
            let [own, video] = &self.lift_layouts;
            let [a, b, c, d] = kind.constants();
            let constants = [a, b, c, d, ("SH_COUNT", light.sh_count as f64)];
            fullscreen(gpu, &self.lift_shader, "fs_lift", &[Some(own), Some(video)], &constants)
        });
        let (first, last) = (0, self.levels.len() - 1);
        for (at, level) in self.levels.iter().enumerate() {
            let timestamps = if at == first {
                timer.begin("reflections")
            } else if at == last {
                timer.end()
            } else {
                None
            };
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("reflections"),
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: level,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
                })],
                timestamp_writes: timestamps,
                ..wgpu::RenderPassDescriptor::default()
            });
            if at == first {
                pass.set_pipeline(lift);
                pass.set_bind_group(0, &self.lift_group, &[]);
                pass.set_bind_group(1, video, &[]);
            } else {
                pass.set_pipeline(&self.mip);
                pass.set_bind_group(0, &self.mip_groups[at - 1], &[]);
            }
            pass.draw(0..3, 0..1);
        }
    }
}

fn lift_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("lift"),
        entries: &[wgpu::BindGroupLayoutEntry {
            binding: 0,
            visibility: wgpu::ShaderStages::FRAGMENT,
            ty: wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None },
            count: None,
        }],
    })
}

/// Bilinear samples that each cover two video texels, enough of them for a texel of the map, at most 4 × 4; and the
/// lights to cut out.
fn lift_uniform(eye_width: u32, light: &FrameLight) -> layout::Lift {
    let mut uniform = layout::Lift {
        sh: light.sh.map(|c| c.extend(0.0).to_array()),
        size_px: [WIDTH, HEIGHT],
        samples: eye_width.div_ceil(2 * WIDTH).clamp(1, 4),
        ..layout::Lift::zeroed()
    };
    let texel = std::f32::consts::TAU / WIDTH as f32;
    let cuts = light.lights.iter().map(|light| (light.direction, map_cut(light.solid_angle_sr))).filter(|(_, cut)| cut.share > 0.0);
    for (slot, (direction, cut)) in uniform.cuts.iter_mut().zip(cuts) {
        *slot = layout::Cut {
            direction: direction.to_array(),
            cos_inner: (cut.radius + 0.5 * texel).cos(),
            cos_outer: (cut.radius + 1.5 * texel).cos(),
            share: cut.share,
            ..layout::Cut::zeroed()
        };
        uniform.cut_count += 1;
    }
    uniform
}

fn fullscreen(
    gpu: &Gpu,
    shader: &wgpu::ShaderModule,
    entry: &str,
    layouts: &[Option<&wgpu::BindGroupLayout>],
    constants: &[(&str, f64)],
) -> wgpu::RenderPipeline {
    let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(entry),
        bind_group_layouts: layouts,
        immediate_size: 0,
    });
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(entry),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module: shader,
            entry_point: Some("vs_fullscreen"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: shader,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
            targets: &[Some(FORMAT.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}
