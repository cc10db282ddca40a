use crate::{Action, Observation, Result, Rng};

/// The actions that a policy wants executed next, one per control step.
pub type ActionChunk = Vec<Action>;

/// Something that acts. Batched, because several environments ask at once.
pub trait Policy: Sync {
    /// Observations that [`Policy::act`] wants for each environment, To.
    fn n_obs_steps(&self) -> usize;

    /// Actions for each environment.
    ///
    /// # Shapes
    /// `histories` (B, To), oldest first; at the start of an episode the first observation is repeated. `rngs` (B): one
    /// stream per environment, so that what one environment gets does not depend on which others ask with it.
    ///
    /// # Errors
    /// When the observations do not fit the policy, or the network fails.
    fn act(&self, histories: &[Vec<&Observation>], rngs: &mut [Rng]) -> Result<Vec<ActionChunk>>;
}
