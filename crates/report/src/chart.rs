//! Charts of one run or several, as inline SVG.

use crate::fate;
use crate::record::{IterationRecord, RunResults};
use crate::svg::{Axes, colour, document, escape, legend, number, percent, px, text_width, ticks};
use std::collections::BTreeSet;

const WIDTH: f64 = 720.0;
const ITERATION_AXIS: &str = "iteration (0: initial policy)";

/// Success rate of the hard policy against the iteration, with 95 % Wilson bars and k/n; one colour a run. Runs of the
/// same task and preset get their mean as a dashed line.
#[must_use]
pub fn success_curve(runs: &[&RunResults]) -> String {
    let several = runs.len() > 1;
    let axes = Axes {
        left: 70.0,
        top: 30.0,
        width: WIDTH - 70.0 - if several { 66.0 } else { 24.0 },
        height: 270.0,
        x: iteration_range(runs),
        y: (0.0, 1.0),
    };
    let mut s = axes.grid(&ticks(0.0, 1.0, 5.0), percent);
    s += &iteration_axis(&axes);
    s += &axes.side_name(16.0, "success on the hard task");
    let names = names(runs);
    let mut ends = vec![];
    let dodge = (axes.width / (axes.x.1 - axes.x.0) * 0.5 / runs.len().max(1) as f64).min(11.0);
    for (i, run) in runs.iter().enumerate() {
        let shift = (i as f64 - (runs.len() as f64 - 1.0) / 2.0) * dodge;
        let moved = Axes { left: axes.left + shift, ..axes };
        s += &series(&moved, run, colour(i), &names[i], several);
        if let Some(last) = run.iterations.last().filter(|_| several) {
            ends.push((moved.py(rate(last)), i, fraction(last)));
        }
    }
    s += &end_labels(&axes, ends);
    let mut entries: Vec<(String, String)> =
        names.into_iter().enumerate().map(|(i, n)| (n, colour(i).to_owned())).collect();
    if several && comparable(runs) {
        s += &axes.line(
            mean(runs).into_iter(),
            "stroke=\"var(--ink)\" stroke-width=\"2.5\" stroke-dasharray=\"7 5\"",
        );
        entries.push(("mean".to_owned(), "var(--ink)".to_owned()));
    }
    let (keys, taken) = legend(&entries, axes.left, axes.bottom() + 62.0, axes.width);
    document(WIDTH, axes.bottom() + 54.0 + taken, "Success rate by iteration", &(s + &keys))
}

fn series(axes: &Axes, run: &RunResults, colour: &str, name: &str, several: bool) -> String {
    let points = run.iterations.iter().map(|r| (f64::from(r.iteration), rate(r)));
    let mut s = axes.line(points, &format!("stroke=\"{colour}\" stroke-width=\"2\" opacity=\".75\""));
    for r in &run.iterations {
        let title = format!("{name}, iteration {}: {}", r.iteration, fraction(r));
        s += &axes.bar(f64::from(r.iteration), rate(r), r.evaluation.wilson95, colour, &title);
        if !several {
            let x = px(axes.px(f64::from(r.iteration)));
            let y = px(axes.py(r.evaluation.wilson95[1]) - 7.0);
            s += &format!("<text class=\"mid b halo\" x=\"{x}\" y=\"{y}\">{}</text>", fraction(r));
        }
    }
    s
}

/// k/n of every run's last policy in the right margin, pushed apart where they would touch.
fn end_labels(axes: &Axes, mut ends: Vec<(f64, usize, String)>) -> String {
    ends.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let (mut s, mut free) = (String::new(), f64::NEG_INFINITY);
    // Labels at the bottom are lifted together, so that the lowest still stands on the axis.
    let count = ends.len();
    for (i, (y, run, text)) in ends.into_iter().enumerate() {
        let lowest = axes.bottom() - 15.0 * (count - 1 - i) as f64;
        let y = y.min(lowest).max(free);
        free = y + 15.0;
        s += &format!(
            "<text class=\"b\" x=\"{}\" y=\"{}\" style=\"fill:{}\">{text}</text>",
            px(axes.right() + 8.0),
            px(y + 4.5),
            colour(run)
        );
    }
    s
}

/// Mean training loss of the policy and validation loss of the critic against the iteration, one colour a run; no
/// point where the stage was skipped.
#[must_use]
pub fn losses(runs: &[&RunResults]) -> String {
    let critic = |r: &IterationRecord| r.collection.as_ref().and_then(|c| c.critic_loss).unwrap_or(f64::NAN);
    let gap = 76.0;
    let width = (WIDTH - 2.0 * gap - 20.0) / 2.0;
    let mut s = panel(runs, gap, width, "policy loss", |r| if r.skipped { f64::NAN } else { r.loss });
    s += &panel(runs, 2.0 * gap + width, width, "critic loss", critic);
    let entries: Vec<(String, String)> =
        names(runs).into_iter().enumerate().map(|(i, n)| (n, colour(i).to_owned())).collect();
    let (keys, taken) = legend(&entries, gap, 262.0, WIDTH - gap);
    document(WIDTH, 254.0 + taken, "Losses by iteration", &(s + &keys))
}

