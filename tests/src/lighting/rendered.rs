//! Objects ray traced under the truth and under an estimate: a diffuse, a matte silver and a mirror sphere, and the ground around a cylinder
//! that shades it.
//!
//! All pixels see the light directly, none the light of other objects. What an estimate stands for is its harmonics and lights alone, as
//! for a viewer without the video; but a mirror shows the video itself, lifted as the method says.

use std::f32::consts::PI;

use glam::{DVec3, Vec3};
use mr360_protocol::light::SH25;
use mr360_shaders::equirect::{pixel_solid_angle_sr, uv_from_direction};
use mr360_shaders::sh::basis25;

use super::radiance_map::RadianceMap;
use super::score::Light;

/// Pixels along the side of each picture.
const SIDE: usize = 48;
/// Columns and rows of the directions that light comes from: 1.4°, finer than anything the surfaces resolve but a shadow's edge.
const DIRECTIONS: (usize, usize) = (256, 128);
/// Square of the silver's roughness of 0.5: α of GGX.
const ALPHA: f32 = 0.25;
/// Radius and height of the cylinder, which stands in the middle of the ground, metres.
const CYLINDER: (f32, f32) = (0.5, 1.0);
/// Length of the ground's side, metres.
const GROUND: f32 = 4.0;
/// Rays along the side of a pixel of the mirror, which shows the whole sphere in little more than a thousand of them.
const RAYS: usize = 8;

/// What is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Object {
    /// White, diffuse sphere.
    Diffuse,
    /// Perfectly conducting sphere of roughness 0.5.
    Silver,
    /// White, diffuse ground with the cylinder's shadow, seen from above.
    Shadow,
    /// Sphere that reflects everything.
    Mirror,
}

impl Object {
    /// All of them, in the order of [`Errors`].
    pub(super) const ALL: [Self; 4] = [Self::Diffuse, Self::Silver, Self::Shadow, Self::Mirror];
    /// Those that harmonics and lights light.
    const LIT: [Self; 3] = [Self::Diffuse, Self::Silver, Self::Shadow];

    /// As tables and CSV call it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Diffuse => "diffuse",
            Self::Silver => "silver",
            Self::Shadow => "shadow",
            Self::Mirror => "mirror",
        }
    }

    /// In words.
    pub(super) fn title(self) -> &'static str {
        match self {
            Self::Diffuse => "diffuse sphere",
            Self::Silver => "matte silver sphere of roughness 0.5",
            Self::Shadow => "ground with a cylinder's shadow",
            Self::Mirror => "mirror sphere, which shows the frame as it is lifted",
        }
    }

    /// Its surface at the pixel with these coordinates in (−1, 1), right and up; `None` beside the object.
    fn surface(self, right: f32, up: f32) -> Option<Surface> {
        if self == Self::Shadow {
            let position = Vec3::new(right, 0.0, -up) * (GROUND / 2.0);
            return (position.length() > CYLINDER.0).then_some(Surface { object: self, position, normal: Vec3::Y });
        }
        let square = right * right + up * up;
        (square < 1.0).then(|| Surface { object: self, position: Vec3::ZERO, normal: Vec3::new(right, up, (1.0 - square).sqrt()) })
    }
}

/// What one pixel shows. Spheres are seen along −z, from far away.
struct Surface {
    object: Object,
    position: Vec3,
    normal: Vec3,
}

impl Surface {
    /// Radiance towards the eye for an irradiance of 1 on a surface that faces a light in this direction.
    fn response(&self, to_light: Vec3) -> f32 {
        let cosine = self.normal.dot(to_light);
        if cosine <= 0.0 {
            return 0.0;
        }
        match self.object {
            Object::Diffuse => cosine / PI,
            Object::Silver => ggx(self.normal.z, cosine, self.normal.dot((to_light + Vec3::Z).normalize_or_zero())),
            Object::Shadow if shaded(self.position, to_light) => 0.0,
            Object::Shadow => cosine / PI,
            // Of a light without extent it shows nothing.
            Object::Mirror => 0.0,
        }
    }
}

/// GGX with Smith's height-correlated shadowing, no Fresnel term, times the light's cosine (Walter et al. 2007; Heitz 2014).
fn ggx(eye: f32, light: f32, half: f32) -> f32 {
    let square = ALPHA * ALPHA;
    let bump = half * half * (square - 1.0) + 1.0;
    let distribution = square / (PI * bump * bump);
    let root = |cosine: f32| (square + (1.0 - square) * cosine * cosine).sqrt();
    0.5 * distribution / (light * root(eye) + eye * root(light)) * light
}

