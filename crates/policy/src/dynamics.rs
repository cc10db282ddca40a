//! Forward and inverse dynamics on a policy's visual-state features, for the baseline TR-DRL-DP: could the reversed step have happened,
//! and which action would have made it?

use crate::batch::{BatchBuilder, Rows};
use crate::divergence::{Skipped, sound};
use crate::model::ConditionEncoder;
use crate::{EncoderNorm, Error, PolicyConfig, Result};
use candle_core::Tensor;
use e2h_core::{ACTION_DIM, Action, Episode, stream};
use e2h_data::Normaliser;
use e2h_nn::{Adam, AdamConfig, Compute, Mlp, Mode, Params, Weights, backward};
use rand::Rng as _;
use rand::seq::SliceRandom as _;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;

/// Features that vary less than this over the rollouts are dropped.
const LEAST_DEVIATION: f32 = 1e-4;
/// Rows encoded at once.
const CHUNK: usize = 64;

/// Sizes and training of both networks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DynamicsConfig {
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Steps of each network.
    pub steps: usize,
    /// Transitions in a step.
    pub batch: usize,
    /// Adam's learning rate.
    pub lr: f32,
    /// Share of the rollouts that is held out, in [0, 1).
    pub validation: f32,
}

impl Default for DynamicsConfig {
    /// The paper's steps for its baseline, at sizes for a CPU.
    fn default() -> Self {
        Self { hidden: vec![256, 256], steps: 2000, batch: 256, lr: 1e-3, validation: 0.2 }
    }
}

impl DynamicsConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        let mut check = |good: bool, words: String| {
            if !good {
                problems.push(words);
            }
        };
        let widths = self.hidden.iter().all(|w| (1..=1 << 16).contains(w)) && self.hidden.len() <= 16;
        check(widths, format!("hidden: expected at most 16 widths from 1 to 65536, got {:?}", self.hidden));
        for (name, n, most) in [("steps", self.steps, 10_000_000), ("batch", self.batch, 1 << 20)] {
            check((1..=most).contains(&n), format!("{name}: expected 1 to {most}, got {n}"));
        }
        check(self.lr > 0.0 && self.lr <= 1.0, format!("lr: expected above 0, at most 1, got {}", self.lr));
        let share = (0.0..1.0).contains(&self.validation);
        check(share, format!("validation: expected 0 or more and below 1, got {}", self.validation));
        problems
    }
}

/// What both networks are trained with.
#[derive(Clone, Copy)]
pub struct DynamicsTraining<'a> {
    /// Configuration of the policy whose encoders make the features.
    pub policy: &'a PolicyConfig,
    /// Its weights.
    pub policy_weights: &'a Weights,
    /// Sizes and steps.
    pub dynamics: &'a DynamicsConfig,
    /// What computes it, then and later.
    pub compute: &'a Compute,
    /// Scaling of states and actions.
    pub normaliser: &'a Normaliser,
    /// Hard rollouts, failures included.
    pub rollouts: &'a [Episode],
    /// Run seed.
    pub seed: u64,
    /// What its random numbers are for.
    pub purpose: &'a str,
}

/// What training ended with. Held-out errors are none when there was nothing to hold out.
#[derive(Debug, Clone, PartialEq)]
pub struct DynamicsReport {
    /// Mean squared error of the next features, in their deviations.
    pub forward: f64,
    /// The same on rollouts held out.
    pub forward_held_out: Option<f64>,
    /// Mean squared error of the normalised actions.
    pub inverse: f64,
    /// The same on rollouts held out.
    pub inverse_held_out: Option<f64>,
    /// Median distance between the inverse model's goal and the pose that really came next, on rollouts held out, mm.
    pub label_mm: Option<f64>,
}

/// Forward and inverse dynamics on features of single frames.
///
/// # Source
/// The paper's baseline TR-DRL-DP (its appendix on baselines); what it leaves open is ours: features are standardised, f predicts their change.
pub struct Dynamics {
    features: Features,
    forward: Mlp,
    inverse: Mlp,
    normaliser: Normaliser,
    compute: Compute,
}

/// One vector a frame: state, and image features of frozen encoders.
struct Features {
    _params: Params,
    condition: ConditionEncoder,
    config: PolicyConfig,
    /// Entries that vary, with mean and deviation.
    entries: Vec<(usize, f32, f32)>,
}

