//! Parquet files: columns from and to Arrow, checksums, and errors that say where.

use super::feature::{Dtype, Feature};
use super::limits::{BYTES, Promised, VALUES};
use super::promises;
use super::table::Column;
use crate::atomic::{io, persist, unfinished};
use crate::file::file_error;
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
use arrow_schema::{DataType, Field, Fields, SchemaRef};
use bytes::Bytes;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use parquet::arrow::{ArrowWriter, ProjectionMask};
use parquet::basic::Compression;
use parquet::errors::ParquetError;
use parquet::file::metadata::{KeyValue, ParquetMetaDataReader};
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::reader::{ChunkReader, Length};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tempfile::NamedTempFile;

/// Key of the checksums in a file's footer: a list of `[first byte, end byte, SHA-256]`, one a row group.
const CHECKSUMS: &str = "auto_e2h.sha256";
/// Rows decoded at once: images of some seconds.
const BATCH: usize = 64;
/// What a footer ends with.
const MAGIC: &[u8; 4] = b"PAR1";
/// What a damaged file should have been.
const WHOLE: &str = "a whole Parquet file";
/// One part of a file that is checked on its own: its bytes and their SHA-256.
type Checksum = (u64, u64, String);

/// An open Parquet file.
pub(crate) struct ParquetFile {
    pub(crate) path: PathBuf,
    pub(super) source: Source,
    pub(super) metadata: ArrowReaderMetadata,
}

/// The bytes of a file, read by their place: threads that share it do not move each other.
#[derive(Clone)]
pub(super) struct Source {
    file: Arc<File>,
    pub(super) length: u64,
}

impl Source {
    /// All bytes from `start` on.
    pub(super) fn from(&self, start: u64) -> BufReader<Place> {
        BufReader::new(Place { source: self.clone(), at: start })
    }

    pub(super) fn bytes(&self, start: u64, length: usize) -> std::io::Result<Vec<u8>> {
        let end = start.checked_add(length as u64);
        if end.is_none_or(|end| end > self.length) {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
        let mut bytes = vec![0; length];
        Place { source: self.clone(), at: start }.read_exact(&mut bytes)?;
        Ok(bytes)
    }
}

/// A place in a file.
pub(super) struct Place {
    source: Source,
    at: u64,
}

impl Read for Place {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        #[cfg(unix)]
        let read = std::os::unix::fs::FileExt::read_at(&*self.source.file, bytes, self.at)?;
        #[cfg(windows)]
        let read = std::os::windows::fs::FileExt::seek_read(&*self.source.file, bytes, self.at)?;
        self.at += read as u64;
        Ok(read)
    }
}

impl Length for Source {
    fn len(&self) -> u64 {
        self.length
    }
}

impl ChunkReader for Source {
    type T = BufReader<Place>;

    fn get_read(&self, start: u64) -> parquet::errors::Result<Self::T> {
        Ok(self.from(start))
    }

    fn get_bytes(&self, start: u64, length: usize) -> parquet::errors::Result<Bytes> {
        Ok(self.bytes(start, length).map_err(|e| ParquetError::External(e.into()))?.into())
    }
}

/// Runs a decoder that this project did not write. Damaged bytes may make it panic; that too is an answer.
fn guard<T>(path: &Path, what: &str, run: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(run))
        .unwrap_or_else(|_| Err(file_error(path, what, WHOLE, "bytes that the decoder stumbles over")))
}

