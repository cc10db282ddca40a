//! Columns from and to Arrow.

use super::feature::{Dtype, Feature};
use super::table::Column;
use crate::file::{file_error, unsupported};
use crate::{Error, Result};
use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type,
};
use arrow_array::{
    Array, ArrayRef, ArrowPrimitiveType, BinaryArray, BooleanArray, FixedSizeListArray, Float32Array,
    Float64Array, Int64Array, ListArray, PrimitiveArray, RecordBatch, StringArray, StructArray,
};
use arrow_buffer::OffsetBuffer;
use arrow_schema::{DataType, Field, Fields};
use std::path::Path;
use std::sync::Arc;

/// Where a value lies, for messages.
pub(super) struct Cell<'a> {
    pub(super) path: &'a Path,
    pub(super) column: &'a str,
    pub(super) first: usize,
}

impl Cell<'_> {
    pub(super) fn error(
        &self,
        row: Option<usize>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Error {
        let what = match row {
            Some(row) => format!("column `{}`, row {}", self.column, self.first + row),
            None => format!("column `{}`", self.column),
        };
        file_error(self.path, &what, expected, found)
    }

    /// For what may be whole.
    fn unsupported(&self, expected: impl Into<String>, found: impl Into<String>) -> Error {
        unsupported(self.path, &format!("column `{}`", self.column), expected, found)
    }

    /// Refuses missing values; `width` of them make a row.
    fn whole(&self, array: &dyn Array, width: usize) -> Result<()> {
        match (0..array.len()).find(|&i| array.null_count() > 0 && array.is_null(i)) {
            Some(i) => Err(self.error(Some(i / width.max(1)), "a value", "none")),
            None => Ok(()),
        }
    }
}

/// A column from Arrow. Lists are unpacked by the feature's shape.
pub(super) fn from_arrow(array: &ArrayRef, feature: &Feature, place: &Cell) -> Result<Column> {
    if feature.dtype == Dtype::Image {
        return images(array, place);
    }
    let rows = array.len();
    let mut leaf = array.clone();
    let mut width = 1;
    // A shape of [1] is a plain number; some writers make it a list of one.
    let plain = feature.shape == [1] && !is_list(leaf.data_type());
    for &size in feature.shape.iter().filter(|_| !plain) {
        leaf = unpack(&leaf, size, width, feature, place)?;
        width *= size;
    }
    place.whole(leaf.as_ref(), width)?;
    if leaf.len() != rows * width {
        return Err(place.error(None, format!("{width} numbers per row"), leaf.len().to_string()));
    }
    let found = || place.unsupported(feature.describe(), array.data_type().to_string());
    fn values<T: ArrowPrimitiveType>(leaf: &ArrayRef) -> &[T::Native] {
        leaf.as_primitive::<T>().values()
    }
    Ok(match (Column::empty(feature.dtype), leaf.data_type()) {
        (Column::F32(_), DataType::Float32) => Column::F32(values::<Float32Type>(&leaf).to_vec()),
        // The feature says 32 bits.
        (Column::F32(_), DataType::Float64) => {
            Column::F32(values::<Float64Type>(&leaf).iter().map(|&v| v as f32).collect())
        }
        (Column::F64(_), DataType::Float64) => Column::F64(values::<Float64Type>(&leaf).to_vec()),
        (Column::F64(_), DataType::Float32) => {
            Column::F64(values::<Float32Type>(&leaf).iter().map(|&v| v.into()).collect())
        }
        (Column::I64(_), kind) => {
            fn wide<T: ArrowPrimitiveType<Native: Into<i64>>>(leaf: &ArrayRef) -> Vec<i64> {
                leaf.as_primitive::<T>().values().iter().map(|&v| v.into()).collect()
            }
            Column::I64(match kind {
                DataType::Int64 => values::<Int64Type>(&leaf).to_vec(),
                DataType::Int32 => wide::<Int32Type>(&leaf),
                DataType::Int16 => wide::<Int16Type>(&leaf),
                DataType::Int8 => wide::<Int8Type>(&leaf),
                DataType::UInt32 => wide::<UInt32Type>(&leaf),
                DataType::UInt16 => wide::<UInt16Type>(&leaf),
                DataType::UInt8 => wide::<UInt8Type>(&leaf),
                _ => return Err(found()),
            })
        }
        (Column::Bool(_), DataType::Boolean) => Column::Bool(leaf.as_boolean().values().iter().collect()),
        (Column::Text(_), DataType::Utf8 | DataType::LargeUtf8) => Column::Text(texts(&leaf)),
        _ => return Err(found()),
    })
}

