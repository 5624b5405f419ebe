//! Geometry on the GPU, once for each shape or model, whatever the number of objects that show it.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use glam::Vec3;
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Geometry, Object, Playback, Scene, Shape};

use super::material::{Look, Materials, upload};
use super::poses::{Deformer, MAX_POSED_VERTICES, Playing, Sources};
use super::stage::ModelFault;
use super::timing::PassTimer;
use crate::gpu::{Gpu, GpuError};
use crate::scene::material::Surface;
use crate::scene::mesh::Bounds;
use crate::scene::model::{LoadedModel, Model, ModelError, Part};
use crate::scene::occluder::{self, Sphere};
use crate::scene::rig::Rig;
use crate::scene::shapes;

/// One draw's worth of geometry.
pub(super) struct GpuPart {
    pub(super) vertices: wgpu::Buffer,
    pub(super) details: Option<wgpu::Buffer>,
    pub(super) indices: wgpu::Buffer,
    pub(super) index_count: u32,
    pub(super) surface: Surface,
    pub(super) look: Look,
    /// The file's textures and factors.
    pub(super) material: wgpu::BindGroup,
    /// Of its bounds, at rest.
    pub(super) center: Vec3,
}

/// A shape or a model.
pub(super) struct GpuModel {
    pub(super) parts: Vec<GpuPart>,
    bounds: Bounds,
    /// A ball that fills its bounds.
    pub(super) round: bool,
    /// Mean reflectance of the file's surfaces in all directions.
    pub(super) albedo: Vec3,
    /// And in mirror directions.
    pub(super) specular: Vec3,
    /// What stands for a mesh at rest where it hides the sky, in the object's frame.
    pub(super) cover: Vec<Sphere>,
    source: Option<Arc<Model>>,
    /// Made for the first animation that is played.
    sources: Option<Sources>,
    /// The animations that objects play just now.
    playing: HashMap<usize, Playing>,
}

impl GpuModel {
    fn rig(&self) -> Option<&Rig> {
        self.source.as_ref()?.rig.as_ref()
    }

    /// Around all parts: at rest, or in all poses of an animation.
    pub(super) fn bounds(&self, animation: Option<usize>) -> Bounds {
        animation.and_then(|at| self.rig()?.bounds.get(at).copied()).unwrap_or(self.bounds)
    }

    /// Which animation an object plays; `None` for none.
    ///
    /// # Errors
    /// [`ModelFault::NoSuchAnimation`] with the names that there are.
    pub(super) fn animation(&self, playback: &Playback) -> Result<Option<usize>, ModelFault> {
        let animations = self.rig().map_or(&[][..], |rig| &rig.animations);
        match playback {
            Playback::Still => Ok(None),
            Playback::First => Ok((!animations.is_empty()).then_some(0)),
            Playback::Named(name) => match animations.iter().position(|animation| animation.name == *name) {
                Some(at) => Ok(Some(at)),
                None => {
                    let names = animations.iter().map(|animation| animation.name.clone()).collect();
                    Err(ModelFault::NoSuchAnimation { name: name.clone(), names })
                }
            },
        }
    }

    /// False for an animation that would take more memory than there is for all.
    pub(super) fn plays(&self, animation: usize) -> bool {
        self.playing.contains_key(&animation) || self.rig().is_none_or(|rig| rig.moving.is_empty())
    }

    fn posed_vertices(&self) -> usize {
        self.sources.as_ref().map_or(0, Sources::vertices)
    }

    /// Vertices of a part, deformed where an animation moves it.
    pub(super) fn vertices<'a>(&'a self, at: usize, part: &'a GpuPart, animation: Option<usize>) -> &'a wgpu::Buffer {
        animation.and_then(|animation| self.playing.get(&animation)?.vertices(at)).unwrap_or(&part.vertices)
    }
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
    materials: Materials,
    plain: wgpu::BindGroup,
    deformer: Deformer,
    loaded: HashMap<Geometry, Result<GpuModel, ModelError>>,
}

