//! Sums over the cells of a panorama: what is clipped, and what the rest shows.

use mr360_shaders::colour::{CLIPPED, LUMA};
use pulp::{Arch, Simd, WithSimd};

use crate::lighting::luminance::{self, Part};
use crate::lighting::panorama::{Geometry, Rows};
use crate::lighting::radiance::Planes;
use crate::lighting::sampling::Grid;
use crate::lighting::vectors::{add_sides, arch_for_rows, load, store, vectors};

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
    /// Of the cells' middles, coordinate by coordinate.
    pub(super) directions: Planes,
    /// Degree to which each texel is clipped in all channels.
    pub(super) clipped: Vec<f32>,
    /// Luminance of each texel's clipped channels: as shown, until it is replaced by what is added to it.
    pub(super) lit: Vec<f32>,
    /// Whether any channel is clipped in a patch: one vector of texels wide and one cell high, rows after each other.
    pub(super) hot: Vec<bool>,
    /// Mean radiance.
    pub(super) radiance: Planes,
    /// Share of the cell that is clipped in all channels.
    pub(super) clipped_share: Vec<f32>,
    /// Share of the cell that no channel is clipped in.
    pub(super) open_share: Vec<f32>,
    /// Mean over the cell of the luminance of what is not clipped.
    pub(super) shown: Vec<f32>,
    /// Energy of what is not clipped, radiance·sr.
    pub(super) open_rgb: Planes,
    /// Luminous flux of clipped channels as shown, luminance·sr.
    pub(super) clipped_flux: Vec<f32>,
    /// Solid angle with any clipped channel.
    pub(super) clipped_sr: f64,
    /// Luminous flux of the panorama as shown.
    pub(super) flux: f64,
    /// Luminous irradiance on level ground, and that of a ground as bright as this one if it were white.
    sky: f64,
    ground: f64,
    /// What the ground's would be if its radiance were 1.
    ground_weight: f64,
    /// Weight of each row of texels in that of its hemisphere: solid angle of a texel times the sine of its distance from the horizon, and
    /// nothing between horizon and ground.
    levels: Vec<f32>,
    sums: Sums,
    arch: Arch,
}

/// Sums over the texels of one row of cells, one a column of texels.
struct Sums {
    open_rgb: Planes,
    brightest: Vec<f32>,
    /// Solid angle that is clipped in all channels, and in any.
    all: Vec<f32>,
    any: Vec<f32>,
    clipped_flux: Vec<f32>,
}

impl Cells {
    /// For panoramas of this size, whose width is a power of two from 8 on: whole vectors make a row.
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
        let geometry = Geometry::new(size);
        let level =
            |((sine, _), texel_sr): (&(f32, f32), &f32)| if *sine > 0.0 || *sine < -GROUND_SINE { sine.abs() * texel_sr } else { 0.0 };
        let levels: Vec<f32> = geometry.sin_cos_latitude.iter().zip(&geometry.solid_angle_sr).map(level).collect();
        let field = || vec![0.0; columns * rows];
        let sums = || vec![0.0; width];
        Self {
            columns,
            rows,
            side,
            solid_angle_sr: (0..rows).map(solid_angle_sr).collect(),
            latitude,
            directions: std::array::from_fn(|axis| (0..columns * rows).map(|cell| direction(cell)[axis]).collect()),
            clipped: vec![0.0; width * height],
            lit: vec![0.0; width * height],
            // As many as there are patches of a single texel: how wide vectors are is not known here.
            hot: vec![false; width * rows],
            radiance: std::array::from_fn(|_| field()),
            clipped_share: field(),
            open_share: field(),
            shown: field(),
            open_rgb: std::array::from_fn(|_| field()),
            clipped_flux: field(),
            clipped_sr: 0.0,
            flux: 0.0,
            sky: 0.0,
            ground: 0.0,
            ground_weight: levels[height / 2..].iter().map(|level| f64::from(*level)).sum::<f64>() * width as f64,
            levels,
            sums: Sums { open_rgb: std::array::from_fn(|_| sums()), brightest: sums(), all: sums(), any: sums(), clipped_flux: sums() },
            arch: arch_for_rows(width),
        }
    }

    /// How bright the ground is under what the sky shows, as a logarithm: ln(π·ground/sky) for a ground of that mean radiance.
    pub(super) fn ground_ln(&self) -> f32 {
        let ground = if self.ground_weight > 0.0 { std::f64::consts::PI * self.ground / self.ground_weight } else { 0.0 };
        (ground / self.sky.max(1e-9) + GROUND_FLOOR).ln() as f32
    }

    /// Begins a panorama.
    pub(super) fn begin(&mut self) {
        (self.clipped_sr, self.flux, self.sky, self.ground) = (0.0, 0.0, 0.0, 0.0);
    }

    /// Takes in the texels of one row of cells, in a panorama of the size that the cells were made for, and writes their luminance where there is
    /// room for it: in the upper hemisphere.
    pub(super) fn take(&mut self, rows: &Rows<'_>, luminance: Option<Part<'_>>) {
        self.arch.dispatch(Take { cells: self, rows, luminance });
    }
}

