//! The page of a comparison.

use super::{ALPHA, ComparedRun, Comparison, Pooled, Standing, paper};
use crate::page::{document, figure, section, table};
use crate::record::wilson95;
use crate::svg::{self, Axes, colour, escape, legend, percent, ticks};
use crate::table::interval;
use e2h_core::CONTROL_HZ;
use std::collections::BTreeSet;

const WIDTH: f64 = 720.0;

/// One HTML document that needs nothing besides itself: verdicts, curves, pooled tables beside the paper's figures, resets, filter
/// pictures.
#[must_use]
pub fn html(c: &Comparison) -> String {
    let (tasks, methods) = (c.tasks(), c.methods());
    let seeds: BTreeSet<u64> = c.runs.iter().map(|r| r.results.seed).collect();
    let counted = |n: usize, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
    let mut body = format!(
        "<header><p class=\"kind\">Auto-E2H comparison</p><h1>{}</h1><p class=\"sub\">{} · {} · {} · preset {}</p>\
         <p class=\"lead\">{}</p></header>",
        escape(&methods.join(", ")),
        counted(tasks.len(), "pair"),
        counted(methods.len(), "method"),
        counted(seeds.len(), "training seed"),
        escape(c.runs.first().map_or("", |r| r.results.preset.as_str())),
        escape(&lead(c))
    );
    body += &section("Methods", &(standings(c) + &pooled(c)));
    for task in &tasks {
        let of: Vec<&ComparedRun> = c.runs.iter().filter(|r| r.results.task == *task).collect();
        let variant = of.first().map_or("", |r| r.results.variant.as_str());
        let title = if variant.is_empty() { (*task).to_owned() } else { format!("{task} ({variant})") };
        let content = figure("", &curves(c, task)) + &policies(c, task) + &filters(&of);
        body += &section(&title, &content);
    }
    body += &costs(c);
    body += &section("Automatic resets", &resets(c));
    body += &section("Provenance", &provenance(c));
    document(&format!("Comparison: {}", methods.join(", ")), &body)
}

/// What was found, in a sentence or two.
fn lead(c: &Comparison) -> String {
    let standings = c.standings(|_| true);
    let words: Vec<String> = standings.iter().map(|s| format!("{} {}", s.method, word(s))).collect();
    let against = if words.is_empty() {
        "There is no other method to compare with.".to_owned()
    } else {
        format!("Against {}: {}.", c.reference, words.join("; "))
    };
    let trials = match c.until_decided {
        Some(most) => format!("{} to {most}", c.trials),
        None => c.trials.to_string(),
    };
    format!(
        "{against} What counts is the last policy, over {trials} trials that all policies share (seed {}).",
        c.evaluation_seed
    )
}

/// What a test allows to say of a method.
fn word(s: &Standing) -> &'static str {
    match s.difference.p {
        None => "not tested, too few training seeds",
        Some(p) if p < ALPHA && s.difference.mean > 0.0 => "better",
        Some(p) if p < ALPHA => "worse",
        Some(_) => "not better and not worse, as far as these seeds tell",
    }
}

fn p_value(p: f64) -> String {
    if p < 0.001 { "&lt; 0.001".to_owned() } else { format!("{p:.3}") }
}

fn points(v: f64) -> String {
    format!("{:+.1}", 100.0 * v)
}

fn standings(c: &Comparison) -> String {
    let rows: Vec<Vec<String>> = c
        .standings(|_| true)
        .iter()
        .map(|s| {
            let [lo, hi] = s.difference.interval;
            vec![
                escape(&s.method),
                s.runs.to_string(),
                format!("<b>{}</b>", points(s.difference.mean)),
                format!("{} to {}", points(lo), points(hi)),
                s.difference.p.map_or("–".to_owned(), p_value),
                word(s).to_owned(),
            ]
        })
        .collect();
    if rows.is_empty() {
        return String::new();
    }
    let head = ["method", "runs", "points", "95% bootstrap", "p, Holm", "verdict"];
    let note = format!(
        "<p class=\"note\">Difference of the last policy's success to {}, in percentage points, on the same trials: mean over pairs; the \
         bootstrap draws training seeds, then trials. Fewer than {} seeds a pair give no p.</p>",
        escape(&c.reference),
        crate::statistics::LEAST_SEEDS
    );
    table(&head, &rows) + &note
}

