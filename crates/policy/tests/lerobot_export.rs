//! Our checkpoints have LeRobot's form once they are exported, and what it cannot express is refused. Whether LeRobot itself opens them is
//! for `tests/interop/run.sh`.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Direction, Episode, Image, Observation, Origin};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_policy::lerobot::{export, import, obstacles};
use e2h_policy::{DiffusionPolicy, EncoderNorm, Error, ImageScaling, PolicyConfig, Prediction, Provenance};
use serde_json::Value;
use std::path::Path;

use std::path::PathBuf;

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/lerobot").join(name)
}

/// Exportable, and as small as a ResNet-18 allows.
fn exportable() -> PolicyConfig {
    PolicyConfig {
        n_image_steps: 2,
        n_action_steps: 8,
        lerobot_alignment: true,
        cameras: vec!["wrist".to_owned(), "table".to_owned()],
        image_size: 36,
        crop_size: 32,
        share_encoder: true,
        encoder_width: 64,
        encoder_blocks: vec![2; 4],
        keypoints: 4,
        image_features: 8,
        prediction: Prediction::Epsilon,
        image_scaling: vec![ImageScaling { mean: [0.5, 0.4, 0.3], std: [0.2, 0.3, 0.4] }; 2],
        ..PolicyConfig::tiny()
    }
}

fn row(t: usize) -> Observation {
    let x = t as f32 * 0.01;
    let state = [x, -x, 0.5 * x, 0., 1., 0., 0., 0.3 + x, x, 0.1, 1., 0., 0., 0., 0.03 + 0.1 * x];
    let image = |k: usize| Image {
        height: 36,
        width: 36,
        data: (0..36 * 36 * 3).map(|i| ((i * 31 + k * 7 + t) % 251) as u8).collect(),
    };
    Observation { state, frames: vec![image(0), image(1)] }
}

fn normaliser() -> Normaliser {
    let mut path = Episode::new(Origin::demonstration("line", Direction::Hard, 0, 0), &[]);
    for t in 0..30 {
        let x = t as f32 * 0.01;
        let observation = Observation { frames: vec![], ..row(t) };
        path.push(&observation, &[x, -x, 0.5 * x, 0., 1., 0., 0., 1.]).unwrap();
    }
    Normaliser::fit(&[path], &NormaliserConfig::default()).unwrap()
}

fn noise_of(n: usize) -> Vec<f32> {
    (0..n).map(|i| (0.7 * ((i * 7919) % 10_007) as f32 + 0.3).sin()).collect()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Names of all entries, of objects inside as well; features and statistics aside, which differ from policy to policy.
fn keys(value: &Value, prefix: &str, out: &mut Vec<String>) {
    match value {
        Value::Object(map) => {
            for (k, v) in map {
                let name = format!("{prefix}.{k}");
                out.push(name.clone());
                if !["input_features", "output_features", "features"].contains(&k.as_str()) {
                    keys(v, &name, out);
                }
            }
        }
        Value::Array(list) => {
            list.iter().enumerate().for_each(|(i, v)| keys(v, &format!("{prefix}.{i}"), out));
        }
        _ => {}
    }
}

#[test]
fn an_exported_folder_has_lerobots_form_and_opens_here_twice() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let policy = DiffusionPolicy::untrained(&exportable(), &normaliser(), 3).unwrap();
    let provenance = Provenance { task: "line".to_owned(), seed: 9, ..Provenance::default() };
    policy.save(&at("ours"), &provenance).unwrap();
    let done = export(&at("ours"), &at("out")).unwrap();
    assert_eq!(done.notes.len(), 2, "{:?}", done.notes);
    assert!(done.notes[0].contains("quaternion") && done.notes[1].contains("beyond 4"), "{:?}", done.notes);

    for name in ["config.json", "policy_preprocessor.json", "policy_postprocessor.json"] {
        let (mut ours, mut theirs) = (vec![], vec![]);
        keys(&json(&at("out").join(name)), "", &mut ours);
        keys(&json(&golden("image").join(name)), "", &mut theirs);
        // norm_map has the kinds of features that there are.
        theirs.retain(|k| !k.ends_with(".ENV"));
        ours.sort();
        theirs.sort();
        assert_eq!(ours, theirs, "{name}");
        assert!(done.files.iter().any(|f| f == name));
    }
    let text = std::fs::read_to_string(at("out").join("config.json")).unwrap();
    assert!(text.find("images.wrist") < text.find("images.table"), "the order of the cameras is lost");

    // The same bytes again.
    export(&at("ours"), &at("again")).unwrap();
    for name in &done.files {
        assert_eq!(
            std::fs::read(at("out").join(name)).unwrap(),
            std::fs::read(at("again").join(name)).unwrap()
        );
    }

    // As one of ours, and as one of LeRobot's.
    let (ours, checkpoint) = DiffusionPolicy::load(&at("out")).unwrap();
    assert_eq!((ours.weights().unwrap(), &checkpoint.config), (policy.weights().unwrap(), policy.config()));
    let (theirs, back) = import(&at("out")).unwrap().into_policy().unwrap();
    assert_eq!(back, provenance);
    assert_eq!(theirs.config().state_limit, 0.0);
    let history = [row(3), row(4)];
    let seen = [history.iter().collect()];
    let mut noise = |x: &mut [f32]| x.copy_from_slice(&noise_of(x.len()));
    let a = policy.sample_with(&seen, &mut noise).unwrap().remove(0);
    let b = theirs.sample_with(&seen, &mut noise).unwrap().remove(0);
    assert_eq!((a.len(), b.len()), (8, 8));
    for (a, b) in a.iter().zip(&b) {
        let norm = b[3..7].iter().map(|v| v * v).sum::<f32>().sqrt();
        let unit = |i: usize| if (3..7).contains(&i) { b[i] / norm } else { b[i] };
        assert!((0..8).all(|i| (a[i] - unit(i)).abs() < 1e-5), "{a:?} {b:?}");
    }

    let message = export(&at("ours"), &at("out")).unwrap_err().to_string();
    assert!(message.contains("expected a new or an empty folder"), "{message}");
    // And round again: what came from LeRobot can go back.
    theirs.save(&at("back"), &back).unwrap();
    assert_eq!(export(&at("back"), &at("there")).unwrap().notes, [] as [String; 0]);
}