/// Whether the cylinder stands between a point of the ground and a light above the horizon.
fn shaded(position: Vec3, to_light: Vec3) -> bool {
    let (radius, height) = CYLINDER;
    let along = to_light.x * to_light.x + to_light.z * to_light.z;
    let towards = -(position.x * to_light.x + position.z * to_light.z);
    let beyond = position.x * position.x + position.z * position.z - radius * radius;
    let root = towards * towards - along * beyond;
    // Rising rays from outside enter through the side or not at all.
    towards > 0.0 && root > 0.0 && (towards - root.sqrt()) / along * to_light.y < height
}

/// Errors of the pictures of [`Object::ALL`]: root mean square over the mean of the truth, and the same after the best single scale.
pub(super) type Errors = [(f64, f64); 4];

/// The pictures' surfaces, and how each answers to every harmonic.
pub(super) struct Stage {
    /// By [`Object::LIT`].
    pictures: [Vec<Surface>; 3],
    /// Coefficient by coefficient, for every surface.
    harmonics: [Vec<[f32; SH25]>; 3],
    /// Where each pixel of the mirror looks.
    mirrored: Vec<[Vec3; RAYS * RAYS]>,
}

/// Radiance of every pixel of the pictures, by [`Object::ALL`].
pub(super) type Pictures = [Vec<DVec3>; 4];

