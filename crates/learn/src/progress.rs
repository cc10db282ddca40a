//! One progress line per stage, on standard error, with what matters in it.

use crate::{Result, Stop};
use e2h_core::mention;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::cell::Cell;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

/// Seconds between two lines of a stage where standard error is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(30);

/// Where progress is shown, and where a stage hears that it should stop.
#[derive(Debug, Clone)]
pub struct Progress {
    quiet: bool,
    stop: Stop,
}

/// The line of one stage.
pub struct Bar {
    bar: ProgressBar,
    name: String,
    quiet: bool,
    start: Instant,
    /// When the last line was printed, where lines are printed instead of a bar.
    line: Option<Cell<Instant>>,
    total: u64,
}

impl Progress {
    /// `quiet` shows nothing.
    #[must_use]
    pub fn new(quiet: bool) -> Self {
        Self { quiet, stop: Stop::default() }
    }

    /// The same, for stages that `stop` may stop.
    #[must_use]
    pub fn stopping(self, stop: Stop) -> Self {
        Self { stop, ..self }
    }

    /// Asked by stages wherever they can end and lose nothing that they have not told.
    ///
    /// # Errors
    /// [`crate::Error::Stopped`] when the program was asked to stop.
    pub fn check(&self) -> Result<()> {
        self.stop.check()
    }

    /// A line for a stage of `total` units.
    #[must_use]
    pub fn bar(&self, name: &str, total: u64) -> Bar {
        let target =
            if self.quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr_with_hz(4) };
        let bar = ProgressBar::with_draw_target(Some(total), target);
        if let Ok(style) = ProgressStyle::with_template(
            "{prefix:<24} {bar:24} {pos:>5}/{len:<5} {per_sec:>9} {eta:>4} left  {msg}",
        ) {
            bar.set_style(style);
        }
        bar.set_prefix(name.to_owned());
        bar.enable_steady_tick(Duration::from_millis(500));
        let start = Instant::now();
        let line = (!self.quiet && !std::io::stderr().is_terminal()).then(|| Cell::new(start));
        Bar { bar, name: name.to_owned(), quiet: self.quiet, start, line, total }
    }

    /// A line of text between stages.
    pub fn say(&self, text: &str) {
        if !self.quiet {
            mention(text);
        }
    }
}

impl Bar {
    /// Units done, and what matters.
    pub fn set(&self, done: u64, message: &str) {
        self.bar.set_position(done);
        self.bar.set_message(message.to_owned());
        if let Some(last) = self.line.as_ref().filter(|l| l.get().elapsed() >= LINE_EVERY) {
            last.set(Instant::now());
            let seconds = self.start.elapsed().as_secs_f64();
            let left = seconds / done.max(1) as f64 * self.total.saturating_sub(done) as f64;
            mention(format_args!(
                "{:<24} {}",
                self.name,
                format_args!("{done}/{} {left:.0} s left, {message}", self.total)
            ));
        }
    }

    /// Replaces the bar by one line that stays, also where standard error is a file.
    pub fn finish(self, message: &str) {
        self.bar.finish_and_clear();
        if !self.quiet {
            mention(format_args!(
                "{:<24} {}",
                self.name,
                format_args!("{message} ({:.0} s)", self.start.elapsed().as_secs_f64())
            ));
        }
    }
}
