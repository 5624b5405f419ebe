//! Writes what a user does.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use mr360_protocol::clock::ClientTime;

use super::{Deed, Line, ScriptError};

/// Deeds that wait for the disk: half a minute of hands.
const WAITING: usize = 4096;

/// A script in the making, written by a thread of its own: whoever does a deed never waits for the disk. Lines that cannot be written, as on a
/// full disk, end it with a warning; the session goes on.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    /// None once it has ended.
    lines: Option<SyncSender<Line>>,
    writer: Option<JoinHandle<()>>,
    /// The script's time begins with the first deed.
    begin: Option<ClientTime>,
}

impl Recorder {
    /// Creates the file.
    ///
    /// # Errors
    /// [`ScriptError::Write`].
    pub fn create(path: &Path) -> Result<Self, ScriptError> {
        let failed = |error: std::io::Error| ScriptError::Write { path: path.to_owned(), fault: error.to_string() };
        let file = File::create(path).map_err(failed)?;
        let (lines, waiting) = sync_channel(WAITING);
        let name = path.to_owned();
        let writer = std::thread::Builder::new().name("script".to_owned()).spawn(move || write(&name, file, &waiting)).map_err(failed)?;
        Ok(Self { path: path.to_owned(), lines: Some(lines), writer: Some(writer), begin: None })
    }

    /// Writes one deed, done at its time of the client's clock. Never blocks.
    pub fn write(&mut self, deed: &Deed) {
        let Some(lines) = &self.lines else { return };
        let mut line = deed.line();
        line.at_us = line.at_us.saturating_sub(self.begin.get_or_insert(ClientTime(line.at_us)).0);
        match lines.try_send(line) {
            Ok(()) => return,
            Err(TrySendError::Full(_)) => {
                tracing::warn!("{}: the disk is too slow; what follows is not recorded", self.path.display());
            }
            // The writer has said why.
            Err(TrySendError::Disconnected(_)) => {}
        }
        // A script with gaps would do something else.
        self.lines = None;
    }
}

fn write(path: &Path, file: File, lines: &Receiver<Line>) {
    let mut file = BufWriter::new(file);
    for line in lines {
        let written = serde_json::to_writer(&mut file, &line).map_err(std::io::Error::from).and_then(|()| file.write_all(b"\n"));
        if let Err(error) = written {
            tracing::warn!("{}: {error}; what follows is not recorded", path.display());
            return;
        }
    }
    if let Err(error) = file.flush() {
        tracing::warn!("{}: {error}; its end is missing", path.display());
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.lines = None;
        // A writer that panicked has written nothing more; there is nothing to be done about it here.
        let _ = self.writer.take().map(JoinHandle::join);
    }
}

#[cfg(all(test, unix))]
mod tests {
    use mr360_protocol::intent::Action;
    use mr360_protocol::scene::ObjectId;

    use super::*;

    #[test]
    fn a_disk_that_takes_nothing_holds_nobody_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        // Open for reading, too, so that writing to it waits instead of failing; nobody reads.
        let file = std::fs::OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let (lines, waiting) = sync_channel(WAITING);
        let (name, to_pipe) = (path.clone(), file.try_clone().unwrap());
        let writer = std::thread::spawn(move || write(&name, to_pipe, &waiting));
        let mut recorder = Recorder { path, lines: Some(lines), writer: None, begin: None };
        let mut written = 0;
        while recorder.lines.is_some() {
            recorder.write(&Deed::Action(ClientTime(written), Action::Grab(ObjectId(1))));
            written += 1;
            assert!(written < 1_000_000, "it does not end");
        }
        assert!(written > WAITING as u64);
        // Let the writer end: read what it writes.
        let mut reader = File::open(&recorder.path).unwrap();
        drop(file);
        let reading = std::thread::spawn(move || std::io::copy(&mut reader, &mut std::io::sink()).unwrap());
        writer.join().unwrap();
        assert!(reading.join().unwrap() > 1_000);
    }
}
