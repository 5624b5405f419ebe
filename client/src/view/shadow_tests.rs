//! Shadows on the ground against closed forms and against rays to every part of the light.

use std::collections::HashMap;
use std::f32::consts::PI;

use glam::{Quat, Vec2, Vec3};
use mr360_protocol::light::{DirectionalLight, LightFrame};
use mr360_protocol::scene::{Geometry, Material, Object, ObjectId, Scene, Shape, Transform};

use super::*;
use crate::environment::light::tan_radius;
use crate::render::{Models, Still, ambient_light};
use crate::scene::mesh::Bounds;
use crate::view::tests::panorama;

pub(super) const GROUND_Y: f32 = -1.6;

/// A solid by its scale.
type Scaled = fn(f32) -> Solid;

/// What stands in the light, in closed form. All are upright.
#[derive(Debug, Clone, Copy)]
pub(super) enum Solid {
    Ball { center: Vec3, radius: f32 },
    Cylinder { center: Vec3, radius: f32, half_height: f32 },
    Block { center: Vec3, half: Vec3 },
}

impl Solid {
    pub(super) fn object(self, id: u32) -> Object {
        let (shape, position, scale) = match self {
            Self::Ball { center, radius } => (Shape::Sphere, center, Vec3::splat(2.0 * radius)),
            Self::Cylinder { center, radius, half_height } => (Shape::Cylinder, center, Vec3::new(radius, half_height, radius) * 2.0),
            Self::Block { center, half } if half.y == 0.0 => (Shape::Plane, center, Vec3::new(half.x * 2.0, 1.0, half.z * 2.0)),
            Self::Block { center, half } => (Shape::Cube, center, half * 2.0),
        };
        let material = Some(Material { base_color: [0.8; 3], ..Material::default() });
        Object {
            id: ObjectId(id),
            geometry: Geometry::Shape(shape),
            transform: Transform { position, rotation: Quat::IDENTITY, scale },
            material,
            animation: Default::default(),
        }
    }

    /// A ray that begins outside meets it.
    pub(super) fn meets(self, origin: Vec3, direction: Vec3) -> bool {
        match self {
            Self::Ball { center, radius } => {
                let to = center - origin;
                let along = to.dot(direction);
                along > 0.0 && to.length_squared() - along * along < radius * radius
            }
            Self::Cylinder { center, radius, half_height } => {
                let (o, d) = (origin - center, direction);
                let (a, b, c) = (d.x * d.x + d.z * d.z, o.x * d.x + o.z * d.z, o.x * o.x + o.z * o.z - radius * radius);
                let root = b * b - a * c;
                // Within the round wall between two distances, within the two caps between two others.
                let round = match (a > 1e-12, root > 0.0) {
                    (true, true) => ((-b - root.sqrt()) / a, (-b + root.sqrt()) / a),
                    (false, _) if c < 0.0 => (f32::NEG_INFINITY, f32::INFINITY),
                    _ => return false,
                };
                let caps = slab(o.y, d.y, half_height);
                round.0.max(caps.0).max(1e-6) < round.1.min(caps.1)
            }
            Self::Block { center, half } => {
                let o = origin - center;
                let (mut near, mut far) = (1e-6f32, f32::INFINITY);
                for axis in 0..3 {
                    let (a, b) = slab(o[axis], direction[axis], half[axis]);
                    (near, far) = (near.max(a), far.min(b));
                }
                near <= far
            }
        }
    }
}

fn slab(o: f32, d: f32, half: f32) -> (f32, f32) {
    if d.abs() < 1e-9 {
        return if o.abs() < half { (f32::NEG_INFINITY, f32::INFINITY) } else { (f32::INFINITY, f32::NEG_INFINITY) };
    }
    let (a, b) = ((-half - o) / d, (half - o) / d);
    (a.min(b), a.max(b))
}

pub(super) fn light(direction: Vec3, solid_angle_sr: f32, irradiance: Vec3, id: u32) -> DirectionalLight {
    DirectionalLight { id, direction: direction.normalize(), irradiance, solid_angle_sr }
}

/// Towards a light of this azimuth about +y from +z, and elevation.
pub(super) fn towards(azimuth_deg: f32, elevation_deg: f32) -> Vec3 {
    let (azimuth, elevation) = (azimuth_deg.to_radians(), elevation_deg.to_radians());
    Vec3::new(azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos())
}

