//! What a surface looks like where a ray meets it: albedo, bump, mirror.

use glam::{Vec2, Vec3};

use super::facade::{WallPoint, groove};
use super::geometry::{Ray, Shape};
use super::noise::{fbm2, smoothstep, unit3, value2, value3};
use super::place::{Contact, GROUND_Y, Material, Place};

/// A surface at a point.
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    pub(super) albedo: Vec3,
    /// Shading normal.
    pub(super) normal: Vec3,
    /// Share of the sun that local relief lets through.
    pub(super) direct: f32,
    /// Share of the ambient light that local relief lets through.
    pub(super) ambient: f32,
    /// Weight of the Fresnel reflection: 1 for glass and water, 0 for matt.
    pub(super) mirror: f32,
}

impl Surface {
    /// A matt surface in the frame of its face: the normal is +z.
    pub(super) fn matt(albedo: Vec3) -> Self {
        Self { albedo, normal: Vec3::Z, direct: 1.0, ambient: 1.0, mirror: 0.0 }
    }

    fn facing(normal: Vec3, albedo: Vec3) -> Self {
        Self { normal, ..Self::matt(albedo) }
    }
}

/// The surface at a contact. `pixel_rad` is the angle of a pixel, for filtering patterns.
pub(super) fn surface(place: &Place, ray: &Ray, contact: &Contact, sun: Vec3, pixel_rad: f32, seed: i32) -> Surface {
    let p = ray.at(contact.t);
    let n = contact.normal;
    let footprint = contact.t * pixel_rad;
    match place.material(contact.primitive) {
        Material::Paving => Surface::facing(n, paving(p, contact.t, pixel_rad, seed)),
        Material::Plain(colour) => Surface::facing(n, weathered(p, colour, footprint)),
        Material::Tiles(colour) => Surface::facing(n, tiles(p, n, colour, footprint)),
        Material::Foliage { colour, crown, radius } => foliage(p, n, colour, crown, radius, footprint),
        Material::Water => water(p, n),
        Material::Clock { wall, dial_y } => Surface::facing(n, tower(place, contact, p, wall, dial_y, footprint)),
        Material::Facade(facade) => {
            let Some(Shape::Box { min, max }) = place.shapes.get(contact.primitive as usize) else {
                return Surface::facing(n, facade.wall);
            };
            if n.y.abs() > 0.5 {
                return Surface::facing(n, Vec3::new(0.30, 0.29, 0.28));
            }
            let along = Vec3::Y.cross(n);
            let into = |v: Vec3| Vec3::new(v.dot(along), v.y, v.dot(n));
            // The corner that the coordinate along the wall starts from.
            let corner = if along.dot(Vec3::ONE) > 0.0 { *min } else { *max };
            let wall = WallPoint {
                at: Vec2::new((p - corner).dot(along), p.y - min.y),
                size: Vec2::new((*max - *min).dot(along).abs(), max.y - min.y),
                view: into(ray.direction),
                sun: into(sun),
                wall_id: (contact.primitive as i32) * 4 + (n.x + 2.0 * n.z) as i32 + seed,
                footprint,
            };
            let local = facade.surface(&wall);
            Surface { normal: along * local.normal.x + Vec3::Y * local.normal.y + n * local.normal.z, ..local }
        }
    }
}

/// Colour of a slab before wear.
const SLAB: Vec3 = Vec3::new(0.395, 0.350, 0.298);
/// Mean albedo of the paving: slabs, bands, joints, stains and cracks.
pub(super) const PAVING_MEAN: Vec3 = Vec3::new(0.402, 0.362, 0.312);

fn weathered(p: Vec3, colour: Vec3, footprint: f32) -> Vec3 {
    let fine = (value3(p * 9.0, 11) - 0.5) * (1.0 - footprint / 0.1).clamp(0.0, 1.0);
    let coarse = (value3(p * 1.3, 12) - 0.5) * (1.0 - footprint / 0.7).clamp(0.0, 1.0);
    colour * (1.0 + 0.16 * coarse + 0.10 * fine)
}

