//! The page of a dataset and of a run: whole, self-contained, safe against what files may say, and alive in a browser.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout, reason = "a test")]

use e2h_core::{Direction, Episode, Frames, Kind, Observation, Origin, Outcome};
use e2h_data::lerobot::{Column, Dtype, Feature, Table, Writer, features_of};
use e2h_refine::{Fate, KinematicConfig, ReverseConfig, kinematic_filter, reverse};
use e2h_report::record::{Collection, Evaluation, IterationRecord, Reversal, wilson95};
use e2h_report::view::{Options, write, write_scalars};
use std::path::{Path, PathBuf};
use std::process::Command;

const HOSTILE: &str = "</script><script>alert(1)</script><img src=x onerror=\"alert('2')\">&amp; \u{202e}<b";

/// Elements that have no end.
const VOID: [&str; 4] = ["meta", "img", "input", "br"];

/// One element: its name and its attributes.
type Element = (String, Vec<(String, String)>);

/// Reads a page as strictly as XML: every element closed in order, every attribute quoted.
fn parse(html: &str) -> Vec<Element> {
    let mut rest = html.strip_prefix("<!doctype html>").expect("a doctype");
    let (mut open, mut all) = (vec![], vec![]);
    while let Some(at) = rest.find('<') {
        rest = &rest[at + 1..];
        if let Some(tail) = rest.strip_prefix('/') {
            let (name, after) = tail.split_once('>').expect("the end of an end tag");
            assert_eq!(open.pop().as_deref(), Some(name), "before {:.80}", after);
            rest = after;
            continue;
        }
        let end = rest.find(|c: char| !c.is_ascii_alphanumeric()).expect("the end of a name");
        let name = rest[..end].to_owned();
        assert!(!name.is_empty(), "a bare < before {rest:.80}");
        rest = &rest[end..];
        let mut attributes = vec![];
        let closed = loop {
            rest = rest.trim_start();
            if let Some(tail) = rest.strip_prefix("/>") {
                rest = tail;
                break true;
            }
            if let Some(tail) = rest.strip_prefix('>') {
                rest = tail;
                break VOID.contains(&name.as_str());
            }
            let end = rest.find(|c: char| "=> /".contains(c)).expect("the end of an attribute");
            let key = rest[..end].to_owned();
            assert!(!key.is_empty(), "in <{name}, before {rest:.80}");
            rest = &rest[end..];
            let value = match rest.strip_prefix("=\"") {
                Some(tail) => {
                    let (value, tail) = tail.split_once('"').expect("a closing quote");
                    rest = tail;
                    value.to_owned()
                }
                None => String::new(),
            };
            attributes.push((key, value));
        };
        if ["script", "style"].contains(&name.as_str()) && !closed {
            let at = rest.find(&format!("</{name}>")).expect("the end of a script or style");
            rest = &rest[at + name.len() + 3..];
        } else if !closed {
            open.push(name.clone());
        }
        all.push((name, attributes));
    }
    assert!(open.is_empty(), "never closed: {open:?}");
    all
}

/// Nothing is fetched, and no script is there but the page's own.
fn assert_self_contained(html: &str) -> Vec<Element> {
    let elements = parse(html);
    for (name, attributes) in &elements {
        for (key, value) in attributes {
            assert!(!key.starts_with("on"), "<{name} {key}>");
            if ["src", "href", "action", "srcset", "data", "poster"].contains(&key.as_str()) {
                assert!(value.starts_with("data:image/png;base64,"), "<{name} {key}=\"{value:.60}\"");
            }
        }
        assert!(!["link", "iframe", "object", "embed", "base"].contains(&name.as_str()), "<{name}>");
    }
    assert_eq!(elements.iter().filter(|e| e.0 == "script").count(), 1);
    assert!(!html.contains("@import") && !html.contains("url(http"));
    elements
}

fn entries(elements: &[Element]) -> usize {
    let class = |e: &&Element| e.1.contains(&("class".to_owned(), "ep".to_owned()));
    elements.iter().filter(|e| e.0 == "details").filter(class).count()
}

