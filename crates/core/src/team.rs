//! Several processes that work on one thing.

use crate::{Error, Result};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

/// Processes, called ranks, that run the same program and meet in the calls below, which all of them make in the same order.
///
/// What comes of a call depends on what the ranks brought and on nothing else: neither on which comes first, nor on the machines.
/// A rank that fails on its own calls [`Team::abort`]; nobody else can end those that wait for it.
pub trait Team {
    /// The number of this process, from 0.
    fn rank(&self) -> usize;

    /// How many processes there are.
    fn size(&self) -> usize;

    /// Leaves on every rank the sums of what the ranks have, entry by entry, added as [`tree_sum`] adds: neighbours first.
    ///
    /// # Shapes
    /// `numbers` is as long on every rank.
    ///
    /// # Errors
    /// When another rank cannot be reached.
    fn sum(&self, numbers: &mut Vec<f32>) -> Result<()>;

    /// Leaves on every rank what rank 0 has.
    ///
    /// # Errors
    /// When another rank cannot be reached.
    fn broadcast(&self, bytes: &mut Vec<u8>) -> Result<()>;

    /// What every rank brought, in their order, at rank 0; an empty list at the others.
    ///
    /// # Errors
    /// When another rank cannot be reached.
    fn gather(&self, bytes: Vec<u8>) -> Result<Vec<Vec<u8>>>;

    /// Ends all ranks: says `why`, where there is something to say, and makes `status` the program's.
    fn abort(&self, why: &str, status: u8) -> !;
}

/// A team of one: every call is done at once.
#[derive(Debug, Clone, Copy, Default)]
pub struct Solo;

impl Team for Solo {
    fn rank(&self) -> usize {
        0
    }

    fn size(&self) -> usize {
        1
    }

    fn sum(&self, _: &mut Vec<f32>) -> Result<()> {
        Ok(())
    }

    fn broadcast(&self, _: &mut Vec<u8>) -> Result<()> {
        Ok(())
    }

    fn gather(&self, bytes: Vec<u8>) -> Result<Vec<Vec<u8>>> {
        Ok(vec![bytes])
    }

    fn abort(&self, why: &str, status: u8) -> ! {
        if !why.is_empty() {
            crate::mention(why);
        }
        std::process::exit(i32::from(status))
    }
}

/// Whether `bytes` are the same on all ranks; the answer is, too.
///
/// # Errors
/// When another rank cannot be reached.
pub fn all_alike(team: &dyn Team, bytes: &[u8]) -> Result<bool> {
    let all = team.gather(bytes.to_vec())?;
    let mut alike = vec![u8::from(all.windows(2).all(|pair| pair[0] == pair[1]))];
    team.broadcast(&mut alike)?;
    Ok(alike == [1])
}

/// Leaves the sum of the parts of `numbers`, of `part` numbers each, in the first: a balanced tree, whose order is that of the parts.
/// A tree of trees over neighbouring parts is the same tree where their number is a power of two, so it does not show how many ranks
/// shared the work.
///
/// ```
/// let mut numbers = [1.0, 10.0, 2.0, 20.0, 3.0, 30.0];
/// e2h_core::tree_sum(&mut numbers, 2);
/// assert_eq!(numbers[..2], [6.0, 60.0]);
/// ```
pub fn tree_sum(numbers: &mut [f32], part: usize) {
    let mut step = part.max(1);
    while step < numbers.len() {
        for pair in numbers.chunks_mut(2 * step).filter(|pair| pair.len() > step) {
            let (a, b) = pair.split_at_mut(step);
            a[..part].iter_mut().zip(&b[..part]).for_each(|(a, b)| *a += b);
        }
        step *= 2;
    }
}

/// How long a thread waits for another, before it takes it for lost.
const PATIENCE: Duration = Duration::from_secs(600);

/// A team of threads of one process: what a program does with a team can be tried without any library.
///
/// ```
/// use e2h_core::{Team as _, Threads};
///
/// let sums = Threads::run(4, |team| {
///     let mut numbers = vec![team.rank() as f32];
///     team.sum(&mut numbers).map(|()| numbers[0])
/// });
/// assert!(sums.into_iter().all(|sum| sum.unwrap() == 6.0));
/// ```
#[derive(Debug)]
pub struct Threads {
    rank: usize,
    /// To every rank, and from every rank.
    to: Vec<Sender<Vec<u8>>>,
    from: Vec<Receiver<Vec<u8>>>,
}

