//! What the paper reports, to stand beside our numbers.

/// Trials of a method on a suite, as the paper has them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Figure {
    /// Method, by our name for it.
    pub method: &'static str,
    /// Successes of the initial policy; none where the paper gives one only for its own method.
    pub initial: Option<usize>,
    /// Successes of the last policy.
    pub last: usize,
    /// Trials of each.
    pub trials: usize,
}

/// Pairs whose trials the paper pools.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Suite {
    /// Its name.
    pub name: &'static str,
    /// Its pairs.
    pub tasks: &'static [&'static str],
    /// What the paper reports of it.
    pub paper: &'static [Figure],
}

const fn figure(method: &'static str, initial: Option<usize>, last: usize, trials: usize) -> Figure {
    Figure { method, initial, last, trials }
}

/// The paper's three suites. The third was real robots there, and is simulated here.
const SUITES: [Suite; 3] = [
    Suite {
        name: "robosuite",
        tasks: &["nut_assembly", "peg_insertion"],
        paper: &[figure("auto-e2h", Some(0), 85, 100), figure("tr-drl", None, 68, 100)],
    },
    Suite {
        name: "Isaac",
        tasks: &["cube_pick_place", "cube_stack", "cylinder_pick_place", "rod_insertion"],
        paper: &[
            figure("auto-e2h", Some(53), 154, 160),
            figure("direct-h", None, 26, 160),
            figure("no-critic", None, 71, 160),
            figure("no-kinematic", None, 45, 160),
            figure("recap", None, 79, 160),
            figure("tr-drl-dp", None, 20, 160),
        ],
    },
    Suite {
        name: "real, simulated here",
        tasks: &["brush", "disk", "mouse", "test_tube"],
        paper: &[
            figure("auto-e2h", Some(32), 56, 80),
            figure("recap", None, 14, 80),
            figure("tr-drl-dp", None, 20, 80),
        ],
    },
];

/// What demonstrations cost in the paper, and what became of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cost {
    /// Seconds an easy demonstration.
    pub easy_s: f64,
    /// Seconds a hard one.
    pub hard_s: f64,
    /// Success of the paper's method, from easy demonstrations, per cent.
    pub ours: u8,
    /// Success of a policy from hard ones, per cent.
    pub hard: u8,
}

/// The row of a pair; none for pairs that the paper's table does not have.
///
/// # Source
/// The paper's table of collection costs.
#[must_use]
pub fn cost(task: &str) -> Option<Cost> {
    let (easy_s, hard_s, ours, hard) = match task {
        "disk" => (19.5, 41.5, 65, 50),
        "mouse" => (24.1, 54.7, 70, 60),
        "test_tube" => (19.6, 39.1, 75, 55),
        "brush" => (19.0, 62.8, 70, 60),
        _ => return None,
    };
    Some(Cost { easy_s, hard_s, ours, hard })
}

/// The suite that a pair is of; none for pairs that the paper does not have.
///
/// # Source
/// The paper's tables and figures of success, counts recomputed from its percentages.
#[must_use]
pub fn suite(task: &str) -> Option<&'static Suite> {
    SUITES.iter().find(|s| s.tasks.contains(&task))
}

/// All suites.
pub(super) fn suites() -> &'static [Suite] {
    &SUITES
}
