//! What refinement did to one reversed rollout: its images, scores, thresholds and the fate of every frame.

use crate::svg::{Axes, document, legend, number, percent, px, ticks};
use crate::{Result, animation, fate, png_image};
use e2h_core::Image;
use std::collections::BTreeMap;

const WIDTH: f64 = 960.0;
const LEFT: f64 = 78.0;
const PLOT: f64 = WIDTH - LEFT - 96.0;
const PANEL: f64 = 110.0;

/// A value and what it is called.
type Threshold = (f32, &'static str);
/// Name, column if there is one, thresholds.
type Curve<'a> = (&'static str, Option<&'a Vec<f32>>, &'a [Threshold]);

/// One reversed rollout as the filters saw it. Columns have one entry per frame that went in, T; a shorter one is drawn
/// as far as it goes. Fields that a caller has no use for come from `..FilterPicture::default()`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FilterPicture {
    /// Time of each frame in the reversed rollout, s, ascending.
    pub times: Vec<f32>,
    /// Speed of the tool centre point, m/s.
    pub speed: Vec<f32>,
    /// Critic value.
    pub value: Option<Vec<f32>>,
    /// Smoothed advantage.
    pub advantage: Option<Vec<f32>>,
    /// Frames below this advantage are dropped.
    pub advantage_threshold: Option<f32>,
    /// How far exploration had displaced the goal, mm.
    pub excursion: Option<Vec<f32>>,
    /// Error of the dynamics model, for the baseline that filters by it.
    pub dynamics_error: Option<Vec<f32>>,
    /// Frames above this error are dropped.
    pub dynamics_threshold: Option<f32>,
    /// Below this speed a frame counts as static, m/s.
    pub static_speed: f32,
    /// Below this speed, and not static, a frame is resampled, m/s.
    pub slow_speed: f32,
    /// Fate of each frame by its name, for example `kept` or `LowAdvantage`.
    pub fates: Vec<String>,
    /// About eight images, evenly spread from the first frame to the last ([`animation::sampled_frames`]).
    pub frames: Vec<Image>,
}

impl FilterPicture {
    /// Number of frames by fate; the values add up to the number of fates.
    #[must_use]
    pub fn totals(&self) -> BTreeMap<String, usize> {
        let mut totals = BTreeMap::new();
        for fate in &self.fates {
            *totals.entry(fate.clone()).or_insert(0) += 1;
        }
        totals
    }

    /// The totals in words, for example `120 frames: 80 kept (67%), 40 static (33%)`.
    #[must_use]
    pub fn totals_text(&self) -> String {
        fate::totals(self.totals().iter().map(|(name, n)| (name.as_str(), *n)))
    }

    /// The picture: sampled images on top, then value, advantage, dynamics error, excursion and speed over time with their
    /// thresholds, all on bands that show the fates (green kept, forward hatch static, backward hatch resampled, red
    /// low advantage, grey too short), then the totals. A slow run is painted whole; the totals count its frames as they
    /// are.
    ///
    /// # Errors
    /// When an image cannot be encoded.
    pub fn svg(&self) -> Result<String> {
        let prefix = fate::prefix(
            self.fates
                .iter()
                .flat_map(|f| f.bytes().chain([0]))
                .chain(self.times.iter().chain(&self.speed).flat_map(|v| v.to_le_bytes())),
        );
        let (images, mut top) = self.images()?;
        let mut s = fate::patterns(&prefix) + &images;
        let slow = [(self.static_speed, "static"), (self.slow_speed, "slow")];
        let advantage: Vec<_> = self.advantage_threshold.map(|t| (t, "min")).into_iter().collect();
        let error: Vec<_> = self.dynamics_threshold.map(|t| (t, "max")).into_iter().collect();
        let curves: [Curve; 5] = [
            ("value", self.value.as_ref(), &[]),
            ("advantage", self.advantage.as_ref(), &advantage),
            ("dynamics error", self.dynamics_error.as_ref(), &error),
            ("excursion, mm", self.excursion.as_ref(), &[]),
            ("speed, m/s", Some(&self.speed), &slow),
        ];
        let mut bottom = top;
        for (name, values, thresholds) in curves {
            let Some(values) = values else { continue };
            let axes = self.axes(top, values, thresholds, name.starts_with("speed"));
            s += &self.bands(&axes, &prefix);
            s += &curve(&axes, &self.times, values, name);
            s += &threshold_lines(&axes, thresholds);
            bottom = axes.bottom();
            top = bottom + 16.0;
        }
        let axes = Axes { top: bottom, height: 0.0, ..self.axes(0.0, &[], &[], true) };
        let (x0, x1) = axes.x;
        s += &axes.bottom_axis(&ticks(x0.max(0.0), x1, 10.0), number, "time in the reversed rollout, s");
        let (keys, taken) = legend(&self.legend(&prefix), LEFT, bottom + 62.0, WIDTH - LEFT);
        Ok(document(
            WIDTH,
            bottom + 56.0 + taken,
            &format!("Filtering. {}", self.totals_text()),
            &(s + &keys),
        ))
    }

