//! When the frames of an MP4 file are shown, read from its tables: no frame is decoded for it.
//!
//! # Source
//! ISO/IEC 14496-12, sections 8.2 to 8.7 (boxes `moov`, `mdhd`, `elst`, `stts`, `ctts`, `stsz`, `stsc`, `stco`).

use crate::Result;
use crate::atomic::io;
use crate::file::{file_error, open_regular, unsupported};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Size of the tables of a file, bytes: a day of frames at 60 Hz takes less.
const LARGEST_TABLES: u64 = 1 << 28;
/// Frames of a file: three days at 60 Hz.
const MOST_FRAMES: usize = 1 << 24;

/// When the frames of the first video track are shown, s, ascending.
#[derive(Debug, PartialEq)]
pub(crate) struct Times(Vec<f64>);

/// What is wrong, in words; true where it is only not read here.
type Wrong = (bool, String);

fn damaged<T>(found: impl Into<String>) -> std::result::Result<T, Wrong> {
    Err((false, found.into()))
}

/// Big-endian numbers of a box, from front to back.
#[derive(Clone, Copy)]
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, n: usize) -> std::result::Result<&'a [u8], Wrong> {
        let Some((head, rest)) = self.0.split_at_checked(n) else {
            return damaged("a table that is cut off");
        };
        self.0 = rest;
        Ok(head)
    }

    fn u32(&mut self) -> std::result::Result<u32, Wrong> {
        Ok(self.take(4)?.iter().fold(0, |v, &b| v << 8 | u32::from(b)))
    }

    fn u64(&mut self) -> std::result::Result<u64, Wrong> {
        Ok(u64::from(self.u32()?) << 32 | u64::from(self.u32()?))
    }

    /// The version of a box, whose flags are passed over.
    fn version(&mut self) -> std::result::Result<u8, Wrong> {
        Ok(self.take(4)?[0])
    }

    /// The box of that name among those that follow each other here.
    fn find(mut self, name: &[u8; 4]) -> std::result::Result<Option<Self>, Wrong> {
        while !self.0.is_empty() {
            let (found, body) = self.next_box()?;
            if found == name {
                return Ok(Some(body));
            }
        }
        Ok(None)
    }

    fn need(self, name: &[u8; 4]) -> std::result::Result<Self, Wrong> {
        let missing = || (false, format!("no table `{}`", String::from_utf8_lossy(name)));
        self.find(name)?.ok_or_else(missing)
    }

    fn next_box(&mut self) -> std::result::Result<(&'a [u8], Self), Wrong> {
        let size = self.u32()?;
        let name = self.take(4)?;
        let size = match size {
            0 => self.0.len(),
            1 => usize::try_from(self.u64()?.saturating_sub(16)).unwrap_or(usize::MAX),
            n => (n as usize).checked_sub(8).ok_or((false, format!("a box of {n} bytes")))?,
        };
        Ok((name, Self(self.take(size)?)))
    }
}

