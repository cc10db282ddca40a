use super::*;
use crate::atomic::fuse;
use crate::fixture::episode;
use e2h_core::{Direction, Episode, Frames, Kind, Outcome};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

mod check;
mod hostile;

fn faults(root: &Path) -> Vec<String> {
    check(root).unwrap().faults.into_iter().map(|f| f.message).collect()
}

fn data_file(root: &Path, n: usize) -> PathBuf {
    root.join(format!("data/chunk-000/file-{n:03}.parquet"))
}

/// Five episodes in three data files: 0 and 1, 2 and 3, 4.
fn three_files(root: &Path) {
    let mut writer = written(root, 2);
    for n in 2..5 {
        if n != 3 {
            writer.commit().unwrap();
        }
        writer.push_episode(&numbered(n)).unwrap();
    }
    writer.finish().unwrap();
}

const FILES: [&str; 5] = [
    "data/chunk-000/file-000.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    "meta/tasks.parquet",
    "meta/info.json",
    "meta/stats.json",
];

fn place() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("set");
    (folder, root)
}

/// An episode that differs from others in every column.
fn numbered(n: usize) -> Episode {
    let mut e = episode(3 + n);
    e.origin.episode = n as u32;
    e.state[0][0] = -(n as f32);
    let mut bytes = e.frames[0].image(0).unwrap().into_owned();
    bytes[0] = n as u8;
    e.frames[0].images[0] = bytes.into();
    e
}

fn written(root: &Path, episodes: usize) -> Writer {
    let mut writer = Writer::create(root, 20.0, Some("arm"), features_of(&numbered(0))).unwrap();
    for n in 0..episodes {
        writer.push_episode(&numbered(n)).unwrap();
    }
    writer
}

/// The dataset holds exactly the first `count` numbered episodes.
fn assert_holds(root: &Path, count: usize) {
    let dataset = Dataset::open(root).unwrap();
    assert_eq!(dataset.len(), count);
    for n in 0..count {
        assert_eq!(dataset.read_episode(n).unwrap(), numbered(n));
    }
}

#[test]
fn a_generic_table_comes_back_column_by_column() {
    let (_folder, root) = place();
    let own = vec![
        ("text".to_owned(), Feature::scalar(Dtype::String)),
        ("matrix".to_owned(), Feature { shape: vec![2, 3], ..Feature::scalar(Dtype::Float64) }),
        ("small".to_owned(), Feature { shape: vec![2], ..Feature::scalar(Dtype::Int8) }),
        ("byte".to_owned(), Feature::scalar(Dtype::UInt8)),
        ("camera".to_owned(), Feature::image(2, 3)),
    ];
    let png = |v: u8| encode_png(2, 3, &[v; 18]).unwrap();
    let table = Table {
        rows: 2,
        columns: vec![
            ("text".to_owned(), Column::Text(vec!["a".to_owned(), String::new()])),
            ("matrix".to_owned(), Column::F64((0..12).map(f64::from).collect())),
            ("small".to_owned(), Column::I64(vec![-128, 127, 0, 1])),
            ("byte".to_owned(), Column::I64(vec![255, 0])),
            ("camera".to_owned(), Column::Png(vec![png(1), png(2)])),
        ],
    };
    let mut writer = Writer::create(&root, 30.0, None, own).unwrap();
    writer.push(&table, "first").unwrap();
    writer.push(&table, "second").unwrap();
    writer.finish().unwrap();
    let dataset = Dataset::open(&root).unwrap();
    let read = dataset.read(1).unwrap();
    for (name, column) in &table.columns {
        assert_eq!(read.column(name), Some(column), "{name}");
    }
    assert_eq!(read.f32("timestamp").unwrap(), [0.0, 1.0_f32 / 30.0]);
    assert_eq!(read.i64("index").unwrap(), [2, 3]);
    assert_eq!(read.i64("frame_index").unwrap(), [0, 1]);
    assert_eq!(dataset.row_tasks(1).unwrap(), ["second", "second"]);
    assert_eq!(dataset.episodes()[1].tasks, ["second"]);
    let one = dataset.read_columns(0, &["byte"]).unwrap();
    assert_eq!(one.columns, [("byte".to_owned(), Column::I64(vec![255, 0]))]);
    assert!(dataset.read_columns(0, &["bite"]).unwrap_err().to_string().contains("bite"));
    assert!(dataset.read(2).is_err());
}

