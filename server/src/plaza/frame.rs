//! One frame: the still place with the movers and their shadows drawn over it.
//!
//! Only pixels near a mover or its shadow are touched; every other pixel is the still one.

use std::f32::consts::{PI, TAU};

use glam::Vec3;
use mr360_shaders::equirect;

use super::ambient::World;
use super::geometry::Ray;
use super::movers::{BodyHit, Figure};
use super::place::GROUND_Y;
use super::still::{Still, Texel, sample_direction, towards_disc};

/// Samples of a touched pixel.
const SAMPLES: usize = 4;
/// Bits of a mark: bodies from bit 0, shadows from bit 16.
const SHADOW_SHIFT: u32 = 16;

/// A pixel that movers changed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Touched {
    pub(super) pixel: u32,
    pub(super) radiance: Vec3,
    /// Movers whose bodies show, a bit each.
    pub(super) bodies: u16,
    /// Movers whose shadow or nearness changes the pixel, a bit each.
    pub(super) shadows: u16,
}

/// Draws movers over a still.
pub(super) struct Composer {
    /// Per pixel: who may show or cast there. All zero between frames.
    marks: Vec<u32>,
    marked: Vec<u32>,
    /// Ambient irradiance on the six axis normals around the camera, +x −x +y −y +z −z: without sun, and of the sun.
    cube: [(Vec3, Vec3); 6],
}

impl Composer {
    pub(super) fn new(still: &Still, world: &World) -> Self {
        let cube = std::array::from_fn(|i| {
            let axis = Vec3::AXES[i / 2] * if i % 2 == 0 { 1.0 } else { -1.0 };
            let light = world.open(axis);
            (light.sky, light.bounce)
        });
        Self { marks: vec![0; still.texels.len()], marked: Vec::new(), cube }
    }

    /// The pixels that differ from `still` under a sun of strength `transmission`, in rising order.
    pub(super) fn compose(&mut self, still: &Still, world: &World, figures: &[Figure], transmission: f32) -> Vec<Touched> {
        for figure in figures {
            for (centre, radius) in figure.body_spheres() {
                self.mark(still, centre, radius, 1 << figure.id);
            }
            for (centre, radius) in figure.shadow_spheres(world.sky.sun) {
                self.mark(still, centre, radius, 1 << (figure.id + SHADOW_SHIFT));
            }
        }
        self.marked.sort_unstable();
        let mut touched = Vec::new();
        let suns: [Vec3; SAMPLES] = std::array::from_fn(|i| towards_disc(&world.sky, i * 2));
        let painter = Painter { still, world, figures, transmission, cube: &self.cube, suns };
        for pixel in &self.marked {
            let mark = std::mem::take(&mut self.marks[*pixel as usize]);
            touched.extend(painter.pixel(*pixel, mark));
        }
        self.marked.clear();
        touched
    }

    /// Marks the pixels around a sphere's image.
    fn mark(&mut self, still: &Still, centre: Vec3, radius: f32, bit: u32) {
        let distance = centre.length();
        let level = centre.x.hypot(centre.z);
        let (width, height) = (still.width as f32, still.height as f32);
        let half_latitude = (radius / distance).min(1.0).asin();
        let half_longitude = if level > radius { (radius / level).asin() } else { PI };
        let uv = equirect::uv_from_direction(centre / distance.max(1e-6));
        let rows = [(uv.y - half_latitude / PI) * height - 1.0, (uv.y + half_latitude / PI) * height + 1.0];
        let [top, bottom] = rows.map(|row| row.clamp(0.0, height) as u32);
        let left = ((uv.x - half_longitude / TAU) * width - 1.0).floor() as i64;
        let right = ((uv.x + half_longitude / TAU) * width + 1.0).ceil() as i64;
        let right = right.min(left + i64::from(still.width) - 1);
        for row in top..(bottom + 1).min(still.height) {
            for column in left..=right {
                let pixel = row * still.width + column.rem_euclid(i64::from(still.width)) as u32;
                let mark = &mut self.marks[pixel as usize];
                if *mark == 0 {
                    self.marked.push(pixel);
                }
                *mark |= bit;
            }
        }
    }
}

struct Painter<'a> {
    still: &'a Still,
    world: &'a World,
    figures: &'a [Figure],
    transmission: f32,
    cube: &'a [(Vec3, Vec3); 6],
    suns: [Vec3; SAMPLES],
}

