//! Surfaces of a model.

use std::borrow::Cow;

use glam::Vec3;
use mr360_protocol::light::MAX_MAGNITUDE;

use super::accessor::slice;
use super::container::{Extras, FileTransform};
use super::model::ModelError;
use super::texture::{Content, MAX_IMAGES, MAX_TEXELS, Sampling, Texture, data_uri, decode, with_mips};

/// How a surface covers what lies behind it (glTF 2.0, Sec. 3.9.4).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum AlphaMode {
    /// Wholly, whatever its alpha.
    #[default]
    Opaque,
    /// Where alpha reaches this.
    Mask(f32),
    /// By its alpha.
    Blend,
}

/// A texture as one surface uses it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextureMap {
    /// Index into the model's textures.
    pub texture: usize,
    /// Filters and edges.
    pub sampling: Sampling,
    /// By the second set of texture coordinates.
    pub second_uv: bool,
    /// Rows of the affine transform from the vertex's coordinates (u, v, 1) to the texture's.
    pub transform: [Vec3; 2],
}

/// The transform that changes nothing.
pub const PLAIN_UV: [Vec3; 2] = [Vec3::X, Vec3::Y];

/// Metallic-roughness of one part.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Linear BT.709.
    pub base_color: Vec3,
    /// In [0, 1]; counts with [`AlphaMode::Mask`] and [`AlphaMode::Blend`].
    pub alpha: f32,
    /// How it covers what lies behind.
    pub alpha_mode: AlphaMode,
    /// Perceptual.
    pub roughness: f32,
    /// In [0, 1].
    pub metallic: f32,
    /// Linear radiance of its own, 1 for the video's white.
    pub emission: Vec3,
    /// Shows its base colour in every light (`KHR_materials_unlit`).
    pub unlit: bool,
    /// Clear, refracting.
    pub glass: bool,
    /// Seen from behind too.
    pub double_sided: bool,
    /// Multiplies the first two components of mapped normals.
    pub normal_scale: f32,
    /// Share of the occlusion map that counts, in [0, 1].
    pub occlusion_strength: f32,
    /// sRGB colour that multiplies `base_color`, and alpha that multiplies `alpha`.
    pub base_color_texture: Option<TextureMap>,
    /// Roughness in green, metallic in blue.
    pub metallic_roughness_texture: Option<TextureMap>,
    /// Directions in tangent space.
    pub normal_texture: Option<TextureMap>,
    /// Ambient light that is let through, in red.
    pub occlusion_texture: Option<TextureMap>,
    /// sRGB colour that multiplies `emission`.
    pub emission_texture: Option<TextureMap>,
}

impl Default for Surface {
    fn default() -> Self {
        Self {
            base_color: Vec3::ONE,
            alpha: 1.0,
            alpha_mode: AlphaMode::Opaque,
            roughness: 1.0,
            metallic: 0.0,
            emission: Vec3::ZERO,
            unlit: false,
            glass: false,
            double_sided: false,
            normal_scale: 1.0,
            occlusion_strength: 1.0,
            base_color_texture: None,
            metallic_roughness_texture: None,
            normal_texture: None,
            occlusion_texture: None,
            emission_texture: None,
        }
    }
}

impl Surface {
    /// The textures it uses, in the order of the shaders: base colour, metallic-roughness, normal, occlusion, emission.
    #[must_use]
    pub fn textures(&self) -> [Option<TextureMap>; 5] {
        [self.base_color_texture, self.metallic_roughness_texture, self.normal_texture, self.occlusion_texture, self.emission_texture]
    }
}

/// Where a texture is named, before it is read.
struct Reference<'a> {
    texture: gltf::Texture<'a>,
    set: u32,
    transform: Option<FileTransform>,
}

impl<'a> Reference<'a> {
    fn of(info: &gltf::texture::Info<'a>) -> Self {
        let transform = info.texture_transform().map(|t| FileTransform {
            offset: t.offset(),
            rotation: t.rotation(),
            scale: t.scale(),
            tex_coord: t.tex_coord(),
        });
        Self { texture: info.texture(), set: info.tex_coord(), transform }
    }
}

/// Rows of KHR_texture_transform's translation × rotation × scale.
fn rows(transform: &FileTransform) -> [Vec3; 2] {
    let (sine, cosine) = transform.rotation.sin_cos();
    let ([offset_u, offset_v], [scale_u, scale_v]) = (transform.offset, transform.scale);
    [Vec3::new(cosine * scale_u, sine * scale_v, offset_u), Vec3::new(-sine * scale_u, cosine * scale_v, offset_v)]
}

/// Reads materials and the images they use; asks for each image once for each way it is used.
pub(super) struct Materials<'a> {
    document: &'a gltf::Document,
    buffers: &'a [Cow<'a, [u8]>],
    extras: &'a Extras,
    pub(super) textures: Vec<Texture>,
    read: Vec<(usize, Content)>,
}

