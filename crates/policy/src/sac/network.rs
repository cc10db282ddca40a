//! The networks: plain ones with their optimiser, the actor, and the pair of critics.

use super::{SacConfig, gaussian};
use crate::{Error, Result};
use candle_core::Tensor;
use e2h_core::Rng;
use e2h_nn::{
    Act, Adam, AdamConfig, Builder, Compute, GroupNorm, HostTensor, Linear, Mlp, Mode, Params, Weights,
    no_grad,
};
use rand::Rng as _;

/// Adam as it is used here: no decay, nothing clipped.
pub(super) fn adam(lr: f32) -> AdamConfig {
    AdamConfig {
        lr,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-8,
        weight_decay: 0.0,
        decoupled: false,
        clip_norm: None,
    }
}

/// Rows of numbers as a tensor.
pub(super) fn matrix(data: &[f32], width: usize, compute: &Compute) -> Result<Tensor> {
    let rows = data.len() / width.max(1);
    Ok(Tensor::from_slice(&data[..rows * width], (rows, width), compute.device())?)
}

/// The numbers of a tensor.
pub(super) fn numbers(tensor: &Tensor) -> Result<Vec<f32>> {
    Ok(tensor.flatten_all()?.to_vec1()?)
}

/// Standard normal numbers.
pub(super) fn normal(n: usize, rng: &mut Rng) -> Vec<f32> {
    (0..n).map(|_| rng.sample::<f32, _>(rand_distr::StandardNormal)).collect()
}

/// Weights from orthogonal matrices, biases 0, gains 1: how every network here begins.
///
/// # Source
/// `torch.nn.init.orthogonal_` with gain 1; Saxe et al., "Exact solutions to the nonlinear dynamics of learning", section 3.
pub(super) fn orthogonal(params: &Params, rng: &mut Rng) -> Result<()> {
    let mut weights = params.export()?;
    for (name, tensor) in &mut weights {
        match tensor.shape[..] {
            [rows, columns] => tensor.data = orthonormal(rows, columns, rng),
            _ if name.ends_with("bias") => tensor.data.fill(0.0),
            _ => {}
        }
    }
    Ok(params.import(&weights)?)
}

/// A matrix whose rows, or columns where these are fewer, are orthonormal.
fn orthonormal(rows: usize, columns: usize, rng: &mut Rng) -> Vec<f32> {
    let (n, dim) = (rows.min(columns), rows.max(columns));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(n);
    while basis.len() < n {
        let mut v: Vec<f64> = (0..dim).map(|_| rng.sample::<f64, _>(rand_distr::StandardNormal)).collect();
        for b in &basis {
            let along: f64 = v.iter().zip(b).map(|(a, b)| a * b).sum();
            v.iter_mut().zip(b).for_each(|(v, b)| *v -= along * b);
        }
        let length = v.iter().map(|v| v * v).sum::<f64>().sqrt();
        // A draw that lies in what is there already has no direction of its own; the next one has.
        if length > 1e-6 {
            v.iter_mut().for_each(|v| *v /= length);
            basis.push(v);
        }
    }
    let entry = |r: usize, c: usize| if rows <= columns { basis[r][c] } else { basis[c][r] };
    (0..rows).flat_map(|r| (0..columns).map(move |c| (r, c))).map(|(r, c)| entry(r, c) as f32).collect()
}

/// The tensors below `prefix`, under their own names.
pub(super) fn part(weights: &Weights, prefix: &str) -> Weights {
    let own = |(name, t): (&String, &HostTensor)| Some((name.strip_prefix(prefix)?.to_owned(), t.clone()));
    weights.iter().filter_map(own).collect()
}

/// Adds tensors below `prefix`.
pub(super) fn put(all: &mut Weights, prefix: &str, weights: Weights) {
    all.extend(weights.into_iter().map(|(name, t)| (format!("{prefix}{name}"), t)));
}

/// A plain network that learns.
pub(super) struct Learner {
    pub(super) params: Params,
    pub(super) net: Mlp,
    pub(super) adam: Adam,
}

