//! Success against the number of easy demonstrations, of many runs: does the loop make up for demonstrations?

use crate::record::{Evaluation, RunResults, wilson95};
use crate::svg::{Axes, colour, document, legend, percent, ticks};
use std::collections::{BTreeMap, BTreeSet};

const WIDTH: f64 = 720.0;

/// What a point of the curve says of its runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Line {
    /// The policy before the loop.
    Initial,
    /// After the loop, without exploration.
    Plain,
    /// After the loop, with exploration.
    Explored,
}

impl Line {
    const ALL: [Self; 3] = [Self::Explored, Self::Plain, Self::Initial];

    /// Its name in legends and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Initial => "initial policy",
            Self::Plain => "last policy, no exploration",
            Self::Explored => "last policy, exploration",
        }
    }

    fn colour(self) -> &'static str {
        colour(match self {
            Self::Explored => 0,
            Self::Plain => 1,
            Self::Initial => 4,
        })
    }
}

/// One point: trials of all runs with as many demonstrations, together.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Point {
    /// Runs.
    pub runs: usize,
    /// Trials that succeeded.
    pub successes: usize,
    /// Trials.
    pub trials: usize,
}

impl Point {
    fn add(&mut self, e: &Evaluation) {
        self.runs += 1;
        self.successes += e.successes;
        self.trials += e.trials;
    }

    fn rate(&self) -> f64 {
        self.successes as f64 / self.trials.max(1) as f64
    }
}

/// The points by line and number of demonstrations. Trials of one policy count once: runs with and without exploration
/// that share a seed share their initial policy.
#[must_use]
pub fn points(runs: &[&RunResults]) -> BTreeMap<(Line, usize), Point> {
    let mut points: BTreeMap<(Line, usize), Point> = BTreeMap::new();
    let mut seen = BTreeSet::new();
    for run in runs {
        let n = run.demonstrations;
        if let Some(first) = run.iterations.first().filter(|_| seen.insert((n, run.seed))) {
            points.entry((Line::Initial, n)).or_default().add(&first.evaluation);
        }
        if let [_, .., last] = &run.iterations[..] {
            let line = if run.explored { Line::Explored } else { Line::Plain };
            points.entry((line, n)).or_default().add(&last.evaluation);
        }
    }
    points
}

/// The curve as a drawing, with the 95 % Wilson interval of every point's pooled trials.
#[must_use]
pub fn demonstration_curve(runs: &[&RunResults]) -> String {
    let points = points(runs);
    let numbers: Vec<usize> = points.keys().map(|k| k.1).collect::<BTreeSet<_>>().into_iter().collect();
    let last = numbers.len().saturating_sub(1).max(1) as f64;
    let axes = Axes {
        left: 70.0,
        top: 24.0,
        width: WIDTH - 94.0,
        height: 270.0,
        x: (-0.12 * last, 1.12 * last),
        y: (0.0, 1.0),
    };
    // Numbers stand at equal distances: they about double from one to the next.
    let at = |n: usize| numbers.iter().position(|m| *m == n).unwrap_or(0) as f64;
    let places: Vec<f64> = (0..numbers.len()).map(|i| i as f64).collect();
    let mut s = axes.grid(&ticks(0.0, 1.0, 5.0), percent);
    let name = |t: f64| numbers.iter().find(|n| at(**n) == t).map_or_else(String::new, usize::to_string);
    s += &axes.bottom_axis(&places, name, "demonstrations of the easy task");
    s += &axes.side_name(16.0, "success on the hard task");
    let mut entries = vec![];
    for (i, line) in Line::ALL.into_iter().enumerate() {
        let own: Vec<(usize, Point)> =
            points.iter().filter(|(k, _)| k.0 == line).map(|(k, p)| (k.1, *p)).collect();
        if own.is_empty() {
            continue;
        }
        let c = line.colour();
        let moved = Axes { left: axes.left + (i as f64 - 1.0) * 9.0, ..axes };
        let dashes = if line == Line::Initial { " stroke-dasharray=\"5 4\"" } else { "" };
        s += &moved.line(
            own.iter().map(|(n, p)| (at(*n), p.rate())),
            &format!("stroke=\"{c}\" stroke-width=\"2\"{dashes}"),
        );
        for (n, p) in own {
            let title = format!(
                "{}, {n} demonstrations: {}/{}, {} run(s)",
                line.name(),
                p.successes,
                p.trials,
                p.runs
            );
            s += &moved.bar(at(n), p.rate(), wilson95(p.successes, p.trials), c, &title);
        }
        entries.push((line.name().to_owned(), c.to_owned()));
    }
    let (keys, taken) = legend(&entries, axes.left, axes.bottom() + 58.0, axes.width);
    document(WIDTH, axes.bottom() + 50.0 + taken, "Success by number of demonstrations", &(s + &keys))
}

