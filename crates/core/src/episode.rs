use crate::state::{EEF, OPENING};
use crate::{ACTION_DIM, Error, ImageStore, Pixels, Pose, Result, STATE_DIM};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// One state row. Units: metres, unit quaternions (wxyz), metres of gripper opening.
pub type State = [f32; STATE_DIM];
/// One action row: absolute goal pose of the tool centre point in the robot base frame, and the gripper command
/// (1 open, 0 closed).
pub type Action = [f32; ACTION_DIM];

/// By how much exploration displaced the goal of a row: x, y, z in m along the axes of the robot's base, yaw in rad about the
/// vertical; zeros where nothing did.
pub type Excursion = [f32; 4];

/// Which task of a pair: the hard one that is learned, or the easy one that undoes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The task to learn (put the nut on).
    Hard,
    /// The task that undoes it (take the nut off).
    Easy,
}

impl Direction {
    /// The other task of the pair.
    #[must_use]
    pub fn reverse(self) -> Self {
        match self {
            Self::Hard => Self::Easy,
            Self::Easy => Self::Hard,
        }
    }

    /// `hard` or `easy`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Hard => "hard",
            Self::Easy => "easy",
        }
    }
}

impl std::fmt::Display for Direction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// How an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The success predicate held long enough; `at` is the first row of the final, successful streak.
    Success {
        /// Row index.
        at: usize,
    },
    /// The horizon was reached.
    Timeout,
    /// The object was dropped in a task that must hold it throughout.
    Dropped,
    /// The simulation diverged.
    Diverged,
}

impl Outcome {
    /// True for [`Outcome::Success`].
    #[must_use]
    pub fn is_success(self) -> bool {
        matches!(self, Self::Success { .. })
    }
}

/// What an episode is made from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A scripted demonstrator.
    Demonstration,
    /// A policy.
    Rollout,
    /// A segment that refinement made of another episode.
    Refined,
}

/// Where an episode comes from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// Task pair, for example `nut_assembly`.
    pub task: String,
    /// Which task of the pair was being done while recording.
    pub direction: Direction,
    /// Demonstration, rollout or refined segment.
    pub kind: Kind,
    /// Iteration of the loop that made it; 0 for initial demonstrations.
    pub iteration: u32,
    /// Index of the episode within its kind and iteration.
    pub episode: u32,
    /// Run seed.
    pub seed: u64,
    /// True when time runs backwards against the recording.
    pub reversed: bool,
}

impl Origin {
    /// Origin of a scripted demonstration.
    #[must_use]
    pub fn demonstration(task: &str, direction: Direction, episode: u32, seed: u64) -> Self {
        Self {
            task: task.to_owned(),
            direction,
            kind: Kind::Demonstration,
            iteration: 0,
            episode,
            seed,
            reversed: false,
        }
    }
}

/// One camera image. Shapes: `data` is (height, width, 3), row-major, 8 bits per channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// RGB bytes.
    pub data: Vec<u8>,
}

/// What a policy sees at one control step.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Low-dimensional state.
    pub state: State,
    /// One image per camera, in the order of the environment's camera names.
    pub frames: Vec<Image>,
}

/// The images of one camera over an episode, one per row.
///
/// An image is shared by all episodes that show it: cloning an episode or selecting rows of it copies no pixel, and an image
/// is freed with the last episode that shows it. Where it lies, in memory or on the disk, is its own affair ([`Pixels`]).
///
/// # Shapes
/// `images` (T), each (height, width, 3), row-major, 8 bits per channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Frames {
    /// Camera name.
    pub camera: String,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// RGB bytes of each row's image.
    pub images: Vec<Pixels>,
}

impl Frames {
    /// Images from the bytes of all of them, one after the other. What is left over at the end becomes an image too short,
    /// which [`Episode::validate`] refuses.
    ///
    /// # Shapes
    /// `bytes` is (T, height, width, 3).
    #[must_use]
    pub fn new(camera: &str, height: usize, width: usize, bytes: &[u8]) -> Self {
        let images = bytes.chunks((height * width * 3).max(1)).map(Pixels::from).collect();
        Self { camera: camera.to_owned(), height, width, images }
    }

    /// Bytes of image `row`; empty when there is no such row.
    ///
    /// # Errors
    /// When the image lies on the disk and cannot be read.
    pub fn image(&self, row: usize) -> Result<Cow<'_, [u8]>> {
        self.images.get(row).map_or(Ok(Cow::Borrowed(&[])), Pixels::read)
    }

    /// A copy of all images, one after the other: what [`Frames::new`] takes.
    ///
    /// # Shapes
    /// The result is (T, height, width, 3).
    ///
    /// # Errors
    /// When an image lies on the disk and cannot be read.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let mut all = vec![];
        for image in &self.images {
            all.extend_from_slice(&image.read()?);
        }
        Ok(all)
    }
}

