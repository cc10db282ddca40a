//! What stages leave in the run directory, and how it is read again.

use super::{Accepted, Run};
use crate::directory::TRAINING;
use crate::policy_class::Trained;
use crate::record::Collection;
use crate::{Error, Result};
use e2h_core::Episode;
use e2h_policy::Provenance;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

/// Minutes that a stage took before it was saved and went on in another process, in the folder of its training state.
const SPENT: &str = "training.json";

/// What a stage leaves. Written whole or not at all; read again, it is what was written, or an error names the file.
pub trait Stored: Sized {
    /// Reads what lies at a place of the run directory; none when nothing does.
    ///
    /// # Errors
    /// When a file cannot be read, or is not what was written.
    fn read(run: &Run, place: &str) -> Result<Option<Self>>;

    /// Files and folders below the run directory that [`Stored::read`] needs: what is sent to other ranks.
    fn places(place: &str) -> Vec<String> {
        vec![place.to_owned()]
    }

    /// Writes it there. `minutes` is how long the stage took, over all processes that worked on it.
    ///
    /// # Errors
    /// When the folder cannot be written.
    fn write(&self, run: &Run, place: &str, minutes: f64) -> Result<()>;
}

/// A value with named fields, kept as JSON with a checksum: for stages of one's own.
#[derive(Debug, Clone, PartialEq)]
pub struct Json<T>(pub T);

impl Run {
    /// What is at `place` below the run directory; or what `make` makes, which is timed and stored there. `make` is called only if
    /// its result is needed, and on rank 0 alone.
    ///
    /// # Errors
    /// Those of `make`; when what is there is not what was written, or the folder cannot be written.
    pub fn stage<T: Stored>(&self, place: &str, make: impl FnOnce() -> Result<T>) -> Result<T> {
        self.stage_of_all(place, || self.lead_alone(make))
    }

    /// The same where all ranks have to call `make`; that of rank 0 returns what is stored, and the others read it.
    pub(super) fn stage_of_all<T: Stored>(
        &self,
        place: &str,
        make: impl FnOnce() -> Result<Option<T>>,
    ) -> Result<T> {
        let mut own = None;
        let there = self.lead(|| {
            own = T::read(self, place)?;
            Ok(own.is_some())
        })?;
        if !there {
            let (clock, spent) = (Instant::now(), self.spent(place)?);
            let made = make()?;
            self.lead(|| {
                let minutes = spent + clock.elapsed().as_secs_f64() / 60.0;
                made.as_ref().map_or(Ok(()), |made| made.write(self, place, minutes))?;
                own = made;
                Ok(())
            })?;
        }
        let places = T::places(place);
        self.send(&places)?;
        if self.team().rank() != 0 {
            own = T::read(self, place)?;
            self.forget(&places)?;
        }
        own.ok_or_else(|| Error::Team(format!("{place}: expected what rank 0 has, found nothing")))
    }

    /// Minutes that earlier processes spent on a stage that goes on from where they saved it.
    pub(super) fn spent(&self, place: &str) -> Result<f64> {
        let there = self.dir.join(format!("{place}/{TRAINING}")).exists();
        let spent = there.then(|| self.dir.get::<Spent>(&format!("{place}/{SPENT}"))).transpose()?.flatten();
        Ok(spent.map_or(0.0, |s| s.minutes))
    }

    /// Notes what [`Run::spent`] says from now on.
    pub(super) fn spend(&self, place: &str, minutes: f64) -> Result<()> {
        self.dir.put_sealed(&format!("{place}/{SPENT}"), &Spent { minutes })
    }
}

#[derive(Serialize, Deserialize)]
struct Spent {
    minutes: f64,
}

impl<T: Serialize + DeserializeOwned> Stored for Json<T> {
    fn read(run: &Run, place: &str) -> Result<Option<Self>> {
        Ok(run.dir.get(place)?.map(Self))
    }

    fn write(&self, run: &Run, place: &str, _: f64) -> Result<()> {
        run.dir.put_sealed(place, &self.0)
    }
}

/// Episodes, as a LeRobot dataset.
impl Stored for Vec<Episode> {
    fn read(run: &Run, place: &str) -> Result<Option<Self>> {
        Ok(run.dir.get_episodes::<BTreeMap<String, f64>>(place)?.map(|(episodes, _)| episodes))
    }

    fn write(&self, run: &Run, place: &str, minutes: f64) -> Result<()> {
        run.dir.put_episodes(place, self, &BTreeMap::from([("minutes", minutes)]))
    }
}

