//! Cameras.
#![allow(clippy::unwrap_used, reason = "tests")]

use e2h_core::{Direction, Image, stream};
use e2h_env::{Env, EnvConfig, Error, Style, TaskOptions, task};

fn env(image_size: usize) -> Env {
    let config = EnvConfig { image_size, ..EnvConfig::default() };
    Env::new(task("nut_assembly", &TaskOptions::default()).unwrap(), &config).unwrap()
}

/// Images along the first steps of a demonstration.
fn watch(env: &mut Env, steps: usize) -> Vec<Image> {
    let mut rng = stream(5, "images", 0, 0);
    env.reset(Direction::Easy, &mut rng).unwrap();
    let task = env.task().clone();
    let mut expert = task.expert(Direction::Easy, task.demonstrator(), &mut rng);
    let mut images = vec![];
    for _ in 0..steps {
        images.extend(env.observe().unwrap().frames);
        let action = expert.act(env.sim());
        env.step(&action).unwrap();
    }
    images
}

#[test]
fn images_do_not_depend_on_threads() {
    let mut first = env(48);
    let expected = watch(&mut first, 30);
    let others: Vec<_> = (0..3).map(|_| first.clone_shared().unwrap()).collect();
    let all: Vec<_> = std::thread::scope(|scope| {
        let spawned: Vec<_> =
            others.into_iter().map(|mut e| scope.spawn(move || watch(&mut e, 30))).collect();
        spawned.into_iter().map(|s| s.join().unwrap()).collect()
    });
    for images in all {
        assert!(images == expected);
    }
}

#[test]
fn both_cameras_see_the_nut_and_the_peg() {
    let mut env = env(72);
    env.reset(Direction::Easy, &mut stream(5, "see", 0, 0)).unwrap();
    assert_eq!(env.cameras(), ["table", "wrist"]);
    let observation = env.observe().unwrap();
    for image in &observation.frames {
        assert_eq!((image.height, image.width, image.data.len()), (72, 72, 72 * 72 * 3));
        let count = |test: fn(i32, i32, i32) -> bool| {
            image.data.chunks_exact(3).filter(|p| test(p[0].into(), p[1].into(), p[2].into())).count()
        };
        let brass = count(|r, g, b| r > 2 * b && g > b + 40);
        let blue = count(|r, _, b| b > 2 * r && b > 40);
        let red = count(|r, g, b| r > 2 * g && r > 2 * b && r > 60);
        assert!(brass > 60 && blue > 10 && red > 5, "brass {brass}, blue {blue}, red {red} pixels");
    }
}

#[test]
fn pictures_come_in_any_size_and_without_cameras_in_observations() {
    let mut env = Env::new(env(8).task().clone(), &EnvConfig::blind()).unwrap();
    env.reset(Direction::Hard, &mut stream(5, "size", 0, 0)).unwrap();
    assert!(env.cameras().is_empty() && env.observe().unwrap().frames.is_empty());
    let plain = env.render("table", 50, 30).unwrap();
    assert_eq!((plain.width, plain.height, plain.data.len()), (50, 30, 4500));
    let pretty = env.render_styled("table", 50, 30, Style { shadows: true }).unwrap();
    assert!(pretty != plain);
    assert!(matches!(env.render("front", 8, 8), Err(Error::Camera { .. })));
}
