//! Plays the broadcast's sound in step with its pictures.
//!
//! Packets are decoded and brought to the device's rate as they arrive; [`playback::Playback`] holds the samples by pts and
//! follows the timeline that the video's playout sets. Without a device the session goes on silently.

mod decoder;
mod device;
mod playback;

use std::sync::{Arc, Mutex};

use bytes::Bytes;

pub use self::decoder::AudioError;
pub use self::playback::{Playback, PlaybackCounters};

use self::decoder::AudioDecoder;
use crate::sync::ClientClock;

/// Audio codecs that a broadcast may carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AudioCodec {
    /// AAC; raw with an AudioSpecificConfig as description, else ADTS.
    Aac,
    /// Opus, with an OpusHead as description or none.
    Opus,
}

/// What the catalog says of the coded audio.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AudioFormat {
    /// Codec of the packets.
    pub codec: AudioCodec,
    /// Samples a second, 1 to 192,000.
    pub sample_rate: u32,
    /// Channels, 1 to 8.
    pub channels: u32,
    /// The codec's own header, where it has one.
    pub description: Option<Bytes>,
}

/// Tells players when samples are due. Kept by whoever runs the video's playout, from before the first player to after the last.
#[derive(Clone, Default)]
pub struct AudioTimeline(Arc<Mutex<Due>>);

#[derive(Default)]
struct Due {
    offset_us: Option<i64>,
    playback: Option<Arc<Mutex<Playback>>>,
}

impl AudioTimeline {
    /// Client time minus pts at which things are presented, microseconds; `None` while nothing is: silence.
    pub fn set(&self, offset_us: Option<i64>) {
        let mut due = lock(&self.0);
        due.offset_us = offset_us;
        if let Some(playback) = &due.playback {
            lock(playback).set_offset(offset_us);
        }
    }

    /// What the player of now played, skipped and filled in.
    #[must_use]
    pub fn counters(&self) -> PlaybackCounters {
        lock(&self.0).playback.as_ref().map(|playback| lock(playback).counters()).unwrap_or_default()
    }

    fn connect(&self, playback: &Arc<Mutex<Playback>>) {
        let mut due = lock(&self.0);
        lock(playback).set_offset(due.offset_us);
        due.playback = Some(Arc::clone(playback));
    }
}

/// Decodes and plays one audio track.
pub struct AudioPlayer {
    decoder: AudioDecoder,
    playback: Arc<Mutex<Playback>>,
    /// `None` without a device: packets are then not even decoded.
    device: Option<device::Output>,
}

impl AudioPlayer {
    /// Opens decoder and default device, to play by `timeline`. No device is no error: one line in the log says so, and the player stays silent.
    ///
    /// # Errors
    /// [`AudioError`] when the format is out of range or FFmpeg cannot decode it.
    pub fn start(format: &AudioFormat, clock: ClientClock, timeline: &AudioTimeline) -> Result<Self, AudioError> {
        decoder::check(format)?;
        let player = Self::open(format, clock)?;
        timeline.connect(&player.playback);
        Ok(player)
    }

    fn open(format: &AudioFormat, clock: ClientClock) -> Result<Self, AudioError> {
        match device::Output::open(clock) {
            Ok((device, playback)) => {
                let (rate, channels) = device.layout();
                tracing::info!(device = device.name(), rate, channels, "playing audio");
                Ok(Self { decoder: AudioDecoder::open(format, rate, channels)?, playback, device: Some(device) })
            }
            Err(error) => {
                tracing::warn!("no sound: {error}; the session goes on silently");
                let playback = Arc::new(Mutex::new(Playback::new(format.sample_rate, 2)));
                Ok(Self { decoder: AudioDecoder::open(format, format.sample_rate, 2)?, playback, device: None })
            }
        }
    }

    /// True when a device plays.
    #[must_use]
    pub fn is_audible(&self) -> bool {
        self.device.as_ref().is_some_and(|device| !device.is_lost())
    }

    /// Decodes a packet; `pts_us` is the time of its first sample. Broken packets are counted and leave a gap of silence.
    pub fn push(&mut self, pts_us: u64, packet: &Bytes) {
        if self.is_audible() {
            let playback = &self.playback;
            self.decoder.decode(pts_us, packet, |pts_us, samples| lock(playback).push(pts_us, samples));
        }
    }

