//! Recorded episodes of any robot, as a policy learns from them: state and action of any width, any cameras.

use crate::lerobot::{Column, Dataset, Dtype, Feature, Info, Table, decode_png};
use crate::{Error, Result, resize_image};
use e2h_core::{ACTION_DIM, CONTROL_HZ, Episode, Frames, ImageStore, STATE_DIM};
use std::sync::Arc;

/// Feature of the robot's state.
pub const STATE_FEATURE: &str = "observation.state";
/// Feature of the state of its surroundings.
pub const ENVIRONMENT_FEATURE: &str = "observation.environment_state";
/// Feature of the action.
pub const ACTION_FEATURE: &str = "action";
/// What whole episodes end with, where a dataset says it.
const SUCCESS_FEATURE: &str = "next.success";
const OBSERVATION: &str = "observation.";

/// A camera of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraLayout {
    /// Name of its feature, for example `observation.images.wrist`.
    pub feature: String,
    /// Rows, pixels.
    pub height: usize,
    /// Columns, pixels.
    pub width: usize,
}

/// What the rows of a recording are made of. The 15 numbers of state and 8 of action of this project's tasks are one layout,
/// [`Layout::of_tasks`].
///
/// # Units
/// Those of the recorder; `fps` in Hz.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    /// Rows a second.
    pub fps: f64,
    /// Names of the numbers of `observation.state`.
    pub state: Vec<String>,
    /// Names of the numbers of `observation.environment_state`; empty without it.
    pub environment: Vec<String>,
    /// Names of the numbers of `action`.
    pub action: Vec<String>,
    /// Cameras, in the order of the dataset.
    pub cameras: Vec<CameraLayout>,
}

impl Layout {
    /// Of a dataset. `cameras` names those to use, by the feature or by what follows its last dot; none takes all.
    ///
    /// # Errors
    /// [`Error::Misfit`] lists all that keeps a policy from learning from the dataset.
    pub fn of(info: &Info, cameras: &[String]) -> Result<Self> {
        let mut problems: Vec<String> = vec![];
        let mut vector = |name: &str, needed: bool| -> Vec<String> {
            let whole = |f: &&Feature| {
                f.shape.len() == 1 && !f.is_visual() && !matches!(f.dtype, Dtype::String | Dtype::Bool)
            };
            match info.feature(name) {
                Some(f) if whole(&f) => {
                    let given = f.entry_names().filter(|n| n.len() == f.width());
                    given.map_or_else(
                        || (0..f.width()).map(|i| i.to_string()).collect(),
                        |n| n.into_iter().map(str::to_owned).collect(),
                    )
                }
                Some(f) => {
                    problems.push(format!("`{name}`: expected a vector of numbers, found {}", f.describe()));
                    vec![]
                }
                None if needed => {
                    let there: Vec<&str> = info.features.iter().map(|(n, _)| n.as_str()).collect();
                    problems
                        .push(format!("`{name}`: expected a vector of numbers, found none among {there:?}"));
                    vec![]
                }
                None => vec![],
            }
        };
        let state = vector(STATE_FEATURE, true);
        let environment = vector(ENVIRONMENT_FEATURE, false);
        let action = vector(ACTION_FEATURE, true);
        let visual: Vec<(&String, &Feature)> = info
            .features
            .iter()
            .filter(|(n, f)| f.is_visual() && n.starts_with(OBSERVATION))
            .map(|(n, f)| (n, f))
            .collect();
        let short = |name: &str| name.rsplit('.').next().unwrap_or_default().to_owned();
        for asked in cameras {
            if !visual.iter().any(|(n, _)| *n == asked || short(n) == *asked) {
                let there: Vec<&str> = visual.iter().map(|(n, _)| n.as_str()).collect();
                problems.push(format!("camera `{asked}`: expected one of {there:?}"));
            }
        }
        let mut found = vec![];
        for (name, feature) in visual {
            let wanted = cameras.is_empty() || cameras.iter().any(|c| c == name || *c == short(name));
            match feature.image_size() {
                _ if !wanted => {}
                Some((height, width)) => found.push(CameraLayout { feature: name.clone(), height, width }),
                None => problems.push(format!("`{name}`: expected an image, found {}", feature.describe())),
            }
        }
        if problems.is_empty() {
            Ok(Self { fps: info.fps, state, environment, action, cameras: found })
        } else {
            Err(Error::Misfit { what: "dataset".to_owned(), problems })
        }
    }

