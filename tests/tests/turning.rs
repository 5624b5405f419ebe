//! A camera that turns once around in a place where nothing moves: what stands still must not change, neither a shadow's texels nor a reflection's mips.
//!
//! Frames are compared in the world and not in the picture: each is averaged over patches of directions that stay where they are, with weights that
//! fall off smoothly and pixels that count by their solid angle, so that another grid of pixels over the same light gives the same averages but for the
//! noise of edges. That noise is told by the turn itself: a step whose changes exceed those of the others is a jump.

use std::collections::HashMap;
use std::f32::consts::{PI, TAU};

use anyhow::{Result, ensure};
use glam::{Quat, Vec2, Vec3};
use half::f16;
use mr360_client::camera::Camera;
use mr360_client::environment::Environment;
use mr360_client::gpu::Gpu;
use mr360_client::picture::{Picture, Samples};
use mr360_client::view::{Renderer, View};
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame};
use mr360_protocol::scene::{Geometry, Material, MaterialKind, Object, ObjectId, Playback, Scene, Shape, Transform};
use mr360_protocol::video::{StereoLayout, Transfer};

const SIZE: (u32, u32) = (320, 180);
const FOV_Y_RAD: f32 = 1.0;
const PITCH_RAD: f32 = -0.3;
/// Distance of the middles of patches, degrees; their weights reach as far.
const PATCH_DEG: f32 = 3.0;
/// Patches lie between these latitudes, degrees.
const LATITUDES_DEG: (f32, f32) = (-45.0, 0.0);
/// A jump changes patches by so many times as much as a step of the turn does: more than 1.7, the most that noise was seen to do, and less than 3.4,
/// what a single texel of the shadow map does.
const JUMP: f32 = 2.3;
/// Most that a step of the turn changes patches on average, of white: twice what was seen, and half of what a texel in every step would do.
const NOISE: f32 = 1e-4;

/// A place with the camera in its middle.
struct Place {
    gpu: Gpu,
    environment: Environment,
    renderer: Renderer,
    target: wgpu::Texture,
}

/// Radiance of the panorama: smooth, without a seam, brighter upwards.
fn radiance(towards: Vec3) -> Vec3 {
    Vec3::new(0.35, 0.4, 0.5)
        + Vec3::new(0.1, 0.15, 0.25) * towards.y
        + Vec3::new(0.1, 0.05, 0.0) * towards.x
        + Vec3::new(0.0, 0.05, 0.05) * towards.z
}

fn panorama() -> Picture {
    let (width, height) = (512, 256);
    let texel = |at: u32| {
        let u = ((at % width) as f32 + 0.5) / width as f32;
        let v = ((at / width) as f32 + 0.5) / height as f32;
        let [r, g, b] = radiance(towards((u - 0.5) * TAU, (0.5 - v) * PI)).to_array().map(f16::from_f32);
        [r, g, b, f16::ONE]
    };
    let texels = (0..width * height).flat_map(texel).collect();
    Picture { pts_us: 0, width, height, stereo: StereoLayout::Mono, samples: Samples::Rgba16F { texels, transfer: Transfer::Linear } }
}

fn towards(longitude: f32, latitude: f32) -> Vec3 {
    Vec3::new(latitude.cos() * longitude.sin(), latitude.sin(), -latitude.cos() * longitude.cos())
}

/// Roughness and metal of surfaces that show shadows and nothing else, and of those that reflect.
const MATT: [(f32, f32); 1] = [(1.0, 0.0)];
const POLISHED: [(f32, f32); 3] = [(0.2, 0.0), (0.0, 1.0), (0.4, 1.0)];

/// Balls all around, of these surfaces in turn. Not cubes: an upright edge in the middle of the picture lies along its columns, and all its pixels round at
/// once.
fn scene(surfaces: &[(f32, f32)]) -> Scene {
    let object = |at: u32| {
        let (roughness, metallic) = surfaces[at as usize % surfaces.len()];
        let around = at as f32 / 12.0 * TAU + 0.1;
        let position = Vec3::new(3.5 * around.sin(), -1.2, -3.5 * around.cos());
        Object {
            id: ObjectId(at + 1),
            geometry: Geometry::Shape(Shape::Sphere),
            transform: Transform { position, rotation: Quat::from_rotation_y(around), scale: Vec3::splat(0.8) },
            material: Some(Material { base_color: [0.7, 0.6, 0.5], roughness, metallic, kind: MaterialKind::Opaque }),
            animation: Playback::First,
        }
    };
    Scene { ground_y: -1.6, objects: (0..12).map(object).collect(), ..Scene::default() }
}

