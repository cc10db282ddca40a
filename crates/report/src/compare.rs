//! Several methods on several pairs: what a comparison measured, and its page, tables and verdicts.
//!
//! Every policy is measured on the same trials, so policies are compared pair by pair ([`crate::statistics`]). A method counts as better only
//! where a test says so; the policy that counts is the one of the last iteration, fixed beforehand.

mod page;
mod paper;
mod text;

use crate::record::{Evaluation, RunResults};
use crate::statistics::{Difference, Discordant, Pair, difference, e_value, holm, mcnemar_mid_p};
use crate::{Error, Result};
use e2h_core::stream;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

pub use page::html;
pub use paper::{Cost, Figure, Suite, cost, suite};
pub use text::{iterations_csv, table, trials_csv};

/// Significance that verdicts ask for, after Holm's adjustment.
pub const ALPHA: f64 = 0.05;

/// A run, and its first and last policy on the trials that are compared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComparedRun {
    /// All that the run measured itself.
    pub results: RunResults,
    /// The initial policy.
    pub initial: Evaluation,
    /// The policy of the last iteration.
    pub last: Evaluation,
    /// A picture of what the filters did in the last round that had one, as SVG.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub filter: Option<String>,
}

/// `compare.json`: runs that differ in pair, method and seed, and in nothing else.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// Method that the others are compared with.
    pub reference: String,
    /// Trials of each first policy, and at least of each last one.
    pub trials: usize,
    /// Where trials of last policies were added until a test had decided: the most of them. Verdicts are then by e-values, which
    /// allow to stop at any time; by McNemar's test otherwise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_decided: Option<usize>,
    /// Seed of these trials.
    pub evaluation_seed: u64,
    /// The runs, by pair, method and seed.
    pub runs: Vec<ComparedRun>,
}

/// One policy against the reference's of the same pair and seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// Task pair.
    pub task: String,
    /// Method compared.
    pub method: String,
    /// Training seed.
    pub seed: u64,
    /// Trials that both have.
    pub trials: usize,
    /// Pairs of trials in which they differ; `ours` are the method's.
    pub pairs: Discordant,
    /// McNemar's mid-p, or 1 / E where trials were added until a test had decided; adjusted over the methods that were compared
    /// on this pair and seed.
    pub p: f64,
}

/// One method against the reference over all pairs and seeds that both have.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// Method compared.
    pub method: String,
    /// Pairs of tasks and seeds.
    pub runs: usize,
    /// Method minus reference; `p` is adjusted over the methods.
    pub difference: Difference,
}