/// An easy episode that moves, stands still and moves on, seen by two cameras.
fn episode(index: u32, rows: usize, side: usize) -> Episode {
    let mut e = Episode::new(Origin::demonstration("nut_assembly", Direction::Easy, index, 3), &[]);
    for t in 0..rows {
        let mut state = [0.0; 15];
        let moved = if t < rows / 3 { t } else { rows / 3 + t.saturating_sub(2 * rows / 3) };
        state[0] = 0.01 * moved as f32;
        state[3] = 1.0;
        state[10] = 1.0;
        state[14] = 0.08;
        e.push(&Observation { state, frames: vec![] }, &[0.1 * index as f32; 8]).unwrap();
    }
    for camera in ["table", "wrist"] {
        let pixel = |t: usize, y: usize, x: usize| {
            let near = x.abs_diff((t + index as usize) % side) < 3 && y.abs_diff(side / 2) < 3;
            if near { [230, 120, 40] } else { [60, (70 + y) as u8, (90 + x) as u8] }
        };
        let bytes: Vec<u8> = (0..rows * side * side)
            .flat_map(|i| pixel(i / (side * side), i / side % side, i % side))
            .collect();
        e.frames.push(Frames::new(camera, side, side, &bytes));
    }
    e.outcome = if index % 3 == 2 { Outcome::Timeout } else { Outcome::Success { at: rows - 1 } };
    e
}

