//! What is known of a light's strength: a frame that does not clip it says it, one that does can only guess.
//!
//! Exposures change while lights stay as they are. In canonical exposure a light that was seen unclipped is known, and remains so for a while
//! when the exposure rises and clips it: an observation counts only when it is at least as sure as what is known has remained. What a frame
//! still shows of a clipped light is a lower bound at any time.

use glam::DVec3;

use super::LUMA;

/// Standard deviation of the logarithm of a strength that is not clipped: grain and compression.
const UNCLIPPED: f64 = 0.02;
/// Variance that a strength gains each second in which nothing as sure was seen. Twenty seconds make it as unsure as a guess from a clipped
/// region that hides all its light: automatic exposures settle in one or two, clouds take minutes.
const DRIFT_PER_S: f64 = 0.05;
/// What is this little less sure counts as equally sure: an observation wavers with the share of it that is clipped.
const AS_SURE: f64 = 1.1;

/// Strength in canonical exposure, as the logarithm of each channel, and how sure it is.
#[derive(Debug, Clone, Copy)]
pub(super) struct Evidence {
    intensity: DVec3,
    sigma: f64,
}

impl Evidence {
    /// All that is known is one observation: its logarithm and the standard deviation of that.
    pub(super) fn new(intensity: DVec3, sigma: f64) -> Self {
        Self { intensity, sigma: sigma.hypot(UNCLIPPED) }
    }

    /// Takes an observation of which a share is hidden, `dt_s` after the last, and returns what is now known.
    pub(super) fn take(&mut self, intensity: DVec3, hidden_share: f64, sigma: f64, dt_s: f64) -> DVec3 {
        let seen = Self::new(intensity, sigma);
        self.sigma = self.sigma.hypot((DRIFT_PER_S * dt_s.max(0.0)).sqrt());
        if seen.sigma <= AS_SURE * self.sigma {
            *self = seen;
        } else {
            let shown_ln = (1.0 - hidden_share).max(f64::MIN_POSITIVE).ln();
            let short = strength_ln(intensity) + shown_ln - strength_ln(self.intensity);
            self.intensity += DVec3::splat(short.max(0.0));
        }
        self.intensity
    }
}

/// Logarithm of the luminance of such an intensity.
fn strength_ln(intensity: DVec3) -> f64 {
    intensity.exp().dot(LUMA).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT_S: f64 = 1.0 / 30.0;

    fn grey(value: f64) -> DVec3 {
        DVec3::splat(value.ln())
    }

    #[test]
    fn what_was_seen_unclipped_outlives_a_rise_of_the_exposure_but_not_for_ever() {
        let mut evidence = Evidence::new(grey(10.0), 0.0);
        let known = |known: DVec3| known.x.exp();
        // Clipped from now on, and guessed to be a third.
        let after = |evidence: &mut Evidence, seconds: usize| {
            (0..30 * seconds).map(|_| known(evidence.take(grey(3.0), 0.8, 1.0, DT_S))).last().unwrap()
        };
        assert!((after(&mut evidence, 10) - 10.0).abs() < 1e-9);
        // 1/0.05 seconds, less a fifth for being nearly as sure.
        assert!((after(&mut evidence, 8) - 3.0).abs() < 1e-9);
        // From then on the guess is followed.
        assert!((known(evidence.take(grey(4.0), 0.8, 1.0, DT_S)) - 4.0).abs() < 1e-9);
        // And what is seen is taken at once.
        assert!((known(evidence.take(grey(12.0), 0.0, 0.0, DT_S)) - 12.0).abs() < 1e-9);
    }

    #[test]
    fn a_clipped_light_is_at_least_what_it_shows() {
        let mut evidence = Evidence::new(grey(1.0), 0.0);
        // Of a guess of 20, a tenth is in the picture.
        let known = evidence.take(grey(20.0), 0.9, 1.1, DT_S);
        assert!((known.x.exp() - 2.0).abs() < 1e-9, "{known}");
        // Its colour stays.
        let mut warm = Evidence::new(DVec3::new(2.0, 1.0, 0.5).map(f64::ln), 0.0);
        let known = warm.take(grey(20.0), 0.5, 1.1, DT_S);
        assert!((known.x - known.y - 2f64.ln()).abs() < 1e-9 && (known.exp().dot(LUMA) - 10.0).abs() < 1e-9, "{known}");
    }
}
