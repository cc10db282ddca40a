//! The numbers of a run or a dataset as TensorBoard event files.

use super::dataset::DatasetSource;
use super::run::RunSource;
use crate::Result;
use crate::record::IterationRecord;
use crate::tensorboard::Events;
use e2h_refine::Fate;
use std::path::Path;

/// Writes the rows of a run's record; the number of values.
pub(super) fn run(source: &RunSource, out: &Path, wall_time: f64) -> Result<usize> {
    let results = source.measured_or_none()?;
    let end = results.iterations.last().map_or(0.0, |r| r.minutes);
    let mut events = Events::create(out, wall_time, 0)?;
    let mut count = 0;
    for record in &results.iterations {
        // The record has minutes since the start; the end is when it was last written.
        let at = wall_time + (record.minutes - end) * 60.0;
        count += iteration(&mut events, record, at)?;
    }
    events.finish()?;
    Ok(count)
}

/// Writes one row of a run's record; the number of values.
///
/// # Errors
/// When the file cannot be written.
pub fn iteration(events: &mut Events, record: &IterationRecord, wall_time: f64) -> Result<usize> {
    let e = &record.evaluation;
    let mut values = vec![
        ("eval/success_rate", e.successes as f64 / e.trials.max(1) as f64),
        ("eval/wilson95_low", e.wilson95[0]),
        ("eval/wilson95_high", e.wilson95[1]),
        ("time/minutes", record.minutes),
    ];
    if e.successes > 0 {
        values.push(("eval/mean_steps", e.mean_steps));
    }
    if !record.skipped {
        values.push(("train/final_loss", record.loss));
    }
    if let Some(c) = &record.collection {
        let share = |k: usize, n: usize| k as f64 / n.max(1) as f64;
        values.extend([
            ("collect/hard_success_rate", share(c.hard_successes, c.cycles)),
            ("collect/easy_success_rate", share(c.easy_successes, c.easy_rollouts)),
            ("collect/automatic_reset_rate", c.automatic_reset_rate()),
            ("refine/accepted", c.accepted as f64),
            ("refine/segments", c.segments as f64),
            ("refine/frames_kept", c.frames_kept as f64),
        ]);
        values.extend(c.explored.rate().map(|r| ("collect/automatic_reset_rate_exploring", r)));
        values.extend(c.plain.rate().map(|r| ("collect/automatic_reset_rate_plain", r)));
        let of: usize = c.fates.values().sum();
        values.push(("refine/kept_fraction", share(c.fates.get(&Fate::Kept).copied().unwrap_or(0), of)));
        values.extend(c.critic_loss.map(|l| ("critic/validation_loss", l)));
    }
    for (tag, value) in &values {
        events.scalar(tag, record.iteration.into(), wall_time, *value)?;
    }
    Ok(values.len())
}

/// Writes length, success and mean speed of every episode, at its index; the number of values.
pub(super) fn dataset(source: &DatasetSource, out: &Path, wall_time: f64) -> Result<usize> {
    let mut events = Events::create(out, wall_time, 0)?;
    let mut count = 0;
    for index in 0..source.listed.len() {
        let r = source.read(index, false)?;
        let mut values = vec![("episode/seconds", r.rows as f64 / r.hz)];
        if r.outcome != "not said" {
            values.push(("episode/success", f64::from(u8::from(r.outcome == "success"))));
        }
        if let Some(speed) = r.speed.filter(|s| !s.is_empty()) {
            values.push(("episode/mean_speed", speed.iter().sum::<f64>() / speed.len() as f64));
        }
        for (tag, value) in &values {
            events.scalar(tag, index as u64, wall_time, *value)?;
        }
        count += values.len();
    }
    events.finish()?;
    Ok(count)
}
