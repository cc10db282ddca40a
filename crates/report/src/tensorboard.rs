//! TensorBoard event files: scalars for those who watch a run there.
//!
//! A file is a list of records in TFRecord framing (length, masked CRC-32C of the length, bytes, masked CRC-32C of the bytes);
//! the bytes are a protobuf `Event`. Only what scalars need is written, by hand.
//!
//! ```
//! use e2h_report::tensorboard::{Events, read};
//!
//! let folder = tempfile::tempdir()?;
//! let mut events = Events::create(folder.path(), 1.7e9, 0)?;
//! events.scalar("train/loss", 10, 1.7e9, 0.5)?;
//! let path = events.finish()?;
//! assert_eq!(read(&path)?[2].scalars, [("train/loss".to_owned(), 0.5)]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Source
//! `tensorflow/core/util/event.proto`, `summary.proto`, and the record format of `tfrecord` files.

use crate::error::io;
use crate::{Error, Result};
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

/// Layout of event files since which a restart is told by a record.
const VERSION: &str = "brain.Event:2";

/// An event file that grows. It is a log: a kill may cut its last record off, which readers pass over.
#[derive(Debug)]
pub struct Events {
    file: BufWriter<File>,
    path: PathBuf,
}

/// A record of an event file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Event {
    /// When it was written, s since 1970.
    pub wall_time: f64,
    /// Step that it belongs to.
    pub step: i64,
    /// Layout of the file; in its first record only.
    pub version: Option<String>,
    /// True where a process started or went on: what earlier files say of this step and later ones is void.
    pub start: bool,
    /// Tags and values.
    pub scalars: Vec<(String, f32)>,
}

impl Events {
    /// A new event file in `dir` (made when missing) of a process that starts, or goes on, at `step`: what earlier files of
    /// the folder say of that step and later ones no longer counts.
    ///
    /// # Units
    /// `wall_time` in s since 1970; it is part of the name, by which TensorBoard orders the files of a folder.
    ///
    /// # Errors
    /// When the folder or the file cannot be made.
    pub fn create(dir: &Path, wall_time: f64, step: u64) -> Result<Self> {
        std::fs::create_dir_all(dir).map_err(io("creating", dir))?;
        for n in 0.. {
            let path = dir.join(format!("events.out.tfevents.{:010.0}.{n:03}.e2h", wall_time.max(0.0)));
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => {
                    let mut this = Self { file: BufWriter::new(file), path };
                    let event = Event { wall_time, version: Some(VERSION.to_owned()), ..Event::default() };
                    this.write(&event)?;
                    this.write(&Event { wall_time, step: signed(step), start: true, ..Event::default() })?;
                    this.flush()?;
                    return Ok(this);
                }
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(io("creating", &path)(e)),
            }
        }
        Err(Error::Options("no name for an event file is free".to_owned()))
    }

    /// Appends one value. It is in the file after [`Events::flush`].
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn scalar(&mut self, tag: &str, step: u64, wall_time: f64, value: f64) -> Result<()> {
        // The format has 32 bits for it.
        let scalars = vec![(tag.to_owned(), value as f32)];
        self.write(&Event { wall_time, step: signed(step), scalars, ..Event::default() })
    }

    /// Hands everything to the system, for a TensorBoard that is watching.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn flush(&mut self) -> Result<()> {
        self.file.flush().map_err(io("writing", &self.path))
    }

    /// Closes the file and returns its path.
    ///
    /// # Errors
    /// When the file cannot be written or synced.
    pub fn finish(mut self) -> Result<PathBuf> {
        self.flush()?;
        self.file.get_ref().sync_all().map_err(io("syncing", &self.path))?;
        Ok(self.path)
    }

    fn write(&mut self, event: &Event) -> Result<()> {
        let bytes = encode(event);
        let length = (bytes.len() as u64).to_le_bytes();
        let record = [&length[..], &masked(&length).to_le_bytes(), &bytes, &masked(&bytes).to_le_bytes()];
        self.file.write_all(&record.concat()).map_err(io("writing", &self.path))
    }
}

fn signed(step: u64) -> i64 {
    i64::try_from(step).unwrap_or(i64::MAX)
}

