//! The columns of one episode, whatever they mean.

use super::feature::{Dtype, Feature, Features};
use crate::{Error, Result};
use e2h_core::one_line;

/// One column of one episode. Rows lie one after the other; a row has [`Feature::width`] numbers.
#[derive(Debug, Clone, PartialEq)]
pub enum Column {
    /// For [`Dtype::Float32`].
    F32(Vec<f32>),
    /// For [`Dtype::Float64`].
    F64(Vec<f64>),
    /// For all integers.
    I64(Vec<i64>),
    /// For [`Dtype::Bool`].
    Bool(Vec<bool>),
    /// For [`Dtype::String`].
    Text(Vec<String>),
    /// For [`Dtype::Image`]: a PNG file per row, and for [`Dtype::Video`] what its decoded frames are turned into.
    Png(Vec<Vec<u8>>),
}

impl Column {
    /// Numbers, texts or images in it.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::F32(v) => v.len(),
            Self::F64(v) => v.len(),
            Self::I64(v) => v.len(),
            Self::Bool(v) => v.len(),
            Self::Text(v) => v.len(),
            Self::Png(v) => v.len(),
        }
    }

    /// True without any.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Its numbers as 64-bit floats, true as 1; none for text and images.
    #[must_use]
    pub fn numbers(&self) -> Option<Vec<f64>> {
        match self {
            Self::F32(v) => Some(v.iter().map(|&v| f64::from(v)).collect()),
            Self::F64(v) => Some(v.clone()),
            Self::I64(v) => Some(v.iter().map(|&v| v as f64).collect()),
            Self::Bool(v) => Some(v.iter().map(|&v| f64::from(u8::from(v))).collect()),
            Self::Text(_) | Self::Png(_) => None,
        }
    }

    /// The rows `rows`, in that order; rows that are not there are left out.
    #[must_use]
    pub fn select(&self, rows: &[usize], width: usize) -> Self {
        fn pick<T: Clone>(values: &[T], rows: &[usize], width: usize) -> Vec<T> {
            rows.iter().filter_map(|r| values.get(r * width..(r + 1) * width)).flatten().cloned().collect()
        }
        match self {
            Self::F32(v) => Self::F32(pick(v, rows, width)),
            Self::F64(v) => Self::F64(pick(v, rows, width)),
            Self::I64(v) => Self::I64(pick(v, rows, width)),
            Self::Bool(v) => Self::Bool(pick(v, rows, width)),
            Self::Text(v) => Self::Text(pick(v, rows, 1)),
            Self::Png(v) => Self::Png(pick(v, rows, 1)),
        }
    }

    /// Bytes of its numbers, texts or images.
    pub(crate) fn bytes(&self) -> usize {
        match self {
            Self::F32(v) => size_of_val(&v[..]),
            Self::F64(v) => size_of_val(&v[..]),
            Self::I64(v) => size_of_val(&v[..]),
            Self::Bool(v) => v.len(),
            Self::Text(v) => v.iter().map(String::len).sum(),
            Self::Png(v) => v.iter().map(Vec::len).sum(),
        }
    }

    pub(crate) fn append(&mut self, other: Self) {
        match (self, other) {
            (Self::F32(a), Self::F32(b)) => a.extend(b),
            (Self::F64(a), Self::F64(b)) => a.extend(b),
            (Self::I64(a), Self::I64(b)) => a.extend(b),
            (Self::Bool(a), Self::Bool(b)) => a.extend(b),
            (Self::Text(a), Self::Text(b)) => a.extend(b),
            (Self::Png(a), Self::Png(b)) => a.extend(b),
            (a, b) => *a = b,
        }
    }

    /// An empty column for the type.
    pub(crate) fn empty(dtype: Dtype) -> Self {
        match dtype {
            Dtype::Float32 => Self::F32(vec![]),
            Dtype::Float64 => Self::F64(vec![]),
            Dtype::Bool => Self::Bool(vec![]),
            Dtype::String => Self::Text(vec![]),
            Dtype::Image | Dtype::Video => Self::Png(vec![]),
            _ => Self::I64(vec![]),
        }
    }

    fn kind(&self) -> &'static str {
        match self {
            Self::F32(_) => "float32",
            Self::F64(_) => "float64",
            Self::I64(_) => "int64",
            Self::Bool(_) => "bool",
            Self::Text(_) => "string",
            Self::Png(_) => "image",
        }
    }
}

