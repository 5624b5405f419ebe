//! The renderer on a live broadcast: scene updates, pictures with their light, views.

use std::collections::HashMap;

use glam::{Vec2, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Action;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Geometry, LibraryItem, Object, ObjectId, Playback, Scene, Shape, Transform};

use super::shared_scene::{SharedScene, Shown};
use crate::environment::Environment;
use crate::frame_loop::{BoxError, Drawn, FrameError, Shot, Stage};
use crate::governor::Governor;
use crate::gpu::{Gpu, GpuError};
use crate::hands::{LocalObject, World, looks};
use crate::overlay::{Overlay, Told};
use crate::scene::mesh::Bounds;
use crate::scene::model::LoadedModel;
use crate::scene::pick::Ray;
use crate::stats::{FrameTimes, PassTime};
use crate::sync::{ClientClock, Paired, ReceivedLight};
use crate::view::{Element, FrameReport, MAX_LOCAL, Parallax, Renderer, Resampling, View, local_id};

/// The renderer behind the frame loop.
pub struct LiveStage {
    gpu: Gpu,
    environment: Environment,
    shared: SharedScene,
    /// Made when the first target tells its format.
    renderer: Option<(wgpu::TextureFormat, Renderer)>,
    /// On the GPU; its objects may have moved since.
    shown: Option<Shown>,
    /// Of this viewer alone, and by their ids: the user's own, then the script's.
    local: Vec<LocalObject>,
    own: Vec<LocalObject>,
    scripted: Vec<LocalObject>,
    local_ids: Vec<ObjectId>,
    /// The local objects are others than those on the GPU.
    local_changed: bool,
    /// The user has moved something since the last frame.
    stirred: bool,
    /// Objects need the light of their picture; without it they are hidden.
    lit: bool,
    light: Option<LightFrame>,
    /// Of the picture, microseconds: when its animations are.
    pts_us: u64,
    warned: HashMap<Element, String>,
    governor: Governor,
    parallax: Parallax,
    resampling: Resampling,
    clock: ClientClock,
    /// The last frame that was presented.
    before: Option<FrameTimes>,
    overlay_shown: bool,
    controls_shown: bool,
    /// Made when first shown, for the format of the target.
    overlay: Option<(wgpu::TextureFormat, Overlay)>,
}

impl LiveStage {
    /// A stage that shows nothing yet.
    ///
    /// # Errors
    /// When the build lacks a shader.
    pub fn new(gpu: Gpu, shared: SharedScene, governor: Governor) -> Result<Self, BoxError> {
        let environment = Environment::new(&gpu)?;
        let clock = shared.clock();
        Ok(Self {
            gpu,
            environment,
            shared,
            renderer: None,
            shown: None,
            local: Vec::new(),
            own: Vec::new(),
            scripted: Vec::new(),
            local_ids: Vec::new(),
            local_changed: false,
            stirred: false,
            lit: false,
            light: None,
            pts_us: 0,
            warned: HashMap::new(),
            governor,
            parallax: Parallax::default(),
            resampling: Resampling::default(),
            clock,
            before: None,
            overlay_shown: false,
            controls_shown: false,
            overlay: None,
        })
    }

    /// The same with the background of mono video at this distance, and video resampled this way.
    #[must_use]
    pub fn with_background(self, parallax: Parallax, resampling: Resampling) -> Self {
        Self { parallax, resampling, ..self }
    }

    fn follow_scene(&mut self) {
        let Some((_, renderer)) = &mut self.renderer else { return };
        // Without light there is nothing to show objects by. They stay on the GPU: the light may be back with the next picture.
        renderer.set_visible(self.lit);
        renderer.set_time(self.pts_us);
        let mut moved = self.shared.advance(self.clock.now());
        if std::mem::take(&mut self.stirred) {
            moved.extend(self.local_ids.iter().copied().zip(self.local.iter().map(|local| local.transform)));
        }
        let current = self.shown.as_ref().is_some_and(|shown| shown.version == self.shared.version()) && !self.local_changed;
        if current && (moved.is_empty() || renderer.move_objects(&self.gpu, &moved)) {
            return;
        }
        self.lay_out(&moved);
    }