impl Learner {
    pub(super) fn new(
        input: usize,
        output: usize,
        c: &SacConfig,
        compute: &Compute,
        rng: &mut Rng,
    ) -> Result<Self> {
        let dims: Vec<usize> =
            std::iter::once(input).chain(c.hidden.iter().copied()).chain([output]).collect();
        let (params, net) = Params::build_on(compute, Mode::Train, rng, |b| Mlp::new(&dims, 0.0, b))?;
        orthogonal(&params, rng)?;
        Ok(Self { adam: Adam::new(&adam(c.lr), &params)?, params, net })
    }

    pub(super) fn forward(&self, x: &Tensor) -> Result<Tensor> {
        Ok(self.net.forward::<Rng>(x, None)?)
    }

    /// One step along the gradient of `loss`; a loss that is not finite changes nothing.
    pub(super) fn step(&mut self, loss: &Tensor) -> Result<f32> {
        let grads = e2h_nn::backward(loss, &self.params)?;
        let lr = self.adam.config().lr;
        self.adam.step(&self.params, &grads, lr)?;
        Ok(loss.to_scalar::<f32>()?)
    }

    pub(super) fn state(&self, prefix: &str, all: &mut Weights) -> Result<()> {
        put(all, &format!("{prefix}net."), self.params.export()?);
        put(all, &format!("{prefix}adam."), self.adam.state()?);
        Ok(())
    }

    pub(super) fn load(&mut self, prefix: &str, all: &Weights) -> Result<()> {
        self.params.import(&part(all, &format!("{prefix}net.")))?;
        Ok(self.adam.load_state(&part(all, &format!("{prefix}adam.")))?)
    }
}

/// What acts: from rows of observations to rows of actions in [-1, 1].
pub struct Actor {
    params: Params,
    net: Mlp,
    sizes: [usize; 2],
}

impl Actor {
    /// An actor from `observation` numbers to `action` numbers.
    ///
    /// # Errors
    /// When a size is zero or the device fails.
    pub fn new(
        observation: usize,
        action: usize,
        config: &SacConfig,
        mode: Mode,
        compute: &Compute,
        rng: &mut Rng,
    ) -> Result<Self> {
        let last = [2 * action];
        let dims: Vec<usize> =
            std::iter::once(observation).chain(config.hidden.iter().copied()).chain(last).collect();
        let (params, net) = Params::build_on(compute, mode, rng, |b| Mlp::new(&dims, 0.0, b))?;
        orthogonal(&params, rng)?;
        Ok(Self { params, net, sizes: [observation, action] })
    }

    /// Its weights by name.
    ///
    /// # Errors
    /// When the device fails.
    pub fn weights(&self) -> Result<Weights> {
        Ok(self.params.export()?)
    }

    /// Takes over weights.
    ///
    /// # Errors
    /// Lists every missing, unexpected and mis-shaped tensor.
    pub fn load(&self, weights: &Weights) -> Result<()> {
        Ok(self.params.import(weights)?)
    }

    pub(super) fn params(&self) -> &Params {
        &self.params
    }

    /// Actions for rows of observations: drawn with `rng`, or the most likely ones without.
    ///
    /// # Shapes
    /// (B, observation) to (B, action), both flat.
    ///
    /// # Errors
    /// [`Error::Observation`] when the numbers are no whole rows.
    pub fn act(&self, observations: &[f32], rng: Option<&mut Rng>) -> Result<Vec<f32>> {
        let [o, a] = self.sizes;
        if observations.is_empty() || !observations.len().is_multiple_of(o) {
            return Err(Error::Observation {
                quantity: "numbers".to_owned(),
                expected: format!("rows of {o}"),
                found: observations.len().to_string(),
            });
        }
        let x = matrix(observations, o, self.params.compute())?;
        let raw = no_grad(|| self.net.forward::<Rng>(&x, None))?;
        match rng {
            None => Ok(gaussian::mean(&numbers(&raw)?, a)),
            Some(rng) => {
                let noise = normal(observations.len() / o * a, rng);
                let drawn = no_grad(|| gaussian::squashed(&raw, &noise))?;
                numbers(&drawn.narrow(1, 0, a)?.contiguous()?)
            }
        }
    }

    /// Actions and their log probabilities, which follow the weights: (B, A) and (B, 1).
    pub(super) fn draw(&self, observations: &Tensor, noise: &[f32]) -> Result<(Tensor, Tensor)> {
        let raw = self.net.forward::<Rng>(observations, None)?;
        let both = gaussian::squashed(&raw, noise)?;
        let a = self.sizes[1];
        Ok((both.narrow(1, 0, a)?.contiguous()?, both.narrow(1, a, 1)?.contiguous()?))
    }
}

