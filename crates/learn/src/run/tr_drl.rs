//! The loop of TR-DRL: two agents that learn as they act.

use super::stage::PolicyStage;
use super::{Accepted, Run, folder};
use crate::progress::Bar;
use crate::record::{Collection, ResetCause, RunResults};
use crate::rollout;
use crate::tr_drl::{Agents, Demonstrated, Kind, Report, Trip, play, replay, side};
use crate::{Error, Result};
use e2h_core::{Direction, Episode, State, align_hemisphere, stream};
use e2h_env::{Env, demonstration_stream};
use e2h_nn::Weights;
use e2h_policy::sac::{Adapter, StatePolicy};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

const BOTH: [Direction; 2] = [Direction::Hard, Direction::Easy];

/// What a round leaves beside its episodes.
#[derive(Serialize, Deserialize)]
struct Notes {
    collection: Collection,
    minutes: f64,
    /// Training steps of both agents so far.
    updates: usize,
    loss: f64,
    /// SHA-256 of the episodes, and of the agents after the round.
    episodes: String,
    agents: String,
}

/// What matters in a round, as it goes.
#[derive(Default)]
struct Tally {
    episodes: [usize; 2],
    successes: [usize; 2],
    steps: usize,
    resets: BTreeMap<ResetCause, usize>,
    reversed: [usize; 2],
    last: [Report; 2],
    models: [f64; 2],
    updates: usize,
    loss: f64,
}

impl Tally {
    fn add(&mut self, direction: Direction, report: Report) {
        let d = side(direction);
        self.updates += 1;
        self.loss += (f64::from(report.critic_loss) - self.loss) / self.updates as f64;
        for (all, n) in self.reversed.iter_mut().zip(report.reversed) {
            *all += n;
        }
        if let Some(losses) = report.models {
            self.models = losses.map(f64::from);
        }
        self.last[d] = report;
    }

    fn show(&self, bar: &Bar) {
        let [hard, easy] = self.last;
        bar.set(
            self.episodes.iter().sum::<usize>() as u64,
            &format!(
                "hard {}/{} easy {}/{} succeeded, value {:.1} {:.1}, alpha {:.3} {:.3}",
                self.successes[0],
                self.episodes[0],
                self.successes[1],
                self.episodes[1],
                hard.value,
                easy.value,
                hard.alpha,
                easy.alpha
            ),
        );
    }

    fn notes(&self) -> Vec<String> {
        let [of, confirmed] = self.reversed;
        let share = 100.0 * confirmed as f64 / of.max(1) as f64;
        let [hard, easy] = self.last;
        let [forward, inverse] = self.models;
        vec![
            format!(
                "agents: value {:.1} and {:.1}, alpha {:.4} and {:.4} (hard, easy)",
                hard.value, easy.value, hard.alpha, easy.alpha
            ),
            format!(
                "dynamics: {share:.0} % of reversed transitions confirmed; forward {forward:.5}, inverse {inverse:.5}"
            ),
        ]
    }
}

impl Run {
    /// The loop of TR-DRL, with its policies, records and report.
    pub(crate) fn learn_tr_drl(&self) -> Result<(RunResults, PathBuf)> {
        let c = &self.config().tr_drl;
        let demonstrations = self.demonstrations()?;
        let hard = match c.demonstrations {
            Demonstrated::Easy => vec![],
            Demonstrated::Both => self.demonstrate(Direction::Hard)?,
        };
        let mut agents = self.agents(&demonstrations.easy, &hard)?;
        let mut env = self.env.clone_shared()?;
        self.remember_demonstrations(&mut agents, &mut env, &demonstrations.easy, &hard)?;
        let mut records = vec![];
        for n in 0..=self.iterations() {
            let accepted = if n == 0 { None } else { Some(self.round(n, &mut agents, &mut env)?) };
            let policy = self.agents_policy(n, &agents, accepted.as_ref())?;
            records.push(self.evaluate(n, &*policy, accepted.as_ref().map(|(a, _)| a))?);
        }
        self.report(&demonstrations, records)
    }