    /// Of this project's own tasks, with images of `side` by `side` pixels.
    #[must_use]
    pub fn of_tasks(cameras: &[String], side: usize) -> Self {
        let own = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect();
        let camera = |name: &String| CameraLayout {
            feature: format!("observation.images.{name}"),
            height: side,
            width: side,
        };
        Self {
            fps: CONTROL_HZ,
            state: own(&crate::lerobot::STATE_NAMES),
            environment: vec![],
            action: own(&crate::lerobot::ACTION_NAMES),
            cameras: cameras.iter().map(camera).collect(),
        }
    }

    /// Numbers of a row's state, those of the environment after those of the robot.
    #[must_use]
    pub fn state_width(&self) -> usize {
        self.state.len() + self.environment.len()
    }

    /// Numbers of a row's action.
    #[must_use]
    pub fn action_width(&self) -> usize {
        self.action.len()
    }

    /// The same with all images of `size` (rows, columns).
    #[must_use]
    pub fn resized(&self, size: (usize, usize)) -> Self {
        let resize = |c: &CameraLayout| CameraLayout { height: size.0, width: size.1, ..c.clone() };
        Self { cameras: self.cameras.iter().map(resize).collect(), ..self.clone() }
    }

    /// All in which `other` differs; empty when one policy can learn from both.
    #[must_use]
    pub fn differences(&self, other: &Self) -> Vec<String> {
        let mut found = vec![];
        let mut same = |what: &str, expected: String, is: String| {
            if expected != is {
                found.push(format!("{what}: expected {expected}, found {is}"));
            }
        };
        same("rows a second", self.fps.to_string(), other.fps.to_string());
        for (name, a, b) in [
            (STATE_FEATURE, &self.state, &other.state),
            (ENVIRONMENT_FEATURE, &self.environment, &other.environment),
            (ACTION_FEATURE, &self.action, &other.action),
        ] {
            let text = |names: &[String]| format!("{} numbers ({})", names.len(), names.join(", "));
            same(&format!("`{name}`"), text(a), text(b));
        }
        let text = |l: &Self| {
            let one = |c: &CameraLayout| format!("{} {} x {}", c.feature, c.height, c.width);
            format!("[{}]", l.cameras.iter().map(one).collect::<Vec<_>>().join(", "))
        };
        same("cameras", text(self), text(other));
        found
    }
}

/// One recorded episode.
///
/// # Shapes
/// State (T, [`Layout::state_width`]), action (T, [`Layout::action_width`]), one entry of `frames` a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    layout: Arc<Layout>,
    state: Vec<f32>,
    action: Vec<f32>,
    frames: Vec<Frames>,
    terminal: bool,
    len: usize,
}

impl Recording {
    /// Reads an episode. Images go to `store`, in the size that `layout` says. Where `next.success` is a column, an episode
    /// that does not end with it is a piece of a longer path, see [`Episode::terminal`].
    ///
    /// # Errors
    /// When the dataset lacks a column of `layout`, a number is not finite, or an image cannot be read.
    pub fn read(dataset: &Dataset, episode: usize, layout: &Arc<Layout>, store: &ImageStore) -> Result<Self> {
        let info = dataset.info();
        let judged = info.feature(SUCCESS_FEATURE).is_some_and(|f| f.dtype == Dtype::Bool && f.width() == 1);
        let mut names = vec![STATE_FEATURE, ACTION_FEATURE];
        names.extend((!layout.environment.is_empty()).then_some(ENVIRONMENT_FEATURE));
        names.extend(judged.then_some(SUCCESS_FEATURE));
        names.extend(layout.cameras.iter().map(|c| c.feature.as_str()));
        let table = dataset.read_columns(episode, &names)?;
        let state = numbers(&table, STATE_FEATURE, layout.state.len(), episode)?;
        let action = numbers(&table, ACTION_FEATURE, layout.action.len(), episode)?;
        let state = if layout.environment.is_empty() {
            state
        } else {
            let more = numbers(&table, ENVIRONMENT_FEATURE, layout.environment.len(), episode)?;
            let rows =
                state.chunks_exact(layout.state.len()).zip(more.chunks_exact(layout.environment.len()));
            rows.flat_map(|(a, b)| a.iter().chain(b).copied()).collect()
        };
        let wrong = |source| Error::Episode { name: format!("{episode}"), source };
        let mut frames = vec![];
        for camera in &layout.cameras {
            let recorded = info.feature(&camera.feature).and_then(Feature::image_size);
            let (height, width) = recorded.unwrap_or((camera.height, camera.width));
            let mut images = Vec::with_capacity(table.rows);
            for (row, file) in table.png(&camera.feature)?.iter().enumerate() {
                let what = format!("{}, row {row} of episode {episode}", camera.feature);
                let image = decode_png(file, height, width, &what)?;
                images.push(resize_image(&image, camera.height, camera.width)?.data.as_slice().into());
            }
            let images = store.take(&images).map_err(wrong)?;
            frames.push(Frames {
                camera: camera.feature.clone(),
                height: camera.height,
                width: camera.width,
                images,
            });
        }
        let terminal = !judged || table.bool(SUCCESS_FEATURE)?.last().is_none_or(|&s| s);
        Ok(Self { layout: layout.clone(), state, action, frames, terminal, len: table.rows })
    }

