//! A run of several ranks: rank 0 leads.
//!
//! All ranks call the same stages. Rank 0 alone reads and writes the run directory, and decides by what is there. The others have a
//! folder of their own on a disk that nobody has to share; what a stage left is sent there file by file, and read by the same code.

use super::Run;
use crate::directory::io;
use crate::gather::{Lanes, from_json, to_json};
use crate::policy_class::Training;
use crate::{Error, Result};
use e2h_core::{Solo, Team};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::cell::Cell;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::rc::Rc;

/// Bytes of a file that travel at a time.
const PIECE: u64 = 1 << 26;

/// The ranks of a run.
pub(super) struct Ranks {
    team: Rc<dyn Team>,
    /// Rank 0 is at something that the others wait for: it is a team of one until it is done.
    leading: Cell<bool>,
    /// The folder of another rank than 0.
    _folder: Option<tempfile::TempDir>,
}

impl Ranks {
    pub(super) fn new(team: Rc<dyn Team>, folder: Option<tempfile::TempDir>) -> Self {
        Self { team, leading: Cell::new(false), _folder: folder }
    }

    fn team(&self) -> &dyn Team {
        if self.leading.get() { &Solo } else { &*self.team }
    }
}

/// What `f` returns on rank 0, where alone it is called; nothing on the others. An error of it is an error of all.
pub(super) fn lead_alone<T>(team: &dyn Team, f: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
    if team.size() == 1 {
        return f().map(Some);
    }
    let mut told = vec![];
    let done = if team.rank() == 0 { Some(f()) } else { None };
    if let Some(Err(error)) = &done {
        told = format!("rank 0: {error}").into_bytes();
    }
    let heard = team.broadcast(&mut told);
    let done = done.transpose()?;
    heard?;
    if told.is_empty() { Ok(done) } else { Err(Error::Led(String::from_utf8_lossy(&told).into_owned())) }
}

/// What `f` returns on rank 0, where alone it is called, on every rank.
pub(super) fn lead<T: Serialize + DeserializeOwned>(
    team: &dyn Team,
    f: impl FnOnce() -> Result<T>,
) -> Result<T> {
    let done = lead_alone(team, f)?;
    let mut bytes = match &done {
        Some(value) if team.size() > 1 => to_json(value)?,
        _ => vec![],
    };
    team.broadcast(&mut bytes)?;
    done.map_or_else(|| from_json(&bytes), Ok)
}

impl Run {
    /// The ranks that are at the same stage as this one.
    pub(crate) fn team(&self) -> &dyn Team {
        self.ranks.team()
    }

    /// What rank 0 makes of `f`, on every rank. `f` may call stages; it is then as if there were no other ranks.
    pub(super) fn lead<T: Serialize + DeserializeOwned>(&self, f: impl FnOnce() -> Result<T>) -> Result<T> {
        lead(self.team(), || self.leading(f))
    }

    /// [`Run::lead`], for what cannot travel: on rank 0 alone.
    pub(super) fn lead_alone<T>(&self, f: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
        lead_alone(self.team(), || self.leading(f))
    }

    fn leading<T>(&self, f: impl FnOnce() -> Result<T>) -> Result<T> {
        let before = self.ranks.leading.replace(true);
        let done = f();
        self.ranks.leading.set(before);
        done
    }

    /// Simulations of this rank's share of `all` lanes: lane i is on rank i modulo the ranks.
    pub(super) fn lanes(&self, all: usize) -> Result<Lanes<'_>> {
        let team = self.team();
        let own = (team.rank()..all).step_by(team.size());
        let envs = own.map(|lane| Ok((lane, self.env.clone_shared()?))).collect::<Result<_>>()?;
        Ok(Lanes { envs, all, team })
    }

    /// Sends what lies at `places`, files or folders, from rank 0's folder to those of the others.
    pub(super) fn send(&self, places: &[String]) -> Result<()> {
        let team = self.team();
        if team.size() == 1 {
            return Ok(());
        }
        let files: Vec<(String, u64)> = self.lead(|| {
            let mut files = vec![];
            for place in places {
                list(self.dir.path(), place, &mut files)?;
            }
            Ok(files)
        })?;
        for (name, size) in files {
            let path = self.dir.join(&name);
            if team.rank() == 0 {
                let mut file = File::open(&path).map_err(io("reading", &path))?;
                for piece in pieces(size) {
                    let mut bytes = vec![0; piece];
                    file.read_exact(&mut bytes).map_err(io("reading", &path))?;
                    team.broadcast(&mut bytes)?;
                }
            } else {
                let folder = path.parent().unwrap_or(&path);
                std::fs::create_dir_all(folder).map_err(io("creating", folder))?;
                let mut file = File::create(&path).map_err(io("writing", &path))?;
                for _ in pieces(size) {
                    let mut bytes = vec![];
                    team.broadcast(&mut bytes)?;
                    file.write_all(&bytes).map_err(io("writing", &path))?;
                }
            }
        }
        Ok(())
    }

    /// Removes what was sent, once it is read. Rank 0 keeps all.
    pub(super) fn forget(&self, places: &[String]) -> Result<()> {
        if self.team().rank() == 0 {
            return Ok(());
        }
        for path in places.iter().map(|place| self.dir.join(place)).filter(|path| path.exists()) {
            let removed =
                if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
            removed.map_err(io("removing", &path))?;
        }
        Ok(())
    }

    /// Refuses to go on where ranks that should have the same weights have others.
    pub(super) fn compare_ranks(&self, training: &dyn Training, name: &str) -> Result<()> {
        let team = self.team();
        if team.size() == 1 {
            return Ok(());
        }
        let found = team.gather(training.fingerprint()?.unwrap_or_default().into_bytes())?;
        self.lead(|| {
            let others = || found.iter().enumerate().filter(|(_, print)| **print != found[0]);
            let ranks: Vec<String> = others().map(|(rank, _)| rank.to_string()).collect();
            if ranks.is_empty() {
                return Ok(());
            }
            Err(Error::Unlike {
                stage: name.to_owned(),
                step: training.step_count(),
                ranks: ranks.join(", "),
                size: team.size(),
            })
        })
    }
}

/// Sizes of the pieces that a file of `size` bytes travels in.
fn pieces(size: u64) -> impl Iterator<Item = usize> {
    (0..size.div_ceil(PIECE)).map(move |i| PIECE.min(size - i * PIECE) as usize)
}

/// Files at and below `place`, with their sizes; none where nothing is.
fn list(root: &Path, place: &str, files: &mut Vec<(String, u64)>) -> Result<()> {
    let path = root.join(place);
    let Ok(about) = std::fs::metadata(&path) else { return Ok(()) };
    if !about.is_dir() {
        files.push((place.to_owned(), about.len()));
        return Ok(());
    }
    for entry in std::fs::read_dir(&path).map_err(io("reading", &path))?.flatten() {
        list(root, &format!("{place}/{}", entry.file_name().to_string_lossy()), files)?;
    }
    Ok(())
}
