//! Display rate: shadows, objects and ground, composite. A frame is recorded in one place, [`Renderer::render`].
//!
//! Objects and changed ground are drawn into a multisampled layer of premultiplied linear radiance; the composite
//! puts it over the video. Where nothing was drawn the layer is exactly 0, so these
//! pixels have the same bits as with no object in the scene: the layer's samples are cleared to 0, and resolving
//! averages zeros.

mod background;
#[cfg(test)]
mod background_tests;
mod casting;
mod catchers;
mod cells;
mod depth;
#[cfg(test)]
mod depth_tests;
#[cfg(test)]
mod energy_tests;
mod extent;
mod glass;
#[cfg(test)]
mod glass_tests;
mod layering;
mod local;
mod material;
#[cfg(test)]
mod material_tests;
mod mirror;
#[cfg(test)]
mod mirror_tests;
mod models;
mod moving;
#[cfg(test)]
mod moving_tests;
mod multiview;
pub mod parallax;
#[cfg(test)]
mod parallax_tests;
mod pipelines;
mod place;
#[cfg(test)]
mod place_tests;
pub mod plan;
mod poses;
#[cfg(test)]
mod probe_tests;
#[cfg(test)]
mod rate_tests;
mod recipe;
#[cfg(test)]
mod reflection_tests;
mod resources;
mod room;
#[cfg(test)]
mod shadow_tests;
pub mod shadows;
mod stage;
#[cfg(test)]
mod tests;
pub mod timing;

use glam::Vec3;
use mr360_protocol::asset::AssetId;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{ObjectId, Scene};
use mr360_shaders::layout;
use mr360_shaders::source::Reflections;

use crate::camera::Camera;
use crate::environment::reflection::How;
use crate::environment::{Environment, FrameLight};
use crate::governor::Tier;
use crate::gpu::{Gpu, GpuError};
use crate::scene::model::LoadedModel;
use crate::scene::pick::{Ray, Target, nearest, nearest_to};
use crate::stats::PassTime;

pub use background::Resampling;
pub use local::{MAX_LOCAL, local_id};
pub use parallax::Parallax;
pub use pipelines::DEPTH_FORMAT;
pub use plan::Plan;
pub use stage::{Element, ModelFault, SceneWarning};

use background::pixel_rad;
use depth::DepthPass;
use extent::Part;
use glass::is_glass;
use layering::Shown;
use mirror::mirrored_use;
use models::Models;
use pipelines::{Kind, Layouts, Pipelines, Use};
use plan::{Casting, SceneNeeds};
use resources::{Layer, Resources};
use room::Room;
use shadows::Frustum;
use stage::Stage;
use timing::PassTimer;

/// Passes that a frame may have.
pub const PASSES: [&str; 26] = [
    "deform",
    SHADOWS[0],
    SHADOWS[1],
    SHADOWS[2],
    SHADOWS[3],
    PLACE_SHADOWS[0],
    PLACE_SHADOWS[1],
    PLACE_SHADOWS[2],
    PLACE_SHADOWS[3],
    "reflections",
    MIRROR[0],
    OBJECTS[0],
    GLASS[0],
    COMPOSITE[0],
    MIRROR[1],
    OBJECTS[1],
    GLASS[1],
    COMPOSITE[1],
    MIRROR[2],
    OBJECTS[2],
    GLASS[2],
    COMPOSITE[2],
    MIRROR[3],
    OBJECTS[3],
    GLASS[3],
    COMPOSITE[3],
];
/// Of each light.
const SHADOWS: [&str; plan::MAX_SHADOWS] = ["shadow 1", "shadow 2", "shadow 3", "shadow 4"];
/// Of each light.
const PLACE_SHADOWS: [&str; plan::MAX_SHADOWS] = ["place shadow 1", "place shadow 2", "place shadow 3", "place shadow 4"];
/// Of each view.
const MIRROR: [&str; MAX_VIEWS] = ["mirror", "mirror view 2", "mirror view 3", "mirror view 4"];
/// Of each view.
const OBJECTS: [&str; MAX_VIEWS] = ["objects", "objects view 2", "objects view 3", "objects view 4"];
/// Of each view.
const GLASS: [&str; MAX_VIEWS] = ["glass", "glass view 2", "glass view 3", "glass view 4"];
/// Of each view.
const COMPOSITE: [&str; MAX_VIEWS] = ["composite", "composite view 2", "composite view 3", "composite view 4"];

/// Most views of one frame.
pub const MAX_VIEWS: usize = 4;

/// One picture to draw.
pub struct View<'a> {
    /// From where.
    pub camera: Camera,
    /// Where to, of the renderer's format and of `size` pixels.
    pub target: &'a wgpu::TextureView,
    /// Columns and rows.
    pub size: (u32, u32),
}

