//! The agent: an actor, two critics with their targets, and the weight of the entropy.

use super::network::{Actor, Twin, adam, matrix, normal, numbers, part, put};
use super::{Batch, SacConfig, network};
use crate::{Error, Result};
use candle_core::Tensor;
use e2h_core::{Rng, stream};
use e2h_nn::{Adam, Compute, HostTensor, Mode, Weights, backward, no_grad};

/// What an update did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SacReport {
    /// Sum of the critics' mean squared errors.
    pub critic_loss: f32,
    /// Mean of the lower value over the batch.
    pub value: f32,
    /// Weight of the entropy.
    pub alpha: f32,
    /// Whether critics and actor began anew after it.
    pub restarted: bool,
}

/// The learned weight of the entropy, exp of a number that Adam moves.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Alpha {
    log: f32,
    mean: f32,
    square: f32,
    steps: u32,
}

impl Alpha {
    fn value(&self) -> f32 {
        self.log.exp()
    }

    /// One step of Adam along the gradient of exp(log) times `surplus`.
    fn step(&mut self, surplus: f32, lr: f32) {
        let c = adam(lr);
        let g = self.value() * surplus;
        self.steps += 1;
        self.mean = c.beta1 * self.mean + (1.0 - c.beta1) * g;
        self.square = c.beta2 * self.square + (1.0 - c.beta2) * g * g;
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(f64::from(self.steps));
        let (m, v) =
            (f64::from(self.mean) / correction(c.beta1), f64::from(self.square) / correction(c.beta2));
        self.log -= (f64::from(lr) * m / (v.sqrt() + f64::from(c.eps))) as f32;
    }

    /// As a tensor; steps in thousands of 2^20 and the rest, which `f32` holds exactly.
    fn state(&self) -> HostTensor {
        let steps = [(self.steps >> 20) as f32, (self.steps & 0xf_ffff) as f32];
        HostTensor { shape: vec![5], data: vec![self.log, self.mean, self.square, steps[0], steps[1]] }
    }

    fn from_state(t: &HostTensor) -> Option<Self> {
        let [log, mean, square, high, low] = t.data[..] else { return None };
        Some(Self { log, mean, square, steps: ((high as u32) << 20) + low as u32 })
    }
}

/// A soft actor-critic agent.
///
/// # Source
/// Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", in the form of `jyp9961/TR-DRL e56d60e
/// robosuite/sac_agentenv.py`; the layer norm from `ikostrikov/rlpd c90fd4b`.
pub struct Sac {
    config: SacConfig,
    sizes: [usize; 2],
    compute: Compute,
    seed: u64,
    purpose: String,
    actor: Actor,
    actor_adam: Adam,
    critics: Twin,
    critic_adam: Adam,
    /// The critics' weights without a gradient of theirs, for the actor's.
    frozen: Twin,
    targets: Twin,
    alpha: Alpha,
    updates: usize,
    restarts: usize,
}

impl Sac {
    /// An agent of observations and actions of these sizes that knows nothing; its weights follow from seed and purpose.
    ///
    /// # Errors
    /// [`Error::Config`] lists all values that cannot work.
    pub fn new(
        config: &SacConfig,
        observation: usize,
        action: usize,
        compute: &Compute,
        seed: u64,
        purpose: &str,
    ) -> Result<Self> {
        let problems = config.validate();
        if !problems.is_empty() {
            return Err(Error::Config(problems.join("; ")));
        }
        let sizes = [observation, action];
        let mut rng = stream(seed, purpose, 0, u64::MAX);
        let actor = Actor::new(observation, action, config, Mode::Train, compute, &mut rng)?;
        let critics = Twin::new(sizes, config, Mode::Train, compute, &mut rng)?;
        let [frozen, targets] = [(); 2].map(|()| Twin::new(sizes, config, Mode::Infer, compute, &mut rng));
        let (frozen, targets) = (frozen?, targets?);
        targets.params.follow(&critics.params, 1.0)?;
        Ok(Self {
            config: config.clone(),
            sizes,
            compute: compute.clone(),
            seed,
            purpose: purpose.to_owned(),
            actor_adam: Adam::new(&adam(config.lr), actor.params())?,
            actor,
            critic_adam: Adam::new(&adam(config.lr), &critics.params)?,
            critics,
            frozen,
            targets,
            alpha: Alpha { log: config.alpha.ln(), mean: 0.0, square: 0.0, steps: 0 },
            updates: 0,
            restarts: 0,
        })
    }

