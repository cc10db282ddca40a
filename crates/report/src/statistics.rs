//! Whether one policy, or one method, is better than another: tests for trials that come in pairs.
//!
//! Trial i of two evaluations with the same seed has the same start, so each trial is a pair. What counts are the pairs in which
//! one succeeds and the other does not.
//!
//! ```
//! use e2h_report::statistics::{Discordant, mcnemar_mid_p};
//!
//! let ours = [true, true, true, true, true, true, false];
//! let theirs = [false, false, false, false, false, true, false];
//! let pairs = Discordant::of(&ours, &theirs);
//! assert_eq!(pairs, Discordant { ours: 5, theirs: 0 });
//! assert!(mcnemar_mid_p(pairs) < 0.05);
//! ```

use e2h_core::Rng;
use rand::Rng as _;

/// Pairs of trials in which the two differ.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Discordant {
    /// Only ours succeeded.
    pub ours: usize,
    /// Only theirs did.
    pub theirs: usize,
}

impl Discordant {
    /// Counts pairs; trials that only one of the two has are no pairs.
    #[must_use]
    pub fn of(ours: &[bool], theirs: &[bool]) -> Self {
        let pairs = || ours.iter().zip(theirs);
        Self {
            ours: pairs().filter(|(a, b)| **a && !**b).count(),
            theirs: pairs().filter(|(a, b)| !**a && **b).count(),
        }
    }
}

/// Two-sided p-value of McNemar's test with the mid-p correction, in (0, 1]: were both policies as good as each other, each
/// discordant pair would be a fair coin.
///
/// # Source
/// Fagerland, Lydersen and Laake 2013 (BMC Medical Research Methodology 13:91), equation 4.
#[must_use]
pub fn mcnemar_mid_p(pairs: Discordant) -> f64 {
    let (n, least) = (pairs.ours + pairs.theirs, pairs.ours.min(pairs.theirs));
    // ln C(n, k) - n ln 2, term by term.
    let mut ln = -(n as f64) * std::f64::consts::LN_2;
    let (mut below, mut at) = (0.0, ln.exp());
    for k in 1..=least {
        below += at;
        ln += ((n - k + 1) as f64 / k as f64).ln();
        at = ln.exp();
    }
    (2.0 * below + at).min(1.0)
}

/// Evidence against "both are as good as each other" that may be looked at after every pair: under it, the chance that it
/// ever reaches 20 is at most 5 %.
///
/// # Source
/// The ratio of a beta(1/2, 1/2) mixture to the fair coin: Robbins 1970; Ville's inequality bounds it at every stop.
#[must_use]
pub fn e_value(pairs: Discordant) -> f64 {
    // 2^n B(b + 1/2, c + 1/2) / B(1/2, 1/2), pair by pair: the next pair's probability under the mixture, over one half.
    let mut ln = 0.0;
    let (mut b, mut c) = (0.0, 0.0);
    for i in 0..pairs.ours + pairs.theirs {
        let (count, n) = if i < pairs.ours { (&mut b, i as f64) } else { (&mut c, i as f64) };
        ln += (2.0 * (*count + 0.5) / (n + 1.0)).ln();
        *count += 1.0;
    }
    ln.exp()
}

/// Holm's adjustment of several p-values, in the order given: each is what it would have to be below to be significant among
/// all of them.
///
/// # Source
/// Holm 1979 (Scandinavian Journal of Statistics 6:65).
#[must_use]
pub fn holm(p: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|a, b| p[*a].total_cmp(&p[*b]));
    let mut adjusted = vec![1.0; p.len()];
    let mut largest: f64 = 0.0;
    for (rank, &i) in order.iter().enumerate() {
        largest = largest.max((p.len() - rank) as f64 * p[i]).min(1.0);
        adjusted[i] = largest;
    }
    adjusted
}

/// Outcomes of the same trials by two methods, of one training seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair<'a> {
    /// Ours, trial by trial.
    pub ours: &'a [bool],
    /// Theirs.
    pub theirs: &'a [bool],
}

impl Pair<'_> {
    fn len(&self) -> usize {
        self.ours.len().min(self.theirs.len())
    }

    fn at(&self, trial: usize) -> f64 {
        f64::from(u8::from(self.ours[trial])) - f64::from(u8::from(self.theirs[trial]))
    }

    fn mean(&self) -> f64 {
        (0..self.len()).map(|i| self.at(i)).sum::<f64>() / self.len().max(1) as f64
    }
}

/// By how much one method is better than another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// Mean difference of the success rate, in [-1, 1]; tasks count alike.
    pub mean: f64,
    /// Its 95 % bootstrap interval.
    pub interval: [f64; 2],
    /// Two-sided bootstrap p-value; none with fewer than [`LEAST_SEEDS`] training seeds of some task: few seeds say little of
    /// how a method varies.
    pub p: Option<f64>,
}

/// Training seeds of every task below which no p-value is given.
pub const LEAST_SEEDS: usize = 5;
/// Draws of the bootstrap.
const DRAWS: usize = 10_000;

