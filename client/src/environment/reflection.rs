//! The reflection map: the left eye's panorama on a cube, lifted, without the narrow lights, with a full chain of mips; and
//! what GGX lobes of several widths see of it. A cube has no seam and no poles, and its texels differ in size by no more than
//! a factor of five.

use std::collections::HashMap;

use bytemuck::Zeroable;
use mr360_shaders::layout;
use mr360_shaders::lobe::{MAX_TAPS, PREFILTER_ALPHA, PREFILTER_LEVELS, PREFILTER_RATIO, taps};
use mr360_shaders::source::{Module, Reflections};

use super::albedo::AlbedoTable;
use super::light::{FrameLight, map_cut};
use super::{VideoKind, sampler_entry, texture_entry};
use crate::gpu::{Gpu, GpuError};
use crate::view::timing::PassTimer;

/// Texels along a side of a face: 1.8° in its middle. Cones finer than that are served from the video itself.
const SIDE: u32 = 64;
const LEVELS: u32 = SIDE.ilog2() + 1;
/// Texels along a side of the finest prefiltered level, whose lobe is 4.5° across at half its height.
const PREFILTER_SIDE: u32 = 64;
/// Taps of a texel, by level: the lobe of the finest spans few texels, and those of the coarser are few themselves.
const PREFILTER_TAPS: [usize; PREFILTER_LEVELS as usize] = [16, 48, 64, 64, 64];
/// Texels of a tap over its share of the lobe. Trilinear texels are wider than their size: at 1 the lobe would be blurred twice.
const TAP_SIZE: f32 = 0.7;
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
/// Texels along a side of a workgroup.
const GROUP: u32 = 8;

/// How reflections are looked up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct How {
    pub(crate) method: Reflections,
    /// Pictures are resampled finely.
    pub(crate) fine: bool,
    /// The finest prefiltered level that is looked into; none where nothing is.
    pub(crate) lobes_from: Option<u32>,
}

pub(super) struct ReflectionMap {
    bind_group: wgpu::BindGroup,
    /// By the kind of video and the number of SH coefficients.
    lifts: HashMap<(VideoKind, usize), wgpu::ComputePipeline>,
    lift_shader: wgpu::ShaderModule,
    lift_layouts: [wgpu::BindGroupLayout; 2],
    lift_uniform: wgpu::Buffer,
    lift_group: wgpu::BindGroup,
    mip: wgpu::ComputePipeline,
    /// From each level to the next.
    mip_groups: Vec<wgpu::BindGroup>,
    prefilter: wgpu::ComputePipeline,
    prefilter_groups: Vec<wgpu::BindGroup>,
}

/// Layout of group 2: the map and its sampler, the lobe's albedo and its sampler, the prefiltered maps.
pub(crate) fn reflection_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("reflection"),
        entries: &[cube_entry(0), sampler_entry(1), texture_entry(2), sampler_entry(3), cube_entry(4)],
    })
}

fn cube_entry(binding: u32) -> wgpu::BindGroupLayoutEntry {
    view_entry(binding, wgpu::TextureViewDimension::Cube)
}

fn view_entry(binding: u32, view_dimension: wgpu::TextureViewDimension) -> wgpu::BindGroupLayoutEntry {
    let sample_type = wgpu::TextureSampleType::Float { filterable: true };
    let ty = wgpu::BindingType::Texture { sample_type, view_dimension, multisampled: false };
    wgpu::BindGroupLayoutEntry { ty, ..texture_entry(binding) }
}

fn storage_entry(binding: u32) -> wgpu::BindGroupLayoutEntry {
    let (access, view_dimension) = (wgpu::StorageTextureAccess::WriteOnly, wgpu::TextureViewDimension::D2Array);
    let ty = wgpu::BindingType::StorageTexture { access, format: FORMAT, view_dimension };
    wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::COMPUTE, ty, count: None }
}

fn uniform_entry(binding: u32) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None };
    wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::COMPUTE, ty, count: None }
}

/// Six faces with mips: as a cube to look into, and level by level to write.
struct Cube {
    whole: wgpu::TextureView,
    levels: Vec<wgpu::TextureView>,
}

impl Cube {
    fn new(device: &wgpu::Device, label: &str, side: u32, levels: u32) -> Self {
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some(label),
            size: wgpu::Extent3d { width: side, height: side, depth_or_array_layers: 6 },
            mip_level_count: levels,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let level = |base_mip_level| {
            texture.create_view(&wgpu::TextureViewDescriptor {
                dimension: Some(wgpu::TextureViewDimension::D2Array),
                base_mip_level,
                mip_level_count: Some(1),
                ..wgpu::TextureViewDescriptor::default()
            })
        };
        let dimension = Some(wgpu::TextureViewDimension::Cube);
        let whole = texture.create_view(&wgpu::TextureViewDescriptor { dimension, ..wgpu::TextureViewDescriptor::default() });
        Self { whole, levels: (0..levels).map(level).collect() }
    }
}

