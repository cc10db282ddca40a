//! How each fate of a frame is named and drawn.

#[derive(Clone, Copy, PartialEq)]
enum Fill {
    Solid,
    /// Lines that rise to the right.
    Forward,
    /// Lines that fall to the right.
    Backward,
    /// Dots.
    Dotted,
}

struct Style {
    /// Name without case and separators, so that `LowAdvantage` and `low_advantage` are one.
    key: &'static str,
    label: &'static str,
    colour: &'static str,
    fill: Fill,
}

const fn style(key: &'static str, label: &'static str, colour: &'static str, fill: Fill) -> Style {
    Style { key, label, colour, fill }
}

/// In the order of the stages, which is the order of legends and bars.
const STYLES: [Style; 8] = [
    style("kept", "kept", "#2a9d4e", Fill::Solid),
    style("resampled", "low-speed resampled", "#2f7ed8", Fill::Backward),
    style("static", "static", "#6b7684", Fill::Forward),
    style("lowadvantage", "low advantage", "#d64545", Fill::Solid),
    style("dynamicserror", "dynamics error", "#e07b1a", Fill::Solid),
    style("tooshort", "too short", "#9aa3ad", Fill::Solid),
    style("aftergoal", "after the goal", "#8a63d2", Fill::Dotted),
    style("", "other", "#c2458f", Fill::Dotted),
];

fn normal(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

/// Position of a fate among the styles; unknown names share the last.
pub(crate) fn rank(name: &str) -> usize {
    let name = normal(name);
    STYLES.iter().position(|s| s.key == name).unwrap_or(STYLES.len() - 1)
}

/// How many fates are told apart.
pub(crate) const RANKS: usize = STYLES.len();

/// What a legend calls the fate.
pub(crate) fn label(rank: usize) -> &'static str {
    STYLES[rank.min(RANKS - 1)].label
}

/// Fill of the fate in a drawing whose patterns are called `prefix`.
pub(crate) fn fill(rank: usize, prefix: &str) -> String {
    format!("url(#{prefix}{rank})")
}

/// The patterns behind [`fill`]. Every drawing has its own `prefix`: a page may hide one drawing and show another.
pub(crate) fn patterns(prefix: &str) -> String {
    let mut s = String::from("<defs>");
    for (rank, style) in STYLES.iter().enumerate() {
        let (strength, lines) = match style.fill {
            Fill::Solid => (0.38, ""),
            Fill::Forward => (0.10, "<path d=\"M-2 2L2-2M0 8L8 0M6 10L10 6\"/>"),
            Fill::Backward => (0.10, "<path d=\"M-2 6L2 10M0 0L8 8M6-2L10 2\"/>"),
            Fill::Dotted => (0.14, "<path d=\"M2 2h.1M6 6h.1\" stroke-linecap=\"round\"/>"),
        };
        s += &format!(
            "<pattern id=\"{prefix}{rank}\" width=\"8\" height=\"8\" patternUnits=\"userSpaceOnUse\" stroke=\"{c}\" \
             stroke-width=\"1.7\"><rect width=\"8\" height=\"8\" stroke=\"none\" fill=\"{c}\" \
             fill-opacity=\"{strength}\"/>{lines}</pattern>",
            c = style.colour
        );
    }
    s + "</defs>"
}

/// The fate that each frame is painted with. Re-timing keeps every second or third frame of a slow run; the whole run is
/// painted as resampled, as stripes of one frame could not be read.
pub(crate) fn painted(fates: &[String]) -> Vec<usize> {
    const LONGEST_GAP: usize = 2;
    let (kept, resampled) = (rank("kept"), rank("resampled"));
    let mut ranks: Vec<usize> = fates.iter().map(|f| rank(f)).collect();
    let mut last = None;
    for t in 0..ranks.len() {
        if ranks[t] != resampled {
            continue;
        }
        let gap = last.map_or(t, |l: usize| l + 1)..t;
        if gap.len() <= LONGEST_GAP && ranks[gap.clone()].iter().all(|r| *r == kept) {
            ranks[gap].fill(resampled);
        }
        last = Some(t);
    }
    ranks
}

/// Rules for `.f0`, `.f1`, ... that paint an element as the fate of that rank.
pub(crate) fn css() -> String {
    let rule = |(rank, style): (usize, &Style)| {
        let c = style.colour;
        let lines = |angle: i32| format!("repeating-linear-gradient({angle}deg,{c} 0 2px,{c}38 2px 6px)");
        let paint = match style.fill {
            Fill::Solid => c.to_owned(),
            Fill::Forward => lines(-45),
            Fill::Backward => lines(45),
            Fill::Dotted => format!("radial-gradient({c} 1.4px,{c}40 1.6px) 0 0/5px 5px"),
        };
        format!(".f{rank}{{background:{paint}}}\n")
    };
    STYLES.iter().enumerate().map(rule).collect()
}

/// A prefix for [`patterns`] that depends on what is drawn and on nothing else (64-bit FNV-1a).
pub(crate) fn prefix(drawn: impl Iterator<Item = u8>) -> String {
    format!("f{:016x}-", e2h_core::fnv1a(drawn))
}

/// `120 frames: 80 kept (67%), 40 static (33%)`, in the order of the stages; names that are not known come last.
#[must_use]
pub(crate) fn totals<'a>(fates: impl Iterator<Item = (&'a str, usize)>) -> String {
    let mut parts: Vec<(usize, &str, usize)> =
        fates.map(|(name, n)| (rank(name), name, n)).filter(|p| p.2 > 0).collect();
    parts.sort_unstable();
    let sum: usize = parts.iter().map(|p| p.2).sum();
    let parts: Vec<String> = parts
        .into_iter()
        .map(|(rank, name, n)| {
            let name = if rank == RANKS - 1 { name } else { label(rank) };
            format!("{n} {name} ({})", crate::svg::percent(n as f64 / sum as f64))
        })
        .collect();
    if parts.is_empty() { "0 frames".to_owned() } else { format!("{sum} frames: {}", parts.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spellings_are_one_fate() {
        assert_eq!(rank("LowAdvantage"), rank("low_advantage"));
        assert_eq!(label(rank("too-short")), "too short");
        assert_eq!(rank("eaten"), RANKS - 1);
    }

    #[test]
    fn totals_follow_the_stages_and_name_the_unknown() {
        let fates = [("static", 25), ("kept", 70), ("eaten", 5), ("too_short", 0)];
        assert_eq!(totals(fates.into_iter()), "100 frames: 70 kept (70%), 25 static (25%), 5 eaten (5%)");
        assert_eq!(totals([].into_iter()), "0 frames");
    }
}
