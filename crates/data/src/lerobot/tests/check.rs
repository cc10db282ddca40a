//! Damage, what is stale, and what is not supported: told apart, and repaired.

use super::*;

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
