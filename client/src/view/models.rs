//! Geometry on the GPU, once for each shape or model, whatever the number of objects that show it.

use std::collections::{HashMap, HashSet};

use glam::Vec3;
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Geometry, Scene, Shape};
use wgpu::util::DeviceExt as _;

use crate::gpu::Gpu;
use crate::scene::material::{Surface, Texture};
use crate::scene::mesh::{Bounds, Mesh};
use crate::scene::model::{LoadedModel, Model, ModelError};
use crate::scene::occluder::{self, Sphere};
use crate::scene::shapes;

/// One draw's worth of geometry.
pub(super) struct GpuPart {
    pub(super) vertices: wgpu::Buffer,
    pub(super) indices: wgpu::Buffer,
    pub(super) index_count: u32,
    pub(super) surface: Surface,
    /// The file's textures.
    pub(super) material: wgpu::BindGroup,
}

/// A shape or a model.
pub(super) struct GpuModel {
    pub(super) parts: Vec<GpuPart>,
    pub(super) bounds: Bounds,
    /// A ball that fills its bounds.
    pub(super) round: bool,
    /// Mean reflectance of the file's surfaces in all directions.
    pub(super) albedo: Vec3,
    /// And in mirror directions.
    pub(super) specular: Vec3,
    /// What stands for a mesh where it hides the sky, in the object's frame.
    pub(super) cover: Vec<Sphere>,
}

/// What a surface sends back of light from everywhere, in all directions and in mirror directions: 1 together where it is
/// white, as the shaders' `ambient_weights` have it.
pub(super) fn reflectance(base_color: Vec3, metallic: f32) -> (Vec3, Vec3) {
    let metallic = metallic.clamp(0.0, 1.0);
    let f0 = Vec3::splat(0.04).lerp(base_color, metallic);
    // Fresnel's term over the hemisphere (Schlick).
    let specular = f0 + (1.0 - f0) / 21.0;
    (base_color * (1.0 - metallic) * (1.0 - specular), specular)
}

/// Everything that has been loaded and is still in the scene.
pub(super) struct Models {
    layout: wgpu::BindGroupLayout,
    sampler: wgpu::Sampler,
    white: wgpu::TextureView,
    plain: wgpu::BindGroup,
    loaded: HashMap<Geometry, Result<GpuModel, ModelError>>,
}

impl Models {
    pub(super) fn new(gpu: &Gpu, layout: &wgpu::BindGroupLayout) -> Self {
        let sampler = gpu.device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("material"),
            address_mode_u: wgpu::AddressMode::Repeat,
            address_mode_v: wgpu::AddressMode::Repeat,
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let white = upload(gpu, &Texture { width: 1, height: 1, levels: vec![vec![255; 4]], srgb: false, mean: Vec3::ONE });
        let plain = material_group(&gpu.device, layout, &white, &white, &sampler);
        Self { layout: layout.clone(), sampler, white, plain, loaded: HashMap::new() }
    }

    /// Uploads what the scene newly names and drops what it no longer does. A model that has not come yet is asked
    /// for again at the next call; a broken one is not.
    pub(super) fn follow(&mut self, gpu: &Gpu, scene: &Scene, model: &dyn Fn(AssetId) -> Option<LoadedModel>) {
        let objects = scene.objects.iter().map(|object| object.geometry);
        let named: HashSet<_> = objects.chain(scene.place.iter().map(|mesh| Geometry::Model(mesh.model))).collect();
        self.loaded.retain(|geometry, _| named.contains(geometry));
        for geometry in named {
            if self.loaded.contains_key(&geometry) {
                continue;
            }
            let loaded = match geometry {
                Geometry::Shape(shape) => Ok(self.shape(gpu, shape)),
                Geometry::Model(id) => match model(id) {
                    Some(model) => model.map(|model| self.model(gpu, &model)),
                    None => continue,
                },
            };
            self.loaded.insert(geometry, loaded);
        }
    }

    /// `None` while the asset has not come.
    pub(super) fn get(&self, geometry: &Geometry) -> Option<Result<&GpuModel, &ModelError>> {
        self.loaded.get(geometry).map(Result::as_ref)
    }

    /// Material group without textures.
    pub(super) fn plain(&self) -> &wgpu::BindGroup {
        &self.plain
    }

