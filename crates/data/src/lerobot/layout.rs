//! Whether a dataset is one of this project's episodes: the same columns, at the same rate, seen by the same cameras.

use super::episode::{SOURCE_EXCURSION, features};
use super::feature::Feature;
use super::info::Info;

/// What keeps a dataset from being read as episodes with these cameras (name, height, width), in words; empty when nothing does.
/// Columns and cameras beside those are no problem. `larger`: images of the same proportions may be larger.
#[must_use]
pub fn misfits(info: &Info, fps: f64, cameras: &[(String, usize, usize)], larger: bool) -> Vec<String> {
    let mut problems = vec![];
    if (info.fps - fps).abs() > 1e-9 {
        problems.push(format!("frame rate: expected {fps} Hz, found {}", info.fps));
    }
    for (name, wanted) in features(cameras) {
        // Datasets from before exploration have no such column.
        let optional = name == SOURCE_EXCURSION;
        match info.features.iter().find(|(n, _)| *n == name) {
            Some((_, found)) => problems.extend(difference(&name, &wanted, found, larger)),
            None if optional => {}
            None => problems.push(format!("feature `{name}`: expected {}, found none", wanted.describe())),
        }
    }
    problems
}

fn difference(name: &str, wanted: &Feature, found: &Feature, larger: bool) -> Option<String> {
    let differ = |expected: String, found: String| {
        Some(format!("feature `{name}`: expected {expected}, found {found}"))
    };
    if let Some((height, width)) = wanted.image_size() {
        let (expected, or) =
            (format!("images of {height} x {width}"), if larger { " or larger" } else { "" });
        return match found.image_size() {
            Some(size) if size == (height, width) => None,
            Some((h, w)) if larger && h >= height && h * width == w * height => None,
            Some((h, w)) => differ(expected + or, format!("{h} x {w}")),
            None => differ(expected + or, found.describe()),
        };
    }
    if (wanted.dtype, &wanted.shape) != (found.dtype, &found.shape) {
        return differ(wanted.describe(), found.describe());
    }
    let (expected, given) =
        (wanted.entry_names().unwrap_or_default(), found.entry_names().unwrap_or_default());
    // Which entry is which is known by its place; other names say that it is something else.
    let at = expected
        .iter()
        .zip(given.iter().map(Some).chain(std::iter::repeat(None)))
        .find(|(a, b)| Some(*a) != *b);
    at.and_then(|(expected, given)| {
        differ(
            format!("an entry `{expected}`"),
            given.map_or("none".to_owned(), |g| format!("`{}`", e2h_core::one_line(g))),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lerobot::Dtype;

    fn cameras(side: usize) -> Vec<(String, usize, usize)> {
        ["table", "wrist"].map(|name| (name.to_owned(), side, side)).to_vec()
    }

    #[test]
    fn our_own_layout_fits_and_whatever_differs_is_named() {
        let info = |fps, features| Info::new(fps, None, features).unwrap();
        let own = features(&cameras(32));
        assert_eq!(misfits(&info(20.0, own.clone()), 20.0, &cameras(32), false), [""; 0]);
        // Larger ones where they may be, and one camera of two.
        assert_eq!(misfits(&info(20.0, own.clone()), 20.0, &cameras(16)[1..], true), [""; 0]);
        assert_eq!(misfits(&info(20.0, own.clone()), 20.0, &cameras(16), false).len(), 2);
        assert_eq!(misfits(&info(20.0, own.clone()), 20.0, &cameras(64), true).len(), 2);

        let mut other = own.clone();
        other[0].1 = Feature::vector(&["x"; 15]);
        other[2].1 = Feature::image(32, 48);
        other[3].1 = Feature::vector(&["x", "y", "z", "roll", "pitch", "yaw", "gripper"]);
        other[4].1 = Feature::scalar(Dtype::Int64);
        other.retain(|(n, _)| n != "observation.images.table" && n != "source.seed" && n != SOURCE_EXCURSION);
        let found = misfits(&info(30.0, other), 20.0, &cameras(32), true);
        let words = [
            "expected 20 Hz, found 30",
            "`observation.state`: expected an entry `eef_x`, found `x`",
            "`observation.images.table`: expected image [32, 32, 3], found none",
            "`observation.images.wrist`: expected images of 32 x 32 or larger, found 32 x 48",
            "`action`: expected float32 [8], found float32 [7]",
            "`next.success`: expected bool [1], found int64 [1]",
            "`source.seed`: expected int64 [1], found none",
        ];
        assert_eq!(found.len(), words.len(), "{found:?}");
        for (problem, words) in found.iter().zip(words) {
            assert!(problem.contains(words), "{words} in {problem}");
        }
    }
}
