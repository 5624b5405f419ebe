//! Sums over the cells of a panorama: what is clipped, and what the rest shows.

use glam::Vec3;
use mr360_shaders::colour::{CLIPPED, LUMA, clipped_degree, luminance};

use crate::lighting::panorama::Panorama;
use crate::lighting::sampling::Grid;

/// Most columns of cells: 2.8° at the horizon.
const COLUMNS: usize = 128;
/// The ground is what lies at least this far below the horizon, as the sine of the angle: nearer to it stand houses and trees.
const GROUND_SINE: f32 = 0.25;
/// Added to the ground's share of the light before its logarithm is taken: a ground so dark says no more than black.
const GROUND_FLOOR: f64 = 0.03;

/// Square cells of a panorama and what they hold.
pub(super) struct Cells {
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Texels along one side of a cell.
    pub(super) side: usize,
    /// Of one cell of each row.
    pub(super) solid_angle_sr: Vec<f32>,
    /// Of each row's middle.
    pub(super) latitude: Vec<f32>,
    /// Of the cells' middles.
    pub(super) directions: Vec<Vec3>,
    /// Degree to which each texel is clipped in all channels.
    pub(super) clipped: Vec<f32>,
    /// Share of the cell that is clipped in all channels.
    pub(super) clipped_share: Vec<f32>,
    /// Share of the cell that no channel is clipped in.
    pub(super) open_share: Vec<f32>,
    /// Mean over the cell of the luminance of what is not clipped.
    pub(super) shown: Vec<f32>,
    /// Energy of what is not clipped, radiance·sr.
    pub(super) open_rgb: [Vec<f32>; 3],
    /// Luminous flux of clipped channels as shown, luminance·sr.
    pub(super) clipped_flux: Vec<f32>,
    /// Solid angle with any clipped channel.
    pub(super) clipped_sr: f64,
    /// Luminous flux of the panorama as shown.
    pub(super) flux: f64,
    /// Luminous irradiance on level ground, and that of a ground as bright as this one if it were white.
    sky: f64,
    ground: f64,
    luminance: Vec<f32>,
}

/// What one row of texels adds to its cells.
struct Row<'a> {
    texels: [&'a [f32]; 3],
    solid_angle_sr: f32,
    side: usize,
}

impl Cells {
    pub(super) fn new(size: Grid) -> Self {
        let (width, height) = (size.width as usize, size.height as usize);
        let side = (width / COLUMNS).max(1);
        let (columns, rows) = (width / side, height / side);
        let latitude: Vec<f32> = (0..rows).map(|row| (0.5 - (row as f32 + 0.5) / rows as f32) * std::f32::consts::PI).collect();
        let solid_angle_sr = |row: usize| mr360_shaders::equirect::pixel_solid_angle_sr(row as u32, columns as u32, rows as u32);
        let direction = |cell: usize| {
            let uv = glam::Vec2::new(((cell % columns) as f32 + 0.5) / columns as f32, ((cell / columns) as f32 + 0.5) / rows as f32);
            mr360_shaders::equirect::direction_from_uv(uv)
        };
        let field = || vec![0.0; columns * rows];
        Self {
            columns,
            rows,
            side,
            solid_angle_sr: (0..rows).map(solid_angle_sr).collect(),
            latitude,
            directions: (0..columns * rows).map(direction).collect(),
            clipped: vec![0.0; width * height],
            clipped_share: field(),
            open_share: field(),
            shown: field(),
            open_rgb: std::array::from_fn(|_| field()),
            clipped_flux: field(),
            clipped_sr: 0.0,
            flux: 0.0,
            sky: 0.0,
            ground: 0.0,
            luminance: vec![0.0; width],
        }
    }

    /// How bright the ground is under what the sky shows, as a logarithm: ln(π·ground/sky) for a ground of that mean radiance.
    pub(super) fn ground_ln(&self) -> f32 {
        (self.ground / self.sky.max(1e-9) + GROUND_FLOOR).ln() as f32
    }

