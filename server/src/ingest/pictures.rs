//! The picture thread: decodes every packet, encodes the pictures where the video is transcoded, and hands them to light.
//!
//! Pictures for light wait in a queue of their own, so that neither the broadcast nor the encoder waits for light. Where light falls behind by more than
//! [`FRAMES_WAITING`] pictures, new ones are dropped and counted.

use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::JoinHandle;

use ffmpeg_next::codec::Parameters;
use ffmpeg_next::format::Pixel;
use ffmpeg_next::{Packet, frame};
use mr360_protocol::clock::ServerTime;

use super::colour::{Tags, broadcast_pixel, nearest_supported};
use super::decode::VideoDecoder;
use super::encode::{Encoding, VideoEncoder};
use super::error::IngestError;
use super::layout::{self, Layout, LayoutFlags, SphericalMetadata};
use super::queue::Queue;
use super::raw::VideoParameters;
use super::reform::{Reform, Target, broadcast_size};
use super::shared::{Shared, count};
use super::{IngestEvent, VideoInfo};
use crate::frame::{Frame, Pixels};

/// Decoded pictures that may wait for light.
const FRAMES_WAITING: usize = 8;
/// Packets that may wait for the decoder.
const PACKETS_WAITING: usize = 64;
/// Packets inside the decoder whose time of arrival is remembered.
const ARRIVALS: usize = 128;

/// What the picture thread is asked to do, in order.
pub(super) enum Job {
    /// A packet with its timestamps in microseconds of the broadcast.
    Packet(Packet, ServerTime),
    /// From here on pictures are encoded, for this reason.
    Encode(String),
    /// The packets that follow come from elsewhere in the source.
    Seek,
}

/// What the picture thread needs to know of the stream.
#[derive(Clone)]
pub(super) struct Stream {
    pub(super) parameters: Parameters,
    pub(super) spherical: SphericalMetadata,
    pub(super) flags: LayoutFlags,
    pub(super) layout: Layout,
    pub(super) frame_rate: f64,
    pub(super) max_width: Option<u32>,
}

/// Handle of the picture thread and of the thread that feeds light.
pub(super) struct Pictures {
    jobs: Arc<Queue<Job>>,
    threads: Vec<JoinHandle<()>>,
}

impl Pictures {
    pub(super) fn start(shared: &Arc<Shared>, stream: Stream) -> Result<Self, IngestError> {
        let jobs = Arc::new(Queue::new(PACKETS_WAITING));
        let frames = Arc::new(Queue::new(FRAMES_WAITING));
        let decoder = VideoDecoder::new(&shared.name, &stream.parameters)?;
        let mut pictures = Self { jobs: Arc::clone(&jobs), threads: Vec::new() };
        let worker = Worker {
            shared: Arc::clone(shared),
            stream,
            decoder,
            frames: Arc::clone(&frames),
            arrivals: VecDeque::new(),
            reform: Reform::default(),
            because: None,
            encoder: None,
            seen: None,
        };
        let light = Arc::clone(shared);
        pictures.spawn(shared, "light feed", move || {
            while let Some((frame, decoded)) = frames.pop() {
                light.sink.event(IngestEvent::Frame(frame, decoded));
            }
        })?;
        pictures.spawn(shared, "pictures", move || worker.run(&jobs))?;
        Ok(pictures)
    }

    fn spawn(&mut self, shared: &Shared, name: &str, body: impl FnOnce() + Send + 'static) -> Result<(), IngestError> {
        let thread = std::thread::Builder::new()
            .name(format!("ingest {name}"))
            .spawn(body)
            .map_err(|error| IngestError::Thread { input: shared.name.clone(), detail: error.to_string() })?;
        self.threads.push(thread);
        Ok(())
    }

    /// Waits for room; false when the thread has given up.
    pub(super) fn push(&self, job: Job) -> bool {
        self.jobs.push(job)
    }

    /// False when there is no room.
    pub(super) fn try_push(&self, job: Job) -> bool {
        self.jobs.try_push(job)
    }

