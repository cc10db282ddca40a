//! What this machine has.

use auto_e2h::core::{Failure, say};
use auto_e2h::learn::hub;
use auto_e2h::nn::{Compute, Precision, vector_unit};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Prints what this machine has.
pub(super) fn doctor() -> Result<(), Failure> {
    let row = |name: &str, words: String| say(format_args!("{name:<14} {words}"));
    row(
        "auto-e2h",
        format!("{}, {} {}", env!("CARGO_PKG_VERSION"), std::env::consts::OS, std::env::consts::ARCH),
    )?;

    let (pinned, loaded) = (mujoco_native::VERSION, auto_e2h::env::mujoco_version());
    let note = if loaded == pinned { String::new() } else { format!("; the bindings are made for {pinned}") };
    let place = library().map_or("linked into this program".to_owned(), |p| p.display().to_string());
    row("MuJoCo", format!("{loaded}, {place}{note}"))?;
    row("", place_of(mujoco_native::cache_dir(), "libraries for the next build are kept"))?;

    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    row("threads", format!("{cores}, as many as this process may have cores; --threads N takes fewer"))?;
    row("vector units", format!("networks use {}", vector_unit()))?;
    row("GPU", gpu())?;
    row("ffmpeg", ffmpeg())?;
    let settings = hub::Settings::from_env();
    let client = if cfg!(feature = "hub") {
        settings.endpoint.clone()
    } else {
        "not in this build (--features hub)".to_owned()
    };
    row("hub", client)?;
    row("", place_of(Some(settings.cache), "policies from the hub are kept"))?;
    Ok(())
}

fn place_of(folder: Option<PathBuf>, what: &str) -> String {
    match folder {
        Some(folder) => {
            let there = if folder.is_dir() { "" } else { " (not there yet)" };
            format!("{what} in {}{there}", folder.display())
        }
        None => format!("{what} nowhere: no home folder is known"),
    }
}

/// The MuJoCo library that this process has loaded; where the system does not tell, the one that it was linked to.
fn library() -> Option<PathBuf> {
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap_or_default();
    let loaded =
        maps.lines().find_map(|l| Some(l[l.find('/')?..].to_owned()).filter(|p| p.contains("libmujoco")));
    let built =
        || Some(Path::new(mujoco_native::LIB_DIR).to_owned()).filter(|d| d.join("libmujoco.so").exists());
    loaded.map(PathBuf::from).or_else(built)
}

fn gpu() -> String {
    let driver = Path::new("/proc/driver/nvidia/version").exists();
    if !cfg!(feature = "cuda") {
        let driver = if driver { "an NVIDIA driver is here; " } else { "no NVIDIA driver is here; " };
        return format!("not in this build: {driver}--features cuda builds for one (needs nvcc)");
    }
    match Compute::open("cuda", Precision::default()) {
        Ok(compute) => format!("{} opens; --device cuda computes networks there", compute.name()),
        Err(e) => e.to_string(),
    }
}

fn ffmpeg() -> String {
    let program = auto_e2h::data::lerobot::video_decoder();
    let name = program.to_string_lossy().into_owned();
    let said = Command::new(&program).arg("-version").output();
    match said {
        Ok(output) if output.status.success() => {
            let text = String::from_utf8_lossy(&output.stdout);
            let line = text.lines().next().unwrap_or_default();
            let version = line.split_whitespace().nth(2).unwrap_or("of an unknown version");
            format!("{version} ({name}); decodes datasets with videos, from 5.1 on")
        }
        Ok(output) => format!("{name} ends with {}; only datasets with videos need it", output.status),
        Err(e) => format!("{name}: {e}; only datasets with videos need it"),
    }
}
