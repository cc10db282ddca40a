//! The closed loop of Auto-E2H: collection, iteration, evaluation and the run directory.
//!
//! A [`Run`] is the method with its stages as functions; `examples/nut_assembly.rs` reads them top to bottom.
//!
//! ```no_run
//! use e2h_learn::{Run, RunOptions};
//!
//! let set = vec!["loop.cycles=2".to_owned()];
//! let options = RunOptions { preset: "smoke".to_owned(), set, ..RunOptions::new("nut_assembly") };
//! let run = Run::open(&options)?;
//! let demonstrations = run.demonstrations()?;
//! let hard = run.train_initial(&demonstrations)?;
//! let record = run.evaluate(0, &*hard, None)?;
//! println!("{} of {}", record.evaluation.successes, record.evaluation.trials);
//! # Ok::<(), e2h_learn::Error>(())
//! ```

mod collect;
pub mod config;
mod digest;
mod directory;
mod error;
mod evaluate;
mod explore;
mod gather;
pub mod hub;
pub mod imitation;
mod method;
pub mod methods;
mod policy_class;
mod progress;
mod published;
mod rollout;
mod run;
mod stop;
mod tr_drl;

pub(crate) use e2h_report::picture;
pub use e2h_report::{self as report, record, tensorboard, view};

pub use collect::{Collected, collect};
pub use config::{Resolved, RunConfig};
pub use error::{Error, Result};
pub use evaluate::{Evaluated, Filmed, Filming, evaluate};
pub use explore::ExploreConfig;
pub use method::{Lesson, Method, Round, Tools};
pub use policy_class::{Diffusion, Job, PolicyClass, States, Trained, Training};
pub use progress::{Bar, Progress};
pub use published::Published;
use run::now;
pub use run::{Accepted, BuildTask, Demonstrations, Json, Parts, Run, RunOptions, Stored, set_threads};
pub use stop::Stop;
pub use tr_drl::{Demonstrated, Reward, TrDrlConfig};
