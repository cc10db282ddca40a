//! What all targets share: what they hold a reader to, a folder that is broken and made whole again, and seeds.
//!
//! A reader may refuse whatever it likes. It must not panic, must not take more memory than [`LIMIT`] at once, must not hang,
//! and its refusal is one line that names the file.

pub mod container;
pub mod fixture;
pub mod pages;

use std::alloc::{GlobalAlloc, Layout, System};
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Mutex;

// Linked whether a target uses it or not: what the coverage calls lies in it.
use libfuzzer_sys as _;

/// Bytes that nobody may ask for at once; libFuzzer's own `-malloc_limit_mb` needs a sanitizer.
pub const LIMIT: usize = 768 << 20;
/// Length of a message that nobody reads to the end.
const LONGEST: usize = 100_000;

struct Limited;

#[global_allocator]
static ALLOCATOR: Limited = Limited;

fn look(size: usize) {
    if size > LIMIT {
        // Printing allocates, which is fine: less than the limit.
        eprintln!("an allocation of {size} bytes at once\n{}", std::backtrace::Backtrace::force_capture());
        std::process::abort();
    }
}

// SAFETY: all is the system's; sizes are looked at before.
unsafe impl GlobalAlloc for Limited {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        look(layout.size());
        // SAFETY: as asked.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        look(layout.size());
        // SAFETY: as asked.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        look(size);
        // SAFETY: as asked.
        unsafe { System.realloc(memory, layout, size) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as asked.
        unsafe { System.dealloc(memory, layout) }
    }
}

static PANIC: Mutex<String> = Mutex::new(String::new());

/// To be called before the first input. Where `E2H_FUZZ_SEEDS` names a folder, writes the target's seeds there and ends.
pub fn begin(seeds: impl FnOnce() -> Vec<Vec<u8>>) {
    // Readers catch the panics of decoders that are not ours: those are no findings, and are said by nobody.
    std::panic::set_hook(Box::new(|info| {
        if let Ok(mut last) = PANIC.lock() {
            *last = info.to_string();
        }
    }));
    let Some(folder) = std::env::var_os("E2H_FUZZ_SEEDS") else { return };
    std::fs::create_dir_all(&folder).expect("a folder for seeds");
    for (i, seed) in seeds().into_iter().enumerate() {
        std::fs::write(Path::new(&folder).join(format!("seed-{i:03}")), seed).expect("a seed");
    }
    std::process::exit(0);
}

/// Runs a reader; a panic that comes out of it ends the target.
pub fn run<T>(reader: impl FnOnce() -> T) -> T {
    catch_unwind(AssertUnwindSafe(reader)).unwrap_or_else(|_| {
        eprintln!("a panic: {}", PANIC.lock().map(|p| p.clone()).unwrap_or_default());
        std::process::abort()
    })
}

/// Holds a refusal to its form; the value otherwise. `root` is the folder that was read.
pub fn judge<T, E: Display>(root: &Path, result: Result<T, E>) -> Option<T> {
    result.map_err(|e| judge_message(root, &e.to_string())).ok()
}

/// The same for a message of a report.
pub fn judge_message(root: &Path, message: &str) {
    let control = message.chars().find(|c| c.is_control());
    let named = message.contains(&root.display().to_string());
    if control.is_some() || !named || message.len() > LONGEST {
        let start: String = message.chars().take(2000).collect();
        eprintln!(
            "a message with {control:?}, that names the folder: {named}, of {} bytes: {start:?}",
            message.len()
        );
        std::process::abort();
    }
}
