use crate::{AdvantageConfig, Error, Refined, Result, SuffixConfig, advantage_filter, cut_suffix};
use e2h_core::Episode;

/// What the critic leaves of what an earlier stage left: suffixes cut where that is on, then the advantage filter over all
/// frames of the iteration. Fates of the results belong to the frames that the earlier stage was given.
///
/// # Shapes
/// `values` has one list for every segment of `first`, in order.
///
/// # Errors
/// When values and frames do not agree in number, or a value is not finite.
///
/// # Source
/// Eq. 6, the outer stage.
pub fn critic_filter(
    first: Vec<Refined>,
    values: &[Vec<f32>],
    suffix: &SuffixConfig,
    advantage: &AdvantageConfig,
) -> Result<Vec<Refined>> {
    let expected = first.iter().map(|r| r.segments.len()).sum();
    if expected != values.len() {
        return Err(Error::Episodes { what: "values", expected, found: values.len() });
    }
    let segments = first.iter().flat_map(|r| &r.segments);
    let cut: Vec<Refined> =
        segments.zip(values).map(|(e, v)| cut_suffix(e, v, suffix)).collect::<Result<_>>()?;
    let rest: Vec<&Episode> = cut.iter().flat_map(|r| &r.segments).collect();
    let rest_values: Vec<Vec<f32>> = rest.iter().zip(values).map(|(e, v)| v[..e.len()].to_vec()).collect();
    let judged = advantage_filter(&rest, &rest_values, advantage)?;
    let mut judged =
        cut.into_iter().zip(judged).map(|(c, j)| c.then(vec![j])).collect::<Result<Vec<_>>>()?.into_iter();
    first
        .into_iter()
        .map(|r| {
            let count = r.segments.len();
            r.then(judged.by_ref().take(count).collect())
        })
        .collect()
}
