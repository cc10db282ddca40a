//! Checkpoints of LeRobot 0.4.4 act the same here (`tests/golden/lerobot`, see the README there).

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]
#![allow(clippy::print_stdout, reason = "how far both are is worth reading when it fails")]

use e2h_core::Image;
use e2h_nn::{
    Compute, HostTensor, Precision, SpatialSoftmax, Weights, candle_operations, load_weights, save_weights,
};
use e2h_policy::lerobot::{LerobotObservation, LerobotPolicy, import};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/lerobot").join(name)
}

/// The formula of `tests/golden/README.md`.
fn s(k: usize, i: usize) -> f64 {
    (0.7 * ((i * 7919 + k * 104_729) % 10_007) as f64 + 0.3).sin()
}

fn numbers(k: usize, n: usize) -> Vec<f32> {
    (0..n).map(|i| s(k, i) as f32).collect()
}

fn observation(policy: &LerobotPolicy, step: usize) -> LerobotObservation {
    let [height, width] = policy.image_size();
    let image = |camera: usize| Image {
        height,
        width,
        data: (0..height * width * 3).map(|i| ((31 * i + 7 * camera + 13 * step) % 251) as u8).collect(),
    };
    LerobotObservation {
        state: numbers(3000 + step, policy.state_dim()),
        environment: numbers(3100 + step, policy.environment_dim()),
        images: (0..policy.cameras().count()).map(image).collect(),
    }
}

