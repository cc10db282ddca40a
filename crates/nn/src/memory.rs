/// Tells the allocator to keep the memory of large buffers instead of giving it back to the system.
///
/// A training step frees and takes the same large buffers again and again. glibc maps and unmaps each of them, and every
/// page is faulted in anew: a tenth of a step. Call this once, before the first thread and the first step. It has no effect on other allocators
/// and systems.
pub fn tune_allocator() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[allow(unsafe_code, reason = "mallopt is a C function")]
    // SAFETY: mallopt only sets parameters of the allocator and may be called at any time.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, i32::MAX);
        // One heap for all threads: what one of them frees another can take.
        libc::mallopt(libc::M_ARENA_MAX, 1);
        // Ask the system for memory in large steps.
        libc::mallopt(libc::M_TOP_PAD, 64 << 20);
    }
}