impl Comparison {
    /// Refuses runs that cannot be compared, and puts the others in order.
    ///
    /// # Errors
    /// [`Error::Options`] when there is none, when two are of the same pair, method and seed, when runs differ in preset, version, or overrides, or
    /// of one pair in variant or number of demonstrations, or when one was measured on other trials (more of them are none, where
    /// `until_decided` says so).
    pub fn new(
        reference: &str,
        evaluation_seed: u64,
        until_decided: Option<usize>,
        mut runs: Vec<ComparedRun>,
    ) -> Result<Self> {
        const LAST: &str = "the last policy's trials";
        let key = |r: &ComparedRun| (r.results.task.clone(), r.results.method.clone(), r.results.seed);
        // The reference first, then by name.
        runs.sort_by_key(|r| {
            (r.results.task.clone(), r.results.method != reference, r.results.method.clone(), r.results.seed)
        });
        let Some(first) = runs.first() else {
            return Err(Error::Options("compare: expected at least one run, got none".to_owned()));
        };
        let name = |r: &ComparedRun| {
            let (task, method, seed) = key(r);
            format!("{task}, {method}, seed {seed}")
        };
        let differ = |a: &ComparedRun, b: &ComparedRun, what: &str, expected: &str, found: &str| {
            Err(Error::Options(format!(
                "compare: {} and {} differ in {what}: expected {expected}, found {found}",
                name(a),
                name(b)
            )))
        };
        let trials = first.initial.trials;
        for (a, b) in runs.iter().map(|b| (first, b)).chain(runs.windows(2).map(|w| (&w[0], &w[1]))) {
            let (x, y) = (&a.results, &b.results);
            for (what, expected, found) in
                [("preset", &x.preset, &y.preset), ("version", &x.version, &y.version)]
            {
                if expected != found {
                    return differ(a, b, what, expected, found);
                }
            }
            if x.overrides != y.overrides {
                return differ(a, b, "overrides", &x.overrides.join(" "), &y.overrides.join(" "));
            }
            for (what, e) in [("the initial policy's trials", &b.initial), (LAST, &b.last)] {
                let fits = match until_decided {
                    Some(most) if what == LAST => (trials..=most.max(trials)).contains(&e.trials),
                    _ => e.trials == trials,
                };
                if !fits || e.outcomes.len() != e.trials {
                    return differ(a, b, what, &trials.to_string(), &e.outcomes.len().to_string());
                }
            }
            if x.task == y.task && x.variant != y.variant {
                return differ(a, b, "variant", &x.variant, &y.variant);
            }
            if x.task == y.task && x.demonstrations != y.demonstrations {
                let [x, y] = [x.demonstrations, y.demonstrations].map(|n| n.to_string());
                return differ(a, b, "demonstrations", &x, &y);
            }
            let given = [x, y].map(|r| r.given.as_ref().map_or("scripted", |g| &*g.sha256));
            if x.task == y.task && given[0] != given[1] {
                return differ(a, b, "demonstrations", given[0], given[1]);
            }
        }
        if let Some(w) = runs.windows(2).find(|w| key(&w[0]) == key(&w[1])) {
            return Err(Error::Options(format!("compare: two runs of {}", name(&w[0]))));
        }
        Ok(Self { reference: reference.to_owned(), trials, until_decided, evaluation_seed, runs })
    }

    /// Pairs of tasks, in order.
    #[must_use]
    pub fn tasks(&self) -> Vec<&str> {
        let mut all: Vec<&str> = self.runs.iter().map(|r| r.results.task.as_str()).collect();
        all.dedup();
        all
    }

    /// Methods, the reference first.
    #[must_use]
    pub fn methods(&self) -> Vec<&str> {
        let mut all: Vec<&str> = self.runs.iter().map(|r| r.results.method.as_str()).collect();
        all.sort_by_key(|m| (*m != self.reference, *m));
        all.dedup();
        all
    }