    /// One entry a fate that occurs, with its total, and the sum.
    fn legend(&self, prefix: &str) -> Vec<(String, String)> {
        let mut counts = [0_usize; fate::RANKS];
        for name in &self.fates {
            counts[fate::rank(name)] += 1;
        }
        let sum = self.fates.len();
        let mut entries: Vec<(String, String)> = (0..fate::RANKS)
            .filter(|&rank| counts[rank] > 0)
            .map(|rank| {
                let share = percent(counts[rank] as f64 / sum as f64);
                (format!("{}: {} ({share})", fate::label(rank), counts[rank]), fate::fill(rank, prefix))
            })
            .collect();
        entries.push((format!("{sum} frames in"), "none".to_owned()));
        entries
    }

    /// Images in one row with their times; returns where the first plot begins too.
    fn images(&self) -> Result<(String, f64)> {
        let count = self.frames.len();
        let (mut s, slot, mut lowest) = (String::new(), PLOT / count.max(1) as f64, 0.0_f64);
        for (i, image) in self.frames.iter().enumerate() {
            let width = (slot - 6.0).clamp(1.0, 150.0);
            let height = width * image.height as f64 / image.width.max(1) as f64;
            let x = LEFT + slot * (i as f64 + 0.5);
            s += &format!(
                "<image x=\"{}\" y=\"4\" width=\"{}\" height=\"{}\" href=\"{}\"/>",
                px(x - width / 2.0),
                px(width),
                px(height),
                png_image::data_uri(&png_image::png_bytes(image)?)
            );
            if let Some(t) = self.times.get(animation::sample_row(i, count, self.times.len())) {
                let y = px(height + 20.0);
                s += &format!("<text class=\"soft mid\" x=\"{}\" y=\"{y}\">{t:.1} s</text>", px(x));
            }
            lowest = lowest.max(height + 26.0);
        }
        Ok((s, lowest + 10.0))
    }

    /// Half the time between two frames, so that a band covers its frame and not the gap after it.
    fn half_step(&self) -> f64 {
        match (self.times.first(), self.times.last()) {
            (Some(a), Some(b)) if self.times.len() > 1 => {
                f64::from(b - a) / (self.times.len() - 1) as f64 / 2.0
            }
            _ => 0.5,
        }
    }

    fn axes(&self, top: f64, values: &[f32], thresholds: &[Threshold], from_zero: bool) -> Axes {
        let all = || values.iter().copied().chain(thresholds.iter().map(|t| t.0)).filter(|v| v.is_finite());
        let lo = all().map(f64::from).fold(f64::INFINITY, f64::min).min(if from_zero {
            0.0
        } else {
            f64::INFINITY
        });
        let hi = all().map(f64::from).fold(f64::NEG_INFINITY, f64::max);
        let (lo, hi) = match (lo.is_finite() && hi.is_finite(), from_zero) {
            (true, _) if hi > lo => (lo, hi),
            (true, false) => (lo - 0.5, hi + 0.5),
            _ => (0.0, 1.0),
        };
        let room = 0.08 * (hi - lo);
        let time = |t: Option<&f32>| t.map_or(0.0, |t| f64::from(*t));
        Axes {
            left: LEFT,
            top,
            width: PLOT,
            height: PANEL,
            x: (time(self.times.first()) - self.half_step(), time(self.times.last()) + self.half_step()),
            y: (if from_zero { lo } else { lo - room }, hi + room),
        }
    }

    /// The fate that each frame with a time is painted with.
    fn band_ranks(&self) -> Vec<usize> {
        fate::painted(&self.fates[..self.fates.len().min(self.times.len())])
    }

