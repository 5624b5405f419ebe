//! What is known about a frame because it was made here.

use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};
use serde::Serialize;

use super::frame::Touched;
use super::geometry::Shape;
use super::movers::Figure;
use super::place::{GROUND_Y, Material, Place};
use super::still::Still;
use super::surface::PAVING_MEAN;

/// The truth about one frame. Directions, metres and linear BT.709 as everywhere; display white is 1.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlazaTruth {
    /// The frame.
    pub frame_index: u64,
    /// Its time since frame 0.
    pub time_secs: f64,
    /// Columns and rows.
    pub size: [u32; 2],
    /// The sun.
    pub sun: SunTruth,
    /// Irradiance of the sky alone, nothing in its way, on level ground: without the sun and its aureole.
    pub sky_irradiance_up: [f32; 3],
    /// Irradiance at the camera on six normals: +x, −x, +y, −y, +z, −z.
    pub irradiances: Vec<IrradianceTruth>,
    /// The ground.
    pub ground: GroundTruth,
    /// The people.
    pub movers: Vec<MoverTruth>,
    /// Everything that stands still; a crown of leaves is one sphere.
    pub geometry: Vec<GeometryTruth>,
}

/// The sun's disc as the camera sees it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SunTruth {
    /// Unit vector towards its centre.
    pub direction: [f32; 3],
    /// On a surface facing it, after clouds and whatever hides part of it.
    pub irradiance: [f32; 3],
    /// Of the whole disc.
    pub solid_angle_sr: f32,
    /// Part of the disc that the place does not hide, 0 to 1.
    pub visible_fraction: f32,
    /// Part of the light that clouds let through, 0 to 1.
    pub transmission: f32,
}

/// Irradiance on one normal.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IrradianceTruth {
    /// The surface's normal.
    pub normal: [f32; 3],
    /// From the sun's disc.
    pub sun: [f32; 3],
    /// From everything else: aureole, sky, place and people.
    pub ambient: [f32; 3],
    /// Both.
    pub total: [f32; 3],
}

/// The ground plane.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GroundTruth {
    /// Its height; the camera is at 0.
    pub y: f32,
    /// Mean albedo.
    pub albedo: [f32; 3],
    /// Distance from the camera within which nothing stands or walks on it, metres.
    pub free_radius: f32,
}

/// A run of pixels: row, first column, columns.
pub type Run = [u32; 3];

/// One walker.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MoverTruth {
    /// Stays the same in every frame.
    pub id: u32,
    /// On the ground below the hip.
    pub position: [f32; 3],
    /// Unit vector of walking.
    pub heading: [f32; 3],
    /// From the ground to the crown, metres.
    pub height: f32,
    /// Least and greatest corner of the body.
    pub bounds: [[f32; 3]; 2],
    /// Pixels in which the body shows.
    pub body_mask: Vec<Run>,
    /// Pixels that the mover darkens: its shadow, and the ambient light that it takes away near its feet.
    pub shadow_mask: Vec<Run>,
}

/// One primitive of the place.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GeometryTruth {
    /// What it is, such as `building`.
    pub name: &'static str,
    /// `box`, `sphere`, `capsule`, `cylinder` or `convex`.
    pub kind: &'static str,
    /// Centre of its bounds.
    pub position: [f32; 3],
    /// Extent of its bounds.
    pub size: [f32; 3],
}

/// Distance that walkers and things keep from the camera.
const FREE_RADIUS: f32 = 6.0;

/// The six normals.
pub(super) const NORMALS: [Vec3; 6] = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];

/// Irradiance of the still place on [`NORMALS`], without the disc: what stays and what scales with the sun.
pub(super) struct StillIrradiance {
    ambient: [DVec3; 6],
    sun: [DVec3; 6],
}

/// Adds a pixel's light to the irradiance on each normal.
fn add(sums: &mut [DVec3; 6], direction: Vec3, radiance: DVec3) {
    for (sum, normal) in sums.iter_mut().zip(NORMALS) {
        let facing = normal.dot(direction);
        if facing > 0.0 {
            *sum += radiance * f64::from(facing);
        }
    }
}

/// Mean of the direction over a pixel, times its solid angle, so that sums over pixels are exact for constant radiance.
fn pixel_vector(width: u32, height: u32, column: u32, row: u32) -> Vec3 {
    let latitude = |edge: u32| (0.5 - f64::from(edge) / f64::from(height)) * PI;
    let (top, bottom) = (latitude(row), latitude(row + 1));
    let longitude = ((f64::from(column) + 0.5) / f64::from(width) - 0.5) * TAU;
    let step = TAU / f64::from(width);
    // ∫cos² φ dφ and ∫sin φ cos φ dφ over the row; ∫cos λ dλ over the column.
    let level = 0.5 * (top - bottom) + 0.25 * ((2.0 * top).sin() - (2.0 * bottom).sin());
    let up = 0.5 * (top.sin().powi(2) - bottom.sin().powi(2));
    let across = 2.0 * (step * 0.5).sin();
    DVec3::new(level * across * longitude.sin(), up * step, -level * across * longitude.cos()).as_vec3()
}