    /// From numbers and images that are there already.
    ///
    /// # Shapes
    /// `state` (T, [`Layout::state_width`]) and `action` (T, [`Layout::action_width`]) in a row.
    ///
    /// # Errors
    /// [`Error::Misfit`] lists all that does not fit `layout`.
    pub fn new(
        layout: &Arc<Layout>,
        state: Vec<f32>,
        action: Vec<f32>,
        frames: Vec<Frames>,
        terminal: bool,
    ) -> Result<Self> {
        let len = action.len() / layout.action_width().max(1);
        let mut problems = vec![];
        for (what, found, width) in
            [(STATE_FEATURE, &state, layout.state_width()), (ACTION_FEATURE, &action, layout.action_width())]
        {
            if found.len() != len * width {
                problems.push(format!("`{what}`: expected {len} x {width} numbers, found {}", found.len()));
            }
            if let Some(i) = found.iter().position(|v| !v.is_finite()) {
                let row = i / width.max(1);
                problems.push(format!("`{what}`, row {row}: expected finite numbers, found {}", found[i]));
            }
        }
        let shape = |f: &Frames| (f.camera.clone(), f.height, f.width, f.images.len());
        let expected: Vec<_> =
            layout.cameras.iter().map(|c| (c.feature.clone(), c.height, c.width, len)).collect();
        let found: Vec<_> = frames.iter().map(shape).collect();
        if expected != found {
            problems.push(format!("images: expected {expected:?}, found {found:?}"));
        }
        if !problems.is_empty() {
            return Err(Error::Misfit { what: "recording".to_owned(), problems });
        }
        Ok(Self { layout: layout.clone(), state, action, frames, terminal, len })
    }

    /// An episode of this project's tasks: the same rows, the same images.
    #[must_use]
    pub fn of_episode(episode: &Episode) -> Self {
        let mut layout = Layout::of_tasks(&[], 0);
        let mut frames = episode.frames.clone();
        for f in &mut frames {
            f.camera = format!("observation.images.{}", f.camera);
            let (feature, height, width) = (f.camera.clone(), f.height, f.width);
            layout.cameras.push(CameraLayout { feature, height, width });
        }
        debug_assert_eq!((layout.state_width(), layout.action_width()), (STATE_DIM, ACTION_DIM));
        Self {
            layout: Arc::new(layout),
            state: episode.state.as_flattened().to_vec(),
            action: episode.action.as_flattened().to_vec(),
            frames,
            terminal: episode.terminal,
            len: episode.len(),
        }
    }

    /// What its rows are made of.
    #[must_use]
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Rows, T.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// True without rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// State of row `t`, then the state of the environment where there is one.
    #[must_use]
    pub fn state(&self, t: usize) -> &[f32] {
        let width = self.layout.state_width();
        &self.state[t * width..(t + 1) * width]
    }

    /// Action of row `t`.
    #[must_use]
    pub fn action(&self, t: usize) -> &[f32] {
        let width = self.layout.action_width();
        &self.action[t * width..(t + 1) * width]
    }

    /// Images, one entry a camera.
    #[must_use]
    pub fn frames(&self) -> &[Frames] {
        &self.frames
    }

    /// True when the last row is the end of the task, see [`Episode::terminal`].
    #[must_use]
    pub fn terminal(&self) -> bool {
        self.terminal
    }
}

/// Recordings that a policy learns from, and how much of every batch comes from them.
#[derive(Debug, Clone, Default)]
pub struct RecordedSource {
    /// The recordings.
    pub recordings: Vec<Arc<Recording>>,
    /// Share of every batch, relative to those of the other sources.
    pub share: f32,
}

