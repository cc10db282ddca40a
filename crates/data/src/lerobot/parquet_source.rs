//! The bytes of a Parquet file, and what was unpacked of it.

use bytes::Bytes;
use parquet::errors::ParquetError;
use parquet::file::reader::{ChunkReader, Length};
use std::fs::File;
use std::io::{BufReader, Read};
use std::sync::Arc;

/// The bytes of a file, read by their place: threads that share it do not move each other.
#[derive(Clone)]
pub(super) struct Source {
    pub(super) file: Arc<File>,
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
