/// How the learning rate changes over training. The rate rises from 0 over `warmup` steps first.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum LrSchedule {
    /// The same rate after the warm-up.
    Constant {
        /// The rate.
        lr: f32,
        /// Steps of the warm-up.
        warmup: usize,
    },
    /// Half a cosine from the rate to 0 after the warm-up.
    Cosine {
        /// The highest rate.
        lr: f32,
        /// Steps of the warm-up.
        warmup: usize,
        /// Steps of the whole training.
        steps: usize,
    },
}

/// The learning rate of step number `step`, from 0.
///
/// # Source
/// `get_constant_schedule_with_warmup` and `get_cosine_schedule_with_warmup` of diffusers 0.35.2 (half a cycle).
#[must_use]
pub fn learning_rate(schedule: &LrSchedule, step: usize) -> f32 {
    let (lr, warmup) = match *schedule {
        LrSchedule::Constant { lr, warmup } | LrSchedule::Cosine { lr, warmup, .. } => (lr, warmup),
    };
    if step < warmup {
        return (f64::from(lr) * step as f64 / warmup as f64) as f32;
    }
    match *schedule {
        LrSchedule::Constant { .. } => lr,
        LrSchedule::Cosine { steps, .. } => {
            let part = (step - warmup) as f64 / steps.saturating_sub(warmup).max(1) as f64;
            (f64::from(lr) * 0.5 * (1.0 + (std::f64::consts::PI * part.min(1.0)).cos())) as f32
        }
    }
}
