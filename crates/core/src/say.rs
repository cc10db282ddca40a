use std::fmt::Display;
use std::io::{ErrorKind, Result, Write as _};

/// Writes a line to standard output, for programs. Where nobody reads any more, as behind `| head -1`, the process ends with
/// status 0 and no word: what a program has to save it saves before it speaks.
///
/// ```no_run
/// e2h_core::say(format_args!("{} of {}", 3, 4))?;
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// When the line cannot be written for another reason, such as a full disk.
pub fn say(line: impl Display) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{line}").and_then(|()| out.flush()) {
        Err(e) if e.kind() == ErrorKind::BrokenPipe => std::process::exit(0),
        done => done.map_err(|e| std::io::Error::new(e.kind(), format!("standard output: {e}"))),
    }
}

/// Writes a line to standard error. Words for people stop no work: when it cannot be written, nothing happens.
pub fn mention(line: impl Display) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}
