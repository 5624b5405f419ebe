//! Light that does not come straight from the sun: the sky where it is seen, and one bounce off what hides it.
//!
//! Gathered at the points of a coarse grid of view rays, smoothed along surfaces, and interpolated.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};
use mr360_shaders::equirect;

use super::geometry::Ray;
use super::noise::unit3;
use super::place::{Contact, Material, Place};
use super::sky::Sky;
use super::surface::PAVING_MEAN;

const STRATA: [u32; 2] = [4, 9];
const TABLE: [usize; 2] = [96, 24];

/// Irradiance from everything but the sun's disc.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Ambient {
    /// Of the sky.
    pub(super) sky: Vec3,
    /// Of sunlight scattered by the place.
    pub(super) bounce: Vec3,
}

impl Ambient {
    fn add(&mut self, other: Self, weight: f32) {
        self.sky += other.sky * weight;
        self.bounce += other.bounce * weight;
    }

    fn scaled(self, factor: f32) -> Self {
        Self { sky: self.sky * factor, bounce: self.bounce * factor }
    }
}

/// Place and sky together, with what gathering needs at hand.
pub(super) struct World {
    pub(super) place: Place,
    pub(super) sky: Sky,
    /// Sky radiance over azimuth and sin φ.
    table: Vec<Vec3>,
}

impl World {
    pub(super) fn new(place: Place, sky: Sky) -> Self {
        let [columns, rows] = TABLE;
        let direction = |i: usize| {
            let up = ((i / columns) as f32 + 0.5) / rows as f32;
            let (sin, cos) = (((i % columns) as f32 + 0.5) / columns as f32 * TAU).sin_cos();
            let level = (1.0 - up * up).sqrt();
            Vec3::new(level * sin, up, -level * cos)
        };
        let table = (0..columns * rows).map(|i| sky.radiance(direction(i))).collect();
        Self { place, sky, table }
    }

    fn sky_coarse(&self, direction: Vec3) -> Vec3 {
        let [columns, rows] = TABLE;
        let column = (direction.x.atan2(-direction.z) / TAU).rem_euclid(1.0) * columns as f32;
        let row = (direction.y.max(0.0) * rows as f32) as usize;
        self.table[row.min(rows - 1) * columns + (column as usize).min(columns - 1)]
    }

    /// Light of sun and aureole on a surface facing them.
    pub(super) fn direct(&self) -> Vec3 {
        self.sky.sun_irradiance + self.sky.aureole_irradiance
    }

    /// Ambient light in the open, by the normal alone.
    pub(super) fn open(&self, normal: Vec3) -> Ambient {
        let (up, down) = (0.5 + 0.5 * normal.y, 0.5 - 0.5 * normal.y);
        let ground = self.direct() * PAVING_MEAN * self.sky.sun.y;
        let around = Vec3::new(0.55, 0.45, 0.35);
        Ambient { sky: self.sky.up_irradiance * (0.72 * up + 0.25 * down), bounce: ground * (0.62 * down + around * 0.22) }
    }

    /// Ambient light on small parts that no gathered point speaks for: mostly ledges, whose undersides see walls.
    pub(super) fn sheltered(&self, normal: Vec3) -> Ambient {
        self.open(normal).scaled(0.78 + 0.28 * normal.y.min(0.0))
    }

    /// Radiance that a matt version of a surface sends back: sky part and sun part.
    pub(super) fn simple(&self, ray: &Ray, contact: &Contact) -> Ambient {
        let albedo = match self.place.material(contact.primitive) {
            Material::Paving => PAVING_MEAN,
            Material::Plain(colour) | Material::Tiles(colour) => colour,
            Material::Foliage { colour, .. } => colour * 0.7,
            Material::Water => Vec3::new(0.08, 0.12, 0.12),
            Material::Clock { wall, .. } => wall,
            Material::Facade(facade) => facade.wall * 0.8,
        };
        let (p, n, sun) = (ray.at(contact.t), contact.normal, self.sky.sun);
        let mut light = self.open(n);
        let facing = n.dot(sun);
        if facing > 0.0 && !self.place.shadowed(p, n, sun) {
            light.bounce += self.direct() * facing;
        }
        Ambient { sky: light.sky * albedo / PI, bounce: light.bounce * albedo / PI }
    }

