//! Display rate: shadows, objects and ground, composite. A frame is recorded in one place, [`Renderer::render`].
//!
//! Objects and changed ground are drawn into a multisampled layer of premultiplied linear radiance; the composite
//! puts it over the video, which is sampled once a pixel. Where nothing was drawn the layer is exactly 0, so these
//! pixels have the same bits as with no object in the scene: the layer's samples are cleared to 0, and resolving
//! averages zeros.

mod extent;
mod material;
#[cfg(test)]
mod material_tests;
mod models;
mod pipelines;
pub mod plan;
mod poses;
#[cfg(test)]
mod probe_tests;
#[cfg(test)]
mod reflection_tests;
mod resources;
pub mod shadows;
mod stage;
#[cfg(test)]
mod tests;
pub mod timing;

use std::collections::HashSet;

use glam::Vec3;
use mr360_protocol::asset::AssetId;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Geometry, ObjectId, Scene};
use mr360_shaders::layout;
use mr360_shaders::source::Alpha;

use crate::camera::Camera;
use crate::environment::{Environment, FrameLight};
use crate::gpu::{Gpu, GpuError};
use crate::scene::mesh::Bounds;
use crate::scene::model::LoadedModel;
use crate::scene::pick::{Ray, nearest};
use crate::stats::PassTime;

pub use plan::Plan;
pub use stage::{ModelFault, SceneWarning};

use extent::{Part, in_view, touched};
use models::Models;
use pipelines::{Kind, Layouts, Pipelines, Use};
use plan::SceneNeeds;
use resources::{Layer, Resources, VIEW_STRIDE};
use shadows::Frustum;
use stage::Stage;
use timing::PassTimer;

