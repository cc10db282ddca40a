//! Parquet files around pages of the fuzzer's: neither compressed nor checksummed, and with a footer that fits, so that
//! every byte reaches the decoder of values.

use arbitrary::{Result, Unstructured};
use parquet::basic::{Compression, Encoding};
use parquet::column::page::{Page, PageReader};
use parquet::file::metadata::{
    ColumnChunkMetaData, FileMetaData, ParquetMetaData, ParquetMetaDataReader, ParquetMetaDataWriter,
    RowGroupMetaData,
};
use parquet::file::serialized_reader::SerializedPageReader;
use std::path::Path;
use std::sync::Arc;

/// Columns that an input may replace, as many as it has bytes for.
const COLUMNS: usize = 3;
/// Pages of a column.
const PAGES: usize = 4;
/// All encodings by their number.
const ENCODINGS: [u8; 9] = [0, 2, 3, 4, 5, 6, 7, 8, 9];

/// One page, as its header describes it.
#[derive(Clone, Debug)]
struct Raw {
    /// 0 data, 2 dictionary, 3 data of the second version.
    kind: u8,
    encoding: u8,
    values: u16,
    rows: u8,
    nulls: u8,
    /// Bytes of levels, of the second version.
    levels: [u8; 2],
    bytes: Vec<u8>,
}

impl Raw {
    fn of(page: &Page) -> Self {
        let encoding = |e: Encoding| e as u8;
        let base = Self {
            kind: 0,
            encoding: encoding(page.encoding()),
            values: page.num_values().try_into().expect("few values"),
            rows: 0,
            nulls: 0,
            levels: [0; 2],
            bytes: page.buffer().to_vec(),
        };
        match page {
            Page::DataPage { .. } => base,
            Page::DictionaryPage { .. } => Self { kind: 2, ..base },
            Page::DataPageV2 { num_rows, num_nulls, def_levels_byte_len, rep_levels_byte_len, .. } => Self {
                kind: 3,
                rows: *num_rows as u8,
                nulls: *num_nulls as u8,
                levels: [*def_levels_byte_len as u8, *rep_levels_byte_len as u8],
                ..base
            },
        }
    }

    fn read(u: &mut Unstructured<'_>) -> Result<Self> {
        let kind = [0, 0, 2, 3][usize::from(u.arbitrary::<u8>()? & 3)];
        let encoding = ENCODINGS[usize::from(u.arbitrary::<u8>()?) % ENCODINGS.len()];
        let (values, rows, nulls, levels) = (u.arbitrary()?, u.arbitrary()?, u.arbitrary()?, u.arbitrary()?);
        let length = usize::from(u.arbitrary::<u16>()?).min(u.len());
        Ok(Self { kind, encoding, values, rows, nulls, levels, bytes: u.bytes(length)?.to_vec() })
    }

    /// What [`Raw::read`] reads.
    fn write(&self, out: &mut Vec<u8>) {
        let encoding = ENCODINGS.iter().position(|e| *e == self.encoding).unwrap_or(0) as u8;
        out.extend([
            match self.kind {
                0 => 0,
                2 => 2,
                _ => 3,
            },
            encoding,
        ]);
        out.extend(self.values.to_le_bytes());
        out.extend([self.rows, self.nulls, self.levels[0], self.levels[1]]);
        out.extend(u16::try_from(self.bytes.len()).expect("a small page").to_le_bytes());
        out.extend(&self.bytes);
    }

    /// Header and page.
    fn file(&self) -> Vec<u8> {
        let mut out = vec![];
        let size = self.bytes.len() as i64;
        for value in [self.kind.into(), size, size] {
            field(&mut out, 1, 5, value);
        }
        let (values, encoding) = (i64::from(self.values), i64::from(self.encoding));
        match self.kind {
            0 => {
                out.push(0x2c);
                for value in [values, encoding, 3, 3] {
                    field(&mut out, 1, 5, value);
                }
            }
            2 => {
                out.push(0x4c);
                for value in [values, encoding] {
                    field(&mut out, 1, 5, value);
                }
            }
            _ => {
                out.push(0x5c);
                let [definition, repetition] = self.levels.map(i64::from);
                for value in [values, self.nulls.into(), self.rows.into(), encoding, definition, repetition] {
                    field(&mut out, 1, 5, value);
                }
            }
        }
        out.extend([0, 0]);
        out.extend(&self.bytes);
        out
    }
}

