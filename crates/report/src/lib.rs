//! What a run of Auto-E2H measured ([`record`]), and what people look at: the report of a run ([`write_report`]), a page of
//! every episode of a run or a dataset ([`view`]), curves ([`chart`], [`curve`]), films ([`animation`]) and event files for
//! TensorBoard ([`tensorboard`]).
//!
//! Knows neither Candle nor MuJoCo, nothing of policies, simulators or how a run is made: it reads what lies in the run's
//! folder ([`folder`]). Pages and pictures are pure functions of their arguments: the same results give the same bytes.
//! Nothing in them refers to a file or a server elsewhere; pictures are inline SVG or base64 PNG.
//!
//! ```
//! use e2h_report::record::{Evaluation, IterationRecord, RunResults, wilson95};
//! use e2h_report::{Pictures, chart, table, write_report};
//!
//! let row = |iteration: u32, successes| IterationRecord {
//!     iteration,
//!     evaluation: Evaluation { successes, trials: 50, wilson95: wilson95(successes, 50), mean_steps: 180.0, seconds: 60.0, outcomes: vec![] },
//!     minutes: 12.0 * f64::from(iteration + 1),
//!     stage_minutes: [("train".to_owned(), 9.0)].into(),
//!     collection: None,
//!     loss: 0.01,
//!     skipped: false,
//!     updates: 1500,
//! };
//! let results = RunResults {
//!     task: "nut_assembly".to_owned(),
//!     iterations: vec![row(0, 14), row(1, 33)],
//!     ..RunResults::default()
//! };
//! assert!(table::iterations(&results).contains("33/50"));
//! assert!(chart::success_curve(&[&results]).starts_with("<svg"));
//!
//! let folder = tempfile::tempdir()?;
//! let page = write_report(folder.path(), &results, "seed = 0\n", &Pictures::default())?;
//! assert!(std::fs::read_to_string(page)?.contains("nut_assembly"));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod animation;
pub mod chart;
pub mod compare;
pub mod curve;
mod error;
mod fate;
pub mod filter;
pub mod folder;
pub mod page;
pub mod picture;
mod png_image;
pub mod record;
pub mod statistics;
mod svg;
pub mod table;
pub mod tensorboard;
pub mod view;

#[cfg(test)]
mod sample;

use e2h_data::write_atomic;
use record::RunResults;
use std::path::{Path, PathBuf};

pub use error::{Error, Result};
pub use page::Pictures;
pub use png_image::png_bytes;

/// Name of the page in a run's folder.
pub const REPORT_FILE: &str = "report.html";

/// Writes [`REPORT_FILE`] into `dir` (made when missing) and returns its path. An older page stays whole until the new
/// one replaces it.
///
/// # Errors
/// [`Error::Data`] with the path.
pub fn write_report(
    dir: &Path,
    results: &RunResults,
    config_toml: &str,
    pictures: &Pictures,
) -> Result<PathBuf> {
    let path = dir.join(REPORT_FILE);
    write_atomic(&path, page::html(results, config_toml, pictures).as_bytes())?;
    Ok(path)
}

/// Writes a drawing to `path`, whole or not at all.
///
/// # Errors
/// [`Error::Data`] with the path.
pub fn write_svg(path: &Path, svg: &str) -> Result<()> {
    Ok(write_atomic(path, svg.as_bytes())?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_replaces_the_one_before_and_leaves_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("run");
        let results = sample::results(1, 3);
        write_report(&folder, &results, "seed = 1\n", &Pictures::default()).unwrap();
        let path = write_report(&folder, &results, "seed = 2\n", &Pictures::default()).unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().contains("seed = 2"));
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    }

    #[test]
    fn what_cannot_be_written_is_named() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("file"), "in the way").unwrap();
        let path = dir.path().join("file").join("x.svg");
        let message = write_svg(&path, "<svg/>").unwrap_err().to_string();
        assert!(message.contains("file"), "{message}");
    }
}
