use crate::grad::Grads;
use crate::graph;
use crate::kernel::optim;
use crate::numbers::{Numbers, elsewhere};
use crate::params::Params;
use crate::storage::edit;
use crate::weights::{HostTensor, Weights};
use crate::{Error, Result};

/// Settings of [`Adam`].
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamConfig {
    /// Learning rate, for callers without a schedule. Diffusion Policy: 1e-4.
    pub lr: f32,
    /// Decay of the mean of the gradients.
    pub beta1: f32,
    /// Decay of the mean of their squares.
    pub beta2: f32,
    /// Added to the root of the mean square.
    pub eps: f32,
    /// Weight decay.
    pub weight_decay: f32,
    /// Whether the decay acts on the weights (AdamW) or is added to the gradient (Adam with L2).
    pub decoupled: bool,
    /// Longest gradient, Euclidean norm over all parameters.
    pub clip_norm: Option<f32>,
}

impl Default for AdamConfig {
    /// Adam as LeRobot trains Diffusion Policy: betas 0.95 and 0.999, decay 1e-6, norm clipped at 10.
    fn default() -> Self {
        Self {
            lr: 1e-4,
            beta1: 0.95,
            beta2: 0.999,
            eps: 1e-8,
            weight_decay: 1e-6,
            decoupled: false,
            clip_norm: Some(10.0),
        }
    }
}

impl AdamConfig {
    /// Largest weight decay that is taken for one.
    const MOST_DECAY: f32 = 10.0;

    /// # Errors
    /// [`Error::Config`] names the first setting that does not work.
    pub fn validate(&self) -> Result<()> {
        let fail =
            |what, expected, found: f32| Err(Error::Config { what, expected, found: found.to_string() });
        if !(self.lr > 0.0 && self.lr.is_finite()) {
            return fail("lr", "a finite number more than 0", self.lr);
        }
        for (what, beta) in [("beta1", self.beta1), ("beta2", self.beta2)] {
            if !(0.0..1.0).contains(&beta) {
                return fail(what, "a number in [0, 1)", beta);
            }
        }
        // At 0 a weight whose gradient has always been 0 would change by 0 / 0.
        if !(self.eps > 0.0 && self.eps <= 1.0) {
            return fail("eps", "more than 0 and at most 1", self.eps);
        }
        if !(0.0..=Self::MOST_DECAY).contains(&self.weight_decay) {
            return fail("weight_decay", "a number from 0 to 10", self.weight_decay);
        }
        if let Some(max) = self.clip_norm.filter(|c| !(*c > 0.0 && *c <= 1e9)) {
            return fail("clip_norm", "more than 0 and at most 1e9", max);
        }
        Ok(())
    }
}

/// Adam or AdamW, in one pass over the memory.
///
/// # Source
/// Kingma and Ba, "Adam", algorithm 1; Loshchilov and Hutter, "Decoupled Weight Decay Regularization", algorithm 2; in the
/// form of `torch.optim.Adam`, `torch.optim.AdamW` and `torch.nn.utils.clip_grad_norm_` of torch 2.7.1.
#[derive(Clone, Debug)]
pub struct Adam {
    config: AdamConfig,
    params: Params,
    mean: Vec<Numbers>,
    square: Vec<Numbers>,
    steps: u64,
    /// A GPU changes the moments in place: clones part before.
    #[cfg(feature = "cuda")]
    shared: std::sync::Arc<()>,
}

/// Steps are stored as two numbers that `f32` holds exactly: thousands of 2^20, and the rest.
const STEP_BASE: u64 = 1 << 20;

impl Adam {
    /// An optimiser of `params` that has made no step.
    ///
    /// # Errors
    /// [`Error::Config`] names the first setting that does not work; [`Error::Candle`] when a device fails.
    pub fn new(config: &AdamConfig, params: &Params) -> Result<Self> {
        config.validate()?;
        let zeros = || -> Result<Vec<Numbers>> {
            params.variables().map(|v| Numbers::zeros(v, params.backend())).collect()
        };
        Ok(Self {
            config: *config,
            params: params.clone(),
            mean: zeros()?,
            square: zeros()?,
            steps: 0,
            #[cfg(feature = "cuda")]
            shared: std::sync::Arc::default(),
        })
    }

    /// The numbers of step number `steps`, with gradients multiplied by `clip`.
    fn numbers(&self, steps: u64, lr: f32, clip: f32) -> optim::Adam {
        let c = &self.config;
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(steps as f64);
        optim::Adam {
            rate: (f64::from(lr) / correction(c.beta1)) as f32,
            beta1: c.beta1,
            beta2: c.beta2,
            eps: c.eps,
            root: (1.0 / correction(c.beta2).sqrt()) as f32,
            clip,
            decay: if c.decoupled { 0.0 } else { c.weight_decay },
            keep: if c.decoupled { 1.0 - lr * c.weight_decay } else { 1.0 },
        }
    }

