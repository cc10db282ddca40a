use super::*;
use crate::atomic::fuse;
use crate::fixture::episode;
use e2h_core::{Direction, Episode, Frames, Kind, Outcome};
use proptest::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;

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
    Arc::make_mut(&mut e.frames[0].images[0])[0] = n as u8;
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

fn faults(root: &Path) -> Vec<String> {
    check(root).unwrap().faults.into_iter().map(|f| f.message).collect()
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

fn data_file(root: &Path, n: usize) -> PathBuf {
    root.join(format!("data/chunk-000/file-{n:03}.parquet"))
}

#[test]
fn a_sound_dataset_has_no_faults() {
    let (_folder, root) = place();
    three_files(&root);
    let report = check(&root).unwrap();
    assert_eq!(report.faults, []);
    assert_eq!((report.episodes, report.frames, report.whole), (5, 25, 5));
    assert_eq!((report.verified_files, report.unverified_files), (6, 0));
    assert_eq!(repair(&root).unwrap().repairs, Vec::<String>::new());
}

#[test]
fn one_changed_byte_is_found_and_what_precedes_it_is_kept() {
    let (_folder, root) = place();
    three_files(&root);
    let file = data_file(&root, 1);
    let mut bytes = std::fs::read(&file).unwrap();
    // In the second half of the data, that is in episode 3.
    let metadata = u32::from_le_bytes(bytes[bytes.len() - 8..bytes.len() - 4].try_into().unwrap()) as usize;
    let at = bytes.len() - 8 - metadata - 1500;
    bytes[at] ^= 1;
    std::fs::write(&file, &bytes).unwrap();
    let report = check(&root).unwrap();
    let first = &report.faults[0];
    assert!(first.message.contains("file-001.parquet: rows 5 to 10: expected the checksum"), "{first:?}");
    assert_eq!((first.episode, report.whole, first.repairable), (Some(3), 3, true));

    let report = repair(&root).unwrap();
    assert_eq!(report.faults, []);
    assert!(report.repairs[0].contains("kept the first 3 of 5 episodes"), "{:?}", report.repairs);
    assert_holds(&root, 3);
    // What was cut off is still there, and the dataset can go on.
    assert_eq!(std::fs::read(root.join("removed/data/chunk-000/file-001.parquet")).unwrap(), bytes);
    let mut writer = Writer::append(&root).unwrap();
    writer.push_episode(&numbered(3)).unwrap();
    writer.finish().unwrap();
    assert_holds(&root, 4);
    assert!(check(&root).unwrap().is_sound());
}

#[test]
fn a_truncated_or_missing_file_costs_its_episodes() {
    for missing in [true, false] {
        let (_folder, root) = place();
        three_files(&root);
        let file = data_file(&root, 2);
        if missing {
            std::fs::remove_file(&file).unwrap();
        } else {
            let bytes = std::fs::read(&file).unwrap();
            std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
        }
        assert!(faults(&root)[0].contains("file-002.parquet"));
        let report = repair(&root).unwrap();
        assert_eq!((report.faults.len(), report.whole), (0, 4), "{report:?}");
        assert_holds(&root, 4);
    }
}

#[test]
fn a_list_that_was_never_finished_costs_its_episodes() {
    // What LeRobot's recorder leaves when it is killed: counts that are ahead of the files.
    let (_folder, root) = place();
    three_files(&root);
    for file in ["meta/episodes/chunk-000/file-002.parquet", "data/chunk-000/file-002.parquet"] {
        std::fs::write(root.join(file), b"PAR1 half").unwrap();
    }
    let report = check(&root).unwrap();
    assert_eq!((report.whole, report.faults[0].episode), (4, Some(4)));
    assert!(Dataset::open(&root).is_err());
    assert_eq!(repair(&root).unwrap().faults, []);
    assert_holds(&root, 4);
}

#[test]
fn a_commit_that_was_cut_off_is_cleared_away() {
    for killed_after in 1..5 {
        let (_folder, root) = place();
        three_files(&root);
        let mut writer = Writer::append(&root).unwrap();
        writer.push_episode(&numbered(5)).unwrap();
        fuse::set(Some(killed_after));
        writer.commit().unwrap_err();
        fuse::set(None);
        let found = faults(&root);
        assert!(found[0].contains("nothing counts") || killed_after > 3, "{found:?}");
        let report = repair(&root).unwrap();
        assert_eq!((report.faults, report.whole), (vec![], 5));
        assert!(!data_file(&root, 3).exists());
        assert_holds(&root, 5);
    }
}

#[test]
fn a_repair_that_was_killed_can_be_run_again() {
    for killed_after in 0..4 {
        let (_folder, root) = place();
        three_files(&root);
        std::fs::write(data_file(&root, 2), b"").unwrap();
        let last = data_file(&root, 1);
        let mut bytes = std::fs::read(&last).unwrap();
        bytes[6000] ^= 0xff;
        std::fs::write(&last, bytes).unwrap();
        let whole = check(&root).unwrap().whole;
        fuse::set(Some(killed_after));
        let _ = repair(&root);
        fuse::set(None);
        let report = repair(&root).unwrap();
        assert_eq!(report.faults, [], "killed after {killed_after}");
        assert_holds(&root, whole);
    }
}

#[test]
fn wrong_numbers_beside_the_rows_are_found() {
    let edit = |root: &Path, file: &str, from: &str, to: &str| {
        let path = root.join(file);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{text}");
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
    };
    let (_folder, root) = place();
    three_files(&root);
    edit(&root, "meta/stats.json", "\"count\": [\n            25", "\"count\": [\n            26");
    assert!(faults(&root)[0].contains("count: expected [25], found [26]"), "{:?}", faults(&root));
    assert!(repair(&root).unwrap().is_sound());
    edit(&root, "meta/info.json", "\"total_frames\": 25", "\"total_frames\": 26");
    assert!(Dataset::open(&root).unwrap_err().to_string().contains("total_frames: expected 25, found 26"));
    assert!(repair(&root).unwrap().is_sound());
    edit(&root, "meta/info.json", "\"total_episodes\": 5", "\"total_episodes\": 7");
    assert!(faults(&root)[0].contains("expected 7 episodes, found 5"), "{:?}", faults(&root));
    assert!(repair(&root).unwrap().is_sound());
    assert_holds(&root, 5);
    edit(&root, "meta/info.json", "\"fps\": 20", "\"fps\": 25");
    let found = faults(&root);
    assert!(found[0].contains("column `timestamp`, row 2: expected 0.08, found 0.1"), "{found:?}");
    edit(&root, "meta/info.json", "v3.0", "v2.1");
    assert!(faults(&root)[0].contains("expected v3.0, found v2.1"));
    assert!(repair(&root).unwrap().repairs.is_empty(), "what cannot be repaired is left alone");
}

#[test]
fn a_foreign_column_type_is_named_with_its_column() {
    let (_folder, root) = place();
    written(&root, 1).finish().unwrap();
    let text = std::fs::read_to_string(root.join("meta/info.json")).unwrap();
    let text = text.replacen("\"dtype\": \"image\"", "\"dtype\": \"video\"", 1);
    std::fs::write(root.join("meta/info.json"), text).unwrap();
    let dataset = Dataset::open(&root).unwrap();
    let name = dataset.info().skipped[0].name.clone();
    let message = dataset.read_columns(0, &[name.as_str()]).unwrap_err().to_string();
    assert!(message.contains("video_path") && message.contains(&name), "{message}");

    let (_folder, root) = place();
    written(&root, 1).finish().unwrap();
    let text = std::fs::read_to_string(root.join("meta/info.json")).unwrap();
    let wrong = text.replacen("\"dtype\": \"bool\"", "\"dtype\": \"string\"", 1);
    std::fs::write(root.join("meta/info.json"), wrong).unwrap();
    let message = Dataset::open(&root).unwrap().read(0).unwrap_err().to_string();
    assert!(message.contains("column `next.success`: expected string [1], found Boolean"), "{message}");
    let at = text.find("\"action\"").unwrap();
    let wrong = text[..at].to_owned() + &text[at..].replacen("8\n", "9\n", 1);
    std::fs::write(root.join("meta/info.json"), wrong).unwrap();
    let message = Dataset::open(&root).unwrap().read(0).unwrap_err().to_string();
    assert!(message.contains("column `action`, row 0: expected 9 entries, found 8"), "{message}");
}

/// Replaces columns of a file of a dataset, as another program would: the checksums are right.
fn replace(path: &Path, columns: Vec<(&str, arrow_array::ArrayRef)>) {
    use super::arrow::replace_columns;
    use super::parquet_file::ParquetFile;
    let file = ParquetFile::open(path).unwrap();
    let rows = file.rows();
    let change = &mut |batch: &arrow_array::RecordBatch, first| {
        let piece = |c: &arrow_array::ArrayRef| c.slice(first, batch.num_rows());
        replace_columns(batch, columns.iter().map(|(n, c)| ((*n).to_owned(), piece(c))).collect(), path)
    };
    file.rewrite(&[rows], &|_| true, change).unwrap();
}

fn integers(values: impl IntoIterator<Item = i64>) -> arrow_array::ArrayRef {
    std::sync::Arc::new(arrow_array::Int64Array::from_iter_values(values))
}

fn kinds(report: &Report) -> Vec<FaultKind> {
    let mut kinds: Vec<FaultKind> = report.faults.iter().map(|f| f.kind).collect();
    kinds.dedup();
    kinds
}

/// Merging, deleting and splitting leave places and statistics as they were, and clocks are not exact. No row is lost by that.
#[test]
fn what_is_stale_is_taken_anew_from_the_rows() {
    let list = "meta/episodes/chunk-000/file-001.parquet";
    type Change<'a> = &'a dyn Fn(&Path);
    let restarted: Change = &|root| {
        replace(&root.join(list), vec![("dataset_from_index", integers([0, 5]))]);
        let rows = (0..11).collect::<Vec<_>>();
        let episodes = [vec![0; 5], vec![1; 6]].concat();
        let columns = vec![("index", integers(rows)), ("episode_index", integers(episodes))];
        replace(&data_file(root, 1), columns);
    };
    let statistics: Change = &|root| {
        let stale = super::arrow::lists(integers([7, 7]), 1);
        replace(&root.join(list), vec![("stats/episode_index/min", stale)]);
    };
    let late: Change = &|root| {
        let times = [5, 6].iter().flat_map(|&n| (0..n).map(|t| t as f32 / 20.0 + 0.004));
        let times = arrow_array::Float32Array::from_iter_values(times);
        replace(&data_file(root, 1), vec![("timestamp", std::sync::Arc::new(times))]);
    };
    let none: Change = &|root| std::fs::remove_file(root.join("meta/stats.json")).unwrap();
    for (name, change) in
        [("restarted", restarted), ("statistics", statistics), ("late", late), ("none", none)]
    {
        let (_folder, root) = place();
        three_files(&root);
        change(&root);
        let report = check(&root).unwrap();
        assert_eq!((kinds(&report), report.whole), (vec![FaultKind::Stale], 5), "{name}: {report:?}");
        assert_holds(&root, 5);
        let report = repair(&root).unwrap();
        assert!(report.is_sound() && !report.repairs.is_empty(), "{name}: {report:?}");
        assert_holds(&root, 5);
        let index = |e| Dataset::open(&root).unwrap().read(e).unwrap().i64("index").unwrap().to_vec();
        assert_eq!((index(2), index(3)), ((7..12).collect(), (12..18).collect()), "{name}");
        let (_folder, other) = place();
        three_files(&other);
        let stats = |root: &Path| std::fs::read(root.join("meta/stats.json")).unwrap();
        assert!(stats(&root) == stats(&other), "{name}");
        // It goes on as if nothing had been.
        let mut writer = Writer::append(&root).unwrap();
        writer.push_episode(&numbered(5)).unwrap();
        writer.finish().unwrap();
        assert_holds(&root, 6);
    }
}

/// Every file below a folder with its bytes.
fn bytes_of(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = vec![];
    for path in crate::atomic::names(folder).unwrap() {
        if path.is_dir() {
            found.extend(bytes_of(&path));
        } else {
            found.push((path.clone(), std::fs::read(&path).unwrap()));
        }
    }
    found
}

#[test]
fn where_something_is_not_supported_nothing_is_touched_and_the_rest_is_read() {
    let (_folder, root) = place();
    three_files(&root);
    let path = root.join("meta/info.json");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replacen("\"bool\"", "\"language\"", 1)).unwrap();
    // Damage beside it is found, and left alone too.
    std::fs::write(data_file(&root, 2), b"").unwrap();
    let before = bytes_of(&root);
    let report = repair(&root).unwrap();
    assert_eq!((kinds(&report), report.whole), (vec![FaultKind::Damage, FaultKind::Unsupported], 4));
    assert!(report.repairs.is_empty() && bytes_of(&root) == before);
    let dataset = Dataset::open(&root).unwrap();
    assert_eq!(dataset.read(0).unwrap().f32("action").unwrap(), numbered(0).action.concat());
    let error = dataset.read_columns(0, &["next.success"]).unwrap_err();
    assert!(error.is_unsupported() && error.to_string().contains("feature `next.success`"), "{error}");
    assert!(Writer::append(&root).unwrap_err().to_string().contains("next.success"));
}