/// A column as 32-bit floats.
fn numbers(table: &Table, name: &str, width: usize, episode: usize) -> Result<Vec<f32>> {
    let column = table.column(name).and_then(Column::numbers).unwrap_or_default();
    // Networks compute in 32 bits.
    let column: Vec<f32> = column.into_iter().map(|v| v as f32).collect();
    let wrong = |expected: String, found: String| Error::Column {
        column: format!("{name} of episode {episode}"),
        expected,
        found,
    };
    if column.len() != table.rows * width {
        return Err(wrong(format!("{} x {width} numbers", table.rows), column.len().to_string()));
    }
    if let Some(i) = column.iter().position(|v| !v.is_finite()) {
        return Err(wrong(format!("finite numbers in row {}", i / width.max(1)), column[i].to_string()));
    }
    Ok(column)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lerobot::{Features, Writer, encode_png};

    /// A dataset of a robot of 3 joints with two cameras of different sizes; `cut` episodes do not end with success.
    fn dataset(root: &std::path::Path, success: &[bool]) -> Dataset {
        let features: Features = vec![
            (STATE_FEATURE.to_owned(), Feature::vector(&["a", "b", "c"])),
            (ACTION_FEATURE.to_owned(), Feature::vector(&["a", "b"])),
            ("observation.images.front".to_owned(), Feature::image(6, 8)),
            ("observation.images.hand".to_owned(), Feature::image(4, 4)),
            (SUCCESS_FEATURE.to_owned(), Feature::scalar(Dtype::Bool)),
        ];
        let mut writer = Writer::create(root, 30.0, Some("arm"), features).unwrap();
        for (e, &ends) in success.iter().enumerate() {
            let rows = 5 + e;
            let image = |h: usize, w: usize| {
                Column::Png((0..rows).map(|t| encode_png(h, w, &vec![t as u8; h * w * 3]).unwrap()).collect())
            };
            let columns = vec![
                (STATE_FEATURE.to_owned(), Column::F32((0..rows * 3).map(|i| i as f32).collect())),
                (ACTION_FEATURE.to_owned(), Column::F32((0..rows * 2).map(|i| i as f32).collect())),
                ("observation.images.front".to_owned(), image(6, 8)),
                ("observation.images.hand".to_owned(), image(4, 4)),
                (
                    SUCCESS_FEATURE.to_owned(),
                    Column::Bool((0..rows).map(|t| ends && t + 1 == rows).collect()),
                ),
            ];
            writer.push(&Table { rows, columns }, "move").unwrap();
        }
        writer.finish().unwrap();
        Dataset::open(root).unwrap()
    }

    #[test]
    fn a_dataset_of_another_robot_is_read_with_its_own_widths() {
        let folder = tempfile::tempdir().unwrap();
        let store = ImageStore::create(folder.path()).unwrap();
        let dataset = dataset(&folder.path().join("d"), &[true, false]);
        let layout = Layout::of(dataset.info(), &[]).unwrap();
        assert_eq!((layout.state_width(), layout.action_width(), layout.fps), (3, 2, 30.0));
        assert_eq!(layout.cameras.len(), 2);
        let layout = Arc::new(layout.resized((3, 4)));
        let whole = Recording::read(&dataset, 0, &layout, &store).unwrap();
        assert_eq!((whole.len(), whole.terminal()), (5, true));
        assert_eq!((whole.state(2), whole.action(4)), (&[6.0, 7.0, 8.0][..], &[8.0, 9.0][..]));
        assert_eq!(*whole.frames()[0].image(3).unwrap(), [3; 36]);
        assert!(!Recording::read(&dataset, 1, &layout, &store).unwrap().terminal());
    }

    #[test]
    fn cameras_are_chosen_by_their_short_names_and_others_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = dataset(&folder.path().join("d"), &[true]);
        let named = |name: &str| Layout::of(dataset.info(), &[name.to_owned()]);
        assert_eq!(named("hand").unwrap().cameras[0].feature, "observation.images.hand");
        let refused = named("wrist").unwrap_err().to_string();
        assert!(
            refused.contains("camera `wrist`") && refused.contains("observation.images.front"),
            "{refused}"
        );
    }

    #[test]
    fn all_that_does_not_fit_is_listed() {
        let ours = Layout::of_tasks(&["table".to_owned()], 72);
        let folder = tempfile::tempdir().unwrap();
        let theirs = Layout::of(dataset(&folder.path().join("d"), &[true]).info(), &[]).unwrap();
        let found = ours.differences(&theirs);
        assert_eq!(found.len(), 4, "{found:?}");
        assert!(found[0].contains("expected 20, found 30"), "{found:?}");
        assert!(ours.differences(&ours.clone()).is_empty());
        let layout = Arc::new(theirs);
        let problems = Recording::new(&layout, vec![0.0; 6], vec![f32::NAN; 6], vec![], true).unwrap_err();
        let text = problems.to_string();
        assert!(text.contains("3 x 3 numbers") && text.contains("NaN") && text.contains("images"), "{text}");
    }

    #[test]
    fn an_episode_of_a_task_is_a_recording_of_one_layout() {
        let episode = crate::fixture::episode(4);
        let recording = Recording::of_episode(&episode);
        assert_eq!(recording.layout().state_width(), STATE_DIM);
        assert_eq!(
            (recording.state(2), recording.action(3)),
            (&episode.state[2][..], &episode.action[3][..])
        );
    }
}
