use std::path::{Path, PathBuf};

fn crates() -> Vec<(String, PathBuf)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates");
    let mut found: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .flatten()
        .filter(|e| e.path().join("Cargo.toml").exists())
        .map(|e| (e.file_name().to_string_lossy().into_owned(), e.path()))
        .collect();
    found.sort();
    found
}

fn sources(dir: &Path, out: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).unwrap().flatten() {
        let path = entry.path();
        if path.is_dir() {
            sources(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

fn dependencies(path: &Path) -> Vec<String> {
    let table: toml::Table = std::fs::read_to_string(path.join("Cargo.toml")).unwrap().parse().unwrap();
    let section = table.get("dependencies").and_then(toml::Value::as_table);
    section.map(|t| t.keys().cloned().collect()).unwrap_or_default()
}

#[test]
fn only_the_crates_that_may_name_candle_or_mujoco_do() {
    for (name, path) in crates() {
        for dependency in dependencies(&path) {
            if dependency.starts_with("candle") {
                assert!(["nn", "policy"].contains(&name.as_str()), "{name} depends on {dependency}");
            }
            if dependency == "mujoco-rs" {
                assert_eq!(name, "env", "{name} depends on {dependency}");
            }
        }
    }
}

#[test]
fn what_needs_no_network_and_no_simulator_stands_on_neither() {
    for (name, path) in crates() {
        let found = dependencies(&path);
        let own: Vec<&String> =
            found.iter().filter(|d| d.starts_with("e2h-") || *d == "mujoco-native").collect();
        match name.as_str() {
            "core" | "nn" => assert!(own.is_empty(), "{name} depends on {own:?}"),
            "refine" | "data" => assert_eq!(own, ["e2h-core"], "{name}"),
            "serve" => assert_eq!(own, ["e2h-core", "e2h-data", "e2h-nn", "e2h-policy"], "{name}"),
            "report" => assert_eq!(own, ["e2h-core", "e2h-data", "e2h-refine"], "{name}"),
            _ => {}
        }
    }
}

#[test]
fn the_code_map_lists_every_crate() {
    let text =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("ARCHITECTURE.md")).unwrap();
    let map: Vec<&str> =
        text.lines().filter_map(|l| l.strip_prefix("| `crates/")?.split('`').next()).collect();
    let mut listed: Vec<&str> = map.iter().filter(|n| **n != "facade").copied().collect();
    listed.sort_unstable();
    assert_eq!(listed, crates().iter().map(|c| c.0.as_str()).collect::<Vec<_>>());
}

#[test]
fn a_layer_of_ones_own_needs_candle_and_one_crate() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/open_layers");
    let mut found = dependencies(&path);
    found.sort();
    assert_eq!(found, ["candle-core", "candle-nn", "e2h-nn"]);
}

/// What a task is called in code: its type and its module. Its name may stand in configurations and examples.
fn task_types() -> Vec<String> {
    let capital = |part: &str| part[..1].to_uppercase() + &part[1..];
    let type_of = |name: &str| name.split('_').map(capital).collect::<String>();
    auto_e2h::env::registry().iter().flat_map(|n| [type_of(n) + "::", format!("{n}::")]).collect()
}

#[test]
fn methods_name_no_task_and_tasks_no_method() {
    for (name, path) in crates() {
        let methods = ["e2h_policy", "e2h_learn", "e2h_nn", "e2h_refine", "e2h_report"];
        let words: Vec<String> = match name.as_str() {
            "learn" | "report" | "policy" | "refine" | "data" => task_types(),
            "env" => methods.map(str::to_owned).to_vec(),
            _ => continue,
        };
        let mut files = vec![];
        sources(&path.join("src"), &mut files);
        for file in files {
            let text = std::fs::read_to_string(&file).unwrap();
            for word in &words {
                assert!(!text.contains(word.as_str()), "{} names {word}", file.display());
            }
        }
    }
}

#[test]
fn every_pair_has_a_program_and_a_configuration_of_its_own() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for name in auto_e2h::env::registry() {
        let read = |path: String| std::fs::read_to_string(root.join(&path)).expect(&path);
        let program = read(format!("examples/{name}.rs"));
        assert!(program.contains(&format!("common::main(\"{name}\",")), "{name}");
        assert!(read(format!("configs/tasks/{name}.toml")).contains(&format!("name = \"{name}\"")));
    }
}