impl Models {
    pub(super) fn new(gpu: &Gpu, layout: &wgpu::BindGroupLayout) -> Result<Self, GpuError> {
        let mut materials = Materials::new(gpu, layout);
        let plain = materials.group(gpu, &Surface::default(), &[]);
        Ok(Self { materials, plain, deformer: Deformer::new(gpu)?, loaded: HashMap::new() })
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
                    Some(model) => model.map(|model| self.model(gpu, model)),
                    None => continue,
                },
            };
            self.loaded.insert(geometry, loaded);
        }
        self.follow_animations(gpu, &scene.objects);
    }

    fn follow_animations(&mut self, gpu: &Gpu, objects: &[Object]) {
        let animation_of = |model: &GpuModel, object: &Object| model.animation(&object.animation).ok().flatten();
        for (geometry, model) in &mut self.loaded {
            let Ok(model) = model else { continue };
            let own = objects.iter().filter(|object| object.geometry == *geometry);
            let wanted: Vec<usize> = own.filter_map(|object| animation_of(model, object)).collect();
            model.playing.retain(|animation, _| wanted.contains(animation));
        }
        let models = self.loaded.values().filter_map(|model| model.as_ref().ok());
        let mut posed: usize = models.map(|model| model.posed_vertices() * model.playing.len()).sum();
        for object in objects {
            let Some(Ok(model)) = self.loaded.get_mut(&object.geometry) else { continue };
            let Some(animation) = animation_of(model, object).filter(|animation| !model.plays(*animation)) else { continue };
            let Some(source) = model.source.clone() else { continue };
            let Some(rig) = &source.rig else { continue };
            let sources = model.sources.get_or_insert_with(|| Sources::new(gpu, rig));
            if posed + sources.vertices() <= MAX_POSED_VERTICES {
                posed += sources.vertices();
                model.playing.insert(animation, Playing::new(gpu, &self.deformer, sources, &source, rig, animation));
            }
        }
    }

    /// Records the poses of the animations that are `wanted`, for a time of the broadcast; returns whether one changed.
    pub(super) fn deform(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        timer: &mut PassTimer,
        time_us: u64,
        wanted: &dyn Fn(&Geometry, usize) -> bool,
    ) -> bool {
        let models = self.loaded.iter_mut().filter_map(|(geometry, model)| Some((geometry, model.as_mut().ok()?)));
        let playing = models.flat_map(|(geometry, model)| {
            model.playing.iter_mut().filter(|(animation, _)| wanted(geometry, **animation)).map(|(_, playing)| playing)
        });
        self.deformer.record(gpu, encoder, timer, time_us, playing)
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
        let surface = Surface { base_color: Vec3::splat(0.8), double_sided: shape == Shape::Plane, ..Surface::default() };
        let (bounds, (albedo, specular)) = (mesh.bounds(), reflectance(surface.base_color, surface.metallic));
        let one = Part { mesh, details: Vec::new(), surface };
        let (parts, round) = (vec![part(gpu, &one, self.plain.clone())], shape == Shape::Sphere);
        let (source, sources, playing) = (None, None, HashMap::new());
        GpuModel { parts, bounds, round, albedo, specular, cover: Vec::new(), source, sources, playing }
    }

    fn model(&mut self, gpu: &Gpu, model: Arc<Model>) -> GpuModel {
        let Model { parts, textures, bounds, .. } = &*model;
        let views: Vec<_> = textures.iter().map(|texture| upload(gpu, texture)).collect();
        let (mut albedo, mut specular) = (Vec3::ZERO, Vec3::ZERO);
        let mut gpu_parts = Vec::with_capacity(parts.len());
        let total = parts.iter().map(|part| part.mesh.indices.len()).sum::<usize>().max(1) as f32;
        for one in parts {
            let texture = one.surface.base_color_texture.and_then(|map| textures.get(map.texture));
            let mean = texture.map_or(Vec3::ONE, |texture| texture.mean);
            let (matt, mirrored) = reflectance(one.surface.base_color * mean, one.surface.metallic);
            let share = one.mesh.indices.len() as f32 / total;
            albedo += matt * share;
            specular += mirrored * share;
            let group = self.materials.group(gpu, &one.surface, &views);
            gpu_parts.push(part(gpu, one, group));
        }
        let cover = occluder::of_surface(parts.iter().map(|part| &part.mesh), bounds);
        let bounds = *bounds;
        let source = model.rig.is_some().then_some(model);
        let (round, sources, playing) = (false, None, HashMap::new());
        GpuModel { parts: gpu_parts, bounds, round, albedo, specular, cover, source, sources, playing }
    }
}

fn part(gpu: &Gpu, part: &Part, material: wgpu::BindGroup) -> GpuPart {
    let Part { mesh, details, surface } = part;
    let vertex = wgpu::BufferUsages::VERTEX;
    GpuPart {
        vertices: filled(gpu, "vertices", bytemuck::cast_slice(&mesh.vertices), vertex),
        details: (!details.is_empty()).then(|| filled(gpu, "vertex details", bytemuck::cast_slice(details), vertex)),
        indices: filled(gpu, "indices", bytemuck::cast_slice(&mesh.indices), wgpu::BufferUsages::INDEX),
        index_count: mesh.indices.len() as u32,
        look: Look::of(surface, details),
        surface: surface.clone(),
        material,
        center: mesh.bounds().center(),
    }
}

/// A buffer that holds these bytes. Not mapped to be filled, which panics where the device has just been lost.
pub(super) fn filled(gpu: &Gpu, label: &str, contents: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
    let (size, usage) = (contents.len() as u64, usage | wgpu::BufferUsages::COPY_DST);
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false });
    gpu.queue.write_buffer(&buffer, 0, contents);
    buffer
}
