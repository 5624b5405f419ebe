//! Writes what a user does.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use mr360_protocol::clock::ClientTime;

use super::{Deed, ScriptError};

/// A script in the making. Lines that cannot be written, as on a full disk, end it with a warning; the session goes on.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    file: Option<BufWriter<File>>,
    /// The script's time begins with the first deed.
    begin: Option<ClientTime>,
}

impl Recorder {
    /// Creates the file.
    ///
    /// # Errors
    /// [`ScriptError::Write`].
    pub fn create(path: &Path) -> Result<Self, ScriptError> {
        let file = File::create(path).map_err(|error| ScriptError::Write { path: path.to_owned(), fault: error.to_string() })?;
        Ok(Self { path: path.to_owned(), file: Some(BufWriter::new(file)), begin: None })
    }

    /// Writes one deed, done at its time of the client's clock.
    pub fn write(&mut self, deed: &Deed) {
        let Some(file) = &mut self.file else { return };
        let mut line = deed.line();
        line.at_us = line.at_us.saturating_sub(self.begin.get_or_insert(ClientTime(line.at_us)).0);
        let written = serde_json::to_writer(&mut *file, &line).map_err(std::io::Error::from).and_then(|()| file.write_all(b"\n"));
        if let Err(error) = written {
            tracing::warn!("{}: {error}; what follows is not recorded", self.path.display());
            self.file = None;
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if let Some(Err(error)) = self.file.as_mut().map(Write::flush) {
            tracing::warn!("{}: {error}; its end is missing", self.path.display());
        }
    }
}