fn is_list(kind: &DataType) -> bool {
    matches!(kind, DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(_, _))
}

/// The children of lists that must all have `size` of them.
fn unpack(array: &ArrayRef, size: usize, width: usize, feature: &Feature, place: &Cell) -> Result<ArrayRef> {
    place.whole(array.as_ref(), width)?;
    let row = |i: usize, found: usize| {
        Err(place.error(Some(i / width.max(1)), format!("{size} entries"), found.to_string()))
    };
    match array.data_type() {
        DataType::List(_) => {
            let list = array.as_list::<i32>();
            match (0..list.len()).find(|&i| list.value_length(i) as usize != size) {
                Some(i) => row(i, list.value_length(i).unsigned_abs() as usize),
                None => {
                    let first = list.value_offsets().first().map_or(0, |&o| o as usize);
                    Ok(list.values().slice(first, list.len() * size))
                }
            }
        }
        DataType::LargeList(_) => {
            let list = array.as_list::<i64>();
            let length = |i: usize| usize::try_from(list.value_length(i)).unwrap_or(usize::MAX);
            match (0..list.len()).find(|&i| length(i) != size) {
                Some(i) => row(i, length(i)),
                None => {
                    let first = list.value_offsets().first().copied().unwrap_or(0);
                    Ok(list.values().slice(usize::try_from(first).unwrap_or(0), list.len() * size))
                }
            }
        }
        DataType::FixedSizeList(_, found) => {
            let list = array.as_fixed_size_list();
            if usize::try_from(*found).ok() != Some(size) {
                return row(0, usize::try_from(*found).unwrap_or(0));
            }
            Ok(list.values().slice(list.offset() * size, list.len() * size))
        }
        other => Err(place.unsupported(feature.describe(), other.to_string())),
    }
}

fn images(array: &ArrayRef, place: &Cell) -> Result<Column> {
    let kind = || place.unsupported("images as struct<bytes, path>", array.data_type().to_string());
    let bytes = match array.data_type() {
        DataType::Struct(_) => {
            place.whole(array.as_ref(), 1)?;
            array.as_struct().column_by_name("bytes").ok_or_else(kind)?.clone()
        }
        _ => array.clone(),
    };
    // Bytes may be left out for a path to a file of the recorder's machine; that file is not part of the dataset.
    if bytes.null_count() > 0 {
        return Err(place.unsupported("images in the file", "paths to other files"));
    }
    match bytes.data_type() {
        DataType::Binary => Ok(Column::Png(bytes.as_binary::<i32>().values_in_rows())),
        DataType::LargeBinary => Ok(Column::Png(bytes.as_binary::<i64>().values_in_rows())),
        _ => Err(kind()),
    }
}

/// Owned rows of a binary array without missing values.
trait ValuesInRows {
    fn values_in_rows(&self) -> Vec<Vec<u8>>;
}

impl<O: arrow_array::OffsetSizeTrait> ValuesInRows for arrow_array::GenericBinaryArray<O> {
    fn values_in_rows(&self) -> Vec<Vec<u8>> {
        (0..self.len()).map(|i| self.value(i).to_vec()).collect()
    }
}

/// Texts of an array; missing ones are empty.
pub(crate) fn texts(array: &ArrayRef) -> Vec<String> {
    match array.data_type() {
        DataType::Utf8 => array.as_string::<i32>().iter().map(|v| v.unwrap_or("").to_owned()).collect(),
        DataType::LargeUtf8 => array.as_string::<i64>().iter().map(|v| v.unwrap_or("").to_owned()).collect(),
        _ => vec![],
    }
}