impl Features {
    fn new(t: &DynamicsTraining<'_>) -> Result<Self> {
        let p = t.policy;
        let config = PolicyConfig {
            n_obs_steps: 1,
            n_image_steps: p.n_image_steps.min(1),
            encoder_norm: EncoderNorm::Group,
            indicator: false,
            ..p.clone()
        };
        let mut rng = stream(t.seed, t.purpose, 0, u64::MAX - 1);
        let (params, condition) = Params::build_on(t.compute, Mode::Infer, &mut rng, |b| {
            ConditionEncoder::new(&config, config.state_features(), &b.pp("diffusion"))
        })?;
        let mut weights = params.export()?;
        for (name, tensor) in &mut weights {
            let found = t.policy_weights.get(name).filter(|f| f.shape == tensor.shape);
            let found = found.ok_or_else(|| {
                Error::Data(format!("dynamics: expected a policy with image encoders, found no `{name}`"))
            })?;
            tensor.clone_from(found);
        }
        params.import(&weights)?;
        Ok(Self { _params: params, condition, config, entries: vec![] })
    }

    /// Every entry of every row's features.
    fn all(&self, episode: &Episode, normaliser: &Normaliser) -> Result<Vec<Vec<f32>>> {
        let c = &self.config;
        let device = self._params.compute().device();
        let mut features = Vec::with_capacity(episode.len());
        let rows: Vec<usize> = (0..episode.len()).collect();
        for some in rows.chunks(CHUNK) {
            let mut batch = BatchBuilder::new(c);
            for &t in some {
                batch.push_state(Rows::Episode(episode, &[t]), normaliser, None);
                batch.push_frame(c, episode, t)?;
            }
            let (state, images) = batch.tensors(c.crop_size, device)?;
            features.extend(self.condition.forward(&state, &images)?.to_vec2::<f32>()?);
        }
        Ok(features)
    }

    /// Fits the scaling, and drops what does not vary.
    fn fit(&mut self, rows: &[Vec<Vec<f32>>]) {
        let width = rows.iter().flatten().next().map_or(0, Vec::len);
        let n = rows.iter().map(Vec::len).sum::<usize>().max(1) as f64;
        let entry = |i: usize| {
            let column = || rows.iter().flatten().map(|row| f64::from(row[i]));
            let mean = column().sum::<f64>() / n;
            let deviation = (column().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt() as f32;
            (deviation >= LEAST_DEVIATION).then_some((i, mean as f32, deviation))
        };
        self.entries = (0..width).filter_map(entry).collect();
    }

    fn scaled(&self, row: &[f32]) -> Vec<f32> {
        self.entries.iter().map(|&(i, mean, deviation)| (row[i] - mean) / deviation).collect()
    }
}

/// Scaled features and normalised actions of a rollout.
struct Path {
    z: Vec<Vec<f32>>,
    a: Vec<Action>,
}

/// Inputs and targets of some transitions of one network.
struct Examples {
    input: Vec<f32>,
    target: Vec<f32>,
    rows: usize,
}

/// Which network learns.
#[derive(Clone, Copy, PartialEq)]
enum Which {
    /// (z, a) to z' - z.
    Forward,
    /// (z, z') to a.
    Inverse,
}

impl Which {
    fn examples<'a>(self, transitions: impl Iterator<Item = (&'a Path, usize)>) -> Examples {
        let mut e = Examples { input: vec![], target: vec![], rows: 0 };
        for (path, t) in transitions {
            let (now, next, action) = (&path.z[t], &path.z[t + 1], &path.a[t]);
            e.input.extend(now);
            match self {
                Self::Forward => {
                    e.input.extend(action);
                    e.target.extend(now.iter().zip(next).map(|(a, b)| b - a));
                }
                Self::Inverse => {
                    e.input.extend(next);
                    e.target.extend(action);
                }
            }
            e.rows += 1;
        }
        e
    }
}

impl Examples {
    fn tensors(self, compute: &Compute) -> Result<(Tensor, Tensor)> {
        let (i, o) = (self.input.len() / self.rows.max(1), self.target.len() / self.rows.max(1));
        Ok((
            Tensor::from_vec(self.input, (self.rows, i), compute.device())?,
            Tensor::from_vec(self.target, (self.rows, o), compute.device())?,
        ))
    }
}

