//! The filter picture of one recording: sampled images, speed over time, and what became of each frame.

use crate::Plan;
use crate::config::Config;
use crate::page::escape;
use e2h_core::Episode;
use e2h_data::lerobot::Table;
use e2h_refine::{Fate, Refined};

const WIDTH: f64 = 960.0;
const LEFT: f64 = 60.0;
const PLOT: f64 = WIDTH - LEFT - 110.0;
const HEIGHT: f64 = 150.0;
/// Of the plot of the advantage.
const LOWER: f64 = 80.0;
const IMAGES: usize = 8;

fn colour(fate: Option<Fate>) -> &'static str {
    match fate {
        Some(Fate::Kept) => "#9fd8b0",
        Some(Fate::Static) => "#c3c9d0",
        Some(Fate::Resampled) => "#a9cbf3",
        Some(Fate::LowAdvantage) => "#f6c98b",
        Some(Fate::TooShort) => "#efe3a8",
        Some(Fate::AfterGoal) => "#d3bfe8",
        _ => "#f0b3b3",
    }
}

/// Frames from left to right in the order of the reversed path.
pub(crate) fn svg(plan: &Plan, recording: &Table, camera: Option<&str>, config: &Config, fps: f64) -> String {
    let rows = plan.reversed.len();
    let x = |t: f64| LEFT + PLOT * t / rows.max(1) as f64;
    let (images, top) = images(&plan.reversed, recording, camera);
    let speeds = speeds(&plan.reversed, fps);
    let limits = [(config.kinematic.static_speed, "static"), (config.kinematic.slow_speed, "slow")];
    let highest = speeds.iter().copied().chain(limits.iter().map(|l| l.0)).fold(1e-6, f64::max) * 1.05;
    let y = |v: f64| top + HEIGHT * (1.0 - v / highest);

    let mut s = images;
    let fate = |t: usize| plan.refined.as_ref().map(|r| r.fates[t]);
    let mut start = 0;
    for t in 1..=rows {
        if t == rows || fate(t) != fate(start) {
            s += &format!(
                "<rect x=\"{:.1}\" y=\"{top:.1}\" width=\"{:.2}\" height=\"{HEIGHT}\" fill=\"{}\"/>",
                x(start as f64),
                x(t as f64) - x(start as f64),
                colour(fate(start))
            );
            start = t;
        }
    }
    let points: Vec<String> =
        speeds.iter().enumerate().map(|(t, &v)| format!("{:.1},{:.1}", x(t as f64 + 0.5), y(v))).collect();
    s += &format!(
        "<polyline points=\"{}\" fill=\"none\" stroke=\"#1d2733\" stroke-width=\"1.6\"/>",
        points.join(" ")
    );
    for (i, (limit, name)) in limits.iter().enumerate() {
        let (line, label) = (y(*limit), y(*limit) + if i == 0 { 12.0 } else { -4.0 });
        s += &format!(
            "<path d=\"M{LEFT} {line:.1}H{:.1}\" stroke=\"#d64545\" stroke-dasharray=\"5 4\"/>\
             <text x=\"{:.1}\" y=\"{label:.1}\">{name} {limit} m/s</text>",
            LEFT + PLOT,
            LEFT + PLOT + 6.0
        );
    }
    let bottom = top + HEIGHT;
    for i in 0..=4 {
        let t = rows as f64 * f64::from(i) / 4.0;
        s += &format!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{:.1} s</text>",
            x(t),
            bottom + 16.0,
            t / fps
        );
    }
    s += &format!(
        "<text x=\"4\" y=\"{:.1}\">{highest:.2} m/s</text><text x=\"4\" y=\"{bottom:.1}\">0</text>",
        top + 10.0
    );
    let lower = plan.refined.as_ref().and_then(|r| advantage(r, &x, bottom + 24.0));
    let bottom = bottom + lower.as_ref().map_or(0.0, |_| LOWER + 30.0);
    s += &lower.unwrap_or_default();
    let all =
        [Fate::Kept, Fate::Static, Fate::Resampled, Fate::LowAdvantage, Fate::TooShort, Fate::AfterGoal];
    let counts: Vec<String> = all
        .into_iter()
        .enumerate()
        .map(|(i, f)| (i, f, plan.refined.as_ref().map_or(0, |r| r.report.count(f))))
        // The critic's fates where it has spoken.
        .filter(|&(i, _, n)| i < 3 || n > 0)
        .map(|(_, f, n)| format!("{n} {}", f.name()))
        .collect();
    let what = match &plan.refined {
        Some(_) => format!("{rows} frames: {}", counts.join(", ")),
        None => format!("{rows} frames, {}", plan.account.verdict),
    };
    s += &format!(
        "<text x=\"{LEFT}\" y=\"{:.1}\" font-weight=\"600\">Episode {}, reversed. {}</text>",
        bottom + 38.0,
        plan.episode,
        escape(&what)
    );
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {:.0}\" font-family=\"system-ui,sans-serif\" \
         font-size=\"12\">{s}</svg>",
        bottom + 48.0
    )
}

