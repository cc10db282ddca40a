//! Parquet files: columns from and to Arrow, checksums, and errors that say where.

use super::feature::{Dtype, Feature};
use super::limits::{BYTES, Promised, VALUES};
use super::promises;
use super::table::Column;
use crate::atomic::{io, persist, unfinished};
use crate::file::{file_error, open_regular, unsupported};
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
use parquet::file::metadata::{ColumnChunkMetaData, KeyValue, ParquetMetaDataReader, RowGroupMetaData};
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
/// Bytes of a footer: far above any dataset's, and what may be read at once.
const LARGEST_FOOTER: u32 = 1 << 28;
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
    /// Whether columns have the types that the writer says, and not only Parquet's own.
    as_written: bool,
}

/// The bytes of a file, read by their place: threads that share it do not move each other.
#[derive(Clone)]
pub(super) struct Source {
    file: Arc<File>,
    /// Bytes of the file.
    pub(super) length: u64,
    /// What has been unpacked of it in memory, as if it followed the file.
    pub(super) unpacked: Arc<Vec<u8>>,
}

impl Source {
    /// Bytes in all.
    pub(super) fn end(&self) -> u64 {
        self.length + self.unpacked.len() as u64
    }

    /// All bytes from `start` on.
    pub(super) fn from(&self, start: u64) -> BufReader<Place> {
        BufReader::new(Place { source: self.clone(), at: start })
    }

