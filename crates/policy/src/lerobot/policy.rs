//! A LeRobot policy with its own widths of state and action.

use super::description::Obstacle;
use super::scaling::Scaling;
use super::{IMAGES, STATE};
use crate::model::{DiffusionModel, Widths};
use crate::policy::denoise;
use crate::{Ddim, DiffusionPolicy, Error, ImageScaling, PolicyConfig, Provenance, Result};
use candle_core::Tensor;
use e2h_core::{ACTION_DIM, Image, STATE_DIM};
use e2h_data::Normaliser;
use e2h_nn::Compute;
use std::path::PathBuf;

/// What a LeRobot policy sees at one step, in the units of its dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct LerobotObservation {
    /// `observation.state`.
    pub state: Vec<f32>,
    /// `observation.environment_state`; empty for a policy without it.
    pub environment: Vec<f32>,
    /// One image per camera, in the order of [`LerobotPolicy::cameras`].
    pub images: Vec<Image>,
}

/// A diffusion policy of LeRobot's, ready to act.
pub struct LerobotPolicy {
    pub(super) path: PathBuf,
    pub(super) model: DiffusionModel,
    pub(super) ddim: Ddim,
    /// The network; its image and crop sizes are those of the crop's rows.
    pub(super) config: PolicyConfig,
    pub(super) state: (usize, Scaling),
    pub(super) environment: (usize, Scaling),
    pub(super) action: (usize, Scaling),
    /// Feature and scaling of each camera.
    pub(super) cameras: Vec<(String, ImageScaling)>,
    /// Rows and columns of its images.
    pub(super) size: [usize; 2],
    /// Rows and columns of the crop that the encoder sees.
    pub(super) crop: [usize; 2],
    pub(super) provenance: Option<Provenance>,
}

impl LerobotPolicy {
    /// The same policy on another device.
    ///
    /// # Errors
    /// When the device fails.
    pub fn into_device(self, compute: &Compute) -> Result<Self> {
        let widths = Widths { state: self.state.0 + self.environment.0, action: self.action.0 };
        let model = self.model.into_device(compute, &self.config, widths)?;
        Ok(Self { model, ..self })
    }

    /// Numbers of `observation.state`.
    #[must_use]
    pub fn state_dim(&self) -> usize {
        self.state.0
    }

    /// Numbers of `observation.environment_state`.
    #[must_use]
    pub fn environment_dim(&self) -> usize {
        self.environment.0
    }

    /// Numbers of an action.
    #[must_use]
    pub fn action_dim(&self) -> usize {
        self.action.0
    }

    /// Names of the image features, in order.
    pub fn cameras(&self) -> impl Iterator<Item = &str> {
        self.cameras.iter().map(|(name, _)| name.as_str())
    }

    /// Rows and columns of its images.
    #[must_use]
    pub fn image_size(&self) -> [usize; 2] {
        self.size
    }

    /// Observations of a history.
    #[must_use]
    pub fn n_obs_steps(&self) -> usize {
        self.config.n_obs_steps
    }

    /// Predicted actions, T, of which `n_action_steps` are returned.
    #[must_use]
    pub fn horizon(&self) -> usize {
        self.config.horizon
    }

    /// Actions that it returns at once.
    #[must_use]
    pub fn n_action_steps(&self) -> usize {
        self.config.n_action_steps
    }

    /// Where it comes from, when this project wrote the folder.
    #[must_use]
    pub fn provenance(&self) -> Option<&Provenance> {
        self.provenance.as_ref()
    }

    fn check(&self, histories: &[Vec<&LerobotObservation>]) -> Result<()> {
        let same = |quantity: &str, expected: String, found: String| {
            if expected == found {
                return Ok(());
            }
            Err(Error::Observation { quantity: quantity.to_owned(), expected, found })
        };
        let [rows, columns] = self.size;
        for history in histories {
            same("steps of history", self.n_obs_steps().to_string(), history.len().to_string())?;
            for o in history {
                same("numbers of the state", self.state.0.to_string(), o.state.len().to_string())?;
                let found = o.environment.len().to_string();
                same("numbers of the environment state", self.environment.0.to_string(), found)?;
                same("images", self.cameras.len().to_string(), o.images.len().to_string())?;
                for (image, camera) in o.images.iter().zip(self.cameras()) {
                    let shape = |h: usize, w: usize, n: usize| format!("{h} x {w} ({n} bytes)");
                    let found = shape(image.height, image.width, image.data.len());
                    same(&format!("image `{camera}`"), shape(rows, columns, rows * columns * 3), found)?;
                }
                if let Some(v) = o.state.iter().chain(&o.environment).find(|v| !v.is_finite()) {
                    same("state", "finite numbers".to_owned(), v.to_string())?;
                }
            }
        }
        Ok(())
    }

