//! How long the stages of a data path take: percentiles in bounded memory, printed as a table.

use std::fmt;

use hdrhistogram::Histogram;

/// Most stages told apart.
const MAX_STAGES: usize = 64;
/// Longest time told apart from longer ones: a minute, microseconds.
const LONGEST_US: u64 = 60_000_000;
/// Significant digits of what is printed.
const DIGITS: u8 = 3;

/// Times by stage, in the order in which the stages first came.
#[derive(Debug, Default, Clone)]
pub struct StageTimes {
    stages: Vec<(String, Histogram<u64>)>,
}

impl StageTimes {
    /// Takes in one time, microseconds. A stage beyond the most is not counted.
    pub fn record(&mut self, stage: &str, us: u64) {
        self.take(|name| name == stage, || stage.to_owned(), us);
    }

    /// As [`StageTimes::record`] for the stage `GROUP: STEP`, whose name is put together only when it first comes.
    pub fn record_step(&mut self, group: &str, step: &str, us: u64) {
        let is_step = |name: &str| name.strip_prefix(group).and_then(|rest| rest.strip_prefix(": ")) == Some(step);
        self.take(is_step, || format!("{group}: {step}"), us);
    }

    fn take(&mut self, is_stage: impl Fn(&str) -> bool, name: impl FnOnce() -> String, us: u64) {
        let known = self.stages.iter().position(|(name, _)| is_stage(name));
        let at = known.or_else(|| {
            let histogram = Histogram::new_with_bounds(1, LONGEST_US, DIGITS).ok().filter(|_| self.stages.len() < MAX_STAGES)?;
            self.stages.push((name(), histogram));
            Some(self.stages.len() - 1)
        });
        if let Some(at) = at {
            self.stages[at].1.saturating_record(us);
        }
    }
}

impl fmt::Display for StageTimes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.stages.is_empty() {
            writeln!(f, "{:<42} {:>8} {:>9} {:>9} {:>9} {:>9}  ms", "stage", "count", "mean", "p50", "p95", "max")?;
        }
        for (name, times) in &self.stages {
            let at = |quantile: f64| times.value_at_quantile(quantile) as f64 / 1_000.0;
            let (mean, max) = (times.mean() / 1_000.0, times.max() as f64 / 1_000.0);
            writeln!(f, "{name:<42} {:>8} {mean:>9.3} {:>9.3} {:>9.3} {max:>9.3}", times.len(), at(0.5), at(0.95))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_a_known_run() {
        let mut times = StageTimes::default();
        (1..=1_000).for_each(|us| times.record("decode", us * 1_000));
        times.record("upload", u64::MAX);
        let text = times.to_string();
        let words: Vec<&str> = text.lines().nth(1).unwrap().split_whitespace().collect();
        assert_eq!((words[0], words[1]), ("decode", "1000"));
        for (word, ms) in words[2..].iter().zip([500.5, 500.0, 950.0, 1_000.0]) {
            // Three significant digits.
            assert!((word.parse::<f64>().unwrap() / ms - 1.0).abs() < 2e-3, "{word} for {ms}");
        }
        assert!(text.lines().nth(2).unwrap().starts_with("upload"));
    }

    #[test]
    fn steps_are_stages_of_their_group() {
        let mut times = StageTimes::default();
        times.record_step("light", "sh", 1);
        times.record("light: sh", 2);
        times.record_step("light", "sample", 3);
        times.record("light", 4);
        let text = times.to_string();
        let counts: Vec<_> = text.lines().skip(1).map(|line| line[..51].split_whitespace().collect::<Vec<_>>().join(" ")).collect();
        assert_eq!(counts, ["light: sh 2", "light: sample 1", "light 1"]);
    }

    #[test]
    fn names_are_bounded() {
        let mut times = StageTimes::default();
        (0..1_000).for_each(|name| times.record(&name.to_string(), 1));
        assert_eq!(times.to_string().lines().count(), 1 + MAX_STAGES);
    }
}
