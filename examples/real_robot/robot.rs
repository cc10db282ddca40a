//! A robot that the framework knows nothing of: millimetres, its own order of numbers, 30 Hz, a camera of 48 x 64 pixels.
//!
//! A gantry with a two-finger gripper stands over a table with a socket. The plug is in the socket or lies on the table.

use auto_e2h::core::Image;

/// Control steps a second, Hz.
pub(crate) const HZ: f64 = 30.0;
/// Rows and columns of the camera.
pub(crate) const IMAGE: (usize, usize) = (48, 64);
/// Jaws when open, mm.
pub(crate) const OPEN: f64 = 80.0;
/// Where the socket is, mm.
pub(crate) const SOCKET: [f64; 2] = [300.0, 0.0];
/// Where the hand begins, mm.
pub(crate) const HOME: [f64; 3] = [300.0, 0.0, 150.0];

/// Fastest motion of the hand and of its jaws, mm/s.
const SPEED: f64 = 250.0;
const JAW_SPEED: f64 = 250.0;
/// Width of the plug, mm.
const PLUG: f64 = 18.0;
/// How far from the middle of the jaws the plug may be to be grasped, mm.
const REACH: f64 = 12.0;
/// Play round the plug in the socket, mm to each side; beyond it the plug stands on the socket's rim.
const PLAY: f64 = 5.0;
/// Half the side of the socket's block and its height, mm.
const BLOCK: (f64, f64) = (30.0, 20.0);

/// Hand, jaws and plug; all in mm.
#[derive(Debug, Clone)]
pub(crate) struct Robot {
    pub(crate) hand: [f64; 3],
    pub(crate) jaw: f64,
    pub(crate) plug: [f64; 3],
    /// How far below the hand the plug is that it holds.
    held: Option<f64>,
}

impl Robot {
    /// The hand at home, the plug at `plug` (x, y) on the table or in the socket.
    pub(crate) fn new(plug: [f64; 2]) -> Self {
        Self { hand: HOME, jaw: OPEN, plug: [plug[0], plug[1], 0.0], held: None }
    }

    /// What its driver reports: jaws, then z, y, x of the hand, then y, x of the plug by a tracker.
    ///
    /// # Units
    /// mm
    pub(crate) fn state(&self) -> [f32; 6] {
        let ([x, y, z], p) = (self.hand, self.plug);
        // The driver reports 32 bits.
        [self.jaw, z, y, x, p[1], p[0]].map(|v| v as f32)
    }

    /// One control step towards a goal (x, y, z and jaws, mm).
    pub(crate) fn step(&mut self, goal: [f64; 3], jaw: f64) {
        let most = SPEED / HZ;
        let way: [f64; 3] = std::array::from_fn(|i| goal[i] - self.hand[i]);
        let length = way.iter().map(|v| v * v).sum::<f64>().sqrt();
        let share = if length > most { most / length } else { 1.0 };
        for (v, w) in self.hand.iter_mut().zip(way) {
            *v += w * share;
        }
        self.hand[2] = self.hand[2].max(5.0);
        self.jaw += (jaw.clamp(0.0, OPEN) - self.jaw).clamp(-JAW_SPEED / HZ, JAW_SPEED / HZ);
        let offset: [f64; 3] = std::array::from_fn(|i| self.plug[i] - self.hand[i]);
        if self.jaw > PLUG + 2.0 {
            self.held = None;
        } else if self.held.is_none() && offset[0].hypot(offset[1]) < REACH && offset[2].abs() < 25.0 {
            self.held = Some(offset[2]);
        }
        if let Some(below) = self.held {
            // It cannot close further than the plug is wide.
            self.jaw = self.jaw.max(PLUG);
            let down = self.in_hole() && self.plug[2] < BLOCK.1;
            for (i, socket) in SOCKET.into_iter().enumerate() {
                // Jaws with a notch for round plugs bring it to their middle. The socket's walls hold it until it is out.
                let free = if down { PLAY } else { f64::INFINITY };
                self.plug[i] = self.hand[i].clamp(socket - free, socket + free);
            }
            self.plug[2] = (self.hand[2] + below).max(if down { 0.0 } else { self.floor() });
        } else {
            self.plug[2] = (self.plug[2] - 20.0).max(self.floor());
        }
    }

    fn off_socket(&self) -> [f64; 2] {
        [self.plug[0] - SOCKET[0], self.plug[1] - SOCKET[1]]
    }

    fn in_hole(&self) -> bool {
        self.off_socket().iter().all(|d| d.abs() <= PLAY)
    }

    /// What the plug would stand on.
    fn floor(&self) -> f64 {
        let on_block = self.off_socket().iter().all(|d| d.abs() < BLOCK.0 + PLUG / 2.0);
        if on_block && !self.in_hole() { BLOCK.1 } else { 0.0 }
    }

    /// The plug is in the socket, and the hand has let go of it and gone up.
    pub(crate) fn plugged_in(&self) -> bool {
        self.in_hole() && self.plug[2] < 1.0 && self.free()
    }

    /// The plug lies on the table, away from the socket, and the hand has let go of it and gone up.
    pub(crate) fn unplugged(&self) -> bool {
        let [x, y] = self.off_socket();
        x.hypot(y) > 70.0 && self.plug[2] < 1.0 && self.free()
    }

    fn free(&self) -> bool {
        self.held.is_none() && self.jaw > 0.6 * OPEN && self.hand[2] > 60.0
    }

    /// The picture of a camera above the table: socket grey, plug red, the hand a blue frame that is larger the higher it is.
    ///
    /// # Shapes
    /// (48, 64, 3)
    pub(crate) fn image(&self) -> Image {
        let (rows, columns) = IMAGE;
        let mut pixels: Vec<u8> = [222, 216, 205].repeat(rows * columns);
        let mut square = |x: f64, y: f64, half: f64, hole: f64, colour: [u8; 3]| {
            for row in 0..rows {
                for column in 0..columns {
                    let px = 120.0 + (row as f64 + 0.5) * 360.0 / rows as f64;
                    let py = -240.0 + (column as f64 + 0.5) * 480.0 / columns as f64;
                    let far = (px - x).abs().max((py - y).abs());
                    if far <= half && far >= hole {
                        pixels[(row * columns + column) * 3..][..3].copy_from_slice(&colour);
                    }
                }
            }
        };
        square(SOCKET[0], SOCKET[1], BLOCK.0, 0.0, [120, 120, 126]);
        square(SOCKET[0], SOCKET[1], 14.0, 0.0, [40, 40, 44]);
        square(self.plug[0], self.plug[1], 15.0, 0.0, [196, 48, 40]);
        let size = 18.0 + 0.12 * self.hand[2];
        square(self.hand[0], self.hand[1], size, size - 9.0, [40, 72, 190]);
        Image { height: rows, width: columns, data: pixels }
    }
}
