//! Models on disk, so that a viewer who comes again need not fetch them again.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use mr360_protocol::asset::{AssetId, MAX_ASSET_BYTES, MAX_ASSETS};

/// Most bytes kept: one scene of the most and largest models.
const MAX_CACHE_BYTES: u64 = (MAX_ASSETS * MAX_ASSET_BYTES) as u64;
/// A file still partial after this was left by a program that was killed.
const PARTIAL_LIFE: Duration = Duration::from_secs(60 * 60);
const PARTIAL: &str = ".partial";

/// Assets on disk, each in a file named by its hash; a file's time of change is its last use. A cache: every failure means only
/// that an asset is fetched again. Several viewers may share the folder. Every call reads or writes files: not for the network's
/// thread, nor for one that draws.
#[derive(Debug, Clone)]
pub struct AssetCache {
    folder: PathBuf,
    capacity: u64,
}

impl AssetCache {
    /// A cache in this folder.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), capacity: MAX_CACHE_BYTES }
    }

    /// The asset, if it is there and whole.
    #[must_use]
    pub fn load(&self, id: AssetId) -> Option<Bytes> {
        let path = self.path(id);
        let file = File::open(&path).ok()?;
        let mut bytes = Vec::new();
        // A byte more than allowed, so that what is too long is noticed.
        (&file).take(MAX_ASSET_BYTES as u64 + 1).read_to_end(&mut bytes).ok()?;
        if bytes.len() > MAX_ASSET_BYTES || AssetId::of(&bytes) != id {
            tracing::warn!(path = %path.display(), "cached asset is damaged; fetching it again");
            return None;
        }
        // In a folder that may only be read, assets keep their times; then they are not written or removed by this program either.
        let _ = file.set_modified(SystemTime::now());
        Some(bytes.into())
    }

    /// Keeps the asset, and lets those go that were used longest ago. A file is written aside and renamed, so that a crash or a
    /// full disk leaves no half.
    pub fn store(&self, id: AssetId, bytes: &[u8]) {
        static WRITTEN: AtomicU64 = AtomicU64::new(0);
        let unique = WRITTEN.fetch_add(1, Ordering::Relaxed);
        let (path, partial) = (self.path(id), self.folder.join(format!("{id}.{}.{unique}{PARTIAL}", std::process::id())));
        let written = std::fs::create_dir_all(&self.folder)
            .and_then(|()| std::fs::write(&partial, bytes))
            .and_then(|()| std::fs::rename(&partial, &path));
        match written {
            Ok(()) => self.trim(&path),
            Err(error) => {
                tracing::warn!(path = %path.display(), %error, "asset not cached");
                // It may never have been made.
                let _ = std::fs::remove_file(&partial);
            }
        }
    }

    /// Removes what is beyond the capacity, the least recently used first, and what crashes left. `newest` stays.
    fn trim(&self, newest: &Path) {
        let Ok(entries) = std::fs::read_dir(&self.folder) else { return };
        let now = SystemTime::now();
        let mut assets = Vec::new();
        for entry in entries.flatten() {
            let (name, path) = (entry.file_name(), entry.path());
            let (Some(name), Ok(metadata)) = (name.to_str(), entry.metadata()) else { continue };
            let used = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
            if name.parse::<AssetId>().is_ok() {
                assets.push((path != newest, std::cmp::Reverse(used), metadata.len(), path));
            } else if name.ends_with(PARTIAL) && now.duration_since(used).is_ok_and(|age| age > PARTIAL_LIFE) {
                // Another viewer may have removed it first; so below.
                let _ = std::fs::remove_file(path);
            }
        }
        assets.sort();
        let mut total: u64 = 0;
        for (beside, _, bytes, path) in assets {
            total = total.saturating_add(bytes);
            if beside && total > self.capacity {
                let _ = std::fs::remove_file(path);
            }
        }
    }

    fn path(&self, id: AssetId) -> PathBuf {
        self.folder.join(id.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cache_returns_what_is_whole_alone() {
        let folder = tempfile::tempdir().unwrap();
        let cache = AssetCache::new(folder.path());
        let id = AssetId::of(b"model");
        assert_eq!(cache.load(id), None);
        cache.store(id, b"model");
        assert_eq!(cache.load(id).as_deref(), Some(&b"model"[..]));
        std::fs::write(cache.path(id), b"mouldy").unwrap();
        assert_eq!(cache.load(id), None);
    }

    #[test]
    fn a_cache_that_cannot_be_written_is_no_error() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, b"").unwrap();
        AssetCache::new(&file).store(AssetId::of(b"x"), b"x");
    }

    #[test]
    fn the_least_recently_used_assets_go_first() {
        let folder = tempfile::tempdir().unwrap();
        let cache = AssetCache { capacity: 25, ..AssetCache::new(folder.path()) };
        let models = [[1_u8; 10], [2; 10], [3; 10], [4; 10]];
        let [first, second, third, fourth] = models.map(|model| AssetId::of(&model));
        let age = |name: &str, hours: u64| {
            let file = File::options().write(true).open(folder.path().join(name)).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(hours * 3600)).unwrap();
        };
        let kept = || [first, second, third, fourth].map(|id| cache.path(id).exists());
        std::fs::write(folder.path().join("notes.txt"), [0; 100]).unwrap();
        std::fs::write(folder.path().join("old.1.partial"), b"half").unwrap();
        std::fs::write(folder.path().join("new.2.partial"), b"half").unwrap();
        age("old.1.partial", 2);
        cache.store(first, &models[0]);
        cache.store(second, &models[1]);
        age(&first.to_string(), 3);
        age(&second.to_string(), 2);
        // Used again, the first is newer than the second.
        assert!(cache.load(first).is_some());
        cache.store(third, &models[2]);
        assert_eq!(kept(), [true, false, true, false]);
        // One asset beyond the capacity stays: it is in use.
        let small = AssetCache { capacity: 5, ..cache.clone() };
        small.store(fourth, &models[3]);
        assert_eq!(kept(), [false, false, false, true]);
        let others = ["notes.txt", "old.1.partial", "new.2.partial"].map(|name| folder.path().join(name).exists());
        assert_eq!(others, [true, false, true]);
    }
}
