//! The renderer on a live broadcast: scene updates, pictures with their light, views.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use glam::{Vec2, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::clock::ClientTime;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{ApplyError, ObjectId, Scene, SceneMessage, Transform};

use crate::camera::Camera;
use crate::environment::Environment;
use crate::frame_loop::{BoxError, Drawn, FrameError, Shot, Stage};
use crate::governor::Governor;
use crate::gpu::{Gpu, GpuError};
use crate::overlay::{Overlay, Told};
use crate::scene::model::{LoadedModel, ModelError};
use crate::scene::pick::Ray;
use crate::stats::{FrameTimes, PassTime};
use crate::sync::{ClientClock, Paired, ReceivedLight};
use crate::view::{Element, FrameReport, Parallax, Renderer, View};

/// Most bytes of memory for all models together.
const MAX_MODEL_BYTES: usize = 2 * 1024 * 1024 * 1024;
/// Farthest point of the ground that the pointer reaches, metres.
const REACH_M: f32 = 100.0;

/// The session's scene and models, written by the network's thread and read by the frame loop.
#[derive(Clone, Default)]
pub struct SharedScene(Arc<Mutex<SceneState>>);

#[derive(Default, Clone)]
struct SceneState {
    /// Shared with the frame loop, which keeps the one it draws: changes are made to a copy then.
    scene: Arc<Scene>,
    models: Arc<HashMap<AssetId, LoadedModel>>,
    /// Counts changes of either.
    version: u64,
}

impl SharedScene {
    fn lock(&self) -> MutexGuard<'_, SceneState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes in a message of the scene track.
    ///
    /// # Errors
    /// When a delta does not follow; the next snapshot heals that.
    pub fn apply(&self, message: &SceneMessage) -> Result<(), ApplyError> {
        let mut state = self.lock();
        Arc::make_mut(&mut state.scene).apply(message)?;
        state.version += 1;
        Ok(())
    }

    /// Takes in a model. Where all together would take too much memory, those that no object shows go first.
    pub fn add_model(&self, id: AssetId, model: LoadedModel) {
        let mut state = self.lock();
        let state = &mut *state;
        let bytes = |model: &LoadedModel| model.as_ref().map_or(0, |model| model.bytes());
        let room = MAX_MODEL_BYTES.saturating_sub(bytes(&model));
        let models = Arc::make_mut(&mut state.models);
        if models.values().map(bytes).sum::<usize>() > room {
            let shown = state.scene.assets();
            models.retain(|id, _| shown.contains(id));
        }
        let fits = models.values().map(bytes).sum::<usize>() <= room;
        let too_large = ModelError::TooLarge { what: "bytes of memory with the scene's other models", limit: MAX_MODEL_BYTES };
        models.insert(id, if fits { model } else { Err(too_large) });
        state.version += 1;
    }

    /// Scene and models of this moment; the lock is not held any longer.
    fn snapshot(&self) -> SceneState {
        self.lock().clone()
    }

    /// Height of the ground.
    #[must_use]
    pub fn ground_y(&self) -> f32 {
        self.lock().scene.ground_y
    }

    /// The object's transform with another position.
    #[must_use]
    pub fn moved_to(&self, id: ObjectId, position: Vec3) -> Option<Transform> {
        let state = self.lock();
        let object = state.scene.object(id)?;
        Some(Transform { position, ..object.transform })
    }
}