    /// Lets the threads finish what they have and waits for them.
    pub(super) fn finish(mut self) {
        self.jobs.close();
        for thread in std::mem::take(&mut self.threads) {
            // A thread that panicked has told so already.
            let _ = thread.join();
        }
    }
}

impl Drop for Pictures {
    fn drop(&mut self) {
        self.jobs.abandon();
    }
}

struct Worker {
    shared: Arc<Shared>,
    stream: Stream,
    decoder: VideoDecoder,
    frames: Arc<Queue<(Frame, ServerTime)>>,
    arrivals: VecDeque<(i64, ServerTime)>,
    reform: Reform,
    because: Option<String>,
    encoder: Option<(Encoding, VideoEncoder)>,
    /// Size and pixel format of the picture before.
    seen: Option<(u32, u32, Pixel)>,
}

impl Worker {
    fn run(mut self, jobs: &Queue<Job>) {
        let result = self.work(jobs);
        if let Err(error) = result {
            self.shared.fail(error);
        }
        jobs.abandon();
        if self.shared.watch.stopped() {
            self.frames.abandon();
        }
        self.frames.close();
    }

    fn work(&mut self, jobs: &Queue<Job>) -> Result<(), IngestError> {
        while let Some(job) = jobs.pop() {
            if self.shared.watch.stopped() {
                return Ok(());
            }
            match job {
                Job::Packet(packet, arrived) => self.packet(&packet, arrived)?,
                Job::Encode(reason) => self.because = Some(reason),
                Job::Seek => {
                    self.decoder.drain();
                    self.pictures()?;
                    self.decoder.restart();
                }
            }
        }
        self.decoder.drain();
        self.pictures()?;
        self.finish_encoder();
        Ok(())
    }

    fn packet(&mut self, packet: &Packet, arrived: ServerTime) -> Result<(), IngestError> {
        if let Some(pts) = packet.pts() {
            if self.arrivals.len() == ARRIVALS {
                self.arrivals.pop_front();
            }
            self.arrivals.push_back((pts, arrived));
        }
        if let Err(error) = self.decoder.send(packet) {
            count(&self.shared.counters.corrupt_packets);
            tracing::debug!(input = self.shared.name, %error, "the decoder refused a packet");
        }
        self.pictures()
    }

    fn pictures(&mut self) -> Result<(), IngestError> {
        loop {
            match self.decoder.receive() {
                Ok(Some(picture)) => self.picture(picture)?,
                Ok(None) => return Ok(()),
                Err(error) => {
                    count(&self.shared.counters.corrupt_packets);
                    tracing::debug!(input = self.shared.name, %error, "a picture could not be decoded");
                    return Ok(());
                }
            }
        }
    }

    fn picture(&mut self, mut picture: frame::Video) -> Result<(), IngestError> {
        let Some(pts) = picture.timestamp().or(picture.pts()) else { return Ok(()) };
        picture.set_pts(Some(pts));
        if picture.is_corrupt() || picture.has_decode_errors() {
            count(&self.shared.counters.corrupt_packets);
        }
        let decoded = self.shared.clock.now();
        self.check_format(&picture)?;
        let tags = Tags::of_frame(&picture);
        if self.because.is_some() {
            return self.transcode(picture, pts, tags, decoded);
        }
        let pixel = nearest_supported(picture.format());
        let target = Target { width: picture.width(), height: picture.height(), pixel, layout: self.stream.layout };
        let picture = self.reform.run(picture, target).map_err(|error| self.convert_error(error))?;
        self.light(picture, pts, tags, decoded);
        Ok(())
    }

    /// Notices a change of size or pixel format, and what it means for the layout.
    fn check_format(&mut self, picture: &frame::Video) -> Result<(), IngestError> {
        let format = (picture.width(), picture.height(), picture.format());
        if self.seen.replace(format).is_some_and(|seen| seen != format) {
            count(&self.shared.counters.format_changes);
            let shape = VideoParameters {
                width: format.0,
                height: format.1,
                sample_aspect: picture.aspect_ratio(),
                ..super::raw::video_parameters(&self.stream.parameters)
            };
            self.stream.layout = layout::decide(&self.shared.name, self.stream.flags, &self.stream.spherical, &shape)?;
        }
        Ok(())
    }