impl ParquetFile {
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(io("open", path))?;
        let length = file.metadata().map_err(io("open", path))?.len();
        let source = Source { file: Arc::new(file), length };
        let broken = |found: String| file_error(path, "file", WHOLE, found);
        let footer = footer(&source, path)?;
        promises::footer(&footer).map_err(broken)?;
        let metadata = guard(path, "file", || {
            let metadata = ParquetMetaDataReader::decode_metadata(&footer);
            let metadata = metadata.map_err(|e| broken(e.to_string()))?;
            ArrowReaderMetadata::try_new(Arc::new(metadata), ArrowReaderOptions::new())
                .map_err(|e| broken(e.to_string()))
        })?;
        let rows = metadata.metadata().file_metadata().num_rows();
        let mut groups = metadata.metadata().row_groups().iter().map(|g| u64::try_from(g.num_rows()).ok());
        let sum = groups.try_fold(0_u64, |sum, rows| sum.checked_add(rows?));
        if sum.is_none() || sum != u64::try_from(rows).ok() {
            let found = sum.map_or("others".to_owned(), |sum| sum.to_string());
            return Err(file_error(
                path,
                "file",
                format!("{rows} rows"),
                format!("{found} in its row groups"),
            ));
        }
        let this = Self { path: path.to_owned(), source, metadata };
        match sum {
            Some(rows) if rows > this.most(VALUES) => {
                Err(file_error(path, "file", this.fewer(VALUES, "rows"), format!("{rows}")))
            }
            _ => Ok(this),
        }
    }

    pub(crate) fn rows(&self) -> usize {
        usize::try_from(self.metadata.metadata().file_metadata().num_rows()).unwrap_or(0)
    }

    pub(crate) fn has(&self, column: &str) -> bool {
        self.metadata.schema().fields().iter().any(|f| f.name() == column)
    }

    /// Decodes some columns of some rows, a batch at a time; `each` also gets the row that a batch begins with.
    pub(crate) fn batches(
        &self,
        columns: &[&str],
        rows: Range<usize>,
        each: &mut dyn FnMut(&RecordBatch, usize) -> Result<()>,
    ) -> Result<()> {
        for column in columns {
            if !self.has(column) {
                return Err(file_error(&self.path, &format!("column `{column}`"), "one", "none"));
            }
        }
        if rows.end > self.rows() {
            let expected = format!("at least {} rows", rows.end);
            return Err(file_error(&self.path, "file", expected, self.rows().to_string()));
        }
        let (mut first, mut done) = (None, 0);
        let mut wanted = vec![];
        for (i, group) in self.metadata.metadata().row_groups().iter().enumerate() {
            let next = done + usize::try_from(group.num_rows()).unwrap_or(0);
            if done < rows.end && next > rows.start {
                first.get_or_insert(done);
                wanted.push(i);
            }
            done = next;
        }
        let Some(first) = first else { return Ok(()) };
        let what = |from: usize| {
            let names = columns.iter().map(|c| format!("`{c}`")).collect::<Vec<_>>().join(", ");
            format!("column {names}, from row {from}")
        };
        let mut next = rows.start;
        let result = guard(&self.path, &what(rows.start), || {
            let (source, metadata) = (self.source.clone(), self.metadata.clone());
            let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(source, metadata);
            let schema = builder.schema().clone();
            let places = columns.iter().filter_map(|c| schema.index_of(c).ok());
            let mask = ProjectionMask::roots(builder.parquet_schema(), places);
            let broken = |from, e: String| file_error(&self.path, &what(from), "readable values", e);
            let mut promised = Promised::default();
            for &group in &wanted {
                self.look(group, &mask, &mut promised).map_err(|e| broken(rows.start, e))?;
            }
            let reader = builder
                .with_projection(mask)
                .with_row_groups(wanted)
                .with_offset(rows.start - first)
                .with_limit(rows.len())
                .with_batch_size(BATCH.min(rows.len().max(1)))
                .build()
                .map_err(|e| broken(rows.start, e.to_string()))?;
            for batch in reader {
                let batch = batch.map_err(|e| broken(next, e.to_string()))?;
                each(&batch, next)?;
                next += batch.num_rows();
            }
            if next != rows.end {
                return Err(broken(next, format!("{} rows", next - rows.start)));
            }
            Ok(())
        });
        // One of several columns is to blame: ask each by itself, so that the message names it.
        if result.is_err() && columns.len() > 1 {
            for column in columns {
                self.batches(&[column], rows.clone(), &mut |_, _| Ok(()))?;
            }
        }
        result
    }

    /// Columns as `features` describe them.
    pub(crate) fn read(
        &self,
        features: &[(&str, &Feature)],
        rows: Range<usize>,
    ) -> Result<Vec<(String, Column)>> {
        let names: Vec<&str> = features.iter().map(|(n, _)| *n).collect();
        let mut out: Vec<Column> = features.iter().map(|(_, f)| Column::empty(f.dtype)).collect();
        let mut bytes = 0;
        self.batches(&names, rows, &mut |batch, first| {
            for ((name, feature), column) in features.iter().zip(&mut out) {
                let array = batch.column_by_name(name).ok_or_else(|| {
                    file_error(&self.path, &format!("column `{name}`"), "one", "none in this batch")
                })?;
                let place = Cell { path: &self.path, column: name, first };
                let piece = from_arrow(array, feature, &place)?;
                bytes += piece.bytes() as u64;
                if bytes > self.most(BYTES) {
                    return Err(place.error(None, self.fewer(BYTES, "bytes"), format!("more: {bytes}")));
                }
                column.append(piece);
            }
            Ok(())
        })?;
        Ok(names.into_iter().map(str::to_owned).zip(out).collect())
    }

    /// Compares every row group with its checksum; the groups that do not fit. None for a file that has no checksums.
    pub(crate) fn damaged_groups(&self) -> Result<Option<Vec<usize>>> {
        let entries = self.metadata.metadata().file_metadata().key_value_metadata();
        let text =
            entries.and_then(|e| e.iter().find(|kv| kv.key == CHECKSUMS)).and_then(|kv| kv.value.as_ref());
        let Some(text) = text else { return Ok(None) };
        let bad = |found: String| file_error(&self.path, CHECKSUMS, "one checksum a row group", found);
        let sums: Vec<Checksum> = serde_json::from_str(text).map_err(|e| bad(e.to_string()))?;
        let groups = self.metadata.metadata().num_row_groups();
        if sums.len() != groups {
            return Err(bad(format!("{} for {groups}", sums.len())));
        }
        let read = io("read", &self.path);
        let mut damaged = vec![];
        let mut place = 0;
        for (i, (start, end, sum)) in sums.into_iter().enumerate() {
            if start != place || end < start {
                return Err(bad(format!("bytes {start} to {end}")));
            }
            place = end;
            let mut hash = Sha256::new();
            let mut group = self.source.from(start).take(end - start);
            let copied = std::io::copy(&mut group, &mut hash).map_err(&read)?;
            if copied != end - start || hex(&hash.finalize()) != sum {
                damaged.push(i);
            }
        }
        Ok(Some(damaged))
    }

    /// Rows of row group `i`.
    pub(crate) fn group_rows(&self, i: usize) -> Range<usize> {
        let groups = self.metadata.metadata().row_groups();
        let rows = |g: &[parquet::file::metadata::RowGroupMetaData]| -> usize {
            // Their sum has been looked at when the file was opened.
            g.iter().map(|g| usize::try_from(g.num_rows()).unwrap_or(0)).sum()
        };
        rows(&groups[..i])..rows(&groups[..=i])
    }

    /// The first `ends.last()` rows as a new file at the same place, one row group up to each of `ends`.
    pub(crate) fn truncate(&self, ends: &[usize]) -> Result<()> {
        let schema = self.schema();
        let columns: Vec<&str> = schema.fields().iter().map(|f| f.name().as_str()).collect();
        let mut writer = ParquetWriter::create(&self.path, schema.clone())?;
        let mut start = 0;
        for &end in ends {
            self.batches(&columns, start..end, &mut |batch, _| {
                let batch = batch.clone().with_schema(schema.clone());
                let same = |e: arrow_schema::ArrowError| {
                    file_error(&self.path, "columns", "those of the file", e.to_string())
                };
                writer.add(&batch.map_err(same)?)
            })?;
            writer.close_group()?;
            start = end;
        }
        writer.finish()
    }

    fn schema(&self) -> SchemaRef {
        self.metadata.schema().clone()
    }
}