/// What a frame cost.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FrameReport {
    /// GPU time by pass, of one or two frames earlier; empty where the GPU cannot tell.
    pub passes: Vec<PassTime>,
    /// What was decided to run.
    pub plan: Plan,
    /// Draw calls.
    pub draws: u32,
    /// Triangles of objects, all views and shadow maps together.
    pub triangles: u64,
}

/// Draws the shared scene into the video.
pub struct Renderer {
    layouts: Layouts,
    pipelines: Pipelines,
    resources: Resources,
    models: Models,
    stage: Stage,
    /// What the place's shadow maps hold.
    place_shown: Vec<Frustum>,
    /// Of the picture.
    light: FrameLight,
    light_changed: bool,
    /// In force: the picture's, or on its way to that of the next one.
    current: FrameLight,
    casting: Casting,
    visible: bool,
    reflections: Reflections,
    parallax: Parallax,
    /// The background is resampled finely.
    fine: bool,
    /// Of the picture: when its animations are.
    time_us: u64,
    /// By view, or one of both eyes.
    layers: Vec<(Room, Layer)>,
    /// Both eyes were drawn by one pass.
    together: bool,
    /// The background of the last frame had a distance.
    backed: bool,
    /// The middle of the views of a frame: what is blended has one order in all of them.
    between: Vec3,
    /// By view, whether anything was drawn in the last frame.
    drawn: Vec<bool>,
    keeps_depth: bool,
    /// Made when first asked for.
    depth: Option<DepthPass>,
    tier: Tier,
    /// Samples a pixel of the layers.
    samples: u32,
    /// Pictures since reflections were made.
    unreflected: u32,
    /// Of the picture that they were made from.
    reflected: FrameLight,
    /// What each shadow map holds; `None` where it shows another scene.
    shadows: [Option<Frustum>; plan::MAX_SHADOWS],
    timer: PassTimer,
}

impl Renderer {
    /// A renderer to targets of one format. sRGB formats and floats are written linear; 8-bit formats without
    /// sRGB get sRGB codes.
    ///
    /// # Errors
    /// [`GpuError::Shader`] when the build lacks a shader file.
    pub fn new(gpu: &Gpu, format: wgpu::TextureFormat) -> Result<Self, GpuError> {
        let layouts = Layouts::new(&gpu.device);
        let pipelines = Pipelines::new(gpu, &layouts, format)?;
        let resources = Resources::new(&gpu.device, &layouts);
        let models = Models::new(gpu, &layouts.material)?;
        let timer = PassTimer::new(gpu);
        Ok(Self {
            layouts,
            pipelines,
            resources,
            models,
            stage: Stage::default(),
            place_shown: Vec::new(),
            light: FrameLight::default(),
            light_changed: true,
            current: FrameLight::default(),
            casting: Casting::default(),
            visible: true,
            reflections: Reflections::default(),
            parallax: Parallax::default(),
            fine: Resampling::default().is_fine(gpu),
            time_us: 0,
            layers: Vec::new(),
            together: false,
            backed: false,
            between: Vec3::ZERO,
            drawn: Vec::new(),
            keeps_depth: false,
            depth: None,
            tier: Tier::FULL,
            samples: 0,
            unreflected: u32::MAX,
            reflected: FrameLight::default(),
            shadows: [None; plan::MAX_SHADOWS],
            timer,
        })
    }

    /// Shows this scene from the next frame on. Geometry stays on the GPU while some object shows it. `model` gives
    /// a model, or `None` while it has not come: call again then. Objects without a usable model are left out; the
    /// warnings say why.
    pub fn set_scene(&mut self, gpu: &Gpu, scene: &Scene, model: &dyn Fn(AssetId) -> Option<LoadedModel>) -> Vec<SceneWarning> {
        self.models.follow(gpu, scene, model);
        let (stage, warnings) = Stage::new(scene, &self.models);
        self.resources.write_scene(gpu, &self.layouts, &stage);
        if stage.occluders_lost > 0 && self.stage.occluders_lost == 0 {
            let (lost, most) = (stage.occluders_lost, layout::MAX_OCCLUDERS);
            tracing::warn!(
                "only the {most} largest of the objects shade what is beside them, {lost} do not; make one model of several objects"
            );
        }
        // Levels that were not asked for until now.
        if self.stage.needs.lobes_from != stage.needs.lobes_from {
            self.unreflected = u32::MAX;
        }
        self.stage = stage;
        self.shadows = [None; plan::MAX_SHADOWS];
        self.place_shown.clear();
        warnings
    }

    /// Shows or hides all objects from the next frame on. Hidden ones stay on the GPU and cannot be picked.
    pub fn set_visible(&mut self, visible: bool) {
        self.visible = visible;
    }

    /// Looks reflections up this way from the next frame on.
    pub fn set_reflections(&mut self, method: Reflections) {
        self.reflections = method;
        self.unreflected = u32::MAX;
    }

