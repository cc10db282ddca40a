//! The crate's programs, built by the same `cargo test`.

use std::process::Command;

#[test]
fn a_mixed_network_learns_and_survives_candles_store() {
    let mut path = std::env::current_exe().unwrap();
    path.pop();
    path.pop();
    let output = Command::new(path.join("examples").join("mixed_network")).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    let error = text.trim().rsplit(' ').next().unwrap().parse::<f32>().unwrap();
    assert!(text.contains("8 parameters") && error < 0.15, "{text}");
}