impl Times {
    /// Reads the tables of a file.
    ///
    /// # Errors
    /// When the file is not there, is cut off, has no video or fewer bytes than its tables say; by another kind when it is a
    /// fragmented file, or no regular file.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let read = io("read", path);
        let mut file = open_regular(path)?;
        let length = file.metadata().map_err(&read)?.len();
        let whole = |found: String| file_error(path, "video", "a whole MP4 file", found);
        let mut at = 0;
        let mut tables = None;
        let mut fragments = false;
        while at < length {
            let mut head = [0; 16];
            let header = length.saturating_sub(at).min(16) as usize;
            file.seek(SeekFrom::Start(at)).map_err(&read)?;
            file.read_exact(&mut head[..header]).map_err(&read)?;
            let mut bytes = Bytes(&head[..header]);
            let cut = |_| whole(format!("{length} bytes, cut off"));
            let (size, name) = (bytes.u32().map_err(cut)?, bytes.take(4).map_err(cut)?.to_owned());
            let (skip, size) = match size {
                0 => (8, length - at),
                1 => (16, bytes.u64().map_err(cut)?),
                n => (8, n.into()),
            };
            if at == 0 && &name != b"ftyp" {
                return Err(whole("bytes that begin otherwise".to_owned()));
            }
            if size < skip || size > length - at {
                let name = String::from_utf8_lossy(&name).into_owned();
                return Err(whole(format!("{length} bytes, cut off in `{name}`")));
            }
            fragments |= &name == b"moof";
            if &name == b"moov" {
                if size > LARGEST_TABLES {
                    let most = format!("tables of at most {LARGEST_TABLES} bytes");
                    return Err(unsupported(path, "video", most, size.to_string()));
                }
                file.seek(SeekFrom::Start(at + skip)).map_err(&read)?;
                let mut bytes = vec![0; usize::try_from(size - skip).unwrap_or(0)];
                file.read_exact(&mut bytes).map_err(&read)?;
                tables = Some(bytes);
            }
            at += size;
        }
        let Some(tables) = tables else {
            return Err(whole(format!("{length} bytes without tables: it was never finished")));
        };
        if fragments {
            return Err(fragmented(path));
        }
        // Fragments may be to come where there are none yet.
        if Bytes(&tables).find(b"mvex").is_ok_and(|found| found.is_some()) {
            return Err(fragmented(path));
        }
        times(Bytes(&tables), length).map(Self).map_err(|(other, found)| {
            if other { unsupported(path, "video", "tables of one video", found) } else { whole(found) }
        })
    }

    /// Looks whether `count` frames from `from` on, s, are there, each nearer to its place than half a frame.
    ///
    /// # Errors
    /// Says which frame is missing or off the grid.
    pub(crate) fn check(&self, path: &Path, from: f64, count: usize, fps: f64) -> Result<()> {
        let half = 0.5 / fps;
        let first = self.0.partition_point(|&t| t <= from - half);
        for k in 0..count {
            let expected = from + k as f64 / fps;
            let what = || format!("video, frame {} of {count} from {from} s", k + 1);
            match self.0.get(first + k) {
                Some(found) if (found - expected).abs() < half => {}
                Some(found) => {
                    let expected = format!("one within half a frame of {expected:.4} s");
                    return Err(file_error(path, &what(), expected, format!("{found:.4} s")));
                }
                None => {
                    let found = format!("the end after {} frames in all", self.0.len());
                    return Err(file_error(path, &what(), format!("one at {expected:.4} s"), found));
                }
            }
        }
        Ok(())
    }
}

/// Its frames are in tables all over the file, which are not read here.
fn fragmented(path: &Path) -> crate::Error {
    let expected = "an MP4 file in one piece (`ffmpeg -i IN -c copy OUT` makes one)";
    unsupported(path, "video", expected, "a fragmented one")
}

/// The first video track's times; `length` is that of the file.
fn times(moov: Bytes, length: u64) -> std::result::Result<Vec<f64>, Wrong> {
    let clock = |mut header: Bytes| -> std::result::Result<f64, Wrong> {
        let skip = if header.version()? == 1 { 16 } else { 8 };
        header.take(skip)?;
        match header.u32()? {
            0 => damaged("a clock of 0 Hz"),
            hz => Ok(hz.into()),
        }
    };
    let whole_clock = clock(moov.need(b"mvhd")?)?;
    let mut boxes = moov;
    while !boxes.0.is_empty() {
        let (name, track) = boxes.next_box()?;
        if name != b"trak" {
            continue;
        }
        let media = track.need(b"mdia")?;
        let mut handler = media.need(b"hdlr")?;
        handler.take(8)?;
        if handler.take(4)? != b"vide" {
            continue;
        }
        let clock = clock(media.need(b"mdhd")?)?;
        let tables = media.need(b"minf")?.need(b"stbl")?;
        let sizes = sizes(tables, length)?;
        places(tables, &sizes, length)?;
        let shown = shown(tables, sizes.len())?;
        let edits = track.find(b"edts")?.map(|e| e.find(b"elst")).transpose()?.flatten();
        let (wait, skipped) = edits.map_or(Ok((0, 0)), edit)?;
        let offset = wait as f64 / whole_clock;
        let mut times: Vec<f64> = shown
            .iter()
            .map(|&t| t - skipped)
            .filter(|&t| t >= 0)
            .map(|t| t as f64 / clock + offset)
            .collect();
        times.sort_by(f64::total_cmp);
        return Ok(times);
    }
    damaged("no video")
}

/// Bytes of each frame.
fn sizes(tables: Bytes, length: u64) -> std::result::Result<Vec<u64>, Wrong> {
    let Some(mut table) = tables.find(b"stsz")? else { return Err((true, "no table `stsz`".to_owned())) };
    table.version()?;
    let (all, count) = (table.u32()?, table.u32()? as usize);
    if count > MOST_FRAMES {
        return Err((true, format!("{count} frames")));
    }
    if all > 0 {
        if u64::from(all) * count as u64 > length {
            return damaged(format!("{count} frames of {all} bytes in a file of {length}"));
        }
        return Ok(vec![all.into(); count]);
    }
    let mut table = Bytes(table.take(count * 4)?);
    (0..count).map(|_| table.u32().map(u64::from)).collect()
}

