//! The static place, rendered once: per pixel its light without the sun, its light from the sun, and the surface.

use std::f32::consts::PI;
use std::sync::{Mutex, mpsc};

use glam::{Vec2, Vec3};
use mr360_shaders::equirect;

use super::ambient::{Ambient, Grid, World};
use super::config::PlazaConfig;
use super::geometry::Ray;
use super::place::{Contact, Material, Place};
use super::sky::{SUN_RADIUS_RAD, Sky};
use super::surface::surface;

/// Places of the samples in a pixel, in sixteenths from its centre: any first 2, 4 or 8 are spread well.
const SAMPLES: [[i8; 2]; 8] = [[1, -3], [-1, 3], [5, 1], [-5, -1], [-3, -6], [3, 7], [7, -5], [-7, 5]];
/// Samples that decide whether a pixel needs all of them.
const PROBES: usize = 2;

/// One rendered pixel.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Texel {
    /// Radiance that stays when the sun is veiled.
    pub(super) ambient: [f32; 3],
    /// Radiance that scales with the sun: direct, bounced, aureole and disc.
    pub(super) sun: [f32; 3],
    /// Distance along the ray of sample 0, metres; infinite for the sky.
    pub(super) distance: f32,
    /// Normal, 8 bits a component, and how much of `sun` is direct, 8 bits.
    packed: u32,
}

impl Texel {
    fn pack(normal: Vec3, direct: f32) -> u32 {
        let byte = |v: f32| (v * 127.0 + 127.5) as u32 & 0xFF;
        byte(normal.x) | byte(normal.y) << 8 | byte(normal.z) << 16 | ((direct * 255.0 + 0.5) as u32) << 24
    }

    /// The surface's normal.
    pub(super) fn normal(&self) -> Vec3 {
        let part = |shift: u32| ((self.packed >> shift & 0xFF) as f32 - 127.0) / 127.0;
        Vec3::new(part(0), part(8), part(16)).normalize_or(Vec3::Y)
    }

    /// Share of `sun` that a shadow takes away.
    pub(super) fn direct_share(&self) -> f32 {
        (self.packed >> 24) as f32 / 255.0
    }

    /// Radiance under a sun of that strength.
    pub(super) fn radiance(&self, transmission: f32) -> Vec3 {
        Vec3::from(self.ambient) + Vec3::from(self.sun) * transmission
    }
}

/// The rendered place.
pub(super) struct Still {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) texels: Vec<Texel>,
    /// Radiance of the disc alone, where there is any, and the pixel.
    pub(super) disc: Vec<(u32, Vec3)>,
    /// Share of the disc that the camera sees.
    pub(super) disc_visible: f32,
}

/// Direction of sample `sample` of a pixel.
pub(super) fn sample_direction(width: u32, height: u32, column: u32, row: u32, sample: usize) -> (Vec2, Vec3) {
    let [dx, dy] = SAMPLES[sample].map(|v| 0.5 + f32::from(v) / 16.0);
    let uv = Vec2::new((column as f32 + dx) / width as f32, (row as f32 + dy) / height as f32);
    (uv, equirect::direction_from_uv(uv))
}

/// A direction into the sun's disc, another one for each sample, so that penumbrae are soft and without noise.
pub(super) fn towards_disc(sky: &Sky, sample: usize) -> Vec3 {
    let (side, up) = sky.sun.any_orthonormal_pair();
    let radius = SUN_RADIUS_RAD * ((sample as f32 + 0.5) / SAMPLES.len() as f32).sqrt();
    let (sin, cos) = (sample as f32 * 2.399_963).sin_cos();
    (sky.sun + (side * cos + up * sin) * radius).normalize()
}

/// What one sample sees.
struct Sample {
    ambient: Vec3,
    direct: Vec3,
    bounce: Vec3,
    contact: Option<Contact>,
}

/// Renders; `progress` is called from this thread with values that rise to 1.
pub(super) fn render(config: &PlazaConfig, world: &World, mut progress: impl FnMut(f32)) -> Still {
    let (width, height) = (config.width, config.height);
    let mut grid = Grid::for_width(width);
    let grid_width = grid.width;
    rows(&mut grid.cells, grid_width, |row, out| Grid::gather_row(grid_width, row, out, world), |done| progress(done * 0.4));
    for stride in [1, 2] {
        let mut smooth = vec![None; grid.cells.len()];
        rows(&mut smooth, grid_width, |row, out| grid.smooth_row(row, stride, out), |_| {});
        grid.cells = smooth;
    }
    let mut texels = vec![Texel::default(); width as usize * height as usize];
    let renderer = Renderer { world, grid: &grid, width, height, seed: (config.seed & 0xFFFF) as i32 };
    rows(&mut texels, width, |row, out| renderer.row(row, out), |done| progress(0.4 + 0.6 * done));
    let (disc, disc_visible) = disc(world, width, height);
    for (pixel, radiance) in &disc {
        let texel = &mut texels[*pixel as usize];
        texel.sun = (Vec3::from(texel.sun) + *radiance).to_array();
    }
    Still { width, height, texels, disc, disc_visible }
}