/// Reads an event file and checks every checksum. A last record that a kill cut off is not there.
///
/// # Errors
/// When the file cannot be read, a checksum is wrong, or a record is no event.
pub fn read(path: &Path) -> Result<Vec<Event>> {
    let bytes = e2h_data::read_file(path, e2h_data::MOST_WEIGHTS).map_err(io("reading", path))?;
    let bad = |at: usize, expected: &str, found: String| Error::Foreign {
        path: path.to_owned(),
        quantity: format!("record at byte {at}"),
        expected: expected.to_owned(),
        found,
    };
    let word = |at: usize| bytes.get(at..)?.first_chunk().map(|b| u32::from_le_bytes(*b));
    let mut events = vec![];
    let mut at = 0;
    while let Some(length) = bytes.get(at..).and_then(<[u8]>::first_chunk::<8>) {
        let size = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        let Some(sum) = word(at + 8) else { break };
        if sum != masked(length) {
            return Err(bad(
                at,
                &format!("checksum {:08x} of its length", masked(length)),
                format!("{sum:08x}"),
            ));
        }
        let end = (at + 12).saturating_add(size);
        let (Some(data), Some(sum)) = (bytes.get(at + 12..end), word(end)) else { break };
        if sum != masked(data) {
            return Err(bad(at, &format!("checksum {:08x}", masked(data)), format!("{sum:08x}")));
        }
        events.push(decode(data).ok_or_else(|| bad(at, "a protobuf Event", "something else".to_owned()))?);
        at = end + 4;
    }
    Ok(events)
}

const fn table() -> [u32; 256] {
    let mut table = [0; 256];
    let mut n = 0;
    while n < 256 {
        let mut crc = n as u32;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 == 1 { 0x82f6_3b78 ^ (crc >> 1) } else { crc >> 1 };
            bit += 1;
        }
        table[n] = crc;
        n += 1;
    }
    table
}

static TABLE: [u32; 256] = table();

/// CRC-32C (Castagnoli).
fn crc32c(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc: u32, b| TABLE[usize::from(crc.to_le_bytes()[0] ^ b)] ^ (crc >> 8))
}

/// The checksum as records have it: rotated and shifted, so that a checksum of checksums is none.
fn masked(bytes: &[u8]) -> u32 {
    crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

// Protobuf: a field is (number << 3 | kind) and its value; kind 0 is a varint, 1 eight bytes, 2 a length and bytes, 5 four bytes.

fn varint(mut v: u64, out: &mut Vec<u8>) {
    while v >= 0x80 {
        out.push(v.to_le_bytes()[0] | 0x80);
        v >>= 7;
    }
    out.push(v.to_le_bytes()[0]);
}

fn field(number: u8, bytes: &[u8], out: &mut Vec<u8>) {
    out.push(number << 3 | 2);
    varint(bytes.len() as u64, out);
    out.extend_from_slice(bytes);
}

fn encode(event: &Event) -> Vec<u8> {
    let mut out = vec![1 << 3 | 1]; // wall_time
    out.extend_from_slice(&event.wall_time.to_le_bytes());
    if event.step != 0 {
        out.push(2 << 3); // step
        varint(event.step.cast_unsigned(), &mut out);
    }
    if let Some(version) = &event.version {
        field(3, version.as_bytes(), &mut out); // file_version
    }
    if !event.scalars.is_empty() {
        let mut summary = vec![];
        for (tag, number) in &event.scalars {
            let mut value = vec![];
            field(1, tag.as_bytes(), &mut value); // tag
            value.push(2 << 3 | 5); // simple_value
            value.extend_from_slice(&number.to_le_bytes());
            field(1, &value, &mut summary);
        }
        field(5, &summary, &mut out); // summary
    }
    if event.start {
        field(7, &[1 << 3, 1], &mut out); // session_log { status: START }
    }
    out
}

/// One field of a message: its number and its value.
enum Value<'a> {
    Whole(u64),
    Bytes(&'a [u8]),
}

/// The fields of a message; none when it is no message.
fn fields(mut bytes: &[u8]) -> Option<Vec<(u64, Value<'_>)>> {
    fn take<'a>(bytes: &mut &'a [u8], n: usize) -> Option<&'a [u8]> {
        let (head, tail) = bytes.split_at_checked(n)?;
        *bytes = tail;
        Some(head)
    }
    fn whole(bytes: &mut &[u8]) -> Option<u64> {
        let mut v = 0;
        for shift in (0..64).step_by(7) {
            let byte = u64::from(take(bytes, 1)?[0]);
            v |= (byte & 0x7f) << shift;
            if byte < 0x80 {
                return Some(v);
            }
        }
        None
    }
    let mut found = vec![];
    while !bytes.is_empty() {
        let key = whole(&mut bytes)?;
        let value = match key & 7 {
            0 => Value::Whole(whole(&mut bytes)?),
            1 => Value::Bytes(take(&mut bytes, 8)?),
            2 => {
                let n = usize::try_from(whole(&mut bytes)?).ok()?;
                Value::Bytes(take(&mut bytes, n)?)
            }
            5 => Value::Bytes(take(&mut bytes, 4)?),
            _ => return None,
        };
        found.push((key >> 3, value));
    }
    Some(found)
}

