//! An equirect panorama: as a cube, without its lights, and as the ground that looks like it.

use std::f32::consts::{PI, TAU};
use std::path::Path;

use bevy::math::{Vec2, Vec3};
use half::f16;

use crate::Light;

/// A brighter ground emits what no albedo gives, as in the truth.
const ALBEDO_MOST: f32 = 0.95;

/// Radiance, rows from the top.
#[derive(Clone)]
pub struct Panorama {
    pub columns: usize,
    pub rows: usize,
    radiance: Vec<Vec3>,
}

impl Panorama {
    pub fn load(path: &Path, columns: usize, rows: usize) -> Result<Self, Box<dyn std::error::Error>> {
        let bytes = std::fs::read(path).map_err(|error| format!("{}: {error}", path.display()))?;
        if columns == 0 || rows == 0 || bytes.len() != columns * rows * 12 {
            return Err(format!("{}: {} bytes are not {columns}×{rows} pixels of RGB floats", path.display(), bytes.len()).into());
        }
        let value = |four: &[u8]| f32::from_le_bytes([four[0], four[1], four[2], four[3]]);
        let radiance = bytes.chunks_exact(12).map(|pixel| Vec3::new(value(&pixel[..4]), value(&pixel[4..8]), value(&pixel[8..]))).collect();
        Ok(Self { columns, rows, radiance })
    }

    fn direction(&self, row: usize, column: usize) -> Vec3 {
        let longitude = ((column as f32 + 0.5) / self.columns as f32 - 0.5) * TAU;
        let latitude = (0.5 - (row as f32 + 0.5) / self.rows as f32) * PI;
        Vec3::new(latitude.cos() * longitude.sin(), latitude.sin(), -latitude.cos() * longitude.cos())
    }

    /// Solid angle of a pixel of this row.
    fn area(&self, row: usize) -> f32 {
        ((row as f32 + 0.5) / self.rows as f32 * PI).sin() * PI / self.rows as f32 * TAU / self.columns as f32
    }

    fn pixels(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let columns = self.columns;
        (0..self.rows).flat_map(move |row| (0..columns).map(move |column| (row, column)))
    }

    /// What exceeds the surroundings within 1.5 half angles of a light is cut off.
    pub fn without(mut self, light: &Light) -> Self {
        let towards = Vec3::from(light.direction);
        let half = (1.0 - light.solid_angle_sr / TAU).clamp(-1.0, 1.0).acos();
        let radius = (1.5 * half).max(1.5 * PI / self.rows as f32);
        let (mut around, mut weight, mut inside) = (Vec3::ZERO, 0.0, Vec::new());
        for (at, (row, column)) in self.pixels().enumerate() {
            let angle = self.direction(row, column).dot(towards).clamp(-1.0, 1.0).acos();
            if angle < radius {
                inside.push(at);
            } else if angle < 2.0 * radius {
                around += self.radiance[at] * self.area(row);
                weight += self.area(row);
            }
        }
        let most = around / weight.max(f32::MIN_POSITIVE);
        for at in inside {
            self.radiance[at] = self.radiance[at].min(most);
        }
        self
    }

    /// Between the four nearest pixels.
    fn seen(&self, direction: Vec3) -> Vec3 {
        let direction = direction.normalize();
        let u = direction.x.atan2(-direction.z) / TAU + 0.5;
        let v = 0.5 - direction.y.asin() / PI;
        let at = Vec2::new(u * self.columns as f32 - 0.5, v * self.rows as f32 - 0.5);
        let (low, share) = (at.floor(), at - at.floor());
        let pixel = |dx: i32, dy: i32| {
            let column = (low.x as i32 + dx).rem_euclid(self.columns as i32) as usize;
            let row = (low.y as i32 + dy).clamp(0, self.rows as i32 - 1) as usize;
            self.radiance[row * self.columns + column]
        };
        pixel(0, 0).lerp(pixel(1, 0), share.x).lerp(pixel(0, 1).lerp(pixel(1, 1), share.x), share.y)
    }

    /// Texels of a cube of this face: +x, −x, +y, −y, +z, −z, where z is turned around.
    pub fn cube(&self, face: u32) -> Vec<u8> {
        let mut texels = Vec::with_capacity(face as usize * face as usize * 48);
        for side in 0..6 {
            for (row, column) in (0..face).flat_map(|row| (0..face).map(move |column| (row, column))) {
                let [s, t] = [column, row].map(|at| (at as f32 + 0.5) / face as f32 * 2.0 - 1.0);
                let on_cube = match side {
                    0 => Vec3::new(1.0, -t, -s),
                    1 => Vec3::new(-1.0, -t, s),
                    2 => Vec3::new(s, 1.0, t),
                    3 => Vec3::new(s, -1.0, -t),
                    4 => Vec3::new(s, -t, 1.0),
                    _ => Vec3::new(-s, -t, -1.0),
                };
                push(&mut texels, self.seen(on_cube * Vec3::new(1.0, 1.0, -1.0)));
            }
        }
        texels
    }

    /// Albedo with which level ground looks as the panorama does, and what it has to emit besides.
    pub fn ground(&self) -> (Self, Self) {
        let facing = |row: usize, column: usize| self.direction(row, column).y.max(0.0) * self.area(row);
        let irradiance: Vec3 = self.pixels().zip(&self.radiance).map(|((row, column), radiance)| *radiance * facing(row, column)).sum();
        let albedo = |radiance: &Vec3| PI * *radiance / irradiance.max(Vec3::splat(1e-9));
        let emitted = |radiance: &Vec3| *radiance * (1.0 - ALBEDO_MOST / albedo(radiance).max(Vec3::splat(1e-9))).max(Vec3::ZERO);
        let with = |of: &dyn Fn(&Vec3) -> Vec3| Self { radiance: self.radiance.iter().map(of).collect(), ..*self };
        (with(&|radiance| albedo(radiance).min(Vec3::splat(ALBEDO_MOST))), with(&emitted))
    }

    /// Half floats with an alpha of 1.
    pub fn texels(&self) -> Vec<u8> {
        let mut texels = Vec::with_capacity(self.radiance.len() * 8);
        self.radiance.iter().for_each(|radiance| push(&mut texels, *radiance));
        texels
    }
}

fn push(texels: &mut Vec<u8>, colour: Vec3) {
    for value in colour.to_array().into_iter().chain([1.0]) {
        texels.extend(f16::from_f32(value.clamp(0.0, 65_000.0)).to_le_bytes());
    }
}
