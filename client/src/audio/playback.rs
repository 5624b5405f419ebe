//! Which sample is due when. No device and no clock in here: time is an argument.

use std::collections::VecDeque;

use mr360_protocol::clock::ClientTime;

/// Most sound held, seconds.
const HELD_S: usize = 2;
/// Gaps and overlaps between packets below this are rounding of their times, microseconds.
const SEAM_US: i64 = 5_000;
/// Gaps up to this are filled with silence; longer ones start the buffer anew, microseconds.
const MAX_GAP_US: i64 = 1_000_000;
/// Within this of its due time sound is left alone, microseconds: far below the 45 ms at which lips and sound come apart.
const IN_SYNC_US: i64 = 3_000;
/// Beyond this it jumps, microseconds.
const JUMP_US: i64 = 60_000;
/// In between it plays faster or slower by at most this share: a twentieth of a semitone.
const MAX_STRETCH: f64 = 0.003;
/// Error at which the full stretch applies, microseconds.
const FULL_STRETCH_US: f64 = 20_000.0;

/// What happened to the sound, in frames (one sample of every channel).
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct PlaybackCounters {
    /// Played.
    pub played: u64,
    /// Silence played because nothing was due or there.
    pub silent: u64,
    /// Thrown away because their time had passed.
    pub skipped: u64,
    /// Thrown away because too much was waiting.
    pub overflow: u64,
}

/// Interleaved samples by pts, and the timeline that says when they are due.
pub struct Playback {
    rate: u32,
    channels: usize,
    samples: VecDeque<f32>,
    /// Pts of the first frame held, microseconds; fractions keep rounding from adding up.
    head_us: f64,
    /// Part of the first frame that was already played, in [0, 1).
    fraction: f64,
    offset_us: Option<i64>,
    counters: PlaybackCounters,
}

impl Playback {
    /// Nothing held. `rate` in Hz; both are at least 1.
    #[must_use]
    pub fn new(rate: u32, channels: usize) -> Self {
        let samples = VecDeque::new();
        Self {
            rate: rate.max(1),
            channels: channels.max(1),
            samples,
            head_us: 0.0,
            fraction: 0.0,
            offset_us: None,
            counters: PlaybackCounters::default(),
        }
    }

    /// Client time minus pts, microseconds; `None` for silence.
    pub fn set_offset(&mut self, offset_us: Option<i64>) {
        self.offset_us = offset_us;
    }

    /// What happened so far.
    #[must_use]
    pub fn counters(&self) -> PlaybackCounters {
        self.counters
    }

    /// Appends interleaved samples whose first is due at `pts_us`.
    pub fn push(&mut self, pts_us: u64, samples: &[f32]) {
        let mut samples = &samples[..samples.len() - samples.len() % self.channels];
        let pts = pts_us as f64;
        if self.samples.is_empty() {
            (self.head_us, self.fraction) = (pts, 0.0);
        }
        let gap_us = (pts - self.tail_us()) as i64;
        if !(-MAX_GAP_US..=MAX_GAP_US).contains(&gap_us) {
            self.samples.clear();
            (self.head_us, self.fraction) = (pts, 0.0);
        } else if gap_us > SEAM_US {
            let silence = self.frames_in(gap_us) * self.channels;
            self.samples.extend(std::iter::repeat_n(0.0, silence));
        } else if gap_us < -SEAM_US {
            let known = (self.frames_in(-gap_us) * self.channels).min(samples.len());
            samples = &samples[known..];
        }
        self.samples.extend(samples);
        let excess = (self.samples.len() / self.channels).saturating_sub(HELD_S * self.rate as usize);
        self.discard(excess);
        self.counters.overflow += excess as u64;
    }

    /// Fills `out`, interleaved, whose first frame is heard at `at`.
    pub fn fill(&mut self, out: &mut [f32], at: ClientTime) {
        out.fill(0.0);
        let frames = out.len() / self.channels;
        let Some(offset_us) = self.offset_us.filter(|_| !self.samples.is_empty()) else {
            self.counters.silent += frames as u64;
            return;
        };
        let due_us = at.0 as f64 - offset_us as f64;
        // Positive: what is held is due later.
        let mut early_us = (self.head_us + self.fraction * self.frame_us() - due_us) as i64;
        let mut from = 0;
        if early_us > JUMP_US {
            from = self.frames_in(early_us).min(frames);
            early_us = 0;
        } else if early_us < -JUMP_US {
            let late = self.frames_in(-early_us).min(self.samples.len() / self.channels);
            self.discard(late);
            self.counters.skipped += late as u64;
            early_us = 0;
        }
        let step = 1.0 - stretch(early_us);
        let channels = self.channels;
        let played = out.chunks_exact_mut(channels).skip(from).take_while(|frame_out| !frame_out.is_empty());
        let mut count = 0;
        for frame_out in played {
            if !self.next_frame(frame_out, step) {
                break;
            }
            count += 1;
        }
        self.counters.played += count;
        self.counters.silent += frames as u64 - count;
    }

    /// One frame by linear interpolation; at a step of exactly 1 samples pass unchanged once the fraction has run out.
    fn next_frame(&mut self, out: &mut [f32], step: f64) -> bool {
        let held = self.samples.len() / self.channels;
        if held < 2 {
            return false;
        }
        if (step - 1.0).abs() < f64::EPSILON {
            self.fraction = 0.0;
        }
        let weight = self.fraction as f32;
        for (channel, sample) in out.iter_mut().enumerate() {
            let (now, next) = (self.samples[channel], self.samples[self.channels + channel]);
            *sample = now + (next - now) * weight;
        }
        self.fraction += step;
        let whole = (self.fraction as usize).min(held);
        self.fraction -= whole as f64;
        self.discard_whole(whole);
        true
    }

