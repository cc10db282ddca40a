//! What goes into a policy and comes out: widths, cameras, sizes.

use super::description::{Description, Feature, Obstacle};
use super::policy::centre;
use super::{ACTION, ENVIRONMENT, IMAGES, STATE};
use crate::model::Widths;
use crate::{Error, PolicyConfig, Result};
use e2h_core::{ACTION_DIM, Rng, STATE_DIM};
use e2h_data::Layout;
use rand::Rng as _;

/// Numbers that a state or an action may have, and sides of an image.
const WIDEST: usize = 1 << 16;

/// What goes into a policy and comes out, in LeRobot's words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Features {
    /// Numbers of `observation.state`.
    pub state: usize,
    /// Numbers of `observation.environment_state`; 0 without it.
    pub environment: usize,
    /// Numbers of an action.
    pub action: usize,
    /// Image features, in order.
    pub cameras: Vec<String>,
    /// Rows and columns of all images.
    pub size: [usize; 2],
    /// Rows and columns of the crop that the encoder sees: random in training, centred otherwise.
    pub crop: [usize; 2],
}

impl Features {
    /// Of recordings with images of one size, of which the encoder sees `crop` (rows, columns; none: all).
    ///
    /// # Errors
    /// [`Error::Config`] lists all that does not fit.
    pub fn of_layout(layout: &Layout, crop: Option<[usize; 2]>) -> Result<Self> {
        let mut problems = vec![];
        let size = layout.cameras.first().map_or([0; 2], |c| [c.height, c.width]);
        if let Some(other) = layout.cameras.iter().find(|c| [c.height, c.width] != size) {
            problems.push(format!(
                "cameras: expected images of one size ({} x {}, as `{}`), found {} x {} from `{}`",
                size[0], size[1], layout.cameras[0].feature, other.height, other.width, other.feature
            ));
        }
        let crop = crop.unwrap_or(size);
        if !layout.cameras.is_empty() && (crop[0] > size[0] || crop[1] > size[1] || crop.contains(&0)) {
            problems.push(format!(
                "crop: expected 1 x 1 to {} x {}, got {} x {}",
                size[0], size[1], crop[0], crop[1]
            ));
        }
        let environment = layout.environment.len();
        if !layout.cameras.is_empty() && environment > 0 {
            problems
                .push(format!("`{ENVIRONMENT}`: expected none beside cameras, found {environment} numbers"));
        }
        if !problems.is_empty() {
            return Err(Error::Config(problems.join("; ")));
        }
        Ok(Self {
            state: layout.state.len(),
            environment,
            action: layout.action_width(),
            cameras: layout.cameras.iter().map(|c| c.feature.clone()).collect(),
            size,
            crop,
        })
    }

    /// Of a policy of this project's tasks.
    pub(super) fn of_tasks(c: &PolicyConfig) -> Self {
        Self {
            state: STATE_DIM,
            environment: 0,
            action: ACTION_DIM,
            cameras: c.cameras.iter().map(|name| format!("{IMAGES}{name}")).collect(),
            size: [c.image_size; 2],
            crop: [c.crop_size; 2],
        }
    }

    /// All that keeps the network of `config` from making anything of these inputs.
    #[must_use]
    pub fn problems(&self, config: &PolicyConfig) -> Vec<String> {
        let mut problems = vec![];
        if !self.cameras.is_empty() {
            let (rows, columns) = config.encoder(self.crop[0], self.crop[1]).map_size();
            // A spatial softmax over one place says that place, whatever the image shows.
            if rows * columns < 4 {
                problems.push(format!(
                    "crop: expected one of which the encoder makes a map of at least four places, got {} x {} pixels, a map \
                     of {rows} x {columns}: take larger images",
                    self.crop[0], self.crop[1]
                ));
            }
        }
        problems
    }

    pub(crate) fn widths(&self) -> Widths {
        Widths { state: self.state + self.environment, action: self.action }
    }

    /// Corner of a random crop, and of the centred one.
    pub(crate) fn corner(&self, rng: Option<&mut Rng>) -> (usize, usize) {
        let [rows, columns] = [0, 1].map(|i| self.size[i] - self.crop[i]);
        match rng {
            Some(rng) => (rng.random_range(0..=rows), rng.random_range(0..=columns)),
            None => (centre(rows), centre(columns)),
        }
    }

    pub(super) fn of(d: &Description, problems: &mut Vec<Obstacle>) -> Self {
        let mut vector = |all: &[(String, Feature)], name: &str, needed: bool| match all
            .iter()
            .find(|(n, _)| n == name)
            .map(|(_, f)| &f.shape[..])
        {
            Some(&[n]) if n > 0 && n <= WIDEST => n,
            None if !needed => 0,
            found => {
                problems.push(Obstacle::new(name, "a vector of up to 65536 numbers", format!("{found:?}")));
                0
            }
        };
        let (inputs, outputs) = (&d.input_features.0, &d.output_features.0);
        let state = vector(inputs, STATE, true);
        let environment = vector(inputs, ENVIRONMENT, false);
        let action = vector(outputs, ACTION, true);
        let images: Vec<&(String, Feature)> = inputs.iter().filter(|(_, f)| f.kind == "VISUAL").collect();
        let mut size = [0; 2];
        for (name, feature) in &images {
            match feature.shape[..] {
                [3, h, w] if h.max(w) <= WIDEST && (size == [0; 2] || size == [h, w]) => size = [h, w],
                _ => problems.push(Obstacle::new(
                    name,
                    "3 channels and the same size in all cameras",
                    format!("{:?}", feature.shape),
                )),
            }
        }
        let crop = d.crop_shape.unwrap_or(size);
        if !images.is_empty() && (crop[0] > size[0] || crop[1] > size[1] || crop.contains(&0)) {
            problems.push(Obstacle::new("crop_shape", format!("1 to {size:?}"), format!("{crop:?}")));
        }
        if !images.is_empty() && environment > 0 {
            problems.push(Obstacle::new(
                ENVIRONMENT,
                "none beside images",
                format!("{environment} numbers and {} cameras", images.len()),
            ));
        }
        let cameras = images.iter().map(|(n, _)| n.clone()).collect();
        Self { state, environment, action, cameras, size, crop }
    }
}