/// A run of three demonstrations and one iteration; its segments.
fn run(dir: &Path) -> Vec<Episode> {
    let put = |name: &str, text: String| std::fs::write(dir.join(name), text).unwrap();
    std::fs::create_dir_all(dir.join("iteration_01")).unwrap();
    put("run.json", r#"{"format":2,"task":"nut_assembly","preset":"smoke","seed":3}"#.to_owned());
    put("config.toml", include_str!("../../../configs/presets/smoke.toml").to_owned());
    let store = |folder: &str, episodes: &[Episode]| {
        let mut writer =
            Writer::create(dir.join(folder), 20.0, Some("panda"), features_of(&episodes[0])).unwrap();
        episodes.iter().for_each(|e| writer.push_episode(e).unwrap());
        writer.finish().unwrap();
    };
    store("demonstrations", &[0, 1, 2].map(|i| episode(i, 60, 24)));
    let mut rollout = episode(4, 90, 24);
    (rollout.origin.kind, rollout.origin.iteration) = (Kind::Rollout, 1);
    let reversed = reverse(&rollout, &ReverseConfig::default());
    let refined = kinematic_filter(&reversed, &KinematicConfig::default(), &ReverseConfig::default());
    assert!(!refined.segments.is_empty());
    store("iteration_01/segments", &refined.segments);
    let mut account = Reversal::new(&reversed, &refined);
    account.value = Some((0..90).map(|t| (t % 7 != 0).then_some(t as f32 / 90.0)).collect());
    put("iteration_01/reversals.json", serde_json::to_string(&[account]).unwrap());
    let kept: usize = refined.segments.iter().map(Episode::len).sum();
    let evaluation = Evaluation {
        successes: 3,
        trials: 4,
        wilson95: wilson95(3, 4),
        mean_steps: 90.0,
        seconds: 1.0,
        outcomes: vec![],
    };
    let record = IterationRecord {
        iteration: 1,
        evaluation,
        minutes: 2.0,
        stage_minutes: std::collections::BTreeMap::new(),
        collection: Some(Collection {
            cycles: 2,
            hard_successes: 1,
            easy_rollouts: 2,
            steps: 400,
            easy_successes: 1,
            accepted: 1,
            fates: [(Fate::Kept, kept), (Fate::Static, 90 - kept)].into(),
            segments: refined.segments.len(),
            frames_kept: kept,
            ..Collection::default()
        }),
        loss: 0.5,
        skipped: false,
        updates: 1500,
    };
    put("iteration_01/record.json", serde_json::to_string(&record).unwrap());
    refined.segments
}

/// A dataset of another robot, all of whose texts are hostile.
fn dataset(dir: &Path, episodes: usize) {
    let hostile = HOSTILE.replace('/', "|"); // names of columns may not have a slash
    let names = ["ee_x", "ee_y", "ee_z", &hostile];
    let camera = format!("observation.images.{hostile}");
    let features = vec![
        ("observation.state".to_owned(), Feature::vector(&names)),
        (camera.clone(), Feature::image(30, 40)),
        ("action".to_owned(), Feature::vector(&["<i>", "b"])),
        ("next.success".to_owned(), Feature::scalar(Dtype::Bool)),
        ("note <u>".to_owned(), Feature::scalar(Dtype::Float32)),
    ];
    let mut writer = Writer::create(dir, 10.0, Some(HOSTILE), features).unwrap();
    for i in 0..episodes {
        let rows = 20 + i;
        let image = |t: usize| (0..30 * 40 * 3).map(|p| ((p + 5 * t) % 251) as u8).collect::<Vec<u8>>();
        let files = (0..rows).map(|t| e2h_data::lerobot::encode_png(30, 40, &image(t)).unwrap()).collect();
        let columns = vec![
            ("observation.state".to_owned(), Column::F32((0..rows * 4).map(|v| v as f32).collect())),
            (camera.clone(), Column::Png(files)),
            ("action".to_owned(), Column::F32((0..rows * 2).map(|v| (v as f32).sin()).collect())),
            (
                "next.success".to_owned(),
                Column::Bool((0..rows).map(|t| i % 2 == 0 && t + 1 == rows).collect()),
            ),
            ("note <u>".to_owned(), Column::F32(vec![0.5; rows])),
        ];
        writer.push(&Table { rows, columns }, &format!("{HOSTILE} {}", i % 3)).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn a_run_has_every_episode_and_what_became_of_its_frames() {
    let dir = tempfile::tempdir().unwrap();
    let segments = run(dir.path());
    let out = dir.path().join("view.html");
    let written = write(dir.path(), &out, &Options::default()).unwrap();
    let html = std::fs::read_to_string(&out).unwrap();
    assert_eq!((written.bytes, written.episodes), (html.len(), 3 + segments.len()));
    let elements = assert_self_contained(&html);
    assert_eq!(entries(&elements), 3 + segments.len());
    for name in
        ["demonstrations/00002", "iteration_01/segments/00000", "Easy rollout 4 of iteration_01, reversed"]
    {
        assert!(html.contains(name), "{name}");
    }
    assert!(html.contains("data-outcome=\"timeout\"") && html.contains("data-direction=\"easy, reversed\""));
    assert!(html.contains("static: frames ") && html.contains("data-fates=\"kept|static\""));
    assert!(html.contains("<figcaption>value</figcaption>") && !html.contains("NaN"));
    // The pictures of an episode, and their rows, from the first to the last.
    assert_eq!(elements.iter().filter(|e| e.0 == "img").count(), 3 * (3 + segments.len()));
    let rows = |v: &str| v.starts_with("0 ") && v.ends_with(" 59");
    assert!(elements.iter().flat_map(|e| &e.1).any(|(k, v)| k == "data-rows" && rows(v)));
    // The same folder gives the same page.
    let again = dir.path().join("again.html");
    write(dir.path(), &again, &Options::default()).unwrap();
    assert!(html == std::fs::read_to_string(again).unwrap());
}

#[test]
fn a_dataset_with_hostile_names_is_harmless() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("<s onload=x>");
    dataset(&root, 5);
    let out = dir.path().join("page.html");
    let written = write(&root, &out, &Options::default()).unwrap();
    let html = std::fs::read_to_string(&out).unwrap();
    let elements = assert_self_contained(&html);
    assert_eq!((entries(&elements), written.shown), (5, 5));
    assert!(!html.contains("<img src=x") && !html.contains("alert(1)</script>") && !html.contains("<u>"));
    assert!(html.contains("&lt;/script&gt;&lt;script&gt;alert(1)"));
    assert!(html.contains("Content-Security-Policy") && html.contains("script-src 'sha256-"));
    assert!(html.contains("3/5"), "successes");
    // The tool is found by the names of its coordinates: 4 in each of three directions from row to row, ten rows a second.
    assert!(html.contains("data-speed=\"69.2820\""), "speed");
}

#[test]
fn datasets_of_other_robots_are_shown_whole() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("page.html");
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/lerobot/dataset");
    let written = write(&golden, &out, &Options::default()).unwrap();
    let html = std::fs::read_to_string(&out).unwrap();
    assert_eq!((entries(&assert_self_contained(&html)), written.shown), (2, 2));
    for text in ["other_arm", "plug it in", "unplug", "4 of 4 frames"] {
        assert!(html.contains(text), "{text}");
    }
    // Text of a row, the names of entries, and the places of a matrix that has no names.
    assert!(
        html.contains("<dd><bdi>first</bdi></dd>") && html.contains(">lift<") && html.contains("1,2"),
        "columns"
    );

    // A map of heights is drawn as its least, mean and largest entry, not as 200 lines.
    let root = dir.path().join("map");
    let shape = Feature { shape: vec![10, 20], ..Feature::scalar(Dtype::Float32) };
    let mut writer = Writer::create(&root, 10.0, None, vec![("heights".to_owned(), shape)]).unwrap();
    let columns = vec![("heights".to_owned(), Column::F32((0..600).map(|v| v as f32).collect()))];
    writer.push(&Table { rows: 3, columns }, "look").unwrap();
    writer.finish().unwrap();
    let position = Some("heights[3:6]".parse().unwrap());
    write(&root, &out, &Options { position, ..Options::default() }).unwrap();
    let html = std::fs::read_to_string(&out).unwrap();
    // 200 further in all three directions from row to row, ten rows a second.
    assert!(html.contains("data-speed=\"3464.1016\""), "speed");
    assert!(html.contains("heights, 10 x 20") && html.contains("largest"), "a summary");
    assert!(!html.contains("9,19"), "one line an entry");
}

#[test]
fn a_page_stays_below_its_size_and_says_what_is_missing() {
    let dir = tempfile::tempdir().unwrap();
    let (root, out) = (dir.path().join("data"), dir.path().join("page.html"));
    dataset(&root, 12);
    let written = write(&root, &out, &Options { megabytes: 0.3, ..Options::default() }).unwrap();
    assert!(written.bytes < 300_000, "{} bytes", written.bytes);
    assert_eq!(written.shown, 12);
    let fewer = |l: &String| l.contains("Animations show every") || l.contains("without pictures");
    assert!(written.left_out.iter().any(fewer), "{:?}", written.left_out);
    let written = write(&root, &out, &Options { episodes: 3, ..Options::default() }).unwrap();
    assert_eq!((written.shown, written.episodes), (3, 12));
    assert!(written.left_out[0].starts_with("3 of 12 episodes"), "{:?}", written.left_out);
    let html = std::fs::read_to_string(&out).unwrap();
    assert!(html.contains("episode 11") && html.contains("3 of 12 episodes"));
}

#[test]
fn what_cannot_be_read_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("page.html");
    let message = write(dir.path(), &out, &Options::default()).unwrap_err().to_string();
    assert!(message.contains("meta/info.json") && message.contains("run.json"), "{message}");
    assert!(!out.exists());
    let zero = Options { episodes: 0, ..Options::default() };
    assert!(write(dir.path(), &out, &zero).unwrap_err().to_string().contains("at least 1"));

    // One broken dataset does not take the others' place.
    let segments = run(dir.path()).len();
    std::fs::write(dir.path().join("demonstrations/data/chunk-000/file-000.parquet"), "torn").unwrap();
    let written = write(dir.path(), &out, &Options::default()).unwrap();
    let html = std::fs::read_to_string(&out).unwrap();
    assert!(html.contains("cannot be read") && html.contains("file-000.parquet"));
    assert!(
        written.episodes == segments
            || written.left_out.iter().any(|l| l.starts_with("3 episodes cannot be read"))
    );
    assert_eq!(entries(&assert_self_contained(&html)), written.episodes);

    let root = dir.path().join("data");
    dataset(&root, 2);
    // Of what stands beside the dataset only what a report can be: a sparse file of a gigabyte takes no place here.
    let frames = root.join("report/frames.csv");
    std::fs::create_dir(root.join("report")).unwrap();
    std::fs::File::create(&frames).unwrap().set_len(1 << 30).unwrap();
    let message = write(&root, &out, &Options::default()).unwrap_err().to_string();
    assert!(message.contains("frames.csv") && message.contains("at most 67108864 bytes"), "{message}");
    std::fs::remove_file(&frames).unwrap();
    let wrong = Options { position: Some("action[0:2]".parse().unwrap()), ..Options::default() };
    assert!(write(&root, &out, &wrong).unwrap_err().to_string().contains("expected 3 entries, found 2"));
}