/// Paired difference of two methods. `tasks` has the training seeds of each task; the bootstrap draws seeds within a task, and
/// trials within a seed. None without a pair, or with a task without one.
#[must_use]
pub fn difference(tasks: &[Vec<Pair<'_>>], rng: &mut Rng) -> Option<Difference> {
    if tasks.is_empty() || tasks.iter().any(|t| t.is_empty() || t.iter().any(|p| p.len() == 0)) {
        return None;
    }
    let over_tasks = |per_task: &mut dyn FnMut(&[Pair<'_>]) -> f64| {
        tasks.iter().map(|t| per_task(t)).sum::<f64>() / tasks.len() as f64
    };
    let mean = over_tasks(&mut |t| t.iter().map(Pair::mean).sum::<f64>() / t.len() as f64);
    let mut draws: Vec<f64> = (0..DRAWS)
        .map(|_| {
            over_tasks(&mut |t| {
                let drawn = (0..t.len()).map(|_| {
                    let pair = &t[rng.random_range(0..t.len())];
                    let n = pair.len();
                    (0..n).map(|_| pair.at(rng.random_range(0..n))).sum::<f64>() / n as f64
                });
                drawn.sum::<f64>() / t.len() as f64
            })
        })
        .collect();
    draws.sort_by(f64::total_cmp);
    let quantile = |q: f64| draws[((DRAWS - 1) as f64 * q).round() as usize];
    let share = |f: fn(f64) -> bool| draws.iter().filter(|d| f(**d)).count() as f64 / DRAWS as f64;
    let p = (2.0 * share(|d| d <= 0.0).min(share(|d| d >= 0.0))).clamp(1.0 / DRAWS as f64, 1.0);
    let enough = tasks.iter().all(|t| t.len() >= LEAST_SEEDS);
    Some(Difference { mean, interval: [quantile(0.025), quantile(0.975)], p: enough.then_some(p) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use e2h_core::stream;

    fn pairs(ours: usize, theirs: usize) -> Discordant {
        Discordant { ours, theirs }
    }

    #[test]
    fn mid_p_values_are_those_of_the_binomial() {
        // By hand: 2 P(X <= m) - P(X = m), X ~ Bin(b + c, 1/2).
        for (b, c, p) in [
            (0, 0, 1.0_f64),
            (1, 0, 0.5),
            (5, 0, 2.0 / 64.0),
            (0, 5, 2.0 / 64.0),
            (7, 2, 2.0 * (1.0 + 9.0) / 512.0 + 36.0 / 512.0),
            (3, 3, 1.0),
        ] {
            assert!((mcnemar_mid_p(pairs(b, c)) - p.min(1.0)).abs() < 1e-12, "{b} {c}");
        }
        // Where 2^-n is no number any more.
        let p = mcnemar_mid_p(pairs(2000, 1000));
        assert!(p > 0.0 && p < 1e-60, "{p}");
    }

    #[test]
    fn e_values_are_the_beta_mixture_and_do_not_depend_on_the_order() {
        // B(b + 1/2, c + 1/2) / B(1/2, 1/2) of (1, 0) is 1/2, of (2, 0) 3/8, of (1, 1) 1/8.
        for (b, c, e) in [(0, 0, 1.0), (1, 0, 1.0), (2, 0, 1.5), (1, 1, 0.5), (0, 2, 1.5)] {
            assert!((e_value(pairs(b, c)) - e).abs() < 1e-12, "{b} {c}");
        }
        assert!((e_value(pairs(13, 4)) - e_value(pairs(4, 13))).abs() < 1e-9);
        assert!(e_value(pairs(6, 0)) < 20.0 && e_value(pairs(8, 0)) > 20.0);
    }

    #[test]
    fn false_alarms_of_the_sequential_test_stay_below_a_twentieth() {
        let mut rng = stream(7, "statistics/test", 0, 0);
        let alarms = (0..2000)
            .filter(|_| {
                let mut seen = Discordant::default();
                (0..300).any(|_| {
                    if rng.random::<bool>() {
                        seen.ours += 1
                    } else {
                        seen.theirs += 1
                    }
                    e_value(seen) >= 20.0
                })
            })
            .count();
        assert!((10..=100).contains(&alarms), "{alarms}");
    }

    #[test]
    fn holm_multiplies_by_how_many_are_left_and_keeps_the_order() {
        let adjusted = holm(&[0.04, 0.01, 0.03, 0.6]);
        for (found, expected) in adjusted.iter().zip([0.09, 0.04, 0.09, 0.6]) {
            assert!((found - expected).abs() < 1e-12, "{adjusted:?}");
        }
        assert!(holm(&[]).is_empty());
    }

    #[test]
    fn differences_are_means_of_seeds_with_an_interval_that_knows_how_seeds_differ() {
        let rate = |k: usize| -> Vec<bool> { (0..100).map(|i| i < k).collect() };
        let (high, low, base) = (rate(90), rate(50), rate(50));
        let against = |ours: &[&Vec<bool>]| -> Vec<Vec<bool>> { ours.iter().map(|o| (*o).clone()).collect() };
        let run = |ours: Vec<Vec<bool>>| {
            let task: Vec<Pair<'_>> = ours.iter().map(|o| Pair { ours: o, theirs: &base }).collect();
            difference(&[task], &mut stream(3, "statistics/test", 0, 1)).unwrap()
        };
        let same = run(against(&[&high, &high, &high, &high, &high]));
        assert!((same.mean - 0.4).abs() < 1e-12 && same.interval[0] > 0.3 && same.p.unwrap() < 0.001);
        // Two seeds that differ: the interval holds both, and there is no p-value.
        let apart = run(against(&[&high, &low]));
        assert!((apart.mean - 0.2).abs() < 1e-12 && apart.p.is_none());
        assert!(apart.interval[0] < 0.02 && apart.interval[1] > 0.38, "{apart:?}");
        assert!(difference(&[], &mut stream(0, "", 0, 0)).is_none());
        assert!(difference(&[vec![]], &mut stream(0, "", 0, 0)).is_none());
    }
}