/// The bytes of a footer: what its last eight bytes say of it.
fn footer(source: &Source, path: &Path) -> Result<Vec<u8>> {
    let broken = |found: String| file_error(path, "file", WHOLE, found);
    let read = io("read", path);
    if source.length < 12 {
        return Err(broken(format!("{} bytes", source.length)));
    }
    let end = source.bytes(source.length - 8, 8).map_err(&read)?;
    let (length, magic) = end.split_at(4);
    if magic != MAGIC {
        return Err(broken(format!("an end of {magic:?}")));
    }
    let length = length.first_chunk().map_or(0, |b| u32::from_le_bytes(*b));
    match (source.length - 8).checked_sub(length.into()) {
        Some(start) if start >= 4 => source.bytes(start, length as usize).map_err(&read),
        _ => Err(broken(format!("a footer of {length} bytes in a file of {}", source.length))),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// Counts and hashes what is written through it.
struct Hashing {
    file: BufWriter<NamedTempFile>,
    hash: Sha256,
    start: u64,
    end: u64,
}

impl Write for Hashing {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let n = self.file.write(bytes)?;
        self.hash.update(&bytes[..n]);
        self.end += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.file.flush()
    }
}

/// A Parquet file in the making; it appears at its place when it is whole.
pub(crate) struct ParquetWriter {
    path: PathBuf,
    writer: ArrowWriter<Hashing>,
    sums: Vec<Checksum>,
}

impl ParquetWriter {
    pub(crate) fn create(path: &Path, schema: SchemaRef) -> Result<Self> {
        let folder = path.parent().unwrap_or(Path::new("."));
        crate::atomic::make_folder(folder)?;
        let file = BufWriter::new(unfinished(folder)?);
        let sink = Hashing { file, hash: Sha256::new(), start: 0, end: 0 };
        // No indices of pages: a row group is an episode, so there is nothing to skip in it, and between rows and footer lies
        // nothing that a checksum does not cover.
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_statistics_enabled(EnabledStatistics::Chunk)
            .set_offset_index_disabled(true)
            .set_created_by(concat!("e2h-data ", env!("CARGO_PKG_VERSION")).to_owned())
            .build();
        let writer = ArrowWriter::try_new(sink, schema, Some(properties)).map_err(write_error(path))?;
        Ok(Self { path: path.to_owned(), writer, sums: vec![] })
    }

    /// Writes one row group.
    pub(crate) fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        self.add(batch)?;
        self.close_group()
    }

    /// Adds rows to the row group that is open.
    pub(crate) fn add(&mut self, batch: &RecordBatch) -> Result<()> {
        self.writer.write(batch).map_err(write_error(&self.path))
    }

    /// Ends the row group that is open, and takes its checksum.
    pub(crate) fn close_group(&mut self) -> Result<()> {
        self.writer.flush().map_err(write_error(&self.path))?;
        self.writer.sync().map_err(io("write", &self.path))?;
        let sink = self.writer.inner_mut();
        self.sums.push((sink.start, sink.end, hex(&sink.hash.finalize_reset())));
        sink.start = sink.end;
        Ok(())
    }

    /// Bytes so far.
    pub(crate) fn len(&self) -> u64 {
        self.writer.inner().end
    }

    /// Puts the file at its place.
    pub(crate) fn finish(mut self) -> Result<()> {
        let failed = write_error(&self.path);
        let text = serde_json::to_string(&self.sums)
            .map_err(|e| file_error(&self.path, CHECKSUMS, "JSON", e.to_string()))?;
        self.writer.append_key_value_metadata(KeyValue::new(CHECKSUMS.to_owned(), text));
        let sink = self.writer.into_inner().map_err(&failed)?;
        let file = sink.file.into_inner().map_err(|e| io("write", &self.path)(e.into_error()))?;
        persist(file, &self.path)
    }
}

