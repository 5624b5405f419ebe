//! Surfaces and textures of a model.

use std::borrow::Cow;

use base64::Engine as _;
use glam::Vec3;
use mr360_shaders::colour::{srgb_decode, srgb_encode};

use super::accessor::slice;
use super::model::ModelError;

/// Longest side of a texture, pixels.
pub const MAX_TEXTURE_SIDE: u32 = 4096;
/// Most images that a model may use.
pub const MAX_IMAGES: usize = 32;
/// Most pixels in all textures together, without their mips: eight of the largest. A few kilobytes of PNG can claim as many.
pub const MAX_TEXELS: u64 = 8 * MAX_TEXTURE_SIDE as u64 * MAX_TEXTURE_SIDE as u64;

/// Metallic-roughness of one part.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Linear BT.709.
    pub base_color: Vec3,
    /// Perceptual.
    pub roughness: f32,
    /// In [0, 1].
    pub metallic: f32,
    /// Clear, refracting.
    pub glass: bool,
    /// Seen from behind too.
    pub double_sided: bool,
    /// sRGB colour that multiplies `base_color`; index into the model's textures.
    pub base_color_texture: Option<usize>,
    /// Roughness in green, metallic in blue; index into the model's textures.
    pub metallic_roughness_texture: Option<usize>,
}

/// An image with all its mips, RGBA of 8 bits.
#[derive(Debug, Clone, PartialEq)]
pub struct Texture {
    /// Columns of the first level.
    pub width: u32,
    /// Rows of the first level.
    pub height: u32,
    /// Halved until 1 × 1.
    pub levels: Vec<Vec<u8>>,
    /// Holds colour, not data.
    pub srgb: bool,
    /// Mean of the first three channels, linear.
    pub mean: Vec3,
}

/// Reads materials and the images they use; asks for each image once for each way it is used.
pub(super) struct Materials<'a> {
    document: &'a gltf::Document,
    buffers: &'a [Cow<'a, [u8]>],
    pub(super) textures: Vec<Texture>,
    read: Vec<(usize, bool)>,
}

impl<'a> Materials<'a> {
    pub(super) fn new(document: &'a gltf::Document, buffers: &'a [Cow<'a, [u8]>]) -> Self {
        Self { document, buffers, textures: Vec::new(), read: Vec::new() }
    }

    pub(super) fn surface(&mut self, material: &gltf::Material<'_>) -> Result<Surface, ModelError> {
        let pbr = material.pbr_metallic_roughness();
        let [r, g, b, _] = pbr.base_color_factor();
        let values = [r, g, b, pbr.metallic_factor(), pbr.roughness_factor()];
        if !values.iter().all(|v| (0.0..=1.0).contains(v)) {
            return Err(ModelError::Material { index: material.index(), fault: format!("factors {values:?} are not all within 0..1") });
        }
        let mut texture = |info: Option<gltf::texture::Info<'_>>, srgb| match info {
            Some(info) if info.tex_coord() != 0 => Err(ModelError::Material {
                index: material.index(),
                fault: "uses a second set of texture coordinates; only TEXCOORD_0 is read".to_owned(),
            }),
            Some(info) => self.texture(info.texture().source().index(), srgb).map(Some),
            None => Ok(None),
        };
        Ok(Surface {
            base_color: Vec3::new(r, g, b),
            roughness: pbr.roughness_factor(),
            metallic: pbr.metallic_factor(),
            glass: material.transmission().is_some_and(|transmission| transmission.transmission_factor() > 0.5),
            double_sided: material.double_sided(),
            base_color_texture: texture(pbr.base_color_texture(), true)?,
            metallic_roughness_texture: texture(pbr.metallic_roughness_texture(), false)?,
        })
    }

    fn texture(&mut self, image: usize, srgb: bool) -> Result<usize, ModelError> {
        if let Some(at) = self.read.iter().position(|key| *key == (image, srgb)) {
            return Ok(at);
        }
        let fault = |fault: String| ModelError::Image { index: image, fault };
        if self.textures.len() >= MAX_IMAGES {
            return Err(fault(format!("more than {MAX_IMAGES} images are used")));
        }
        let taken: u64 = self.textures.iter().map(|texture| u64::from(texture.width) * u64::from(texture.height)).sum();
        let room = MAX_TEXELS.saturating_sub(taken);
        let source = self.document.images().nth(image).ok_or_else(|| fault("does not exist".to_owned()))?;
        let pixels = match source.source() {
            gltf::image::Source::View { view, .. } => {
                let bytes =
                    slice(&view, self.buffers).ok_or_else(|| fault(format!("buffer view {} lies outside of its buffer", view.index())))?;
                decode(bytes, room)
            }
            gltf::image::Source::Uri { uri, .. } => decode(&data_uri(uri).map_err(fault)?, room),
        };
        let (width, height, pixels) = pixels.map_err(fault)?;
        self.textures.push(with_mips(width, height, pixels, srgb));
        self.read.push((image, srgb));
        Ok(self.textures.len() - 1)
    }
}