/// Trains both from scratch on adjacent rows of all rollouts. `progress` is told (steps done of both together, loss) after every step, and
/// may end the training.
///
/// # Errors
/// When no rollout has two rows, they do not fit, the policy has no image encoders, a loss or a weight is not finite, or `progress` broke off.
pub fn train_dynamics(
    training: &DynamicsTraining<'_>,
    mut progress: impl FnMut(usize, f32) -> ControlFlow<()>,
) -> Result<(Dynamics, DynamicsReport)> {
    let t = training;
    let problems = t.dynamics.validate();
    if !problems.is_empty() {
        return Err(Error::Config(format!("dynamics: {}", problems.join("; "))));
    }
    let mut order: Vec<&Episode> = t.rollouts.iter().filter(|e| e.len() > 1).collect();
    if order.is_empty() {
        return Err(Error::Data(
            "dynamics: expected a hard rollout of two rows or more, got none".to_owned(),
        ));
    }
    order.shuffle(&mut stream(t.seed, t.purpose, 0, u64::MAX));
    let mut features = Features::new(t)?;
    let raw = order.iter().map(|e| features.all(e, t.normaliser)).collect::<Result<Vec<_>>>()?;
    features.fit(&raw);
    let paths: Vec<Path> = order
        .iter()
        .zip(&raw)
        .map(|(e, rows)| Path {
            z: rows.iter().map(|r| features.scaled(r)).collect(),
            a: e.action.iter().map(|a| t.normaliser.normalise_action(a)).collect(),
        })
        .collect();
    drop(raw);
    let held = ((paths.len() as f32 * t.dynamics.validation) as usize).min(paths.len() - 1);
    let (validation, learned) = paths.split_at(held);
    let width = features.entries.len();

    let mut told = |which: Which, step: usize, loss: f32| {
        let before = if which == Which::Forward { 0 } else { t.dynamics.steps };
        progress(before + step, loss)
    };
    let (forward, forward_loss) = fit(t, Which::Forward, [width + ACTION_DIM, width], learned, &mut told)?;
    let (inverse, inverse_loss) = fit(t, Which::Inverse, [2 * width, ACTION_DIM], learned, &mut told)?;
    let dynamics =
        Dynamics { features, forward, inverse, normaliser: t.normaliser.clone(), compute: t.compute.clone() };
    let held_out = |which| dynamics.loss(which, validation);
    let report = DynamicsReport {
        forward: forward_loss,
        forward_held_out: held_out(Which::Forward)?,
        inverse: inverse_loss,
        inverse_held_out: held_out(Which::Inverse)?,
        label_mm: dynamics.label_distance(&order[..held], validation)?,
    };
    Ok((dynamics, report))
}

/// Trains one network; returns it for inference, and its mean loss over the last tenth of the steps.
fn fit(
    t: &DynamicsTraining<'_>,
    which: Which,
    [input, output]: [usize; 2],
    paths: &[Path],
    told: &mut impl FnMut(Which, usize, f32) -> ControlFlow<()>,
) -> Result<(Mlp, f64)> {
    let c = t.dynamics;
    let purpose = format!("{}/{}", t.purpose, if which == Which::Forward { "forward" } else { "inverse" });
    let dims: Vec<usize> = std::iter::once(input).chain(c.hidden.iter().copied()).chain([output]).collect();
    let build = |mode| {
        let mut rng = stream(t.seed, &purpose, 0, u64::MAX);
        Params::build_on(t.compute, mode, &mut rng, |b| Mlp::new(&dims, 0.0, b))
    };
    let (params, network) = build(Mode::Train)?;
    let config =
        AdamConfig { lr: c.lr, beta1: 0.9, weight_decay: 0.0, clip_norm: None, ..AdamConfig::default() };
    let mut adam = Adam::new(&config, &params)?;
    let mut skipped = Skipped::default();
    let (mut tail, mut counted) = (0.0, 0usize);
    for step in 0..c.steps {
        let mut rng = stream(t.seed, &purpose, 0, step as u64);
        let drawn = (0..c.batch).map(|_| {
            let path = &paths[rng.random_range(0..paths.len())];
            (path, rng.random_range(0..path.z.len() - 1))
        });
        let (x, y) = which.examples(drawn.collect::<Vec<_>>().into_iter()).tensors(t.compute)?;
        let loss = (network.forward::<e2h_core::Rng>(&x, None)? - y)?.sqr()?.mean_all()?;
        let value = loss.to_scalar::<f32>()?;
        if !value.is_finite() {
            return Err(Error::NotFinite { step, seed: t.seed, loss: value });
        }
        let grads = backward(&loss, &params)?;
        skipped.after(adam.step(&params, &grads, c.lr)?, step, t.seed)?;
        if step >= c.steps - (c.steps / 10).max(1) {
            tail += f64::from(value);
            counted += 1;
        }
        if told(which, step + 1, value).is_break() {
            return Err(Error::Stopped { step: step + 1 });
        }
    }
    let weights = params.export()?;
    sound(&weights, c.steps, t.seed)?;
    let (params, network) = build(Mode::Infer)?;
    params.import(&weights)?;
    Ok((network, tail / counted.max(1) as f64))
}

