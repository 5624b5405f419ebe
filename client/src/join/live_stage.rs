//! The renderer on a live broadcast: scene updates, pictures with their light, views.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use glam::{Vec2, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{ApplyError, ObjectId, Scene, SceneMessage, Transform};

use crate::camera::Camera;
use crate::environment::Environment;
use crate::frame_loop::{BoxError, FrameError, Stage, Target};
use crate::gpu::Gpu;
use crate::scene::pick::Ray;
use crate::stats::PassTime;
use crate::sync::{Paired, ReceivedLight};
use crate::view::{Renderer, View};

/// Farthest point of the ground that the pointer reaches, metres.
const REACH_M: f32 = 100.0;

/// The session's scene and models, written by the network's thread and read by the frame loop.
#[derive(Clone, Default)]
pub struct SharedScene(Arc<Mutex<SceneState>>);

#[derive(Default)]
struct SceneState {
    scene: Scene,
    assets: HashMap<AssetId, Arc<[u8]>>,
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
        state.scene.apply(message)?;
        state.version += 1;
        Ok(())
    }

    /// Takes in a model.
    pub fn add_asset(&self, id: AssetId, bytes: &[u8]) {
        let mut state = self.lock();
        state.assets.insert(id, bytes.into());
        state.version += 1;
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
    warned: HashMap<ObjectId, String>,
}

impl LiveStage {
    /// A stage that shows nothing yet.
    ///
    /// # Errors
    /// When the build lacks a shader.
    pub fn new(gpu: Gpu, shared: SharedScene) -> Result<Self, BoxError> {
        let environment = Environment::new(&gpu)?;
        Ok(Self { gpu, environment, shared, renderer: None, shown: None, ground_y: 0.0, lit: false, light: None, warned: HashMap::new() })
    }

    fn follow_scene(&mut self) {
        let Some((_, renderer)) = &mut self.renderer else { return };
        let state = self.shared.lock();
        let wanted = self.lit.then_some(state.version);
        if self.shown == wanted {
            return;
        }
        // Without light there is nothing to show objects by: an empty scene on the same ground.
        let hidden = Scene { ground_y: state.scene.ground_y, ..Scene::default() };
        let scene = if self.lit { &state.scene } else { &hidden };
        for warning in renderer.set_scene(&self.gpu, scene, &|id| state.assets.get(&id).cloned()) {
            let text = warning.to_string();
            if self.warned.insert(warning.object, text.clone()).as_ref() != Some(&text) {
                tracing::warn!("{text}; the object is left out");
            }
        }
        self.ground_y = state.scene.ground_y;
        self.shown = wanted;
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
        if let Some(ReceivedLight { light, .. }) = paired.light {
            if let Some((_, renderer)) = &mut self.renderer {
                renderer.set_light(&light);
            }
            self.light = Some(light);
        }
        Ok(())
    }

    fn draw(&mut self, camera: &Camera, target: &Target) -> Result<Vec<PassTime>, FrameError> {
        if self.renderer.as_ref().is_none_or(|(format, _)| *format != target.format) {
            let failed = |source: BoxError| FrameError::Failed { action: "setting up the renderer", source };
            let mut renderer = Renderer::new(&self.gpu, target.format).map_err(|error| failed(error.into()))?;
            if let Some(light) = &self.light {
                renderer.set_light(light);
            }
            self.renderer = Some((target.format, renderer));
            self.shown = None;
        }
        self.follow_scene();
        let Some((_, renderer)) = &mut self.renderer else { return Ok(Vec::new()) };
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") });
        let view = View { camera: *camera, target: &target.view, size: (target.width, target.height) };
        let report = renderer.render(&self.gpu, &mut encoder, &mut self.environment, &[view]);
        self.gpu.queue.submit([encoder.finish()]);
        Ok(report.passes.iter().map(|pass| PassTime { name: pass.name, gpu_ms: pass.gpu_ms }).collect())
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

fn ray(camera: &Camera, ndc: Vec2, aspect: f32) -> Ray {
    Ray { origin: camera.position, direction: camera.ray(ndc, aspect) }
}
