use crate::{SMALL, assert_same_results, assert_success, example, nut_assembly, text};
use std::path::Path;
use std::process::Command;

fn fails(command: &mut Command, words: &[&str]) {
    let output = command.output().unwrap();
    let message = text(&output.stderr);
    assert!(!output.status.success(), "{message}");
    for word in words {
        assert!(message.contains(word), "expected `{word}` in: {message}");
    }
}

#[test]
fn wrong_configuration_is_refused_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    fails(&mut nut_assembly(&out, &["--set", "loop.cycle=3"]), &["loop.cycle", "did you mean `loop.cycles`"]);
    fails(&mut nut_assembly(&out, &["--set", "loop.cycles=few"]), &["loop.cycles", "integer", "few"]);
    fails(&mut nut_assembly(&out, &["--set", "policy.horizon=15"]), &["horizon", "multiple of 2", "15"]);
    fails(&mut nut_assembly(&out, &["--set", "task.variant=rund"]), &["rund", "round"]);
    #[cfg(not(feature = "cuda"))]
    fails(&mut nut_assembly(&out, &["--device", "cuda"]), &["`cuda`", "without CUDA", "--features cuda"]);
    fails(&mut nut_assembly(&out, &["--device", "cuda:x"]), &["`cuda:x`", "expected cpu, cuda or cuda:N"]);
    fails(&mut nut_assembly(&out, &["--set", "device.fp16=true"]), &["device.fp16", "device.bf16"]);
    let sharpness = &["--set", "train.step.keypoint_sharpness=0", "--set", "refine.goal.least=nan"];
    fails(&mut nut_assembly(&out, sharpness), &["train.step.keypoint_sharpness", "refine.goal.least", "NaN"]);
    fails(&mut nut_assembly(&out, &["--threads", "0"]), &["threads", "at least 1"]);
    fails(&mut nut_assembly(&out, &["--iterations", "4000000000"]), &["loop.iterations", "0 to 1000"]);
    fails(&mut nut_assembly(&out, &["--set", "task.name=disk"]), &["task.name", "nut_assembly", "disk"]);
    fails(
        &mut nut_assembly(&out, &["--set", "policy.cameras=[\"foo\"]"]),
        &["policy.cameras", "wrist", "foo"],
    );
    assert!(!out.exists(), "a refused run left a folder");
}

#[test]
fn a_run_directory_is_never_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    assert_success(&nut_assembly(&out, &["--set=loop.iterations=0"]).output().unwrap());
    fails(&mut nut_assembly(&out, &["--set=loop.iterations=0"]), &["exists", "--resume"]);
    fails(
        &mut nut_assembly(&out, &["--resume", "--set=loop.iterations=0", "--set=loop.cycles=1"]),
        &["config.toml", "expected", "found"],
    );
    fails(
        &mut nut_assembly(&out, &["--resume", "--set=loop.iterations=0", "--seed", "9"]),
        &["run", "seed 9", "seed 0"],
    );

    let other = dir.path().join("holiday");
    std::fs::create_dir(&other).unwrap();
    std::fs::write(other.join("photo.jpg"), "mine").unwrap();
    fails(&mut nut_assembly(&other, &["--resume"]), &["exists"]);
    let nowhere = dir.path().join("nowhere");
    fails(&mut nut_assembly(&nowhere, &["--resume"]), &["nowhere", "leave --resume out"]);
    assert!(!nowhere.exists(), "a refused run left a folder");

    // Foreign and damaged checkpoints.
    let evaluate = |checkpoint: &std::path::Path| {
        let mut command = example("evaluate");
        command.args(["--trials", "1", "--checkpoint"]).arg(checkpoint);
        command
    };
    fails(&mut evaluate(&other), &["policy.json"]);
    let told = text(&evaluate(&other).output().unwrap().stderr);
    assert_eq!(told.matches("No such file").count(), 1, "{told}");
    assert_eq!(told.lines().count(), 1, "{told}");
    for (video, words) in [("x.mp4", ".png or .apng"), ("no/such/x.png", "No such file")] {
        let mut command = evaluate(Path::new("checkpoints/nut_assembly"));
        fails(command.arg("--video").arg(dir.path().join(video)), &["--video", words]);
        assert!(!dir.path().join(video).exists());
    }
    let policy = out.join("iteration_00/policy");
    let json = std::fs::read_to_string(policy.join("policy.json")).unwrap();
    std::fs::write(policy.join("policy.json"), json.replace("\"format\": 1", "\"format\": 99")).unwrap();
    fails(&mut evaluate(&policy), &["expected format 1", "found 99"]);
    std::fs::write(policy.join("policy.json"), &json).unwrap();
    // A digit of the normaliser, in a file that is otherwise whole.
    let at =
        json.find("state_min").unwrap() + json[json.find("state_min").unwrap()..].find("0.").unwrap() + 2;
    let digit = if json.as_bytes()[at] == b'3' { "4" } else { "3" };
    std::fs::write(policy.join("policy.json"), format!("{}{digit}{}", &json[..at], &json[at + 1..])).unwrap();
    fails(&mut nut_assembly(&out, &["--resume", "--set=loop.iterations=0"]), &["policy.json", "SHA-256"]);
    std::fs::write(policy.join("policy.json"), &json).unwrap();
    let weights = policy.join("model.safetensors");
    let mut bytes = std::fs::read(&weights).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&weights, bytes).unwrap();
    fails(&mut evaluate(&policy), &["SHA-256"]);
}