/// The bytes of a `data:…;base64,…` URI.
pub(super) fn data_uri(uri: &str) -> Result<Vec<u8>, String> {
    let shown: String = uri.chars().take(60).collect();
    let rest = uri.strip_prefix("data:").ok_or_else(|| format!("lies in another file, {shown:?}; embed it, as a .glb does"))?;
    let (_, text) = rest.split_once(";base64,").ok_or_else(|| format!("has a data URI that is not base64: {shown:?}"))?;
    base64::engine::general_purpose::STANDARD.decode(text).map_err(|error| format!("has broken base64: {error}"))
}

/// Decodes a PNG or JPEG of at most `room` pixels; its size is known before anything is allocated for it.
fn decode(bytes: &[u8], room: u64) -> Result<(u32, u32, Vec<u8>), String> {
    let open = || image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format().map_err(|error| error.to_string());
    let reader = open()?;
    if !matches!(reader.format(), Some(image::ImageFormat::Png | image::ImageFormat::Jpeg)) {
        return Err("neither PNG nor JPEG".to_owned());
    }
    let (width, height) = reader.into_dimensions().map_err(|error| error.to_string())?;
    if width > MAX_TEXTURE_SIDE || height > MAX_TEXTURE_SIDE {
        return Err(format!("{width}×{height} pixels; at most {MAX_TEXTURE_SIDE} pixels on a side are read"));
    }
    if u64::from(width) * u64::from(height) > room {
        return Err(format!("brings the textures to more than {MAX_TEXELS} pixels; use smaller images"));
    }
    let mut reader = open()?;
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_TEXTURE_SIDE);
    limits.max_image_height = Some(MAX_TEXTURE_SIDE);
    reader.limits(limits);
    let pixels = reader.decode().map_err(|error| error.to_string())?.into_rgba8();
    Ok((pixels.width(), pixels.height(), pixels.into_raw()))
}

fn with_mips(width: u32, height: u32, pixels: Vec<u8>, srgb: bool) -> Texture {
    let to_linear: [f32; 256] = std::array::from_fn(|code| {
        let value = code as f32 / 255.0;
        if srgb { srgb_decode(value) } else { value }
    });
    let to_code = |value: f32| ((if srgb { srgb_encode(value) } else { value }) * 255.0 + 0.5) as u8;
    let mut levels = vec![pixels];
    let (mut w, mut h) = (width as usize, height as usize);
    while w > 1 || h > 1 {
        let Some(finer) = levels.last() else { break };
        let (next_w, next_h) = ((w / 2).max(1), (h / 2).max(1));
        let mut coarser = Vec::with_capacity(next_w * next_h * 4);
        for (y, x) in (0..next_h).flat_map(|y| (0..next_w).map(move |x| (y, x))) {
            let corner = |dy: usize, dx: usize| ((2 * y + dy).min(h - 1) * w + (2 * x + dx).min(w - 1)) * 4;
            let corners = [corner(0, 0), corner(0, 1), corner(1, 0), corner(1, 1)];
            for channel in 0..3 {
                coarser.push(to_code(corners.iter().map(|at| to_linear[usize::from(finer[at + channel])]).sum::<f32>() / 4.0));
            }
            coarser.push((corners.iter().map(|at| u32::from(finer[at + 3])).sum::<u32>() / 4) as u8);
        }
        levels.push(coarser);
        (w, h) = (next_w, next_h);
    }
    let last = levels.last().map_or([255; 4], |level| [0, 1, 2, 3].map(|i| level.get(i).copied().unwrap_or(255)));
    let mean = Vec3::from_array([0, 1, 2].map(|i| to_linear[usize::from(last[i])]));
    Texture { width, height, levels, srgb, mean }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_takes_no_more_than_the_room_that_is_left() {
        let mut png = std::io::Cursor::new(Vec::new());
        image::RgbImage::from_pixel(8, 4, image::Rgb([200, 0, 0])).write_to(&mut png, image::ImageFormat::Png).unwrap();
        let (width, height, texels) = decode(png.get_ref(), 32).unwrap();
        assert_eq!((width, height, texels.len()), (8, 4, 128));
        let error = decode(png.get_ref(), 31).unwrap_err();
        assert!(error.contains("more than") && error.contains("smaller images"), "{error}");
        let wide = image::GrayImage::new(MAX_TEXTURE_SIDE + 1, 1);
        let mut png = std::io::Cursor::new(Vec::new());
        wide.write_to(&mut png, image::ImageFormat::Png).unwrap();
        assert!(decode(png.get_ref(), MAX_TEXELS).unwrap_err().contains("4097×1"));
    }
}
