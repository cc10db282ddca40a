//! What a Parquet file promises, looked at before the decoder believes it.
//!
//! The decoder takes memory for as many columns, bytes and values as the file's own headers name, and goes as deep as its
//! schema does. A file of a hundred bytes may so ask for sixteen gigabytes or overflow the stack, and neither can be caught.
//! Headers are walked here by their published layout ([`super::thrift`]), and one that does not keep to it is refused, because the
//! decoder might read it otherwise.
//!
//! # Source
//! `parquet.thrift` of parquet-format 2.12.

use super::thrift::{Any, Binary, Bool, Byte, Double, Int, Kind, List, Struct, Walker, Wrong, wrong};
use std::io::Read;

const EMPTY: Kind = Struct(&[]);
const UNIT: Kind = Struct(&[(1, EMPTY), (2, EMPTY), (3, EMPTY)]);
const MOMENT: Kind = Struct(&[(1, Bool), (2, UNIT)]);
const LOGICAL: Kind = Struct(&[
    (1, EMPTY),
    (2, EMPTY),
    (3, EMPTY),
    (4, EMPTY),
    (5, Struct(&[(1, Int), (2, Int)])),
    (6, EMPTY),
    (7, MOMENT),
    (8, MOMENT),
    (10, Struct(&[(1, Byte), (2, Bool)])),
    (11, EMPTY),
    (12, EMPTY),
    (13, EMPTY),
    (14, EMPTY),
    (15, EMPTY),
    (16, Struct(&[(1, Byte)])),
    (17, Struct(&[(1, Binary)])),
    (18, Struct(&[(1, Binary), (2, Int)])),
]);
/// Children of a schema's element.
const CHILDREN: i16 = 5;
const ELEMENT: Kind = Struct(&[
    (1, Int),
    (2, Int),
    (3, Int),
    (4, Binary),
    (CHILDREN, Int),
    (6, Int),
    (7, Int),
    (8, Int),
    (9, Int),
    (10, LOGICAL),
]);
const ENTRY: Kind = Struct(&[(1, Binary), (2, Binary)]);
const STATISTICS: Kind = Struct(&[
    (1, Binary),
    (2, Binary),
    (3, Int),
    (4, Int),
    (5, Binary),
    (6, Binary),
    (7, Bool),
    (8, Bool),
    (9, Int),
]);
const SIZES: Kind = Struct(&[(1, Int), (2, List(&Int)), (3, List(&Int))]);
const BOX: Kind = Struct(&[
    (1, Double),
    (2, Double),
    (3, Double),
    (4, Double),
    (5, Double),
    (6, Double),
    (7, Double),
    (8, Double),
]);
const COLUMN: Kind = Struct(&[
    (1, Int),
    (2, List(&Int)),
    (3, List(&Binary)),
    (4, Int),
    (5, Int),
    (6, Int),
    (7, Int),
    (8, List(&ENTRY)),
    (9, Int),
    (10, Int),
    (11, Int),
    (12, STATISTICS),
    (13, List(&Struct(&[(1, Int), (2, Int), (3, Int)]))),
    (14, Int),
    (15, Int),
    (16, SIZES),
    (17, Struct(&[(1, BOX), (2, List(&Int))])),
]);
const CHUNK: Kind = Struct(&[
    (1, Binary),
    (2, Int),
    (3, COLUMN),
    (4, Int),
    (5, Int),
    (6, Int),
    (7, Int),
    (8, Any),
    (9, Binary),
]);
const GROUP: Kind = Struct(&[
    (1, List(&CHUNK)),
    (2, Int),
    (3, Int),
    (4, List(&Struct(&[(1, Int), (2, Bool), (3, Bool)]))),
    (5, Int),
    (6, Int),
    (7, Int),
]);
/// The schema in a footer.
const SCHEMA: i16 = 2;
const FOOTER: &[(i16, Kind)] = &[
    (1, Int),
    (SCHEMA, List(&ELEMENT)),
    (3, Int),
    (4, List(&GROUP)),
    (5, List(&ENTRY)),
    (6, Binary),
    (7, List(&Struct(&[(1, EMPTY), (2, EMPTY)]))),
    (8, Any),
    (9, Binary),
];
const PAGE: &[(i16, Kind)] = &[
    (1, Int),
    (2, Int),
    (3, Int),
    (4, Int),
    (5, Struct(&[(1, Int), (2, Int), (3, Int), (4, Int), (5, Any)])),
    (6, EMPTY),
    (7, Struct(&[(1, Int), (2, Int), (3, Bool)])),
    (8, Struct(&[(1, Int), (2, Int), (3, Int), (4, Int), (5, Int), (6, Int), (7, Bool), (8, Any)])),
];

/// Levels of a schema; LeRobot's deepest column, an image's statistics, has nine.
const DEEPEST: usize = 40;
/// Checks a footer: its structures end, and its schema is not deeper than any table is.
pub(super) fn footer(bytes: &[u8]) -> Result<(), Wrong> {
    let mut walker = Walker { input: bytes, left: bytes.len() as u64 };
    walker.fields(FOOTER, &mut |walker, id, wire, kind| {
        if id == SCHEMA && wire == 9 { schema(walker) } else { walker.value(wire, kind, false) }
    })
}

