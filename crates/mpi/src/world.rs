//! The calls of a team, over MPI.

use crate::Error;
use e2h_core::{Result, Team, mention, tree_sum};
use mpi::Threading;
use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::{
    Communicator as _, CommunicatorCollectives as _, Destination as _, Root as _, Source as _,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Says how many seconds a rank waits for the others.
const WAIT: &str = "E2H_MPI_WAIT";
/// Seconds, where nothing is said: what rank 0 does alone, such as training a critic, may take long.
const USUAL_WAIT: u64 = 7200;
/// Status of a program that a panic ends, as everywhere in Rust.
const PANICKED: i32 = 101;
/// Status where a rank does not answer: that of `sysexits.h` for what may work another time.
const NO_ANSWER: u8 = 75;
/// Numbers that are summed at a time, and bytes that travel at a time: MPI counts in 32 bits.
const BLOCK: usize = 1 << 26;
/// How long a call may take once all ranks are in it, beside the time that it may wait for them.
const TRANSFER: Duration = Duration::from_secs(60);

/// All ranks of this program.
pub(crate) struct World {
    // Before the universe, which ends MPI when it goes.
    world: SimpleCommunicator,
    _universe: Universe,
    /// Milliseconds after `clock` at which the call in progress began, and one more; 0 between calls.
    since: Arc<AtomicU64>,
    clock: Instant,
    wait: Duration,
}

impl World {
    /// Starts MPI, and what ends all ranks when one of them panics or is stuck.
    pub(crate) fn start(expected: usize) -> crate::Result<Self> {
        let wait = match std::env::var(WAIT) {
            Err(_) => USUAL_WAIT,
            Ok(text) => text.parse().ok().filter(|s| *s > 0).ok_or(Error::Setting {
                name: WAIT,
                expected: "a number of seconds from 1",
                found: text,
            })?,
        };
        let failed = |expected, found: &str| Error::Start { expected, found: found.to_owned() };
        let (universe, level) = mpi::initialize_with_threading(Threading::Funneled)
            .ok_or_else(|| failed("a library that was not started yet", "one that was"))?;
        if level < Threading::Funneled {
            return Err(failed("calls of one thread beside others (funneled)", "a library for one thread"));
        }
        let world = universe.world();
        let (rank, size) = (world.rank(), world.size());
        // As where the program was built with another library than it was started with.
        if usize::try_from(size).ok() != Some(expected) {
            let found = format!("{size}: start the program with the library that it was built with");
            return Err(Error::Start { expected: "as many ranks as were started", found });
        }
        let main = std::thread::current().id();
        std::panic::set_hook(Box::new(move |panic| {
            mention(format_args!("rank {rank}: {panic}"));
            if std::thread::current().id() == main {
                SimpleCommunicator::world().abort(PANICKED);
            }
            // MPI may be called on the main thread alone; the launcher ends the others when a process dies.
            std::process::abort();
        }));
        let this = Self {
            world,
            _universe: universe,
            since: Arc::default(),
            clock: Instant::now(),
            wait: Duration::from_secs(wait),
        };
        this.watch();
        Ok(this)
    }

    /// Ends the process when a call does not return: the main thread is in the library then and cannot.
    fn watch(&self) {
        let (since, clock, limit) = (self.since.clone(), self.clock, self.wait + TRANSFER);
        let rank = self.world.rank();
        std::thread::spawn(move || {
            loop {
                std::thread::sleep(Duration::from_secs(1));
                let began = match since.load(Ordering::Relaxed) {
                    0 => continue,
                    began => Duration::from_millis(began - 1),
                };
                if clock.elapsed().saturating_sub(began) > limit {
                    mention(format_args!(
                        "rank {rank}: a call of MPI has not returned in {} s",
                        limit.as_secs()
                    ));
                    std::process::abort();
                }
            }
        });
    }

    /// Runs `call` once all ranks are there, which they wait for without keeping a core busy.
    fn together<T>(&self, call: impl FnOnce() -> T) -> T {
        let began = u64::try_from(self.clock.elapsed().as_millis()).unwrap_or(u64::MAX - 1);
        self.since.store(began + 1, Ordering::Relaxed);
        let start = Instant::now();
        let mut barrier = self.world.immediate_barrier();
        while let Err(open) = barrier.test() {
            barrier = open;
            let waited = start.elapsed();
            if waited > self.wait {
                let seconds = self.wait.as_secs();
                self.abort(
                    &format!("rank {}: another rank has not come in {seconds} s ({WAIT})", self.world.rank()),
                    NO_ANSWER,
                );
            }
            // At first at once, later not: what comes in a millisecond costs none, what takes minutes costs no core.
            if waited < Duration::from_micros(200) {
                std::thread::yield_now();
            } else {
                std::thread::sleep((waited / 10).clamp(Duration::from_micros(50), Duration::from_millis(10)));
            }
        }
        let done = call();
        self.since.store(0, Ordering::Relaxed);
        done
    }
}

impl Team for World {
    fn rank(&self) -> usize {
        // Never negative.
        self.world.rank().unsigned_abs() as usize
    }

    fn size(&self) -> usize {
        self.world.size().unsigned_abs() as usize
    }

    /// MPI moves the numbers; the order in which they are added is ours, where that of the library is no promise.
    fn sum(&self, numbers: &mut Vec<f32>) -> Result<()> {
        self.together(|| {
            for block in numbers.chunks_mut(BLOCK) {
                let part = block.len().div_ceil(self.size());
                let mut own = block.to_vec();
                own.resize(part * self.size(), 0.0);
                let mut parts = vec![0f32; own.len()];
                self.world.all_to_all_into(&own[..], &mut parts[..]);
                tree_sum(&mut parts, part);
                self.world.all_gather_into(&parts[..part], &mut own[..]);
                block.copy_from_slice(&own[..block.len()]);
            }
        });
        Ok(())
    }

    fn broadcast(&self, bytes: &mut Vec<u8>) -> Result<()> {
        self.together(|| {
            let root = self.world.process_at_rank(0);
            let mut length = bytes.len() as u64;
            root.broadcast_into(&mut length);
            bytes.resize(usize::try_from(length).unwrap_or(usize::MAX), 0);
            for block in bytes.chunks_mut(BLOCK) {
                root.broadcast_into(block);
            }
        });
        Ok(())
    }

    fn gather(&self, bytes: Vec<u8>) -> Result<Vec<Vec<u8>>> {
        Ok(self.together(|| {
            let mut lengths = vec![0u64; self.size()];
            self.world.all_gather_into(&(bytes.len() as u64), &mut lengths[..]);
            if self.rank() != 0 {
                let root = self.world.process_at_rank(0);
                bytes.chunks(BLOCK).for_each(|block| root.send(block));
                return vec![];
            }
            let mut all = vec![bytes];
            for (rank, length) in (0..).zip(lengths).skip(1) {
                let mut theirs = vec![0u8; usize::try_from(length).unwrap_or(usize::MAX)];
                for block in theirs.chunks_mut(BLOCK) {
                    self.world.process_at_rank(rank).receive_into(block);
                }
                all.push(theirs);
            }
            all
        }))
    }

    fn abort(&self, why: &str, status: u8) -> ! {
        if !why.is_empty() {
            mention(why);
        }
        self.world.abort(i32::from(status))
    }
}
