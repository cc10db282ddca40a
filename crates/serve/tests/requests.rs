//! What a request may look like, and what is said of one that does not.

use crate::common::{entries, message, policy, seen};
use e2h_serve::wire::{Array, Dtype, Value};
use e2h_serve::{Inputs, Request, Servable as _};

fn inputs() -> Inputs {
    policy(&["wrist", "table"]).inputs()
}

fn without(k: u64, inputs: &Inputs, key: &str) -> Vec<(String, Value)> {
    let mut all = entries(&seen(k, inputs), inputs);
    all.retain(|(name, _)| name != key);
    all
}

fn with(key: &str, value: impl Into<Value>) -> Value {
    let inputs = inputs();
    let old = if key.contains("state") { "observation/state" } else { "observation/images/wrist" };
    let mut all = without(0, &inputs, old);
    all.push((key.to_owned(), value.into()));
    message(all)
}

fn refused(request: &Value, words: &[&str]) {
    let error = Request::read(request, &inputs()).unwrap_err().to_string();
    for word in words {
        assert!(error.contains(word), "expected `{word}` in: {error}");
    }
}

#[test]
fn every_name_is_found() {
    let inputs = inputs();
    let seen = seen(3, &inputs);
    let state: Value = Array::f32(&[15], &seen.state).into();
    let [wrist, table]: [Value; 2] = [0, 1].map(|i| Array::image(&seen.images[i]).into());
    for s in ["observation/state", "observation.state", "state"] {
        for before in ["observation/images/", "observation.images.", "observation/", ""] {
            let request = Value::map([
                (s, state.clone()),
                (&format!("{before}wrist"), wrist.clone()),
                (&format!("{before}table"), table.clone()),
                ("prompt", "put it on".into()),
            ]);
            let read = Request::read(&request, &inputs).unwrap();
            assert_eq!(read.history, vec![seen.clone(); inputs.n_obs_steps], "{s} {before}");
        }
    }
    let openpi = Value::map([
        ("observation/state", state.clone()),
        ("observation/image", wrist.clone()),
        ("observation/wrist_image", table.clone()),
    ]);
    assert_eq!(Request::read(&openpi, &inputs).unwrap().history[0], seen);
    // A key with the camera's own name wins over openpi's.
    let both = Value::map([
        ("observation/state", state),
        ("observation/image", table.clone()),
        ("observation/images/wrist", wrist),
        ("table", table),
    ]);
    assert_eq!(Request::read(&both, &inputs).unwrap().history[0], seen);
}

#[test]
fn a_history_comes_oldest_first_and_one_observation_fills_it() {
    let inputs = inputs();
    assert_eq!(inputs.n_obs_steps, 2);
    let both = [seen(1, &inputs), seen(2, &inputs)];
    let stack = |parts: [Array; 2]| Value::from(Array::stack(&parts).unwrap());
    let mut all = vec![("state".to_owned(), stack([0, 1].map(|t: usize| Array::f32(&[15], &both[t].state))))];
    for (i, camera) in inputs.cameras.iter().enumerate() {
        all.push((camera.name.clone(), stack([0, 1].map(|t: usize| Array::image(&both[t].images[i])))));
    }
    assert_eq!(Request::read(&message(all.clone()), &inputs).unwrap().history, both);
    all.retain(|(name, _)| name != "wrist");
    all.push(("wrist".to_owned(), Array::image(&both[0].images[0]).into()));
    refused(&message(all), &["2 steps in all arrays", "one in `wrist`"]);
}

#[test]
fn numbers_of_every_kind_are_states_and_channels_may_come_first() {
    let inputs = inputs();
    let ones = |dtype, one: &[u8]| Array::new(dtype, vec![15], one.repeat(15)).unwrap();
    for array in [
        ones(Dtype::F8, &1.0_f64.to_le_bytes()),
        ones(Dtype::F2, &[0, 0x3c]),
        ones(Dtype::I8, &1_i64.to_le_bytes()),
        ones(Dtype::I4, &1_i32.to_le_bytes()),
        ones(Dtype::U1, &[1]),
    ] {
        let read = Request::read(&with("state", array), &inputs).unwrap();
        assert_eq!(read.history[0].state, vec![1.0; 15]);
    }
    let list: Value = vec![1.0; 15].into_iter().collect();
    assert_eq!(Request::read(&with("state", list), &inputs).unwrap().history[0].state, vec![1.0; 15]);

    let image = &seen(0, &inputs).images[0];
    let (h, w) = (image.height, image.width);
    let planes: Vec<u8> = (0..3).flat_map(|c| image.data.iter().skip(c).step_by(3).copied()).collect();
    let first = Array::new(Dtype::U1, vec![3, h, w], planes).unwrap();
    assert_eq!(Request::read(&with("wrist", first), &inputs).unwrap().history[0].images[0], *image);
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let inputs = inputs();
    let n = inputs.cameras[0].height;
    refused(
        &Value::map([]),
        &["`observation/state` (15 numbers)", "observation/images/table", "an empty map"],
    );
    refused(
        &message(without(0, &inputs, "observation/images/table")),
        &["`observation/images/table` is missing", "found `observation/images/wrist`, `observation/state`"],
    );
    refused(&Value::Nil, &["request: expected a map", "nil"]);
    refused(&with("state", Array::f32(&[14], &[0.0; 14])), &["`state`", "[15] or [2, 15]", "[14] of <f4"]);
    refused(&with("state", Array::f32(&[3, 15], &[0.0; 45])), &["[3, 15]"]);
    refused(&with("state", "here"), &["`state`", "text"]);
    let mut nan = [0.0; 15];
    nan[4] = f32::NAN;
    refused(
        &with("state", Array::f32(&[15], &nan)),
        &["`state`: expected finite numbers, found NaN at entry 4"],
    );
    let large = Array::new(Dtype::F8, vec![15], 1e300_f64.to_le_bytes().repeat(15)).unwrap();
    refused(&with("state", large), &["finite numbers, found inf"]);
    let floats = Array::f32(&[n, n, 3], &[0.5]);
    refused(&with("wrist", floats), &["`wrist`", "uint8 from 0 to 255", "multiplied by 255"]);
    let small = Array::new(Dtype::U1, vec![n, n - 1, 3], vec![0; n * (n - 1) * 3]).unwrap();
    refused(&with("wrist", small), &["`wrist`", &format!("[{n}, {n}, 3]"), &format!("[{n}, {}, 3]", n - 1)]);
    for (key, value) in [("seed", Value::Int(-1)), ("seed", Value::Float(1.0)), ("reset", Value::Int(1))] {
        let mut all = entries(&seen(0, &inputs), &inputs);
        all.push((key.to_owned(), value));
        refused(&message(all), &[&format!("`{key}`")]);
    }
    for bytes in [vec![], vec![0; 55], vec![0xff; 56]] {
        let mut all = entries(&seen(0, &inputs), &inputs);
        all.push(("random_stream".to_owned(), Value::Bytes(bytes)));
        refused(&message(all), &["`random_stream`"]);
    }
}
