//! Percentiles in bounded memory.

/// Steps within a doubling: percentiles are exact to 1/16, about 6 %.
const STEPS_LOG2: u32 = 4;
const STEPS: u64 = 1 << STEPS_LOG2;
/// Enough for all of u64.
const BINS: usize = ((64 - STEPS_LOG2 as usize) + 1) << STEPS_LOG2;

/// Counts of values in logarithmic bins, each at most 1/16 of its value wide; values below 16 are exact.
#[derive(Clone)]
pub struct Histogram {
    bins: Vec<u32>,
    count: u64,
    sum: u128,
    max: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { bins: vec![0; BINS], count: 0, sum: 0, max: 0 }
    }
}

impl Histogram {
    /// Takes in one value.
    pub fn record(&mut self, value: u64) {
        if let Some(bin) = self.bins.get_mut(bin_of(value)) {
            *bin = bin.saturating_add(1);
        }
        self.count += 1;
        self.sum += u128::from(value);
        self.max = self.max.max(value);
    }

    /// Number of values.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Exact mean; 0 without values.
    #[must_use]
    pub fn mean(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sum as f64 / self.count as f64 }
    }

    /// Exact largest value; 0 without values.
    #[must_use]
    pub fn max(&self) -> u64 {
        self.max
    }

    /// Value that `percent` of the values do not exceed, rounded up to its bin's end; 0 without values.
    #[must_use]
    pub fn percentile(&self, percent: u64) -> u64 {
        let rank = (self.count * percent.min(100)).div_ceil(100).max(1);
        let mut seen = 0;
        for (at, bin) in self.bins.iter().enumerate() {
            seen += u64::from(*bin);
            if seen >= rank {
                return last_of(at).min(self.max);
            }
        }
        self.max
    }
}

fn bin_of(value: u64) -> usize {
    if value < STEPS {
        return value as usize;
    }
    let exponent = value.ilog2() - STEPS_LOG2;
    ((u64::from(exponent + 1) << STEPS_LOG2) + ((value >> exponent) - STEPS)) as usize
}

/// Largest value in a bin.
fn last_of(bin: usize) -> u64 {
    let bin = bin as u64;
    if bin < STEPS {
        return bin;
    }
    let exponent = (bin >> STEPS_LOG2) - 1;
    let first = (STEPS + (bin & (STEPS - 1))) << exponent;
    first + ((1_u64 << exponent) - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_cover_everything_without_gaps() {
        for value in (0..100_000).chain([u64::MAX, u64::MAX / 3, 1 << 40]) {
            let bin = bin_of(value);
            assert!(bin < BINS);
            assert!(last_of(bin) >= value && (bin == 0 || last_of(bin - 1) < value), "{value}");
            assert!(last_of(bin) - value <= value / STEPS);
        }
    }

    #[test]
    fn percentiles_of_a_ramp() {
        let mut histogram = Histogram::default();
        assert_eq!((histogram.percentile(95), histogram.max(), histogram.mean()), (0, 0, 0.0));
        (1..=10_000).for_each(|value| histogram.record(value));
        assert_eq!((histogram.count(), histogram.max(), histogram.mean()), (10_000, 10_000, 5_000.5));
        for (percent, exact) in [(50, 5_000), (95, 9_500)] {
            let estimate = histogram.percentile(percent);
            assert!(estimate >= exact && estimate <= exact + exact / STEPS, "{estimate}");
        }
        assert_eq!(histogram.percentile(100), 10_000);
    }
}