/// Fills rows on all cores. Each row depends on nothing but its index, so the result is the same on any number of them.
fn rows<T: Send>(out: &mut [T], width: u32, fill: impl Fn(u32, &mut [T]) + Sync, mut progress: impl FnMut(f32)) {
    let total = out.len() / width as usize;
    let queue = Mutex::new(out.chunks_mut(width as usize).enumerate());
    let (done, finished) = mpsc::channel();
    let threads = std::thread::available_parallelism().map_or(2, usize::from).min(total);
    std::thread::scope(|scope| {
        for _ in 0..threads {
            let (queue, fill, done) = (&queue, &fill, done.clone());
            scope.spawn(move || {
                loop {
                    let next = queue.lock().unwrap_or_else(std::sync::PoisonError::into_inner).next();
                    let Some((row, pixels)) = next else { break };
                    fill(row as u32, pixels);
                    // The receiver outlives the scope's threads.
                    let _ = done.send(());
                }
            });
        }
        drop(done);
        for (count, ()) in finished.iter().enumerate() {
            progress((count + 1) as f32 / total as f32);
        }
    });
}

struct Renderer<'a> {
    world: &'a World,
    grid: &'a Grid,
    width: u32,
    height: u32,
    seed: i32,
}

impl Renderer<'_> {
    fn row(&self, row: u32, out: &mut [Texel]) {
        for (column, texel) in out.iter_mut().enumerate() {
            *texel = self.pixel(column as u32, row);
        }
    }

    fn pixel(&self, column: u32, row: u32) -> Texel {
        let probes: [Sample; PROBES] = std::array::from_fn(|i| self.sample(column, row, i));
        let (mut ambient, mut direct, mut bounce) = (Vec3::ZERO, Vec3::ZERO, Vec3::ZERO);
        let mut take = |sample: &Sample| {
            ambient += sample.ambient;
            direct += sample.direct;
            bounce += sample.bounce;
        };
        probes.iter().for_each(&mut take);
        let mut count = PROBES;
        if differ(&probes[0], &probes[1]) {
            (PROBES..SAMPLES.len()).for_each(|i| take(&self.sample(column, row, i)));
            count = SAMPLES.len();
        }
        let scale = 1.0 / count as f32;
        let sun = direct + bounce;
        let share = direct.element_sum() / sun.element_sum().max(1e-9);
        let (distance, normal) = probes[0].contact.map_or((f32::INFINITY, Vec3::Y), |contact| (contact.t, contact.normal));
        Texel { ambient: (ambient * scale).to_array(), sun: (sun * scale).to_array(), distance, packed: Texel::pack(normal, share) }
    }

    fn sample(&self, column: u32, row: u32, index: usize) -> Sample {
        let sky = &self.world.sky;
        let (uv, direction) = sample_direction(self.width, self.height, column, row, index);
        let ray = Ray { origin: Vec3::ZERO, direction };
        let Some(contact) = self.world.place.trace(&ray) else {
            return Sample { ambient: sky.radiance(direction), direct: Vec3::ZERO, bounce: sky.aureole(direction), contact: None };
        };
        let mut sample = self.lit(&ray, uv, &contact, index);
        // Air between here and there.
        let clear = (-(contact.t - 20.0).max(0.0) / 420.0).exp();
        sample.ambient = sky.haze.lerp(sample.ambient, clear);
        sample.direct *= clear;
        sample.bounce *= clear;
        sample
    }

    fn lit(&self, ray: &Ray, uv: Vec2, contact: &Contact, index: usize) -> Sample {
        let world = self.world;
        let (p, n, sun) = (ray.at(contact.t), contact.normal, world.sky.sun);
        let pixel_rad = PI / self.height as f32;
        let material = world.place.material(contact.primitive);
        let look = surface(&world.place, ray, contact, sun, pixel_rad, self.seed);
        let leafy = matches!(material, Material::Foliage { .. });
        let gathered = if leafy { None } else { self.grid.at(uv, p, n, contact.t) };
        let light = gathered.unwrap_or_else(|| if leafy { world.open(look.normal) } else { world.sheltered(n) });
        let facing = look.normal.dot(sun);
        // Leaves let some light through.
        let facing = if leafy { facing.max(0.0) * 0.85 + 0.22 } else { facing.max(0.0) };
        let reached = facing * look.direct > 0.0
            && (leafy || n.dot(sun) > 0.0)
            && !world.place.shadowed(p, if leafy { look.normal } else { n }, towards_disc(&world.sky, index));
        let fresnel = look.mirror * (0.09 + 0.91 * (1.0 + ray.direction.dot(look.normal)).clamp(0.0, 1.0).powi(5));
        let matt = look.albedo * ((1.0 - fresnel) / PI);
        let mut sample = Sample {
            ambient: light.sky * matt * look.ambient,
            direct: if reached { world.direct() * matt * (facing * look.direct) } else { Vec3::ZERO },
            bounce: light.bounce * matt * look.ambient,
            contact: Some(*contact),
        };
        if fresnel > 0.0 {
            let mirrored = self.mirrored(p, n, ray.direction.reflect(look.normal));
            sample.ambient += mirrored.sky * fresnel;
            sample.bounce += mirrored.bounce * fresnel;
        }
        sample
    }

    /// Radiance from a mirrored direction, without the sun's image.
    fn mirrored(&self, p: Vec3, n: Vec3, direction: Vec3) -> Ambient {
        let ray = Ray { origin: p + n * 4e-3, direction };
        match self.world.place.trace(&ray) {
            Some(contact) => self.world.simple(&ray, &contact),
            None => Ambient { sky: self.world.sky.radiance(direction), bounce: Vec3::ZERO },
        }
    }
}

