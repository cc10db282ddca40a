//! Compares methods on pairs: learns with each, measures all on the same trials, and says which is better.
//!
//! ```text
//! cargo run --release --example compare -- --tasks cube_pick_place --methods auto-e2h,direct-h --seeds 0,1 --out runs/compare
//! cargo run --release --example compare -- --tasks cube_pick_place --preset smoke --seeds 0 --trials 10 --out runs/compare_smoke
//! ```
//!
//! The same command goes on where it was stopped. `--shard i/n` does a part of the runs, for several machines that share a folder or
//! have it copied together; `--merge` only writes the page of the runs that are there. `--until-decided` goes on with the trials of last
//! policies that no test has told apart yet, up to 500 of each.

use anyhow::{Context as _, bail, ensure};
use auto_e2h::core::{Direction, mention, say};
use auto_e2h::data::{read_text, write_atomic};
use auto_e2h::learn::{Error, Progress, Published, Run, RunOptions, Stop, evaluate};
use auto_e2h::nn::{Compute, Precision};
use auto_e2h::report::compare::{self, ComparedRun, Comparison};
use auto_e2h::report::record::Evaluation;
use clap::Parser;
use std::collections::VecDeque;
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::Duration;

/// Learns several pairs with several methods, and tells which method is better.
#[derive(Parser, Clone)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example compare -- --tasks cube_pick_place --methods auto-e2h,direct-h --seeds 0,1 --out runs/compare\n  cargo run --release --example compare -- --tasks cube_pick_place --preset smoke --seeds 0 --trials 10 --out runs/compare_smoke"
)]
struct Arguments {
    /// Task pairs.
    #[arg(long, value_delimiter = ',', required = true, value_name = "A,B")]
    tasks: Vec<String>,
    /// Methods; the others are compared with the first.
    #[arg(long, value_delimiter = ',', default_value = "auto-e2h,direct-h", value_name = "X,Y")]
    methods: Vec<String>,
    /// Training seeds.
    #[arg(long, value_delimiter = ',', default_value = "0,1", value_name = "I,J")]
    seeds: Vec<u64>,
    /// Sizes and step counts to run with: smoke, laptop or paper.
    #[arg(long, default_value = "laptop")]
    preset: String,
    /// Override a value of every run's configuration, for example loop.demonstrations=5 (may be repeated).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Folder of the comparison.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Trials of each first and last policy.
    #[arg(long, default_value_t = 200)]
    trials: usize,
    /// Add trials of last policies until a test tells them from the reference's, at most so many; verdicts are then by E-values.
    #[arg(long, value_name = "MOST", num_args = 0..=1, default_missing_value = "500", conflicts_with = "shard")]
    until_decided: Option<usize>,
    /// Seed of these trials; no choice should have been made on it.
    #[arg(long, default_value_t = 800_000)]
    evaluation_seed: u64,
    /// Runs side by side (by default one a core); never changes a result.
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Do part I of N of the runs, I from 1.
    #[arg(long, value_name = "I/N", conflicts_with = "merge")]
    shard: Option<String>,
    /// Only write the page of the runs that are there.
    #[arg(long)]
    merge: bool,
    /// Where networks are trained: cpu, cuda or cuda:N. A folder may go on elsewhere; results may then differ in the last bits.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Do one run alone, in this process.
    #[arg(long, value_name = "TASK/METHOD/SEED", conflicts_with_all = ["merge", "shard"])]
    only: Option<String>,
    /// Threads of a run that is done alone.
    #[arg(long, requires = "only")]
    threads: Option<usize>,
    /// Show no progress.
    #[arg(long)]
    quiet: bool,
}

/// One run of the comparison.
#[derive(Clone, PartialEq)]
struct Job {
    task: String,
    method: String,
    seed: u64,
}

impl Job {
    fn name(&self) -> String {
        format!("{}/{}/{}", self.task, self.method, self.seed)
    }

    /// Its run directory.
    fn folder(&self, out: &Path) -> PathBuf {
        out.join(&self.task).join(format!("{}-{}", self.method, self.seed))
    }

    /// Beside its run directory.
    fn file(&self, out: &Path, kind: &str) -> PathBuf {
        out.join(&self.task).join(format!("{}-{}.{kind}", self.method, self.seed))
    }

    fn options(&self, a: &Arguments) -> RunOptions {
        RunOptions {
            preset: a.preset.clone(),
            method: self.method.clone(),
            seed: self.seed,
            set: a.set.clone(),
            quiet: a.quiet,
            device: a.device.clone(),
            threads: a.threads,
            ..RunOptions::new(&self.task)
        }
    }
}

