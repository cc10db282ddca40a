//! The values of the filters, and how `--set` changes them.

use anyhow::{Context, Result, bail};
use e2h_core::nearest;
use e2h_refine::{GateConfig, KinematicConfig, ReverseConfig};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Everything that `--set` can change.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Config {
    pub(crate) reverse: ReverseConfig,
    pub(crate) kinematic: KinematicConfig,
    /// Off by default: how often a gripper should switch depends on the task.
    pub(crate) gate: GateConfig,
    /// True when the reference quaternion was set by hand; otherwise it is the first orientation of the dataset.
    #[serde(skip)]
    pub(crate) reference_given: bool,
}

impl Config {
    pub(crate) fn resolve(set: &[String]) -> Result<Self> {
        let default = Self {
            reverse: ReverseConfig::default(),
            kinematic: KinematicConfig::default(),
            gate: GateConfig { enabled: false, ..GateConfig::default() },
            reference_given: false,
        };
        let mut table = serde_json::to_value(&default)?;
        for text in set {
            let (key, value) =
                text.split_once('=').with_context(|| format!("--set: expected key=value, got `{text}`"))?;
            let value: Value = serde_json::from_str(value).ok().with_context(|| {
                format!("--set {key}: expected a number, true, false or a list, got `{value}`")
            })?;
            *slot(&mut table, key.trim(), &value)? = value.clone();
            // One at a time, so that a value of the wrong kind is named with its key.
            serde_json::from_value::<Self>(table.clone()).with_context(|| format!("--set {key}"))?;
        }
        let mut config: Self = serde_json::from_value(table)?;
        config.reference_given =
            set.iter().any(|s| s.trim_start().starts_with("reverse.reference_quaternion"));
        let mut problems = config.reverse.validate();
        problems.extend(config.kinematic.validate());
        problems.extend(config.gate.validate());
        if !problems.is_empty() {
            bail!("{}", problems.join("; "));
        }
        Ok(config)
    }
}

/// The entry that `key` names.
fn slot<'a>(table: &'a mut Value, key: &str, value: &Value) -> Result<&'a mut Value> {
    let (group, name) = key.split_once('.').unwrap_or((key, ""));
    let unknown = |known: &Map<String, Value>, word: &str, prefix: &str| {
        let near = nearest(word, known.keys().map(String::as_str)).unwrap_or_default().to_owned();
        anyhow::anyhow!("--set: unknown key `{key}`; did you mean `{prefix}{near}`?")
    };
    let groups = table.as_object_mut().context("the configuration is a table")?;
    if !groups.contains_key(group) {
        return Err(unknown(groups, group, ""));
    }
    let entries = groups.get_mut(group).and_then(Value::as_object_mut).context("a group is a table")?;
    if !entries.contains_key(name) {
        return Err(unknown(entries, name, &format!("{group}.")));
    }
    let old = entries.get_mut(name).context("the entry is there")?;
    if std::mem::discriminant(&*old) != std::mem::discriminant(value) {
        bail!("--set {key}: expected a value like {old}, got {value}");
    }
    Ok(old)
}
