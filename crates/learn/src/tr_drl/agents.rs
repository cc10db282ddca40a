//! Both agents, what they share, and an update.

use super::TrDrlConfig;
use super::trip::{Kind, Parts, Row, Trip, parts, side};
use crate::Result;
use e2h_core::{Direction, Rng, stream};
use e2h_nn::{Compute, Weights};
use e2h_policy::sac::{Adapter, Batch, Confirmation, Models, Potential, Replay, Sac};

/// Transitions that are kept of a kind.
const KEPT: usize = 300_000;
/// States that a potential learns from at a time.
const POTENTIAL_BATCH: usize = 256;

/// One direction.
struct Side {
    agent: Sac,
    adapter: Adapter,
    rollouts: Replay,
    demonstrations: Replay,
    reversed: Replay,
    /// Learned from successes of this direction.
    own: Potential,
    /// Learned from successes of the other one, turned round.
    turned: Potential,
}

/// What an update did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Report {
    pub(crate) value: f32,
    pub(crate) alpha: f32,
    pub(crate) critic_loss: f32,
    /// Reversed transitions that were looked at, and that were confirmed.
    pub(crate) reversed: [usize; 2],
    /// Errors of the dynamics models, forward and inverse; where they learned.
    pub(crate) models: Option<[f32; 2]>,
}

/// Both agents, their memories, the dynamics models and the potentials.
pub(crate) struct Agents {
    sides: [Side; 2],
    models: Models,
    confirmation: Confirmation,
    config: TrDrlConfig,
}

impl Agents {
    /// Agents that know nothing. Adapters of the hard and of the easy task.
    pub(crate) fn new(
        config: &TrDrlConfig,
        adapters: [Adapter; 2],
        compute: &Compute,
        seed: u64,
    ) -> Result<Self> {
        let mut rng = stream(seed, "tr-drl/weights", 0, 0);
        let [hard, easy] = adapters;
        let c = &config.agent;
        let (o, a) = (hard.observation(), hard.action());
        let confirmation = hard.confirmation(config.tolerance);
        let mut make = |adapter: Adapter, name: &str| -> Result<Side> {
            let inputs = adapter.of_potentials().len();
            let replay = || Replay::new(Row::width(a), KEPT);
            Ok(Side {
                agent: Sac::new(c, o, a, compute, seed, &format!("tr-drl/{name}"))?,
                adapter,
                rollouts: replay(),
                demonstrations: replay(),
                reversed: replay(),
                own: Potential::new(inputs, KEPT, c, compute, &mut rng)?,
                turned: Potential::new(inputs, KEPT, c, compute, &mut rng)?,
            })
        };
        let sides = [make(hard, "hard")?, make(easy, "easy")?];
        let models = Models::new(o, a, c, compute, &mut stream(seed, "tr-drl/models", 0, 0))?;
        Ok(Self { sides, models, confirmation, config: config.clone() })
    }

    pub(crate) fn adapter(&self, direction: Direction) -> &Adapter {
        &self.sides[side(direction)].adapter
    }

    pub(crate) fn agent(&self, direction: Direction) -> &Sac {
        &self.sides[side(direction)].agent
    }

    /// An action drawn from the agent's policy.
    pub(crate) fn act(&self, direction: Direction, state: &[f32], rng: &mut Rng) -> Result<Vec<f32>> {
        let s = &self.sides[side(direction)];
        Ok(s.agent.actor().act(&s.adapter.observe(state), Some(rng))?)
    }

    /// Remembers an episode in both directions.
    pub(crate) fn remember(&mut self, trip: &Trip, kind: Kind) {
        let (reward, gamma) = (self.config.reward, self.config.agent.gamma);
        let [mine, theirs] = [trip.direction, trip.direction.reverse()].map(side);
        for row in trip.reversed(reward, gamma) {
            self.sides[theirs].reversed.push(&row.numbers());
        }
        let own = &mut self.sides[mine];
        let place = match kind {
            Kind::Demonstration => &mut own.demonstrations,
            Kind::Rollout => &mut own.rollouts,
        };
        for row in trip.transitions(reward, gamma) {
            place.push(&row.numbers());
        }
        let Some(length) = trip.success.filter(|n| *n > 0) else { return };
        for i in 0..length.min(trip.decisions()) {
            let share = |n: usize| n as f32 / length as f32;
            let own = &mut self.sides[mine];
            let seen = own.adapter.observe(&trip.states[i + 1]);
            own.own.push(&seen[own.adapter.of_potentials()], share(i + 1));
            let turned = &mut self.sides[theirs];
            let seen = turned.adapter.observe(&trip.states[i]);
            turned.turned.push(&seen[turned.adapter.of_potentials()], 1.0 - share(i));
        }
    }

    /// Lets the potentials learn that know something new after a success of `direction`.
    pub(crate) fn learn_potentials(
        &mut self,
        direction: Direction,
        steps: usize,
        rng: &mut Rng,
    ) -> Result<()> {
        self.sides[side(direction)].own.learn(steps, POTENTIAL_BATCH, rng)?;
        self.sides[side(direction.reverse())].turned.learn(steps, POTENTIAL_BATCH, rng)?;
        Ok(())
    }