    pub(super) fn bytes(&self, start: u64, length: usize) -> std::io::Result<Vec<u8>> {
        let end = start.checked_add(length as u64);
        if end.is_none_or(|end| end > self.end()) {
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
        if let Some(at) = self.at.checked_sub(self.source.length) {
            let at = usize::try_from(at).unwrap_or(usize::MAX);
            let read = self.source.unpacked.get(at..).unwrap_or_default().read(bytes)?;
            self.at += read as u64;
            return Ok(read);
        }
        // Up to the end that was measured: behind it lies what was unpacked.
        let left = usize::try_from(self.source.length - self.at).unwrap_or(usize::MAX);
        let most = bytes.len().min(left);
        let bytes = &mut bytes[..most];
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
        self.end()
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

    /// Refuses by name what is packed in a way that is not read here.
    fn check_packing(&self, group: usize, columns: &[&str]) -> Result<()> {
        for column in self.metadata.metadata().row_group(group).columns() {
            let Some(name) = column.column_path().parts().first() else { continue };
            let known = matches!(
                column.compression(),
                Compression::UNCOMPRESSED | Compression::SNAPPY | Compression::ZSTD(_)
            );
            if !known && columns.contains(&name.as_str()) {
                let what = format!("column `{name}`");
                let found = format!("{:?}", column.compression());
                return Err(unsupported(&self.path, &what, "snappy, zstd or no packing", found));
            }
        }
        Ok(())
    }

    /// This file with the zstd pages of some columns unpacked in memory; none where there are no such pages.
    fn unpack(
        &self,
        groups: &[usize],
        columns: &ProjectionMask,
    ) -> std::result::Result<Option<Self>, String> {
        let metadata = self.metadata.metadata();
        let mut unpacked = vec![];
        let mut all: Option<Vec<RowGroupMetaData>> = None;
        for &group in groups {
            let packed = |(i, c): &(usize, &ColumnChunkMetaData)| {
                columns.leaf_included(*i) && matches!(c.compression(), Compression::ZSTD(_))
            };
            let chunks: Vec<_> =
                metadata.row_group(group).columns().iter().enumerate().filter(packed).collect();
            for (i, chunk) in chunks {
                let plain = self.unpack_chunk(chunk, &mut unpacked)?;
                let all = all.get_or_insert_with(|| metadata.row_groups().to_vec());
                let mut columns = all[group].columns().to_vec();
                columns[i] = plain;
                let built = all[group].clone().into_builder().set_column_metadata(columns).build();
                all[group] = built.map_err(|e| e.to_string())?;
            }
        }
        let Some(all) = all else { return Ok(None) };
        let metadata = metadata.as_ref().clone().into_builder().set_row_groups(all).build();
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(!self.as_written);
        let metadata =
            ArrowReaderMetadata::try_new(Arc::new(metadata), options).map_err(|e| e.to_string())?;
        let source = Source { unpacked: Arc::new(unpacked), ..self.source.clone() };
        Ok(Some(Self { path: self.path.clone(), source, metadata, as_written: self.as_written }))
    }

    /// Adds the pages of one column to `out`, unpacked, and says where they are now.
    fn unpack_chunk(
        &self,
        chunk: &ColumnChunkMetaData,
        out: &mut Vec<u8>,
    ) -> std::result::Result<ColumnChunkMetaData, String> {
        let (mut at, length) = chunk.byte_range();
        let end = at.checked_add(length).filter(|end| *end <= self.source.length);
        let end = end.ok_or_else(|| format!("a column of {length} bytes from byte {at} on"))?;
        let start = out.len();
        let mut data = None;
        while at < end {
            let page = promises::page(self.source.from(at), end - at)?;
            let left = end - at - page.header;
            if page.stored > left {
                return Err(format!("a page of {} bytes where {left} are left", page.stored));
            }
            if page.unpacked > self.most(BYTES).saturating_sub(out.len() as u64) {
                return Err(format!("more, expected {}", self.fewer(BYTES, "bytes")));
            }
            let read = |from, length: u64| {
                self.source
                    .bytes(from, usize::try_from(length).unwrap_or(usize::MAX))
                    .map_err(|e| e.to_string())
            };
            let (header, body) = (read(at, page.header)?, read(at + page.header, page.stored)?);
            let body = unpack_page(&body, &page)?;
            let size = i32::try_from(body.len()).map_err(|_| "a page of more than 2 GiB".to_owned())?;
            if !page.dictionary {
                data.get_or_insert(out.len());
            }
            out.extend(promises::restate(&header, size, crc32fast::hash(&body))?);
            out.extend(body);
            at += page.header + page.stored;
        }
        let place = |at: usize| i64::try_from(self.source.length + at as u64).unwrap_or(i64::MAX);
        let dictionary = chunk.dictionary_page_offset().map(|_| place(start));
        let data = if dictionary.is_some() { data.unwrap_or(start) } else { start };
        let builder = chunk.clone().into_builder();
        let builder = builder.set_compression(Compression::UNCOMPRESSED).set_index_page_offset(None);
        let builder = builder.set_total_compressed_size(i64::try_from(out.len() - start).unwrap_or(i64::MAX));
        let builder = builder.set_dictionary_page_offset(dictionary).set_data_page_offset(place(data));
        builder.build().map_err(|e| e.to_string())
    }
}

/// The bytes of a page, unpacked. Levels of the second version of pages are never packed.
fn unpack_page(body: &[u8], page: &promises::Page) -> std::result::Result<Vec<u8>, String> {
    let levels = usize::try_from(page.levels).ok().and_then(|n| body.split_at_checked(n));
    let (levels, packed) = levels.ok_or_else(|| format!("levels of {} bytes", page.levels))?;
    let mut out = levels.to_vec();
    if page.plain {
        out.extend_from_slice(packed);
    } else if !packed.is_empty() {
        let failed = |e: String| format!("a page that zstd cannot unpack: {e}");
        let decoder = ruzstd::decoding::StreamingDecoder::new(packed).map_err(|e| failed(e.to_string()))?;
        let left = page.unpacked.saturating_sub(page.levels);
        // One byte more shows whether there are more.
        decoder.take(left + 1).read_to_end(&mut out).map_err(|e| failed(e.to_string()))?;
    }
    let found = out.len() as u64;
    if found == page.unpacked {
        Ok(out)
    } else {
        Err(format!("a page of {found} bytes, not {}", page.unpacked))
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
    let found = || place.unsupported(feature.describe(), array.data_type().to_string());
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
