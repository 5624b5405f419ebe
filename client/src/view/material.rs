//! Materials on the GPU: textures, samplers, and which parts of the material shader a draw needs.

use std::collections::HashMap;

use bytemuck::Zeroable;
use glam::Vec3;
use mr360_shaders::layout;
use mr360_shaders::source::Alpha;
use wgpu::util::DeviceExt as _;

use crate::environment::{sampler_entry, texture_entry};
use crate::gpu::Gpu;
use crate::scene::material::{AlphaMode, PLAIN_UV, Surface, TextureMap};
use crate::scene::texture::{Content, Sampling, Texture, Wrap};

/// What of `material.wgsl` a draw uses; each has a pipeline of its own. The default is an object's plain material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, PartialOrd, Ord)]
pub(super) struct Look {
    /// In the order of [`Surface::textures`].
    maps: [bool; 5],
    uv_transforms: bool,
    emissive: bool,
    unlit: bool,
    tangents: bool,
    /// The mesh has a second vertex buffer.
    pub(super) detailed: bool,
    pub(super) alpha: Alpha,
}

impl Look {
    pub(super) fn of(surface: &Surface, details: &[layout::Detail]) -> Self {
        let mut maps = surface.textures().map(|map| map.is_some());
        let emissive = surface.emission != Vec3::ZERO && !surface.unlit;
        maps[4] &= emissive;
        if surface.unlit {
            maps[1..].fill(false);
        }
        let own = |map: &TextureMap| map.second_uv || map.transform != PLAIN_UV;
        Self {
            uv_transforms: surface.textures().iter().zip(maps).any(|(map, used)| used && map.as_ref().is_some_and(own)),
            emissive,
            unlit: surface.unlit,
            tangents: maps[2] && details.first().is_some_and(|detail| detail.tangent[3] != 0.0),
            detailed: !details.is_empty(),
            alpha: match surface.alpha_mode {
                AlphaMode::Opaque => Alpha::Opaque,
                AlphaMode::Mask(_) => Alpha::Mask,
                AlphaMode::Blend => Alpha::Blend,
            },
            maps,
        }
    }

    /// A texture says how rough each place is, or normals spread.
    pub(super) fn varies(&self) -> bool {
        self.maps[1] || self.maps[2]
    }

    /// Without blending: glass shows what is behind it in its own way.
    pub(super) fn solid(self) -> Self {
        let alpha = if self.alpha == Alpha::Blend { Alpha::Opaque } else { self.alpha };
        Self { alpha, ..self }
    }

    /// What counts for how much of a light it lets through.
    pub(super) fn cutout(&self) -> Self {
        let base_color = self.maps[0];
        Self {
            maps: [base_color, false, false, false, false],
            uv_transforms: base_color && self.uv_transforms,
            detailed: self.detailed,
            alpha: self.alpha,
            ..Self::default()
        }
    }

    /// Of the fragment shader.
    pub(super) fn constants(&self) -> Vec<(&'static str, f64)> {
        let flags = [
            ("METALLIC_ROUGHNESS_MAP", self.maps[1]),
            ("NORMAL_MAP", self.maps[2]),
            ("OCCLUSION_MAP", self.maps[3]),
            ("EMISSION_MAP", self.maps[4]),
            ("EMISSIVE", self.emissive),
            ("UNLIT", self.unlit),
            ("TANGENTS", self.tangents),
        ];
        let flag = |(name, value)| (name, f64::from(u8::from(value)));
        self.cutout_constants().into_iter().chain(flags.map(flag)).collect()
    }

