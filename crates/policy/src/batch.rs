//! Host-side assembly of what the network is fed: every number passes through here once.

use crate::config::TOOL_FRAME;
use crate::{Error, ImageScaling, PolicyConfig, Result};
use candle_core::{Device, Tensor};
use e2h_core::state::{EEF_QUATERNION, OBJECT_QUATERNION, eef_position, object_position};
use e2h_core::{Episode, Frames, Observation, Rng, State};
use e2h_data::Normaliser;
use rand::Rng as _;
use rayon::prelude::*;

/// Top-left corner of a crop, pixels (row, column).
pub(crate) type Corner = (usize, usize);

/// Where state rows come from.
pub(crate) enum Rows<'a> {
    Observations(&'a [&'a Observation]),
    Episode(&'a Episode, &'a [usize]),
}

/// Random factors on an image: (contrast, brightness).
pub(crate) type Jitter = (f32, f32);

/// An image to append, and where its crop begins.
pub(crate) struct Part<'a> {
    pub(crate) camera: usize,
    pub(crate) frames: &'a Frames,
    pub(crate) row: usize,
    pub(crate) corner: Corner,
}

/// State and images of a batch, growing sample by sample.
pub(crate) struct BatchBuilder {
    state: Vec<f32>,
    images: Vec<Vec<f32>>,
    samples: usize,
    relative: bool,
    tool_frame: bool,
    /// Largest normalised state entry.
    limit: f32,
    scaling: Vec<ImageScaling>,
    /// Columns of the images.
    stride: usize,
}

impl BatchBuilder {
    pub(crate) fn new(config: &PolicyConfig) -> Self {
        Self {
            state: vec![],
            images: vec![vec![]; if config.n_image_steps == 0 { 0 } else { config.cameras.len() }],
            samples: 0,
            relative: config.relative_features,
            tool_frame: config.tool_frame_features,
            limit: if config.state_limit > 0.0 { config.state_limit } else { f32::INFINITY },
            scaling: config.image_scaling.clone(),
            stride: config.image_size,
        }
    }

    /// The same for images of so many columns, scaled so.
    pub(crate) fn of_images(self, stride: usize, scaling: &[ImageScaling]) -> Self {
        Self { stride, scaling: scaling.to_vec(), ..self }
    }

    /// Appends the scaled state history of one sample as it is, for recordings of any width.
    pub(crate) fn push_scaled(
        &mut self,
        rows: &[usize],
        state: impl Fn(usize, &mut Vec<f32>),
        noise: Option<(f32, &mut Rng)>,
    ) {
        let start = self.state.len();
        rows.iter().for_each(|&row| state(row, &mut self.state));
        if let Some((sigma, rng)) = noise.filter(|(sigma, _)| *sigma > 0.0) {
            for v in &mut self.state[start..] {
                *v += sigma * rng.sample::<f32, _>(rand_distr::StandardNormal);
            }
        }
        self.samples += 1;
    }

    /// Appends the normalised state history of one sample; `noise` is (standard deviation, stream) in training.
    pub(crate) fn push_state(
        &mut self,
        rows: Rows<'_>,
        normaliser: &Normaliser,
        mut noise: Option<(f32, &mut Rng)>,
    ) {
        let mut push = |state: &State| {
            let start = self.state.len();
            let limit = |v: f32| v.clamp(-self.limit, self.limit);
            self.state.extend(normaliser.normalise_state(state).map(limit));
            if self.relative {
                self.state.extend(from_tool(state).map(limit));
            }
            if self.tool_frame {
                self.state.extend(in_tool_frame(state).map(limit));
            }
            if let Some((sigma, rng)) = &mut noise
                && *sigma > 0.0
            {
                for v in &mut self.state[start..] {
                    *v += *sigma * rng.sample::<f32, _>(rand_distr::StandardNormal);
                }
            }
        };
        match rows {
            Rows::Observations(observations) => observations.iter().for_each(|o| push(&o.state)),
            Rows::Episode(episode, rows) => rows.iter().for_each(|&r| push(&episode.state[r])),
        }
        self.samples += 1;
    }