#[derive(Serialize, Deserialize)]
pub(super) struct AcceptedNotes {
    collection: Collection,
    pub(super) stage_minutes: BTreeMap<String, f64>,
    /// SHA-256 of what lies beside the segments. Runs of version 0.1 have none.
    #[serde(default)]
    files: BTreeMap<String, String>,
}

/// A file beside a place: in the same folder.
fn beside(place: &str, file: &str) -> String {
    let iteration = place.rsplit_once('/').map_or("", |(iteration, _)| iteration);
    format!("{iteration}/{file}")
}

/// Where the easy policy's own segments lie, beside the hard policy's.
fn easy_place(place: &str) -> String {
    beside(place, "easy_segments")
}

impl Stored for Accepted {
    fn read(run: &Run, place: &str) -> Result<Option<Self>> {
        let Some((segments, notes)) = run.dir.get_episodes::<AcceptedNotes>(place)? else { return Ok(None) };
        run.dir.verify_seals(&notes.files)?;
        let mut easy = vec![];
        if run.config().train.easy_update_steps > 0 {
            let found = run.dir.get_episodes::<usize>(&easy_place(place))?;
            easy.extend(found.into_iter().flat_map(|(episodes, _)| episodes).map(Arc::new));
        }
        let segments = segments.into_iter().map(Arc::new).collect();
        Ok(Some(Self { segments, easy, collection: notes.collection, stage_minutes: notes.stage_minutes }))
    }

    fn places(place: &str) -> Vec<String> {
        vec![place.to_owned(), easy_place(place)]
    }

    fn write(&self, run: &Run, place: &str, _: f64) -> Result<()> {
        // First, because the segments say that the round is done.
        if run.config().train.easy_update_steps > 0 {
            run.dir.put_episodes(&easy_place(place), &self.easy, &self.easy.len())?;
        }
        let notes = AcceptedNotes {
            collection: self.collection.clone(),
            stage_minutes: self.stage_minutes.clone(),
            files: run.dir.seals(&["filter.svg", "reversals.json"].map(|file| beside(place, file)))?,
        };
        run.dir.put_episodes(place, &self.segments, &notes)
    }
}

#[derive(Serialize, Deserialize)]
pub(super) struct TrainNotes {
    pub(super) minutes: f64,
    pub(super) loss: f64,
    /// Steps; runs of version 0.1 have none.
    #[serde(default)]
    pub(super) steps: usize,
    /// SHA-256 of the policy's files. Runs of version 0.1 have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    files: Option<BTreeMap<String, String>>,
    /// Of `policy.json` alone, in runs that were begun before `files`.
    #[serde(default, skip_serializing)]
    policy_sha256: Option<String>,
}

/// A trained policy, on its way into the run directory or out of it.
pub(super) struct PolicyStage {
    pub(super) policy: Box<dyn Trained>,
    pub(super) loss: f64,
    pub(super) steps: usize,
    pub(super) provenance: Provenance,
}

impl Stored for PolicyStage {
    fn read(run: &Run, place: &str) -> Result<Option<Self>> {
        let Some(notes) = run.dir.get::<TrainNotes>(&format!("{place}/notes.json"))? else { return Ok(None) };
        for (file, sum) in notes.files.iter().flatten() {
            run.dir.verify(&format!("{place}/{file}"), Some(sum))?;
        }
        run.dir.verify(&format!("{place}/policy.json"), notes.policy_sha256.as_deref())?;
        let policy = run.class.load(&run.dir.join(place), &run.compute)?;
        Ok(Some(Self { policy, loss: notes.loss, steps: notes.steps, provenance: Provenance::default() }))
    }

    fn write(&self, run: &Run, place: &str, minutes: f64) -> Result<()> {
        let folder = run.dir.join(place);
        self.policy.save(&folder, &self.provenance)?;
        let mut files = BTreeMap::new();
        run.dir.sums(place, "", &mut files)?;
        files.retain(|file, _| ![TRAINING, SPENT].contains(&file.as_str()) && !file.starts_with('.'));
        let notes = TrainNotes {
            minutes,
            loss: self.loss,
            steps: self.steps,
            files: Some(files),
            policy_sha256: None,
        };
        run.dir.put_sealed(&format!("{place}/notes.json"), &notes)?;
        for file in [TRAINING, SPENT].map(|file| folder.join(file)).iter().filter(|f| f.exists()) {
            std::fs::remove_file(file).map_err(|source| Error::Io {
                doing: "removing",
                path: file.clone(),
                source,
            })?;
        }
        Ok(())
    }
}
