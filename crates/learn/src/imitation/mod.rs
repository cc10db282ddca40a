//! Training a policy on any LeRobotDataset: no task, no simulator, no loop.
//!
//! A folder of such a training has LeRobot's layout: `checkpoints/000500/pretrained_model` is what LeRobot and
//! [`e2h_policy::lerobot::import`] open, `checkpoints/last` and `checkpoints/best` say which. Beside them lie `metrics.jsonl`,
//! `losses.svg`, `config.toml` and `training.json`.

mod config;
mod data;
mod folder;

pub use config::{DataConfig, ImageStatistics, ImitationConfig, ImitationTraining, NetworkConfig};
pub use data::{DatasetRecord, DatasetShare};

use crate::directory::{io, write_atomic};
use crate::tensorboard::Events;
use crate::{Error, Progress, Result, Stop};
use data::Opened;
use e2h_core::ImageStore;
use e2h_nn::{Compute, Precision, learning_rate};
use e2h_policy::lerobot::{Features, Scalings};
use e2h_policy::{PolicyConfig, Provenance, Trainer, TrainingData};
use e2h_report::chart;
use folder::{Folder, Identity, Metric};
use std::path::PathBuf;

/// What a training is asked to do.
#[derive(Debug, Clone)]
pub struct ImitationOptions {
    /// What it learns from.
    pub datasets: Vec<DatasetShare>,
    /// Preset name.
    pub preset: String,
    /// Overrides, `key.path=value`.
    pub set: Vec<String>,
    /// Seed of everything random.
    pub seed: u64,
    /// Its folder.
    pub out: PathBuf,
    /// Go on with a folder that is there.
    pub resume: bool,
    /// `cpu`, `cuda` or `cuda:N`.
    pub device: String,
    /// Threads; none for one a core. Never changes a result.
    pub threads: Option<usize>,
    /// Show no progress.
    pub quiet: bool,
    /// Write TensorBoard event files.
    pub tensorboard: bool,
    /// Where it hears that it should stop.
    pub stop: Stop,
}

/// How a training ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Imitated {
    /// Steps done.
    pub steps: usize,
    /// Mean loss of the last hundred steps.
    pub loss: f64,
    /// Loss on the held-out episodes after the last step; none where nothing is held out.
    pub validation_loss: Option<f64>,
    /// The policy of the last step, for LeRobot and for [`e2h_policy::lerobot::import`].
    pub last: PathBuf,
    /// That of the lowest loss on held-out episodes; the last one where nothing is held out.
    pub best: PathBuf,
}

/// Steps between two lines of `metrics.jsonl`.
const LOG_EVERY: usize = 10;

/// Trains a policy, or goes on with one: the same datasets, seed and configuration give the same bytes, stopped in between or not,
/// on any number of threads.
///
/// # Errors
/// Before any work, when datasets do not fit each other or the configuration (all problems are listed), or the folder is in the
/// way; [`Error::Stopped`] when it was asked to stop, with its state saved; when training diverges or the folder cannot be written.
pub fn imitate(options: &ImitationOptions) -> Result<Imitated> {
    if let Some(n) = options.threads {
        crate::set_threads(n)?;
    }
    let (config, text) = ImitationConfig::resolve(&options.preset, &options.set)?;
    let compute = Compute::open(&options.device, Precision::default())?;
    let opened = Opened::open(&options.datasets, &config.data, options.seed)?;
    let crop = <[usize; 2]>::try_from(&config.data.crop[..]).ok();
    let features = Features::of_layout(&opened.layout, crop).map_err(|e| match e {
        e2h_policy::Error::Config(text) if config.data.resize.is_empty() => {
            Error::Config(format!("{text} (data.resize brings images to one size)"))
        }
        e => e.into(),
    })?;
    let policy = config.check_network(&features)?;
    let identity = Identity::new(options, opened.records());
    let folder = Folder::open(&options.out, options.resume, &identity, &text)?;
    let progress = Progress::new(options.quiet).stopping(options.stop.clone());

    let store = ImageStore::create(&options.out)?;
    let bar = progress.bar("read episodes", opened.episodes() as u64);
    let mut count = 0;
    let (learned, held) = opened.read(&store, || {
        progress.check()?;
        count += 1;
        bar.set(count, "");
        Ok(())
    })?;
    let rows: usize = learned.iter().flat_map(|s| &s.recordings).map(|r| r.len()).sum();
    bar.finish(&format!("{count} episodes, {rows} rows to learn from"));

    let all: Vec<_> = learned.iter().flat_map(|s| s.recordings.iter().cloned()).collect();
    let images = data::image_scaling(&learned, &opened.layout, config.data.image_scaling)?;
    let scalings = Scalings::fit(&all.iter().map(|r| &**r).collect::<Vec<_>>(), images)?;
    let drop = config.drop_last();
    let data = TrainingData::of_recordings(&learned, &policy, &features, &scalings, drop)?;
    let validation = held
        .iter()
        .any(|s| !s.recordings.is_empty())
        .then(|| TrainingData::of_recordings(&held, &policy, &features, &scalings, drop))
        .transpose()?;
    let provenance = provenance(options, &config, &opened)?;
    let mut training = Training {
        folder,
        config,
        policy,
        features: &features,
        scalings: &scalings,
        provenance,
        metrics: vec![],
        events: None,
        progress,
    };
    training.run(&data, validation.as_ref(), &compute, options)
}