    /// Runs of a pair and a method, by seed.
    pub fn of<'a>(&'a self, task: &'a str, method: &'a str) -> impl Iterator<Item = &'a ComparedRun> {
        self.runs.iter().filter(move |r| r.results.task == task && r.results.method == method)
    }

    fn run(&self, task: &str, method: &str, seed: u64) -> Option<&ComparedRun> {
        self.runs
            .iter()
            .find(|r| r.results.task == task && r.results.method == method && r.results.seed == seed)
    }

    /// Every last policy against the reference's of the same pair and seed.
    #[must_use]
    pub fn verdicts(&self) -> Vec<Verdict> {
        let mut groups: BTreeMap<(&str, u64), Vec<Verdict>> = BTreeMap::new();
        for run in self.runs.iter().filter(|r| r.results.method != self.reference) {
            let r = &run.results;
            let Some(reference) = self.run(&r.task, &self.reference, r.seed) else { continue };
            let pairs = Discordant::of(&successes(&run.last), &successes(&reference.last));
            let (task, method) = (r.task.clone(), r.method.clone());
            let p = match self.until_decided {
                Some(_) => (1.0 / e_value(pairs)).min(1.0),
                None => mcnemar_mid_p(pairs),
            };
            groups.entry((&r.task, r.seed)).or_default().push(Verdict {
                task,
                method,
                seed: r.seed,
                trials: run.last.trials.min(reference.last.trials),
                pairs,
                p,
            });
        }
        let mut all = vec![];
        for group in groups.into_values() {
            let adjusted = holm(&group.iter().map(|v| v.p).collect::<Vec<_>>());
            all.extend(group.into_iter().zip(adjusted).map(|(v, p)| Verdict { p, ..v }));
        }
        all
    }

    /// Verdicts that more trials may still change: no test has decided, and there may be more.
    #[must_use]
    pub fn undecided(&self) -> Vec<Verdict> {
        let most = self.until_decided.unwrap_or(0);
        self.verdicts().into_iter().filter(|v| v.p >= ALPHA && v.trials < most).collect()
    }

    /// Every method against the reference, over the pairs that `among` holds for, on the trials that were fixed beforehand: a bootstrap knows
    /// nothing of trials that were added because a test had not decided. The bootstrap's draws are seeded, so the same
    /// comparison gives the same numbers.
    #[must_use]
    pub fn standings(&self, among: impl Fn(&str) -> bool) -> Vec<Standing> {
        let mut all = vec![];
        for method in self.methods().into_iter().filter(|m| *m != self.reference) {
            let outcomes: Vec<Vec<(Vec<bool>, Vec<bool>)>> = self
                .tasks()
                .into_iter()
                .filter(|t| among(t))
                .map(|task| {
                    let both = self.of(task, method).filter_map(|run| {
                        let reference = self.run(task, &self.reference, run.results.seed)?;
                        let fixed = |r: &ComparedRun| -> Vec<bool> {
                            successes(&r.last).into_iter().take(self.trials).collect()
                        };
                        Some((fixed(run), fixed(reference)))
                    });
                    both.collect()
                })
                .filter(|seeds: &Vec<_>| !seeds.is_empty())
                .collect();
            let pairs: Vec<Vec<Pair<'_>>> = outcomes
                .iter()
                .map(|seeds| seeds.iter().map(|(ours, theirs)| Pair { ours, theirs }).collect())
                .collect();
            let mut rng = stream(0, "compare/bootstrap", 0, 0);
            if let Some(difference) = difference(&pairs, &mut rng) {
                let runs = outcomes.iter().map(Vec::len).sum();
                all.push(Standing { method: method.to_owned(), runs, difference });
            }
        }
        let tested: Vec<usize> = (0..all.len()).filter(|i| all[*i].difference.p.is_some()).collect();
        let p: Vec<f64> = tested.iter().filter_map(|i| all[*i].difference.p).collect();
        for (i, p) in tested.into_iter().zip(holm(&p)) {
            all[i].difference.p = Some(p);
        }
        all
    }

    /// Writes `compare.json`, `compare.html`, `iterations.csv` and `trials.csv` into a folder.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let json = serde_json::to_string(self)
            .map_err(|e| Error::Options(format!("compare: expected numbers that JSON has: {e}")))?;
        for (name, text) in [
            ("compare.json", json + "\n"),
            ("compare.html", html(self)),
            ("iterations.csv", iterations_csv(self)),
            ("trials.csv", trials_csv(self)),
        ] {
            e2h_data::write_atomic(&folder.join(name), text.as_bytes())?;
        }
        Ok(())
    }
}

/// Outcomes as successes, trial by trial.
fn successes(e: &Evaluation) -> Vec<bool> {
    e.outcomes.iter().map(|t| t.outcome.is_success()).collect()
}

/// Trials of several policies together.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Pooled {
    /// Trials that succeeded.
    pub successes: usize,
    /// Trials.
    pub trials: usize,
}

