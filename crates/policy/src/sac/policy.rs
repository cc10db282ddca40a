//! An actor and its adapter as a policy, and on disk.

use super::{Actor, Adapter, SacConfig};
use crate::folder::{read_description, read_verified, write_description, write_weights};
use crate::{Error, Provenance, Result};
use e2h_core::{ActionChunk, Observation, Policy, Rng};
use e2h_nn::{Compute, Mode, Weights};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Version of the folder's layout; a reader refuses others.
const FORMAT: u32 = 1;
/// The class of policies, as `policy.json` has it.
pub const KIND: &str = "sac";
const DESCRIPTION: &str = "policy.json";

/// A policy from states alone: the most likely action of an actor.
pub struct StatePolicy {
    actor: Actor,
    adapter: Adapter,
    hidden: Vec<usize>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: u32,
    kind: String,
    /// SHA-256 of the weights.
    sha256: String,
    hidden: Vec<usize>,
    adapter: Adapter,
    provenance: Provenance,
}

impl StatePolicy {
    /// A policy of an actor's weights.
    ///
    /// # Errors
    /// When they are not of these sizes.
    pub fn new(adapter: &Adapter, hidden: &[usize], weights: &Weights) -> Result<Self> {
        adapter.check()?;
        let config = SacConfig { hidden: hidden.to_vec(), ..SacConfig::default() };
        let problems = config.validate();
        if !problems.is_empty() {
            return Err(Error::Config(problems.join("; ")));
        }
        // All of it is overwritten.
        let mut rng = e2h_core::stream(0, "actor", 0, 0);
        let (o, a) = (adapter.observation(), adapter.action());
        let actor = Actor::new(o, a, &config, Mode::Infer, &Compute::cpu(), &mut rng)?;
        actor.load(weights)?;
        Ok(Self { actor, adapter: adapter.clone(), hidden: hidden.to_vec() })
    }

    /// The actor's weights by name.
    ///
    /// # Errors
    /// When they cannot be read back.
    pub fn weights(&self) -> Result<Weights> {
        self.actor.weights()
    }

    /// Writes a folder that stands alone.
    ///
    /// # Errors
    /// When a weight is not finite or the folder cannot be written.
    pub fn save(&self, folder: &Path, provenance: &Provenance) -> Result<()> {
        let sha256 = write_weights(folder, &self.weights()?, &BTreeMap::new())?;
        let file = File {
            format: FORMAT,
            kind: KIND.to_owned(),
            sha256,
            hidden: self.hidden.clone(),
            adapter: self.adapter.clone(),
            provenance: provenance.clone(),
        };
        write_description(folder, DESCRIPTION, &file)
    }

    /// Reads a folder of [`StatePolicy::save`].
    ///
    /// # Errors
    /// When a file is missing, foreign or damaged; names what was expected and found.
    pub fn load(folder: &Path) -> Result<(Self, Provenance)> {
        let path = folder.join(DESCRIPTION);
        let value = read_description(&path, Some(KIND), &[("format", FORMAT.into())])?;
        let fail = |problem: String| Error::Checkpoint { path: path.clone(), problem };
        let file: File = serde_json::from_value(value).map_err(|e| fail(e.to_string()))?;
        let weights = read_verified(folder, &file.sha256)?;
        let policy = Self::new(&file.adapter, &file.hidden, &weights)
            .map_err(|e| fail(e2h_core::one_line(&e.to_string())))?;
        Ok((policy, file.provenance))
    }
}

impl Policy for StatePolicy {
    fn n_obs_steps(&self) -> usize {
        1
    }

    fn act(&self, histories: &[Vec<&Observation>], _: &mut [Rng]) -> e2h_core::Result<Vec<ActionChunk>> {
        let one = |history: &Vec<&Observation>| -> Result<ActionChunk> {
            let Some(now) = history.last() else {
                return Err(Error::Observation {
                    quantity: "history".to_owned(),
                    expected: "1 observation".to_owned(),
                    found: "none".to_owned(),
                });
            };
            // One by one, so that what one environment gets does not depend on which others ask.
            let action = self.actor.act(&self.adapter.observe(&now.state), None)?;
            Ok(self.adapter.actions(&now.state, &action).to_vec())
        };
        histories.iter().map(|h| one(h).map_err(e2h_core::Error::from)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::REPEAT;
    use super::*;
    use e2h_core::{Direction, Episode, Origin, stream};

    #[test]
    fn a_saved_policy_acts_as_before_and_a_damaged_one_is_refused() {
        let mut episode = Episode::new(Origin::demonstration("test", Direction::Hard, 0, 0), &[]);
        episode.state = vec![[0.1; 15], [0.3; 15]];
        let adapter = Adapter::fit(&[&episode], &[[0.3; 15]], [0.0, 1.0, 0.0, 0.0], false).unwrap();
        let config = SacConfig { hidden: vec![8, 8], ..SacConfig::default() };
        let mut rng = stream(3, "test", 0, 0);
        let actor = Actor::new(19, 4, &config, Mode::Infer, &Compute::cpu(), &mut rng).unwrap();
        let policy = StatePolicy::new(&adapter, &config.hidden, &actor.weights().unwrap()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        policy.save(folder.path(), &Provenance::default()).unwrap();
        let (again, _) = StatePolicy::load(folder.path()).unwrap();
        let seen = Observation { state: [0.2; 15], frames: vec![] };
        let act = |p: &StatePolicy| p.act(&[vec![&seen]], &mut [stream(0, "act", 0, 0)]).unwrap();
        assert_eq!(act(&policy), act(&again));
        assert_eq!(act(&policy)[0].len(), REPEAT);
        let path = folder.path().join("policy.json");
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.replace("\"sac\"", "\"other\"")).unwrap();
        let refused = StatePolicy::load(folder.path()).err().unwrap().to_string();
        assert!(refused.contains("expected a policy of kind `sac`, found `other`"), "{refused}");
        std::fs::write(&path, text.replace("[\n    8,", "[\n    9,")).unwrap();
        assert!(StatePolicy::load(folder.path()).is_err());
    }
}
