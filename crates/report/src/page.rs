//! The report page of one run.

use crate::png_image::data_uri;
use crate::record::{Collection, Evaluation, IterationRecord, RunResults};
use crate::svg::{escape, number, percent};
use crate::table::interval;
use crate::{chart, fate};
use e2h_core::CONTROL_HZ;

const STYLE: &str = include_str!("page.css");

/// Pictures that only the run itself can make; each with its title.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pictures {
    /// SVG of [`FilterPicture::svg`](super::filter::FilterPicture::svg).
    pub filter: Vec<(String, String)>,
    /// Animated PNG of [`apng_bytes`](super::animation::apng_bytes).
    pub animations: Vec<(String, Vec<u8>)>,
    /// PNG of [`png_bytes`](super::png_bytes): camera views, what the policy sees.
    pub views: Vec<(String, Vec<u8>)>,
}

/// The page of a run: one HTML document that needs nothing besides itself.
#[must_use]
pub fn html(results: &RunResults, config_toml: &str, pictures: &Pictures) -> String {
    let title = format!("{} ({}), {}, seed {}", results.task, results.variant, results.preset, results.seed);
    let mut body = format!(
        "<header><p class=\"kind\">Auto-E2H run</p><h1>{}</h1><p class=\"sub\">{}</p><p class=\"lead\">{}</p></header>",
        escape(&results.task),
        escape(&subtitle(results)),
        escape(&summary(results))
    );
    body += &section("Success by iteration", &figure("", &chart::success_curve(&[results])));
    body += &section("Evaluation", &evaluation_table(results));
    if results.iterations.iter().any(|r| r.collection.is_some()) {
        let below = "<p class=\"note\">Frames of the accepted reversals by what became of them. Resampled are those \
                     that were skipped when slow motion was re-timed.</p>";
        let collection = collection_table(results) + &figure("", &chart::fates(results)) + below;
        body += &section("Collection and refinement", &collection);
    }
    body += &section("Time by stage", &figure("", &chart::stage_times(results)));
    body += &section("Losses", &figure("", &chart::losses(&[results])));
    body += &images("Rollouts", &pictures.animations);
    body += &images("Views", &pictures.views);
    if !pictures.filter.is_empty() {
        let figures: String = pictures.filter.iter().map(|(title, svg)| figure(title, svg)).collect();
        body += &section("What the filters did", &figures);
    }
    body += &section("Configuration", &format!("<pre tabindex=\"0\">{}</pre>", escape(config_toml)));
    body += &section("Provenance", &provenance(results));
    document(&title, &body)
}

/// A whole page: `body` is HTML, `title` is not.
pub(crate) fn document(title: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>{}</title>\n<style>\n{STYLE}</style>\n</head>\n\
         <body>\n<main>\n{body}</main>\n</body>\n</html>\n",
        escape(title)
    )
}

fn subtitle(results: &RunResults) -> String {
    let variant =
        if results.variant.is_empty() { String::new() } else { format!("variant {} · ", results.variant) };
    format!("{variant}preset {} · seed {}", results.preset, results.seed)
}

/// The run in one or two sentences.
fn summary(results: &RunResults) -> String {
    let [first, .., last] = results.iterations.as_slice() else {
        return results.iterations.first().map_or("No policy has been evaluated yet.".to_owned(), |only| {
            format!(
                "The initial policy succeeds in {} trials, after {} minutes.",
                share(&only.evaluation),
                number(only.minutes)
            )
        });
    };
    let apart = first.evaluation.wilson95[1] < last.evaluation.wilson95[0];
    format!(
        "Success on the hard task went from {} to {} in {} iteration{} and {:.0} minutes.{}",
        share(&first.evaluation),
        share(&last.evaluation),
        last.iteration,
        if last.iteration == 1 { "" } else { "s" },
        last.minutes,
        if apart { " The two 95% intervals do not overlap." } else { "" }
    )
}

fn share(e: &Evaluation) -> String {
    format!("{}/{} ({})", e.successes, e.trials, percent(e.successes as f64 / e.trials as f64))
}

pub(crate) fn section(title: &str, content: &str) -> String {
    format!("<section>\n<h2>{}</h2>\n{content}\n</section>\n", escape(title))
}

