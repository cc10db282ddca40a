//! From episodes and rollouts to what the report draws.

use crate::Result;
use crate::animation::{sampled_frames, tile};
use crate::filter::FilterPicture;
use e2h_core::{CONTROL_HZ, Episode, Image, Outcome};
use e2h_refine::{KinematicConfig, Refined};

/// The filter picture of one reversed rollout: sampled frames, speed, value, and what became of every frame.
///
/// # Errors
/// When an image's bytes do not fill it.
pub fn filter(episode: &Episode, refined: &Refined, config: &KinematicConfig) -> Result<String> {
    let picture = FilterPicture {
        times: (0..episode.len()).map(|t| t as f32 / CONTROL_HZ as f32).collect(),
        speed: refined.speed.clone(),
        value: refined.value.clone(),
        advantage: refined.advantage.clone(),
        advantage_threshold: refined.threshold,
        excursion: excursions(episode),
        dynamics_error: refined.dynamics_error.clone(),
        dynamics_threshold: refined.dynamics_threshold,
        static_speed: config.static_speed as f32,
        slow_speed: config.slow_speed as f32,
        fates: refined.fates.iter().map(|f| f.name().to_owned()).collect(),
        frames: sampled_frames(episode, 0, 8)?,
    };
    picture.svg()
}

/// How far the goal of every row was displaced, mm; none where nothing displaced any.
pub(crate) fn excursions(episode: &Episode) -> Option<Vec<f32>> {
    let far = |[x, y, z, _]: &[f32; 4]| 1000.0 * (x * x + y * y + z * z).sqrt();
    let all: Vec<f32> = episode.excursion.iter().map(far).collect();
    all.iter().any(|&v| v > 0.0).then_some(all)
}

/// Films of several rollouts side by side.
#[must_use]
pub fn tiles(films: &[(Outcome, Vec<Image>)], columns: usize) -> Vec<Image> {
    let (outcomes, frames): (Vec<Outcome>, Vec<Vec<Image>>) = films.iter().cloned().unzip();
    tile(&frames, &outcomes, columns)
}