    /// Shows the background of a source with one view at this distance from the next frame on.
    pub fn set_parallax(&mut self, parallax: Parallax) {
        self.parallax = parallax;
    }

    /// Resamples the video this way from the next frame on.
    pub fn set_resampling(&mut self, gpu: &Gpu, resampling: Resampling) {
        self.fine = resampling.is_fine(gpu);
    }

    /// Shows animated models in their pose of this time from the next frame on: the pts of the environment's picture. They move
    /// at the video's rate, as if the camera had filmed them, and every viewer sees the same pose with the same picture.
    pub fn set_time(&mut self, pts_us: u64) {
        self.time_us = pts_us;
    }

    /// Takes the light that belongs to the environment's picture.
    pub fn set_light(&mut self, light: &LightFrame) {
        self.light = FrameLight::from(light);
        self.light_changed = true;
        self.current = self.light.clone();
        self.casting.order(&mut self.current.lights);
    }

    /// Lights objects by this until the next light is set: one between that of the picture and the next one's. Reflections show the
    /// picture, and stay as they are.
    pub fn relight(&mut self, light: &LightFrame) {
        self.current = FrameLight { lift: self.light.lift, ..FrameLight::from(light) };
        self.casting.order(&mut self.current.lights);
    }

    /// The light in force.
    #[must_use]
    pub fn current_light(&self) -> &FrameLight {
        &self.current
    }

    /// True when the scene has something that light falls on.
    #[must_use]
    pub fn has_objects(&self) -> bool {
        self.stage.needs.objects > 0
    }

    /// Leaves out what this tier leaves out, from the next frame on.
    pub fn set_tier(&mut self, tier: Tier) {
        self.tier = tier;
    }

    /// What a frame does in a tier, with this scene under this light.
    #[must_use]
    pub fn plan(&self, tier: Tier) -> Plan {
        let needs = if self.visible { self.stage.needs } else { SceneNeeds::default() };
        Plan::new(needs, &self.current, &self.casting).within(tier)
    }

    /// The nearest object along a ray and where it is met.
    #[must_use]
    pub fn pick(&self, ray: &Ray) -> Option<(ObjectId, Vec3)> {
        nearest(ray, self.stage.targets.iter().copied().filter(|_| self.visible))
    }

    /// The object nearest to a point, within `reach_m` of it.
    #[must_use]
    pub fn near(&self, point: Vec3, reach_m: f32) -> Option<ObjectId> {
        Some(nearest_to(point, reach_m, self.stage.targets.iter().copied().filter(|_| self.visible))?.0)
    }

    /// An object as it is drawn: its place, and its bounds in its own frame.
    #[must_use]
    pub fn target(&self, id: ObjectId) -> Option<&Target> {
        self.stage.targets.iter().find(|target| target.id == id)
    }