    /// Agents that know nothing but the scaling of what was demonstrated, and where it ended.
    fn agents(&self, easy: &[Episode], hard: &[Episode]) -> Result<Agents> {
        let held = !self.task.homes();
        let all: Vec<&Episode> = easy.iter().chain(hard).collect();
        let firsts: Vec<State> = easy.iter().filter_map(|e| e.state.first().copied()).collect();
        let lasts =
            |of: &[Episode]| -> Vec<State> { of.iter().filter_map(|e| e.state.last().copied()).collect() };
        // Without hard demonstrations the hard task ends where the easy ones began.
        let ends = if hard.is_empty() { firsts } else { lasts(hard) };
        let q = self.task.home().orientation;
        let q = align_hemisphere([q.w, q.i, q.j, q.k], &self.task.eef_reference()).map(|v| v as f32);
        let adapters = [Adapter::fit(&all, &ends, q, held)?, Adapter::fit(&all, &lasts(easy), q, held)?];
        Agents::new(&self.config().tr_drl, adapters, &self.compute, self.options.seed)
    }

    /// Demonstrations by decisions: played again with the actions that agents have, those kept that succeed.
    fn remember_demonstrations(
        &self,
        agents: &mut Agents,
        env: &mut Env,
        easy: &[Episode],
        hard: &[Episode],
    ) -> Result<()> {
        let c = &self.config().tr_drl;
        let seed = self.options.seed;
        for (direction, all) in [(Direction::Easy, easy), (Direction::Hard, hard)] {
            let mut kept = 0;
            for episode in all {
                self.progress.check()?;
                // Demonstrations that the run was given have a seed of their own.
                let mut rng = demonstration_stream(episode.origin.seed, direction, episode.origin.episode);
                env.reset(direction, &mut rng)?;
                let trip = replay(env, agents.adapter(direction), direction, c.reward, &episode.action)?;
                if trip.success.is_some() {
                    agents.remember(&trip, Kind::Demonstration);
                    kept += 1;
                }
            }
            if 2 * kept < all.len() {
                return Err(Error::Demonstrations(format!(
                    "{kept} of {} {direction} demonstrations succeed with the actions of an agent, expected half or more",
                    all.len()
                )));
            }
            if kept > 0 {
                let mut rng = stream(seed, "tr-drl/potential", 0, side(direction) as u64);
                agents.learn_potentials(direction, c.potential_steps, &mut rng)?;
                self.progress.say(&format!("{direction} demonstrations: {kept} of {} adapted", all.len()));
            }
        }
        Ok(())
    }

    /// A round: both directions by turns, an update a decision. Where an earlier process did it, its episodes are remembered.
    fn round(&self, n: u32, agents: &mut Agents, env: &mut Env) -> Result<(Accepted, Notes)> {
        let [episodes, weights, notes_file] =
            ["episodes.safetensors", "agents.safetensors", "agents.json"].map(|f| folder(n, f));
        let later = self.dir.join(folder(n + 1, "agents.json")).exists();
        if let Some(notes) = self.dir.get::<Notes>(&notes_file)? {
            self.dir.verify(&episodes, Some(&notes.episodes))?;
            let (all, _) = e2h_nn::load_weights(self.dir.join(&episodes))?;
            for i in 0..2 * self.config().tr_drl.episodes {
                let trip = Trip::load(&format!("{i:06}."), &all).ok_or_else(|| Error::Foreign {
                    path: self.dir.join(&episodes),
                    quantity: format!("episode {i}"),
                    expected: "states, actions and goals of every decision".to_owned(),
                    found: "others, or none".to_owned(),
                })?;
                agents.remember(&trip, Kind::Rollout);
            }
            // Only the last round's agents go on.
            if !later {
                self.dir.verify(&weights, Some(&notes.agents))?;
                agents.load(&e2h_nn::load_weights(self.dir.join(&weights))?.0)?;
            }
            let accepted = accept(&notes);
            return Ok((accepted, notes));
        }
        let (clock, mut tally, mut all) = (Instant::now(), Tally::default(), Weights::new());
        let c = &self.config().tr_drl;
        let bar = self.progress.bar(&format!("tr-drl {n}"), 2 * c.episodes as u64);
        for i in 0..c.episodes {
            for direction in BOTH {
                let trip = self.episode(n, i, direction, agents, env, &mut tally)?;
                let index = tally.episodes.iter().sum::<usize>() - 1;
                trip.state(&format!("{index:06}."), &mut all);
                tally.show(&bar);
            }
        }
        let folder_of_round = self.dir.join(folder(n, ""));
        std::fs::create_dir_all(&folder_of_round)
            .map_err(crate::directory::io("creating", &folder_of_round))?;
        e2h_nn::save_weights(self.dir.join(&episodes), &all, &BTreeMap::new())?;
        e2h_nn::save_weights(self.dir.join(&weights), &agents.state()?, &BTreeMap::new())?;
        let before: Option<Notes> = self.dir.get(&folder(n - 1, "agents.json"))?;
        let notes = Notes {
            collection: Collection {
                cycles: tally.episodes[0],
                hard_successes: tally.successes[0],
                easy_successes: tally.successes[1],
                easy_rollouts: tally.episodes[1],
                steps: tally.steps,
                resets: tally.resets.clone(),
                notes: tally.notes(),
                ..Collection::default()
            },
            minutes: clock.elapsed().as_secs_f64() / 60.0,
            updates: before.map_or(0, |b| b.updates) + tally.updates,
            loss: tally.loss,
            episodes: self.dir.sha256(&episodes)?,
            agents: self.dir.sha256(&weights)?,
        };
        self.dir.put_sealed(&notes_file, &notes)?;
        let old = self.dir.join(folder(n - 1, "agents.safetensors"));
        if old.exists() {
            std::fs::remove_file(&old).map_err(crate::directory::io("removing", &old))?;
        }
        bar.finish(&format!(
            "hard {} and easy {} of {} succeeded",
            tally.successes[0], tally.successes[1], c.episodes
        ));
        let accepted = accept(&notes);
        Ok((accepted, notes))
    }