impl Pooled {
    /// The sum of several evaluations.
    #[must_use]
    pub fn of<'a>(evaluations: impl Iterator<Item = &'a Evaluation>) -> Self {
        evaluations.fold(Self::default(), |sum, e| Self {
            successes: sum.successes + e.successes,
            trials: sum.trials + e.trials,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::{Trial, wilson95};
    use crate::sample;
    use e2h_core::Outcome;

    fn evaluation(successes: impl Fn(usize) -> bool) -> Evaluation {
        let outcome = |i| if successes(i) { Outcome::Success { at: 90 } } else { Outcome::Timeout };
        Evaluation::new((0..40).map(|i| Trial { outcome: outcome(i), steps: 100 + i }).collect(), 1.0)
    }

    fn run(task: &str, method: &str, seed: u64, k: usize) -> ComparedRun {
        let mut results = sample::results(seed, 3);
        (results.task, results.method, results.demonstrations) = (task.to_owned(), method.to_owned(), 5);
        ComparedRun {
            results,
            initial: evaluation(|i| i < 10),
            last: evaluation(|i| i < k),
            filter: Some("<svg><title>filter</title></svg>".to_owned()),
        }
    }

    /// Two pairs, three methods, five seeds: ours is far better than `recap` and about as good as `no-critic`.
    pub(super) fn comparison() -> Comparison {
        let mut runs = vec![];
        for task in ["nut_assembly", "disk"] {
            for seed in 0..5 {
                runs.push(run(task, "recap", seed, 15));
                runs.push(run(task, "auto-e2h", seed, 36));
                runs.push(run(task, "no-critic", seed, if seed % 2 == 0 { 35 } else { 37 }));
            }
        }
        Comparison::new("auto-e2h", 800_000, None, runs).unwrap()
    }

    #[test]
    fn trials_are_added_until_a_test_has_decided_and_verdicts_are_then_by_e_values() {
        let mut runs = comparison().runs;
        assert!(comparison().undecided().is_empty(), "nobody asked for it");
        let sequential = |runs: &[ComparedRun]| Comparison::new("auto-e2h", 800_000, Some(60), runs.to_vec());
        let c = sequential(&runs).unwrap();
        // 1 / E of 21 to 0 is clear; 1 or 0 pairs are not.
        let open = c.undecided();
        assert!(!open.is_empty() && open.iter().all(|v| v.method == "no-critic" && v.trials == 40));
        for v in c.verdicts() {
            // Two methods are compared: Holm doubles the smaller of two.
            let p = (1.0 / e_value(v.pairs)).min(1.0);
            assert!((v.p - (2.0 * p).min(1.0)).abs() < 1e-12 || v.p >= p, "{v:?}");
        }
        // More trials of some policies are in order; what both have counts.
        let more = runs.iter_mut().find(|r| r.results.method == "no-critic" && r.results.seed == 0).unwrap();
        let failed = Trial { outcome: Outcome::Timeout, steps: 500 };
        let trials = more.last.outcomes.iter().copied().chain([failed; 20]);
        more.last = Evaluation::new(trials.collect(), 1.0);
        let c = sequential(&runs).unwrap();
        assert!(c.verdicts().iter().all(|v| v.trials == 40));
        assert_eq!(c.standings(|_| true), sequential(&comparison().runs).unwrap().standings(|_| true));
        assert!(html(&c).contains("E-value"), "the page says what it went by");
        // Without the word they are other trials.
        let told = Comparison::new("auto-e2h", 800_000, None, runs).unwrap_err().to_string();
        assert!(told.contains("expected 40, found 60"), "{told}");
    }

    #[test]
    fn what_demonstrations_cost_is_told_where_there_are_hard_ones() {
        let mut runs = comparison().runs;
        assert!(!html(&comparison()).contains("s a demonstration"));
        for seed in 0..5 {
            let mut hard = run("disk", "hard-demos", seed, 30);
            hard.results.hard_demonstration_steps = Some(342.0);
            runs.push(hard);
        }
        let page = html(&Comparison::new("auto-e2h", 800_000, None, runs).unwrap());
        // 171 steps at 20 Hz against 342; 36 of 40 against 30.
        for word in ["s a demonstration", "8.6", "17.1", "50%", "180/200", "150/200", "+15.0"] {
            assert!(page.contains(word), "{word}");
        }
    }

    #[test]
    fn a_method_is_better_only_where_a_test_says_so() {
        let c = comparison();
        assert_eq!(c.tasks(), ["disk", "nut_assembly"]);
        assert_eq!(c.methods(), ["auto-e2h", "no-critic", "recap"]);
        for v in c.verdicts() {
            if v.method == "recap" {
                assert_eq!(v.pairs, Discordant { ours: 0, theirs: 21 });
                assert!(v.p < 1e-4, "{v:?}");
            } else {
                assert!(v.p > ALPHA, "{v:?}");
            }
        }
        let standings = c.standings(|_| true);
        let [no_critic, recap] = &standings[..] else { panic!("{standings:?}") };
        assert!((recap.difference.mean + 21.0 / 40.0).abs() < 1e-12 && recap.runs == 10);
        assert!(recap.difference.p.unwrap() < 0.01);
        assert!(no_critic.difference.p.unwrap() > ALPHA, "{no_critic:?}");
        // Four seeds are too few for a p-value of the method.
        let few: Vec<_> = c.runs.into_iter().filter(|r| r.results.seed < 4).collect();
        let few = Comparison::new("auto-e2h", 800_000, None, few).unwrap();
        assert!(few.standings(|_| true).iter().all(|s| s.difference.p.is_none()));
    }

    #[test]
    fn what_cannot_be_compared_is_refused_by_name() {
        let refused = |change: fn(&mut Vec<ComparedRun>)| {
            let mut runs = comparison().runs;
            change(&mut runs);
            Comparison::new("auto-e2h", 800_000, None, runs).unwrap_err().to_string()
        };
        let told = refused(|r| r[3].results.preset = "paper".to_owned());
        assert!(told.contains("disk, auto-e2h, seed 3") && told.contains("preset"), "{told}");
        assert!(refused(|r| r[3].results.version = "9".to_owned()).contains("version"));
        assert!(refused(|r| r[4].results.overrides = vec!["a=1".to_owned()]).contains("found a=1"));
        assert!(refused(|r| r[4].results.variant = "square".to_owned()).contains("variant"));
        assert!(refused(|r| r[4].results.demonstrations = 9).contains("expected 5, found 9"));
        let message = refused(|r| {
            r[4].results.given = Some(crate::folder::Given {
                from: "hand".to_owned(),
                sha256: "c0ffee".to_owned(),
                episodes: 5,
                of: 6,
                resized: false,
                seconds: None,
            });
        });
        assert!(message.contains("expected scripted, found c0ffee"), "{message}");
        assert!(refused(|r| r[5].results.seed = 1).contains("two runs of"));
        assert!(refused(|r| r[6].last.outcomes.truncate(39)).contains("expected 40, found 39"));
        assert!(refused(Vec::clear).contains("at least one run"));
    }

    #[test]
    fn the_page_and_the_tables_say_it_and_need_nothing_besides() {
        let mut c = comparison();
        c.runs[0].results.machine = "<script>".to_owned();
        let page = html(&c);
        assert_eq!(page, html(&c));
        assert!(
            !page.contains("<script") && !page.replace("http://www.w3.org/2000/svg", "").contains("http")
        );
        for word in ["no-critic", "180/200", "75/200", "56/80", "85/100", "not better", "worse"] {
            assert!(page.contains(word), "{word}");
        }
        for tag in ["section", "figure", "table", "svg", "div", "g", "text"] {
            let open = page.matches(&format!("<{tag}>")).count() + page.matches(&format!("<{tag} ")).count();
            assert_eq!(open, page.matches(&format!("</{tag}>")).count(), "{tag}");
        }
        let text = table(&c);
        assert!(text.contains("180/200") && text.contains("nut_assembly"), "{text}");
        let csv = iterations_csv(&c);
        assert_eq!(csv.lines().count(), 1 + 30 * 3);
        // First and last policy of every run.
        assert_eq!(trials_csv(&c).lines().count(), 1 + 30 * 2 * 40);
        assert!(trials_csv(&c).contains("disk,loose,auto-e2h,0,last,800000,39,timeout,139"));
        let [lo, hi] = wilson95(180, 200);
        assert!(text.contains(&format!("{:.0} to {:.0} %", 100.0 * lo, 100.0 * hi)), "{text}");
    }

    #[test]
    fn it_is_read_as_it_was_written() {
        let c = comparison();
        let folder = tempfile::tempdir().unwrap();
        c.write(folder.path()).unwrap();
        let text = std::fs::read_to_string(folder.path().join("compare.json")).unwrap();
        assert_eq!(serde_json::from_str::<Comparison>(&text).unwrap(), c);
    }
}
