//! What a training step draws: windows of episodes of this project's tasks, or of recordings of any robot.

use crate::batch::{BatchBuilder, Corner, Rows};
use crate::lerobot::{Features, Scalings};
use crate::{Error, ImageScaling, PolicyConfig, Result};
use e2h_core::{Episode, Frames, Rng};
use e2h_data::{
    Alignment, Normaliser, RecordedSource, Recording, Sampler, Source, Window, WindowConfig, Windows,
};

/// What a policy learns from: windows of weighted sources, and how they are scaled.
pub struct TrainingData<'a> {
    rows: Learned<'a>,
    /// Of each source.
    windows: Vec<Windows>,
    sampler: Sampler,
}

enum Learned<'a> {
    Episodes(&'a [Source], &'a Normaliser),
    Recordings(&'a [RecordedSource], &'a Features, &'a Scalings),
}

fn window(config: &PolicyConfig) -> WindowConfig {
    WindowConfig {
        n_obs_steps: config.n_obs_steps,
        horizon: config.horizon,
        alignment: if config.lerobot_alignment { Alignment::LeRobot } else { Alignment::Paper },
    }
}

fn sampler(windows: &[Windows], shares: impl Iterator<Item = f32>) -> Result<Sampler> {
    Ok(Sampler::new(&windows.iter().zip(shares.map(f64::from)).collect::<Vec<_>>())?)
}

impl<'a> TrainingData<'a> {
    /// Windows over `sources`, of which every batch takes as much as their shares say.
    ///
    /// # Errors
    /// When there is nothing to draw from.
    pub fn new(sources: &'a [Source], config: &PolicyConfig, normaliser: &'a Normaliser) -> Result<Self> {
        let window = window(config);
        let windows: Vec<_> = sources.iter().map(|s| Windows::new(&s.episodes, &window)).collect();
        let sampler = sampler(&windows, sources.iter().map(|s| s.share))?;
        Ok(Self { rows: Learned::Episodes(sources, normaliser), windows, sampler })
    }

    /// The same over recordings of `features`, for a [`crate::Trainer::of_features`]. The last `drop_last` rows of an episode
    /// are the newest of no window.
    ///
    /// # Errors
    /// When there is nothing to draw from, or a recording is of another layout.
    pub fn of_recordings(
        sources: &'a [RecordedSource],
        config: &PolicyConfig,
        features: &'a Features,
        scalings: &'a Scalings,
        drop_last: usize,
    ) -> Result<Self> {
        for recording in sources.iter().flat_map(|s| &s.recordings) {
            let found = Features::of_layout(recording.layout(), Some(features.crop))?;
            if found != *features {
                return Err(Error::Data(format!("expected recordings of {features:?}, found {found:?}")));
            }
        }
        let window = window(config);
        let lengths = |s: &RecordedSource| -> Vec<(usize, bool)> {
            s.recordings.iter().map(|r| (r.len(), r.terminal())).collect()
        };
        let windows: Vec<_> =
            sources.iter().map(|s| Windows::of_lengths(lengths(s), &window, drop_last)).collect();
        let sampler = sampler(&windows, sources.iter().map(|s| s.share))?;
        Ok(Self { rows: Learned::Recordings(sources, features, scalings), windows, sampler })
    }

    /// Windows of a batch with their episodes and what is known of their sources.
    pub(crate) fn batch(&self, size: usize, rng: &mut Rng) -> Vec<Example<'_>> {
        let of = |source: usize, window: &Window| match self.rows {
            Learned::Episodes(sources, normaliser) => {
                let source = &sources[source];
                let label = source.label.unwrap_or_default();
                (Of::Episode(&source.episodes[window.episode], normaliser), label)
            }
            Learned::Recordings(sources, features, scalings) => {
                (Of::Recording(&sources[source].recordings[window.episode], features, scalings), 0.0)
            }
        };
        let picks = self.sampler.batch(size, rng).into_iter();
        picks
            .map(|pick| {
                let window = self.windows[pick.source].window(pick.window);
                let (of, indicator) = of(pick.source, &window);
                Example { of, window, indicator }
            })
            .collect()
    }

    /// Rows and columns of the crops.
    pub(crate) fn crop(&self, config: &PolicyConfig) -> [usize; 2] {
        match self.rows {
            Learned::Episodes(..) => [config.crop_size; 2],
            Learned::Recordings(_, features, _) => features.crop,
        }
    }

    /// How the images are scaled.
    pub(crate) fn scaling<'b>(&'b self, config: &'b PolicyConfig) -> &'b [ImageScaling] {
        match self.rows {
            Learned::Episodes(..) => &config.image_scaling,
            Learned::Recordings(_, _, scalings) => &scalings.images,
        }
    }

    /// Columns of the images.
    pub(crate) fn columns(&self, config: &PolicyConfig) -> usize {
        match self.rows {
            Learned::Episodes(..) => config.image_size,
            Learned::Recordings(_, features, _) => features.size[1],
        }
    }
}

/// A drawn window and the episode that it is of.
pub(crate) struct Example<'a> {
    of: Of<'a>,
    pub(crate) window: Window,
    /// What is known of its source: 0 where nothing is.
    pub(crate) indicator: f32,
}

enum Of<'a> {
    Episode(&'a Episode, &'a Normaliser),
    Recording(&'a Recording, &'a Features, &'a Scalings),
}

impl Example<'_> {
    pub(crate) fn push_state(&self, batch: &mut BatchBuilder, noise: Option<(f32, &mut Rng)>) {
        let rows = &self.window.observations;
        match &self.of {
            Of::Episode(episode, normaliser) => {
                batch.push_state(Rows::Episode(episode, rows), normaliser, noise)
            }
            Of::Recording(recording, _, scalings) => {
                batch.push_scaled(rows, |row, out| scalings.push_state(recording, row, out), noise);
            }
        }
    }

    pub(crate) fn push_action(&self, row: usize, out: &mut Vec<f32>) {
        match &self.of {
            Of::Episode(episode, normaliser) => out.extend(normaliser.normalise_action(&episode.action[row])),
            Of::Recording(recording, _, scalings) => scalings.push_action(recording, row, out),
        }
    }

    /// Corner of a crop: random, or centred without a stream.
    pub(crate) fn corner(&self, c: &PolicyConfig, rng: Option<&mut Rng>) -> Corner {
        match (&self.of, rng) {
            (Of::Episode(..), Some(rng)) => c.random_crop(rng),
            (Of::Episode(..), None) => c.centre_crop(),
            (Of::Recording(_, features, _), rng) => features.corner(rng),
        }
    }

    /// Images of camera `camera` of the configuration.
    pub(crate) fn frames(&self, c: &PolicyConfig, camera: usize) -> Result<&Frames> {
        let episode = match &self.of {
            Of::Recording(recording, ..) => return Ok(&recording.frames()[camera]),
            Of::Episode(episode, _) => episode,
        };
        let named = episode.frames.iter().find(|f| f.camera == c.cameras[camera]);
        named.filter(|f| f.height == c.image_size).ok_or_else(|| {
            Error::Data(format!(
                "expected images of {0} x {0} from {1:?}, found {2:?}",
                c.image_size,
                c.cameras,
                episode.frames.iter().map(|f| (&f.camera, f.height, f.width)).collect::<Vec<_>>()
            ))
        })
    }
}
