//! What can be served: what a policy sees, what it answers, and what it is.

use crate::wire::Value;
use crate::{Error, Result};
use e2h_core::{ACTION_DIM, Action, CONTROL_HZ, Image, Observation, Rng, STATE_DIM};
use e2h_data::lerobot::{ACTION_NAMES, STATE_NAMES};
use e2h_nn::Compute;
use e2h_policy::lerobot::{LerobotObservation, LerobotPolicy};
use e2h_policy::{DiffusionPolicy, Provenance};
use rand::Rng as _;
use std::path::Path;

/// A camera that a policy looks through.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Camera {
    /// Its name, without `observation.images.`.
    pub name: String,
    /// Rows of its images.
    pub height: usize,
    /// Columns of its images.
    pub width: usize,
}

/// What a policy takes and gives.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Inputs {
    /// Class of the policy.
    pub kind: String,
    /// Numbers of the state.
    pub state: usize,
    /// Their names, where somebody gave them some.
    pub state_names: Vec<String>,
    /// Numbers of LeRobot's `observation.environment_state`; 0 for most.
    pub environment: usize,
    /// Its cameras, in order.
    pub cameras: Vec<Camera>,
    /// Observations of a history, To.
    pub n_obs_steps: usize,
    /// Actions of an answer, Ta.
    pub n_action_steps: usize,
    /// Numbers of an action.
    pub action: usize,
    /// Their names, where somebody gave them some.
    pub action_names: Vec<String>,
    /// Actions a second that it was trained for, where that is known.
    pub control_hz: Option<f64>,
    /// Where it comes from, where that is known.
    pub provenance: Option<Provenance>,
}

impl Inputs {
    /// The first message of a connection.
    #[must_use]
    pub fn metadata(&self) -> Value {
        let names = |names: &[String]| names.iter().map(String::as_str).collect::<Value>();
        let camera = |c: &Camera| {
            let (height, width) = (c.height.into(), c.width.into());
            Value::map([("name", Value::from(c.name.as_str())), ("height", height), ("width", width)])
        };
        let mut all = vec![
            ("kind", Value::from(self.kind.as_str())),
            ("version", env!("CARGO_PKG_VERSION").into()),
            ("state_width", self.state.into()),
            ("state_names", names(&self.state_names)),
            ("environment_width", self.environment.into()),
            ("cameras", self.cameras.iter().map(camera).collect()),
            ("n_obs_steps", self.n_obs_steps.into()),
            ("n_action_steps", self.n_action_steps.into()),
            ("action_width", self.action.into()),
            ("action_names", names(&self.action_names)),
            // Our own clients ask for answers from a stream of theirs then.
            (crate::request::STREAM, Value::Bool(true)),
        ];
        all.extend(self.control_hz.map(|hz| ("control_hz", hz.into())));
        if let Some(p) = &self.provenance {
            all.push(("task", p.task.as_str().into()));
            all.extend(p.direction.map(|d| ("direction", d.name().into())));
            let mut origin = vec![
                ("preset", Value::from(p.preset.as_str())),
                ("seed", p.seed.into()),
                ("iteration", u64::from(p.iteration).into()),
                ("version", p.version.as_str().into()),
            ];
            if !p.run.is_null() {
                // So that an evaluation can rebuild the environment, as it does from the checkpoint itself.
                origin.push(("run", Value::Text(p.run.to_string())));
            }
            all.push(("provenance", Value::map(origin)));
        }
        Value::map(all)
    }
}

/// What a policy sees at one step, in the units of its data.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Seen {
    /// The state.
    pub state: Vec<f32>,
    /// LeRobot's `observation.environment_state`; empty for most.
    pub environment: Vec<f32>,
    /// One image per camera, in order.
    pub images: Vec<Image>,
}

/// A policy that a [`crate::Server`] can answer with.
///
/// The server calls it from one thread, with all histories that wait. It has seen to it that histories have the widths, sizes
/// and lengths of [`Inputs`], and only finite numbers.
pub trait Servable: Send {
    /// What it takes and gives. Never changes.
    fn inputs(&self) -> Inputs;

    /// The next actions of each history.
    ///
    /// # Shapes
    /// `histories` (B, To), oldest first; `rngs` (B), one stream a history, so that what one gets does not depend on which others are
    /// there. The result is (B, Ta, action).
    ///
    /// # Errors
    /// When the observations do not fit the policy, or the network fails.
    fn act(&self, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> Result<Vec<Vec<Vec<f32>>>>;
}

impl Servable for DiffusionPolicy {
    fn inputs(&self) -> Inputs {
        let c = self.config();
        let (height, width) = (c.image_size, c.image_size);
        let camera = |name: &String| Camera { name: name.clone(), height, width };
        Inputs {
            kind: "diffusion".to_owned(),
            state: STATE_DIM,
            state_names: STATE_NAMES.map(str::to_owned).to_vec(),
            environment: 0,
            cameras: c.cameras.iter().map(camera).collect(),
            n_obs_steps: c.n_obs_steps,
            n_action_steps: c.n_action_steps,
            action: ACTION_DIM,
            action_names: ACTION_NAMES.map(str::to_owned).to_vec(),
            control_hz: Some(CONTROL_HZ),
            provenance: None,
        }
    }

