//! A recording session: practice, takes, and what becomes of them, one control step at a time.

use crate::controls::{Control, Event};
use crate::pilot::{Limits, Pilot};
use crate::store::Store;
use crate::{Error, Result};
use e2h_core::{Direction, Episode, Origin, Outcome, Rng, stream};
use e2h_data::Take;
use e2h_env::{Env, EnvConfig, Task, demonstration_stream};
use std::path::PathBuf;
use std::sync::Arc;

/// Starts in a row that may diverge: chance does not fail so often.
const MOST_STARTS: u32 = 10;
/// Longest take, control steps: far longer than any demonstration.
const LONGEST: usize = 20_000;

/// What a session is started with.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Which task of the pair.
    pub direction: Direction,
    /// Where the dataset is, or will be.
    pub out: PathBuf,
    /// Seed of the starts.
    pub seed: u64,
    /// Free space that the task was asked for, m a side; 0 for its default.
    pub clearance: f64,
    /// How fast and how far the hand may go.
    pub limits: Limits,
}

impl Settings {
    /// Seed 0 and the usual limits.
    #[must_use]
    pub fn new(direction: Direction, out: PathBuf) -> Self {
        Self { direction, out, seed: 0, clearance: 0.0, limits: Limits::default() }
    }
}

/// What a session is at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Nothing is recorded.
    Practice,
    /// A take is recorded.
    Recording,
    /// A take that the disk did not take: it is kept until it is saved or discarded.
    Unsaved,
}

/// What to tell the person.
#[derive(Debug, Clone, PartialEq)]
pub struct Status {
    /// What the session is at.
    pub phase: Phase,
    /// Whether the task is done, and has been for long enough.
    pub success: bool,
    /// Control steps of the take.
    pub rows: usize,
    /// Seconds of the take by the clock.
    pub seconds: f64,
    /// Episodes in the dataset.
    pub saved: usize,
    /// Whether the gripper is told to be open.
    pub open: bool,
    /// How far the goal is from where the hand began, m.
    pub from_home: f64,
    /// What happened last.
    pub note: String,
}

/// A simulation that is steered by hand, and the takes that are recorded of it.
pub struct Session {
    env: Env,
    pilot: Pilot,
    store: Store,
    settings: Settings,
    phase: Phase,
    take: Option<Episode>,
    outcome: Option<Outcome>,
    /// Number of the take, which draws its start.
    index: u32,
    practice: u64,
    discarded: usize,
    /// Times by the clock: when the take began, its last step, and what the next one is counted from.
    began: f64,
    now: f64,
    since: Option<f64>,
    note: String,
}

impl Session {
    /// A session with the hand at rest before a start to practise on. The dataset is made with the first take.
    ///
    /// # Errors
    /// Settings that cannot work, a scene that MuJoCo refuses, a folder that cannot take these demonstrations.
    pub fn open(task: Arc<dyn Task>, config: &EnvConfig, settings: Settings) -> Result<Self> {
        // People take their time.
        let config = EnvConfig { horizon_easy: LONGEST, horizon_hard: LONGEST, ..config.clone() };
        let env = Env::new(task.clone(), &config)?;
        let side = config.image_size;
        let cameras: Vec<_> = env.cameras().iter().map(|name| (name.clone(), side, side)).collect();
        let pilot = Pilot::new(settings.limits.clone(), &env.sim().goal(), true)?;
        let store = Store::open(&settings.out, &*task, settings.clearance, settings.direction, &cameras)?;
        let mut this = Self {
            env,
            pilot,
            index: store.next(),
            store,
            settings,
            phase: Phase::Practice,
            take: None,
            outcome: None,
            practice: 0,
            discarded: 0,
            began: 0.0,
            now: 0.0,
            since: None,
            note: "practise, or record a take".to_owned(),
        };
        this.practise()?;
        Ok(this)
    }

    /// The simulation, to be shown.
    #[must_use]
    pub fn env(&self) -> &Env {
        &self.env
    }

    /// The dataset.
    #[must_use]
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// What to tell the person.
    #[must_use]
    pub fn status(&self) -> Status {
        let take = self.take.as_ref();
        Status {
            phase: self.phase,
            success: self.outcome.is_some_and(Outcome::is_success),
            rows: take.map_or(0, Episode::len),
            seconds: if take.is_some() { self.now - self.began } else { 0.0 },
            saved: self.store.episodes(),
            open: self.env.sim().opens(),
            from_home: self.pilot.from_home(),
            note: self.note.clone(),
        }
    }

    /// One control step: what was touched since the last one, then the simulation. `now`: seconds by any clock that goes forwards.
    ///
    /// # Errors
    /// When the simulation fails. A disk that refuses an episode is no error: the episode is kept and told of.
    pub fn step(&mut self, events: &[Event], now: f64) -> Result<()> {
        let since = *self.since.get_or_insert(now);
        for event in events {
            let new = self.pilot.handle(*event);
            if let (true, Event::Press(control)) = (new, event) {
                self.command(*control, now, since)?;
            }
        }
        // A take that is not yet on the disk ended where it ended.
        if self.phase != Phase::Unsaved {
            self.now = now;
        }
        self.advance()
    }

