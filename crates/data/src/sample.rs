use crate::{Error, Result, Windows};
use e2h_core::Rng;
use rand::Rng as _;

/// Which set a window comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Set {
    /// The initial demonstrations, `D_h^(0)`.
    First,
    /// What refinement accepted, `D_filt^(n)`.
    Second,
}

/// One drawn window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Pick {
    /// Its set.
    pub set: Set,
    /// Its index there.
    pub window: usize,
}

/// Draws batches from two sets: a fixed share from each, with equal chances inside a set.
///
/// # Source
/// "Sampled with a 1:1 weighting": `share` 0.5.
#[derive(Debug, Clone, PartialEq)]
pub struct Sampler {
    first: usize,
    second: usize,
    share: f64,
}

impl Sampler {
    /// `share` is the part of every batch that comes from `first`, 0 to 1; all of it while `second` is empty, none while
    /// `first` is.
    ///
    /// # Errors
    /// When both sets are empty.
    pub fn new(first: &Windows, second: &Windows, share: f64) -> Result<Self> {
        let share = match (first.len(), second.len()) {
            (0, 0) => return Err(Error::NoWindows),
            (_, 0) => 1.0,
            (0, _) => 0.0,
            _ => share.clamp(0.0, 1.0),
        };
        Ok(Self { first: first.len(), second: second.len(), share })
    }

    /// `size` windows, those of the first set first. A share that is no whole number of windows is rounded up or down by
    /// chance, so that it holds on average.
    #[must_use]
    pub fn batch(&self, size: usize, rng: &mut Rng) -> Vec<Pick> {
        let wanted = self.share * size as f64;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 <= wanted <= size")]
        let whole = wanted.floor() as usize;
        let part = wanted - wanted.floor();
        let from_first = whole + usize::from(part > 0.0 && rng.random_bool(part));
        let mut draw = |i| {
            let (set, windows) =
                if i < from_first { (Set::First, self.first) } else { (Set::Second, self.second) };
            // 64 bits whatever the machine, so that every machine draws the same numbers.
            let window = rng.random_range(0..windows as u64);
            Pick { set, window: usize::try_from(window).unwrap_or(0) }
        };
        (0..size).map(&mut draw).collect()
    }
}