#[test]
fn everything_that_lerobot_cannot_express_is_listed_and_nothing_is_written() {
    assert!(obstacles(&exportable()).is_empty());
    let folder = tempfile::tempdir().unwrap();
    let config = PolicyConfig {
        relative_features: true,
        image_size: 27,
        image_features: 9,
        n_groups: 4,
        horizon: 18,
        guidance: 1.5,
        ..PolicyConfig::tiny()
    };
    let policy = DiffusionPolicy::untrained(&config, &normaliser(), 3).unwrap();
    let (ours, out) = (folder.path().join("ours"), folder.path().join("out"));
    policy.save(&ours, &Provenance::default()).unwrap();
    let error = export(&ours, &out).unwrap_err();
    let Error::Lerobot { obstacles: found, .. } = &error else { panic!("{error}") };
    assert_eq!(found.len(), 10, "{error}");
    for words in [
        "lerobot_alignment: expected true",
        "n_image_steps: expected 2, as n_obs_steps, found 1",
        "relative_features: expected false, found true",
        "encoder_width: expected 64, found 16",
        "encoder_blocks: expected [2, 2, 2, 2] (resnet18) or [3, 4, 6, 3] (resnet34), found [1]",
        "image_features: expected 8, twice the keypoints, found 9",
        "horizon: expected a multiple of 4 for 2 levels, found 18",
        "n_groups: expected 8, found 4",
        "guidance: expected 1, found 1.5",
        "found 20 in 27",
    ] {
        assert!(error.to_string().contains(words), "expected `{words}` in: {error}");
    }
    assert!(!out.exists());
    let blind = PolicyConfig { cameras: vec![], ..exportable() };
    assert_eq!(obstacles(&PolicyConfig { image_scaling: vec![], ..blind })[0].setting, "cameras");
}

#[test]
fn a_policy_with_a_folded_norm_is_not_exported() {
    let config = PolicyConfig { encoder_norm: EncoderNorm::Folded, ..exportable() };
    assert_eq!(
        obstacles(&config)[0].to_string(),
        "encoder_norm: expected group, found folded (a batch norm)"
    );
    let text = serde_json::to_string(&config).unwrap();
    assert!(text.contains(r#""encoder_norm":"folded""#));
    assert_eq!(serde_json::from_str::<PolicyConfig>(&text).unwrap(), config);
    assert!(!serde_json::to_string(&exportable()).unwrap().contains("encoder_norm"));
    // It is saved and loaded like any other.
    let folder = tempfile::tempdir().unwrap();
    let policy = DiffusionPolicy::untrained(&config, &normaliser(), 3).unwrap();
    policy.save(folder.path(), &Provenance::default()).unwrap();
    assert_eq!(DiffusionPolicy::load(folder.path()).unwrap().0.weights().unwrap(), policy.weights().unwrap());
}

#[test]
fn checkpoints_from_before_the_new_settings_read_and_write_the_same() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../checkpoints/nut_assembly/policy.json");
    let before = json(&path)["config"].clone();
    let config: PolicyConfig = serde_json::from_value(before.clone()).unwrap();
    assert!(config.unit_quaternion && config.image_scaling.is_empty());
    assert_eq!(serde_json::to_value(&config).unwrap(), before);
}