    /// Lays the scene out anew, with what has `moved` since where it is now.
    fn lay_out(&mut self, moved: &[(ObjectId, Transform)]) {
        let Some((_, renderer)) = &mut self.renderer else { return };
        let shown = self.shared.shown();
        let mut scene = Scene::clone(&shown.scene);
        for (id, transform) in moved {
            if let Some(object) = scene.objects.iter_mut().find(|object| object.id == *id) {
                object.transform = *transform;
            }
        }
        scene.objects.extend(self.local_ids.iter().zip(&self.local).map(|(id, local)| Object {
            id: *id,
            geometry: local.geometry,
            transform: local.transform,
            material: local.material,
            animation: Playback::First,
        }));
        let model = |id: AssetId| -> Option<LoadedModel> { looks::model(id).map(Ok).or_else(|| shown.models.get(&id).cloned()) };
        for warning in renderer.set_scene(&self.gpu, &scene, &model) {
            let text = warning.to_string();
            if self.warned.insert(warning.element, text.clone()).as_ref() != Some(&text) {
                tracing::warn!("{text}; it is left out");
            }
        }
        self.shown = Some(shown);
        self.local_changed = false;
    }

    /// Tells the governor what a frame cost: CPU and GPU work side by side, so that the longer of the two counts. Returns it, milliseconds.
    fn govern(&mut self, begun: ClientTime, passes: &[PassTime]) -> f32 {
        let Some((_, renderer)) = &self.renderer else { return 0.0 };
        let now = self.clock.now();
        let gpu_us = passes.iter().map(|pass| pass.gpu_ms).sum::<f32>() * 1_000.0;
        let cost_us = now.0.saturating_sub(begun.0).max(gpu_us as u64);
        let cost_ms = cost_us as f32 * 1e-3;
        if let Some(tier) = self.governor.observe(now, cost_us, &|tier| renderer.plan(tier)) {
            let budget_ms = self.governor.budget_us().unwrap_or_default() * 1e-3;
            tracing::info!(%tier, plan = ?renderer.plan(tier), "frames took about {cost_ms:.1} ms of {budget_ms:.1}: changing what they do");
        }
        cost_ms
    }

    fn draw_overlay(&mut self, shots: &[Shot], drawn: &Drawn, cost_ms: f32) -> Result<(), FrameError> {
        let Some((_, renderer)) = self.renderer.as_ref().filter(|_| self.overlay_shown || self.controls_shown) else { return Ok(()) };
        let Some(first) = shots.first() else { return Ok(()) };
        let wanted = first.target.format;
        if self.overlay.as_ref().is_none_or(|(format, _)| *format != wanted) {
            let failed = |source: BoxError| FrameError::Failed { action: "setting up the overlay", source };
            self.overlay = Some((wanted, Overlay::new(&self.gpu, wanted).map_err(|error| failed(error.into()))?));
        }
        let Some((_, overlay)) = &mut self.overlay else { return Ok(()) };
        let told = Told {
            drawn,
            before: self.before.as_ref(),
            cost_ms,
            budget_ms: self.governor.budget_us().map(|budget| budget * 1e-3),
            light: renderer.current_light(),
            looking: first.camera.ray(Vec2::ZERO, 1.0),
            controls: self.controls_shown,
        };
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("overlay") });
        overlay.draw(&self.gpu, &mut encoder, shots, &told);
        self.gpu.queue.submit([encoder.finish()]);
        Ok(())
    }
}

impl Stage for LiveStage {
    fn prepare(&mut self) -> Result<bool, FrameError> {
        let laid_out = self.shown.as_ref().is_some_and(|shown| shown.version == self.shared.version());
        let changed = !laid_out || self.local_changed || self.stirred || self.shared.moving();
        Ok(self.renderer.is_some() && self.lit && changed)
    }

