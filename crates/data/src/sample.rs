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
        // 0 <= wanted <= size.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::WindowConfig;
    use crate::fixture::episode;
    use e2h_core::{Episode, stream};

    fn windows(lengths: &[usize]) -> Windows {
        let episodes: Vec<Episode> = lengths.iter().map(|&n| episode(n)).collect();
        Windows::new(&episodes, &WindowConfig::default())
    }

    fn from_first(batch: &[Pick]) -> usize {
        batch.iter().filter(|p| p.set == Set::First).count()
    }

    #[test]
    fn half_of_every_batch_comes_from_each_set_however_large() {
        let sampler = Sampler::new(&windows(&[5]), &windows(&[300, 200]), 0.5).unwrap();
        let mut rng = stream(1, "batch", 0, 0);
        for _ in 0..50 {
            let batch = sampler.batch(32, &mut rng);
            assert_eq!(from_first(&batch), 16);
            assert!(batch.iter().all(|p| p.window < if p.set == Set::First { 5 } else { 500 }));
        }
    }

    #[test]
    fn a_broken_share_holds_on_average_and_windows_are_uniform() {
        let sampler = Sampler::new(&windows(&[10]), &windows(&[10]), 0.3).unwrap();
        let mut rng = stream(2, "batch", 0, 0);
        let picks: Vec<Pick> = (0..8000).flat_map(|_| sampler.batch(4, &mut rng)).collect();
        // 1.2 of 4; six standard deviations are 0.0067 of the share.
        assert!((from_first(&picks) as f64 / 32000.0 - 0.3).abs() < 0.007);
        for window in 0..10 {
            let share = picks.iter().filter(|p| p.window == window).count() as f64 / 32000.0;
            assert!((share - 0.1).abs() < 0.011, "window {window}: {share}");
        }
    }

    #[test]
    fn an_empty_set_leaves_all_to_the_other() {
        let mut rng = stream(3, "batch", 0, 0);
        let sampler = Sampler::new(&windows(&[9]), &windows(&[]), 0.5).unwrap();
        assert_eq!(from_first(&sampler.batch(7, &mut rng)), 7);
        let sampler = Sampler::new(&windows(&[0]), &windows(&[9]), 0.5).unwrap();
        assert_eq!(from_first(&sampler.batch(7, &mut rng)), 0);
        assert!(matches!(Sampler::new(&windows(&[]), &windows(&[0]), 0.5), Err(Error::NoWindows)));
    }

    #[test]
    fn a_stream_repeats() {
        let sampler = Sampler::new(&windows(&[40]), &windows(&[40]), 0.4).unwrap();
        let draw = || sampler.batch(64, &mut stream(4, "batch", 1, 2));
        assert_eq!(draw(), draw());
    }
}
