//! Finds or fetches the pinned MuJoCo library and tells the linker where it is.
//!
//! All work is done by the build script; this crate knows nothing about simulation. It looks, in this order, at a
//! `MUJOCO_DYNAMIC_LINK_DIR` (or `MUJOCO_STATIC_LINK_DIR`) of your own, a per-user cache (`E2H_MUJOCO_CACHE`, else
//! `$XDG_CACHE_HOME/auto-e2h`, else `~/.cache/auto-e2h`), a wheel file named by `MUJOCO_WHEEL`, `pip download`, and the
//! official release archive. Whatever it gets must have the pinned SHA-256; otherwise the build stops with one message
//! that lists what was tried and the ways out.
//!
//! A package with binaries, tests or examples that link MuJoCo depends on this crate directly and has this `build.rs`,
//! so that its programs also find the library when they are started without cargo:
//!
//! ```
//! if let Ok(dir) = std::env::var("DEP_MUJOCO_NATIVE_LIBDIR") {
//!     println!("cargo::rustc-link-arg=-Wl,-rpath,{dir}");
//!     println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN");
//! }
//! ```

mod cache;
#[cfg(test)]
#[allow(dead_code, reason = "what only the build script calls")]
mod obtain;

pub use cache::cache_dir;

/// Version of MuJoCo that the bindings are made for.
pub const VERSION: &str = "3.17.0";

/// Directory that holds the library this was built with; empty on docs.rs.
pub const LIB_DIR: &str = env!("MUJOCO_NATIVE_LIB_DIR");