/// Rays that show a share to half a hundredth.
pub(super) const RAYS: u32 = 1024;

/// Share of a light's disc that is seen from a point, by rays spread evenly over the disc that the shaders assume.
pub(super) fn seen_of_light(point: Vec3, light: &DirectionalLight, solids: &[Solid], rays: u32) -> f32 {
    let (right, up) = light.direction.any_orthonormal_pair();
    let radius = tan_radius(light.solid_angle_sr);
    let free = (0..rays).filter(|i| {
        let (r, angle) = (((*i as f32 + 0.5) / rays as f32).sqrt() * radius, *i as f32 * PI * (3.0 - 5.0f32.sqrt()));
        let ray = (light.direction + right * (r * angle.cos()) + up * (r * angle.sin())).normalize();
        !solids.iter().any(|solid| solid.meets(point, ray))
    });
    free.count() as f32 / rays as f32
}

pub(super) struct Eye {
    pub(super) camera: Camera,
    size: (u32, u32),
}

impl Eye {
    pub(super) fn at(position: Vec3, target: Vec3, fov_y_rad: f32, size: (u32, u32)) -> Self {
        let ahead = (target - position).normalize();
        let camera = Camera { position, ..Camera::looking((-ahead.x).atan2(-ahead.z), ahead.y.asin(), fov_y_rad) };
        Self { camera, size }
    }

    /// The pixel that shows a point.
    pub(super) fn pixel(&self, point: Vec3) -> usize {
        let (width, height) = (self.size.0 as f32, self.size.1 as f32);
        let at = (self.camera.clip_from_view(width / height) * self.camera.view_from_world()).project_point3(point);
        ((0.5 - at.y * 0.5) * height) as usize * self.size.0 as usize + ((at.x * 0.5 + 0.5) * width) as usize
    }

    pub(super) fn ray(&self, pixel: usize) -> Vec3 {
        let (x, y) = (pixel as u32 % self.size.0, pixel as u32 / self.size.0);
        let (width, height) = (self.size.0 as f32, self.size.1 as f32);
        self.camera.ray(Vec2::new((x as f32 + 0.5) / width * 2.0 - 1.0, 1.0 - (y as f32 + 0.5) / height * 2.0), width / height)
    }

    /// Points of the ground that no solid hides, by pixel.
    pub(super) fn ground(&self, solids: &[Solid]) -> Vec<Option<Vec3>> {
        let point = |pixel: usize| {
            let ray = self.ray(pixel);
            let distance = (GROUND_Y - self.camera.position.y) / ray.y;
            let seen = distance > 0.0 && distance < 30.0 && !solids.iter().any(|solid| solid.meets(self.camera.position, ray));
            seen.then(|| self.camera.position + ray * distance)
        };
        (0..(self.size.0 * self.size.1) as usize).map(point).collect()
    }

    /// Radiance over a panorama of 0.5 all around, without ambient light.
    fn draw(&self, gpu: &Gpu, objects: Vec<Object>, lights: Vec<DirectionalLight>) -> Vec<Vec3> {
        let scene = Scene { ground_y: GROUND_Y, objects, ..Scene::default() };
        self.draw_scene(gpu, &scene, &HashMap::new(), lights)
    }

    pub(super) fn draw_scene(&self, gpu: &Gpu, scene: &Scene, assets: &Models, lights: Vec<DirectionalLight>) -> Vec<Vec3> {
        let picture = panorama(16, 8, |_| Vec3::splat(0.5));
        let light = LightFrame { sh: vec![Vec3::ZERO; 9], lights, ..ambient_light(&picture) };
        let still = Still { gpu, picture: &picture, light: &light, scene, assets };
        let bytes = still.draw(&self.camera, self.size, wgpu::TextureFormat::Rgba32Float).unwrap();
        bytemuck::pod_collect_to_vec::<u8, f32>(&bytes).chunks_exact(4).map(|t| Vec3::new(t[0], t[1], t[2])).collect()
    }

    /// Share of one light on the ground as drawn, by pixel: it alone is red, and without ambient light the
    /// rendering rule's factor is the share itself.
    fn drawn_share(&self, gpu: &Gpu, solids: &[Solid], lights: &[DirectionalLight], which: usize) -> Vec<f32> {
        let objects = (1..).zip(solids).map(|(id, solid)| solid.object(id)).collect();
        let colour = |at: usize| if at == which { Vec3::X * 4.0 } else { Vec3::Z * 4.0 };
        let lights = lights.iter().enumerate().map(|(at, one)| DirectionalLight { irradiance: colour(at), ..*one }).collect();
        self.draw(gpu, objects, lights).iter().map(|c| c.x / 0.5).collect()
    }
}