/// Whether two probes of a pixel disagree enough to show.
fn differ(a: &Sample, b: &Sample) -> bool {
    let surface = |s: &Sample| s.contact.map(|c| (c.primitive == Place::GROUND, c.normal));
    let code = |s: &Sample| (s.ambient + s.direct + s.bounce).clamp(Vec3::ZERO, Vec3::ONE).map(f32::sqrt);
    surface(a) != surface(b) || (code(a) - code(b)).abs().max_element() > 0.02
}

/// The disc's radiance in each pixel that it touches, weighted by the part of the pixel that it covers, so that its
/// energy is the same at every size; and the part of the disc that nothing hides.
fn disc(world: &World, width: u32, height: u32) -> (Vec<(u32, Vec3)>, f32) {
    let sun = world.sky.sun;
    let pixel_rad = PI / height as f32;
    let steps = ((pixel_rad / SUN_RADIUS_RAD * 24.0).ceil() as u32).clamp(8, 600);
    let reach = SUN_RADIUS_RAD + pixel_rad;
    let chord = 2.0 * (SUN_RADIUS_RAD * 0.5).sin();
    let (mut pixels, mut total, mut seen) = (Vec::new(), 0.0f64, 0.0f64);
    for row in 0..height {
        let latitude = (0.5 - (row as f32 + 0.5) / height as f32) * PI;
        if (latitude - sun.y.asin()).abs() > reach {
            continue;
        }
        for column in 0..width {
            let uv = |dx: f32, dy: f32| Vec2::new((column as f32 + dx) / width as f32, (row as f32 + dy) / height as f32);
            if (equirect::direction_from_uv(uv(0.5, 0.5)) - sun).length() > reach {
                continue;
            }
            let mut covered = 0.0f64;
            for (i, j) in (0..steps).flat_map(|j| (0..steps).map(move |i| (i, j))) {
                let direction = equirect::direction_from_uv(uv((i as f32 + 0.5) / steps as f32, (j as f32 + 0.5) / steps as f32));
                if (direction - sun).length() > chord {
                    continue;
                }
                let weight = f64::from((1.0 - direction.y * direction.y).sqrt());
                total += weight;
                if world.place.trace(&Ray { origin: Vec3::ZERO, direction }).is_none() {
                    covered += weight;
                }
            }
            seen += covered;
            if covered > 0.0 {
                pixels.push((row * width + column, covered / f64::from(equirect::pixel_solid_angle_sr(row, width, height))));
            }
        }
    }
    let total = total.max(f64::MIN_POSITIVE);
    let radiance = |share: f64| world.sky.sun_irradiance * (share / total) as f32;
    (pixels.into_iter().map(|(pixel, share)| (pixel, radiance(share))).collect(), (seen / total) as f32)
}