fn rate(p: Pooled) -> String {
    if p.trials == 0 {
        return "–".to_owned();
    }
    let share = percent(p.successes as f64 / p.trials as f64);
    format!("<b>{}/{}</b> {share} ({})", p.successes, p.trials, interval(wilson95(p.successes, p.trials)))
}

/// The same without the interval, where a table is wide.
fn short(p: Pooled) -> String {
    if p.trials == 0 {
        return "–".to_owned();
    }
    format!("{}/{} {}", p.successes, p.trials, percent(p.successes as f64 / p.trials as f64))
}

/// First and last policy a suite, beside the paper's.
fn pooled(c: &Comparison) -> String {
    let mut rows = vec![];
    for suite in paper::suites() {
        if !c.tasks().iter().any(|t| suite.tasks.contains(t)) {
            continue;
        }
        let ran: Vec<&str> = c.tasks().into_iter().filter(|t| suite.tasks.contains(t)).collect();
        let name = format!("{} <small>{} of {}</small>", suite.name, ran.len(), suite.tasks.len());
        for method in c.methods() {
            let runs =
                || c.runs.iter().filter(|r| r.results.method == method && ran.contains(&&*r.results.task));
            if runs().count() == 0 {
                continue;
            }
            let figure = suite.paper.iter().find(|f| f.method == method);
            let paper = |k: Option<usize>| {
                figure
                    .and_then(|f| Some(short(Pooled { successes: k?, trials: f.trials })))
                    .unwrap_or("–".to_owned())
            };
            rows.push(vec![
                name.clone(),
                escape(method),
                short(Pooled::of(runs().map(|r| &r.initial))),
                rate(Pooled::of(runs().map(|r| &r.last))),
                paper(figure.and_then(|f| f.initial)),
                paper(figure.map(|f| f.last)),
            ]);
        }
    }
    let head = ["suite, pairs", "method", "initial", "last", "paper: initial", "last"];
    let added = c.until_decided.map_or("", |_| " Trials that were added count here, and stopping where a test has decided tilts a share a little.");
    let note = "<p class=\"note\">k/n over the pairs of a suite that ran and their training seeds, with 95% Wilson intervals of the pooled trials: they describe these \
                policies, not how a method varies. The paper's pairs, robots and budgets are not ours; its figures are single runs.";
    table(&head, &rows) + note + added + "</p>"
}

/// Success by iteration, one colour a method, trials of all seeds together.
fn curves(c: &Comparison, task: &str) -> String {
    let methods = c.methods();
    let last = c
        .runs
        .iter()
        .filter(|r| r.results.task == task)
        .flat_map(|r| &r.results.iterations)
        .map(|i| i.iteration)
        .max();
    let last = f64::from(last.unwrap_or(0).max(1));
    let axes = Axes {
        left: 70.0,
        top: 24.0,
        width: WIDTH - 94.0,
        height: 250.0,
        x: (-0.15, last + 0.15),
        y: (0.0, 1.0),
    };
    let mut s = axes.grid(&ticks(0.0, 1.0, 5.0), percent);
    let places: Vec<f64> = (0..=last as u32).map(f64::from).collect();
    s += &axes.bottom_axis(&places, |t| format!("{t:.0}"), "iteration (0: initial policy)");
    s += &axes.side_name(16.0, "success on the hard task");
    let mut entries = vec![];
    for (i, method) in methods.iter().enumerate() {
        let runs: Vec<&ComparedRun> = c.of(task, method).collect();
        if runs.is_empty() {
            continue;
        }
        let at = |n: u32| {
            let rows = runs.iter().flat_map(|r| &r.results.iterations).filter(|r| r.iteration == n);
            Pooled::of(rows.map(|r| &r.evaluation))
        };
        let points: Vec<(f64, Pooled)> =
            (0..=last as u32).map(|n| (f64::from(n), at(n))).filter(|(_, p)| p.trials > 0).collect();
        let share = |p: &Pooled| p.successes as f64 / p.trials as f64;
        let c = colour(i);
        let shift = (i as f64 - (methods.len() as f64 - 1.0) / 2.0) * 7.0;
        let moved = Axes { left: axes.left + shift, ..axes };
        s += &moved.line(
            points.iter().map(|(x, p)| (*x, share(p))),
            &format!("stroke=\"{c}\" stroke-width=\"2\" opacity=\".8\""),
        );
        for (x, p) in &points {
            let title = format!("{method}, iteration {x:.0}: {}/{}", p.successes, p.trials);
            s += &moved.bar(*x, share(p), wilson95(p.successes, p.trials), c, &escape(&title));
        }
        entries.push(((*method).to_owned(), c.to_owned()));
    }
    let (keys, taken) = legend(&entries, axes.left, axes.bottom() + 58.0, axes.width);
    svg::document(WIDTH, axes.bottom() + 50.0 + taken, &format!("Success by iteration, {task}"), &(s + &keys))
}

