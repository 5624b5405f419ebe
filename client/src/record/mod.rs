//! Writes what was rendered: MP4 by libx264, and PNG.
//!
//! The MP4 is fragmented, one fragment a GOP, so that a crash leaves a playable file.

mod encoder;
mod picture_file;
mod yuv;

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use ffmpeg_next as ffmpeg;

pub use self::picture_file::PictureFile;

use self::encoder::{Mp4, Written};

/// Largest side recorded, pixels: H.264 level 6.2.
pub const MAX_SIDE: u32 = 8192;
/// Frames that wait for the encoder.
const QUEUED_FRAMES: usize = 4;

/// Why nothing, or nothing more, is recorded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// A path that FFmpeg cannot be given.
    #[error("{path:?} cannot be written: the path is not UTF-8; choose another name")]
    Path {
        /// The path.
        path: PathBuf,
    },
    /// Zero or too large.
    #[error("a recording of {width}×{height} is not possible, each side must be 1 to {MAX_SIDE}; choose another size")]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// This FFmpeg was built without libx264.
    #[error("recording needs libx264, which this FFmpeg lacks; install an FFmpeg built with it")]
    NoEncoder,
    /// No space left on the device.
    #[error(
        "{path}: the disk is full, there is no space left; the recording ends here, and what it holds stays playable. Free some space or choose another place"
    )]
    DiskFull {
        /// The file.
        path: String,
    },
    /// Anything else FFmpeg reports.
    #[error("{path}: {action} failed ({fault}); check that the folder exists and can be written to")]
    Ffmpeg {
        /// The file.
        path: String,
        /// What was tried.
        action: &'static str,
        /// FFmpeg's error.
        fault: ffmpeg::Error,
    },
    /// The frame does not have the size that the recording began with.
    #[error("frame of {got} bytes given to a recording of {width}×{height} RGBA")]
    FrameSize {
        /// Bytes given.
        got: usize,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// A picture file could not be written.
    #[error("{path}: writing the picture failed ({detail}); check that the folder exists, can be written to, and has space")]
    Picture {
        /// The file.
        path: String,
        /// What was wrong.
        detail: String,
    },
    /// The encoder's thread did not start or ended by a panic.
    #[error("the recorder's thread failed ({detail})")]
    Thread {
        /// What was wrong.
        detail: String,
    },
}

/// What a finished recording holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordReport {
    /// Frames in the file.
    pub frames: u64,
    /// Frames left out: the encoder could not keep up, or they did not come after the one before.
    pub dropped: u64,
}

/// One rendered frame.
struct RgbaFrame {
    time_us: u64,
    texels: Vec<u8>,
}

/// Records on a thread of its own. A failure ends the recording, is logged once and reported by [`Recorder::finish`]; whoever
/// pushes frames goes on undisturbed.
pub struct Recorder {
    frames: Option<SyncSender<RgbaFrame>>,
    /// Buffers on their way back.
    used: Receiver<Vec<u8>>,
    thread: Option<JoinHandle<Result<Written, RecordError>>>,
    width: u32,
    height: u32,
    dropped: u64,
    failed: bool,
}

impl Recorder {
    /// Creates the file, with its header. A disk that is full by then ends the recording as one that fills later does.
    ///
    /// # Errors
    /// [`RecordError`] when the file cannot be created or the size not be encoded.
    pub fn start(path: &Path, width: u32, height: u32) -> Result<Self, RecordError> {
        let mp4 = match Mp4::create(path, width, height) {
            Err(error) if !matches!(error, RecordError::DiskFull { .. }) => return Err(error),
            created => created,
        };
        let (frames, queue) = sync_channel::<RgbaFrame>(QUEUED_FRAMES);
        let (give_back, used) = sync_channel(QUEUED_FRAMES + 2);
        let thread = std::thread::Builder::new()
            .name("record".to_owned())
            .spawn(move || encode(mp4, &queue, &give_back))
            .map_err(|error| RecordError::Thread { detail: error.to_string() })?;
        Ok(Self { frames: Some(frames), used, thread: Some(thread), width, height, dropped: 0, failed: false })
    }

    /// Takes tightly packed RGBA8, sRGB-encoded, row by row from the top, shown at `time_us`. Never blocks: what the encoder has no
    /// room for is left out and counted, and so is a frame that does not come after the one before.
    ///
    /// # Errors
    /// [`RecordError::FrameSize`].
    pub fn push(&mut self, time_us: u64, rgba: &[u8]) -> Result<(), RecordError> {
        let expected = self.width as usize * self.height as usize * 4;
        if rgba.len() != expected {
            return Err(RecordError::FrameSize { got: rgba.len(), width: self.width, height: self.height });
        }
        let Some(frames) = self.frames.as_ref().filter(|_| !self.failed) else { return Ok(()) };
        let mut texels = self.used.try_recv().unwrap_or_default();
        texels.clear();
        texels.extend_from_slice(rgba);
        match frames.try_send(RgbaFrame { time_us, texels }) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => self.dropped += 1,
            Err(TrySendError::Disconnected(_)) => self.failed = true,
        }
        Ok(())
    }

    /// True once the recording has ended by a failure.
    #[must_use]
    pub fn has_failed(&self) -> bool {
        self.failed
    }

    /// Writes what is still inside and closes the file.
    ///
    /// # Errors
    /// The failure that ended the recording, if one did.
    pub fn finish(mut self) -> Result<RecordReport, RecordError> {
        self.frames = None;
        let joined = self.thread.take().map(JoinHandle::join);
        match joined {
            Some(Ok(result)) => result.map(|written| RecordReport { frames: written.frames, dropped: self.dropped + written.skipped }),
            Some(Err(_)) | None => Err(RecordError::Thread { detail: "it panicked".to_owned() }),
        }
    }
}

