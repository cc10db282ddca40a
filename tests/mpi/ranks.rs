//! Do the ranks of this machine or cluster work together? Sums numbers whose order shows, and tells the sum's hash and the time.
//!
//! ```text
//! cargo build --release -p e2h-mpi --features mpi --example ranks
//! mpirun -n 2 target/release/examples/ranks
//! ```
//!
//! The hash is the same for 1, 2, 4 and 8 ranks, and with every library. The first argument may be the count of numbers, by default
//! five million; the second `panic`, `fail` or `stuck`, which the last rank then does, to see the job end.

use e2h_core::{Failure, Team, fnv1a, say, tree_sum};
use std::time::{Duration, Instant};

/// Parts of the sum, however many ranks there are.
const SHARDS: usize = 8;
const ROUNDS: usize = 9;

/// Numbers of a part, of sizes so unlike that the order of their sum shows.
fn shard(part: usize, count: usize) -> impl Iterator<Item = f32> {
    let mut state = (part as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (0..count).map(move |_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let unit = (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5;
        unit * 2f32.powi((state & 31) as i32 - 16)
    })
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let count: usize = arguments.first().map_or(Ok(5_000_000), |text| text.parse())?;
    let team = e2h_mpi::team()?;
    let (rank, size) = (team.rank(), team.size());
    if !SHARDS.is_multiple_of(size) {
        team.abort(if rank == 0 { "expected 1, 2, 4 or 8 ranks" } else { "" }, 1);
    }
    let each = SHARDS / size;
    let mut mine: Vec<f32> = (rank * each..(rank + 1) * each).flat_map(|part| shard(part, count)).collect();
    tree_sum(&mut mine, count);
    mine.truncate(count);
    let (mut sum, mut times) = (vec![], vec![]);
    for round in 0..ROUNDS {
        if round == 2 && rank + 1 == size {
            go_wrong(&*team, arguments.get(1).map_or("", String::as_str));
        }
        sum.clone_from(&mine);
        team.broadcast(&mut vec![])?;
        let clock = Instant::now();
        team.sum(&mut sum)?;
        times.push(clock.elapsed());
    }
    times.sort();
    let own = fnv1a(sum.iter().flat_map(|v| v.to_le_bytes()));
    let all = team.gather(own.to_le_bytes().to_vec())?;
    if rank == 0 {
        let alike = if all.iter().all(|hash| *hash == all[0]) { "on all" } else { "AND OTHERS" };
        let ms = times[ROUNDS / 2].as_secs_f64() * 1e3;
        say(format_args!("{size} ranks, {count} numbers: {own:016x} {alike}, {ms:.1} ms"))?;
    }
    Ok(())
}

fn go_wrong(team: &dyn Team, how: &str) {
    match how {
        "panic" => std::panic::panic_any("as asked"),
        "fail" => team.abort("it failed, as asked", 3),
        "stuck" => std::thread::sleep(Duration::from_secs(3600)),
        _ => {}
    }
}