    /// Records one frame: shadow maps and reflections once, then each view. At most [`MAX_VIEWS`] are drawn.
    pub fn render(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        environment: &mut Environment,
        views: &[View<'_>],
    ) -> FrameReport {
        self.record(gpu, encoder, environment, views.get(..MAX_VIEWS).unwrap_or(views), None)
    }

    /// `both` is where two views are drawn to by one pass.
    fn record(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        environment: &mut Environment,
        views: &[View<'_>],
        both: Option<&wgpu::TextureView>,
    ) -> FrameReport {
        self.timer.collect(gpu);
        self.together = both.is_some();
        self.between = views.iter().map(|view| view.camera.position).sum::<Vec3>() / views.len().max(1) as f32;
        let plan = self.plan(self.tier);
        self.casting.keep(self.current.lights.get(..plan.shadows).unwrap_or_default());
        if std::mem::take(&mut self.light_changed) {
            environment.set_light(gpu, &self.light);
            self.unreflected = self.unreflected.saturating_add(1);
        }
        let how = How { method: self.reflections, fine: self.fine, lobes_from: self.stage.needs.lobes_from };
        if plan.reflections && (plan.reflections_every == 1 || self.unreflected >= plan.reflections_every) {
            if self.unreflected > 0 {
                self.reflected = self.light.clone();
            }
            self.unreflected = 0;
            environment.refresh_reflections(gpu, encoder, &self.light, how, &mut self.timer);
        }
        let frusta: Vec<Frustum> =
            self.current.lights.iter().take(plan.shadows).map(|light| self.resources.frustum(light, &self.stage)).collect();
        let place_frusta = self.place_frusta(frusta.len());
        let eyes: Vec<Vec3> = views.iter().filter(|_| plan.ground_mirrors).map(|view| view.camera.position).collect();
        let ground = self.stage.changed_ground(&self.current, frusta.len(), &eyes);
        let changed_place = self.stage.changed_place(&self.current, frusta.len(), plan.place_mirrors);
        let lights = (&self.current, &self.reflected);
        self.resources.write_frame(gpu, &self.stage, lights, (&frusta, &place_frusta), (plan.occlusion, ground));
        let mut report = FrameReport { plan, ..FrameReport::default() };
        self.pose(gpu, encoder, plan, views);
        let dome_m = self.parallax.dome_m(environment.is_stereo(), views.iter().map(|view| view.camera.position));
        self.backed = dome_m.is_some();
        let place = !self.stage.place.draws.is_empty();
        // Then the place is drawn whether or not there are objects, and in the same way.
        let place_shows = dome_m.is_some() && place;
        let samples = if place_shows { Tier::FULL.limits().samples } else { plan.samples };
        let kind = Kind {
            video: environment.kind(),
            sh_count: self.current.sh_count,
            samples,
            views: if both.is_some() { views.len() as u32 } else { 1 },
            reflections: self.reflections,
            place,
            parallax: dome_m.is_some(),
            magnified: self.fine && environment.is_coded() && views.iter().any(|view| environment.texels(pixel_rad(view)) < 1.0),
        };
        self.prepare(gpu, kind, plan);
        self.draw_shadows(encoder, &frusta, &mut report);
        self.draw_place_shadows(encoder, place_frusta, &mut report);
        if (plan.objects || place_shows) && self.samples != samples {
            self.samples = samples;
            self.layers.clear();
        }
        self.drawn.clear();
        let shown = Shown { dome_m, ground, changed_place };
        match both {
            Some(target) => self.draw_both(gpu, (encoder, environment), kind, (views, target), &shown, &mut report),
            None => {
                for (at, view) in views.iter().enumerate() {
                    self.draw_view(gpu, (&mut *encoder, &*environment), kind, (at, view), &shown, &mut report);
                }
            }
        }
        self.timer.finish(encoder);
        report.passes = self.timer.latest().to_vec();
        report
    }

    /// Makes what pipelines this frame needs and earlier ones did not.
    fn prepare(&mut self, gpu: &Gpu, kind: Kind, plan: Plan) {
        if plan.shadows > 0 {
            self.stage.draws.iter().for_each(|draw| self.pipelines.prepare_caster(gpu, &self.layouts, draw.surface, draw.look));
        }
        let objects = self.stage.draws.iter().map(object_use);
        let others = [
            (Use::Composite, true),
            (Use::Ground { glossy: plan.ground_mirrors }, plan.objects),
            (Use::MirrorMip, plan.ground_mirrors),
            (Use::PlaceMirrored, plan.ground_mirrors && kind.place),
            (Use::Horizon, plan.ground_hides),
            (Use::GlassBack, plan.glass),
            (Use::Place { glossy: plan.place_mirrors }, (plan.objects || kind.parallax) && kind.place),
        ];
        let mirrored = self.stage.draws.iter().filter(|draw| plan.ground_mirrors && !is_glass(draw)).map(mirrored_use);
        for what in objects.chain(mirrored).chain(others.into_iter().filter_map(|(what, needed)| needed.then_some(what))) {
            self.pipelines.prepare(gpu, &self.layouts, kind, what);
        }
    }
}

fn depth_attachment(view: &wgpu::TextureView, clear: f32, store: wgpu::StoreOp) -> wgpu::RenderPassDepthStencilAttachment<'_> {
    let depth_ops = Some(wgpu::Operations { load: wgpu::LoadOp::Clear(clear), store });
    wgpu::RenderPassDepthStencilAttachment { view, depth_ops, stencil_ops: None }
}

/// The layer is a window into the image.
fn look_into(pass: &mut wgpu::RenderPass<'_>, view: &View<'_>, part: Part) {
    let (x, y) = (part.origin.0 as f32, part.origin.1 as f32);
    pass.set_viewport(-x, -y, view.size.0.max(1) as f32, view.size.1.max(1) as f32, 0.0, 1.0);
    pass.set_scissor_rect(0, 0, part.size.0, part.size.1);
}

fn object_use(draw: &stage::Draw) -> Use {
    if is_glass(draw) {
        return Use::Glass { look: draw.look };
    }
    Use::Object { surface: draw.surface, look: draw.look, double_sided: draw.double_sided }
}

fn draw_part(pass: &mut wgpu::RenderPass<'_>, model: &models::GpuModel, part: &models::GpuPart, draw: &stage::Draw) {
    pass.set_vertex_buffer(0, model.vertices(draw.part, part, draw.animation).slice(..));
    if let Some(details) = part.details.as_ref().filter(|_| draw.look.detailed) {
        pass.set_vertex_buffer(1, details.slice(..));
    }
    pass.set_index_buffer(part.indices.slice(..), wgpu::IndexFormat::Uint32);
    pass.draw_indexed(0..part.index_count, 0, draw.instances.clone());
}
