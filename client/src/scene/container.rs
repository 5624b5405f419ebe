//! From the bytes of a .glb or .gltf to its document and buffers.

use std::borrow::Cow;

use serde::Deserialize;

use super::model::ModelError;
use super::texture::data_uri;

/// Most bytes in all buffers together.
const MAX_BUFFER_BYTES: usize = 256 * 1024 * 1024;
/// Extensions that a file may require.
const SUPPORTED_EXTENSIONS: [&str; 4] =
    ["KHR_materials_transmission", "KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_texture_transform"];

/// A file that was taken apart.
pub(super) struct Container<'a> {
    pub(super) document: gltf::Document,
    pub(super) extras: Extras,
    pub(super) binary: Option<&'a [u8]>,
}

impl<'a> Container<'a> {
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, ModelError> {
        let (json, binary) = split(bytes)?;
        let format = |error: String| ModelError::Format(error);
        let gltf = gltf::Gltf::from_slice_without_validation(json).map_err(|error| format(error.to_string()))?;
        if let Some(unknown) = gltf.extensions_required().find(|name| !SUPPORTED_EXTENSIONS.contains(name)) {
            return Err(ModelError::Extension(unknown.to_owned()));
        }
        let extras = serde_json::from_slice(json).map_err(|error| format(error.to_string()))?;
        let mut json = gltf.document.into_json();
        guard(&json)?;
        // Checked above; the crate knows fewer than are read here.
        json.extensions_required.clear();
        let document = gltf::Document::from_json(json).map_err(|error| format(error.to_string()))?;
        Ok(Self { document, extras, binary })
    }

    /// The declared bytes of every buffer. The binary chunk is lent out, not copied: many buffers may claim it.
    pub(super) fn buffers(&self) -> Result<Vec<Cow<'a, [u8]>>, ModelError> {
        let mut total = 0;
        let mut out = Vec::new();
        for buffer in self.document.buffers() {
            let fault = |fault: String| ModelError::Buffer { index: buffer.index(), fault };
            total = buffer.length().saturating_add(total);
            if total > MAX_BUFFER_BYTES {
                return Err(fault(format!("brings the buffers to more than {MAX_BUFFER_BYTES} bytes; simplify the model")));
            }
            let bytes = match buffer.source() {
                // glTF 2.0, Sec. 4.4.3.2: the first buffer alone may be the binary chunk.
                gltf::buffer::Source::Bin if buffer.index() > 0 => {
                    return Err(fault("has no URI; only the first buffer may be the file's binary chunk".to_owned()));
                }
                gltf::buffer::Source::Bin => {
                    Cow::Borrowed(self.binary.ok_or_else(|| fault("is missing: the file has no binary chunk".to_owned()))?)
                }
                gltf::buffer::Source::Uri(uri) => Cow::Owned(data_uri(uri).map_err(fault)?),
            };
            if bytes.len() < buffer.length() {
                return Err(fault(format!("holds {} bytes where {} are declared; the file is cut short", bytes.len(), buffer.length())));
            }
            out.push(bytes);
        }
        Ok(out)
    }
}

/// What the gltf crate, as it is built here, leaves out of its document.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Extras {
    #[serde(default)]
    pub(super) materials: Vec<MaterialExtras>,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct MaterialExtras {
    extensions: MaterialExtensions,
    pub(super) normal_texture: TextureExtras,
    pub(super) occlusion_texture: TextureExtras,
}

impl MaterialExtras {
    pub(super) fn emissive_strength(&self) -> f32 {
        self.extensions.emissive_strength.as_ref().map_or(1.0, |extension| extension.emissive_strength)
    }
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
struct MaterialExtensions {
    #[serde(rename = "KHR_materials_emissive_strength")]
    emissive_strength: Option<EmissiveStrength>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct EmissiveStrength {
    emissive_strength: f32,
}

impl Default for EmissiveStrength {
    fn default() -> Self {
        Self { emissive_strength: 1.0 }
    }
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub(super) struct TextureExtras {
    extensions: TextureExtensions,
}

impl TextureExtras {
    pub(super) fn transform(&self) -> Option<FileTransform> {
        self.extensions.transform.clone()
    }
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
struct TextureExtensions {
    #[serde(rename = "KHR_texture_transform")]
    transform: Option<FileTransform>,
}

/// KHR_texture_transform as a file gives it.
#[derive(Debug, Clone, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct FileTransform {
    pub(super) offset: [f32; 2],
    /// Radians.
    pub(super) rotation: f32,
    pub(super) scale: [f32; 2],
    pub(super) tex_coord: Option<u32>,
}

impl Default for FileTransform {
    fn default() -> Self {
        Self { offset: [0.0; 2], rotation: 0.0, scale: [1.0; 2], tex_coord: None }
    }
}

/// JSON and binary chunk of a .glb (glTF 2.0, Sec. 4.4), or the whole of a .gltf.
fn split(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), ModelError> {
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let fault = |fault: &str| ModelError::Format(fault.to_owned());
    if word(4) != Some(2) {
        return Err(fault("its binary container is not version 2"));
    }
    let chunk = |at: usize, kind: &[u8; 4]| {
        let length = word(at)? as usize;
        let body = bytes.get(at + 8..(at + 8).checked_add(length)?)?;
        (bytes.get(at + 4..at + 8)? == kind).then_some(body)
    };
    let json = chunk(12, b"JSON").ok_or_else(|| fault("its JSON chunk is missing or cut short"))?;
    let after = 20 + json.len();
    if bytes.len() < after + 8 {
        return Ok((json, None));
    }
    let binary = chunk(after, b"BIN\0").ok_or_else(|| fault("its binary chunk is cut short or of another kind"))?;
    Ok((json, Some(binary)))
}

/// What the gltf crate itself would panic over: it looks these up before, or without, checking them.
fn guard(root: &gltf::json::Root) -> Result<(), ModelError> {
    for (mesh, primitive, one) in
        root.meshes.iter().enumerate().flat_map(|(m, mesh)| mesh.primitives.iter().enumerate().map(move |(p, one)| (m, p, one)))
    {
        let targets = one.targets.iter().flatten().flat_map(|target| [target.positions, target.normals, target.tangents]);
        let named = one.attributes.values().copied().chain(targets.flatten());
        if let Some(missing) = named.into_iter().find(|accessor| accessor.value() >= root.accessors.len()) {
            return Err(ModelError::Primitive { mesh, primitive, fault: format!("accessor {} does not exist", missing.value()) });
        }
    }
    for (animation, one) in root.animations.iter().enumerate() {
        for (channel, target) in one.channels.iter().map(|channel| &channel.target).enumerate() {
            let fault = |fault: String| ModelError::Animation { index: animation, fault: format!("channel {channel} {fault}") };
            if target.node.value() >= root.nodes.len() {
                return Err(fault(format!("moves node {} that does not exist", target.node.value())));
            }
            if target.path == gltf::json::validation::Checked::Invalid {
                return Err(fault("moves neither translation, rotation, scale nor weights".to_owned()));
            }
        }
    }
    let unnamed = |image: &gltf::json::Image| image.uri.is_none() && (image.buffer_view.is_none() || image.mime_type.is_none());
    match root.images.iter().position(unnamed) {
        Some(index) => Err(ModelError::Image { index, fault: "has neither a URI nor a buffer view with its MIME type".to_owned() }),
        None => Ok(()),
    }
}
