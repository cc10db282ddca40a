//! Candle layers that train on the CPU, their kernels, optimisers and weight files