/// Share of a disc of radius 1 on one side of a line at this distance from its centre.
fn beyond_line(s: f32) -> f32 {
    let s = s.clamp(-1.0, 1.0);
    0.5 + (s * (1.0 - s * s).sqrt() + s.asin()) / PI
}

/// Where a falling or rising profile of (place, share) first passes a share.
fn crossing(profile: &[(f32, f32)], share: f32) -> f32 {
    let pair = profile.windows(2).find(|p| (p[0].1 - share) * (p[1].1 - share) <= 0.0 && p[0].1 != p[1].1).unwrap();
    pair[0].0 + (pair[1].0 - pair[0].0) * (share - pair[0].1) / (pair[1].1 - pair[0].1)
}

/// How wide a profile's edge is, up to a factor of its form: ∫ V (1 − V) dx, which steps of the taps do not sway.
fn spread(profile: &[(f32, f32)]) -> f32 {
    profile.windows(2).map(|p| (p[1].0 - p[0].0) * p[0].1 * (1.0 - p[0].1)).sum()
}

/// The share of light along the ground in +x through z = −4, from `from` to `to`, as drawn.
fn profile(gpu: &Gpu, solids: &[Solid], light: DirectionalLight, from: f32, to: f32) -> Vec<(f32, f32)> {
    let (middle, half) = ((from + to) * 0.5, (to - from) * 0.5);
    // From above, beneath what floats: the picture spans the way.
    let height = 0.2;
    let size = (512, 16);
    let fov_y = 2.0 * (half / height * size.1 as f32 / size.0 as f32).atan();
    let above = Vec3::new(middle, GROUND_Y + height, -4.0);
    let eye = Eye { camera: Camera { position: above, ..Camera::looking(0.0, -PI / 2.0, fov_y) }, size };
    let share = eye.drawn_share(gpu, solids, &[light], 0);
    let row = (size.1 / 2 * size.0) as usize;
    (row..row + size.0 as usize)
        .map(|pixel| {
            let ray = eye.ray(pixel);
            (above.x + ray.x * (GROUND_Y - above.y) / ray.y, share[pixel])
        })
        .collect()
}

/// Side of the shadow map's texels in the light's plane.
fn texel_m(solids: &[Solid], light: &DirectionalLight) -> f32 {
    let boxes: Vec<_> = solids
        .iter()
        .map(|solid| {
            let (center, half) = match *solid {
                Solid::Ball { center, radius } => (center, Vec3::splat(radius)),
                Solid::Cylinder { center, radius, half_height } => (center, Vec3::new(radius, half_height, radius)),
                Solid::Block { center, half } => (center, half),
            };
            Bounds { min: center - half, max: center + half }
        })
        .collect();
    let highest = boxes.iter().map(|b| b.max.y - GROUND_Y).fold(0.0, f32::max);
    let fall = (highest / light.direction.y.max(0.05)).min(shadows::LONGEST_SHADOW_M);
    shadows::fit(light.direction, &boxes, tan_radius(light.solid_angle_sr) * fall).texel_m()
}