    fn discard(&mut self, frames: usize) {
        if frames > 0 {
            self.fraction = 0.0;
            self.discard_whole(frames);
        }
    }

    fn discard_whole(&mut self, frames: usize) {
        self.samples.drain(..(frames * self.channels).min(self.samples.len()));
        self.head_us += frames as f64 * self.frame_us();
    }

    fn tail_us(&self) -> f64 {
        self.head_us + (self.samples.len() / self.channels) as f64 * self.frame_us()
    }

    fn frame_us(&self) -> f64 {
        1e6 / f64::from(self.rate)
    }

    /// Frames in a span of at least 0 µs.
    fn frames_in(&self, span_us: i64) -> usize {
        (span_us as f64 / self.frame_us()).round() as usize
    }
}

/// Share by which playing slows down (positive) for sound that is `early_us` too early.
fn stretch(early_us: i64) -> f64 {
    if early_us.abs() <= IN_SYNC_US { 0.0 } else { (early_us as f64 / FULL_STRETCH_US).clamp(-1.0, 1.0) * MAX_STRETCH }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: u32 = 48_000;
    /// 10 ms.
    const BLOCK: usize = 480;

    /// A ramp whose value is the frame's number since pts 0, so that what plays says when it is due.
    fn ramp(from: usize, frames: usize) -> Vec<f32> {
        (from..from + frames).map(|i| i as f32).collect()
    }

    fn play(playback: &mut Playback, at_us: u64) -> Vec<f32> {
        let mut out = vec![-1.0; BLOCK];
        playback.fill(&mut out, ClientTime(at_us));
        out
    }

    #[test]
    fn in_step_samples_pass_unchanged() {
        let mut playback = Playback::new(RATE, 1);
        playback.push(0, &ramp(0, 4_800));
        assert_eq!(play(&mut playback, 1_000_000), vec![0.0; BLOCK]);
        playback.set_offset(Some(1_000_000));
        assert_eq!(play(&mut playback, 1_000_000), ramp(0, BLOCK));
        assert_eq!(play(&mut playback, 1_010_000), ramp(BLOCK, BLOCK));
        assert_eq!(playback.counters(), PlaybackCounters { played: 960, silent: 480, ..PlaybackCounters::default() });
    }

    #[test]
    fn far_too_early_waits_and_far_too_late_skips() {
        let mut playback = Playback::new(RATE, 1);
        playback.set_offset(Some(0));
        playback.push(1_000_000, &ramp(48_000, 9_600));
        assert_eq!(play(&mut playback, 500_000), vec![0.0; BLOCK]);
        // Due in 65 ms, which is after this block.
        assert_eq!(play(&mut playback, 935_000), vec![0.0; BLOCK]);
        assert_eq!(play(&mut playback, 1_000_000), ramp(48_000, BLOCK));
        // 90 ms are missed.
        assert_eq!(play(&mut playback, 1_100_000), ramp(48_000 + 4_800, BLOCK));
        assert_eq!(playback.counters().skipped, 4_320);
    }

    #[test]
    fn drift_is_followed_without_jumps() {
        let mut playback = Playback::new(RATE, 1);
        playback.set_offset(Some(0));
        let mut pushed = 0;
        let mut worst = 0.0_f64;
        for block in 0..6_000_u64 {
            while pushed < (block as usize + 20) * BLOCK {
                playback.push(pushed as u64 * 1_000_000 / u64::from(RATE), &ramp(pushed, BLOCK));
                pushed += BLOCK;
            }
            // The device's clock is 200 ppm slow: its blocks last 10.002 ms.
            let at = block * 10_002;
            let out = play(&mut playback, at);
            if block > 0 {
                worst = worst.max((f64::from(out[0]) / f64::from(RATE) * 1e6 - at as f64).abs());
            }
        }
        assert_eq!((playback.counters().skipped, playback.counters().overflow), (0, 0));
        // The dead band, and a block's stretch on top.
        assert!(worst < 4_500.0, "{worst}");
    }

    #[test]
    fn gaps_are_silence_and_overlaps_are_cut() {
        let mut playback = Playback::new(RATE, 1);
        playback.set_offset(Some(0));
        playback.push(0, &ramp(0, 480));
        playback.push(20_000, &ramp(960, 480));
        playback.push(20_000, &ramp(960, 960));
        assert_eq!(play(&mut playback, 0), ramp(0, 480));
        assert_eq!(play(&mut playback, 10_000), vec![0.0; BLOCK]);
        assert_eq!(play(&mut playback, 20_000), ramp(960, 480));
        assert_eq!(play(&mut playback, 30_000)[..479], ramp(1_440, 479));
        // A jump of the broadcast's time starts anew.
        playback.push(90_000_000, &ramp(7, 480));
        assert_eq!(play(&mut playback, 90_000_000)[..2], [7.0, 8.0]);
    }

    #[test]
    fn memory_is_bounded_and_channels_stay_together() {
        let mut playback = Playback::new(RATE, 2);
        let stereo: Vec<f32> = (0..960).flat_map(|i| [i as f32, -(i as f32)]).collect();
        for i in 0..500_u64 {
            playback.push(i * 20_000, &stereo);
        }
        assert_eq!(playback.samples.len(), HELD_S * 2 * RATE as usize);
        assert_eq!(playback.counters().overflow, 400 * 960);
        playback.push(500 * 20_000, &stereo[..7]);
        playback.set_offset(Some(0));
        let mut out = vec![0.0; 960];
        playback.fill(&mut out, ClientTime(9_000_000));
        assert!(out.chunks(2).all(|frame| frame[0] == -frame[1]));
    }
}
