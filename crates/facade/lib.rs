//! Auto-E2H: learning hard manipulation from easy, reversed tasks. Re-exports of the single crates.
pub use e2h_core as core;
pub use e2h_data as data;
pub use e2h_env as env;
pub use e2h_learn as learn;
pub use e2h_mpi as mpi;
pub use e2h_nn as nn;
pub use e2h_policy as policy;
pub use e2h_refine as refine;
pub use e2h_report as report;
pub use e2h_serve as serve;
pub use e2h_teleop as teleop;