#[test]
fn a_plates_shadow_has_its_edge_and_its_penumbra() {
    let gpu = Gpu::headless().unwrap();
    for (elevation_deg, solid_angle_sr, height) in [
        (90.0, 0.01, 0.5),
        (90.0, 0.05, 1.0),
        (45.0, 0.01, 0.5),
        (45.0, 0.05, 1.0),
        (25.0, 0.003, 0.5),
        (25.0, 0.02, 0.5),
        (45.0, 6.8e-5, 0.5),
    ] {
        let direction = towards(-90.0, elevation_deg);
        let sun = light(direction, solid_angle_sr, Vec3::ONE, 1);
        let plate = Solid::Block { center: Vec3::new(0.0, GROUND_Y + height, -4.0), half: Vec3::new(0.6, 0.0, 0.6) };
        let tan = tan_radius(solid_angle_sr);
        // The far edge at x = 0.6 falls away from the light; its penumbra is the disc's image on the ground.
        let edge = 0.6 + height / elevation_deg.to_radians().tan();
        let radius = tan * height / elevation_deg.to_radians().sin().powi(2);
        let reach = (1.6 * radius).max(0.02);
        let drawn = profile(&gpu, &[plate], sun, edge - reach, edge + reach);
        let truth: Vec<_> = drawn.iter().map(|(x, _)| (*x, seen_of_light(Vec3::new(*x, GROUND_Y, -4.0), &sun, &[plate], RAYS))).collect();
        let texel = texel_m(&[plate], &sun) / direction.y;
        let off = crossing(&drawn, 0.5) - edge;
        // Of a disc behind a straight edge, over a radius of 1.
        let unit: Vec<_> = (-1000..=1000).map(|i| i as f32 / 1000.0).map(|s| (s, beyond_line(s))).collect();
        let (width, expected) = (spread(&drawn), spread(&unit) * radius);
        let true_width = spread(&truth);
        let worst = drawn.iter().zip(&truth).map(|(a, b)| (a.1 - b.1).abs()).fold(0.0, f32::max);
        println!(
            "elevation {elevation_deg} solid angle {solid_angle_sr} height {height}: edge off by {:.2} texels; width {width:.4} m, closed form {expected:.4}, rays {true_width:.4}; worst share {worst:.3}; {:.1} texels a radius",
            off / texel,
            radius / texel
        );
        assert!(off.abs() <= texel.max(0.02 * radius), "edge off by {off} m, a texel is {texel} m");
        if radius > 6.0 * texel {
            // The rays know how the light's disc lies aslant over the plate. At low light the blockers of the search lie
            // uphill of the edge by more of the gap than it spans.
            let tolerance = if elevation_deg < 45.0 { 0.2 } else { 0.1 };
            assert!((true_width / expected - 1.0).abs() < 0.03, "rays give {true_width}, the closed form {expected}");
            assert!((width / true_width - 1.0).abs() < tolerance, "width {width} against {true_width}");
        } else {
            // A narrower one is as wide as the filter: an edge of some texels.
            assert!(width < expected + texel, "width {width}, a texel is {texel}");
        }
    }
}

#[test]
fn a_discs_shadow_is_what_its_lens_leaves_of_the_light() {
    let gpu = Gpu::headless().unwrap();
    // Two discs of radii a and b, d apart: the area that they share.
    let lens = |a: f32, b: f32, d: f32| {
        if d >= a + b {
            return 0.0;
        }
        if d <= (a - b).abs() {
            return PI * a.min(b).powi(2);
        }
        let part = |r: f32, other: f32| r * r * ((d * d + r * r - other * other) / (2.0 * d * r)).clamp(-1.0, 1.0).acos();
        part(a, b) + part(b, a) - 0.5 * ((-d + a + b) * (d + a - b) * (d - a + b) * (d + a + b)).max(0.0).sqrt()
    };
    for (radius, height, solid_angle_sr) in [(0.3, 0.8, 0.05), (0.1, 1.0, 0.1), (0.3, 0.4, 0.2)] {
        let sun = light(Vec3::Y, solid_angle_sr, Vec3::ONE, 1);
        let disc = Solid::Cylinder { center: Vec3::new(0.0, GROUND_Y + height, -4.0), radius, half_height: 0.002 };
        let penumbra = tan_radius(solid_angle_sr) * height;
        let reach = radius + 1.2 * penumbra;
        let drawn = profile(&gpu, &[disc], sun, -reach, reach);
        let errors: Vec<f32> =
            drawn.iter().map(|(x, share)| share - (1.0 - lens(radius, penumbra, x.abs()) / (PI * penumbra * penumbra))).collect();
        let worst = errors.iter().fold(0.0f32, |w, e| w.max(e.abs()));
        let mean = errors.iter().map(|e| e.abs()).sum::<f32>() / errors.len() as f32;
        println!("disc {radius} at {height} under {solid_angle_sr} sr: mean {mean:.4} worst {worst:.4}");
        // Steps of one tap in 48; the mesh has 48 corners, 0.3 % of area less than the disc.
        assert!(worst < 0.06 && mean < 0.02, "mean {mean} worst {worst}");
    }
}

