//! The models of a scene, as self-contained bytes that viewers fetch by their hash.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use mr360_protocol::asset::{AssetId, MAX_ASSET_BYTES};
use mr360_protocol::track;
use serde_json::Value;

/// Assets by hash.
#[derive(Default)]
pub struct Assets {
    by_id: BTreeMap<AssetId, Bytes>,
}

/// Why a model cannot be published.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AssetError {
    /// Not readable.
    #[error("{path}: {fault}; check the path and its permissions")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        fault: String,
    },
    /// Too large for one asset.
    #[error("{path}: {bytes} bytes with all it refers to, at most {MAX_ASSET_BYTES}; simplify the model or shrink its textures")]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size, as far as it was read.
        bytes: u64,
    },
    /// Not glTF 2.0.
    #[error("{path}: {fault}; expected a glTF 2.0 model (.glb or .gltf)")]
    NotGltf {
        /// The file.
        path: PathBuf,
        /// What was wrong.
        fault: String,
    },
}

const GLB_MAGIC: &[u8; 4] = b"glTF";

impl Assets {
    /// Reads a model, makes it self-contained and returns its name.
    ///
    /// # Errors
    /// [`AssetError`] naming the file.
    pub fn add(&mut self, path: &Path) -> Result<AssetId, AssetError> {
        let bytes = read_bounded(path)?;
        let bytes = if bytes.starts_with(GLB_MAGIC) { bytes } else { embed(path, &bytes)? };
        if bytes.len() > MAX_ASSET_BYTES {
            return Err(AssetError::TooLarge { path: path.to_owned(), bytes: bytes.len() as u64 });
        }
        let id = AssetId::of(&bytes);
        self.by_id.insert(id, bytes.into());
        Ok(id)
    }

    /// What an asset holds.
    #[must_use]
    pub fn bytes(&self, id: AssetId) -> Option<Bytes> {
        self.by_id.get(&id).cloned()
    }

    /// One track an asset. They must be kept: the group of a track that has ended ages out of the cache.
    pub(super) fn publish(&self, broadcast: &moq_net::broadcast::Producer) -> Result<Vec<moq_net::track::Producer>, moq_net::Error> {
        self.by_id
            .iter()
            .map(|(id, bytes)| {
                let mut track = broadcast.create_track(id.track(), track::asset_info())?;
                track.write_frame(moq_net::Timestamp::now(), bytes.clone())?;
                Ok(track)
            })
            .collect()
    }
}

fn read_bounded(path: &Path) -> Result<Vec<u8>, AssetError> {
    let read = |error: std::io::Error| AssetError::Read { path: path.to_owned(), fault: error.to_string() };
    let bytes = fs::metadata(path).map_err(read)?.len();
    if bytes > MAX_ASSET_BYTES as u64 {
        return Err(AssetError::TooLarge { path: path.to_owned(), bytes });
    }
    fs::read(path).map_err(read)
}

/// Replaces every file that a .gltf refers to by a data URI.
fn embed(path: &Path, text: &[u8]) -> Result<Vec<u8>, AssetError> {
    let not_gltf = |fault: String| AssetError::NotGltf { path: path.to_owned(), fault };
    let mut document: Value = serde_json::from_slice(text).map_err(|error| not_gltf(error.to_string()))?;
    if document.pointer("/asset/version").is_none() {
        return Err(not_gltf("no asset.version in it".to_owned()));
    }
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut total = text.len() as u64;
    for (list, media_type) in [("buffers", Some("application/octet-stream")), ("images", None)] {
        let Some(entries) = document.get_mut(list).and_then(Value::as_array_mut) else { continue };
        for (index, entry) in entries.iter_mut().enumerate() {
            let Some(uri) = entry.get("uri").and_then(Value::as_str).filter(|uri| !uri.starts_with("data:")) else { continue };
            let element = format!("{list}[{index}].uri {uri:?}");
            let file = local_file(folder, uri).ok_or_else(|| not_gltf(format!("{element} leaves the model's folder")))?;
            let media_type =
                media_type.or_else(|| image_type(&file)).ok_or_else(|| not_gltf(format!("{element} is neither PNG nor JPEG")))?;
            let bytes = read_bounded(&file)?;
            total += bytes.len() as u64;
            if total > MAX_ASSET_BYTES as u64 {
                return Err(AssetError::TooLarge { path: path.to_owned(), bytes: total });
            }
            entry["uri"] = Value::String(format!("data:{media_type};base64,{}", STANDARD.encode(bytes)));
        }
    }
    serde_json::to_vec(&document).map_err(|error| not_gltf(error.to_string()))
}

/// A relative URI as a file below `folder`. Others would let a model publish any file of the host.
fn local_file(folder: &Path, uri: &str) -> Option<PathBuf> {
    let base = url::Url::parse("file:///model/").ok()?;
    let joined = base.join(uri).ok()?.to_file_path().ok()?;
    let inside = joined.strip_prefix("/model").ok()?;
    (!uri.contains(':') && !uri.starts_with('/')).then(|| folder.join(inside))
}

fn image_type(file: &Path) -> Option<&'static str> {
    match file.extension()?.to_str()?.to_ascii_lowercase().as_str() {
        "png" => Some("image/png"),
        "jpg" | "jpeg" => Some("image/jpeg"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(json: &str) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.gltf");
        fs::write(&path, json).unwrap();
        (folder, path)
    }

    #[test]
    fn files_beside_a_gltf_are_embedded() {
        let (folder, path) =
            model(r#"{"asset":{"version":"2.0"},"buffers":[{"uri":"a%20b.bin","byteLength":3}],"images":[{"uri":"t.png"}]}"#);
        fs::write(folder.path().join("a b.bin"), [1, 2, 3]).unwrap();
        fs::write(folder.path().join("t.png"), [4]).unwrap();
        let mut assets = Assets::default();
        let id = assets.add(&path).unwrap();
        let document: Value = serde_json::from_slice(&assets.by_id[&id]).unwrap();
        assert_eq!(document["buffers"][0]["uri"], "data:application/octet-stream;base64,AQID");
        assert_eq!(document["images"][0]["uri"], "data:image/png;base64,BA==");
    }

    #[test]
    fn a_model_cannot_reach_out_of_its_folder() {
        for uri in ["../secret.bin", "/etc/passwd", "file:///etc/passwd", "https://host/x.bin"] {
            let (_folder, path) = model(&format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{{"uri":"{uri}"}}]}}"#));
            let error = Assets::default().add(&path).unwrap_err().to_string();
            assert!(error.contains("model.gltf"), "{error}");
            assert!(error.contains("leaves the model's folder") || error.contains("No such file"), "{uri}: {error}");
        }
    }

    #[test]
    fn missing_broken_and_huge_models_are_named() {
        let (folder, path) = model("{}");
        let mut assets = Assets::default();
        assert!(matches!(assets.add(&path), Err(AssetError::NotGltf { .. })));
        assert!(matches!(assets.add(&folder.path().join("none.glb")), Err(AssetError::Read { .. })));
        let huge = folder.path().join("huge.glb");
        fs::File::create(&huge).unwrap().set_len(MAX_ASSET_BYTES as u64 + 1).unwrap();
        assert!(matches!(assets.add(&huge), Err(AssetError::TooLarge { .. })));
    }
}
