use std::sync::Once;

/// Sends MuJoCo's warnings to the `log` facade. Left alone, MuJoCo writes them into `MUJOCO_LOG.TXT` in the working
/// directory; what they say is noticed by `Env::step` anyway.
#[allow(unsafe_code, reason = "the only way to replace MuJoCo's log handler")]
pub(crate) fn install() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // SAFETY: no other thread may use MuJoCo meanwhile. This crate is the only one that does, every use of it begins
        // with an `Env`, and every `Env::new` waits for this call before anything else.
        unsafe { mujoco_rs::prelude::install_logging_hook() };
    });
}