#[test]
fn no_surface_of_a_convex_object_shadows_itself() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.0, 0.2, -1.0), Vec3::new(0.0, -1.0, -4.0), 0.6, (160, 120));
    const FLOATING: Vec3 = Vec3::new(0.0, -0.9, -4.0);
    let solids: [(&str, Scaled); 3] = [
        ("ball", |r| Solid::Ball { center: FLOATING, radius: 0.5 * r }),
        ("cylinder", |r| Solid::Cylinder { center: FLOATING, radius: 0.4 * r, half_height: 0.5 * r }),
        ("cube", |r| Solid::Block { center: FLOATING, half: Vec3::splat(0.5 * r) }),
    ];
    for (name, sized) in solids {
        let (solid, inner) = (sized(1.0), sized(0.97));
        for (azimuth_deg, elevation_deg, solid_angle_sr) in
            [(60.0, 3.0, 6.8e-5), (20.0, 10.0, 6.8e-5), (-70.0, 45.0, 0.02), (5.0, 3.0, 0.05), (150.0, 30.0, 6.8e-5), (90.0, 80.0, 0.3)]
        {
            let direction = towards(azimuth_deg, elevation_deg);
            let red = light(direction, solid_angle_sr, Vec3::X, 9);
            // Four stronger blue lights take the shadow maps: the red one then casts no shadow at all.
            let blue = (1..=4).map(|id| light(towards(180.0, -60.0), 6.8e-5, Vec3::Z * 20.0, id));
            let free = eye.draw(&gpu, vec![solid.object(1)], blue.chain([red]).collect());
            let drawn = eye.draw(&gpu, vec![solid.object(1)], vec![red]);
            let brightest = 0.8 / PI;
            // Pixels on the outline show the ground in part, which is shaded.
            let on_object = |pixel: &usize| inner.meets(eye.camera.position, eye.ray(*pixel));
            let (mut worst, mut dark, mut lit) = (0.0f32, 0.0, 0.0);
            for pixel in (0..drawn.len()).filter(on_object) {
                worst = worst.max((free[pixel].x - drawn[pixel].x) / brightest);
                dark += free[pixel].x - drawn[pixel].x;
                lit += free[pixel].x;
            }
            println!("{name} from {azimuth_deg}/{elevation_deg} {solid_angle_sr} sr: worst {worst:.4}, all {:.5}", dark / lit);
            assert!(worst < 0.05 && dark < 0.01 * lit, "{name} from {azimuth_deg}, {elevation_deg}: worst {worst}, all {}", dark / lit);
        }
    }
}

#[test]
fn a_box_on_the_ground_is_in_touch_with_its_shadow() {
    let gpu = Gpu::headless().unwrap();
    for (elevation_deg, solid_angle_sr) in [(60.0, 6.8e-5), (30.0, 6.8e-5), (45.0, 0.01), (30.0, 0.05)] {
        let sun = light(towards(-90.0, elevation_deg), solid_angle_sr, Vec3::ONE, 1);
        let block = Solid::Block { center: Vec3::new(-0.5, GROUND_Y + 0.5, -4.0), half: Vec3::splat(0.5) };
        // The wall that turns away from the light stands at x = 0.
        let drawn = profile(&gpu, &[block], sun, 0.0, 0.06);
        let texel = texel_m(&[block], &sun);
        let lit: Vec<_> = drawn.iter().filter(|(x, share)| *x > 0.0 && *share > 0.5).collect();
        let gap = lit.iter().map(|(x, _)| *x).fold(0.0, f32::max);
        println!(
            "box under {elevation_deg}° {solid_angle_sr} sr: {} of {} points lit, up to {:.2} texels",
            lit.len(),
            drawn.len(),
            gap / texel
        );
        assert!(gap <= 1.5 * texel, "lit up to {gap} m from the wall, a texel is {texel} m");
    }
}

/// Wrong over true shadow pixels, each light's shadow taken where less than half of it is seen.
fn shadow_error(gpu: &Gpu, solids: &[Solid], lights: &[DirectionalLight]) -> f32 {
    let eye = Eye::at(Vec3::new(0.6, 2.0, -1.5), Vec3::new(0.0, GROUND_Y, -4.0), 0.8, (320, 240));
    let ground = eye.ground(solids);
    let (mut wrong, mut shadow) = (0, 0);
    for (which, one) in lights.iter().enumerate() {
        let drawn = eye.drawn_share(gpu, solids, lights, which);
        for (pixel, point) in ground.iter().enumerate() {
            let Some(point) = point else { continue };
            // Few rays tell umbra and full light, all of them the edge.
            let rough = seen_of_light(*point, one, solids, 48);
            let truly = if (0.25..0.75).contains(&rough) { seen_of_light(*point, one, solids, RAYS) < 0.5 } else { rough < 0.5 };
            shadow += usize::from(truly);
            wrong += usize::from(truly != (drawn[pixel] < 0.5));
        }
    }
    assert!(shadow > 300, "{shadow} pixels of shadow are too few to judge");
    wrong as f32 / shadow as f32
}

