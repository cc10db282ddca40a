//! Statistics of features: an episode's, and their sum over episodes, by LeRobot's rules.

use super::feature::{Dtype, Feature, Features};
use super::picture;
use super::table::{Column, Table};
use crate::Result;
use serde_json::{Map, Value};
use std::path::Path;

/// Names of the quantiles and their shares.
pub const QUANTILES: [(&str, f64); 5] =
    [("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)];
/// Bins of the histogram that quantiles are read from.
const BINS: usize = 5000;

/// Statistics of one feature. Units: the feature's; images are scaled to [0, 1].
///
/// # Shapes
/// Every list has one number per entry of the feature's last axis; 3 for images, one per channel.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureStats {
    /// Least value.
    pub min: Vec<f64>,
    /// Largest value.
    pub max: Vec<f64>,
    /// Mean.
    pub mean: Vec<f64>,
    /// Standard deviation, that of the population.
    pub std: Vec<f64>,
    /// Rows, or images, that were looked at.
    pub count: u64,
    /// The five of [`QUANTILES`], read from a histogram: exact to a 5000th of the range. Over several episodes they are
    /// the means of the episodes' quantiles, as LeRobot has them.
    pub quantiles: [Vec<f64>; 5],
}

/// Statistics of the features that have any (text has none), in the order of the features.
pub type Stats = Vec<(String, FeatureStats)>;

/// Statistics of one episode.
///
/// # Errors
/// When an image cannot be decoded.
///
/// # Source
/// `compute_episode_stats` of LeRobot 0.4.4.
// Differs: means and squares are summed in 64 bits. LeRobot sums in the type of the column, so that a small deviation around
// a large 32-bit float drowns, and squares 8-bit pixels in 8 bits, so that its deviations of images are wrong.
pub(crate) fn of_table(table: &Table, features: &Features) -> Result<Stats> {
    let mut stats = vec![];
    for (name, feature) in features {
        let Some(column) = table.column(name) else { continue };
        let found = match (column, feature.dtype) {
            (Column::Png(files), _) => of_images(files, feature, name)?,
            (column, _) => column.numbers().map(|v| of_numbers(&v, table.rows, feature)),
        };
        stats.extend(found.map(|s| (name.clone(), s)));
    }
    Ok(stats)
}

fn of_numbers(values: &[f64], rows: usize, feature: &Feature) -> FeatureStats {
    let width = feature.shape.last().copied().unwrap_or(1);
    let entry = |i: usize| {
        let mut column: Vec<(f64, f64)> = values.iter().skip(i).step_by(width).map(|&v| (v, 1.0)).collect();
        column.sort_by(|a, b| a.0.total_cmp(&b.0));
        summary(&column)
    };
    collect((0..width).map(entry), rows as u64)
}

/// LeRobot looks at a part of the images, and at a part of the pixels of large ones.
fn of_images(files: &[Vec<u8>], feature: &Feature, name: &str) -> Result<Option<FeatureStats>> {
    let Some((height, width)) = feature.image_size() else { return Ok(None) };
    let sampled = sampled_rows(files.len());
    let step = if height.max(width) < 300 { 1 } else { height.max(width) / 150 };
    let mut counts = vec![[0_u64; 256]; 3];
    for &row in &sampled {
        let what = format!("column `{name}`, row {row}");
        let data = picture::decode(&files[row], height, width, Path::new("(new episode)"), &what)?;
        for line in data.chunks_exact(width * 3).step_by(step) {
            for pixel in line.chunks_exact(3).step_by(step) {
                for (count, &value) in counts.iter_mut().zip(pixel) {
                    count[usize::from(value)] += 1;
                }
            }
        }
    }
    let channel = |count: &[u64; 256]| {
        let seen = count.iter().enumerate().filter(|(_, n)| **n > 0);
        let column: Vec<(f64, f64)> = seen.map(|(v, &n)| (v as f64, n as f64)).collect();
        summary(&column).map(|v| v / 255.0)
    };
    Ok(Some(collect(counts.iter().map(channel), sampled.len() as u64)))
}

/// Rows whose images count: about the three-quarters power of their number, at least 100, evenly spread.
pub(crate) fn sampled_rows(rows: usize) -> Vec<usize> {
    // Far below 2^52.
    let count = ((rows as f64).powf(0.75) as usize).min(10_000).max(rows.min(100));
    let step = rows.saturating_sub(1) as f64 / count.saturating_sub(1).max(1) as f64;
    // 0 <= i * step <= rows - 1.
    (0..count).map(|i| ((i as f64 * step).round_ties_even() as usize).min(rows - 1)).collect()
}

/// Min, max, mean, deviation and quantiles of values with their counts, ascending and not empty.
fn summary(column: &[(f64, f64)]) -> [f64; 9] {
    let total: f64 = column.iter().map(|c| c.1).sum();
    let mean = column.iter().map(|(v, n)| v * n).sum::<f64>() / total;
    let variance = column.iter().map(|(v, n)| (v - mean) * (v - mean) * n).sum::<f64>() / total;
    let (min, max) = (column.first().map_or(0.0, |c| c.0), column.last().map_or(0.0, |c| c.0));
    let mut out = [min, max, mean, variance.sqrt(), mean, mean, mean, mean, mean];
    if total < 2.0 {
        return out;
    }
    // The edges lie a hair outside, so that a constant column has a range too.
    let (low, high) = (min - 1e-10, max + 1e-10);
    let width = (high - low) / BINS as f64;
    let edge = |i: usize| if i == BINS { high } else { low + width * i as f64 };
    // Clamped to the bins.
    let bin = |v: f64| if width > 0.0 { (((v - low) / width) as usize).min(BINS - 1) } else { 0 };
    for (slot, (_, share)) in out[4..].iter_mut().zip(QUANTILES) {
        let target = share * total;
        let mut before = 0.0;
        let mut values = column.iter().peekable();
        *slot = high;
        while let Some((v, n)) = values.next() {
            let this = bin(*v);
            let mut inside = *n;
            while let Some((_, n)) = values.next_if(|(v, _)| bin(*v) == this) {
                inside += n;
            }
            if before + inside >= target {
                // What falls into the first bin is its lower edge: LeRobot does not look into that one.
                let fraction = if this == 0 { 0.0 } else { (target - before) / inside };
                *slot = edge(this) + fraction * (edge(this + 1) - edge(this));
                break;
            }
            before += inside;
        }
    }
    out
}

fn collect(entries: impl Iterator<Item = [f64; 9]>, count: u64) -> FeatureStats {
    let mut lists: [Vec<f64>; 9] = Default::default();
    for entry in entries {
        for (list, value) in lists.iter_mut().zip(entry) {
            list.push(value);
        }
    }
    let [min, max, mean, std, quantiles @ ..] = lists;
    FeatureStats { min, max, mean, std, count, quantiles }
}

/// Adds an episode to what there is.
///
/// # Source
/// `aggregate_feature_stats` of LeRobot 0.4.4, two at a time as its recorder does it.
pub(crate) fn add(total: &mut Stats, episode: &Stats) {
    for (name, more) in episode {
        match total.iter_mut().find(|(n, _)| n == name) {
            Some((_, sum)) => sum.add(more),
            None => total.push((name.clone(), more.clone())),
        }
    }
}

impl FeatureStats {
    fn add(&mut self, other: &Self) {
        let (a, b) = (self.count as f64, other.count as f64);
        if a + b == 0.0 {
            return;
        }
        let mixed = |x: f64, y: f64| (x * a + y * b) / (a + b);
        for i in 0..self.mean.len().min(other.mean.len()) {
            let mean = mixed(self.mean[i], other.mean[i]);
            let spread = |std: f64, m: f64| std * std + (m - mean) * (m - mean);
            let variance = mixed(spread(self.std[i], self.mean[i]), spread(other.std[i], other.mean[i]));
            (self.mean[i], self.std[i]) = (mean, variance.sqrt());
            self.min[i] = self.min[i].min(other.min[i]);
            self.max[i] = self.max[i].max(other.max[i]);
            for (q, r) in self.quantiles.iter_mut().zip(&other.quantiles) {
                q[i] = mixed(q[i], r[i]);
            }
        }
        self.count += other.count;
    }

    /// The lists in the order in which LeRobot writes them; the count comes between the fourth and the fifth.
    pub(crate) fn lists(&self) -> impl Iterator<Item = (&'static str, &Vec<f64>)> {
        let first = [("min", &self.min), ("max", &self.max), ("mean", &self.mean), ("std", &self.std)];
        first.into_iter().chain(QUANTILES.iter().zip(&self.quantiles).map(|((name, _), list)| (*name, list)))
    }
}

/// How the least and the largest value of a feature are written.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Bounds {
    Float,
    Integer,
    Bool,
    /// One number per channel, nested three deep.
    Image,
}