/// Loss of one training against the step, and that on held-out episodes, on a logarithmic axis.
///
/// # Shapes
/// `train` and `held_out` are (step, loss); losses that are not above 0 leave a gap.
#[must_use]
pub fn training_curve(train: &[(f64, f64)], held_out: &[(f64, f64)]) -> String {
    let log = |v: f64| if v > 0.0 { v.log10() } else { f64::NAN };
    let all = || train.iter().chain(held_out);
    let values = || all().map(|p| log(p.1)).filter(|v| v.is_finite());
    let (low, high) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    let (low, high) =
        if low <= high { (low.floor(), high.ceil().max(low.floor() + 1.0)) } else { (-3.0, 0.0) };
    let last = all().map(|p| p.0).fold(1.0, f64::max);
    let axes =
        Axes { left: 80.0, top: 20.0, width: WIDTH - 104.0, height: 270.0, x: (0.0, last), y: (low, high) };
    let decades: Vec<f64> = ticks(low, high, (high - low).min(6.0));
    let mut s = axes.grid(&decades, |t| number(10_f64.powf(t)));
    s += &axes.bottom_axis(&ticks(0.0, last, 6.0), number, "step");
    s += &axes.side_name(16.0, "loss");
    let mut entries = vec![];
    for (i, (name, points)) in [("training", train), ("held-out episodes", held_out)].into_iter().enumerate()
    {
        if points.is_empty() {
            continue;
        }
        let line = points.iter().map(|p| (p.0, log(p.1)));
        s += &axes.line(line, &format!("stroke=\"{}\" stroke-width=\"2\"", colour(i)));
        entries.push((name.to_owned(), colour(i).to_owned()));
    }
    let (keys, taken) = legend(&entries, axes.left, axes.bottom() + 62.0, axes.width);
    document(WIDTH, axes.bottom() + 54.0 + taken, "Loss by step", &(s + &keys))
}

fn panel(
    runs: &[&RunResults],
    left: f64,
    width: f64,
    name: &str,
    value: impl Fn(&IterationRecord) -> f64,
) -> String {
    let points = |run: &RunResults| -> Vec<(f64, f64)> {
        run.iterations
            .iter()
            .map(|r| (f64::from(r.iteration), value(r)))
            .filter(|p| p.1.is_finite())
            .collect()
    };
    let top = runs.iter().flat_map(|r| points(r)).map(|p| p.1).fold(0.0, f64::max);
    let y = (0.0, if top > 0.0 { top * 1.08 } else { 1.0 });
    let axes = Axes { left, top: 14.0, width, height: 186.0, x: iteration_range(runs), y };
    let mut s = axes.side_name(left - 54.0, name) + &iteration_axis(&axes);
    if top > 0.0 {
        s += &axes.grid(&ticks(0.0, y.1, 4.0), number);
    } else {
        let (x, y) = (px(left + width / 2.0), px(110.0));
        s += &format!("<text class=\"soft mid\" x=\"{x}\" y=\"{y}\">no values</text>");
    }
    for (i, run) in runs.iter().enumerate() {
        let points = points(run);
        let c = colour(i);
        s += &axes.line(points.iter().copied(), &format!("stroke=\"{c}\" stroke-width=\"2\""));
        for (x, y) in points {
            let (cx, cy) = (px(axes.px(x)), px(axes.py(y)));
            s += &format!(
                "<circle cx=\"{cx}\" cy=\"{cy}\" r=\"3.5\" fill=\"{c}\"><title>{}</title></circle>",
                number(y)
            );
        }
    }
    s
}

/// Minutes of every stage as a stacked bar an iteration.
#[must_use]
pub fn stage_times(results: &RunResults) -> String {
    let order = ["demonstrations", "train easy", "collect", "refine", "critic", "train", "evaluate"];
    let mut stages: Vec<String> = results
        .iterations
        .iter()
        .flat_map(|r| r.stage_minutes.keys().cloned())
        .collect::<BTreeSet<_>>()
        .into_iter()
        .collect();
    stages.sort_by_key(|s| order.iter().position(|o| o == s).unwrap_or(order.len()));
    let rows: Vec<Row> = results
        .iterations
        .iter()
        .map(|r| Row {
            name: r.iteration.to_string(),
            parts: stages.iter().map(|s| r.stage_minutes.get(s).copied().unwrap_or(0.0)).collect(),
            total: format!("{} min", number(r.stage_minutes.values().sum())),
        })
        .collect();
    let entries: Vec<(String, String)> =
        stages.into_iter().enumerate().map(|(i, s)| (s, colour(i).to_owned())).collect();
    stacked(&rows, &entries, "", "Minutes by stage and iteration")
}

