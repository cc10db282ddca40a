//! The entry of each episode: what is seen of it closed, and its pictures, plots and facts.

use super::Source;
use super::film::{Film, Films, ordinal};
use super::panel::{LINES, limited, panels};
use super::plot::{Plot, band};
use super::recording::{Account, Recording};
use crate::Result;
use crate::fate;
use crate::svg::{escape, number, percent};
use std::collections::{BTreeMap, BTreeSet};

/// Bytes that one point of a line takes.
const POINT: f64 = 6.0;
/// Most plots of one episode; a column of a thousand entries must not hide the others.
const PLOTS: usize = 24;

/// Points that a line may have so that plots leave room for pictures.
pub(super) fn points(source: &Source, chosen: &[usize], megabytes: f64) -> usize {
    let lines = chosen.first().and_then(|&i| source.read(i).ok()).map_or(24, |r| {
        let columns: usize = r.columns.iter().map(|c| c.entries.len()).sum();
        (columns + 4).min(PLOTS * LINES)
    });
    let all = (lines * chosen.len()).max(1) as f64;
    // Between 40 and 400.
    (Films::room_for_plots(megabytes) / (all * POINT)).clamp(40.0, 400.0) as usize
}

/// The entries of a page, one episode after the other.
#[derive(Default)]
pub(super) struct Entries {
    pub(super) html: String,
    pub(super) shown: usize,
    points: usize,
    /// Largest distance of drawn rows.
    sparse: usize,
    /// Entries that no plot shows, by column.
    hidden: BTreeMap<String, usize>,
    /// Successes among the episodes that say how they ended.
    pub(super) successes: (usize, usize),
    unreadable: usize,
    problems: BTreeSet<String>,
}

impl Entries {
    /// No entries yet; lines will have at most `points` points.
    pub(super) fn new(points: usize) -> Self {
        Self { points, ..Self::default() }
    }

    /// An entry that says why there is nothing in it.
    pub(super) fn unreadable(&mut self, index: usize, name: &str, why: &str) {
        self.shown += 1;
        self.unreadable += 1;
        self.html += &format!(
            "<details class=\"ep\" data-index=\"{index}\" data-origin=\"\" data-direction=\"\" data-iteration=\"\" \
             data-outcome=\"unreadable\" data-fates=\"\" data-rows=\"0\" data-kept=\"\" data-speed=\"\" data-text=\"{n}\">\
             <summary><span class=\"name\"><bdi>{n}</bdi></span><span class=\"tag bad\">cannot be read</span></summary>\
             <p class=\"body\">{}</p></details>\n",
            escape(why),
            n = escape(name),
        );
    }

    /// An entry with everything that is known of the episode.
    pub(super) fn episode(&mut self, index: usize, r: &Recording, film: Result<Option<Film>>) {
        self.shown += 1;
        if r.outcome != "not said" {
            self.successes.1 += 1;
            self.successes.0 += usize::from(r.outcome == "success");
        }
        let mut problems = r.problems.clone();
        let film = film.unwrap_or_else(|e| {
            problems.push(e.to_string());
            None
        });
        let mut fates: Vec<usize> = r.account.iter().flat_map(|a| &a.fates).map(|f| fate::rank(f)).collect();
        fates.sort_unstable();
        fates.dedup();
        let fates: Vec<&str> = fates.into_iter().map(fate::label).collect();
        let speed = r.account.as_ref().filter(|_| r.own_account).map(|a| &a.speed).or(r.speed.as_ref());
        let speed = speed.filter(|s| !s.is_empty()).map(|s| s.iter().sum::<f64>() / s.len() as f64);
        let kept = r.account.as_ref().map(Account::kept);
        let text = format!("{} {}", r.name, r.tasks.join(" ")).to_lowercase();
        let iteration = r.iteration.map_or(String::new(), |i| i.to_string());
        self.html += &format!(
            "<details class=\"ep\" data-index=\"{index}\" data-origin=\"{}\" data-direction=\"{}\" data-iteration=\"{}\" \
             data-outcome=\"{}\" data-fates=\"{}\" data-rows=\"{}\" data-kept=\"{}\" data-speed=\"{}\" data-hz=\"{}\" \
             data-text=\"{}\">\n<summary>",
            escape(&r.origin),
            escape(&r.direction),
            iteration,
            escape(&r.outcome),
            escape(&fates.join("|")),
            r.rows,
            kept.map_or(String::new(), |k| format!("{k:.3}")),
            speed.map_or(String::new(), |s| format!("{s:.4}")),
            r.hz,
            escape(&text),
        );
        if let Some(f) = &film {
            self.html += &format!(
                "<span class=\"thumbs\"><img alt=\"first picture\" src=\"{}\"><img alt=\"last picture\" src=\"{}\"></span>",
                f.first, f.last
            );
        }
        self.html += &line(r, kept, speed);
        self.html += "</summary>\n<div class=\"body\">\n<div class=\"side\">\n";
        if let Some(f) = &film {
            self.html += &player(f, r);
        }
        for problem in &problems {
            self.html += &format!("<p class=\"note\">{}</p>\n", escape(problem));
        }
        self.problems.extend(problems);
        self.html += &facts(r);
        self.html += "</div>\n<div class=\"plots\">\n";
        let plots = self.account(r) + &self.columns(r);
        self.html += &plots;
        self.html += "</div>\n</div>\n</details>\n";
    }