/// A schema is a list of elements; a group's children follow it.
fn schema<R: Read>(walker: &mut Walker<R>) -> Result<(), Wrong> {
    let (wire, length) = walker.list()?;
    let Struct(known) = &ELEMENT else { return Ok(()) };
    if wire != 12 {
        return wrong("a schema of no structures");
    }
    // Children that are still to come, of each group that is open.
    let mut open: Vec<u64> = vec![];
    for element in 0..length {
        let mut children = 0;
        walker.fields(known, &mut |walker, id, wire, kind| {
            if id == CHILDREN && (4..=6).contains(&wire) {
                children = walker.signed()?;
                return Ok(());
            }
            walker.value(wire, kind, false)
        })?;
        match u64::try_from(children) {
            Ok(0) => {}
            Ok(children) if children < length - element && open.len() < DEEPEST => {
                open.push(children);
                continue;
            }
            Ok(children) if open.len() < DEEPEST => {
                return wrong(format!("a group of {children} columns in a schema of {length}"));
            }
            Ok(_) => return wrong(format!("columns more than {DEEPEST} levels deep")),
            Err(_) => return wrong(format!("a group of {children} columns")),
        }
        // This one is done, and with it every group whose last child it was.
        while let Some(left) = open.last_mut() {
            *left -= 1;
            if *left > 0 {
                break;
            }
            open.pop();
        }
    }
    Ok(())
}

/// What the header of a page says.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Page {
    /// Bytes of the header itself.
    pub(super) header: u64,
    /// Bytes of the page in the file.
    pub(super) stored: u64,
    /// Bytes of it in memory.
    pub(super) unpacked: u64,
    /// Values in it; for a page of a dictionary, those of the dictionary.
    pub(super) values: u64,
    pub(super) dictionary: bool,
    /// Bytes of levels before the values that are not packed with them.
    pub(super) levels: u64,
    /// Whether its values are not packed, whatever the column says.
    pub(super) plain: bool,
    /// Whether texts may begin with as much of the one before as they like.
    pub(super) shares_prefixes: bool,
}

/// The number of Parquet's `DELTA_BYTE_ARRAY`.
const DELTA_BYTE_ARRAY: i64 = 7;

/// Length of the longest text in a dictionary, bytes.
pub(super) fn longest(mut dictionary: &[u8]) -> u64 {
    let mut longest = 0;
    while let Some((length, rest)) = dictionary.split_first_chunk() {
        let length = u32::from_le_bytes(*length);
        // What is longer than the page is the decoder's to refuse.
        let Some(rest) = rest.get(length as usize..) else { break };
        (longest, dictionary) = (longest.max(length.into()), rest);
    }
    longest
}

/// Reads the header of a page; `left` bytes are left of its column.
pub(super) fn page(input: impl Read, left: u64) -> Result<Page, Wrong> {
    let mut walker = Walker { input, left };
    let mut page = Page::default();
    let size = |v: i64| u64::try_from(v).map_err(|_| format!("a page of {v} bytes or values"));
    walker.fields(PAGE, &mut |walker, id, wire, kind| match (id, kind, wire) {
        (2 | 3, _, 4..=6) => {
            let slot = if id == 2 { &mut page.unpacked } else { &mut page.stored };
            *slot = size(walker.signed()?)?;
            Ok(())
        }
        (5 | 7 | 8, Struct(known), 12) => {
            page.dictionary |= id == 7;
            walker.fields(known, &mut |walker, inner, wire, kind| {
                if inner == 1 && (4..=6).contains(&wire) {
                    page.values = page.values.max(size(walker.signed()?)?);
                    return Ok(());
                }
                if id == 8 && (inner == 5 || inner == 6) && (4..=6).contains(&wire) {
                    page.levels = page.levels.saturating_add(size(walker.signed()?)?);
                    return Ok(());
                }
                if id == 8 && inner == 7 {
                    page.plain = wire == 2;
                }
                let encoding = if id == 8 { 4 } else { 2 };
                if inner == encoding && (4..=6).contains(&wire) {
                    page.shares_prefixes |= walker.signed()? == DELTA_BYTE_ARRAY;
                    return Ok(());
                }
                walker.value(wire, kind, false)
            })
        }
        _ => walker.value(wire, kind, false),
    })?;
    page.header = left - walker.left;
    Ok(page)
}