    /// Of the casters' fragment shader, which has no others.
    pub(super) fn cutout_constants(&self) -> [(&'static str, f64); 3] {
        let flag = |value: bool| f64::from(u8::from(value));
        [("BASE_COLOR_MAP", flag(self.maps[0])), ("UV_TRANSFORMS", flag(self.uv_transforms)), ("ALPHA", f64::from(self.alpha.index()))]
    }
}

/// Layout of the material's group: its uniform, textures, samplers.
pub(super) fn layout_entries() -> Vec<wgpu::BindGroupLayoutEntry> {
    let uniform = wgpu::BindGroupLayoutEntry {
        binding: 0,
        visibility: wgpu::ShaderStages::FRAGMENT,
        ty: wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    std::iter::once(uniform).chain((1..=5).map(texture_entry)).chain((6..=10).map(sampler_entry)).collect()
}

/// Makes groups of materials.
pub(super) struct Materials {
    layout: wgpu::BindGroupLayout,
    samplers: HashMap<Sampling, wgpu::Sampler>,
    white: wgpu::TextureView,
}

impl Materials {
    pub(super) fn new(gpu: &Gpu, layout: &wgpu::BindGroupLayout) -> Self {
        let white = Texture { width: 1, height: 1, levels: vec![vec![255; 4]], content: Content::Data, mean: Vec3::ONE };
        Self { layout: layout.clone(), samplers: HashMap::new(), white: upload(gpu, &white) }
    }

    /// The group of a surface, given the views of its model's textures.
    pub(super) fn group(&mut self, gpu: &Gpu, surface: &Surface, views: &[wgpu::TextureView]) -> wgpu::BindGroup {
        let textures = surface.textures();
        let sampling = textures.map(|map| map.map_or_else(Sampling::default, |map| map.sampling));
        for one in sampling {
            self.samplers.entry(one).or_insert_with(|| sampler(gpu, one));
        }
        let uniform = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("material"),
            size: size_of::<layout::Material>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        gpu.queue.write_buffer(&uniform, 0, bytemuck::bytes_of(&material(surface)));
        let mut entries = vec![wgpu::BindGroupEntry { binding: 0, resource: uniform.as_entire_binding() }];
        for (binding, map) in (1..).zip(textures) {
            let view = map.and_then(|map| views.get(map.texture)).unwrap_or(&self.white);
            entries.push(wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::TextureView(view) });
        }
        for (binding, sampling) in (6..).zip(sampling) {
            if let Some(sampler) = self.samplers.get(&sampling) {
                entries.push(wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::Sampler(sampler) });
            }
        }
        gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("material"), layout: &self.layout, entries: &entries })
    }
}

fn material(surface: &Surface) -> layout::Material {
    let map = |map: Option<TextureMap>| {
        let [u, v] = map.map_or(PLAIN_UV, |map| map.transform);
        let second = f32::from(u8::from(map.is_some_and(|map| map.second_uv)));
        layout::TextureMap { u: u.extend(second).to_array(), v: v.extend(0.0).to_array() }
    };
    layout::Material {
        maps: surface.textures().map(map),
        emission: surface.emission.to_array(),
        normal_scale: surface.normal_scale,
        occlusion_strength: surface.occlusion_strength,
        alpha: surface.alpha,
        alpha_cutoff: match surface.alpha_mode {
            AlphaMode::Mask(cutoff) => cutoff,
            AlphaMode::Opaque | AlphaMode::Blend => 0.0,
        },
        ..layout::Material::zeroed()
    }
}

fn sampler(gpu: &Gpu, sampling: Sampling) -> wgpu::Sampler {
    let wrap = sampling.wrap.map(|wrap| match wrap {
        Wrap::Repeat => wgpu::AddressMode::Repeat,
        Wrap::Mirror => wgpu::AddressMode::MirrorRepeat,
        Wrap::Clamp => wgpu::AddressMode::ClampToEdge,
    });
    let filter = |linear| if linear { wgpu::FilterMode::Linear } else { wgpu::FilterMode::Nearest };
    gpu.device.create_sampler(&wgpu::SamplerDescriptor {
        label: Some("material"),
        address_mode_u: wrap[0],
        address_mode_v: wrap[1],
        mag_filter: filter(sampling.magnify_linear),
        min_filter: filter(sampling.minify_linear),
        mipmap_filter: match sampling.mips_linear {
            Some(true) => wgpu::MipmapFilterMode::Linear,
            _ => wgpu::MipmapFilterMode::Nearest,
        },
        // Without mips the first level alone; a maximum of 0 would take every footprint for a magnified one.
        lod_max_clamp: if sampling.mips_linear.is_some() { 32.0 } else { 0.25 },
        ..wgpu::SamplerDescriptor::default()
    })
}

pub(super) fn upload(gpu: &Gpu, texture: &Texture) -> wgpu::TextureView {
    let descriptor = wgpu::TextureDescriptor {
        label: Some("model texture"),
        size: wgpu::Extent3d { width: texture.width, height: texture.height, depth_or_array_layers: 1 },
        mip_level_count: texture.levels.len() as u32,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: match texture.content {
            Content::Colour => wgpu::TextureFormat::Rgba8UnormSrgb,
            Content::Data | Content::Normals => wgpu::TextureFormat::Rgba8Unorm,
        },
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    };
    let order = wgpu::util::TextureDataOrder::LayerMajor;
    let made = gpu.device.create_texture_with_data(&gpu.queue, &descriptor, order, &texture.levels.concat());
    made.create_view(&wgpu::TextureViewDescriptor::default())
}
