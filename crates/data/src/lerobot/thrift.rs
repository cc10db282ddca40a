//! Thrift's compact protocol, as far as headers of Parquet files are written in it: walks a structure of known layout, and keeps nothing.
//!
//! # Source
//! The specification of Thrift's compact protocol.

use std::io::Read;

/// What a header's field holds.
pub(super) enum Kind {
    Bool,
    Byte,
    /// 16, 32 or 64 bits; all are written alike.
    Int,
    Double,
    Binary,
    List(&'static Kind),
    Struct(&'static [(i16, Kind)]),
    /// A structure that the decoder passes over as a whole.
    Any,
}

pub(super) use Kind::{Any, Binary, Bool, Byte, Double, Int, List, Struct};

/// Levels of a structure that is passed over.
const DEEPEST_SKIPPED: usize = 16;

/// What is wrong, in words.
pub(super) type Wrong = String;

pub(super) fn wrong<T>(what: impl Into<Wrong>) -> Result<T, Wrong> {
    Err(what.into())
}

/// What reads a field: gets its number, its type on the wire, and its kind.
pub(super) type Each<'a, W> = dyn FnMut(&mut W, i16, u8, &'static Kind) -> Result<(), Wrong> + 'a;

/// Reads headers; never beyond its bytes.
pub(super) struct Walker<R> {
    pub(super) input: R,
    /// Bytes that are left.
    pub(super) left: u64,
}

impl<R: Read> Walker<R> {
    fn byte(&mut self) -> Result<u8, Wrong> {
        let mut byte = [0];
        if self.left == 0 || self.input.read_exact(&mut byte).is_err() {
            return wrong("a header that is cut off");
        }
        self.left -= 1;
        Ok(byte[0])
    }

    fn pass(&mut self, bytes: u64) -> Result<(), Wrong> {
        let copied = std::io::copy(&mut (&mut self.input).take(bytes.min(self.left)), &mut std::io::sink());
        if bytes > self.left || copied.ok() != Some(bytes) {
            return wrong(format!("a text of {bytes} bytes where {} are left", self.left));
        }
        self.left -= bytes;
        Ok(())
    }

    /// A number of up to 64 bits, seven of them a byte.
    fn number(&mut self) -> Result<u64, Wrong> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        wrong("a number of more than 64 bits")
    }

    pub(super) fn signed(&mut self) -> Result<i64, Wrong> {
        let value = self.number()?;
        Ok((value >> 1).cast_signed() ^ -(value & 1).cast_signed())
    }

    /// Type and length of a list.
    pub(super) fn list(&mut self) -> Result<(u8, u64), Wrong> {
        let head = self.byte()?;
        let length = if head >> 4 == 15 { self.number()? } else { u64::from(head >> 4) };
        if length > self.left {
            return wrong(format!("a list of {length} entries in {} bytes", self.left));
        }
        Ok((head & 15, length))
    }

    /// The fields of a structure, in the order of their numbers; `each` has to read the field.
    pub(super) fn fields(
        &mut self,
        known: &'static [(i16, Kind)],
        each: &mut Each<'_, Self>,
    ) -> Result<(), Wrong> {
        let mut last = 0_i16;
        loop {
            let head = self.byte()?;
            let wire = head & 15;
            if wire == 0 {
                return if head == 0 { Ok(()) } else { wrong("a structure without an end") };
            }
            let step = i64::from(head >> 4);
            let id = if step == 0 { self.signed()? } else { i64::from(last) + step };
            let id = i16::try_from(id).ok().filter(|id| *id > last);
            let Some(id) = id else { return wrong("fields out of order") };
            last = id;
            let kind = known.iter().find(|(n, _)| *n == id).map_or(&Any, |(_, kind)| kind);
            each(self, id, wire, kind)?;
        }
    }

    /// Passes over a value that has to be of `kind`; `wire` is its type.
    pub(super) fn value(&mut self, wire: u8, kind: &'static Kind, in_list: bool) -> Result<(), Wrong> {
        match (kind, wire) {
            (Any, wire) => self.any(wire, in_list, 0),
            (Bool, 1 | 2) if !in_list => Ok(()),
            (Bool, 1 | 2) | (Byte, 3) => self.pass(1),
            (Int, 4..=6) => self.number().map(|_| ()),
            (Double, 7) => self.pass(8),
            (Binary, 8) => {
                let length = self.number()?;
                self.pass(length)
            }
            (List(kind), 9) => {
                let (wire, length) = self.list()?;
                (0..length).try_for_each(|_| self.value(wire, kind, true))
            }
            (Struct(known), 12) => {
                self.fields(known, &mut |this, _, wire, kind| this.value(wire, kind, false))
            }
            (_, wire) => wrong(format!("a header's field of type {wire}, which is another's")),
        }
    }

    /// Passes over whatever there is.
    fn any(&mut self, wire: u8, in_list: bool, depth: usize) -> Result<(), Wrong> {
        if depth > DEEPEST_SKIPPED {
            return wrong("structures within structures without end");
        }
        match wire {
            1 | 2 if !in_list => Ok(()),
            1..=3 => self.pass(1),
            4..=6 => self.number().map(|_| ()),
            7 => self.pass(8),
            8 => {
                let length = self.number()?;
                self.pass(length)
            }
            9 | 10 => {
                let (wire, length) = self.list()?;
                (0..length).try_for_each(|_| self.any(wire, true, depth + 1))
            }
            12 => self.fields(&[], &mut |this, _, wire, _| this.any(wire, false, depth + 1)),
            // Parquet has no maps.
            _ => wrong(format!("a header's field of unknown type {wire}")),
        }
    }
}
