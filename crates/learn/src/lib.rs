//! The closed loop of Auto-E2H: collection, iteration, evaluation, run directory and report.

pub mod record;
pub mod report;