    /// [`Adam::step`] on a GPU: norm, clipping and step follow each other there, and the norm is waited for at the end.
    #[cfg(feature = "cuda")]
    fn device_step(&mut self, params: &Params, grads: &Grads, lr: f32) -> Result<f32> {
        let Some(norm) = grads.device_norm()? else { return Ok(0.0) };
        if std::sync::Arc::strong_count(&self.shared) > 1 {
            let apart = |list: &[Numbers]| list.iter().map(Numbers::apart).collect::<Result<Vec<_>>>();
            (self.mean, self.square) = (apart(&self.mean)?, apart(&self.square)?);
            self.shared = std::sync::Arc::default();
        }
        let now: Vec<_> = params.variables().map(|v| v.as_detached_tensor()).collect();
        let mut rows = Vec::with_capacity(now.len());
        for ((p, g), (m, v)) in now.iter().zip(&grads.list).zip(self.mean.iter().zip(&self.square)) {
            match (g, m, v) {
                (None, _, _) => {}
                (Some(Numbers::Device(g)), Numbers::Device(m), Numbers::Device(v)) => rows.push([p, g, m, v]),
                _ => return Err(elsewhere("gradients", params.len())),
            }
        }
        let numbers = self.numbers(self.steps + 1, lr, 1.0);
        crate::gpu::Gpu::of(&norm)?.adam(&rows, &norm, &numbers, self.config.clip_norm)?;
        let norm = norm.to_scalar::<f32>()?;
        // The device has left everything as it was otherwise.
        self.steps += u64::from(norm.is_finite());
        Ok(norm)
    }

    /// How many steps were made.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// The settings.
    #[must_use]
    pub fn config(&self) -> &AdamConfig {
        &self.config
    }

    /// Moves the parameters along `grads` at the learning rate `lr`. Returns the norm of the gradient before clipping.
    /// Parameters that the loss does not depend on stay as they are, as in PyTorch.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when `params` or `grads` are of another network. A norm that is not finite is returned
    /// and nothing changes: the caller knows the step and the seed to name.
    pub fn step(&mut self, params: &Params, grads: &Grads, lr: f32) -> Result<f32> {
        grads.check(params)?;
        self.check(params)?;
        #[cfg(feature = "cuda")]
        if params.backend() == crate::compute::Backend::Gpu {
            return self.device_step(params, grads, lr);
        }
        let norm = grads.norm()?;
        if !norm.is_finite() {
            return Ok(norm);
        }
        self.steps += 1;
        let clip = self.config.clip_norm.map_or(1.0, |max| (max / (norm + 1e-6)).min(1.0));
        let step = self.numbers(self.steps, lr, clip);
        let moments = self.mean.iter_mut().zip(&mut self.square);
        for ((var, g), (m, v)) in params.variables().zip(&grads.list).zip(moments) {
            match (g, m, v) {
                (None, _, _) => {}
                (Some(Numbers::Host(g)), Numbers::Host(m), Numbers::Host(v)) => {
                    edit(var, |p| optim::adam(p, g, m, v, step))?;
                }
                (Some(Numbers::Device(g)), Numbers::Device(m), Numbers::Device(v)) => {
                    graph::optim::adam(var, g, m, v, step)?;
                }
                _ => return Err(elsewhere("gradients", params.len())),
            }
        }
        Ok(norm)
    }

    /// Moments as `mean.<name>` and `square.<name>` in PyTorch's layout, and `steps`.
    ///
    /// # Errors
    /// [`Error::Candle`] when a device fails; none on the CPU.
    pub fn state(&self) -> Result<Weights> {
        let mut out = Weights::new();
        for (prefix, list) in [("mean", &self.mean), ("square", &self.square)] {
            let named = self.params.all_outward(list)?.into_iter();
            out.extend(named.map(|(n, t)| (format!("{prefix}.{n}"), t)));
        }
        let data = vec![(self.steps / STEP_BASE) as f32, (self.steps % STEP_BASE) as f32];
        out.insert("steps".into(), HostTensor { shape: vec![2], data });
        Ok(out)
    }

    /// Takes over a [`Adam::state`], all or nothing.
    ///
    /// # Errors
    /// [`Error::Import`] when names or shapes differ.
    pub fn load_state(&mut self, state: &Weights) -> Result<()> {
        let (mut mean, mut square, mut steps) = (Weights::new(), Weights::new(), None);
        let mut unexpected = Vec::new();
        for (name, t) in state {
            if let Some(n) = name.strip_prefix("mean.") {
                mean.insert(n.into(), t.clone());
            } else if let Some(n) = name.strip_prefix("square.") {
                square.insert(n.into(), t.clone());
            } else if let ("steps", [high, low]) = (name.as_str(), &t.data[..]) {
                steps = Some(*high as u64 * STEP_BASE + *low as u64);
            } else {
                unexpected.push(name.clone());
            }
        }
        let missing = if steps.is_none() { vec!["steps".to_owned()] } else { Vec::new() };
        if !unexpected.is_empty() || !missing.is_empty() {
            return Err(Error::Import { missing, unexpected, misshaped: Vec::new() });
        }
        let (mean, square) = (self.params.all_inward(&mean)?, self.params.all_inward(&square)?);
        (self.mean, self.square, self.steps) = (mean, square, steps.unwrap_or_default());
        Ok(())
    }

    fn check(&self, params: &Params) -> Result<()> {
        let same = params.len() == self.mean.len()
            && params.variables().zip(&self.mean).all(|(v, m)| v.elem_count() == m.len());
        if same {
            return Ok(());
        }
        Err(Error::OtherParams { what: "optimiser", expected: params.len(), found: self.mean.len() })
    }
}
