//! The scene laid out for drawing: instances in draw order, what casts, what occludes, what can be picked.

use std::collections::HashMap;
use std::ops::Range;

use glam::{Mat4, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Geometry, Gloss, Material, MaterialKind, Object, ObjectId, Scene, Transform};
use mr360_shaders::layout::{self, MAX_OCCLUDERS};
use mr360_shaders::lobe::finest_level;
use mr360_shaders::source::{Alpha, OCCLUDER_REACH, Surface};

use super::local::{casts, is_local};
use super::material::Look;
use super::models::{GpuModel, GpuPart, Models, reflectance};
use super::moving::{Slot, matrices};
use super::place::{Place, is_glossy};
use super::plan::{SceneNeeds, reflects};
use super::poses::MAX_POSED_VERTICES;
use super::shadows::ground_shadow;
use crate::environment::FrameLight;
use crate::environment::light::tan_radius;
use crate::scene::mesh::Bounds;
use crate::scene::model::ModelError;
use crate::scene::occluder;
use crate::scene::pick::Target;

/// Most drawn parts of all objects together.
pub(super) const MAX_INSTANCES: usize = 65_536;

/// An object or a mesh of the place that is left out of the picture, and why.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{element} is not drawn: model {model}: {fault}")]
pub struct SceneWarning {
    /// Which.
    pub element: Element,
    /// Its model.
    pub model: AssetId,
    /// What is wrong with it.
    pub fault: ModelFault,
}

/// Why a model is not drawn.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModelFault {
    /// Not here yet; it is tried again when the scene is set again.
    #[error("has not arrived yet")]
    Missing,
    /// Refused.
    #[error(transparent)]
    Broken(ModelError),
    /// It has no animation of that name.
    #[error("has no animation {name:?}; {}", known(names))]
    NoSuchAnimation {
        /// As the scene names it.
        name: String,
        /// What the file has.
        names: Vec<String>,
    },
    /// The animations of the scene take too much memory.
    #[error("the scene's animations move more than {MAX_POSED_VERTICES} vertices; use simpler models or fewer animations")]
    TooManyPoses,
    /// The scene is full.
    #[error("the scene draws more than {MAX_INSTANCES} parts; use simpler models or fewer objects")]
    TooManyParts,
}

/// What of a scene is left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Element {
    /// This object.
    Object(ObjectId),
    /// The mesh of the place that is the so manieth, counted from 1.
    Place(usize),
}

impl std::fmt::Display for Element {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Object(id) => write!(f, "object {}", id.0),
            Self::Place(index) => write!(f, "place {index}"),
        }
    }
}

fn known(names: &[String]) -> String {
    const SHOWN: usize = 12;
    let listed: Vec<_> = names.iter().take(SHOWN).map(|name| format!("{name:?}")).collect();
    match names.len() {
        0 => "it has none, leave the name out".to_owned(),
        count if count > SHOWN => format!("its {count} are {}, …", listed.join(", ")),
        _ => format!("it has {}", listed.join(", ")),
    }
}

/// One draw call.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Draw {
    pub(super) geometry: Geometry,
    pub(super) part: usize,
    pub(super) instances: Range<u32>,
    /// Which of its model's animations moves it.
    pub(super) animation: Option<usize>,
    /// With the material of the model's file.
    pub(super) own_material: bool,
    pub(super) look: Look,
    pub(super) double_sided: bool,
    /// Of its one instance in the world, where draws have to be in order of distance.
    pub(super) center: Vec3,
    /// What its instances are shaded with.
    pub(super) surface: Surface,
    /// Its instances throw shadows.
    pub(super) casts: bool,
}

/// What is drawn until the scene changes.
#[derive(Default)]
pub(super) struct Stage {
    pub(super) instances: Vec<layout::Instance>,
    pub(super) draws: Vec<Draw>,
    pub(super) occluders: Vec<layout::Occluder>,
    /// Those that found no room, the smallest.
    pub(super) occluders_lost: usize,
    pub(super) casters: Vec<Bounds>,
    /// Of each, whether it is a ball within its cube.
    pub(super) round: Vec<bool>,
    /// Of objects that throw no shadow.
    pub(super) apart: Vec<Bounds>,
    /// Of the objects that can be moved in the layout as it is.
    pub(super) slots: HashMap<ObjectId, Slot>,
    pub(super) targets: Vec<Target>,
    /// Middles of what is of glass.
    pub(super) glass: Vec<Vec3>,
    /// Objects that move by themselves, each with its bounds in the world.
    pub(super) animated: Vec<(Geometry, usize, Bounds)>,
    pub(super) needs: SceneNeeds,
    pub(super) ground_y: f32,
    pub(super) ground_gloss: Gloss,
    pub(super) triangles: u64,
    pub(super) place: Place,
}

