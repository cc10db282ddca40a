//! Puts the pinned MuJoCo library into `OUT_DIR/lib` and tells dependents where it is. A directory inside `target/`,
//! because cargo puts only those on the library path of `cargo run` and `cargo test`.

#[path = "src/cache.rs"]
#[allow(unreachable_pub, reason = "public in the crate, which shares it")]
mod cache;
#[path = "src/obtain.rs"]
mod obtain;

use obtain::{Library, Settings};
use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    for name in obtain::VARIABLES {
        println!("cargo::rerun-if-env-changed={name}");
    }
    for path in ["build.rs", "src/cache.rs", "src/obtain.rs", "stub"] {
        println!("cargo::rerun-if-changed={path}");
    }
    if env::var_os("DOCS_RS").is_some() {
        println!("cargo::rustc-env=MUJOCO_NATIVE_LIB_DIR=");
        return;
    }
    match provide() {
        Ok(dir) => {
            println!("cargo::rustc-link-search=native={}", dir.display());
            println!("cargo::metadata=LIBDIR={}", dir.display()); // dependents read DEP_MUJOCO_NATIVE_LIBDIR
            println!("cargo::rustc-env=MUJOCO_NATIVE_LIB_DIR={}", dir.display());
        }
        Err(message) => {
            for line in message.lines() {
                println!("cargo::error={line}");
            }
            std::process::exit(1);
        }
    }
}

fn provide() -> Result<PathBuf, String> {
    if let Some(dir) = env::var_os("MUJOCO_STATIC_LINK_DIR") {
        return Ok(dir.into());
    }
    if let Some(dir) = env::var_os("MUJOCO_DYNAMIC_LINK_DIR").map(PathBuf::from)
        && !is_stub(&dir)?
    {
        return link_to(&dir);
    }
    let library = Library::pinned(&variable("CARGO_CFG_TARGET_OS")?, &variable("CARGO_CFG_TARGET_ARCH")?)?;
    let out = out_dir("lib")?;
    let file = out.join(library.file);
    obtain::install(&library, &Settings::from_environment(out_dir("work")?), &file)?;
    println!("cargo::rerun-if-changed={}", file.display());
    symlink(Path::new(library.file), &out.join("libmujoco.so"))?;
    Ok(out)
}

/// The committed stub only satisfies the build script of `mujoco-rs`; it is nobody's own library.
fn is_stub(dir: &Path) -> Result<bool, String> {
    let stub = Path::new(&variable("CARGO_MANIFEST_DIR")?).join("stub");
    Ok(match (dir.canonicalize(), stub.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        _ => false,
    })
}

/// A directory under `OUT_DIR` with links to the user's own library.
fn link_to(dir: &Path) -> Result<PathBuf, String> {
    let out = out_dir("user")?;
    for name in ["libmujoco.so", "libmujoco.so.3.17.0"] {
        let target =
            dir.join(name).canonicalize().or_else(|_| dir.join("libmujoco.so").canonicalize()).map_err(
                |e| format!("MUJOCO_DYNAMIC_LINK_DIR={}: expected {name} there: {e}", dir.display()),
            )?;
        symlink(&target, &out.join(name))?;
    }
    Ok(out)
}

fn symlink(target: &Path, link: &Path) -> Result<(), String> {
    let _ = fs::remove_file(link); // usually absent
    #[cfg(unix)]
    let made = std::os::unix::fs::symlink(target, link);
    #[cfg(not(unix))]
    let made = fs::copy(link.with_file_name(target), link).map(|_| ());
    made.map_err(|e| format!("{}: {e}", link.display()))
}

fn out_dir(name: &str) -> Result<PathBuf, String> {
    let dir = PathBuf::from(variable("OUT_DIR")?).join(name);
    fs::create_dir_all(&dir).map_err(|e| format!("{}: {e}", dir.display()))?;
    Ok(dir)
}

fn variable(name: &str) -> Result<String, String> {
    env::var(name).map_err(|e| format!("{name}: {e}"))
}