impl Stage {
    pub(super) fn new() -> Self {
        let at = |pixel: usize| (pixel as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0;
        let pictures = Object::LIT
            .map(|object| (0..SIDE * SIDE).filter_map(|pixel| object.surface(at(pixel % SIDE), -at(pixel / SIDE))).collect::<Vec<_>>());
        let (columns, rows) = DIRECTIONS;
        let grid = RadianceGrid::empty();
        let bases: Vec<[f32; SH25]> = (0..columns * rows)
            .map(|cell| {
                let solid_angle = pixel_solid_angle_sr((cell / columns) as u32, columns as u32, rows as u32);
                basis25(grid.directions[cell]).map(|value| value * solid_angle)
            })
            .collect();
        let harmonics = pictures.each_ref().map(|surfaces| {
            let answer = |surface: &Surface| {
                let mut sum = [0.0; SH25];
                for (direction, basis) in grid.directions.iter().zip(&bases) {
                    let response = surface.response(*direction);
                    if response > 0.0 {
                        sum.iter_mut().zip(basis).for_each(|(sum, value)| *sum += response * value);
                    }
                }
                sum
            };
            surfaces.iter().map(answer).collect()
        });
        let mirrored = (0..SIDE * SIDE).filter_map(|pixel| mirrored(at(pixel % SIDE), -at(pixel / SIDE))).collect();
        Self { pictures, harmonics, mirrored }
    }

    /// What the mirror shows of a panorama.
    pub(super) fn mirror(&self, map: &RadianceMap) -> Vec<DVec3> {
        let seen = |ray: &Vec3| {
            let uv = uv_from_direction(*ray);
            let (column, row) = ((uv.x * map.width as f32) as usize % map.width, (uv.y * map.height as f32) as usize);
            map.texels()[row.min(map.height - 1) * map.width + column].as_dvec3()
        };
        self.mirrored.iter().map(|rays| rays.iter().map(seen).sum::<DVec3>() / rays.len() as f64).collect()
    }

    /// Under all light of a panorama.
    #[cfg(test)]
    fn under_truth(&self, map: &RadianceMap) -> Pictures {
        self.under_all(&[map]).remove(0)
    }

    /// Under all light of each of several panoramas, in their order: what a surface answers to a direction is worked out once for all.
    pub(super) fn under_all(&self, maps: &[&RadianceMap]) -> Vec<Pictures> {
        let directions = RadianceGrid::empty().directions;
        let grids: Vec<RadianceGrid> = maps.iter().map(|map| RadianceGrid::of(map)).collect();
        // Direction by direction, the energies of all panoramas.
        let energies: Vec<Vec3> = (0..directions.len()).flat_map(|cell| grids.iter().map(move |grid| grid.energy[cell])).collect();
        let mut all: Vec<Pictures> = maps.iter().map(|_| Pictures::default()).collect();
        for (picture, surfaces) in self.pictures.iter().enumerate() {
            for surface in surfaces {
                let mut sums = vec![Vec3::ZERO; maps.len()];
                for (direction, energies) in directions.iter().zip(energies.chunks_exact(maps.len().max(1))) {
                    let response = surface.response(*direction);
                    if response > 0.0 {
                        sums.iter_mut().zip(energies).for_each(|(sum, energy)| *sum += *energy * response);
                    }
                }
                all.iter_mut().zip(sums).for_each(|(pictures, sum)| pictures[picture].push(sum.as_dvec3()));
            }
        }
        for (pictures, map) in all.iter_mut().zip(maps) {
            pictures[Object::LIT.len()] = self.mirror(map);
        }
        all
    }

    /// Under what a method says, with what the mirror shows of its panorama; harmonics that ring below 0 leave a pixel black.
    pub(super) fn under(&self, light: &Light, mirror: &[DVec3]) -> Pictures {
        let mut pictures = Pictures::default();
        pictures[Object::LIT.len()] = mirror.to_vec();
        for ((surfaces, harmonics), picture) in self.pictures.iter().zip(&self.harmonics).zip(&mut pictures) {
            for (surface, answers) in surfaces.iter().zip(harmonics) {
                let soft: Vec3 = light.sh.iter().zip(answers).map(|(coefficient, answer)| *coefficient * *answer).sum();
                let hard: Vec3 = light.lights.iter().map(|light| light.irradiance * surface.response(light.direction)).sum();
                picture.push((soft.max(Vec3::ZERO) + hard).as_dvec3());
            }
        }
        pictures
    }
}

/// Errors of pictures where `truth` is of a panorama that is `scale` times as bright in them.
pub(super) fn errors(estimate: &Pictures, truth: &Pictures, scale: f32) -> Errors {
    let mut errors = Errors::default();
    for ((error, estimate), truth) in errors.iter_mut().zip(estimate).zip(truth) {
        let truth: Vec<DVec3> = truth.iter().map(|pixel| *pixel * f64::from(scale)).collect();
        let values = 3.0 * truth.len() as f64;
        let mean = truth.iter().map(|pixel| pixel.element_sum()).sum::<f64>() / values;
        let after = |factor: f64| {
            let square: f64 = estimate.iter().zip(&truth).map(|(e, t)| (*e * factor - *t).length_squared()).sum();
            (square / values).sqrt() / mean
        };
        let own: f64 = estimate.iter().map(|pixel| pixel.length_squared()).sum();
        let shared: f64 = estimate.iter().zip(&truth).map(|(e, t)| e.dot(*t)).sum();
        *error = (after(1.0), after(if own > 0.0 { shared / own } else { 0.0 }));
    }
    errors
}

/// Where a pixel of the mirror looks, whose middle has these coordinates in (−1, 1); none beside the sphere. Rays that miss it look where the nearest of its rim does.
fn mirrored(right: f32, up: f32) -> Option<[Vec3; RAYS * RAYS]> {
    (right * right + up * up < 1.0).then(|| {
        std::array::from_fn(|ray| {
            let within = |ray: usize| ((ray as f32 + 0.5) / RAYS as f32 - 0.5) * 2.0 / SIDE as f32;
            let at = glam::Vec2::new(right + within(ray % RAYS), up + within(ray / RAYS)).clamp_length_max(0.999);
            let normal = at.extend((1.0 - at.length_squared()).sqrt());
            2.0 * normal.z * normal - Vec3::Z
        })
    })
}

/// A panorama's energy, radiance · solid angle, collected into [`DIRECTIONS`].
struct RadianceGrid {
    directions: Vec<Vec3>,
    energy: Vec<Vec3>,
}

impl RadianceGrid {
    fn empty() -> Self {
        let (columns, rows) = DIRECTIONS;
        let centre = |cell: usize| {
            let (column, row) = (cell % columns, cell / columns);
            mr360_shaders::equirect::direction_from_uv(glam::Vec2::new(
                (column as f32 + 0.5) / columns as f32,
                (row as f32 + 0.5) / rows as f32,
            ))
        };
        Self { directions: (0..columns * rows).map(centre).collect(), energy: vec![Vec3::ZERO; columns * rows] }
    }