/// What a link leads to may be another's.
#[cfg(unix)]
#[test]
fn a_repair_changes_nothing_through_a_symbolic_link() {
    let (folder, root) = place();
    three_files(&root);
    let other = folder.path().join("other");
    std::fs::rename(root.join("data/chunk-000"), &other).unwrap();
    std::os::unix::fs::symlink(&other, root.join("data/chunk-000")).unwrap();
    assert_holds(&root, 5);
    std::fs::write(other.join("file-002.parquet"), b"").unwrap();
    let before = bytes_of(&other);
    let message = repair(&root).unwrap_err().to_string();
    assert!(message.contains("chunk-000: repair") && message.contains("a symbolic link"), "{message}");
    assert_eq!(bytes_of(&other), before);
    assert_eq!(Dataset::open(&root).unwrap().len(), 5);
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_in_a_dataset_are_refused_and_not_read() {
    for file in FILES {
        let (_folder, root) = place();
        three_files(&root);
        std::fs::remove_file(root.join(file)).unwrap();
        std::os::unix::fs::symlink("/dev/zero", root.join(file)).unwrap();
        let report = check(&root).unwrap();
        assert!(
            !report.is_sound() && report.faults[0].message.contains("a regular file"),
            "{file}: {report:?}"
        );
    }
}

/// 70 rows that pyarrow packed with zstd.
#[test]
fn rows_that_are_packed_with_zstd_are_read() {
    use super::parquet_file::ParquetFile;
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/lerobot/packed/zstd.parquet");
    let file = ParquetFile::open(&path).unwrap();
    let (time, count) = (Feature::scalar(Dtype::Float32), Feature::scalar(Dtype::Int64));
    let state = Feature { shape: vec![8], ..Feature::scalar(Dtype::Float32) };
    let wanted = [("timestamp", &time), ("frame_index", &count), ("observation.state", &state)];
    let columns = file.read(&wanted, 0..70).unwrap();
    let rows: Vec<i64> = (0..50).chain(0..20).collect();
    assert_eq!(columns[1].1, Column::I64(rows.clone()));
    assert_eq!(columns[0].1, Column::F32(rows.iter().map(|&t| (t as f64 / 20.0) as f32).collect()));
    assert_eq!(columns[2].1.len(), 70 * 8);
    assert!(columns[2].1.numbers().unwrap().iter().all(|v| v.is_finite()));
    assert_eq!(file.read(&wanted[1..2], 60..65).unwrap()[0].1, Column::I64((10..15).collect()));

    let (_folder, root) = place();
    std::fs::create_dir_all(&root).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    for at in (4..bytes.len() - 8).step_by(61) {
        let mut bad = bytes.clone();
        bad[at] ^= 0x55;
        std::fs::write(root.join("x"), bad).unwrap();
        let _ = ParquetFile::open(&root.join("x")).and_then(|f| f.read(&wanted, 0..70));
    }
}

/// A dataset of two episodes of 20 rows at 20 Hz, with a video of 50 ms a frame.
fn with_video(root: &Path) -> PathBuf {
    let own = vec![("x".to_owned(), Feature::scalar(Dtype::Float32))];
    let mut writer = Writer::create(root, 20.0, None, own).unwrap();
    for _ in 0..2 {
        let columns = vec![("x".to_owned(), Column::F32(vec![1.0; 20]))];
        writer.push(&Table { rows: 20, columns }, "t").unwrap();
    }
    writer.finish().unwrap();
    let seconds = |v: [f64; 2]| -> arrow_array::ArrayRef {
        std::sync::Arc::new(arrow_array::Float64Array::from(v.to_vec()))
    };
    let columns = vec![
        ("videos/top/chunk_index", integers([0, 0])),
        ("videos/top/file_index", integers([0, 0])),
        ("videos/top/from_timestamp", seconds([0.0, 1.0])),
        ("videos/top/to_timestamp", seconds([1.0, 2.0])),
    ];
    replace(&root.join("meta/episodes/chunk-000/file-000.parquet"), columns);
    let mut info = super::dataset::read_info(root).unwrap();
    info.video_path = Some("videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4".to_owned());
    info.features.push(("top".to_owned(), Feature { dtype: Dtype::Video, ..Feature::image(4, 4) }));
    super::writer::write_json(&root.join("meta/info.json"), &info).unwrap();
    let path = root.join("videos/top/chunk-000/file-000.mp4");
    crate::write_atomic(&path, &super::mp4::tests::file(&[50; 40])).unwrap();
    path
}

#[test]
fn videos_are_looked_into() {
    let (_folder, root) = place();
    let path = with_video(&root);
    assert_eq!(check(&root).unwrap().faults, []);
    let whole = std::fs::read(&path).unwrap();
    for (file, expected, left) in [
        (super::mp4::tests::file(&[50; 39]), "frame 20 of 20 from 1 s", 1),
        (super::mp4::tests::file(&[54; 40]), "within half a frame of", 0),
        (whole[..whole.len() / 2].to_vec(), "cut off in `mdat`", 0),
        (vec![], "without tables", 0),
    ] {
        std::fs::write(&path, file).unwrap();
        let report = check(&root).unwrap();
        let message = &report.faults[0].message;
        assert_eq!((kinds(&report), report.whole), (vec![FaultKind::Damage], left), "{report:?}");
        assert!(message.contains(expected), "{message}");
        let read = Dataset::open(&root).unwrap().read_columns(1, &["top"]).unwrap_err().to_string();
        assert!(read.contains("file-000.mp4: video"), "{read}");
    }
    // In fragments it may be whole: nothing is cut.
    std::fs::write(&path, super::mp4::tests::fragments(&[50; 40])).unwrap();
    for report in [check(&root).unwrap(), repair(&root).unwrap()] {
        let of_it = report.faults.iter().filter(|f| f.path == path);
        assert!(of_it.clone().all(|f| f.message.contains("found a fragmented one")), "{report:?}");
        assert_eq!((of_it.count() > 0, report.worst()), (true, Some(FaultKind::Unsupported)), "{report:?}");
    }
    assert_eq!(Dataset::open(&root).unwrap().len(), 2);

    std::fs::write(&path, super::mp4::tests::file(&[50; 39])).unwrap();
    let report = repair(&root).unwrap();
    assert!(report.is_sound() && report.whole == 1, "{report:?}");

    // Times of rows that drift by more than half a frame would show the wrong frames.
    let (_folder, root) = place();
    with_video(&root);
    let times = (0..40).map(|t| (t % 20) as f32 * 0.053);
    let times = arrow_array::Float32Array::from_iter_values(times);
    replace(&data_file(&root, 0), vec![("timestamp", std::sync::Arc::new(times))]);
    let read = Dataset::open(&root).unwrap().read_columns(0, &["top"]).unwrap_err().to_string();
    assert!(read.contains("column `timestamp`, row 9: expected within half a frame"), "{read}");
    assert_eq!(kinds(&check(&root).unwrap()), [FaultKind::Damage]);
}

/// A Parquet file of nothing but a footer whose schema promises more columns than there is memory for.
#[test]
fn a_file_that_promises_more_than_it_holds_is_refused_before_there_is_memory_for_it() {
    let (_folder, root) = place();
    written(&root, 1).finish().unwrap();
    // Version 2; a schema of one element, `a`, with 2^31 - 1 children.
    let footer = [0x15, 4, 0x19, 0x1c, 0x48, 1, b'a', 0x15, 0xfe, 0xff, 0xff, 0xff, 0x0f, 0, 0];
    let file = [b"PAR1", &footer[..], &(footer.len() as u32).to_le_bytes(), b"PAR1"].concat();
    let path = data_file(&root, 0);
    std::fs::write(&path, &file).unwrap();
    let message = Dataset::open(&root).unwrap().read(0).unwrap_err().to_string();
    let expected =
        "file: expected a whole Parquet file, found a group of 2147483647 columns in a schema of 1";
    assert_eq!(message, format!("{}: {expected}", path.display()));
    assert!(faults(&root)[0].contains("a group of 2147483647 columns"));
}

/// Pages that say they unpack to more than they can, and columns that say they have more pages than the file.
#[test]
fn pages_that_promise_more_than_they_hold_are_refused_before_there_is_memory_for_them() {
    let (_folder, root) = place();
    written(&root, 1).finish().unwrap();
    let path = data_file(&root, 0);
    let good = std::fs::read(&path).unwrap();
    // The first page's header begins with its kind and both sizes; the first of them is that in memory.
    let (kind, sizes) = (&good[4..6], &good[6..9]);
    assert!(kind[0] == 0x15 && sizes[0] == 0x15 && sizes[1] >= 0x80 && sizes[2] < 0x80, "{:?}", &good[..16]);
    let mut bad = good.clone();
    bad[7..9].copy_from_slice(&[0xfe, 0x7f]);
    std::fs::write(&path, &bad).unwrap();
    let message = Dataset::open(&root).unwrap().read(0).unwrap_err().to_string();
    assert!(message.contains("column `observation.state`, from row 0"), "{message}");
    assert!(message.contains("a page of 8191 bytes packed into"), "{message}");
}

/// One long text in a dictionary, and rows that all name it: a file of some kilobytes, half a gigabyte of texts.
#[test]
fn texts_that_a_dictionary_repeats_without_end_are_refused_before_there_is_memory_for_them() {
    use arrow_array::{DictionaryArray, Int32Array, RecordBatch, StringArray, types::Int32Type};
    use parquet::arrow::ArrowWriter;
    use parquet::arrow::arrow_writer::ArrowWriterOptions;
    use parquet::basic::Compression;
    use parquet::file::properties::WriterProperties;
    use std::sync::Arc;

    let (_folder, root) = place();
    std::fs::create_dir_all(&root).unwrap();
    let path = root.join("file.parquet");
    for (compression, rows, fails) in [
        (Compression::SNAPPY, 1024, true),
        (Compression::SNAPPY, 4, false),
        (Compression::UNCOMPRESSED, 4096, true),
        (Compression::UNCOMPRESSED, 4, false),
    ] {
        // Uncompressed files are large by themselves, and may unpack to so much more.
        let long = "x".repeat(if compression == Compression::SNAPPY { 1 << 19 } else { 1 << 17 });
        let texts = Arc::new(StringArray::from(vec![long.as_str()]));
        let keys = Int32Array::from(vec![0; rows]);
        let column = Arc::new(DictionaryArray::<Int32Type>::try_new(keys, texts).unwrap());
        let batch = RecordBatch::try_from_iter([("note", column as _)]).unwrap();
        let properties = WriterProperties::builder().set_compression(compression).build();
        // Without Arrow's own schema a reader takes the column for plain texts.
        let options = ArrowWriterOptions::new().with_properties(properties).with_skip_arrow_metadata(true);
        let file = std::fs::File::create(&path).unwrap();
        let mut writer = ArrowWriter::try_new_with_options(file, batch.schema(), options).unwrap();
        writer.write(&batch).unwrap();
        writer.close().unwrap();
        let feature = Feature::scalar(Dtype::String);
        let read =
            super::parquet_file::ParquetFile::open(&path).unwrap().read(&[("note", &feature)], 0..rows);
        if fails {
            let message = read.unwrap_err().to_string();
            assert!(
                message.contains("column `note`") && message.contains("bytes of text, expected at most"),
                "{message}"
            );
        } else {
            let Column::Text(texts) = &read.unwrap()[0].1 else { panic!("no texts") };
            assert_eq!((texts.len(), &texts[3]), (4, &long));
        }
    }
}

/// The same by texts that each begin with all of the one before.
#[test]
fn texts_that_share_their_beginnings_without_end_are_refused_too() {
    use arrow_array::{RecordBatch, StringArray};
    use parquet::arrow::ArrowWriter;
    use parquet::basic::{Compression, Encoding};
    use parquet::file::properties::WriterProperties;
    use std::sync::Arc;

    let (_folder, root) = place();
    std::fs::create_dir_all(&root).unwrap();
    let path = root.join("file.parquet");
    let long = "x".repeat(1 << 19);
    for (rows, fails) in [(4, false), (1024, true)] {
        let batch =
            RecordBatch::try_from_iter([("note", Arc::new(StringArray::from(vec![long.as_str(); 4])) as _)])
                .unwrap();
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_dictionary_enabled(false)
            .set_encoding(Encoding::DELTA_BYTE_ARRAY)
            .build();
        let file = std::fs::File::create(&path).unwrap();
        let mut writer = ArrowWriter::try_new(file, batch.schema(), Some(properties)).unwrap();
        (0..rows / 4).for_each(|_| writer.write(&batch).unwrap());
        writer.close().unwrap();
        assert!(std::fs::metadata(&path).unwrap().len() < 100_000, "the texts share nothing");
        let feature = Feature::scalar(Dtype::String);
        let read =
            super::parquet_file::ParquetFile::open(&path).unwrap().read(&[("note", &feature)], 0..rows);
        match read {
            Ok(columns) => assert!(!fails && columns[0].1 == Column::Text(vec![long.clone(); rows])),
            Err(e) => assert!(fails && e.to_string().contains("bytes of text, expected at most"), "{e}"),
        }
    }
}

/// Names and texts of others stand in messages, which stay one line.
#[test]
fn what_files_say_does_not_break_a_message() {
    let (_folder, root) = place();
    written(&root, 1).finish().unwrap();
    let text = std::fs::read_to_string(root.join("meta/info.json")).unwrap();
    let refusal = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        std::fs::write(root.join("meta/info.json"), text.replacen(from, to, 1)).unwrap();
        let message = Dataset::open(&root).unwrap_err().to_string();
        assert!(!message.contains(char::is_control) && message.contains("info.json"), "{message:?}");
        message
    };
    std::fs::write(root.join("meta/info.json"), text.replacen("\"bool\"", "\"b\\no\\u001b[31mol\"", 1))
        .unwrap();
    let message = Dataset::open(&root).unwrap().read_columns(0, &["next.success"]).unwrap_err().to_string();
    assert!(!message.contains(char::is_control) && message.contains("info.json"), "{message:?}");
    assert!(refusal("\"action\"", "\"act\\nion\"").contains("control characters"));
    assert!(refusal("data/chunk", "data/\\nchunk").contains("data_path"));
    let long = refusal("\"v3.0\"", &format!("\"{}\"", "x".repeat(1 << 20)));
    assert!(long.len() < 2000, "{}", long.len());
}

