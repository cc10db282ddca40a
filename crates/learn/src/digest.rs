//! What a dataset from elsewhere is recognised by.

use crate::Result;
use crate::directory::io;
use e2h_report::folder::sha256;
use std::path::{Path, PathBuf};

/// Folders whose files are the dataset; what lies beside them may change.
const FOLDERS: [&str; 3] = ["meta", "data", "videos"];

/// SHA-256 of the names and the contents of all files of a dataset.
pub(crate) fn of_dataset(root: &Path) -> Result<String> {
    let (mut folders, mut files) = (FOLDERS.map(PathBuf::from).to_vec(), vec![]);
    while let Some(folder) = folders.pop() {
        let place = root.join(&folder);
        if !place.is_dir() {
            continue;
        }
        for entry in std::fs::read_dir(&place).map_err(io("reading", &place))?.flatten() {
            let name = folder.join(entry.file_name());
            // On its way to its place, and not yet part of anything.
            let unfinished = entry.file_name().to_string_lossy().starts_with(".new-");
            if entry.path().is_dir() {
                folders.push(name);
            } else if !unfinished {
                files.push(name);
            }
        }
    }
    files.sort();
    let mut list = String::new();
    for name in files {
        let path = root.join(&name);
        let bytes = e2h_data::read_file(&path, e2h_data::MOST_WEIGHTS).map_err(io("reading", &path))?;
        list += &format!("{} {}\n", sha256(&bytes), name.display());
    }
    Ok(sha256(list.as_bytes()))
}
