//! What `--stats` wrote, read by the names of its columns, and the figures drawn from it.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};

/// A CSV file of numbers. Columns that nobody asks for may hold anything.
#[derive(Debug, Clone, PartialEq)]
pub struct Samples {
    source: String,
    columns: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Samples {
    /// Reads a CSV file with one line of column names.
    ///
    /// # Errors
    /// When it cannot be read, is empty, or has a row of another length than its head.
    pub fn load(path: &Path) -> Result<Self> {
        let source = path.display().to_string();
        let text = fs::read_to_string(path).with_context(|| source.clone())?;
        Self::parse(&text, &source)
    }

    /// As [`Samples::load`], from text; `source` is for messages.
    ///
    /// # Errors
    /// As [`Samples::load`].
    pub fn parse(text: &str, source: &str) -> Result<Self> {
        let cells = |line: &str| line.split(',').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>();
        let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        let (_, head) = lines.next().with_context(|| format!("{source}: empty; a line of column names was expected"))?;
        let columns = cells(head);
        let mut rows = Vec::new();
        for (at, line) in lines {
            let row = cells(line);
            ensure!(row.len() == columns.len(), "{source}: line {}: {} cells under {} names", at + 1, row.len(), columns.len());
            rows.push(row);
        }
        Ok(Self { source: source.to_owned(), columns, rows })
    }

    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// True without rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Names of the columns, in order.
    #[must_use]
    pub fn columns(&self) -> &[String] {
        &self.columns
    }

    /// A column, row by row; `None` where the cell is empty.
    ///
    /// # Errors
    /// When there is no such column, or a cell of it is no finite number.
    pub fn column(&self, name: &str) -> Result<Vec<Option<f64>>> {
        let at = self.columns.iter().position(|column| column == name);
        let at = at.with_context(|| format!("{}: no column {name:?} among {}", self.source, self.columns.join(", ")))?;
        let number = |(row, cells): (usize, &Vec<String>)| match cells[at].as_str() {
            "" => Ok(None),
            cell => match cell.parse::<f64>() {
                Ok(value) if value.is_finite() => Ok(Some(value)),
                _ => anyhow::bail!("{}: row {}: {name} {cell:?} is no number", self.source, row + 1),
            },
        };
        self.rows.iter().enumerate().map(number).collect()
    }

    /// The rows where `column` is at least its own smallest value plus `offset`; rows without that cell are left out.
    ///
    /// # Errors
    /// As [`Samples::column`].
    pub fn after(&self, column: &str, offset: f64) -> Result<Self> {
        let values = self.column(column)?;
        let start = values.iter().flatten().copied().fold(f64::INFINITY, f64::min) + offset;
        let late = |value: &Option<f64>| value.is_some_and(|value| value >= start);
        let rows = values.iter().zip(&self.rows).filter(|(value, _)| late(value)).map(|(_, row)| row.clone()).collect();
        Ok(Self { source: self.source.clone(), columns: self.columns.clone(), rows })
    }
}

/// The value that the share `q` (0 to 1) of `values` does not exceed: nearest rank, so it is one of them. `None` without values.
#[must_use]
pub fn percentile(values: &[f64], q: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1).min(sorted.len().saturating_sub(1))).copied()
}

/// The middle value, or the mean of the two in the middle. `None` without values.
#[must_use]
pub fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    match sorted.get(middle).copied() {
        Some(upper) if sorted.len().is_multiple_of(2) => Some(0.5 * (sorted[middle - 1] + upper)),
        odd => odd,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name_and_others_ignored() {
        let samples = Samples::parse("frame, light_age_us,note\n1,20.5,a b\n2,,x\n\n3,7,\n", "viewer.csv").unwrap();
        assert_eq!(samples.len(), 3);
        assert_eq!(samples.column("light_age_us").unwrap(), [Some(20.5), None, Some(7.0)]);
        assert!(samples.column("note").is_err());
        let error = samples.column("age").unwrap_err().to_string();
        assert!(error.contains("viewer.csv") && error.contains("\"age\"") && error.contains("light_age_us"), "{error}");
    }

    #[test]
    fn broken_files_are_named() {
        assert!(Samples::parse("", "a.csv").unwrap_err().to_string().contains("a.csv: empty"));
        assert!(Samples::parse("x,y\n1,2\n3\n", "a.csv").unwrap_err().to_string().contains("line 3: 1 cells under 2"));
        assert!(Samples::parse("x\ninf\n", "a.csv").unwrap().column("x").unwrap_err().to_string().contains("no number"));
    }

    #[test]
    fn rows_after_an_offset() {
        let samples = Samples::parse("t,v\n12,b\n10,a\n,\n15,c\n", "a.csv").unwrap();
        assert_eq!(samples.after("t", 2.0).unwrap().column("t").unwrap(), [Some(12.0), Some(15.0)]);
        assert!(Samples::parse("t\n", "a.csv").unwrap().after("t", 0.0).unwrap().is_empty());
    }

    #[test]
    fn percentiles_are_nearest_rank() {
        let values = [4.0, 1.0, 3.0, 2.0];
        assert_eq!(percentile(&values, 0.0), Some(1.0));
        assert_eq!(percentile(&values, 0.5), Some(2.0));
        assert_eq!(percentile(&values, 0.51), Some(3.0));
        assert_eq!(percentile(&values, 1.0), Some(4.0));
        assert_eq!(percentile(&[], 0.5), None);
        assert_eq!((median(&values), median(&values[..3]), median(&[])), (Some(2.5), Some(3.0), None));
    }
}