impl ReflectionMap {
    pub(super) fn new(gpu: &Gpu, video_layout: &wgpu::BindGroupLayout) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let sharp = Cube::new(device, "reflection", SIDE, LEVELS);
        let filtered = Cube::new(device, "prefiltered", PREFILTER_SIDE, PREFILTER_LEVELS);
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("reflection"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let albedo = AlbedoTable::new(gpu);
        let bind_group = group(
            device,
            "reflection",
            &reflection_layout(device),
            &[
                wgpu::BindingResource::TextureView(&sharp.whole),
                wgpu::BindingResource::Sampler(&sampler),
                wgpu::BindingResource::TextureView(&albedo.view),
                wgpu::BindingResource::Sampler(&albedo.sampler),
                wgpu::BindingResource::TextureView(&filtered.whole),
            ],
        );
        let make = |label, entries: &[_]| device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries });
        let lift_layout = make("lift", &[uniform_entry(0), storage_entry(1)]);
        let lift_uniform = uniform(device, "lift", size_of::<layout::Lift>());
        let lift_resources = [lift_uniform.as_entire_binding(), wgpu::BindingResource::TextureView(&sharp.levels[0])];
        let lift_group = group(device, "lift", &lift_layout, &lift_resources);
        let mip_layout = make("mip", &[view_entry(0, wgpu::TextureViewDimension::D2Array), storage_entry(1)]);
        let mip_groups = sharp.levels.windows(2).map(|pair| {
            let resources = [wgpu::BindingResource::TextureView(&pair[0]), wgpu::BindingResource::TextureView(&pair[1])];
            group(device, "mip", &mip_layout, &resources)
        });
        let prefilter_layout = make("prefilter", &[uniform_entry(0), cube_entry(1), sampler_entry(2), storage_entry(3)]);
        let prefilter_groups = filtered.levels.iter().enumerate().map(|(at, level)| {
            let settings = uniform(device, "prefilter", size_of::<layout::Prefilter>());
            gpu.queue.write_buffer(&settings, 0, bytemuck::bytes_of(&prefilter_uniform(at)));
            let resources = [
                settings.as_entire_binding(),
                wgpu::BindingResource::TextureView(&sharp.whole),
                wgpu::BindingResource::Sampler(&sampler),
                wgpu::BindingResource::TextureView(level),
            ];
            group(device, "prefilter", &prefilter_layout, &resources)
        });
        Ok(Self {
            bind_group,
            lifts: HashMap::new(),
            lift_shader: gpu.shader(Module::EnvironmentLift)?,
            mip_groups: mip_groups.collect(),
            mip: pipeline(gpu, &gpu.shader(Module::EnvironmentMip)?, "cs_mip", &[Some(&mip_layout)], &[]),
            prefilter_groups: prefilter_groups.collect(),
            prefilter: pipeline(gpu, &gpu.shader(Module::EnvironmentPrefilter)?, "cs_prefilter", &[Some(&prefilter_layout)], &[]),
            lift_layouts: [lift_layout, video_layout.clone()],
            lift_uniform,
            lift_group,
        })
    }

    pub(super) fn bind_group(&self) -> &wgpu::BindGroup {
        &self.bind_group
    }

    /// Lift and mips, and of the prefiltered maps those that are looked into.
    pub(super) fn record(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        (kind, video): (VideoKind, &wgpu::BindGroup),
        eye_width: u32,
        (light, how): (&FrameLight, How),
        timer: &mut PassTimer,
    ) {
        gpu.queue.write_buffer(&self.lift_uniform, 0, bytemuck::bytes_of(&lift_uniform(eye_width, how.fine, light)));
        let lift = self.lifts.entry((kind, light.sh_count)).or_insert_with(|| {
            let [own, video] = &self.lift_layouts;
            let [a, b, c, d] = kind.constants();
            let constants = [a, b, c, d, ("SH_COUNT", light.sh_count as f64)];
            pipeline(gpu, &self.lift_shader, "cs_lift", &[Some(own), Some(video)], &constants)
        });
        let timestamp_writes = timer.compute_pass("reflections");
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("reflections"), timestamp_writes });
        let faces = |pass: &mut wgpu::ComputePass<'_>, group: &wgpu::BindGroup, side: u32| {
            pass.set_bind_group(0, group, &[]);
            pass.dispatch_workgroups(side.div_ceil(GROUP), side.div_ceil(GROUP), 6);
        };
        pass.set_pipeline(lift);
        pass.set_bind_group(1, video, &[]);
        faces(&mut pass, &self.lift_group, SIDE);
        pass.set_pipeline(&self.mip);
        for (at, group) in self.mip_groups.iter().enumerate() {
            faces(&mut pass, group, SIDE >> (at + 1));
        }
        if let Some(finest) = how.lobes_from.filter(|_| how.method == Reflections::Prefiltered) {
            pass.set_pipeline(&self.prefilter);
            for (at, group) in self.prefilter_groups.iter().enumerate().skip(finest as usize) {
                faces(&mut pass, group, PREFILTER_SIDE >> at);
            }
        }
    }
}

