//! Normal actions through a tanh, with their log probability.

use candle_core::Tensor;
use e2h_nn::with_gradient;
use std::f32::consts::LN_2;

/// Half of ln(2 pi).
const HALF_LN_TAU: f32 = 0.918_938_5;
/// Lowest logarithm of a deviation, and half the range above it.
const LOG_DEVIATION: (f32, f32) = (-10.0, 6.0);

/// Logarithm of the deviation that an output `r` of the network says, and its derivative.
fn log_deviation(r: f32) -> (f32, f32) {
    let (lowest, half) = LOG_DEVIATION;
    let t = r.tanh();
    (lowest + half * (1.0 + t), half * (1.0 - t * t))
}

/// ln(1 + e^x) without overflow.
fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// Actions a = tanh(mean + deviation noise), and ln p(a).
///
/// # Shapes
/// `raw` (B, 2A): means, then what the deviations follow from; `noise` (B A), standard normal. The result is (B, A + 1): actions, and the
/// logarithm of their probability density at the end.
///
/// # Source
/// `jyp9961/TR-DRL e56d60e robosuite/sac_agentenv.py`; Haarnoja et al., "Soft Actor-Critic", appendix C. The density of tanh(u) is that of
/// u over 1 - tanh^2 u = exp(2 (ln 2 - u - softplus(-2u))).
pub(super) fn squashed(raw: &Tensor, noise: &[f32]) -> candle_core::Result<Tensor> {
    let (rows, width) = raw.dims2()?;
    let a = width / 2;
    if noise.len() != rows * a {
        candle_core::bail!("noise: expected {} numbers, got {}", rows * a, noise.len());
    }
    let x = raw.detach().flatten_all()?.to_vec1::<f32>()?;
    let mut out = Vec::with_capacity(rows * (a + 1));
    for (x, noise) in x.chunks_exact(width).zip(noise.chunks_exact(a.max(1))) {
        let mut log_p = 0.0;
        for k in 0..a {
            let (log_sd, _) = log_deviation(x[a + k]);
            let u = x[k] + log_sd.exp() * noise[k];
            out.push(u.tanh());
            log_p +=
                -0.5 * noise[k] * noise[k] - log_sd - HALF_LN_TAU - 2.0 * (LN_2 - u - softplus(-2.0 * u));
        }
        out.push(log_p);
    }
    let value = Tensor::from_vec(out, (rows, a + 1), raw.device())?;
    let noise = noise.to_vec();
    with_gradient(value, &[raw], move |given, dy| {
        let dx = given.gradient(0, || {
            let x = given.argument(0).flatten_all()?.to_vec1::<f32>()?;
            let dy = dy.flatten_all()?.to_vec1::<f32>()?;
            let mut dx = vec![0.0; x.len()];
            let rows = dx.chunks_exact_mut(2 * a).zip(x.chunks_exact(2 * a)).zip(dy.chunks_exact(a + 1));
            for (((dx, x), dy), noise) in rows.zip(noise.chunks_exact(a.max(1))) {
                for k in 0..a {
                    let (log_sd, slope) = log_deviation(x[a + k]);
                    let spread = log_sd.exp() * noise[k];
                    let action = (x[k] + spread).tanh();
                    // d ln p / du = 2 tanh u; u moves by `spread` with the logarithm of the deviation, which itself counts -1.
                    let du = dy[k] * (1.0 - action * action) + dy[a] * 2.0 * action;
                    dx[k] = du;
                    dx[a + k] = (du * spread - dy[a]) * slope;
                }
            }
            Tensor::from_vec(dx, (dy.len() / (a + 1), 2 * a), given.argument(0).device())
        })?;
        Ok([dx, None, None])
    })
}

/// The most likely action's tanh: that of the mean.
///
/// # Shapes
/// `raw` (B, 2A) on the host to (B, A).
pub(super) fn mean(raw: &[f32], actions: usize) -> Vec<f32> {
    raw.chunks_exact((2 * actions).max(1)).flat_map(|x| x[..actions].iter().map(|m| m.tanh())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn value(raw: &[f32], noise: &[f32]) -> Vec<f32> {
        let raw = Tensor::from_slice(raw, (1, raw.len()), &Device::Cpu).unwrap();
        squashed(&raw, noise).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn densities_integrate_to_one() {
        // Over the noise the density of a is p(a) da: the sum of exp(ln p) times the width in a.
        for (mean, r) in [(0.3, 0.5), (-1.2, 0.6), (0.0, 0.75)] {
            let (mut sum, mut before) = (0.0f64, None::<(f64, f64)>);
            for i in 0..=40_000 {
                let noise = -8.0 + 16.0 * i as f32 / 40_000.0;
                let out = value(&[mean, r], &[noise]);
                let now = (f64::from(out[0]), f64::from(out[1]).exp());
                if let Some(b) = before {
                    sum += (now.0 - b.0) * 0.5 * (now.1 + b.1);
                }
                before = Some(now);
            }
            assert!((sum - 1.0).abs() < 1e-3, "{mean} {r}: {sum}");
        }
    }

    #[test]
    fn gradients_equal_finite_differences() {
        let raw = [0.3f32, -0.8, 1.1, 0.4, 0.9, 0.2];
        let (noise, weight) = ([0.7f32, -1.3, 0.2], [0.5f32, -1.0, 2.0, 0.7]);
        let loss = |raw: &[f32]| -> f64 {
            value(raw, &noise).iter().zip(weight).map(|(v, w)| f64::from(*v) * f64::from(w)).sum()
        };
        let var = Var::from_slice(&raw, (1, 6), &Device::Cpu).unwrap();
        let out = squashed(&var, &noise).unwrap();
        let w = Tensor::from_slice(&weight, (1, 4), &Device::Cpu).unwrap();
        let grads = (out * w).unwrap().sum_all().unwrap().backward().unwrap();
        let got = grads.get(&var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for i in 0..6 {
            let at = |d: f32| {
                let mut raw = raw;
                raw[i] += d;
                loss(&raw)
            };
            let want = (at(5e-3) - at(-5e-3)) / 1e-2;
            assert!((f64::from(got[i]) - want).abs() < 3e-3 * want.abs().max(1.0), "{i}: {} {want}", got[i]);
        }
    }

    #[test]
    fn far_out_everything_stays_finite() {
        for raw in [[40.0, 5.0], [-40.0, -5.0]] {
            let out = value(&raw, &[3.0]);
            assert!(out.iter().all(|v| v.is_finite()), "{out:?}");
        }
    }
}
