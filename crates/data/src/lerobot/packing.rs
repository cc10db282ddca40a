//! How pages are packed: what is read here, and zstd, which is unpacked before the Parquet reader sees it.

use super::limits::BYTES;
use super::parquet_file::ParquetFile;
use super::parquet_source::Source;
use super::promises;
use crate::Result;
use crate::file::unsupported;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions};
use parquet::basic::Compression;
use parquet::file::metadata::{ColumnChunkMetaData, RowGroupMetaData};
use std::io::Read;
use std::sync::Arc;

impl ParquetFile {
    /// Refuses by name what is packed in a way that is not read here.
    pub(super) fn check_packing(&self, group: usize, columns: &[&str]) -> Result<()> {
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
    pub(super) fn unpack(
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
