//! Layers of one input as Candle's modules, for its `seq` and for whatever takes a `Module`.

use super::{Conv1d, Conv2d, ConvTranspose1d, GroupNorm, Linear, MaxPool2d, Mish, Relu, SpatialSoftmax};
use crate::{Mlp, RgbEncoder};
use candle_core::{Module, Result, Tensor};
use rand_chacha::ChaCha8Rng;

macro_rules! modules {
    ($($layer:ty $(, $more:expr)*;)*) => {$(
        impl Module for $layer {
            fn forward(&self, x: &Tensor) -> Result<Tensor> {
                Ok(<$layer>::forward(self, x $(, $more)*)?)
            }
        }
    )*};
}

modules! {
    Conv1d;
    Conv2d;
    ConvTranspose1d;
    GroupNorm, None;
    Linear;
    MaxPool2d;
    Mish;
    Mlp, None::<&mut ChaCha8Rng>;
    Relu;
    RgbEncoder;
    SpatialSoftmax;
}
