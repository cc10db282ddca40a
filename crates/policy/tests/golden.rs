//! Values of LeRobot 0.4.4 and diffusers 0.35.2, from `tests/golden` (see the README there).

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use candle_core::{Device, Tensor};
use e2h_nn::{Mode, Weights, mse};
use e2h_policy::{Ddim, DiffusionModel, PolicyConfig, Prediction};
use safetensors::{Dtype, SafeTensors};
use std::collections::BTreeMap;

struct Golden(BTreeMap<String, (Vec<usize>, Vec<f64>)>);

impl Golden {
    fn read(name: &str) -> Self {
        // Tests run in the folder of their package, wherever they were built.
        let path = format!("../../tests/golden/{name}.safetensors");
        let bytes = std::fs::read(path).unwrap();
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let read = |view: &safetensors::tensor::TensorView<'_>| -> Vec<f64> {
            let d = view.data();
            match view.dtype() {
                Dtype::F32 => {
                    d.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap()))).collect()
                }
                Dtype::F64 => d.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect(),
                Dtype::I64 => {
                    d.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as f64).collect()
                }
                other => panic!("{other:?}"),
            }
        };
        Self(file.tensors().iter().map(|(n, v)| (n.clone(), (v.shape().to_vec(), read(v)))).collect())
    }
    fn values(&self, name: &str) -> &[f64] {
        &self.0[name].1
    }
    fn f32(&self, name: &str) -> Vec<f32> {
        self.values(name).iter().map(|&v| v as f32).collect()
    }
    fn tensor(&self, name: &str) -> Tensor {
        Tensor::from_vec(self.f32(name), self.0[name].0.clone(), &Device::Cpu).unwrap()
    }
}

/// Norm of the difference over the norm of the reference.
fn assert_close(name: &str, got: &[f32], want: &[f64], tolerance: f64) {
    assert_eq!(got.len(), want.len(), "{name}");
    let d: f64 = got.iter().zip(want).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum::<f64>().sqrt();
    let n: f64 = want.iter().map(|b| b * b).sum::<f64>().sqrt();
    assert!(d <= tolerance * n, "{name}: relative difference {:e}, allowed {tolerance:e}", d / n);
}

fn vec(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

/// The formula that fills every parameter, from the generator's documentation.
fn fill(weights: &mut Weights) {
    for (k, (name, tensor)) in weights.iter_mut().enumerate() {
        let fan_in: usize = tensor.shape[1..].iter().product();
        for (i, v) in tensor.data.iter_mut().enumerate() {
            let s = (0.7 * ((i * 7919 + k * 104_729) % 10_007) as f64 + 0.3).sin();
            *v = if name.ends_with(".bias") {
                0.05 * s
            } else if tensor.shape.len() == 1 {
                1.0 + 0.1 * s
            } else {
                s * (2.0 / fan_in as f64).sqrt()
            } as f32;
        }
    }
}

#[test]
fn schedule_and_chain_are_those_of_diffusers() {
    let g = Golden::read("ddim");
    let ddim = Ddim::new(100, 10, Prediction::Epsilon).unwrap();
    let f32s = |v: &[f64]| v.iter().map(|&x| x as f32).collect::<Vec<_>>();
    assert_close("betas", &f32s(ddim.betas()), g.values("betas"), 1e-5);
    assert_close("alphas", &f32s(ddim.alphas_cumprod()), g.values("alphas_cumprod"), 1e-5);
    let steps: Vec<f32> = ddim.steps().map(|s| s.timestep as f32).collect();
    assert_close("timesteps", &steps, g.values("timesteps"), 0.0);

    let chain = g.values("chain");
    let n = chain.len() / 11;
    let mut x: Vec<f32> = chain[..n].iter().map(|&v| v as f32).collect();
    for (k, step) in ddim.steps().enumerate() {
        let noise: Vec<f32> = x.iter().map(|v| (0.5 * v + 0.01 * step.timestep as f32).tanh()).collect();
        ddim.step(step, &noise, &mut x);
        assert_close(&format!("chain {k}"), &x, &chain[(k + 1) * n..(k + 2) * n], 1e-5);
    }

    let (mut clean, noise) = (g.f32("add_noise.x0"), g.f32("add_noise.noise"));
    let half = clean.len() / 2;
    for (i, &t) in g.values("add_noise.t").iter().enumerate() {
        ddim.add_noise(&mut clean[i * half..(i + 1) * half], &noise[i * half..(i + 1) * half], t as usize);
    }
    assert_close("add_noise", &clean, g.values("add_noise.out"), 1e-5);
}

#[test]
fn the_whole_model_is_lerobots() {
    let g = Golden::read("diffusion_model");
    let config = PolicyConfig {
        n_obs_steps: 2,
        n_image_steps: 2,
        n_action_steps: 15,
        lerobot_alignment: true,
        image_size: 56,
        crop_size: 56,
        share_encoder: true,
        encoder_width: 64,
        encoder_blocks: vec![2, 2, 2, 2],
        keypoints: 32,
        image_features: 64,
        down_dims: vec![32, 64, 128],
        kernel_size: 5,
        step_embed_dim: 32,
        prediction: Prediction::Epsilon,
        inference_steps: 10,
        ..PolicyConfig::tiny()
    };
    let model = DiffusionModel::new(&config, Mode::Infer, &mut e2h_core::stream(0, "weights", 0, 0)).unwrap();
    let mut weights = model.params().export().unwrap();
    fill(&mut weights);
    model.params().import(&weights).unwrap();

    let state = g.tensor("state").flatten_from(1).unwrap();
    let images = g.tensor("images"); // (B, To, camera, 3, H, W)
    let images: Vec<Tensor> = (0..2)
        .map(|camera| {
            let x = images.narrow(2, camera, 1).unwrap().squeeze(2).unwrap().flatten(0, 1).unwrap();
            x.permute((0, 2, 3, 1)).unwrap().contiguous().unwrap()
        })
        .collect();
    let condition = model.condition(&state, &images).unwrap();
    assert_close("condition", &vec(&condition), g.values("global_cond"), 1e-4);

    let ddim = Ddim::new(100, 10, Prediction::Epsilon).unwrap();
    let (mut noisy, noise) = (g.f32("action"), g.f32("noise"));
    let half = noisy.len() / 2;
    let timesteps = g.f32("t");
    for (i, &t) in timesteps.iter().enumerate() {
        ddim.add_noise(&mut noisy[i * half..(i + 1) * half], &noise[i * half..(i + 1) * half], t as usize);
    }
    let noisy = Tensor::from_vec(noisy, (2, 16, 8), &Device::Cpu).unwrap();
    let output = model.forward(&noisy, &timesteps, &condition).unwrap();
    assert_close("pred", &vec(&output), g.values("pred"), 1e-4);
    let loss = mse(&output, &g.tensor("noise"), None).unwrap().to_scalar::<f32>().unwrap();
    assert_close("loss", &[loss], g.values("loss"), 1e-4);

    // From the reference's condition: ten steps that begin by dividing by a small signal would multiply the encoder's rounding.
    let condition = g.tensor("global_cond");
    let mut x = g.f32("init_noise");
    for step in ddim.steps() {
        let input = Tensor::from_slice(&x, (2, 16, 8), &Device::Cpu).unwrap();
        let output = model.forward(&input, &[step.timestep as f32; 2], &condition).unwrap();
        ddim.step(step, &vec(&output), &mut x);
    }
    assert_close("sample", &x, g.values("sample"), 1e-4);
}
