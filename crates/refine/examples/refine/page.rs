//! The report: what came in, what became of it and why.

use crate::config::Config;
use crate::critic::Judge;
use crate::{Arguments, LeftOut, Plan};
use anyhow::Result;
use e2h_core::Episode;
use e2h_data::lerobot::Info;
use e2h_refine::{RefineReport, Refined};
use serde::Serialize;
use serde_json::{Value, json};
use std::fmt::{self, Display, Formatter};

/// Whether a recording was used.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Verdict {
    Accepted,
    /// Its `next.success` is never true.
    Failed,
    /// Its reversal switches the gripper otherwise than the gate asks.
    Gate {
        closings: usize,
        openings: usize,
    },
}

impl Display for Verdict {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Accepted => f.write_str("accepted"),
            Self::Failed => f.write_str("rejected: the recording did not succeed"),
            Self::Gate { closings, openings } => {
                write!(f, "rejected: the gripper closes {closings} and opens {openings} times")
            }
        }
    }
}

/// One path in figures.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Figures {
    pub(crate) frames: usize,
    pub(crate) seconds: f64,
    pub(crate) path_m: f64,
}

impl Figures {
    fn new<'a>(episodes: impl IntoIterator<Item = &'a Episode>, hz: f64) -> Self {
        let mut sum = Self::default();
        for e in episodes {
            sum.frames += e.len();
            sum.seconds += e.len() as f64 / hz;
            sum.path_m +=
                (1..e.len()).map(|t| (e.eef(t).position - e.eef(t - 1).position).norm()).sum::<f64>();
        }
        sum
    }

    /// Mean speed, m/s.
    fn speed(&self) -> f64 {
        if self.seconds > 0.0 { self.path_m / self.seconds } else { 0.0 }
    }
}

/// What became of one recording.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Account {
    pub(crate) episode: usize,
    pub(crate) verdict: Verdict,
    /// As recorded, at the recording's rate.
    recorded: Figures,
    /// At the rate of control, reversed.
    before: Figures,
    /// As written.
    after: Figures,
    /// Closings and openings of the reversed path.
    gripper: (usize, usize),
    /// Fates of the frames of `before`; they add up.
    fates: RefineReport,
}

impl Account {
    #[allow(clippy::too_many_arguments, reason = "every stage of one episode")]
    pub(crate) fn new(
        episode: usize,
        recorded: &Episode,
        recorded_hz: f64,
        reversed: &Episode,
        refined: Option<&Refined>,
        hz: f64,
        verdict: Verdict,
        gripper: (usize, usize),
    ) -> Self {
        Self {
            episode,
            verdict,
            recorded: Figures::new([recorded], recorded_hz),
            before: Figures::new([reversed], hz),
            after: Figures::new(refined.iter().flat_map(|r| &r.segments), hz),
            gripper,
            fates: refined.map(|r| r.report.clone()).unwrap_or_default(),
        }
    }

    pub(crate) fn accepted(&self) -> bool {
        self.verdict == Verdict::Accepted
    }

    /// A later stage has changed what is left.
    pub(crate) fn refine(&mut self, refined: &Refined, hz: f64) {
        self.after = Figures::new(&refined.segments, hz);
        self.fates = refined.report.clone();
    }
}

/// Fate of every frame of every reversed recording.
pub(crate) fn csv(plans: &[Plan], fps: f64) -> String {
    let mut out = String::from("episode,frame,time_s,source_frame,speed_m_s,value,advantage,fate\n");
    for plan in plans {
        for t in 0..plan.reversed.len() {
            let (speed, fate) = match &plan.refined {
                // The filter counts 20 frames a second.
                Some(r) => (format!("{:.5}", f64::from(r.speed[t]) * fps / 20.0), r.fates[t].name()),
                None => (String::new(), "rejected"),
            };
            let time = t as f64 / fps;
            // Empty without a critic, and where an earlier stage had removed the frame.
            let number = |column: Option<&Vec<f32>>| {
                column.map(|c| c[t]).filter(|v| v.is_finite()).map_or(String::new(), |v| format!("{v:.6}"))
            };
            let value = number(plan.refined.as_ref().and_then(|r| r.value.as_ref()));
            let advantage = number(plan.refined.as_ref().and_then(|r| r.advantage.as_ref()));
            let source = plan.reversed.source[t];
            out += &format!("{},{t},{time:.4},{source},{speed},{value},{advantage},{fate}\n", plan.episode);
        }
    }
    out
}

