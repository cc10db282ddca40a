//! The values of the filters, and how `--set` changes them.

use anyhow::{Context, Result, bail};
use e2h_core::nearest;
use e2h_refine::{GateConfig, KinematicConfig, ReverseConfig};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

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
        let mut table = Table::try_from(&default)?;
        for text in set {
            let (key, value) =
                text.split_once('=').with_context(|| format!("--set: expected key=value, got `{text}`"))?;
            let value =
                format!("v = {value}").parse::<Table>().ok().and_then(|mut t| t.remove("v")).with_context(
                    || format!("--set {key}: expected a number, true, false or a list, got `{value}`"),
                )?;
            replace(&mut table, key.trim(), value)?;
        }
        let mut config: Self = Value::Table(table).try_into().context("--set")?;
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

fn replace(table: &mut Table, key: &str, value: Value) -> Result<()> {
    let (group, name) = key.split_once('.').unwrap_or((key, ""));
    let names = |t: &Table| t.keys().cloned().collect::<Vec<_>>();
    let unknown = |known: Vec<String>, word: &str, prefix: &str| {
        let near = nearest(word, known.iter().map(String::as_str)).unwrap_or_default().to_owned();
        anyhow::anyhow!("--set: unknown key `{key}`; did you mean `{prefix}{near}`?")
    };
    let groups = names(table);
    let Some(Value::Table(entries)) = table.get_mut(group) else { return Err(unknown(groups, group, "")) };
    let known = names(entries);
    let Some(slot) = entries.get_mut(name) else { return Err(unknown(known, name, &format!("{group}."))) };
    *slot = match (&slot, value) {
        (Value::Float(_), Value::Integer(i)) => Value::Float(i as f64),
        (old, new) if old.type_str() == new.type_str() => new,
        (old, new) => {
            bail!("--set {key}: expected a value of type {}, got {new} ({})", old.type_str(), new.type_str())
        }
    };
    Ok(())
}