/// [`Cells::take`] for whatever vectors there are.
struct Take<'a, 'b> {
    cells: &'a mut Cells,
    rows: &'a Rows<'b>,
    luminance: Option<Part<'a>>,
}

impl WithSimd for Take<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let row = self.rows.first / self.cells.side;
        match self.luminance.take() {
            Some(part) => self.add_texels::<S, true>(simd, part.texels, part.sums),
            None => self.add_texels::<S, false>(simd, &mut [], &mut luminance::Sums::default()),
        }
        self.average(row);
        let any = self.correct_clipped(simd, row);
        self.finish(row, any);
    }
}

impl Take<'_, '_> {
    /// Sums the texels up as if nothing were clipped; `UPPER` ones leave their luminance and its sums.
    #[inline(always)]
    fn add_texels<S: Simd, const UPPER: bool>(&mut self, simd: S, texels: &mut [f32], of_luminance: &mut luminance::Sums) {
        let Rows { geometry, first, count, .. } = *self.rows;
        let Sums { open_rgb: [reds, greens, blues], brightest, .. } = &mut self.cells.sums;
        let (texels_sr, levels) = (&geometry.solid_angle_sr[first..first + count], &self.cells.levels[first..first + count]);
        let (r, g, b) = (self.rows.channel(0), self.rows.channel(1), self.rows.channel(2));
        let (r, g, b) = (S::as_simd_f32s(r).0, S::as_simd_f32s(g).0, S::as_simd_f32s(b).0);
        let texels = S::as_mut_simd_f32s(texels).0;
        let zero = simd.splat_f32s(0.0);
        let (mut energy, mut level, mut squares, mut peak) = (zero, zero, zero, zero);
        let in_row = vectors::<S>(brightest.len());
        for vector in 0..in_row {
            let (mut red, mut green, mut blue, mut most) = (zero, zero, zero, zero);
            for (row, (texel_sr, level_sr)) in texels_sr.iter().zip(levels).enumerate() {
                let at = row * in_row + vector;
                let (r, g, b, texel_sr) = (r[at], g[at], b[at], simd.splat_f32s(*texel_sr));
                red = simd.add_f32s(red, simd.mul_f32s(r, texel_sr));
                green = simd.add_f32s(green, simd.mul_f32s(g, texel_sr));
                blue = simd.add_f32s(blue, simd.mul_f32s(b, texel_sr));
                most = simd.max_f32s(most, simd.max_f32s(simd.max_f32s(r, g), b));
                let luminance = luminance::of(simd, r, g, b);
                let flux = simd.mul_f32s(luminance, texel_sr);
                energy = simd.add_f32s(energy, flux);
                level = simd.add_f32s(level, simd.mul_f32s(luminance, simd.splat_f32s(*level_sr)));
                if UPPER {
                    squares = simd.add_f32s(squares, simd.mul_f32s(flux, luminance));
                    peak = simd.max_f32s(peak, luminance);
                    texels[at] = luminance;
                }
            }
            store(simd, reds, vector, red);
            store(simd, greens, vector, green);
            store(simd, blues, vector, blue);
            store(simd, brightest, vector, most);
        }
        let (energy, level) = (f64::from(simd.reduce_sum_f32s(energy)), f64::from(simd.reduce_sum_f32s(level)));
        self.cells.flux += energy;
        *(if UPPER { &mut self.cells.sky } else { &mut self.cells.ground }) += level;
        if UPPER {
            *of_luminance = luminance::Sums { energy, squares: f64::from(simd.reduce_sum_f32s(squares)), peak: simd.reduce_max_f32s(peak) };
        }
    }

