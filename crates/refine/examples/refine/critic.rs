//! The critic's stage: a critic is read or trained, and what it sees no progress in is left out.

use crate::config::Config;
use crate::{Arguments, Plan};
use anyhow::{Context, Result, bail, ensure};
use e2h_core::{Direction, Episode, Frames, Kind, Origin, Outcome, align_hemisphere};
use e2h_data::lerobot::{Dataset, Dtype, Feature, Info, RobotColumns, Table, decode_png};
use e2h_data::{Normaliser, NormaliserConfig, resize_image};
use e2h_policy::{Critic, CriticProvenance, CriticTraining, train_critic};
use e2h_refine::{critic_filter, resample};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Folder of a critic trained here, in that of the new dataset.
const FOLDER: &str = "critic";

/// Where the recordings' numbers and images are.
pub(crate) struct Source<'a> {
    pub(crate) columns: &'a RobotColumns,
    pub(crate) cameras: &'a [(String, Feature)],
}

/// A critic, or what it is to be trained on.
pub(crate) enum Stage {
    Ready(Box<Judge>),
    Train(Box<Dataset>),
}

/// A critic and where it comes from.
pub(crate) struct Judge {
    critic: Critic,
    pub(crate) about: CriticProvenance,
    pub(crate) folder: PathBuf,
}

/// Opens and checks all that the stage needs, before any work; none without a critic.
pub(crate) fn open(
    a: &Arguments,
    info: &Info,
    source: &Source<'_>,
    config: &Config,
) -> Result<Option<Stage>> {
    let inputs = inputs(info, source, a.fps, config)?;
    if let Some(folder) = &a.critic {
        let (critic, about) = Critic::load(folder)?;
        about.check_inputs(&inputs, folder)?;
        return Ok(Some(Stage::Ready(Box::new(Judge { critic, about, folder: folder.clone() }))));
    }
    let Some(root) = &a.train_critic else { return Ok(None) };
    let folder = a.out.join(FOLDER);
    if folder.exists() {
        bail!("{0}: expected none: use it with --critic {0}, or remove it", folder.display());
    }
    let hard = Dataset::open(root)?;
    let name = root.display();
    ensure!(!hard.is_empty(), "{name}: expected hard rollouts, found none");
    let found = hard.info().feature(&a.success).map(|f| format!("{:?} x {}", f.dtype, f.width()));
    let flag = hard.info().feature(&a.success).is_some_and(|f| f.dtype == Dtype::Bool && f.width() == 1);
    ensure!(
        flag,
        "{name}: column `{}`: expected one Bool a row that says whether the rollout has succeeded (--success), found {}",
        a.success,
        found.unwrap_or("none".to_owned())
    );
    source.columns.check(hard.info()).with_context(|| name.to_string())?;
    let expected = CriticProvenance { inputs, ..CriticProvenance::default() };
    expected.check_inputs(&self::inputs(hard.info(), source, a.fps, config)?, root)?;
    Ok(Some(Stage::Train(Box::new(hard))))
}

/// The critic's inputs in words; what differs between two datasets differs here.
fn inputs(info: &Info, source: &Source<'_>, fps: f64, config: &Config) -> Result<BTreeMap<String, String>> {
    let c = source.columns;
    let pose = |slice: &e2h_data::lerobot::ColumnSlice| -> Result<String> {
        Ok(format!("{slice}, {} numbers, {:?}", slice.width(info)?, c.rotation))
    };
    let mut all = BTreeMap::from([
        ("pose".to_owned(), pose(&c.pose)?),
        ("rate".to_owned(), format!("{fps} Hz")),
        ("opening".to_owned(), format!("{} m", config.reverse.open_width_m)),
    ]);
    if let Some(object) = &c.object {
        all.insert("object".to_owned(), pose(object)?);
    }
    if let Some(gripper) = &c.gripper {
        let (closed, open) = c.gripper_range;
        let text = format!("{gripper}, {} number, {closed} to {open}", gripper.width(info)?);
        all.insert("gripper".to_owned(), text);
    }
    for (name, _) in source.cameras {
        let found = info.feature(name).filter(|f| f.is_visual());
        all.insert(format!("camera {name}"), found.map_or("none".to_owned(), |f| format!("{:?}", f.shape)));
    }
    Ok(all)
}