impl Drop for Recorder {
    /// Leaves a whole file behind when the session ends by an error; what went wrong is in the log by then.
    fn drop(&mut self) {
        self.frames = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn encode(created: Result<Mp4, RecordError>, queue: &Receiver<RgbaFrame>, give_back: &SyncSender<Vec<u8>>) -> Result<Written, RecordError> {
    let result = created.and_then(|mut mp4| {
        for frame in queue {
            mp4.write(frame.time_us, &frame.texels)?;
            // With the buffer full of buffers, this one is simply freed.
            let _ = give_back.try_send(frame.texels);
        }
        mp4.finish()
    });
    if let Err(error) = &result {
        tracing::error!("recording stopped: {error}");
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: u32, height: u32, value: u8) -> Vec<u8> {
        (0..width * height).flat_map(|_| [value, value, value, 255]).collect()
    }

    /// (pts in µs, luma of the first sample, width, height) of every frame in a file.
    fn read(path: &Path) -> Vec<(i64, u8, u32, u32)> {
        let mut input = ffmpeg::format::input(path).unwrap();
        let stream = input.streams().next().unwrap();
        let time_base = stream.time_base();
        let mut decoder = ffmpeg::codec::Context::from_parameters(stream.parameters()).unwrap().decoder().video().unwrap();
        assert_eq!(decoder.color_space(), ffmpeg::color::Space::BT709);
        let mut frames = Vec::new();
        let mut frame = ffmpeg::frame::Video::empty();
        let mut take = |decoder: &mut ffmpeg::decoder::Video| {
            while decoder.receive_frame(&mut frame).is_ok() {
                let us = frame.pts().unwrap() * 1_000_000 * i64::from(time_base.0) / i64::from(time_base.1);
                frames.push((us, frame.data(0)[0], frame.width(), frame.height()));
            }
        };
        for (_, packet) in input.packets() {
            decoder.send_packet(&packet).unwrap();
            take(&mut decoder);
        }
        decoder.send_eof().unwrap();
        take(&mut decoder);
        frames
    }

    #[test]
    fn uneven_times_and_odd_sizes_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.mp4");
        let mut mp4 = Mp4::create(&path, 33, 17).unwrap();
        for (i, time) in [1_000_000, 1_033_333, 1_050_001, 1_050_001, 1_200_000].into_iter().enumerate() {
            mp4.write(time, &grey(33, 17, 40 * i as u8)).unwrap();
        }
        // The fourth has the time of the third and is left out.
        assert_eq!(mp4.finish().unwrap(), Written { frames: 4, skipped: 1 });
        let frames = read(&path);
        assert_eq!(
            frames.iter().map(|f| (f.0, f.2, f.3)).collect::<Vec<_>>(),
            [(0, 34, 18), (33_333, 34, 18), (50_001, 34, 18), (200_000, 34, 18)]
        );
        // Grey g becomes 16 + 219 g/255; x264 stays within two codes on flat frames.
        for (frame, grey) in frames.iter().zip([0.0, 40.0, 80.0, 160.0]) {
            assert!((f32::from(frame.1) - (16.0 + 219.0 * grey / 255.0)).abs() <= 2.5, "{frame:?}");
        }
    }

    #[test]
    fn a_crash_leaves_a_playable_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.mp4");
        let mut mp4 = Mp4::create(&path, 64, 32).unwrap();
        for i in 0..90_u64 {
            mp4.write(i * 33_333, &grey(64, 32, i as u8)).unwrap();
        }
        let copy = folder.path().join("crashed.mp4");
        std::fs::copy(&path, &copy).unwrap();
        drop(mp4);
        // Whole fragments only: one a second.
        assert!(read(&copy).len() >= 30, "{}", read(&copy).len());
    }

    #[test]
    fn a_full_disk_is_named_and_stops_only_the_recording() {
        let error = Mp4::create(Path::new("/dev/full"), 64, 64)
            .and_then(|mut mp4| {
                (0..200_u64).try_for_each(|i| mp4.write(i * 33_333, &grey(64, 64, i as u8)))?;
                mp4.finish()
            })
            .unwrap_err();
        assert!(matches!(error, RecordError::DiskFull { .. }), "{error}");
    }

    #[test]
    fn a_disk_that_is_full_from_the_start_fails_nobody_but_the_recording() {
        let mut recorder = Recorder::start(Path::new("/dev/full"), 16, 16).unwrap();
        while !recorder.has_failed() {
            recorder.push(0, &grey(16, 16, 9)).unwrap();
        }
        assert!(matches!(recorder.finish(), Err(RecordError::DiskFull { .. })));
    }

    #[test]
    fn the_recorder_survives_the_end_of_its_thread() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = Recorder::start(&folder.path().join("out.mp4"), 16, 16).unwrap();
        assert!(matches!(recorder.push(0, &[0; 3]), Err(RecordError::FrameSize { got: 3, .. })));
        recorder.push(0, &grey(16, 16, 9)).unwrap();
        assert_eq!(recorder.finish().unwrap(), RecordReport { frames: 1, dropped: 0 });
        assert!(matches!(Recorder::start(&folder.path().join("no/out.mp4"), 16, 16), Err(RecordError::Ffmpeg { .. })));
        assert!(matches!(Recorder::start(&folder.path().join("out.mp4"), 0, 16), Err(RecordError::Size { .. })));
    }
}