/// One recorded episode, by column; row t of every column is one control step.
///
/// # Shapes
/// `state` (T, 15), `action` (T, 8), `frames` one entry per camera (T, H, W, 3), `source` (T), `excursion` (T, 4).
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// State before the action of the same row.
    pub state: Vec<State>,
    /// Action taken in this row.
    pub action: Vec<Action>,
    /// Images seen before the action of the same row.
    pub frames: Vec<Frames>,
    /// Row of the original recording that each row comes from (the nearest one where poses were interpolated).
    pub source: Vec<u32>,
    /// By how much exploration had displaced the goal when the row was observed: the pose in `state` is off the policy's own
    /// way by about as much.
    pub excursion: Vec<Excursion>,
    /// How it ended.
    pub outcome: Outcome,
    /// True when the last row is the end of the task, so that a policy may repeat the last action after it; false for a
    /// segment that was cut out of a longer path.
    pub terminal: bool,
    /// Where it comes from.
    pub origin: Origin,
}

impl Episode {
    /// An episode without rows. `cameras` names the images that every observation will bring.
    #[must_use]
    pub fn new(origin: Origin, cameras: &[String]) -> Self {
        Self {
            state: vec![],
            action: vec![],
            frames: cameras.iter().map(|camera| Frames::new(camera, 0, 0, &[])).collect(),
            source: vec![],
            excursion: vec![],
            outcome: Outcome::Timeout,
            terminal: true,
            origin,
        }
    }

    /// Rows, T.
    #[must_use]
    pub fn len(&self) -> usize {
        self.state.len()
    }

