//! Images of a model with their mips, and how they are sampled.

use base64::Engine as _;
use glam::Vec3;
use mr360_shaders::colour::{srgb_decode, srgb_encode};

/// Longest side of a texture, pixels.
pub const MAX_TEXTURE_SIDE: u32 = 4096;
/// Most images that a model may use.
pub const MAX_IMAGES: usize = 32;
/// Most pixels in all textures together, without their mips: eight of the largest. A few kilobytes of PNG can claim as many.
pub const MAX_TEXELS: u64 = 8 * MAX_TEXTURE_SIDE as u64 * MAX_TEXTURE_SIDE as u64;

/// What an image holds, which decides how it is averaged and decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    /// sRGB colour.
    Colour,
    /// Numbers.
    Data,
    /// Directions in tangent space. Alpha is replaced by [`widening`].
    Normals,
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
    /// What it holds.
    pub content: Content,
    /// Mean of the first three channels, linear.
    pub mean: Vec3,
}

/// What lies beyond an edge of a texture (glTF 2.0, Sec. 5.26).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Wrap {
    /// The texture again.
    #[default]
    Repeat,
    /// The texture turned over.
    Mirror,
    /// Its edge.
    Clamp,
}

/// How a texture is sampled; the default is glTF's, with all filters linear where the file leaves them open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Sampling {
    /// Along u and v.
    pub wrap: [Wrap; 2],
    /// Between texels that are larger than pixels.
    pub magnify_linear: bool,
    /// Between texels that are smaller than pixels.
    pub minify_linear: bool,
    /// Between levels; `None` for the first level alone.
    pub mips_linear: Option<bool>,
}

impl Default for Sampling {
    fn default() -> Self {
        Self { wrap: [Wrap::Repeat; 2], magnify_linear: true, minify_linear: true, mips_linear: Some(true) }
    }
}