/// One critic: linear layers with ReLU between them, and a layer norm before each ReLU where it is asked for.
struct Critic {
    linears: Vec<Linear>,
    norms: Vec<GroupNorm>,
}

impl Critic {
    fn new(dims: &[usize], norm: bool, builder: &Builder<'_>) -> e2h_nn::Result<Self> {
        let (mut linears, mut norms) = (vec![], vec![]);
        for (i, d) in dims.windows(2).enumerate() {
            linears.push(Linear::new(d[0], d[1], &builder.pp(i))?);
            if norm && i + 2 < dims.len() {
                // One group over the channels of a row is a layer norm.
                norms.push(GroupNorm::new(1, d[1], Act::Relu, &builder.pp(format!("{i}.norm")))?);
            }
        }
        Ok(Self { linears, norms })
    }

    fn forward(&self, x: &Tensor) -> e2h_nn::Result<Tensor> {
        let mut x = x.clone();
        for (i, linear) in self.linears.iter().enumerate() {
            x = linear.forward(&x)?;
            if i + 1 < self.linears.len() {
                x = match self.norms.get(i) {
                    Some(norm) => norm.forward(&x, None)?,
                    None => e2h_nn::Relu.forward(&x)?,
                };
            }
        }
        Ok(x)
    }
}

/// Two critics of observation and action, of which the lower value counts.
pub(super) struct Twin {
    pub(super) params: Params,
    critics: [Critic; 2],
}

impl Twin {
    pub(super) fn new(
        sizes: [usize; 2],
        c: &SacConfig,
        mode: Mode,
        compute: &Compute,
        rng: &mut Rng,
    ) -> Result<Self> {
        let input = [sizes[0] + sizes[1]];
        let dims: Vec<usize> = input.into_iter().chain(c.hidden.iter().copied()).chain([1]).collect();
        let (params, critics) = Params::build_on(compute, mode, rng, |b| {
            Ok([
                Critic::new(&dims, c.layer_norm, &b.pp("q1"))?,
                Critic::new(&dims, c.layer_norm, &b.pp("q2"))?,
            ])
        })?;
        orthogonal(&params, rng)?;
        Ok(Self { params, critics })
    }

    /// Both values, (B, 1) each.
    pub(super) fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<[Tensor; 2]> {
        let x = Tensor::cat(&[observations, actions], 1)?;
        Ok([self.critics[0].forward(&x)?, self.critics[1].forward(&x)?])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_begin_orthonormal_whatever_their_form() {
        let mut rng = e2h_core::stream(0, "orthonormal", 0, 0);
        for (rows, columns) in [(3, 7), (7, 3), (5, 5), (1, 4)] {
            let m = orthonormal(rows, columns, &mut rng);
            let (n, dim) = (rows.min(columns), rows.max(columns));
            let at =
                |v: usize, i: usize| if rows <= columns { m[v * columns + i] } else { m[i * columns + v] };
            for a in 0..n {
                for b in 0..n {
                    let dot: f32 = (0..dim).map(|i| at(a, i) * at(b, i)).sum();
                    assert!(
                        (dot - f32::from(u8::from(a == b))).abs() < 1e-5,
                        "{rows} {columns}: {a} {b} {dot}"
                    );
                }
            }
        }
    }

    #[test]
    fn an_actor_without_chance_takes_the_mean_and_refuses_parts_of_rows() {
        let mut rng = e2h_core::stream(0, "actor", 0, 0);
        let config = SacConfig { hidden: vec![8], ..SacConfig::default() };
        let actor = Actor::new(3, 2, &config, Mode::Infer, &Compute::cpu(), &mut rng).unwrap();
        let one = actor.act(&[0.1, 0.2, 0.3], None).unwrap();
        let two = actor.act(&[0.1, 0.2, 0.3, 0.5, 0.5, 0.5], None).unwrap();
        assert_eq!(one, two[..2]);
        assert_ne!(one, actor.act(&[0.1, 0.2, 0.3], Some(&mut rng)).unwrap());
        assert!(actor.act(&[0.1, 0.2], None).unwrap_err().to_string().contains("rows of 3"));
    }
}
