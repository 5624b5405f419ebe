//! Writes what a user does.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, TrySendError, channel, sync_channel};
use std::time::Duration;

use mr360_protocol::clock::ClientTime;

use super::{Deed, Line, MAX_AT_US, MAX_BYTES, MAX_DEEDS, ScriptError};

/// Deeds that wait for the disk: half a minute of hands.
const WAITING: usize = 4096;
/// At its end a session waits so long for the disk.
const PATIENCE: Duration = Duration::from_secs(5);

/// How long a script may become.
#[derive(Debug, Clone, Copy)]
struct Bounds {
    bytes: u64,
    deeds: usize,
    at_us: u64,
}

impl Bounds {
    /// Of what [`super::load`] takes.
    const LOADED: Self = Self { bytes: MAX_BYTES, deeds: MAX_DEEDS, at_us: MAX_AT_US };
}

/// A script in the making, written by a thread of its own: whoever does a deed never waits for the disk. Lines that cannot be written, as on a
/// full disk, or would make it longer than what is played, end it with a warning; the session goes on.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    /// None once it has ended.
    lines: Option<SyncSender<Line>>,
    /// Closed by the writer when the file is.
    ended: Receiver<()>,
    patience: Duration,
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
        let (ending, ended) = channel();
        let writer = move || write(&name, file, &waiting, Bounds::LOADED, ending);
        std::thread::Builder::new().name("script".to_owned()).spawn(writer).map_err(failed)?;
        Ok(Self { path: path.to_owned(), lines: Some(lines), ended, patience: PATIENCE, begin: None })
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

/// Writes lines until there are no more; then closes the file, and after it `ending`.
fn write(path: &Path, file: impl Write, lines: &Receiver<Line>, bounds: Bounds, ending: Sender<()>) {
    let mut file = BufWriter::new(file);
    if let Err(error) = write_within(bounds, path, &mut file, lines) {
        tracing::warn!("{}: {error}; what follows is not recorded", path.display());
    } else if let Err(error) = file.flush() {
        tracing::warn!("{}: {error}; its end is missing", path.display());
    }
    drop(file);
    drop(ending);
}

/// Writes lines until there are no more, or one would be too much.
fn write_within(bounds: Bounds, path: &Path, file: &mut impl Write, lines: &Receiver<Line>) -> std::io::Result<()> {
    let (mut bytes, mut deeds) = (0, 0);
    for line in lines {
        let mut text = serde_json::to_vec(&line)?;
        text.push(b'\n');
        bytes += text.len() as u64;
        deeds += 1;
        if bytes > bounds.bytes || deeds > bounds.deeds || line.at_us > bounds.at_us {
            let Bounds { bytes, deeds, at_us } = bounds;
            tracing::warn!(
                "{}: a script has at most {bytes} bytes, {deeds} deeds and {} s; what follows is not recorded",
                path.display(),
                at_us / 1_000_000
            );
            return Ok(());
        }
        file.write_all(&text)?;
    }
    Ok(())
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.lines = None;
        // A writer that panicked has closed it, too; it has written nothing more, and there is nothing to be done about it here.
        if self.ended.recv_timeout(self.patience) == Err(RecvTimeoutError::Timeout) {
            tracing::warn!("{}: the disk does not take what was recorded; its end is missing", self.path.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::intent::Action;
    use mr360_protocol::scene::ObjectId;

    use super::*;

    fn grab(at_us: u64) -> Deed {
        Deed::Action(ClientTime(at_us), Action::Grab(ObjectId(1)))
    }

    /// How many of four deeds, a second from each other and as long as each other, are written.
    fn written(bounds: Bounds) -> usize {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("script.jsonl");
        let (lines, waiting) = sync_channel(4);
        (1..=4).for_each(|second| lines.send(grab(second * 1_000_000).line()).unwrap());
        drop(lines);
        let (ending, ended) = channel();
        write(&path, File::create(&path).unwrap(), &waiting, bounds, ending);
        assert_eq!(ended.recv(), Err(std::sync::mpsc::RecvError));
        super::super::load(&path).unwrap().len()
    }

    #[test]
    fn a_recording_ends_where_it_could_no_longer_be_played() {
        let length = serde_json::to_vec(&grab(1_000_000).line()).unwrap().len() as u64 + 1;
        assert_eq!(written(Bounds::LOADED), 4);
        assert_eq!([1, 2, 4].map(|deeds| written(Bounds { deeds, ..Bounds::LOADED })), [1, 2, 4]);
        assert_eq!([length, 3 * length - 1, 4 * length].map(|bytes| written(Bounds { bytes, ..Bounds::LOADED })), [1, 2, 4]);
        assert_eq!([999_999, 2_000_000, 4_000_000].map(|at_us| written(Bounds { at_us, ..Bounds::LOADED })), [0, 2, 4]);
    }

    #[test]
    fn what_was_recorded_for_longer_than_a_day_can_be_played() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("script.jsonl");
        let mut recorder = Recorder::create(&path).unwrap();
        [7, 7 + MAX_AT_US, 8 + MAX_AT_US, 9 + MAX_AT_US].into_iter().for_each(|at_us| recorder.write(&grab(at_us)));
        drop(recorder);
        let deeds = super::super::load(&path).unwrap();
        assert_eq!(deeds.iter().map(|deed| deed.at().0).collect::<Vec<_>>(), [0, MAX_AT_US]);
    }

    #[cfg(unix)]
    #[test]
    fn a_disk_that_takes_nothing_holds_nobody_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        // Open for reading, too, so that writing to it waits instead of failing; nobody reads.
        let file = std::fs::OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let (lines, waiting) = sync_channel(WAITING);
        let (name, to_pipe) = (path.clone(), file.try_clone().unwrap());
        let (ending, ended) = channel();
        let writer = std::thread::spawn(move || write(&name, to_pipe, &waiting, Bounds::LOADED, ending));
        let mut recorder = Recorder { path: path.clone(), lines: Some(lines), ended, patience: Duration::from_millis(1), begin: None };
        let mut written = 0;
        while recorder.lines.is_some() {
            recorder.write(&grab(written));
            written += 1;
            assert!(written < 1_000_000, "it does not end");
        }
        assert!(written > WAITING as u64);
        // Nor at the end, though the writer is not done.
        drop(recorder);
        assert!(!writer.is_finished());
        // Let the writer end: read what it writes.
        let mut reader = File::open(&path).unwrap();
        drop(file);
        let reading = std::thread::spawn(move || std::io::copy(&mut reader, &mut std::io::sink()).unwrap());
        writer.join().unwrap();
        assert!(reading.join().unwrap() > 1_000);
    }
}
