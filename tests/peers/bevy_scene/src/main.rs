//! Balls on a ground in a panorama, drawn by Bevy as its users would set it up, and timed; the peer of `mr360-bench render --part bevy`.
//!
//! Reads one job as JSON from stdin, draws to a texture without pipelining and waits for the GPU after every frame, and prints two lines: what drew,
//! and the milliseconds of every frame as a JSON array. Where the job asks for it the last picture is written as RGBA of 8 bits, sRGB.
//!
//! What is made better than the defaults, to judge Bevy at its best: the lights are taken out of the environment, so that they do not count twice; the
//! ground has the albedo that makes it look, with nothing on it, as the panorama does; a still panorama is filtered once, and not on every frame.

use std::collections::VecDeque;
use std::io::Read as _;
use std::path::PathBuf;
use std::time::Instant;

use bevy::app::PluginsState;
use bevy::asset::RenderAssetUsages;
use bevy::camera::{Exposure, RenderTarget};
use bevy::core_pipeline::tonemapping::{DebandDither, Tonemapping};
use bevy::image::ImageSampler;
use bevy::light::{CascadeShadowConfigBuilder, DirectionalLightShadowMap, GlobalAmbientLight, NotShadowCaster, Skybox};
use bevy::log::LogPlugin;
use bevy::mesh::{Indices, PrimitiveTopology};
use bevy::prelude::*;
use bevy::render::RenderPlugin;
use bevy::render::gpu_readback::{Readback, ReadbackComplete};
use bevy::render::pipelined_rendering::PipelinedRenderingPlugin;
use bevy::render::render_resource::{
    Extent3d, PollType, TextureDimension, TextureFormat, TextureUsages, TextureViewDescriptor, TextureViewDimension,
};
use bevy::render::renderer::{RenderAdapterInfo, RenderDevice};
use bevy::window::ExitCondition;
use half::f16;
use panorama::Panorama;
use serde::Deserialize;

mod panorama;

/// Columns and rows of a face of the environment's cube: as fine as a panorama of 1024 columns.
const FACE: u32 = 256;
/// Frames that a picture on its way back from the GPU may take.
const PATIENCE: u32 = 100;
/// Side of a cell of the ground, degrees of azimuth and depression, and the depression at which it ends.
const GROUND_CELL_DEG: f32 = 3.0;
const GROUND_END_DEG: f32 = 0.5;
/// How far from the camera shadows are drawn, metres.
const SHADOWS_TO_M: f32 = 8.0;

/// What to draw, and how often.
#[derive(Deserialize)]
struct Job {
    /// RGB of 32-bit floats, little-endian, rows from the top.
    panorama: PathBuf,
    columns: usize,
    rows: usize,
    /// The strongest one first; that one alone casts shadows.
    lights: Vec<Light>,
    objects: Vec<Ball>,
    ground_y: f32,
    size: (u32, u32),
    fov_y_deg: f32,
    pitch_deg: f32,
    /// 1 or 4.
    samples: u32,
    shadow_size: usize,
    /// Another panorama with every frame, or the same.
    changing: bool,
    /// Frames before those that are timed.
    warm: u32,
    frames: u32,
    picture: Option<PathBuf>,
}

#[derive(Deserialize)]
pub struct Light {
    direction: [f32; 3],
    irradiance: [f32; 3],
    solid_angle_sr: f32,
}

#[derive(Deserialize)]
struct Ball {
    position: [f32; 3],
    diameter: f32,
    base_color: [f32; 3],
    roughness: f32,
    metallic: f32,
}

/// A picture that came back.
#[derive(Resource, Default)]
struct Returned(Option<Vec<u8>>);

/// What changes with the panorama.
struct Cube {
    image: Handle<Image>,
    /// Texels of the panorama before its light changes and after.
    versions: VecDeque<Vec<u8>>,
}

fn main() {
    if let Err(fault) = run() {
        eprintln!("bevy_scene: {fault}");
        std::process::exit(1);
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let mut text = String::new();
    std::io::stdin().read_to_string(&mut text)?;
    let job: Job = serde_json::from_str(&text)?;
    let whole = Panorama::load(&job.panorama, job.columns, job.rows)?;
    let mut app = start();
    let (target, cube, camera) = set_up(app.world_mut(), &job, &whole);
    let mut cube = cube;
    let mut times = Vec::new();
    for frame in 0..job.warm + job.frames {
        // Filtered by now; the maps stay when the component that has them filtered goes.
        if !job.changing && frame == job.warm / 2 {
            app.world_mut().entity_mut(camera).remove::<GeneratedEnvironmentMapLight>();
        }
        let begin = Instant::now();
        if job.changing {
            change(app.world_mut(), &mut cube);
        }
        turn(&mut app)?;
        if frame >= job.warm {
            times.push(begin.elapsed().as_secs_f64() * 1e3);
        }
    }
    println!("Bevy 0.19.1 on {}", app.world().resource::<RenderAdapterInfo>().name);
    println!("{}", serde_json::to_string(&times)?);
    if let Some(path) = &job.picture {
        std::fs::write(path, read_back(&mut app, target, job.size)?)?;
    }
    Ok(())
}

/// Bevy without a window, and with its GPU open.
fn start() -> App {
    let mut app = App::new();
    let window = WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() };
    let render = RenderPlugin { synchronous_pipeline_compilation: true, ..default() };
    // Its log would go to stdout.
    app.add_plugins(DefaultPlugins.build().disable::<PipelinedRenderingPlugin>().disable::<LogPlugin>().set(window).set(render));
    app.insert_resource(GlobalAmbientLight::NONE);
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();
    app
}

