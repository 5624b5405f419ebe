//! The decoder's thread.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::Receiver;

use ffmpeg_next as ffmpeg;
use mr360_protocol::clock::ClientTime;

use super::codec::{self, DecodeError, Opened};
use super::hardware;
use super::outbox::{NobodyListens, PictureSender};
use super::pictures::Pictures;
use super::{DecodeCounters, Decoded, Hardware, Input, VideoFormat};
use crate::sync::ClientClock;

/// Units inside the decoder whose times are remembered; reordering and GPU pipelines stay well below.
const MAX_INSIDE: usize = 64;
/// Errors in a row after which the GPU is given up.
const GPU_STRIKES: u32 = 3;
/// The first errors are logged, then one in so many.
const LOG_EVERY: u64 = 100;

/// Times of a unit inside the decoder.
struct Inside {
    pts: i64,
    arrived: ClientTime,
    blocked_before_us: u64,
}

pub(super) struct Worker {
    clock: ClientClock,
    hardware: Hardware,
    output: PictureSender,
    counters: Arc<DecodeCounters>,
    pictures: Pictures,
    decoder: Option<(Opened, VideoFormat)>,
    inside: VecDeque<Inside>,
    waits_for_keyframe: bool,
    strikes: u32,
}

impl Worker {
    pub(super) fn new(clock: ClientClock, hardware: Hardware, output: PictureSender, counters: Arc<DecodeCounters>) -> Self {
        Self {
            clock,
            hardware,
            output,
            counters,
            pictures: Pictures::new(),
            decoder: None,
            inside: VecDeque::new(),
            waits_for_keyframe: true,
            strikes: 0,
        }
    }

    pub(super) fn run(mut self, units: &Receiver<Input>) {
        while let Ok(input) = units.recv() {
            if self.decode(&input).is_err() {
                return;
            }
        }
        // The receiver may be gone by now; there is nobody left to tell.
        let _ = self.drain();
    }

    fn decode(&mut self, input: &Input) -> Result<(), NobodyListens> {
        let fits = self.decoder.as_ref().is_some_and(|(_, format)| *format == input.format);
        if (self.waits_for_keyframe || !fits) && !input.unit.keyframe {
            self.counters.unanchored.add(1);
            return Ok(());
        }
        if !fits {
            self.drain()?;
            self.reopen(input.format);
        }
        let Some((opened, _)) = self.decoder.as_mut() else {
            self.counters.errors.add(1);
            return Ok(());
        };
        let Ok(pts) = i64::try_from(input.unit.pts_us) else {
            self.count_error("presentation time out of range");
            return Ok(());
        };
        let mut packet = ffmpeg::Packet::copy(&input.unit.data);
        packet.set_pts(Some(pts));
        packet.set_dts(Some(pts));
        if input.unit.keyframe {
            packet.set_flags(ffmpeg::packet::Flags::KEY);
        }
        if self.inside.len() == MAX_INSIDE {
            self.inside.pop_front();
        }
        self.inside.push_back(Inside { pts, arrived: input.unit.arrived, blocked_before_us: input.blocked_before_us });
        let sent = opened.decoder.send_packet(&packet);
        if let Err(error) = sent {
            self.fail("decoding", error);
            return Ok(());
        }
        self.waits_for_keyframe = false;
        self.receive()
    }

    /// Everything the decoder has ready.
    fn receive(&mut self) -> Result<(), NobodyListens> {
        while let Some((opened, format)) = self.decoder.as_mut() {
            let format = *format;
            let mut frame = ffmpeg::frame::Video::empty();
            match opened.decoder.receive_frame(&mut frame) {
                Ok(()) => {}
                Err(ffmpeg::Error::Eof) => return Ok(()),
                Err(ffmpeg::Error::Other { errno }) if errno == ffmpeg::error::EAGAIN => return Ok(()),
                Err(error) => {
                    self.fail("decoding", error);
                    return Ok(());
                }
            }
            if frame.is_corrupt() {
                self.count_error("a picture is damaged");
                self.waits_for_keyframe = true;
                continue;
            }
            if hardware::is_on_device(&frame) {
                match hardware::download(&frame) {
                    Ok(copy) => frame = copy,
                    Err(error) => {
                        self.fail("reading the picture back from the GPU", error);
                        return Ok(());
                    }
                }
            }
            match self.pictures.take(&frame, &format) {
                Ok(picture) => {
                    self.strikes = 0;
                    self.hand_out(picture)?;
                }
                Err(error) => self.count_error(&error.to_string()),
            }
        }
        Ok(())
    }

    fn hand_out(&mut self, picture: crate::picture::Picture) -> Result<(), NobodyListens> {
        let decoded = self.clock.now();
        let at = self.inside.iter().position(|inside| u64::try_from(inside.pts) == Ok(picture.pts_us));
        // A pts that was never put in would break the pairing with the light.
        let Some(inside) = at.and_then(|at| self.inside.remove(at)) else {
            self.count_error("a picture came out with a time that no unit had");
            return Ok(());
        };
        let blocked_us = self.counters.blocked_us.get();
        let held_us = blocked_us.saturating_sub(inside.blocked_before_us);
        self.counters.pictures.add(1);
        let sent = self.output.send(Decoded { picture, arrived: inside.arrived, decoded, held_us });
        let stood_us = self.clock.now().0.saturating_sub(decoded.0);
        self.counters.blocked_us.add(stood_us);
        if sent? {
            self.counters.superseded.add(1);
        }
        Ok(())
    }

    /// What is still inside when the stream or its format ends.
    fn drain(&mut self) -> Result<(), NobodyListens> {
        if let Some((opened, _)) = self.decoder.as_mut()
            && opened.decoder.send_eof().is_ok()
        {
            self.receive()?;
        }
        self.decoder = None;
        self.inside.clear();
        Ok(())
    }

    fn reopen(&mut self, format: VideoFormat) {
        self.inside.clear();
        self.waits_for_keyframe = true;
        self.strikes = 0;
        match codec::open(&format, self.hardware) {
            Ok(opened) => self.decoder = Some((opened, format)),
            Err(error) => {
                self.decoder = None;
                self.report(&error);
            }
        }
    }

    /// After an error the references are broken: nothing up to the next keyframe is of use.
    fn fail(&mut self, action: &'static str, source: ffmpeg::Error) {
        let Some((opened, format)) = self.decoder.as_mut() else { return };
        let (format, on_gpu) = (*format, opened.on_gpu);
        opened.decoder.flush();
        self.inside.clear();
        self.waits_for_keyframe = true;
        self.strikes += 1;
        self.counters.errors.add(1);
        self.report(&DecodeError::Ffmpeg { codec: format.codec, action, fault: source });
        if on_gpu && self.strikes >= GPU_STRIKES {
            tracing::warn!("the GPU's decoder failed {GPU_STRIKES} times in a row; going on in software");
            self.hardware = Hardware::Never;
            self.reopen(format);
        }
    }

    fn report(&self, error: &DecodeError) {
        if self.counters.errors.get().is_multiple_of(LOG_EVERY) || self.counters.errors.get() <= 3 {
            tracing::warn!(errors = self.counters.errors.get(), "{error}; waiting for the next keyframe");
        }
    }

    fn count_error(&self, what: &str) {
        self.counters.errors.add(1);
        if self.counters.errors.get().is_multiple_of(LOG_EVERY) || self.counters.errors.get() <= 3 {
            tracing::warn!(errors = self.counters.errors.get(), "{what}; the picture is dropped");
        }
    }
}
