//! The steps before and after the network, with the statistics that they scale by.

use super::description::{Description, Feature, InOrder, Obstacle};
use super::scaling::{Scaling, Scalings};
use super::{ACTION, ENVIRONMENT, EPS, STATE};
use crate::{Error, Result};
use e2h_data::write_atomic;
use e2h_nn::{HostTensor, Weights};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

pub(super) const PREPROCESSOR: &str = "policy_preprocessor";
pub(super) const POSTPROCESSOR: &str = "policy_postprocessor";
const NORMALISER: &str = "normalizer_processor";
const UNNORMALISER: &str = "unnormalizer_processor";
/// Steps that change no number.
const HARMLESS: [&str; 3] = ["rename_observations_processor", "to_batch_processor", "device_processor"];

#[derive(Serialize, Deserialize)]
struct Pipeline {
    name: String,
    steps: Vec<Step>,
}

#[derive(Serialize, Deserialize)]
struct Step {
    #[serde(default, skip_serializing_if = "String::is_empty")]
    registry_name: String,
    /// A step that LeRobot does not know by name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    class: Option<String>,
    config: Value,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    state_file: Option<String>,
}

#[derive(Deserialize)]
struct NormaliserStep {
    #[serde(default = "eps")]
    eps: f64,
    norm_map: BTreeMap<String, String>,
    #[serde(default)]
    normalize_observation_keys: Option<Vec<String>>,
}

fn eps() -> f64 {
    EPS
}

fn step(name: &str, config: Value) -> Step {
    Step { registry_name: name.to_owned(), class: None, config, state_file: None }
}

/// Writes both pipelines with their statistics, those first.
pub(super) fn write(dir: &Path, d: &Description, scalings: &Scalings) -> Result<()> {
    let statistics = statistics(d, scalings);
    let device = |device: &str| step("device_processor", json!({"device": device, "float_dtype": null}));
    let scaling = |name: &str, features: &[&InOrder<Feature>]| {
        let features: BTreeMap<_, _> = features.iter().flat_map(|f| f.0.iter().cloned()).collect();
        step(name, json!({"eps": EPS, "features": features, "norm_map": d.normalization_mapping}))
    };
    let before = vec![
        step("rename_observations_processor", json!({"rename_map": {}})),
        step("to_batch_processor", json!({})),
        device("cpu"),
        scaling(NORMALISER, &[&d.input_features, &d.output_features]),
    ];
    let after = vec![scaling(UNNORMALISER, &[&d.output_features]), device("cpu")];
    for (name, mut steps) in [(PREPROCESSOR, before), (POSTPROCESSOR, after)] {
        for (i, step) in steps.iter_mut().enumerate() {
            if [NORMALISER, UNNORMALISER].contains(&step.registry_name.as_str()) {
                let file = format!("{name}_step_{i}_{}.safetensors", step.registry_name);
                e2h_nn::save_weights(dir.join(&file), &statistics, &BTreeMap::new())?;
                step.state_file = Some(file);
            }
        }
        let path = dir.join(format!("{name}.json"));
        let text = serde_json::to_string_pretty(&Pipeline { name: name.to_owned(), steps })
            .map_err(|e| Error::Checkpoint { path: path.clone(), problem: e.to_string() })?;
        write_atomic(&path, text.as_bytes())?;
    }
    Ok(())
}

/// Modes of the kinds of features, as `config.json` has them.
pub(super) fn modes(s: &Scalings) -> BTreeMap<String, String> {
    let images = if s.images.is_empty() { "IDENTITY" } else { "MEAN_STD" };
    let mut modes = vec![("STATE", s.state.mode()), ("VISUAL", images), ("ACTION", s.action.mode())];
    modes.extend((s.environment != Scaling::None).then(|| ("ENV", s.environment.mode())));
    modes.into_iter().map(|(kind, mode)| (kind.to_owned(), mode.to_owned())).collect()
}

/// Ranges of states and actions, moments of images.
fn statistics(d: &Description, scalings: &Scalings) -> Weights {
    let mut all = Weights::new();
    let mut put = |feature: &str, name: &str, data: &[f32], shape: Vec<usize>| {
        all.insert(format!("{feature}.{name}"), HostTensor { shape, data: data.to_vec() });
    };
    for (feature, scaling) in
        [(STATE, &scalings.state), (ENVIRONMENT, &scalings.environment), (ACTION, &scalings.action)]
    {
        let [(first, a), (second, b)] = match scaling {
            Scaling::None => continue,
            Scaling::Range { min, max, .. } => [("min", min), ("max", max)],
            Scaling::Moments { mean, std, .. } => [("mean", mean), ("std", std)],
        };
        put(feature, first, a, vec![a.len()]);
        put(feature, second, b, vec![b.len()]);
    }
    let cameras = d.input_features.0.iter().filter(|(_, f)| f.kind == "VISUAL");
    for ((name, _), scaling) in cameras.zip(&scalings.images) {
        put(name, "mean", &scaling.mean, vec![3, 1, 1]);
        put(name, "std", &scaling.std, vec![3, 1, 1]);
    }
    all
}