/// What cannot be an episode of this project is refused with the name of the file.
#[test]
fn a_foreign_dataset_is_no_episode_and_says_which_file() {
    let (_folder, root) = place();
    let own = vec![("x".to_owned(), Feature::scalar(Dtype::Float32))];
    let mut writer = Writer::create(&root, 20.0, None, own).unwrap();
    let columns = vec![("x".to_owned(), Column::F32(vec![1.0]))];
    writer.push(&Table { rows: 1, columns }, "t").unwrap();
    writer.finish().unwrap();
    let message = Dataset::open(&root).unwrap().read_episode(0).unwrap_err().to_string();
    let name = data_file(&root, 0).display().to_string();
    assert_eq!(message, format!("{name}: episode 0, column `source.success_at`: expected int64, found none"));
}

/// A dataset with damage in one of its files, and what all readers say of it: errors, but no panic and no hang.
fn survive(file: &str, damage: impl Fn(&mut Vec<u8>)) -> bool {
    thread_local! { static WHOLE: (tempfile::TempDir, PathBuf) = {
        let (folder, root) = place();
        written(&root, 2).finish().unwrap();
        (folder, root)
    }; }
    WHOLE.with(|(_folder, whole)| {
        let path = whole.join(file);
        let good = std::fs::read(&path).unwrap();
        let mut bad = good.clone();
        damage(&mut bad);
        std::fs::write(&path, &bad).unwrap();
        if let Ok(dataset) = Dataset::open(whole) {
            for i in 0..dataset.len() {
                let _ = dataset.read(i);
                let _ = dataset.read_episode(i);
            }
        }
        let noticed = check(whole).map_or(true, |r| !r.is_sound());
        let _ = Writer::append(whole);
        std::fs::write(&path, good).unwrap();
        noticed
    })
}