impl Dynamics {
    /// Error and action of every step of a path that is to be taken, for instance a reversed rollout: the inverse model's action from each row to
    /// the next, and how far the forward model then ends from it (mean square over the features, in their deviations). The last row has no
    /// next one and repeats what the one before has. The gripper entry of the actions is the path's own.
    ///
    /// # Shapes
    /// Both lists have a number a row.
    ///
    /// # Errors
    /// When the images do not fit the encoders, or cannot be read.
    pub fn judge(&self, path: &Episode) -> Result<(Vec<f32>, Vec<Action>)> {
        if path.len() < 2 {
            return Ok((vec![0.0; path.len()], path.action.clone()));
        }
        let raw = self.features.all(path, &self.normaliser)?;
        let z: Vec<Vec<f32>> = raw.iter().map(|r| self.features.scaled(r)).collect();
        let actions = self.act(&z)?;
        let walked = Path { z, a: actions.clone() };
        let examples = Which::Forward.examples((0..walked.a.len()).map(|t| (&walked, t)));
        let (x, y) = examples.tensors(&self.compute)?;
        let off = (self.forward.forward::<e2h_core::Rng>(&x, None)? - y)?.sqr()?.mean(1)?;
        let mut errors = off.to_vec1::<f32>()?;
        errors.extend(errors.last().copied());
        let mut labels: Vec<Action> = actions.iter().map(|a| self.normaliser.unnormalise_action(a)).collect();
        labels.extend(labels.last().copied());
        for (label, own) in labels.iter_mut().zip(&path.action) {
            label[7] = own[7];
        }
        Ok((errors, labels))
    }

    /// The inverse model's normalised action of each step.
    fn act(&self, z: &[Vec<f32>]) -> Result<Vec<Action>> {
        let pairs: Vec<f32> = z.windows(2).flat_map(|w| w[0].iter().chain(&w[1]).copied()).collect();
        let rows = z.len() - 1;
        let x = Tensor::from_vec(pairs, (rows, 2 * self.features.entries.len()), self.compute.device())?;
        let y = self.inverse.forward::<e2h_core::Rng>(&x, None)?.clamp(-1f32, 1f32)?;
        Ok(y.flatten_all()?.to_vec1::<f32>()?.as_chunks::<ACTION_DIM>().0.to_vec())
    }

    fn loss(&self, which: Which, paths: &[Path]) -> Result<Option<f64>> {
        if paths.is_empty() {
            return Ok(None);
        }
        let network = if which == Which::Forward { &self.forward } else { &self.inverse };
        let (mut sum, mut n) = (0.0, 0usize);
        for path in paths {
            let examples = which.examples((0..path.z.len() - 1).map(|t| (path, t)));
            let rows = examples.rows;
            let (x, y) = examples.tensors(&self.compute)?;
            let loss = (network.forward::<e2h_core::Rng>(&x, None)? - y)?.sqr()?.mean_all()?;
            sum += f64::from(loss.to_scalar::<f32>()?) * rows as f64;
            n += rows;
        }
        Ok(Some(sum / n as f64))
    }

    /// Median distance of the inverse model's goals to the poses that came next, mm.
    fn label_distance(&self, episodes: &[&Episode], paths: &[Path]) -> Result<Option<f64>> {
        let mut all = vec![];
        for (episode, path) in episodes.iter().zip(paths) {
            for (t, action) in self.act(&path.z)?.iter().enumerate() {
                let goal = self.normaliser.unnormalise_action(action);
                let next = &episode.state[t + 1];
                let square: f32 = (0..3).map(|i| (goal[i] - next[i]).powi(2)).sum();
                all.push(1000.0 * f64::from(square.sqrt()));
            }
        }
        all.sort_by(f64::total_cmp);
        Ok(all.get(all.len() / 2).copied())
    }
}
