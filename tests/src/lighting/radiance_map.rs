//! The true radiance of a panorama, and what is found in a folder of them.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use glam::{Vec2, Vec3};
use mr360_server::frame::Pixels;
use mr360_server::image_file;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};

/// BT.709 luminance of linear radiance.
pub(super) const LUMA: Vec3 = Vec3::new(0.2126, 0.7152, 0.0722);

/// Which half of a folder a panorama belongs to. Methods may be tuned on one half only; the other one judges them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Half {
    /// Even places of the alphabetical order, counted from 0.
    Tune,
    /// Odd places.
    HeldOut,
}

impl Half {
    /// Both.
    pub(super) const ALL: [Self; 2] = [Self::Tune, Self::HeldOut];

    /// The split rule: files in alphabetical order, even places to tune on, odd places held out.
    pub(super) fn of_place(place: usize) -> Self {
        if place.is_multiple_of(2) { Self::Tune } else { Self::HeldOut }
    }

    /// As tables and CSV call it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Tune => "tune",
            Self::HeldOut => "held out",
        }
    }
}

/// The .exr and .hdr files of a folder in alphabetical order.
///
/// # Errors
/// When the folder cannot be read or holds none.
pub(super) fn find(folder: &Path) -> Result<Vec<PathBuf>> {
    let remedy = "give a folder of .exr or .hdr panoramas with --panoramas, or run deploy/fetch-media, which fetches some";
    let entries = fs::read_dir(folder).with_context(|| format!("panoramas {}: cannot be read; {remedy}", folder.display()))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.with_context(|| format!("panoramas {}", folder.display()))?.path();
        let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
        if ["exr", "hdr"].iter().any(|known| extension.eq_ignore_ascii_case(known)) {
            files.push(path);
        }
    }
    ensure!(!files.is_empty(), "panoramas {}: no .exr or .hdr file; {remedy}", folder.display());
    files.sort_unstable();
    Ok(files)
}

/// Linear BT.709 radiance over the whole sphere, equirect, row by row from the top. Finite, nowhere negative.
#[derive(Debug, Clone)]
pub(super) struct RadianceMap {
    /// Columns.
    pub(super) width: usize,
    /// Rows, half as many.
    pub(super) height: usize,
    texels: Vec<Vec3>,
}

impl RadianceMap {
    /// Loads an HDR file. Negative and non-finite values, which compression leaves around lamps, become 0.
    ///
    /// # Errors
    /// When it cannot be read, is not linear, or is not twice as wide as high.
    pub(super) fn load(path: &Path) -> Result<Self> {
        let Pixels::Rgb { width, height, texels, transfer } = image_file::load(path)?.pixels else {
            bail!("{}: not a picture", path.display());
        };
        ensure!(
            transfer == mr360_protocol::video::Transfer::Linear,
            "{}: not linear radiance; give OpenEXR or Radiance HDR files",
            path.display()
        );
        ensure!(
            width == 2 * height && height > 1,
            "{}: {width}×{height} is no equirect panorama; it must be twice as wide as high",
            path.display()
        );
        let mend = |v: f32| if v.is_finite() && v > 0.0 { v } else { 0.0 };
        let texels: Vec<Vec3> = texels.into_iter().map(|texel| Vec3::from_array(texel.map(mend))).collect();
        ensure!(texels.iter().any(|texel| *texel != Vec3::ZERO), "{}: black all over", path.display());
        Ok(Self { width: width as usize, height: height as usize, texels })
    }

    /// A panorama of `height` rows whose pixels hold `radiance` of the direction of their centres.
    pub(super) fn of(height: usize, radiance: impl Fn(Vec3) -> Vec3) -> Self {
        let mut map = Self { width: 2 * height, height, texels: Vec::new() };
        map.texels = (0..2 * height * height).map(|at| radiance(map.direction(at % (2 * height), at / (2 * height)))).collect();
        map
    }

    /// Another panorama of the same size.
    pub(super) fn with_texels(&self, texels: Vec<Vec3>) -> Self {
        Self { texels, ..*self }
    }

    /// Radiance, row by row.
    pub(super) fn texels(&self) -> &[Vec3] {
        &self.texels
    }

    /// Rows from the top.
    pub(super) fn rows(&self) -> impl Iterator<Item = &[Vec3]> {
        self.texels.chunks_exact(self.width)
    }

    /// Direction of a pixel's centre.
    pub(super) fn direction(&self, column: usize, row: usize) -> Vec3 {
        direction_from_uv(Vec2::new((column as f32 + 0.5) / self.width as f32, (row as f32 + 0.5) / self.height as f32))
    }

    /// Solid angle of each pixel of a row.
    pub(super) fn solid_angle_sr(&self, row: usize) -> f64 {
        f64::from(pixel_solid_angle_sr(row as u32, self.width as u32, self.height as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_taken_in_alphabetical_order_and_split_by_place() {
        let folder = tempfile::tempdir().unwrap();
        let error = find(folder.path()).unwrap_err().to_string();
        assert!(error.contains("no .exr") && error.contains("deploy/fetch-media") && error.contains("--panoramas"), "{error}");
        for name in ["c.exr", "a.HDR", "b.exr", "a.png", "SHA256SUMS"] {
            fs::write(folder.path().join(name), "").unwrap();
        }
        let names: Vec<_> = find(folder.path()).unwrap().iter().map(|path| path.file_name().unwrap().to_owned()).collect();
        assert_eq!(names, ["a.HDR", "b.exr", "c.exr"]);
        assert_eq!([0, 1, 2].map(Half::of_place), [Half::Tune, Half::HeldOut, Half::Tune]);
        let missing = format!("{:#}", find(&folder.path().join("none")).unwrap_err());
        assert!(missing.contains("none") && missing.contains("deploy/fetch-media"), "{missing}");
    }

    #[test]
    fn files_that_are_no_hdr_panorama_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let save = |name: &str, width, height, value| {
            let path = folder.path().join(name);
            image::Rgb32FImage::from_pixel(width, height, image::Rgb([value, -1.0, f32::NAN])).save(&path).unwrap();
            path
        };
        let map = RadianceMap::load(&save("whole.exr", 8, 4, 2.0)).unwrap();
        assert_eq!((map.width, map.height, map.texels()[5]), (8, 4, Vec3::new(2.0, 0.0, 0.0)));
        assert!(RadianceMap::load(&save("square.exr", 8, 8, 2.0)).unwrap_err().to_string().contains("twice as wide"));
        assert!(RadianceMap::load(&save("black.exr", 8, 4, 0.0)).unwrap_err().to_string().contains("black"));
        let png = folder.path().join("ldr.exr");
        image::RgbImage::new(8, 4).save_with_format(&png, image::ImageFormat::Png).unwrap();
        assert!(RadianceMap::load(&png).unwrap_err().to_string().contains("not linear"));
    }
}
