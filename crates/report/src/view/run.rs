//! Episodes of a run directory: demonstrations, and the segments that each iteration learned from.

use super::Listed;
use super::page::Head;
use super::recording::{Account, Recording};
use crate::error::io;
use crate::folder::RunFolder;
use crate::record::{IterationRecord, Reversal, RunResults};
use crate::{Error, Result};
use crate::{chart, svg::escape};
use e2h_core::{CONTROL_HZ, one_line};
use e2h_data::lerobot::Dataset;
use e2h_refine::{Fate, KinematicConfig, ReverseConfig, kinematic_filter};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

const DEMONSTRATIONS: &str = "demonstrations";

/// What the page needs of a run's configuration; the rest is the run's own affair.
#[derive(Deserialize)]
struct Settings {
    task: TaskSettings,
    #[serde(rename = "loop")]
    closed_loop: LoopSettings,
    refine: RefineSettings,
}

#[derive(Deserialize)]
struct TaskSettings {
    variant: String,
}

#[derive(Deserialize)]
struct LoopSettings {
    demonstrations: usize,
    refine_easy_demonstrations: bool,
    explore: ExploreSettings,
}

#[derive(Deserialize)]
struct ExploreSettings {
    enabled: bool,
}

#[derive(Deserialize)]
struct RefineSettings {
    kinematic: KinematicConfig,
    reverse: ReverseConfig,
}

impl Settings {
    fn read(text: &str) -> std::result::Result<Self, String> {
        let settings: Self =
            toml::from_str(text).map_err(|e| one_line(&e.to_string().trim().replace('\n', " ")))?;
        let mut problems = settings.refine.kinematic.validate();
        problems.extend(settings.refine.reverse.validate());
        if problems.is_empty() { Ok(settings) } else { Err(one_line(&problems.join("; "))) }
    }
}

pub(super) struct RunSource {
    pub(super) listed: Vec<Listed>,
    /// Folder and name of each episode.
    places: Vec<(String, usize)>,
    dir: RunFolder,
    /// The configuration, or why it cannot be read.
    config: std::result::Result<Settings, String>,
    pub(super) records: Vec<IterationRecord>,
    results: Option<RunResults>,
    /// What refinement made of each reversal, by folder and episode.
    reversals: BTreeMap<(String, u32), Account>,
    notes: Vec<String>,
}