/// A drawing that may be scrolled sideways where the screen is narrow.
pub(crate) fn figure(title: &str, svg: &str) -> String {
    let caption =
        if title.is_empty() { String::new() } else { format!("<figcaption>{}</figcaption>", escape(title)) };
    format!("<figure>{caption}<div class=\"scroll\" tabindex=\"0\">{svg}</div></figure>\n")
}

fn images(title: &str, images: &[(String, Vec<u8>)]) -> String {
    if images.is_empty() {
        return String::new();
    }
    let figures: String = images
        .iter()
        .map(|(caption, bytes)| {
            let caption = escape(caption);
            let uri = data_uri(bytes);
            format!(
                "<figure><figcaption>{caption}</figcaption><img alt=\"{caption}\" src=\"{uri}\"></figure>\n"
            )
        })
        .collect();
    section(title, &format!("<div class=\"images\">{figures}</div>"))
}

/// A table whose first column names the row; cells are HTML.
pub(crate) fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let head: String = head.iter().map(|h| format!("<th scope=\"col\">{h}</th>")).collect();
    let body: String = rows
        .iter()
        .map(|row| {
            let cells: String = row
                .iter()
                .enumerate()
                .map(
                    |(i, c)| {
                        if i == 0 { format!("<th scope=\"row\">{c}</th>") } else { format!("<td>{c}</td>") }
                    },
                )
                .collect();
            format!("<tr>{cells}</tr>\n")
        })
        .collect();
    format!(
        "<div class=\"scroll\" tabindex=\"0\"><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>\n"
    )
}

fn evaluation_table(results: &RunResults) -> String {
    let head = ["iteration", "success", "rate", "Wilson 95%", "steps to success", "minutes", "loss"];
    let rows: Vec<Vec<String>> = results
        .iterations
        .iter()
        .map(|r| {
            let e = &r.evaluation;
            let steps = if e.successes == 0 { "–".to_owned() } else { format!("{:.0}", e.mean_steps) };
            let skipped = if r.skipped { " <span class=\"tag\">no update</span>" } else { "" };
            vec![
                format!("{}{skipped}", r.iteration),
                format!("<b>{}/{}</b>", e.successes, e.trials),
                percent(e.successes as f64 / e.trials as f64),
                interval(e.wilson95),
                steps,
                format!("{:.1}", r.minutes),
                if r.skipped { "–".to_owned() } else { number(r.loss) },
            ]
        })
        .collect();
    table(&head, &rows)
}

fn collection_table(results: &RunResults) -> String {
    let head = [
        "iteration",
        "hard",
        "easy",
        "accepted",
        "automatic resets",
        "external resets",
        "segments",
        "frames kept",
        "critic loss",
    ];
    let row = |r: &IterationRecord, c: &Collection| {
        vec![
            r.iteration.to_string(),
            format!("{}/{}", c.hard_successes, c.cycles),
            format!("{}/{}", c.easy_successes, c.easy_rollouts),
            c.accepted.to_string(),
            automatic(c),
            resets(c),
            c.segments.to_string(),
            c.frames_kept.to_string(),
            c.critic_loss.map_or("–".to_owned(), number),
        ]
    };
    let collected = || results.iterations.iter().filter_map(|r| Some((r, r.collection.as_ref()?)));
    let rows: Vec<Vec<String>> = collected().map(|(r, c)| row(r, c)).collect();
    let details: String = collected()
        .map(|(r, c)| {
            let notes: String =
                c.notes.iter().map(|n| format!("; {}", escape(n.trim_end_matches('.')))).collect();
            format!(
                "<li>Iteration {}: {}{notes}.</li>\n",
                r.iteration,
                escape(&fate::totals(c.fates.iter().map(|(f, n)| (f.name(), *n))))
            )
        })
        .collect();
    table(&head, &rows) + &format!("<ul class=\"note\">\n{details}</ul>\n")
}

/// The automatic-reset rate; of both kinds of cycles where there were both.
fn automatic(c: &Collection) -> String {
    let all = percent(c.automatic_reset_rate());
    match (c.explored.rate(), c.plain.rate()) {
        (Some(explored), Some(plain)) => {
            format!("{all} ({} exploring, {} not)", percent(explored), percent(plain))
        }
        (Some(_), None) => format!("{all} (exploring)"),
        _ => all,
    }
}