/// One frame, to its end on the GPU.
fn turn(app: &mut App) -> Result<(), Box<dyn std::error::Error>> {
    app.update();
    app.world().resource::<RenderDevice>().poll(PollType::Wait { submission_index: None, timeout: None })?;
    Ok(())
}

fn change(world: &mut World, cube: &mut Cube) {
    cube.versions.rotate_left(1);
    let texels = cube.versions.front().cloned();
    if let Some(mut image) = world.resource_mut::<Assets<Image>>().get_mut(&cube.image) {
        image.data = texels;
    }
}

/// Camera, lights, balls and ground.
fn set_up(world: &mut World, job: &Job, whole: &Panorama) -> (Handle<Image>, Cube, Entity) {
    let rest = job.lights.iter().fold(whole.clone(), |rest, light| rest.without(light));
    let cube = cube(world, &rest);
    let (width, height) = job.size;
    let mut target = Image::new_target_texture(width, height, TextureFormat::Rgba8UnormSrgb, None);
    target.texture_descriptor.usage |= TextureUsages::COPY_SRC;
    let target = world.resource_mut::<Assets<Image>>().add(target);
    let projection = PerspectiveProjection {
        fov: job.fov_y_deg.to_radians(),
        aspect_ratio: width as f32 / height as f32,
        near: 0.05,
        far: 1000.0,
        ..default()
    };
    let camera = world
        .spawn((
            Camera3d::default(),
            RenderTarget::Image(target.clone().into()),
            Projection::Perspective(projection),
            Transform::from_rotation(Quat::from_rotation_x(job.pitch_deg.to_radians())),
            Tonemapping::None,
            DebandDither::Disabled,
            if job.samples == 1 { Msaa::Off } else { Msaa::Sample4 },
            // Radiance comes out as it went in.
            Exposure { ev100: -1.2_f32.log2() },
            Skybox { image: Some(cube.image.clone()), brightness: 1.0, ..default() },
            GeneratedEnvironmentMapLight { environment_map: cube.image.clone(), intensity: 1.0, ..default() },
        ))
        .id();
    world.insert_resource(DirectionalLightShadowMap { size: job.shadow_size });
    for (at, light) in job.lights.iter().enumerate() {
        spawn_light(world, light, at == 0);
    }
    for ball in &job.objects {
        spawn_ball(world, ball);
    }
    spawn_ground(world, job.ground_y, whole);
    (target, cube, camera)
}

fn spawn_light(world: &mut World, light: &Light, casts: bool) {
    let strongest = light.irradiance.into_iter().fold(f32::MIN_POSITIVE, f32::max);
    let [red, green, blue] = light.irradiance.map(|part| part / strongest);
    let cascades =
        CascadeShadowConfigBuilder { num_cascades: 1, minimum_distance: 0.5, maximum_distance: SHADOWS_TO_M, ..default() }.build();
    world.spawn((
        DirectionalLight { color: Color::linear_rgb(red, green, blue), illuminance: strongest, shadow_maps_enabled: casts, ..default() },
        cascades,
        Transform::from_translation(Vec3::from(light.direction)).looking_at(Vec3::ZERO, Vec3::X),
    ));
}

fn spawn_ball(world: &mut World, ball: &Ball) {
    let mesh = world.resource_mut::<Assets<Mesh>>().add(Sphere::new(0.5).mesh().uv(48, 24));
    let [red, green, blue] = ball.base_color;
    let material = world.resource_mut::<Assets<StandardMaterial>>().add(StandardMaterial {
        base_color: Color::linear_rgb(red, green, blue),
        perceptual_roughness: ball.roughness,
        metallic: ball.metallic,
        ..default()
    });
    let place = Transform::from_translation(ball.position.into()).with_scale(Vec3::splat(ball.diameter));
    world.spawn((Mesh3d(mesh), MeshMaterial3d(material), place));
}