    fn command(&mut self, control: Control, now: f64, since: f64) -> Result<()> {
        match (control, self.phase) {
            (Control::Record, Phase::Practice) => self.record(now)?,
            (Control::Record | Control::Reset, Phase::Recording | Phase::Unsaved) => {
                self.tell("save or discard this take first");
            }
            (Control::Reset, Phase::Practice) => {
                self.practise()?;
                self.tell("another start");
            }
            (Control::Save, Phase::Recording) if !self.outcome.is_some_and(Outcome::is_success) => {
                self.tell("not saved: the task is not done. Go on, or discard it");
            }
            (Control::Save, Phase::Recording | Phase::Unsaved) => self.save(now, since)?,
            (Control::Save | Control::Discard, Phase::Practice) => self.tell("no take is being recorded"),
            (Control::Discard, _) => self.discard("discarded")?,
            _ => {}
        }
        Ok(())
    }

    fn tell(&mut self, note: impl Into<String>) {
        self.note = note.into();
    }

    /// From a new start, with nothing recorded.
    fn practise(&mut self) -> Result<()> {
        (self.take, self.outcome, self.phase) = (None, None, Phase::Practice);
        for _ in 0..MOST_STARTS {
            self.practice += 1;
            let rng = stream(self.settings.seed, "teleop/practice", self.index.into(), self.practice);
            if self.start(rng)? {
                return Ok(());
            }
        }
        Err(Error::Starts(MOST_STARTS))
    }

    /// Begins a take, from a start that whoever knows its seed and number can make again.
    fn record(&mut self, now: f64) -> Result<()> {
        for _ in 0..MOST_STARTS {
            let (seed, direction) = (self.settings.seed, self.settings.direction);
            if self.start(demonstration_stream(seed, direction, self.index))? {
                let task = self.env.task().name();
                let origin = Origin::demonstration(task, direction, self.index, seed);
                self.take = Some(Episode::new(origin, self.env.cameras()));
                (self.began, self.now) = (now, now);
                self.phase = Phase::Recording;
                self.tell(format!("take {} is recorded", self.index));
                return Ok(());
            }
            self.index += 1;
        }
        Err(Error::Starts(MOST_STARTS))
    }

    /// Resets the scene; false where that diverged.
    fn start(&mut self, mut rng: Rng) -> Result<bool> {
        self.outcome = None;
        match self.env.reset(self.settings.direction, &mut rng) {
            Ok(()) => {
                self.pilot.place(&self.env.sim().goal(), self.env.sim().opens());
                Ok(true)
            }
            Err(e2h_env::Error::Diverged(_)) => Ok(false),
            Err(e) => Err(e.into()),
        }
    }

    fn advance(&mut self) -> Result<()> {
        let (goal, open) = self.pilot.advance(&self.env.sim().tcp());
        // In the hemisphere of what is observed, as all that is recorded.
        let observed = self.env.state();
        let near = [3, 4, 5, 6].map(|i| f64::from(observed[i]));
        let mut action = [0.0; e2h_core::ACTION_DIM];
        action[..7].copy_from_slice(&goal.to_row(&near));
        action[7] = f32::from(u8::from(open));
        if self.phase == Phase::Recording
            && let Some(take) = &mut self.take
        {
            take.push(&self.env.observe()?, &action)?;
        }
        let outcome = self.env.step(&action)?;
        match outcome {
            // The take has ended; what is done with the scene meanwhile does not change it.
            Some(Outcome::Diverged | Outcome::Dropped) if self.phase == Phase::Unsaved => self.again()?,
            _ if self.phase == Phase::Unsaved => {}
            Some(Outcome::Diverged) => self.discard("discarded: the simulation diverged")?,
            Some(Outcome::Dropped) => self.discard("discarded: the object was dropped")?,
            Some(Outcome::Timeout) if self.phase == Phase::Recording => {
                self.discard("discarded: it took too long")?;
            }
            other => self.outcome = other,
        }
        Ok(())
    }

    /// A new start while a take waits to be saved.
    fn again(&mut self) -> Result<()> {
        let (take, outcome) = (self.take.take(), self.outcome);
        self.practise()?;
        (self.take, self.outcome, self.phase) = (take, outcome, Phase::Unsaved);
        Ok(())
    }

    fn discard(&mut self, note: &str) -> Result<()> {
        if self.phase != Phase::Practice {
            self.discarded += 1;
            self.index += 1;
        }
        self.practise()?;
        self.tell(note);
        Ok(())
    }

    fn save(&mut self, now: f64, since: f64) -> Result<()> {
        let (Some(take), Some(outcome)) = (&mut self.take, self.outcome) else { return Ok(()) };
        if self.phase == Phase::Recording {
            self.now = now;
            take.outcome = outcome;
        }
        let seconds = self.now - self.began;
        // Waiting for a full disk is not what a demonstration costs.
        let times = Take { episode: 0, seconds, cost_seconds: self.now - since, discarded: self.discarded };
        match self.store.save(take, times) {
            Ok(()) => {
                let rows = take.len();
                self.index += 1;
                (self.discarded, self.since) = (0, Some(now));
                let saved = self.store.episodes();
                self.practise()?;
                self.tell(format!("saved, {rows} steps in {seconds:.1} s; {saved} in the dataset"));
            }
            Err(e) => {
                self.phase = Phase::Unsaved;
                self.tell(format!("not saved: {e}. Make room and save again, or discard it"));
            }
        }
        Ok(())
    }
}
