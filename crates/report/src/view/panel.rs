//! Which entries of a column are drawn together.

/// Lines that share one plot.
#[derive(Debug, PartialEq)]
pub(super) struct Panel {
    pub(super) title: String,
    /// Name and entry of each line.
    pub(super) lines: Vec<(String, usize)>,
}

/// Most lines in one plot; more cannot be told apart.
pub(super) const LINES: usize = 8;
/// Most plots of one column.
const PANELS: usize = 8;

const POSITION: [&str; 3] = ["x", "y", "z"];
const QUATERNION: [&str; 4] = ["qw", "qx", "qy", "qz"];
const ROTATION: [&str; 6] = ["roll", "pitch", "yaw", "rx", "ry", "rz"];

/// Splits a column into plots: x, y, z of one thing are one, its quaternion another, and all that is left a third (and more
/// where it is long).
pub(super) fn panels(column: &str, entries: &[String]) -> Vec<Panel> {
    let short = column.strip_prefix("observation.").unwrap_or(column);
    let mut panels: Vec<Panel> = vec![];
    let mut rest = vec![];
    for (i, entry) in entries.iter().enumerate() {
        let (thing, last) = entry.rsplit_once(['_', '.']).unwrap_or(("", entry));
        let kind = if POSITION.contains(&last) {
            "position"
        } else if QUATERNION.contains(&last) {
            "quaternion"
        } else if ROTATION.contains(&last) {
            "rotation"
        } else {
            rest.push((entry.clone(), i));
            continue;
        };
        let title = format!("{short}: {thing} {kind}").replace(":  ", ": ");
        let line = (last.to_owned(), i);
        match panels.iter_mut().find(|p| p.title == title) {
            Some(panel) => panel.lines.push(line),
            None => panels.push(Panel { title, lines: vec![line] }),
        }
    }
    let alone = rest.len() == 1 && !panels.is_empty();
    let parts = rest.len().div_ceil(LINES);
    for (part, lines) in rest.chunks(LINES).enumerate() {
        let title = match lines {
            [(name, _)] if alone => format!("{short}: {name}"),
            _ if parts > 1 => format!("{short} ({} of {parts})", part + 1),
            _ => short.to_owned(),
        };
        panels.push(Panel { title, lines: lines.to_vec() });
    }
    panels
}

/// The first plots of a column, and how many entries are left out.
pub(super) fn limited(mut panels: Vec<Panel>) -> (Vec<Panel>, usize) {
    let left = panels.iter().skip(PANELS).map(|p| p.lines.len()).sum();
    panels.truncate(PANELS);
    (panels, left)
}

#[cfg(test)]
mod tests {
    use super::*;
    use e2h_data::lerobot::{ACTION_NAMES, STATE_NAMES};

    fn titles(column: &str, entries: &[&str]) -> Vec<(String, usize)> {
        let entries: Vec<String> = entries.iter().map(|e| (*e).to_owned()).collect();
        panels(column, &entries).into_iter().map(|p| (p.title, p.lines.len())).collect()
    }

    #[test]
    fn poses_are_taken_apart_and_joints_stay_together() {
        let expected = [
            ("state: eef position", 3),
            ("state: eef quaternion", 4),
            ("state: object position", 3),
            ("state: object quaternion", 4),
            ("state: gripper", 1),
        ];
        assert_eq!(titles("observation.state", &STATE_NAMES), expected.map(|(t, n)| (t.to_owned(), n)));
        assert_eq!(titles("action", &ACTION_NAMES).len(), 3);
        let joints = ["shoulder_pan.pos", "elbow.pos", "gripper.pos"];
        assert_eq!(titles("action", &joints), [("action".to_owned(), 3)]);
        assert_eq!(titles("p", &["x", "y", "z"]), [("p: position".to_owned(), 3)]);
    }

    #[test]
    fn long_columns_are_split_and_limited() {
        let entries: Vec<String> = (0..100).map(|i| i.to_string()).collect();
        let all = panels("observation.environment_state", &entries);
        assert_eq!((all.len(), all[12].lines.len()), (13, 4));
        assert_eq!(all[1].title, "environment_state (2 of 13)");
        let (shown, left) = limited(all);
        assert_eq!((shown.len(), left), (8, 100 - 64));
    }
}