    /// The next `n_action_steps` actions for each history, oldest observation first. `noise` fills the slice that it is given:
    /// once for where sampling begins, and for a DDPM policy once more for every step.
    ///
    /// # Shapes
    /// The slice is (histories, T, action), the result (histories, `n_action_steps`, action).
    ///
    /// # Errors
    /// When the observations do not fit the policy.
    pub fn sample(
        &self,
        histories: &[Vec<&LerobotObservation>],
        noise: &mut dyn FnMut(&mut [f32]),
    ) -> Result<Vec<Vec<Vec<f32>>>> {
        if histories.is_empty() {
            return Ok(vec![]);
        }
        self.check(histories)?;
        let c = &self.config;
        let mut state = vec![];
        let mut images = vec![vec![]; self.cameras.len()];
        for o in histories.iter().flatten() {
            for (values, scaling) in [(&o.state, &self.state.1), (&o.environment, &self.environment.1)] {
                let start = state.len();
                state.extend_from_slice(values);
                scaling.normalise(&mut state[start..]);
            }
            for ((pixels, image), (_, scaling)) in images.iter_mut().zip(&o.images).zip(&self.cameras) {
                self.push_crop(image, scaling, pixels);
            }
        }
        let (b, device) = (histories.len(), self.model.device());
        let width = state.len() / b;
        let state = Tensor::from_vec(state, (b, width), device)?;
        let [rows, columns] = self.crop;
        let images = images
            .into_iter()
            .map(|v| Tensor::from_vec(v, (b * c.n_obs_steps, rows, columns, 3), device))
            .collect::<candle_core::Result<Vec<_>>>()?;
        let condition = self.model.condition(&state, &images)?;
        let mut x = denoise(&self.model, &self.ddim, c, self.action.0, &condition, noise)?;
        self.action.1.invert(&mut x);
        let action = |row: &[f32]| row.to_vec();
        Ok(x.chunks_exact(c.horizon * self.action.0)
            .map(|sample| {
                let rows = sample.chunks_exact(self.action.0);
                rows.skip(c.n_obs_steps - 1).take(c.n_action_steps).map(action).collect()
            })
            .collect())
    }

    /// Appends the centre of an image, scaled.
    fn push_crop(&self, image: &Image, scaling: &ImageScaling, pixels: &mut Vec<f32>) {
        let [top, left] = [0, 1].map(|i| centre(self.size[i] - self.crop[i]));
        let start = pixels.len();
        for row in top..top + self.crop[0] {
            let from = (row * image.width + left) * 3;
            let bytes = &image.data[from..from + self.crop[1] * 3];
            pixels.extend(bytes.iter().map(|&v| f32::from(v) / 255.0));
        }
        scaling.apply(&mut pixels[start..]);
    }

    /// One of our policies that acts the same, where states and actions are this project's.
    ///
    /// # Errors
    /// [`Error::Lerobot`] lists everything that does not fit.
    pub fn into_policy(self) -> Result<(DiffusionPolicy, Provenance)> {
        let mut problems = vec![];
        let mut ask = |ok: bool, setting: &str, expected: String, found: String| {
            if !ok {
                problems.push(Obstacle::new(setting, expected, found));
            }
        };
        ask(self.state.0 == STATE_DIM, STATE, format!("{STATE_DIM} numbers"), self.state.0.to_string());
        let environment = self.environment.0;
        ask(environment == 0, super::ENVIRONMENT, "none".to_owned(), format!("{environment} numbers"));
        let action = self.action.0;
        ask(action == ACTION_DIM, super::ACTION, format!("{ACTION_DIM} numbers"), action.to_string());
        let ([h, w], [rows, columns]) = (self.size, self.crop);
        ask(h == w, "image size", "a square".to_owned(), format!("{h} x {w}"));
        ask(rows == columns, "crop_shape", "a square".to_owned(), format!("{rows} x {columns}"));
        let centred = (h.saturating_sub(rows)) % 4 != 3;
        ask(centred, "crop_shape", "a crop whose centre is ours too".to_owned(), format!("{rows} of {h}"));
        if !problems.is_empty() {
            return Err(Error::Lerobot {
                doing: "making our policy of",
                path: self.path,
                obstacles: problems,
            });
        }
        let (state, action) = (&self.state.1, &self.action.1);
        let normaliser = Normaliser {
            state_min: std::array::from_fn(|i| state.range(i, false).0),
            state_max: std::array::from_fn(|i| state.range(i, false).1),
            action_min: std::array::from_fn(|i| action.range(i, true).0),
            action_max: std::array::from_fn(|i| action.range(i, true).1),
        }
        .check()
        .map_err(|e| Error::Checkpoint { path: self.path.clone(), problem: e.to_string() })?;
        let plain = ImageScaling { mean: [0.0; 3], std: [1.0; 3] };
        let scaled = self.cameras.iter().any(|(_, s)| *s != plain);
        let name =
            |n: &String| n.strip_prefix(IMAGES).or(n.strip_prefix("observation.")).unwrap_or(n).to_owned();
        let config = PolicyConfig {
            cameras: self.cameras.iter().map(|(n, _)| name(n)).collect(),
            image_size: h,
            crop_size: rows,
            image_scaling: if scaled { self.cameras.iter().map(|c| c.1.clone()).collect() } else { vec![] },
            ..self.config
        };
        let policy = DiffusionPolicy::with_weights(&config, &normaliser, &self.model.params.export()?)
            .map_err(|e| Error::Checkpoint { path: self.path, problem: e.to_string() })?;
        let provenance = self.provenance.unwrap_or_else(|| Provenance {
            preset: "lerobot".to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            ..Provenance::default()
        });
        Ok((policy, provenance))
    }
}

/// Where torchvision puts the first row of a centred crop: half of what is left over, halves to the even number.
pub(super) fn centre(border: usize) -> usize {
    let half = border / 2;
    if border % 2 == 1 && half % 2 == 1 { half + 1 } else { half }
}
