//! The critic: how far along is this frame?

use crate::batch::{BatchBuilder, Rows};
use crate::divergence::{Skipped, sound};
use crate::model::ConditionEncoder;
use crate::train_config::without_zero_clip;
use crate::{CriticConfig, EncoderNorm, Error, PolicyConfig, Result};
use candle_core::Tensor;
use e2h_core::{Episode, Rng, stream};
use e2h_data::Normaliser;
use e2h_nn::{Adam, Builder, Compute, Mlp, Mode, Params, Weights, backward};
use rand::Rng as _;
use rand::seq::SliceRandom as _;
use std::ops::ControlFlow;

/// A value function on two-step visual-state input.
pub struct Critic {
    pub(crate) params: Params,
    condition: ConditionEncoder,
    head: Mlp,
    pub(crate) normaliser: Normaliser,
    /// The policy's configuration with the critic's crop.
    pub(crate) config: PolicyConfig,
}

/// What training a critic ended with.
#[derive(Debug, Clone, PartialEq)]
pub struct CriticReport {
    /// Mean squared error on the training trajectories over the last tenth of the steps.
    pub train_loss: f64,
    /// Mean squared error on the held-out trajectories; none when there was nothing to hold out.
    pub validation_loss: Option<f64>,
    /// Loss of every step.
    pub losses: Vec<f32>,
}

impl Critic {
    pub(crate) fn new(
        policy: &PolicyConfig,
        critic: &CriticConfig,
        compute: &Compute,
        normaliser: &Normaliser,
        mode: Mode,
        seed: u64,
    ) -> Result<Self> {
        let problems = critic.validate(policy);
        if !problems.is_empty() {
            return Err(Error::Config(format!("critic: {}", problems.join("; "))));
        }
        let config = Self::config(policy, critic);
        let (params, (condition, head)) =
            Params::build_on(compute, mode, &mut stream(seed, "critic/weights", 0, 0), |b| {
                Self::parts(&config, critic, b)
            })?;
        Ok(Self { params, condition, head, normaliser: normaliser.clone(), config })
    }

    /// A critic with given weights, on the CPU.
    pub(crate) fn with_weights(
        policy: &PolicyConfig,
        critic: &CriticConfig,
        normaliser: &Normaliser,
        weights: &Weights,
    ) -> Result<Self> {
        Params::check(weights, |b| Self::parts(&Self::config(policy, critic), critic, b))?;
        let this = Self::new(policy, critic, &Compute::cpu(), normaliser, Mode::Infer, 0)?;
        this.params.import(weights)?;
        Ok(this)
    }

    fn config(policy: &PolicyConfig, critic: &CriticConfig) -> PolicyConfig {
        PolicyConfig {
            crop_size: critic.crop_size,
            encoder_norm: EncoderNorm::Group,
            indicator: false,
            ..policy.clone()
        }
    }

    fn parts(
        config: &PolicyConfig,
        critic: &CriticConfig,
        b: &Builder<'_>,
    ) -> e2h_nn::Result<(ConditionEncoder, Mlp)> {
        let dims: Vec<usize> =
            std::iter::once(config.condition_dim()).chain(critic.hidden.iter().copied()).chain([1]).collect();
        let condition = ConditionEncoder::new(config, config.state_features(), &b.pp("diffusion"))?;
        Ok((condition, Mlp::new(&dims, critic.dropout, &b.pp("head"))?))
    }

    /// Starts the image encoders from a policy's; the head stays as drawn.
    fn adopt_encoders(&self, policy: &Weights) -> Result<()> {
        let mut weights = self.params.export()?;
        for (name, tensor) in &mut weights {
            if let Some(found) = policy.get(name).filter(|f| f.shape == tensor.shape) {
                tensor.clone_from(found);
            }
        }
        Ok(self.params.import(&weights)?)
    }

    fn forward(&self, batch: BatchBuilder, dropout: Option<&mut Rng>) -> Result<Tensor> {
        let (state, images) = batch.tensors(self.config.crop_size, self.params.compute().device())?;
        let condition = self.condition.forward(&state, &images)?;
        Ok(self.head.forward(&condition, dropout)?)
    }

    fn push(
        &self,
        batch: &mut BatchBuilder,
        episode: &Episode,
        t: usize,
        augment: Option<(&mut Rng, f32)>,
    ) -> Result<()> {
        let c = &self.config;
        let rows: Vec<usize> =
            (0..c.n_obs_steps).map(|k| (t + k + 1).saturating_sub(c.n_obs_steps)).collect();
        batch.push_state(Rows::Episode(episode, &rows), &self.normaliser, None);
        if c.n_image_steps == 0 {
            return Ok(());
        }
        let mut augment = augment;
        for (camera, name) in c.cameras.iter().enumerate() {
            let (corner, jitter) = match &mut augment {
                Some((rng, width)) => {
                    let mut draw = || if *width > 0.0 { rng.random_range(-*width..=*width) } else { 0.0 };
                    let jitter = (1.0 + draw(), draw() * 0.5);
                    (c.random_crop(rng), Some(jitter))
                }
                None => (c.centre_crop(), None),
            };
            let named = episode.frames.iter().find(|f| f.camera == *name);
            let frames = named.filter(|f| f.height == c.image_size).ok_or_else(|| {
                Error::Data(format!(
                    "expected images of {0} x {0} from camera {1}, found {2:?}",
                    c.image_size,
                    name,
                    episode.frames.iter().map(|f| (&f.camera, f.height)).collect::<Vec<_>>()
                ))
            })?;
            for &row in &rows[c.n_obs_steps - c.n_image_steps..] {
                batch.push_image(camera, &frames.image(row)?, corner, c.crop_size, jitter);
            }
        }
        Ok(())
    }