    /// Distance of drawn rows of a line of `rows`.
    fn every(&mut self, rows: usize) -> usize {
        let every = rows.div_ceil(self.points).max(1);
        self.sparse = self.sparse.max(every);
        every
    }

    /// One line over time, on what became of the frames.
    fn timeline(
        &mut self,
        (title, values): (&str, &[f64]),
        hz: f64,
        fates: Option<&[String]>,
        limits: Vec<(f64, &str)>,
        map: Option<&[usize]>,
    ) -> String {
        let (every, seconds) = (self.every(values.len()), values.len() as f64 / hz);
        Plot { title, lines: vec![("", values.to_vec())], limits, every, seconds, fates, map }.html()
    }

    /// Speed, value and advantage, of the episode and of the path that it was cut out of.
    fn account(&mut self, r: &Recording) -> String {
        let own = r.account.as_ref().filter(|_| r.own_account);
        let fates = own.map(|a| &a.fates[..]);
        let speed = own.map(|a| &a.speed).filter(|s| !s.is_empty()).or(r.speed.as_ref());
        let mut html = String::new();
        for (title, values) in [("speed, m/s", speed), ("value", r.value.as_ref())] {
            if let Some(values) = values {
                html += &self.timeline((title, values), r.hz, fates, vec![], None);
            }
        }
        let Some(a) = &r.account else { return html };
        let heading =
            format!("<h4>{}</h4>\n<p class=\"note\">{}</p>\n", escape(&a.title), escape(&totals(&a.fates)));
        if own.is_some() {
            let alone = if html.is_empty() { band(&a.fates, "wide") } else { String::new() };
            return heading + &alone + &html;
        }
        // Another path than the episode's own: the rows of the recording say where the episode's rows are in it.
        let places: BTreeMap<u32, usize> = a.source.iter().enumerate().map(|(t, &s)| (s, t)).collect();
        let map: Vec<usize> = r.source.iter().filter_map(|s| places.get(s).copied()).collect();
        let map = (map.len() == r.rows).then_some(&map[..]);
        let fates = Some(&a.fates[..]);
        let mut path = self.timeline(("speed of the whole path, m/s", &a.speed), r.hz, fates, vec![], map);
        if let Some(excursion) = &a.excursion {
            path += &self.timeline(("excursion of the goal, mm", excursion), r.hz, fates, vec![], map);
        }
        if let Some(value) = &a.value {
            path += &self.timeline(("value", value), r.hz, fates, vec![], map);
        }
        if let Some(advantage) = &a.advantage {
            let limits = a.threshold.map(|t| (t, "dropped below")).into_iter().collect();
            path += &self.timeline(("advantage, smoothed", advantage), r.hz, fates, limits, map);
        }
        heading + &path + "<h4>The episode</h4>\n" + &html
    }

