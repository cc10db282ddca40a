//! One self-contained page of a dataset or a run: every episode with its animation, its numbers over time, and what became
//! of its frames.
//!
//! The page needs nothing besides itself, reads without JavaScript, and with it filters, sorts and plays in step with the
//! plots. It is a pure function of the folder and of [`Options`].

mod dataset;
mod entry;
mod film;
mod page;
mod panel;
mod plot;
mod recording;
mod run;
pub mod scalars;

use crate::{Error, Result};
use e2h_data::lerobot::ColumnSlice;
use recording::Recording;
use std::path::{Path, PathBuf};

/// Name of the page in a folder.
pub const VIEW_FILE: &str = "view.html";

/// How much goes onto a page.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Most episodes shown; of more, as many evenly spread ones.
    pub episodes: usize,
    /// Rows from one picture of an animation to the next; by default what keeps the page below its size.
    pub stride: Option<usize>,
    /// Size of the page, MB. Pictures that do not fit are left out, and the page says so.
    pub megabytes: f64,
    /// Where a dataset keeps the position of the tool, m: its speed is drawn. By default the columns that this project names so.
    pub position: Option<ColumnSlice>,
}

impl Default for Options {
    fn default() -> Self {
        Self { episodes: 200, stride: None, megabytes: 20.0, position: None }
    }
}

/// What a page came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Written {
    /// The page.
    pub path: PathBuf,
    /// Its size, bytes.
    pub bytes: usize,
    /// Episodes in the folder.
    pub episodes: usize,
    /// Episodes on the page.
    pub shown: usize,
    /// What was left out, in sentences; also on the page.
    pub left_out: Vec<String>,
}

/// An episode before it is read.
#[derive(Debug, Clone)]
struct Listed {
    /// What it is called on the page.
    name: String,
    rows: usize,
}

/// Where episodes come from.
enum Source {
    Dataset(Box<dataset::DatasetSource>),
    Run(Box<run::RunSource>),
}

impl Source {
    fn open(dir: &Path, options: &Options) -> Result<Self> {
        if dir.join("meta/info.json").exists() {
            return Ok(Self::Dataset(Box::new(dataset::DatasetSource::open(dir, options)?)));
        }
        if dir.join("run.json").exists() {
            return Ok(Self::Run(Box::new(run::RunSource::open(dir)?)));
        }
        Err(Error::Foreign {
            path: dir.to_owned(),
            quantity: "folder".to_owned(),
            expected: "a LeRobotDataset v3.0 (meta/info.json) or a run (run.json)".to_owned(),
            found: if dir.is_dir() { "neither file" } else { "no such folder" }.to_owned(),
        })
    }

    fn listed(&self) -> &[Listed] {
        match self {
            Self::Dataset(d) => &d.listed,
            Self::Run(r) => &r.listed,
        }
    }

    fn read(&self, index: usize) -> Result<Recording> {
        match self {
            Self::Dataset(d) => d.read(index, true),
            Self::Run(r) => r.read(index),
        }
    }

    fn head(&self) -> page::Head {
        match self {
            Self::Dataset(d) => d.head(),
            Self::Run(r) => r.head(),
        }
    }
}

/// Writes the page of `dir`, a LeRobotDataset v3.0 or a run directory, to `out`. An episode that cannot be read has its
/// reason where its plots would be.
///
/// # Errors
/// When `dir` is neither, cannot be opened as a whole, or `out` cannot be written; an older page stays whole.
pub fn write(dir: &Path, out: &Path, options: &Options) -> Result<Written> {
    let (html, mut written) = html(dir, options)?;
    out.clone_into(&mut written.path);
    e2h_data::write_atomic(out, html.as_bytes())?;
    Ok(written)
}

fn html(dir: &Path, options: &Options) -> Result<(String, Written)> {
    let problem = |text: String| Err(Error::Options(text));
    if options.episodes == 0 || options.stride == Some(0) {
        return problem("episodes and stride: expected at least 1, got 0".to_owned());
    }
    if !(options.megabytes.is_finite() && options.megabytes > 0.0) {
        return problem(format!(
            "size of the page: expected a positive number of MB, got {}",
            options.megabytes
        ));
    }
    let source = Source::open(dir, options)?;
    let all = source.listed();
    let chosen = spread(all.len(), options.episodes);
    let mut left_out = vec![];
    if chosen.len() < all.len() {
        left_out.push(format!(
            "{} of {} episodes are shown, evenly spread; --episodes {} shows all.",
            chosen.len(),
            all.len(),
            all.len()
        ));
    }
    let rows: usize = chosen.iter().map(|&i| all[i].rows).sum();
    let points = entry::points(&source, &chosen, options.megabytes);
    let mut films = film::Films::plan(&source, &chosen, rows, options);
    let mut entries = entry::Entries::new(points);
    for &index in &chosen {
        match source.read(index) {
            Ok(recording) => {
                let film = films.make(&recording, entries.html.len());
                entries.episode(index, &recording, film);
            }
            Err(e) => entries.unreadable(index, &all[index].name, &e.to_string()),
        }
    }
    left_out.extend(films.left_out());
    left_out.extend(entries.left_out());
    let html = page::html(&source.head(), all.len(), &entries, &left_out);
    let written = Written {
        path: PathBuf::new(),
        bytes: html.len(),
        episodes: all.len(),
        shown: chosen.len(),
        left_out,
    };
    Ok((html, written))
}

/// `wanted` of `count` indices, from the first to the last, evenly spread; all of them where there are no more.
fn spread(count: usize, wanted: usize) -> Vec<usize> {
    if count <= wanted {
        return (0..count).collect();
    }
    (0..wanted).map(|i| i * (count - 1) / (wanted - 1).max(1)).collect()
}

/// Writes what is known of `dir` as TensorBoard event files into `out`: success, losses and refinement by iteration for a
/// run, and length and success by episode for a dataset. `wall_time` is when it was made, s since 1970.
///
/// # Errors
/// As [`write()`]; also when an episode cannot be read.
pub fn write_scalars(dir: &Path, out: &Path, wall_time: f64) -> Result<usize> {
    match Source::open(dir, &Options::default())? {
        Source::Dataset(d) => scalars::dataset(&d, out, wall_time),
        Source::Run(r) => scalars::run(&r, out, wall_time),
    }
}