    /// Side of the images that it takes, pixels.
    #[must_use]
    pub fn image_size(&self) -> usize {
        self.config.image_size
    }

    /// Value of every row of `episode`.
    ///
    /// # Errors
    /// When the episode's images do not fit the critic.
    pub fn evaluate(&self, episode: &Episode) -> Result<Vec<f32>> {
        let mut values = Vec::with_capacity(episode.len());
        let rows: Vec<usize> = (0..episode.len()).collect();
        for some in rows.chunks(64) {
            let mut batch = BatchBuilder::new(&self.config);
            for &t in some {
                self.push(&mut batch, episode, t, None)?;
            }
            values.extend(self.forward(batch, None)?.flatten_all()?.to_vec1::<f32>()?);
        }
        Ok(values)
    }
}

/// `G_t = (T - t) r + r_T` with `r = -1 / (2 H)`, `r_T` 1 for a success and 0 otherwise (the paper's equation 9).
fn target(episode: &Episode, t: usize, horizon: usize) -> f32 {
    let remaining = (episode.len() - t) as f32;
    let terminal = if episode.outcome.is_success() { 1.0 } else { 0.0 };
    terminal - remaining / (2.0 * horizon as f32)
}

/// What a critic is trained with.
#[derive(Clone, Copy)]
pub struct CriticTraining<'a> {
    /// Configuration of the policy whose rollouts it judges.
    pub policy: &'a PolicyConfig,
    /// Its own.
    pub critic: &'a CriticConfig,
    /// What computes it, then and later.
    pub compute: &'a Compute,
    /// Scaling of states.
    pub normaliser: &'a Normaliser,
    /// Weights of the policy: its encoders are what the critic's start from, where they fit.
    pub policy_weights: &'a Weights,
    /// Hard rollouts, failures included.
    pub rollouts: &'a [Episode],
    /// Horizon H of the hard task, control steps.
    pub horizon: usize,
    /// Run seed.
    pub seed: u64,
    /// What its random numbers are for.
    pub purpose: &'a str,
}

/// Trains a critic from scratch.
///
/// `progress` is told (steps done, loss) after every step, and may end the training.
///
/// # Errors
/// When there are no rollouts, they do not fit, the loss or a weight is not finite, the gradient has been too long for several steps,
/// or `progress` broke off.
pub fn train_critic(
    training: &CriticTraining<'_>,
    mut progress: impl FnMut(usize, f32) -> ControlFlow<()>,
) -> Result<(Critic, CriticReport)> {
    let CriticTraining {
        policy,
        critic,
        compute,
        normaliser,
        policy_weights,
        rollouts,
        horizon,
        seed,
        purpose,
    } = *training;
    let mut order: Vec<&Episode> = rollouts.iter().filter(|e| !e.is_empty()).collect();
    if order.is_empty() {
        return Err(Error::Data("the critic needs at least one hard rollout, got none".to_owned()));
    }
    order.shuffle(&mut stream(seed, purpose, 0, u64::MAX));
    let held = ((order.len() as f32 * critic.validation) as usize).min(order.len() - 1);
    let (validation, training) = order.split_at(held);

    let network = Critic::new(policy, critic, compute, normaliser, Mode::Train, seed)?;
    network.adopt_encoders(policy_weights)?;
    let mut adam = Adam::new(&without_zero_clip(critic.adam), &network.params)?;
    let mut losses = Vec::with_capacity(critic.steps);
    let mut skipped = Skipped::default();
    for step in 0..critic.steps {
        let mut rng = stream(seed, purpose, 0, step as u64);
        let mut batch = BatchBuilder::new(&network.config);
        let mut targets = Vec::with_capacity(critic.batch);
        for _ in 0..critic.batch {
            // Trajectories first, then a row: long failures would outweigh short successes otherwise.
            let episode = training[rng.random_range(0..training.len())];
            let t = rng.random_range(0..episode.len());
            network.push(&mut batch, episode, t, Some((&mut rng, critic.colour_jitter)))?;
            targets.push(target(episode, t, horizon));
        }
        let target = Tensor::from_vec(targets, (critic.batch, 1), compute.device())?;
        let loss = (network.forward(batch, Some(&mut rng))? - target)?.sqr()?.mean_all()?;
        let value = loss.to_scalar::<f32>()?;
        if !value.is_finite() {
            return Err(Error::NotFinite { step, seed, loss: value });
        }
        let grads = backward(&loss, &network.params)?;
        skipped.after(adam.step(&network.params, &grads, critic.adam.lr)?, step, seed)?;
        losses.push(value);
        if progress(step + 1, value).is_break() {
            return Err(Error::Stopped { step: step + 1 });
        }
    }

    let trained = Critic::new(policy, critic, compute, normaliser, Mode::Infer, seed)?;
    let weights = network.params.export()?;
    sound(&weights, critic.steps, seed)?;
    trained.params.import(&weights)?;
    let mut squares = (0.0, 0usize);
    for episode in validation {
        for (t, v) in trained.evaluate(episode)?.iter().enumerate() {
            squares.0 += f64::from(v - target(episode, t, horizon)).powi(2);
            squares.1 += 1;
        }
    }
    let tail = &losses[losses.len() - (losses.len() / 10).max(1).min(losses.len())..];
    let report = CriticReport {
        train_loss: tail.iter().map(|&l| f64::from(l)).sum::<f64>() / tail.len().max(1) as f64,
        validation_loss: (squares.1 > 0).then(|| squares.0 / squares.1 as f64),
        losses,
    };
    Ok((trained, report))
}