/// A column to Arrow, as LeRobot lays it out. The table has been validated.
pub(crate) fn to_arrow(feature: &Feature, column: &Column) -> ArrayRef {
    fn narrow<T: ArrowPrimitiveType<Native: TryFrom<i64>>>(values: &[i64]) -> ArrayRef
    where
        T::Native: Default,
    {
        let values = values.iter().map(|&v| T::Native::try_from(v).unwrap_or_default());
        Arc::new(PrimitiveArray::<T>::from_iter_values(values))
    }
    let leaf: ArrayRef = match column {
        Column::F32(v) => Arc::new(Float32Array::from(v.clone())),
        Column::F64(v) => Arc::new(Float64Array::from(v.clone())),
        Column::Bool(v) => Arc::new(BooleanArray::from(v.clone())),
        Column::Text(v) => Arc::new(StringArray::from(v.clone())),
        Column::Png(v) => return pictures(v),
        Column::I64(v) => match feature.dtype {
            Dtype::Int8 => narrow::<Int8Type>(v),
            Dtype::Int16 => narrow::<Int16Type>(v),
            Dtype::Int32 => narrow::<Int32Type>(v),
            Dtype::UInt8 => narrow::<UInt8Type>(v),
            Dtype::UInt16 => narrow::<UInt16Type>(v),
            Dtype::UInt32 => narrow::<UInt32Type>(v),
            _ => Arc::new(Int64Array::from(v.clone())),
        },
    };
    match feature.shape[..] {
        [1] => leaf,
        [n] => {
            let field = Arc::new(Field::new("element", leaf.data_type().clone(), true));
            Arc::new(FixedSizeListArray::new(field, i32::try_from(n).unwrap_or(i32::MAX), leaf, None))
        }
        _ => feature.shape.iter().rev().fold(leaf, |inner, &n| lists(inner, n)),
    }
}

/// Every `size` values as one list.
pub(crate) fn lists(values: ArrayRef, size: usize) -> ArrayRef {
    let field = Arc::new(Field::new("element", values.data_type().clone(), true));
    let lengths = std::iter::repeat_n(size, values.len() / size.max(1));
    Arc::new(ListArray::new(field, OffsetBuffer::from_lengths(lengths), values, None))
}

fn pictures(files: &[Vec<u8>]) -> ArrayRef {
    let bytes = BinaryArray::from_iter_values(files);
    let path = StringArray::from_iter_values((0..files.len()).map(|t| format!("frame-{t:06}.png")));
    let fields = Fields::from(vec![
        Field::new("bytes", DataType::Binary, true),
        Field::new("path", DataType::Utf8, true),
    ]);
    Arc::new(StructArray::new(fields, vec![Arc::new(bytes) as ArrayRef, Arc::new(path)], None))
}

/// A column of plain numbers.
pub(crate) fn plain(column: &Column) -> ArrayRef {
    let dtype = if matches!(column, Column::F32(_)) { Dtype::Float32 } else { Dtype::Int64 };
    to_arrow(&Feature::scalar(dtype), column)
}

/// The batch with some columns replaced, and those added that it does not have.
pub(crate) fn replace_columns(
    old: &RecordBatch,
    mut new: Vec<(String, ArrayRef)>,
    path: &Path,
) -> Result<RecordBatch> {
    let mut columns = vec![];
    for (field, column) in old.schema().fields().iter().zip(old.columns()) {
        let place = new.iter().position(|(n, _)| n == field.name());
        columns.push(place.map_or_else(|| (field.name().clone(), column.clone()), |i| new.remove(i)));
    }
    columns.extend(new);
    batch(columns, path)
}

/// A batch of columns that may all be missing values, as pandas and pyarrow write them.
pub(crate) fn batch(columns: Vec<(String, ArrayRef)>, path: &Path) -> Result<RecordBatch> {
    RecordBatch::try_from_iter_with_nullable(columns.into_iter().map(|(n, c)| (n, c, true)))
        .map_err(|e| file_error(path, "columns", "one length", e.to_string()))
}
