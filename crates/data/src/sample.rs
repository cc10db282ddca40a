use crate::{Error, Result, Windows};
use e2h_core::{Episode, Rng};
use rand::Rng as _;
use std::sync::Arc;

/// Episodes that a policy learns from, and how much of every batch comes from them.
#[derive(Debug, Clone, Default)]
pub struct Source {
    /// The episodes.
    pub episodes: Vec<Arc<Episode>>,
    /// Share of every batch, relative to those of the other sources; whatever it is, a source without episodes gives none.
    pub share: f32,
    /// What a policy is told of the source while it learns (1 for what it shall do, -1 for what not); none tells nothing.
    pub label: Option<f32>,
}

impl Source {
    /// Episodes with their share of every batch, without a label.
    #[must_use]
    pub fn new(episodes: Vec<Arc<Episode>>, share: f32) -> Self {
        Self { episodes, share, label: None }
    }

    /// The only source: all of every batch comes from it.
    #[must_use]
    pub fn whole(episodes: Vec<Arc<Episode>>) -> Self {
        Self::new(episodes, 1.0)
    }

    /// The same source with a label.
    #[must_use]
    pub fn labelled(self, label: f32) -> Self {
        Self { label: Some(label), ..self }
    }
}

/// One drawn window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Pick {
    /// Index of its source.
    pub source: usize,
    /// Its index there.
    pub window: usize,
}

/// Draws batches from sources: a fixed share from each, with equal chances inside one.
///
/// # Source
/// "Sampled with a 1:1 weighting": two shares of 0.5.
#[derive(Debug, Clone, PartialEq)]
pub struct Sampler {
    /// Index of the source, windows, share; of sources with windows alone. The shares add up to 1.
    sources: Vec<(usize, usize, f64)>,
}

impl Sampler {
    /// Windows of each source, and its share relative to the others'. What has no windows leaves its share to the others.
    ///
    /// # Errors
    /// When no source has a window, or none that has one a share.
    pub fn new(sources: &[(&Windows, f64)]) -> Result<Self> {
        let there = || sources.iter().enumerate().filter(|(_, (windows, _))| !windows.is_empty());
        let of = |share: f64| if share.is_finite() { share.max(0.0) } else { 0.0 };
        let sum: f64 = there().map(|(_, (_, share))| of(*share)).sum();
        let alone = there().count() == 1;
        if there().count() == 0 || (sum <= 0.0 && !alone) {
            return Err(Error::NoWindows);
        }
        let share = |given: f64| if alone { 1.0 } else { of(given) / sum };
        Ok(Self { sources: there().map(|(i, (w, given))| (i, w.len(), share(*given))).collect() })
    }

    /// `size` windows, in the order of the sources. A share that is no whole number of windows is rounded up or down by
    /// chance, so that it holds on average.
    #[must_use]
    pub fn batch(&self, size: usize, rng: &mut Rng) -> Vec<Pick> {
        // Ends of the sources' stretches of the batch; all are moved by the same draw, so that each length holds on average.
        let mut ends: Vec<f64> = vec![];
        for (_, _, share) in &self.sources {
            ends.push(ends.last().copied().unwrap_or_default() + share * size as f64);
        }
        if let Some(last) = ends.last_mut() {
            *last = size as f64;
        }
        let broken = ends.iter().any(|e| e.fract() > 0.0);
        let shift = if broken { rng.random::<f64>() } else { 0.0 };
        let mut picks = Vec::with_capacity(size);
        for ((source, windows, _), end) in self.sources.iter().zip(ends) {
            while picks.len() < size && (picks.len() as f64) < (end + shift).floor() {
                // 64 bits whatever the machine, so that every machine draws the same numbers.
                let window = rng.random_range(0..*windows as u64);
                picks.push(Pick { source: *source, window: usize::try_from(window).unwrap_or(0) });
            }
        }
        picks
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

    fn two(first: &[usize], second: &[usize], share: f64) -> Result<Sampler> {
        Sampler::new(&[(&windows(first), share), (&windows(second), 1.0 - share)])
    }

    fn from_first(batch: &[Pick]) -> usize {
        batch.iter().filter(|p| p.source == 0).count()
    }

    #[test]
    fn half_of_every_batch_comes_from_each_set_however_large() {
        let sampler = two(&[5], &[300, 200], 0.5).unwrap();
        let mut rng = stream(1, "batch", 0, 0);
        for _ in 0..50 {
            let batch = sampler.batch(32, &mut rng);
            assert_eq!(from_first(&batch), 16);
            assert!(batch.iter().all(|p| p.window < if p.source == 0 { 5 } else { 500 }));
        }
    }

    #[test]
    fn a_broken_share_holds_on_average_and_windows_are_uniform() {
        let sampler = two(&[10], &[10], 0.3).unwrap();
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
        let sampler = two(&[9], &[], 0.5).unwrap();
        assert_eq!(from_first(&sampler.batch(7, &mut rng)), 7);
        let sampler = two(&[0], &[9], 0.5).unwrap();
        assert_eq!(from_first(&sampler.batch(7, &mut rng)), 0);
        assert!(matches!(two(&[], &[0], 0.5), Err(Error::NoWindows)));
    }

    #[test]
    fn a_stream_repeats() {
        let sampler = two(&[40], &[40], 0.4).unwrap();
        let draw = || sampler.batch(64, &mut stream(4, "batch", 1, 2));
        assert_eq!(draw(), draw());
    }

    #[test]
    fn any_number_of_shares_holds_on_average_and_fills_every_batch() {
        let sets = [windows(&[7]), windows(&[]), windows(&[30]), windows(&[4]), windows(&[9])];
        let shares = [0.1, 5.0, 0.2, 0.0, 0.7];
        let sampler = Sampler::new(&sets.iter().zip(shares).collect::<Vec<_>>()).unwrap();
        let mut rng = stream(5, "batch", 0, 0);
        let mut counts = [0usize; 5];
        for _ in 0..20_000 {
            let batch = sampler.batch(3, &mut rng);
            assert_eq!(batch.len(), 3);
            assert!(batch.is_sorted_by_key(|p| p.source));
            for pick in batch {
                assert!(pick.window < sets[pick.source].len());
                counts[pick.source] += 1;
            }
        }
        for (count, share) in counts.iter().zip([0.1, 0.0, 0.2, 0.0, 0.7]) {
            assert!((*count as f64 / 60_000.0 - share).abs() < 0.012, "{counts:?}");
        }
    }

    #[test]
    fn shares_that_give_nothing_are_refused() {
        let some = windows(&[9]);
        assert!(matches!(Sampler::new(&[]), Err(Error::NoWindows)));
        assert!(matches!(Sampler::new(&[(&some, 0.0), (&some, f64::NAN)]), Err(Error::NoWindows)));
        // With no other there is nothing to share.
        assert_eq!(Sampler::new(&[(&some, 0.0)]).unwrap().batch(4, &mut stream(6, "b", 0, 0)).len(), 4);
    }
}
