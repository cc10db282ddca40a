//! The model card: what a published policy is, how well it does, and the command that made it.

use super::{Files, Publication, read_if_there};
use crate::config::RunConfig;
use crate::directory::io;
use crate::record::{RunResults, parse_results};
use crate::report::chart;
use crate::{Error, Result};
use e2h_core::Direction;
use e2h_policy::{Checkpoint, Provenance};
use std::path::Path;
use toml::{Table, Value};

/// Looks at everything that is to be sent.
pub(super) fn files(publication: &Publication) -> Result<Files> {
    let dir = &publication.dir;
    let (checkpoint, _) = Checkpoint::read(dir)?;
    let measured = results(dir)?;
    // Curve and table are of the run that made this policy; those of other seeds go along in the file.
    let p = &checkpoint.provenance;
    let variant = p.run.pointer("/task/variant").and_then(serde_json::Value::as_str).unwrap_or_default();
    let made = |r: &&RunResults| {
        (&r.task, &r.preset, r.seed, r.variant.as_str()) == (&p.task, &p.preset, p.seed, variant)
    };
    let own = measured.as_ref().and_then(|(runs, _)| runs.iter().find(made));
    let read = |name| {
        let path = dir.join(name);
        Ok((name, e2h_data::read_file(&path, e2h_data::MOST_WEIGHTS).map_err(io("reading", &path))?))
    };
    let mut files: Files =
        ["policy.json", "model.safetensors"].into_iter().map(read).collect::<Result<_>>()?;
    let card = read_if_there(&dir.join("README.md"))?.filter(|t| t.starts_with("---\n"));
    let card =
        card.unwrap_or_else(|| model_card(&publication.address, p, own, publication.license.as_deref()));
    files.push(("README.md", card.into_bytes()));
    if let (Some(own), Some((_, text))) = (own, &measured) {
        files.push(("curve.svg", chart::success_curve(&[own]).into_bytes()));
        files.push(("results.json", text.clone().into_bytes()));
    }
    Ok(files)
}

/// What was measured, and the text that says so: beside the checkpoint, or where a run directory has it.
fn results(dir: &Path) -> Result<Option<(Vec<RunResults>, String)>> {
    for path in [dir.join("results.json"), dir.join("../../results.json")] {
        let Some(text) = read_if_there(&path)? else { continue };
        let runs = parse_results(&text).map_err(|e| Error::Foreign {
            path,
            quantity: "file".to_owned(),
            expected: "results of runs of this version".to_owned(),
            found: e.to_string(),
        })?;
        return Ok(Some((runs, text)));
    }
    Ok(None)
}

/// Text that is one YAML value whatever is in it: JSON's strings are YAML's.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

/// The model card with its front matter: task, curve, and the command that made the policy.
#[must_use]
pub fn model_card(
    address: &super::Address,
    provenance: &Provenance,
    results: Option<&RunResults>,
    license: Option<&str>,
) -> String {
    let p = provenance;
    let measured = results.and_then(|r| r.iterations.iter().find(|i| i.iteration == p.iteration));
    let measured = measured.filter(|_| p.direction == Some(Direction::Hard)).map(|i| &i.evaluation);
    let mut card = "---\n".to_owned();
    if let Some(license) = license {
        card += &format!("license: {}\n", quoted(license));
    }
    card += "library_name: auto-e2h\npipeline_tag: robotics\n";
    card +=
        &format!("tags: [robotics, auto-e2h, diffusion-policy, imitation-learning, {}]\n", quoted(&p.task));
    if let Some(e) = measured {
        card += &format!(
            "model-index:\n- name: {}\n  results:\n  - task: {{type: robotics, name: {task}}}\n    \
             dataset: {{type: simulation, name: {task}}}\n    metrics:\n    - {{type: success_rate, name: success rate, \
             value: {:.4}}}\n",
            quoted(&address.name),
            e.successes as f64 / e.trials.max(1) as f64,
            task = quoted(&p.task),
        );
    }
    card += &format!("---\n\n# {}\n\n", plain(&address.name));
    card += &format!(
        "A diffusion policy for the {} task of `{}`, learned from time-reversed demonstrations of the task that undoes it \
         with Auto-E2H {}.\n\n",
        p.direction.map_or("", Direction::name),
        plain(&p.task),
        plain(&p.version)
    );
    card += &format!(
        "```console\n$ cargo run --release --features hub --example evaluate -- --checkpoint {address} --trials 50\n```\n\n"
    );
    card += "## Made by\n\n";
    card += &format!("```console\n$ {}\n```\n\n", command(p));
    card += &format!("Preset {}, seed {}, after {} updates.\n", plain(&p.preset), p.seed, p.iteration);
    let Some(results) = results.filter(|r| !r.iterations.is_empty()) else { return card };
    card += &format!("On {}.\n\n", plain(&results.machine));
    if let Some(given) = &results.given {
        card += &format!("Demonstrations that were given to it: {}.\n\n", plain(&given.words()));
    }
    card += "## Success by iteration\n\n![success by iteration](curve.svg)\n\n";
    card += "| iteration | successes | Wilson 95 % | minutes |\n|---|---|---|---|\n";
    for i in &results.iterations {
        let e = &i.evaluation;
        let this = if i.iteration == p.iteration && p.direction == Some(Direction::Hard) {
            " (this policy)"
        } else {
            ""
        };
        card += &format!(
            "| {}{this} | {} of {} | {:.0} to {:.0} % | {:.1} |\n",
            i.iteration,
            e.successes,
            e.trials,
            e.wilson95[0] * 100.0,
            e.wilson95[1] * 100.0,
            i.minutes
        );
    }
    card += "\nIteration 0 is the initial policy. Each row is of fresh trials at seeds that training never saw.\n";
    card
}

