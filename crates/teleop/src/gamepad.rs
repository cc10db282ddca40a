//! Gamepads: their buttons and sticks as events.

use crate::controls::{Event, Sticks, button};
use gilrs::{Axis, EventType, Gilrs};

/// All gamepads that are plugged in, as one.
pub struct Gamepads {
    gilrs: Option<Gilrs>,
    sticks: Sticks,
}

impl Default for Gamepads {
    fn default() -> Self {
        Self::new()
    }
}

impl Gamepads {
    /// Looks for gamepads; later ones are found when they are plugged in. Where the system has no way to, there are none.
    #[must_use]
    pub fn new() -> Self {
        Self { gilrs: Gilrs::new().ok(), sticks: Sticks::default() }
    }

    /// Names of those that are plugged in.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        self.gilrs.iter().flat_map(Gilrs::gamepads).map(|(_, pad)| e2h_core::one_line(pad.name())).collect()
    }

    /// What was touched since the last time.
    pub fn poll(&mut self) -> Vec<Event> {
        let mut events = vec![];
        let Some(gilrs) = &mut self.gilrs else { return events };
        let before = self.sticks;
        while let Some(gilrs::Event { event, .. }) = gilrs.next_event() {
            match event {
                EventType::ButtonPressed(name, _) => {
                    events.extend(button(&format!("{name:?}")).map(Event::Press));
                }
                EventType::ButtonReleased(name, _) => {
                    events.extend(button(&format!("{name:?}")).map(Event::Release));
                }
                EventType::AxisChanged(axis, value, _) => {
                    let value = f64::from(value);
                    // Sticks are positive up and to the right; the robot's left is positive, and turning left is.
                    match axis {
                        Axis::LeftStickY => self.sticks.forward = value,
                        Axis::LeftStickX => self.sticks.left = -value,
                        Axis::RightStickY => self.sticks.up = value,
                        Axis::RightStickX => self.sticks.turn = -value,
                        _ => {}
                    }
                }
                EventType::Disconnected => {
                    self.sticks = Sticks::default();
                    events.push(Event::ReleaseAll);
                }
                _ => {}
            }
        }
        if self.sticks != before {
            events.push(Event::Sticks(self.sticks));
        }
        events
    }
}
