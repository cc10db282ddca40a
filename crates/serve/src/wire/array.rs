//! Numbers with a shape, as numpy has them.

use crate::{Error, Result};
use half::f16;
use std::fmt;

/// Dimensions that an array may have.
const MOST_DIMENSIONS: usize = 8;

/// What the numbers of an array are; all of them little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// `|u1`: a byte.
    U1,
    /// `|b1`: true or false.
    B1,
    /// `<i4`.
    I4,
    /// `<i8`.
    I8,
    /// `<f2`.
    F2,
    /// `<f4`.
    F4,
    /// `<f8`.
    F8,
}

impl Dtype {
    /// All of them.
    pub const ALL: [Self; 7] = [Self::U1, Self::B1, Self::I4, Self::I8, Self::F2, Self::F4, Self::F8];

    /// As numpy writes it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::U1 => "|u1",
            Self::B1 => "|b1",
            Self::I4 => "<i4",
            Self::I8 => "<i8",
            Self::F2 => "<f2",
            Self::F4 => "<f4",
            Self::F8 => "<f8",
        }
    }

    /// Bytes of a number.
    #[must_use]
    pub fn size(self) -> usize {
        match self {
            Self::U1 | Self::B1 => 1,
            Self::F2 => 2,
            Self::I4 | Self::F4 => 4,
            Self::I8 | Self::F8 => 8,
        }
    }

    pub(super) fn of(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|d| d.name() == name).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            Error::mismatch("dtype of an array", format!("one of {known}"), format!("`{name}`"))
        })
    }
}

/// Numbers in C order. Made only where shape and bytes agree.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    dtype: Dtype,
    shape: Vec<usize>,
    data: Vec<u8>,
}

impl Array {
    /// An array of these bytes.
    ///
    /// # Errors
    /// When the shape does not have as many numbers as there are bytes for, or a truth is neither 0 nor 1.
    pub fn new(dtype: Dtype, shape: Vec<usize>, data: Vec<u8>) -> Result<Self> {
        if shape.len() > MOST_DIMENSIONS {
            let found = shape.len().to_string();
            return Err(Error::mismatch(
                "dimensions of an array",
                format!("at most {MOST_DIMENSIONS}"),
                found,
            ));
        }
        let bytes = shape.iter().try_fold(dtype.size(), |n, side| n.checked_mul(*side));
        if bytes != Some(data.len()) {
            let expected = format!("as many as {shape:?} of {} has", dtype.name());
            return Err(Error::mismatch("bytes of an array", expected, data.len().to_string()));
        }
        if dtype == Dtype::B1 && data.iter().any(|b| *b > 1) {
            return Err(Error::mismatch("truths of an array", "bytes of 0 or 1", "others"));
        }
        Ok(Self { dtype, shape, data })
    }

    /// An array of `f32`. Numbers that the shape has no room for are left out, those that are missing are 0.
    #[must_use]
    pub fn f32(shape: &[usize], values: &[f32]) -> Self {
        let mut data: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        data.resize(shape.iter().product::<usize>() * 4, 0);
        Self { dtype: Dtype::F4, shape: shape.to_owned(), data }
    }

    /// An image, (height, width, 3).
    #[must_use]
    pub fn image(image: &e2h_core::Image) -> Self {
        let mut data = image.data.clone();
        data.resize(image.height * image.width * 3, 0);
        Self { dtype: Dtype::U1, shape: vec![image.height, image.width, 3], data }
    }

    /// Several of one kind and shape along a new first axis; none when they differ, or there are none.
    #[must_use]
    pub fn stack(parts: &[Self]) -> Option<Self> {
        let first = parts.first()?;
        let alike = parts.iter().all(|p| p.dtype == first.dtype && p.shape == first.shape);
        let shape = std::iter::once(parts.len()).chain(first.shape.iter().copied()).collect();
        let data = parts.iter().flat_map(|p| p.data.iter().copied()).collect();
        alike.then_some(Self { dtype: first.dtype, shape, data })
    }

    /// What its numbers are.
    #[must_use]
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Its sides.
    #[must_use]
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Its bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// Its numbers, as near as `f32` comes.
    #[must_use]
    pub fn to_f32(&self) -> Vec<f32> {
        let d = &self.data;
        match self.dtype {
            Dtype::U1 | Dtype::B1 => d.iter().map(|v| f32::from(*v)).collect(),
            Dtype::I4 => d.as_chunks().0.iter().map(|b| i32::from_le_bytes(*b) as f32).collect(),
            Dtype::I8 => d.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b) as f32).collect(),
            Dtype::F2 => d.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
            Dtype::F4 => d.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Dtype::F8 => d.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
        }
    }
}

impl fmt::Display for Array {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} of {}", self.shape, self.dtype.name())
    }
}