/// The largest difference between what LeRobot did and what is done here, in units of the dataset.
fn difference(policy: &LerobotPolicy, expected: &Path) -> f32 {
    let (expected, _) = load_weights(expected).unwrap();
    let per = policy.horizon() * policy.action_dim();
    let mut draws = expected["noise"].data.chunks_exact(per);
    let seen: Vec<LerobotObservation> = (0..policy.n_obs_steps()).map(|t| observation(policy, t)).collect();
    let chunk = policy
        .sample(&[seen.iter().collect()], &mut |x| x.copy_from_slice(draws.next().unwrap()))
        .unwrap()
        .remove(0);
    assert!(draws.next().is_none(), "a draw was not asked for");
    let want = &expected["actions"];
    assert_eq!([chunk.len(), chunk[0].len()], want.shape[..]);
    chunk.concat().iter().zip(&want.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn a_low_dimensional_policy_of_lerobots_acts_the_same_with_its_own_sampler() {
    let folder = golden("state");
    let policy = import(&folder).unwrap();
    assert_eq!((policy.state_dim(), policy.environment_dim(), policy.action_dim()), (5, 3, 4));
    let worst = difference(&policy, &folder.join("expected.safetensors"));
    assert!(worst < 1e-4, "{worst:e}");
    // What the noise does is not an accident of clipping: other noise gives other actions.
    let seen: Vec<LerobotObservation> = (0..2).map(|t| observation(&policy, t)).collect();
    let act = |k: usize| {
        policy.sample(&[seen.iter().collect()], &mut |x| x.copy_from_slice(&numbers(k, x.len()))).unwrap()
    };
    assert_ne!(act(1), act(2));
}

/// On Candle's operations, or on the GPU that `E2H_TEST_DEVICE` names.
#[test]
fn a_policy_of_lerobots_acts_the_same_on_another_device() {
    let folder = golden("state");
    let policy = import(&folder).unwrap();
    let moved = || {
        let name = std::env::var("E2H_TEST_DEVICE");
        let compute = Compute::open(name.as_deref().unwrap_or("cpu"), Precision::default()).unwrap();
        let policy = policy.into_device(&compute).unwrap();
        difference(&policy, &folder.join("expected.safetensors"))
    };
    let worst = if std::env::var("E2H_TEST_DEVICE").is_ok() { moved() } else { candle_operations(moved) };
    assert!(worst < 1e-4, "{worst:e}");
}

/// `config.json` may describe a network of any size, and so may a checkpoint of ours: it is refused by what the weights are,
/// before there is memory for it.
#[test]
fn a_network_that_no_memory_holds_is_refused() {
    let folder = copy("state");
    let path = folder.path().join("config.json");
    let text = std::fs::read_to_string(&path).unwrap();
    let refusal = |change: &dyn Fn(&mut Value)| {
        let mut value: Value = serde_json::from_str(&text).unwrap();
        change(&mut value);
        std::fs::write(&path, value.to_string()).unwrap();
        let message = import(folder.path()).err().unwrap().to_string();
        let named = message.contains(folder.path().to_str().unwrap());
        assert!(named && !message.contains(char::is_control), "{message}");
        message
    };
    let dims = |dims: &[usize]| refusal(&|v: &mut Value| v["down_dims"] = dims.into());
    assert!(dims(&[1 << 20, 1 << 20]).contains("of another shape"));
    assert!(dims(&[1 << 40]).contains("1 to 16 sizes of 1 to 1048576"));
    assert!(dims(&[8; 70]).contains("levels of down_dims: expected 1 to 16, got 70"));
    assert!(refusal(&|v| v["horizon"] = (1_u64 << 60).into()).contains("horizon: expected 1 to 4096"));
    assert!(refusal(&|v| v["num_train_timesteps"] = (1_u64 << 50).into()).contains("train_timesteps"));
    assert!(refusal(&|v| v["n_obs_steps"] = u64::MAX.into()).contains("n_obs_steps"));
    assert!(refusal(&|v| v["spatial_softmax_num_keypoints"] = u64::MAX.into()).contains("image_features"));
    let wide =
        |key: &str| refusal(&|v: &mut Value| v["input_features"][key]["shape"] = vec![1_u64 << 62].into());
    assert!(wide("observation.state").contains("a vector of up to 65536 numbers"));
    assert!(wide("observation.environment_state").contains("a vector of up to 65536 numbers"));
    refusal(&|v| v["type"] = "dif\nfusion".into());
}

/// A copy of a folder.
fn copy(name: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for file in std::fs::read_dir(golden(name)).unwrap() {
        let file = file.unwrap();
        std::fs::copy(file.path(), folder.path().join(file.file_name())).unwrap();
    }
    folder
}

/// The parameters whose shapes are stated, by the formula; buffers of batch norms have numbers of their own.
fn filled(folder: &Path) -> Weights {
    let shapes: BTreeMap<String, Vec<usize>> =
        serde_json::from_slice(&std::fs::read(folder.join("shapes.json")).unwrap()).unwrap();
    let mut weights = Weights::new();
    let buffers = shapes.iter().filter(|(n, _)| n.contains(".running_"));
    for (k, (name, shape)) in buffers.enumerate() {
        let value =
            |i| if name.ends_with("mean") { 0.2 * s(6000 + k, i) } else { 1.0 + 0.5 * s(6000 + k, i) };
        let data = (0..shape[0]).map(|i| value(i) as f32).collect();
        weights.insert(name.clone(), HostTensor { shape: shape.clone(), data });
    }
    let parameter =
        |n: &str| !n.ends_with("pos_grid") && !n.contains(".running_") && !n.ends_with("num_batches_tracked");
    for (k, (name, shape)) in shapes.iter().filter(|(n, _)| parameter(n)).enumerate() {
        let fan_in: usize = shape[1..].iter().product();
        let value = |i: usize| match () {
            () if name.ends_with(".bias") => 0.05 * s(k, i),
            () if shape.len() == 1 => 1.0 + 0.1 * s(k, i),
            () => s(k, i) * (2.0 / fan_in as f64).sqrt(),
        };
        let data = (0..shape.iter().product()).map(|i| value(i) as f32).collect();
        weights.insert(name.clone(), HostTensor { shape: shape.clone(), data });
    }
    weights
}

/// A safetensors file with numbers of another type: `number` gives the bytes of each. Integers besides, as LeRobot counts
/// batches.
fn save_as(path: &Path, weights: &Weights, dtype: &str, number: impl Fn(f32) -> Vec<u8>) {
    let (mut header, mut data) = (serde_json::Map::new(), vec![]);
    let mut put = |name: &str, dtype: &str, shape: &[usize], bytes: Vec<u8>| {
        let entry = serde_json::json!({
            "dtype": dtype, "shape": shape, "data_offsets": [data.len(), data.len() + bytes.len()]
        });
        header.insert(name.to_owned(), entry);
        data.extend(bytes);
    };
    for (name, t) in weights {
        put(name, dtype, &t.shape, t.data.iter().flat_map(|v| number(*v)).collect());
        if let Some(norm) = name.strip_suffix("running_mean") {
            put(&format!("{norm}num_batches_tracked"), "I64", &[], 7_i64.to_le_bytes().to_vec());
        }
    }
    let header = Value::Object(header).to_string();
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    std::fs::write(path, bytes).unwrap();
}

fn plain(v: f32) -> Vec<u8> {
    v.to_le_bytes().to_vec()
}

/// The batch norms of LeRobot 0.6's default are folded into the convolutions, and act as they do there.
#[test]
fn a_policy_with_batch_norm_acts_the_same() {
    let folder = copy("batch");
    let file = folder.path().join("model.safetensors");
    let mut weights = filled(folder.path());
    save_as(&file, &weights, "F32", plain);
    let policy = import(folder.path()).unwrap();
    let worst = difference(&policy, &folder.path().join("expected.safetensors"));
    assert!(worst < 1e-4, "{worst:e}");

    // The means matter: others give other actions.
    let mean = "diffusion.rgb_encoder.backbone.4.0.bn1.running_mean";
    weights.get_mut(mean).unwrap().data.iter_mut().for_each(|v| *v += 0.5);
    save_as(&file, &weights, "F32", plain);
    let other = difference(&import(folder.path()).unwrap(), &folder.path().join("expected.safetensors"));
    assert!(other > 1e-3, "{other:e}");

    let refusal = |weights: &Weights| {
        save_as(&file, weights, "F32", plain);
        import(folder.path()).err().unwrap().to_string()
    };
    let mut broken = weights.clone();
    broken.get_mut("diffusion.rgb_encoder.backbone.1.running_var").unwrap().data[3] = -0.5;
    assert!(refusal(&broken).contains("backbone.1.running_var`: expected 0 or more, found -0.5"));
    broken.remove("diffusion.rgb_encoder.backbone.1.running_var");
    assert!(refusal(&broken).contains("expected `diffusion.rgb_encoder.backbone.1.running_var`, found none"));
    broken = weights.clone();
    broken.get_mut("diffusion.rgb_encoder.backbone.5.0.downsample.1.bias").unwrap().data.pop();
    broken.get_mut("diffusion.rgb_encoder.backbone.5.0.downsample.1.bias").unwrap().shape = vec![127];
    assert!(refusal(&broken).contains("downsample.1.bias`: expected shape [128], found [127]"));
    // A norm that is not there at all.
    broken = weights.clone();
    broken.retain(|n, _| !n.contains("backbone.6.1.bn2."));
    assert!(refusal(&broken).contains("diffusion.rgb_encoder.backbone.6.1.conv2.bias"));
}

/// What it cannot do is said by name.
/// Numbers of 16 bits are the same numbers in 32.
#[test]
fn weights_of_sixteen_bits_open() {
    let folder = copy("state");
    let file = folder.path().join("model.safetensors");
    let (weights, _) = load_weights(&file).unwrap();
    // Cut to what bf16 has, and to a multiple of 1/1024 below 2, which f16 has.
    let brain = |v: f32| f32::from_bits(v.to_bits() & 0xffff_0000);
    let half = |v: f32| (v * 1024.0).round().clamp(-2047.0, 2047.0) / 1024.0;
    let half_bits = |v: f32| {
        let bits = v.to_bits();
        if v == 0.0 {
            return 0;
        }
        let exponent = (bits >> 23 & 0xff) as u16 - 112;
        (bits >> 16) as u16 & 0x8000 | exponent << 10 | (bits >> 13 & 0x3ff) as u16
    };
    let act = || {
        let policy = import(folder.path()).unwrap();
        let seen: Vec<LerobotObservation> = (0..2).map(|t| observation(&policy, t)).collect();
        policy.sample(&[seen.iter().collect()], &mut |x| x.copy_from_slice(&numbers(1, x.len()))).unwrap()
    };
    let rounded = |round: &dyn Fn(f32) -> f32| {
        let mut w = weights.clone();
        w.values_mut().for_each(|t| t.data.iter_mut().for_each(|v| *v = round(*v)));
        w
    };
    save_as(&file, &rounded(&brain), "F32", plain);
    let expected = act();
    save_as(&file, &rounded(&brain), "BF16", |v| v.to_le_bytes()[2..].to_vec());
    assert_eq!(act(), expected);
    save_as(&file, &rounded(&half), "F32", plain);
    let expected = act();
    save_as(&file, &rounded(&half), "F16", |v| half_bits(v).to_le_bytes().to_vec());
    assert_eq!(act(), expected);
    save_as(&file, &weights, "F64", |v| f64::from(v).to_le_bytes().to_vec());
    let message = import(folder.path()).err().unwrap().to_string();
    assert!(
        message.contains("expected tensors of type F32, F16 or BF16") && message.contains("F64"),
        "{message}"
    );
}

/// The positions of the spatial softmax are computed here; a file with others means something else.
#[test]
fn positions_other_than_ours_are_refused() {
    let folder = copy("batch");
    let file = folder.path().join("model.safetensors");
    let mut weights = filled(folder.path());
    let name = "diffusion.rgb_encoder.pool.pos_grid";
    let ours = SpatialSoftmax::position_grid(2, 2);
    let open = |weights: &Weights| {
        save_as(&file, weights, "F32", plain);
        import(folder.path()).err().map(|e| e.to_string()).unwrap_or_default()
    };
    weights.insert(name.to_owned(), ours.clone());
    assert_eq!(open(&weights), "");
    // y first, from 0 to 1, and of another map.
    let swap = |t: &HostTensor| t.data.chunks(2).flat_map(|p| [p[1], p[0]]).collect::<Vec<_>>();
    weights.insert(name.to_owned(), HostTensor { data: swap(&ours), ..ours.clone() });
    let message = open(&weights);
    assert!(
        message.contains("pos_grid: expected [4, 2], from -1 to 1 over a map of 2 x 2, found"),
        "{message}"
    );
    let unit = ours.data.iter().map(|v| (v + 1.0) / 2.0).collect();
    weights.insert(name.to_owned(), HostTensor { data: unit, ..ours.clone() });
    assert!(open(&weights).contains("found 0 in the place of -1, entry 0"));
    weights.insert(name.to_owned(), SpatialSoftmax::position_grid(3, 2));
    assert!(open(&weights).contains("found [6, 2]"));
}

/// Positions that were rounded to 16 bits with the weights are those positions still.
#[test]
fn rounded_positions_are_taken() {
    let folder = copy("image");
    let at = |name: &str| folder.path().join(name);
    let mut config = json(&at("config.json"));
    for camera in ["wrist", "front"] {
        config["input_features"][format!("observation.images.{camera}")]["shape"] = vec![3, 67, 130].into();
    }
    config["crop_shape"] = vec![64, 120].into();
    std::fs::write(at("config.json"), config.to_string()).unwrap();
    let mut weights = filled(folder.path());
    let mut open = |change: &dyn Fn(f32) -> f32| {
        for camera in 0..2 {
            let mut grid = SpatialSoftmax::position_grid(2, 4);
            grid.data.iter_mut().for_each(|v| *v = change(*v));
            weights.insert(format!("diffusion.rgb_encoder.{camera}.pool.pos_grid"), grid);
        }
        save_weights(at("model.safetensors"), &weights, &BTreeMap::new()).unwrap();
        import(folder.path()).err().map(|e| e.to_string()).unwrap_or_default()
    };
    assert_eq!(open(&|v| v), "");
    assert_eq!(open(&|v| f32::from_bits(v.to_bits() & 0xffff_0000)), "");
    assert_eq!(open(&|v| (v * 2048.0).round() / 2048.0), "");
    assert!(open(&|v| v * 0.999).contains("pos_grid"));
    assert!(open(&|v| (v * 10.0).round() / 10.0).contains("pos_grid"));
}

#[test]
fn folders_from_before_lerobot_04_are_told_what_to_do() {
    let folder = copy("state");
    let at = |name: &str| folder.path().join(name);
    std::fs::remove_file(at("policy_preprocessor.json")).unwrap();
    let (mut weights, _) = load_weights(at("model.safetensors")).unwrap();
    let buffer = HostTensor { shape: vec![5], data: vec![0.0; 5] };
    weights.insert("normalize_inputs.buffer_observation_state.mean".to_owned(), buffer);
    save_weights(at("model.safetensors"), &weights, &BTreeMap::new()).unwrap();
    let message = import(folder.path()).err().unwrap().to_string();
    for words in ["before 0.4", "lerobot.processor.migrate_policy_normalization", "_migrated"] {
        assert!(message.contains(words), "expected `{words}` in: {message}");
    }
    // And from before a policy said its type.
    let mut config = json(&at("config.json"));
    config.as_object_mut().unwrap().remove("type");
    std::fs::write(at("config.json"), config.to_string()).unwrap();
    let message = import(folder.path()).err().unwrap().to_string();
    assert!(
        message.contains("expected the `type` of the policy") && message.contains("input_shapes"),
        "{message}"
    );
}

/// Against float64, beside torch's float32. Sampling amplifies a rounding, in some cases a thousandfold: single cases say nothing
/// (on the first, torch 2.7 and 2.10 are 4e-5 apart, where ours and torch are 4e-5 and 2e-5 from float64), their middle does. Its
/// standard error over 48 cases is 12 %, by bootstrap, and three of those are granted.
fn rounds_no_worse_than_torch(policy: &LerobotPolicy, file: &Path) {
    let (cases, _) = load_weights(file).unwrap();
    let per: usize = cases["float64"].shape[1..].iter().product();
    let torch = cases["float32"].data.chunks_exact(per);
    let mut worse = vec![];
    for (case, (want, torch)) in cases["float64"].data.chunks_exact(per).zip(torch).enumerate() {
        let steps = (0..policy.n_obs_steps()).map(|t| case * policy.n_obs_steps() + t);
        let seen: Vec<LerobotObservation> = steps.map(|step| observation(policy, step)).collect();
        let noise = &mut |x: &mut [f32]| x.copy_from_slice(&numbers(4000 + case, x.len()));
        let ours = policy.sample(&[seen.iter().collect()], noise).unwrap().remove(0).concat();
        assert_eq!(ours.len(), per);
        let off = |v: &[f32]| v.iter().zip(want).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt();
        println!("case {case}: {:.1e} from float64, torch {:.1e}", off(&ours), off(torch));
        worse.push(off(&ours) / off(torch));
    }
    worse.sort_by(f64::total_cmp);
    let middle = worse[worse.len() / 2];
    println!("{middle:.2} times as far as torch");
    assert!(middle < 1.4, "{middle:.2} times as far from float64 as torch's float32");
}

#[test]
fn an_image_policy_of_lerobots_acts_the_same() {
    let folder = copy("image");
    let mut weights = filled(folder.path());
    let file = folder.path().join("model.safetensors");
    save_weights(&file, &weights, &BTreeMap::new()).unwrap();
    let policy = import(folder.path()).unwrap();
    assert_eq!(
        policy.cameras().collect::<Vec<_>>(),
        ["observation.images.wrist", "observation.images.front"]
    );
    rounds_no_worse_than_torch(&policy, &folder.path().join("rounding.safetensors"));

    weights.remove("diffusion.unet.final_conv.1.bias");
    save_weights(&file, &weights, &BTreeMap::new()).unwrap();
    let message = import(folder.path()).err().unwrap().to_string();
    assert!(message.contains("diffusion.unet.final_conv.1.bias"), "{message}");
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn everything_of_lerobots_that_is_not_computed_here_is_listed() {
    let folder = copy("state");
    let edit = |name: &str, change: &dyn Fn(&mut Value)| {
        let path = folder.path().join(name);
        let mut value = json(&golden("state").join(name));
        change(&mut value);
        std::fs::write(path, value.to_string()).unwrap();
        import(folder.path()).err().map(|e| e.to_string()).unwrap_or_default()
    };
    let message = edit("config.json", &|v| {
        v["use_film_scale_modulation"] = false.into();
        v["n_groups"] = 4.into();
        v["beta_schedule"] = "linear".into();
        v["clip_sample_range"] = 2.0.into();
    });
    for words in [
        "use_film_scale_modulation: expected true, found false",
        "beta_schedule: expected squaredcos_cap_v2, found linear",
        "n_groups: expected 8, found 4",
        "true and 2",
    ] {
        assert!(message.contains(words), "expected `{words}` in: {message}");
    }
    let message = edit("config.json", &|v| v["type"] = "act".into());
    assert!(message.ends_with("type: expected diffusion, found act"), "{message}");
    let message = edit("config.json", &|v| v["down_dims"] = vec![8, 24].into());
    assert!(message.contains("down_modules.1"), "{message}");
    assert_eq!(edit("config.json", &|_| {}), "");

    let message = edit("policy_preprocessor.json", &|v| v["steps"][0]["registry_name"] = "tokenizer".into());
    assert!(message.contains("steps") && message.contains("tokenizer"), "{message}");
    for file in ["../x", "a\u{7f}\n.safetensors"] {
        let message = edit("policy_preprocessor.json", &|v| v["steps"][3]["state_file"] = file.into());
        assert!(message.contains("in this folder") && !message.contains(char::is_control), "{message:?}");
    }
    let message = edit("policy_preprocessor.json", &|v| {
        v["steps"][3]["config"]["norm_map"]["STATE"] = "QUANTILES".into();
    });
    assert!(message.contains("observation.state.q01: expected 5 finite numbers, found none"), "{message}");
    edit("policy_preprocessor.json", &|_| {});

    let error = import(folder.path()).unwrap().into_policy().err().unwrap().to_string();
    for words in [
        "observation.state: expected 15 numbers, found 5",
        "observation.environment_state: expected none, found 3 numbers",
        "action: expected 8 numbers, found 4",
    ] {
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
    std::fs::remove_file(folder.path().join("policy_postprocessor.json")).unwrap();
    let message = import(folder.path()).err().unwrap().to_string();
    assert!(message.contains("policy_postprocessor.json"), "{message}");
}