/// Harmonics of the panorama's even part; and a sun, turned by an angle about the vertical.
fn light(sun_turned_rad: Option<f32>) -> LightFrame {
    let mut sh = vec![Vec3::ZERO; 9];
    sh[0] = Vec3::new(0.35, 0.4, 0.5) / 0.282_095;
    sh[1] = Vec3::new(0.1, 0.15, 0.25) / 0.488_603;
    let sun = |turned_rad| DirectionalLight {
        id: 1,
        direction: Quat::from_rotation_y(turned_rad) * Vec3::new(0.6, 0.6, 0.5).normalize(),
        irradiance: Vec3::splat(1.6),
        // Its penumbrae are wider than a pixel: edges sharper than that lie along rows at times, and then all their pixels round at once.
        solid_angle_sr: 0.015,
    };
    LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh, lights: sun_turned_rad.map(sun).into_iter().collect() }
}

impl Place {
    fn new() -> Result<Self> {
        let gpu = Gpu::headless()?;
        let mut environment = Environment::new(&gpu)?;
        environment.upload(&gpu, &panorama())?;
        let format = wgpu::TextureFormat::Rgba32Float;
        let renderer = Renderer::new(&gpu, format)?;
        let target = gpu.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("turning"),
            size: wgpu::Extent3d { width: SIZE.0, height: SIZE.1, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        Ok(Self { gpu, environment, renderer, target })
    }

    fn set(&mut self, scene: &Scene, light: &LightFrame) -> Result<()> {
        self.renderer.set_light(light);
        let warnings = self.renderer.set_scene(&self.gpu, scene, &|_| None);
        ensure!(warnings.is_empty(), "{warnings:?}");
        Ok(())
    }

    /// The patches as seen with the camera turned so far to the left.
    fn seen(&mut self, yaw_deg: f32) -> Result<Patches> {
        let camera = Camera::looking(yaw_deg.to_radians(), PITCH_RAD, FOV_Y_RAD);
        let view = self.target.create_view(&wgpu::TextureViewDescriptor::default());
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        self.renderer.render(&self.gpu, &mut encoder, &mut self.environment, &[View { camera, target: &view, size: SIZE }]);
        self.gpu.queue.submit([encoder.finish()]);
        let bytes = self.gpu.read_texture(&self.target)?;
        let value = |four: &[u8]| f32::from_le_bytes([four[0], four[1], four[2], four[3]]);
        // Green is as good as any: nothing here is of one colour alone. What exceeds white, as a sun in a mirror, is white on a screen.
        Ok(Patches::new(&camera, bytes.chunks_exact(16).map(|texel| value(&texel[4..8]).min(1.0))))
    }
}

/// Averages by column and row of the patches' grid, of those that lie in the picture as a whole.
struct Patches(HashMap<(i32, i32), f32>);

impl Patches {
    fn new(camera: &Camera, pixels: impl Iterator<Item = f32>) -> Self {
        let aspect = SIZE.0 as f32 / SIZE.1 as f32;
        let columns = (360.0 / PATCH_DEG) as i32;
        let mut sums: HashMap<(i32, i32), (f32, f32)> = HashMap::new();
        for (at, value) in pixels.enumerate() {
            let (x, y) = (at as u32 % SIZE.0, at as u32 / SIZE.0);
            let ndc = Vec2::new((x as f32 + 0.5) / SIZE.0 as f32 * 2.0 - 1.0, 1.0 - (y as f32 + 0.5) / SIZE.1 as f32 * 2.0);
            let ray = camera.ray(ndc, aspect);
            // A pixel's solid angle falls with the cube of the cosine to the axis.
            let area = ray.dot(camera.world_from_view * Vec3::NEG_Z).powi(3);
            let place = Vec2::new(ray.x.atan2(-ray.z), ray.y.asin()) * (180.0 / PI / PATCH_DEG);
            for (across, up) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let patch = place.floor() + Vec2::new(across as f32, up as f32);
                let weight = (Vec2::ONE - (place - patch).abs()).max(Vec2::ZERO);
                let weight = area * weight.x * weight.y;
                let sum = sums.entry(((patch.x as i32).rem_euclid(columns), patch.y as i32)).or_default();
                *sum = (sum.0 + weight * value, sum.1 + weight);
            }
        }
        let whole = |(column, row): (i32, i32)| {
            let corner = |(across, up): (f32, f32)| {
                let angle = |at: i32, aside: f32| (at as f32 + aside) * PATCH_DEG.to_radians();
                in_picture(camera, towards(angle(column, across), angle(row, up)))
            };
            let latitude = row as f32 * PATCH_DEG;
            (LATITUDES_DEG.0..=LATITUDES_DEG.1).contains(&latitude)
                && [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].into_iter().all(corner)
        };
        Self(sums.into_iter().filter(|(patch, _)| whole(*patch)).map(|(patch, (sum, weight))| (patch, sum / weight)).collect())
    }

