//! Stopping a run from outside, at a place where nothing is lost.

use crate::{Error, Result};
use signal_hook::consts::{SIGINT, SIGTERM};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Whether somebody asked the program to stop. Clones ask the same; by default nobody ever does.
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicUsize>);

impl Stop {
    /// From now on SIGINT and SIGTERM ask; a second one ends the process at once, with 128 and the signal's number as status.
    ///
    /// # Errors
    /// When the system does not let signals be handled.
    pub fn on_signals() -> Result<Self> {
        let (this, again) = (Self::default(), Arc::new(AtomicBool::new(false)));
        for signal in [SIGINT, SIGTERM] {
            let number = usize::try_from(signal).unwrap_or_default();
            // In this order: the first signal finds nothing set, the second ends the process.
            signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, again.clone())
                .and_then(|_| signal_hook::flag::register(signal, again.clone()))
                .and_then(|_| signal_hook::flag::register_usize(signal, this.0.clone(), number))
                .map_err(Error::Signals)?;
        }
        Ok(this)
    }

    /// Asks as a signal of this number does.
    pub fn ask(&self, signal: i32) {
        self.0.store(usize::try_from(signal).unwrap_or_default(), Ordering::SeqCst);
    }

    /// # Errors
    /// [`Error::Stopped`] when somebody asked.
    pub fn check(&self) -> Result<()> {
        match self.0.load(Ordering::SeqCst) {
            0 => Ok(()),
            signal => Err(Error::Stopped { signal: i32::try_from(signal).unwrap_or_default() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_hear_what_one_is_asked() {
        let stop = Stop::default();
        let other = stop.clone();
        assert!(other.check().is_ok());
        stop.ask(SIGTERM);
        assert!(matches!(other.check(), Err(Error::Stopped { signal: SIGTERM })));
        assert!(Stop::default().check().is_ok());
    }
}
