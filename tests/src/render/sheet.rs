//! Pictures side by side under a colour map for differences.

use anyhow::{Context, Result};
use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};
use std::path::Path;

/// Gap between pictures, pixels.
const GAP: u32 = 4;
/// Points of the colour map "magma" of Matplotlib, evenly spaced from 0 to 1.
const MAGMA: [[u8; 3]; 9] = [
    [0, 0, 4],
    [28, 16, 68],
    [79, 18, 123],
    [129, 37, 129],
    [181, 54, 122],
    [229, 80, 100],
    [251, 135, 97],
    [254, 194, 135],
    [252, 253, 191],
];

/// A value from 0 to 1 as colour.
fn magma(value: f64) -> Rgb<u8> {
    let at = value.clamp(0.0, 1.0) * (MAGMA.len() - 1) as f64;
    let low = (at as usize).min(MAGMA.len() - 2);
    let share = at - low as f64;
    let mixed = |channel: usize| f64::from(MAGMA[low][channel]) * (1.0 - share) + f64::from(MAGMA[low + 1][channel]) * share;
    Rgb([0, 1, 2].map(|channel| mixed(channel).round() as u8))
}

/// One value a pixel from 0 to 1, as colours from black to pale yellow.
pub(super) fn coloured(values: &[f64], width: u32) -> RgbImage {
    let height = values.len() as u32 / width.max(1);
    RgbImage::from_fn(width, height, |x, y| magma(values.get((y * width + x) as usize).copied().unwrap_or_default()))
}

/// Rows of pictures, each scaled to `tile` columns and rows, on white.
pub(super) fn sheet(rows: &[Vec<RgbImage>], tile: (u32, u32)) -> RgbImage {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let place = |count: u32, side: u32| count * (side + GAP);
    let mut made = RgbImage::from_pixel((place(columns, tile.0)).max(1), place(rows.len() as u32, tile.1).max(1), Rgb([255; 3]));
    for (down, row) in rows.iter().enumerate() {
        for (across, picture) in row.iter().enumerate() {
            let scaled = imageops::resize(picture, tile.0, tile.1, FilterType::Triangle);
            let (x, y) = (place(across as u32, tile.0), place(down as u32, tile.1));
            imageops::replace(&mut made, &scaled, i64::from(x), i64::from(y));
        }
    }
    made
}

/// Writes a sheet in the format that its name says.
///
/// # Errors
/// When it cannot be written.
pub(super) fn save(folder: &Path, name: &str, sheet: &RgbImage) -> Result<()> {
    let path = folder.join(name);
    sheet.save(&path).with_context(|| format!("{}: cannot be written", path.display()))?;
    eprintln!("wrote {}", path.display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_lie_in_rows_and_differences_have_the_maps_colours() {
        let difference = coloured(&[0.0, 1.0, 0.5, 7.0], 2);
        let at = |x, y| difference.get_pixel(x, y).0;
        assert_eq!([at(0, 0), at(1, 0), at(0, 1), at(1, 1)], [MAGMA[0], MAGMA[8], MAGMA[4], MAGMA[8]]);
        let red = RgbImage::from_pixel(8, 8, Rgb([255, 0, 0]));
        let made = sheet(&[vec![red.clone()], vec![red.clone(), red]], (16, 8));
        assert_eq!(made.dimensions(), (2 * (16 + GAP), 2 * (8 + GAP)));
        assert_eq!(made.get_pixel(16 + GAP, 8 + GAP).0, [255, 0, 0]);
        assert_eq!(made.get_pixel(16 + GAP, 0).0, [255; 3]);
    }
}
