use crate::{Error, Result};
use std::borrow::Cow;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// A file without a name that holds images which need not be in memory. It is gone with the last [`Pixels`] that lie in it, and
/// with the process however that ends.
///
/// What is read often stays in the system's cache as long as nobody else wants the memory.
#[derive(Clone)]
pub struct ImageStore(Arc<Inner>);

struct Inner {
    folder: PathBuf,
    /// The file, and where the next image goes.
    file: Mutex<(File, u64)>,
}

impl ImageStore {
    /// An empty store on the disk of `folder`.
    ///
    /// # Errors
    /// When no file can be made there.
    pub fn create(folder: &Path) -> Result<Self> {
        let file = tempfile::tempfile_in(folder).map_err(|source| Error::Store {
            doing: "creating",
            folder: folder.to_owned(),
            source,
        })?;
        Ok(Self(Arc::new(Inner { folder: folder.to_owned(), file: Mutex::new((file, 0)) })))
    }

    /// The same images here, written in one go; those that lie here already are not written again.
    ///
    /// # Errors
    /// When one cannot be read, or they cannot be written, for want of space for instance; the store stays as it was.
    pub fn take<'a>(&self, images: impl IntoIterator<Item = &'a Pixels>) -> Result<Vec<Pixels>> {
        let here = |p: &Pixels| matches!(&p.0, Place::Stored { store, .. } if Arc::ptr_eq(&store.0, &self.0));
        // Read before this store is locked: two stores may take from each other.
        let images: Vec<&Pixels> = images.into_iter().collect();
        let mut bytes = vec![];
        for image in images.iter().filter(|p| !here(p)) {
            bytes.extend_from_slice(&image.read()?);
        }
        let mut guard = self.0.file.lock().unwrap_or_else(PoisonError::into_inner);
        let (file, end) = &mut *guard;
        let mut next = *end;
        let mut place = |image: &Pixels| {
            if here(image) {
                return image.clone();
            }
            let (at, len) = (next, image.len());
            next += len as u64;
            Pixels(Place::Stored { store: self.clone(), at, len })
        };
        let taken = images.into_iter().map(&mut place).collect();
        file.seek(SeekFrom::Start(*end))
            .and_then(|_| file.write_all(&bytes))
            .map_err(|e| self.error("writing", e))?;
        *end += bytes.len() as u64;
        Ok(taken)
    }

    /// Bytes of all images that were written.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.0.file.lock().unwrap_or_else(PoisonError::into_inner).1
    }

    fn get(&self, at: u64, len: usize) -> Result<Vec<u8>> {
        let mut bytes = vec![0; len];
        let mut guard = self.0.file.lock().unwrap_or_else(PoisonError::into_inner);
        let file = &mut guard.0;
        file.seek(SeekFrom::Start(at))
            .and_then(|_| file.read_exact(&mut bytes))
            .map_err(|e| self.error("reading", e))?;
        Ok(bytes)
    }

    fn error(&self, doing: &'static str, source: std::io::Error) -> Error {
        Error::Store { doing, folder: self.0.folder.clone(), source }
    }
}

impl std::fmt::Debug for ImageStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ImageStore({} bytes in {})", self.bytes(), self.0.folder.display())
    }
}

/// The bytes of one image, in memory or in an [`ImageStore`]. A clone shares them.
#[derive(Clone)]
pub struct Pixels(Place);

#[derive(Clone)]
enum Place {
    Memory(Arc<[u8]>),
    Stored { store: ImageStore, at: u64, len: usize },
}

impl Pixels {
    /// The bytes: borrowed where they are in memory, read where they are not.
    ///
    /// # Errors
    /// When the store cannot be read.
    pub fn read(&self) -> Result<Cow<'_, [u8]>> {
        match &self.0 {
            Place::Memory(bytes) => Ok(Cow::Borrowed(bytes)),
            Place::Stored { store, at, len } => store.get(*at, *len).map(Cow::Owned),
        }
    }

    /// How many bytes.
    #[must_use]
    pub fn len(&self) -> usize {
        match &self.0 {
            Place::Memory(bytes) => bytes.len(),
            Place::Stored { len, .. } => *len,
        }
    }

    /// True without bytes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// True where the bytes are in memory.
    #[must_use]
    pub fn in_memory(&self) -> bool {
        matches!(self.0, Place::Memory(_))
    }
}

impl From<&[u8]> for Pixels {
    fn from(bytes: &[u8]) -> Self {
        Self(Place::Memory(bytes.into()))
    }
}

impl From<Vec<u8>> for Pixels {
    fn from(bytes: Vec<u8>) -> Self {
        Self(Place::Memory(bytes.into()))
    }
}

/// By their bytes, wherever they lie; what cannot be read equals nothing.
impl PartialEq for Pixels {
    fn eq(&self, other: &Self) -> bool {
        self.len() == other.len() && matches!((self.read(), other.read()), (Ok(a), Ok(b)) if a == b)
    }
}

impl std::fmt::Debug for Pixels {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Pixels({} bytes, {})", self.len(), if self.in_memory() { "in memory" } else { "stored" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_stored_is_read_again_also_after_the_store_was_let_go() {
        let folder = tempfile::tempdir().unwrap();
        let store = ImageStore::create(folder.path()).unwrap();
        let memory: Vec<Pixels> = (0u8..5).map(|n| vec![n; 7 + usize::from(n)].into()).collect();
        let stored = store.take(&memory).unwrap();
        assert_eq!(store.bytes(), 45);
        assert!(stored.iter().all(|p| !p.in_memory()) && memory.iter().all(Pixels::in_memory));
        let again = store.take([&stored[3], &memory[1]]).unwrap();
        assert_eq!(store.bytes(), 45 + 8, "what lies there is not written twice");
        drop(store);
        assert_eq!(stored, memory);
        assert_eq!((&*again[0].read().unwrap(), &*again[1].read().unwrap()), (&[3; 10][..], &[1; 8][..]));
        assert_ne!(stored[0], memory[1]);
        let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
        assert!(left.is_empty(), "the file has no name: {left:?}");
    }

    #[test]
    fn images_move_from_one_store_to_another() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b] = [0; 2].map(|_| ImageStore::create(folder.path()).unwrap());
        let there = a.take(&[vec![9; 4].into(), vec![1, 2, 3].into()]).unwrap();
        let there = b.take(&there[1..]).unwrap();
        drop(a);
        assert_eq!((b.bytes(), &*there[0].read().unwrap()), (3, &[1u8, 2, 3][..]));
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let message = ImageStore::create(Path::new("/no/such/folder")).unwrap_err().to_string();
        assert!(message.contains("/no/such/folder") && message.contains("images"), "{message}");
    }
}
