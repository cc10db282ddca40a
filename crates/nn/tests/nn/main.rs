//! Tests of the layers, the optimisers and the files.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod candle;
mod convolutions;
mod examples;
mod files;
mod golden;
mod gradients;
mod optim;
mod support;
mod threads;