/// A number of Thrift's compact protocol behind its field's head.
fn field(out: &mut Vec<u8>, step: u8, kind: u8, value: i64) {
    out.push(step << 4 | kind);
    let mut v = ((value << 1) ^ (value >> 63)) as u64;
    while v >= 0x80 {
        out.push(v as u8 | 0x80);
        v >>= 7;
    }
    out.push(v as u8);
}

/// A file taken apart.
pub struct Template {
    metadata: ParquetMetaData,
    /// Pages by row group and column.
    pages: Vec<Vec<Vec<Raw>>>,
}

impl Template {
    pub fn of(file: &[u8], place: &Path) -> Self {
        std::fs::write(place, file).expect("a file");
        let file = std::fs::File::open(place).expect("a file");
        let metadata = ParquetMetaDataReader::new().parse_and_finish(&file).expect("metadata");
        let file = Arc::new(file);
        let pages = metadata.row_groups().iter().map(|group| {
            let column = |c: &ColumnChunkMetaData| {
                let rows = group.num_rows() as usize;
                let mut reader = SerializedPageReader::new(file.clone(), c, rows, None).expect("a column");
                let mut pages = vec![];
                while let Some(page) = reader.get_next_page().expect("a page") {
                    pages.push(Raw::of(&page));
                }
                pages
            };
            group.columns().iter().map(column).collect()
        });
        Self { pages: pages.collect(), metadata }
    }

    /// One input for every column: its own pages.
    pub fn seeds(&self) -> Vec<Vec<u8>> {
        let seed = |(column, pages): (usize, &Vec<Raw>)| {
            let mut out = vec![column as u8, pages.len() as u8 - 1];
            pages.iter().take(PAGES).for_each(|p| p.write(&mut out));
            out
        };
        self.pages[0].iter().enumerate().map(seed).collect()
    }

    /// The file with the columns that the input has pages for.
    pub fn build(&self, input: &[u8]) -> Vec<u8> {
        let mut u = Unstructured::new(input);
        let mut pages = self.pages.clone();
        for _ in 0..COLUMNS {
            let Ok([column, count]) = u.arbitrary::<[u8; 2]>() else { break };
            if u.is_empty() {
                break;
            }
            let columns = pages[0].len();
            let slot = &mut pages[0][usize::from(column) % columns];
            slot.clear();
            for _ in 0..=usize::from(count) % PAGES {
                slot.extend(Raw::read(&mut u));
            }
        }
        self.file(&pages)
    }

    fn file(&self, pages: &[Vec<Vec<Raw>>]) -> Vec<u8> {
        let old = self.metadata.file_metadata();
        let mut out = b"PAR1".to_vec();
        let mut groups = vec![];
        for (group, pages) in self.metadata.row_groups().iter().zip(pages) {
            let mut builder =
                RowGroupMetaData::builder(old.schema_descr_ptr()).set_num_rows(group.num_rows());
            for (column, pages) in group.columns().iter().zip(pages) {
                let (start, mut first, mut dictionary) = (out.len() as i64, None, None);
                for page in pages {
                    let place = if page.kind == 2 { &mut dictionary } else { &mut first };
                    place.get_or_insert(out.len() as i64);
                    out.extend(page.file());
                }
                let new = ColumnChunkMetaData::builder(column.column_descr_ptr())
                    .set_compression(Compression::UNCOMPRESSED)
                    .set_num_values(column.num_values())
                    .set_data_page_offset(first.unwrap_or(start))
                    .set_dictionary_page_offset(dictionary.filter(|d| *d == start))
                    .set_total_compressed_size(out.len() as i64 - start)
                    .set_total_uncompressed_size(out.len() as i64 - start);
                builder = builder.add_column_metadata(new.build().expect("a column"));
            }
            groups.push(builder.build().expect("a group"));
        }
        let file = FileMetaData::new(
            old.version(),
            old.num_rows(),
            old.created_by().map(str::to_owned),
            old.key_value_metadata()
                .map(|e| e.iter().filter(|e| e.key != "auto_e2h.sha256").cloned().collect()),
            old.schema_descr_ptr(),
            old.column_orders().cloned(),
        );
        let mut footer = vec![];
        let metadata = ParquetMetaData::new(file, groups);
        ParquetMetaDataWriter::new(&mut footer, &metadata).finish().expect("a footer");
        out.extend(footer);
        out
    }
}
