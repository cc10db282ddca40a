//! What there is. Everything is read from the checkout's own files, so that a new task, preset, policy or program is listed as
//! soon as it is there.

use auto_e2h::core::{Failure, say};
use auto_e2h::env::{registry, variants};
use auto_e2h::learn::methods;
use auto_e2h::report::record::{RunResults, parse_results};
use std::path::{Path, PathBuf};

type Result<T> = std::result::Result<T, Failure>;

/// The checkout: the current folder if it is one, otherwise where this program was built.
fn checkout() -> Result<PathBuf> {
    let built = Path::new(env!("CARGO_MANIFEST_DIR"));
    let found = [Path::new("."), built].into_iter().find(|f| f.join("configs/presets").is_dir());
    found
        .map(Path::to_owned)
        .ok_or_else(|| Failure::from("expected a checkout of Auto-E2H in the current folder"))
}

/// Prints what there is.
pub(super) fn list() -> Result<()> {
    let root = checkout()?;
    let examples = examples(&root)?;
    say("Tasks\n")?;
    for name in registry() {
        let words = comment(&read(&root.join(format!("configs/tasks/{name}.toml")))?, "# ");
        row(name, &words)?;
        let variants = variants(name);
        if variants.len() > 1 {
            row("", &format!("variants: {}", variants.join(", ")))?;
        }
    }
    say(
        "\n  cargo run --release --example nut_assembly -- --preset smoke    # any of them; --help has the rest\n",
    )?;

    say("Presets\n")?;
    for path in files(&root.join("configs/presets"), "toml")? {
        row(&stem(&path), &comment(&read(&path)?, "# "))?;
    }
    say("\n  --preset NAME; every value in configs/presets can be set with --set key=value\n")?;

    say("Methods\n")?;
    for method in methods::registry() {
        row(method.name, method.about().trim_end_matches('.'))?;
    }
    say("\n  --method NAME; values of configs/methods are laid over preset and task\n")?;

    say(
        "Trained policies, and how they did when they were trained (checkpoints/NAME/README.md has the rest)\n",
    )?;
    for folder in entries(&root.join("checkpoints"))? {
        if folder.join("policy.json").is_file() {
            row(&stem(&folder), &policy(&folder)?)?;
        }
    }
    say("\n  cargo run --release --example evaluate -- --checkpoint checkpoints/nut_assembly --trials 50\n")?;

    say("Other programs\n")?;
    for example in examples.iter().filter(|e| !registry().contains(&e.name.as_str())) {
        row(&example.name, &example.summary)?;
        for command in &example.commands {
            row("", command)?;
        }
    }
    say("\n  each has --help; `cargo run --release -- doctor` says what this machine has for them")?;
    Ok(())
}

/// A name and words, wrapped into the column right of the names.
fn row(name: &str, words: &str) -> Result<()> {
    const NAMES: usize = 20;
    const WORDS: usize = 100;
    let mut lines = vec![String::new()];
    // A command stays on its line, to be copied.
    let parts: Vec<&str> = if words.contains("cargo run") { vec![words] } else { words.split(' ').collect() };
    for part in parts {
        match lines.last_mut() {
            Some(line) if line.is_empty() || line.len() + part.len() < WORDS => {
                if !line.is_empty() {
                    line.push(' ');
                }
                line.push_str(part);
            }
            _ => lines.push(part.to_owned()),
        }
    }
    for (i, line) in lines.iter().enumerate() {
        say(format_args!("  {:<NAMES$} {line}", if i == 0 { name } else { "" }))?;
    }
    Ok(())
}

/// How a published policy did where it was measured, and what it is a policy of.
fn policy(folder: &Path) -> Result<String> {
    let description: serde_json::Value = serde_json::from_str(&read(&folder.join("policy.json"))?)?;
    let of = |key: &str| description.pointer(&format!("/provenance/{key}"));
    let word = |key: &str| of(key).and_then(serde_json::Value::as_str).unwrap_or_default().to_owned();
    let number = |key: &str| of(key).and_then(serde_json::Value::as_u64).unwrap_or_default();
    let (task, variant, preset) = (word("task"), word("run/task/variant"), word("preset"));
    let (seed, iteration) = (number("seed"), number("iteration"));
    let made = |r: &&RunResults| (&r.task, &r.variant, &r.preset, r.seed) == (&task, &variant, &preset, seed);
    let results = folder.join("results.json");
    let runs = if results.is_file() { parse_results(&read(&results)?)? } else { vec![] };
    let row = runs.iter().find(made).and_then(|r| {
        r.iterations.iter().find(|row| u64::from(row.iteration) == iteration).map(|row| &row.evaluation)
    });
    let measured = row.map_or("not measured".to_owned(), |e| format!("{} of {}", e.successes, e.trials));
    let pair = if variant.is_empty() { task } else { format!("{task} ({variant})") };
    let demonstrations = number("run/loop/demonstrations");
    Ok(format!(
        "{measured}; {pair} from {demonstrations} easy demonstrations, {preset}, seed {seed}, iteration {iteration}"
    ))
}

/// A program as its first comment describes it.
struct Example {
    name: String,
    summary: String,
    commands: Vec<String>,
}

/// All programs of the root package and of the crates, by name.
fn examples(root: &Path) -> Result<Vec<Example>> {
    let mut folders = vec![root.join("examples")];
    folders.extend(
        entries(&root.join("crates"))?.into_iter().map(|c| c.join("examples")).filter(|f| f.is_dir()),
    );
    let mut found = vec![];
    for folder in folders {
        for path in entries(&folder)? {
            let file = if path.is_dir() { path.join("main.rs") } else { path.clone() };
            if !file.is_file() || file.extension().is_none_or(|e| e != "rs") {
                continue;
            }
            let text = read(&file)?;
            let header: Vec<&str> =
                text.lines().map_while(|l| l.strip_prefix("//!")).map(str::trim).collect();
            found.push(Example {
                name: stem(&path),
                summary: comment(&text, "//! "),
                commands: commands(&header),
            });
        }
    }
    found.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(found)
}

/// The commands in a comment; a line that ends with a backslash goes on in the next.
fn commands(lines: &[&str]) -> Vec<String> {
    let mut found: Vec<String> = vec![];
    let mut open = false;
    for line in lines {
        let text = line.trim_end_matches('\\').trim_end();
        match (line.find("cargo run"), found.last_mut()) {
            (_, Some(last)) if open => *last = format!("{last} {text}"),
            (Some(_), _) => found.push(text.to_owned()),
            (None, _) => {}
        }
        open = line.ends_with('\\');
    }
    found
}

/// The first sentence of the comment that a file begins with.
fn comment(text: &str, mark: &str) -> String {
    let lines: Vec<&str> = text.lines().map_while(|l| l.strip_prefix(mark)).collect();
    let words = lines.join(" ");
    words.split_once(". ").map_or(words.as_str(), |(first, _)| first).trim_end_matches('.').to_owned()
}

fn read(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).map_err(|e| Failure::from(format!("reading {}: {e}", path.display())))
}

/// What lies in a folder, sorted.
fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let failed = |e| Failure::from(format!("reading {}: {e}", folder.display()));
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        found.push(entry.map_err(failed)?.path());
    }
    found.sort();
    Ok(found)
}

fn files(folder: &Path, extension: &str) -> Result<Vec<PathBuf>> {
    Ok(entries(folder)?.into_iter().filter(|p| p.extension().is_some_and(|e| e == extension)).collect())
}

fn stem(path: &Path) -> String {
    path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default()
}