    /// Appends the crop at `corner` of one (side, side, 3) image.
    pub(crate) fn push_image(
        &mut self,
        camera: usize,
        image: &[u8],
        corner: Corner,
        crop: usize,
        jitter: Option<Jitter>,
    ) {
        self.push_part(camera, image, corner, [crop, crop], jitter);
    }

    /// The same for a crop of rows and columns.
    pub(crate) fn push_part(
        &mut self,
        camera: usize,
        image: &[u8],
        corner: Corner,
        [rows, columns]: [usize; 2],
        jitter: Option<Jitter>,
    ) {
        let Some(column) = self.images.get_mut(camera) else { return };
        let first = column.len();
        column.resize(first + rows * columns * 3, 0.0);
        let scaling = self.scaling.get(camera);
        fill(&mut column[first..], image, (corner, columns, self.stride), &table(jitter), scaling);
    }

    /// Appends parts of images of `crop` rows and columns in their order. Threads share the work: at the paper's batch it is
    /// 150 MB a step.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub(crate) fn push_parts(&mut self, parts: &[Part<'_>], crop: [usize; 2]) -> Result<()> {
        let (size, table, stride) = ((crop[0] * crop[1] * 3).max(1), table(None), self.stride);
        for (camera, column) in self.images.iter_mut().enumerate() {
            let of: Vec<&Part<'_>> = parts.iter().filter(|p| p.camera == camera).collect();
            let (first, scaling) = (column.len(), self.scaling.get(camera));
            column.resize(first + of.len() * size, 0.0);
            column[first..].par_chunks_exact_mut(size).zip(of).try_for_each(|(to, part)| -> Result<()> {
                let image = part.frames.image(part.row)?;
                fill(to, &image, (part.corner, crop[1], stride), &table, scaling);
                Ok(())
            })?;
        }
        Ok(())
    }

    /// Appends the middle of the images of one row, one a camera.
    ///
    /// # Errors
    /// When the episode lacks a camera's images in the size of the configuration, or they cannot be read.
    pub(crate) fn push_frame(&mut self, c: &PolicyConfig, episode: &Episode, row: usize) -> Result<()> {
        if c.n_image_steps == 0 {
            return Ok(());
        }
        for (camera, name) in c.cameras.iter().enumerate() {
            let named = episode.frames.iter().find(|f| f.camera == *name);
            let frames = named.filter(|f| f.height == c.image_size).ok_or_else(|| {
                Error::Data(format!(
                    "expected images of {0} x {0} from camera {name}, found {1:?}",
                    c.image_size,
                    episode.frames.iter().map(|f| (&f.camera, f.height)).collect::<Vec<_>>()
                ))
            })?;
            self.push_image(camera, &frames.image(row)?, c.centre_crop(), c.crop_size, None);
        }
        Ok(())
    }

    /// State (B, To * S) and one (B * steps, crop, crop, 3) tensor a camera, on `device`.
    pub(crate) fn tensors(self, crop: usize, device: &Device) -> Result<(Tensor, Vec<Tensor>)> {
        self.tensors_of([crop, crop], device)
    }

    /// The same for crops of rows and columns.
    pub(crate) fn tensors_of(
        self,
        [rows, columns]: [usize; 2],
        device: &Device,
    ) -> Result<(Tensor, Vec<Tensor>)> {
        let width = self.state.len() / self.samples.max(1);
        let state = Tensor::from_vec(self.state, (self.samples, width), device)?;
        let images = self
            .images
            .into_iter()
            .map(|data| {
                let n = data.len() / (rows * columns * 3);
                Tensor::from_vec(data, (n, rows, columns, 3), device)
            })
            .collect::<candle_core::Result<_>>()?;
        Ok((state, images))
    }
}

/// What each value of a pixel becomes: a look-up instead of the arithmetic.
fn table(jitter: Option<Jitter>) -> [f32; 256] {
    let (contrast, brightness) = jitter.unwrap_or((1.0, 0.0));
    std::array::from_fn(|v| ((v as f32 / 255.0 - 0.5) * contrast + 0.5 + brightness).clamp(0.0, 1.0))
}

