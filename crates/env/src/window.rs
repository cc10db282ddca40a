//! MuJoCo's own window, which shows a scene and tells which keys are touched.

use crate::{Error, Result, Sim};
use mujoco_rs::prelude::{MjData, MjModel, MjtState};
use mujoco_rs::viewer::{MjViewer, egui};
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

const STATE: u32 = MjtState::mjSTATE_INTEGRATION as u32;

/// A key that went down (true) or was let go, by its name; a window that is no longer looked at lets go of everything.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    /// A key, for example `W`, `Space`, `Left` or `Shift`, and whether it is down.
    Is(&'static str, bool),
    /// Nothing is held any more.
    None,
}

/// A panel of words in the window.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Panel {
    /// Lines in large letters.
    pub head: Vec<String>,
    /// Whether they tell something good.
    pub good: bool,
    /// A line below.
    pub note: String,
    /// A table of two columns.
    pub rows: Vec<[String; 2]>,
}

/// What the window's user interface and its owner share.
#[derive(Default)]
struct Shared {
    keys: Vec<Key>,
    shift: bool,
    focused: bool,
    panel: Panel,
}

/// A window on a simulation. What is done in it with the mouse, or with MuJoCo's own keys, changes what is seen and never the simulation.
pub struct Window {
    viewer: MjViewer,
    /// What is shown: a copy, because the viewer writes into what it is given.
    shown: MjData<Arc<MjModel>>,
    shared: Rc<RefCell<Shared>>,
}

impl Window {
    /// Opens it. Only the main thread can.
    ///
    /// # Errors
    /// When there is no display, or no OpenGL.
    pub fn open(sim: &Sim, title: &str) -> Result<Self> {
        let mut model = (*sim.model).clone();
        // From behind the robot's right shoulder: away from it is away from whoever looks.
        let vis = model.vis_mut();
        (vis.global.azimuth, vis.global.elevation) = (28.0, -32.0);
        // Shadows show how high the hand is; sharp ones take ten times as long where a CPU draws.
        vis.quality.shadowsize = 1024;
        (vis.quality.numslices, vis.quality.numstacks) = (16, 8);
        let stat = model.stat_mut();
        (stat.center, stat.extent) = ([0.5, 0.0, 0.12], 0.75);
        let failed = |what: &str, e: &dyn std::error::Error| {
            let cause = e.source().map_or(String::new(), |c| format!(": {c}"));
            Error::Window(format!("{what}{cause}"))
        };
        let builder = MjViewer::builder().window_name(title.to_owned());
        let mut viewer = builder.build_passive(&model).map_err(|e| failed(&e.to_string(), &e))?;
        let shared = Rc::new(RefCell::new(Shared { focused: true, ..Shared::default() }));
        let inner = shared.clone();
        viewer.add_ui_callback(move |ui, _| {
            let mut shared = inner.borrow_mut();
            listen(ui, &mut shared);
            draw(ui, &shared.panel);
        });
        Ok(Self { viewer, shown: MjData::new(Arc::new(model)), shared })
    }

    /// False once it was closed.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.viewer.running()
    }

    /// Shows the simulation as it is, with words over it; returns what was touched since the last time.
    ///
    /// # Errors
    /// When OpenGL fails.
    pub fn show(&mut self, sim: &Sim, panel: Panel) -> Result<Vec<Key>> {
        let state = sim.data.state(STATE);
        self.shown.set_state(&state, STATE).map_err(|e| Error::MuJoCo(e.to_string()))?;
        self.shown.forward();
        self.shared.borrow_mut().panel = panel;
        self.viewer.sync_data(&mut self.shown);
        self.viewer.render().map_err(|e| Error::Window(e.to_string()))?;
        Ok(std::mem::take(&mut self.shared.borrow_mut().keys))
    }
}

/// Takes down what was touched.
fn listen(ui: &egui::Ui, shared: &mut Shared) {
    let context = ui.ctx().clone();
    // Somebody is typing into a field of the viewer's own panel.
    let typing = context.memory(|m| m.focused().is_some());
    context.input(|input| {
        for event in &input.events {
            if let egui::Event::Key { key, pressed, repeat: false, .. } = event
                && !(typing && *pressed)
            {
                shared.keys.push(Key::Is(key.name(), *pressed));
            }
        }
        if input.modifiers.shift != shared.shift {
            shared.shift = input.modifiers.shift;
            shared.keys.push(Key::Is("Shift", shared.shift));
        }
        if shared.focused && !input.focused {
            shared.keys.push(Key::None);
        }
        shared.focused = input.focused;
    });
}

fn draw(ui: &egui::Ui, panel: &Panel) {
    let window = egui::Window::new("Recording").anchor(egui::Align2::RIGHT_TOP, [-8.0, 8.0]).resizable(false);
    window.show(ui.ctx(), |ui| {
        let colour = if panel.good { egui::Color32::LIGHT_GREEN } else { ui.visuals().strong_text_color() };
        for line in &panel.head {
            ui.label(egui::RichText::new(line).size(18.0).color(colour));
        }
        ui.label(&panel.note);
        ui.separator();
        egui::Grid::new("controls").num_columns(2).show(ui, |ui| {
            for [name, words] in &panel.rows {
                ui.monospace(name);
                ui.label(words);
                ui.end_row();
            }
        });
    });
}