    /// What acts.
    #[must_use]
    pub fn actor(&self) -> &Actor {
        &self.actor
    }

    /// Updates made.
    #[must_use]
    pub fn updates(&self) -> usize {
        self.updates
    }

    /// How often critics and actor began anew.
    #[must_use]
    pub fn restarts(&self) -> usize {
        self.restarts
    }

    fn observations(&self, rows: &[f32]) -> Result<Tensor> {
        matrix(rows, self.sizes[0], &self.compute)
    }

    fn check(&self, batch: &Batch) -> Result<()> {
        let [o, a] = self.sizes;
        let n = batch.len();
        let found = [batch.observation.len(), batch.action.len(), batch.next.len(), batch.bootstrap.len()];
        if n > 0 && found == [n * o, n * a, n * o, n] {
            return Ok(());
        }
        Err(Error::Data(format!(
            "batch: expected rows of {o}, {a}, {o} and 1 numbers, got {found:?} for {n}"
        )))
    }

    /// What the critics should say: r + gamma (min Q'(s', a') - alpha ln p(a')), with a' drawn by `noise`.
    pub(super) fn targets(&self, batch: &Batch, noise: &[f32]) -> Result<Vec<f32>> {
        let next = self.observations(&batch.next)?;
        let (q1, q2, log_p) = no_grad(|| -> Result<_> {
            let (action, log_p) = self.actor.draw(&next, noise)?;
            let [q1, q2] = self.targets.values(&next, &action)?;
            Ok((numbers(&q1)?, numbers(&q2)?, numbers(&log_p)?))
        })?;
        let weight = if self.config.entropy_in_target { self.alpha.value() } else { 0.0 };
        let value = |i: usize| q1[i].min(q2[i]) - weight * log_p[i];
        let row = |(i, (r, b)): (usize, (&f32, &f32))| {
            // Where nothing comes after, whatever the networks say of it must not count, even if it is no number.
            if *b > 0.0 { r + self.config.gamma * b * value(i) } else { *r }
        };
        Ok(batch.reward.iter().zip(&batch.bootstrap).enumerate().map(row).collect())
    }

    /// Sum of both mean squared errors, and the mean of the lower value.
    pub(super) fn critic_loss(&self, batch: &Batch, targets: &[f32]) -> Result<(Tensor, f32)> {
        let action = matrix(&batch.action, self.sizes[1], &self.compute)?;
        let [q1, q2] = self.critics.values(&self.observations(&batch.observation)?, &action)?;
        let y = matrix(targets, 1, &self.compute)?;
        let loss = ((&q1 - &y)?.sqr()?.mean_all()? + (&q2 - &y)?.sqr()?.mean_all()?)?;
        let lower: f32 = numbers(&q1)?.iter().zip(numbers(&q2)?).map(|(a, b)| a.min(b)).sum();
        Ok((loss, lower / targets.len().max(1) as f32))
    }

    /// Mean of alpha ln p(a) - min Q(s, a), and the mean of ln p(a).
    pub(super) fn actor_loss(&self, batch: &Batch, noise: &[f32]) -> Result<(Tensor, f32)> {
        self.frozen.params.follow(&self.critics.params, 1.0)?;
        let s = self.observations(&batch.observation)?;
        let (action, log_p) = self.actor.draw(&s, noise)?;
        let [q1, q2] = self.frozen.values(&s, &action)?;
        // Which of both is the lower one has no gradient of its own.
        let first: Vec<f32> =
            numbers(&q1)?.iter().zip(numbers(&q2)?).map(|(a, b)| if *a <= b { 1.0 } else { 0.0 }).collect();
        let first = matrix(&first, 1, &self.compute)?;
        let lower = ((&q1 * &first)? + (q2 * first.affine(-1.0, 1.0)?)?)?;
        let loss = ((&log_p * f64::from(self.alpha.value()))? - lower)?.mean_all()?;
        let mean = numbers(&log_p)?.iter().sum::<f32>() / batch.len().max(1) as f32;
        Ok((loss, mean))
    }

