//! What a Parquet file may unpack to: looked at in its headers and dictionaries, before a decoder takes memory for it.

use super::parquet_file::ParquetFile;
use super::promises::{self, Page};
use parquet::arrow::ProjectionMask;
use parquet::basic::{Compression, Type};

/// Values that any file may unpack to, and how many more for each of its bytes. A thousand to one is what the densest common
/// compression reaches; what promises more is made to fill the memory.
pub(super) const VALUES: (u64, u64) = (1 << 24, 1024);
/// The same in bytes of texts and images.
pub(super) const BYTES: (u64, u64) = (1 << 28, 1024);
/// Snappy makes at most 64 bytes of 3.
const SNAPPY: u64 = 22;

/// What the pages of one pass over a file unpack to, as far as their headers tell.
#[derive(Default)]
pub(super) struct Promised {
    values: u64,
    /// Of texts and images.
    bytes: u64,
}

impl Promised {
    fn add(&mut self, values: u64, bytes: u64) {
        self.values = self.values.saturating_add(values);
        self.bytes = self.bytes.saturating_add(bytes);
    }
}

impl ParquetFile {
    /// What a file of this size may unpack to.
    pub(super) fn most(&self, (any, each): (u64, u64)) -> u64 {
        self.source.length.saturating_mul(each).saturating_add(any)
    }

    pub(super) fn fewer(&self, limit: (u64, u64), what: &str) -> String {
        format!("at most {} {what} of a file of {} bytes", self.most(limit), self.source.length)
    }

    /// Looks at the headers of the pages of some columns of a row group, before they are decoded. `promised` is what the groups
    /// before it promised.
    pub(super) fn look(
        &self,
        group: usize,
        columns: &ProjectionMask,
        promised: &mut Promised,
    ) -> std::result::Result<(), String> {
        for (i, column) in self.metadata.metadata().row_group(group).columns().iter().enumerate() {
            if !columns.leaf_included(i) {
                continue;
            }
            let (mut at, length) = column.byte_range();
            let end = at.checked_add(length).filter(|end| *end <= self.source.end());
            let Some(end) = end else { return Err(format!("a column of {length} bytes from byte {at} on")) };
            let texts = column.column_type() == Type::BYTE_ARRAY;
            // A dictionary's longest text may stand in every row.
            let mut longest = match column.column_type() {
                Type::FIXED_LEN_BYTE_ARRAY => {
                    column.column_descr().type_length().max(0).unsigned_abs().into()
                }
                _ => 0,
            };
            let mut values = 0_u64;
            while at < end {
                let page = promises::page(self.source.from(at), end - at)?;
                let left = end - at - page.header;
                if page.stored > left {
                    return Err(format!("a page of {} bytes where {left} are left", page.stored));
                }
                let snappy = matches!(column.compression(), Compression::SNAPPY | Compression::UNCOMPRESSED);
                if snappy && page.unpacked > page.stored.saturating_mul(SNAPPY).saturating_add(64) {
                    let Page { unpacked, stored, .. } = page;
                    return Err(format!("a page of {unpacked} bytes packed into {stored}"));
                }
                values = values.saturating_add(page.values);
                promised.add(page.values, 0);
                if texts && page.dictionary {
                    longest = longest.max(self.longest_text(at, &page, column.compression())?);
                }
                if texts && page.shares_prefixes {
                    promised.add(0, page.values.saturating_mul(page.unpacked));
                }
                at += page.header + page.stored;
            }
            promised.add(0, values.saturating_mul(longest));
            for (what, found, limit) in
                [("values", promised.values, VALUES), ("bytes of text", promised.bytes, BYTES)]
            {
                if found > self.most(limit) {
                    return Err(format!("{found} {what}, expected {}", self.fewer(limit, what)));
                }
            }
        }
        Ok(())
    }

    /// Length of the longest text in a page that begins at `at` and holds a dictionary.
    fn longest_text(&self, at: u64, page: &Page, packed: Compression) -> std::result::Result<u64, String> {
        let bytes = self.source.bytes(at + page.header, page.stored as usize).map_err(|e| e.to_string())?;
        if packed != Compression::SNAPPY {
            return Ok(promises::longest(&bytes));
        }
        match snap::raw::decompress_len(&bytes) {
            Ok(length) if length as u64 <= page.unpacked => {}
            Ok(length) => return Err(format!("a page of {length} bytes, expected {}", page.unpacked)),
            Err(e) => return Err(format!("a dictionary that cannot be unpacked: {e}")),
        }
        let unpacked = snap::raw::Decoder::new().decompress_vec(&bytes);
        let unpacked = unpacked.map_err(|e| format!("a dictionary that cannot be unpacked: {e}"))?;
        Ok(promises::longest(&unpacked))
    }
}
