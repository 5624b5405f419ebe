//! Deterministic procedural noise, the same on every machine and thread.

use glam::{Vec2, Vec3};

/// Mixes a lattice point into 32 well-spread bits (finaliser of MurmurHash3).
pub(super) fn hash3(x: i32, y: i32, z: i32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ (z as u32).wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85EB_CA6B);
    h ^= h >> 13;
    h = h.wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// A value in [0, 1) for a lattice point.
pub(super) fn unit3(x: i32, y: i32, z: i32) -> f32 {
    (hash3(x, y, z) >> 8) as f32 / 16_777_216.0
}

/// Smooth step from 0 at `from` to 1 at `to`.
pub(super) fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Value noise in [0, 1] with features of size one.
pub(super) fn value2(p: Vec2, seed: i32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let w = f * f * (Vec2::splat(3.0) - 2.0 * f);
    let (i, j) = (cell.x as i32, cell.y as i32);
    let top = unit3(i, j, seed) * (1.0 - w.x) + unit3(i + 1, j, seed) * w.x;
    let bottom = unit3(i, j + 1, seed) * (1.0 - w.x) + unit3(i + 1, j + 1, seed) * w.x;
    top * (1.0 - w.y) + bottom * w.y
}

/// Sum of octaves of [`value2`], about [0, 1].
pub(super) fn fbm2(p: Vec2, octaves: i32, seed: i32) -> f32 {
    let mut sum = 0.0;
    let mut weight = 0.5;
    let mut q = p;
    for octave in 0..octaves {
        sum += weight * value2(q, seed + octave);
        weight *= 0.5;
        // Turned between octaves so that the lattice does not show.
        q = Vec2::new(1.6 * q.x - 1.2 * q.y, 1.2 * q.x + 1.6 * q.y);
    }
    sum
}

/// Value noise in three dimensions, in [0, 1].
pub(super) fn value3(p: Vec3, seed: i32) -> f32 {
    let cell = p.z.floor();
    let f = p.z - cell;
    let w = f * f * (3.0 - 2.0 * f);
    let layer = cell as i32;
    let plane = Vec2::new(p.x, p.y);
    value2(plane, seed ^ layer.wrapping_mul(7919)) * (1.0 - w) + value2(plane, seed ^ (layer + 1).wrapping_mul(7919)) * w
}
