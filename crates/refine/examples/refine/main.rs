//! Turns recordings of an easy task, by any robot, into training data for the hard one.
//!
//! ```text
//! cargo run --release --example refine -- --dataset recordings/unplug --out refined/plug_in \
//!     --pose observation.state[0:7] --rotation wxyz --gripper observation.state[7] --gripper-range 0,0.08 \
//!     --task "plug it in"
//! ```
//!
//! Reads a LeRobotDataset v3.0, brings it to the rate of control, reverses it, cuts and re-times what stands still or is slow,
//! with a critic leaves out what makes too little progress, and writes a LeRobotDataset with a report beside it. Needs no
//! simulator and no network; minutes of recordings take seconds, the training of a critic minutes. `crates/refine/REAL_ROBOT.md` says what comes before and after.

mod config;
mod critic;
mod page;
mod picture;

use anyhow::{Context, Result, bail, ensure};
use clap::Parser;
use config::Config;
use e2h_core::{Direction, Episode, Origin, mention, say};
use e2h_data::lerobot::{
    ACTION_NAMES, Column, ColumnSlice, Dataset, Dtype, Feature, Features, Info, RobotColumns, Rotation,
    STATE_NAMES, Table, Writer, decode_png, source_columns, source_features,
};
use e2h_refine::{Refined, gate, gripper_switches, kinematic_filter, resample, reverse};
use page::{Account, Verdict};
use serde::Serialize;
use std::path::PathBuf;

/// Reverses and filters a dataset of easy-direction episodes.
#[derive(Parser)]
#[command(
    version,
    after_help = "Example:\n  cargo run --release --example refine -- --dataset recordings/unplug --out refined/plug_in \\\n      --pose observation.state[0:7] --rotation wxyz --gripper observation.state[7] --gripper-range 0,0.08 \\\n      --task \"plug it in\""
)]
struct Arguments {
    /// LeRobotDataset v3.0 with episodes of the easy task.
    #[arg(long, value_name = "DIR")]
    dataset: PathBuf,
    /// Folder of the new dataset; must not hold one yet.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Rate of the new dataset, Hz.
    #[arg(long, default_value_t = 20.0)]
    fps: f64,
    /// Pose of the tool centre point in the robot's base frame: metres, then the orientation.
    #[arg(long, value_name = "COLUMN[a:b]", default_value = "observation.state[0:7]")]
    pose: ColumnSlice,
    /// How orientations are written: wxyz, xyzw, rotvec or none.
    #[arg(long, default_value = "wxyz")]
    rotation: Rotation,
    /// Opening of the gripper.
    #[arg(long, value_name = "COLUMN[i]")]
    gripper: Option<ColumnSlice>,
    /// Its value when the gripper is closed, and when it is fully open.
    #[arg(long, value_name = "CLOSED,OPEN", default_value = "0,0.08", allow_hyphen_values = true)]
    gripper_range: String,
    /// Pose of the object, written as the tool's, where it is known.
    #[arg(long, value_name = "COLUMN[a:b]")]
    object: Option<ColumnSlice>,
    /// Further numbers that the policy is to see, taken over as they are (may be repeated).
    #[arg(long, value_name = "COLUMN[a:b]")]
    state: Vec<ColumnSlice>,
    /// Cameras that the policy is to see (may be repeated; by default all).
    #[arg(long, value_name = "COLUMN")]
    camera: Vec<String>,
    /// The hard task in words (by default that of the recordings).
    #[arg(long)]
    task: Option<String>,
    /// Critic that the advantage filter asks: a folder that --train-critic made.
    #[arg(long, value_name = "DIR", conflicts_with = "train_critic")]
    critic: Option<PathBuf>,
    /// Train one first, from a LeRobotDataset of hard rollouts with the same columns; it is saved in OUT/critic.
    #[arg(long, value_name = "DIR")]
    train_critic: Option<PathBuf>,
    /// Column of the hard rollouts that is true where a rollout has succeeded.
    #[arg(long, value_name = "COLUMN", default_value = "next.success")]
    success: String,
    /// Override a value of the filters, for example kinematic.static_frames=8 (may be repeated).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Leave out episodes that cannot be read or hold a number that is not finite, and say which, instead of stopping.
    #[arg(long)]
    skip_broken: bool,
    /// Episodes whose filter picture is part of the report.
    #[arg(long, default_value_t = 12)]
    pictures: usize,
    /// Print one JSON line and nothing else.
    #[arg(long)]
    json: bool,
}