/// Passes that a frame may have, in order.
pub const PASSES: [&str; 8] = ["deform", "shadow 1", "shadow 2", "shadow 3", "shadow 4", "reflections", "objects", "composite"];

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
    light: FrameLight,
    light_changed: bool,
    visible: bool,
    time_us: u64,
    layers: Vec<Layer>,
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
        let (stage, light) = (Stage::default(), FrameLight::default());
        let (light_changed, visible, time_us, layers) = (true, true, 0, Vec::new());
        Ok(Self { layouts, pipelines, resources, models, stage, light, light_changed, visible, time_us, layers, timer })
    }

    /// Shows this scene from the next frame on. Geometry stays on the GPU while some object shows it. `model` gives
    /// a model, or `None` while it has not come: call again then. Objects without a usable model are left out; the
    /// warnings say why.
    pub fn set_scene(&mut self, gpu: &Gpu, scene: &Scene, model: &dyn Fn(AssetId) -> Option<LoadedModel>) -> Vec<SceneWarning> {
        self.models.follow(gpu, scene, model);
        let (stage, warnings) = Stage::new(scene, &self.models);
        self.resources.write_scene(gpu, &self.layouts, &stage);
        self.stage = stage;
        warnings
    }

    /// Shows or hides all objects from the next frame on. Hidden ones stay on the GPU and cannot be picked.
    pub fn set_visible(&mut self, visible: bool) {
        self.visible = visible;
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
    }

    /// The nearest object along a ray and where it is met.
    #[must_use]
    pub fn pick(&self, ray: &Ray) -> Option<(ObjectId, Vec3)> {
        nearest(ray, self.stage.targets.iter().copied().filter(|_| self.visible))
    }

    /// Records one frame: shadow maps and reflections once, then each view. At most [`MAX_VIEWS`] are drawn.
    pub fn render(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        environment: &mut Environment,
        views: &[View<'_>],
    ) -> FrameReport {
        self.timer.collect(gpu);
        let views = views.get(..MAX_VIEWS).unwrap_or(views);
        let needs = if self.visible { self.stage.needs } else { SceneNeeds::default() };
        let plan = Plan::new(needs, &self.light);
        if std::mem::take(&mut self.light_changed) {
            environment.set_light(gpu, &self.light);
        }
        if plan.reflections {
            environment.refresh_reflections(gpu, encoder, &self.light, &mut self.timer);
        }
        let frusta: Vec<Frustum> =
            self.light.lights.iter().take(plan.shadows).map(|light| self.resources.frustum(light, &self.stage)).collect();
        self.resources.write_frame(gpu, &self.stage, &self.light, &frusta);
        let mut report = FrameReport { plan, ..FrameReport::default() };
        self.pose(gpu, encoder, plan, views);
        let kind = Kind { video: environment.kind(), sh_count: self.light.sh_count };
        self.prepare(gpu, kind, plan);
        self.draw_shadows(encoder, frusta.len(), &mut report);
        let ground = self.stage.changed_ground(&self.light, frusta.len());
        for (at, view) in views.iter().enumerate() {
            // From beneath there is no ground to see.
            let ground = ground.filter(|_| view.camera.position.y > self.stage.ground_y);
            let part = if plan.objects { touched(&view.camera, view.size, &self.stage, ground) } else { None };
            self.resources.write_view(gpu, at, view, part.unwrap_or_default());
            if let Some(part) = part {
                self.make_layer(gpu, at, part);
                self.draw_layer(encoder, environment, kind, (at, view, part), ground.is_some(), &mut report);
            }
            self.composite(encoder, environment, kind, (at, view), part.is_some(), &mut report);
        }
        self.timer.finish(encoder);
        report.passes = self.timer.latest().to_vec();
        report
    }

    /// Brings animated models that this frame shows into their pose. A shadow may fall into a view that its object is outside of.
    fn pose(&mut self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, plan: Plan, views: &[View<'_>]) {
        let Self { stage, models, timer, time_us, .. } = self;
        if !plan.objects || stage.animated.is_empty() {
            return;
        }
        let seen = |bounds: &Bounds| plan.shadows > 0 || views.iter().any(|view| in_view(&view.camera, view.size, bounds));
        let shown: HashSet<(Geometry, usize)> =
            stage.animated.iter().filter(|(.., bounds)| seen(bounds)).map(|(geometry, animation, _)| (*geometry, *animation)).collect();
        models.deform(gpu, encoder, timer, *time_us, &|geometry, animation| shown.contains(&(*geometry, animation)));
    }

    /// Makes what pipelines this frame needs and earlier ones did not.
    fn prepare(&mut self, gpu: &Gpu, kind: Kind, plan: Plan) {
        if plan.shadows > 0 {
            self.stage.draws.iter().for_each(|draw| self.pipelines.prepare_caster(gpu, &self.layouts, draw.look));
        }
        let objects = self.stage.draws.iter().map(object_use);
        let others = [(Use::Composite, true), (Use::Ground, plan.objects), (Use::Horizon, plan.ground_hides)];
        for what in objects.chain(others.into_iter().filter_map(|(what, needed)| needed.then_some(what))) {
            self.pipelines.prepare(gpu, &self.layouts, kind, what);
        }
    }

    /// The layer's targets, kept while they hold the part and are not far too large for it.
    fn make_layer(&mut self, gpu: &Gpu, at: usize, part: Part) {
        let fits = |layer: &Layer| {
            let ((width, height), (wide, high)) = (part.size, layer.size);
            wide >= width && high >= height && u64::from(wide) * u64::from(high) <= 2 * u64::from(width) * u64::from(height)
        };
        if let Some(layer) = self.layers.get_mut(at) {
            if !fits(layer) {
                *layer = Layer::new(&gpu.device, &self.layouts.layer, part.size);
            }
        } else {
            // Views before this one may have had nothing to draw.
            while self.layers.len() <= at {
                self.layers.push(Layer::new(&gpu.device, &self.layouts.layer, part.size));
            }
        }
    }

    fn draw_shadows(&mut self, encoder: &mut wgpu::CommandEncoder, count: usize, report: &mut FrameReport) {
        const NAMES: [&str; plan::MAX_SHADOWS] = ["shadow 1", "shadow 2", "shadow 3", "shadow 4"];
        for (at, (layer, name)) in self.resources.shadow_layers.iter().zip(NAMES).take(count).enumerate() {
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some(name),
                depth_stencil_attachment: Some(depth_attachment(layer, 1.0, wgpu::StoreOp::Store)),
                timestamp_writes: self.timer.pass(name),
                ..wgpu::RenderPassDescriptor::default()
            });
            pass.set_bind_group(0, &self.resources.caster_instances, &[]);
            pass.set_bind_group(1, &self.resources.caster_views, &[at as u32 * VIEW_STRIDE]);
            for draw in &self.stage.draws {
                if let Some(Ok(model)) = self.models.get(&draw.geometry)
                    && let Some(part) = model.parts.get(draw.part)
                {
                    let (pipeline, with_material) = self.pipelines.caster(draw.look);
                    pass.set_pipeline(pipeline);
                    if with_material {
                        pass.set_bind_group(3, &part.material, &[]);
                    }
                    draw_part(&mut pass, model, part, draw);
                    report.draws += 1;
                }
            }
            report.triangles += self.stage.triangles;
        }
    }

    fn draw_layer(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Part),
        ground: bool,
        report: &mut FrameReport,
    ) {
        const NAMES: [&str; MAX_VIEWS] = ["objects", "objects, view 2", "objects, view 3", "objects, view 4"];
        let Some(layer) = self.layers.get(at) else { return };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(NAMES[at]),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &layer.samples,
                depth_slice: None,
                resolve_target: Some(&layer.resolved),
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Discard },
            })],
            depth_stencil_attachment: Some(depth_attachment(&layer.depth, 0.0, wgpu::StoreOp::Discard)),
            timestamp_writes: self.timer.pass(NAMES[at]),
            ..wgpu::RenderPassDescriptor::default()
        });
        // The layer is a window into the image.
        let (x, y) = (part.origin.0 as f32, part.origin.1 as f32);
        pass.set_viewport(-x, -y, view.size.0.max(1) as f32, view.size.1.max(1) as f32, 0.0, 1.0);
        pass.set_scissor_rect(0, 0, part.size.0, part.size.1);
        pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
        pass.set_bind_group(1, environment.bind_group(), &[]);
        pass.set_bind_group(2, environment.reflection_bind_group(), &[]);
        let draw_object = |pass: &mut wgpu::RenderPass<'_>, draw: &stage::Draw| {
            let Some(Ok(model)) = self.models.get(&draw.geometry) else { return 0 };
            let Some(part) = model.parts.get(draw.part) else { return 0 };
            let Some(pipeline) = self.pipelines.get(kind, object_use(draw)) else { return 0 };
            pass.set_pipeline(pipeline);
            pass.set_bind_group(3, if draw.own_material { &part.material } else { self.models.plain() }, &[]);
            draw_part(pass, model, part, draw);
            1
        };
        for draw in self.stage.draws.iter().filter(|draw| draw.look.alpha != Alpha::Blend) {
            report.draws += draw_object(&mut pass, draw);
        }
        report.triangles += self.stage.triangles;
        // After the objects, so that ground they cover is not shaded. From beneath there is no ground to see.
        let changed = (ground, Use::Ground);
        let hiding = (report.plan.ground_hides && view.camera.position.y > self.stage.ground_y, Use::Horizon);
        for (_, what) in [changed, hiding].into_iter().filter(|(drawn, _)| *drawn) {
            if let Some(pipeline) = self.pipelines.get(kind, what) {
                pass.set_pipeline(pipeline);
                pass.draw(0..4, 0..1);
                report.draws += 1;
            }
        }
        // Over all that covers, ground too, which writes what is changed and not what is added to it.
        for draw in self.stage.blended(view.camera.position) {
            report.draws += draw_object(&mut pass, draw);
        }
    }

    fn composite(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view): (usize, &View<'_>),
        drawn: bool,
        report: &mut FrameReport,
    ) {
        const NAMES: [&str; MAX_VIEWS] = ["composite", "composite, view 2", "composite, view 3", "composite, view 4"];
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(NAMES[at]),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: view.target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            timestamp_writes: self.timer.pass(NAMES[at]),
            ..wgpu::RenderPassDescriptor::default()
        });
        let layer = self.layers.get(at).filter(|_| drawn).map_or(&self.resources.no_layer, |layer| &layer.group);
        let Some(pipeline) = self.pipelines.get(kind, Use::Composite) else { return };
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
        pass.set_bind_group(1, environment.bind_group(), &[]);
        pass.set_bind_group(2, layer, &[]);
        pass.draw(0..3, 0..1);
        report.draws += 1;
    }
}