/// Copies the part at `corner`, of so many columns, of an image whose rows have `stride` pixels.
fn fill(
    to: &mut [f32],
    image: &[u8],
    (corner, columns, stride): (Corner, usize, usize),
    table: &[f32; 256],
    scaling: Option<&ImageScaling>,
) {
    for (row, to) in to.chunks_exact_mut((columns * 3).max(1)).enumerate() {
        let start = ((corner.0 + row) * stride + corner.1) * 3;
        for (to, v) in to.iter_mut().zip(&image[start..start + columns * 3]) {
            *to = table[usize::from(*v)];
        }
    }
    if let Some(scaling) = scaling {
        scaling.apply(to);
    }
}

/// From the tool to the object, in units of 10 cm: centred on zero and of the order of one, whatever the task's ranges are.
fn from_tool(state: &State) -> [f32; 3] {
    let (object, tool) = (object_position(state), eef_position(state));
    std::array::from_fn(|i| (object[i] - tool[i]) * 10.0)
}

/// The object's pose in the frame of the tool: position in units of 10 cm, and the first two columns of the rotation matrix.
fn in_tool_frame(state: &State) -> [f32; TOOL_FRAME] {
    let columns = |q: &[f32]| {
        let n = q.iter().map(|v| v * v).sum::<f32>().max(1e-12);
        let [w, x, y, z] = [0, 1, 2, 3].map(|i| q[i] / n.sqrt());
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)],
            [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)],
            [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    };
    let (tool, object) = (columns(&state[EEF_QUATERNION]), columns(&state[OBJECT_QUATERNION]));
    let seen = |v: [f32; 3]| tool.map(|axis| axis.iter().zip(&v).map(|(a, b)| a * b).sum::<f32>());
    let position = seen(from_tool(state));
    let mut out = [0.0; TOOL_FRAME];
    for (slot, v) in out.iter_mut().zip([position, seen(object[0]), seen(object[1])].concat()) {
        *slot = v;
    }
    out
}

impl ImageScaling {
    /// Scales (..., 3) pixels in [0, 1].
    pub(crate) fn apply(&self, pixels: &mut [f32]) {
        for pixel in pixels.as_chunks_mut::<3>().0 {
            for (v, (mean, std)) in pixel.iter_mut().zip(self.mean.iter().zip(&self.std)) {
                *v = (*v - mean) / std;
            }
        }
    }
}

impl PolicyConfig {
    /// Corner of the centred crop.
    pub(crate) fn centre_crop(&self) -> Corner {
        let c = (self.image_size - self.crop_size) / 2;
        (c, c)
    }

    /// Corner of a random crop.
    pub(crate) fn random_crop(&self, rng: &mut Rng) -> Corner {
        let room = self.image_size - self.crop_size;
        (rng.random_range(0..=room), rng.random_range(0..=room))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tool_sees_the_same_wherever_both_are_and_however_they_are_turned() {
        let row = |tool: [f32; 7], object: [f32; 7]| {
            let mut state = State::default();
            state[..7].copy_from_slice(&tool);
            state[7..14].copy_from_slice(&object);
            state
        };
        // A tool that points down sees an object 10 cm below it ahead, and its z axis turned over.
        let down = [0.0, 1.0, 0.0, 0.0];
        let a = in_tool_frame(&row([0.5, 0.1, 0.2, 0.0, 1.0, 0.0, 0.0], [0.5, 0.1, 0.1, 1.0, 0.0, 0.0, 0.0]));
        assert_eq!(a, [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0]);
        // Both carried elsewhere and turned by 0.7 rad about the vertical; a quaternion's sign says nothing.
        let (s, c) = (0.35_f32.sin(), 0.35_f32.cos());
        let turned = [c * down[0] - s * down[3], c * down[1] - s * down[2], c * down[2] + s * down[1], 0.0];
        let b = in_tool_frame(&row(
            [-0.2, 0.3, 0.5, turned[0], turned[1], turned[2], turned[3]],
            [-0.2, 0.3, 0.4, -c, 0.0, 0.0, -s],
        ));
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-6), "{a:?} {b:?}");
    }
}
