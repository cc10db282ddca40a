//! What there is to steer with, and which keys and buttons do it.

/// Something that a person does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Control {
    /// Held: away from the robot, x.
    Forward,
    /// Held: towards the robot.
    Back,
    /// Held: to the robot's left, y.
    Left,
    /// Held: to its right.
    Right,
    /// Held: up, z.
    Up,
    /// Held: down.
    Down,
    /// Held: the hand turns counter-clockwise, seen from above.
    TurnLeft,
    /// Held: clockwise.
    TurnRight,
    /// Held: a quarter of the speed.
    Slow,
    /// Held: straight up, then to where the hand began.
    Home,
    /// Opens or closes the gripper.
    Gripper,
    /// Begins a take from a new start.
    Record,
    /// Ends a take that has succeeded, and saves it.
    Save,
    /// Throws a take away.
    Discard,
    /// Another start, to look at or to practise on.
    Reset,
}

/// How far the sticks of a gamepad are pushed, each from -1 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sticks {
    /// Away from the robot.
    pub forward: f64,
    /// To the robot's left.
    pub left: f64,
    /// Up.
    pub up: f64,
    /// Counter-clockwise, seen from above.
    pub turn: f64,
}

/// A change of what is touched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Event {
    /// A key or button went down. Once more without having been let go is no second press.
    Press(Control),
    /// It was let go.
    Release(Control),
    /// Where the sticks are now.
    Sticks(Sticks),
    /// Everything was let go: the window is no longer looked at, or the gamepad was unplugged.
    ReleaseAll,
}

/// A control, and what it is reached with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Binding {
    /// What it does.
    pub control: Control,
    /// Names of its keys. Those that MuJoCo's viewer has for itself are not among them.
    pub keys: &'static [&'static str],
    /// The button of a gamepad, or its stick; empty for none.
    pub button: &'static str,
    /// The same in words.
    pub words: &'static str,
}

const fn bind(
    control: Control,
    keys: &'static [&'static str],
    button: &'static str,
    words: &'static str,
) -> Binding {
    Binding { control, keys, button, words }
}

/// All controls, in the order in which they are told.
pub const BINDINGS: [Binding; 15] = [
    bind(Control::Forward, &["W"], "left stick", "away from the robot"),
    bind(Control::Back, &["S"], "left stick", "towards the robot"),
    bind(Control::Left, &["A"], "left stick", "to the robot's left"),
    bind(Control::Right, &["D"], "left stick", "to its right"),
    bind(Control::Up, &["Up", "R"], "right stick", "up"),
    bind(Control::Down, &["Down", "F"], "right stick", "down"),
    bind(Control::TurnLeft, &["Left", "Q"], "right stick", "turn left"),
    bind(Control::TurnRight, &["Right", "V"], "right stick", "turn right"),
    bind(Control::Slow, &["Shift"], "LeftTrigger", "slowly"),
    bind(Control::Home, &["G"], "RightTrigger", "up and home"),
    bind(Control::Gripper, &["Space"], "South", "open or close"),
    bind(Control::Record, &["B"], "Start", "record a take"),
    bind(Control::Save, &["Enter"], "North", "save it"),
    bind(Control::Discard, &["Delete"], "East", "discard it"),
    bind(Control::Reset, &["N"], "Select", "another start"),
];

/// What a key does, by its name.
#[must_use]
pub fn key(name: &str) -> Option<Control> {
    BINDINGS.iter().find(|b| b.keys.contains(&name)).map(|b| b.control)
}

/// What a button of a gamepad does, by its name.
#[must_use]
pub fn button(name: &str) -> Option<Control> {
    BINDINGS.iter().find(|b| b.button == name && !name.contains(' ')).map(|b| b.control)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn the_table_for_people_is_this_one() {
        let table: Vec<String> = BINDINGS
            .iter()
            .map(|b| format!("| {} | {} | {} |", b.keys.join(" "), b.button, b.words))
            .collect();
        assert!(include_str!("../README.md").contains(&table.join("\n")), "{}", table.join("\n"));
    }

    #[test]
    fn no_key_means_two_things_and_none_is_the_viewers() {
        let keys: Vec<&str> = BINDINGS.iter().flat_map(|b| b.keys.iter().copied()).collect();
        assert_eq!(keys.iter().collect::<BTreeSet<_>>().len(), keys.len());
        for taken in ["C", "U", "J", "M", "H", "Z", "T", "I", "E", "X", "Escape", "Backspace", "[", "]", "F1"]
        {
            assert_eq!(key(taken), None, "{taken}");
        }
        let controls: BTreeSet<Control> = BINDINGS.iter().map(|b| b.control).collect();
        assert_eq!(controls.len(), BINDINGS.len());
        assert_eq!((key("W"), button("South")), (Some(Control::Forward), Some(Control::Gripper)));
        assert_eq!((key("w"), button("left stick")), (None, None));
    }
}