/// Frames of the accepted reversals by fate as a stacked bar an iteration.
#[must_use]
pub fn fates(results: &RunResults) -> String {
    let rows: Vec<Row> = results
        .iterations
        .iter()
        .filter_map(|r| {
            let collection = r.collection.as_ref()?;
            let mut parts = vec![0.0; fate::RANKS];
            for (fate, n) in &collection.fates {
                parts[fate::rank(fate.name())] += *n as f64;
            }
            let total = format!("{} frames", collection.fates.values().sum::<usize>());
            Some(Row { name: r.iteration.to_string(), parts, total })
        })
        .collect();
    let drawn = rows.iter().flat_map(|r| r.name.bytes().chain(r.parts.iter().flat_map(|p| p.to_le_bytes())));
    let prefix = fate::prefix(drawn);
    let entries: Vec<(String, String)> =
        (0..fate::RANKS).map(|i| (fate::label(i).to_owned(), fate::fill(i, &prefix))).collect();
    stacked(&rows, &entries, &fate::patterns(&prefix), "Frames by fate and iteration")
}

struct Row {
    name: String,
    parts: Vec<f64>,
    total: String,
}

/// Horizontal stacked bars; `entries` name the parts, and those that are nowhere larger than 0 leave the legend.
fn stacked(rows: &[Row], entries: &[(String, String)], defs: &str, label: &str) -> String {
    let (left, step) = (84.0, 28.0);
    let margin = rows.iter().map(|r| text_width(&r.total)).fold(60.0, f64::max) + 14.0;
    let longest = rows.iter().map(|r| r.parts.iter().sum::<f64>()).fold(0.0, f64::max);
    let unit = if longest > 0.0 { (WIDTH - left - margin) / longest } else { 0.0 };
    let mut s = defs.to_owned();
    for (i, row) in rows.iter().enumerate() {
        let (y, mut x) = (i as f64 * step + 4.0, left);
        s += &format!(
            "<text class=\"soft end\" x=\"{}\" y=\"{}\">iteration {}</text>",
            px(left - 8.0),
            px(y + 14.5),
            escape(&row.name)
        );
        for (part, (name, fill)) in row.parts.iter().zip(entries).filter(|(p, _)| **p > 0.0) {
            s += &format!(
                "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"20\" fill=\"{fill}\"><title>{}: {}</title></rect>",
                px(x),
                px(y),
                px(part * unit),
                escape(name),
                number(*part)
            );
            x += part * unit;
        }
        s += &format!("<text x=\"{}\" y=\"{}\">{}</text>", px(x + 8.0), px(y + 14.5), escape(&row.total));
    }
    let used: Vec<(String, String)> = entries
        .iter()
        .enumerate()
        .filter(|(i, _)| rows.iter().any(|r| r.parts.get(*i).is_some_and(|p| *p > 0.0)))
        .map(|(_, e)| e.clone())
        .collect();
    let height = rows.len() as f64 * step + 4.0;
    let (keys, taken) = legend(&used, left, height + 14.0, WIDTH - left);
    document(WIDTH, height + taken + 8.0, label, &(s + &keys))
}

fn rate(r: &IterationRecord) -> f64 {
    if r.evaluation.trials == 0 { 0.0 } else { r.evaluation.successes as f64 / r.evaluation.trials as f64 }
}

fn fraction(r: &IterationRecord) -> String {
    format!("{}/{}", r.evaluation.successes, r.evaluation.trials)
}

fn last_iteration(runs: &[&RunResults]) -> f64 {
    runs.iter().flat_map(|r| &r.iterations).map(|r| f64::from(r.iteration)).fold(1.0, f64::max)
}

/// From a little before the initial policy to a little after the last, so that bars and labels stay inside.
fn iteration_range(runs: &[&RunResults]) -> (f64, f64) {
    let last = last_iteration(runs);
    (-0.06 * last - 0.08, last * 1.06 + 0.08)
}

fn iteration_axis(axes: &Axes) -> String {
    // Whole numbers only: half an iteration means nothing.
    let whole: Vec<f64> = ticks(0.0, axes.x.1, (axes.width / 40.0).min(12.0))
        .into_iter()
        .filter(|t| t.fract().abs() < 1e-9)
        .collect();
    axes.bottom_axis(&whole, |t| format!("{t:.0}"), ITERATION_AXIS)
}