/// A recording that --skip-broken passed over.
#[derive(Serialize)]
struct LeftOut {
    episode: usize,
    reason: String,
}

/// What becomes of one recording.
struct Plan {
    episode: usize,
    reversed: Episode,
    refined: Option<Refined>,
    account: Account,
}

fn main() -> Result<(), e2h_core::Failure> {
    Ok(program()?)
}

fn program() -> Result<()> {
    let a = Arguments::parse();
    let dataset = Dataset::open(&a.dataset)?;
    let columns = columns(&a)?;
    columns.check(dataset.info())?;
    let cameras = cameras(&a, dataset.info())?;
    let mut config = Config::resolve(&a.set)?;
    ensure!(a.fps.is_finite() && a.fps > 0.0, "--fps: expected a positive rate, Hz, got {}", a.fps);
    ensure!(!dataset.is_empty(), "{}: expected episodes, found none", a.dataset.display());
    if !config.reference_given {
        let first = |i: usize| -> Result<[f64; 4]> {
            let table = dataset.read_columns(i, &columns.names())?;
            Ok(columns.first_orientation(&table, dataset.info())?)
        };
        let tried = if a.skip_broken { dataset.len() } else { 1 };
        let found = (0..tried).find_map(|i| first(i).ok());
        config.reverse.reference_quaternion = found.map_or_else(|| first(0), Ok)?;
    }

    let source = critic::Source { columns: &columns, cameras: &cameras };
    let stage = critic::open(&a, dataset.info(), &source, &config)?;
    ensure!(
        !a.out.join("meta/info.json").exists(),
        "{}: expected none: a new dataset needs a folder of its own",
        a.out.display()
    );

    // Poses alone first: they are small, and the critic's threshold is one of all episodes.
    let (mut plans, mut left_out) = (vec![], vec![]);
    for episode in 0..dataset.len() {
        let found = plan(&dataset, &columns, &config, &a, episode);
        // Without --skip-broken the first image that cannot be decoded ends the work when it is asked for.
        match found.and_then(|p| if a.skip_broken { whole_images(&dataset, &cameras, p) } else { Ok(p) }) {
            Ok(plan) => plans.push(plan),
            Err(e) if a.skip_broken => {
                let reason = e2h_core::one_line(&format!("{e:#}"));
                mention(format_args!("left out episode {episode}: {reason}"));
                left_out.push(LeftOut { episode, reason });
            }
            Err(e) => return Err(e),
        }
    }
    ensure!(
        plans.iter().any(|p| p.refined.is_some()),
        "no episode was accepted: {}",
        plans.iter().map(|p| p.account.verdict.to_string()).collect::<Vec<_>>().join("; ")
    );

    let judge = stage.map(|s| s.judge(&a, &source, &config)).transpose()?;
    if let Some(judge) = &judge {
        judge.filter(&a, &dataset, &source, &config, &mut plans)?;
    }

    let features = features(&a, dataset.info(), &cameras)?;
    let robot = dataset.info().robot_type.clone();
    let mut writer = Writer::create(&a.out, a.fps, robot.as_deref(), features)?;
    let mut drawn = vec![];
    for plan in &plans {
        let names = columns_to_copy(&a, &cameras);
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let draws = drawn.len() < a.pictures;
        if plan.refined.is_none() && !draws {
            continue;
        }
        let recording = dataset.read_columns(plan.episode, &names)?;
        let task = a.task.clone().or_else(|| dataset.episodes()[plan.episode].tasks.first().cloned());
        for segment in plan.refined.iter().flat_map(|r| &r.segments) {
            let table = table(&a, dataset.info(), &cameras, &recording, segment)?;
            writer.push(&table, task.as_deref().unwrap_or_default())?;
        }
        if draws {
            drawn.push(picture::svg(plan, &recording, cameras.first().map(|c| c.0.as_str()), &config, a.fps));
        }
    }
    let info = writer.finish()?;

    let accounts: Vec<&Account> = plans.iter().map(|p| &p.account).collect();
    let report = page::json(&a, &config, judge.as_ref(), &accounts, &left_out, &info);
    e2h_data::write_atomic(&a.out.join("report/frames.csv"), page::csv(&plans, a.fps).as_bytes())?;
    e2h_data::write_atomic(
        &a.out.join("report/report.json"),
        serde_json::to_string_pretty(&report)?.as_bytes(),
    )?;
    let html = page::html(&a, &config, judge.as_ref(), &accounts, &left_out, &info, &drawn)?;
    e2h_data::write_atomic(&a.out.join("report/report.html"), html.as_bytes())?;
    if a.json {
        say(report)?;
    } else {
        say(page::text(&accounts, &left_out, judge.as_ref()).trim_end())?;
        say(format_args!("dataset: {}", a.out.display()))?;
        say(format_args!("report: {}", a.out.join("report/report.html").display()))?;
    }
    Ok(())
}