/// The renderer behind the frame loop.
pub struct LiveStage {
    gpu: Gpu,
    environment: Environment,
    shared: SharedScene,
    /// Made when the first target tells its format.
    renderer: Option<(wgpu::TextureFormat, Renderer)>,
    /// Version of the shared scene on the GPU.
    shown: Option<u64>,
    ground_y: f32,
    /// Objects need the light of their picture; without it they are hidden.
    lit: bool,
    light: Option<LightFrame>,
    /// Of the picture, microseconds: when its animations are.
    pts_us: u64,
    warned: HashMap<Element, String>,
    governor: Governor,
    parallax: Parallax,
    clock: ClientClock,
    /// The last frame that was presented.
    before: Option<FrameTimes>,
    overlay_shown: bool,
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
        Ok(Self {
            gpu,
            environment,
            shared,
            renderer: None,
            shown: None,
            ground_y: 0.0,
            lit: false,
            light: None,
            pts_us: 0,
            warned: HashMap::new(),
            governor,
            parallax: Parallax::default(),
            clock: ClientClock::start(),
            before: None,
            overlay_shown: false,
            overlay: None,
        })
    }

    /// The same with the background of mono video at this distance.
    #[must_use]
    pub fn with_parallax(self, parallax: Parallax) -> Self {
        Self { parallax, ..self }
    }

    fn follow_scene(&mut self) {
        let Some((_, renderer)) = &mut self.renderer else { return };
        // Without light there is nothing to show objects by. They stay on the GPU: the light may be back with the next picture.
        renderer.set_visible(self.lit);
        renderer.set_time(self.pts_us);
        if self.shown == Some(self.shared.lock().version) {
            return;
        }
        let state = self.shared.snapshot();
        for warning in renderer.set_scene(&self.gpu, &state.scene, &|id| state.models.get(&id).cloned()) {
            let text = warning.to_string();
            if self.warned.insert(warning.element, text.clone()).as_ref() != Some(&text) {
                tracing::warn!("{text}; it is left out");
            }
        }
        self.ground_y = state.scene.ground_y;
        self.shown = Some(state.version);
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
        let Some((_, renderer)) = self.renderer.as_ref().filter(|_| self.overlay_shown) else { return Ok(()) };
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
        };
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("overlay") });
        overlay.draw(&self.gpu, &mut encoder, shots, &told);
        self.gpu.queue.submit([encoder.finish()]);
        Ok(())
    }
}

impl Stage for LiveStage {
    fn prepare(&mut self) -> Result<bool, FrameError> {
        let version = self.shared.lock().version;
        Ok(self.renderer.is_some() && self.lit && self.shown != Some(version))
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
        let report = renderer.render(&self.gpu, &mut encoder, &mut self.environment, &views);
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
    }

    fn device_lost(&self) -> Option<String> {
        self.gpu.lost().then(|| "the driver gave it up".to_owned())
    }

    fn pick(&self, camera: &Camera, ndc: Vec2, aspect: f32) -> Option<ObjectId> {
        let (_, renderer) = self.renderer.as_ref()?;
        Some(renderer.pick(&ray(camera, ndc, aspect))?.0)
    }

    fn ground_point(&self, camera: &Camera, ndc: Vec2, aspect: f32) -> Option<Vec3> {
        ray(camera, ndc, aspect).ground(self.ground_y, REACH_M)
    }

    fn position(&self, object: ObjectId) -> Option<Vec3> {
        Some(self.shared.lock().scene.object(object)?.transform.position)
    }
}

fn view_of(shot: &Shot) -> View<'_> {
    View { camera: shot.camera, target: &shot.target.view, size: (shot.target.width, shot.target.height) }
}