fn decode(bytes: &[u8]) -> Option<Event> {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).ok();
    let mut event = Event::default();
    for (number, value) in fields(bytes)? {
        match (number, value) {
            (1, Value::Bytes(b)) => event.wall_time = f64::from_le_bytes(*b.first_chunk()?),
            (2, Value::Whole(v)) => event.step = v.cast_signed(),
            (3, Value::Bytes(b)) => event.version = Some(text(b)?),
            (5, Value::Bytes(b)) => {
                for (_, value) in fields(b)? {
                    let Value::Bytes(b) = value else { continue };
                    let (mut tag, mut scalar) = (String::new(), None);
                    for (number, value) in fields(b)? {
                        match (number, value) {
                            (1, Value::Bytes(b)) => tag = text(b)?,
                            (2, Value::Bytes(b)) => scalar = Some(f32::from_le_bytes(*b.first_chunk()?)),
                            _ => {}
                        }
                    }
                    event.scalars.extend(scalar.map(|v| (tag, v)));
                }
            }
            (7, Value::Bytes(b)) => {
                event.start = fields(b)?.iter().any(|f| matches!(f, (1, Value::Whole(1))));
            }
            _ => {}
        }
    }
    Some(event)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_those_of_rfc_3720() {
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
    }

    #[test]
    fn what_is_written_is_read_with_its_checksums() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = Events::create(dir.path(), 1234.5, 7).unwrap();
        for step in [7, 300, 1 << 40] {
            events.scalar("train/loss", step, 2000.25, 0.125 * step as f64).unwrap();
        }
        let path = events.finish().unwrap();
        let name = path.file_name().unwrap().to_str().unwrap();
        assert!(name.starts_with("events.out.tfevents.0000001"), "{name}");
        let found = read(&path).unwrap();
        assert_eq!(found.len(), 5);
        assert_eq!(found[0].version.as_deref(), Some("brain.Event:2"));
        assert!(found[1].start && found[1].step == 7 && !found[2].start);
        let expected = Event {
            wall_time: 2000.25,
            step: 300,
            scalars: vec![("train/loss".to_owned(), 37.5)],
            ..Event::default()
        };
        assert_eq!(found[3], expected);
        assert_eq!(found[4].step, 1 << 40);

        // Every damaged byte of the records is found; a cut-off end is what a kill leaves.
        let whole = std::fs::read(&path).unwrap();
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x10;
            std::fs::write(&path, bytes).unwrap();
            assert!(read(&path).is_err(), "byte {at}");
        }
        std::fs::write(&path, &whole[..whole.len() - 3]).unwrap();
        assert_eq!(read(&path).unwrap().len(), 4);
    }

    #[test]
    fn files_of_one_second_do_not_replace_each_other() {
        let dir = tempfile::tempdir().unwrap();
        let a = Events::create(dir.path(), 9.0, 0).unwrap().finish().unwrap();
        let b = Events::create(dir.path(), 9.0, 5).unwrap().finish().unwrap();
        assert!(a < b);
        assert_eq!((read(&a).unwrap()[1].step, read(&b).unwrap()[1].step), (0, 5));
    }
}
