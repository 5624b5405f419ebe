//! Both eyes by one pass draw what each by passes of its own does. The system's driver may not draw two layers at once; that of the OpenXR runtime for
//! tests does, so the test runs itself once more on that one.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use glam::{Quat, Vec3};
use mr360_client::camera::Camera;
use mr360_client::environment::Environment;
use mr360_client::governor::Tier;
use mr360_client::gpu::Gpu;
use mr360_client::picture::Picture;
use mr360_client::render::{Models, load_light, load_panorama};
use mr360_client::scene::model::Model;
use mr360_client::view::{DEPTH_FORMAT, FrameReport, Parallax, Renderer, Resampling, View};
use mr360_protocol::asset::AssetId;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Gloss, ObjectId, PlaceMesh, Scene, Transform};
use mr360_protocol::video::StereoLayout;
use mr360_tests::models::ball;
use mr360_tests::sandbox::{Sandbox, media};
use mr360_tests::xr::XrRuntime;

use super::hold::folder;
use super::{materials, video};

/// Set where the driver is the runtime's, to the panorama: there the path of the program, by which it is found, is that of the dynamic loader.
const THERE: &str = "MR360_TEST_ON_THE_RUNTIMES_DRIVER";
/// See [`super::PANORAMAS`].
const PANORAMA: &str = "esplanade";
const SIZE: (u32, u32) = (160, 96);
/// Of an eye from the middle, metres.
const HALF_DISTANCE_M: f32 = 0.032;

/// What is drawn, and how.
struct Case {
    name: &'static str,
    picture: Picture,
    scene: Scene,
    tier: Tier,
}

/// What came of it: both eyes' pictures and depths.
struct Pair {
    colours: [Vec<u8>; 2],
    depths: [Vec<u8>; 2],
    report: FrameReport,
}

#[test]
fn one_pass_draws_both_eyes_as_two_do() -> Result<()> {
    let Some(path) = std::env::var_os(THERE) else {
        return on_the_runtimes_driver("multiview::one_pass_draws_both_eyes_as_two_do");
    };
    let gpu = Gpu::headless()?;
    let panorama = || load_panorama(Path::new(&path), StereoLayout::Mono);
    let light = load_light(&folder().join(format!("{PANORAMA}.json")))?;
    let (objects, mut models) = every_material()?;
    for case in cases(&panorama, &objects, &mut models)? {
        let [apart, together] = [false, true].map(|multiview| draw(&gpu, multiview, &case, &light, &models));
        let (apart, together) = (apart?, together?);
        for eye in 0..2 {
            ensure!(apart.colours[eye] == together.colours[eye], "{}: the picture of eye {eye} differs", case.name);
            ensure!(apart.depths[eye] == together.depths[eye], "{}: the depth of eye {eye} differs", case.name);
        }
        ensure!(together.colours[0] != together.colours[1], "{}: both eyes see the same", case.name);
        ensure!(together.depths[0] != together.depths[1], "{}: both eyes have the same depth", case.name);
        let (draws, of) = (together.report.draws, apart.report.draws);
        ensure!(4 * draws < 3 * of, "{}: {draws} draws by one pass, {of} by two", case.name);
        let passes = |pair: &Pair| pair.report.passes.iter().filter(|pass| pass.name.contains("view 2")).count();
        ensure!(passes(&together) == 0 && passes(&apart) > 0, "{}: an eye has passes of its own", case.name);
    }
    Ok(())
}

/// Runs a test of this program again, through the dynamic loader of the runtime and so with its Vulkan driver.
fn on_the_runtimes_driver(test: &str) -> Result<()> {
    let sandbox = Sandbox::new()?;
    let mut command = XrRuntime::new(&sandbox, "xr")?.starter()?;
    let output = command
        .arg(std::env::current_exe()?)
        .args(["--exact", test, "--nocapture"])
        .env(THERE, media(&format!("hdr/{PANORAMA}.exr"))?)
        .output()
        .context("the runtime's dynamic loader")?;
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    ensure!(output.status.success() && said.contains("1 passed"), "on the runtime's driver:\n{said}");
    Ok(())
}

/// Objects of every material beside each other, in two rows.
fn every_material() -> Result<(Scene, Models)> {
    let (mut scene, mut models) = (Scene { ground_y: -1.6, ..Scene::default() }, HashMap::new());
    for (at, (_, one, assets)) in materials::all()?.into_iter().enumerate() {
        models.extend(assets);
        for mut object in one.objects {
            object.id = ObjectId(at as u32 + 1);
            object.transform.scale *= 0.5;
            object.transform.position = Vec3::new(0.55 * (at % 5) as f32 - 1.1, if at < 5 { -1.3 } else { -0.7 }, -2.6);
            scene.objects.push(object);
        }
    }
    Ok((scene, models))
}

