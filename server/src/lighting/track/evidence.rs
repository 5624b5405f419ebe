//! What is known of a light's strength: a frame that does not clip it says it, one that does can only guess.
//!
//! Exposures change while lights stay as they are. In canonical exposure a light that was seen unclipped is known, and remains so when the
//! exposure rises and clips it. A guess gives way to what is surer; one guess gives way to another only when it differs by more than guesses
//! waver, and than they differ between exposures. All else pulls slowly, and only by what the exposure does not explain. What a frame still
//! shows of a clipped light is a lower bound at any time.

use glam::DVec3;

use super::life::strength_ln;

/// Standard deviation of the logarithm of a strength that is not clipped: grain and compression.
const UNCLIPPED: f64 = 0.02;
/// Time constant by which guesses pull at what is known. Automatic exposures settle within seconds and must not move a light by more than a
/// few per cent; what is known is worth nothing any more after some minutes.
const MEMORY_S: f64 = 60.0;
/// Up to this standard deviation a strength is seen and not guessed.
const SEEN: f64 = 0.05;
/// What is surer than what is known has this share of its standard deviation, or less; what is as sure, up to the inverse of it.
const SURER: f64 = 0.8;
/// Guesses of one scene differ by up to this share of their standard deviation, from noise and from what moves about in it.
const WAVER: f64 = 0.25;
/// And by up to this part of the difference of their exposures, both as logarithms: white stays white when the exposure doubles, and a guess
/// in proportion to it halves.
const EXPOSED: f64 = 1.0;
/// Time constant by which a better guess is taken: a guess that comes by a step need not go into the light by one.
const TAKEN_S: f64 = 0.2;

/// What an observation is worth beside what is known.
#[derive(Debug, Clone, Copy)]
enum Trust {
    Seen,
    Better,
    Guess,
}

/// Strength in canonical exposure, as the logarithm of each channel, and how sure it is.
#[derive(Debug, Clone, Copy)]
pub(super) struct Evidence {
    intensity: DVec3,
    sigma: f64,
    /// Logarithm of the exposure in which it was seen.
    exposure: f64,
}

impl Evidence {
    /// One observation: the logarithm of its strength, the standard deviation of that, and the logarithm of its exposure.
    pub(super) fn new(intensity: DVec3, sigma: f64, exposure: f64) -> Self {
        Self { intensity, sigma: sigma.hypot(UNCLIPPED), exposure }
    }

    /// Takes an observation of which a share is hidden, `dt_s` after the last, and returns what is now known.
    pub(super) fn take(&mut self, seen: &Self, hidden_share: f64, dt_s: f64) -> DVec3 {
        let (pull, share) = match self.trust(seen) {
            Trust::Seen => (1.0, 1.0),
            Trust::Better => (1.0 - (-dt_s.max(0.0) / TAKEN_S).exp(), 1.0),
            Trust::Guess => (1.0 - (-dt_s.max(0.0) / MEMORY_S).exp(), self.unexplained_share(seen)),
        };
        self.intensity += (seen.intensity - self.intensity) * (pull * share);
        self.sigma += (seen.sigma - self.sigma) * pull;
        self.exposure += (seen.exposure - self.exposure) * pull;
        let shown_ln = (1.0 - hidden_share).max(f64::MIN_POSITIVE).ln();
        let short = strength_ln(seen.intensity) + shown_ln - strength_ln(self.intensity);
        self.intensity += DVec3::splat(short.max(0.0));
        self.intensity
    }

    /// How far a guess is off what is known, as a logarithm.
    fn differs(&self, seen: &Self) -> f64 {
        (strength_ln(seen.intensity) - strength_ln(self.intensity)).abs()
    }

    /// What the exposures alone may make of that.
    fn exposed(&self, seen: &Self) -> f64 {
        EXPOSED * (seen.exposure - self.exposure).abs()
    }

    /// Share of the difference that the exposures do not explain. They come nearer as the memory of the old one fades.
    fn unexplained_share(&self, seen: &Self) -> f64 {
        let differs = self.differs(seen);
        if differs > 0.0 { (1.0 - self.exposed(seen) / differs).max(0.0) } else { 0.0 }
    }

    fn trust(&self, seen: &Self) -> Trust {
        if seen.sigma <= SEEN {
            return Trust::Seen;
        }
        let differs = self.differs(seen);
        let explained = WAVER * seen.sigma + self.exposed(seen);
        let changed = seen.sigma <= self.sigma / SURER && differs > explained;
        if changed || seen.sigma <= SURER * self.sigma { Trust::Better } else { Trust::Guess }
    }
}

#[cfg(test)]
mod tests {
    use super::super::LUMA;
    use super::*;

    const DT_S: f64 = 1.0 / 30.0;

    fn grey(value: f64) -> DVec3 {
        DVec3::splat(value.ln())
    }