fn main() -> ExitCode {
    match program() {
        Ok(status) => status,
        Err(error) => {
            if let Some(Error::Stopped { signal }) = error.downcast_ref::<Error>() {
                mention("stopped; the same command goes on from here");
                return ExitCode::from(u8::try_from(128 + signal).unwrap_or(1));
            }
            mention(format_args!("Error: {:?}", auto_e2h::core::Failure::from(error)));
            ExitCode::FAILURE
        }
    }
}

fn program() -> anyhow::Result<ExitCode> {
    let mut a = Arguments::parse();
    let stop = Stop::on_signals()?;
    let jobs = check(&a)?;
    plan(&mut a)?;
    if let Some(name) = &a.only {
        let job = jobs.iter().find(|j| j.name() == *name);
        let job = job.with_context(|| {
            format!("--only: expected a run of these tasks, methods and seeds, got {name}")
        })?;
        run(&a, job, &jobs, &stop)?;
        return Ok(ExitCode::SUCCESS);
    }
    let failed = if a.merge { 0 } else { work(&a, &jobs, &stop)? };
    if a.shard.is_none() {
        decide(&a, &jobs, &stop)?;
    }
    finish(&a, &jobs)?;
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// All runs, the first method's first: others begin with its demonstrations and policies where they are theirs too. Everything that can
/// be wrong is said before any work.
fn check(a: &Arguments) -> anyhow::Result<Vec<Job>> {
    fn twice<T: PartialEq>(all: &[T]) -> bool {
        (1..all.len()).any(|i| all[..i].contains(&all[i]))
    }
    ensure!(!twice(&a.tasks), "--tasks: one is named twice");
    ensure!(!twice(&a.methods), "--methods: one is named twice");
    ensure!(!twice(&a.seeds), "--seeds: one is named twice");
    ensure!((1..=100_000).contains(&a.trials), "--trials: expected 1 to 100000, got {}", a.trials);
    if let Some(most) = a.until_decided {
        ensure!(
            (a.trials..=100_000).contains(&most),
            "--until-decided: expected from --trials ({}) to 100000, got {most}",
            a.trials
        );
    }
    ensure!(a.jobs != Some(0), "--jobs: expected at least 1, got 0");
    Compute::open(&a.device, Precision::default())?;
    let mut jobs = vec![];
    for method in &a.methods {
        for task in &a.tasks {
            for &seed in &a.seeds {
                jobs.push(Job { task: task.clone(), method: method.clone(), seed });
            }
        }
    }
    for job in jobs.iter().filter(|j| j.seed == a.seeds[0]) {
        job.options(a).resolve().with_context(|| format!("{}, {}", job.task, job.method))?;
    }
    Ok(jobs)
}

/// Writes the plan of a new folder, and refuses a folder of another one. Once trials go on until a test has decided, they always do.
fn plan(a: &mut Arguments) -> anyhow::Result<()> {
    // What all runs of a folder share; pairs, methods and seeds may become more.
    let mut mine = serde_json::json!({
        "version": env!("CARGO_PKG_VERSION"),
        "preset": a.preset,
        "overrides": a.set,
        "trials": a.trials,
        "evaluation_seed": a.evaluation_seed,
    });
    let asked = a.until_decided;
    let mut with = |most: Option<usize>| {
        if let Some(most) = most {
            mine["until_decided"] = most.into();
        }
        mine.clone()
    };
    let path = a.out.join("plan.json");
    if path.exists() {
        let there: serde_json::Value = serde_json::from_str(&read_text(&path)?)
            .with_context(|| format!("{}: expected the plan of a comparison", path.display()))?;
        let planned = there.get("until_decided").and_then(serde_json::Value::as_u64);
        let planned = planned.and_then(|most| usize::try_from(most).ok());
        a.until_decided = asked.or(planned);
        let mine = with(planned.and(a.until_decided));
        ensure!(there == mine, "{} is another comparison: expected {mine}, found {there}", a.out.display());
        if planned.is_none() && asked.is_some() {
            write_atomic(&path, format!("{}\n", serde_json::to_string_pretty(&with(asked))?).as_bytes())?;
        }
        return Ok(());
    }
    let mine = with(asked);
    ensure!(!a.merge, "{}: expected a folder of a comparison, found no plan.json", a.out.display());
    let filled = std::fs::read_dir(&a.out).is_ok_and(|mut entries| entries.next().is_some());
    ensure!(!filled, "{} exists and is no comparison: give --out another folder", a.out.display());
    write_atomic(&path, format!("{}\n", serde_json::to_string_pretty(&mine)?).as_bytes())?;
    Ok(())
}

/// Learns, and measures the first and the last policy.
fn run(a: &Arguments, job: &Job, all: &[Job], stop: &Stop) -> anyhow::Result<()> {
    let folder = job.folder(&a.out);
    let shared = all.iter().filter(|j| j.task == job.task && j.seed == job.seed && *j != job);
    let shared = shared.map(|j| j.folder(&a.out)).find(|f| f.join("policy_easy/notes.json").exists());
    let options = RunOptions {
        out: Some(folder.clone()),
        resume: folder.exists(),
        initial_from: shared,
        stop: stop.clone(),
        ..job.options(a)
    };
    let (results, _) = Run::open(&options)?.learn()?;
    let last = results.iterations.last().map_or(0, |i| i.iteration);
    let progress = Progress::new(a.quiet).stopping(stop.clone());
    let measure = |iteration: u32| measure(a, job, iteration, 0..a.trials, &progress);
    let initial = measure(0)?;
    let compared = ComparedRun {
        last: if last == 0 { initial.clone() } else { measure(last)? },
        initial,
        filter: (1..=last)
            .rev()
            .find_map(|n| std::fs::read_to_string(folder.join(format!("iteration_{n:02}/filter.svg"))).ok()),
        results,
    };
    write_atomic(&job.file(&a.out, "json"), serde_json::to_string(&compared)?.as_bytes())?;
    Ok(())
}

/// A policy of a run on trials of the comparison.
fn measure(
    a: &Arguments,
    job: &Job,
    iteration: u32,
    trials: Range<usize>,
    progress: &Progress,
) -> anyhow::Result<Evaluation> {
    let folder = job.folder(&a.out).join(format!("iteration_{iteration:02}/policy"));
    let published = Published::open(&folder)?;
    let envs = published.envs(published.config.evaluation.parallel.min(trials.len()))?;
    Ok(evaluate(envs, published.policy(), Direction::Hard, trials, a.evaluation_seed, None, progress)?
        .evaluation)
}

/// Trials that are added at once, where a test has not decided.
const BLOCK: usize = 50;

/// Adds trials to last policies until a test tells every one from the reference's, or there are as many as there may be. What is added is
/// stored, so the same command goes on from there.
fn decide(a: &Arguments, jobs: &[Job], stop: &Stop) -> anyhow::Result<()> {
    let Some(most) = a.until_decided else { return Ok(()) };
    let progress = Progress::new(a.quiet).stopping(stop.clone());
    loop {
        let comparison = read(a, jobs)?;
        let open = comparison.undecided();
        if open.is_empty() {
            return Ok(());
        }
        for v in open {
            progress.say(&format!(
                "{}, seed {}: {} trials do not tell {} from {}",
                v.task, v.seed, v.trials, v.method, comparison.reference
            ));
            for method in [&comparison.reference, &v.method] {
                let job = Job { task: v.task.clone(), method: method.clone(), seed: v.seed };
                extend(a, &job, (v.trials + BLOCK).min(most), &progress)?;
            }
        }
    }
}

/// Measures the last policy of a run on more trials, up to `wanted` of them.
fn extend(a: &Arguments, job: &Job, wanted: usize, progress: &Progress) -> anyhow::Result<()> {
    let mut run = stored(a, job)?;
    let done = run.last.trials;
    if done >= wanted {
        return Ok(());
    }
    let last = run.results.iterations.last().map_or(0, |i| i.iteration);
    let more = measure(a, job, last, done..wanted, progress)?;
    let mut outcomes = std::mem::take(&mut run.last.outcomes);
    outcomes.extend(more.outcomes);
    run.last = Evaluation::new(outcomes, run.last.seconds + more.seconds);
    write_atomic(&job.file(&a.out, "json"), serde_json::to_string(&run)?.as_bytes())?;
    Ok(())
}

/// A run in a process of its own.
struct Running {
    job: Job,
    child: Child,
}

/// Does the runs that are not done, side by side; returns how many failed.
fn work(a: &Arguments, jobs: &[Job], stop: &Stop) -> anyhow::Result<usize> {
    let (part, parts) = match &a.shard {
        None => (0, 1),
        Some(text) => shard(text)?,
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mine: Vec<&Job> =
        jobs.iter().enumerate().filter(|(i, _)| i % parts == part).map(|(_, j)| j).collect();
    let mut waiting: VecDeque<&Job> =
        mine.iter().copied().filter(|j| !j.file(&a.out, "json").exists()).collect();
    let side = a.jobs.unwrap_or(cores).min(waiting.len().max(1));
    let threads = (cores / side).max(1);
    let progress = Progress::new(a.quiet).stopping(stop.clone());
    let bar = progress.bar("compare", mine.len() as u64);
    let (mut running, mut failed): (Vec<Running>, Vec<String>) = (vec![], vec![]);
    while !waiting.is_empty() || !running.is_empty() {
        while running.len() < side
            && let Some(job) = waiting.pop_front()
        {
            running.push(Running { job: job.clone(), child: start(a, job, threads)? });
        }
        let mut still = vec![];
        for mut r in running {
            match r.child.try_wait()? {
                None => still.push(r),
                Some(status) if status.success() => {}
                Some(status) => {
                    let log = r.job.file(&a.out, "log");
                    let text = std::fs::read_to_string(&log).unwrap_or_default();
                    let words = text.lines().last().unwrap_or("it said nothing").to_owned();
                    failed.push(format!(
                        "{} failed ({status}): {words} (all of it: {})",
                        r.job.name(),
                        log.display()
                    ));
                }
            }
        }
        running = still;
        let done = mine.len() - waiting.len() - running.len();
        let busy: Vec<String> =
            running.iter().map(|r| format!("{} {}", r.job.name(), iteration(a, &r.job))).collect();
        bar.set(done as u64, &busy.join(", "));
        if let Err(stopped) = stop.check() {
            end(running);
            return Err(stopped.into());
        }
        std::thread::sleep(Duration::from_millis(300));
    }
    bar.finish(&format!("{} of {} runs", mine.len() - failed.len(), mine.len()));
    for words in &failed {
        mention(words);
    }
    Ok(failed.len())
}

fn shard(text: &str) -> anyhow::Result<(usize, usize)> {
    let numbers = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match numbers {
        Some((i, n)) if (1..=n).contains(&i) => Ok((i - 1, n)),
        _ => bail!("--shard: expected I/N with I from 1 to N, got {text}"),
    }
}

/// Starts a run with this program; what it says goes to a file beside its folder.
fn start(a: &Arguments, job: &Job, threads: usize) -> anyhow::Result<Child> {
    let log = job.file(&a.out, "log");
    std::fs::create_dir_all(a.out.join(&job.task))?;
    let file =
        File::options().create(true).append(true).open(&log).with_context(|| log.display().to_string())?;
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["--only", &job.name(), "--preset", &a.preset, "--threads", &threads.to_string()]);
    command.args(["--tasks", &a.tasks.join(","), "--methods", &a.methods.join(",")]);
    command.args(["--seeds", &a.seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(",")]);
    command.args([
        "--device",
        &a.device,
        "--trials",
        &a.trials.to_string(),
        "--evaluation-seed",
        &a.evaluation_seed.to_string(),
    ]);
    command.arg("--out").arg(&a.out);
    for set in &a.set {
        command.args(["--set", set]);
    }
    // An interrupt from the terminal reaches this process alone, which passes it on once: a second one would end a run at once.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    command.stdin(Stdio::null()).stdout(file.try_clone()?).stderr(file);
    command.spawn().context("starting a run")
}

/// How far a run is, in words.
fn iteration(a: &Arguments, job: &Job) -> String {
    let folder = job.folder(&a.out);
    let done =
        (0..1000).take_while(|n| folder.join(format!("iteration_{n:02}/record.json")).exists()).count();
    if done == 0 { "begins".to_owned() } else { format!("iteration {done}") }
}

/// Asks runs to save their state, and waits until they have.
fn end(running: Vec<Running>) {
    for r in &running {
        let asked = Command::new("kill").args(["-TERM", &r.child.id().to_string()]).status();
        if !asked.is_ok_and(|s| s.success()) {
            mention(format_args!("{} goes on: it could not be asked to stop", r.job.name()));
        }
    }
    for mut r in running {
        // Whatever it ends with, the folder is as good as after a kill.
        let _ = r.child.wait();
    }
}

/// What a run that is done measured.
fn stored(a: &Arguments, job: &Job) -> anyhow::Result<ComparedRun> {
    let path = job.file(&a.out, "json");
    serde_json::from_str(&read_text(&path)?)
        .with_context(|| format!("{}: expected a compared run", path.display()))
}

/// The comparison of all runs that are there.
fn read(a: &Arguments, jobs: &[Job]) -> anyhow::Result<Comparison> {
    let there = jobs.iter().filter(|j| j.file(&a.out, "json").exists());
    let runs: Vec<ComparedRun> = there.map(|job| stored(a, job)).collect::<anyhow::Result<_>>()?;
    if runs.is_empty() {
        bail!("none of the {} runs is done", jobs.len());
    }
    Ok(Comparison::new(&a.methods[0], a.evaluation_seed, a.until_decided, runs)?)
}

/// Writes the comparison of all runs that are there.
fn finish(a: &Arguments, jobs: &[Job]) -> anyhow::Result<()> {
    let comparison = read(a, jobs)?;
    let there = comparison.runs.len();
    comparison.write(&a.out)?;
    say(compare::table(&comparison))?;
    say(format_args!("{there} of {} runs: {}", jobs.len(), a.out.join("compare.html").display()))?;
    Ok(())
}
