//! Optimisers against torch, and their state.

use crate::support::{Golden, assert_close, compute, elsewhere, filled, input, loss, rng, wide};
use e2h_nn::{
    Adam, AdamConfig, Ema, EmaConfig, Linear, LrSchedule, Mode, Params, Weights, backward, learning_rate,
};

fn near(config: &AdamConfig, name: &str) {
    // p of the reference is the bias of a layer whose input is zero: its output is p.
    let (params, net) =
        Params::build_on(&compute(), Mode::Train, &mut rng(0), |b| Linear::new(1, 3, b)).unwrap();
    let mut w = params.export().unwrap();
    w.get_mut("weight").unwrap().data.fill(0.0);
    w.get_mut("bias").unwrap().data.copy_from_slice(&[1.0, -2.0, 3.0]);
    params.import(&w).unwrap();
    let zero = input(0, &[1, 1], 0.0, 0.0);
    let mut adam = Adam::new(config, &params).unwrap();
    let mut trace = Vec::new();
    for k in 0..10 {
        let p = net.forward(&zero).unwrap();
        let fourth = p.sqr().unwrap().sqr().unwrap();
        let l = (fourth + (p * f64::from(k + 1)).unwrap().sin().unwrap()).unwrap().sum_all().unwrap();
        adam.step(&params, &backward(&l, &params).unwrap(), config.lr).unwrap();
        trace.extend(wide(&params.export().unwrap()["bias"].data));
    }
    assert_close(name, &trace, &Golden::open("optim").get(name).1, 1e-6);
}

#[test]
fn adam_as_in_torch() {
    as_in_torch();
    elsewhere(as_in_torch);
}

fn as_in_torch() {
    let plain =
        AdamConfig { lr: 2e-2, beta1: 0.9, weight_decay: 0.0, clip_norm: None, ..AdamConfig::default() };
    near(&plain, "adam");
    near(&AdamConfig { weight_decay: 1e-2, ..plain }, "adam_wd");
    near(&AdamConfig { weight_decay: 1e-2, decoupled: true, ..plain }, "adamw");
    near(&AdamConfig { clip_norm: Some(1.0), ..plain }, "adam_clip");
}

#[test]
fn ema_decay_as_in_diffusers() {
    let got: Vec<f64> = (0..60).map(|k| EmaConfig::default().decay(k * 100)).collect();
    assert_close("decay", &got, &Golden::open("optim").get("ema_decay").1, 1e-6);
}

#[test]
fn schedules() {
    let constant = LrSchedule::Constant { lr: 1.0, warmup: 4 };
    let rates: Vec<f32> = [0, 1, 4, 100].iter().map(|s| learning_rate(&constant, *s)).collect();
    assert_eq!(rates, [0.0, 0.25, 1.0, 1.0]);
    let cosine = LrSchedule::Cosine { lr: 2.0, warmup: 10, steps: 110 };
    let rates: Vec<f32> = [5, 10, 60, 110, 500].iter().map(|s| learning_rate(&cosine, *s)).collect();
    assert_close("cosine", &wide(&rates), &[1.0, 2.0, 1.0, 0.0, 0.0], 1e-6);
}

fn some_steps(params: &Params, net: &Linear, adam: &mut Adam, ema: &mut Ema, steps: std::ops::Range<u64>) {
    for k in steps {
        let l = loss(&net.forward(&input(k, &[3, 4], 1.0, 0.0)).unwrap());
        adam.step(params, &backward(&l, params).unwrap(), 1e-2).unwrap();
        ema.update(params).unwrap();
    }
}

/// Stopping, saving and going on gives the same bytes as not stopping.
#[test]
fn state_resumes() {
    resumes();
    elsewhere(resumes);
}

fn resumes() {
    let build = || {
        let (params, net) = filled(Mode::Train, |b| Linear::new(4, 5, b));
        let adam = Adam::new(&AdamConfig::default(), &params).unwrap();
        let ema = Ema::new(&EmaConfig::default(), &params).unwrap();
        (params, net, adam, ema)
    };
    let (params, net, mut adam, mut ema) = build();
    some_steps(&params, &net, &mut adam, &mut ema, 0..6);
    let (p2, n2, mut a2, mut e2) = build();
    some_steps(&p2, &n2, &mut a2, &mut e2, 0..3);
    let saved = (p2.export().unwrap(), a2.state().unwrap(), e2.state().unwrap());
    let (p3, n3, mut a3, mut e3) = build();
    p3.import(&saved.0).unwrap();
    a3.load_state(&saved.1).unwrap();
    e3.load_state(&saved.2).unwrap();
    some_steps(&p3, &n3, &mut a3, &mut e3, 3..6);
    assert_eq!(params.export().unwrap(), p3.export().unwrap());
    assert_eq!(adam.state().unwrap(), a3.state().unwrap());
    assert_eq!(ema.weights().unwrap(), e3.weights().unwrap());
    assert_eq!((a3.steps(), e3.updates()), (6, 6));
    assert!(a3.load_state(&Weights::new()).is_err() && e3.load_state(&saved.1).is_err());
}

#[test]
fn ema_starts_at_the_weights_and_follows() {
    ema_follows();
    elsewhere(ema_follows);
}

fn ema_follows() {
    let (params, _) = filled(Mode::Train, |b| Linear::new(1, 1, b));
    let mut ema = Ema::new(&EmaConfig::default(), &params).unwrap();
    let mut want = 0.0;
    for k in 0..5u8 {
        let mut w = params.export().unwrap();
        w.get_mut("weight").unwrap().data[0] = f32::from(k) + 1.0;
        params.import(&w).unwrap();
        ema.update(&params).unwrap();
        let decay = EmaConfig::default().decay(k.into());
        want = decay * want + (1.0 - decay) * (f64::from(k) + 1.0);
    }
    assert!((f64::from(ema.weights().unwrap()["weight"].data[0]) - want).abs() < 1e-6);
}

#[test]
fn a_gradient_that_is_not_finite_changes_nothing() {
    not_finite();
    elsewhere(not_finite);
}

fn not_finite() {
    let (params, net) = filled(Mode::Train, |b| Linear::new(4, 5, b));
    let before = params.export().unwrap();
    let mut adam = Adam::new(&AdamConfig::default(), &params).unwrap();
    let l = (loss(&net.forward(&input(0, &[3, 4], 1.0, 0.0)).unwrap()) * f64::NAN).unwrap();
    assert!(adam.step(&params, &backward(&l, &params).unwrap(), 1e-2).unwrap().is_nan());
    assert_eq!((params.export().unwrap(), adam.steps()), (before, 0));
    let config = AdamConfig { beta1: 1.0, ..AdamConfig::default() };
    assert!(Adam::new(&config, &params).is_err());
}