    /// Mean change of the patches that both frames show.
    fn change_to(&self, next: &Self) -> Result<f32> {
        let changes: Vec<f32> = self.0.iter().filter_map(|(patch, value)| Some((next.0.get(patch)? - value).abs())).collect();
        ensure!(changes.len() > 200, "only {} patches are seen as a whole", changes.len());
        Ok(changes.iter().sum::<f32>() / changes.len() as f32)
    }
}

fn median(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    sorted[sorted.len() / 2]
}

fn in_picture(camera: &Camera, direction: Vec3) -> bool {
    let view = camera.world_from_view.inverse() * direction;
    let tan = (FOV_Y_RAD / 2.0).tan();
    let aspect = SIZE.0 as f32 / SIZE.1 as f32;
    view.z < 0.0 && (view.x / -view.z).abs() < 0.97 * tan * aspect && (view.y / -view.z).abs() < 0.97 * tan
}

/// Changes with every step of one degree; `alter` is called before the frame of each degree but the first.
fn turn(place: &mut Place, degrees: std::ops::Range<i32>, mut alter: impl FnMut(&mut Place, i32) -> Result<()>) -> Result<Vec<f32>> {
    let mut before = place.seen(degrees.start as f32)?;
    let mut changes = Vec::new();
    for degree in degrees.start + 1..=degrees.end {
        alter(place, degree)?;
        let now = place.seen(degree as f32)?;
        changes.push(before.change_to(&now)?);
        before = now;
    }
    Ok(changes)
}

/// A place in which shadows can jump, and one in which reflections can. A sun in polished surfaces would be a dot smaller than a pixel, which flickers on
/// any screen.
fn places() -> [(&'static str, Scene, LightFrame); 2] {
    [("shadows", scene(&MATT), light(Some(0.0))), ("reflections", scene(&POLISHED), light(None))]
}

#[test]
fn nothing_jumps_while_the_camera_turns_once_around() -> Result<()> {
    let mut place = Place::new()?;
    for (name, scene, light) in places() {
        place.set(&scene, &light)?;
        let changes = turn(&mut place, 0..360, |_, _| Ok(()))?;
        let (noise, (at, largest)) = (median(&changes), (0..).zip(changes).fold((0, 0.0), |a, b| if b.1 > a.1 { b } else { a }));
        eprintln!("{name}: a step changes patches by {noise:.2e}, the largest, from {at}°, by {:.2} times as much", largest / noise);
        ensure!(noise < NOISE, "{name}: every step of the turn changes what stands still, by {noise}");
        ensure!(
            largest < JUMP * noise,
            "{name}: the step from {at}° changes what stands still {:.2} times as much as others",
            largest / noise
        );
    }
    Ok(())
}

#[test]
fn a_jump_of_a_shadow_or_of_a_reflection_is_seen() -> Result<()> {
    const JUMPS_AT: i32 = 31;
    let mut place = Place::new()?;
    let [(_, matt, sun), (_, polished, sky)] = places();
    // The sun turns by as much as moves the tip of a shadow one metre long by a texel of a map that spans the ring of balls, 8 m.
    let texel = light(Some(8.0 / mr360_shaders::layout::SHADOW_MAP_SIZE as f32));
    let rougher = scene(&POLISHED.map(|(roughness, metallic)| (roughness + 0.05, metallic)));
    for (name, before, after) in
        [("a texel of a shadow", (&matt, &sun), (&matt, &texel)), ("a twentieth of roughness", (&polished, &sky), (&rougher, &sky))]
    {
        place.set(before.0, before.1)?;
        let changes = turn(&mut place, 0..60, |place, degree| if degree == JUMPS_AT { place.set(after.0, after.1) } else { Ok(()) })?;
        let excess = changes[JUMPS_AT as usize - 1] / median(&changes);
        eprintln!("{name} changes patches by {excess:.2} times as much as a step of the turn");
        ensure!(excess > JUMP, "{name} that jumps changes patches only {excess:.2} times as much as a step of the turn");
    }
    Ok(())
}
