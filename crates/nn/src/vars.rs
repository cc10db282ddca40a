//! Parameters that are shared with candle-nn: its layers in our networks, its models under our optimiser, weights both ways.

use crate::builder::{Builder, Init};
use crate::params::Params;
use crate::storage::host;
use crate::weights::{HostTensor, Weights};
use crate::{Error, Result};
use candle_core::{DType, Device, Shape, Tensor, Var};
use candle_nn::init::NormalOrUniform;
use candle_nn::var_builder::SimpleBackend;
use candle_nn::{VarBuilder, VarMap};
use std::sync::PoisonError;

struct Vars<'a>(Builder<'a>);

impl SimpleBackend for Vars<'_> {
    fn get(
        &self,
        shape: Shape,
        name: &str,
        init: candle_nn::Init,
        dtype: DType,
        device: &Device,
    ) -> candle_core::Result<Tensor> {
        if dtype != DType::F32 || !device.same_device(self.0.device()) {
            let found = format!("`{name}` of {dtype:?} on {:?}", device.location());
            let expected = "f32 on the device of the network";
            return Err(Error::Config { what: "variable", expected, found }.into());
        }
        Ok(self.0.tensor(name, shape.dims(), start(init, &shape))?)
    }

    fn get_unchecked(&self, name: &str, _: DType, _: &Device) -> candle_core::Result<Tensor> {
        let (what, expected) = ("variable", "a shape, through `get`");
        Err(Error::Config { what, expected, found: format!("`{name}` without") }.into())
    }

    fn contains_tensor(&self, name: &str) -> bool {
        self.0.has(name)
    }
}

/// Candle's distribution, for our own random numbers: Candle's cannot be seeded on the CPU.
fn start(init: candle_nn::Init, shape: &Shape) -> Init {
    match init {
        candle_nn::Init::Const(c) => Init::Constant(c as f32),
        candle_nn::Init::Uniform { lo, up } => {
            Init::Uniform { mid: (0.5 * (lo + up)) as f32, half: (0.5 * (up - lo)) as f32 }
        }
        candle_nn::Init::Randn { mean, stdev } => Init::Normal { mean: mean as f32, deviation: stdev as f32 },
        candle_nn::Init::Kaiming { dist, fan, non_linearity } => {
            let deviation = non_linearity.gain() / (fan.for_shape(shape).max(1) as f64).sqrt();
            match dist {
                NormalOrUniform::Uniform => Init::within((3f64.sqrt() * deviation) as f32),
                NormalOrUniform::Normal => Init::Normal { mean: 0.0, deviation: deviation as f32 },
            }
        }
    }
}

impl<'a> Builder<'a> {
    /// The builder for layers of candle-nn and for layers of your own: what they ask for becomes a parameter below this path,
    /// with its name and shape, and the same seed gives the same numbers. A name that was asked for before gives the same
    /// variable.
    ///
    /// Gradients of candle-nn's layers are Candle's, which are silently wrong for `Conv1d` with more than one sample, for
    /// `Linear` on transposed inputs, for max pooling and for `upsample_nearest` beside another reader (0.11.1). A layer that
    /// copies what it gets, as `BatchNorm` does in [`crate::Mode::Infer`], does not see a later [`Params::import`].
    ///
    /// ```
    /// use e2h_nn::candle_core::{Device, Module, Tensor};
    /// use e2h_nn::rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
    /// use e2h_nn::{Linear, Mode, Params, Relu, candle_nn};
    ///
    /// let mut rng = ChaCha8Rng::seed_from_u64(0);
    /// let (params, net) = Params::build(Mode::Train, &mut rng, |b| {
    ///     let net = candle_nn::seq().add(candle_nn::linear(3, 8, b.pp("theirs").var_builder())?).add(Relu);
    ///     Ok(net.add(Linear::new(8, 1, &b.pp("ours"))?))
    /// })?;
    /// assert_eq!(params.names().collect::<Vec<_>>(), ["ours.bias", "ours.weight", "theirs.bias", "theirs.weight"]);
    /// assert_eq!(net.forward(&Tensor::new(&[[1f32, 2., 3.]], &Device::Cpu)?)?.dims(), [1, 1]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub fn var_builder(&self) -> VarBuilder<'a> {
        VarBuilder::from_backend(Box::new(Vars(self.clone())), DType::F32, self.device().clone())
    }
}

impl Params {
    /// The variables of a candle-nn model, for [`crate::backward`], [`crate::Adam`], [`crate::Ema`] and weight files: the
    /// variables themselves, not copies, as many as `map` holds now.
    ///
    /// # Errors
    /// [`Error::Config`] unless they are of `f32` and on one device.
    pub fn from_var_map(map: &VarMap) -> Result<Self> {
        let vars = map.data().lock().unwrap_or_else(PoisonError::into_inner);
        Self::of_vars(vars.iter().map(|(n, v)| (n.clone(), v.clone())).collect())
    }

    /// Copies all parameters into `map`, by the same names and in PyTorch's layout: into its variables where it has them,
    /// else into new ones on the same device. Others of its variables stay as they are.
    ///
    /// # Errors
    /// [`Error::Import`] lists the variables of `map` that have another shape; it is then as before. [`Error::Candle`] when a
    /// device fails.
    pub fn export_to(&self, map: &VarMap) -> Result<()> {
        let mut vars = map.data().lock().unwrap_or_else(PoisonError::into_inner);
        let other = |(name, shape): (&String, &Vec<usize>)| {
            let found = vars.get(name).filter(|v| v.dims() != shape)?;
            Some(format!("{name}: expected {shape:?}, found {:?}", found.dims()))
        };
        let misshaped: Vec<String> = self.shapes().filter_map(other).collect();
        if !misshaped.is_empty() {
            return Err(Error::Import { missing: vec![], unexpected: vec![], misshaped });
        }
        for (name, HostTensor { shape, data }) in self.export()? {
            match vars.get(&name) {
                Some(var) => {
                    var.set(&Tensor::from_vec(data, shape, var.device())?.to_dtype(var.dtype())?)?;
                }
                None => {
                    vars.insert(name, Var::from_vec(data, shape, self.compute().device())?);
                }
            }
        }
        Ok(())
    }

    /// Takes over the variables of the same names, in PyTorch's layout, that `vars` holds below its path; all or nothing.
    ///
    /// # Errors
    /// [`Error::Import`] lists every missing and mis-shaped variable; a `VarBuilder` cannot say which others it holds.
    pub fn import_from(&self, vars: &VarBuilder<'_>) -> Result<()> {
        let (mut missing, mut misshaped, mut weights) = (vec![], vec![], Weights::new());
        for (name, shape) in self.shapes() {
            if !vars.contains_tensor(name) {
                missing.push(name.clone());
                continue;
            }
            match vars.get(&shape[..], name).and_then(|t| t.to_dtype(DType::F32)) {
                Ok(t) => {
                    weights.insert(name.clone(), HostTensor { shape: shape.clone(), data: host(&t)? });
                }
                Err(e) => {
                    let why = e.to_string().lines().next().unwrap_or_default().to_owned();
                    misshaped.push(format!("{name}: expected {shape:?}, found {why}"));
                }
            }
        }
        if !missing.is_empty() || !misshaped.is_empty() {
            return Err(Error::Import { missing, unexpected: vec![], misshaped });
        }
        self.import(&weights)
    }
}