#[test]
fn numbers_of_a_run_and_a_dataset_become_scalars() {
    let dir = tempfile::tempdir().unwrap();
    let read = |folder: &str| {
        let file = std::fs::read_dir(dir.path().join(folder)).unwrap().flatten().next().unwrap().path();
        e2h_report::tensorboard::read(&file).unwrap()
    };
    run(dir.path());
    let count = write_scalars(dir.path(), &dir.path().join("tb"), 1.0e9).unwrap();
    let events = read("tb");
    assert_eq!(events.iter().map(|e| e.scalars.len()).sum::<usize>(), count);
    let success = ("eval/success_rate".to_owned(), 0.75);
    let success = events.iter().find(|e| e.scalars.contains(&success)).unwrap();
    assert_eq!((success.step, success.wall_time.to_bits()), (1, 1.0e9_f64.to_bits()));

    let root = dir.path().join("data");
    dataset(&root, 4);
    write_scalars(&root, &dir.path().join("tb2"), 1.0e9).unwrap();
    let successes: Vec<(i64, f32)> = read("tb2")
        .iter()
        .flat_map(|e| e.scalars.iter().filter(|s| s.0 == "episode/success").map(|s| (e.step, s.1)))
        .collect();
    assert_eq!(successes, [(0, 1.0), (1, 0.0), (2, 1.0), (3, 0.0)]);
}