    /// One update of the agent of `direction`; in the hard one's turn the dynamics models learn too. None where there is nothing to learn
    /// from yet.
    pub(crate) fn update(&mut self, direction: Direction, rng: &mut Rng) -> Result<Option<Report>> {
        let [n, d, r] = self.config.batch;
        let me = &self.sides[side(direction)];
        let width = me.adapter.action();
        let (mut batch, mut report) = (Batch::default(), Report::default());
        let rollouts: Vec<&[f32]> = me.rollouts.draw(n, rng).collect();
        let demonstrations: Vec<&[f32]> = me.demonstrations.draw(d, rng).collect();
        for row in rollouts.into_iter().chain(demonstrations) {
            let p = parts(row, width);
            let (now, next) = (me.adapter.observe(p.now), me.adapter.observe(p.next));
            batch.push(&now, p.action, p.reward, &next, p.bootstrap);
        }
        let reversed: Vec<&[f32]> = me.reversed.draw(r, rng).collect();
        if !reversed.is_empty() {
            // The models know the hard task's view alone.
            let view = &self.sides[0].adapter;
            let of = |part: for<'a> fn(&Parts<'a>) -> &'a [f32]| -> Vec<f32> {
                reversed.iter().flat_map(|row| view.observe(part(&parts(row, width)))).collect()
            };
            let (now, next) = (of(|p| p.now), of(|p| p.next));
            let (actions, good) = self.models.propose(&now, &next, &self.confirmation)?;
            for ((row, action), good) in reversed.iter().zip(actions.chunks_exact(width)).zip(&good) {
                if *good {
                    let p = parts(row, width);
                    let (now, next) = (me.adapter.observe(p.now), me.adapter.observe(p.next));
                    batch.push(&now, action, p.reward, &next, p.bootstrap);
                }
            }
            report.reversed = [reversed.len(), good.iter().filter(|g| **g).count()];
        }
        if batch.is_empty() {
            return Ok(None);
        }
        self.shape(direction, &mut batch)?;
        let done = self.sides[side(direction)].agent.update(&batch, rng)?;
        (report.value, report.alpha, report.critic_loss) = (done.value, done.alpha, done.critic_loss);
        if direction == Direction::Hard {
            report.models = self.learn_models(rng)?;
        }
        Ok(Some(report))
    }

    /// Rewards of decisions without success: how much further the potentials say they lead.
    fn shape(&self, direction: Direction, batch: &mut Batch) -> Result<()> {
        let me = &self.sides[side(direction)];
        let potentials: Vec<&Potential> =
            [&me.own, &me.turned].into_iter().filter(|p| !p.is_empty()).collect();
        if potentials.is_empty() || self.config.shaping == 0.0 {
            return Ok(());
        }
        let o = me.adapter.observation();
        let seen = |rows: &[f32]| -> Vec<f32> {
            rows.chunks_exact(o).flat_map(|row| row[me.adapter.of_potentials()].iter().copied()).collect()
        };
        let (now, next) = (seen(&batch.observation), seen(&batch.next));
        let mut shaped = vec![0.0; batch.len()];
        let limit = self.config.shaping_limit;
        for p in &potentials {
            for ((shaped, a), b) in shaped.iter_mut().zip(p.values(&now)?).zip(p.values(&next)?) {
                *shaped += (self.config.shaping * (b - a)).clamp(-limit, limit) / potentials.len() as f32;
            }
        }
        for (reward, shaped) in batch.reward.iter_mut().zip(shaped) {
            if *reward == 0.0 {
                *reward = shaped;
            }
        }
        Ok(())
    }

    /// One step of the dynamics models on transitions of both directions.
    fn learn_models(&mut self, rng: &mut Rng) -> Result<Option<[f32; 2]>> {
        let [n, d, _] = self.config.batch;
        let view = &self.sides[0].adapter;
        let width = view.action();
        let (mut now, mut action, mut next) = (vec![], vec![], vec![]);
        for s in &self.sides {
            for (memory, n) in [(&s.rollouts, n.div_ceil(2)), (&s.demonstrations, d.div_ceil(2))] {
                for row in memory.draw(n, rng) {
                    let p = parts(row, width);
                    now.extend(view.observe(p.now));
                    action.extend_from_slice(p.action);
                    next.extend(view.observe(p.next));
                }
            }
        }
        if action.is_empty() {
            return Ok(None);
        }
        Ok(Some(self.models.learn(&now, &action, &next)?))
    }

    /// Weights and optimisers. Memories are the caller's to fill again.
    pub(crate) fn state(&self) -> Result<Weights> {
        let mut all = Weights::new();
        for (s, name) in self.sides.iter().zip(["hard", "easy"]) {
            s.agent.state(&format!("{name}.agent."), &mut all)?;
            s.own.state(&format!("{name}.own."), &mut all)?;
            s.turned.state(&format!("{name}.turned."), &mut all)?;
        }
        self.models.state("models.", &mut all)?;
        Ok(all)
    }

    /// Takes over what [`Agents::state`] gave.
    pub(crate) fn load(&mut self, all: &Weights) -> Result<()> {
        for (s, name) in self.sides.iter_mut().zip(["hard", "easy"]) {
            s.agent.load(&format!("{name}.agent."), all)?;
            s.own.load(&format!("{name}.own."), all)?;
            s.turned.load(&format!("{name}.turned."), all)?;
        }
        Ok(self.models.load("models.", all)?)
    }
}