/// Looks whether every frame lies in the file.
fn places(tables: Bytes, sizes: &[u64], length: u64) -> std::result::Result<(), Wrong> {
    let mut runs = tables.need(b"stsc")?;
    runs.version()?;
    let count = runs.u32()? as usize;
    let mut runs = Bytes(runs.take(count.saturating_mul(12))?);
    let mut chunk_runs = Vec::with_capacity(count);
    for _ in 0..count {
        let (first, samples) = (runs.u32()?, runs.u32()?);
        runs.u32()?;
        chunk_runs.push((first as usize, samples as usize));
    }
    let (mut offsets, wide) = match tables.find(b"stco")? {
        Some(table) => (table, false),
        None => (tables.need(b"co64")?, true),
    };
    offsets.version()?;
    let chunks = offsets.u32()? as usize;
    let (mut next, mut run) = (0, 0);
    for chunk in 1..=chunks {
        let offset = if wide { offsets.u64()? } else { offsets.u32()?.into() };
        while chunk_runs.get(run + 1).is_some_and(|r| r.0 <= chunk) {
            run += 1;
        }
        let samples = chunk_runs.get(run).map_or(0, |r| r.1).min(sizes.len() - next);
        let bytes = sizes[next..next + samples].iter().fold(0_u64, |a, &b| a.saturating_add(b));
        if offset.saturating_add(bytes) > length {
            return damaged(format!("frames up to byte {} of {length}", offset.saturating_add(bytes)));
        }
        next += samples;
    }
    if next == sizes.len() { Ok(()) } else { damaged(format!("places of {next} of {} frames", sizes.len())) }
}

/// When each frame is shown, by the track's clock.
fn shown(tables: Bytes, frames: usize) -> std::result::Result<Vec<i64>, Wrong> {
    let runs = |mut table: Bytes| -> std::result::Result<Vec<i64>, Wrong> {
        table.version()?;
        let count = table.u32()?;
        let mut out: Vec<i64> = vec![];
        for _ in 0..count {
            let (n, value) = (table.u32()? as usize, table.u32()?);
            if n > frames - out.len() {
                return damaged(format!("times of more than {frames} frames"));
            }
            // Offsets of version 0 have no sign by the standard and one in practice; durations are far below that.
            out.extend(std::iter::repeat_n(i64::from(value.cast_signed()), n));
        }
        if out.len() == frames {
            Ok(out)
        } else {
            damaged(format!("times of {} of {frames} frames", out.len()))
        }
    };
    let mut at = 0;
    let mut shown: Vec<i64> = vec![];
    for duration in runs(tables.need(b"stts")?)? {
        shown.push(at);
        at += duration;
    }
    if let Some(offsets) = tables.find(b"ctts")? {
        for (time, offset) in shown.iter_mut().zip(runs(offsets)?) {
            *time += offset;
        }
    }
    Ok(shown)
}