/// Total, then each cause with its count.
fn resets(c: &Collection) -> String {
    let total: usize = c.resets.values().sum();
    let causes: Vec<String> =
        c.resets.iter().filter(|(_, n)| **n > 0).map(|(cause, n)| format!("{} {n}", cause.words())).collect();
    if causes.is_empty() {
        total.to_string()
    } else {
        format!("{total} <small>{}</small>", causes.join(", "))
    }
}

fn provenance(results: &RunResults) -> String {
    let demonstration = format!(
        "{:.0} control steps ({:.1} s) in the mean",
        results.demonstration_steps,
        results.demonstration_steps / CONTROL_HZ
    );
    let from = results.given.as_ref().map_or("the scripted demonstrator".to_owned(), |given| {
        format!("{} (SHA-256 {})", given.words(), given.sha256)
    });
    let rows = [
        ("library", format!("auto-e2h {}", results.version)),
        ("machine", results.machine.clone()),
        ("task", format!("{} {}", results.task, results.variant)),
        ("preset", results.preset.clone()),
        ("seed", results.seed.to_string()),
        ("easy demonstration", demonstration),
        ("demonstrations from", from),
    ];
    let rows: String =
        rows.iter().map(|(name, value)| format!("<dt>{name}</dt><dd>{}</dd>\n", escape(value))).collect();
    format!("<dl>\n{rows}</dl>")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{animation, png_bytes, sample};

    fn pictures() -> Pictures {
        let rollout = sample::rollout(6, 16, 16, 1);
        Pictures {
            filter: vec![("episode <3>".into(), sample::filter_picture().svg().unwrap())],
            animations: vec![("trials & errors".into(), animation::apng_bytes(&rollout, 10).unwrap())],
            views: vec![("table".into(), png_bytes(&rollout[0]).unwrap())],
        }
    }

    #[test]
    fn text_from_outside_is_escaped() {
        let mut results = sample::results(1, 4);
        results.machine = "<script>alert(1)</script>".into();
        if let Some(c) = &mut results.iterations[1].collection {
            c.notes.push("a < b".into());
        }
        let config = "name = \"<b>&amp;\"\nx = '</pre><script>'\n";
        let page = html(&results, config, &pictures());
        for bad in ["<script", "<b>&amp;\"", "a < b", "<3>"] {
            assert!(!page.contains(bad), "{bad}");
        }
        assert!(page.contains("name = &quot;&lt;b&gt;&amp;amp;&quot;"));
        assert!(page.contains("trials &amp; errors"));
    }

    #[test]
    fn the_page_needs_nothing_and_is_the_same_every_time() {
        let (results, pictures) = (sample::results(1, 4), pictures());
        let page = html(&results, "seed = 1", &pictures);
        assert_eq!(page, html(&results, "seed = 1", &pictures));
        let plain = page.replace("http://www.w3.org/2000/svg", "");
        assert!(!plain.contains("http") && !plain.contains("url(\"") && !plain.contains("<link"));
        assert!(plain.contains("data:image/png;base64,") && !plain.contains("NaN"));
        for tag in ["section", "figure", "table", "svg", "div", "dl", "ul", "g", "text"] {
            let open = page.matches(&format!("<{tag}>")).count() + page.matches(&format!("<{tag} ")).count();
            assert_eq!(open, page.matches(&format!("</{tag}>")).count(), "{tag}");
        }
    }

    #[test]
    fn the_summary_says_what_happened() {
        let mut results = sample::results(1, 5);
        assert_eq!(
            summary(&results),
            "Success on the hard task went from 4/50 (8%) to 39/50 (78%) in 4 iterations and 68 minutes. \
             The two 95% intervals do not overlap."
        );
        results.iterations.truncate(1);
        assert_eq!(summary(&results), "The initial policy succeeds in 4/50 (8%) trials, after 11 minutes.");
        results.iterations.clear();
        assert!(html(&results, "", &Pictures::default()).contains("No policy has been evaluated yet."));
    }
}
