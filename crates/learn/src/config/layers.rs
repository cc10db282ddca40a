//! Layers of a configuration: TOML tables that are laid over one another, and what is said to a key that there is not.

use crate::{Error, Result};
use e2h_core::nearest;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// The text of this name.
pub(crate) fn find<'a>(what: &str, name: &str, known: &[(&str, &'a str)]) -> Result<&'a str> {
    known.iter().find(|(n, _)| *n == name).map(|(_, text)| *text).ok_or_else(|| {
        let names: Vec<&str> = known.iter().map(|(n, _)| *n).collect();
        Error::Config(format!("unknown {what} `{name}`; {}", suggestion(name, "", &names)))
    })
}

/// What may have been meant, or all that can be.
pub(crate) fn suggestion(name: &str, prefix: &str, known: &[&str]) -> String {
    match nearest(name, known.iter().copied()) {
        Some(near) => format!("did you mean `{prefix}{near}`?"),
        None => format!("known: {}", known.join(", ")),
    }
}

pub(crate) fn parse(name: &str, text: &str) -> Result<Table> {
    text.parse::<Table>().map_err(|e| Error::Config(format!("{name}: {}", e.message())))
}

/// A whole table as what it configures, and as text.
pub(crate) fn typed<T: DeserializeOwned>(table: Table) -> Result<(T, String)> {
    let text = toml::to_string(&table).map_err(|e| Error::Config(e.to_string()))?;
    let config = Value::Table(table).try_into().map_err(|e: toml::de::Error| {
        Error::Config(e2h_core::one_line(&e.to_string().trim().replace('\n', " ")))
    })?;
    Ok((config, text))
}

/// Keys of earlier versions, and what says it now.
const MOVED: [(&str, &str); 1] = [("train.step.adam.lr", "train.step.schedule.lr")];

/// A table inside a table, if there is one.
pub(crate) fn inner<'a>(table: Option<&'a Value>, key: &str) -> Option<&'a Table> {
    table?.get(key)?.as_table()
}

/// The layer that one `key.path=value` lays over a configuration.
pub(crate) fn layer(text: &str) -> Result<Table> {
    let (key, value) = text
        .split_once('=')
        .ok_or_else(|| Error::Config(format!("--set: expected key=value, got `{text}`")))?;
    let mut layer = Value::String(value.trim().to_owned());
    // What is not TOML is taken as a plain string, so that quotes are not needed on the command line.
    if let Ok(parsed) = format!("v = {value}").parse::<Table>()
        && let Some(v) = parsed.get("v")
    {
        layer = v.clone();
    }
    let mut path: Vec<&str> = key.trim().split('.').collect();
    let last = path.pop().unwrap_or_default();
    let mut table = Table::from_iter([(last.to_owned(), layer)]);
    for part in path.into_iter().rev() {
        table = Table::from_iter([(part.to_owned(), Value::Table(table))]);
    }
    Ok(table)
}

/// Lays `over` onto `base`; a key that `base` does not have is unknown, because presets state every entry.
pub(crate) fn merge(base: &mut Table, over: &Table, path: &str) -> Result<()> {
    for (key, value) in over {
        let full = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let Some(slot) = base.get_mut(key) else {
            let known: Vec<&str> = base.keys().map(String::as_str).collect();
            let prefix = if path.is_empty() { String::new() } else { format!("{path}.") };
            let said = MOVED.iter().find(|(old, _)| *old == full).map_or_else(
                || suggestion(key, &prefix, &known),
                |(_, new)| format!("did you mean `{new}`?"),
            );
            return Err(Error::Config(format!("unknown key `{full}`; {said}")));
        };
        match (slot, value) {
            (Value::Table(slot), Value::Table(value)) => merge(slot, value, &full)?,
            (slot @ Value::Float(_), Value::Integer(i)) => *slot = Value::Float(*i as f64),
            (slot, value) if slot.type_str() == value.type_str() => *slot = value.clone(),
            (slot, value) => {
                return Err(Error::Config(format!(
                    "key `{full}`: expected a value of type {}, got {value} ({})",
                    slot.type_str(),
                    value.type_str()
                )));
            }
        }
    }
    Ok(())
}
