//! The numbers that stand in for weights and inputs, and comparisons.

use candle_core::Tensor;
use e2h_nn::{Builder, Compute, HostTensor, Mode, Params, Precision, Result, Weights, candle_operations};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use safetensors::SafeTensors;
use std::cell::Cell;

thread_local! {
    static ELSEWHERE: Cell<bool> = const { Cell::new(false) };
    static PRECISION: Cell<Precision> = const { Cell::new(Precision { tf32: false, bf16: false }) };
}

/// The device that `E2H_TEST_DEVICE` names, opened once.
fn named() -> Option<&'static Compute> {
    static OPENED: std::sync::OnceLock<Option<Compute>> = std::sync::OnceLock::new();
    let open = || {
        let name = std::env::var("E2H_TEST_DEVICE").ok()?;
        Some(Compute::open(&name, Precision::default()).unwrap_or_else(|e| panic!("{e}")))
    };
    OPENED.get_or_init(open).as_ref()
}

/// Where tensors and networks are made now.
pub(crate) fn compute() -> Compute {
    let place = named().filter(|_| ELSEWHERE.get()).cloned().unwrap_or_default();
    match PRECISION.get() {
        p if p == Precision::default() => place,
        p => Compute::open(place.name(), p).unwrap(),
    }
}

/// Whether `E2H_TEST_DEVICE` names a device.
pub(crate) fn device_given() -> bool {
    named().is_some()
}

/// Runs `f` with products of this precision.
pub(crate) fn in_precision<R>(precision: Precision, f: impl FnOnce() -> R) -> R {
    struct Restore(Precision);
    impl Drop for Restore {
        fn drop(&mut self) {
            PRECISION.set(self.0);
            // TF32 is a switch of the whole process.
            Compute::open(compute().name(), self.0).unwrap();
        }
    }
    let _restore = Restore(PRECISION.replace(precision));
    f()
}

/// Runs `f` on Candle's operations: on the device that `E2H_TEST_DEVICE` names (`benches/cuda/run.sh`), else on the CPU.
pub(crate) fn elsewhere<R>(f: impl FnOnce() -> R) -> R {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            ELSEWHERE.set(self.0);
        }
    }
    let _restore = Restore(ELSEWHERE.replace(true));
    if named().is_some() { f() } else { candle_operations(f) }
}

pub(crate) fn s(k: u64, n: usize) -> impl Iterator<Item = f64> {
    (0..n as u64).map(move |i| (0.7 * ((i * 7919 + k * 104_729) % 10_007) as f64 + 0.3).sin())
}

/// Weights of the given names and shapes, filled as `tests/golden/README.md` says.
pub(crate) fn fill(like: &Weights) -> Weights {
    let mut out = like.clone();
    for (k, (name, t)) in out.iter_mut().enumerate() {
        let scale = (2.0 / t.shape.iter().skip(1).product::<usize>() as f64).sqrt();
        let of = |v: f64| match (name.ends_with(".bias"), t.shape.len()) {
            (true, _) => 0.05 * v,
            (false, 1) => 1.0 + 0.1 * v,
            _ => v * scale,
        };
        t.data = s(k as u64, t.data.len()).map(|v| of(v) as f32).collect();
    }
    out
}

/// A tensor of s(k) times `scale` plus `shift`.
pub(crate) fn input(k: u64, shape: &[usize], scale: f64, shift: f64) -> Tensor {
    let data: Vec<f32> = s(k, shape.iter().product()).map(|v| (v * scale + shift) as f32).collect();
    Tensor::from_vec(data, shape, compute().device()).unwrap()
}