    /// Sums up a panorama of the size that the cells were made for.
    pub(super) fn take(&mut self, panorama: &Panorama) {
        for field in [&mut self.clipped_share, &mut self.shown, &mut self.clipped_flux].into_iter().chain(&mut self.open_rgb) {
            field.fill(0.0);
        }
        self.open_share.fill(1.0);
        (self.clipped_sr, self.flux, self.sky) = (0.0, 0.0, 0.0);
        let (mut ground, mut ground_weight) = (0.0, 0.0);
        let width = panorama.size.width as usize;
        for row in 0..panorama.size.height as usize {
            let sine = panorama.geometry.sin_cos_latitude[row].0;
            let solid_angle_sr = panorama.geometry.solid_angle_sr[row];
            let texels = [0, 1, 2].map(|channel| panorama.row(channel, row));
            let flux = f64::from(self.take_row(row, &Row { texels, solid_angle_sr, side: self.side })) * f64::from(solid_angle_sr);
            self.flux += flux;
            let weight = f64::from(sine.abs());
            if sine > 0.0 {
                self.sky += weight * flux;
            } else if sine < -GROUND_SINE {
                ground += weight * flux;
                ground_weight += weight * f64::from(solid_angle_sr) * width as f64;
            }
        }
        self.ground = if ground_weight > 0.0 { std::f64::consts::PI * ground / ground_weight } else { 0.0 };
        self.finish();
    }

    /// Adds a row to its cells and returns the sum of its luminance.
    fn take_row(&mut self, row: usize, from: &Row<'_>) -> f32 {
        let [red, green, blue] = from.texels;
        let width = red.len();
        let mut brightest = 0.0f32;
        for (((y, r), g), b) in self.luminance.iter_mut().zip(red).zip(green).zip(blue) {
            *y = LUMA.x * r + LUMA.y * g + LUMA.z * b;
            brightest = brightest.max(*r).max(*g).max(*b);
        }
        self.clipped[row * width..(row + 1) * width].fill(0.0);
        let first = row / from.side * self.columns;
        let cells = first..first + self.columns;
        for (shown, y) in self.shown[cells.clone()].iter_mut().zip(self.luminance.chunks_exact(from.side)) {
            *shown += y.iter().sum::<f32>() * from.solid_angle_sr;
        }
        for (open, texels) in self.open_rgb.iter_mut().zip(from.texels) {
            for (open, values) in open[cells.clone()].iter_mut().zip(texels.chunks_exact(from.side)) {
                *open += values.iter().sum::<f32>() * from.solid_angle_sr;
            }
        }
        if brightest > CLIPPED.0 {
            self.take_clipped(row, first, from);
        }
        self.luminance.iter().sum()
    }

    /// Corrects a row's cells for its clipped texels.
    fn take_clipped(&mut self, row: usize, first: usize, from: &Row<'_>) {
        let [red, green, blue] = from.texels;
        let omega = from.solid_angle_sr;
        for (column, ((r, g), b)) in red.iter().zip(green).zip(blue).enumerate() {
            let radiance = Vec3::new(*r, *g, *b);
            if radiance.max_element() <= CLIPPED.0 {
                continue;
            }
            let degree = clipped_degree(radiance);
            let (any, all) = (degree.max_element(), degree.min_element());
            let cell = first + column / from.side;
            self.clipped[row * red.len() + column] = all;
            self.clipped_share[cell] += omega * all;
            self.open_share[cell] -= omega * any / self.solid_angle_sr[cell / self.columns];
            self.shown[cell] -= omega * luminance(radiance) * any;
            self.clipped_flux[cell] += omega * luminance(radiance * degree);
            self.clipped_sr += f64::from(omega * any);
            for (open, value) in self.open_rgb.iter_mut().zip(radiance.to_array()) {
                open[cell] -= omega * value * any;
            }
        }
    }

    /// From sums to shares and means.
    fn finish(&mut self) {
        for (row, solid_angle_sr) in self.solid_angle_sr.iter().enumerate() {
            let cells = row * self.columns..(row + 1) * self.columns;
            for field in [&mut self.clipped_share, &mut self.shown] {
                field[cells.clone()].iter_mut().for_each(|sum| *sum /= solid_angle_sr);
            }
        }
    }
}