fn write_error(path: &Path) -> impl Fn(parquet::errors::ParquetError) -> Error {
    let path = path.to_owned();
    move |e| Error::Io { action: "write", path: path.clone(), source: std::io::Error::other(e) }
}

/// Where a value lies, for messages.
struct Cell<'a> {
    path: &'a Path,
    column: &'a str,
    first: usize,
}

impl Cell<'_> {
    fn error(&self, row: Option<usize>, expected: impl Into<String>, found: impl Into<String>) -> Error {
        let what = match row {
            Some(row) => format!("column `{}`, row {}", self.column, self.first + row),
            None => format!("column `{}`", self.column),
        };
        file_error(self.path, &what, expected, found)
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
fn from_arrow(array: &ArrayRef, feature: &Feature, place: &Cell) -> Result<Column> {
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
        return Err(place.error(None, format!("{width} numbers a row"), leaf.len().to_string()));
    }
    let found = || place.error(None, feature.describe(), array.data_type().to_string());
    fn values<T: ArrowPrimitiveType>(leaf: &ArrayRef) -> &[T::Native] {
        leaf.as_primitive::<T>().values()
    }
    Ok(match (Column::empty(feature.dtype), leaf.data_type()) {
        (Column::F32(_), DataType::Float32) => Column::F32(values::<Float32Type>(&leaf).to_vec()),
        #[allow(clippy::cast_possible_truncation, reason = "the feature says 32 bits")]
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
        other => Err(place.error(None, feature.describe(), other.to_string())),
    }
}

fn images(array: &ArrayRef, place: &Cell) -> Result<Column> {
    let kind = || place.error(None, "images as struct<bytes, path>", array.data_type().to_string());
    let bytes = match array.data_type() {
        DataType::Struct(_) => {
            place.whole(array.as_ref(), 1)?;
            array.as_struct().column_by_name("bytes").ok_or_else(kind)?.clone()
        }
        _ => array.clone(),
    };
    // Bytes may be left out for a path to a file of the recorder's machine; that file is not part of the dataset.
    place.whole(bytes.as_ref(), 1)?;
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

/// A batch of columns that may all be missing values, as pandas and pyarrow write them.
pub(crate) fn batch(columns: Vec<(String, ArrayRef)>, path: &Path) -> Result<RecordBatch> {
    RecordBatch::try_from_iter_with_nullable(columns.into_iter().map(|(n, c)| (n, c, true)))
        .map_err(|e| file_error(path, "columns", "one length", e.to_string()))
}