impl Painter<'_> {
    fn pixel(&self, pixel: u32, mark: u32) -> Option<Touched> {
        let still = self.still;
        let (column, row) = (pixel % still.width, pixel / still.width);
        let texel = &still.texels[pixel as usize];
        let unchanged = texel.radiance(self.transmission);
        // The plane of the surface seen by the still's first sample.
        let plane = texel.distance.is_finite().then(|| {
            let (_, direction) = sample_direction(still.width, still.height, column, row, 0);
            (direction * texel.distance, texel.normal())
        });
        let mark = self.culled(column, row, mark, plane);
        if mark == 0 {
            return None;
        }
        let (mut sum, mut bodies, mut shadows) = (Vec3::ZERO, 0u16, 0u16);
        let mut sunlit = None;
        for sample in 0..SAMPLES {
            let (_, direction) = sample_direction(still.width, still.height, column, row, sample);
            let ray = Ray { origin: Vec3::ZERO, direction };
            if let Some((id, hit)) = self.nearest(&ray, mark, texel.distance) {
                bodies |= 1 << id;
                sum += self.body(&ray, &hit, sample, &mut sunlit);
            } else if let Some(plane) = plane.filter(|_| mark >> SHADOW_SHIFT != 0) {
                sum += self.darkened(texel, &ray, plane, mark, sample, &mut shadows);
            } else {
                sum += unchanged;
            }
        }
        (bodies | shadows != 0).then(|| Touched { pixel, radiance: sum / SAMPLES as f32, bodies, shadows })
    }

    /// The bits of a mark that remain when the pixel's first ray, as wide as the pixel, is tried on the movers' bounds.
    fn culled(&self, column: u32, row: u32, mark: u32, plane: Option<(Vec3, Vec3)>) -> u32 {
        let pixel_rad = PI / self.still.height as f32;
        let (_, direction) = sample_direction(self.still.width, self.still.height, column, row, 0);
        let ray = Ray { origin: Vec3::ZERO, direction };
        let mut kept = 0;
        for figure in self.figures {
            if mark >> figure.id & 1 != 0 && figure.near(&ray, pixel_rad * (figure.position.length() + 1.0)) {
                kept |= 1 << figure.id;
            }
            let bit = 1 << (figure.id + SHADOW_SHIFT);
            let Some((p, normal)) = plane.filter(|_| mark & bit != 0) else { continue };
            // The pixel's reach on the surface, long where that is seen edge on.
            let margin = pixel_rad * p.length() / normal.dot(direction).abs().max(0.02) + 0.02;
            if figure.darkens(p, margin) || figure.near(&Ray { origin: p, direction: self.suns[0] }, margin) {
                kept |= bit;
            }
        }
        kept
    }

    fn nearest(&self, ray: &Ray, mark: u32, limit: f32) -> Option<(u32, BodyHit)> {
        let mut best: Option<(u32, BodyHit)> = None;
        for figure in self.figures.iter().filter(|figure| mark >> figure.id & 1 != 0) {
            if let Some(hit) = figure.hit(ray, best.as_ref().map_or(limit, |(_, hit)| hit.t)) {
                best = Some((figure.id, hit));
            }
        }
        best
    }

    /// Radiance of a body. `sunlit` keeps for the pixel whether the place lets the sun through to it.
    fn body(&self, ray: &Ray, hit: &BodyHit, sample: usize, sunlit: &mut Option<bool>) -> Vec3 {
        let (p, n, sun) = (ray.at(hit.t), hit.normal, self.suns[sample]);
        let up = (p.y - GROUND_Y).clamp(0.0, 1.8);
        let squares = n * n;
        let (mut sky, mut bounce) = (Vec3::ZERO, Vec3::ZERO);
        for axis in 0..3 {
            let (s, b) = self.cube[axis * 2 + usize::from(n[axis] < 0.0)];
            sky += s * squares[axis];
            bounce += b * squares[axis];
        }
        let mut from_sun = bounce * (0.75 + 0.14 * up);
        let facing = n.dot(sun);
        if facing > 0.0 {
            let shadow = Ray { origin: p + n * 0.01, direction: sun };
            let open = *sunlit.get_or_insert_with(|| !self.world.place.shadowed(p, n, sun));
            if open && !self.figures.iter().any(|figure| figure.blocks(&shadow)) {
                from_sun += self.world.direct() * facing;
            }
        }
        (sky * (0.66 + 0.19 * up) + from_sun * self.transmission) * hit.albedo / PI
    }

    /// Radiance of the place with the movers' shadows on it.
    fn darkened(&self, texel: &Texel, ray: &Ray, (origin, normal): (Vec3, Vec3), mark: u32, sample: usize, shadows: &mut u16) -> Vec3 {
        let slope = normal.dot(ray.direction);
        // Where the surface is seen edge on, the first sample's point stands for the pixel.
        let p = if slope < -0.02 { ray.at(normal.dot(origin) / slope) } else { origin };
        let share = texel.direct_share();
        let (mut open, mut direct) = (1.0, share);
        let shadow = Ray { origin: p + normal * 4e-3, direction: self.suns[sample] };
        for figure in self.figures.iter().filter(|figure| mark >> (figure.id + SHADOW_SHIFT) & 1 != 0) {
            let near = figure.openness(p, normal);
            let blocks = share > 0.0 && figure.blocks(&shadow);
            open *= near;
            if blocks {
                direct = 0.0;
            }
            if near < 0.995 || blocks {
                *shadows |= 1 << figure.id;
            }
        }
        let sun = (1.0 - share) * open + direct;
        Vec3::from(texel.ambient) * open + Vec3::from(texel.sun) * (sun * self.transmission)
    }
}