impl From<&gltf::texture::Sampler<'_>> for Sampling {
    fn from(sampler: &gltf::texture::Sampler<'_>) -> Self {
        use gltf::texture::{MagFilter, MinFilter, WrappingMode};
        let wrap = |mode| match mode {
            WrappingMode::Repeat => Wrap::Repeat,
            WrappingMode::MirroredRepeat => Wrap::Mirror,
            WrappingMode::ClampToEdge => Wrap::Clamp,
        };
        let (minify_linear, mips_linear) = match sampler.min_filter() {
            Some(MinFilter::Nearest) => (false, None),
            Some(MinFilter::Linear) => (true, None),
            Some(MinFilter::NearestMipmapNearest) => (false, Some(false)),
            Some(MinFilter::LinearMipmapNearest) => (true, Some(false)),
            Some(MinFilter::NearestMipmapLinear) => (false, Some(true)),
            Some(MinFilter::LinearMipmapLinear) | None => (true, Some(true)),
        };
        let magnify_linear = sampler.mag_filter() != Some(MagFilter::Nearest);
        Self { wrap: [wrap(sampler.wrap_s()), wrap(sampler.wrap_t())], magnify_linear, minify_linear, mips_linear }
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
pub(super) fn decode(bytes: &[u8], room: u64) -> Result<(u32, u32, Vec<u8>), String> {
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

/// The texture with its mips.
pub(super) fn with_mips(width: u32, height: u32, pixels: Vec<u8>, content: Content) -> Texture {
    match content {
        Content::Normals => normal_mips(width, height, pixels),
        Content::Colour | Content::Data => averaged_mips(width, height, pixels, content),
    }
}

/// The four texels of the finer level of `w` × `h` that a texel of the next covers, row by row.
fn covered(w: usize, h: usize) -> impl Iterator<Item = [usize; 4]> {
    let corner = move |x: usize, y: usize| y.min(h - 1) * w + x.min(w - 1);
    let (next_w, next_h) = ((w / 2).max(1), (h / 2).max(1));
    (0..next_h).flat_map(move |y| {
        (0..next_w).map(move |x| {
            let (x, y) = (2 * x, 2 * y);
            [corner(x, y), corner(x + 1, y), corner(x, y + 1), corner(x + 1, y + 1)]
        })
    })
}

fn averaged_mips(width: u32, height: u32, pixels: Vec<u8>, content: Content) -> Texture {
    let srgb = content == Content::Colour;
    let to_linear: [f32; 256] = std::array::from_fn(|code| {
        let value = code as f32 / 255.0;
        if srgb { srgb_decode(value) } else { value }
    });
    let to_code = |value: f32| ((if srgb { srgb_encode(value) } else { value }) * 255.0 + 0.5) as u8;
    let mut levels = vec![pixels];
    let (mut w, mut h) = (width as usize, height as usize);
    while w > 1 || h > 1 {
        let Some(finer) = levels.last() else { break };
        let texel = |corners: [usize; 4]| {
            let mean = |channel: usize| corners.iter().map(|at| to_linear[usize::from(finer[at * 4 + channel])]).sum::<f32>() / 4.0;
            let alpha = corners.iter().map(|at| u32::from(finer[at * 4 + 3])).sum::<u32>() / 4;
            [to_code(mean(0)), to_code(mean(1)), to_code(mean(2)), alpha as u8]
        };
        levels.push(covered(w, h).flat_map(texel).collect());
        (w, h) = ((w / 2).max(1), (h / 2).max(1));
    }
    let last = levels.last().map_or([255; 4], |level| [0, 1, 2, 3].map(|i| level.get(i).copied().unwrap_or(255)));
    let mean = Vec3::from_array([0, 1, 2].map(|i| to_linear[usize::from(last[i])]));
    Texture { width, height, levels, content, mean }
}

/// GGX alpha that the spread of the normals in a texel stands for, to be added to the surface's own as squares.
///
/// The mean of unit normals has a length r < 1 where they differ; slopes then vary by σ² = (1 − r) / r along each axis
/// (Toksvig 2005, "Mipmapping normal maps"), and alpha² is twice that variance.
#[must_use]
pub fn widening(mean: Vec3) -> f32 {
    let length = mean.length().clamp(1e-3, 1.0);
    (2.0 * (1.0 - length) / length).sqrt().min(1.0)
}

/// Directions are averaged as unit vectors. What the average is shorter by is kept in alpha, so that sampling needs no
/// second texture, and 8 bits of direction cannot be taken for a spread: the first level has none.
fn normal_mips(width: u32, height: u32, mut pixels: Vec<u8>) -> Texture {
    pixels.chunks_exact_mut(4).for_each(|texel| texel[3] = 0);
    let (mut w, mut h) = (width as usize, height as usize);
    let unit = |at: usize| {
        let code = |channel: usize| f32::from(pixels[at * 4 + channel]) / 127.5 - 1.0;
        Vec3::new(code(0), code(1), code(2)).normalize_or(Vec3::Z)
    };
    let mut levels = Vec::new();
    let mut means: Vec<Vec3> = Vec::new();
    while w > 1 || h > 1 {
        let mean =
            |corners: [usize; 4]| corners.iter().map(|at| if levels.is_empty() { unit(*at) } else { means[*at] }).sum::<Vec3>() / 4.0;
        let coarser: Vec<Vec3> = covered(w, h).map(mean).collect();
        let code = |value: f32| (value * 127.5 + 128.0) as u8;
        let texel = |mean: &Vec3| {
            let direction = mean.normalize_or(Vec3::Z);
            [code(direction.x), code(direction.y), code(direction.z), (widening(*mean) * 255.0 + 0.5) as u8]
        };
        levels.push(coarser.iter().flat_map(texel).collect());
        means = coarser;
        (w, h) = ((w / 2).max(1), (h / 2).max(1));
    }
    levels.insert(0, pixels);
    Texture { width, height, levels, content: Content::Normals, mean: Vec3::ONE }
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

    #[test]
    fn normals_that_differ_average_to_a_wider_lobe() {
        // Columns tilted by ±θ about y: their mean is (0, 0, cos θ), whatever the level.
        let tilt = 0.3f32;
        let code = |v: f32| (v * 127.5 + 128.0) as u8;
        let column = |x: usize| {
            let sign = if x.is_multiple_of(2) { 1.0 } else { -1.0 };
            [code(sign * tilt.sin()), 128, code(tilt.cos()), 77]
        };
        let pixels: Vec<u8> = (0..8 * 4).flat_map(|at| column(at % 8)).collect();
        let texture = with_mips(8, 4, pixels, Content::Normals);
        assert_eq!(texture.levels.iter().map(Vec::len).collect::<Vec<_>>(), [128, 32, 8, 4]);
        assert!(texture.levels[0].chunks_exact(4).all(|texel| texel[3] == 0), "the first level spreads nothing");
        let expected = (2.0 * (1.0 - tilt.cos()) / tilt.cos()).sqrt();
        for texel in texture.levels[1..].iter().flat_map(|level| level.chunks_exact(4)) {
            // Codes of 8 bits, in and out.
            assert!((f32::from(texel[3]) / 255.0 - expected).abs() < 0.01, "{texel:?}, expected {expected}");
            assert!(texel[0].abs_diff(128) <= 1 && texel[2] >= 254, "{texel:?}");
        }
        assert_eq!(widening(Vec3::Z), 0.0);
        assert_eq!(widening(Vec3::ZERO), 1.0);
    }
}