struct Sums {
    recorded: Figures,
    before: Figures,
    after: Figures,
    fates: RefineReport,
    accepted: usize,
}

fn sums(accounts: &[&Account]) -> Sums {
    let sum = |f: fn(&Account) -> &Figures| {
        accounts.iter().map(|a| f(a)).fold(Figures::default(), |a, b| Figures {
            frames: a.frames + b.frames,
            seconds: a.seconds + b.seconds,
            path_m: a.path_m + b.path_m,
        })
    };
    Sums {
        recorded: sum(|a| &a.recorded),
        before: sum(|a| &a.before),
        after: sum(|a| &a.after),
        fates: RefineReport::sum(accounts.iter().map(|a| &a.fates)),
        accepted: accounts.iter().filter(|a| a.verdict == Verdict::Accepted).count(),
    }
}

pub(crate) fn json(
    a: &Arguments,
    config: &Config,
    judge: Option<&Judge>,
    accounts: &[&Account],
    left_out: &[LeftOut],
    info: &Info,
) -> Value {
    let s = sums(accounts);
    let critic = judge.map(|j| json!({"folder": j.folder, "about": j.about}));
    json!({
        "dataset": a.dataset, "out": a.out, "fps": a.fps, "config": config,
        "episodes_in": accounts.len() + left_out.len(), "left_out": left_out, "episodes_accepted": s.accepted, "episodes_out": info.total_episodes,
        "frames_out": info.total_frames, "recorded": s.recorded, "before": s.before, "after": s.after,
        "fates": s.fates, "critic": critic, "episodes": accounts,
    })
}

/// The same in lines for a terminal.
pub(crate) fn text(accounts: &[&Account], left_out: &[LeftOut], judge: Option<&Judge>) -> String {
    let s = sums(accounts);
    let mut out = format!(
        "{} of {} recordings accepted\n{:>10} {:>8} {:>9} {:>8} {:>10}\n",
        s.accepted,
        accounts.len() + left_out.len(),
        "",
        "frames",
        "s",
        "path, m",
        "mean, m/s"
    );
    for (name, f) in [("recorded", &s.recorded), ("reversed", &s.before), ("refined", &s.after)] {
        out +=
            &format!("{name:>10} {:>8} {:>9.1} {:>8.2} {:>10.3}\n", f.frames, f.seconds, f.path_m, f.speed());
    }
    let f = &s.fates;
    out +=
        &format!("frames: {} kept, {} static, {} re-timed, of {}\n", f.kept, f.still, f.resampled, f.frames);
    if judge.is_some() {
        out += &format!(
            "critic: {} without progress, {} in short remainders, {} after the goal\n",
            f.low_advantage, f.too_short, f.after_goal
        );
    }
    for account in accounts.iter().filter(|a| a.verdict != Verdict::Accepted) {
        out += &format!("episode {}: {}\n", account.episode, account.verdict);
    }
    for broken in left_out {
        out += &format!("episode {}: left out, {}\n", broken.episode, broken.reason);
    }
    out
}