/// The columns of one episode.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Table {
    /// Rows.
    pub rows: usize,
    /// Name and values of each column.
    pub columns: Vec<(String, Column)>,
}

impl Table {
    /// The column of that name.
    #[must_use]
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|(n, _)| n == name).map(|(_, c)| c)
    }

    /// A column of 32-bit floats.
    ///
    /// # Errors
    /// When it is not there or of another type.
    pub fn f32(&self, name: &str) -> Result<&[f32]> {
        match self.column(name) {
            Some(Column::F32(v)) => Ok(v),
            other => Err(unlike(name, "float32", other)),
        }
    }

    /// A column of integers.
    ///
    /// # Errors
    /// When it is not there or of another type.
    pub fn i64(&self, name: &str) -> Result<&[i64]> {
        match self.column(name) {
            Some(Column::I64(v)) => Ok(v),
            other => Err(unlike(name, "int64", other)),
        }
    }

    /// A column of truth values.
    ///
    /// # Errors
    /// When it is not there or of another type.
    pub fn bool(&self, name: &str) -> Result<&[bool]> {
        match self.column(name) {
            Some(Column::Bool(v)) => Ok(v),
            other => Err(unlike(name, "bool", other)),
        }
    }

    /// A column of PNG files.
    ///
    /// # Errors
    /// When it is not there or of another type.
    pub fn png(&self, name: &str) -> Result<&[Vec<u8>]> {
        match self.column(name) {
            Some(Column::Png(v)) => Ok(v),
            other => Err(unlike(name, "image", other)),
        }
    }

    /// Checks that the columns are those of `features`, with the right type, length and range, and nothing infinite.
    ///
    /// # Errors
    /// Names the first column that does not fit.
    pub fn validate(&self, features: &Features) -> Result<()> {
        for (name, _) in &self.columns {
            if !features.iter().any(|(n, _)| n == name) {
                return Err(column_error(name, "no such column", "one"));
            }
        }
        if self.rows == 0 {
            return Err(column_error("(all)", "at least one row", "none"));
        }
        for (name, feature) in features {
            let column = self.column(name).ok_or_else(|| unlike(name, feature.describe(), None))?;
            check(name, feature, column, self.rows)?;
        }
        Ok(())
    }
}

fn unlike(name: &str, expected: impl Into<String>, found: Option<&Column>) -> Error {
    column_error(name, expected, found.map_or("none", Column::kind))
}

pub(crate) fn column_error(column: &str, expected: impl Into<String>, found: impl Into<String>) -> Error {
    Error::Column {
        column: one_line(column),
        expected: one_line(&expected.into()),
        found: one_line(&found.into()),
    }
}

/// Least and largest integer of a type; none for what is no integer.
pub(crate) fn range(dtype: Dtype) -> Option<(i64, i64)> {
    match dtype {
        Dtype::Int8 => Some((i8::MIN.into(), i8::MAX.into())),
        Dtype::Int16 => Some((i16::MIN.into(), i16::MAX.into())),
        Dtype::Int32 => Some((i32::MIN.into(), i32::MAX.into())),
        Dtype::Int64 => Some((i64::MIN, i64::MAX)),
        Dtype::UInt8 => Some((0, u8::MAX.into())),
        Dtype::UInt16 => Some((0, u16::MAX.into())),
        Dtype::UInt32 => Some((0, u32::MAX.into())),
        _ => None,
    }
}

fn check(name: &str, feature: &Feature, column: &Column, rows: usize) -> Result<()> {
    let fits = std::mem::discriminant(column) == std::mem::discriminant(&Column::empty(feature.dtype));
    if !fits {
        return Err(unlike(name, feature.describe(), Some(column)));
    }
    let width = if feature.is_visual() { 1 } else { feature.width() };
    if column.len() != rows * width {
        let expected = format!("{rows} rows of {width}");
        return Err(column_error(name, expected, format!("{} entries", column.len())));
    }
    let at = |i: usize| format!("row {}, entry {}", i / width, i % width);
    let bad = match (column, range(feature.dtype)) {
        (Column::F32(v), _) => v.iter().position(|v| !v.is_finite()),
        (Column::F64(v), _) => v.iter().position(|v| !v.is_finite()),
        (Column::I64(v), Some((lo, hi))) => v.iter().position(|v| !(lo..=hi).contains(v)),
        _ => None,
    };
    match bad {
        Some(i) => Err(column_error(name, format!("a finite {:?} at {}", feature.dtype, at(i)), "none")),
        None => Ok(()),
    }
}
