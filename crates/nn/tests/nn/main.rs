//! Tests of the layers, the optimisers and the files.

mod files;
mod golden;
mod gradients;
mod optim;
mod support;
mod threads;
