//! What a run says of itself: one row of the record an iteration, and the report at the end.

use super::stage::TrainNotes;
use super::{Accepted, Demonstrations, HARD_DEMONSTRATIONS, Run, folder, now};
use crate::Result;
use crate::evaluate::{Evaluated, Filmed, Filming, evaluate_lanes};
use crate::picture;
use crate::record::{IterationRecord, RunResults};
use crate::report;
use crate::rollout;
use crate::view::scalars;
use e2h_core::{Direction, Episode, Policy};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// What `record.json` holds.
#[derive(Serialize, Deserialize)]
struct Measured {
    #[serde(flatten)]
    record: IterationRecord,
    /// SHA-256 of what lies beside it. Runs of version 0.1 have none.
    #[serde(default)]
    files: BTreeMap<String, String>,
}

impl Run {
    /// Measures the hard policy and appends its row to the record.
    ///
    /// # Errors
    /// When the simulation fails or the folder cannot be written.
    pub fn evaluate(
        &self,
        iteration: u32,
        policy: &dyn Policy,
        accepted: Option<&Accepted>,
    ) -> Result<IterationRecord> {
        let file = folder(iteration, "record.json");
        let found = self.lead(|| {
            let Some(Measured { record, files }) = self.dir.get(&file)? else { return Ok(None) };
            self.dir.verify_seals(&files)?;
            self.log(&record)?;
            Ok(Some(record))
        })?;
        if let Some(record) = found {
            return Ok(record);
        }
        let e = &self.config().evaluation;
        let lanes = self.lanes(e.parallel.min(e.trials))?;
        let filming = Filming { trials: Filmed::First(e.filmed), camera: "table".to_owned(), size: 160 };
        let filming = (e.filmed > 0).then_some(&filming);
        let trials = 0..e.trials;
        let done = evaluate_lanes(lanes, policy, Direction::Hard, trials, e.seed, filming, &self.progress)?;
        self.lead(|| self.measured(iteration, &file, done, accepted))
    }

    /// The row of an evaluation, written beside its pictures.
    fn measured(
        &self,
        iteration: u32,
        file: &str,
        done: Evaluated,
        accepted: Option<&Accepted>,
    ) -> Result<IterationRecord> {
        let evaluation = done.evaluation;
        if !done.films.is_empty() {
            let path = self.dir.join(folder(iteration, "rollouts.png"));
            report::animation::write_apng(&path, &picture::tiles(&done.films, 3), 10)?;
        }
        let place = folder(iteration, "policy");
        let trained: Option<TrainNotes> = self.dir.get(&format!("{place}/notes.json"))?;
        let mut stage_minutes = BTreeMap::from([("evaluate".to_owned(), evaluation.seconds / 60.0)]);
        stage_minutes.insert("train".to_owned(), trained.as_ref().map_or(0.0, |t| t.minutes));
        if iteration == 0 {
            let easy: Option<TrainNotes> = self.dir.get("policy_easy/notes.json")?;
            stage_minutes.insert("train easy".to_owned(), easy.map_or(0.0, |t| t.minutes));
            let recorded: Option<BTreeMap<String, f64>> = self.dir.get("demonstrations/notes.json")?;
            let recorded = recorded.and_then(|r| r.get("minutes").copied()).unwrap_or(0.0);
            stage_minutes.insert("demonstrations".to_owned(), recorded);
        }
        if let Some(accepted) = accepted {
            stage_minutes.extend(accepted.stage_minutes.clone());
        }
        let updates = trained.as_ref().map_or(0, |t| t.steps);
        let before = if iteration == 0 {
            0.0
        } else {
            let previous: Option<IterationRecord> = self.dir.get(&folder(iteration - 1, "record.json"))?;
            previous.map_or(0.0, |p| p.minutes)
        };
        let record = IterationRecord {
            iteration,
            evaluation,
            minutes: before + stage_minutes.values().sum::<f64>(),
            stage_minutes,
            collection: accepted.map(|a| a.collection.clone()),
            loss: trained.as_ref().map_or(0.0, |t| t.loss),
            skipped: accepted.is_some_and(|a| a.segments.is_empty()) && updates == 0,
            updates,
        };
        let files = self.dir.seals(&[folder(iteration, "rollouts.png")])?;
        let measured = Measured { record, files };
        self.dir.put_sealed(file, &measured)?;
        let record = measured.record;
        self.log(&record)?;
        self.progress.say(&format!(
            "iteration {iteration}: {} of {} trials, {:.1} minutes",
            record.evaluation.successes, record.evaluation.trials, record.minutes
        ));
        Ok(record)
    }