fn columns(a: &Arguments) -> Result<RobotColumns> {
    let range = a
        .gripper_range
        .split_once(',')
        .and_then(|(c, o)| Some((c.trim().parse().ok()?, o.trim().parse().ok()?)));
    let gripper_range =
        range.with_context(|| format!("--gripper-range: expected two numbers, got `{}`", a.gripper_range))?;
    let (pose, gripper, object) = (a.pose.clone(), a.gripper.clone(), a.object.clone());
    Ok(RobotColumns { pose, rotation: a.rotation, gripper, gripper_range, object })
}

fn cameras(a: &Arguments, info: &Info) -> Result<Vec<(String, Feature)>> {
    let all: Vec<(String, Feature)> = info.features.iter().filter(|(_, f)| f.is_visual()).cloned().collect();
    if a.camera.is_empty() {
        return Ok(all);
    }
    let find = |name: &String| {
        all.iter().find(|(n, _)| n == name).cloned().with_context(|| {
            let names = all.iter().map(|(n, _)| n.as_str());
            let perhaps = e2h_core::nearest(name, names).map(|n| format!(", perhaps `{n}`"));
            format!("--camera {name}: no such column{}", perhaps.unwrap_or_default())
        })
    };
    a.camera.iter().map(find).collect()
}

fn columns_to_copy(a: &Arguments, cameras: &[(String, Feature)]) -> Vec<String> {
    let mut names: Vec<String> = a.state.iter().map(|s| s.column.clone()).collect();
    names.extend(cameras.iter().map(|(n, _)| n.clone()));
    names.sort();
    names.dedup();
    names
}

/// Eq. 3, 4 and 7 of the paper for one recording.
fn plan(
    dataset: &Dataset,
    columns: &RobotColumns,
    config: &Config,
    a: &Arguments,
    episode: usize,
) -> Result<Plan> {
    let (info, fps) = (dataset.info(), a.fps);
    let mut names = columns.names();
    for slice in &a.state {
        slice.width(info)?;
        if !names.contains(&slice.column.as_str()) {
            names.push(&slice.column);
        }
    }
    let judged = info.feature("next.success").is_some_and(|f| f.dtype == Dtype::Bool);
    if judged && !names.contains(&"next.success") {
        names.push("next.success");
    }
    let table = dataset.read_columns(episode, &names)?;
    // What is taken over as it is is looked at too, before any row is written.
    for slice in &a.state {
        for (row, values) in slice.read(&table, info)?.iter().enumerate() {
            let finite = values.iter().all(|v| v.is_finite());
            ensure!(
                finite,
                "episode {episode}, `{slice}`, row {row}: expected finite numbers, found {values:?}"
            );
        }
    }
    let span = &dataset.episodes()[episode];
    let task = span.tasks.first().map_or("", String::as_str);
    let index = u32::try_from(episode).context("episode index")?;
    let origin = Origin::demonstration(task, Direction::Easy, index, 0);
    let reference = config.reverse.reference_quaternion;
    let recorded = columns
        .episode(&table, info, origin, &reference, config.reverse.open_width_m)
        .with_context(|| format!("episode {episode}"))?;
    let reversed = reverse(&resample(&recorded, info.fps, fps, &reference)?, &config.reverse);
    let failed = judged && !table.bool("next.success")?.contains(&true);
    let switches = gripper_switches(&reversed, &config.reverse);
    let verdict = if failed {
        Verdict::Failed
    } else if !gate(&reversed, &config.gate, &config.reverse) {
        Verdict::Gate { closings: switches.0, openings: switches.1 }
    } else {
        Verdict::Accepted
    };
    let refined = (verdict == Verdict::Accepted)
        .then(|| kinematic_filter(&reversed, &config.kinematic.at_rate(fps), &config.reverse));
    let account =
        Account::new(episode, &recorded, info.fps, &reversed, refined.as_ref(), fps, verdict, switches);
    Ok(Plan { episode, reversed, refined, account })
}