    /// From the sums over a row of cells to its energy, all of it open so far, and its mean radiance.
    #[inline(always)]
    fn average(&mut self, row: usize) {
        let Cells { columns, side, solid_angle_sr, radiance, open_rgb, sums, .. } = &mut *self.cells;
        let (share, cells) = (1.0 / solid_angle_sr[row], row * *columns..(row + 1) * *columns);
        for ((radiance, open), sums) in radiance.iter_mut().zip(open_rgb).zip(&sums.open_rgb) {
            let open = &mut open[cells.clone()];
            add_sides(sums, *side, open);
            for (radiance, open) in radiance[cells.clone()].iter_mut().zip(open) {
                *radiance = *open * share;
            }
        }
    }

    /// Corrects the sums over a row of cells for its clipped texels; returns whether there are any.
    #[inline(always)]
    fn correct_clipped<S: Simd>(&mut self, simd: S, row: usize) -> bool {
        let width = self.cells.sums.brightest.len();
        let side = self.cells.side;
        let mut found = false;
        for patch in 0..vectors::<S>(width) {
            let hot = simd.reduce_max_f32s(load(simd, &self.cells.sums.brightest, patch)) > CLIPPED.0;
            let was_hot = std::mem::replace(&mut self.cells.hot[row * width + patch], hot);
            if hot && !found {
                found = true;
                let Sums { all, any, clipped_flux, .. } = &mut self.cells.sums;
                [all, any, clipped_flux].into_iter().for_each(|sums| sums.fill(0.0));
            }
            if hot {
                self.correct_patch(simd, row, patch);
            } else if was_hot {
                for texel_row in row * side..(row + 1) * side {
                    let texels = texel_row * width..(texel_row + 1) * width;
                    store(simd, &mut self.cells.clipped[texels.clone()], patch, simd.splat_f32s(0.0));
                    store(simd, &mut self.cells.lit[texels], patch, simd.splat_f32s(0.0));
                }
            }
        }
        found
    }

