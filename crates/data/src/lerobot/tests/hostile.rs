//! Files that lie, are cut off or were written by somebody else.

use super::*;

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