impl Threads {
    /// Runs `work` on `size` threads; what they return is in the order of their ranks.
    ///
    /// # Panics
    /// When one of them does.
    pub fn run<T: Send>(size: usize, work: impl Fn(Self) -> T + Sync) -> Vec<T> {
        let mut members: Vec<Self> = (0..size).map(|rank| Self { rank, to: vec![], from: vec![] }).collect();
        for source in 0..size {
            for place in 0..size {
                let (to, from) = channel();
                members[source].to.push(to);
                members[place].from.push(from);
            }
        }
        std::thread::scope(|scope| {
            let work = &work;
            let started: Vec<_> =
                members.into_iter().map(|member| scope.spawn(move || work(member))).collect();
            let joined = started.into_iter().map(std::thread::ScopedJoinHandle::join);
            joined.map(|done| done.unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
        })
    }

    /// What every rank brought, on every rank.
    fn exchange(&self, bytes: &[u8]) -> Result<Vec<Vec<u8>>> {
        let lost = |rank: usize, why: &str| Error::Team { rank, problem: why.to_owned() };
        for (rank, to) in self.to.iter().enumerate() {
            to.send(bytes.to_vec()).map_err(|_| lost(rank, "it has ended"))?;
        }
        let from = self.from.iter().enumerate();
        from.map(|(rank, from)| {
            from.recv_timeout(PATIENCE).map_err(|e| match e {
                RecvTimeoutError::Timeout => lost(rank, "it is silent"),
                RecvTimeoutError::Disconnected => lost(rank, "it has ended"),
            })
        })
        .collect()
    }
}

impl Team for Threads {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.to.len()
    }

    fn sum(&self, numbers: &mut Vec<f32>) -> Result<()> {
        let bytes: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
        let all = self.exchange(&bytes)?.concat();
        let mut all: Vec<f32> = all.as_chunks().0.iter().map(|number| f32::from_le_bytes(*number)).collect();
        tree_sum(&mut all, numbers.len());
        all.truncate(numbers.len());
        *numbers = all;
        Ok(())
    }

    fn broadcast(&self, bytes: &mut Vec<u8>) -> Result<()> {
        let mut all = self.exchange(bytes)?;
        *bytes = all.swap_remove(0);
        Ok(())
    }

    fn gather(&self, bytes: Vec<u8>) -> Result<Vec<Vec<u8>>> {
        let all = self.exchange(&bytes)?;
        Ok(if self.rank == 0 { all } else { vec![] })
    }

    /// # Panics
    /// Always: a thread has no other way to end the rest.
    fn abort(&self, why: &str, status: u8) -> ! {
        std::panic::panic_any(format!("rank {} ends all with status {status}: {why}", self.rank))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sizes so unlike that the order of a sum shows.
    fn unlike(part: usize) -> Vec<f32> {
        (0..5_u32)
            .map(|i| (1.0 + part as f32 / 7.0) * 10f32.powi(((part as i32 * 5) % 9) - i as i32))
            .collect()
    }

    #[test]
    fn a_sum_has_the_same_bits_however_many_ranks_share_it() {
        let sums = [1, 2, 4, 8].map(|size| {
            let all = Threads::run(size, |team| {
                let mine = team.rank() * 8 / size..(team.rank() + 1) * 8 / size;
                let mut numbers: Vec<f32> = mine.flat_map(unlike).collect();
                tree_sum(&mut numbers, 5);
                numbers.truncate(5);
                team.sum(&mut numbers).unwrap();
                numbers
            });
            assert!(all.iter().all(|sum| *sum == all[0]));
            all[0].clone()
        });
        assert!(sums.iter().all(|sum| *sum == sums[0]), "{sums:?}");
        let mut in_order = vec![0.0; 5];
        for part in 0..8 {
            in_order.iter_mut().zip(unlike(part)).for_each(|(sum, v)| *sum += v);
        }
        assert_ne!(in_order, sums[0], "numbers whose order does not show");
    }

    #[test]
    fn what_ranks_bring_arrives_in_their_order() {
        let all = Threads::run(3, |team| {
            let mut word = vec![b'a' + team.rank() as u8];
            let gathered = team.gather(word.clone()).unwrap();
            let alike = [all_alike(&team, b"x").unwrap(), all_alike(&team, &word).unwrap()];
            team.broadcast(&mut word).unwrap();
            (gathered.concat(), word, alike)
        });
        let expect = |at_first: &[u8]| (at_first.to_vec(), b"a".to_vec(), [true, false]);
        assert_eq!(all, [expect(b"abc"), expect(b""), expect(b"")]);
    }

    #[test]
    fn a_rank_that_has_gone_is_named() {
        let all = Threads::run(2, |team| if team.rank() == 1 { Ok(()) } else { team.sum(&mut vec![1.0]) });
        // It may still be there to hear, but it says nothing.
        let message = all[0].as_ref().unwrap_err().to_string();
        assert!(message.contains("rank 1") && message.contains("has ended"), "{message}");
    }

    #[test]
    fn a_team_of_one_changes_nothing() {
        let mut numbers = vec![0.1, -3.0];
        Solo.sum(&mut numbers).unwrap();
        assert_eq!(numbers, [0.1, -3.0]);
        assert_eq!(Solo.gather(vec![7]).unwrap(), [[7]]);
        assert!(all_alike(&Solo, &[1]).unwrap());
    }
}
