//! Taking over from another run what this one would make byte for byte: demonstrations, and the policies before the loop.

use super::{Run, folder};
use crate::config::RunConfig;
use crate::{Error, Result};
use e2h_report::folder::RunFolder;
use std::path::Path;

impl Run {
    /// Copies the finished stages before the loop of the run in `other`, as far as that run and this one make the same of them: of the
    /// same pair, preset and seed, with the same values of all that a stage depends on. What is there already stays.
    ///
    /// # Errors
    /// When `other` is no run directory, or cannot be read or copied.
    pub(super) fn take_over(&self, other: &Path) -> Result<()> {
        let there = RunFolder::open(other)?;
        let (a, b) = (there.identity(), &self.identity);
        let given = match (&a.given, &b.given) {
            (Some(a), Some(b)) => a.same(b),
            (a, b) => a.is_none() && b.is_none(),
        };
        let identity =
            given && (&a.task, &a.preset, a.seed, &a.policy) == (&b.task, &b.preset, b.seed, &b.policy);
        let path = other.join("config.toml");
        let text = e2h_data::read_text(&path).map_err(crate::directory::io("reading", &path))?;
        let mut theirs = RunConfig::from_text(&a.preset, &text)
            .map_err(|e| Error::Foreign {
                path,
                quantity: "configuration".to_owned(),
                expected: "one of this version".to_owned(),
                found: e.to_string(),
            })?
            .config;
        theirs.know(&*self.task);
        let ours = self.config();
        if !identity || !ours.demonstrates_like(&theirs) {
            return Ok(());
        }
        let done = |file: &str| other.join(file).exists();
        let policies = ours.begins_like(&theirs);
        // A method of one's own may begin in its own way: the same name, the same code.
        let same = a.method == b.method
            || [&a.method, &b.method].iter().all(|m| crate::methods::begins_with_reversals(m));
        let first = folder(0, "");
        let first = first.trim_end_matches('/');
        for (place, wanted) in [
            ("demonstrations", done("demonstrations/notes.json")),
            ("policy_easy", policies && done("policy_easy/notes.json")),
            (
                first,
                policies
                    && same
                    && done(&format!("{first}/record.json"))
                    && done(&format!("{first}/policy/notes.json")),
            ),
        ] {
            if wanted && !self.dir.join(place).exists() {
                self.dir.copy(&other.join(place), place)?;
            }
        }
        Ok(())
    }
}