impl Stage {
    /// The critic; trained and saved where it is not there yet.
    pub(crate) fn judge(self, a: &Arguments, source: &Source<'_>, config: &Config) -> Result<Judge> {
        let hard = match self {
            Self::Ready(judge) => {
                say(a, format_args!("critic: {}", judge.folder.display()));
                return Ok(*judge);
            }
            Self::Train(hard) => hard,
        };
        let rollouts = (0..hard.len())
            .map(|i| rollout(&hard, a, source, config, i).with_context(|| format!("hard rollout {i}")))
            .collect::<Result<Vec<_>>>()?;
        let successes = rollouts.iter().filter(|r| r.outcome.is_success()).count();
        let rows: usize = rollouts.iter().map(Episode::len).sum();
        ensure!(
            successes > 0,
            "{}: expected at least one successful rollout, found none in {}: a value learned from failures alone \
             says nothing of progress",
            hard.root().display(),
            rollouts.len()
        );
        say(
            a,
            format_args!(
                "critic: {} rollouts, {successes} successful, {rows} rows at {} Hz",
                rollouts.len(),
                a.fps
            ),
        );

        let names: Vec<String> = source.cameras.iter().map(|(n, _)| n.clone()).collect();
        let settings = &config.critic;
        let network = settings.network(&names, source.columns.object.is_some());
        network.validate()?;
        let training = settings.training();
        // A small share.
        let scaling = NormaliserConfig { margin: settings.margin as f32, ..NormaliserConfig::default() };
        let normaliser = Normaliser::fit(&rollouts, &scaling)?;
        let horizon = config.advantage_at(a.fps).horizon;
        let every = settings.steps.div_ceil(10).max(1);
        let (none, seed) = (e2h_nn::Weights::new(), settings.seed);
        let progress = |step: usize, loss: f32| {
            if step.is_multiple_of(every) || step == settings.steps {
                say(a, format_args!("critic: step {step} of {}, loss {loss:.4}", settings.steps));
            }
            std::ops::ControlFlow::Continue(())
        };
        let settings = CriticTraining {
            policy: &network,
            critic: &training,
            compute: &e2h_nn::Compute::cpu(),
            normaliser: &normaliser,
            policy_weights: &none,
            rollouts: &rollouts,
            horizon,
            seed,
            purpose: "critic",
        };
        let (critic, report) = train_critic(&settings, progress)?;
        let about = CriticProvenance {
            inputs: inputs(hard.info(), source, a.fps, config)?,
            reference_quaternion: config.reverse.reference_quaternion,
            rollouts: rollouts.len(),
            successes,
            horizon,
            seed,
            train_loss: report.train_loss,
            validation_loss: report.validation_loss,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        let folder = a.out.join(FOLDER);
        critic.save(&folder, &training, &about)?;
        let held = about.validation_loss.map_or(String::new(), |v| format!(", {v:.4} on held-out rollouts"));
        say(
            a,
            format_args!(
                "critic: mean squared error {:.4}{held}; saved in {}",
                about.train_loss,
                folder.display()
            ),
        );
        Ok(Judge { critic, about, folder })
    }
}

/// Progress goes beside the output.
fn say(a: &Arguments, text: std::fmt::Arguments<'_>) {
    if !a.json {
        e2h_core::mention(text);
    }
}

/// A hard rollout at the rate of control, cut where it first succeeds.
fn rollout(
    hard: &Dataset,
    a: &Arguments,
    source: &Source<'_>,
    config: &Config,
    index: usize,
) -> Result<Episode> {
    let info = hard.info();
    let mut names = source.columns.names();
    names.push(&a.success);
    names.extend(source.cameras.iter().map(|(n, _)| n.as_str()));
    names.sort_unstable();
    names.dedup();
    let table = hard.read_columns(index, &names)?;
    let task = hard.episodes()[index].tasks.first().map_or("", String::as_str);
    let number = u32::try_from(index).context("episode index")?;
    let origin = Origin { kind: Kind::Rollout, ..Origin::demonstration(task, Direction::Hard, number, 0) };
    let reference = &config.reverse.reference_quaternion;
    let whole = source.columns.episode(&table, info, origin, reference, config.reverse.open_width_m)?;
    let success = table.bool(&a.success)?.iter().position(|&s| s);
    let rows: Vec<usize> = (0..success.map_or(whole.len(), |at| at + 1)).collect();
    let mut cut = whole.select(&rows);
    cut.outcome = success.map_or(Outcome::Timeout, |at| Outcome::Success { at });
    let mut episode = resample(&cut, info.fps, a.fps, reference)?;
    episode.frames = frames(&episode, &table, source, config.critic.image_size)?;
    Ok(episode)
}

/// The images of an episode's rows in the critic's size.
fn frames(episode: &Episode, recording: &Table, source: &Source<'_>, size: usize) -> Result<Vec<Frames>> {
    let camera = |(name, feature): &(String, Feature)| {
        let Some((height, width)) = feature.image_size() else { bail!("{name}: expected an image") };
        let files = recording.png(name)?;
        let mut images = Vec::with_capacity(episode.len());
        for &row in &episode.source {
            let what = format!("column `{name}`, row {row}");
            let file = files.get(row as usize).with_context(|| what.clone())?;
            images.push(resize_image(&decode_png(file, height, width, &what)?, size, size)?.data.into());
        }
        Ok(Frames { camera: name.clone(), height: size, width: size, images })
    };
    source.cameras.iter().map(camera).collect()
}

impl Judge {
    /// Values of the rows of a segment of a recording.
    fn values(&self, segment: &Episode, recording: &Table, source: &Source<'_>) -> Result<Vec<f32>> {
        let mut seen = segment.clone();
        for state in &mut seen.state {
            // Written in the hemisphere of this dataset; the critic knows another, perhaps.
            for start in [3, 10] {
                let q = std::array::from_fn(|i| f64::from(state[start + i]));
                let q = align_hemisphere(q, &self.about.reference_quaternion);
                // States are 32 bits.
                state[start..start + 4].copy_from_slice(&q.map(|v| v as f32));
            }
        }
        seen.frames = frames(segment, recording, source, self.critic.image_size())?;
        Ok(self.critic.evaluate(&seen)?)
    }

