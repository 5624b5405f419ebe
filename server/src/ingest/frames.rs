//! Decoding without pace or broadcast, for analysis.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use ffmpeg_next::{Error, Packet};
use mr360_protocol::video::{Colour, StereoLayout};

use super::colour::{Tags, nearest_supported};
use super::decode::VideoDecoder;
use super::error::IngestError;
use super::layout::{self, Layout, LayoutFlags, Projection, SphericalMetadata};
use super::open::{self, Opened};
use super::raw::{self, VideoParameters};
use super::reform::{Reform, Target, broadcast_size};
use super::session::MAX_BAD_READS;
use super::source::Source;
use super::synthetic::{self, FrameSource};
use super::timeline::{Rising, micros, shown};
use super::watch::Watch;
use super::{IngestConfig, SILENCE};
use crate::frame::{Frame, Pixels};

/// What is known of the pictures.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DecodeOptions {
    /// Stereo layout; overrules metadata.
    pub stereo: Option<StereoLayout>,
    /// Projection; overrules metadata.
    pub projection: Option<Projection>,
}

/// Decodes a source as fast as it can be read, first frame at zero. Synthetic sources never end.
///
/// # Errors
/// As [`super::spawn`], for network sources too. While iterating: when the stream is lost, ends without a single picture, or its pictures can no
/// longer be used. Damage that is survived is logged.
pub fn decode_frames(source: &Source, options: DecodeOptions) -> Result<DecodedFrames, IngestError> {
    super::run::init()?;
    let name = source.to_string();
    IngestConfig { stereo: options.stereo, projection: options.projection, ..IngestConfig::new(source.clone()) }.check()?;
    if let Source::Synthetic(text) = source {
        return Ok(DecodedFrames { inner: Inner::Synthetic(synthetic::parse(text)?, 0) });
    }
    let watch = Watch::new();
    let opened = open::open(source, SILENCE, &watch)?;
    let flags = LayoutFlags { stereo: options.stereo, projection: options.projection };
    let video = raw::video_parameters(&opened.video.parameters);
    let layout = layout::decide(&name, flags, &opened.video.spherical, &video)?;
    let decoder = VideoDecoder::new(&name, &opened.video.parameters)?;
    let layout = Some((video.width, video.height, layout));
    let spherical = opened.video.spherical.clone();
    let stream = Box::new(StreamFrames {
        name,
        watch,
        opened,
        decoder,
        flags,
        spherical,
        reform: Reform::default(),
        ready: VecDeque::new(),
        layout,
        first_us: None,
        last_us: None,
        rising: Rising::default(),
        bad_reads: 0,
        silent: false,
        refused: 0,
        over: false,
    });
    Ok(DecodedFrames { inner: Inner::Stream(stream) })
}

/// Iterator over decoded frames; after an error it ends.
pub struct DecodedFrames {
    inner: Inner,
}

enum Inner {
    Stream(Box<StreamFrames>),
    Synthetic(Box<dyn FrameSource>, u64),
}

impl Iterator for DecodedFrames {
    type Item = Result<Frame, IngestError>;

    fn next(&mut self) -> Option<Self::Item> {
        match &mut self.inner {
            Inner::Stream(stream) => stream.next(),
            Inner::Synthetic(source, index) => {
                let picture = synthetic::render(source.as_mut(), *index);
                let pts_us = (*index as f64 * 1_000_000.0 / source.info().2) as u64;
                *index += 1;
                Some(Ok(Frame { pts_us, stereo: StereoLayout::Mono, pixels: Pixels::Video(picture, Colour::default()) }))
            }
        }
    }
}

struct StreamFrames {
    name: String,
    watch: Watch,
    opened: Opened,
    decoder: VideoDecoder,
    flags: LayoutFlags,
    spherical: SphericalMetadata,
    reform: Reform,
    ready: VecDeque<ffmpeg_next::frame::Video>,
    /// Size of the picture before, and the layout that holds for it.
    layout: Option<(u32, u32, Layout)>,
    first_us: Option<i64>,
    last_us: Option<i64>,
    rising: Rising,
    /// Refused reads in a row.
    bad_reads: u32,
    /// The last read brought nothing, and no more time is allowed for it.
    silent: bool,
    /// Packets and pictures that the demuxer or decoder refused.
    refused: u64,
    over: bool,
}

impl StreamFrames {
    fn next(&mut self) -> Option<Result<Frame, IngestError>> {
        loop {
            if let Some(picture) = self.ready.pop_front() {
                let frame = self.frame(picture);
                self.over |= frame.is_err();
                return Some(frame);
            }
            if self.over {
                return None;
            }
            if let Err(error) = self.read() {
                self.over = true;
                return Some(Err(error));
            }
        }
    }

