//! Tables as Markdown and CSV.

/// Rows of text under a head.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows.
    #[must_use]
    pub fn new(head: &[&str]) -> Self {
        Self { head: head.iter().map(|&name| name.to_owned()).collect(), rows: Vec::new() }
    }

    /// Adds a row; cells beyond the head are dropped, missing ones are empty.
    pub fn push(&mut self, cells: impl IntoIterator<Item = String>) {
        let mut row: Vec<String> = cells.into_iter().take(self.head.len()).collect();
        row.resize(self.head.len(), String::new());
        self.rows.push(row);
    }

    /// GitHub's Markdown.
    #[must_use]
    pub fn markdown(&self) -> String {
        let line = |cells: &[String]| {
            let cells: Vec<_> = cells.iter().map(|cell| cell.replace('|', "\\|").replace('\n', " ")).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        let rule = format!("|{}\n", "---|".repeat(self.head.len()));
        [line(&self.head), rule].into_iter().chain(self.rows.iter().map(|row| line(row))).collect()
    }

    /// CSV of RFC 4180, with \n as line end.
    #[must_use]
    pub fn csv(&self) -> String {
        let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
        let cell = |text: &String| if text.contains([',', '"', '\n', '\r']) { quoted(text) } else { text.clone() };
        let line = |cells: &Vec<String>| cells.iter().map(cell).collect::<Vec<_>>().join(",") + "\n";
        std::iter::once(&self.head).chain(&self.rows).map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms() {
        let mut table = Table::new(&["name", "ms"]);
        table.push(["a|b, \"c\"".to_owned(), "1.5".to_owned(), "dropped".to_owned()]);
        table.push(["d".to_owned()]);
        assert_eq!(table.markdown(), "| name | ms |\n|---|---|\n| a\\|b, \"c\" | 1.5 |\n| d |  |\n");
        assert_eq!(table.csv(), "name,ms\n\"a|b, \"\"c\"\"\",1.5\nd,\n");
    }
}
