//! Where libraries are kept for the next build. Shared by the build script and the crate.

use std::env;
use std::path::PathBuf;

/// The per-user cache: `E2H_MUJOCO_CACHE`, else `$XDG_CACHE_HOME/auto-e2h`, else `~/.cache/auto-e2h`; none when no home
/// directory is known.
#[must_use]
pub fn cache_dir() -> Option<PathBuf> {
    env::var_os("E2H_MUJOCO_CACHE")
        .map(PathBuf::from)
        .or_else(|| env::var_os("XDG_CACHE_HOME").map(|d| PathBuf::from(d).join("auto-e2h")))
        .or_else(|| env::var_os("HOME").map(|d| PathBuf::from(d).join(".cache/auto-e2h")))
}
