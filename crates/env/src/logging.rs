use mujoco_rs::prelude::{MjLogMessage, MjtLogLevel};
use std::io::Write as _;
use std::sync::Once;

/// Takes MuJoCo's messages. Left alone, MuJoCo writes them into `MUJOCO_LOG.TXT` in the working directory. An error that it does not
/// survive goes to standard error; all others to the `log` facade, and what they say is noticed by `Env::step` anyway.
#[allow(unsafe_code, reason = "the only way to replace MuJoCo's log handler")]
pub(crate) fn install() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // SAFETY: no other thread may use MuJoCo meanwhile. This crate is the only one that does, every use of it begins
        // with an `Env`, and every `Env::new` waits for this call before anything else.
        unsafe { mujoco_rs::logging::set_log_handler(handle) };
    });
}

/// When it returns from an error, the process ends with status 1.
fn handle(message: &MjLogMessage) {
    let parts = [message.func(), Some(message.subject()), message.body()];
    let text: Vec<&str> = parts.into_iter().flatten().filter(|t| !t.is_empty()).collect();
    let text = e2h_core::one_line(&text.join(": "));
    let level = match message.level() {
        MjtLogLevel::mjLOG_ERROR => {
            // Nowhere is left to tell that this cannot be written; a panic would abort.
            let _ = writeln!(std::io::stderr(), "Error: MuJoCo cannot go on: {text}");
            return;
        }
        MjtLogLevel::mjLOG_WARNING => log::Level::Warn,
        MjtLogLevel::mjLOG_INFO => log::Level::Info,
        _ => log::Level::Debug,
    };
    log::log!(target: "mujoco", level, "{text}");
}
