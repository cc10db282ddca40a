use crate::{assert_success, nut_assembly, text};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

fn wait_for(path: &Path) {
    for _ in 0..60_000 {
        if path.exists() {
            return;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    panic!("{} never came", path.display());
}

#[cfg(unix)]
#[test]
fn signals_save_the_training_state_and_end_with_their_status() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let long = "--set=train.easy_steps=1000000";
    let never = "--set=train.save_every=1000000";
    for (signal, status) in [("-TERM", 143), ("-INT", 130)] {
        let resume = out.exists();
        let mut command = nut_assembly(&out, &[long, never]);
        let child = command.args(resume.then_some("--resume")).stderr(Stdio::piped()).spawn().unwrap();
        wait_for(&out.join("demonstrations"));
        std::thread::sleep(Duration::from_millis(500));
        assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
        let ended = child.wait_with_output().unwrap();
        let words = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(status), "{words}");
        assert!(words.contains("--resume") && words.contains("SIG"), "{words}");
        assert!(out.join("policy_easy/training.safetensors").exists());
    }
}

#[test]
fn words_that_cannot_be_written_stop_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let program = crate::example("nut_assembly").get_program().to_owned();
    for (name, shell) in [("full", "\"$@\" 2>/dev/full >/dev/null"), ("closed", "\"$@\" 2>/dev/null | true")]
    {
        let out = dir.path().join(name);
        let output = Command::new("bash")
            .args(["-c", &format!("set -o pipefail; {shell}"), "bash"])
            .arg(&program)
            .args(["--preset", "smoke", "--out"])
            .arg(&out)
            .args(crate::SMALL)
            .output()
            .unwrap();
        assert_success(&output);
        assert!(out.join("report.html").exists(), "{name}");
    }
}

/// Every program that prints, with little to do. NEW is a folder of its own; RUN, SET and OURS are a finished run, recordings and a
/// checkpoint that LeRobot can have.
const PROGRAMS: [(&str, &str); 18] = [
    ("nut_assembly", "--preset smoke --quiet --resume --out RUN SMALL"),
    (
        "compare",
        "--tasks disk --methods hard-demos --seeds 0 --preset smoke --trials 1 --quiet --out NEW/compare",
    ),
    ("curve", "RUN --out NEW/curve.svg"),
    ("dataset", "check SET"),
    ("env_step", "--task disk --px 16 --steps 5"),
    ("evaluate", "--checkpoint RUN/iteration_00/policy --trials 1"),
    ("experts", "--task disk --trials 1"),
    ("export", "--checkpoint OURS --lerobot NEW/lerobot"),
    ("flat_memory", "1"),
    ("gallery", "--task disk --size 16 --out NEW"),
    ("interop", "write NEW/set"),
    ("mixed_network", ""),
    ("peer", "--batch 1 --repeats 1 --threads 1"),
    ("real_robot", "record --episodes 1 --out NEW/recordings"),
    ("refine", "--dataset SET --out NEW/refined --pose observation.state[0:7] --rotation wxyz --task back"),
    ("speed", "1 nothing"),
    (
        "train",
        "--dataset SET --preset smoke --set data.validation=0.3 --set data.resize=[40,40] --set train.steps=1 --out NEW/trained",
    ),
    ("view", "RUN --out NEW/page.html --tensorboard NEW/events"),
];
/// The other benchmarks are run by what runs `nut_assembly`; `publish` needs a hub; `lerobot_actions` prints nothing;
/// `serve` waits for clients, and `teleop` for a person.
const OTHERS: [&str; 15] = [
    "brush",
    "cube_pick_place",
    "cube_stack",
    "cylinder_pick_place",
    "disk",
    "lerobot_actions",
    "mouse",
    "own_policy",
    "own_task",
    "peg_insertion",
    "publish",
    "rod_insertion",
    "serve",
    "teleop",
    "test_tube",
];

