//! The renderer on a device that is really lost. They need a Vulkan adapter and fail without one.

use glam::{Quat, Vec3};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Action;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Geometry, Material, Object, ObjectId, Scene, SceneMessage, Shape, Transform};

use super::shared_scene::SharedScene;
use super::*;
use crate::frame_loop::{Drawn, FrameError, Shot, Stage};
use crate::governor::{Governor, Tier};
use crate::hands::{LocalObject, World};
use crate::headless::tests::{endless_frame_loop, png};
use crate::headless::{Files, HeadlessOptions, Pace};
use crate::sync::{ClientClock, Paired};

/// Where in a frame the device is destroyed.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Step {
    Prepare,
    Update,
    Draw,
}

/// A renderer whose device is destroyed under it.
struct Doomed {
    stage: LiveStage,
    device: wgpu::Device,
    /// Counts down the calls of this step.
    ends: Option<(Step, u32)>,
}

impl Doomed {
    fn reached(&mut self, step: Step) {
        match &mut self.ends {
            Some((at, 0)) if *at == step => self.device.destroy(),
            Some((at, left)) if *at == step => *left -= 1,
            _ => {}
        }
    }
}

impl Stage for Doomed {
    fn prepare(&mut self) -> Result<bool, FrameError> {
        self.reached(Step::Prepare);
        self.stage.prepare()
    }

    fn update(&mut self, paired: Paired) -> Result<(), FrameError> {
        self.reached(Step::Update);
        self.stage.update(paired)
    }

    fn relight(&mut self, light: &LightFrame) -> bool {
        self.stage.relight(light)
    }

    fn draw(&mut self, shots: &[Shot]) -> Result<Drawn, FrameError> {
        self.reached(Step::Draw);
        self.stage.draw(shots)
    }

    fn device_lost(&self) -> Option<String> {
        self.stage.device_lost()
    }

    fn has_scene(&self) -> bool {
        self.stage.has_scene()
    }

    fn predict(&mut self, action: &Action, now: ClientTime) {
        self.stage.predict(action, now);
    }

    fn show_local(&mut self, objects: &[LocalObject]) {
        self.stage.show_local(objects);
    }
}

impl World for Doomed {}

/// A white ball in the middle of the view.
fn scene() -> SharedScene {
    let transform = Transform { position: Vec3::new(0.0, 0.0, -3.0), rotation: Quat::IDENTITY, scale: Vec3::ONE };
    let material = Some(Material { base_color: [1.0; 3], ..Material::default() });
    let ball = Object { id: ObjectId(1), geometry: Geometry::Shape(Shape::Sphere), transform, material, animation: Default::default() };
    let shared = SharedScene::new(ClientClock::start());
    shared.apply(&SceneMessage::Snapshot { at_us: 0, scene: Scene { ground_y: -1.6, objects: vec![ball], ..Scene::default() } }).unwrap();
    shared
}

/// The middle of the last of `frames` frames, and how often the device was opened.
fn watch(frames: u64, ends: Option<(Step, u32)>) -> ([u8; 4], u32) {
    let folder = tempfile::tempdir().unwrap();
    let snapshot = folder.path().join("out.png");
    let options = HeadlessOptions { width: 64, height: 36, pace: Pace::Video, frames: Some(frames), duration: None, stop: Arc::default() };
    let files = Files { snapshot: Some(png(&snapshot)), ..Files::default() };
    let (mut frame_loop, feeder) = endless_frame_loop();
    let scene = scene();
    let mut opened = 0;
    let mut open = || {
        opened += 1;
        let gpu = Gpu::headless()?;
        let (device, queue) = (gpu.device.clone(), gpu.queue.clone());
        let stage = Doomed {
            stage: LiveStage::new(gpu, scene.clone(), Governor::fixed(Tier::FULL))?,
            device: device.clone(),
            ends: ends.filter(|_| opened == 1),
        };
        Ok(Graphics { device, queue, stage })
    };
    let report = headless::run(&mut frame_loop, &options, files, &mut open, &mut |_| Camera::looking(0.0, 0.0, 1.0)).unwrap();
    assert_eq!(report.frames, frames);
    drop(frame_loop);
    feeder.join().unwrap();
    (image::open(&snapshot).unwrap().to_rgba8().get_pixel(32, 18).0, opened)
}

#[test]
fn a_device_destroyed_in_mid_run_is_opened_anew_and_the_objects_come_back() {
    let (whole, opened) = watch(6, None);
    assert_eq!(opened, 1);
    assert!(whole[0] > 100, "the ball is not there: {whole:?}");
    for step in [Step::Prepare, Step::Update, Step::Draw] {
        assert_eq!(watch(6, Some((step, 2))), (whole, 2), "destroyed in {step:?}");
    }
    // While the geometry goes up, and in the last frame, which counts only when a device has drawn it.
    for calls in [0, 5] {
        assert_eq!(watch(6, Some((Step::Draw, calls))), (whole, 2), "destroyed in draw {calls}");
    }
}
