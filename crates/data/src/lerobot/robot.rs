//! Recordings of any robot as episodes: which column holds the pose, which the gripper.

use super::info::Info;
use super::table::{Table, column_error};
use crate::{Error, Result};
use e2h_core::state::{EEF, OBJECT, OBJECT_QUATERNION, OPENING};
use e2h_core::{Episode, Origin, Outcome, State, align_hemisphere, continue_signs};
use std::str::FromStr;

/// Some entries of a column, written `name`, `name[3]` or `name[0:7]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColumnSlice {
    /// Name of the column.
    pub column: String,
    /// First entry.
    pub start: usize,
    /// Entry after the last; none for all that there are.
    pub end: Option<usize>,
}

impl FromStr for ColumnSlice {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let bad = || column_error(text, "name, name[3] or name[0:7]", "something else");
        let Some((column, rest)) = text.split_once('[') else {
            return Ok(Self { column: text.to_owned(), start: 0, end: None });
        };
        let range = rest.strip_suffix(']').ok_or_else(bad)?;
        let number = |t: &str| t.trim().parse::<usize>().map_err(|_| bad());
        let (start, end) = match range.split_once(':') {
            Some((a, b)) => (number(a)?, number(b)?),
            None => (number(range)?, number(range)? + 1),
        };
        if start >= end {
            return Err(bad());
        }
        Ok(Self { column: column.to_owned(), start, end: Some(end) })
    }
}

impl std::fmt::Display for ColumnSlice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.end {
            None => f.write_str(&self.column),
            Some(end) if end == self.start + 1 => write!(f, "{}[{}]", self.column, self.start),
            Some(end) => write!(f, "{}[{}:{end}]", self.column, self.start),
        }
    }
}

impl ColumnSlice {
    /// Entries of the slice.
    ///
    /// # Errors
    /// When the dataset has no such column, or the column not so many entries.
    pub fn width(&self, info: &Info) -> Result<usize> {
        let feature = info.feature(&self.column).filter(|f| !f.is_visual()).ok_or_else(|| {
            let names: Vec<&str> =
                info.features.iter().filter(|(_, f)| !f.is_visual()).map(|(n, _)| n.as_str()).collect();
            let perhaps = e2h_core::nearest(&self.column, names).map(|n| format!(", perhaps `{n}`"));
            let perhaps = perhaps.unwrap_or_default();
            column_error(&self.column, format!("a column of numbers{perhaps}"), "none")
        })?;
        let end = self.end.unwrap_or_else(|| feature.width());
        if end > feature.width() {
            return Err(column_error(
                &self.to_string(),
                format!("entries below {}", feature.width()),
                end.to_string(),
            ));
        }
        Ok(end - self.start)
    }

    /// Names of its entries, made up where the dataset gives none.
    ///
    /// # Errors
    /// As [`ColumnSlice::width`].
    pub fn entry_names(&self, info: &Info) -> Result<Vec<String>> {
        let width = self.width(info)?;
        let given = info.feature(&self.column).and_then(super::Feature::entry_names);
        let name = |i: usize| match given.as_ref().and_then(|g| g.get(i)) {
            Some(name) => format!("{}.{name}", self.column),
            None => format!("{}.{i}", self.column),
        };
        Ok((self.start..self.start + width).map(name).collect())
    }

    /// The rows of the slice.
    ///
    /// # Shapes
    /// (T, width)
    ///
    /// # Errors
    /// As [`ColumnSlice::width`].
    pub fn read(&self, table: &Table, info: &Info) -> Result<Vec<Vec<f64>>> {
        let width = self.width(info)?;
        let all = info.feature(&self.column).map_or(1, super::Feature::width);
        let numbers = table.column(&self.column).and_then(super::Column::numbers);
        let numbers = numbers.ok_or_else(|| column_error(&self.column, "numbers", "none"))?;
        Ok(numbers.chunks_exact(all).map(|row| row[self.start..self.start + width].to_vec()).collect())
    }
}

/// How a recording writes orientations, after the three numbers of the position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rotation {
    /// A quaternion, real part first.
    Wxyz,
    /// A quaternion, real part last.
    Xyzw,
    /// A rotation vector, rad.
    Rotvec,
    /// Not at all: the hand does not turn.
    None,
}

impl FromStr for Rotation {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "wxyz" => Ok(Self::Wxyz),
            "xyzw" => Ok(Self::Xyzw),
            "rotvec" => Ok(Self::Rotvec),
            "none" => Ok(Self::None),
            other => Err(column_error("rotation", "wxyz, xyzw, rotvec or none", other)),
        }
    }
}

impl Rotation {
    /// Numbers of a pose written in this way.
    #[must_use]
    pub fn pose_width(self) -> usize {
        match self {
            Self::Wxyz | Self::Xyzw => 7,
            Self::Rotvec => 6,
            Self::None => 3,
        }
    }

