//! Lights in reflections, each counted once: in the reflection map or as a highlight. They need a Vulkan adapter and
//! fail without one.

use std::collections::HashMap;
use std::f32::consts::PI;

use glam::{Quat, Vec3};
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame};
use mr360_protocol::scene::{Geometry, Material, MaterialKind, Object, ObjectId, Scene, Shape, Transform};
use mr360_shaders::brdf::albedo;
use mr360_shaders::sh::{basis25, irradiance};
use mr360_shaders::source::Reflections;

use super::tests::{self, panorama};
use crate::camera::Camera;
use crate::gpu::Gpu;
use crate::picture::Picture;
use crate::render::{Still, ambient_light};

pub(super) const SIDE: u32 = 440;
/// Far and narrow: nearly an orthographic view.
pub(super) const FOV: f32 = 0.05;
pub(super) const DISTANCE_M: f32 = 100.0;

/// A disc of the sky, sent as a light.
struct Disc {
    direction: Vec3,
    radius: f32,
    radiance: f32,
}

impl Disc {
    fn picture(&self, around: f32) -> Picture {
        let inside = |d: Vec3| d.dot(self.direction) >= self.radius.cos();
        panorama(1024, 512, |d| Vec3::splat(if inside(d) { self.radiance } else { around }))
    }

    fn light(&self) -> DirectionalLight {
        DirectionalLight {
            id: 1,
            direction: self.direction,
            irradiance: Vec3::splat(self.radiance * PI * self.radius.sin().powi(2)),
            solid_angle_sr: 2.0 * PI * (1.0 - self.radius.cos()),
        }
    }
}

fn frame(sh: Vec<Vec3>, lights: Vec<DirectionalLight>) -> LightFrame {
    LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh, lights }
}

fn metal(roughness: f32) -> Material {
    Material { base_color: [1.0; 3], roughness, metallic: 1.0, ..Material::default() }
}

fn glass() -> Material {
    Material { base_color: [1.0; 3], roughness: 0.0, kind: MaterialKind::Glass, ..Material::default() }
}

/// A ball straight ahead, of this radius in pixels, far above any ground.
pub(super) fn draw(gpu: &Gpu, picture: &Picture, light: &LightFrame, material: Material, radius_px: f32) -> Vec<f32> {
    draw_by(Reflections::default(), gpu, picture, light, material, radius_px)
}

fn draw_by(reflections: Reflections, gpu: &Gpu, picture: &Picture, light: &LightFrame, material: Material, radius_px: f32) -> Vec<f32> {
    let metres_per_px = 2.0 * DISTANCE_M * (FOV / 2.0).tan() / SIDE as f32;
    let transform =
        Transform { position: Vec3::NEG_Z * DISTANCE_M, rotation: Quat::IDENTITY, scale: Vec3::splat(2.0 * radius_px * metres_per_px) };
    let object = Object {
        id: ObjectId(1),
        geometry: Geometry::Shape(Shape::Sphere),
        transform,
        material: Some(material),
        animation: Default::default(),
    };
    let scene = Scene { ground_y: -1e5, objects: vec![object], ..Scene::default() };
    let still = Still { gpu, picture, light, scene: &scene, assets: &HashMap::new() };
    let bytes = still.draw_by(reflections, &Camera::looking(0.0, 0.0, FOV), (SIDE, SIDE), wgpu::TextureFormat::Rgba32Float).unwrap();
    bytemuck::pod_collect_to_vec::<u8, f32>(&bytes).chunks_exact(4).map(|texel| texel[1]).collect()
}

#[test]
fn a_wide_light_stays_in_the_reflections() {
    let gpu = Gpu::headless().unwrap();
    let disc = Disc { direction: Vec3::Z, radius: PI / 3.0, radiance: 1.0 };
    let picture = disc.picture(0.1);
    // What the server sends with such a light: the SH of the sky around it, which ring below zero in its place.
    let rest = Disc { radiance: 0.0, ..disc }.picture(0.1);
    let light = frame(ambient_light(&rest).sh, vec![disc.light()]);
    let middle = (SIDE / 2 * SIDE + SIDE / 2) as usize;
    for roughness in [0.0, 0.06, 0.1, 0.15, 0.3] {
        for radius_px in [20.0, 200.0] {
            let seen = draw(&gpu, &picture, &light, metal(roughness), radius_px)[middle];
            // The middle of the ball mirrors the middle of the disc. A lobe of roughness 0.3 loses up to 5 % between
            // the facets, and gets part of it back.
            assert!((seen - 1.0).abs() < 0.05, "roughness {roughness}, {radius_px} px: {seen}");
        }
    }
    let seen = draw(&gpu, &picture, &light, glass(), 20.0)[middle];
    // Fresnel's 4 % of the disc, and 96 % of what is straight behind.
    assert!((seen - (0.04 + 0.96 * 0.1)).abs() < 0.01, "glass: {seen}");
}