/// One page that needs nothing else.
pub(crate) fn html(
    a: &Arguments,
    config: &Config,
    judge: Option<&Judge>,
    accounts: &[&Account],
    left_out: &[LeftOut],
    info: &Info,
    pictures: &[String],
) -> Result<String> {
    let s = sums(accounts);
    let critic = judge.map_or(String::new(), |j| critic_rows(j, config, a.fps, &s.fates));
    let row = |name: &str, f: &Figures| {
        format!("<tr><th>{name}<td>{}<td>{:.1}<td>{:.2}<td>{:.3}", f.frames, f.seconds, f.path_m, f.speed())
    };
    let episode = |x: &&Account| {
        format!(
            "<tr><td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{} / {}",
            x.episode,
            escape(&x.verdict.to_string()),
            x.recorded.frames,
            x.before.frames,
            x.fates.kept,
            x.fates.still,
            x.fates.resampled,
            x.fates.low_advantage + x.fates.too_short + x.fates.after_goal,
            x.after.frames,
            x.gripper.0,
            x.gripper.1
        )
    };
    let broken = |x: &LeftOut| format!("<li>episode {}: {}", x.episode, escape(&x.reason));
    let broken = match left_out {
        [] => String::new(),
        some => format!("<h2>Left out</h2><ul>{}</ul>", some.iter().map(broken).collect::<String>()),
    };
    Ok(format!(
        "<!doctype html><meta charset=utf-8><title>Refinement</title><style>\
         body{{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em}}\
         table{{border-collapse:collapse}}th,td{{padding:.2em .8em;text-align:right;border-bottom:1px solid #ddd}}\
         pre{{background:#f4f6f8;padding:1em;overflow:auto}}svg{{width:100%;height:auto}}</style>\
         <h1>From easy recordings to hard demonstrations</h1>\
         <p>{} of {} recordings of <code>{}</code> accepted; {} episodes of {} frames at {} Hz written.</p>\
         <table><tr><th><th>frames<th>s<th>path, m<th>mean, m/s{}{}{}</table>\
         <p>Recorded: at the recording's rate. Reversed: at {} Hz, before any filter. Refined: as written.</p>\
         <h2>Why frames were left out</h2><table><tr><th>fate<th>frames<th>reason\
         <tr><th>kept<td>{}<td>a row of the new dataset, with its own image\
         <tr><th>static<td>{}<td>inside a run that stood still\
         <tr><th>re-timed<td>{}<td>inside a slow run, passed over when that was sped up{critic}\
         <tr><th>all<td>{}<td>frames of accepted recordings, reversed</table>\
         <p>Every frame: <code>frames.csv</code> beside this page.</p>\
         <h2>Episodes</h2><table><tr><th>episode<th>verdict<th>recorded<th>reversed<th>kept<th>static<th>re-timed\
         <th>critic<th>written<th>closes / opens{}</table>{broken}<h2>Pictures</h2>{}<h2>Values</h2><pre>{}</pre>\n",
        s.accepted,
        accounts.len() + left_out.len(),
        escape(&a.dataset.display().to_string()),
        info.total_episodes,
        info.total_frames,
        a.fps,
        row("recorded", &s.recorded),
        row("reversed", &s.before),
        row("refined", &s.after),
        a.fps,
        s.fates.kept,
        s.fates.still,
        s.fates.resampled,
        s.fates.frames,
        accounts.iter().map(episode).collect::<String>(),
        pictures.concat(),
        escape(&serde_json::to_string_pretty(config)?)
    ))
}

/// What the critic left out, and by which rule.
fn critic_rows(judge: &Judge, config: &Config, fps: f64, fates: &RefineReport) -> String {
    let (advantage, suffix) = (config.advantage_at(fps), config.suffix_at(fps));
    let about = &judge.about;
    let held = about.validation_loss.map_or("none held out".to_owned(), |v| format!("{v:.4} held out"));
    format!(
        "<tr><th>low advantage<td>{}<td>the critic saw too little progress: among the lowest {} % of all frames, in a run of \
         {} or more\
         <tr><th>too short<td>{}<td>in a remainder of fewer than {} frames between two of those\
         <tr><th>after the goal<td>{}<td>after the value had stayed at {} for {} frames{}\
         <tr><th>critic<td><td>{}: {} hard rollouts, {} successful; mean squared error {:.4} in training, {held}",
        fates.low_advantage,
        advantage.percentile,
        advantage.min_run,
        fates.too_short,
        advantage.min_run,
        fates.after_goal,
        suffix.value,
        suffix.frames,
        if suffix.enabled { "" } else { " (off)" },
        escape(&judge.folder.display().to_string()),
        about.rollouts,
        about.successes,
        about.train_loss
    )
}

pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