    /// A row of the record as TensorBoard scalars. A resumed run writes it again, which voids what it wrote before.
    fn log(&self, record: &IterationRecord) -> Result<()> {
        let Some(mut events) = self.events("loop", record.iteration.into())? else { return Ok(()) };
        scalars::iteration(&mut events, record, now())?;
        events.finish()?;
        Ok(())
    }

    /// Writes `results.json` and `report.html`; returns the results and the report's path.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn report(
        &self,
        demonstrations: &Demonstrations,
        records: Vec<IterationRecord>,
    ) -> Result<(RunResults, PathBuf)> {
        self.lead(|| self.reported(demonstrations, records))
    }

    fn reported(
        &self,
        demonstrations: &Demonstrations,
        records: Vec<IterationRecord>,
    ) -> Result<(RunResults, PathBuf)> {
        let c = self.config();
        let easy = &demonstrations.easy;
        let mean_steps = |episodes: &[Episode]| {
            episodes.iter().map(Episode::len).sum::<usize>() as f64 / episodes.len().max(1) as f64
        };
        let recorded = self.dir.join(HARD_DEMONSTRATIONS).exists();
        let hard = recorded.then(|| self.demonstrate(Direction::Hard)).transpose()?;
        let results = RunResults {
            task: self.options.task.clone(),
            variant: c.task.variant.clone(),
            preset: self.options.preset.clone(),
            method: self.identity.method.clone(),
            seed: self.options.seed,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            demonstrations: c.closed_loop.demonstrations,
            given: self.identity.given.clone(),
            explored: c.closed_loop.explore.enabled,
            overrides: self.options.set.clone(),
            machine: machine(self.compute.name()),
            iterations: records,
            demonstration_steps: mean_steps(easy),
            hard_demonstration_steps: hard.as_deref().map(mean_steps),
        };
        self.dir.put("results.json", &results)?;
        let mut pictures = report::Pictures::default();
        let mut views = self.env.clone_shared()?;
        for (direction, title) in
            [(Direction::Hard, "hard task, start"), (Direction::Easy, "easy task, start")]
        {
            rollout::reset(&mut views, direction, self.options.seed, "views", 0, 0)?;
            for camera in ["table", "wrist"] {
                let image = views.render(camera, 320, 320)?;
                pictures.views.push((format!("{camera} camera: {title}"), report::png_bytes(&image)?));
            }
        }
        for n in 0..=self.iterations() {
            if let Ok(bytes) = std::fs::read(self.dir.join(folder(n, "rollouts.png"))) {
                pictures.animations.push((format!("iteration {n}: rollouts at evaluation seeds"), bytes));
            }
            if let Ok(svg) = std::fs::read_to_string(self.dir.join(folder(n, "filter.svg"))) {
                pictures.filter.push((format!("iteration {n}: one reversed rollout"), svg));
            }
        }
        let path = report::write_report(self.dir.path(), &results, &self.resolved.text, &pictures)?;
        Ok((results, path))
    }
}

/// The processor's name where the system tells it, the threads, and the device of the networks if it is another.
fn machine(device: &str) -> String {
    let name = std::fs::read_to_string("/proc/cpuinfo")
        .ok()
        .and_then(|text| {
            let line = text.lines().find(|l| l.starts_with("model name"))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        })
        .unwrap_or_else(|| std::env::consts::ARCH.to_owned());
    let also = if device == "cpu" { String::new() } else { format!(", networks on {device}") };
    format!("{name}, {} threads{also}", rayon::current_num_threads())
}