    /// Reads one packet and takes the pictures that it completes.
    fn read(&mut self) -> Result<(), IngestError> {
        if !self.silent {
            self.watch.allow(SILENCE);
        }
        let mut packet = Packet::empty();
        match packet.read(&mut self.opened.input) {
            Ok(()) => {
                (self.bad_reads, self.silent) = (0, false);
                if packet.stream() != self.opened.video.index {
                    return Ok(());
                }
                self.decode(packet);
            }
            Err(Error::InvalidData) if self.bad_reads < MAX_BAD_READS => {
                (self.bad_reads, self.silent) = (self.bad_reads + 1, false);
                self.refuse(Error::InvalidData);
                return Ok(());
            }
            Err(Error::Other { errno }) if errno == ffmpeg_next::error::EAGAIN && !self.watch.interrupts() => {
                self.silent = true;
                self.watch.sleep_until(Instant::now() + Duration::from_millis(5));
                return Ok(());
            }
            Err(Error::Eof) => {
                self.over = true;
                self.decoder.drain();
            }
            Err(error) => {
                let detail = if self.watch.timed_out() { format!("no data for {SILENCE:?}") } else { error.to_string() };
                return Err(IngestError::Lost { input: self.name.clone(), detail });
            }
        }
        self.receive();
        if self.over { self.end() } else { Ok(()) }
    }

    fn decode(&mut self, mut packet: Packet) {
        let time_base = self.opened.video.time_base;
        let pts_us = packet.pts().map(|pts| micros(pts, time_base));
        let dts_us = packet.dts().map(|dts| micros(dts, time_base));
        packet.set_pts(match (pts_us, dts_us) {
            (Some(_), Some(dts_us)) => Some(shown(pts_us, dts_us, self.step_us()).0),
            _ => pts_us,
        });
        packet.set_dts(dts_us);
        if let Err(error) = self.decoder.send(&packet) {
            self.refuse(error);
        }
    }

    fn receive(&mut self) {
        loop {
            match self.decoder.receive() {
                Ok(Some(picture)) => self.ready.push_back(picture),
                Ok(None) => return,
                Err(error) => return self.refuse(error),
            }
        }
    }

    /// Damage is the decoder's to skip; it is told once, and in full at the end.
    fn refuse(&mut self, error: Error) {
        self.refused += 1;
        if self.refused == 1 {
            tracing::warn!(input = self.name, %error, "damaged packets are skipped");
        } else {
            tracing::debug!(input = self.name, %error, "a packet was refused");
        }
    }

    /// The source is over.
    fn end(&self) -> Result<(), IngestError> {
        if self.first_us.is_none() && self.ready.is_empty() {
            let detail = format!("no picture could be decoded, {} packets were refused", self.refused);
            return Err(IngestError::NotAVideo { input: self.name.clone(), detail });
        }
        if self.refused > 0 {
            tracing::warn!(input = self.name, packets = self.refused, "damage was skipped");
        }
        Ok(())
    }

    fn step_us(&self) -> i64 {
        (1_000_000.0 / self.opened.video.frame_rate) as i64
    }

    fn frame(&mut self, mut picture: ffmpeg_next::frame::Video) -> Result<Frame, IngestError> {
        let step_us = self.step_us();
        let pts_us = picture.timestamp().or(picture.pts());
        let first_us = *self.first_us.get_or_insert(pts_us.unwrap_or(0));
        let wanted = pts_us.map_or(self.last_us.map_or(0, |last| last + step_us), |pts| pts - first_us);
        let pts_us = self.rising.rise(wanted);
        self.last_us = i64::try_from(pts_us).ok();
        picture.set_pts(i64::try_from(pts_us).ok());
        let shape = VideoParameters {
            width: picture.width(),
            height: picture.height(),
            sample_aspect: picture.aspect_ratio(),
            ..raw::video_parameters(&self.opened.video.parameters)
        };
        let tags = Tags::of_frame(&picture);
        let layout = match self.layout {
            Some((width, height, layout)) if (width, height) == (shape.width, shape.height) => layout,
            _ => layout::decide(&self.name, self.flags, &self.spherical, &shape)?,
        };
        self.layout = Some((shape.width, shape.height, layout));
        let pixel = nearest_supported(picture.format());
        let (width, height) = match layout.projection {
            Projection::Equirect => (shape.width, shape.height),
            _ => broadcast_size(layout, shape.width, shape.height, None),
        };
        let picture = self
            .reform
            .run(picture, Target { width, height, pixel, layout })
            .map_err(|error| IngestError::Convert { input: self.name.clone(), detail: error.to_string() })?;
        let colour = tags.colour(pixel);
        Ok(Frame { pts_us, stereo: layout.stereo, pixels: Pixels::Video(picture, colour) })
    }
}