/// Every last policy of a pair.
fn policies(c: &Comparison, task: &str) -> String {
    let verdicts = c.verdicts();
    let rows: Vec<Vec<String>> = c
        .runs
        .iter()
        .filter(|r| r.results.task == task)
        .map(|run| {
            let r = &run.results;
            let verdict =
                verdicts.iter().find(|v| v.task == task && v.method == r.method && v.seed == r.seed);
            let best = r.iterations.iter().map(|i| i.evaluation.successes).max().unwrap_or(0);
            let trials = r.iterations.first().map_or(0, |i| i.evaluation.trials);
            vec![
                format!("{}, seed {}", escape(&r.method), r.seed),
                rate(Pooled::of([&run.initial].into_iter())),
                rate(Pooled::of([&run.last].into_iter())),
                format!("{best}/{trials}"),
                verdict.map_or("–".to_owned(), |v| format!("{} and {}", v.pairs.ours, v.pairs.theirs)),
                verdict.map_or("–".to_owned(), |v| {
                    let word = match (v.p < ALPHA, v.pairs.ours > v.pairs.theirs) {
                        (true, true) => " better",
                        (true, false) => " worse",
                        _ => "",
                    };
                    format!("{}{word}", p_value(v.p))
                }),
                format!("{:.0}", r.iterations.last().map_or(0.0, |i| i.minutes)),
            ]
        })
        .collect();
    let (p, test) = match c.until_decided {
        Some(_) => (
            "1 / E, Holm",
            "E-value of the pairs of trials that differ: it may be looked at after every block of trials, and they were added until it had decided",
        ),
        None => ("McNemar p, Holm", "p of McNemar's test (mid-p)"),
    };
    let head = ["policy", "initial", "last", "best on the way", "only it, only reference", p, "minutes"];
    let note = format!(
        "<p class=\"note\">{test}. Only it, only reference: trials in which one of the two succeeded. Best on the way is over the run's own \
         trials, chosen afterwards, and counts for nothing.</p>"
    );
    table(&head, &rows) + &note
}