    /// The quaternion (wxyz) of such a pose; none when it has no direction.
    fn quaternion(self, pose: &[f64]) -> Option<[f64; 4]> {
        let q = match (self, pose.get(3..)?) {
            (Self::Wxyz, &[w, x, y, z]) | (Self::Xyzw, &[x, y, z, w]) => [w, x, y, z],
            (Self::Rotvec, &[x, y, z]) => {
                let angle = (x * x + y * y + z * z).sqrt();
                let s = if angle > 1e-9 { (0.5 * angle).sin() / angle } else { 0.5 };
                [(0.5 * angle).cos(), x * s, y * s, z * s]
            }
            (Self::None, _) => [1.0, 0.0, 0.0, 0.0],
            _ => return None,
        };
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
        // A unit quaternion within what 32 bits and careless recorders leave of it.
        (0.9..1.1).contains(&norm).then(|| q.map(|v| v / norm))
    }
}

/// Which columns of a recording hold what an episode is made of.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotColumns {
    /// Pose of the tool centre point in the robot's base frame: metres, then the orientation.
    pub pose: ColumnSlice,
    /// How orientations are written.
    pub rotation: Rotation,
    /// Opening of the gripper, in any unit; none for a tool that neither opens nor closes.
    pub gripper: Option<ColumnSlice>,
    /// Its value when it is closed, and when it is fully open.
    pub gripper_range: (f64, f64),
    /// Pose of the object, written as `pose` is, where it is known.
    pub object: Option<ColumnSlice>,
}

impl RobotColumns {
    /// Names of the columns that are needed.
    #[must_use]
    pub fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = [Some(&self.pose), self.gripper.as_ref(), self.object.as_ref()]
            .into_iter()
            .flatten()
            .map(|s| s.column.as_str())
            .collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Checks that the dataset has these columns with these entries.
    ///
    /// # Errors
    /// Names the first that does not fit.
    pub fn check(&self, info: &Info) -> Result<()> {
        for slice in [Some(&self.pose), self.object.as_ref()].into_iter().flatten() {
            let (expected, found) = (self.rotation.pose_width(), slice.width(info)?);
            if expected != found {
                let expected = format!("{expected} numbers, a pose with {:?}", self.rotation);
                return Err(column_error(&slice.to_string(), expected, found.to_string()));
            }
        }
        if let Some(gripper) = &self.gripper
            && gripper.width(info)? != 1
        {
            return Err(column_error(&gripper.to_string(), "one number", gripper.width(info)?.to_string()));
        }
        let (closed, open) = self.gripper_range;
        if !(closed.is_finite() && open.is_finite() && closed != open) {
            return Err(column_error(
                "gripper range",
                "two different numbers",
                format!("{closed} and {open}"),
            ));
        }
        Ok(())
    }

    /// The recording as an episode without images and with empty actions, to be reversed. The first orientation lies in the
    /// hemisphere of `reference` (wxyz), the others go on from it without a jump of the sign; openings are scaled to `open_width`, m. An unknown object lies at the origin.
    ///
    /// # Errors
    /// When a column is missing, or a row holds no pose.
    pub fn episode(
        &self,
        table: &Table,
        info: &Info,
        origin: Origin,
        reference: &[f64; 4],
        open_width: f64,
    ) -> Result<Episode> {
        self.check(info)?;
        let pose = self.pose.read(table, info)?;
        let object = self.object.as_ref().map(|o| o.read(table, info)).transpose()?;
        let gripper = self.gripper.as_ref().map(|g| g.read(table, info)).transpose()?;
        let (closed, open) = self.gripper_range;
        let mut episode = Episode::new(origin, &[]);
        for (t, pose) in pose.iter().enumerate() {
            let mut state = State::default();
            self.place(pose, reference, &mut state[EEF], &self.pose, t)?;
            state[OBJECT_QUATERNION.start] = 1.0;
            if let (Some(object), Some(slice)) = (&object, &self.object) {
                self.place(&object[t], reference, &mut state[OBJECT], slice, t)?;
            }
            let fraction = gripper.as_ref().map_or(1.0, |g| (g[t][0] - closed) / (open - closed));
            // Stored episodes are f32.
            let width = (fraction.clamp(0.0, 1.0) * open_width) as f32;
            state[OPENING] = width;
            let observation = e2h_core::Observation { state, frames: vec![] };
            episode
                .push(&observation, &[0.0; 8])
                .map_err(|source| Error::Episode { name: "recording".into(), source })?;
        }
        continue_signs(&mut episode.state, 3..7, reference);
        continue_signs(&mut episode.state, 10..14, reference);
        episode.outcome = Outcome::Success { at: episode.len().saturating_sub(1) };
        episode.validate().map_err(|source| Error::Episode { name: "recording".into(), source })?;
        Ok(episode)
    }