#[test]
fn a_narrow_light_reflects_its_energy_once() {
    let gpu = Gpu::headless().unwrap();
    let disc = Disc { direction: Vec3::new(0.4, 0.5, 0.75).normalize(), radius: 3f32.to_radians(), radiance: 50.0 };
    let picture = disc.picture(0.0);
    let light = disc.light();
    let cut = frame(vec![Vec3::ZERO; 9], vec![light]);
    let kept = frame(basis25(disc.direction).iter().take(9).map(|basis| light.irradiance * *basis).collect(), vec![]);
    for roughness in [0.0, 0.03, 0.06, 0.1, 0.15, 0.3] {
        for radius_px in [20.0f32, 200.0] {
            let energy = |light| draw(&gpu, &picture, light, metal(roughness), radius_px).iter().sum::<f32>();
            let (cut, kept) = (energy(&cut), energy(&kept));
            // Texels of the map are as large as the pixels of a small ball: what they make of a disc depends on how it lies
            // among them. Lobes that share their pixels with the ball's rim lose another part there.
            assert!((cut / kept - 1.0).abs() < 0.08, "roughness {roughness}, {radius_px} px: {cut} against {kept}");
            if roughness < 0.1 {
                // A ball of radius r mirrors E·r²/4 (its area over all 4π directions), from wherever the light comes.
                // The ball's near side is up to 5 % larger than a parallel view would show it.
                let closed = light.irradiance.y * radius_px * radius_px / 4.0;
                assert!((cut / closed - 1.0).abs() < 0.12, "roughness {roughness}, {radius_px} px: {cut} against {closed}");
            }
        }
    }
}

#[test]
fn a_narrow_light_shows_once_in_glass() {
    let gpu = Gpu::headless().unwrap();
    for direction in [Vec3::new(0.4, 0.5, 0.75), Vec3::new(-0.4, 0.5, -0.75)] {
        let disc = Disc { direction: direction.normalize(), radius: 3f32.to_radians(), radiance: 50.0 };
        let picture = disc.picture(0.0);
        let cut = frame(vec![Vec3::ZERO; 9], vec![disc.light()]);
        let kept = frame(vec![Vec3::ZERO; 9], vec![]);
        for radius_px in [20.0, 80.0, 200.0] {
            let energy = |light| draw(&gpu, &picture, light, glass(), radius_px).iter().sum::<f32>();
            let (cut, kept) = (energy(&cut), energy(&kept));
            // The rim, where Fresnel's reflectance is up to 25 times that of the middle, is a pixel wide on the smallest ball.
            assert!((cut / kept - 1.0).abs() < 0.08, "{direction}, {radius_px} px: {cut} against {kept}");
        }
    }
}

/// What the pixels of a ball show: normal, mirror direction, and n·v; `None` beside it. The view is taken as parallel.
pub(super) fn mirrored(radius_px: f32) -> Vec<Option<(Vec3, Vec3, f32)>> {
    let half = SIDE as f32 / 2.0;
    // A ball at a distance of d radii is seen from where its rim is at the angle asin(1/d).
    let distance = DISTANCE_M / (radius_px * 2.0 * DISTANCE_M * (FOV / 2.0).tan() / SIDE as f32);
    let pixel = |at: u32| {
        let slope = |pixels: f32| (pixels + 0.5 - half) / half * (FOV / 2.0).tan();
        let ray = Vec3::new(slope((at % SIDE) as f32), -slope((at / SIDE) as f32), -1.0).normalize();
        // Distance and ball in radii.
        let along = ray.dot(Vec3::NEG_Z * distance);
        let root = along * along - distance * distance + 1.0;
        (root > 0.0).then(|| {
            let n = ray * (along - root.sqrt()) + Vec3::Z * distance;
            (n, ray - 2.0 * ray.dot(n) * n, -ray.dot(n))
        })
    };
    (0..SIDE * SIDE).map(pixel).collect()
}