    fn update(&mut self, paired: Paired) -> Result<(), FrameError> {
        let failed = |source: BoxError| FrameError::Failed { action: "uploading a picture", source };
        self.environment.upload(&self.gpu, &paired.picture).map_err(|error| failed(error.into()))?;
        self.lit = paired.light.is_some();
        self.pts_us = paired.picture.pts_us;
        if let Some(ReceivedLight { light, .. }) = paired.light {
            if let Some((_, renderer)) = &mut self.renderer {
                renderer.set_light(&light);
            }
            self.light = Some(light);
        }
        Ok(())
    }

    fn relight(&mut self, light: &LightFrame) -> bool {
        let Some((_, renderer)) = self.renderer.as_mut().filter(|_| self.lit) else { return false };
        renderer.relight(light);
        renderer.has_objects()
    }

    fn draw(&mut self, shots: &[Shot]) -> Result<Drawn, FrameError> {
        let Some(wanted) = shots.first().map(|shot| shot.target.format) else { return Ok(Drawn::default()) };
        if self.renderer.as_ref().is_none_or(|(format, _)| *format != wanted) {
            let failed = |source: BoxError| FrameError::Failed { action: "setting up the renderer", source };
            let mut renderer = Renderer::new(&self.gpu, wanted).map_err(|error| failed(error.into()))?;
            renderer.set_parallax(self.parallax);
            renderer.set_resampling(&self.gpu, self.resampling);
            if shots.iter().any(|shot| shot.target.both.is_some()) {
                let multiview = renderer.use_multiview(&self.gpu).map_err(|error| failed(error.into()))?;
                tracing::info!(multiview, "views of both eyes");
            }
            if let Some(light) = &self.light {
                renderer.set_light(light);
            }
            self.renderer = Some((wanted, renderer));
            self.shown = None;
        }
        self.follow_scene();
        let begun = self.clock.now();
        let Some((_, renderer)) = &mut self.renderer else { return Ok(Drawn::default()) };
        let tier = self.governor.tier();
        renderer.set_tier(tier);
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") });
        let views: Vec<View<'_>> = shots.iter().map(view_of).collect();
        let depths: Vec<&wgpu::TextureView> = shots.iter().filter_map(|shot| shot.target.depth.as_ref()).collect();
        renderer.set_keeps_depth(!depths.is_empty());
        let both = shots.first().and_then(|shot| shot.target.both.as_ref());
        let report = match (<&[View<'_>; 2]>::try_from(views.as_slice()), both) {
            (Ok(eyes), Some(both)) => renderer.render_eyes(&self.gpu, &mut encoder, &mut self.environment, (eyes, both)),
            _ => renderer.render(&self.gpu, &mut encoder, &mut self.environment, &views),
        };
        if !depths.is_empty() {
            let failed = |error: GpuError| FrameError::Failed { action: "writing depth", source: error.into() };
            renderer.write_depth(&self.gpu, &mut encoder, &depths).map_err(failed)?;
        }
        self.gpu.queue.submit([encoder.finish()]);
        let FrameReport { passes, plan, .. } = report;
        let cost_ms = self.govern(begun, &passes);
        let drawn = Drawn { passes, tier, plan };
        self.draw_overlay(shots, &drawn, cost_ms)?;
        Ok(drawn)
    }

    fn presented(&mut self, times: &FrameTimes) {
        self.before = Some(*times);
    }

    fn set_interval(&mut self, interval_us: u32) {
        self.governor.set_interval(interval_us);
    }

    fn toggle_overlay(&mut self) {
        self.overlay_shown = !self.overlay_shown;
        self.controls_shown = false;
    }

    fn toggle_controls(&mut self) {
        self.controls_shown = !self.controls_shown;
    }

    fn device_lost(&self) -> Option<String> {
        self.gpu.lost().then(|| "the driver gave it up".to_owned())
    }

    fn has_scene(&self) -> bool {
        self.shown.as_ref().is_some_and(|shown| shown.version > 0)
    }

    fn predict(&mut self, action: &Action, now: ClientTime) {
        let at = action.object().and_then(|object| self.transform(object));
        self.shared.lead(action, at, now);
        self.stirred = true;
    }

    fn show_local(&mut self, objects: &[LocalObject]) {
        self.own = objects.to_vec();
        self.show_own_and_scripted();
    }

    fn show_script(&mut self, objects: &[LocalObject]) {
        self.scripted = objects.to_vec();
        self.show_own_and_scripted();
    }
}

impl LiveStage {
    fn show_own_and_scripted(&mut self) {
        let objects: Vec<_> = self.own.iter().chain(&self.scripted).take(MAX_LOCAL as usize).cloned().collect();
        let alike = |a: &LocalObject, b: &LocalObject| (a.geometry, a.material, a.casts) == (b.geometry, b.material, b.casts);
        let same = objects.len() == self.local.len() && objects.iter().zip(&self.local).all(|(a, b)| alike(a, b));
        self.local_changed |= !same;
        self.stirred |= self.local != objects;
        self.local_ids = (0..).zip(&objects).map(|(index, local)| local_id(index, local.casts)).collect();
        self.local = objects;
    }
}

fn view_of(shot: &Shot) -> View<'_> {
    View { camera: shot.camera, target: &shot.target.view, size: (shot.target.width, shot.target.height) }
}