impl<'a> Materials<'a> {
    pub(super) fn new(document: &'a gltf::Document, buffers: &'a [Cow<'a, [u8]>], extras: &'a Extras) -> Self {
        Self { document, buffers, extras, textures: Vec::new(), read: Vec::new() }
    }

    pub(super) fn surface(&mut self, material: &gltf::Material<'_>) -> Result<Surface, ModelError> {
        let fault = |fault: String| ModelError::Material { index: material.index(), fault };
        let pbr = material.pbr_metallic_roughness();
        let [r, g, b, alpha] = pbr.base_color_factor();
        let [red, green, blue] = material.emissive_factor();
        let extras = material.index().and_then(|index| self.extras.materials.get(index)).cloned().unwrap_or_default();
        let occlusion_strength = material.occlusion_texture().map_or(1.0, |occlusion| occlusion.strength());
        let values = [r, g, b, alpha, pbr.metallic_factor(), pbr.roughness_factor(), red, green, blue, occlusion_strength];
        if !values.iter().all(|v| (0.0..=1.0).contains(v)) {
            return Err(fault(format!("factors {values:?} are not all within 0..1")));
        }
        let normal_scale = material.normal_texture().map_or(1.0, |normal| normal.scale());
        let (strength, cutoff) = (extras.emissive_strength(), material.alpha_cutoff().unwrap_or(0.5));
        if !(normal_scale.is_finite() && strength.is_finite() && strength >= 0.0 && cutoff.is_finite() && cutoff >= 0.0) {
            return Err(fault(format!(
                "normal scale {normal_scale}, emissive strength {strength} or alpha cutoff {cutoff} is not a finite number from 0 on"
            )));
        }
        let plain = |info: Option<gltf::texture::Info<'a>>| info.map(|info| Reference::of(&info));
        let normal = self.own(material).and_then(|m| m.normal_texture()).map(|normal| Reference {
            texture: normal.texture(),
            set: normal.tex_coord(),
            transform: extras.normal_texture.transform(),
        });
        let occlusion = self.own(material).and_then(|m| m.occlusion_texture()).map(|occlusion| Reference {
            texture: occlusion.texture(),
            set: occlusion.tex_coord(),
            transform: extras.occlusion_texture.transform(),
        });
        let own = self.own(material);
        let base_color = plain(own.as_ref().and_then(|m| m.pbr_metallic_roughness().base_color_texture()));
        let metallic_roughness = plain(own.as_ref().and_then(|m| m.pbr_metallic_roughness().metallic_roughness_texture()));
        let emission = plain(own.as_ref().and_then(gltf::Material::emissive_texture));
        let mut map = |reference: Option<Reference<'a>>, content| {
            reference.map(|reference| self.map(material.index(), &reference, content)).transpose()
        };
        Ok(Surface {
            base_color: Vec3::new(r, g, b),
            alpha,
            alpha_mode: match material.alpha_mode() {
                gltf::material::AlphaMode::Opaque => AlphaMode::Opaque,
                gltf::material::AlphaMode::Mask => AlphaMode::Mask(cutoff),
                gltf::material::AlphaMode::Blend => AlphaMode::Blend,
            },
            roughness: pbr.roughness_factor(),
            metallic: pbr.metallic_factor(),
            emission: (Vec3::new(red, green, blue) * strength).min(Vec3::splat(MAX_MAGNITUDE)),
            unlit: material.unlit(),
            glass: material.transmission().is_some_and(|transmission| transmission.transmission_factor() > 0.5),
            double_sided: material.double_sided(),
            normal_scale,
            occlusion_strength,
            base_color_texture: map(base_color, Content::Colour)?,
            metallic_roughness_texture: map(metallic_roughness, Content::Data)?,
            normal_texture: map(normal, Content::Normals)?,
            occlusion_texture: map(occlusion, Content::Data)?,
            emission_texture: map(emission, Content::Colour)?,
        })
    }

    /// The same material, with the document's lifetime.
    fn own(&self, material: &gltf::Material<'_>) -> Option<gltf::Material<'a>> {
        self.document.materials().nth(material.index()?)
    }

    fn map(&mut self, material: Option<usize>, reference: &Reference<'_>, content: Content) -> Result<TextureMap, ModelError> {
        let set = reference.transform.as_ref().and_then(|transform| transform.tex_coord).unwrap_or(reference.set);
        let fault = |fault: String| ModelError::Material { index: material, fault };
        if set > 1 {
            return Err(fault(format!("uses texture coordinates {set}; only TEXCOORD_0 and TEXCOORD_1 are read")));
        }
        let transform = reference.transform.as_ref().map_or(PLAIN_UV, rows);
        if !transform.iter().all(|row| row.is_finite()) {
            return Err(fault("its texture transform is not finite".to_owned()));
        }
        let texture = self.texture(reference.texture.source().index(), content)?;
        Ok(TextureMap { texture, sampling: Sampling::from(&reference.texture.sampler()), second_uv: set == 1, transform })
    }

    fn texture(&mut self, image: usize, content: Content) -> Result<usize, ModelError> {
        if let Some(at) = self.read.iter().position(|key| *key == (image, content)) {
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
        self.textures.push(with_mips(width, height, pixels, content));
        self.read.push((image, content));
        Ok(self.textures.len() - 1)
    }
}