/// The browser of this machine, if there is one.
fn browser() -> Option<PathBuf> {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).flat_map(|d| names.map(|n| d.join(n))).find(|p| p.is_file())
}

/// The page as the browser has it once its script has run.
fn dom(browser: &Path, page: &Path, fragment: &str) -> String {
    let profile = tempfile::tempdir().unwrap();
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"])
        .args([
            "--disable-component-update",
            "--disable-sync",
            "--no-first-run",
            "--virtual-time-budget=4000",
        ])
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .arg("--dump-dom")
        .arg(format!("file://{}#{fragment}", page.display()))
        .output()
        .unwrap();
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn a_browser_filters_and_plays() {
    let Some(browser) = browser() else {
        println!("skipped: no chromium, chromium-browser or google-chrome on PATH");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    run(dir.path());
    let out = dir.path().join("view.html");
    let written = write(dir.path(), &out, &Options::default()).unwrap();

    let all = dom(&browser, &out, "");
    assert!(all.contains(&format!("data-shown=\"{}\"", written.shown)), "the script did not run");
    assert!(all.contains("<option value=\"timeout\">timeout (1)</option>"));
    assert!(!all.contains("<canvas"), "nothing plays before it is opened");

    let some = dom(&browser, &out, "outcome=timeout&open=2");
    assert!(some.contains("data-shown=\"1\""), "the filter did not work");
    assert!(some.contains("data-started=\"done\"") && some.contains("<canvas"), "the player did not start");
    assert!(some.contains("class=\"now\" style=\"left:"), "plots have no cursor");

    // Hostile text changes nothing: the one script of the page still runs.
    let root = dir.path().join("data");
    dataset(&root, 3);
    write(&root, &out, &Options::default()).unwrap();
    let hostile = dom(&browser, &out, "outcome=failure&open=1");
    assert!(hostile.contains("data-shown=\"1\"") && hostile.contains("<canvas"), "the script did not run");
}