#[test]
fn many_commits_read_as_one_dataset() {
    let (_folder, root) = place();
    let mut writer = written(&root, 2);
    writer.commit().unwrap();
    writer.push_episode(&numbered(2)).unwrap();
    writer.finish().unwrap();
    let mut writer = Writer::append(&root).unwrap();
    writer.push_episode(&numbered(3)).unwrap();
    let info = writer.finish().unwrap();
    assert_eq!((info.total_episodes, info.total_frames, info.total_tasks), (4, 18, 1));
    assert_eq!(info.splits["train"], "0:4");
    assert_holds(&root, 4);

    // The statistics are those of all rows at once.
    let (_folder, other) = place();
    written(&other, 4).finish().unwrap();
    let stats = |root: &Path| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(root.join("meta/stats.json")).unwrap()).unwrap()
    };
    assert_eq!(stats(&root)["observation.state"], stats(&other)["observation.state"]);
    assert_eq!(stats(&root)["index"]["max"][0], 17);
    assert_eq!(stats(&root)["observation.images.wrist"]["count"][0], 18);
    assert_eq!(stats(&root)["next.success"]["max"][0], true);
}

#[test]
fn a_full_file_is_committed_by_itself() {
    let (_folder, root) = place();
    let mut writer = written(&root, 0);
    writer.commit().unwrap();
    let mut e = numbered(0);
    // Noise does not compress: this is more than a file's worth of it.
    let side = 700;
    e.frames.truncate(1);
    let mut x = 1_u32;
    let mut noise = || {
        x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (x >> 24) as u8
    };
    let bytes: Vec<u8> = (0..e.len() * side * side * 3).map(|_| noise()).collect();
    e.frames[0] = Frames::new(&e.frames[0].camera, side, side, &bytes);
    let mut writer = Writer::create(root.with_extension("big"), 20.0, None, features_of(&e)).unwrap();
    for _ in 0..25 {
        writer.push_episode(&e).unwrap();
    }
    let first = Dataset::open(root.with_extension("big")).unwrap();
    assert!((20..25).contains(&first.len()), "{}", first.len());
    writer.finish().unwrap();
    let dataset = Dataset::open(root.with_extension("big")).unwrap();
    assert_eq!(dataset.len(), 25);
    assert_eq!(dataset.episodes()[24].file, (0, 1));
    assert_eq!(dataset.read_episode(24).unwrap(), e);
}

#[test]
fn a_writer_killed_between_any_two_files_leaves_whole_episodes() {
    // Five files a commit: rows, places, tasks, statistics, info.
    for killed_after in 0..5 {
        let (_folder, root) = place();
        let mut writer = written(&root, 2);
        fuse::set(Some(killed_after));
        writer.commit().unwrap_err();
        fuse::set(None);
        drop(writer);
        assert!(Dataset::open(&root).is_err(), "nothing yet");

        written(&root, 2).finish().unwrap();
        let mut writer = Writer::append(&root).unwrap();
        writer.push_episode(&numbered(2)).unwrap();
        fuse::set(Some(killed_after));
        writer.commit().unwrap_err();
        fuse::set(None);
        drop(writer);
        assert_holds(&root, 2);

        // Whoever goes on ends with the same dataset as without the kill.
        let mut writer = Writer::append(&root).unwrap();
        writer.push_episode(&numbered(2)).unwrap();
        writer.finish().unwrap();
        assert_holds(&root, 3);
        let (_folder, other) = place();
        written(&other, 2).finish().unwrap();
        let mut writer = Writer::append(&other).unwrap();
        writer.push_episode(&numbered(2)).unwrap();
        writer.finish().unwrap();
        for file in
            ["meta/stats.json", "meta/info.json", "meta/tasks.parquet", "data/chunk-000/file-001.parquet"]
        {
            let bytes = |root: &Path| std::fs::read(root.join(file)).unwrap();
            assert!(bytes(&root) == bytes(&other), "{file} after {killed_after}");
        }
    }
}