/// The curve as a Markdown table: a row a number of demonstrations, k/n and interval a line.
#[must_use]
pub fn table(runs: &[&RunResults]) -> String {
    let points = points(runs);
    let numbers: BTreeSet<usize> = points.keys().map(|k| k.1).collect();
    let mut lines = Line::ALL;
    lines.reverse();
    let mut s = "| demonstrations |".to_owned();
    s.extend(lines.map(|l| format!(" {} |", l.name())));
    s += "\n|---|---|---|---|\n";
    for n in numbers {
        s += &format!("| {n} |");
        for line in lines {
            s += &points.get(&(line, n)).map_or_else(
                || " |".to_owned(),
                |p| {
                    let [lo, hi] = wilson95(p.successes, p.trials);
                    format!(" {}/{} ({:.0} to {:.0} %) |", p.successes, p.trials, 100.0 * lo, 100.0 * hi)
                },
            );
        }
        s.push('\n');
    }
    s
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{sample, svg::px};

    fn run(demonstrations: usize, explored: bool, seed: u64) -> RunResults {
        RunResults { demonstrations, explored, ..sample::results(seed, 3) }
    }

    #[test]
    fn runs_of_a_kind_are_pooled_and_a_shared_initial_policy_counts_once() {
        let runs = [run(5, true, 0), run(5, false, 0), run(5, true, 1), run(40, true, 0)];
        let points = points(&runs.each_ref());
        // Of 50 trials each, the sample's seeds 0 and 1 start with 6 and 4 and end with 27 and 25 successes.
        let at = |line, n| points[&(line, n)];
        assert_eq!(at(Line::Initial, 5), Point { runs: 2, successes: 10, trials: 100 });
        assert_eq!(at(Line::Explored, 5), Point { runs: 2, successes: 52, trials: 100 });
        assert_eq!(at(Line::Plain, 5), Point { runs: 1, successes: 27, trials: 50 });
        assert!(!points.contains_key(&(Line::Plain, 40)));
        let text = table(&runs.each_ref());
        assert!(
            text.contains("| 5 | 10/100 (6 to 17 %) | 27/50 (40 to 67 %) | 52/100 (42 to 62 %) |"),
            "{text}"
        );
        assert!(text.contains("| 40 | 6/50 (6 to 24 %) | | 27/50"), "{text}");
    }

    #[test]
    fn bars_stand_where_the_intervals_are_and_nothing_is_still_a_drawing() {
        let runs = [run(2, true, 0), run(10, true, 0)];
        let svg = demonstration_curve(&runs.each_ref());
        assert_eq!(svg.matches("class=\"bar\"").count(), 4);
        // 27 of 50 in a plot from 24 (100%) to 294 (0%).
        assert!(svg.contains(&format!("cy=\"{}\"", px(294.0 - 270.0 * 0.54))), "{svg}");
        assert!(svg.contains(">2</text>") && svg.contains(">10</text>"));
        assert!(!svg.contains("no exploration"), "no run without exploration, no entry for it");
        let nothing = demonstration_curve(&[]);
        assert!(nothing.starts_with("<svg") && !nothing.contains("NaN") && !nothing.contains("inf"));
    }
}
