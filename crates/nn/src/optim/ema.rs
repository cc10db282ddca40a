use crate::compute::Backend;
use crate::graph;
use crate::kernel::optim;
use crate::numbers::{Numbers, elsewhere};
use crate::params::Params;
use crate::storage::with;
use crate::weights::{HostTensor, Weights};
use crate::{Error, Result};

/// Settings of [`Ema`].
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EmaConfig {
    /// Exponent of the warm-up; larger forgets the first weights later.
    pub power: f32,
    /// Largest decay.
    pub max: f32,
}

impl Default for EmaConfig {
    fn default() -> Self {
        Self { power: 0.75, max: 0.9999 }
    }
}

impl EmaConfig {
    /// # Errors
    /// [`Error::Config`] names the first setting that does not work.
    pub fn validate(&self) -> Result<()> {
        let fail =
            |what, expected, found: f32| Err(Error::Config { what, expected, found: found.to_string() });
        if !(self.power > 0.0 && self.power <= 100.0) {
            return fail("power", "more than 0 and at most 100", self.power);
        }
        // At 1 the average would stay where it began.
        if !(0.0..1.0).contains(&self.max) {
            return fail("max", "a number in [0, 1)", self.max);
        }
        Ok(())
    }

    /// The share of the old average that update number `step` (from 0) keeps: 1 - (1 + step)^-power, between 0 and `max`.
    ///
    /// # Source
    /// `EMAModel.get_decay` of Diffusion Policy, also `diffusers.training_utils`, with `inv_gamma` 1.
    #[must_use]
    pub fn decay(&self, step: u64) -> f64 {
        (1.0 - (1.0 + step as f64).powf(-f64::from(self.power))).min(f64::from(self.max)).max(0.0)
    }
}

/// An average of the weights over training, which acts better than the last ones.
#[derive(Clone, Debug)]
pub struct Ema {
    config: EmaConfig,
    params: Params,
    average: Vec<Numbers>,
    updates: u64,
    /// A GPU changes `average` in place: clones part before.
    #[cfg(feature = "cuda")]
    shared: std::sync::Arc<()>,
}

/// Updates are stored as two numbers that `f32` holds exactly.
const UPDATE_BASE: u64 = 1 << 20;

impl Ema {
    /// An average that starts at the present weights.
    ///
    /// # Errors
    /// [`Error::Config`] when a setting does not work; [`Error::Candle`] when a variable cannot be read.
    pub fn new(config: &EmaConfig, params: &Params) -> Result<Self> {
        config.validate()?;
        let average: Result<_> = params.variables().map(|v| Numbers::copy(v, params.backend())).collect();
        Ok(Self {
            config: *config,
            params: params.clone(),
            average: average?,
            updates: 0,
            #[cfg(feature = "cuda")]
            shared: std::sync::Arc::default(),
        })
    }

    /// Makes sure that no clone sees what is changed in place.
    #[cfg(feature = "cuda")]
    fn own(&mut self) -> Result<()> {
        if std::sync::Arc::strong_count(&self.shared) > 1 {
            self.average = self.average.iter().map(Numbers::apart).collect::<Result<_>>()?;
            self.shared = std::sync::Arc::default();
        }
        Ok(())
    }

    /// Moves the average towards the present weights; the first update takes them over.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when `params` are of another network.
    pub fn update(&mut self, params: &Params) -> Result<()> {
        let same = params.len() == self.average.len()
            && params.variables().zip(&self.average).all(|(v, a)| v.elem_count() == a.len());
        if !same {
            let (expected, found) = (params.len(), self.average.len());
            return Err(Error::OtherParams { what: "moving average", expected, found });
        }
        let part = (1.0 - self.config.decay(self.updates)) as f32;
        #[cfg(feature = "cuda")]
        if params.backend() == Backend::Gpu {
            self.own()?;
            let mut rows = Vec::with_capacity(self.average.len());
            let now: Vec<_> = params.variables().map(|v| v.as_detached_tensor()).collect();
            for (p, a) in now.iter().zip(&self.average) {
                let Numbers::Device(a) = a else { return Err(elsewhere("moving average", params.len())) };
                rows.push([a, p]);
            }
            if let Some([first, _]) = rows.first() {
                crate::gpu::Gpu::of(first)?.blend(&rows, part)?;
            }
            self.updates += 1;
            return Ok(());
        }
        for (var, a) in params.variables().zip(&mut self.average) {
            match a {
                Numbers::Host(a) if params.backend() == Backend::Kernels => with(var.as_tensor(), |p| {
                    if part < 1.0 { optim::blend(a, p, part) } else { a.copy_from_slice(p) }
                })?,
                Numbers::Device(a) if params.backend() == Backend::Candle && part < 1.0 => {
                    *a = graph::optim::blend(a, &var.as_detached_tensor(), part)?;
                }
                a @ Numbers::Device(_) if params.backend() == Backend::Candle => {
                    *a = Numbers::copy(var, Backend::Candle)?;
                }
                _ => return Err(elsewhere("moving average", params.len())),
            }
        }
        self.updates += 1;
        Ok(())
    }

    /// The averaged weights in PyTorch's layout.
    ///
    /// # Errors
    /// [`Error::Candle`] when a device fails; none on the CPU.
    pub fn weights(&self) -> Result<Weights> {
        self.params.all_outward(&self.average)
    }

    /// How many updates were made.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// The averages as `average.<name>` in PyTorch's layout, and `updates`.
    ///
    /// # Errors
    /// As [`Ema::weights`].
    pub fn state(&self) -> Result<Weights> {
        let mut out: Weights =
            self.weights()?.into_iter().map(|(n, t)| (format!("average.{n}"), t)).collect();
        let data = vec![(self.updates / UPDATE_BASE) as f32, (self.updates % UPDATE_BASE) as f32];
        out.insert("updates".into(), HostTensor { shape: vec![2], data });
        Ok(out)
    }

    /// Takes over a [`Ema::state`], all or nothing.
    ///
    /// # Errors
    /// [`Error::Import`] when names or shapes differ.
    pub fn load_state(&mut self, state: &Weights) -> Result<()> {
        let (mut average, mut updates, mut unexpected) = (Weights::new(), None, Vec::new());
        for (name, t) in state {
            if let Some(n) = name.strip_prefix("average.") {
                average.insert(n.into(), t.clone());
            } else if let ("updates", [high, low]) = (name.as_str(), &t.data[..]) {
                updates = Some(*high as u64 * UPDATE_BASE + *low as u64);
            } else {
                unexpected.push(name.clone());
            }
        }
        let missing = if updates.is_none() { vec!["updates".to_owned()] } else { Vec::new() };
        if !unexpected.is_empty() || !missing.is_empty() {
            return Err(Error::Import { missing, unexpected, misshaped: Vec::new() });
        }
        self.average = self.params.all_inward(&average)?;
        self.updates = updates.unwrap_or_default();
        Ok(())
    }
}