    fn shape(&self, gpu: &Gpu, shape: Shape) -> GpuModel {
        let mesh = shapes::mesh(shape);
        let surface = Surface {
            base_color: Vec3::splat(0.8),
            roughness: 1.0,
            metallic: 0.0,
            glass: false,
            double_sided: shape == Shape::Plane,
            base_color_texture: None,
            metallic_roughness_texture: None,
        };
        let (bounds, (albedo, specular)) = (mesh.bounds(), reflectance(surface.base_color, surface.metallic));
        let (parts, round) = (vec![part(gpu, &mesh, surface, self.plain.clone())], shape == Shape::Sphere);
        GpuModel { parts, bounds, round, albedo, specular, cover: Vec::new() }
    }

    fn model(&self, gpu: &Gpu, model: &Model) -> GpuModel {
        let Model { parts, textures, bounds } = model;
        let views: Vec<_> = textures.iter().map(|texture| upload(gpu, texture)).collect();
        let view = |at: Option<usize>| at.and_then(|at| views.get(at)).unwrap_or(&self.white);
        let (mut albedo, mut specular) = (Vec3::ZERO, Vec3::ZERO);
        let mut gpu_parts = Vec::with_capacity(parts.len());
        let total = parts.iter().map(|part| part.mesh.indices.len()).sum::<usize>().max(1) as f32;
        for one in parts {
            let mean = one.surface.base_color_texture.and_then(|at| textures.get(at)).map_or(Vec3::ONE, |texture| texture.mean);
            let (matt, mirrored) = reflectance(one.surface.base_color * mean, one.surface.metallic);
            let share = one.mesh.indices.len() as f32 / total;
            albedo += matt * share;
            specular += mirrored * share;
            let (color, metallic_roughness) = (view(one.surface.base_color_texture), view(one.surface.metallic_roughness_texture));
            let group = material_group(&gpu.device, &self.layout, color, metallic_roughness, &self.sampler);
            gpu_parts.push(part(gpu, &one.mesh, one.surface.clone(), group));
        }
        let cover = occluder::of_surface(parts.iter().map(|part| &part.mesh), bounds);
        GpuModel { parts: gpu_parts, bounds: *bounds, round: false, albedo, specular, cover }
    }
}

fn part(gpu: &Gpu, mesh: &Mesh, surface: Surface, material: wgpu::BindGroup) -> GpuPart {
    // Not mapped to be filled, which panics where the device has just been lost.
    let buffer = |label, contents: &[u8], usage| {
        let (size, usage) = (contents.len() as u64, usage | wgpu::BufferUsages::COPY_DST);
        let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false });
        gpu.queue.write_buffer(&buffer, 0, contents);
        buffer
    };
    GpuPart {
        vertices: buffer("vertices", bytemuck::cast_slice(&mesh.vertices), wgpu::BufferUsages::VERTEX),
        indices: buffer("indices", bytemuck::cast_slice(&mesh.indices), wgpu::BufferUsages::INDEX),
        index_count: mesh.indices.len() as u32,
        surface,
        material,
    }
}

fn upload(gpu: &Gpu, texture: &Texture) -> wgpu::TextureView {
    let descriptor = wgpu::TextureDescriptor {
        label: Some("model texture"),
        size: wgpu::Extent3d { width: texture.width, height: texture.height, depth_or_array_layers: 1 },
        mip_level_count: texture.levels.len() as u32,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: if texture.srgb { wgpu::TextureFormat::Rgba8UnormSrgb } else { wgpu::TextureFormat::Rgba8Unorm },
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    };
    let order = wgpu::util::TextureDataOrder::LayerMajor;
    let made = gpu.device.create_texture_with_data(&gpu.queue, &descriptor, order, &texture.levels.concat());
    made.create_view(&wgpu::TextureViewDescriptor::default())
}

fn material_group(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    base_color: &wgpu::TextureView,
    metallic_roughness: &wgpu::TextureView,
    sampler: &wgpu::Sampler,
) -> wgpu::BindGroup {
    device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("material"),
        layout,
        entries: &[
            wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(base_color) },
            wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::TextureView(metallic_roughness) },
            wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::Sampler(sampler) },
        ],
    })
}