/// The smoothed advantage below the speed, with the threshold of the filter; none without a critic.
fn advantage(refined: &Refined, x: &impl Fn(f64) -> f64, top: f64) -> Option<String> {
    let (values, threshold) = (refined.advantage.as_ref()?, f64::from(refined.threshold?));
    let points: Vec<(usize, f64)> =
        values.iter().enumerate().filter(|(_, v)| v.is_finite()).map(|(t, &v)| (t, f64::from(v))).collect();
    let (low, high) = points
        .iter()
        .fold((threshold - 1e-6, threshold + 1e-6), |(low, high), &(_, v)| (low.min(v), high.max(v)));
    let y = |v: f64| top + LOWER * (high - v) / (high - low);
    let mut s = String::new();
    // A line for each stretch that the critic has seen.
    for run in points.chunk_by(|a, b| a.0 + 1 == b.0) {
        let line: Vec<String> =
            run.iter().map(|&(t, v)| format!("{:.1},{:.1}", x(t as f64 + 0.5), y(v))).collect();
        s += &format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"#8a4bb8\" stroke-width=\"1.6\"/>",
            line.join(" ")
        );
    }
    let line = y(threshold);
    s += &format!(
        "<path d=\"M{LEFT} {line:.1}H{:.1}\" stroke=\"#d64545\" stroke-dasharray=\"5 4\"/>\
         <text x=\"{:.1}\" y=\"{:.1}\">threshold</text><text x=\"4\" y=\"{:.1}\">advantage</text>",
        LEFT + PLOT,
        LEFT + PLOT + 6.0,
        line + 4.0,
        top + 10.0
    );
    Some(s)
}

/// Speed of the step ahead, m/s; the last row has that of the step before.
fn speeds(episode: &Episode, fps: f64) -> Vec<f64> {
    let step = |t: usize| (episode.eef(t).position - episode.eef(t - 1).position).norm() * fps;
    let mut speeds: Vec<f64> = (1..episode.len()).map(step).collect();
    speeds.extend(speeds.last().copied().or((!episode.is_empty()).then_some(0.0)));
    speeds
}

/// Some images in a row, and where the plot below them begins.
fn images(episode: &Episode, recording: &Table, camera: Option<&str>) -> (String, f64) {
    let Some(files) = camera.and_then(|c| recording.png(c).ok()) else { return (String::new(), 10.0) };
    let (slot, mut height, mut s) = (PLOT / IMAGES as f64, 0.0, String::new());
    for i in 0..IMAGES.min(episode.len()) {
        let t = i * (episode.len() - 1) / (IMAGES.min(episode.len()) - 1).max(1);
        let Some(file) = files.get(episode.source[t] as usize) else { continue };
        // Width and height of a PNG file stand at fixed places.
        let side =
            |at: usize| file.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(1, u32::from_be_bytes);
        let tall = (slot - 6.0) * f64::from(side(20)) / f64::from(side(16)).max(1.0);
        s += &format!(
            "<image x=\"{:.1}\" y=\"4\" width=\"{:.1}\" height=\"{tall:.1}\" href=\"data:image/png;base64,{}\"/>",
            LEFT + slot * i as f64,
            slot - 6.0,
            base64(file)
        );
        height = f64::max(height, tall);
    }
    (s, height + 12.0)
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let word = (0..3).fold(0_usize, |w, i| w << 8 | group.get(i).map_or(0, |&b| usize::from(b)));
        for i in 0..4 {
            let digit = DIGITS[word >> (18 - 6 * i) & 63];
            text.push(if i <= group.len() { char::from(digit) } else { '=' });
        }
    }
    text
}