#[test]
fn unfinished_files_are_no_part_of_a_dataset_and_are_cleared_away() {
    let (_folder, root) = place();
    written(&root, 2).finish().unwrap();
    let left = root.join("data/chunk-000/.new-abc");
    std::fs::write(&left, b"half").unwrap();
    assert_holds(&root, 2);
    drop(Writer::append(&root).unwrap());
    assert!(!left.exists());
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let (_folder, root) = place();
    let mut writer = written(&root, 1);
    let good = to_table(&numbered(1), &[]).unwrap();
    let message = |writer: &mut Writer, change: &dyn Fn(&mut Table)| {
        let mut table = good.clone();
        change(&mut table);
        writer.push(&table, "t").unwrap_err().to_string()
    };
    let action = |t: &Table| t.columns.iter().position(|(n, _)| n == "action").unwrap();
    let short = message(&mut writer, &|t| drop(t.columns.remove(action(t))));
    assert_eq!(short, "column `action`: expected float32 [8], found none");
    let nan = message(&mut writer, &|t| {
        let i = action(t);
        if let Column::F32(v) = &mut t.columns[i].1 {
            v[11] = f32::NAN;
        }
    });
    assert!(nan.contains("column `action`") && nan.contains("row 1, entry 3"), "{nan}");
    let other = message(&mut writer, &|t| {
        let i = action(t);
        t.columns[i].1 = Column::Bool(vec![true; 32]);
    });
    assert!(other.contains("found bool"), "{other}");
    let more = message(&mut writer, &|t| t.columns.push(("x".into(), Column::Bool(vec![]))));
    assert!(more.contains("`x`"), "{more}");
    let empty = message(&mut writer, &|t| t.rows = 0);
    assert!(empty.contains("at least one row"), "{empty}");
    let image = message(&mut writer, &|t| {
        if let Column::Png(v) = &mut t.columns[1].1 {
            v[2] = b"jpeg".to_vec();
        }
    });
    assert!(image.contains("observation.images.wrist") && image.contains("row 2"), "{image}");
    // The writer goes on after each of them.
    writer.push_episode(&numbered(1)).unwrap();
    writer.finish().unwrap();
    assert_holds(&root, 2);
    assert!(Writer::create(&root, 20.0, None, vec![]).unwrap_err().to_string().contains("info.json"));
}

#[test]
fn threads_read_a_dataset_side_by_side() {
    let (_folder, root) = place();
    written(&root, 12).finish().unwrap();
    let dataset = Dataset::open(&root).unwrap();
    std::thread::scope(|scope| {
        for first in 0..4 {
            let dataset = &dataset;
            scope.spawn(move || {
                for n in (0..12).cycle().skip(first * 3).take(60) {
                    assert_eq!(dataset.read_episode(n).unwrap(), numbered(n));
                }
            });
        }
    });
}

#[test]
fn fates_and_tables_of_others() {
    let e = numbered(2);
    let table = to_table(&e, &[0, 2, 0, 1, 0]).unwrap();
    let (back, fates) = from_table(&table, &features_of(&e), "test").unwrap();
    assert_eq!((back, fates), (e.clone(), vec![0, 2, 0, 1, 0]));
    let mut other = table.clone();
    other.columns.retain(|(n, _)| n != "source.seed");
    let message = from_table(&other, &features_of(&e), "test").unwrap_err().to_string();
    assert!(message.contains("source.seed"), "{message}");
    let mut other = table;
    for (name, column) in &mut other.columns {
        if name == "source.outcome" {
            *column = Column::I64(vec![9; 5]);
        }
    }
    let message = from_table(&other, &features_of(&e), "test").unwrap_err().to_string();
    assert_eq!(message, "column `source.outcome`: expected below 4, found 9");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn episodes_survive_with_all_their_provenance(
        numbers in prop::collection::vec(-1e30_f32..1e30, 1..12), terminal: bool, reversed: bool, seed: u64,
        task in ".{0,12}", kind in 0_usize..3, outcome in 0_usize..4, iteration: u32, cameras: bool,
    ) {
        let (_folder, root) = place();
        let mut e = episode(numbers.len());
        for (t, v) in numbers.iter().enumerate() {
            (e.state[t][14], e.action[t][0], e.source[t]) = (*v, -v, u32::MAX - t as u32);
        }
        if !cameras {
            e.frames.clear();
        }
        e.terminal = terminal;
        e.outcome = [Outcome::Success { at: 7 }, Outcome::Timeout, Outcome::Dropped, Outcome::Diverged][outcome];
        e.origin.kind = [Kind::Demonstration, Kind::Rollout, Kind::Refined][kind];
        e.origin.direction = if reversed { Direction::Hard } else { Direction::Easy };
        (e.origin.reversed, e.origin.seed, e.origin.iteration, e.origin.task) = (reversed, seed, iteration, task);
        let mut writer = Writer::create(&root, 20.0, None, features_of(&e)).unwrap();
        writer.push_episode(&e).unwrap();
        writer.finish().unwrap();
        prop_assert_eq!(Dataset::open(&root).unwrap().read_episode(0).unwrap(), e);
    }
}

