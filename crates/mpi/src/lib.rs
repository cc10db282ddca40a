//! The ranks that `mpirun` or `srun` started, as a [`Team`].
//!
//! Without its feature `mpi` this crate has no dependency and no team but [`Solo`]; it then only notices that it was started several
//! times. Deliberately knows nothing of what the ranks do together.
//!
//! ```
//! // Started by hand it is a team of one, with the feature and without.
//! let team = e2h_mpi::team()?;
//! assert_eq!((team.rank(), team.size()), (0, 1));
//! # Ok::<(), e2h_mpi::Error>(())
//! ```

#[cfg(feature = "mpi")]
mod world;

use e2h_core::{Solo, Team};
use std::rc::Rc;

/// Why there is no team.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Several processes were started of a program that cannot speak to others.
    #[error(
        "expected one process, found {found} started together: this program was built without MPI; build it with `--features mpi` \
         (needs mpicc and libclang), or start it without mpirun or srun"
    )]
    NotBuilt {
        /// How many were started.
        found: usize,
    },
    /// The library did not start.
    #[error("MPI: expected {expected}, found {found}")]
    Start {
        /// What is needed.
        expected: &'static str,
        /// What it said.
        found: String,
    },
    /// A setting of the environment is not what it should be.
    #[error("{name}: expected {expected}, found `{found}`")]
    Setting {
        /// The variable.
        name: &'static str,
        /// What is needed.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// Where launchers say a process's rank and how many there are: Open MPI's, those that speak PMI (MPICH, Intel, SLURM) and PMIx.
const LAUNCHERS: [[&str; 2]; 3] = [
    ["OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"],
    ["PMI_RANK", "PMI_SIZE"],
    ["PMIX_RANK", "SLURM_STEP_NUM_TASKS"],
];

/// Rank and number of processes, as a launcher says; none where nothing launched this process beside others.
fn launched(variable: impl Fn(&str) -> Option<String>) -> Option<(usize, usize)> {
    let number = |name| variable(name)?.parse::<usize>().ok();
    let found = LAUNCHERS.iter().find_map(|[rank, size]| Some((number(rank)?, number(size)?)));
    found.filter(|(_, size)| *size > 1)
}

fn environment() -> Option<(usize, usize)> {
    launched(|name| std::env::var(name).ok())
}

/// Whether this process is the one that speaks for all that were started with it, as far as their launcher has said. For what fails
/// before there is a team.
#[must_use]
pub fn speaks() -> bool {
    environment().is_none_or(|(rank, _)| rank == 0)
}

/// The processes that were started together, or [`Solo`]. To be called once, on the main thread, where all its calls have to be made too.
///
/// From here on a panic on any thread ends all ranks, as does a rank that waits for another longer than `E2H_MPI_WAIT` seconds (two
/// hours where that is not set).
///
/// # Errors
/// When several processes were started of a program without the feature `mpi`, or the library does not start.
pub fn team() -> Result<Rc<dyn Team>> {
    let Some((_, size)) = environment() else { return Ok(Rc::new(Solo)) };
    several(size)
}

#[cfg(feature = "mpi")]
fn several(size: usize) -> Result<Rc<dyn Team>> {
    Ok(Rc::new(world::World::start(size)?))
}

#[cfg(not(feature = "mpi"))]
fn several(found: usize) -> Result<Rc<dyn Team>> {
    Err(Error::NotBuilt { found })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launchers_are_told_from_a_start_by_hand() {
        let of = |set: &'static [(&str, &str)]| {
            launched(|name| set.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned()))
        };
        assert_eq!(of(&[("OMPI_COMM_WORLD_RANK", "3"), ("OMPI_COMM_WORLD_SIZE", "4")]), Some((3, 4)));
        assert_eq!(of(&[("PMI_RANK", "0"), ("PMI_SIZE", "2")]), Some((0, 2)));
        assert_eq!(of(&[("PMIX_RANK", "1"), ("SLURM_STEP_NUM_TASKS", "2")]), Some((1, 2)));
        // One of a batch script's processes, a rank alone, nothing.
        assert_eq!(of(&[("SLURM_NTASKS", "4"), ("SLURM_PROCID", "0")]), None);
        assert_eq!(of(&[("OMPI_COMM_WORLD_RANK", "0"), ("OMPI_COMM_WORLD_SIZE", "1")]), None);
        assert_eq!(of(&[]), None);
    }

    #[cfg(not(feature = "mpi"))]
    #[test]
    fn a_program_without_the_feature_says_how_to_build_it() {
        let message = several(4).err().map(|e| e.to_string()).unwrap_or_default();
        assert!(message.contains("found 4") && message.contains("--features mpi"), "{message}");
    }
}