pub(super) struct Placed<'a> {
    pub(super) object: &'a Object,
    pub(super) model: &'a GpuModel,
    pub(super) animation: Option<usize>,
    /// In its own frame, in all its poses.
    pub(super) bounds: Bounds,
    world_from_object: Mat4,
}

impl Stage {
    /// Lays out the scene; objects whose model is missing or broken are left out, each with a warning.
    pub(super) fn new(scene: &Scene, models: &Models) -> (Self, Vec<SceneWarning>) {
        let mut warnings = Vec::new();
        let mut placed = Vec::with_capacity(scene.objects.len());
        let mut parts = 0;
        for object in &scene.objects {
            let fault = match models.get(&object.geometry) {
                Some(Ok(model)) if parts + model.parts.len() <= MAX_INSTANCES => match model.animation(&object.animation) {
                    Ok(Some(animation)) if !model.plays(animation) => ModelFault::TooManyPoses,
                    Ok(animation) => {
                        parts += model.parts.len();
                        placed.push(Placed::new(object, model, animation));
                        continue;
                    }
                    Err(fault) => fault,
                },
                Some(Ok(_)) => ModelFault::TooManyParts,
                Some(Err(error)) => ModelFault::Broken(error.clone()),
                None => ModelFault::Missing,
            };
            if let Geometry::Model(model) = object.geometry {
                warnings.push(SceneWarning { element: Element::Object(object.id), model, fault });
            }
        }
        // Objects of the same geometry and kind of surface share draws; those with a material of their own use none
        // of the file's textures.
        let key = |p: &Placed<'_>| {
            (geometry_key(&p.object.geometry), p.animation, p.object.material.as_ref().map(surface_of), casts(p.object.id))
        };
        placed.sort_by_key(key);
        let mut stage = Self { ground_y: scene.ground_y, ground_gloss: scene.ground, ..Self::default() };
        stage.needs.glossy_ground = is_glossy(scene.ground);
        stage.needs.add_lobes(finest_level(scene.ground.roughness).filter(|_| stage.needs.glossy_ground));
        for run in placed.chunk_by(|a, b| key(a) == key(b)) {
            stage.add_run(run);
        }
        let ranges;
        (stage.occluders, stage.occluders_lost, ranges) = occluders(&placed);
        stage.hold_occluders(&ranges);
        stage.needs.objects = placed.len();
        for (index, mesh) in (1..).zip(&scene.place) {
            if let Err(fault) = stage.add_place(mesh, models, &mut parts) {
                warnings.push(SceneWarning { element: Element::Place(index), model: mesh.model, fault });
            }
        }
        (stage, warnings)
    }

    fn add_run(&mut self, run: &[Placed<'_>]) {
        let Some(first) = run.first() else { return };
        let casting = casts(first.object.id);
        let first_instance = self.instances.len() as u32;
        for (at, part) in first.model.parts.iter().enumerate() {
            let start = self.instances.len() as u32;
            self.instances.extend(run.iter().map(|placed| instance(placed, part)));
            let own_material = first.object.material.is_none();
            let used = &self.instances[start as usize..];
            let own = used.first().map_or(Surface::Varying, |i| Surface::of(i.roughness, i.glass == 1));
            let look = match own {
                _ if !own_material => Look::default(),
                Surface::Glass if !part.surface.unlit => part.look.solid(),
                _ => part.look,
            };
            // A texture makes a surface smoother than its factor says, and spread normals make it rougher: those leave rough what is.
            let varies =
                look.varies() && !part.surface.glass && (own != Surface::Rough || part.surface.metallic_roughness_texture.is_some());
            let unlit = own_material && part.surface.unlit;
            self.needs.reflective |= !unlit && (varies || used.iter().any(|i| reflects(i.roughness, i.glass == 1)));
            let surface = match own {
                _ if unlit => Surface::Rough,
                _ if varies => Surface::Varying,
                own => own,
            };
            let finest = match surface {
                Surface::Rough | Surface::Mirror => None,
                Surface::Varying => Some(0),
                // One pipeline does for glass of every roughness, but its lobes vary as those of others.
                Surface::Glass if look.varies() => Some(0),
                Surface::Glossy | Surface::Glass => used.iter().filter_map(|i| finest_level(i.roughness)).min(),
            };
            self.needs.add_lobes(finest);
            if surface == Surface::Glass {
                self.needs.glass = true;
                self.glass.extend(run.iter().map(|placed| placed.world_from_object.transform_point3(part.center)));
            }
            let animation = first.animation;
            let draw = |instances: Range<u32>, center: Vec3| Draw {
                geometry: first.object.geometry,
                part: at,
                instances,
                animation,
                own_material,
                look,
                double_sided: part.surface.double_sided,
                surface,
                center,
                casts: casting,
            };
            if look.alpha == Alpha::Blend {
                let one =
                    |(index, placed): (u32, &Placed<'_>)| draw(index..index + 1, placed.world_from_object.transform_point3(part.center));
                self.draws.extend((start..).zip(run).map(one));
            } else {
                self.draws.push(draw(start..self.instances.len() as u32, Vec3::ZERO));
            }
            self.triangles += u64::from(part.index_count / 3) * run.len() as u64;
        }
        for (at, placed) in run.iter().enumerate() {
            let world = world_bounds(&placed.bounds, &placed.world_from_object);
            self.needs.beneath_ground |= self.is_beneath(&world);
            let slot = Slot::new(placed, first_instance + at as u32, run.len() as u32, self.place_of_next(casting));
            self.slots.extend(slot.map(|slot| (placed.object.id, slot)));
            let bounds = if casting { &mut self.casters } else { &mut self.apart };
            bounds.push(world);
            if casting {
                self.round.push(placed.model.round && is_even(placed.object.transform.scale));
            }
            self.animated.extend(placed.animation.map(|animation| (placed.object.geometry, animation, world)));
            let shape = match placed.object.geometry {
                Geometry::Shape(shape) => Some(shape),
                Geometry::Model(_) => None,
            };
            if !is_local(placed.object.id) {
                self.targets.push(Target { id: placed.object.id, transform: placed.object.transform, bounds: placed.bounds, shape });
            }
        }
    }

    /// How high over the ground objects reach, metres.
    pub(super) fn highest(&self) -> f32 {
        self.casters.iter().map(|caster| caster.max.y - self.ground_y).fold(0.0, f32::max)
    }

    /// A millimetre: what stands on the ground by its bounds does not reach beneath it.
    pub(super) fn is_beneath(&self, world: &Bounds) -> bool {
        world.min.y < self.ground_y - 1e-3
    }

    /// Draws of blended surfaces, the farthest from a point first: those that glass may show, and those nearer than all glass.
    pub(super) fn blended(&self, from: Vec3) -> (Vec<&Draw>, Vec<&Draw>) {
        let nearest_glass = self.glass.iter().map(|at| at.distance_squared(from)).reduce(f32::min).unwrap_or(0.0);
        let mut draws: Vec<&Draw> = self.draws.iter().filter(|draw| draw.look.alpha == Alpha::Blend).collect();
        draws.sort_by(|a, b| b.center.distance_squared(from).total_cmp(&a.center.distance_squared(from)));
        draws.into_iter().partition(|draw| draw.center.distance_squared(from) >= nearest_glass)
    }

    /// The part of the ground, in x and z, that objects can change under this light: their occluders' reach and
    /// the shadows of the first `shadows` lights; and on which `eyes` see them mirrored.
    pub(super) fn changed_ground(&self, light: &FrameLight, shadows: usize, eyes: &[Vec3]) -> Option<Bounds> {
        let mut changed: Option<Bounds> = None;
        let mut add = |bounds: Bounds| changed = Some(changed.map_or(bounds, |all| all.including(bounds.min).including(bounds.max)));
        for occluder in &self.occluders {
            let center = Vec3::from_array(occluder.center);
            let (reach, height) = (occluder.radius * OCCLUDER_REACH, (center.y - self.ground_y).abs());
            if height < reach {
                let across = Vec3::splat((reach * reach - height * height).sqrt());
                add(Bounds { min: center - across, max: center + across });
            }
        }
        eyes.iter().filter_map(|eye| self.mirrored_ground(*eye)).for_each(&mut add);
        for light in light.lights.iter().take(shadows) {
            let tan_radius = tan_radius(light.solid_angle_sr);
            for caster in &self.casters {
                if let Some(bounds) = ground_shadow(light.direction, tan_radius, caster.center(), caster.half().length(), self.ground_y) {
                    add(bounds);
                }
            }
        }
        changed
    }
}

impl<'a> Placed<'a> {
    fn new(object: &'a Object, model: &'a GpuModel, animation: Option<usize>) -> Self {
        let Transform { position, rotation, scale } = object.transform;
        let world_from_object = Mat4::from_scale_rotation_translation(scale, rotation, position);
        Self { object, model, animation, bounds: model.bounds(animation), world_from_object }
    }
}

/// A ball of this scale is a ball.
pub(super) fn is_even(scale: Vec3) -> bool {
    scale.abs().max_element() <= 1.0001 * scale.abs().min_element()
}

/// Around a box in the world.
pub(super) fn world_bounds(bounds: &Bounds, world_from_object: &Mat4) -> Bounds {
    bounds.corners().map(|corner| world_from_object.transform_point3(corner)).into_iter().fold(Bounds::EMPTY, Bounds::including)
}

fn surface_of(material: &Material) -> Surface {
    Surface::of(material.roughness, material.kind == MaterialKind::Glass)
}

/// An order that keeps equal geometries together.
fn geometry_key(geometry: &Geometry) -> (u8, Option<AssetId>) {
    match geometry {
        Geometry::Shape(shape) => (*shape as u8, None),
        Geometry::Model(id) => (u8::MAX, Some(*id)),
    }
}

fn instance(placed: &Placed<'_>, part: &GpuPart) -> layout::Instance {
    let surface = &part.surface;
    let own = placed.object.material.unwrap_or(Material {
        base_color: surface.base_color.to_array(),
        roughness: surface.roughness,
        metallic: surface.metallic,
        kind: if surface.glass { MaterialKind::Glass } else { MaterialKind::Opaque },
    });
    let (world_from_object, normal_from_object) = matrices(&placed.world_from_object);
    layout::Instance {
        world_from_object,
        normal_from_object,
        base_color: own.base_color,
        roughness: own.roughness,
        metallic: own.metallic,
        glass: u32::from(own.kind == MaterialKind::Glass),
        object: placed.object.id.0,
        padding: 0,
    }
}

/// Which of the spheres stand for which object.
type Whose = Vec<(ObjectId, Range<usize>)>;

/// The spheres that stand for the objects, how many found no room, and which are whose, where all did.
fn occluders(placed: &[Placed<'_>]) -> (Vec<layout::Occluder>, usize, Whose) {
    let casting = || placed.iter().filter(|placed| casts(placed.object.id));
    let mut all = Vec::new();
    let mut ranges = Vec::new();
    for placed in casting() {
        let begin = all.len();
        all.extend(spheres_of(placed, true));
        ranges.push((placed.object.id, begin..all.len()));
    }
    if all.len() > MAX_OCCLUDERS {
        all = casting().flat_map(|placed| spheres_of(placed, false)).collect();
        all.sort_by(|a, b| b.radius.total_cmp(&a.radius));
        ranges.clear();
    }
    let lost = all.len().saturating_sub(MAX_OCCLUDERS);
    all.truncate(MAX_OCCLUDERS);
    (all, lost, ranges)
}

fn spheres_of(placed: &Placed<'_>, detailed: bool) -> Vec<layout::Occluder> {
    let (transform, model) = (placed.object.transform, placed.model);
    let spheres = if detailed && !model.cover.is_empty() {
        model.cover.iter().map(|sphere| sphere.scaled(transform.scale)).collect()
    } else if detailed {
        occluder::cover(&placed.bounds, transform.scale, model.round)
    } else {
        vec![occluder::single(&placed.bounds, transform.scale)]
    };
    let (albedo, specular) =
        placed.object.material.map_or((model.albedo, model.specular), |own| reflectance(own.base_color.into(), own.metallic));
    let object = placed.object.id.0;
    // A model fills only a part of its box: half of it on average, 0.8 of each side.
    let filled = if model.cover.is_empty() || detailed { 1.0 } else { 0.8 };
    let occluder = |sphere: occluder::Sphere| layout::Occluder {
        center: (transform.position + transform.rotation * sphere.center).to_array(),
        radius: sphere.radius * filled,
        albedo: albedo.to_array(),
        object,
        specular: specular.to_array(),
        padding: 0.0,
    };
    spheres.into_iter().map(occluder).collect()
}
