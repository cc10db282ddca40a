//! A run directory as those see it who only read, and the JSON files in it.
//!
//! A sealed file begins with the SHA-256 of all that follows it, so that damage is told from another value.

use crate::error::io;
use crate::{Error, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::path::{Path, PathBuf};

/// Layout of run directories; 2: episodes are LeRobot datasets.
pub const LAYOUT: u32 = 2;
/// What a run is, in its folder.
pub const IDENTITY_FILE: &str = "run.json";
/// SHA-256 of every other file of a dataset, in its folder.
pub const SUMS_FILE: &str = "files.json";
/// Begins a sealed file, before the SHA-256 of all that follows it.
const SEAL: &str = "{\n  \"sha256\": \"";

/// What a run is: `run.json`, written once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Identity {
    /// Layout of the folder, [`LAYOUT`].
    pub format: u32,
    /// Task pair.
    pub task: String,
    /// Preset name.
    pub preset: String,
    /// Run seed.
    pub seed: u64,
    /// Method name; none in runs of version 0.1, which were all of `auto-e2h`.
    #[serde(default = "auto_e2h")]
    pub method: String,
    /// Class of its policies; none in runs of version 0.1, which were all `diffusion`.
    #[serde(default = "diffusion")]
    pub policy: String,
    /// Easy demonstrations that it was given; none where its scripted demonstrator recorded them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub given: Option<Given>,
}

impl Identity {
    /// Whether both are one run: the same of everything, but for the place and the pace of demonstrations that were given.
    #[must_use]
    pub fn same(&self, other: &Self) -> bool {
        let mut alike = other.clone();
        if let (Some(a), Some(b)) = (&mut alike.given, &self.given)
            && a.same(b)
        {
            *a = b.clone();
        }
        alike == *self
    }
}

/// A dataset of easy demonstrations that a run was given in place of scripted ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Given {
    /// The folder, as it was named.
    pub from: String,
    /// SHA-256 of its files and their names.
    pub sha256: String,
    /// Successful episodes that the run took, the first ones.
    pub episodes: usize,
    /// Episodes that there were.
    pub of: usize,
    /// Whether its images were larger than the run's, and were made smaller.
    #[serde(default)]
    pub resized: bool,
    /// Seconds that a person took for the episodes taken; none where that is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
}

impl Given {
    /// Whether both are the same episodes of the same dataset.
    #[must_use]
    pub fn same(&self, other: &Self) -> bool {
        (&self.sha256, self.episodes) == (&other.sha256, other.episodes)
    }

    /// In words.
    #[must_use]
    pub fn words(&self) -> String {
        let smaller = if self.resized { ", images made smaller" } else { "" };
        let pace = self.seconds.map_or(String::new(), |s| {
            format!(", {:.1} s each by the clock", s / self.episodes.max(1) as f64)
        });
        format!("{} of {} episodes of {}{smaller}{pace}", self.episodes, self.of, self.from)
    }
}

fn diffusion() -> String {
    "diffusion".to_owned()
}

fn auto_e2h() -> String {
    "auto-e2h".to_owned()
}

/// A run directory that is there, to be read.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    identity: Identity,
}

impl RunFolder {
    /// # Errors
    /// When `path` is no run directory, or one of another layout.
    pub fn open(path: &Path) -> Result<Self> {
        let foreign = |expected: &str, found: String| Error::Foreign {
            path: path.to_owned(),
            quantity: "run directory".to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let identity: Identity = read_json(&path.join(IDENTITY_FILE))?
            .ok_or_else(|| foreign("a file run.json", "none".to_owned()))?;
        if identity.format != LAYOUT {
            return Err(foreign(&format!("layout version {LAYOUT}"), identity.format.to_string()));
        }
        Ok(Self { path: path.to_owned(), identity })
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the run is.
    #[must_use]
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Reads a JSON file; none when it is not there.
    ///
    /// # Errors
    /// As [`read_json`].
    pub fn get<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>> {
        read_json(&self.path.join(name))
    }
}

/// SHA-256 in hexadecimal digits.
#[must_use]
pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

fn holds_digest(line: &str) -> bool {
    line.split(|c: char| !c.is_ascii_hexdigit()).any(|word| word.len() == 64)
}

/// Compares two checksums of a file.
///
/// # Errors
/// [`Error::Foreign`] when they differ.
pub fn compare(path: &Path, expected: &str, found: String) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    let expected = e2h_core::one_line(expected);
    Err(Error::Foreign { path: path.to_owned(), quantity: "SHA-256".to_owned(), expected, found })
}

/// Puts the seal on the text of a JSON object with named fields, which [`read_json`] compares. `text` is as `serde_json` prints
/// it over several lines, without a line break at its end; other values stay as they are.
#[must_use]
pub fn sealed(text: &str) -> String {
    match text.strip_prefix("{\n") {
        Some(rest) => format!("{SEAL}{}\",\n{rest}", sha256(format!("{rest}\n").as_bytes())),
        None => text.to_owned(),
    }
}

/// Reads JSON, sealed or not; none when the file is not there.
///
/// # Errors
/// When it cannot be read, its seal is broken, or it is not what a run writes.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    let text = match e2h_data::read_text(path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(io("reading", path)(e)),
    };
    // Runs of version 0.1 have no seals.
    let seal = text.strip_prefix(SEAL).and_then(|rest| rest.split_once("\",\n"));
    let text = match seal {
        Some((seal, rest)) => {
            compare(path, seal, sha256(rest.as_bytes()))?;
            format!("{{\n{rest}")
        }
        // Only lists of sums begin with a digest: the seal itself is damaged.
        None if !path.ends_with(SUMS_FILE) && text.lines().nth(1).is_some_and(holds_digest) => {
            let found = e2h_core::one_line(text.lines().nth(1).unwrap_or_default().trim());
            let (quantity, expected) = ("seal".to_owned(), "\"sha256\"".to_owned());
            return Err(Error::Foreign { path: path.to_owned(), quantity, expected, found });
        }
        None => text,
    };
    serde_json::from_str(&text).map(Some).map_err(|e| Error::Foreign {
        path: path.to_owned(),
        quantity: "file".to_owned(),
        expected: "one that this run wrote".to_owned(),
        found: e.to_string(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seal_tells_damage() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.json");
        let identity = Identity {
            format: LAYOUT,
            task: "nut".to_owned(),
            preset: "smoke".to_owned(),
            seed: 7,
            method: auto_e2h(),
            policy: diffusion(),
            given: None,
        };
        let text = format!("{}\n", sealed(&serde_json::to_string_pretty(&identity).unwrap()));
        std::fs::write(&path, &text).unwrap();
        assert_eq!(RunFolder::open(dir.path()).unwrap().identity(), &identity);
        std::fs::write(&path, text.replace("\"seed\": 7", "\"seed\": 8")).unwrap();
        let message = RunFolder::open(dir.path()).unwrap_err().to_string();
        assert!(message.contains("SHA-256") && message.contains("run.json"), "{message}");
        // Plain JSON is read as it is.
        std::fs::write(&path, r#"{"format":1,"task":"nut","preset":"smoke","seed":7}"#).unwrap();
        let message = RunFolder::open(dir.path()).unwrap_err().to_string();
        assert!(message.contains("layout version 2") && message.contains("found 1"), "{message}");
    }
}