/// What demonstrations of either direction cost and what became of them; nothing where no run has hard ones.
fn costs(c: &Comparison) -> String {
    let seconds = |steps: f64| steps / CONTROL_HZ;
    let mut rows = vec![];
    for task in c.tasks() {
        let with: Vec<&ComparedRun> = c
            .runs
            .iter()
            .filter(|r| r.results.task == task && r.results.hard_demonstration_steps.is_some())
            .collect();
        if with.is_empty() {
            continue;
        }
        let mean =
            |of: &dyn Fn(&ComparedRun) -> f64| with.iter().map(|r| of(r)).sum::<f64>() / with.len() as f64;
        let easy = mean(&|r| seconds(r.results.demonstration_steps));
        let hard = mean(&|r| seconds(r.results.hard_demonstration_steps.unwrap_or_default()));
        let ours = Pooled::of(c.of(task, &c.reference).map(|r| &r.last));
        let theirs = Pooled::of(with.iter().map(|r| &r.last));
        let share = |p: Pooled| p.successes as f64 / p.trials as f64;
        let gain = (ours.trials > 0).then(|| points(share(ours) - share(theirs)));
        let paper = paper::cost(task).map_or("–".to_owned(), |p| {
            format!(
                "{:.1} and {:.1} s, {} and {}%, {:+}",
                p.easy_s,
                p.hard_s,
                p.ours,
                p.hard,
                i32::from(p.ours) - i32::from(p.hard)
            )
        });
        rows.push(vec![
            escape(task),
            format!("{easy:.1}"),
            format!("{hard:.1}"),
            percent(1.0 - easy / hard),
            short(ours),
            short(theirs),
            gain.unwrap_or("–".to_owned()),
            paper,
        ]);
    }
    if rows.is_empty() {
        return String::new();
    }
    let ours = format!("{}, easy", escape(&c.reference));
    let head = ["pair", "easy, s", "hard, s", "time saved", &ours, "hard alone", "gain, points", "paper"];
    let note = "<p class=\"note\">Seconds of robot time (s a demonstration, mean) of the scripted demonstrators, and success of the last policy that began \
                with as many easy demonstrations and of one that learned from the hard ones alone. A script does not pay for difficulty as a person does: \
                a hard task is no slower for it. The paper's are of people at real robots, 50 demonstrations and 20 trials an entry.</p>";
    section("What demonstrations cost", &(table(&head, &rows) + note))
}

fn filters(runs: &[&ComparedRun]) -> String {
    let mut seen = BTreeSet::new();
    let pictures = runs.iter().filter_map(|r| {
        let svg = r.filter.as_ref()?;
        seen.insert(&r.results.method).then(|| {
            figure(&format!("{}, seed {}: one reversed rollout", r.results.method, r.results.seed), svg)
        })
    });
    pictures.collect()
}

/// Share of cycles that needed no external reset.
fn resets(c: &Comparison) -> String {
    let methods = c.methods();
    let rows: Vec<Vec<String>> = c
        .tasks()
        .into_iter()
        .map(|task| {
            let cell = |method: &&str| {
                let rates: Vec<f64> = c
                    .of(task, method)
                    .flat_map(|r| &r.results.iterations)
                    .filter_map(|i| i.collection.as_ref())
                    .filter(|c| c.cycles > 0)
                    .map(crate::record::Collection::automatic_reset_rate)
                    .collect();
                if rates.is_empty() {
                    "–".to_owned()
                } else {
                    percent(rates.iter().sum::<f64>() / rates.len() as f64)
                }
            };
            std::iter::once(escape(task)).chain(methods.iter().map(cell)).collect()
        })
        .collect();
    let head: Vec<String> =
        std::iter::once("pair".to_owned()).chain(methods.iter().map(|m| escape(m))).collect();
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    let note = "<p class=\"note\">Cycles of collection that needed no external reset, mean over rounds and seeds. The paper's real robots: \
                80, 95, 82.5 and 80% (disk, mouse, test tube, brush).</p>";
    table(&head, &rows) + note
}

fn provenance(c: &Comparison) -> String {
    let distinct = |of: fn(&ComparedRun) -> String| {
        let all: BTreeSet<String> = c.runs.iter().map(of).collect();
        all.into_iter().collect::<Vec<_>>().join("; ")
    };
    let rows = [
        ("library", distinct(|r| format!("auto-e2h {}", r.results.version))),
        ("machine", distinct(|r| r.results.machine.clone())),
        ("demonstrations", distinct(|r| format!("{}: {}", r.results.task, r.results.demonstrations))),
        ("laid over preset, task and method", distinct(|r| r.results.overrides.join(" "))),
        ("trials", format!("{} at seed {}", c.trials, c.evaluation_seed)),
    ];
    let rows: String =
        rows.iter().map(|(name, value)| format!("<dt>{name}</dt><dd>{}</dd>\n", escape(value))).collect();
    format!("<dl>\n{rows}</dl>")
}