    /// Cosine-weighted gathering over stratified directions, turned by `turn` in [0, 1).
    fn gather(&self, p: Vec3, n: Vec3, turn: Vec2) -> Ambient {
        let tangent = if n.y.abs() > 0.9 { Vec3::X } else { Vec3::Y }.cross(n).normalize();
        let bitangent = n.cross(tangent);
        let mut sum = Ambient::default();
        for ring in 0..STRATA[0] {
            for sector in 0..STRATA[1] {
                let r2 = (ring as f32 + (turn.y + sector as f32 * 0.618).fract()) / STRATA[0] as f32;
                let (sin, cos) = ((sector as f32 + turn.x + ring as f32 * 0.37) / STRATA[1] as f32 * TAU).sin_cos();
                let direction = (tangent * cos + bitangent * sin) * r2.sqrt() + n * (1.0 - r2).sqrt();
                let ray = Ray { origin: p + n * 4e-3, direction };
                match self.place.trace(&ray) {
                    None => sum.sky += self.sky_coarse(direction),
                    Some(contact) => sum.add(self.simple(&ray, &contact), 1.0),
                }
            }
        }
        sum.scaled(PI / (STRATA[0] * STRATA[1]) as f32)
    }
}

/// One grid point on a surface.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    p: Vec3,
    n: Vec3,
    t: f32,
    light: Ambient,
}

/// The grid; cells that look at the sky are empty.
pub(super) struct Grid {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) cells: Vec<Option<Cell>>,
}

impl Grid {
    /// An empty grid fit for a picture of that width.
    pub(super) fn for_width(width: u32) -> Self {
        let width = (width / 2).clamp(64, 640);
        Self { width, height: width / 2, cells: vec![None; (width * (width / 2)) as usize] }
    }

    /// Gathers one row.
    pub(super) fn gather_row(width: u32, row: u32, out: &mut [Option<Cell>], world: &World) {
        for (column, cell) in out.iter_mut().enumerate() {
            let uv = Vec2::new((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / (width / 2) as f32);
            let ray = Ray { origin: Vec3::ZERO, direction: equirect::direction_from_uv(uv) };
            *cell = world.place.trace(&ray).map(|contact| {
                let (p, n) = (ray.at(contact.t), contact.normal);
                let turn = Vec2::new(unit3(column as i32, row as i32, 501), unit3(column as i32, row as i32, 502));
                Cell { p, n, t: contact.t, light: world.gather(p, n, turn) }
            });
        }
    }

    /// One smoothed row: neighbours on the same surface, weighted by their closeness in the world.
    pub(super) fn smooth_row(&self, row: u32, stride: i32, out: &mut [Option<Cell>]) {
        for (column, target) in out.iter_mut().enumerate() {
            let Some(centre) = self.cell(column as i32, row as i32) else { continue };
            let (mut sum, mut total) = (Ambient::default(), 0.0);
            for (dx, dy) in (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (dx, dy))) {
                let Some(other) = self.cell(column as i32 + dx * stride, row as i32 + dy * stride) else { continue };
                let weight = kinship(&other, centre.p, centre.n, centre.t) * (-0.25 * (dx * dx + dy * dy) as f32).exp();
                sum.add(other.light, weight);
                total += weight;
            }
            *target = Some(Cell { light: sum.scaled(1.0 / total.max(1e-9)), ..centre });
        }
    }

    fn cell(&self, column: i32, row: i32) -> Option<Cell> {
        if row < 0 || row >= self.height as i32 {
            return None;
        }
        let column = column.rem_euclid(self.width as i32);
        self.cells[(row as u32 * self.width + column as u32) as usize]
    }

    /// Light on a surface point seen at `uv`; `None` where no grid point lies on its surface nearby.
    pub(super) fn at(&self, uv: Vec2, p: Vec3, n: Vec3, t: f32) -> Option<Ambient> {
        let x = uv.x * self.width as f32 - 0.5;
        let y = uv.y * self.height as f32 - 0.5;
        let (column, row) = (x.floor() as i32, y.floor() as i32);
        let (mut sum, mut total) = (Ambient::default(), 0.0);
        for (dx, dy) in (-1..=2).flat_map(|dy| (-1..=2).map(move |dx| (dx, dy))) {
            let Some(cell) = self.cell(column + dx, row + dy) else { continue };
            let (fx, fy) = (((column + dx) as f32 - x) * 0.5, ((row + dy) as f32 - y) * 0.5);
            let tent = (1.0 - fx.abs()).max(0.0) * (1.0 - fy.abs()).max(0.0);
            let weight = tent * kinship(&cell, p, n, t);
            sum.add(cell.light, weight);
            total += weight;
        }
        (total > 1e-3).then(|| sum.scaled(1.0 / total))
    }
}

/// How far a grid point speaks for a surface point: same facing, same plane.
fn kinship(cell: &Cell, p: Vec3, n: Vec3, t: f32) -> f32 {
    let facing = cell.n.dot(n).max(0.0).powi(8);
    let off_plane = (cell.p - p).dot(n).abs() / (0.006 * t + 0.02);
    if facing < 0.05 || off_plane > 3.0 {
        return 0.0;
    }
    let apart = (cell.p - p).length() / (0.10 * t + 0.1);
    facing * (-off_plane * off_plane).exp() / (1.0 + apart * apart)
}
