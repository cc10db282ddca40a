use crate::{assert_success, example, text};
use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};

const CHECKPOINT: &str = "checkpoints/nut_assembly";

/// A program that serves, and its address. Killed with the test.
struct Served(Child, String);

impl Served {
    fn start(arguments: &[&str]) -> Self {
        let mut command = example("serve");
        command.args(["--checkpoint", CHECKPOINT, "--listen", "127.0.0.1:0"]).args(arguments);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.split(": ").next().unwrap().to_owned();
        assert!(url.starts_with("ws://127.0.0.1:") && line.contains("15 numbers of state"), "{line}");
        Self(child, url)
    }

    /// The status that a signal ends it with.
    fn stop(&mut self, signal: &str) -> Option<i32> {
        assert!(Command::new("kill").args([signal, &self.0.id().to_string()]).status().unwrap().success());
        self.0.wait().unwrap().code()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
    }
}

fn evaluate(arguments: &[&str]) -> serde_json::Value {
    let output = {
        let given = |name: &str| arguments.contains(&name);
        let mut command = example("evaluate");
        command.arg("--json").args(arguments);
        command.args(["--trials", "5"].iter().filter(|_| !given("--trials")));
        command.args(["--seed", "7"].iter().filter(|_| !given("--seed")));
        command.output().unwrap()
    };
    assert_success(&output);
    let mut value: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    value.as_object_mut().unwrap().remove("seconds");
    value
}

fn fails(arguments: &[&str], words: &[&str]) {
    let output = example("evaluate").args(["--trials", "1"]).args(arguments).output().unwrap();
    let message = text(&output.stderr);
    assert!(!output.status.success(), "{message}");
    for word in words {
        assert!(message.contains(word), "expected `{word}` in: {message}");
    }
}

#[test]
fn a_served_policy_has_the_result_of_its_checkpoint() {
    let mut served = Served::start(&[]);
    let url = served.1.clone();
    let local = evaluate(&["--checkpoint", CHECKPOINT]);
    let outcomes = local["outcomes"].as_array().unwrap();
    assert!(outcomes.iter().any(|o| o != &outcomes[0]), "trials that differ: {local}");
    assert_eq!(evaluate(&["--policy", &url]), local);
    // The same, said by hand, and with fewer connections than simulations.
    let by_hand = ["--policy", &url, "--task", "nut_assembly", "--direction", "hard", "--connections", "2"];
    assert_eq!(evaluate(&by_hand), local);
    // Another seed has other trials, another task another scene.
    assert_ne!(evaluate(&["--policy", &url, "--seed", "8"]), local);
    let square = ["--policy", &url, "--task", "nut_assembly", "--set", "task.variant=square"];
    assert_ne!(evaluate(&square), local);

    fails(&["--policy", &url, "--task", "nut"], &["unknown task `nut`", "nut_assembly"]);
    fails(&["--policy", &url, "--checkpoint", CHECKPOINT], &["cannot be used with"]);
    assert_eq!(served.stop("-INT"), Some(130));
    fails(&["--policy", &url], &[&url, "connecting"]);
}

#[test]
fn a_server_wants_its_token_and_no_strangers() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("token");
    std::fs::write(&file, "sesame\n").unwrap();
    let mut served = Served::start(&["--token-file", file.to_str().unwrap()]);
    fails(&["--policy", &served.1.clone()], &["401"]);
    assert_eq!(evaluate(&["--policy", &served.1, "--token", "sesame", "--trials", "1"])["trials"], 1);
    assert_eq!(served.stop("-TERM"), Some(143));

    let refuse = |arguments: &[&str], words: &[&str]| {
        let output = example("serve").args(arguments).output().unwrap();
        let message = text(&output.stderr);
        assert!(!output.status.success() && message.lines().count() == 1, "{message}");
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    };
    refuse(&["--checkpoint", CHECKPOINT, "--listen", "0.0.0.0:0"], &["0.0.0.0:0", "loopback", "token"]);
    refuse(&["--checkpoint", CHECKPOINT, "--token-file", "no/such"], &["no/such"]);
    refuse(&["--checkpoint", CHECKPOINT, "--device", "gpu"], &["`gpu`", "cpu, cuda or cuda:N"]);
    refuse(&["--checkpoint", "no/such"], &["no/such", "policy.json"]);
}
