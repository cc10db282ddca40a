//! The page itself: what stands above, between and below the episodes.

use super::entry::Entries;
use super::plot;
use crate::fate;
use crate::png_image::base64;
use crate::svg::{escape, percent};
use sha2::{Digest as _, Sha256};

const STYLE: &str = include_str!("../page.css");
const VIEW_STYLE: &str = include_str!("view.css");
const SCRIPT: &str = include_str!("view.js");

/// What stands above the episodes.
#[derive(Default)]
pub(super) struct Head {
    pub(super) kind: &'static str,
    pub(super) title: String,
    pub(super) subtitle: String,
    /// Rows of all episodes.
    pub(super) frames: usize,
    /// Rows a second.
    pub(super) hz: f64,
    /// Frames kept by refinement, of how many.
    pub(super) kept: Option<(usize, usize)>,
    /// HTML: drawings of the whole.
    pub(super) intro: String,
    /// Names and values below the episodes.
    pub(super) facts: Vec<(String, String)>,
    /// What a reader has to know, in sentences.
    pub(super) notes: Vec<String>,
}

/// The whole page. `listed` is the number of episodes, shown or not.
pub(super) fn html(head: &Head, listed: usize, entries: &Entries, left_out: &[String]) -> String {
    let h = head;
    let tile = |value: String, name: &str| format!("<div><b>{value}</b><span>{name}</span></div>\n");
    let mut tiles = tile(listed.to_string(), "episodes");
    tiles += &tile(h.frames.to_string(), "frames");
    if h.hz > 0.0 {
        tiles += &tile(duration(h.frames as f64 / h.hz), "recorded");
    }
    let (k, n) = entries.successes;
    if n > 0 {
        let of = if entries.shown < listed { "successes, of those shown" } else { "successes" };
        tiles += &tile(format!("{k}/{n}"), of);
    }
    if let Some((kept, of)) = h.kept.filter(|k| k.1 > 0) {
        tiles += &tile(percent(kept as f64 / of as f64), &format!("kept of {of} reversed frames"));
    }
    let list =
        |items: &[String]| -> String { items.iter().map(|i| format!("<li>{}</li>\n", escape(i))).collect() };
    let notes: Vec<String> = h.notes.iter().chain(left_out).cloned().collect();
    let notes = if notes.is_empty() {
        String::new()
    } else {
        format!("<section>\n<h2>Left out</h2>\n<ul class=\"note\">\n{}</ul>\n</section>\n", list(&notes))
    };
    let facts: String = h
        .facts
        .iter()
        .map(|(n, v)| format!("<dt><bdi>{}</bdi></dt><dd><bdi>{}</bdi></dd>\n", escape(n), escape(v)))
        .collect();
    let intro = if h.intro.is_empty() {
        String::new()
    } else {
        format!("<section class=\"intro\">\n{}</section>\n", h.intro)
    };
    let script = base64(&Sha256::digest(SCRIPT.as_bytes()));
    // Whatever a file's text may smuggle in: no script but this one runs, and nothing is fetched.
    let policy = format!(
        "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'sha256-{script}'"
    );
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <meta name=\"color-scheme\" content=\"light dark\">\n<title>{title}: episodes</title>\n\
             <style>\n{STYLE}{VIEW_STYLE}{}{}</style>\n</head>\n<body>\n<main>\n\
             <header><p class=\"kind\">{}</p><h1><bdi>{title}</bdi></h1><p class=\"sub\"><bdi>{}</bdi></p></header>\n\
             <section class=\"tiles\">\n{tiles}</section>\n{intro}\
             <section>\n<h2>Episodes</h2>\n{FILTERS}<p class=\"note legend\">{}</p>\n<div id=\"list\">\n{}</div>\n</section>\n\
             {notes}<section>\n<h2>What it is</h2>\n<dl>\n{facts}</dl>\n</section>\n</main>\n<script>{SCRIPT}</script>\n\
             </body>\n</html>\n",
        plot::css(),
        fate::css(),
        h.kind,
        escape(&h.subtitle),
        legend(&entries.html),
        entries.html,
        title = escape(&h.title),
    )
}
/// Only the script shows it: without one there is nothing to filter with.
const FILTERS: &str = "<form id=\"filters\" hidden>\n\
    <label>find <input name=\"text\" type=\"search\" placeholder=\"name or task\"></label>\n\
    <label>origin <select name=\"origin\"><option value=\"\">all</option></select></label>\n\
    <label>direction <select name=\"direction\"><option value=\"\">all</option></select></label>\n\
    <label>iteration <select name=\"iteration\"><option value=\"\">all</option></select></label>\n\
    <label>outcome <select name=\"outcome\"><option value=\"\">all</option></select></label>\n\
    <label>has frames <select name=\"fate\"><option value=\"\">of any fate</option></select></label>\n\
    <label>sort by <select name=\"sort\"><option value=\"index\">index</option><option value=\"rows\">length</option>\
    <option value=\"kept\">share kept</option><option value=\"speed\">mean speed</option>\
    <option value=\"outcome\">outcome</option></select></label>\n\
    <label class=\"check\"><input name=\"down\" type=\"checkbox\"> descending</label>\n\
    <button type=\"reset\">show all</button>\n<output name=\"count\" aria-live=\"polite\"></output>\n</form>\n";

/// The fates that occur, with their colours.
fn legend(episodes: &str) -> String {
    (0..fate::RANKS)
        .filter(|rank| episodes.contains(&format!("<i class=\"f{rank}\"")))
        .map(|rank| format!("<span><i class=\"f{rank}\"></i> {}</span> ", fate::label(rank)))
        .collect()
}

/// Seconds for people.
fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 9.95 => format!("{s:.1} s"),
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}