/// The plan again, if every image of the recording can be decoded.
fn whole_images(dataset: &Dataset, cameras: &[(String, Feature)], plan: Plan) -> Result<Plan> {
    for (name, feature) in cameras {
        // One camera at a time: an episode's images are most of the memory.
        let table = dataset.read_columns(plan.episode, &[name.as_str()])?;
        let Some((height, width)) = feature.image_size() else { bail!("{name}: expected an image") };
        for (row, file) in table.png(name)?.iter().enumerate() {
            decode_png(file, height, width, &format!("column `{name}`, row {row}"))?;
        }
    }
    Ok(plan)
}

fn features(a: &Arguments, info: &Info, cameras: &[(String, Feature)]) -> Result<Features> {
    let mut names: Vec<String> = STATE_NAMES[..7].iter().map(|n| (*n).to_owned()).collect();
    if a.gripper.is_some() {
        names.push("gripper".to_owned());
    }
    for slice in &a.state {
        names.extend(slice.entry_names(info)?);
    }
    let mut features = vec![("observation.state".to_owned(), Feature::vector(&names))];
    for (name, feature) in cameras {
        let Some((height, width)) = feature.image_size() else { bail!("{name}: expected an image") };
        features.push((name.clone(), Feature::image(height, width)));
    }
    features.push(("action".to_owned(), Feature::vector(&ACTION_NAMES)));
    features.push(("next.success".to_owned(), Feature::scalar(Dtype::Bool)));
    features.extend(source_features());
    Ok(features)
}

/// The rows of a refined segment: poses as the filter left them, everything else as recorded in the row that it came from.
fn table(
    a: &Arguments,
    info: &Info,
    cameras: &[(String, Feature)],
    recording: &Table,
    segment: &Episode,
) -> Result<Table> {
    let rows: Vec<usize> = segment.source.iter().map(|&r| r as usize).collect();
    let further = a.state.iter().map(|s| s.read(recording, info)).collect::<Result<Vec<_>, _>>()?;
    let mut state = vec![];
    for (t, &row) in rows.iter().enumerate() {
        state.extend_from_slice(&segment.state[t][..7]);
        if a.gripper.is_some() {
            state.push(segment.opening(t));
        }
        // `observation.state` is 32 bits.
        for column in &further {
            let values = column.get(row).with_context(|| format!("row {row}"))?;
            state.extend(values.iter().map(|&v| v as f32));
        }
    }
    let mut columns = vec![("observation.state".to_owned(), Column::F32(state))];
    for (name, _) in cameras {
        let images = recording.column(name).context("a camera")?;
        columns.push((name.clone(), images.select(&rows, 1)));
    }
    columns.push(("action".to_owned(), Column::F32(segment.action.concat())));
    // The reversed path ends where the recording began: with the hard task done.
    let success = (1..=rows.len()).map(|t| t == rows.len() && segment.terminal).collect();
    columns.push(("next.success".to_owned(), Column::Bool(success)));
    let fates = vec![0; rows.len()];
    columns.extend(source_columns(
        &segment.origin,
        segment.outcome,
        segment.terminal,
        &segment.source,
        &fates,
    ));
    Ok(Table { rows: rows.len(), columns })
}
