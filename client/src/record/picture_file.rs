//! Picture files that appear under their name only when they are whole.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageFormat};

use super::RecordError;

/// A picture that is still to come, opened under a temporary name in its place: what cannot be written is known before anything is drawn,
/// and a run that fails leaves what stood there before.
#[derive(Debug)]
pub struct PictureFile {
    path: PathBuf,
    part: PathBuf,
    file: File,
    format: ImageFormat,
}

impl PictureFile {
    /// Creates the temporary file.
    ///
    /// # Errors
    /// [`RecordError::Picture`] when there can be no such file.
    pub fn create(path: &Path, format: ImageFormat) -> Result<Self, RecordError> {
        let name = path.file_name().filter(|_| !path.is_dir()).ok_or_else(|| failure(path, &"not a file name"))?;
        let mut part = name.to_owned();
        part.push(".part");
        let part = path.with_file_name(part);
        let file = File::create(&part).map_err(|error| failure(path, &error))?;
        Ok(Self { path: path.to_owned(), part, file, format })
    }

    /// Writes the picture and gives it its name.
    ///
    /// # Errors
    /// [`RecordError::Picture`] when the disk is full, or the format does not hold such pixels.
    pub fn write(self, picture: &DynamicImage) -> Result<(), RecordError> {
        let mut out = BufWriter::new(&self.file);
        picture.write_to(&mut out, self.format).map_err(|error| failure(&self.path, &error))?;
        out.flush().and_then(|()| std::fs::rename(&self.part, &self.path)).map_err(|error| failure(&self.path, &error))
    }
}

impl Drop for PictureFile {
    fn drop(&mut self) {
        // Gone by now when the picture was written; otherwise what is left of it would only confuse.
        let _ = std::fs::remove_file(&self.part);
    }
}

fn failure(path: &Path, detail: &dyn std::fmt::Display) -> RecordError {
    RecordError::Picture { path: path.display().to_string(), detail: detail.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_written_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.png");
        let grey = |value| DynamicImage::from(image::RgbaImage::from_pixel(3, 2, image::Rgba([value, value, value, 255])));
        let names = || {
            let entries = std::fs::read_dir(folder.path()).unwrap();
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect::<Vec<_>>()
        };
        PictureFile::create(&path, ImageFormat::Png).unwrap().write(&grey(77)).unwrap();
        assert_eq!(image::open(&path).unwrap(), grey(77));
        // A run that ends early does not touch what was there.
        drop(PictureFile::create(&path, ImageFormat::Png).unwrap());
        assert_eq!(image::open(&path).unwrap(), grey(77));
        assert_eq!(names(), ["out.png"]);
        // What comes into its place meanwhile is told of, and nothing half-written stays.
        let late = PictureFile::create(&folder.path().join("late.png"), ImageFormat::Png).unwrap();
        std::fs::create_dir(folder.path().join("late.png")).unwrap();
        assert!(matches!(late.write(&grey(99)), Err(RecordError::Picture { .. })));
        std::fs::remove_dir(folder.path().join("late.png")).unwrap();
        assert_eq!(names(), ["out.png"]);
        for wrong in [folder.path().join("no/out.png"), folder.path().to_owned(), "..".into()] {
            assert!(matches!(PictureFile::create(&wrong, ImageFormat::Png), Err(RecordError::Picture { .. })), "{wrong:?}");
        }
    }
}