    /// True without rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.state.is_empty()
    }

    /// Appends one control step that nothing displaced.
    ///
    /// # Errors
    /// When the number of images or their size differs from the rows before.
    pub fn push(&mut self, observation: &Observation, action: &Action) -> Result<()> {
        if observation.frames.len() != self.frames.len() {
            return Err(Error::Cameras { expected: self.frames.len(), found: observation.frames.len() });
        }
        for (column, image) in self.frames.iter_mut().zip(&observation.frames) {
            if self.state.is_empty() {
                (column.height, column.width) = (image.height, image.width);
            }
            if (column.height, column.width) != (image.height, image.width) {
                return Err(Error::ImageSize {
                    camera: column.camera.clone(),
                    expected: (column.height, column.width),
                    found: (image.height, image.width),
                });
            }
            column.images.push(image.data.as_slice().into());
        }
        // Episodes are far shorter than 2^32 rows.
        self.source.push(self.state.len() as u32);
        self.state.push(observation.state);
        self.action.push(*action);
        self.excursion.push(Excursion::default());
        Ok(())
    }

    /// The rows `rows` in that order, as a new episode. Numbers are copied, images are shared with this episode (see
    /// [`Frames`]); nothing is blended.
    /// Rows outside the episode are left out. `terminal` is kept only when the last row is taken last.
    #[must_use]
    pub fn select(&self, rows: &[usize]) -> Self {
        let rows: Vec<usize> = rows.iter().copied().filter(|&r| r < self.len()).collect();
        Self {
            state: rows.iter().map(|&r| self.state[r]).collect(),
            action: rows.iter().map(|&r| self.action[r]).collect(),
            frames: self
                .frames
                .iter()
                .map(|f| Frames {
                    camera: f.camera.clone(),
                    images: rows.iter().filter_map(|&r| f.images.get(r).cloned()).collect(),
                    ..*f
                })
                .collect(),
            source: rows.iter().map(|&r| self.source[r]).collect(),
            excursion: rows.iter().map(|&r| self.excursion[r]).collect(),
            outcome: self.outcome,
            terminal: self.terminal && rows.last().is_some_and(|&r| r + 1 == self.len()),
            origin: self.origin.clone(),
        }
    }

    /// Moves the images to `store`: from here on they take no memory, and reading them takes a moment.
    ///
    /// # Errors
    /// When an image cannot be read or written; all stay where they were.
    pub fn store_images(&mut self, store: &ImageStore) -> Result<()> {
        let stored = store.take(self.frames.iter().flat_map(|f| &f.images))?;
        for (image, stored) in self.frames.iter_mut().flat_map(|f| &mut f.images).zip(stored) {
            *image = stored;
        }
        Ok(())
    }

    /// Pose of the tool centre point in row `t`.
    #[must_use]
    pub fn eef(&self, t: usize) -> Pose {
        Pose::from_row(&self.state[t][EEF])
    }

    /// Gripper opening in row `t`, m.
    #[must_use]
    pub fn opening(&self, t: usize) -> f32 {
        self.state[t][OPENING]
    }

    /// Checks that columns agree in length, images have the size of their camera and all numbers are finite.
    ///
    /// # Errors
    /// Names the first column that does not fit.
    pub fn validate(&self) -> Result<()> {
        let rows = |column: &str, found: usize| {
            if found == self.len() {
                Ok(())
            } else {
                Err(Error::Rows { column: column.to_owned(), expected: self.len(), found })
            }
        };
        rows("action", self.action.len())?;
        rows("source", self.source.len())?;
        rows("excursion", self.excursion.len())?;
        for f in &self.frames {
            rows(&f.camera, f.images.len())?;
            let expected = f.height * f.width * 3;
            if let Some(row) = f.images.iter().position(|image| image.len() != expected) {
                let (camera, found) = (f.camera.clone(), f.images[row].len());
                return Err(Error::ImageBytes { camera, row, expected, found });
            }
        }
        let finite = |column, row, values: &[f32]| {
            if values.iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Error::NotFinite { column, row }) }
        };
        for t in 0..self.len() {
            finite("state", t, &self.state[t])?;
            finite("action", t, &self.action[t])?;
            finite("excursion", t, &self.excursion[t])?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn observation(v: f32, side: usize) -> Observation {
        let image = Image { height: side, width: side, data: vec![v as u8; side * side * 3] };
        Observation { state: [v; STATE_DIM], frames: vec![image] }
    }

    fn episode(rows: usize) -> Episode {
        let mut e = Episode::new(Origin::demonstration("t", Direction::Easy, 0, 1), &["table".to_owned()]);
        for t in 0..rows {
            e.push(&observation(t as f32, 2), &[t as f32; ACTION_DIM]).unwrap();
        }
        e
    }

    #[test]
    fn select_takes_rows_in_order_and_keeps_their_source() {
        let e = episode(5);
        let s = e.select(&[4, 1, 9]);
        assert_eq!(s.source, [4, 1]);
        assert_eq!(*s.frames[0].image(1).unwrap(), [1; 12]);
        assert!(!s.terminal);
        assert!(e.select(&[0, 4]).terminal);
        s.validate().unwrap();
    }

    #[test]
    fn images_are_shared_and_outlive_the_episode_that_they_came_with() {
        let e = episode(5);
        let s = e.select(&[3, 0]).select(&[1]);
        let first = |e: &Episode| e.frames[0].image(0).unwrap().as_ptr();
        assert_eq!(first(&s), first(&e));
        drop(e);
        assert_eq!(*s.frames[0].image(0).unwrap(), [0; 12]);
    }

    #[test]
    fn an_episode_is_the_same_with_its_images_on_the_disk() {
        let folder = tempfile::tempdir().unwrap();
        let store = ImageStore::create(folder.path()).unwrap();
        let (mut e, whole) = (episode(5), episode(5));
        e.store_images(&store).unwrap();
        assert!(e.frames[0].images.iter().all(|image| !image.in_memory()));
        assert_eq!(e, whole);
        assert_eq!(e.select(&[4, 2]), whole.select(&[4, 2]));
        assert_eq!(store.bytes(), 5 * 12);
    }

    #[test]
    fn images_of_another_size_are_refused_by_row() {
        let mut e = episode(3);
        let bytes = e.frames[0].to_bytes().unwrap();
        assert_eq!(Frames::new("table", 2, 2, &bytes), e.frames[0]);
        e.frames[0] = Frames::new("table", 2, 2, &bytes[..35]);
        let message = e.validate().unwrap_err().to_string();
        assert_eq!(message, "camera `table`, row 2: expected an image of 12 bytes, got 11");
        e.frames[0] = Frames::new("table", 2, 2, &bytes[..24]);
        assert!(matches!(e.validate(), Err(Error::Rows { expected: 3, found: 2, .. })));
    }

    #[test]
    fn excursions_go_where_their_rows_go() {
        let mut e = episode(3);
        e.excursion[2] = [0.03, 0.0, 0.01, 0.2];
        assert_eq!(e.select(&[2, 0]).excursion, [[0.03, 0.0, 0.01, 0.2], [0.0; 4]]);
        e.excursion.pop();
        assert!(matches!(e.validate(), Err(Error::Rows { expected: 3, found: 2, .. })));
    }

    #[test]
    fn push_refuses_other_images() {
        let mut e = episode(1);
        assert!(matches!(e.push(&observation(0.0, 3), &[0.0; 8]), Err(Error::ImageSize { .. })));
        let none = Observation { state: [0.0; STATE_DIM], frames: vec![] };
        assert!(matches!(e.push(&none, &[0.0; 8]), Err(Error::Cameras { expected: 1, found: 0 })));
    }

    #[test]
    fn validate_names_the_bad_column() {
        let mut e = episode(3);
        e.action[2][4] = f32::NAN;
        assert!(matches!(e.validate(), Err(Error::NotFinite { column: "action", row: 2 })));
        e.action.pop();
        assert!(matches!(e.validate(), Err(Error::Rows { expected: 3, found: 2, .. })));
    }
}