    fn act(&self, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> Result<Vec<Vec<Vec<f32>>>> {
        let ours = |seen: Seen| {
            let found = seen.state.len().to_string();
            let state = seen.state.try_into();
            let state = state.map_err(|_| Error::mismatch("state", format!("{STATE_DIM} numbers"), found))?;
            Ok(Observation { state, frames: seen.images })
        };
        let histories: Vec<Vec<Observation>> = histories
            .into_iter()
            .map(|history| history.into_iter().map(ours).collect::<Result<_>>())
            .collect::<Result<_>>()?;
        let histories: Vec<Vec<&Observation>> = histories.iter().map(|h| h.iter().collect()).collect();
        let row = |action: Action| action.to_vec();
        let chunks = self.sample(&histories, rngs)?;
        Ok(chunks.into_iter().map(|chunk| chunk.into_iter().map(row).collect()).collect())
    }
}

impl Servable for LerobotPolicy {
    fn inputs(&self) -> Inputs {
        let [height, width] = self.image_size();
        let short = |name: &str| {
            let name = name.strip_prefix("observation.").unwrap_or(name);
            name.strip_prefix("images.").unwrap_or(name).to_owned()
        };
        let camera = |name: &str| Camera { name: short(name), height, width };
        // What `train` wrote of the datasets it learned from; other folders do not say.
        let known = |key: &str| self.provenance().and_then(|p| p.run.get(key));
        let names = |key: &str| -> Vec<String> {
            let list = known(key).and_then(serde_json::Value::as_array);
            list.into_iter().flatten().filter_map(|v| Some(v.as_str()?.to_owned())).collect()
        };
        Inputs {
            kind: "lerobot diffusion".to_owned(),
            state: self.state_dim(),
            state_names: names("state"),
            environment: self.environment_dim(),
            cameras: self.cameras().map(camera).collect(),
            n_obs_steps: self.n_obs_steps(),
            n_action_steps: self.n_action_steps(),
            action: self.action_dim(),
            action_names: names("action"),
            control_hz: known("fps").and_then(serde_json::Value::as_f64),
            provenance: self.provenance().cloned(),
        }
    }

    fn act(&self, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> Result<Vec<Vec<Vec<f32>>>> {
        let theirs =
            |s: Seen| LerobotObservation { state: s.state, environment: s.environment, images: s.images };
        let histories: Vec<Vec<LerobotObservation>> =
            histories.into_iter().map(|history| history.into_iter().map(theirs).collect()).collect();
        let histories: Vec<Vec<&LerobotObservation>> = histories.iter().map(|h| h.iter().collect()).collect();
        let per = self.horizon() * self.action_dim();
        Ok(self.sample(&histories, &mut |noise| {
            for (row, rng) in noise.chunks_exact_mut(per).zip(rngs.iter_mut()) {
                row.fill_with(|| rng.sample(rand_distr::StandardNormal));
            }
        })?)
    }
}

/// A policy that knows where it comes from.
struct Known<P>(P, Provenance);

impl<P: Servable> Servable for Known<P> {
    fn inputs(&self) -> Inputs {
        Inputs { provenance: Some(self.1.clone()), ..self.0.inputs() }
    }

    fn act(&self, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> Result<Vec<Vec<Vec<f32>>>> {
        self.0.act(histories, rngs)
    }
}

/// Opens a folder as what can be served: one of ours (`policy.json`), otherwise one of LeRobot's (`config.json`).
///
/// # Errors
/// When a file is missing, foreign or does not match; names what was expected and found.
pub fn open(folder: &Path) -> Result<Box<dyn Servable>> {
    open_on(folder, &Compute::cpu())
}

/// The same, with its network on a device.
///
/// # Errors
/// As [`open`], and when the device fails.
pub fn open_on(folder: &Path, compute: &Compute) -> Result<Box<dyn Servable>> {
    if folder.join("config.json").exists() && !folder.join("policy.json").exists() {
        return Ok(Box::new(e2h_policy::lerobot::import(folder)?.into_device(compute)?));
    }
    let (policy, checkpoint) = DiffusionPolicy::load(folder)?;
    Ok(Box::new(Known(policy.into_device(compute)?, checkpoint.provenance)))
}
