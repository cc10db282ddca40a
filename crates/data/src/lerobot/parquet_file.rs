//! Parquet files: rows of some columns, checksums, and errors that say where.

use super::arrow::{Cell, from_arrow};
use super::feature::Feature;
use super::limits::{BYTES, Promised, VALUES};
use super::parquet_source::Source;
use super::parquet_writer::{ParquetWriter, hex};
use super::promises;
use super::table::Column;
use crate::Result;
use crate::atomic::io;
use crate::file::{file_error, open_regular, unsupported};
use arrow_array::RecordBatch;
use arrow_schema::SchemaRef;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use parquet::file::metadata::ParquetMetaDataReader;
use sha2::{Digest, Sha256};
use std::io::Read;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Key of the checksums in a file's footer: a list of `[first byte, end byte, SHA-256]`, one per row group.
pub(super) const CHECKSUMS: &str = "auto_e2h.sha256";
/// Rows decoded at once: images of some seconds.
const BATCH: usize = 64;
/// Bytes of a footer: far above any dataset's, and what may be read at once.
const LARGEST_FOOTER: u32 = 1 << 28;
/// What a footer ends with.
const MAGIC: &[u8; 4] = b"PAR1";
/// What a damaged file should have been.
const WHOLE: &str = "a whole Parquet file";
/// One part of a file that is checked on its own: its bytes and their SHA-256.
pub(super) type Checksum = (u64, u64, String);

/// An open Parquet file.
pub(crate) struct ParquetFile {
    pub(crate) path: PathBuf,
    pub(super) source: Source,
    pub(super) metadata: ArrowReaderMetadata,
    /// Whether columns have the types that the writer says, and not only Parquet's own.
    pub(super) as_written: bool,
}

/// Runs a decoder that this project did not write. Damaged bytes may make it panic; that too is an answer.
fn guard<T>(path: &Path, what: &str, run: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(run))
        .unwrap_or_else(|_| Err(file_error(path, what, WHOLE, "bytes that the decoder stumbles over")))
}

impl ParquetFile {
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = open_regular(path)?;
        let length = file.metadata().map_err(io("open", path))?.len();
        let source = Source { file: Arc::new(file), length, unpacked: Arc::default() };
        let broken = |found: String| file_error(path, "file", WHOLE, found);
        let footer = footer(&source, path)?;
        promises::footer(&footer).map_err(broken)?;
        let metadata = guard(path, "file", || {
            let metadata = ParquetMetaDataReader::decode_metadata(&footer);
            let metadata = metadata.map_err(|e| broken(e.to_string()))?;
            // By Parquet's own types: what a writer calls a large list, a dictionary or a view is then what it is here.
            let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
            ArrowReaderMetadata::try_new(Arc::new(metadata), options).map_err(|e| broken(e.to_string()))
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
        let this = Self { path: path.to_owned(), source, metadata, as_written: false };
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
        for &group in &wanted {
            self.check_packing(group, columns)?;
        }
        let what = |from: usize| {
            let names = columns.iter().map(|c| format!("`{c}`")).collect::<Vec<_>>().join(", ");
            format!("column {names}, from row {from}")
        };
        let mut next = rows.start;
        let result = guard(&self.path, &what(rows.start), || {
            let schema = self.metadata.schema();
            let places = columns.iter().filter_map(|c| schema.index_of(c).ok());
            let mask = ProjectionMask::roots(self.metadata.parquet_schema(), places);
            let broken = |from, e: String| file_error(&self.path, &what(from), "readable values", e);
            let unpacked = self.unpack(&wanted, &mask).map_err(|e| broken(rows.start, e))?;
            let this = unpacked.as_ref().unwrap_or(self);
            let mut promised = Promised::default();
            for &group in &wanted {
                this.look(group, &mask, &mut promised).map_err(|e| broken(rows.start, e))?;
            }
            let (source, metadata) = (this.source.clone(), this.metadata.clone());
            let reader = ParquetRecordBatchReaderBuilder::new_with_metadata(source, metadata)
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
        let bad = |found: String| file_error(&self.path, CHECKSUMS, "one checksum per row group", found);
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

    /// The first `ends.last()` rows as a new file at the same place, one row group up to each of `ends`: the columns that
    /// `wanted` wants, as `change` makes them of batches that begin at a row. What the writer said of the columns stays.
    pub(crate) fn rewrite(
        &self,
        ends: &[usize],
        wanted: &dyn Fn(&str) -> bool,
        change: &mut dyn FnMut(&RecordBatch, usize) -> Result<RecordBatch>,
    ) -> Result<()> {
        let full = self.as_written()?;
        let described = full.metadata.schema().clone();
        let columns: Vec<&str> =
            described.fields().iter().map(|f| f.name().as_str()).filter(|n| wanted(n)).collect();
        let same = |e: arrow_schema::ArrowError| {
            file_error(&self.path, "columns", "those of the file", e.to_string())
        };
        let mut open: Option<(ParquetWriter, SchemaRef)> = None;
        let mut start = 0;
        for &end in ends {
            full.batches(&columns, start..end, &mut |batch, first| {
                let batch = change(batch, first)?;
                let (writer, schema) = match &mut open {
                    Some(open) => open,
                    None => {
                        let schema = batch.schema().as_ref().clone();
                        let schema = Arc::new(schema.with_metadata(described.metadata().clone()));
                        open.insert((ParquetWriter::create(&self.path, schema.clone())?, schema))
                    }
                };
                writer.add(&batch.with_schema(schema.clone()).map_err(same)?)
            })?;
            if let Some((writer, _)) = &mut open {
                writer.close_group()?;
            }
            start = end;
        }
        match open {
            Some((writer, _)) => writer.finish(),
            None => Err(file_error(&self.path, "file", "rows to keep", "none")),
        }
    }

    /// The same file, with columns of the types that its writer says.
    fn as_written(&self) -> Result<Self> {
        guard(&self.path, "schema", || {
            let metadata = self.metadata.metadata().clone();
            let full = ArrowReaderMetadata::try_new(metadata, ArrowReaderOptions::new());
            let metadata = full.map_err(|e| unsupported(&self.path, "schema", "Arrow's", e.to_string()))?;
            Ok(Self { path: self.path.clone(), source: self.source.clone(), metadata, as_written: true })
        })
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
    if magic == b"PARE" {
        return Err(unsupported(path, "file", "an open Parquet file", "an encrypted one"));
    }
    if magic != MAGIC {
        return Err(broken(format!("an end of {magic:?}")));
    }
    let length = length.first_chunk().map_or(0, |b| u32::from_le_bytes(*b));
    if length > LARGEST_FOOTER {
        let most = format!("a footer of at most {LARGEST_FOOTER} bytes");
        return Err(unsupported(path, "file", most, length.to_string()));
    }
    match (source.length - 8).checked_sub(length.into()) {
        Some(start) if start >= 4 => source.bytes(start, length as usize).map_err(&read),
        _ => Err(broken(format!("a footer of {length} bytes in a file of {}", source.length))),
    }
}