impl StillIrradiance {
    pub(super) fn new(still: &Still) -> Self {
        let (mut ambient, mut sun) = ([DVec3::ZERO; 6], [DVec3::ZERO; 6]);
        let pixels = (0..still.height).flat_map(|row| (0..still.width).map(move |column| (column, row)));
        for ((column, row), texel) in pixels.zip(&still.texels) {
            let vector = pixel_vector(still.width, still.height, column, row);
            add(&mut ambient, vector, Vec3::from(texel.ambient).as_dvec3());
            add(&mut sun, vector, Vec3::from(texel.sun).as_dvec3());
        }
        for (pixel, radiance) in &still.disc {
            let vector = pixel_vector(still.width, still.height, pixel % still.width, pixel / still.width);
            add(&mut sun, vector, -radiance.as_dvec3());
        }
        Self { ambient, sun }
    }

    /// The six irradiances of a frame, the disc's by its closed form.
    pub(super) fn of_frame(&self, still: &Still, touched: &[Touched], sun: &SunTruth) -> Vec<IrradianceTruth> {
        let mut ambient: [DVec3; 6] = std::array::from_fn(|i| self.ambient[i] + self.sun[i] * f64::from(sun.transmission));
        for change in touched {
            let (column, row) = (change.pixel % still.width, change.pixel / still.width);
            let was = still.texels[change.pixel as usize].radiance(sun.transmission);
            add(&mut ambient, pixel_vector(still.width, still.height, column, row), (change.radiance - was).as_dvec3());
        }
        let irradiance = |(normal, ambient): (Vec3, DVec3)| {
            let direct = Vec3::from(sun.irradiance) * normal.dot(Vec3::from(sun.direction)).max(0.0);
            let ambient = ambient.as_vec3();
            IrradianceTruth {
                normal: normal.to_array(),
                sun: direct.to_array(),
                ambient: ambient.to_array(),
                total: (direct + ambient).to_array(),
            }
        };
        NORMALS.into_iter().zip(ambient).map(irradiance).collect()
    }
}

/// The ground's truth.
pub(super) fn ground() -> GroundTruth {
    GroundTruth { y: GROUND_Y, albedo: PAVING_MEAN.to_array(), free_radius: FREE_RADIUS }
}

/// Every primitive; the clumps of a crown are one `foliage` sphere.
pub(super) fn geometry(place: &Place) -> Vec<GeometryTruth> {
    let mut list: Vec<GeometryTruth> = Vec::new();
    for (i, (shape, name)) in place.shapes.iter().zip(&place.names).enumerate() {
        let (min, max) = shape.bounds();
        let kind = match shape {
            Shape::Box { .. } => "box",
            Shape::Sphere { .. } => "sphere",
            Shape::Capsule { .. } => "capsule",
            Shape::Cylinder { .. } => "cylinder",
            Shape::Convex { .. } => "convex",
        };
        let one = match place.material(i as u32) {
            Material::Foliage { crown, radius, .. } => {
                GeometryTruth { name: "foliage", kind: "sphere", position: crown.to_array(), size: [radius * 2.0; 3] }
            }
            _ => GeometryTruth { name, kind, position: ((min + max) * 0.5).to_array(), size: (max - min).to_array() },
        };
        // Clumps of one crown follow each other.
        if list.last() != Some(&one) {
            list.push(one);
        }
    }
    list
}

/// A walker's truth.
pub(super) fn mover(figure: &Figure, touched: &[Touched], width: u32) -> MoverTruth {
    let bit = 1u16 << figure.id;
    MoverTruth {
        id: figure.id,
        position: figure.position.to_array(),
        heading: figure.heading.to_array(),
        height: figure.height,
        bounds: [figure.bounds.0.to_array(), figure.bounds.1.to_array()],
        body_mask: runs(touched.iter().filter(|t| t.bodies & bit != 0), width),
        shadow_mask: runs(touched.iter().filter(|t| t.shadows & bit != 0), width),
    }
}

fn runs<'a>(pixels: impl Iterator<Item = &'a Touched>, width: u32) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for touched in pixels {
        let (row, column) = (touched.pixel / width, touched.pixel % width);
        match runs.last_mut() {
            Some([last, first, count]) if *last == row && *first + *count == column => *count += 1,
            _ => runs.push([row, column, 1]),
        }
    }
    runs
}
