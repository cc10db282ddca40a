//! What no sensible setting exceeds, so that sums of settings and indices stay numbers.

/// Most frames that a setting counts: fourteen hours at 20 Hz.
const MOST_FRAMES: usize = 1_000_000;
/// Largest length, angle or speed, m, rad and m/s.
const LARGEST: f64 = 100.0;

/// A problem when `value` is not a number of frames from `least` on.
pub(crate) fn frames(name: &str, value: usize, least: usize) -> Option<String> {
    let bad = !(least..=MOST_FRAMES).contains(&value);
    bad.then(|| format!("{name}: expected {least} to {MOST_FRAMES} frames, got {value}"))
}

/// A problem when `value` is no sensible length, angle or speed; 0 is one where `zero` says so.
pub(crate) fn amount(name: &str, value: f64, zero: bool) -> Option<String> {
    let good = value <= LARGEST && (value > 0.0 || (zero && value == 0.0));
    let least = if zero { "at least 0" } else { "more than 0" };
    (!good).then(|| format!("{name}: expected {least} and at most {LARGEST}, got {value}"))
}
