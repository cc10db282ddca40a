use std::error::Error;
use std::fmt;

/// What `main` returns when it fails: prints an error and its causes on one line, each of them once.
///
/// Errors of libraries say what caused them, because their texts are used alone too; programs that print the chain of causes
/// beside it would say everything twice.
///
/// ```no_run
/// fn main() -> Result<(), e2h_core::Failure> {
///     std::fs::read("episodes")?;
///     Ok(())
/// }
/// ```
pub struct Failure(String);

impl<E: Into<Box<dyn Error + Send + Sync>>> From<E> for Failure {
    fn from(error: E) -> Self {
        let error: Box<dyn Error + Send + Sync> = error.into();
        let mut text = error.to_string();
        let mut cause = error.source();
        while let Some(error) = cause {
            let words = error.to_string();
            if !text.contains(&words) {
                text = format!("{text}: {words}");
            }
            cause = error.source();
        }
        Self(text)
    }
}

// What the standard library prints behind `Error: `.
impl fmt::Debug for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    enum Sample {
        #[error("reading {path}: {source}")]
        Told { path: &'static str, source: std::io::Error },
        #[error("reading {path}")]
        Silent { path: &'static str, source: std::io::Error },
    }

    #[test]
    fn every_cause_is_told_once() {
        let cause = || std::io::Error::other("no such place");
        for error in
            [Sample::Told { path: "a", source: cause() }, Sample::Silent { path: "a", source: cause() }]
        {
            assert_eq!(format!("{:?}", Failure::from(error)), "reading a: no such place");
        }
        assert_eq!(format!("{:?}", Failure::from("plain words")), "plain words");
    }
}
