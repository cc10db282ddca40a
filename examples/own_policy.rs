//! A class of policies of one's own in the loop: behaviour cloning from the state with a small network, no images.
//!
//! ```text
//! cargo run --release --example own_policy -- --preset smoke
//! cargo run --release --example own_policy -- --seed 1 --set loop.cycles=20
//! ```

mod common;

use auto_e2h::core::{self, ACTION_DIM, ActionChunk, Observation, Policy, Rng, STATE_DIM, stream};
use auto_e2h::data::{Normaliser, Source};
use auto_e2h::learn::{Error, Job, Parts, PolicyClass, Result, Trained, Training};
use auto_e2h::nn::candle_core::{self, Device, Module, Tensor};
use auto_e2h::nn::candle_nn::{self, Linear};
use auto_e2h::nn::{self, Adam, AdamConfig, Builder, Compute, Mode, Params, Weights, backward, mse};
use auto_e2h::policy::Provenance;
use common::Run;
use rand::Rng as _;
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

/// Actions that one call predicts.
const CHUNK: usize = 8;
/// The state, and the object's position less the tool's.
const FEATURES: usize = STATE_DIM + 3;
const NORMALISER: &str = "normaliser";

struct Mlp([Linear; 3]);

impl Mlp {
    fn new(b: &Builder<'_>) -> nn::Result<Self> {
        let sizes = [(FEATURES, 256, "0"), (256, 256, "1"), (256, CHUNK * ACTION_DIM, "2")];
        let [first, second, third] =
            sizes.map(|(from, to, name)| candle_nn::linear(from, to, b.var_builder().pp(name)));
        Ok(Self([first?, second?, third?]))
    }
}

impl Module for Mlp {
    fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        let [first, second, third] = &self.0;
        third.forward(&second.forward(&first.forward(x)?.relu()?)?.relu()?)
    }
}

/// What the network sees of a state.
fn features(state: &core::State, normaliser: &Normaliser) -> [f32; FEATURES] {
    let mut row = [0.0; FEATURES];
    row[..STATE_DIM].copy_from_slice(&normaliser.normalise_state(state));
    for i in 0..3 {
        row[STATE_DIM + i] = 10.0 * (state[7 + i] - state[i]);
    }
    row
}

fn tensor(rows: &[f32], width: usize) -> candle_core::Result<Tensor> {
    Tensor::from_slice(rows, (rows.len() / width, width), &Device::Cpu)
}

struct Cloned {
    params: Params,
    net: Mlp,
    normaliser: Normaliser,
}

impl Cloned {
    fn new(weights: Option<&Weights>, normaliser: &Normaliser, seed: u64, mode: Mode) -> nn::Result<Self> {
        let (params, net) = Params::build(mode, &mut stream(seed, "own/weights", 0, 0), Mlp::new)?;
        weights.map_or(Ok(()), |w| params.import(w))?;
        Ok(Self { params, net, normaliser: normaliser.clone() })
    }
}

impl Policy for Cloned {
    fn n_obs_steps(&self) -> usize {
        1
    }

    fn act(&self, histories: &[Vec<&Observation>], _: &mut [Rng]) -> core::Result<Vec<ActionChunk>> {
        let rows: Vec<f32> = histories.iter().flat_map(|h| features(&h[0].state, &self.normaliser)).collect();
        let output = tensor(&rows, FEATURES).and_then(|x| self.net.forward(&x)?.to_vec2::<f32>());
        let output = output.map_err(|e| core::Error::Model(e.to_string()))?;
        let chunk = |row: &Vec<f32>| {
            row.as_chunks::<ACTION_DIM>().0.iter().map(|a| self.normaliser.unnormalise_action(a)).collect()
        };
        Ok(output.iter().map(chunk).collect())
    }
}

impl Trained for Cloned {
    fn weights(&self) -> Result<Weights> {
        Ok(self.params.export()?)
    }

    fn save(&self, folder: &Path, provenance: &Provenance) -> Result<()> {
        let about = serde_json::json!({ "kind": "mlp", "task": provenance.task, "seed": provenance.seed });
        auto_e2h::data::write_atomic(&folder.join("policy.json"), format!("{about:#}\n").as_bytes())?;
        let mut weights = self.weights()?;
        let data = self.normaliser.to_vec();
        weights.insert(NORMALISER.to_owned(), nn::HostTensor { shape: vec![data.len()], data });
        Ok(nn::save_weights(folder.join("model.safetensors"), &weights, &BTreeMap::new())?)
    }
}

struct Cloning<'a> {
    job: Job<'a>,
    policy: Cloned,
    adam: Adam,
    step: usize,
    losses: VecDeque<f32>,
}