/// A network with filled weights.
pub(crate) fn filled<T>(mode: Mode, f: impl FnOnce(&Builder<'_>) -> Result<T>) -> (Params, T) {
    let (params, net) = Params::build_on(&compute(), mode, &mut rng(0), f).unwrap();
    params.import(&fill(&params.export().unwrap())).unwrap();
    (params, net)
}

pub(crate) fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// L = sum(out * s(2000)), in Candle.
pub(crate) fn loss(out: &Tensor) -> Tensor {
    let weights = input(2000, out.dims(), 1.0, 0.0);
    (out * weights).unwrap().sum_all().unwrap()
}

/// The same in f64.
pub(crate) fn loss64(out: &Tensor) -> f64 {
    values(out).iter().zip(s(2000, out.elem_count())).map(|(a, b)| f64::from(*a) * f64::from(b as f32)).sum()
}

pub(crate) fn values(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

/// Norm of the difference over norm of the reference, or over 1e-3 where the reference vanishes.
pub(crate) fn difference(got: &[f64], want: &[f64]) -> f64 {
    assert_eq!(got.len(), want.len());
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
    let d = norm(&mut got.iter().zip(want).map(|(a, b)| a - b));
    d / norm(&mut want.iter().copied()).max(1e-3)
}

pub(crate) fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|v| f64::from(*v)).collect()
}

pub(crate) fn assert_close(what: &str, got: &[f64], want: &[f64], tolerance: f64) {
    let d = difference(got, want);
    let worst =
        (0..got.len()).max_by(|a, b| (got[*a] - want[*a]).abs().total_cmp(&(got[*b] - want[*b]).abs()));
    let at = worst.map(|i| (i, got[i], want[i]));
    assert!(
        d <= tolerance,
        "{what}: relative difference {d:.2e} above {tolerance:.0e}, worst (index, got, want) {at:?}"
    );
}

/// A reference file.
pub(crate) struct Golden(Vec<u8>);

impl Golden {
    pub(crate) fn open(name: &str) -> Self {
        // Tests run in the folder of their package, wherever they were built.
        let path = format!("../../tests/golden/{name}.safetensors");
        Self(std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}")))
    }

    pub(crate) fn get(&self, name: &str) -> (Vec<usize>, Vec<f64>) {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let t = file.tensor(name).unwrap();
        let (d, mut shape) = (t.data(), t.shape().to_vec());
        let data = match t.dtype() {
            safetensors::Dtype::F32 => {
                d.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()).into()).collect()
            }
            safetensors::Dtype::F64 => {
                d.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect()
            }
            safetensors::Dtype::I64 => {
                d.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as f64).collect()
            }
            other => panic!("{name} is {other:?}"),
        };
        if shape.is_empty() {
            shape.push(1);
        }
        (shape, data)
    }

    pub(crate) fn tensor(&self, name: &str) -> Tensor {
        let (shape, data) = self.get(name);
        let data: Vec<f32> = data.iter().map(|v| *v as f32).collect();
        Tensor::from_vec(data, shape, compute().device()).unwrap()
    }

    /// Compares sum, sum of squares and first 16 numbers of every gradient. The sum is measured against what its terms
    /// could add up to, because it may cancel.
    pub(crate) fn compare_gradients(&self, grads: &Weights, tolerance: f64) {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let stored: Vec<&str> =
            file.names().into_iter().filter_map(|n| n.strip_prefix("grad_sum.")).collect();
        assert_eq!(stored.len(), grads.len(), "as many parameters as the reference");
        for (name, HostTensor { data, .. }) in grads {
            let wide = wide(data);
            let (sum, sq) = (wide.iter().sum::<f64>(), wide.iter().map(|v| v * v).sum::<f64>());
            let want_sum = self.get(&format!("grad_sum.{name}")).1[0];
            let want_sq = self.get(&format!("grad_sq.{name}")).1[0];
            let head = self.get(&format!("grad_head.{name}")).1;
            // A bias before a softmax has no gradient: what is stored of it is rounding.
            let scale = (want_sq * wide.len() as f64).sqrt().max(1e-2);
            let errors = [
                (sum - want_sum).abs() / scale,
                (sq.sqrt() - want_sq.sqrt()).abs() / want_sq.sqrt().max(1e-2),
                // The first numbers may be small beside the rest: measured against a share of the whole.
                difference(&wide[..head.len()], &head).min(
                    wide.iter().zip(&head).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
                        / (want_sq * head.len() as f64 / wide.len() as f64).sqrt().max(1e-2),
                ),
            ];
            for (kind, e) in ["sum", "norm", "first 16"].iter().zip(errors) {
                assert!(e <= tolerance, "gradient of {name}: {kind} off by {e:.2e}");
            }
        }
    }
}