/// What a pipeline scales by.
pub(super) struct Statistics {
    step: NormaliserStep,
    tensors: Weights,
}

impl Statistics {
    /// Reads pipeline `name` of a folder. Steps that would change numbers otherwise are added to `obstacles`.
    pub(super) fn read(dir: &Path, name: &str, obstacles: &mut Vec<Obstacle>) -> Result<Self> {
        let path = dir.join(format!("{name}.json"));
        let bytes = e2h_data::read_file(&path, e2h_data::MOST_TEXT).map_err(|source| Error::Io {
            doing: "reading LeRobot checkpoint",
            path: path.clone(),
            source,
        })?;
        let fail = |problem: String| Error::Checkpoint { path: path.clone(), problem };
        let pipeline: Pipeline = serde_json::from_slice(&bytes).map_err(|e| fail(e.to_string()))?;
        let wanted = if name == PREPROCESSOR { NORMALISER } else { UNNORMALISER };
        let mut found = None;
        for step in pipeline.steps {
            let what = if step.registry_name.is_empty() {
                step.class.clone().unwrap_or_default()
            } else {
                step.registry_name.clone()
            };
            if what == wanted && found.is_none() {
                found = Some(step);
            } else if !HARMLESS.contains(&what.as_str()) {
                let expected = format!("only {HARMLESS:?} and one {wanted}");
                obstacles.push(Obstacle::new(&format!("{name}.json steps"), expected, what));
            }
        }
        // A pipeline that scales nothing is one, too.
        let Some(step) = found else {
            let step =
                NormaliserStep { eps: EPS, norm_map: BTreeMap::new(), normalize_observation_keys: None };
            return Ok(Self { step, tensors: Weights::new() });
        };
        let file =
            step.state_file.ok_or_else(|| fail(format!("{wanted}: expected a state_file, found none")))?;
        let inside = Path::new(&file).components().count() == 1 && Path::new(&file).file_name().is_some();
        if !inside || file.contains(char::is_control) {
            return Err(fail(format!("{wanted}: expected a state_file in this folder, found `{file}`")));
        }
        let step = serde_json::from_value(step.config).map_err(|e| fail(format!("{wanted}: {e}")))?;
        let (tensors, _) = e2h_nn::load_weights(dir.join(file))?;
        Ok(Self { step, tensors })
    }

    /// How a feature of `width` entries (channels of an image) is scaled.
    pub(super) fn scaling(
        &self,
        feature: &str,
        kind: &str,
        width: usize,
        obstacles: &mut Vec<Obstacle>,
    ) -> Scaling {
        let s = &self.step;
        let left_out = s.normalize_observation_keys.as_ref().is_some_and(|k| !k.iter().any(|k| k == feature));
        let prefix = format!("{feature}.");
        let known = self.tensors.keys().any(|k| k.starts_with(&prefix));
        // LeRobot leaves alone what it has no statistics of.
        if (left_out && kind != "ACTION") || !known {
            return Scaling::None;
        }
        let mut get = |name: &str| {
            let tensor = self.tensors.get(&format!("{feature}.{name}"));
            let finite = |t: &&HostTensor| t.data.len() == width && t.data.iter().all(|v| v.is_finite());
            tensor.filter(finite).map(|t| t.data.clone()).unwrap_or_else(|| {
                let all = |t: &HostTensor| {
                    let bad = t.data.iter().find(|v| !v.is_finite());
                    format!("{} numbers{}", t.data.len(), bad.map_or(String::new(), |v| format!(", one {v}")))
                };
                let found = tensor.map_or("none".to_owned(), all);
                obstacles.push(Obstacle::new(
                    &format!("{feature}.{name}"),
                    format!("{width} finite numbers"),
                    found,
                ));
                vec![1.0; width]
            })
        };
        // Statistics are 32 bits, in LeRobot too.
        let eps = s.eps as f32;
        match s.norm_map.get(kind).map_or("IDENTITY", String::as_str) {
            "IDENTITY" => Scaling::None,
            "MIN_MAX" => Scaling::Range { min: get("min"), max: get("max"), eps },
            "QUANTILES" => Scaling::Range { min: get("q01"), max: get("q99"), eps },
            "QUANTILE10" => Scaling::Range { min: get("q10"), max: get("q90"), eps },
            "MEAN_STD" => Scaling::Moments { mean: get("mean"), std: get("std"), eps },
            other => {
                obstacles.push(Obstacle::new(
                    &format!("norm_map {kind}"),
                    "IDENTITY, MIN_MAX, MEAN_STD, QUANTILES or QUANTILE10",
                    other,
                ));
                Scaling::None
            }
        }
    }
}
