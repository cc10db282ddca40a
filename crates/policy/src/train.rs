//! Training of a diffusion policy, one step at a time, exactly resumable.

use crate::batch::{BatchBuilder, Part};
use crate::divergence::{Skipped, sound};
use crate::examples::TrainingData;
use crate::lerobot::Features;
use crate::model::{Widths, widened};
use crate::{Ddim, DiffusionModel, EncoderNorm, Error, PolicyConfig, Prediction, Result, TrainConfig};
use candle_core::{Device, Tensor};
use e2h_core::{ACTION_DIM, Rng, Solo, Team, stream};
use e2h_nn::{
    Adam, Compute, Ema, Grads, HostTensor, LrSchedule, Mode, Weights, backward, learning_rate, mse_part,
    repeat_rows,
};
use rand::Rng as _;
use sha2::{Digest as _, Sha256};
use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::path::Path;

/// Where a training state's header has its checksum.
const SEAL: &str = "sha256";

/// SHA-256 of names, shapes and numbers.
fn digest(weights: &Weights) -> String {
    let mut hasher = Sha256::new();
    for (name, tensor) in weights {
        hasher.update((name.len() as u64).to_le_bytes());
        hasher.update(name);
        for size in std::iter::once(&tensor.shape.len()).chain(&tensor.shape) {
            hasher.update((*size as u64).to_le_bytes());
        }
        for value in &tensor.data {
            hasher.update(value.to_le_bytes());
        }
    }
    hasher.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

/// Losses that the mean is of.
const RECENT: usize = 100;
/// What the network is asked in a step, and the answer.
///
/// # Shapes
/// `noisy` and `target` (rows, T, action), `timesteps` (rows), `condition` (rows, condition), `mask` (rows, T); a row is one of the
/// noises of one of the conditions that were asked for.
struct Batch {
    noisy: Tensor,
    timesteps: Vec<f32>,
    condition: Tensor,
    target: Tensor,
    /// On the host, where the loss reads it.
    mask: Tensor,
    /// Actions that count in the whole step's loss.
    counted: f64,
}

/// A policy in training: network, optimiser, average of the weights, step counter.
pub struct Trainer {
    model: DiffusionModel,
    adam: Adam,
    ema: Ema,
    ddim: Ddim,
    config: PolicyConfig,
    widths: Widths,
    train: TrainConfig,
    schedule: LrSchedule,
    seed: u64,
    purpose: String,
    step: usize,
    skipped: Skipped,
    /// Of the last steps.
    losses: VecDeque<f32>,
}

impl Trainer {
    /// A trainer at step 0 of `steps` (the length of the learning-rate schedule). `start` are the weights to continue from; without them they are drawn from `seed`. `purpose`
    /// names the random streams (for example `train/hard/3`), so that two stages of a run never share one. A policy with an
    /// indicator may start from the weights of one without: it acts as that one did until it learns otherwise.
    ///
    /// # Errors
    /// When the configuration does not fit together or `start` is of another network.
    pub fn new(
        config: &PolicyConfig,
        train: &TrainConfig,
        steps: usize,
        start: Option<&Weights>,
        seed: u64,
        purpose: &str,
    ) -> Result<Self> {
        let widths = Widths { state: config.state_features(), action: ACTION_DIM };
        Self::of_widths(config, widths, train, steps, start, seed, purpose)
    }

    /// The same for recordings of any robot. `config` says nothing of their cameras and sizes: that is up to `features`.
    ///
    /// # Errors
    /// As [`Trainer::new`].
    pub fn of_features(
        config: &PolicyConfig,
        features: &Features,
        train: &TrainConfig,
        steps: usize,
        seed: u64,
        purpose: &str,
    ) -> Result<Self> {
        Self::of_widths(&config.seeing(features), features.widths(), train, steps, None, seed, purpose)
    }

    fn of_widths(
        config: &PolicyConfig,
        widths: Widths,
        train: &TrainConfig,
        steps: usize,
        start: Option<&Weights>,
        seed: u64,
        purpose: &str,
    ) -> Result<Self> {
        if config.encoder_norm == EncoderNorm::Folded {
            return Err(Error::Config(
                "encoder_norm: expected group, got folded: without its batch norm the encoder is for acting only"
                    .to_owned(),
            ));
        }
        let problems = train.validate();
        if !problems.is_empty() {
            return Err(Error::Config(problems.join("; ")));
        }
        let rng = &mut stream(seed, "weights", 0, 0);
        let model = DiffusionModel::of_widths(&Compute::cpu(), config, widths, Mode::Train, rng)?;
        if let Some(weights) = start {
            if config.indicator {
                model.params.import(&widened(config, weights))?;
            } else {
                model.params.import(weights)?;
            }
        } else if (train.keypoint_sharpness - 1.0).abs() > 0.0 {
            let mut weights = model.params.export()?;
            for (_, attention) in weights.iter_mut().filter(|(name, _)| name.ends_with("pool.nets.weight")) {
                attention.data.iter_mut().for_each(|w| *w *= train.keypoint_sharpness);
            }
            model.params.import(&weights)?;
        }
        let adam = Adam::new(&train.optimiser(), &model.params)?;
        let ema = Ema::new(&train.ema, &model.params)?;
        let ddim = Ddim::new(config.train_timesteps, config.inference_steps, config.prediction)?;
        Ok(Self {
            model,
            adam,
            ema,
            ddim,
            config: config.clone(),
            widths,
            train: train.clone(),
            schedule: train.schedule.over(steps),
            seed,
            purpose: purpose.to_owned(),
            step: 0,
            skipped: Skipped::default(),
            losses: VecDeque::with_capacity(RECENT),
        })
    }

    /// The same training on another device, from where it is.
    ///
    /// # Errors
    /// When the device fails.
    pub fn into_device(self, compute: &Compute) -> Result<Self> {
        if self.model.params.is_on(compute) {
            return Ok(self);
        }
        let rng = &mut stream(self.seed, "weights", 0, 0);
        let model = DiffusionModel::of_widths(compute, &self.config, self.widths, Mode::Train, rng)?;
        model.params.import(&self.model.params.export()?)?;
        let mut adam = Adam::new(&self.train.optimiser(), &model.params)?;
        adam.load_state(&self.adam.state()?)?;
        let mut ema = Ema::new(&self.train.ema, &model.params)?;
        ema.load_state(&self.ema.state()?)?;
        Ok(Self { model, adam, ema, ..self })
    }

    /// Steps done.
    #[must_use]
    pub fn step_count(&self) -> usize {
        self.step
    }

    /// Mean loss of the last hundred steps; 0 before the first.
    #[must_use]
    pub fn mean_loss(&self) -> f64 {
        self.losses.iter().map(|&l| f64::from(l)).sum::<f64>() / self.losses.len().max(1) as f64
    }

    /// One optimiser step; returns its loss.
    ///
    /// # Source
    /// Ho et al., arXiv 2006.11239, algorithm 1, on action chunks (Chi et al., arXiv 2303.04137); the loss leaves out
    /// actions past the end of a cut segment.
    ///
    /// # Errors
    /// When the data do not fit, the loss is not finite, or the gradient has been too long for several steps.
    pub fn step(&mut self, data: &TrainingData<'_>) -> Result<f32> {
        self.step_with(data, &Solo)
    }

    /// The same step by all ranks of `team`, which all have to call it on the same data: each computes the gradients of its part of
    /// the shards ([`TrainConfig::shards`]). The weights have the same bits on all ranks, and whatever the number of ranks.
    ///
    /// # Errors
    /// As [`Trainer::step`]; when the shards cannot be shared evenly, or another rank cannot be reached.
    pub fn step_with(&mut self, data: &TrainingData<'_>, team: &dyn Team) -> Result<f32> {
        let (shards, ranks) = (self.train.shards, team.size());
        if !shards.is_multiple_of(ranks) {
            return Err(Error::Config(format!(
                "shards: expected a multiple of the {ranks} ranks, got {shards}"
            )));
        }
        let (value, grads) =
            if shards == 1 { self.whole_gradient(data)? } else { self.shared_gradient(data, team)? };
        if !value.is_finite() {
            return Err(Error::NotFinite { step: self.step, seed: self.seed, loss: value });
        }
        let lr = learning_rate(&self.schedule, self.step);
        let norm = self.adam.step(&self.model.params, &grads, lr)?;
        self.skipped.after(norm, self.step, self.seed)?;
        self.ema.update(&self.model.params)?;
        self.step += 1;
        if self.losses.len() == RECENT {
            self.losses.pop_front();
        }
        self.losses.push_back(value);
        Ok(value)
    }

    /// Loss and gradients of the step's conditions `rows`, as parts of the whole step's.
    fn part(&self, data: &TrainingData<'_>, rows: Range<usize>) -> Result<(Tensor, Grads)> {
        // A stream per step: nothing of the generator has to be stored for an exact resume.
        let mut rng = stream(self.seed, &self.purpose, 0, self.step as u64);
        let loss = self.loss_of(&self.model, data, &self.train, false, rows, &mut rng)?;
        let grads = backward(&loss, &self.model.params)?;
        Ok((loss, grads))
    }

    fn whole_gradient(&self, data: &TrainingData<'_>) -> Result<(f32, Grads)> {
        let (loss, grads) = self.part(data, 0..self.train.conditions)?;
        // Read only now: a GPU is waited for here, and has all of the way back to do meanwhile.
        Ok((loss.to_scalar::<f32>()?, grads))
    }

    /// Gradients of a shard, and at their end its part of the loss.
    fn shard(&self, data: &TrainingData<'_>, shard: usize) -> Result<(Vec<f32>, Grads)> {
        let each = self.train.conditions / self.train.shards;
        let (loss, grads) = self.part(data, shard * each..(shard + 1) * each)?;
        let mut numbers = Vec::with_capacity(self.model.params.count() + 1);
        grads.flatten(&self.model.params, &mut numbers)?;
        numbers.push(loss.to_scalar::<f32>()?);
        Ok((numbers, grads))
    }

    /// The sum over all shards, in the order of a balanced tree: it is that of the configuration, however many ranks there are.
    fn shared_gradient(&self, data: &TrainingData<'_>, team: &dyn Team) -> Result<(f32, Grads)> {
        let own = self.train.shards / team.size();
        // Sums of 1, 2, 4, ... neighbours, the largest first.
        let mut sums: Vec<(usize, Vec<f32>)> = vec![];
        let mut latest = None;
        for shard in team.rank() * own..(team.rank() + 1) * own {
            let (mut numbers, grads) = self.shard(data, shard)?;
            latest = Some(grads);
            let mut shards = 1;
            while let Some((_, mut before)) = sums.pop_if(|(n, _)| *n == shards) {
                before.iter_mut().zip(&numbers).for_each(|(a, b)| *a += b);
                (numbers, shards) = (before, 2 * shards);
            }
            sums.push((shards, numbers));
        }
        let (Some((_, mut numbers)), Some(mut grads)) = (sums.pop(), latest) else {
            return Err(Error::Config(format!("shards: expected at least 1, got {}", self.train.shards)));
        };
        team.sum(&mut numbers)?;
        // With the gradients, so that a loss that is no number ends all ranks at the same step.
        let value = numbers.pop().unwrap_or(f32::NAN);
        grads.unflatten(&self.model.params, &numbers)?;
        Ok((value, grads))
    }

    /// SHA-256 of the weights, of the optimiser's state and of a gradient: where ranks whose numbers should be equal have another, their processors
    /// round differently.
    ///
    /// # Errors
    /// When the data do not fit.
    pub fn fingerprint(&self, data: &TrainingData<'_>) -> Result<String> {
        let mut all = self.model.params.export()?;
        all.extend(self.adam.state()?.into_iter().map(|(name, t)| (format!("adam/{name}"), t)));
        let (numbers, _) = self.shard(data, 0)?;
        all.insert("shard".to_owned(), HostTensor { shape: vec![numbers.len()], data: numbers });
        Ok(digest(&all))
    }

    /// Mean loss of the averaged weights over `batches` batches of `data`, the same ones in every call: crops are centred and
    /// nothing is disturbed.
    ///
    /// # Errors
    /// When the data do not fit.
    pub fn validation_loss(&self, data: &TrainingData<'_>, batches: usize) -> Result<f64> {
        let rng = &mut stream(self.seed, "weights", 0, 0);
        let compute = self.model.params.compute();
        let model = DiffusionModel::of_widths(compute, &self.config, self.widths, Mode::Infer, rng)?;
        model.params.import(&self.ema.weights()?)?;
        let plain = TrainConfig { conditioning_dropout: 0.0, observation_noise: 0.0, ..self.train.clone() };
        let mut sum = 0.0;
        for i in 0..batches {
            let rng = &mut stream(self.seed, "validate", 0, i as u64);
            let loss = self.loss_of(&model, data, &plain, true, 0..plain.conditions, rng)?;
            sum += f64::from(loss.to_scalar::<f32>()?);
        }
        Ok(sum / batches.max(1) as f64)
    }

    fn loss_of(
        &self,
        model: &DiffusionModel,
        data: &TrainingData<'_>,
        train: &TrainConfig,
        centred: bool,
        own: Range<usize>,
        rng: &mut Rng,
    ) -> Result<Tensor> {
        let batch = self.draw(model, data, train, centred, own, rng)?;
        let output = model.forward(&batch.noisy, &batch.timesteps, &batch.condition)?;
        Ok(mse_part(&output, &batch.target, &batch.mask, batch.counted)?)
    }

    /// Draws what is random of the whole step, in one order, and builds the conditions `own` of it.
    fn draw(
        &self,
        model: &DiffusionModel,
        data: &TrainingData<'_>,
        t: &TrainConfig,
        centred: bool,
        own: Range<usize>,
        rng: &mut Rng,
    ) -> Result<Batch> {
        let (c, action) = (&self.config, self.widths.action);
        let builder = || BatchBuilder::new(c).of_images(data.columns(c), data.scaling(c));
        let (mut batch, mut others) = (builder(), builder());
        let (per, rows) = (c.horizon * action, own.len() * t.noises);
        let mut clean = Vec::with_capacity(own.len() * per);
        let mut mask = Vec::with_capacity(rows * c.horizon);
        let mut counted = 0;
        let first_image = c.n_obs_steps - c.n_image_steps;
        let mut indicators = Vec::with_capacity(rows);
        let examples = data.batch(t.conditions, rng);
        let mut parts = Vec::new();
        for (i, example) in examples.iter().enumerate() {
            let (window, indicator, mine) = (&example.window, example.indicator, own.contains(&i));
            let to = if mine { &mut batch } else { &mut others };
            example.push_state(to, Some((t.observation_noise, rng)));
            if c.n_image_steps > 0 {
                for camera in 0..c.cameras.len() {
                    let corner = example.corner(c, (!centred).then_some(&mut *rng));
                    if mine {
                        let frames = example.frames(c, camera)?;
                        let rows = window.observations[first_image..].iter();
                        parts.extend(rows.map(|&row| Part { camera, frames, row, corner }));
                    }
                }
            }
            counted += t.noises * window.mask.iter().filter(|m| **m).count();
            if mine {
                for &row in &window.actions {
                    example.push_action(row, &mut clean);
                }
                for _ in 0..t.noises {
                    indicators.push(indicator);
                    mask.extend(window.mask.iter().map(|&m| if m { 1.0f32 } else { 0.0 }));
                }
            }
        }
        batch.push_parts(&parts, data.crop(c))?;
        let mut noisy = Vec::with_capacity(rows * per);
        let mut target = Vec::with_capacity(rows * per);
        let mut timesteps = Vec::with_capacity(rows);
        let mut keep = Vec::with_capacity(rows);
        let mut samples = clean.chunks_exact(per);
        for i in 0..t.conditions {
            let sample = if own.contains(&i) { samples.next() } else { None };
            for _ in 0..t.noises {
                let k = rng.random_range(0..c.train_timesteps);
                let noise: Vec<f32> = (0..per).map(|_| rng.sample(rand_distr::StandardNormal)).collect();
                let kept = if rng.random::<f32>() < t.conditioning_dropout { 0.0 } else { 1.0f32 };
                let Some(sample) = sample else { continue };
                let start = noisy.len();
                noisy.extend_from_slice(sample);
                self.ddim.add_noise(&mut noisy[start..], &noise, k);
                match c.prediction {
                    Prediction::Epsilon => target.extend(noise),
                    Prediction::Sample => target.extend_from_slice(sample),
                }
                timesteps.push(k as f32);
                keep.push(kept);
            }
        }
        if c.indicator {
            // Last, so that all else is drawn as without it.
            let mut indicators = indicators.iter_mut();
            for row in 0..t.conditions * t.noises {
                let dropped = rng.random::<f32>() < t.indicator_dropout;
                if own.contains(&(row / t.noises))
                    && let Some(indicator) = indicators.next()
                    && dropped
                {
                    *indicator = 0.0;
                }
            }
        }
        let device = model.device();
        let (state, images) = batch.tensors_of(data.crop(c), device)?;
        let mut condition = repeat_rows(&model.condition(&state, &images)?, t.noises)?;
        if keep.contains(&0.0) {
            condition = condition.broadcast_mul(&Tensor::from_vec(keep, (rows, 1), device)?)?;
        }
        if c.indicator {
            condition = model.indicate(&condition, &indicators)?;
        }
        let shape = (rows, c.horizon, action);
        Ok(Batch {
            noisy: Tensor::from_vec(noisy, shape, device)?,
            timesteps,
            condition,
            target: Tensor::from_vec(target, shape, device)?,
            mask: Tensor::from_vec(mask, (rows, c.horizon), &Device::Cpu)?,
            counted: counted as f64,
        })
    }

    /// The averaged weights: the policy to act with.
    ///
    /// # Errors
    /// When they cannot be read back, or one of them is not finite.
    pub fn weights(&self) -> Result<Weights> {
        let weights = self.ema.weights()?;
        sound(&weights, self.step, self.seed)?;
        Ok(weights)
    }

    /// Writes everything that [`Trainer::restore`] needs to go on as if nothing had happened.
    ///
    /// # Errors
    /// When the file cannot be written, or a number is not finite: the file that was there stays.
    pub fn save(&self, path: &Path) -> Result<()> {
        let mut all = Weights::new();
        for (part, tensors) in
            [("model", self.model.params.export()?), ("adam", self.adam.state()?), ("ema", self.ema.state()?)]
        {
            all.extend(tensors.into_iter().map(|(name, t)| (format!("{part}/{name}"), t)));
        }
        sound(&all, self.step, self.seed)?;
        let mut add = |name: &str, data: Vec<f32>| {
            all.insert(name.to_owned(), HostTensor { shape: vec![data.len()], data });
        };
        add("step", vec![self.step as f32]);
        add("skipped", vec![self.skipped.0 as f32]);
        add("losses", self.losses.iter().copied().collect());
        let seal = BTreeMap::from([(SEAL.to_owned(), digest(&all))]);
        Ok(e2h_nn::save_weights(path, &all, &seal)?)
    }

    /// Continues from a file that [`Trainer::save`] wrote.
    ///
    /// # Errors
    /// When the file is missing, damaged or of another network.
    pub fn restore(&mut self, path: &Path) -> Result<()> {
        let (mut all, metadata) = e2h_nn::load_weights(path)?;
        // States of version 0.1 have none.
        if let Some(expected) = metadata.get(SEAL) {
            let found = digest(&all);
            if *expected != found {
                let problem = format!(
                    "damaged: expected SHA-256 {}, found {found}; remove the file to train this stage from its beginning",
                    e2h_core::one_line(expected)
                );
                return Err(Error::Checkpoint { path: path.to_owned(), problem });
            }
        }
        // States of version 0.1 have a step only.
        let mut number = |name: &str| all.remove(name).and_then(|t| t.data.first().copied());
        let (step, skipped) = (number("step"), number("skipped").unwrap_or_default());
        let losses = all.remove("losses").map(|t| t.data).unwrap_or_default();
        let step = step.ok_or_else(|| Error::Checkpoint {
            path: path.to_owned(),
            problem: "expected a training state with tensor `step`, found none".to_owned(),
        })?;
        let part = |prefix: &str| -> Weights {
            all.iter()
                .filter_map(|(name, t)| Some((name.strip_prefix(prefix)?.to_owned(), t.clone())))
                .collect()
        };
        self.model.params.import(&part("model/"))?;
        self.adam.load_state(&part("adam/"))?;
        self.ema.load_state(&part("ema/"))?;
        self.step = step as usize;
        self.skipped = Skipped(skipped as usize);
        self.losses = losses.into_iter().take(RECENT).collect();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use e2h_core::{Direction, Episode, Observation, Origin};
    use e2h_data::{Normaliser, NormaliserConfig, Source};
    use std::sync::Arc;

    /// The last entry of every row's condition, its other entries, and what else was drawn.
    fn drawn(config: &PolicyConfig, train: &TrainConfig, step: u64) -> (Vec<f32>, Vec<Vec<f32>>, Vec<f32>) {
        let mut episode = Episode::new(Origin::demonstration("line", Direction::Hard, 0, 0), &[]);
        for t in 0..30_u8 {
            let x = f32::from(t) * 0.01;
            let state = [x, -x, x, 0., 1., 0., 0., 0.3, x, 0.1, 1., 0., 0., 0., 0.08];
            episode.push(&Observation { state, frames: vec![] }, &[x, x, x, 0., 1., 0., 0., 1.]).unwrap();
        }
        let normaliser = Normaliser::fit(&[episode.clone()], &NormaliserConfig::default()).unwrap();
        // In this order in every batch: a half good, a quarter bad, a quarter that nobody says anything of.
        let source = |share: f32| Source::new(vec![Arc::new(episode.clone())], share);
        let sources = [source(0.5).labelled(1.0), source(0.25).labelled(-1.0), source(0.25)];
        let data = TrainingData::new(&sources, config, &normaliser).unwrap();
        let trainer = Trainer::new(config, train, 1, None, 1, "test").unwrap();
        let rng = &mut stream(1, "test", 0, step);
        let batch = trainer.draw(&trainer.model, &data, train, false, 0..train.conditions, rng).unwrap();
        let rows = batch.condition.to_vec2::<f32>().unwrap();
        assert_eq!(rows[0].len(), config.condition_dim());
        let observed = config.condition_dim() - usize::from(config.indicator);
        let last = rows.iter().flat_map(|row| row[observed..].to_vec()).collect();
        let observations = rows.iter().map(|row| row[..observed].to_vec()).collect();
        let others = [&batch.noisy, &batch.target, &batch.mask].map(|t| t.flatten_all().unwrap());
        let others = others.iter().flat_map(|t| t.to_vec1::<f32>().unwrap()).chain(batch.timesteps);
        (last, observations, others.collect())
    }

    #[test]
    fn the_last_entry_of_a_condition_is_its_sources_label_or_0_where_it_is_dropped() {
        let plain = PolicyConfig { cameras: vec![], ..PolicyConfig::tiny() };
        let config = PolicyConfig { indicator: true, ..plain.clone() };
        let train = |indicator_dropout: f32, conditioning_dropout: f32| TrainConfig {
            conditions: 16,
            noises: 2,
            shards: 1,
            conditioning_dropout,
            indicator_dropout,
            observation_noise: 0.1,
            keypoint_sharpness: 1.0,
            adam: crate::ScheduledAdam::default(),
            schedule: crate::ScheduleConfig { kind: crate::ScheduleKind::Constant, lr: 1e-3, warmup: 0 },
            ema: e2h_nn::EmaConfig::default(),
        };
        let said: Vec<f32> = [(1.0, 16), (-1.0, 8), (0.0, 8)].iter().flat_map(|&(c, n)| vec![c; n]).collect();
        assert_eq!(drawn(&config, &train(0.0, 0.0), 0).0, said);
        // Whether the observation is there is another draw, and does not touch it.
        assert_eq!(drawn(&config, &train(0.0, 0.9), 0).0, said);

        let (mut dropped, mut unseen, mut both, mut all) = (0, 0, 0, 0);
        for step in 0..200 {
            let train = train(0.3, 0.5);
            let (last, observations, others) = drawn(&config, &train, step);
            // All else is drawn as without an indicator.
            assert_eq!((vec![], observations.clone(), others), drawn(&plain, &train, step));
            for ((c, said), observation) in last.iter().zip(&said).zip(&observations).take(24) {
                let (gone, blind) = (*c == 0.0, observation.iter().all(|v| *v == 0.0));
                assert!(gone || c == said, "{c} for {said}");
                dropped += u32::from(gone);
                unseen += u32::from(blind);
                both += u32::from(gone && blind);
                all += 1;
            }
        }
        // Of 4800; four standard deviations are 0.029 at most.
        for (count, share) in [(dropped, 0.3), (unseen, 0.5), (both, 0.15)] {
            let found = f64::from(count) / f64::from(all);
            assert!((found - share).abs() < 0.03, "{found} for {share}");
        }
    }
}