/// A fan about the point beneath the camera, whose texture coordinates are the panorama's as seen from there.
fn spawn_ground(world: &mut World, ground_y: f32, whole: &Panorama) {
    let columns = (360.0 / GROUND_CELL_DEG) as u32;
    let depressions = (1..(90.0 / GROUND_CELL_DEG) as u32).rev().map(|row| row as f32 * GROUND_CELL_DEG);
    let depressions: Vec<f32> = std::iter::once(89.9).chain(depressions).chain([1.5, GROUND_END_DEG]).collect();
    let (mut positions, mut coordinates) = (Vec::new(), Vec::new());
    for depression in &depressions {
        for column in 0..=columns {
            let u = column as f32 / columns as f32;
            let (sin, cos) = ((u - 0.5) * std::f32::consts::TAU).sin_cos();
            let distance = -ground_y / depression.to_radians().tan();
            positions.push([distance * sin, ground_y, -distance * cos]);
            coordinates.push([u, 0.5 + depression / 180.0]);
        }
    }
    let corner = |row: u32, column: u32| row * (columns + 1) + column;
    let cells = (0..depressions.len() as u32 - 1).flat_map(|row| (0..columns).map(move |column| (row, column)));
    let indices = cells.flat_map(|(row, column)| {
        let [a, b, c, d] = [corner(row, column), corner(row, column + 1), corner(row + 1, column), corner(row + 1, column + 1)];
        [a, b, c, b, d, c]
    });
    let mut mesh = Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default());
    mesh.insert_attribute(Mesh::ATTRIBUTE_NORMAL, vec![[0.0, 1.0, 0.0]; positions.len()]);
    mesh.insert_attribute(Mesh::ATTRIBUTE_POSITION, positions);
    mesh.insert_attribute(Mesh::ATTRIBUTE_UV_0, coordinates);
    mesh.insert_indices(Indices::U32(indices.collect()));
    let mesh = world.resource_mut::<Assets<Mesh>>().add(mesh);
    let (albedo, emitted) = whole.ground();
    let [albedo, emitted] = [albedo, emitted].map(|map| {
        let mut image = image(&map.texels(), (whole.columns as u32, whole.rows as u32, 1));
        image.sampler = ImageSampler::linear();
        world.resource_mut::<Assets<Image>>().add(image)
    });
    let material = StandardMaterial {
        base_color_texture: Some(albedo),
        emissive: LinearRgba::WHITE,
        emissive_texture: Some(emitted),
        perceptual_roughness: 1.0,
        reflectance: 0.0,
        double_sided: true,
        cull_mode: None,
        ..default()
    };
    let material = world.resource_mut::<Assets<StandardMaterial>>().add(material);
    world.spawn((Mesh3d(mesh), MeshMaterial3d(material), NotShadowCaster));
}

fn image(texels: &[u8], (width, height, layers): (u32, u32, u32)) -> Image {
    let size = Extent3d { width, height, depth_or_array_layers: layers };
    Image::new(size, TextureDimension::D2, texels.to_vec(), TextureFormat::Rgba16Float, RenderAssetUsages::all())
}

/// The panorama on a cube, as Bevy wants one: left-handed, so z has the other sign.
fn cube(world: &mut World, panorama: &Panorama) -> Cube {
    let texels = panorama.cube(FACE);
    let mut image = image(&texels, (FACE, FACE, 6));
    image.texture_view_descriptor = Some(TextureViewDescriptor { dimension: Some(TextureViewDimension::Cube), ..default() });
    let image = world.resource_mut::<Assets<Image>>().add(image);
    // A video's next picture: a little darker.
    let darker =
        texels.chunks_exact(2).flat_map(|half| f16::from_f32(f16::from_le_bytes([half[0], half[1]]).to_f32() * 0.99).to_le_bytes());
    let darker = darker.collect();
    Cube { image, versions: [texels, darker].into() }
}

/// The target as it is after another frame, rows packed.
fn read_back(app: &mut App, target: Handle<Image>, (width, height): (u32, u32)) -> Result<Vec<u8>, Box<dyn std::error::Error>> {
    app.insert_resource(Returned::default());
    app.world_mut().spawn(Readback::texture(target)).observe(|back: On<ReadbackComplete>, mut returned: ResMut<Returned>| {
        returned.0 = Some(back.data.clone());
    });
    for _ in 0..PATIENCE {
        turn(app)?;
        if let Some(bytes) = app.world_mut().resource_mut::<Returned>().0.take() {
            let padded = bytes.len() / height as usize;
            return Ok(bytes.chunks_exact(padded).flat_map(|row| row[..width as usize * 4].to_vec()).collect());
        }
    }
    Err("the picture does not come back from the GPU".into())
}