/// Text that is no Markdown, whatever is in it.
fn plain(text: &str) -> String {
    let harmless = |c: char| c.is_alphanumeric() || " _-.,:()/+".contains(c);
    text.chars().filter(|c| harmless(*c)).collect()
}

/// The command that made a policy: its program, preset and seed, and every value that differs from theirs.
#[must_use]
pub fn command(provenance: &Provenance) -> String {
    let p = provenance;
    let mut command = format!(
        "cargo run --release --example {} -- --preset {} --seed {}",
        plain(&p.task),
        plain(&p.preset),
        p.seed
    );
    let standard = |set: &[String]| RunConfig::resolve(&p.preset, &p.task, set).ok().map(|r| r.config);
    let this = serde_json::from_value::<RunConfig>(p.run.clone()).ok();
    if let (Some(standard_one), Some(this)) = (standard(&[]), this) {
        // A variant may bring values of its own.
        let mut set = vec![];
        if this.task.variant != standard_one.task.variant {
            set.push(format!("task.variant={}", Value::String(this.task.variant.clone())));
        }
        let standard = standard(&set).unwrap_or(standard_one);
        let (Ok(standard), Ok(this)) = (Table::try_from(standard), Table::try_from(this)) else {
            return command;
        };
        differences(&standard, &this, "", &mut set);
        for text in set {
            // Quotes of the shell, which a quote in the value ends and opens again.
            command += &format!(" --set '{}'", text.replace('\'', "'\\''"));
        }
    }
    command
}

fn differences(standard: &Table, this: &Table, path: &str, out: &mut Vec<String>) {
    for (key, value) in this {
        let full = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        match (standard.get(key), value) {
            (Some(Value::Table(a)), Value::Table(b)) => differences(a, b, &full, out),
            (Some(a), b) if a == b => {}
            _ => out.push(format!("{full}={value}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::{Evaluation, IterationRecord, wilson95};

    fn provenance(set: &[&str]) -> Provenance {
        let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
        let config = RunConfig::resolve("laptop", "nut_assembly", &set).unwrap().config;
        Provenance {
            task: "nut_assembly".to_owned(),
            direction: Some(Direction::Hard),
            preset: "laptop".to_owned(),
            seed: 7,
            iteration: 2,
            version: "0.1.0".to_owned(),
            run: serde_json::to_value(config).unwrap(),
        }
    }

    /// Made-up results.
    fn results(successes: &[usize]) -> RunResults {
        let row = |(i, &k): (usize, &usize)| IterationRecord {
            iteration: u32::try_from(i).unwrap(),
            evaluation: Evaluation {
                successes: k,
                trials: 50,
                wilson95: wilson95(k, 50),
                mean_steps: 200.0,
                seconds: 80.0,
                outcomes: vec![],
            },
            minutes: 11.0 + 14.3 * i as f64,
            stage_minutes: [("train".to_owned(), 7.5)].into(),
            collection: None,
            loss: 0.04,
            skipped: false,
            updates: 1500,
        };
        RunResults {
            task: "nut_assembly".to_owned(),
            preset: "laptop".to_owned(),
            seed: 7,
            iterations: successes.iter().enumerate().map(row).collect(),
            ..RunResults::default()
        }
    }

    #[test]
    fn the_command_says_what_differs_and_makes_the_same_configuration() {
        let plain = "cargo run --release --example nut_assembly -- --preset laptop --seed 7";
        assert_eq!(command(&provenance(&[])), plain);
        let made =
            command(&provenance(&["loop.cycles=3", "task.variant=square", "train.step.schedule.lr=0.5"]));
        assert!(made.starts_with(plain), "{made}");
        let set: Vec<String> =
            made.split(" --set '").skip(1).map(|s| s.trim_end_matches('\'').to_owned()).collect();
        assert_eq!(set.len(), 3, "{made}");
        let again = RunConfig::resolve("laptop", "nut_assembly", &set).unwrap().config;
        let wanted = provenance(&["loop.cycles=3", "task.variant=square", "train.step.schedule.lr=0.5"]).run;
        assert_eq!(serde_json::to_value(again).unwrap(), wanted);
    }

    #[test]
    fn the_card_has_front_matter_curve_and_command() {
        let results = results(&[1, 9, 22, 28]);
        let address = "lab/nut".parse().unwrap();
        let card = model_card(&address, &provenance(&[]), Some(&results), Some("mit"));
        let mut parts = card.splitn(3, "---\n");
        assert_eq!(parts.next(), Some(""));
        let front = parts.next().unwrap();
        for line in ["license: \"mit\"", "library_name: auto-e2h", "pipeline_tag: robotics", "value: 0.4400"]
        {
            assert!(front.contains(line), "{line} in {front}");
        }
        let text = parts.next().unwrap();
        assert!(
            text.contains("![success by iteration](curve.svg)") && text.contains("--preset laptop --seed 7")
        );
        assert!(text.contains("| 2 (this policy) | 22 of 50 |"), "{text}");
        assert!(text.contains("--checkpoint hf://lab/nut"));
        // Without a run's results there is no curve to refer to.
        let bare = model_card(&address, &provenance(&[]), None, None);
        assert!(!bare.contains("curve.svg") && !bare.contains("license"));
    }

    #[test]
    fn names_cannot_leave_their_place() {
        let mut p = provenance(&[]);
        p.task = "x\"]\nevil: true\n---\n<script>".to_owned();
        let card = model_card(&"lab/nut".parse().unwrap(), &p, None, None);
        assert!(!card.contains("\nevil: true") && !card.contains("<script>\n"), "{card}");
        let body = card.splitn(3, "---\n").nth(2).unwrap();
        assert!(!body.contains("<script>"), "{body}");
    }
}
