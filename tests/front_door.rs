use super::{assert_success, example, text};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

fn front_door(arguments: &[&str]) -> Output {
    let output = Command::new(env!("CARGO_BIN_EXE_auto-e2h")).args(arguments).output().unwrap();
    assert_success(&output);
    output
}

/// Name and source of every example of the root package and of the crates.
fn examples() -> Vec<(String, PathBuf)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let crates = std::fs::read_dir(root.join("crates")).unwrap().flatten().map(|c| c.path().join("examples"));
    let folders = crates.chain([root.join("examples")]).filter(|f| f.is_dir());
    let files = folders.flat_map(|f| std::fs::read_dir(f).unwrap().flatten().map(|e| e.path()));
    let source = |p: PathBuf| if p.is_dir() { p.join("main.rs") } else { p };
    let name = |p: &Path| p.file_stem().unwrap().to_string_lossy().into_owned();
    let mut found: Vec<_> = files.map(|p| (name(&p), source(p))).filter(|e| e.1.is_file()).collect();
    found.sort();
    found
}

#[test]
fn it_lists_everything_there_is() {
    let listed = text(&front_door(&[]).stdout);
    assert_eq!(listed, text(&front_door(&["list"]).stdout));
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut names: Vec<String> = auto_e2h::env::registry().iter().map(|n| (*n).to_owned()).collect();
    names.extend(["smoke", "laptop", "paper"].map(str::to_owned));
    names.extend(auto_e2h::learn::methods::registry().iter().map(|m| m.name.to_owned()));
    names.extend(examples().into_iter().map(|e| e.0));
    let checkpoints = std::fs::read_dir(root.join("checkpoints")).unwrap().flatten();
    let checkpoints = checkpoints.filter(|c| c.path().join("policy.json").exists());
    names.extend(checkpoints.map(|c| c.file_name().to_string_lossy().into_owned()));
    for name in names {
        assert!(listed.lines().any(|l| l.split_whitespace().next() == Some(&name)), "{name} in {listed}");
    }
    assert!(
        listed.contains("100 of 100; nut_assembly (loose) from 10") && !listed.contains("not measured"),
        "{listed}"
    );
    assert!(!listed.contains('\u{1b}'), "colours in a pipe");
}

#[test]
fn the_doctor_says_what_this_machine_has() {
    let said = text(&front_door(&["doctor"]).stdout);
    let version = mujoco_native::VERSION;
    assert!(
        said.contains(&format!("MuJoCo         {version}, ")) && !said.contains("bindings are made"),
        "{said}"
    );
    for what in ["libmujoco", "threads", "vector units", "GPU", "ffmpeg", "auto-e2h", "hub"] {
        assert!(said.contains(what), "{what} in {said}");
    }
}

#[test]
fn nobody_reading_is_no_failure() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_auto-e2h")).stdout(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    assert!(child.wait().unwrap().success());
}

#[test]
fn every_example_says_its_version_and_a_command_to_begin_with() {
    for (name, source) in examples() {
        let run = |argument: &str| {
            let output = example(&name).arg(argument).env("NO_COLOR", "1").output().expect(&name);
            assert_success(&output);
            text(&output.stdout)
        };
        let version = run("--version");
        assert!(version.trim_end().ends_with(env!("CARGO_PKG_VERSION")), "{name}: {version}");
        let help = run("--help");
        assert!(!help.contains('\u{1b}'), "{name}: colours");
        let commands: Vec<&str> = help.lines().map(str::trim).filter(|l| l.contains("cargo run ")).collect();
        assert!((1..=2).contains(&commands.len()), "{name}: {help}");
        // What the help says is what the first comment of the program says.
        if !auto_e2h::env::registry().contains(&name.as_str()) {
            let text = std::fs::read_to_string(source).unwrap();
            for command in commands {
                assert!(
                    text.lines().any(|l| l.starts_with("//!") && l.contains(command)),
                    "{name}: {command}"
                );
            }
        }
    }
}