    fn of(map: &RadianceMap) -> Self {
        let (columns, rows) = DIRECTIONS;
        let mut grid = Self::empty();
        for (row, texels) in map.rows().enumerate() {
            let solid_angle = map.solid_angle_sr(row) as f32;
            let line = (row * rows / map.height) * columns;
            for (column, texel) in texels.iter().enumerate() {
                grid.energy[line + column * columns / map.width] += *texel * solid_angle;
            }
        }
        grid
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::DirectionalLight;

    use super::*;

    fn even(radiance: f32) -> Light {
        let mut sh = vec![Vec3::ZERO; 9];
        sh[0] = Vec3::splat(radiance * (4.0 * PI).sqrt());
        Light { sh, ..Light::default() }
    }

    #[test]
    fn even_light_is_seen_alike_under_truth_and_harmonics() {
        let stage = Stage::new();
        let even_map = RadianceMap::of(128, |_| Vec3::ONE);
        let (truth, estimate) = (stage.under_truth(&even_map), stage.under(&even(1.0), &stage.mirror(&even_map)));
        for (at, error) in errors(&estimate, &truth, 1.0).iter().enumerate() {
            assert!(error.0 < 1e-3, "{at}: {error:?}");
        }
        // A white diffuse sphere vanishes in even light; the ground darkens beside the cylinder alone.
        assert!(truth[0].iter().all(|pixel| (pixel.x - 1.0).abs() < 2e-3));
        // One scattering off a conductor of α = 0.25 that faces the eye returns 91.6 % of even light, integrated elsewhere.
        let facing = truth[1][truth[1].len() / 2 + SIDE / 2].x;
        assert!((facing - 0.9158).abs() < 2e-3, "{facing}");
        let (near, far) = (truth[2].iter().map(|p| p.x).fold(1.0, f64::min), truth[2][0].x);
        assert!(near < 0.75 && far > 0.95 && far <= 1.002, "{near} {far}");
        // Twice as bright: off by half of the truth, and by nothing after the best scale; the diffuse sphere is even.
        let doubled = errors(&estimate, &truth, 2.0);
        assert!((doubled[0].0 - 0.5).abs() < 2e-3 && doubled.iter().all(|error| error.1 < 1e-3), "{doubled:?}");
    }

    #[test]
    fn a_mirror_shows_what_lies_in_the_mirrored_direction() {
        let stage = Stage::new();
        let directions = RadianceMap::of(256, |direction| direction * 0.5 + 0.5);
        let shown = stage.mirror(&directions);
        // The middle shows what is behind the eye; half way to the rim, where the normal is 30° off, 60° from that; the rim what is behind the sphere.
        let pixels: Vec<(f32, f32)> = (0..SIDE * SIDE)
            .map(|pixel| ((pixel % SIDE) as f32, (pixel / SIDE) as f32))
            .map(|(x, y)| ((x + 0.5) / SIDE as f32 * 2.0 - 1.0, 1.0 - (y + 0.5) / SIDE as f32 * 2.0))
            .filter(|(right, up)| right * right + up * up < 1.0)
            .collect();
        assert_eq!(shown.len(), pixels.len());
        for (seen, (right, up)) in shown.iter().zip(pixels) {
            let towards = (*seen * 2.0 - 1.0).as_vec3();
            let angle = 2.0 * right.hypot(up).asin();
            let expected = Vec3::new(angle.sin() * right / right.hypot(up), angle.sin() * up / right.hypot(up), angle.cos());
            // A pixel near the rim spans tens of degrees.
            if right.hypot(up) < 0.9 {
                assert!((towards - expected).length() < 0.02, "{right} {up}: {towards} {expected}");
            }
        }
        assert!(stage.under(&even(1.0), &shown)[3] == shown);
    }

    #[test]
    fn one_light_shades_the_ground_where_the_cylinder_stands_before_it() {
        let to_light = Vec3::new(1.0, 1.0, 0.0).normalize();
        // At 45° a cylinder one metre high throws a shadow one metre long, from its far side on.
        for (x, z, expected) in [(-0.6, 0.0, true), (-1.4, 0.0, true), (-1.6, 0.0, false), (0.6, 0.0, false), (-0.6, 0.6, false)] {
            assert_eq!(shaded(Vec3::new(x, 0.0, z), to_light), expected, "{x} {z}");
        }
        assert!(!shaded(Vec3::new(0.6, 0.0, 0.0), Vec3::Y));
        let stage = Stage::new();
        let lights = vec![DirectionalLight { id: 0, direction: to_light, irradiance: Vec3::splat(PI), solid_angle_sr: 0.01 }];
        let lit = stage.under(&Light { sh: vec![Vec3::ZERO; 9], lights, ..Light::default() }, &[]);
        for (pixel, surface) in lit[2].iter().zip(&stage.pictures[2]) {
            let expected = if shaded(surface.position, to_light) { 0.0 } else { 0.5f64.sqrt() };
            assert!((pixel.x - expected).abs() < 1e-6);
        }
        for (pixel, surface) in lit[0].iter().zip(&stage.pictures[0]) {
            assert!((pixel.x - f64::from(surface.normal.dot(to_light).max(0.0))).abs() < 1e-6);
        }
        // A light at the eye is mirrored brightest where the surface faces it: D / 4, D = 1 / (π α²).
        let brightest = Surface { object: Object::Silver, position: Vec3::ZERO, normal: Vec3::Z }.response(Vec3::Z);
        assert!((brightest * 4.0 * PI * ALPHA * ALPHA - 1.0).abs() < 1e-5, "{brightest}");
    }
}
