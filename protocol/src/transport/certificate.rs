//! The server's certificate: the host's own, or one made on first start and kept.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use sha2::{Digest, Sha256};

/// A certificate chain and its key.
pub struct Certificate {
    pub(super) chain: Vec<CertificateDer<'static>>,
    pub(super) key: PrivateKeyDer<'static>,
    self_signed: bool,
}

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CertificateError {
    /// Not readable or not writable.
    #[error("{path}: {fault}; check the path and its permissions")]
    File {
        /// The file.
        path: PathBuf,
        /// The system's word.
        fault: String,
    },
    /// Not PEM, or nothing usable in it.
    #[error("{path}: {fault}; expected PEM as written by openssl or certbot")]
    Pem {
        /// The file.
        path: PathBuf,
        /// What was wrong.
        fault: String,
    },
    /// The kept key is there, its certificate is not.
    #[error(
        "{certificate} is missing beside {key}; put it back, or delete {key} to have a new certificate made: viewers then need the new join URL"
    )]
    Half {
        /// The file that is missing.
        certificate: PathBuf,
        /// The file that is there.
        key: PathBuf,
    },
    /// Could not be made.
    #[error("cannot make a self-signed certificate: {0}")]
    Make(String),
}

const CERTIFICATE_FILE: &str = "certificate.pem";
const KEY_FILE: &str = "key.pem";
const LOCK_FILE: &str = "lock";

impl Certificate {
    /// Reads the host's own certificate chain and key, PEM.
    ///
    /// # Errors
    /// [`CertificateError`] naming the file.
    pub fn load(chain_file: &Path, key_file: &Path) -> Result<Self, CertificateError> {
        let chain = read_chain(chain_file)?;
        let key = read_key(key_file)?;
        Ok(Self { chain, key, self_signed: false })
    }

    /// The self-signed certificate kept in `folder`, made there on first use.
    ///
    /// # Errors
    /// [`CertificateError`] naming the file. A damaged file is an error, never replaced: viewers hold its fingerprint. A certificate without
    /// a key, which can never serve, is.
    pub fn load_or_make(folder: &Path) -> Result<Self, CertificateError> {
        let (chain_file, key_file) = (folder.join(CERTIFICATE_FILE), folder.join(KEY_FILE));
        // Servers that start at the same time must not mix one's certificate with the other's key.
        let _lock = lock(folder)?;
        match (chain_file.exists(), key_file.exists()) {
            (true, true) => {}
            (false, true) => return Err(CertificateError::Half { certificate: chain_file, key: key_file }),
            // The key comes last: without it a first start was cut short, and nobody was given the fingerprint.
            (_, false) => make(&chain_file, &key_file)?,
        }
        Ok(Self { self_signed: true, ..Self::load(&chain_file, &key_file)? })
    }

    /// SHA-256 of the certificate, for the join URL; `None` for the host's own, which authorities vouch for.
    #[must_use]
    pub fn fingerprint(&self) -> Option<[u8; 32]> {
        self.chain.first().filter(|_| self.self_signed).map(|certificate| fingerprint(certificate))
    }
}

pub(super) fn fingerprint(certificate: &[u8]) -> [u8; 32] {
    Sha256::digest(certificate).into()
}

fn read(path: &Path) -> Result<Vec<u8>, CertificateError> {
    fs::read(path).map_err(|error| CertificateError::File { path: path.to_owned(), fault: error.to_string() })
}

fn read_chain(path: &Path) -> Result<Vec<CertificateDer<'static>>, CertificateError> {
    let pem_error = |fault: String| CertificateError::Pem { path: path.to_owned(), fault };
    let chain =
        CertificateDer::pem_slice_iter(&read(path)?).collect::<Result<Vec<_>, _>>().map_err(|error| pem_error(error.to_string()))?;
    if chain.is_empty() {
        return Err(pem_error("no certificate in it".to_owned()));
    }
    Ok(chain)
}

fn read_key(path: &Path) -> Result<PrivateKeyDer<'static>, CertificateError> {
    PrivateKeyDer::from_pem_slice(&read(path)?).map_err(|error| CertificateError::Pem { path: path.to_owned(), fault: error.to_string() })
}

/// Waits until no other process looks at or makes the files of `folder`; held until dropped.
fn lock(folder: &Path) -> Result<fs::File, CertificateError> {
    let path = folder.join(LOCK_FILE);
    fs::create_dir_all(folder)
        .and_then(|()| fs::OpenOptions::new().write(true).create(true).truncate(false).open(&path))
        .and_then(|file| file.lock().map(|()| file))
        .map_err(|error| CertificateError::File { path, fault: error.to_string() })
}

fn make(chain_file: &Path, key_file: &Path) -> Result<(), CertificateError> {
    let file_error = |path: &Path| {
        let path = path.to_owned();
        move |error: std::io::Error| CertificateError::File { path, fault: error.to_string() }
    };
    let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned(), "::1".to_owned()];
    let made = rcgen::generate_simple_self_signed(names).map_err(|error| CertificateError::Make(error.to_string()))?;
    let aside = |file: &Path| file.with_extension(format!("{}.partial", std::process::id()));
    let (chain_aside, key_aside) = (aside(chain_file), aside(key_file));
    let written = write_private(&chain_aside, made.cert.pem().as_bytes())
        .map_err(file_error(chain_file))
        .and_then(|()| write_private(&key_aside, made.signing_key.serialize_pem().as_bytes()).map_err(file_error(key_file)))
        .and_then(|()| fs::rename(&chain_aside, chain_file).map_err(file_error(chain_file)))
        .and_then(|()| fs::rename(&key_aside, key_file).map_err(file_error(key_file)));
    if written.is_err() {
        // Either may never have been made, or have its own name already.
        let _ = fs::remove_file(&chain_aside);
        let _ = fs::remove_file(&key_aside);
    }
    written
}

/// Writes a file for the owner's eyes alone, down to the disk.
fn write_private(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut options = fs::OpenOptions::new();
    options.write(true).create(true).truncate(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}