#[test]
fn every_program_is_tried_with_outputs_that_take_nothing() {
    let mut there = vec![];
    let crates = std::fs::read_dir("crates").unwrap().flatten().map(|e| e.path().join("examples"));
    for folder in crates.chain([PathBuf::from("examples")]).filter(|folder| folder.exists()) {
        for path in std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path()) {
            if path.extension().is_some_and(|e| e == "rs") || path.join("main.rs").exists() {
                there.push(path.file_stem().unwrap().to_str().unwrap().to_owned());
            }
        }
    }
    there.sort_unstable();
    let mut listed: Vec<&str> = PROGRAMS.iter().map(|p| p.0).chain(OTHERS).collect();
    listed.sort_unstable();
    assert_eq!(there, listed);
}

#[cfg(target_os = "linux")]
#[test]
fn closed_pipes_end_programs_quietly_and_full_disks_with_a_message() {
    let dir = tempfile::tempdir().unwrap();
    let (run, set) = (dir.path().join("run"), dir.path().join("run/demonstrations"));
    assert_success(&nut_assembly(&run, &[]).output().unwrap());
    let ours = dir.path().join("ours");
    let for_lerobot = "lerobot_alignment=true n_action_steps=8 n_image_steps=2 relative_features=false encoder_width=64 \
                       encoder_blocks=[2,2,2,2] image_features=8";
    let mut arguments: Vec<String> =
        for_lerobot.split_whitespace().map(|v| format!("--set=policy.{v}")).collect();
    arguments.extend(["--set=train.step.conditions=2", "--set=loop.iterations=0"].map(str::to_owned));
    assert_success(&nut_assembly(&ours, &[]).args(arguments).output().unwrap());

    let tried = |name: &str, arguments: &str| {
        let new = tempfile::tempdir_in(dir.path()).unwrap();
        let place = |text: &str| {
            let places = [("NEW", new.path()), ("RUN", &run), ("SET", &set)];
            let text = text.replace("OURS", ours.join("iteration_00/policy").to_str().unwrap());
            places.iter().fold(text, |text, (word, path)| text.replace(word, path.to_str().unwrap()))
        };
        let mut command = crate::example(name);
        for argument in arguments.split_whitespace() {
            if argument == "SMALL" {
                command.args(crate::SMALL)
            } else {
                command.arg(place(argument))
            };
        }
        (command, new)
    };
    let full = || std::fs::File::options().write(true).open("/dev/full").unwrap();
    let closed = || std::io::pipe().unwrap().1;
    for (name, arguments) in PROGRAMS {
        let (mut command, _new) = tried(name, arguments);
        let output = command.stdout(closed()).output().unwrap();
        let words = text(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{name} behind a closed pipe: {words}");
        assert!(!words.contains("rror") && !words.contains("panicked"), "{name}: {words}");

        let (mut command, _new) = tried(name, arguments);
        let output = command.stdout(full()).output().unwrap();
        let words = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name} with a full disk: {words}");
        assert!(words.contains("standard output") && !words.contains("panicked"), "{name}: {words}");

        let (mut command, _new) = tried(name, arguments);
        let output = command.stderr(full()).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{name} with words that go nowhere");
        assert!(!output.stdout.is_empty(), "{name} prints nothing");
    }

    // Here the status is what was asked for, whoever reads.
    std::fs::write(first(&set.join("data"), "parquet"), "damage").unwrap();
    let (mut command, _new) = tried("dataset", "check SET");
    let output = command.stdout(closed()).output().unwrap();
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(1), String::new()));
}

fn first(folder: &Path, extension: &str) -> PathBuf {
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == extension) {
                return path;
            }
        }
    }
    panic!("no .{extension} below {}", folder.display());
}

