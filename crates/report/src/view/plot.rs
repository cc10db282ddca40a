//! Small plots that fit any width: a stretched drawing with its labels beside it in HTML, and the band of fates.

use crate::fate;
use crate::svg::{colour, escape, number};

/// Sides of a drawing, in its own units; whole numbers are fine enough and short.
const WIDTH: f64 = 1000.0;
const HEIGHT: f64 = 200.0;

/// One plot over the rows of an episode.
pub(super) struct Plot<'a> {
    pub(super) title: &'a str,
    /// Name and values of each line.
    pub(super) lines: Vec<(&'a str, Vec<f64>)>,
    /// Values that are drawn as dashed lines, with their names.
    pub(super) limits: Vec<(f64, &'a str)>,
    /// Every so many rows is drawn, and the last.
    pub(super) every: usize,
    /// Seconds that the rows take.
    pub(super) seconds: f64,
    /// Drawn behind the lines.
    pub(super) fates: Option<&'a [String]>,
    /// Frames of this plot that each row of the episode is, when they are not its rows.
    pub(super) map: Option<&'a [usize]>,
}

impl Plot<'_> {
    /// The figure.
    pub(super) fn html(&self) -> String {
        let rows = self.lines.iter().map(|l| l.1.len()).max().unwrap_or(0);
        let all = || {
            let lines = self.lines.iter().flat_map(|l| l.1.iter().copied());
            lines.chain(self.limits.iter().map(|l| l.0)).filter(|v| v.is_finite())
        };
        let (lo, hi) = (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
        let (lo, hi) = if lo > hi { (0.0, 1.0) } else { (lo, hi) };
        let (bottom, top) = if hi > lo { (lo, hi) } else { (lo - 0.5, hi + 0.5) };
        let y = |v: f64| HEIGHT * (0.96 - 0.92 * (v - bottom) / (top - bottom));
        let mut drawing = String::new();
        for (value, _) in &self.limits {
            drawing += &format!("<path class=\"limit\" d=\"M0 {:.0}H{WIDTH}\"/>", y(*value));
        }
        let mut keys = String::new();
        for (i, (name, values)) in self.lines.iter().enumerate() {
            let path = path(values, self.every, y);
            drawing += &format!("<path class=\"c{}\" d=\"{path}\"/>", i % super::panel::LINES);
            if self.lines.len() > 1 {
                keys += &format!(" <b class=\"c{}\">{}</b>", i % super::panel::LINES, escape(name));
            }
        }
        for (value, name) in &self.limits {
            keys += &format!(" <small>- - {} {}</small>", escape(name), number(*value));
        }
        let band = self.fates.map_or(String::new(), |f| band(f, "behind"));
        let map = self.map.map_or(String::new(), |map| {
            let list: Vec<String> = map.iter().map(ToString::to_string).collect();
            format!(" data-map=\"{}\"", list.join(" "))
        });
        format!(
            "<figure class=\"plot\" data-rows=\"{rows}\"{map}><figcaption>{}{keys}</figcaption><div class=\"area\">{band}\
             <svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" preserveAspectRatio=\"none\" role=\"img\" aria-label=\"{} over {:.1} s, \
             from {} to {}\">{drawing}</svg><span class=\"hi\">{}</span><span class=\"lo\">{}</span>\
             <span class=\"end\">{:.1} s</span></div></figure>\n",
            escape(self.title),
            escape(self.title),
            self.seconds,
            number(lo),
            number(hi),
            number(hi),
            number(lo),
            self.seconds,
        )
    }
}

/// Steps from point to point in whole units; a new line begins after what is not finite.
fn path(values: &[f64], every: usize, y: impl Fn(f64) -> f64) -> String {
    let rows = values.len();
    let x = |t: usize| (WIDTH * (t as f64 + 0.5) / rows.max(1) as f64).round();
    let mut d = String::new();
    // Where the pen is, and whether the line goes on from there already.
    let mut at: Option<(f64, f64, bool)> = None;
    for t in (0..rows).filter(|t| t % every.max(1) == 0 || t + 1 == rows) {
        if !values[t].is_finite() {
            at = None;
            continue;
        }
        // Adding zero turns a negative zero into a plain one.
        let (px, py) = (x(t), y(values[t]).round() + 0.0);
        if let Some((ax, ay, goes_on)) = at {
            let dy = py - ay + 0.0;
            // A minus parts two numbers as well as a space does.
            let gap = if dy < 0.0 { "" } else { " " };
            d += &format!("{}{}{gap}{dy}", if goes_on { ' ' } else { 'l' }, px - ax);
        } else {
            d += &format!("M{px} {py}");
        }
        at = Some((px, py, at.is_some()));
    }
    d
}

/// A band whose stretches are painted as the fates of the frames.
pub(super) fn band(fates: &[String], class: &str) -> String {
    let ranks = fate::painted(fates);
    let mut s = format!("<span class=\"band {class}\" aria-hidden=\"true\">");
    let mut start = 0;
    for run in ranks.chunk_by(|a, b| a == b) {
        let end = start + run.len();
        s += &format!(
            "<i class=\"f{}\" style=\"flex:{}\" title=\"{}: frames {start} to {}\"></i>",
            run[0],
            run.len(),
            fate::label(run[0]),
            end - 1
        );
        start = end;
    }
    s + "</span>"
}

/// Rules for the colours of lines and their keys.
pub(super) fn css() -> String {
    (0..super::panel::LINES).map(|i| format!(".c{i}{{--c:{}}}\n", colour(i))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_visits_its_points_and_breaks_at_gaps() {
        let y = |v: f64| 10.0 * v;
        assert_eq!(path(&[0.0, 1.0, 3.0, 2.0], 1, y), "M125 0l250 10 250 20 250-10");
        assert_eq!(path(&[0.0, f64::NAN, 3.0, 2.0], 1, y), "M125 0M625 30l250-10");
        assert_eq!(path(&[0.0, 1.0, 3.0, 2.0, 9.0, 5.0], 4, y), "M83 0l667 90 167-40");
        assert_eq!(path(&[], 1, y), "");
    }

    #[test]
    fn a_band_has_every_frame_once() {
        let fates = ["kept", "kept", "static", "kept"].map(str::to_owned);
        let html = band(&fates, "x");
        let sum: usize =
            html.split("flex:").skip(1).map(|t| t.split('"').next().unwrap().parse::<usize>().unwrap()).sum();
        assert_eq!(sum, 4);
        assert!(html.contains("static: frames 2 to 2"));
    }

    #[test]
    fn flat_and_empty_plots_have_no_nan() {
        for values in [vec![], vec![1.0; 3], vec![f64::NAN; 2]] {
            let plot = Plot {
                title: "a<b",
                lines: vec![("x", values)],
                limits: vec![],
                every: 1,
                seconds: 1.0,
                fates: None,
                map: None,
            };
            let html = plot.html();
            assert!(!html.contains("NaN") && !html.contains("inf") && !html.contains("a<b"), "{html}");
        }
    }
}