    fn transcode(&mut self, picture: frame::Video, pts: i64, tags: Tags, decoded: ServerTime) -> Result<(), IngestError> {
        // Pictures of packets that went out untouched before the change to transcoding.
        if !self.shared.video_rises(pts) {
            return Ok(());
        }
        let encoding = encoding(&self.stream, &tags, (picture.width(), picture.height()));
        if !self.encoder.as_ref().is_some_and(|(known, _)| *known == encoding) {
            self.finish_encoder();
            let encoder = VideoEncoder::new(&encoding).map_err(|error| encoding.error(&self.shared.name, error))?;
            self.encoder = Some((encoding, encoder));
            let audio = self.shared.announced().and_then(|(_, audio)| audio);
            self.shared.announce(video_info(&encoding, self.stream.layout, self.because.clone()), audio);
        }
        let target = Target { width: encoding.width, height: encoding.height, pixel: encoding.pixel, layout: self.stream.layout };
        let mut picture = self.reform.run(picture, target).map_err(|error| self.convert_error(error))?;
        let pts = i64::try_from(self.shared.rise_video(pts)).unwrap_or(i64::MAX);
        picture.set_pts(Some(pts));
        let Some((_, encoder)) = &mut self.encoder else { return Ok(()) };
        let coded = encoder.encode(&mut picture).map_err(|error| encoding.error(&self.shared.name, error))?;
        for unit in coded {
            let arrived = self.arrived(unit.pts_us).unwrap_or(decoded);
            self.shared.send_coded(unit, arrived);
        }
        self.light(picture, pts, tags, decoded);
        Ok(())
    }

    fn finish_encoder(&mut self) {
        let Some((_, mut encoder)) = self.encoder.take() else { return };
        let now = self.shared.clock.now();
        for unit in encoder.finish().unwrap_or_default() {
            self.shared.send_coded(unit, now);
        }
    }

    /// When the packet of this picture came in.
    fn arrived(&mut self, pts: i64) -> Option<ServerTime> {
        let index = self.arrivals.iter().position(|&(known, _)| known == pts)?;
        self.arrivals.remove(index).map(|(_, arrived)| arrived)
    }

    fn light(&self, picture: frame::Video, pts: i64, tags: Tags, decoded: ServerTime) {
        let colour = tags.colour(picture.format());
        let frame =
            Frame { pts_us: u64::try_from(pts).unwrap_or(0), stereo: self.stream.layout.stereo, pixels: Pixels::Video(picture, colour) };
        if !self.frames.try_push((frame, decoded)) && !self.shared.watch.stopped() {
            count(&self.shared.counters.frames_without_light);
        }
    }

    fn convert_error(&self, error: ffmpeg_next::Error) -> IngestError {
        IngestError::Convert { input: self.shared.name.clone(), detail: error.to_string() }
    }
}

/// How pictures with these tags and this size are encoded.
pub(super) fn encoding(stream: &Stream, tags: &Tags, (width, height): (u32, u32)) -> Encoding {
    let pixel = broadcast_pixel(tags.colour(nearest_supported(tags.pixel)), tags.pixel);
    let (width, height) = broadcast_size(stream.layout, width, height, stream.max_width);
    Encoding { width, height, pixel, colour: tags.colour(pixel), frame_rate: stream.frame_rate }
}

/// What is announced of a transcoded video.
pub(super) fn video_info(encoding: &Encoding, layout: Layout, because: Option<String>) -> VideoInfo {
    VideoInfo {
        codec: encoding.codec(),
        width: encoding.width,
        height: encoding.height,
        frame_rate: encoding.frame_rate,
        stereo: layout.stereo,
        colour: encoding.colour,
        transcoded_because: because,
    }
}