    /// What alpha's loss multiplies exp(log alpha) with: mean(-ln p) - target entropy, which is -A.
    pub(super) fn surplus(&self, mean_log_p: f32) -> f32 {
        self.sizes[1] as f32 - mean_log_p
    }

    /// One step of the critics, and every [`SacConfig::actor_every`]th time one of actor, alpha and targets.
    ///
    /// # Errors
    /// [`Error::Data`] when the batch does not fit, [`Error::NotFinite`] when a loss is not finite.
    pub fn update(&mut self, batch: &Batch, rng: &mut Rng) -> Result<SacReport> {
        let n = batch.len() * self.sizes[1];
        let noise = [normal(n, rng), normal(n, rng)];
        self.update_with(batch, &noise)
    }

    /// The same with noise that is given: of the targets' actions, and of the actor's.
    pub(super) fn update_with(
        &mut self,
        batch: &Batch,
        [of_targets, of_actor]: &[Vec<f32>; 2],
    ) -> Result<SacReport> {
        self.check(batch)?;
        let lr = self.config.lr;
        let targets = self.targets(batch, of_targets)?;
        let (loss, value) = self.critic_loss(batch, &targets)?;
        let critic_loss = self.finite(loss.to_scalar::<f32>()?)?;
        let grads = backward(&loss, &self.critics.params)?;
        self.critic_adam.step(&self.critics.params, &grads, lr)?;
        self.updates += 1;
        if self.updates.is_multiple_of(self.config.actor_every) {
            let (loss, log_p) = self.actor_loss(batch, of_actor)?;
            self.finite(loss.to_scalar::<f32>()?)?;
            let grads = backward(&loss, self.actor.params())?;
            self.actor_adam.step(self.actor.params(), &grads, lr)?;
            self.alpha.step(self.surplus(log_p), lr);
            self.targets.params.follow(&self.critics.params, self.config.tau)?;
        }
        let restarted = critic_loss > self.config.restart_above;
        if restarted {
            self.restart()?;
        }
        Ok(SacReport { critic_loss, value, alpha: self.alpha.value(), restarted })
    }

    fn finite(&self, loss: f32) -> Result<f32> {
        if loss.is_finite() {
            return Ok(loss);
        }
        Err(Error::NotFinite { step: self.updates, seed: self.seed, loss })
    }

    /// Fresh weights of actor, critics and targets; the optimisers' moments stay, as in the source.
    fn restart(&mut self) -> Result<()> {
        self.restarts += 1;
        let mut rng = stream(self.seed, &format!("{}/restart", self.purpose), 0, self.restarts as u64);
        network::orthogonal(self.actor.params(), &mut rng)?;
        network::orthogonal(&self.critics.params, &mut rng)?;
        self.targets.params.follow(&self.critics.params, 1.0)?;
        Ok(())
    }

    /// Adds all that [`Sac::load`] needs below `prefix`.
    ///
    /// # Errors
    /// When the device fails.
    pub fn state(&self, prefix: &str, all: &mut Weights) -> Result<()> {
        for (name, weights) in [
            ("actor.", self.actor.weights()?),
            ("actor_adam.", self.actor_adam.state()?),
            ("critics.", self.critics.params.export()?),
            ("critics_adam.", self.critic_adam.state()?),
            ("targets.", self.targets.params.export()?),
        ] {
            put(all, &format!("{prefix}{name}"), weights);
        }
        let counts =
            [self.updates, self.restarts].map(|n| [(n >> 20) as f32, (n & 0xf_ffff) as f32]).concat();
        all.insert(format!("{prefix}alpha"), self.alpha.state());
        all.insert(format!("{prefix}counts"), HostTensor { shape: vec![4], data: counts });
        Ok(())
    }

