//! A blur on the sphere, near enough to a Gaussian: two passes of a box whose width is an angle.

/// Blurs fields of one size.
pub(super) struct Blur {
    columns: usize,
    /// Of one cell of each row.
    solid_angle_sr: Vec<f32>,
    /// Of each row's middle.
    cos_latitude: Vec<f32>,
    pass: Vec<f32>,
    /// Running sums along one row, or of every column.
    sums: Vec<f32>,
}

impl Blur {
    /// For fields of rows of this many cells; solid angle of one cell of each row, and the rows' latitudes.
    pub(super) fn new(columns: usize, solid_angle_sr: &[f32], latitude: &[f32]) -> Self {
        Self {
            columns,
            solid_angle_sr: solid_angle_sr.to_vec(),
            cos_latitude: latitude.iter().map(|latitude| latitude.cos().max(1e-3)).collect(),
            pass: vec![0.0; columns * latitude.len()],
            sums: vec![0.0; 2 * columns + 1],
        }
    }

    /// Blurs `field` into `out` by a box that reaches this many degrees to either side, twice.
    pub(super) fn run(&mut self, field: &[f32], half_width_deg: f32, out: &mut [f32]) {
        let cells = (half_width_deg * self.columns as f32 / 360.0).round() as usize;
        out.copy_from_slice(field);
        for _ in 0..2 {
            self.along_rows(out, cells);
            self.along_columns(cells, out);
        }
    }

    /// Means over a box as wide in every row, wrapped around; a row that the box does not fit into is made even.
    fn along_rows(&mut self, field: &[f32], cells: usize) {
        let columns = self.columns;
        for (row, (values, out)) in field.chunks_exact(columns).zip(self.pass.chunks_exact_mut(columns)).enumerate() {
            let reach = (cells as f32 / self.cos_latitude[row]).round() as usize;
            let width = 2 * reach + 1;
            if width >= columns {
                out.fill(values.iter().sum::<f32>() / columns as f32);
                continue;
            }
            let mut sum = 0.0;
            self.sums[0] = sum;
            let wrapped = values[columns - reach..].iter().chain(values).chain(&values[..reach]);
            for (to, value) in self.sums[1..].iter_mut().zip(wrapped) {
                sum += value;
                *to = sum;
            }
            for ((out, from), to) in out.iter_mut().zip(&self.sums).zip(&self.sums[width..]) {
                *out = (to - from) / width as f32;
            }
        }
    }

    /// Means over a box down the columns, weighted by solid angle and cut at the poles.
    fn along_columns(&mut self, cells: usize, out: &mut [f32]) {
        let (columns, rows) = (self.columns, self.solid_angle_sr.len());
        let sums = &mut self.sums[..columns];
        sums.fill(0.0);
        let mut weight = 0.0;
        let mut add = |sums: &mut [f32], row: usize, sign: f32, pass: &[f32]| {
            let share = sign * self.solid_angle_sr[row];
            weight += share;
            sums.iter_mut().zip(&pass[row * columns..(row + 1) * columns]).for_each(|(sum, value)| *sum += share * value);
            weight
        };
        for row in 0..cells.min(rows) {
            add(sums, row, 1.0, &self.pass);
        }
        for row in 0..rows {
            let mut weight = 0.0;
            if row + cells < rows {
                weight = add(sums, row + cells, 1.0, &self.pass);
            }
            if row > cells {
                weight = add(sums, row - cells - 1, -1.0, &self.pass);
            }
            if weight == 0.0 {
                weight = self.solid_angle_sr[row.saturating_sub(cells)..(row + cells + 1).min(rows)].iter().sum();
            }
            let inverse = 1.0 / weight;
            for (out, sum) in out[row * columns..(row + 1) * columns].iter_mut().zip(sums.iter()) {
                *out = sum * inverse;
            }
        }
    }
}