/// How long nothing is shown (by the file's clock), and where in the track the video begins (by the track's).
fn edit(mut table: Bytes) -> std::result::Result<(i64, i64), Wrong> {
    let wide = table.version()? == 1;
    let mut wait = 0_i64;
    for _ in 0..table.u32()? {
        let (duration, start) = if wide {
            (table.u64()?.cast_signed(), table.u64()?.cast_signed())
        } else {
            (table.u32()?.into(), table.u32()?.cast_signed().into())
        };
        table.u32()?;
        if start >= 0 {
            return Ok((wait, start));
        }
        wait = wait.saturating_add(duration);
    }
    Ok((wait, 0))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    fn boxed(name: &[u8; 4], body: &[u8]) -> Vec<u8> {
        [&(body.len() as u32 + 8).to_be_bytes()[..], name, body].concat()
    }

    fn table(name: &[u8; 4], numbers: &[u32]) -> Vec<u8> {
        let body: Vec<u8> = numbers.iter().flat_map(|n| n.to_be_bytes()).collect();
        boxed(name, &body)
    }

    /// The same frames, in fragments: tables that say where they begin, and of each fragment its own.
    pub(crate) fn fragments(ticks: &[u32]) -> Vec<u8> {
        let whole = file(ticks);
        let (ftyp, rest) = whole.split_at(12);
        let (mdat, moov) = rest.split_at(8 + 500 * ticks.len());
        let trex = table(b"trex", &[0, 1, 1, 50, 500, 0]);
        let begun = boxed(b"moov", &[&moov[8..], &boxed(b"mvex", &trex)].concat());
        let moof = boxed(b"moof", &table(b"mfhd", &[0, 1]));
        [ftyp, &begun, &moof, mdat].concat()
    }

    /// An MP4 file of frames without contents, shown for `ticks` each at 1000 ticks a second.
    pub(crate) fn file(ticks: &[u32]) -> Vec<u8> {
        let n = ticks.len() as u32;
        let times: Vec<u32> = ticks.iter().flat_map(|&t| [1, t]).collect();
        let stts = table(b"stts", &[&[0, n][..], &times].concat());
        let stsz = table(b"stsz", &[0, 500, n]);
        let ftyp = boxed(b"ftyp", b"isom");
        let mdat = boxed(b"mdat", &vec![7; 500 * n as usize]);
        let stsc = table(b"stsc", &[0, 1, 1, n, 1]);
        let stco = table(b"stco", &[0, 1, ftyp.len() as u32 + 8]);
        let stbl = boxed(b"stbl", &[stts, stsz, stsc, stco].concat());
        let hdlr = boxed(b"hdlr", &[&[0; 8][..], b"vide", &[0; 12]].concat());
        let mdhd = table(b"mdhd", &[0, 0, 0, 1000, 0, 0]);
        let mdia = boxed(b"mdia", &[mdhd, hdlr, boxed(b"minf", &stbl)].concat());
        let mvhd = table(b"mvhd", &[0, 0, 0, 1000, 0]);
        let moov = boxed(b"moov", &[mvhd, boxed(b"trak", &mdia)].concat());
        [ftyp, mdat, moov].concat()
    }

    fn read(bytes: &[u8]) -> Result<Times> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        Times::read(file.path())
    }

    #[test]
    fn frames_are_counted_and_their_times_compared() {
        let times = read(&file(&[50; 40])).unwrap();
        assert_eq!((times.0.len(), times.0[3]), (40, 0.15));
        let path = Path::new("x.mp4");
        times.check(path, 0.0, 40, 20.0).unwrap();
        times.check(path, 0.5, 30, 20.0).unwrap();
        let short = times.check(path, 0.5, 31, 20.0).unwrap_err().to_string();
        assert!(short.contains("frame 31 of 31") && short.contains("after 40 frames in all"), "{short}");
        // 10 % too slow: half a frame is lost after five.
        let slow = read(&file(&[55; 40])).unwrap().check(path, 0.0, 40, 20.0).unwrap_err().to_string();
        assert!(slow.contains("frame 6 of 40"), "{slow}");
        let mut gap = [50; 40];
        gap[9] = 100;
        let gap = read(&file(&gap)).unwrap().check(path, 0.0, 40, 20.0).unwrap_err().to_string();
        assert!(gap.contains("frame 11 of 40") && gap.contains("found 0.5500 s"), "{gap}");
    }

    #[test]
    fn files_that_are_cut_off_are_damaged_at_every_length() {
        let whole = file(&[50; 40]);
        for length in 0..whole.len() {
            let error = read(&whole[..length]).unwrap_err();
            assert!(!error.is_unsupported(), "{length}: {error}");
        }
        let lies = [&whole[..12], &whole[12 + 8 + 500 * 40..]].concat();
        assert!(read(&lies).unwrap_err().to_string().contains("frames of 500 bytes"), "no frames in it");
    }

    #[test]
    fn files_in_fragments_are_not_damaged() {
        let whole = fragments(&[50; 40]);
        let begun = &whole[..whole.len() - 500 * 40 - 8 - 24]; // nothing but what fragments need
        // Old tools leave out what announces them.
        let mut silent = whole.clone();
        let at = silent.windows(4).position(|w| w == b"mvex").unwrap();
        silent[at..at + 4].copy_from_slice(b"free");
        for bytes in [&whole[..], begun, &silent] {
            let error = read(bytes).unwrap_err();
            assert!(
                error.is_unsupported() && error.to_string().contains("found a fragmented one"),
                "{error}"
            );
        }
        assert!(!read(&whole[..whole.len() - 1]).unwrap_err().is_unsupported(), "cut off");
    }

    #[test]
    fn edits_and_offsets_move_the_times() {
        let elst = table(b"elst", &[0, 2, 500, u32::MAX, 0, 1000, 100, 0]);
        assert_eq!(edit(Bytes(&elst[8..])).unwrap(), (500, 100));
        let tables = [table(b"stts", &[0, 1, 3, 50]), table(b"ctts", &[0, 2, 1, 100, 2, 50])].concat();
        assert_eq!(shown(Bytes(&tables), 3).unwrap(), [100, 100, 150]);
    }
}