/// A checkpoint states the configuration of its run: what the environment of an evaluation is built from.
#[test]
fn a_published_checkpoint_with_a_damaged_run_section_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let published = Path::new("checkpoints/nut_assembly");
    let whole = std::fs::read_to_string(published.join("policy.json")).unwrap();
    std::fs::copy(published.join("model.safetensors"), dir.path().join("model.safetensors")).unwrap();
    let evaluate = |damage: &dyn Fn(&mut serde_json::Value)| {
        let mut policy: serde_json::Value = serde_json::from_str(&whole).unwrap();
        damage(&mut policy["provenance"]["run"]);
        std::fs::write(dir.path().join("policy.json"), policy.to_string()).unwrap();
        let mut command = example("evaluate");
        command.args(["--trials", "1", "--checkpoint"]).arg(dir.path());
        command
    };
    let place = dir.path().join("policy.json");
    let place = place.to_str().unwrap();
    assert_success(&evaluate(&|_| ()).output().unwrap());
    let gone = |run: &mut serde_json::Value| drop(run["loop"].as_object_mut().unwrap().remove("cycles"));
    fails(&mut evaluate(&gone), &[place, "run configuration", "missing field `cycles`"]);
    let renamed = |run: &mut serde_json::Value| run["env"]["holdsteps"] = 10.into();
    fails(&mut evaluate(&renamed), &[place, "run configuration", "holdsteps"]);
    let text = |run: &mut serde_json::Value| run["loop"]["cycles"] = "4O".into();
    fails(&mut evaluate(&text), &[place, "run configuration", "4O"]);
    let impossible = |run: &mut serde_json::Value| run["env"]["home_noise_rad"] = (-1).into();
    fails(&mut evaluate(&impossible), &[place, "run configuration", "env.home_noise_rad", "-1"]);
    fails(&mut evaluate(&|run| *run = serde_json::Value::Null), &[place, "run configuration"]);
}

#[test]
fn pictures_of_no_pixels_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    for size in ["0", "100000"] {
        let mut gallery = example("gallery");
        fails(gallery.args(["--size", size, "--out"]).arg(dir.path()), &["--size", size, "expected 1 to"]);
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn every_program_has_a_version() {
    for name in ["nut_assembly", "evaluate", "experts", "view", "export", "publish", "env_step", "peer"] {
        let output = example(name).arg("--version").output().unwrap();
        assert_success(&output);
        assert!(text(&output.stdout).contains(env!("CARGO_PKG_VERSION")), "{name}");
    }
}

#[test]
fn two_processes_do_not_work_on_one_run() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let mut first = nut_assembly(&out, &[]).stdout(std::process::Stdio::null()).spawn().unwrap();
    while !out.join("run.json").exists() {
        assert!(first.try_wait().unwrap().is_none(), "the first run ended early");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    let named = format!("process {}", first.id());
    fails(&mut nut_assembly(&out, &["--resume"]), &["in use", &named]);
    first.kill().unwrap();
    first.wait().unwrap();
    // What the kill left is removed; the lock ended with its process.
    std::fs::write(out.join(".tmpleft"), "x").unwrap();
    std::fs::create_dir_all(out.join("iteration_01/segments.unfinished")).unwrap();
    assert_success(&nut_assembly(&out, &["--resume"]).output().unwrap());
    assert!(!out.join(".tmpleft").exists() && !out.join("iteration_01/segments.unfinished").exists());
}

#[test]
fn videos_without_a_decoder_are_refused_by_name_and_the_rest_is_shown() {
    let dir = tempfile::tempdir().unwrap();
    let page = dir.path().join("page.html");
    let output = example("view")
        .arg("tests/golden/lerobot/video")
        .arg("--out")
        .arg(&page)
        .env("E2H_FFMPEG", "/no/such/ffmpeg")
        .output()
        .unwrap();
    assert_success(&output);
    let said = text(&output.stdout) + &text(&output.stderr);
    for word in ["observation.images.front", "file-000.mp4", "E2H_FFMPEG", "/no/such/ffmpeg"] {
        assert!(said.contains(word), "expected `{word}` in: {said}");
    }
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("episode 1") && html.contains("plug it in"));
}