#[test]
fn at_most_four_in_a_hundred_shadow_pixels_are_wrong() {
    let gpu = Gpu::headless().unwrap();
    let lights = [(40.0, 50.0), (-60.0, 35.0), (160.0, 60.0), (-150.0, 40.0)];
    let cylinder = Solid::Cylinder { center: Vec3::new(0.0, GROUND_Y + 0.5, -4.0), radius: 0.3, half_height: 0.5 };
    let ball = Solid::Ball { center: Vec3::new(0.2, GROUND_Y + 0.6, -4.0), radius: 0.4 };
    let mut all = Vec::new();
    for (name, solid) in [("cylinder", cylinder), ("ball", ball)] {
        for count in [1, 2, 4] {
            for solid_angle_sr in [6.8e-5, 0.01, 0.06] {
                let used: Vec<_> = lights.iter().take(count).map(|(a, e)| light(towards(*a, *e), solid_angle_sr, Vec3::ONE, 1)).collect();
                let error = shadow_error(&gpu, &[solid], &used);
                println!("{name}, {count} lights of {solid_angle_sr} sr: {:.2} %", 100.0 * error);
                all.push(error);
            }
        }
    }
    let mean = all.iter().sum::<f32>() / all.len() as f32;
    println!("mean {:.2} %", 100.0 * mean);
    assert!(mean <= 0.04 && all.iter().all(|error| *error <= 0.08), "{all:?}");
}

#[test]
fn glass_casts_as_much_shadow_as_it_keeps_light() {
    let gpu = Gpu::headless().unwrap();
    let sun = light(towards(-90.0, 45.0), 6.8e-5, Vec3::X * 4.0, 1);
    let plate = Solid::Block { center: Vec3::new(0.0, GROUND_Y + 0.5, -4.0), half: Vec3::new(0.4, 0.01, 0.4) };
    let eye = Eye::at(Vec3::new(0.5, GROUND_Y + 1.5, -3.0), Vec3::new(0.5, GROUND_Y, -4.0), 0.5, (120, 90));
    for (tint, through) in [(1.0f32, 0.92f32), (0.5, 0.46), (0.0, 0.0)] {
        let mut object = plate.object(1);
        let glass = Material { base_color: [tint; 3], kind: mr360_protocol::scene::MaterialKind::Glass, ..Material::default() };
        object.material = Some(glass);
        let drawn = eye.draw(&gpu, vec![object], vec![sun]);
        // Well within the shadow: the plate's middle falls to x = 0.5.
        let within = |point: &Vec3| (point.x - 0.5).abs() < 0.25 && (point.z + 4.0).abs() < 0.25;
        let ground = eye.ground(&[plate]);
        let shares: Vec<f32> = (0..drawn.len()).filter(|i| ground[*i].as_ref().is_some_and(within)).map(|i| drawn[i].x / 0.5).collect();
        let mean = shares.iter().sum::<f32>() / shares.len() as f32;
        let spread = (shares.iter().map(|s| (s - mean).powi(2)).sum::<f32>() / shares.len() as f32).sqrt();
        println!("glass of tint {tint}: {mean:.3} of the light, spread {spread:.3}, {} pixels", shares.len());
        // The screen has 16 steps, and a share of few dots escapes some searches.
        assert!(shares.len() > 200 && (mean - through).abs() < 0.05 && spread < 0.08, "tint {tint}: {mean} ± {spread}");
    }
}