    /// Packets that could not be decoded.
    #[must_use]
    pub fn errors(&self) -> u64 {
        self.decoder.errors()
    }
}

/// Held for the copying of a few milliseconds of samples at most, on both sides.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    /// ADTS packets of a 1 kHz tone at 44.1 kHz.
    fn tone() -> Vec<Bytes> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tone.aac");
        let status = Command::new("ffmpeg")
            .args(["-v", "error", "-f", "lavfi", "-i", "sine=frequency=1000:sample_rate=44100:duration=1", "-ac", "2", "-c:a", "aac"])
            .arg(&path)
            .status();
        assert!(status.unwrap().success());
        let bytes = Bytes::from(std::fs::read(&path).unwrap());
        let mut packets = Vec::new();
        let mut at = 0;
        while at + 7 <= bytes.len() {
            // ADTS: 13 bits of frame length from bit 30 on.
            let length = (usize::from(bytes[at + 3] & 3) << 11) | (usize::from(bytes[at + 4]) << 3) | usize::from(bytes[at + 5] >> 5);
            packets.push(bytes.slice(at..at + length));
            at += length;
        }
        packets
    }

    fn aac() -> AudioFormat {
        AudioFormat { codec: AudioCodec::Aac, sample_rate: 44_100, channels: 2, description: None }
    }

    #[test]
    fn a_tone_arrives_at_the_device_rate_in_the_right_place() {
        let mut decoder = AudioDecoder::open(&aac(), 48_000, 2).unwrap();
        let mut playback = Playback::new(48_000, 2);
        let packets = tone();
        let mut samples = 0;
        for (i, packet) in packets.iter().enumerate() {
            decoder.decode(1_000_000 + i as u64 * 1_024 * 1_000_000 / 44_100, packet, |pts, decoded| {
                samples += decoded.len() / 2;
                playback.push(pts, decoded);
            });
        }
        assert_eq!(decoder.errors(), 0);
        // The resampler keeps up to its filter's length.
        let expected = packets.len() * 1_024 * 48_000 / 44_100;
        assert!(samples.abs_diff(expected) < 64, "{samples} {expected}");
        playback.set_offset(Some(0));
        let mut out = vec![0.0; 2 * 4_800];
        playback.fill(&mut out, mr360_protocol::clock::ClientTime(1_500_000));
        let crossings = out.chunks(2).map(|frame| frame[0]).collect::<Vec<_>>().windows(2).filter(|w| w[0] <= 0.0 && w[1] > 0.0).count();
        // 100 ms of 1 kHz.
        assert!((99..=101).contains(&crossings), "{crossings}");
    }

    #[test]
    fn broken_packets_are_counted() {
        let mut decoder = AudioDecoder::open(&aac(), 48_000, 2).unwrap();
        for i in 0..20 {
            decoder.decode(i * 21_000, &Bytes::from(vec![0x5a; 200]), |_, _| {});
        }
        assert!(decoder.errors() >= 19);
        let wrong = |change: fn(&mut AudioFormat)| {
            let mut format = aac();
            change(&mut format);
            AudioDecoder::open(&format, 48_000, 2).err().map(|error| error.to_string()).unwrap_or_default()
        };
        assert!(wrong(|f| f.sample_rate = 0).contains("sample rate"));
        assert!(wrong(|f| f.channels = 9).contains("channels"));
        assert!(wrong(|f| f.description = Some(Bytes::from(vec![0; 70_000]))).contains("description"));
        // FFmpeg's word stands in the text; with all causes, as programs print errors, it would stand there again.
        let error = AudioError::Ffmpeg { codec: AudioCodec::Aac, fault: ffmpeg_next::Error::Eof };
        assert!(std::error::Error::source(&error).is_none());
    }

    #[test]
    fn without_a_device_the_player_is_silent_and_alive() {
        let timeline = AudioTimeline::default();
        let Ok(mut player) = AudioPlayer::start(&aac(), ClientClock::start(), &timeline) else { panic!("no device must be no error") };
        timeline.set(Some(0));
        for packet in tone() {
            player.push(0, &packet);
        }
        assert_eq!(player.errors(), 0);
    }
}
