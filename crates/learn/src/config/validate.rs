//! What a configuration is refused for. Each type knows its own limits; here are those of a run, and what must agree.

use super::RunConfig;
use crate::{Error, Result};
use e2h_env::CAMERAS;

/// Most weights of a policy: with its optimiser and its average 16 GB.
const MOST_PARAMETERS: u128 = 1_000_000_000;
/// Most pixels of all images of a training step, and most numbers of one layer of the U-Net.
const MOST_NUMBERS: usize = 1 << 30;
/// Most steps of a stage, and between two saved states.
const MOST_STEPS: usize = 100_000_000;

/// Problems, each with the key that it is of.
#[derive(Default)]
struct Problems(Vec<String>);

impl Problems {
    fn check(&mut self, ok: bool, text: impl FnOnce() -> String) {
        if !ok {
            self.0.push(text());
        }
    }

    fn count(&mut self, key: &str, value: usize, least: usize, most: usize) {
        self.check((least..=most).contains(&value), || {
            format!("{key}: expected {least} to {most}, got {value}")
        });
    }

    fn number(&mut self, key: &str, value: f32, least: f32, most: f32) {
        self.check((least..=most).contains(&value), || {
            format!("{key}: expected {least} to {most}, got {value}")
        });
    }

    /// Those of a part, which names its entries as it knows them.
    fn of(&mut self, part: &str, problems: Vec<String>) {
        self.0.extend(problems.into_iter().map(|p| format!("{part}.{p}")));
    }
}

impl RunConfig {
    /// Checks every value, and that they fit together; needs no simulation and no memory.
    ///
    /// # Errors
    /// Lists all problems, each with its key, what was expected and what was found.
    pub fn validate(&self) -> Result<()> {
        let mut all = Problems::default();
        all.of("task.demonstrator", self.task.demonstrator.validate());
        let clearance = self.task.clearance;
        all.check((0.0..=1.0).contains(&clearance), || {
            format!("task.clearance: expected 0 to 1, got {clearance}")
        });
        self.check_loop(&mut all);
        self.check_learning(&mut all);
        let r = &self.refine;
        for (part, problems) in [
            ("env", self.env.validate()),
            ("refine.reverse", r.reverse.validate()),
            ("refine.kinematic", r.kinematic.validate()),
            ("refine.gate", r.gate.validate()),
            ("refine.goal", r.goal.validate()),
            ("refine.advantage", r.advantage.validate()),
            ("refine.suffix", r.suffix.validate()),
        ] {
            all.of(part, problems);
        }
        if all.0.is_empty() { Ok(()) } else { Err(Error::Config(all.0.join("; "))) }
    }

    /// Whether the registry has the task in that form.
    pub(super) fn check_registry(&self) -> Result<()> {
        e2h_env::task(&self.task.name, &self.task.options()).map(|_| ()).map_err(|e| {
            let problem = e2h_core::one_line(&e.to_string());
            Error::Config(format!("task.name, task.variant or task.clearance: {problem}"))
        })
    }

    fn check_loop(&self, all: &mut Problems) {
        let l = &self.closed_loop;
        all.count("loop.demonstrations", l.demonstrations, 1, 100_000);
        all.count("loop.iterations", l.iterations as usize, 0, 1000);
        all.count("loop.cycles", l.cycles, 1, 100_000);
        all.count("loop.loops", l.loops, 1, 1024);
        all.number("loop.base_share", l.base_share, 0.0, 1.0);
        all.of("loop.explore", l.explore.validate(l.iterations));
        let e = &self.evaluation;
        all.count("evaluation.trials", e.trials, 1, 100_000);
        all.count("evaluation.parallel", e.parallel, 1, 1024);
        all.count("evaluation.filmed", e.filmed, 0, 100);
    }

    fn check_learning(&self, all: &mut Problems) {
        let (p, t) = (&self.policy, &self.train);
        for (key, steps, least) in [
            ("train.easy_steps", t.easy_steps, 0),
            ("train.initial_steps", t.initial_steps, 0),
            ("train.update_steps", t.update_steps, 0),
            ("train.easy_update_steps", t.easy_update_steps, 0),
            ("train.save_every", t.save_every, 1),
        ] {
            all.count(key, steps, least, MOST_STEPS);
        }
        all.number("train.normaliser_margin", t.normaliser_margin, 0.0, 10.0);
        all.of("train.step", t.step.validate());
        all.check(p.guidance == 1.0 || t.step.conditioning_dropout > 0.0, || {
            format!(
                "policy.guidance: expected 1 for a policy trained with train.step.conditioning_dropout = 0, got {}",
                p.guidance
            )
        });
        let guidance = self.recap.guidance;
        all.number("recap.guidance", guidance, 0.0, 100.0);
        all.check(guidance == 1.0 || t.step.indicator_dropout > 0.0, || {
            format!("recap.guidance: expected 1 with train.step.indicator_dropout = 0, got {guidance}")
        });
        all.of("dynamics.network", self.dynamics.network.validate());
        all.of("dynamics.filter", self.dynamics.filter.validate());
        all.of("tr_drl", self.tr_drl.validate());
        all.of("critic.network", self.critic.network.validate(p));
        for camera in p.cameras.iter().filter(|c| !CAMERAS.contains(&c.as_str())) {
            all.0.push(format!(
                "policy.cameras: expected cameras of the scene ({}), got `{}`",
                CAMERAS.join(", "),
                e2h_core::one_line(camera)
            ));
        }
        let images = !p.cameras.is_empty();
        all.check(!images || self.env.cameras, || {
            "env.cameras: expected true for a policy with cameras, got false".to_owned()
        });
        all.check(!images || p.n_image_steps > 0, || {
            "policy.n_image_steps: expected at least 1 for a policy with cameras, got 0".to_owned()
        });
        all.check(!images || p.image_size == self.env.image_size, || {
            format!(
                "policy.image_size: expected env.image_size ({}), got {}",
                self.env.image_size, p.image_size
            )
        });
        match p.count_parameters() {
            Ok(n) => all.check(n <= MOST_PARAMETERS, || {
                format!("policy: expected at most {MOST_PARAMETERS} parameters, got {n}")
            }),
            Err(e) => all.0.push(format!("policy: {e}")),
        }
        let pixels = |samples: usize, crop: usize| {
            [p.cameras.len(), p.n_image_steps, crop, crop, 3].into_iter().fold(samples, usize::saturating_mul)
        };
        let s = &t.step;
        let rows = s.conditions.saturating_mul(s.noises).saturating_mul(p.horizon);
        let widest = p.down_dims.iter().copied().max().unwrap_or(0);
        for (key, numbers) in [
            ("train.step.conditions", pixels(s.conditions, p.crop_size)),
            ("train.step.noises", rows.saturating_mul(widest)),
            ("critic.network.batch", pixels(self.critic.network.batch, self.critic.network.crop_size)),
        ] {
            all.check(numbers <= MOST_NUMBERS, || {
                format!("{key}: expected a step of at most {MOST_NUMBERS} numbers, got {numbers}")
            });
        }
    }
}
