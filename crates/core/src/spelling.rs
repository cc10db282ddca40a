/// The candidate with the fewest edits from `name`: what an answer to a misspelt name suggests.
///
/// ```
/// assert_eq!(e2h_core::nearest("lapto", ["smoke", "laptop", "paper"]), Some("laptop"));
/// ```
#[must_use]
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    candidates.into_iter().min_by_key(|candidate| edits(name, candidate))
}

/// Letters to insert, delete or replace between two names.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(x != *y);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}

/// Longest text of a file that is repeated in a message, characters.
const LONGEST: usize = 1000;

/// Text out of a file, or about one, fit for a message: on one line, without control characters, and not too long.
///
/// ```
/// assert_eq!(e2h_core::one_line("two\nlines"), "two\u{fffd}lines");
/// ```
#[must_use]
pub fn one_line(text: &str) -> String {
    let mut characters = text.chars();
    let line: String =
        characters.by_ref().take(LONGEST).map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
    match characters.count() {
        0 => line,
        more => format!("{line}... ({more} more characters)"),
    }
}