/// A sky and what a round GGX lobe around a direction sees of it, by thousands of taps of the sky itself.
struct Sky<'a> {
    radiance: &'a dyn Fn(Vec3) -> f32,
    taps: Vec<mr360_shaders::lobe::Tap>,
}

impl<'a> Sky<'a> {
    fn new(radiance: &'a dyn Fn(Vec3) -> f32, roughness: f32) -> Self {
        Self { radiance, taps: mr360_shaders::lobe::taps(roughness * roughness, 4096) }
    }

    fn lobe(&self, axis: Vec3) -> f32 {
        let (right, up) = axis.any_orthonormal_pair();
        let world = |d: Vec3| right * d.x + up * d.y + axis * d.z;
        let weight: f32 = self.taps.iter().map(|tap| tap.direction.z).sum();
        self.taps.iter().map(|tap| tap.direction.z * (self.radiance)(world(tap.direction))).sum::<f32>() / weight
    }
}

/// Pixels of a large ball near enough to its middle for its mesh to show what the ball would: value, mirror direction, normal
/// and n·v.
fn middle(drawn: &[f32], radius_px: f32) -> Vec<(f32, Vec3, Vec3, f32)> {
    let seen =
        drawn.iter().zip(mirrored(radius_px)).filter_map(|(value, seen)| seen.map(|(n, mirror, cosine)| (*value, mirror, n, cosine)));
    seen.filter(|(_, _, _, n_dot_v)| *n_dot_v > 0.6).collect()
}

/// Mean and worst error of a white metal ball against the same lobe of the sky itself, over the sky's mean radiance.
fn errors(gpu: &Gpu, method: Reflections, sky: &dyn Fn(Vec3) -> f32, roughness: f32) -> (f32, f32) {
    let radius_px = 150.0;
    let picture = panorama(512, 256, |d| Vec3::splat(sky(d)));
    let light = ambient_light(&picture);
    let drawn = draw_by(method, gpu, &picture, &light, metal(roughness), radius_px);
    let truth = Sky::new(sky, roughness);
    let mean = light.sh[0].x * 0.282_094_8;
    let off = |(value, mirror, n, n_dot_v): (f32, Vec3, Vec3, f32)| {
        let energy = albedo(n_dot_v, roughness).element_sum();
        let expected = energy * truth.lobe(mirror) + (1.0 - energy) * irradiance(&light.sh, n).x / PI;
        (value - expected).abs() / mean
    };
    let off: Vec<f32> = middle(&drawn, radius_px).into_iter().step_by(173).map(off).collect();
    (off.iter().sum::<f32>() / off.len() as f32, off.into_iter().fold(0.0, f32::max))
}

/// Windows, a bright ceiling and a lamp: edges, and ten times the radiance in places.
fn room(d: Vec3) -> f32 {
    let window = |direction: Vec3, radius_deg: f32, radiance: f32| {
        if d.dot(direction.normalize()) > radius_deg.to_radians().cos() { radiance } else { 0.0 }
    };
    0.3 + 0.2 * d.y
        + window(Vec3::new(0.8, 0.2, 0.5), 15.0, 3.0)
        + window(Vec3::new(-0.6, 0.1, 0.8), 20.0, 2.0)
        + window(Vec3::Y, 30.0, 1.0)
        + window(Vec3::new(0.1, 0.6, 0.9), 6.0, 6.0)
}

#[test]
fn prefiltered_maps_are_near_the_lobe_and_nearer_than_taps_of_each_pixel() {
    let gpu = Gpu::headless().unwrap();
    for roughness in [0.2, 0.25, 0.3, 0.4, 0.5, 0.6] {
        let [prefiltered, iorns, taps] = Reflections::ALL.map(|(method, _)| errors(&gpu, method, &room, roughness));
        // Edges of ten times the mean radiance between texels of 1.8°, on a mesh whose mirror directions are off by half of
        // that: 4.6 % of the mean at roughness 0.2, less where lobes are wider.
        assert!(prefiltered.0 < 0.05, "roughness {roughness}: {prefiltered:?}");
        assert!(prefiltered.0 < iorns.0 && prefiltered.0 < taps.0, "roughness {roughness}: {prefiltered:?} {iorns:?} {taps:?}");
    }
}

