use crate::{Error, Result};
use candle_core::{Device, DeviceLocation, Tensor};
use std::cell::Cell;

thread_local! {
    static CANDLE: Cell<bool> = const { Cell::new(false) };
}

/// Runs `f` with networks that are built inside, and operations without weights, on Candle's operations instead of our
/// kernels: what other devices compute with, on any machine. For tests and measurements.
#[doc(hidden)]
pub fn candle_operations<R>(f: impl FnOnce() -> R) -> R {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            CANDLE.set(self.0);
        }
    }
    let _restore = Restore(CANDLE.replace(true));
    f()
}

/// What computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Backend {
    /// Our kernels on the CPU: a tape records them, gradients are plain numbers.
    Kernels,
    /// Candle's operations, which Candle tracks: gradients are tensors.
    Candle,
    /// Our kernels on an NVIDIA GPU: a tape records their launches, gradients are tensors.
    #[cfg_attr(not(feature = "cuda"), allow(dead_code, reason = "made with feature cuda alone"))]
    Gpu,
}

impl Backend {
    fn on(device: &Device) -> Self {
        match device {
            _ if CANDLE.get() => Self::Candle,
            Device::Cpu => Self::Kernels,
            #[cfg(feature = "cuda")]
            Device::Cuda(_) => Self::Gpu,
            _ => Self::Candle,
        }
    }

    /// For an operation without weights.
    pub(crate) fn of(inputs: &[&Tensor]) -> Self {
        let elsewhere = inputs.iter().map(|t| t.device()).find(|d| !d.is_cpu());
        Self::on(elsewhere.unwrap_or(&Device::Cpu))
    }
}

/// How exact a GPU multiplies. The CPU always computes in `f32`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Precision {
    /// Products of `f32` on tensor cores, which read 10 bits of each mantissa. Acts on the whole process.
    pub tf32: bool,
    /// Factors of the products of linear layers and convolutions in `bf16`; sums, weights, normalisations and the
    /// optimiser stay in `f32`.
    pub bf16: bool,
}

/// Where networks are computed, and how.
#[derive(Clone, Debug)]
pub struct Compute {
    device: Device,
    bf16: bool,
    name: String,
}

impl Default for Compute {
    fn default() -> Self {
        Self::cpu()
    }
}

impl Compute {
    /// The processor.
    #[must_use]
    pub fn cpu() -> Self {
        Self { device: Device::Cpu, bf16: false, name: "cpu".to_owned() }
    }

    /// The device of tensors that are there already; products are in `f32`.
    pub(crate) fn of(device: &Device) -> Self {
        let name = match device.location() {
            DeviceLocation::Cpu => return Self::cpu(),
            DeviceLocation::Cuda { gpu_id } => format!("cuda:{gpu_id}"),
            DeviceLocation::Metal { gpu_id } => format!("metal:{gpu_id}"),
        };
        Self { device: device.clone(), bf16: false, name }
    }

    /// Opens `cpu`, `cuda` (the first GPU) or `cuda:N`.
    ///
    /// # Errors
    /// [`Error::Device`] when the name is another, this program was built without CUDA, or the machine has no such GPU.
    pub fn open(name: &str, precision: Precision) -> Result<Self> {
        let fail = |problem: String| Error::Device { asked: name.to_owned(), problem };
        if name == "cpu" {
            return Ok(Self { bf16: precision.bf16, ..Self::cpu() });
        }
        let number = match name.strip_prefix("cuda") {
            Some("") => Some(0),
            Some(rest) => rest.strip_prefix(':').and_then(|n| n.parse::<usize>().ok()),
            None => None,
        };
        let number = number.ok_or_else(|| fail("expected cpu, cuda or cuda:N".to_owned()))?;
        let device = cuda(number).map_err(fail)?;
        candle_core::cuda::set_gemm_reduced_precision_f32(precision.tf32);
        Ok(Self { device, bf16: precision.bf16, name: format!("cuda:{number}") })
    }

    /// Where tensors have to be.
    #[must_use]
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Its name: `cpu` or `cuda:N`.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Waits until the device has done what it was given: for measurements.
    ///
    /// # Errors
    /// [`Error::Candle`] when the device failed.
    pub fn synchronize(&self) -> Result<()> {
        Ok(self.device.synchronize()?)
    }

    pub(crate) fn bf16(&self) -> bool {
        self.bf16
    }

    /// What computes networks that are built now.
    pub(crate) fn backend(&self) -> Backend {
        Backend::on(&self.device)
    }
}

#[cfg(not(feature = "cuda"))]
fn cuda(_: usize) -> std::result::Result<Device, String> {
    Err("this program was built without CUDA; build it with `--features cuda`, or use cpu".to_owned())
}

/// Devices that were opened: tensors of one GPU understand each other however often its name is given.
#[cfg(feature = "cuda")]
static OPENED: std::sync::Mutex<Vec<(usize, Device)>> = std::sync::Mutex::new(Vec::new());

#[cfg(feature = "cuda")]
fn cuda(number: usize) -> std::result::Result<Device, String> {
    let mut opened = OPENED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    if let Some((_, device)) = opened.iter().find(|(n, _)| *n == number) {
        return Ok(device.clone());
    }
    let device = cuda_anew(number)?;
    opened.push((number, device.clone()));
    Ok(device)
}

#[cfg(feature = "cuda")]
fn cuda_anew(number: usize) -> std::result::Result<Device, String> {
    // The loader of the driver panics where a library is missing. Its message would be a second one, in other words.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    // A stream of its own orders tensors that threads share; the default stream is one for each thread.
    // The text of an error is the driver's too.
    let open = || {
        let device = Device::new_cuda_with_stream(number).map_err(|e| e.to_string())?;
        crate::gpu::prepare(&device).map_err(|e| e.to_string())?;
        Ok::<_, String>(device)
    };
    let opened = std::panic::catch_unwind(open);
    std::panic::set_hook(hook);
    match opened {
        Ok(Ok(device)) => Ok(device),
        Ok(Err(text)) => Err(format!("no such GPU: {}; use cpu", text.lines().next().unwrap_or_default())),
        Err(_) => {
            let libraries = "libcuda, libcublas and libcurand";
            Err(format!(
                "expected NVIDIA's driver and the libraries {libraries}, found none that load; use cpu"
            ))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_devices_are_refused_in_one_line() {
        for name in ["gpu", "cuda:", "cuda:one", "cuda1", ""] {
            let error = Compute::open(name, Precision::default()).unwrap_err().to_string();
            assert!(error.contains("expected cpu, cuda or cuda:N") && !error.contains('\n'), "{error}");
        }
        assert_eq!(Compute::open("cpu", Precision::default()).unwrap().name(), "cpu");
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn without_the_feature_it_says_how_to_get_it() {
        let error = Compute::open("cuda:1", Precision::default()).unwrap_err().to_string();
        assert!(error.contains("`cuda:1`") && error.contains("--features cuda") && !error.contains('\n'));
    }
}