    /// The quaternion (wxyz) of the first row: a reference for all others.
    ///
    /// # Errors
    /// As [`RobotColumns::episode`].
    pub fn first_orientation(&self, table: &Table, info: &Info) -> Result<[f64; 4]> {
        let rows = self.pose.read(table, info)?;
        rows.first()
            .and_then(|row| self.rotation.quaternion(row))
            .ok_or_else(|| column_error(&format!("{}, row 0", self.pose), "a unit quaternion", "none"))
    }

    fn place(
        &self,
        pose: &[f64],
        reference: &[f64; 4],
        out: &mut [f32],
        slice: &ColumnSlice,
        row: usize,
    ) -> Result<()> {
        let q = self.rotation.quaternion(pose).ok_or_else(|| {
            column_error(&format!("{slice}, row {row}"), "a unit quaternion", format!("{pose:?}"))
        })?;
        let all = pose[..3].iter().copied().chain(align_hemisphere(q, reference));
        // Stored episodes are f32.
        for (slot, value) in out.iter_mut().zip(all) {
            *slot = value as f32;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lerobot::{Column, Dtype, Feature};
    use e2h_core::Direction;

    fn info() -> Info {
        let features = vec![
            ("tcp".to_owned(), Feature { shape: vec![8], ..Feature::scalar(Dtype::Float32) }),
            ("jaw".to_owned(), Feature::scalar(Dtype::Int64)),
        ];
        Info::new(30.0, None, features).unwrap()
    }

    fn table(tcp: &[f32]) -> Table {
        let columns =
            vec![("tcp".to_owned(), Column::F32(tcp.to_vec())), ("jaw".to_owned(), Column::I64(vec![10]))];
        Table { rows: 1, columns }
    }

    fn columns(pose: &str, rotation: &str) -> RobotColumns {
        RobotColumns {
            pose: pose.parse().unwrap(),
            rotation: rotation.parse().unwrap(),
            gripper: Some("jaw".parse().unwrap()),
            gripper_range: (20.0, 0.0),
            object: None,
        }
    }

    fn state(c: &RobotColumns, tcp: &[f32]) -> Result<e2h_core::State> {
        let origin = Origin::demonstration("t", Direction::Easy, 0, 0);
        Ok(c.episode(&table(tcp), &info(), origin, &[1.0, 0.0, 0.0, 0.0], 0.08)?.state[0])
    }

    #[test]
    fn slices_are_read_as_written() {
        for text in ["a", "a.b[3]", "a[0:7]"] {
            assert_eq!(text.parse::<ColumnSlice>().unwrap().to_string(), text);
        }
        for text in ["a[", "a[x]", "a[3:3]", "a[7:1]", "a[1:2:3]"] {
            assert!(text.parse::<ColumnSlice>().is_err(), "{text}");
        }
        let slice: ColumnSlice = "tcp[6:8]".parse().unwrap();
        assert_eq!(slice.entry_names(&info()).unwrap(), ["tcp.6", "tcp.7"]);
        assert_eq!(slice.read(&table(&[0., 1., 2., 3., 4., 5., 6., 7.]), &info()).unwrap(), [[6.0, 7.0]]);
    }

    #[test]
    fn every_way_to_write_an_orientation_gives_the_same_pose() {
        let (s, c) = (0.3_f32.sin(), 0.3_f32.cos());
        let wxyz = state(&columns("tcp[0:7]", "wxyz"), &[1., 2., 3., -c, 0., 0., -s, 9.]).unwrap();
        let xyzw = state(&columns("tcp[1:8]", "xyzw"), &[9., 1., 2., 3., 0., 0., s, c]).unwrap();
        let rotvec = state(&columns("tcp[0:6]", "rotvec"), &[1., 2., 3., 0., 0., 0.6, 9., 9.]).unwrap();
        let expected = [1., 2., 3., c, 0., 0., s, 0., 0., 0., 1., 0., 0., 0., 0.04];
        for found in [wxyz, xyzw, rotvec] {
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        }
        let none = state(&columns("tcp[0:3]", "none"), &[1., 2., 3., 9., 9., 9., 9., 9.]).unwrap();
        assert_eq!(none[..7], [1., 2., 3., 1., 0., 0., 0.]);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let message = |c: &RobotColumns, tcp: &[f32]| state(c, tcp).unwrap_err().to_string();
        let zeros = [0.0; 8];
        assert!(message(&columns("tpc[0:7]", "wxyz"), &zeros).contains("perhaps `tcp`"));
        assert!(message(&columns("tcp[0:6]", "wxyz"), &zeros).contains("expected 7 numbers"));
        assert!(message(&columns("tcp[2:9]", "wxyz"), &zeros).contains("entries below 8"));
        assert!(message(&columns("tcp[0:7]", "wxyz"), &zeros).contains("tcp[0:7], row 0"));
        let stuck = RobotColumns { gripper_range: (1.0, 1.0), ..columns("tcp[0:3]", "none") };
        assert!(message(&stuck, &zeros).contains("gripper range"));
    }
}
