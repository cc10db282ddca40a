//! The success curve as plain text.

use crate::record::{IterationRecord, RunResults};
use crate::svg::percent;

/// Text table for a terminal: iteration, success k/n, Wilson 95 %, minutes, external resets, frames kept. Ends with a
/// line break.
#[must_use]
pub fn iterations(results: &RunResults) -> String {
    let mut rows =
        vec![["iteration", "success", "Wilson 95%", "minutes", "resets", "frames kept"].map(str::to_owned)];
    rows.extend(results.iterations.iter().map(row));
    let width = |c: usize| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0);
    let widths: [usize; 6] = std::array::from_fn(width);
    let mut text = String::new();
    for (i, cells) in rows.iter().enumerate() {
        let line: Vec<String> = cells.iter().zip(widths).map(|(cell, w)| format!("{cell:>w$}")).collect();
        text += &line.join("  ");
        text.push('\n');
        if i == 0 {
            text += &widths.map(|w| "-".repeat(w)).join("  ");
            text.push('\n');
        }
    }
    text
}

fn row(r: &IterationRecord) -> [String; 6] {
    let e = &r.evaluation;
    let c = r.collection.as_ref();
    let frames = |kept: usize| if r.skipped { "skipped".to_owned() } else { kept.to_string() };
    [
        r.iteration.to_string(),
        format!("{}/{}", e.successes, e.trials),
        interval(e.wilson95),
        format!("{:.1}", r.minutes),
        c.map_or("-".to_owned(), |c| c.resets.values().sum::<usize>().to_string()),
        c.map_or("-".to_owned(), |c| frames(c.frames_kept)),
    ]
}

/// `21% to 45%`.
pub(crate) fn interval([lo, hi]: [f64; 2]) -> String {
    format!("{} to {}", percent(lo), percent(hi))
}

#[cfg(test)]
mod tests {
    use crate::sample;

    #[test]
    fn columns_line_up() {
        let text = super::iterations(&sample::results(1, 3));
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 5);
        assert!(lines.iter().all(|l| l.len() == lines[0].len()), "{text}");
        assert_eq!(lines[2], "        0     4/50   3% to 19%     11.0       -            -");
        assert!(lines[3].ends_with("24         6090"), "{text}");
    }
}
