//! The default output device, by cpal.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use cpal::traits::{DeviceTrait, HostTrait, StreamTrait};
use cpal::{FromSample, OutputCallbackInfo, SampleFormat, SizedSample, StreamConfig};
use mr360_protocol::clock::ClientTime;

use super::{Playback, lock};
use crate::sync::ClientClock;

/// A running stream; it ends when dropped.
pub(super) struct Output {
    _stream: cpal::Stream,
    name: String,
    rate: u32,
    channels: usize,
    lost: Arc<AtomicBool>,
}

impl Output {
    /// Opens the default device in its own format and returns what feeds it.
    pub(super) fn open(clock: ClientClock) -> Result<(Self, Arc<Mutex<Playback>>), cpal::Error> {
        let device = cpal::default_host()
            .default_output_device()
            .ok_or_else(|| cpal::Error::with_message(cpal::ErrorKind::DeviceNotAvailable, "this system has no audio output device"))?;
        let supported = device.default_output_config()?;
        let (rate, device_channels) = (supported.sample_rate(), usize::from(supported.channels()));
        // Front left and right; further channels stay silent.
        let channels = device_channels.min(2);
        let playback = Arc::new(Mutex::new(Playback::new(rate, channels)));
        let feed = Feed { clock, playback: Arc::clone(&playback), channels, device_channels, scratch: Vec::new() };
        let lost = Arc::new(AtomicBool::new(false));
        let (config, told) = (supported.config(), Arc::clone(&lost));
        let stream = match supported.sample_format() {
            SampleFormat::F32 => build::<f32>(&device, config, feed, told),
            SampleFormat::I16 => build::<i16>(&device, config, feed, told),
            SampleFormat::I32 => build::<i32>(&device, config, feed, told),
            SampleFormat::U16 => build::<u16>(&device, config, feed, told),
            SampleFormat::U8 => build::<u8>(&device, config, feed, told),
            other => {
                Err(cpal::Error::with_message(cpal::ErrorKind::UnsupportedConfig, format!("its sample format {other} is not supported")))
            }
        }?;
        stream.play()?;
        let name = device.description().map_or_else(|_| "unnamed".to_owned(), |description| description.to_string());
        Ok((Self { _stream: stream, name, rate, channels, lost }, playback))
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Rate in Hz and channels (1 or 2).
    pub(super) fn layout(&self) -> (u32, usize) {
        (self.rate, self.channels)
    }

    pub(super) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }
}

/// What the device's callback needs.
struct Feed {
    clock: ClientClock,
    playback: Arc<Mutex<Playback>>,
    channels: usize,
    device_channels: usize,
    scratch: Vec<f32>,
}

impl Feed {
    fn fill<T: SizedSample + FromSample<f32>>(&mut self, out: &mut [T], info: &OutputCallbackInfo) {
        let times = info.timestamp();
        let ahead = times.playback.saturating_duration_since(times.callback);
        let heard = self.clock.now().0.saturating_add(u64::try_from(ahead.as_micros()).unwrap_or(0));
        self.scratch.resize(out.len() / self.device_channels * self.channels, 0.0);
        lock(&self.playback).fill(&mut self.scratch, ClientTime(heard));
        out.fill(T::EQUILIBRIUM);
        for (to, from) in out.chunks_exact_mut(self.device_channels).zip(self.scratch.chunks_exact(self.channels)) {
            for (to, from) in to.iter_mut().zip(from) {
                *to = T::from_sample(from.clamp(-1.0, 1.0));
            }
        }
    }
}

fn build<T: SizedSample + FromSample<f32>>(
    device: &cpal::Device,
    config: StreamConfig,
    mut feed: Feed,
    lost: Arc<AtomicBool>,
) -> Result<cpal::Stream, cpal::Error> {
    let on_error = move |error: cpal::Error| match error.kind() {
        cpal::ErrorKind::Xrun | cpal::ErrorKind::DeviceChanged | cpal::ErrorKind::RealtimeDenied => {
            tracing::debug!("audio device: {error}");
        }
        _ => {
            if !lost.swap(true, Ordering::Relaxed) {
                tracing::warn!("audio device lost: {error}; the session goes on silently");
            }
        }
    };
    device.build_output_stream(config, move |out: &mut [T], info: &OutputCallbackInfo| feed.fill(out, info), on_error, None)
}