/// Mean of a function of the cosine from the axis over the part of a lobe's kernel D(θ/2)·cos θ that lies within `least`.
fn lobe_mean(roughness: f64, least: f64, f: impl Fn(f64) -> f64) -> f64 {
    let a2 = roughness.powi(4);
    let kernel = |z: f64| z / (0.5 * (1.0 + z) * (a2 - 1.0) + 1.0).powi(2);
    let steps = 100_000;
    let (mut sum, mut all) = (0.0, 0.0);
    for i in 0..steps {
        let z = (f64::from(i) + 0.5) / f64::from(steps);
        all += kernel(z);
        if z >= least {
            sum += kernel(z) * f(z);
        }
    }
    sum / all
}

#[test]
fn a_lobe_of_low_bands_is_their_convolution() {
    let gpu = Gpu::headless().unwrap();
    let radius_px = 150.0;
    let (linear, square) = (|d: Vec3| 0.3 * d.dot(Vec3::new(0.48, 0.64, 0.6)), |d: Vec3| 0.2 * (1.5 * d.x * d.x - 0.5));
    let picture = panorama(512, 256, |d| Vec3::splat(0.5 + linear(d) + square(d)));
    let light = frame(vec![Vec3::ZERO; 9], vec![]);
    for roughness in [0.2f32, 0.4, 0.6, 0.7] {
        // A round kernel scales band l by its mean Legendre polynomial (Funk and Hecke).
        let first = lobe_mean(f64::from(roughness), 0.0, |z| z) as f32;
        let second = lobe_mean(f64::from(roughness), 0.0, |z| 1.5 * z * z - 0.5) as f32;
        let drawn = draw(&gpu, &picture, &light, metal(roughness), radius_px);
        for (value, mirror, _, n_dot_v) in middle(&drawn, radius_px) {
            let expected = albedo(n_dot_v, roughness).element_sum() * (0.5 + first * linear(mirror) + second * square(mirror));
            // The mesh's normals are off by up to half a degree, its mirror directions by twice as much, on a slope of 0.7.
            assert!((value - expected).abs() < 0.015, "roughness {roughness}, {mirror}: {value} against {expected}");
        }
    }
}

#[test]
fn neither_seam_nor_pole_nor_a_cube_s_edge_shows_in_a_lobe() {
    let gpu = Gpu::headless().unwrap();
    let radius_px = 150.0;
    let light = frame(vec![Vec3::ZERO; 9], vec![]);
    let places =
        [Vec3::Z, Vec3::Y, Vec3::NEG_Y, Vec3::new(0.01, 0.02, 1.0), Vec3::new(0.02, 1.0, 0.03), Vec3::new(1.0, 0.0, 1.0), Vec3::ONE];
    for direction in places.map(Vec3::normalize) {
        let disc = Disc { direction, radius: 12f32.to_radians(), radiance: 1.0 };
        let picture = disc.picture(0.0);
        for roughness in [0.25f32, 0.4, 0.6] {
            let drawn = draw(&gpu, &picture, &light, metal(roughness), radius_px);
            let nearest = middle(&drawn, radius_px).into_iter().max_by(|a, b| a.1.dot(direction).total_cmp(&b.1.dot(direction))).unwrap();
            let within = lobe_mean(f64::from(roughness), f64::from(disc.radius.cos()), |_| 1.0) as f32;
            let expected = albedo(nearest.3, roughness).element_sum() * within;
            // Trilinear texels blur the disc, by more where it lies between them: 9 % in the middle of a face.
            assert!((nearest.0 / expected - 1.0).abs() < 0.12, "{direction}, roughness {roughness}: {} against {expected}", nearest.0);
        }
    }
}

/// Pixels that show a mirror ball clear of its rim, where one spans much of the ground, and where their rays fall on it.
fn falls(camera: &Camera, center: Vec3, radius: f32, ground_y: f32) -> Vec<(usize, Vec3)> {
    let fall = |i: usize| {
        let ray = tests::ray_of(camera, i);
        let along = ray.dot(center);
        let root = along * along - center.length_squared() + radius * radius;
        let point = ray * (along - root.max(0.0).sqrt());
        let normal = (point - center) / radius;
        let mirror = ray - normal * (2.0 * ray.dot(normal));
        let clear = root > 0.4 * radius * radius && mirror.y < -0.3;
        clear.then(|| (i, point + mirror * ((ground_y - point.y) / mirror.y)))
    };
    (0..(tests::SIZE.0 * tests::SIZE.1) as usize).filter_map(fall).collect()
}

