//! The built-in methods, and the values that make ablations of them.

mod auto_e2h;
mod direct_h;
mod hard_demos;
mod recap;
mod tr_drl;
mod tr_drl_dp;

use crate::{Error, Method, Result};
use std::sync::Arc;
use toml::{Table, Value};

pub use auto_e2h::{AutoE2h, candidates, filter};
pub use direct_h::DirectH;
pub use hard_demos::HardDemos;
pub use recap::{Indicator, Recap, RecapConfig};
pub use tr_drl::TrDrl;
pub use tr_drl_dp::{DynamicsStage, TrDrlDp};

/// A method as it is chosen: code, and values laid over preset and task file.
#[derive(Debug, Clone, Copy)]
pub struct Entry {
    /// What `--method` says.
    pub name: &'static str,
    /// Text of `configs/methods/NAME.toml`.
    text: &'static str,
}

macro_rules! entries {
    ($($name:literal),*) => {
        &[$(Entry { name: $name, text: include_str!(concat!("../../../configs/methods/", $name, ".toml")) }),*]
    };
}

/// The method of a run that names none.
pub const DEFAULT: &str = "auto-e2h";

/// All that `--method` can name, the default first.
#[must_use]
pub fn registry() -> &'static [Entry] {
    entries![
        "auto-e2h",
        "auto-e2h-literal",
        "no-kinematic",
        "no-critic",
        "direct-h",
        "hard-demos",
        "recap",
        "tr-drl-dp",
        "tr-drl"
    ]
}

/// Names of the code that a method file can ask for.
const CODE: [&str; 6] = ["auto-e2h", "direct-h", "hard-demos", "recap", "tr-drl-dp", "tr-drl"];

fn code(name: &str) -> Option<Arc<dyn Method>> {
    match name {
        "auto-e2h" => Some(Arc::new(AutoE2h)),
        "direct-h" => Some(Arc::new(DirectH)),
        "hard-demos" => Some(Arc::new(HardDemos)),
        "recap" => Some(Arc::new(Recap)),
        "tr-drl-dp" => Some(Arc::new(TrDrlDp)),
        "tr-drl" => Some(Arc::new(TrDrl)),
        _ => None,
    }
}

impl Entry {
    /// One line on what it is.
    #[must_use]
    pub fn about(&self) -> &'static str {
        self.text.lines().next().unwrap_or_default().trim_start_matches('#').trim()
    }

    /// Its code, and its values.
    pub(crate) fn read(&self) -> Result<(Arc<dyn Method>, Table)> {
        let fail = |problem: String| Error::Config(format!("method {}: {problem}", self.name));
        let mut values: Table =
            self.text.parse().map_err(|e: toml::de::Error| fail(e.message().to_owned()))?;
        let named = values.remove("code");
        let named = named.as_ref().and_then(Value::as_str).unwrap_or(self.name);
        let code = code(named)
            .ok_or_else(|| fail(format!("code: expected one of {}, found {named}", CODE.join(", "))))?;
        Ok((code, values))
    }
}

/// Whether the hard policy of a method begins with the reversed demonstrations and nothing else; false for one that is not built in.
pub(crate) fn begins_with_reversals(name: &str) -> bool {
    !["hard-demos", "tr-drl"].contains(&name) && registry().iter().any(|m| m.name == name)
}

/// A method by name.
///
/// # Errors
/// An unknown name; the message has the nearest known one.
pub fn find(name: &str) -> Result<Entry> {
    registry().iter().find(|m| m.name == name).copied().ok_or_else(|| {
        let names: Vec<&str> = registry().iter().map(|m| m.name).collect();
        Error::Config(format!("unknown method `{name}`; {}", crate::config::suggestion(name, "", &names)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_method_says_what_it_is_and_has_its_code() {
        for entry in registry() {
            entry.read().unwrap();
            assert!(entry.about().len() > 20, "{}", entry.name);
        }
    }

    #[test]
    fn an_unknown_method_gets_the_nearest_known_one() {
        let message = find("no-critik").unwrap_err().to_string();
        assert!(message.contains("did you mean `no-critic`"), "{message}");
    }
}
