//! Networks that learn on the CPU: layers on Candle tensors with kernels of their own, optimisers, weight files. With
//! feature `cuda` they run on a GPU too, see [`Compute`].
//!
//! Several of Candle's gradients are wrong without an error, and its graph allocates for every gradient that flows. Here a
//! network's forward pass is one node of Candle's graph with a backward pass of its own, over channels-last buffers and
//! products whose tiles live in registers (AVX-512, AVX2 or plain, chosen at run time). Parameters keep the names and, in files, the layouts of PyTorch.
//!
//! It is open: layers of candle-nn and layers of your own become parts of a network ([`Builder::var_builder`]), which trains as one
//! ([`backward`], [`Adam`]); [`with_gradient`] gives a layer an exact backward pass; weights go to and come from candle-nn's stores
//! ([`Params::export_to`], [`Params::import_from`]), and its models come under our optimiser ([`Params::from_var_map`]).
//!
//! The same seed gives the same bytes in any number of threads. Deliberately knows nothing of robots, data or diffusion
//! schedules.
//!
//! ```
//! use candle_core::{Device, Tensor};
//! use e2h_nn::{Adam, AdamConfig, Mlp, Mode, Params, backward, candle_nn, mse};
//! use e2h_nn::rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
//!
//! let mut rng = ChaCha8Rng::seed_from_u64(0);
//! let (params, net) = Params::build(Mode::Train, &mut rng, |b| Mlp::new(&[2, 16, 1], 0.0, b))?;
//! let x = Tensor::new(&[[0f32, 0.], [0., 1.], [1., 0.], [1., 1.]], &Device::Cpu)?;
//! let y = Tensor::new(&[[0f32], [1.], [1.], [0.]], &Device::Cpu)?;
//! let mut adam = Adam::new(&AdamConfig::default(), &params)?;
//! let mut loss = f32::MAX;
//! for _ in 0..1000 {
//!     let l = mse(&net.forward(&x, None::<&mut ChaCha8Rng>)?, &y, None)?;
//!     adam.step(&params, &backward(&l, &params)?, 1e-2)?;
//!     loss = l.to_scalar()?;
//! }
//! assert!(loss < 1e-3);
//!
//! // The same with layers of candle-nn around one of ours.
//! use e2h_nn::candle_core::Module;
//! let (params, net) = Params::build(Mode::Train, &mut rng, |b| {
//!     let theirs = b.var_builder();
//!     let net = candle_nn::seq().add(candle_nn::linear(2, 16, theirs.pp("first"))?).add(e2h_nn::Mish);
//!     Ok(net.add(candle_nn::linear(16, 1, theirs.pp("last"))?))
//! })?;
//! let grads = backward(&mse(&net.forward(&x)?, &y, None)?, &params)?;
//! assert_eq!(grads.export(&params)?["first.weight"].shape, [16, 2]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod builder;
mod compute;
mod error;
#[cfg(feature = "cuda")]
mod gpu;
mod grad;
mod graph;
mod kernel;
mod layers;
mod loss;
mod memory;
mod mlp;
mod numbers;
mod optim;
mod params;
mod rgb;
mod storage;
mod tape;
mod unet;
mod vars;
mod weights;

/// The tensors, the variables and the random numbers of this crate's interface.
pub use {candle_core, candle_nn, rand_chacha};

pub use builder::{Builder, Mode};
pub use compute::{Compute, Precision, candle_operations};
pub use error::{Error, Result};
pub use grad::{Grads, backward, backward_many, no_grad};
pub use graph::{Given, Gradients, with_gradient};
pub use kernel::vector_unit;
pub use layers::{
    Act, Conv1d, Conv2d, ConvTranspose1d, Film, GroupNorm, Linear, MaxPool2d, Mish, Relu, SpatialSoftmax,
    dropout, repeat_rows, sinusoidal_embedding,
};
pub use loss::{mse, mse_part};
pub use memory::tune_allocator;
pub use mlp::Mlp;
pub use optim::{Adam, AdamConfig, Ema, EmaConfig, LrSchedule, learning_rate};
pub use params::Params;
pub use rgb::{RgbEncoder, RgbEncoderConfig};
pub use unet::{ConditionalUnet1d, UnetConfig};
pub use weights::{HostTensor, Weights, load_weights, load_weights_without, parse_weights, save_weights};