impl World for LiveStage {
    fn pick(&self, ray: &Ray) -> Option<(ObjectId, Vec3)> {
        self.renderer.as_ref()?.1.pick(ray)
    }

    fn near(&self, point: Vec3, reach_m: f32) -> Option<ObjectId> {
        self.renderer.as_ref()?.1.near(point, reach_m)
    }

    fn transform(&self, object: ObjectId) -> Option<Transform> {
        Some(self.renderer.as_ref()?.1.target(object)?.transform)
    }

    fn object_bounds(&self, object: ObjectId) -> Option<Bounds> {
        Some(self.renderer.as_ref()?.1.target(object)?.bounds)
    }

    fn bounds(&self, geometry: &Geometry) -> Option<Bounds> {
        match geometry {
            Geometry::Shape(Shape::Plane) => Some(Bounds { min: Vec3::new(-0.5, 0.0, -0.5), max: Vec3::new(0.5, 0.0, 0.5) }),
            Geometry::Shape(_) => Some(Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) }),
            Geometry::Model(id) => Some(self.shown.as_ref()?.models.get(id)?.as_ref().ok()?.bounds),
        }
    }

    fn library(&self) -> &[LibraryItem] {
        self.shown.as_ref().map_or(&[][..], |shown| &shown.scene.library[..])
    }

    fn ground_y(&self) -> f32 {
        self.shown.as_ref().map_or(0.0, |shown| shown.scene.ground_y)
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::{LightFrame, SH9};
    use mr360_protocol::scene::SceneMessage;
    use mr360_protocol::video::{StereoLayout, Transfer};

    use super::*;
    use crate::camera::Camera;
    use crate::governor::Tier;
    use crate::picture::{Picture, Samples};
    use crate::sync::ReceivedLight;

    fn snapshot(geometry: Geometry) -> SceneMessage {
        let object = Object { id: ObjectId(1), geometry, transform: Transform::default(), material: None, animation: Default::default() };
        SceneMessage::Snapshot { at_us: 0, scene: Scene { objects: vec![object], ..Scene::default() } }
    }

    fn paired(lit: bool) -> Paired {
        let samples = Samples::Rgba16F { texels: vec![half::f16::ONE; 2 * 4], transfer: Transfer::Linear };
        let picture = Picture { pts_us: 0, width: 2, height: 1, stereo: StereoLayout::Mono, samples };
        let now = ClientTime(0);
        let light = LightFrame { pts_us: 0, published_us: 0, lift: Default::default(), sh: vec![Vec3::ONE; SH9], lights: vec![] };
        let light = lit.then_some(ReceivedLight { light, arrived: now });
        Paired { picture, light, arrived: now, decoded: now, paired: now }
    }

    /// A stage that has drawn one frame of a ball at the origin, and what draws the next.
    fn stand() -> (LiveStage, SharedScene, impl FnMut(&mut LiveStage, bool)) {
        let gpu = Gpu::headless().unwrap();
        let offscreen = crate::headless::Offscreen::new(&gpu.device, &gpu.queue, 8, 8);
        let shared = SharedScene::new(ClientClock::start());
        shared.apply(&snapshot(Geometry::Shape(Shape::Sphere))).unwrap();
        let stage = LiveStage::new(gpu, shared.clone(), Governor::fixed(Tier::FULL)).unwrap();
        let camera = Camera { position: Vec3::Z * 3.0, ..Camera::looking(0.0, 0.0, 1.0) };
        let draw = move |stage: &mut LiveStage, lit| {
            stage.update(paired(lit)).unwrap();
            stage.draw(&[Shot { camera, target: offscreen.target() }]).unwrap();
        };
        (stage, shared, draw)
    }

    fn ahead(x: f32) -> Ray {
        Ray { origin: Vec3::new(x, 0.0, 3.0), direction: Vec3::NEG_Z }
    }

    fn picked(stage: &LiveStage, x: f32) -> Option<ObjectId> {
        Some(stage.pick(&ahead(x))?.0)
    }

    #[test]
    fn a_gap_of_light_hides_objects_and_leaves_them_on_the_gpu() {
        let (mut stage, _, mut draw) = stand();
        let mut seen = Vec::new();
        for lit in [true, false, true] {
            draw(&mut stage, lit);
            seen.push((stage.shown.as_ref().map(|shown| shown.version), picked(&stage, 0.0)));
        }
        assert_eq!(seen, [(Some(1), Some(ObjectId(1))), (Some(1), None), (Some(1), Some(ObjectId(1)))]);
    }

    #[test]
    fn what_the_user_leads_is_there_in_the_next_frame_and_hands_are_drawn_but_not_taken() {
        let (mut stage, shared, mut draw) = stand();
        assert!(!stage.has_scene());
        draw(&mut stage, true);
        assert!(stage.has_scene() && !stage.prepare().unwrap());
        assert_eq!((stage.library().len(), stage.ground_y()), (4, -1.6));
        let moved = Transform { position: Vec3::X * 5.0, ..Transform::default() };
        for action in [Action::Grab(ObjectId(1)), Action::Move(ObjectId(1), moved)] {
            stage.predict(&action, ClientTime(0));
        }
        assert!(stage.prepare().unwrap(), "it looks different");
        draw(&mut stage, true);
        assert_eq!((picked(&stage, 0.0), picked(&stage, 5.0)), (None, Some(ObjectId(1))));
        assert_eq!(stage.transform(ObjectId(1)), Some(moved));
        assert!(!stage.prepare().unwrap(), "held still, it looks the same");

        let pose = crate::hands::Pose { position: Vec3::ZERO, ..crate::hands::Pose::IDENTITY };
        let local = [looks::controller(0, &pose, 1.0), looks::ray(&pose, 2.0, 1.0)];
        stage.show_local(&local);
        assert!(stage.prepare().unwrap());
        draw(&mut stage, true);
        assert!(!stage.prepare().unwrap() && stage.warned.is_empty());
        assert_eq!(picked(&stage, 0.0), None);
        // Moved, they stay in the layout; one less, and all is laid out anew. Neither is the shared scene's business.
        stage.show_local(&[looks::controller(0, &crate::hands::Pose { position: Vec3::Y, ..pose }, 1.0), looks::ray(&pose, 3.0, 1.0)]);
        assert!(!stage.local_changed && stage.prepare().unwrap());
        draw(&mut stage, true);
        stage.show_local(&local[..1]);
        assert!(stage.local_changed);
        draw(&mut stage, true);
        // A script's hands and the user's do not take each other's place.
        stage.show_script(&local[1..]);
        draw(&mut stage, true);
        for _ in 0..3 {
            stage.show_local(&local[..1]);
            stage.show_script(&local[1..]);
            assert!(!stage.local_changed && !stage.stirred && stage.local == local);
        }
        stage.show_script(&[]);
        assert_eq!(stage.local, local[..1]);
        draw(&mut stage, true);
        assert_eq!((shared.version(), shared.shown().scene.objects.len()), (1, 1));
        assert_eq!(picked(&stage, 5.0), Some(ObjectId(1)), "laid out anew, it is where it is led");
    }
}
