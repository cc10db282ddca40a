use std::ops::Range;

/// Centred moving average over `width` entries; near the ends over those that there are.
#[must_use]
pub fn moving_average(values: &[f64], width: usize) -> Vec<f64> {
    let half = width / 2;
    let mut sums = Vec::with_capacity(values.len() + 1);
    sums.push(0.0);
    for v in values {
        sums.push(sums[sums.len() - 1] + v);
    }
    let mean = |t: usize| {
        let (a, b) = (t.saturating_sub(half), (t + half + 1).min(values.len()));
        (sums[b] - sums[a]) / (b - a) as f64
    };
    (0..values.len()).map(mean).collect()
}

/// The `percent`-th percentile, linear between neighbours; none of no values.
#[must_use]
pub fn percentile(values: &[f64], percent: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = percent.clamp(0.0, 100.0) / 100.0 * sorted.len().checked_sub(1)? as f64;
    // 0 <= place < length.
    let below = place.floor() as usize;
    let low = *sorted.get(below)?;
    let high = sorted.get(below + 1).copied().unwrap_or(low);
    Some(low + (high - low) * (place - below as f64))
}

/// The maximal runs of `wanted` in `mask`, in order.
#[must_use]
pub fn runs(mask: &[bool], wanted: bool) -> Vec<Range<usize>> {
    let mut found = vec![];
    let mut start = 0;
    for end in 1..=mask.len() {
        if end == mask.len() || mask[end] != mask[start] {
            if mask[start] == wanted {
                found.push(start..end);
            }
            start = end;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn averages_shrink_at_the_ends() {
        assert_eq!(moving_average(&[1.0, 2.0, 6.0, 3.0], 3), [1.5, 3.0, 11.0 / 3.0, 4.5]);
        assert_eq!(moving_average(&[1.0, 2.0], 1), [1.0, 2.0]);
    }

    #[test]
    fn percentiles_lie_between_neighbours() {
        let values: Vec<f64> = (0..=10).rev().map(f64::from).collect();
        assert_eq!(percentile(&values, 30.0), Some(3.0));
        assert_eq!(percentile(&values, 25.0), Some(2.5));
        assert_eq!(percentile(&values, 100.0), Some(10.0));
        assert_eq!(percentile(&[], 30.0), None);
    }

    #[test]
    fn runs_are_maximal() {
        let mask = [true, true, false, true];
        assert_eq!(runs(&mask, true), [0..2, 3..4]);
        assert_eq!(runs(&mask, false), vec![2..3; 1]);
        assert!(runs(&[], true).is_empty());
    }
}
