//! The Rust side of `tests/interop/run.sh`: writes datasets for LeRobot to open, and prints what it reads of any dataset.
//!
//! ```text
//! cargo run --release -p e2h-data --example interop -- write DIR
//! cargo run --release -p e2h-data --example interop -- append DIR
//! cargo run --release -p e2h-data --example interop -- dump DIR
//! cargo run --release -p e2h-data --example interop -- images DIR OUT
//! ```

use anyhow::{Context, Result};
use clap::Parser;
use e2h_core::{Direction, Episode, Frames, Observation, Origin, Outcome, say};
use e2h_data::lerobot::{Column, Dataset, Writer, features_of};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

/// Rows of the episodes that `write` makes: one that is sampled, short ones, a single row.
const ROWS: [usize; 5] = [130, 7, 1, 12, 30];

/// Our side of the checks against LeRobot.
#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release -p e2h-data --example interop -- dump DIR")]
enum Arguments {
    /// Writes a dataset of our episodes.
    Write { dir: String },
    /// Appends an episode to a dataset.
    Append { dir: String },
    /// Prints what is read of a dataset, as JSON.
    Dump { dir: String },
    /// Writes the pixels of a dataset's images to a file.
    Images { dir: String, out: String },
}

fn main() -> Result<()> {
    match Arguments::parse() {
        Arguments::Write { dir } => write(&dir),
        Arguments::Append { dir } => append(&dir),
        Arguments::Dump { dir } => dump(&dir),
        Arguments::Images { dir, out } => images(&dir, &out),
    }
}

/// Two cameras, one of them large enough for LeRobot to look at a part of its pixels.
fn episode(index: usize, rows: usize) -> Result<Episode> {
    let direction = if index.is_multiple_of(2) { Direction::Easy } else { Direction::Hard };
    let mut e =
        Episode::new(Origin::demonstration("put the nut on", direction, index as u32, u64::MAX - 7), &[]);
    for t in 0..rows {
        let x = t as f32 * 0.37 + index as f32;
        let state = std::array::from_fn(|i| (x + i as f32).sin() * (i + 1) as f32);
        let action = std::array::from_fn(|i| (x * 1.7 - i as f32).cos());
        e.push(&Observation { state, frames: vec![] }, &action)?;
    }
    for (camera, height, width) in [("table", 48, 64), ("wrist", 240, 320)] {
        let pixel = |i: usize| (i * 31 + (i / 3 % width) * 5 + index * 17) as u8;
        let bytes: Vec<u8> = (0..rows * height * width * 3).map(pixel).collect();
        e.frames.push(Frames::new(camera, height, width, &bytes));
    }
    e.origin.reversed = index == 3;
    e.outcome = if index == 1 { Outcome::Timeout } else { Outcome::Success { at: rows - 1 } };
    Ok(e)
}

fn write(dir: &str) -> Result<()> {
    let mut writer = Writer::create(dir, 20.0, Some("mujoco_panda"), features_of(&episode(0, 1)?))?;
    for (i, &rows) in ROWS.iter().enumerate() {
        let mut e = episode(i, rows)?;
        if i == 1 {
            e.origin.task = "take the nut off".to_owned();
        }
        writer.push_episode(&e)?;
        if i == 2 {
            writer.commit()?;
        }
    }
    let info = writer.finish()?;
    Ok(say(format_args!("wrote {} episodes, {} frames", info.total_episodes, info.total_frames))?)
}

/// The first episode again, whatever the columns are.
fn append(dir: &str) -> Result<()> {
    let dataset = Dataset::open(dir)?;
    let own: Vec<String> = dataset.info().own_features().into_iter().map(|(n, _)| n).collect();
    let own: Vec<&str> = own.iter().map(String::as_str).collect();
    let table = dataset.read_columns(0, &own)?;
    let mut writer = Writer::append(dir)?;
    writer.push(&table, "once more")?;
    let info = writer.finish()?;
    Ok(say(format_args!("appended: {} episodes, {} frames", info.total_episodes, info.total_frames))?)
}

/// Every number, and the SHA-256 of every image's pixels, one JSON line per episode.
fn dump(dir: &str) -> Result<()> {
    let dataset = Dataset::open(dir)?;
    for i in 0..dataset.len() {
        let table = dataset.read(i)?;
        let mut columns = serde_json::Map::new();
        for (name, column) in &table.columns {
            let value: Value = match column {
                Column::Png(files) => files.iter().map(|f| pixels(f)).collect::<Result<Vec<_>>>()?.into(),
                Column::Text(v) => v.clone().into(),
                Column::I64(v) => v.clone().into(),
                Column::Bool(v) => v.clone().into(),
                other => other.numbers().context("numbers")?.into(),
            };
            columns.insert(name.clone(), value);
        }
        let line =
            json!({"episode": i, "rows": table.rows, "tasks": dataset.row_tasks(i)?, "columns": columns});
        say(line)?;
    }
    Ok(())
}

/// The first camera's frames as files, a folder per episode.
fn images(dir: &str, out: &str) -> Result<()> {
    let dataset = Dataset::open(dir)?;
    let camera = dataset.info().features.iter().find(|(_, f)| f.is_visual()).context("a camera")?.0.clone();
    for i in 0..dataset.len() {
        let folder = std::path::Path::new(out).join(format!("{i:03}"));
        std::fs::create_dir_all(&folder)?;
        for (t, file) in dataset.read_columns(i, &[&camera])?.png(&camera)?.iter().enumerate() {
            std::fs::write(folder.join(format!("{t:05}.png")), file)?;
        }
    }
    Ok(())
}

fn pixels(file: &[u8]) -> Result<String> {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(file));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info()?;
    let mut data = vec![0; reader.output_buffer_size().context("a size")?];
    let frame = reader.next_frame(&mut data)?;
    data.truncate(frame.buffer_size());
    Ok(Sha256::digest(&data).iter().map(|b| format!("{b:02x}")).collect())
}