#[test]
fn what_reaches_beneath_the_ground_is_hidden_and_keeps_its_shadow() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.6, 0.0, -1.0), Vec3::new(0.3, GROUND_Y, -4.0), 0.8, (160, 120));
    let sun = light(towards(-60.0, 40.0), 0.01, Vec3::ONE * 4.0, 1);
    let standing = Solid::Cylinder { center: Vec3::new(0.0, GROUND_Y + 0.4, -4.0), radius: 0.3, half_height: 0.4 };
    let sunk = Solid::Cylinder { center: Vec3::new(0.0, GROUND_Y, -4.0), radius: 0.3, half_height: 0.8 };
    let [above, through] = [standing, sunk].map(|solid| eye.draw(&gpu, vec![solid.object(1)], vec![sun]));
    // Clear of the line of contact, which is drawn from other triangles.
    let clear = Solid::Cylinder { center: Vec3::new(0.0, GROUND_Y + 0.4, -4.0), radius: 0.33, half_height: 0.42 };
    let open = eye.ground(&[clear]);
    let pairs = above.iter().zip(&through).zip(&open).filter(|(_, point)| point.is_some());
    let differ = pairs.filter(|((a, b), _)| (**a - **b).abs().max_element() > 0.15).count();
    let shadow = eye.ground(&[standing]).iter().zip(&above).filter(|(point, c)| point.is_some() && c.x < 0.25).count();
    println!("{differ} pixels differ, {shadow} of shadow");
    // The two maps have texels of other sizes.
    assert!(shadow > 200 && differ < shadow / 25, "{differ} pixels differ, {shadow} of shadow");
    // Wholly beneath: not a bit changes, though the ground above is within reach of its shade.
    let beneath = Solid::Cylinder { center: Vec3::new(0.0, GROUND_Y - 0.6, -4.0), radius: 0.3, half_height: 0.5 };
    assert_eq!(eye.draw(&gpu, vec![beneath.object(1)], vec![sun]), eye.draw(&gpu, vec![], vec![sun]));
}

#[test]
fn a_mirror_gives_the_ground_light_back() {
    let gpu = Gpu::headless().unwrap();
    // Bright above and dark below: most of what a mirror ball sends down comes from the sky, a matt one only has the ground's.
    let picture = panorama(64, 32, |d| Vec3::splat(if d.y > 0.0 { 1.0 } else { 0.1 }));
    let camera = Camera::looking(0.0, -0.4, 0.8);
    let size = (64, 64);
    let beside = |metallic: f32, roughness: f32, base_color: f32| {
        let material = Some(Material { base_color: [base_color; 3], roughness, metallic, ..Material::default() });
        let ball = Solid::Ball { center: Vec3::new(0.0, GROUND_Y + 0.5, -4.0), radius: 0.5 };
        let scene = Scene { ground_y: GROUND_Y, objects: vec![Object { material, ..ball.object(1) }], ..Scene::default() };
        let light = ambient_light(&picture);
        let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene, assets: &HashMap::new() };
        let bytes = still.draw(&camera, size, wgpu::TextureFormat::Rgba32Float).unwrap();
        let at = (camera.clip_from_view(1.0) * camera.view_from_world()).project_point3(Vec3::new(0.0, GROUND_Y, -3.6));
        let pixel = (32.0 - at.y * 32.0) as usize * 64 + 32;
        bytemuck::pod_collect_to_vec::<u8, f32>(&bytes)[4 * pixel] / 0.1
    };
    let (black, matt, metal, mirror) = (beside(0.0, 1.0, 0.0), beside(0.0, 1.0, 0.9), beside(1.0, 0.5, 0.9), beside(1.0, 0.0, 0.9));
    assert!((metal - mirror).abs() < 1e-3, "as much whatever the roughness: {metal} {mirror}");
    // The ball hides the factor f, and a mirror of reflectance ρ gives back ρ (½ sky + ½ ground): about ρ/2 of what it took.
    let given_back = (mirror - black) / (1.0 - black);
    assert!((0.38..0.62).contains(&given_back), "{given_back}: {black} {mirror}");
    assert!(matt - black < 0.4 * (mirror - black), "{black} {matt} {mirror}");
}

#[test]
fn occluders_beyond_the_most_are_counted() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let ball = |id: u32| Solid::Ball { center: Vec3::new(id as f32, 0.0, -4.0), radius: 0.01 * id as f32 }.object(id);
    for (count, lost) in [(64, 0), (80, 16)] {
        let scene = Scene { ground_y: GROUND_Y, objects: (1..=count).map(ball).collect(), ..Scene::default() };
        renderer.set_scene(&gpu, &scene, &|_| None);
        assert_eq!((renderer.stage.occluders.len(), renderer.stage.occluders_lost), (64, lost));
        // The largest are kept.
        let least = renderer.stage.occluders.iter().map(|o| o.radius).fold(f32::INFINITY, f32::min);
        assert!((least - 0.01 * (lost + 1) as f32).abs() < 1e-6, "{least}");
    }
}