fn cases(linear: &dyn Fn() -> Result<Picture>, scene: &Scene, models: &mut Models) -> Result<Vec<Case>> {
    let room = ball(24).finish()?;
    let id = AssetId::of(&room);
    models.insert(id, Arc::new(Model::parse(&room)?));
    let mesh = |gloss| {
        let transform = Transform { position: Vec3::new(0.3, -1.7, -2.0), rotation: Quat::IDENTITY, scale: Vec3::splat(0.8) };
        PlaceMesh { model: id, transform, casts_shadows: true, gloss }
    };
    let polished = Gloss { roughness: 0.2, reflectance: Gloss::DIELECTRIC };
    // One reaches beneath the ground, which hides it there.
    let mut sunk = scene.clone();
    if let Some(object) = sunk.objects.first_mut() {
        object.transform.position.y -= 0.3;
    }
    let glossy = Scene { ground: polished, place: vec![mesh(polished)], ..sunk.clone() };
    let matt = Scene { place: vec![mesh(Gloss::MATT)], ..scene.clone() };
    let still = |picture: Picture| Picture { pts_us: materials::TIME_US, ..picture };
    Ok(vec![
        Case { name: "matt ground", picture: still(linear()?), scene: sunk, tier: Tier::FULL },
        Case { name: "glossy ground and place", picture: still(linear()?), scene: glossy, tier: Tier::FULL },
        Case {
            name: "place before coded video",
            picture: still(video::coded(&linear()?, video::COLOURS[0].1)?),
            scene: matt,
            tier: Tier::FULL,
        },
        Case {
            name: "stereo video, lowest tier",
            picture: still(video::top_bottom(&linear()?)?),
            scene: scene.clone(),
            tier: Tier::LOWEST,
        },
    ])
}

fn layers(gpu: &Gpu, format: wgpu::TextureFormat) -> (wgpu::Texture, [wgpu::TextureView; 2], wgpu::TextureView) {
    let texture = gpu.device.create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d { width: SIZE.0, height: SIZE.1, depth_or_array_layers: 2 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let each = [0, 1].map(|base_array_layer| {
        let (dimension, array_layer_count) = (Some(wgpu::TextureViewDimension::D2), Some(1));
        texture.create_view(&wgpu::TextureViewDescriptor { dimension, base_array_layer, array_layer_count, ..Default::default() })
    });
    let both = texture.create_view(&wgpu::TextureViewDescriptor::default());
    (texture, each, both)
}

fn draw(gpu: &Gpu, multiview: bool, case: &Case, light: &LightFrame, models: &Models) -> Result<Pair> {
    let format = wgpu::TextureFormat::Rgba32Float;
    let (mut environment, mut renderer) = (Environment::new(gpu)?, Renderer::new(gpu, format)?);
    if multiview {
        ensure!(renderer.use_multiview(gpu)?, "the runtime's driver does not draw two layers at once");
    }
    environment.upload(gpu, &case.picture)?;
    renderer.set_light(light);
    renderer.set_time(case.picture.pts_us);
    renderer.set_tier(case.tier);
    renderer.set_parallax(Parallax::default());
    renderer.set_resampling(gpu, Resampling::Fine);
    renderer.set_keeps_depth(true);
    let warnings = renderer.set_scene(gpu, &case.scene, &|id| models.get(&id).cloned().map(Ok));
    ensure!(warnings.is_empty(), "{}: {warnings:?}", case.name);
    let (colour, targets, both) = layers(gpu, format);
    let (depth, depths, _) = layers(gpu, DEPTH_FORMAT);
    let eye = |right_eye: bool| {
        let aside = if right_eye { HALF_DISTANCE_M } else { -HALF_DISTANCE_M };
        Camera { position: Vec3::new(aside, -0.1, 0.1), right_eye, ..Camera::looking(0.05, -0.3, 1.0) }
    };
    let mut report = FrameReport::default();
    // Times of passes come two frames later.
    for _ in 0..3 {
        let views = [false, true].map(|right| View { camera: eye(right), target: &targets[usize::from(right)], size: SIZE });
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        report = renderer.render_eyes(gpu, &mut encoder, &mut environment, (&views, &both));
        renderer.write_depth(gpu, &mut encoder, &depths.each_ref())?;
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
    }
    let read = |texture: &wgpu::Texture| -> Result<[Vec<u8>; 2]> { Ok([gpu.read_layer(texture, 0)?, gpu.read_layer(texture, 1)?]) };
    Ok(Pair { colours: read(&colour)?, depths: read(&depth)?, report })
}