#[test]
fn a_loss_that_is_no_number_stops_the_run_with_step_and_seed() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let arguments = [
        "--set=train.step.schedule.lr=1e30",
        "--set=train.step.schedule.warmup=0",
        "--set=train.step.adam.clip_norm=0.0",
    ];
    fails(&mut nut_assembly(&out, &arguments), &["step", "seed 0", "loss"]);
    assert!(out.join("demonstrations").exists(), "what was made before is lost");
}

/// A limit on the size of a file, with its signal ignored, makes writes fail as a full disk does.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_nothing_half_written() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, full) = (dir.path().join("whole"), dir.path().join("full"));
    assert_success(&nut_assembly(&whole, &[]).output().unwrap());
    let program = example("nut_assembly").get_program().to_owned();
    for kilobytes in [16, 200, 400] {
        let resume = full.exists();
        let mut command = Command::new("bash");
        command
            .arg("-c")
            .arg(format!("trap '' XFSZ; ulimit -f {kilobytes}; exec \"$@\""))
            .arg("bash")
            .arg(&program)
            .args(["--preset", "smoke", "--quiet", "--out"])
            .arg(&full)
            .args(SMALL)
            .args(resume.then_some("--resume"));
        fails(&mut command, &["File too large"]);
    }
    assert_success(&nut_assembly(&full, &["--resume"]).output().unwrap());
    assert_same_results(&whole, &full);
}

/// Pipes wait for ever and devices never end: neither is read, whichever file of a policy or a run it stands for.
#[cfg(unix)]
#[test]
fn pipes_and_devices_in_place_of_files_are_refused() {
    use std::process::Stdio;
    let dir = tempfile::tempdir().unwrap();
    let published = Path::new(env!("CARGO_MANIFEST_DIR")).join("checkpoints/nut_assembly");
    let (policy, run) = (dir.path().join("policy"), dir.path().join("run"));
    std::fs::create_dir(&policy).unwrap();
    for file in ["policy.json", "model.safetensors"] {
        std::fs::copy(published.join(file), policy.join(file)).unwrap();
    }
    std::fs::create_dir_all(&run).unwrap();
    std::fs::write(run.join("run.json"), r#"{"format":2,"task":"nut_assembly","preset":"smoke","seed":0}"#)
        .unwrap();
    std::fs::write(run.join("config.toml"), "").unwrap();
    let evaluate = || {
        let mut command = example("evaluate");
        command.args(["--trials", "1", "--checkpoint"]).arg(&policy);
        command
    };
    let view = || {
        let mut command = example("view");
        command.arg(&run);
        command
    };
    for (folder, file, command) in [
        (&policy, "policy.json", &evaluate as &dyn Fn() -> Command),
        (&policy, "model.safetensors", &evaluate),
        (&run, "run.json", &view),
        (&run, "config.toml", &view),
    ] {
        let (place, kept) = (folder.join(file), dir.path().join("kept"));
        std::fs::rename(&place, &kept).unwrap();
        for pipe in [true, false] {
            if pipe {
                assert!(Command::new("mkfifo").arg(&place).status().unwrap().success());
            } else {
                std::os::unix::fs::symlink("/dev/zero", &place).unwrap();
            }
            let mut child = command().stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
            let begun = std::time::Instant::now();
            while child.try_wait().unwrap().is_none() && begun.elapsed().as_secs() < 30 {
                std::thread::sleep(std::time::Duration::from_millis(10));
            }
            child.kill().unwrap();
            let output = child.wait_with_output().unwrap();
            let words = text(&output.stderr);
            assert_eq!(output.status.code(), Some(1), "{file}, a pipe: {pipe}: {words}");
            assert!(words.contains(file) && words.contains("expected a regular file"), "{words}");
            std::fs::remove_file(&place).unwrap();
        }
        std::fs::rename(&kept, &place).unwrap();
    }
}