#[test]
fn a_mirror_shows_the_ground_where_its_rays_fall() {
    let gpu = Gpu::headless().unwrap();
    let (ground_y, center, radius) = (-1.6, Vec3::new(0.0, -0.4, -3.0), 0.4);
    // Stripes a metre wide, light and dark, as they look from where the panorama was taken.
    let light = |point: Vec3| point.z.floor() as i32 & 1 == 0;
    let picture = panorama(2048, 1024, |d| match d.y {
        y if y >= -0.05 => Vec3::splat(0.5),
        y => Vec3::splat(if light(d / y * ground_y) { 0.9 } else { 0.1 }),
    });
    let ball = tests::object(1, Shape::Sphere, center, 2.0 * radius, tests::mirror());
    let camera = Camera::looking(0.0, -0.13, 0.3);
    let drawn = tests::draw(&gpu, &picture, &ambient_light(&picture), &tests::scene(vec![ball]), &camera);
    let falls = falls(&camera, center, radius, ground_y);
    // As high as the ball hangs, its shade takes no more than half. The rest are edges of stripes.
    let right = falls.iter().filter(|(i, point)| (drawn[*i].x > 0.3) == light(*point)).count();
    assert!(falls.len() > 500 && right * 100 > falls.len() * 85, "{right} of {}", falls.len());
}

#[test]
fn a_mirror_shows_the_shade_on_the_ground() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(64, 32, |_| Vec3::ONE);
    let (center, radius, foot) = (Vec3::new(0.0, -0.7, -3.0), 0.4, Vec3::new(0.7, -1.6, -2.4));
    let mirror = tests::object(1, Shape::Sphere, center, 2.0 * radius, tests::mirror());
    let black = tests::object(2, Shape::Sphere, foot + Vec3::Y * 0.2, 0.4, tests::diffuse(0.0));
    let camera = Camera::looking(0.0, -0.2, 0.3);
    let draw = |objects: &[Object]| tests::draw(&gpu, &picture, &ambient_light(&picture), &tests::scene(objects.to_vec()), &camera);
    let drawn = draw(&[mirror.clone(), black.clone()]);
    let hidden = draw(&[black]);
    let (mut near, mut far) = (0, 0);
    for (i, point) in falls(&camera, center, radius, -1.6) {
        if hidden[i].x < 0.5 {
            // The black ball stands before the mirror.
        } else if point.distance(foot) < 0.15 {
            near += 1;
            // From within 0.15 m of its foot, a ball of 0.2 m hides at least half of the sky.
            assert!(drawn[i].x < 0.55, "{point}: {}", drawn[i].x);
        } else if point.distance(foot) > 1.1 {
            far += 1;
            assert!(drawn[i].x > 0.98, "{point}: {}", drawn[i].x);
        }
    }
    assert!(near > 5 && far > 20, "{near} {far}");
}

#[test]
fn neighbours_hide_light_from_a_glossy_lobe() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(64, 32, |_| Vec3::ONE);
    let middle = |roughness: f32, black_at: Vec3| {
        let metal = Material { base_color: [1.0; 3], roughness, metallic: 1.0, ..Material::default() };
        let center = Vec3::new(0.0, 0.0, -3.0);
        let objects =
            vec![tests::object(1, Shape::Sphere, center, 0.6, metal), tests::object(2, Shape::Sphere, black_at, 0.6, tests::diffuse(0.0))];
        let scene = Scene { ground_y: -100.0, objects, ..Scene::default() };
        let camera = Camera::looking(0.0, 0.0, 0.5);
        // Where the surface is turned by 45° to the right: its lobe looks along +x.
        let at = center + Vec3::new(1.0, 0.0, 1.0).normalize() * 0.3;
        tests::draw(&gpu, &picture, &ambient_light(&picture), &scene, &camera)[tests::pixel_of(&camera, at)].x
    };
    for (roughness, most) in [(0.3, 0.4), (0.5, 0.85), (1.0, 0.92)] {
        let (beside, behind) = (middle(roughness, Vec3::new(0.9, 0.0, -2.8)), middle(roughness, Vec3::new(-0.9, 0.0, -3.4)));
        assert!(beside < most, "roughness {roughness}: {beside}");
        assert!((behind - 1.0).abs() < 0.01, "roughness {roughness}: {behind}");
    }
}
