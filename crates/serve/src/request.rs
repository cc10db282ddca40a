//! A client's message as observations that fit the policy.

use crate::servable::{Camera, Inputs, Seen};
use crate::wire::{Array, Dtype, Value};
use crate::{Error, Result};
use e2h_core::{Image, Rng};
use rand::SeedableRng as _;

/// Key of a random stream of the client's: where its ChaCha8 stands. The answer has it too, as far as it was used.
pub(crate) const STREAM: &str = "random_stream";
/// Bytes of a stream: key, number, position.
const STREAM_BYTES: usize = 32 + 8 + 16;

/// What openpi calls the images of the first two cameras.
pub(crate) const OPENPI_IMAGES: [&str; 2] = ["observation/image", "observation/wrist_image"];

/// What a client asks.
#[derive(Debug, Clone)]
pub struct Request {
    /// What it sees, oldest first; To observations.
    pub history: Vec<Seen>,
    /// Where the answer's random numbers begin, if the client says so.
    pub seed: Option<u64>,
    /// Whether the connection's random stream begins anew.
    pub reset: bool,
    /// A stream of the client's.
    pub stream: Option<Rng>,
}

impl Request {
    /// Reads a message for a policy that takes `inputs`. Keys that nobody asks for, such as `prompt`, are passed over.
    ///
    /// # Errors
    /// When something is missing (all that is expected is listed) or is of another shape or type, or a number is not finite.
    pub fn read(message: &Value, inputs: &Inputs) -> Result<Self> {
        if !matches!(message, Value::Map(_)) {
            return Err(Error::mismatch("request", "a map of observations", message.kind()));
        }
        let steps = inputs.n_obs_steps;
        let reader = Reader { message, inputs };
        let state = reader.numbers("state", inputs.state)?;
        let environment = reader.numbers("environment_state", inputs.environment)?;
        let mut images = vec![];
        for (i, camera) in inputs.cameras.iter().enumerate() {
            images.push(reader.images(i, camera)?);
        }
        reader.same_steps()?;
        let history = (0..steps)
            .map(|t| Seen {
                state: at(&state, t).unwrap_or_default(),
                environment: at(&environment, t).unwrap_or_default(),
                images: images.iter().filter_map(|steps| at(steps, t)).collect(),
            })
            .collect();
        let wrong =
            |key: &str, expected: &str, found: &Value| Err(Error::mismatch(key, expected, found.kind()));
        let seed = match message.get("seed") {
            None | Some(Value::Nil) => None,
            Some(value) => match value.as_u64() {
                None => return wrong("`seed`", "a whole number from 0 on", value),
                seed => seed,
            },
        };
        let reset = match message.get("reset") {
            None | Some(Value::Nil) => false,
            Some(Value::Bool(reset)) => *reset,
            Some(value) => return wrong("`reset`", "true or false", value),
        };
        let stream = match message.get(STREAM) {
            None | Some(Value::Nil) => None,
            Some(value) => Some(read_stream(value)?),
        };
        Ok(Self { history, seed, reset, stream })
    }
}

/// A single observation is seen at every step.
fn at<T: Clone>(steps: &[T], t: usize) -> Option<T> {
    steps.get(t).or(steps.last()).cloned()
}

struct Reader<'a> {
    message: &'a Value,
    inputs: &'a Inputs,
}