fn depth_attachment(view: &wgpu::TextureView, clear: f32, store: wgpu::StoreOp) -> wgpu::RenderPassDepthStencilAttachment<'_> {
    let depth_ops = Some(wgpu::Operations { load: wgpu::LoadOp::Clear(clear), store });
    wgpu::RenderPassDepthStencilAttachment { view, depth_ops, stencil_ops: None }
}

fn object_use(draw: &stage::Draw) -> Use {
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

/// The view's uniform.
fn view_uniform(view: &View<'_>, layer: Part) -> layout::View {
    let (width, height) = (view.size.0.max(1) as f32, view.size.1.max(1) as f32);
    let aspect = width / height;
    let camera = &view.camera;
    let tan = (camera.fov_y_rad * 0.5).tan();
    let axes = [Vec3::X * (tan * aspect), Vec3::Y * tan, Vec3::NEG_Z].map(|axis| (camera.world_from_view * axis).extend(0.0).to_array());
    layout::View {
        clip_from_world: (camera.clip_from_view(aspect) * camera.view_from_world()).to_cols_array_2d(),
        world_from_ndc: axes,
        position: camera.position.to_array(),
        eye: u32::from(camera.right_eye),
        size_px: [width, height],
        layer_origin: [layer.origin.0 as f32, layer.origin.1 as f32],
        layer_size: [layer.size.0 as f32, layer.size.1 as f32],
        padding: [0.0; 2],
    }
}
