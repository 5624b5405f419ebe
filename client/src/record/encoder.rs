//! One fragmented MP4 with one H.264 track.

use std::path::Path;

use ffmpeg_next as ffmpeg;
use ffmpeg_next::Rational;
use ffmpeg_next::format::Pixel;

use super::{MAX_SIDE, RecordError, yuv};

/// Times are kept to the microsecond.
const TIME_BASE: Rational = Rational(1, 1_000_000);
/// Frames a second at most, in the main.
const NOMINAL_RATE: Rational = Rational(60, 1);
/// Frames from one keyframe, and so from one fragment, to the next.
const GOP_FRAMES: u32 = 30;

/// What became of the frames.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(super) struct Written {
    /// In the file.
    pub(super) frames: u64,
    /// Left out: they did not come after the one before.
    pub(super) skipped: u64,
}

/// An open file.
pub(super) struct Mp4 {
    path: String,
    output: ffmpeg::format::context::Output,
    encoder: ffmpeg::encoder::Video,
    stream_time_base: Rational,
    width: usize,
    height: usize,
    first_us: Option<u64>,
    last_pts: i64,
    /// Time from the frame before the last to the last, microseconds: the guess for how long the last one stays.
    step_us: i64,
    written: Written,
}

impl Mp4 {
    pub(super) fn create(path: &Path, width: u32, height: u32) -> Result<Self, RecordError> {
        let name = path.to_str().filter(|name| !name.contains('\0')).ok_or_else(|| RecordError::Path { path: path.to_owned() })?.to_owned();
        if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
            return Err(RecordError::Size { width, height });
        }
        let encoder = open_encoder(width.next_multiple_of(2), height.next_multiple_of(2), &name)?;
        let failed = |action, source| failure(&name, action, source);
        let mut output = ffmpeg::format::output_as(&name, "mp4").map_err(|e| failed("creating the file", e))?;
        output.add_stream_with(&encoder).map_err(|e| failed("adding the video track", e))?.set_time_base(TIME_BASE);
        let mut options = ffmpeg::Dictionary::new();
        options.set("movflags", "frag_keyframe+empty_moov+default_base_moof");
        options.set("flush_packets", "1");
        output.write_header_with(options).map_err(|e| failed("writing the header", e))?;
        let stream_time_base = output.stream(0).map_or(TIME_BASE, |stream| stream.time_base());
        let (width, height) = (width as usize, height as usize);
        Ok(Self {
            path: name,
            output,
            encoder,
            stream_time_base,
            width,
            height,
            first_us: None,
            last_pts: -1,
            step_us: 1_000_000 / 30,
            written: Written::default(),
        })
    }

    /// Takes RGBA8 of the size given at the start. Frames that do not come after the one before are left out and counted.
    pub(super) fn write(&mut self, time_us: u64, rgba: &[u8]) -> Result<(), RecordError> {
        let first = *self.first_us.get_or_insert(time_us);
        let pts = time_us.checked_sub(first).and_then(|since| i64::try_from(since).ok());
        let Some(pts) = pts.filter(|pts| *pts > self.last_pts) else {
            self.written.skipped += 1;
            return Ok(());
        };
        let mut frame = ffmpeg::frame::Video::new(Pixel::YUV420P, self.encoder.width(), self.encoder.height());
        yuv::fill(&mut frame, rgba, self.width, self.height);
        frame.set_pts(Some(pts));
        if self.last_pts >= 0 {
            self.step_us = pts - self.last_pts;
        }
        self.last_pts = pts;
        self.encoder.send_frame(&frame).map_err(|e| failure(&self.path, "encoding", e))?;
        self.write_packets()?;
        self.written.frames += 1;
        Ok(())
    }

    /// Closes the file.
    pub(super) fn finish(mut self) -> Result<Written, RecordError> {
        self.encoder.send_eof().map_err(|e| failure(&self.path, "encoding", e))?;
        self.write_packets()?;
        self.output.write_trailer().map_err(|e| failure(&self.path, "closing the file", e))?;
        Ok(self.written)
    }

    fn write_packets(&mut self) -> Result<(), RecordError> {
        let mut packet = ffmpeg::Packet::empty();
        while self.encoder.receive_packet(&mut packet).is_ok() {
            packet.set_stream(0);
            packet.set_duration(self.step_us);
            packet.rescale_ts(TIME_BASE, self.stream_time_base);
            packet.write_interleaved(&mut self.output).map_err(|e| failure(&self.path, "writing", e))?;
        }
        Ok(())
    }
}

fn open_encoder(width: u32, height: u32, path: &str) -> Result<ffmpeg::encoder::Video, RecordError> {
    let failed = |source| failure(path, "opening the encoder", source);
    let codec = ffmpeg::encoder::find_by_name("libx264").ok_or(RecordError::NoEncoder)?;
    let mut context = ffmpeg::codec::Context::new_with_codec(codec);
    // The header of a fragmented file is written first: it needs the parameter sets at once.
    context.set_flags(ffmpeg::codec::Flags::GLOBAL_HEADER);
    let mut encoder = context.encoder().video().map_err(failed)?;
    encoder.set_width(width);
    encoder.set_height(height);
    encoder.set_format(Pixel::YUV420P);
    encoder.set_time_base(TIME_BASE);
    // Frames come when they come; this is what H.264's level is reckoned from.
    encoder.set_frame_rate(Some(NOMINAL_RATE));
    encoder.set_gop(GOP_FRAMES);
    encoder.set_max_b_frames(0);
    encoder.set_colorspace(ffmpeg::color::Space::BT709);
    encoder.set_color_primaries(ffmpeg::color::Primaries::BT709);
    encoder.set_color_transfer_characteristic(ffmpeg::color::TransferCharacteristic::BT709);
    encoder.set_color_range(ffmpeg::color::Range::MPEG);
    let mut options = ffmpeg::Dictionary::new();
    // Fast enough to run beside the renderer; no lookahead, so that little is lost in a crash.
    options.set("preset", "veryfast");
    options.set("tune", "zerolatency");
    options.set("crf", "18");
    encoder.open_with(options).map_err(failed)
}

fn failure(path: &str, action: &'static str, source: ffmpeg::Error) -> RecordError {
    let path = path.to_owned();
    match source {
        ffmpeg::Error::Other { errno } if errno == ffmpeg::error::ENOSPC => RecordError::DiskFull { path },
        fault => RecordError::Ffmpeg { path, action, fault },
    }
}
