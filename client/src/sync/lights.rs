//! Lights that wait for their picture.

use std::collections::BTreeMap;

use super::ReceivedLight;

/// Most lights held: about eight seconds at 30 frames/s.
pub const MAX_LIGHTS: usize = 256;

/// Lights by pts, at most [`MAX_LIGHTS`].
#[derive(Default)]
pub(super) struct Lights(BTreeMap<u64, ReceivedLight>);

impl Lights {
    /// Adds one and returns how many were pushed out for it: those farthest from `about_us`, so that strays do not displace
    /// what is needed next.
    pub(super) fn insert(&mut self, received: ReceivedLight, about_us: u64) -> u64 {
        self.0.insert(received.light.pts_us, received);
        let mut pushed_out = 0;
        while self.0.len() > MAX_LIGHTS {
            let (Some(first), Some(last)) = (self.0.keys().next().copied(), self.0.keys().next_back().copied()) else { break };
            let farthest = if first.abs_diff(about_us) >= last.abs_diff(about_us) { first } else { last };
            self.0.remove(&farthest);
            pushed_out += 1;
        }
        pushed_out
    }

    pub(super) fn contains(&self, pts_us: u64) -> bool {
        self.0.contains_key(&pts_us)
    }

    pub(super) fn take(&mut self, pts_us: u64) -> Option<ReceivedLight> {
        self.0.remove(&pts_us)
    }

    /// The first one later than this.
    pub(super) fn next_after(&self, pts_us: u64) -> Option<&ReceivedLight> {
        Some(self.0.range(pts_us.checked_add(1)?..).next()?.1)
    }

    /// Removes what no picture can ask for any more and returns how many that were.
    pub(super) fn forget_up_to(&mut self, pts_us: u64) -> u64 {
        let Some(after) = pts_us.checked_add(1) else { return std::mem::take(&mut self.0).len() as u64 };
        let later = self.0.split_off(&after);
        std::mem::replace(&mut self.0, later).len() as u64
    }

    pub(super) fn keep_near(&mut self, pts_us: u64, within_us: u64) {
        self.0.retain(|light, _| light.abs_diff(pts_us) <= within_us);
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }
}