pub(crate) fn bounds(feature: &Feature) -> Bounds {
    match feature.dtype {
        Dtype::Image | Dtype::Video => Bounds::Image,
        Dtype::Bool => Bounds::Bool,
        Dtype::Float32 | Dtype::Float64 | Dtype::String => Bounds::Float,
        _ => Bounds::Integer,
    }
}

/// `meta/stats.json`.
pub(crate) fn to_json(stats: &Stats, features: &Features) -> Value {
    let mut out = Map::new();
    for (name, feature) in features {
        let Some((_, found)) = stats.iter().find(|(n, _)| n == name) else { continue };
        let kind = bounds(feature);
        let number = |list: &str, v: f64| match (list, kind) {
            // Came from an integer.
            ("min" | "max", Bounds::Integer) => Value::from(v as i64),
            ("min" | "max", Bounds::Bool) => Value::from(v != 0.0),
            (_, Bounds::Image) => Value::from(vec![vec![v]]),
            _ => Value::from(v),
        };
        let list = |(key, values): (&str, &Vec<f64>)| {
            (key.to_owned(), values.iter().map(|&v| number(key, v)).collect::<Vec<_>>().into())
        };
        let mut entry: Map<String, Value> = found.lists().map(list).collect();
        entry.insert("count".to_owned(), vec![found.count].into());
        out.insert(name.clone(), entry.into());
    }
    out.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn column(values: &[f32]) -> FeatureStats {
        let table = Table { rows: values.len(), columns: vec![("x".into(), Column::F32(values.to_vec()))] };
        let features = vec![("x".to_owned(), Feature::scalar(Dtype::Float32))];
        of_table(&table, &features).unwrap().remove(0).1
    }

    /// Compared to `compute_episode_stats` of LeRobot 0.4.4 for `np.arange(11, dtype="f4")[:, None] ** 2`; its quantiles
    /// lie in bins of a fiftieth, so that they may differ by one.
    #[test]
    fn numbers_agree_with_lerobot() {
        let s = column(&(0_u8..11).map(|v| f32::from(v) * f32::from(v)).collect::<Vec<_>>());
        assert_eq!((s.min[0], s.max[0], s.mean[0], s.count), (0.0, 100.0, 35.0, 11));
        assert!((s.std[0] - 32.832_909).abs() < 1e-4, "{}", s.std[0]);
        let q: Vec<f64> = s.quantiles.iter().map(|q| q[0]).collect();
        for (got, want) in q.iter().zip([0.0, 1.002, 25.01, 81.018, 99.997_78]) {
            assert!((got - want).abs() < 0.021, "{q:?}");
        }
    }

    #[test]
    fn single_rows_and_constants_have_their_value_everywhere() {
        for s in [column(&[3.0]), column(&[3.0; 40])] {
            assert!(s.lists().all(|(name, v)| (v[0] - if name == "std" { 0.0 } else { 3.0 }).abs() < 1e-9));
        }
    }

    #[test]
    fn images_are_counted_by_channel() {
        let png = |v: u8| picture::encode(1, 2, &[v, 0, 255, v, 0, 255]).unwrap();
        let table = Table { rows: 2, columns: vec![("c".into(), Column::Png(vec![png(0), png(51)]))] };
        let s = of_table(&table, &vec![("c".into(), Feature::image(1, 2))]).unwrap().remove(0).1;
        assert_eq!((s.count, s.max.clone()), (2, vec![0.2, 0.0, 1.0]));
        assert!((s.mean[0] - 0.1).abs() < 1e-12 && (s.std[0] - 0.1).abs() < 1e-12);
        let json = to_json(&vec![("c".into(), s)], &vec![("c".into(), Feature::image(1, 2))]);
        assert_eq!(json["c"]["max"][0][0][0], 0.2);
    }

    /// `sample_indices` of LeRobot 0.4.4.
    #[test]
    fn images_are_sampled_as_lerobot_samples_them() {
        assert_eq!(sampled_rows(3), [0, 1, 2]);
        assert_eq!(sampled_rows(1), [0]);
        assert_eq!(sampled_rows(400).len(), 100);
        assert_eq!(sampled_rows(400)[..4], [0, 4, 8, 12]);
        assert_eq!((sampled_rows(1000).len(), &sampled_rows(1000)[..6]), (177, &[0, 6, 11, 17, 23, 28][..]));
    }

    proptest! {
        #[test]
        fn parts_add_up_to_the_whole(values in prop::collection::vec(-1e3_f32..1e3, 4..60), cut in 1_usize..3) {
            let whole = column(&values);
            let cut = values.len() * cut / 4;
            let mut sum = vec![("x".to_owned(), column(&values[..cut]))];
            add(&mut sum, &vec![("x".to_owned(), column(&values[cut..]))]);
            let sum = &sum[0].1;
            prop_assert_eq!((sum.count, &sum.min, &sum.max), (whole.count, &whole.min, &whole.max));
            prop_assert!((sum.mean[0] - whole.mean[0]).abs() < 1e-9);
            prop_assert!((sum.std[0] - whole.std[0]).abs() < 1e-6);
        }

        #[test]
        fn quantiles_ascend_inside_the_range(values in prop::collection::vec(-1e3_f32..1e3, 2..200)) {
            let s = column(&values);
            let q: Vec<f64> = s.quantiles.iter().map(|q| q[0]).collect();
            prop_assert!(q.windows(2).all(|p| p[0] <= p[1]), "{:?}", q);
            prop_assert!(q[0] >= s.min[0] - 1e-9 && q[4] <= s.max[0] + 1e-9);
        }
    }
}