    /// Corrects the sums over one patch. Nothing but plain loops: a closure that is not inlined knows no vectors, and calls every operation.
    #[inline(always)]
    fn correct_patch<S: Simd>(&mut self, simd: S, row: usize, patch: usize) {
        let Cells { side, clipped, lit, sums, .. } = &mut *self.cells;
        let width = sums.brightest.len();
        let zero = simd.splat_f32s(0.0);
        let (mut all_sr, mut any_sr, mut flux) = (zero, zero, zero);
        let mut open = [load(simd, &sums.open_rgb[0], patch), load(simd, &sums.open_rgb[1], patch), load(simd, &sums.open_rgb[2], patch)];
        for texel_row in row * *side..(row + 1) * *side {
            let texels = texel_row * width..(texel_row + 1) * width;
            let solid_angle_sr = simd.splat_f32s(self.rows.geometry.solid_angle_sr[texel_row]);
            let (mut radiance, mut degree, mut luminance) = ([zero; 3], [zero; 3], zero);
            for channel in 0..3 {
                radiance[channel] = load(simd, self.rows.row(channel, texel_row), patch);
                degree[channel] = clipped_degree(simd, radiance[channel]);
                let shown = simd.mul_f32s(radiance[channel], degree[channel]);
                luminance = simd.add_f32s(luminance, simd.mul_f32s(shown, simd.splat_f32s(LUMA.to_array()[channel])));
            }
            let all = simd.min_f32s(simd.min_f32s(degree[0], degree[1]), degree[2]);
            let any = simd.mul_f32s(simd.max_f32s(simd.max_f32s(degree[0], degree[1]), degree[2]), solid_angle_sr);
            for channel in 0..3 {
                open[channel] = simd.sub_f32s(open[channel], simd.mul_f32s(radiance[channel], any));
            }
            store(simd, &mut clipped[texels.clone()], patch, all);
            store(simd, &mut lit[texels], patch, luminance);
            all_sr = simd.add_f32s(all_sr, simd.mul_f32s(all, solid_angle_sr));
            any_sr = simd.add_f32s(any_sr, any);
            flux = simd.add_f32s(flux, simd.mul_f32s(luminance, solid_angle_sr));
        }
        for (sums, open) in sums.open_rgb.iter_mut().zip(open) {
            store(simd, sums, patch, open);
        }
        store(simd, &mut sums.all, patch, all_sr);
        store(simd, &mut sums.any, patch, any_sr);
        store(simd, &mut sums.clipped_flux, patch, flux);
    }

    /// From the sums over a row of cells to its shares and means; `any` says whether any of it is clipped.
    #[inline(always)]
    fn finish(&mut self, row: usize, any: bool) {
        let share = 1.0 / self.cells.solid_angle_sr[row];
        let Cells { columns, side, clipped_share, open_share, shown, open_rgb, clipped_flux, sums, clipped_sr, .. } = &mut *self.cells;
        let cells = row * *columns..(row + 1) * *columns;
        let [red, green, blue] = open_rgb;
        let (red, green, blue) = (&mut red[cells.clone()], &mut green[cells.clone()], &mut blue[cells.clone()]);
        let (clipped_share, open_share) = (&mut clipped_share[cells.clone()], &mut open_share[cells.clone()]);
        let (shown, clipped_flux) = (&mut shown[cells.clone()], &mut clipped_flux[cells]);
        if any {
            for (open, sums) in [&mut *red, &mut *green, &mut *blue].into_iter().zip(&sums.open_rgb) {
                add_sides(sums, *side, open);
            }
        }
        for (((shown, r), g), b) in shown.iter_mut().zip(red).zip(green).zip(blue) {
            *shown = share * (LUMA.x * *r + LUMA.y * *g + LUMA.z * *b);
        }
        if !any {
            clipped_share.fill(0.0);
            open_share.fill(1.0);
            clipped_flux.fill(0.0);
            return;
        }
        add_sides(&sums.all, *side, clipped_share);
        add_sides(&sums.any, *side, open_share);
        add_sides(&sums.clipped_flux, *side, clipped_flux);
        let mut of_row = 0.0;
        for (clipped, open) in clipped_share.iter_mut().zip(open_share) {
            of_row += f64::from(*open);
            *clipped *= share;
            *open = 1.0 - share * *open;
        }
        *clipped_sr += of_row;
    }
}

/// [`mr360_shaders::colour::clipped_degree`] of several texels of one channel.
#[inline(always)]
fn clipped_degree<S: Simd>(simd: S, linear: S::f32s) -> S::f32s {
    let (first, last) = CLIPPED;
    let t = simd.mul_f32s(simd.sub_f32s(linear, simd.splat_f32s(first)), simd.splat_f32s(1.0 / (last - first)));
    let t = simd.min_f32s(simd.max_f32s(t, simd.splat_f32s(0.0)), simd.splat_f32s(1.0));
    simd.mul_f32s(simd.mul_f32s(t, t), simd.sub_f32s(simd.splat_f32s(3.0), simd.add_f32s(t, t)))
}