fn tiles(p: Vec3, n: Vec3, colour: Vec3, footprint: f32) -> Vec3 {
    // Courses follow the height, columns the level direction of the slope.
    let level = Vec3::Y.cross(n).normalize_or(Vec3::X);
    let (course, column) = (p.y / 0.22, p.dot(level) / 0.28);
    let fade = (1.0 - footprint / 0.28).clamp(0.0, 1.0);
    let tone = unit3(course.floor() as i32, column.floor() as i32, 21) - 0.5;
    let lap = groove(course, 0.22, footprint / 0.22 * 1.5).max(0.6 * groove(column, 0.16, footprint / 0.28));
    colour * (1.0 + 0.45 * fade * tone + 0.5 * (fbm2(Vec2::new(p.dot(level), p.y) * 0.4, 3, 22) - 0.44)) * (1.0 - 0.42 * lap)
}

fn foliage(p: Vec3, n: Vec3, colour: Vec3, crown: Vec3, radius: f32, footprint: f32) -> Surface {
    let fade = (1.0 - footprint / 0.16).clamp(0.0, 1.0);
    let leaf = Vec3::new(value3(p * 13.0, 31), value3(p * 13.0, 32), value3(p * 13.0, 33)) - 0.5;
    let out = (p - crown) / radius;
    let normal = (n * 0.30 + out * 0.55 + leaf * 1.9 * fade).normalize_or(n);
    // Deep and low in the crown it is dark.
    let open = smoothstep(0.45, 1.15, out.length()) * (0.62 + 0.38 * out.y.clamp(-1.0, 1.0));
    let speckle = 1.0 + 1.1 * fade * (value3(p * 17.0, 34) - 0.5);
    Surface { albedo: colour * speckle, normal, direct: 1.0, ambient: 0.18 + 0.82 * open, mirror: 0.0 }
}

fn water(p: Vec3, n: Vec3) -> Surface {
    if n.y < 0.5 {
        return Surface::facing(n, Vec3::new(0.05, 0.09, 0.09));
    }
    let flat = Vec2::new(p.x, p.z);
    let slope = |offset: f32| (fbm2(flat * 5.0 + offset, 2, 41) - 0.37) * 0.10;
    let normal = Vec3::new(slope(0.0), 1.0, slope(37.0)).normalize();
    Surface { albedo: Vec3::new(0.035, 0.085, 0.085), normal, direct: 1.0, ambient: 1.0, mirror: 1.0 }
}

fn tower(place: &Place, contact: &Contact, p: Vec3, wall: Vec3, dial_y: f32, footprint: f32) -> Vec3 {
    let stone = weathered(p, wall, footprint);
    let Some(Shape::Box { min, max }) = place.shapes.get(contact.primitive as usize) else { return stone };
    let centre = (*min + *max) * 0.5;
    let along = Vec3::Y.cross(contact.normal);
    let d = Vec2::new((p - centre).dot(along), p.y - dial_y);
    let r = d.length();
    if r > 1.55 {
        let joint = groove(p.y / 0.6, 0.05, footprint / 0.6);
        let slit = d.x.abs() < 0.32 && [6.4, 11.0].iter().any(|y| (*y..*y + 2.2).contains(&(p.y - GROUND_Y)));
        return if slit { Vec3::splat(0.03) } else { stone * (1.0 - 0.25 * joint) };
    }
    // Ten past ten.
    let hand = |angle: f32, length: f32, width: f32| {
        let (sin, cos) = angle.sin_cos();
        let (up, across) = (d.x * sin + d.y * cos, d.x * cos - d.y * sin);
        (-0.15..length).contains(&up) && across.abs() < width
    };
    let hour = (d.x.atan2(d.y) / std::f32::consts::TAU * 12.0).rem_euclid(1.0);
    let mark = (1.08..1.32).contains(&r) && !(0.09..0.91).contains(&hour);
    if r > 1.38 {
        Vec3::new(0.30, 0.22, 0.08)
    } else if mark || hand(1.047, 1.15, 0.05) || hand(-1.0, 0.75, 0.07) {
        Vec3::splat(0.04)
    } else {
        Vec3::new(0.74, 0.71, 0.62)
    }
}