impl Training for Cloning<'_> {
    fn step_count(&self) -> usize {
        self.step
    }

    fn step(&mut self) -> Result<f32> {
        let mut rng = stream(self.job.seed, self.job.purpose, 0, self.step as u64);
        let (mut x, mut y) = (vec![], vec![]);
        // Every source by its share; an episode first, then a row of it.
        let there: Vec<&Source> = self.job.sources.iter().filter(|s| !s.episodes.is_empty()).collect();
        for _ in 0..64 {
            let mut at = rng.random::<f32>() * there.iter().map(|s| s.share).sum::<f32>();
            let source = there
                .iter()
                .find(|s| {
                    at -= s.share;
                    at < 0.0
                })
                .unwrap_or(&there[0]);
            let episode = &source.episodes[rng.random_range(0..source.episodes.len())];
            let t = rng.random_range(0..episode.len());
            x.extend(features(&episode.state[t], self.job.normaliser));
            for k in 0..CHUNK {
                let row = (t + k).min(episode.len() - 1);
                y.extend(self.job.normaliser.normalise_action(&episode.action[row]));
            }
        }
        let net = &self.policy.net;
        let learn = || mse(&net.forward(&tensor(&x, FEATURES)?)?, &tensor(&y, CHUNK * ACTION_DIM)?, None);
        let loss: Tensor = learn()?;
        let value = loss.to_scalar::<f32>().map_err(nn::Error::from)?;
        self.adam.step(&self.policy.params, &backward(&loss, &self.policy.params)?, 1e-3)?;
        self.step += 1;
        self.losses.truncate(99);
        self.losses.push_front(value);
        Ok(value)
    }

    fn mean_loss(&self) -> f64 {
        self.losses.iter().map(|&l| f64::from(l)).sum::<f64>() / self.losses.len().max(1) as f64
    }

    fn save(&self, file: &Path) -> Result<()> {
        let mut all = self.policy.params.export()?;
        all.extend(self.adam.state()?.into_iter().map(|(name, t)| (format!("adam/{name}"), t)));
        for (name, data) in
            [("step", vec![self.step as f32]), ("losses", self.losses.iter().copied().collect())]
        {
            all.insert(name.to_owned(), nn::HostTensor { shape: vec![data.len()], data });
        }
        Ok(nn::save_weights(file, &all, &BTreeMap::new())?)
    }

    fn restore(&mut self, file: &Path) -> Result<()> {
        let (mut all, _) = nn::load_weights(file)?;
        let mut numbers = |name: &str| all.remove(name).map(|t| t.data).unwrap_or_default();
        self.step = numbers("step").first().map_or(0, |&step| step as usize);
        self.losses = numbers("losses").into();
        let (adam, net): (Weights, Weights) =
            all.into_iter().partition(|(name, _)| name.starts_with("adam/"));
        let adam = adam.into_iter().map(|(name, t)| (name.replacen("adam/", "", 1), t)).collect();
        self.policy.params.import(&net)?;
        Ok(self.adam.load_state(&adam)?)
    }

    fn policy(&self) -> Result<Box<dyn Trained>> {
        let weights = self.policy.params.export()?;
        Ok(Box::new(Cloned::new(Some(&weights), self.job.normaliser, 0, Mode::Infer)?))
    }
}

/// The class: how a run begins a training of it, and reads what it saved.
struct BehaviourCloning;

impl PolicyClass for BehaviourCloning {
    fn name(&self) -> &str {
        "mlp"
    }

    fn train<'a>(&self, job: Job<'a>) -> Result<Box<dyn Training + 'a>> {
        let policy = Cloned::new(job.start, job.normaliser, job.seed, Mode::Train)?;
        let adam = Adam::new(&AdamConfig::default(), &policy.params)?;
        Ok(Box::new(Cloning { job, policy, adam, step: 0, losses: VecDeque::new() }))
    }

    fn load(&self, folder: &Path, _: &Compute) -> Result<Box<dyn Trained>> {
        let (mut weights, _) = nn::load_weights(folder.join("model.safetensors"))?;
        let numbers = weights.remove(NORMALISER).map(|t| t.data).unwrap_or_default();
        let normaliser = Normaliser::from_slice(&numbers).map_err(Error::from)?;
        Ok(Box::new(Cloned::new(Some(&weights), &normaliser, 0, Mode::Infer)?))
    }
}

fn main() -> ExitCode {
    let parts = Parts { policy: Some(Arc::new(BehaviourCloning)), ..Parts::default() };
    common::main("nut_assembly", parts, Run::learn)
}