    /// State, action and whatever else changes over time.
    fn columns(&mut self, r: &Recording) -> String {
        let mut html = String::new();
        let mut drawn = 0;
        for series in &r.columns {
            let width = series.entries.len().max(1);
            let every = self.every(r.rows);
            let (shown, mut left) = limited(panels(&series.name, &series.entries));
            for panel in shown {
                if drawn == PLOTS {
                    left += panel.lines.len();
                    continue;
                }
                drawn += 1;
                let line = |(name, i): &(String, usize)| {
                    (name.clone(), series.values.iter().skip(*i).step_by(width).copied().collect())
                };
                let lines: Vec<(String, Vec<f64>)> = panel.lines.iter().map(line).collect();
                let plot = Plot {
                    title: &panel.title,
                    lines: lines.iter().map(|(n, v)| (n.as_str(), v.clone())).collect(),
                    limits: vec![],
                    every,
                    seconds: r.rows as f64 / r.hz,
                    fates: None,
                    map: None,
                };
                html += &plot.html();
            }
            if left > 0 {
                self.hidden.insert(series.name.clone(), left);
            }
        }
        html
    }

    /// What the plots do not show, in sentences.
    pub(super) fn left_out(&self) -> Vec<String> {
        let mut text = vec![];
        if self.sparse > 1 {
            text.push(format!("Lines of long episodes have every {} row.", ordinal(self.sparse)));
        }
        for (column, n) in &self.hidden {
            text.push(format!("{n} entries of {column} are not drawn."));
        }
        if self.unreadable > 0 {
            text.push(format!("{} episodes cannot be read; their entries say why.", self.unreadable));
        }
        text.extend(self.problems.iter().take(3).map(|p| format!("Not shown: {p}")));
        text
    }
}

/// What is seen of a closed entry.
fn line(r: &Recording, kept: Option<f64>, speed: Option<f64>) -> String {
    let tag = |text: &str, class: &str| {
        if text.is_empty() {
            String::new()
        } else {
            format!("<span class=\"tag {class}\">{}</span>", escape(text))
        }
    };
    let mut s = format!("<span class=\"name\"><bdi>{}</bdi></span><span class=\"tags\">", escape(&r.name));
    let class = match r.outcome.as_str() {
        "success" => "good",
        "not said" => "",
        _ => "bad",
    };
    s += &tag(if r.outcome == "not said" { "" } else { &r.outcome }, class);
    s += &tag(&r.origin, "");
    s += &tag(&r.direction, "");
    s += &r.iteration.map_or(String::new(), |i| tag(&format!("iteration {i}"), ""));
    s += &tag(&format!("{} frames, {:.1} s", r.rows, r.rows as f64 / r.hz), "");
    s += &kept.map_or(String::new(), |k| tag(&format!("{} kept", percent(k)), ""));
    s += &speed.map_or(String::new(), |v| tag(&format!("{} m/s", number(v)), ""));
    s += "</span>";
    s + &r.account.as_ref().map_or(String::new(), |a| band(&a.fates, "line"))
}

fn player(f: &Film, r: &Recording) -> String {
    let rows: Vec<String> = f.rows.iter().map(ToString::to_string).collect();
    let cameras = escape(&f.cameras.join(", "));
    let (height, width) = f.size;
    format!(
        "<figure class=\"film\" data-rows=\"{}\"><img loading=\"lazy\" width=\"{width}\" height=\"{height}\" \
         alt=\"animation, cameras {cameras}\" src=\"{}\"><figcaption><bdi>{cameras}</bdi> · {} of {} frames</figcaption></figure>\n",
        rows.join(" "),
        f.animation,
        rows.len(),
        r.rows
    )
}

fn facts(r: &Recording) -> String {
    let mut rows = vec![("task".to_owned(), r.tasks.join("; "))];
    rows.extend(r.facts.iter().cloned());
    let row = |(name, value): (String, String)| {
        format!("<dt><bdi>{}</bdi></dt><dd><bdi>{}</bdi></dd>\n", escape(&name), escape(&value))
    };
    format!("<dl>\n{}</dl>\n", rows.into_iter().map(row).collect::<String>())
}

/// Frames by fate in words.
fn totals(fates: &[String]) -> String {
    let mut counts = BTreeMap::new();
    for f in fates {
        *counts.entry(f.clone()).or_insert(0) += 1;
    }
    fate::totals(counts.iter().map(|(name, n)| (name.as_str(), *n)))
}
