/// What an answer to a misspelt name suggests: a candidate that the name abbreviates, or the one with the fewest edits from
/// it; none where so many letters differ that it would be a guess.
///
/// ```
/// assert_eq!(e2h_core::nearest("lapto", ["smoke", "laptop", "paper"]), Some("laptop"));
/// assert_eq!(e2h_core::nearest("nut", ["nut_assembly", "disk"]), Some("nut_assembly"));
/// assert_eq!(e2h_core::nearest("tpc", ["tcp", "joints"]), Some("tcp"));
/// assert_eq!(e2h_core::nearest("kettle", ["nut_assembly", "disk"]), None);
/// ```
#[must_use]
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let candidates: Vec<&str> = candidates.into_iter().collect();
    // A part of a name, or a name with something added, is meant as that name however many letters are missing.
    let shared =
        |candidate: &&&str| !name.is_empty() && (candidate.contains(name) || name.contains(**candidate));
    let length = |candidate: &&&str| candidate.chars().count().abs_diff(name.chars().count());
    let parts = candidates.iter().filter(shared).min_by_key(|c| (!c.starts_with(name), length(c)));
    let (edited, distance) = candidates.iter().map(|c| (c, edits(name, c))).min_by_key(|(_, n)| *n)?;
    let longest = edited.chars().count().max(name.chars().count());
    let near = (2 * distance <= longest).then_some(edited);
    // One or two letters apart is a slip of the hand, and beats a shared part.
    if distance <= 2 { near.or(parts) } else { parts.or(near) }.copied()
}

/// Letters to insert, delete, replace or swap with their neighbour between two names.
fn edits(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut rows: Vec<Vec<usize>> = vec![(0..=b.len()).collect()];
    for i in 1..=a.len() {
        let mut row = vec![i];
        for j in 1..=b.len() {
            let replaced = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            let mut least = replaced.min(rows[i - 1][j] + 1).min(row[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                least = least.min(rows[i - 2][j - 2] + 1);
            }
            row.push(least);
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
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