fn comparable(runs: &[&RunResults]) -> bool {
    runs.windows(2)
        .all(|w| (&w[0].task, &w[0].variant, &w[0].preset) == (&w[1].task, &w[1].variant, &w[1].preset))
}

/// Mean success rate by iteration, as far as every run goes.
fn mean(runs: &[&RunResults]) -> Vec<(f64, f64)> {
    let length = runs.iter().map(|r| r.iterations.len()).min().unwrap_or(0);
    (0..length)
        .map(|i| {
            let sum: f64 = runs.iter().map(|r| rate(&r.iterations[i])).sum();
            (f64::from(runs[0].iterations[i].iteration), sum / runs.len() as f64)
        })
        .collect()
}

/// What tells each run from the others: always its seed, the rest where it differs.
fn names(runs: &[&RunResults]) -> Vec<String> {
    let differs = |of: fn(&RunResults) -> &str| runs.windows(2).any(|w| of(w[0]) != of(w[1]));
    let parts: [fn(&RunResults) -> &str; 3] = [|r| &r.task, |r| &r.variant, |r| &r.preset];
    let shown = parts.map(|of| differs(of));
    let name = |run: &RunResults| {
        let mut words: Vec<String> = parts
            .iter()
            .zip(shown)
            .filter(|(of, shown)| *shown && !of(run).is_empty())
            .map(|(of, _)| of(run).to_owned())
            .collect();
        words.push(format!("seed {}", run.seed));
        words.join(", ")
    };
    runs.iter().map(|r| name(r)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample;

    /// The numbers of an SVG path.
    fn path_numbers(d: &str) -> Vec<f64> {
        d.split(|c: char| !(c.is_ascii_digit() || c == '.' || c == '-'))
            .filter_map(|t| t.parse().ok())
            .collect()
    }

    #[test]
    fn wilson_bars_stand_where_the_interval_is() {
        let run = sample::results(3, 6);
        let svg = success_curve(&[&run]);
        let bars: Vec<&str> =
            svg.split("class=\"bar\"").skip(1).map(|t| t.split('"').nth(3).unwrap()).collect();
        assert_eq!(bars.len(), run.iterations.len());
        for (bar, r) in bars.iter().zip(&run.iterations) {
            // M x0 hi H x1 M x hi V lo M x0 lo H x1, in a plot from 30 (100%) to 300 (0%).
            let n = path_numbers(bar);
            let [lo, hi] = r.evaluation.wilson95;
            assert!((n[1] - (300.0 - 270.0 * hi)).abs() < 0.06, "{bar}");
            assert!((n[5] - (300.0 - 270.0 * lo)).abs() < 0.06, "{bar}");
            assert!(svg.contains(&format!(">{}</text>", fraction(r))));
        }
    }

    #[test]
    fn runs_are_told_apart() {
        let (a, mut b) = (sample::results(1, 4), sample::results(2, 4));
        let svg = success_curve(&[&a, &b]);
        assert!(
            svg.contains(">seed 1</text>") && svg.contains(">seed 2</text>") && svg.contains(">mean</text>")
        );
        b.task = "peg<1>".to_owned();
        let svg = success_curve(&[&a, &b]);
        assert!(svg.contains(">peg&lt;1&gt;, seed 2</text>") && !svg.contains(">mean</text>"));
        assert_eq!(svg, success_curve(&[&a, &b]));
    }

    #[test]
    fn a_skipped_update_has_no_loss() {
        let mut run = sample::results(1, 4);
        let points = |run: &RunResults| losses(&[run]).matches("<circle").count();
        let before = points(&run);
        run.iterations[2].skipped = true;
        assert_eq!(points(&run) + 1, before);
    }

    #[test]
    fn charts_of_nothing_are_drawings() {
        let mut run = sample::results(1, 1);
        run.iterations.clear();
        for svg in
            [success_curve(&[]), losses(&[]), success_curve(&[&run]), losses(&[&run]), stage_times(&run)]
        {
            assert!(svg.starts_with("<svg") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }

    #[test]
    fn end_labels_keep_apart() {
        let axes = Axes { left: 0.0, top: 0.0, width: 9.0, height: 100.0, x: (0.0, 1.0), y: (0.0, 1.0) };
        let s = end_labels(&axes, vec![(99.0, 0, "a".into()), (98.0, 1, "b".into()), (5.0, 2, "c".into())]);
        let ys: Vec<f64> =
            s.split(" y=\"").skip(1).map(|t| t.split('"').next().unwrap().parse().unwrap()).collect();
        assert!(ys[1] >= ys[0] + 15.0 && ys[2] >= ys[1] + 14.9 && ys[2] <= 105.0, "{ys:?}");
    }
}