/// What LeRobot 0.4.4 wrote by the formula of `tests/golden/make_lerobot_dataset.py`, copied to where it may be changed.
fn of_lerobot(root: &Path) {
    fn copy(from: &Path, to: &Path) {
        std::fs::create_dir_all(to).unwrap();
        for entry in std::fs::read_dir(from).unwrap().flatten() {
            let (from, to) = (entry.path(), to.join(entry.file_name()));
            if from.is_dir() {
                copy(&from, &to);
            } else {
                std::fs::copy(from, to).unwrap();
            }
        }
    }
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/lerobot/dataset"), root);
}

#[test]
fn a_dataset_that_lerobot_wrote_is_read_number_by_number_and_goes_on() {
    let (_folder, root) = place();
    of_lerobot(&root);
    let report = check(&root).unwrap();
    assert_eq!(report.faults, []);
    assert_eq!((report.whole, report.frames, report.unverified_files), (2, 9, 2));
    let dataset = Dataset::open(&root).unwrap();
    for (e, rows) in [(0, 5), (1, 4)] {
        let table = dataset.read(e).unwrap();
        let number = |t: usize, i: usize| e as f64 + t as f64 / 8.0 + i as f64 / 64.0;
        let all = |n: usize| (0..rows * n).map(|i| number(i / n, i % n)).collect::<Vec<_>>();
        for (name, n) in
            [("observation.tcp", 7), ("observation.jaw_mm", 1), ("observation.force", 6), ("action", 3)]
        {
            assert_eq!(table.column(name).unwrap().numbers().unwrap(), all(n), "{name}");
        }
        let flags: Vec<bool> = (0..rows).map(|t| t % 2 == 1).collect();
        assert_eq!(table.bool("touching").unwrap(), flags);
        let ticks: Vec<i64> = (0..rows).map(|t| (1000 * e + t) as i64).collect();
        assert_eq!(table.i64("ticks").unwrap(), ticks);
        let Some(Column::Text(notes)) = table.column("note") else { panic!("no notes") };
        assert_eq!((notes[0].as_str(), notes[1].as_str()), ("first", ""));
        for (t, file) in table.png("observation.images.front").unwrap().iter().enumerate() {
            assert_eq!(decode_png(file, 6, 8, "it").unwrap().data, [(16 * e + t) as u8; 6 * 8 * 3]);
        }
        assert_eq!(dataset.row_tasks(e).unwrap(), vec![["unplug", "plug it in"][e]; rows]);
    }
    let message = dataset.read_episode(0).unwrap_err().to_string();
    assert!(message.contains("file-000.parquet: episode 0, column `source."), "{message}");

    let own: Vec<String> = dataset.info().own_features().into_iter().map(|(n, _)| n).collect();
    let own: Vec<&str> = own.iter().map(String::as_str).collect();
    let mut writer = Writer::append(&root).unwrap();
    writer.push(&dataset.read_columns(1, &own).unwrap(), "plug it in").unwrap();
    writer.finish().unwrap();
    assert_eq!(check(&root).unwrap().faults, []);
    let read = |e| Dataset::open(&root).unwrap().read_columns(e, &own).unwrap();
    assert_eq!(read(1), read(2));
}