/// Most samples along a side of a texel: with them all of a picture of 1600 columns counts, or of 4800 where it is resampled finely.
const LIFT_SAMPLES: u32 = 4;
const FINE_LIFT_SAMPLES: u32 = 12;

/// Bilinear samples that each cover two video texels, enough of them for a texel in the middle of a face; and the lights to cut out.
fn lift_uniform(eye_width: u32, fine: bool, light: &FrameLight) -> layout::Lift {
    let texel = 2.0 / SIDE as f32;
    let samples = (eye_width as f32 / std::f32::consts::TAU * texel / 2.0).ceil() as u32;
    let mut uniform = layout::Lift {
        sh: light.sh.map(|c| c.extend(0.0).to_array()),
        size_px: SIDE,
        samples: samples.clamp(1, if fine { FINE_LIFT_SAMPLES } else { LIFT_SAMPLES }),
        ..layout::Lift::zeroed()
    };
    let cuts = light.lights.iter().map(|light| (light.direction, map_cut(light.solid_angle_sr))).filter(|(_, cut)| cut.share > 0.0);
    for (slot, (direction, cut)) in uniform.cuts.iter_mut().zip(cuts) {
        *slot = layout::Cut {
            direction: direction.to_array(),
            cos_inner: (cut.radius + 0.5 * texel).cos(),
            cos_outer: (cut.radius + texel).cos(),
            share: cut.share,
            ..layout::Cut::zeroed()
        };
        uniform.cut_count += 1;
    }
    uniform
}

fn prefilter_uniform(level: usize) -> layout::Prefilter {
    let texel_sr = 4.0 * std::f32::consts::PI / (6 * SIDE * SIDE) as f32;
    let count = PREFILTER_TAPS.get(level).copied().unwrap_or(MAX_TAPS);
    let mut uniform = layout::Prefilter { count: count as u32, size_px: PREFILTER_SIDE >> level, ..layout::Prefilter::zeroed() };
    for (slot, tap) in uniform.taps.iter_mut().zip(taps(PREFILTER_ALPHA * PREFILTER_RATIO.powi(level as i32), count)) {
        let mip = 0.5 * (TAP_SIZE * tap.solid_angle_sr / texel_sr).log2();
        *slot = tap.direction.extend(mip.clamp(0.0, (LEVELS - 1) as f32)).to_array();
    }
    uniform
}

fn uniform(device: &wgpu::Device, label: &str, size: usize) -> wgpu::Buffer {
    let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST;
    device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size: size as u64, usage, mapped_at_creation: false })
}

/// Resources at bindings 0, 1, 2, …
fn group(device: &wgpu::Device, label: &str, layout: &wgpu::BindGroupLayout, resources: &[wgpu::BindingResource<'_>]) -> wgpu::BindGroup {
    let entries: Vec<_> =
        (0..).zip(resources).map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource: resource.clone() }).collect();
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some(label), layout, entries: &entries })
}

fn pipeline(
    gpu: &Gpu,
    module: &wgpu::ShaderModule,
    entry: &str,
    layouts: &[Option<&wgpu::BindGroupLayout>],
    constants: &[(&str, f64)],
) -> wgpu::ComputePipeline {
    let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(entry),
        bind_group_layouts: layouts,
        immediate_size: 0,
    });
    gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(entry),
        layout: Some(&layout),
        module,
        entry_point: Some(entry),
        compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
        cache: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_columns_of_a_picture_count_as_far_as_asked() {
        let light = FrameLight::default();
        let samples = |width, fine| lift_uniform(width, fine, &light).samples;
        assert_eq!([1, 400, 1600, 3840, 16_384].map(|width| samples(width, false)), [1, 1, 4, 4, 4]);
        assert_eq!([1, 400, 1600, 3840, 16_384].map(|width| samples(width, true)), [1, 1, 4, 10, 12]);
        // Each sample covers two texels in the middle of a face.
        let texels = 4800.0 / std::f32::consts::TAU * 2.0 / SIDE as f32;
        assert!(2.0 * samples(4800, true) as f32 >= texels, "{texels}");
    }
}