    fn bands(&self, axes: &Axes, prefix: &str) -> String {
        let ranks = self.band_ranks();
        let (mut s, mut start) = (String::new(), 0);
        for run in ranks.chunk_by(|a, b| a == b) {
            let end = start + run.len() - 1;
            let x0 = axes.px(f64::from(self.times[start]) - self.half_step());
            let x1 = axes.px(f64::from(self.times[end]) + self.half_step());
            s += &format!(
                "<rect class=\"band\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" fill=\"{}\"><title>{}: frames {start} \
                 to {end}</title></rect>",
                px(x0),
                px(axes.top),
                px(x1 - x0),
                px(axes.height),
                fate::fill(run[0], prefix),
                fate::label(run[0])
            );
            start = end + 1;
        }
        s
    }
}

fn curve(axes: &Axes, times: &[f32], values: &[f32], name: &str) -> String {
    let points = times.iter().zip(values).map(|(t, v)| (f64::from(*t), f64::from(*v)));
    axes.grid(&ticks(axes.y.0, axes.y.1, 4.0), number)
        + &axes.side_name(14.0, name)
        + &axes.line(points, "stroke=\"var(--ink)\" stroke-width=\"1.8\"")
}

/// Dashed lines, named in the right margin; names that would touch are pushed up.
fn threshold_lines(axes: &Axes, thresholds: &[Threshold]) -> String {
    let (mut s, mut free) = (String::new(), f64::INFINITY);
    for (value, name) in thresholds.iter().filter(|t| t.0.is_finite()) {
        let y = axes.py(f64::from(*value));
        let label = (y + 4.5).min(free);
        free = label - 15.0;
        s += &format!(
            "<path d=\"M{} {y1}H{}\" stroke=\"#d64545\" stroke-width=\"1.3\" stroke-dasharray=\"5 4\"/>\
             <text class=\"soft\" x=\"{}\" y=\"{}\">{name} {}</text>",
            px(axes.left),
            px(axes.right()),
            px(axes.right() + 6.0),
            px(label),
            number(f64::from(*value)),
            y1 = px(y),
        );
    }
    s
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample;

    #[test]
    fn every_frame_is_in_a_band_and_in_the_totals() {
        let picture = sample::filter_picture();
        let svg = picture.svg().unwrap();
        assert_eq!(picture.totals().values().sum::<usize>(), picture.fates.len());
        assert!(picture.totals_text().starts_with("240 frames: "), "{}", picture.totals_text());
        let kept = picture.totals()["kept"];
        assert!(svg.contains(&format!(">kept: {kept} (")) && svg.contains(">240 frames in<"));
        // Bands of one panel tile the whole plot.
        let panels = svg.matches("rotate(-90").count();
        assert_eq!(panels, 3);
        let widths: f64 = svg
            .split("class=\"band\"")
            .skip(1)
            .map(|t| t.split("width=\"").nth(1).unwrap().split('"').next().unwrap().parse::<f64>().unwrap())
            .sum();
        assert!((widths / panels as f64 - PLOT).abs() < 2.0, "{widths}");
        assert_eq!(svg.matches("<image ").count(), 8);
        assert_eq!(svg, picture.svg().unwrap());
    }

    #[test]
    fn a_re_timed_run_is_one_band() {
        let fates = "kkkrkrrkkrkkkrsr".chars().map(|c| match c {
            'r' => "resampled",
            's' => "static",
            _ => "Kept",
        });
        let fates: Vec<String> = fates.map(str::to_owned).collect();
        let times = (0..fates.len()).map(|t| t as f32).collect();
        let picture = FilterPicture { fates, times, ..FilterPicture::default() };
        let painted: String = picture.band_ranks().iter().map(|r| ["k", "r", "s"][*r]).collect();
        assert_eq!(painted, "kkkrrrrrrrkkkrsr");
        assert_eq!(picture.totals()["resampled"], 6);
    }

    #[test]
    fn patterns_of_two_pictures_do_not_share_names() {
        let (a, mut b) = (sample::filter_picture(), sample::filter_picture());
        b.fates[0] = "static".to_owned();
        let id = |s: &str| s.split("pattern id=\"").nth(1).unwrap().split('"').next().unwrap().to_owned();
        assert_ne!(id(&a.svg().unwrap()), id(&b.svg().unwrap()));
    }

    #[test]
    fn scarce_data_still_draws() {
        let empty = FilterPicture::default().svg().unwrap();
        assert!(empty.contains("0 frames in") && !empty.contains("NaN") && !empty.contains("inf"), "{empty}");
        let one = FilterPicture {
            times: vec![0.0],
            speed: vec![f32::NAN],
            fates: vec!["Kept".into(), "Kept".into()],
            ..FilterPicture::default()
        };
        let svg = one.svg().unwrap();
        assert!(svg.contains("2 frames in") && !svg.contains("NaN"), "{svg}");
    }
}
