use crate::{DemonstratorConfig, Env, Result};
use e2h_core::{Action, Direction, Episode, Origin, Outcome, Rng, stream};

/// The stream from which demonstration `index` of a seed draws its start first: whoever resets an environment with it stands where the
/// demonstration began.
#[must_use]
pub fn demonstration_stream(seed: u64, direction: Direction, index: u32) -> Rng {
    let purpose = match direction {
        Direction::Easy => "demonstrate",
        Direction::Hard => "demonstrate/hard",
    };
    stream(seed, purpose, 0, u64::from(index))
}

/// Records a scripted demonstration from a fresh start: through the whole script, back to home, and
/// [`DemonstratorConfig::tail`] control steps at rest. The outcome is a success when the goal was held at the end.
///
/// # Errors
/// As [`Env::reset`] and [`Env::step`].
pub fn demonstrate(
    env: &mut Env,
    direction: Direction,
    config: &DemonstratorConfig,
    origin: Origin,
    rng: &mut Rng,
) -> Result<Episode> {
    env.reset(direction, rng)?;
    let mut expert = env.task().expert(direction, config, rng);
    let mut episode = Episode::new(origin, env.cameras());
    let mut tail = config.tail;
    let horizon = env.horizon(direction);
    while episode.len() < horizon && tail > 0 {
        let observation = env.observe()?;
        let action = expert.act(env.sim());
        episode.push(&observation, &action)?;
        if let Some(accident) = env.advance(&action)? {
            episode.outcome = accident;
            return Ok(episode);
        }
        if expert.done() {
            tail -= 1;
        }
    }
    episode.outcome = env.held().unwrap_or(Outcome::Timeout);
    Ok(episode)
}

/// Plays actions open loop from the current state, then holds the last one until the episode ends.
///
/// # Errors
/// As [`Env::step`]; nothing to play gives `None`.
pub fn replay(env: &mut Env, actions: &[Action]) -> Result<Option<Outcome>> {
    let Some(last) = actions.last() else { return Ok(None) };
    for action in actions.iter().chain(std::iter::repeat(last)) {
        let outcome = env.step(action)?;
        if outcome.is_some() {
            return Ok(outcome);
        }
    }
    Ok(None)
}