impl RunSource {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let dir = RunFolder::open(path)?;
        let file = path.join("config.toml");
        let text = e2h_data::read_text(&file).map_err(io("reading", &file))?;
        let config = Settings::read(&text);
        let mut this = Self {
            listed: vec![],
            places: vec![],
            results: dir.get("results.json")?,
            dir,
            config,
            records: vec![],
            reversals: BTreeMap::new(),
            notes: vec![],
        };
        if let Err(e) = &this.config {
            this.notes.push(format!(
                "The configuration is not one of this version, so demonstrations have no fates: {e}"
            ));
        }
        this.list(DEMONSTRATIONS)?;
        for iteration in iterations(path)? {
            this.records.extend(this.dir.get::<IterationRecord>(&format!("{iteration}/record.json"))?);
            let segments = format!("{iteration}/segments");
            this.list(&segments)?;
            match this.dir.get::<Vec<Reversal>>(&format!("{iteration}/reversals.json"))? {
                Some(all) => {
                    for r in all {
                        this.reversals.insert((segments.clone(), r.episode), account(&iteration, r));
                    }
                }
                None if this.dir.path().join(&segments).exists() => this.notes.push(format!(
                    "{iteration} was made before runs kept what the filters made of every frame: it has totals only."
                )),
                None => {}
            }
        }
        Ok(this)
    }

    fn list(&mut self, folder: &str) -> Result<()> {
        let path = self.dir.path().join(folder);
        if !path.is_dir() {
            return Ok(());
        }
        if !path.join("meta").exists() {
            return Ok(()); // nothing was learned from
        }
        // A dataset that is not whole is told on the page; the others have their place.
        let dataset = match Dataset::open(&path) {
            Ok(dataset) => dataset,
            Err(e) => {
                self.notes.push(format!("{folder} cannot be read: {e}"));
                return Ok(());
            }
        };
        for (i, span) in dataset.episodes().iter().enumerate() {
            self.listed.push(Listed { name: format!("{folder}/{i:05}"), rows: span.length });
            self.places.push((folder.to_owned(), i));
        }
        Ok(())
    }

    pub(super) fn read(&self, index: usize) -> Result<Recording> {
        let (folder, episode) = &self.places[index];
        let episode = Dataset::open(self.dir.path().join(folder))?.read_episode(*episode)?;
        let mut account = self.reversals.get(&(folder.clone(), episode.origin.episode)).cloned();
        let mut own = false;
        if let (DEMONSTRATIONS, Ok(c)) = (folder.as_str(), &self.config)
            && c.closed_loop.refine_easy_demonstrations
        {
            let refined = kinematic_filter(&episode, &c.refine.kinematic, &c.refine.reverse);
            account = Some(Account {
                title: "What the kinematic filter leaves of it for the easy policy".to_owned(),
                source: episode.source.clone(),
                fates: refined.fates.iter().map(|f| f.name().to_owned()).collect(),
                speed: refined.speed.iter().map(|&v| f64::from(v)).collect(),
                ..Account::default()
            });
            own = true;
        }
        let mut recording = Recording::of_episode(self.listed[index].name.clone(), episode, CONTROL_HZ);
        (recording.account, recording.own_account) = (account, own);
        Ok(recording)
    }

    /// What the run measured: as it wrote it at its end, or as far as it has come.
    fn measured(&self) -> RunResults {
        self.results.clone().unwrap_or_else(|| RunResults {
            task: self.dir.identity().task.clone(),
            variant: self.config.as_ref().map_or(String::new(), |c| c.task.variant.clone()),
            preset: self.dir.identity().preset.clone(),
            method: self.dir.identity().method.clone(),
            seed: self.dir.identity().seed,
            version: String::new(),
            demonstrations: self.config.as_ref().map_or(0, |c| c.closed_loop.demonstrations),
            given: self.dir.identity().given.clone(),
            explored: self.config.as_ref().is_ok_and(|c| c.closed_loop.explore.enabled),
            overrides: vec![],
            machine: String::new(),
            iterations: self.records.clone(),
            demonstration_steps: 0.0,
            hard_demonstration_steps: None,
        })
    }

    pub(super) fn head(&self) -> Head {
        let results = self.measured();
        let collections = || self.records.iter().filter_map(|r| r.collection.as_ref());
        let of: usize = collections().flat_map(|c| c.fates.values()).sum();
        let kept: usize = collections().filter_map(|c| c.fates.get(&Fate::Kept)).sum();
        let mut intro = String::new();
        if !results.iterations.is_empty() {
            intro += &figure("Success on the hard task", &chart::success_curve(&[&results]));
        }
        if of > 0 {
            intro += &figure("Frames of the accepted reversals by fate", &chart::fates(&results));
        }
        let say = |text: &str| if text.is_empty() { "not said".to_owned() } else { text.to_owned() };
        let facts = vec![
            ("task".to_owned(), results.task.clone()),
            ("variant".to_owned(), say(&results.variant)),
            ("preset".to_owned(), results.preset.clone()),
            ("seed".to_owned(), results.seed.to_string()),
            ("library".to_owned(), say(&results.version)),
            ("machine".to_owned(), say(&results.machine)),
            ("finished".to_owned(), if self.results.is_some() { "yes" } else { "not yet" }.to_owned()),
        ];
        Head {
            kind: "Auto-E2H run",
            title: results.task.clone(),
            subtitle: format!("{} · {} · seed {}", say(&results.variant), results.preset, results.seed),
            frames: self.listed.iter().map(|l| l.rows).sum(),
            hz: CONTROL_HZ,
            kept: (of > 0).then_some((kept, of)),
            intro,
            facts,
            notes: self.notes.clone(),
        }
    }
}

fn figure(title: &str, svg: &str) -> String {
    format!(
        "<figure><figcaption>{}</figcaption><div class=\"scroll\" tabindex=\"0\">{svg}</div></figure>\n",
        escape(title)
    )
}

/// Names of the folders of iterations, in order.
fn iterations(path: &Path) -> Result<Vec<String>> {
    let mut found = vec![];
    for entry in std::fs::read_dir(path).map_err(io("reading", path))? {
        let name = entry.map_err(io("reading", path))?.file_name().to_string_lossy().into_owned();
        let digits = name.strip_prefix("iteration_").unwrap_or_default();
        if !digits.is_empty() && digits.chars().all(|c| c.is_ascii_digit()) {
            found.push((digits.parse::<u64>().unwrap_or(u64::MAX), name));
        }
    }
    found.sort();
    Ok(found.into_iter().map(|(_, name)| name).collect())
}

fn account(iteration: &str, r: Reversal) -> Account {
    let wide = |v: Vec<f32>| v.into_iter().map(f64::from).collect::<Vec<_>>();
    let gaps = |v: Vec<Option<f32>>| v.into_iter().map(|v| v.map_or(f64::NAN, f64::from)).collect::<Vec<_>>();
    Account {
        title: format!("Easy rollout {} of {iteration}, reversed: what the filters did", r.episode),
        source: r.source,
        fates: r.fates.iter().map(|f| f.name().to_owned()).collect(),
        speed: wide(r.speed),
        excursion: r.excursion.map(wide),
        value: r.value.map(gaps),
        advantage: r.advantage.map(gaps),
        threshold: r.threshold.map(f64::from),
    }
}

impl RunSource {
    /// Refuses a folder without any record.
    pub(super) fn measured_or_none(&self) -> Result<RunResults> {
        let results = self.measured();
        if results.iterations.is_empty() {
            return Err(Error::Foreign {
                path: self.dir.path().to_owned(),
                quantity: "run".to_owned(),
                expected: "at least one evaluated iteration".to_owned(),
                found: "none".to_owned(),
            });
        }
        Ok(results)
    }
}
