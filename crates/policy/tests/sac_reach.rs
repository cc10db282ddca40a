//! Soft actor-critic by itself: it learns to reach from reward 1 within 20 mm alone.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Rng, stream};
use e2h_nn::Compute;
use e2h_policy::sac::{Batch, Replay, Sac, SacConfig};
use rand::Rng as _;

/// Half the side of the box of starts and goals, m.
const HALF: f32 = 0.1;
/// Largest step of a decision along an axis, m.
const STEP: f32 = 0.02;
/// Radius of success, m.
const NEAR: f32 = 0.02;
/// Decisions of an episode.
const HORIZON: usize = 40;

/// A point that moves, and where it shall go.
struct Reach {
    at: [f32; 3],
    goal: [f32; 3],
}

impl Reach {
    fn draw(rng: &mut Rng) -> Self {
        let mut point = || [(); 3].map(|()| rng.random_range(-HALF..HALF));
        Self { at: point(), goal: point() }
    }

    fn observation(&self) -> Vec<f32> {
        let at = self.at.map(|v| v / HALF);
        let way: [f32; 3] = std::array::from_fn(|i| (self.goal[i] - self.at[i]) / HALF);
        [at, way].concat()
    }

    fn step(&mut self, action: &[f32]) {
        for (v, a) in self.at.iter_mut().zip(action) {
            *v = (*v + STEP * a).clamp(-2.0 * HALF, 2.0 * HALF);
        }
    }

    fn reached(&self) -> bool {
        let d: f32 = self.at.iter().zip(self.goal).map(|(a, g)| (a - g).powi(2)).sum();
        d.sqrt() < NEAR
    }
}

/// Successes of 200 episodes, after so many decisions of training. `absorbing`: an episode ends at success, with all the
/// reward that would come. Otherwise it goes on, with reward 1 a decision.
fn learned(absorbing: bool, decisions: usize) -> usize {
    let config = SacConfig { hidden: vec![64, 64], lr: 1e-3, ..SacConfig::default() };
    let mut sac = Sac::new(&config, 6, 3, &Compute::cpu(), 0, "reach").unwrap();
    let mut rng = stream(0, "reach", 0, 0);
    // Observation, action, reward, next observation, whether something comes after.
    let mut replay = Replay::new(6 + 3 + 1 + 6 + 1, 100_000);
    let (mut reach, mut t) = (Reach::draw(&mut rng), 0);
    for n in 0..decisions {
        let now = reach.observation();
        let action = if n < 1000 {
            (0..3).map(|_| rng.random_range(-1.0..1.0)).collect()
        } else {
            sac.actor().act(&now, Some(&mut rng)).unwrap()
        };
        reach.step(&action);
        t += 1;
        let ends = absorbing && reach.reached();
        let reward = if ends { 1.0 / (1.0 - config.gamma) } else { f32::from(u8::from(reach.reached())) };
        let bootstrap = f32::from(u8::from(!ends));
        replay.push(&[&now[..], &action, &[reward], &reach.observation(), &[bootstrap]].concat());
        if ends || t == HORIZON {
            (reach, t) = (Reach::draw(&mut rng), 0);
        }
        if n >= 1000 {
            let mut batch = Batch::default();
            for row in replay.draw(128, &mut rng) {
                batch.push(&row[..6], &row[6..9], row[9], &row[10..16], row[16]);
            }
            let report = sac.update(&batch, &mut rng).unwrap();
            assert!(
                report.value < 1.2 / (1.0 - config.gamma),
                "values grow beyond what there is: {report:?}"
            );
        }
    }
    let mut rng = stream(1, "reach", 0, 0);
    let mut succeeds = || {
        let mut reach = Reach::draw(&mut rng);
        (0..HORIZON).any(|_| {
            let action = sac.actor().act(&reach.observation(), None).unwrap();
            reach.step(&action);
            reach.reached()
        })
    };
    (0..200).filter(|_| succeeds()).count()
}

#[test]
fn it_learns_to_reach_where_episodes_end_at_success() {
    let k = learned(true, 10_000);
    assert!(k > 190, "{k} of 200");
}

#[test]
fn it_learns_to_reach_where_they_go_on() {
    let k = learned(false, 10_000);
    assert!(k > 190, "{k} of 200");
}
