//! One progress line a stage, on standard error, with what matters in it.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::cell::Cell;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

/// Seconds between two lines of a stage where standard error is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(30);

/// Where progress is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    quiet: bool,
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
        Self { quiet }
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
            eprintln!("{text}");
        }
    }
}

impl Bar {
    /// Units done, and what matters.
    pub fn set(&self, done: u64, message: &str) {
        self.bar.set_position(done);
        self.bar.set_message(message.to_owned());
        if let Some(line) = self.line.as_ref().filter(|l| l.get().elapsed() >= LINE_EVERY) {
            line.set(Instant::now());
            let seconds = self.start.elapsed().as_secs_f64();
            let left = seconds / done.max(1) as f64 * self.total.saturating_sub(done) as f64;
            eprintln!("{:<24} {done}/{} {left:.0} s left, {message}", self.name, self.total);
        }
    }

    /// Replaces the bar by one line that stays, also where standard error is a file.
    pub fn finish(self, message: &str) {
        self.bar.finish_and_clear();
        if !self.quiet {
            eprintln!("{:<24} {message} ({:.0} s)", self.name, self.start.elapsed().as_secs_f64());
        }
    }
}