/// Slabs of granite in a grid with paler bands, a round carpet under the camera, cracks and a manhole.
fn paving(p: Vec3, distance: f32, pixel_rad: f32, seed: i32) -> Vec3 {
    let flat = Vec2::new(p.x, p.z);
    // A pixel's footprint on level ground: long along the view, short across.
    let across = distance * pixel_rad;
    let along = across * distance / GROUND_Y.abs();
    let view = flat.normalize_or(Vec2::Y).abs();
    let footprint = Vec2::new(along * view.x + across * view.y, along * view.y + across * view.x);
    let soft = footprint.max_element();
    let visible = |size: f32| (1.0 - soft / size).clamp(0.0, 1.0);

    let band = groove(p.x / 6.0 + 0.5, 0.12, footprint.x / 6.0).max(groove(p.z / 6.0 + 0.5, 0.12, footprint.y / 6.0));
    let (size, shift) = (Vec2::new(1.0, 0.6), (p.z / 0.6).floor().rem_euclid(2.0) * 0.5);
    let slab = Vec2::new(p.x / size.x + shift, p.z / size.y);
    let key = |salt| unit3(slab.x.floor() as i32, slab.y.floor() as i32, seed + salt) - 0.5;
    let joint = groove(slab.x, 0.016 / size.x, footprint.x / size.x).max(groove(slab.y, 0.016 / size.y, footprint.y / size.y));

    let mut albedo = SLAB.lerp(Vec3::new(0.50, 0.47, 0.42), band);
    albedo *= Vec3::ONE + (Vec3::splat(0.26 * key(1)) + Vec3::new(0.06, 0.0, -0.08) * key(2)) * visible(1.6) * (1.0 - band);
    albedo *= 1.0 + 0.22 * (fbm2(flat * 0.22, 4, seed + 50) - 0.47) + 0.20 * (fbm2(flat * 1.1, 3, seed + 55) - 0.44) * visible(1.5);
    albedo *= 1.0 + 0.16 * (value2(flat * 42.0, seed + 60) - 0.5) * visible(0.04);
    albedo *= 1.0 - 0.50 * joint;
    albedo *= 1.0 - 0.55 * crack(flat, soft, seed) - 0.25 * stain(flat, seed);
    manhole(flat - Vec2::new(2.3, -4.6), albedo, soft)
}

/// Thin dark lines where a noise field crosses its middle, in a few places.
fn crack(p: Vec2, footprint: f32, seed: i32) -> f32 {
    let wander = Vec2::new(fbm2(p * 2.1, 3, seed + 70), fbm2(p * 2.1, 3, seed + 75)) * 0.5;
    let field = value2((p + wander) * 0.33, seed + 80) - 0.5;
    let width = 0.002 + 0.2 * footprint;
    let somewhere = smoothstep(0.60, 0.72, value2(p * 0.21, seed + 85));
    (1.0 - field.abs() / width).clamp(0.0, 1.0) * somewhere * (0.01 / footprint.max(0.01))
}

fn stain(p: Vec2, seed: i32) -> f32 {
    smoothstep(0.56, 0.78, fbm2(p * 0.55, 4, seed + 90))
}

fn manhole(p: Vec2, around: Vec3, footprint: f32) -> Vec3 {
    let r = p.length();
    let inside = ((0.40 - r) / footprint.max(0.004) + 0.5).clamp(0.0, 1.0);
    if inside <= 0.0 {
        return around;
    }
    let ring = if (0.33..0.36).contains(&r) { 0.55 } else { 1.0 };
    let studs = groove(p.x / 0.07, 0.35, footprint / 0.07) * groove(p.y / 0.07, 0.35, footprint / 0.07);
    let iron = Vec3::new(0.105, 0.095, 0.085) * ring * (0.75 + 0.9 * if r < 0.33 { studs } else { 0.3 });
    around.lerp(iron, inside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plaza::truth;

    #[test]
    fn the_published_albedo_is_the_mean_of_the_textured_paving() {
        // A square of 62 m, many times the period of bands (6 m) and broadest noise (5 m), in steps without a common
        // measure with either or with the slabs; pixels of no width, so that nothing is filtered away.
        const SIDE: i32 = 1000;
        let mean_of = |seed: i32| {
            let mut sum = glam::DVec3::ZERO;
            for (column, row) in (0..SIDE).flat_map(|column| (0..SIDE).map(move |row| (column, row))) {
                let at = |i: i32| (i - SIDE / 2) as f32 * 0.061_803_4;
                sum += paving(Vec3::new(at(column), GROUND_Y, at(row)), 1.0, 0.0, seed).as_dvec3();
            }
            (sum / f64::from(SIDE * SIDE)).as_vec3()
        };
        let published = Vec3::from(truth::ground().albedo);
        for seed in [1, 2, 77] {
            let mean = mean_of(seed);
            // Seeds differ by half of that among themselves.
            assert!((mean / published - 1.0).abs().max_element() < 0.01, "seed {seed}: {mean} against {published}");
        }
    }
}