    #[test]
    fn what_was_seen_unclipped_outlives_a_rise_of_the_exposure_but_not_for_ever() {
        let mut evidence = Evidence::new(grey(10.0), 0.0, 0.0);
        // Clipped from now on, and guessed to be a third.
        let guess = Evidence::new(grey(3.0), 1.0, 2.0);
        let mut after = |seconds: usize| (0..30 * seconds).map(|_| evidence.take(&guess, 0.8, DT_S).x.exp()).last().unwrap();
        // With y the logarithm of known over guess and τ the time in memories: nothing as long as 2 e^−τ, what the exposures explain, is more
        // than y; then y' = 2 e^−τ − y.
        let (y, explained) = ((10f64 / 3.0).ln(), 2.0);
        let begin = f64::ln(explained / y);
        let pulled = |seconds: f64| {
            let later = (seconds / MEMORY_S - begin).max(0.0);
            3.0 * f64::exp((y + explained * later * (-begin).exp()) * (-later).exp())
        };
        assert!((after(4) - 10.0).abs() < 1e-9 && (pulled(4.0) - 10.0).abs() < 1e-9);
        assert!((after(76) / pulled(80.0) - 1.0).abs() < 1e-3 && (7.0..8.0).contains(&pulled(80.0)), "{}", pulled(80.0));
        // Once it is remembered no better than it is guessed, the guess is as good.
        assert!((3.0..3.9).contains(&after(340)));
        // What is seen is taken at once, without a step in between.
        let seen = Evidence::new(grey(12.0), 0.0, 0.0);
        assert!((evidence.take(&seen, 0.0, DT_S).x.exp() - 12.0).abs() < 1e-9);
    }

    #[test]
    fn guesses_of_one_exposure_pull_slowly_and_the_exposure_does_not() {
        let pulled = |exposure: f64| {
            let mut evidence = Evidence::new(grey(5.0), 0.4, 0.0);
            let guess = Evidence::new(grey(4.6), 0.4, exposure);
            (0..300).map(|_| evidence.take(&guess, 0.7, DT_S).x.exp()).last().unwrap()
        };
        let slowly = 4.6 * (5.0f64 / 4.6).powf((-10.0 / MEMORY_S).exp());
        assert!((pulled(0.0) / slowly - 1.0).abs() < 1e-6, "{}", pulled(0.0));
        assert!((pulled(0.5) - 5.0).abs() < 1e-9, "{}", pulled(0.5));
    }

    #[test]
    fn guesses_give_way_to_changes_and_not_to_noise_nor_to_the_exposure() {
        let first = Evidence::new(grey(5.0), 0.4, 0.0);
        // After half a second.
        let after = |seen: Evidence| {
            let mut evidence = first;
            (0..15).map(|_| evidence.take(&seen, 0.7, DT_S).x.exp()).last().unwrap()
        };
        let near = |value: f64, expected: f64| assert!((value / expected - 1.0).abs() < 0.12, "{value} {expected}");
        // A tenth of a deviation of 0.4 is noise, and twice as much light is none: it is taken up to what would be noise again.
        near(after(Evidence::new(grey(5.0 * 1.08), 0.4, 0.0)), 5.0);
        near(after(Evidence::new(grey(10.0), 0.4, 0.0)), 10.0);
        near(after(Evidence::new(grey(2.5), 0.4, 0.0)), 2.5);
        // Unless the exposure has doubled twice since.
        near(after(Evidence::new(grey(9.0), 0.45, 4f64.ln())), 5.0);
        near(after(Evidence::new(grey(3.0), 0.45, 4f64.ln())), 5.0);
        // What is much surer counts, what is less sure does not.
        near(after(Evidence::new(grey(6.0), 0.2, -1.0)), 6.0);
        near(after(Evidence::new(grey(2.0), 0.8, 0.0)), 5.0);
    }

    #[test]
    fn a_clipped_light_is_at_least_what_it_shows() {
        let mut evidence = Evidence::new(grey(1.0), 0.0, 0.0);
        // Of a guess of 20, a tenth is in the picture.
        let known = evidence.take(&Evidence::new(grey(20.0), 1.1, 0.0), 0.9, DT_S);
        assert!((known.x.exp() - 2.0).abs() < 1e-9, "{known}");
        // Its colour stays, but for what the guess pulls.
        let mut warm = Evidence::new(DVec3::new(2.0, 1.0, 0.5).map(f64::ln), 0.0, 0.0);
        let known = warm.take(&Evidence::new(grey(20.0), 1.1, 0.0), 0.5, DT_S);
        assert!((known.x - known.y - 2f64.ln()).abs() < 1e-3 && (known.exp().dot(LUMA) - 10.0).abs() < 1e-9, "{known}");
    }
}