const FILES: [&str; 5] = [
    "data/chunk-000/file-000.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    "meta/tasks.parquet",
    "meta/info.json",
    "meta/stats.json",
];

#[test]
fn truncated_files_are_refused_at_every_length() {
    for file in FILES {
        let length = {
            let (_folder, root) = place();
            written(&root, 2).finish().unwrap();
            std::fs::metadata(root.join(file)).unwrap().len() as usize
        };
        for keep in (0..length).step_by(length / 40 + 1).chain([length - 1]) {
            assert!(survive(file, |b| b.truncate(keep)), "{file} of {keep} bytes");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]
    #[test]
    fn damaged_files_never_stop_a_reader(
        file in 0..FILES.len(), near_end: bool, changes in prop::collection::vec((any::<u16>(), any::<u8>()), 1..6),
    ) {
        survive(FILES[file], |bytes| {
            for &(at, value) in &changes {
                // Footers steer the decoder, so half of the damage is done there.
                let span = if near_end { bytes.len().min(3000) } else { bytes.len() };
                let at = bytes.len() - 1 - usize::from(at) % span;
                bytes[at] = value;
            }
        });
    }

    #[test]
    fn changed_rows_are_always_noticed(at in any::<u32>(), bit in 0_u8..8) {
        let noticed = survive(FILES[0], |bytes| {
            let metadata = u32::from_le_bytes(*bytes[..bytes.len() - 4].last_chunk().unwrap()) as usize;
            let at = at as usize % (bytes.len() - 8 - metadata);
            bytes[at] ^= 1_u8 << bit;
        });
        prop_assert!(noticed);
    }
}