    /// One episode from an external reset, with an update a decision once those with drawn actions are over.
    fn episode(
        &self,
        n: u32,
        i: usize,
        direction: Direction,
        agents: &mut Agents,
        env: &mut Env,
        tally: &mut Tally,
    ) -> Result<Trip> {
        let c = &self.config().tr_drl;
        let number = (n as usize - 1) * c.episodes + i;
        let named = |purpose: &str| {
            stream(self.options.seed, &format!("tr-drl/{purpose}/{direction}"), n.into(), i as u64)
        };
        let (mut draw, mut learn) = (named("act"), named("learn"));
        let (seed, purpose) = (self.options.seed, format!("tr-drl/reset/{direction}"));
        let diverged = rollout::reset(env, direction, seed, &purpose, n.into(), i as u64)?;
        *tally.resets.entry(ResetCause::Episode).or_default() += 1;
        if diverged > 0 {
            *tally.resets.entry(ResetCause::ResetDiverged).or_default() += diverged;
        }
        let random = number < c.random_episodes;
        let adapter = agents.adapter(direction).clone();
        let trip = play(env, &adapter, direction, c.reward, |state| {
            if random {
                return Ok((0..adapter.action()).map(|_| draw.random_range(-1.0..=1.0)).collect());
            }
            self.progress.check()?;
            if let Some(report) = agents.update(direction, &mut learn)? {
                tally.add(direction, report);
            }
            agents.act(direction, state, &mut draw)
        })?;
        let d = side(direction);
        tally.episodes[d] += 1;
        tally.steps += trip.steps;
        agents.remember(&trip, Kind::Rollout);
        if trip.success.is_some() {
            tally.successes[d] += 1;
            agents.learn_potentials(direction, c.potential_more_steps, &mut named("potential"))?;
        }
        Ok(trip)
    }

    /// The hard agent after a round, on disk.
    fn agents_policy(
        &self,
        n: u32,
        agents: &Agents,
        round: Option<&(Accepted, Notes)>,
    ) -> Result<Box<dyn crate::Trained>> {
        let provenance = self.provenance(Direction::Hard, n)?;
        let (loss, steps) = round.map_or((0.0, 0), |(_, notes)| (notes.loss, notes.updates));
        let done = self.stage(&folder(n, "policy"), || {
            let weights = agents.agent(Direction::Hard).actor().weights()?;
            let hidden = &self.config().tr_drl.agent.hidden;
            let policy = StatePolicy::new(agents.adapter(Direction::Hard), hidden, &weights)?;
            Ok(PolicyStage { policy: Box::new(policy), loss, steps, provenance })
        })?;
        Ok(done.policy)
    }
}

fn accept(notes: &Notes) -> Accepted {
    Accepted {
        segments: vec![],
        easy: vec![],
        collection: notes.collection.clone(),
        stage_minutes: BTreeMap::from([("train".to_owned(), notes.minutes)]),
    }
}