    /// Leaves out what makes too little progress; the threshold is one of all recordings together.
    pub(crate) fn filter(
        &self,
        a: &Arguments,
        dataset: &Dataset,
        source: &Source<'_>,
        config: &Config,
        plans: &mut [Plan],
    ) -> Result<()> {
        let names: Vec<&str> = source.cameras.iter().map(|(n, _)| n.as_str()).collect();
        let mut values = vec![];
        for plan in plans.iter().filter(|p| p.refined.is_some()) {
            let recording = dataset.read_columns(plan.episode, &names)?;
            for segment in plan.refined.iter().flat_map(|r| &r.segments) {
                values.push(self.values(segment, &recording, source)?);
            }
        }
        let asked = config.suffix_at(a.fps);
        let suffix = asked.trusting(self.about.successes);
        if suffix.enabled != asked.enabled {
            let (found, needed) = (self.about.successes, suffix.min_successes);
            say(a, format_args!("suffix: not cut, the critic has seen {found} successes of {needed}"));
        }
        let first: Vec<_> = plans.iter_mut().filter_map(|p| p.refined.take()).collect();
        let mut later = critic_filter(first, &values, &suffix, &config.advantage_at(a.fps))?.into_iter();
        for plan in plans.iter_mut().filter(|p| p.account.accepted()) {
            plan.refined = later.next();
            if let Some(refined) = &plan.refined {
                plan.account.refine(refined, a.fps);
            }
        }
        let kept: usize = plans.iter().filter_map(|p| p.refined.as_ref()).map(|r| r.report.kept).sum();
        ensure!(
            kept > 0,
            "the advantage filter left nothing: expected at least a run of advantage.min_run frames"
        );
        Ok(())
    }
}
