//! Layers, channels last: `(B, L, C)` and `(N, H, W, C)`.

mod conv;
mod elementwise;
mod linear;
mod module;
mod norm;
mod pool;

pub use conv::{Conv1d, Conv2d, ConvTranspose1d};
pub use elementwise::{Film, Mish, Relu, dropout, repeat_rows, sinusoidal_embedding};
pub use linear::Linear;
pub use norm::{Act, GroupNorm};
pub use pool::{MaxPool2d, SpatialSoftmax};

pub(crate) use elementwise::{add, concat, masked, mish, relu};
pub(crate) use norm::Extra;