/// The header of a page that has been read by [`page`], for the same page in `stored` bytes with the checksum `sum`.
pub(super) fn restate(header: &[u8], stored: i32, sum: u32) -> Result<Vec<u8>, Wrong> {
    let number = |out: &mut Vec<u8>, v: i32| {
        let mut v = ((v << 1) ^ (v >> 31)).cast_unsigned();
        while v >= 0x80 {
            out.push((v & 0x7f) as u8 | 0x80);
            v >>= 7;
        }
        out.push(v as u8);
    };
    let mut out = Vec::with_capacity(header.len() + 8);
    let (mut at, mut id) = (0, 0);
    // Kind, both sizes and the checksum are the first four fields, and numbers; what follows is not touched.
    loop {
        let Some(&head) = header.get(at) else { return wrong("a header that is cut off") };
        id += head >> 4;
        if head >> 4 == 0 || id > 4 {
            if id < 3 {
                return wrong("a header without sizes");
            }
            out.extend_from_slice(&header[at..]);
            return Ok(out);
        }
        let length = header[at + 1..].iter().position(|b| *b < 0x80);
        let Some(length) = length else { return wrong("a header that is cut off") };
        let end = at + length + 2;
        match id {
            3 => {
                out.push(head);
                number(&mut out, stored);
            }
            4 => {
                out.push(head);
                number(&mut out, sum.cast_signed());
            }
            _ => out.extend_from_slice(&header[at..end]),
        }
        at = end;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A field's head and its value.
    fn field(step: u8, wire: u8, value: &[u8]) -> Vec<u8> {
        [&[step << 4 | wire], value].concat()
    }

    fn zigzag(v: i32) -> Vec<u8> {
        let mut v = ((v << 1) ^ (v >> 31)).cast_unsigned();
        let mut out = vec![];
        while v >= 0x80 {
            out.push(v as u8 | 0x80);
            v >>= 7;
        }
        out.push(v as u8);
        out
    }

    /// A footer whose schema has elements with these numbers of children.
    fn footer_of(children: &[i32]) -> Vec<u8> {
        let element = |n: &i32| [field(4, 8, &[1, b'a']), field(1, 5, &zigzag(*n)), vec![0]].concat();
        let mut length = vec![0xfc];
        let mut n = children.len();
        while n >= 0x80 {
            length.push(n as u8 | 0x80);
            n >>= 7;
        }
        length.push(n as u8);
        let list = [length, children.iter().flat_map(element).collect()].concat();
        [field(1, 5, &[2]), field(1, 9, &list), vec![0]].concat()
    }

    #[test]
    fn schemas_that_end_are_accepted() {
        for children in [&[1, 0][..], &[3, 0, 2, 0, 0, 0], &[0]] {
            footer(&footer_of(children)).unwrap();
        }
    }

    #[test]
    fn a_schema_without_end_is_refused() {
        let refusal = |children: &[i32]| footer(&footer_of(children)).unwrap_err();
        assert_eq!(refusal(&[1, i32::MAX, 0]), "a group of 2147483647 columns in a schema of 3");
        assert_eq!(refusal(&[-1]), "a group of -1 columns");
        let deep: Vec<i32> = std::iter::repeat_n(1, 100_000).chain([0]).collect();
        assert_eq!(refusal(&deep), "columns more than 40 levels deep");
    }

    #[test]
    fn headers_that_end_early_or_lie_about_lengths_are_refused() {
        let whole = footer_of(&[3, 0, 2, 0, 0, 0]);
        for length in 0..whole.len() {
            assert!(footer(&whole[..length]).is_err(), "{length}");
        }
        // A text of 2^40 bytes; a list of 2^40 entries; a field whose type is another's; one field twice.
        let huge = [0x80, 0x80, 0x80, 0x80, 0x80, 0x20];
        assert!(footer(&field(6, 8, &huge)).unwrap_err().contains("1099511627776 bytes"));
        assert!(footer(&field(5, 9, &[&[0xfc][..], &huge].concat())).unwrap_err().contains("entries"));
        assert!(footer(&field(3, 8, &[0])).unwrap_err().contains("type 8"));
        let twice = [field(2, 9, &[0x0c]), field(0, 9, &[4, 0x0c])].concat();
        assert_eq!(footer(&twice).unwrap_err(), "fields out of order");
    }

    #[test]
    fn a_header_is_restated_with_another_size_and_checksum() {
        let whole = |stored: i32, sum: i32| {
            let data = [field(1, 5, &zigzag(7)), field(1, 5, &[0]), vec![0]].concat();
            let sizes = [field(1, 5, &[0]), field(1, 5, &zigzag(500)), field(1, 5, &zigzag(stored))].concat();
            [sizes, field(1, 5, &zigzag(sum)), field(1, 12, &data), vec![0]].concat()
        };
        assert_eq!(restate(&whole(60, 1), 500, u32::MAX).unwrap(), whole(500, -1));
        let header = whole(60, 1);
        assert!((0..7).all(|n| restate(&header[..n], 1, 1).is_err()));
    }

    #[test]
    fn a_page_says_its_sizes() {
        let data = [field(1, 5, &zigzag(7)), field(1, 5, &[0]), vec![0]].concat();
        let header = [
            field(1, 5, &[0]),
            field(1, 5, &zigzag(100)),
            field(1, 5, &zigzag(60)),
            field(2, 12, &data),
            vec![0],
        ]
        .concat();
        let found = page(&header[..], 500).unwrap();
        let header = header.len() as u64;
        assert_eq!(found, Page { header, stored: 60, unpacked: 100, values: 7, ..Page::default() });
        assert!(page(&[0x15, 0, 0x15, 1][..], 500).unwrap_err().contains("a page of -1 bytes"));
    }
}