fn provenance(options: &ImitationOptions, config: &ImitationConfig, opened: &Opened) -> Result<Provenance> {
    let run = serde_json::json!({
        "training": serde_json::to_value(config).map_err(|e| Error::Config(e.to_string()))?,
        "fps": opened.layout.fps,
        "state": opened.layout.state,
        "environment_state": opened.layout.environment,
        "action": opened.layout.action,
        "datasets": opened.records(),
    });
    Ok(Provenance {
        task: opened.tasks().join("; "),
        direction: None,
        preset: options.preset.clone(),
        seed: options.seed,
        iteration: 0,
        version: env!("CARGO_PKG_VERSION").to_owned(),
        run,
    })
}

/// A training under way.
struct Training<'a> {
    folder: Folder,
    config: ImitationConfig,
    policy: PolicyConfig,
    features: &'a Features,
    scalings: &'a Scalings,
    provenance: Provenance,
    metrics: Vec<Metric>,
    events: Option<Events>,
    progress: Progress,
}

impl Training<'_> {
    fn run(
        &mut self,
        data: &TrainingData<'_>,
        validation: Option<&TrainingData<'_>>,
        compute: &Compute,
        options: &ImitationOptions,
    ) -> Result<Imitated> {
        let t = self.config.train.clone();
        let trainer =
            Trainer::of_features(&self.policy, self.features, &t.step, t.steps, options.seed, "imitate")?;
        let mut trainer = trainer.into_device(compute)?;
        if let Some((state, metrics)) = self.folder.last()? {
            trainer.restore(&state)?;
            self.metrics = metrics;
        }
        let begun = trainer.step_count();
        if options.tensorboard && begun < t.steps {
            self.events = Some(Events::create(&options.out.join("tensorboard"), crate::now(), begun as u64)?);
        }
        let bar = self.progress.bar("train", t.steps as u64);
        while trainer.step_count() < t.steps {
            if let Err(stopped) = self.progress.check() {
                if trainer.step_count() > begun {
                    self.save(&trainer)?;
                }
                return Err(stopped);
            }
            trainer.step(data)?;
            let step = trainer.step_count();
            let last = step == t.steps;
            if step % LOG_EVERY == 0 || last {
                let lr = learning_rate(&t.step.schedule.over(t.steps), step - 1);
                let metric =
                    Metric { step, loss: Some(trainer.mean_loss()), lr: Some(lr), validation_loss: None };
                self.log(metric)?;
                let held = self.validation_loss().map_or(String::new(), |v| format!(", held out {v:.4}"));
                bar.set(step as u64, &format!("loss {:.4}{held}", trainer.mean_loss()));
            }
            if let Some(held) = validation.filter(|_| step % t.validate_every == 0 || last) {
                let loss = trainer.validation_loss(held, t.validation_batches)?;
                let best = self.best().is_none_or(|(_, best)| loss < best);
                self.log(Metric { step, loss: None, lr: None, validation_loss: Some(loss) })?;
                if best {
                    self.save(&trainer)?;
                }
            }
            if step % t.save_every == 0 || last {
                self.save(&trainer)?;
            }
        }
        self.events.take().map(Events::finish).transpose()?;
        let held = self.validation_loss().map_or(String::new(), |v| format!(", held out {v:.4}"));
        bar.finish(&format!("{} steps, loss {:.4}{held}", t.steps, trainer.mean_loss()));
        Ok(Imitated {
            steps: trainer.step_count(),
            loss: trainer.mean_loss(),
            validation_loss: self.validation_loss(),
            last: self.folder.policy("last"),
            best: self.folder.policy("best"),
        })
    }

    fn log(&mut self, metric: Metric) -> Result<()> {
        if let Some(events) = &mut self.events {
            let (step, now) = (metric.step as u64, crate::now());
            let values = [("train/loss", metric.loss), ("train/lr", metric.lr.map(f64::from))];
            for (tag, value) in values.into_iter().chain([("validation/loss", metric.validation_loss)]) {
                value.map_or(Ok(()), |v| events.scalar(tag, step, now, v))?;
            }
            events.flush()?;
        }
        self.metrics.push(metric);
        Ok(())
    }

    /// The last loss on held-out episodes.
    fn validation_loss(&self) -> Option<f64> {
        self.metrics.iter().rev().find_map(|m| m.validation_loss)
    }

    /// Step and loss of the best look at them.
    fn best(&self) -> Option<(usize, f64)> {
        let looks = self.metrics.iter().filter_map(|m| Some((m.step, m.validation_loss?)));
        looks.reduce(|a, b| if b.1 < a.1 { b } else { a })
    }

    /// A checkpoint of this step, and what the folder says of the training so far.
    fn save(&self, trainer: &Trainer) -> Result<()> {
        let step = trainer.step_count();
        let best = self.best().map_or(step, |(step, _)| step);
        let weights = trainer.weights()?;
        self.folder.put(step, best, &self.metrics, |dir| {
            let policy = dir.join(folder::POLICY);
            e2h_policy::lerobot::save(
                &policy,
                &self.policy,
                self.features,
                self.scalings,
                &weights,
                &self.provenance,
            )?;
            let state = dir.join(folder::STATE);
            std::fs::create_dir_all(&state).map_err(io("creating", &state))?;
            Ok(trainer.save(&state.join(crate::directory::TRAINING))?)
        })?;
        let points = |of: fn(&Metric) -> Option<f64>| -> Vec<(f64, f64)> {
            self.metrics.iter().filter_map(|m| Some((m.step as f64, of(m)?))).collect()
        };
        let curve = chart::training_curve(&points(|m| m.loss), &points(|m| m.validation_loss));
        write_atomic(&self.folder.join("losses.svg"), curve.as_bytes())
    }
}