#[test]
fn a_flipped_bit_in_what_a_run_reads_again_is_told_by_file_name() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    assert_success(&nut_assembly(&out, &[]).output().unwrap());
    for path in [
        first(&out.join("demonstrations/data"), "parquet"),
        out.join("demonstrations/notes.json"),
        out.join("iteration_00/record.json"),
        out.join("iteration_00/policy/notes.json"),
        out.join("iteration_01/segments/notes.json"),
        out.join("iteration_01/segments/files.json"),
    ] {
        let whole = std::fs::read(&path).unwrap();
        // A digit, so that JSON stays JSON.
        let at = (whole.len() / 2..whole.len()).find(|&i| whole[i].is_ascii_digit()).unwrap();
        let mut flipped = whole.clone();
        flipped[at] ^= 1;
        std::fs::write(&path, flipped).unwrap();
        let output = nut_assembly(&out, &["--resume"]).output().unwrap();
        let words = text(&output.stderr);
        assert!(!output.status.success(), "{} is used in silence", path.display());
        assert!(words.contains(path.to_str().unwrap()) && words.contains("SHA-256"), "{words}");
        std::fs::write(&path, whole).unwrap();
    }
    // The seal itself: its digest, and its name, without which the file would look like one that has none.
    for sealed in ["policy_easy/notes.json", "iteration_01/segments/files.json"] {
        let sealed = out.join(sealed);
        let whole = std::fs::read_to_string(&sealed).unwrap();
        for damaged in
            [whole.replacen("sha256", "sha254", 1), whole.replacen("\"sha256\": \"", "\"sha256\": \"f", 1)]
        {
            std::fs::write(&sealed, &damaged).unwrap();
            let output = nut_assembly(&out, &["--resume"]).output().unwrap();
            let words = text(&output.stderr);
            assert!(!output.status.success() && words.contains(sealed.to_str().unwrap()), "{words}");
        }
        std::fs::write(&sealed, whole).unwrap();
    }
    let files = results_of(&out);
    assert_success(&nut_assembly(&out, &["--resume"]).output().unwrap());
    // To the last digit of every number that was read and written again.
    assert!(files == results_of(&out), "a resumed run writes other results");
}

fn results_of(run: &Path) -> [Vec<u8>; 2] {
    ["results.json", "report.html"].map(|file| std::fs::read(run.join(file)).unwrap())
}

/// No stage reads pictures again, but the report shows them.
#[test]
fn a_damaged_picture_is_told_by_file_name_and_a_removed_one_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    // A reversal is accepted and shown, whatever becomes of its gripper.
    let arguments =
        ["--set=evaluation.filmed=1", "--set=refine.gate.enabled=false", "--set=env.horizon_easy=300"];
    let arguments = [&arguments[..], &["--set=train.easy_steps=400", "--set=train.step.noises=1"]].concat();
    let run = |resume: &[&str]| nut_assembly(&out, &[&arguments[..], resume].concat()).output().unwrap();
    assert_success(&run(&[]));
    for picture in ["iteration_00/rollouts.png", "iteration_01/filter.svg", "iteration_01/reversals.json"] {
        let place = out.join(picture);
        let whole = std::fs::read(&place).unwrap();
        let mut flipped = whole.clone();
        flipped[whole.len() / 2] ^= 1;
        std::fs::write(&place, flipped).unwrap();
        let output = run(&["--resume"]);
        let words = text(&output.stderr);
        assert!(!output.status.success(), "{picture} is used in silence");
        assert!(words.contains(place.to_str().unwrap()) && words.contains("SHA-256"), "{words}");
        std::fs::remove_file(&place).unwrap();
        assert_success(&run(&["--resume"]));
        std::fs::write(&place, whole).unwrap();
    }
}

/// Calls `mju_error` at the tenth step.
#[cfg(target_os = "linux")]
const BREAKS: &str = r#"
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdatomic.h>
static atomic_long count;
void mj_step(const void *m, void *d) {
    void (*real)(const void *, void *) = dlsym(RTLD_NEXT, "mj_step");
    void (*error)(const char *, ...) = dlsym(RTLD_DEFAULT, "mju_error");
    if (atomic_fetch_add(&count, 1) == 9) error("the stack is full");
    real(m, d);
}
"#;

#[cfg(target_os = "linux")]
#[test]
fn a_mujoco_that_cannot_go_on_says_why() {
    let dir = tempfile::tempdir().unwrap();
    let (source, library) = (dir.path().join("breaks.c"), dir.path().join("breaks.so"));
    std::fs::write(&source, BREAKS).unwrap();
    let mut built = Command::new("cc");
    built.args(["-shared", "-fPIC", "-o"]).arg(&library).arg(&source).arg("-ldl");
    assert!(built.status().unwrap().success());
    let output = nut_assembly(&dir.path().join("run"), &[]).env("LD_PRELOAD", &library).output().unwrap();
    let words = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1));
    assert!(words.contains("MuJoCo cannot go on") && words.contains("the stack is full"), "{words}");
}