fn ray(camera: &Camera, ndc: Vec2, aspect: f32) -> Ray {
    Ray { origin: camera.position, direction: camera.ray(ndc, aspect) }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::{LightFrame, SH9};
    use mr360_protocol::scene::{Geometry, Object};
    use mr360_protocol::video::{StereoLayout, Transfer};

    use super::*;
    use crate::governor::Tier;
    use crate::picture::{Picture, Samples};
    use crate::scene::mesh::{Bounds, Mesh};
    use crate::scene::model::Model;
    use crate::sync::ReceivedLight;

    fn model(indices: usize) -> LoadedModel {
        let mesh = Mesh { vertices: Vec::new(), indices: vec![0; indices] };
        let parts = vec![crate::scene::model::Part { mesh, ..Default::default() }];
        Ok(Arc::new(Model { parts, textures: Vec::new(), bounds: Bounds::EMPTY, rig: None }))
    }

    fn snapshot(geometry: Geometry) -> SceneMessage {
        let object = Object { id: ObjectId(1), geometry, transform: Transform::default(), material: None, animation: Default::default() };
        SceneMessage::Snapshot(Scene { objects: vec![object], ..Scene::default() })
    }

    #[test]
    fn what_the_frame_loop_holds_does_not_change_under_it() {
        let shared = SharedScene::default();
        let id = AssetId::of(b"a");
        shared.apply(&snapshot(Geometry::Model(id))).unwrap();
        let before = shared.snapshot();
        shared.add_model(id, model(3));
        shared.apply(&SceneMessage::Snapshot(Scene::default())).unwrap();
        assert_eq!((before.scene.objects.len(), before.models.len(), before.version), (1, 0, 1));
        let after = shared.snapshot();
        assert_eq!((after.scene.objects.len(), after.models.len(), after.version), (0, 1, 3));
        // Nothing changed: the same scene and models, not copies of them.
        assert!(Arc::ptr_eq(&after.scene, &shared.snapshot().scene) && Arc::ptr_eq(&after.models, &shared.snapshot().models));
    }

    #[test]
    fn models_that_nobody_shows_make_room_and_too_many_are_refused() {
        let shared = SharedScene::default();
        let [shown, unseen, third, fourth] = [b"a", b"b", b"c", b"d"].map(|name| AssetId::of(name));
        shared.apply(&snapshot(Geometry::Model(shown))).unwrap();
        // Zeroed memory that nobody reads costs none.
        let large = || model(MAX_MODEL_BYTES / 4 / 2);
        shared.add_model(shown, large());
        shared.add_model(unseen, large());
        shared.add_model(third, model(3));
        let models = shared.snapshot().models;
        assert!(models.contains_key(&shown) && !models.contains_key(&unseen) && models[&third].is_ok());
        shared.add_model(fourth, model(MAX_MODEL_BYTES / 4 / 2 + 1));
        assert!(matches!(shared.snapshot().models[&fourth], Err(ModelError::TooLarge { .. })));
    }

    fn paired(lit: bool) -> Paired {
        let samples = Samples::Rgba16F { texels: vec![half::f16::ONE; 2 * 4], transfer: Transfer::Linear };
        let picture = Picture { pts_us: 0, width: 2, height: 1, stereo: StereoLayout::Mono, samples };
        let now = ClientTime(0);
        let light = LightFrame { pts_us: 0, published_us: 0, lift: Default::default(), sh: vec![Vec3::ONE; SH9], lights: vec![] };
        let light = lit.then_some(ReceivedLight { light, arrived: now });
        Paired { picture, light, arrived: now, decoded: now, paired: now }
    }

    #[test]
    fn a_gap_of_light_hides_objects_and_leaves_them_on_the_gpu() {
        let gpu = Gpu::headless().unwrap();
        let (device, queue) = (gpu.device.clone(), gpu.queue.clone());
        let shared = SharedScene::default();
        shared.apply(&snapshot(Geometry::Shape(mr360_protocol::scene::Shape::Sphere))).unwrap();
        let mut stage = LiveStage::new(gpu, shared, Governor::fixed(Tier::FULL)).unwrap();
        let offscreen = crate::headless::Offscreen::new(&device, &queue, 8, 8);
        let camera = Camera { position: Vec3::Z * 3.0, ..Camera::looking(0.0, 0.0, 1.0) };
        let mut seen = Vec::new();
        for lit in [true, false, true] {
            stage.update(paired(lit)).unwrap();
            stage.draw(&[Shot { camera, target: offscreen.target() }]).unwrap();
            seen.push((stage.shown, stage.pick(&camera, Vec2::ZERO, 1.0)));
        }
        assert_eq!(seen, [(Some(1), Some(ObjectId(1))), (Some(1), None), (Some(1), Some(ObjectId(1)))]);
    }
}