impl Reader<'_> {
    fn missing(&self, what: &str) -> Error {
        let i = self.inputs;
        let mut expected = vec![format!("`observation/state` ({} numbers)", i.state)];
        if i.environment > 0 {
            expected.push(format!("`observation/environment_state` ({} numbers)", i.environment));
        }
        expected.extend(
            i.cameras
                .iter()
                .map(|c| format!("`observation/images/{}` ({} x {} x 3 uint8)", c.name, c.height, c.width)),
        );
        let found = match self.message {
            Value::Map(map) if !map.is_empty() => {
                map.keys().take(32).map(|k| format!("`{k}`")).collect::<Vec<_>>().join(", ")
            }
            _ => "an empty map".to_owned(),
        };
        Error::mismatch("request", format!("{} ({what} is missing)", expected.join(", ")), found)
    }

    /// The first of these keys that the message has.
    fn find(&self, keys: &[String]) -> Option<(String, &Value)> {
        keys.iter().find_map(|key| Some((key.clone(), self.message.get(key)?)))
    }

    fn numbers_keys(name: &str) -> [String; 3] {
        [format!("observation/{name}"), format!("observation.{name}"), name.to_owned()]
    }

    fn image_keys(&self, index: usize, camera: &Camera) -> Vec<String> {
        let name = &camera.name;
        let mut keys = ["observation/images/", "observation.images.", "observation/", "observation.", ""]
            .map(|before| format!("{before}{name}"))
            .to_vec();
        // Openpi's name of the second camera may be the name of the first one here.
        let exact = |key: &str| self.inputs.cameras.iter().any(|c| key == format!("observation/{}", c.name));
        keys.extend(OPENPI_IMAGES.get(index).filter(|key| !exact(key)).map(|key| (*key).to_owned()));
        keys
    }

    /// One row a step, or one for all.
    fn numbers(&self, name: &str, width: usize) -> Result<Vec<Vec<f32>>> {
        if width == 0 {
            return Ok(vec![]);
        }
        let keys = Self::numbers_keys(name);
        let (key, value) = self.find(&keys).ok_or_else(|| self.missing(&format!("`{}`", keys[0])))?;
        let steps = self.inputs.n_obs_steps;
        let wrong = || {
            let history = if steps > 1 { format!(" or [{steps}, {width}]") } else { String::new() };
            Error::mismatch(&format!("`{key}`"), format!("numbers of shape [{width}]{history}"), value.kind())
        };
        let flat = match value {
            Value::Array(a) if !matches!(a.dtype(), Dtype::B1) => match *a.shape() {
                [n] if n == width => a.to_f32(),
                [t, n] if n == width && (t == 1 || t == steps) => a.to_f32(),
                _ => return Err(wrong()),
            },
            Value::List(list) if list.len() == width => list
                .iter()
                .map(|v| match v {
                    Value::Int(v) => Some(*v as f32),
                    Value::Float(v) => Some(*v as f32),
                    _ => None,
                })
                .collect::<Option<Vec<f32>>>()
                .ok_or_else(wrong)?,
            _ => return Err(wrong()),
        };
        match flat.iter().position(|v| !v.is_finite()) {
            Some(i) => {
                let found = format!("{} at entry {}", flat[i], i % width);
                Err(Error::mismatch(&format!("`{key}`"), "finite numbers", found))
            }
            None => Ok(flat.chunks_exact(width).map(<[f32]>::to_vec).collect()),
        }
    }

    /// One image a step, or one for all.
    fn images(&self, index: usize, camera: &Camera) -> Result<Vec<Image>> {
        let keys = self.image_keys(index, camera);
        let (key, value) = self.find(&keys).ok_or_else(|| self.missing(&format!("`{}`", keys[0])))?;
        let Camera { height, width, .. } = *camera;
        let steps = self.inputs.n_obs_steps;
        let wrong = |found: String| {
            let history =
                if steps > 1 { format!(", perhaps with {steps} steps before it") } else { String::new() };
            let expected = format!("uint8 from 0 to 255 of shape [{height}, {width}, 3]{history}");
            Error::mismatch(&format!("`{key}`"), expected, found)
        };
        let Value::Array(array) = value else { return Err(wrong(value.kind())) };
        if array.dtype() != Dtype::U1 {
            return Err(wrong(format!("{array}; numbers from 0 to 1 are to be multiplied by 255")));
        }
        let (before, sides) = match array.shape() {
            [a, b, c] => (1, [*a, *b, *c]),
            [t, a, b, c] if *t == 1 || *t == steps => (*t, [*a, *b, *c]),
            _ => return Err(wrong(array.to_string())),
        };
        let rows_first = sides == [height, width, 3];
        if !rows_first && sides != [3, height, width] {
            return Err(wrong(array.to_string()));
        }
        let size = height * width * 3;
        let image = |data: &[u8]| {
            let data = if rows_first {
                data.to_vec()
            } else {
                let plane = height * width;
                (0..size).map(|i| data[i % 3 * plane + i / 3]).collect()
            };
            Image { height, width, data }
        };
        Ok((0..before).map(|t| image(&array.data()[t * size..(t + 1) * size])).collect())
    }

    /// Refuses some inputs with a history beside others without.
    fn same_steps(&self) -> Result<()> {
        let steps = self.inputs.n_obs_steps;
        if steps == 1 {
            return Ok(());
        }
        let has_history = |value: &Value, single: usize| match value {
            Value::Array(a) => a.shape().len() > single && a.shape().first() != Some(&1),
            _ => false,
        };
        let mut with = vec![];
        let mut without = vec![];
        let mut sort = |found: Option<(String, &Value)>, single: usize| {
            if let Some((key, value)) = found {
                let list = if has_history(value, single) { &mut with } else { &mut without };
                list.push(format!("`{key}`"));
            }
        };
        sort(self.find(&Self::numbers_keys("state")), 1);
        if self.inputs.environment > 0 {
            sort(self.find(&Self::numbers_keys("environment_state")), 1);
        }
        for (i, camera) in self.inputs.cameras.iter().enumerate() {
            sort(self.find(&self.image_keys(i, camera)), 3);
        }
        if with.is_empty() || without.is_empty() {
            return Ok(());
        }
        let expected = format!("{steps} steps in all arrays, or one in all");
        let found = format!("{steps} in {}, one in {}", with.join(", "), without.join(", "));
        Err(Error::mismatch("request", expected, found))
    }
}

/// Where a stream stands, for a message.
pub(crate) fn write_stream(rng: &Rng) -> Value {
    let mut bytes = rng.get_seed().to_vec();
    bytes.extend(rng.get_stream().to_le_bytes());
    bytes.extend(rng.get_word_pos().to_le_bytes());
    Value::Bytes(bytes)
}

/// The stream that a message says.
pub(crate) fn read_stream(value: &Value) -> Result<Rng> {
    let wrong = || {
        let expected = format!("{STREAM_BYTES} bytes: the key of a ChaCha8, its stream, its position");
        Error::mismatch(&format!("`{STREAM}`"), expected, value.kind())
    };
    let Value::Bytes(bytes) = value else { return Err(wrong()) };
    let (key, rest) = bytes.split_first_chunk::<32>().ok_or_else(wrong)?;
    let (stream, position) = rest.split_first_chunk::<8>().ok_or_else(wrong)?;
    let position: [u8; 16] = position.try_into().map_err(|_| wrong())?;
    let position = u128::from_le_bytes(position);
    // Words that the generator has before it begins again.
    if position >> 68 != 0 {
        return Err(Error::mismatch(&format!("`{STREAM}`"), "a position below 2^68", position.to_string()));
    }
    let mut rng = Rng::from_seed(*key);
    rng.set_stream(u64::from_le_bytes(*stream));
    rng.set_word_pos(position);
    Ok(rng)
}

/// The actions of an answer.
pub(crate) fn actions(chunk: &[Vec<f32>], width: usize) -> Array {
    Array::f32(&[chunk.len(), width], &chunk.concat())
}
