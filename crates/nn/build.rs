//! Compiles the kernels for GPUs to PTX, where feature `cuda` asks for them.

use std::path::PathBuf;
use std::process::{Command, ExitCode};

const SOURCE: &str = "src/gpu/kernels.cu";

fn main() -> ExitCode {
    println!("cargo:rerun-if-changed={SOURCE}");
    println!("cargo:rerun-if-env-changed=NVCC");
    if std::env::var_os("CARGO_FEATURE_CUDA").is_none() {
        return ExitCode::SUCCESS;
    }
    let nvcc = std::env::var("NVCC").unwrap_or_else(|_| "nvcc".to_owned());
    let out = PathBuf::from(std::env::var_os("OUT_DIR").unwrap_or_default()).join("kernels.ptx");
    // PTX for compute capability 8.0: the driver compiles it for whatever card there is from A100 on.
    let mut command = Command::new(&nvcc);
    command.args(["--ptx", "-O3", "-std=c++17", "-arch=compute_80", "-o"]).arg(&out).arg(SOURCE);
    match command.status() {
        Ok(status) if status.success() => ExitCode::SUCCESS,
        Ok(status) => {
            println!("cargo::error={nvcc} failed on {SOURCE}: {status}");
            ExitCode::FAILURE
        }
        Err(e) => {
            println!(
                "cargo::error=feature `cuda`: expected NVIDIA's compiler as `{nvcc}`, which does not start ({e}); install the CUDA toolkit, \
                 name the compiler in NVCC, or build with benches/cuda/build.sh"
            );
            ExitCode::FAILURE
        }
    }
}
