//! A comparison as plain text and as CSV.

use super::{Comparison, Pooled};
use crate::record::{Evaluation, wilson95};
use e2h_core::Outcome;

/// Text table for a terminal: pair, method, seeds, first and last policy with k/n over all seeds and 95 % Wilson interval.
#[must_use]
pub fn table(c: &Comparison) -> String {
    let head = ["pair", "method", "seeds", "initial", "last", "Wilson 95 %", "per seed"];
    let mut rows = vec![head.map(str::to_owned)];
    for task in c.tasks() {
        for method in c.methods() {
            let seeds = c.of(task, method).count();
            if seeds == 0 {
                continue;
            }
            let pooled = |of: fn(&super::ComparedRun) -> &Evaluation| Pooled::of(c.of(task, method).map(of));
            let (initial, last) = (pooled(|r| &r.initial), pooled(|r| &r.last));
            let [lo, hi] = wilson95(last.successes, last.trials);
            let each: Vec<String> = c.of(task, method).map(|r| r.last.successes.to_string()).collect();
            rows.push([
                task.to_owned(),
                method.to_owned(),
                seeds.to_string(),
                format!("{}/{}", initial.successes, initial.trials),
                format!("{}/{}", last.successes, last.trials),
                format!("{:.0} to {:.0} %", 100.0 * lo, 100.0 * hi),
                each.join(" "),
            ]);
        }
    }
    let widths: [usize; 7] =
        std::array::from_fn(|i| rows.iter().map(|r| r[i].chars().count()).max().unwrap_or(0));
    let line = |r: &[String; 7]| {
        let cells = r.iter().zip(widths).map(|(cell, w)| format!("{cell:<w$}"));
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

/// A variant's name, also of a pair that has only one.
fn variant(name: &str) -> &str {
    if name.is_empty() { "default" } else { name }
}

/// A row an iteration of every run, as each measured itself; control steps of collection and training steps add up.
#[must_use]
pub fn iterations_csv(c: &Comparison) -> String {
    let mut s =
        "task,variant,preset,method,seed,iteration,successes,trials,wilson_low,wilson_high,env_steps,updates,minutes,\
         automatic_reset_rate\n"
            .to_owned();
    for r in c.runs.iter().map(|r| &r.results) {
        let (mut env_steps, mut updates) = (0, 0);
        for i in &r.iterations {
            let e = &i.evaluation;
            env_steps += i.collection.as_ref().map_or(0, |c| c.steps);
            updates += i.updates;
            let resets =
                i.collection.as_ref().map_or(String::new(), |c| format!("{:.4}", c.automatic_reset_rate()));
            s += &format!(
                "{},{},{},{},{},{},{},{},{:.4},{:.4},{env_steps},{updates},{:.2},{resets}\n",
                r.task,
                variant(&r.variant),
                r.preset,
                r.method,
                r.seed,
                i.iteration,
                e.successes,
                e.trials,
                e.wilson95[0],
                e.wilson95[1],
                i.minutes
            );
        }
    }
    s
}

/// A row a trial of every first and last policy.
#[must_use]
pub fn trials_csv(c: &Comparison) -> String {
    let mut s = "task,variant,method,seed,policy,evaluation_seed,trial,outcome,steps\n".to_owned();
    for run in &c.runs {
        let r = &run.results;
        for (policy, e) in [("initial", &run.initial), ("last", &run.last)] {
            for (i, t) in e.outcomes.iter().enumerate() {
                let outcome = match t.outcome {
                    Outcome::Success { .. } => "success",
                    Outcome::Timeout => "timeout",
                    Outcome::Dropped => "dropped",
                    Outcome::Diverged => "diverged",
                };
                s += &format!(
                    "{},{},{},{},{policy},{},{i},{outcome},{}\n",
                    r.task,
                    variant(&r.variant),
                    r.method,
                    r.seed,
                    c.evaluation_seed,
                    t.steps
                );
            }
        }
    }
    s
}
