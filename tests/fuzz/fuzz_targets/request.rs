//! Messages of a client: msgpack with arrays, and the observations in them.

#![no_main]

use e2h_core::Image;
use e2h_fuzz::{begin, judge, run};
use e2h_serve::wire::{Array, Dtype, Value};
use e2h_serve::{Camera, Inputs, Request};
use libfuzzer_sys::fuzz_target;
use std::path::Path;

fn inputs(which: u8) -> Inputs {
    let camera = |name: &str| Camera { name: name.to_owned(), height: 4, width: 5 };
    Inputs {
        state: 3,
        environment: usize::from(which >> 2 & 1) * 2,
        cameras: ["wrist", "table"].iter().take(usize::from(which >> 3 & 3)).map(|c| camera(c)).collect(),
        n_obs_steps: usize::from(which & 3) + 1,
        n_action_steps: 8,
        action: 2,
        ..Inputs::default()
    }
}

fn seeds() -> Vec<Vec<u8>> {
    let image = Array::image(&Image { height: 4, width: 5, data: (0..60).collect() });
    let state = |dtype: Dtype| {
        let bytes = vec![0; 3 * dtype.size()];
        Value::from(Array::new(dtype, vec![3], bytes).expect("an array"))
    };
    let two = |a: &Array| Value::from(Array::stack(&[a.clone(), a.clone()]).expect("alike"));
    let mut seeds = vec![];
    for dtype in Dtype::ALL {
        let message = Value::map([
            ("observation/state", state(dtype)),
            ("observation/environment_state", Array::f32(&[2], &[1.0, 2.0]).into()),
            ("observation/image", image.clone().into()),
            ("observation.images.table", image.clone().into()),
            ("prompt", "pick".into()),
            ("seed", Value::from(u64::MAX)),
        ]);
        seeds.push([&[20], &message.encode()[..]].concat());
    }
    let history = Value::map([
        ("state", two(&Array::f32(&[3], &[0.5; 3]))),
        ("wrist", two(&image)),
        ("table", two(&image)),
        ("reset", Value::Bool(true)),
        ("random_stream", Value::Bytes(vec![0; 56])),
        ("more", [Value::Nil, Value::Float(0.5), Value::Int(-7)].into_iter().collect()),
    ]);
    seeds.push([&[17], &history.encode()[..]].concat());
    let scalar = b"\x81\xa4seed\x83\xc4\x0d__npgeneric__\xc3\xc4\x04data\x07\xc4\x05dtype\xa3<i8";
    seeds.push([&[0], &scalar[..]].concat());
    seeds
}

fuzz_target!(init: begin(seeds), |input: &[u8]| {
    let Some((which, bytes)) = input.split_first() else { return };
    run(|| {
        // There is no file that a message could name.
        let Some(value) = judge(Path::new(""), Value::decode(bytes)) else { return };
        let again = value.encode();
        assert_eq!(Value::decode(&again).expect("what was written").encode(), again);
        let inputs = inputs(*which);
        let Some(request) = judge(Path::new(""), Request::read(&value, &inputs)) else { return };
        assert_eq!(request.history.len(), inputs.n_obs_steps);
        for seen in request.history {
            assert!(seen.state.len() == 3 && seen.state.iter().all(|v| v.is_finite()));
            assert_eq!((seen.environment.len(), seen.images.len()), (inputs.environment, inputs.cameras.len()));
            assert!(seen.images.iter().all(|i| (i.height, i.width, i.data.len()) == (4, 5, 60)));
        }
    });
});
