//! Parquet files in the making, with a checksum of every row group.

use super::parquet_file::{CHECKSUMS, Checksum};
use crate::atomic::{io, persist, unfinished};
use crate::file::file_error;
use crate::{Error, Result};
use arrow_array::RecordBatch;
use arrow_schema::SchemaRef;
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use sha2::{Digest, Sha256};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

pub(super) fn hex(bytes: &[u8]) -> String {
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
