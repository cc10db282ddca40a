//! Policies in the layout that LeRobot reads and writes: `DiffusionPolicy` of LeRobot 0.4.4.
//!
//! [`export`] turns a checkpoint of ours into a folder that `DiffusionPolicy.from_pretrained` opens, with pre- and
//! post-processor; [`obstacles`] says what of a configuration LeRobot cannot express. [`import`] opens such a folder, whatever
//! the widths of its state and action are, and [`LerobotPolicy::into_policy`] makes one of ours of it where they are this
//! project's. [`save`] writes what a [`crate::Trainer`] learned from recordings of any robot. Batch norm is folded into the convolutions: such a policy acts, and is not trained further.
//!
//! | file | holds |
//! |---|---|
//! | `config.json` | architecture, features, sampler |
//! | `model.safetensors` | weights; [`HEADER`] in its metadata says where they come from |
//! | `policy_preprocessor.json` | steps before the network; names the file of the ranges of observations |
//! | `policy_postprocessor.json` | steps after it; names the file of the ranges of actions |
//! | `policy.json` | not LeRobot's: what makes the folder one of our checkpoints too |
//!
//! # Source
//! LeRobot 0.4.4 (`policies/diffusion`, `processor/normalize_processor.py`); checked against it by `tests/interop/run.sh`.

mod description;
mod export;
mod features;
mod fold;
mod import;
mod policy;
mod processors;
mod scaling;

pub use description::{Obstacle, network_obstacles, obstacles};
pub use export::{Exported, HEADER, export, save};
pub use features::Features;
pub use import::import;
pub use policy::{LerobotObservation, LerobotPolicy};
pub use scaling::{IMAGENET, Scaling, Scalings};

const CONFIG_FILE: &str = "config.json";
const WEIGHTS_FILE: &str = "model.safetensors";
/// A buffer of LeRobot's that is computed here: the positions of the spatial softmax.
pub(crate) const POSITION_GRID: &str = ".pool.pos_grid";
/// LeRobot's guard against divisions by zero.
const EPS: f64 = 1e-8;
const STATE: &str = "observation.state";
const ENVIRONMENT: &str = "observation.environment_state";
const IMAGES: &str = "observation.images.";
const ACTION: &str = "action";
