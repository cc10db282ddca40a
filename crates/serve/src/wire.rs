//! What travels: msgpack with arrays, as openpi packs them.
//!
//! An array is a map with four keys of kind *bin* (`__ndarray__`, `data`, `dtype`, `shape`), a numpy scalar one with three
//! (`__npgeneric__`, `data`, `dtype`); every other key is text. Reading trusts nothing: depth, number of values and sizes are
//! checked before memory is taken for them.
//!
//! ```
//! use e2h_serve::wire::{Array, Value};
//!
//! let message = Value::map([("state", Array::f32(&[2], &[0.5, -1.0]).into()), ("seed", Value::from(7_u64))]);
//! assert_eq!(Value::decode(&message.encode())?, message);
//! # Ok::<(), e2h_serve::Error>(())
//! ```

mod array;
mod read;
mod write;

pub use array::{Array, Dtype};
use std::collections::BTreeMap;

/// Deepest nesting that is read.
pub const MOST_DEPTH: usize = 16;
/// Values in a message, not counting the numbers of arrays. An observation has dozens.
pub const MOST_VALUES: usize = 1 << 16;

/// One value of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Nothing.
    Nil,
    /// True or false.
    Bool(bool),
    /// A whole number that fits `i64`.
    Int(i64),
    /// A whole number above the largest `i64`.
    Large(u64),
    /// Any other number.
    Float(f64),
    /// Text.
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
    /// A list.
    List(Vec<Value>),
    /// Named values; of a key that comes twice the last one counts, as in Python.
    Map(BTreeMap<String, Value>),
    /// Numbers with a shape.
    Array(Array),
}

impl Value {
    /// Named values.
    pub fn map<'a>(entries: impl IntoIterator<Item = (&'a str, Self)>) -> Self {
        Self::Map(entries.into_iter().map(|(k, v)| (k.to_owned(), v)).collect())
    }

    /// The value of a key; none where there is none, or this is no map.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Map(map) => map.get(key),
            _ => None,
        }
    }

    /// The number, if it is a whole one from 0 on.
    #[must_use]
    pub fn as_u64(&self) -> Option<u64> {
        match self {
            Self::Int(v) => u64::try_from(*v).ok(),
            Self::Large(v) => Some(*v),
            _ => None,
        }
    }

    /// The same as a size.
    #[must_use]
    pub fn as_usize(&self) -> Option<usize> {
        self.as_u64().and_then(|v| usize::try_from(v).ok())
    }

    /// The text, if it is one.
    #[must_use]
    pub fn as_str(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// What kind of value this is, for messages.
    #[must_use]
    pub fn kind(&self) -> String {
        match self {
            Self::Nil => "nil".to_owned(),
            Self::Bool(v) => v.to_string(),
            Self::Int(v) => format!("the number {v}"),
            Self::Large(v) => format!("the number {v}"),
            Self::Float(v) => format!("the number {v}"),
            Self::Text(_) => "text".to_owned(),
            Self::Bytes(v) => format!("{} bytes", v.len()),
            Self::List(v) => format!("a list of {}", v.len()),
            Self::Map(v) => format!("a map of {}", v.len()),
            Self::Array(a) => a.to_string(),
        }
    }
}

impl From<u64> for Value {
    fn from(v: u64) -> Self {
        i64::try_from(v).map_or(Self::Large(v), Self::Int)
    }
}

impl From<usize> for Value {
    fn from(v: usize) -> Self {
        Self::from(v as u64)
    }
}

impl From<f64> for Value {
    fn from(v: f64) -> Self {
        Self::Float(v)
    }
}

impl From<&str> for Value {
    fn from(v: &str) -> Self {
        Self::Text(v.to_owned())
    }
}

impl From<Array> for Value {
    fn from(v: Array) -> Self {
        Self::Array(v)
    }
}

impl<T: Into<Self>> FromIterator<T> for Value {
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        Self::List(values.into_iter().map(Into::into).collect())
    }
}