    /// Takes over what [`Sac::state`] added.
    ///
    /// # Errors
    /// When a tensor is missing or has another shape.
    pub fn load(&mut self, prefix: &str, all: &Weights) -> Result<()> {
        let of = |name: &str| part(all, &format!("{prefix}{name}."));
        self.actor.load(&of("actor"))?;
        self.actor_adam.load_state(&of("actor_adam"))?;
        self.critics.params.import(&of("critics"))?;
        self.critic_adam.load_state(&of("critics_adam"))?;
        self.targets.params.import(&of("targets"))?;
        let missing =
            |name: &str| Error::Data(format!("agent: expected `{prefix}{name}`, found none of its form"));
        let alpha = all.get(&format!("{prefix}alpha")).and_then(Alpha::from_state);
        self.alpha = alpha.ok_or_else(|| missing("alpha"))?;
        let counts = all.get(&format!("{prefix}counts")).map(|t| &t.data[..]);
        let Some([a, b, c, d]) = counts else { return Err(missing("counts")) };
        let count = |high: f32, low: f32| ((high as usize) << 20) + low as usize;
        (self.updates, self.restarts) = (count(*a, *b), count(*c, *d));
        Ok(())
    }

    /// The critics' parameters, for tests of gradients.
    #[cfg(test)]
    pub(super) fn critic_params(&self) -> &e2h_nn::Params {
        &self.critics.params
    }

    #[cfg(test)]
    pub(super) fn target_params(&self) -> &e2h_nn::Params {
        &self.targets.params
    }

    #[cfg(test)]
    pub(super) fn set_alpha(&mut self, alpha: f32) {
        self.alpha.log = alpha.ln();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(n: usize) -> Batch {
        let mut rng = stream(1, "batch", 0, 0);
        let mut b = Batch::default();
        for i in 0..n {
            let v = normal(8, &mut rng);
            let action: Vec<f32> = v[6..8].iter().map(|a| a.tanh()).collect();
            b.push(&v[..3], &action, v[0], &v[3..6], f32::from(u8::from(i % 3 > 0)));
        }
        b
    }

    fn agent(seed: u64) -> Sac {
        let config = SacConfig { hidden: vec![8, 8], ..SacConfig::default() };
        Sac::new(&config, 3, 2, &Compute::cpu(), seed, "test").unwrap()
    }

    #[test]
    fn a_saved_agent_goes_on_with_the_same_bytes() {
        let (mut whole, b) = (agent(3), batch(16));
        let step = |sac: &mut Sac, i: u64| sac.update(&b, &mut stream(0, "step", 0, i)).unwrap();
        for i in 0..7 {
            step(&mut whole, i);
        }
        let mut saved = Weights::new();
        whole.state("x.", &mut saved).unwrap();
        let mut other = agent(4);
        other.load("x.", &saved).unwrap();
        for i in 7..15 {
            assert_eq!(step(&mut whole, i), step(&mut other, i));
        }
        let all = |sac: &Sac| {
            let mut w = Weights::new();
            sac.state("", &mut w).unwrap();
            w
        };
        assert_eq!(all(&whole), all(&other));
        saved.remove("x.alpha");
        assert!(other.load("x.", &saved).unwrap_err().to_string().contains("alpha"));
    }

    #[test]
    fn a_loss_beyond_all_bounds_restarts_critics_and_actor() {
        let mut sac = agent(0);
        let mut b = batch(8);
        let before = sac.actor.weights().unwrap();
        b.reward.fill(1e3);
        b.bootstrap.fill(0.0);
        let report = sac.update(&b, &mut stream(0, "step", 0, 0)).unwrap();
        assert!(report.restarted && sac.restarts() == 1);
        assert_ne!(before, sac.actor.weights().unwrap());
        assert_eq!(sac.critics.params.export().unwrap(), sac.targets.params.export().unwrap());
        b.reward[3] = f32::NAN;
        assert!(matches!(sac.update(&b, &mut stream(0, "step", 0, 1)), Err(Error::NotFinite { .. })));
        b.action.pop();
        assert!(matches!(sac.update(&b, &mut stream(0, "step", 0, 2)), Err(Error::Data(_))));
    }

    #[test]
    fn the_weight_of_the_entropy_falls_while_there_is_more_than_wanted() {
        let mut alpha = Alpha { log: 0.1f32.ln(), mean: 0.0, square: 0.0, steps: 0 };
        alpha.step(2.0, 1e-2);
        assert!((alpha.value() - 0.1 * (-1e-2f32).exp()).abs() < 1e-6);
        let again = Alpha::from_state(&alpha.state()).unwrap();
        assert_eq!(again, alpha);
        alpha.step(-50.0, 1e-2);
        assert!(alpha.value() > again.value());
    }
}
