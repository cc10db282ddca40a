//! The Rust side of the checkpoint checks of `tests/interop/run.sh`: makes a policy, and prints what a policy does.
//!
//! ```text
//! cargo run --release -p e2h-policy --example lerobot_actions -- make DIR
//! cargo run --release -p e2h-policy --example lerobot_actions -- ours CHECKPOINT INPUTS OUT
//! cargo run --release -p e2h-policy --example lerobot_actions -- theirs LEROBOT INPUTS OUT
//! ```
//!
//! `INPUTS` is a safetensors file: `state` (To, S), perhaps `environment` (To, E), `images` (To, cameras, H, W, 3) from 0 to
//! 255, `noise` (draws, T, A). `OUT` gets `actions` (Ta, A).

use clap::Parser;
use e2h_core::{Direction, Episode, Image, Observation, Origin};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_nn::{HostTensor, Weights, load_weights, save_weights};
use e2h_policy::lerobot::{LerobotObservation, import};
use e2h_policy::{DiffusionPolicy, PolicyConfig, Prediction, Provenance};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Our side of the checks of policies against LeRobot.
#[derive(Parser)]
#[command(
    version,
    after_help = "Example:\n  cargo run --release -p e2h-policy --example lerobot_actions -- ours CHECKPOINT INPUTS OUT"
)]
enum Arguments {
    /// Writes a policy of ours with drawn weights.
    Make { dir: PathBuf },
    /// Writes the actions of a policy of ours.
    Ours { checkpoint: PathBuf, inputs: String, out: String },
    /// Writes the actions of a policy of LeRobot's.
    Theirs { lerobot: PathBuf, inputs: String, out: String },
}

fn main() -> Result<()> {
    match Arguments::parse() {
        Arguments::Make { dir } => make(&dir),
        Arguments::Ours { checkpoint, inputs, out } => ours(&checkpoint, &Inputs::read(&inputs)?, &out),
        Arguments::Theirs { lerobot, inputs, out } => theirs(&lerobot, &Inputs::read(&inputs)?, &out),
    }
}

/// A policy that LeRobot can express, with drawn weights and ranges of a made-up path.
fn make(dir: &Path) -> Result<()> {
    let config = PolicyConfig {
        n_image_steps: 2,
        n_action_steps: 8,
        lerobot_alignment: true,
        // Not in the order of the alphabet.
        cameras: vec!["wrist".to_owned(), "table".to_owned()],
        image_size: 72,
        crop_size: 64,
        encoder_width: 64,
        encoder_blocks: vec![2; 4],
        keypoints: 32,
        image_features: 64,
        down_dims: vec![32, 64, 128],
        kernel_size: 5,
        step_embed_dim: 32,
        prediction: Prediction::Epsilon,
        inference_steps: 10,
        unit_quaternion: false,
        ..PolicyConfig::tiny()
    };
    let mut path = Episode::new(Origin::demonstration("made up", Direction::Hard, 0, 0), &[]);
    for t in 0..50_u16 {
        let x = f32::from(t) * 0.01;
        let state = [x, -x, 0.5 * x + 0.1, 0., 1., 0., 0., 0.3 + x, x, 0.1, 1., 0., 0., 0., 0.03 + 0.1 * x];
        path.push(&Observation { state, frames: vec![] }, &[x, -x, 0.5 * x, 0., 1., 0., 0., 1.])?;
    }
    let normaliser =
        Normaliser::fit(&[path], &NormaliserConfig { margin: 0.1, ..NormaliserConfig::default() })?;
    let policy = DiffusionPolicy::untrained(&config, &normaliser, 7)?;
    policy.save(dir, &Provenance { task: "made up".to_owned(), ..Provenance::default() })?;
    Ok(())
}

struct Inputs(Weights);

impl Inputs {
    fn read(path: &str) -> Result<Self> {
        Ok(Self(load_weights(path)?.0))
    }

    fn rows(&self, name: &str) -> Vec<Vec<f32>> {
        let Some(t) = self.0.get(name) else { return vec![] };
        let width: usize = t.shape[1..].iter().product();
        t.data.chunks_exact(width.max(1)).map(<[f32]>::to_vec).collect()
    }

    /// Images of one step.
    // Whole numbers from 0 to 255.
    fn images(&self, step: usize) -> Vec<Image> {
        let Some(t) = self.0.get("images") else { return vec![] };
        let [_, cameras, height, width, _] = t.shape[..] else { return vec![] };
        let n = height * width * 3;
        let image = |camera: usize| {
            let start = (step * cameras + camera) * n;
            Image { height, width, data: t.data[start..start + n].iter().map(|&v| v as u8).collect() }
        };
        (0..cameras).map(image).collect()
    }

    /// Hands out the recorded draws, one after the other.
    fn noise(&self) -> impl FnMut(&mut [f32]) {
        let mut draws = self.rows("noise").into_iter();
        move |out: &mut [f32]| {
            if let Some(draw) = draws.next() {
                out.copy_from_slice(&draw);
            }
        }
    }
}

fn ours(checkpoint: &Path, inputs: &Inputs, out: &str) -> Result<()> {
    let (policy, _) = DiffusionPolicy::load(checkpoint)?;
    let mut history = vec![];
    for (step, row) in inputs.rows("state").iter().enumerate() {
        let state = row.as_slice().try_into()?;
        history.push(Observation { state, frames: inputs.images(step) });
    }
    let chunk = policy.sample_with(&[history.iter().collect()], &mut inputs.noise())?.remove(0);
    write(out, &chunk.iter().map(|a| a.to_vec()).collect::<Vec<_>>())
}

fn theirs(folder: &Path, inputs: &Inputs, out: &str) -> Result<()> {
    let policy = import(folder)?;
    let environment = inputs.rows("environment");
    let mut history = vec![];
    for (step, state) in inputs.rows("state").into_iter().enumerate() {
        let environment = environment.get(step).cloned().unwrap_or_default();
        history.push(LerobotObservation { state, environment, images: inputs.images(step) });
    }
    write(out, &policy.sample(&[history.iter().collect()], &mut inputs.noise())?.remove(0))
}

fn write(out: &str, actions: &[Vec<f32>]) -> Result<()> {
    let shape = vec![actions.len(), actions.first().map_or(0, Vec::len)];
    let all = Weights::from([("actions".to_owned(), HostTensor { shape, data: actions.concat() })]);
    Ok(save_weights(out, &all, &BTreeMap::new())?)
}
