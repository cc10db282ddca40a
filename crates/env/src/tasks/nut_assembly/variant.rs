//! Shapes and places of the three nuts.

use crate::expert::draw;
use e2h_core::Rng;
use rand::Rng as _;
use std::f64::consts::{PI, TAU};
use std::fmt::Write as _;

/// Half the thickness of every nut, m.
pub(super) const NUT_HALF_HEIGHT: f64 = 0.01;
/// Top of every peg, m above the table.
pub(super) const PEG_TOP: f64 = 0.13;
const PEG_HALF_LENGTH: f64 = 0.1;
const ROUND_PEG_RADIUS: f64 = 0.015;
const SQUARE_PEG_HALF_WIDTH: f64 = 0.016;
/// Share of the free play that resets on the peg use: the rest keeps them clear of the walls.
const PLAY: f64 = 0.95;

/// Names of the variants, the default first.
pub(super) const VARIANTS: [&str; 3] = ["loose", "round", "square"];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    Round,
    Square,
}

/// How the nut is turned in starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Yaw {
    /// Handle towards the robot.
    Fixed,
    /// Any way, on the table and on the peg.
    Uniform,
    /// Any way on the table, in quarter turns on the peg.
    Quarters,
}

/// One nut, its peg and its start box. Lengths in m, in the frame of the robot's base.
#[derive(Debug)]
pub(super) struct Variant {
    pub(super) name: &'static str,
    shape: Shape,
    /// Half sizes of a ring segment: across the wall, along it.
    segment: [f64; 2],
    /// Distance of the segments' centres from the middle.
    ring: f64,
    handle_half_length: f64,
    handle_at: f64,
    /// Where along the handle it is held: far enough out that the hand clears the peg.
    pub(super) grip_at: f64,
    pub(super) peg: [f64; 2],
    pub(super) start_x: [f64; 2],
    pub(super) start_y: [f64; 2],
    pub(super) yaw: Yaw,
    /// Spread of the yaw with which nuts end up on the peg, rad to each side.
    pub(super) peg_yaw: f64,
    pub(super) home: [f64; 3],
    /// Largest distance of a nut that is on its peg.
    pub(super) seat_xy: f64,
    /// How far from the middle the demonstrators pass the peg's top, standard deviation; small against the free play.
    pub(super) entry: f64,
}

/// The round nut of the released TR-DRL scene: twice robosuite's, over a 30 mm peg.
const LOOSE: Variant = Variant {
    name: "loose",
    shape: Shape::Round,
    segment: [0.0225, 0.045],
    ring: 0.0849,
    handle_half_length: 0.04525,
    handle_at: 0.14,
    grip_at: 0.14,
    peg: [0.76, -0.1],
    start_x: [0.46, 0.56],
    start_y: [-0.2, -0.1],
    yaw: Yaw::Fixed,
    peg_yaw: 0.1,
    home: [0.48, -0.12, 0.24],
    seat_xy: 0.05,
    entry: 0.003,
};

/// robosuite's round nut.
const ROUND: Variant = Variant {
    name: "round",
    segment: [0.01125, 0.0225],
    ring: 0.04245,
    handle_half_length: 0.02525,
    handle_at: 0.06,
    grip_at: 0.068,
    peg: [0.66, -0.1],
    start_x: [0.445, 0.45],
    start_y: [-0.225, -0.11],
    yaw: Yaw::Uniform,
    home: [0.50, -0.14, 0.24],
    seat_xy: 0.03,
    ..LOOSE
};

/// robosuite's square nut and square peg.
const SQUARE: Variant = Variant {
    name: "square",
    shape: Shape::Square,
    segment: [0.0105, 0.04375],
    ring: 0.03325,
    handle_half_length: 0.02525,
    handle_at: 0.054,
    grip_at: 0.066,
    peg: [0.66, 0.1],
    start_x: [0.445, 0.45],
    start_y: [0.11, 0.225],
    yaw: Yaw::Quarters,
    home: [0.50, 0.14, 0.24],
    seat_xy: 0.03,
    entry: 0.0015,
    ..LOOSE
};

static ALL: [Variant; 3] = [LOOSE, ROUND, SQUARE];

impl Variant {
    /// The variant of a name; the default for an unknown one (the registry has checked it).
    pub(super) fn named(name: &str) -> &'static Self {
        ALL.iter().find(|v| v.name == name).unwrap_or(&ALL[0])
    }

    /// Bodies of nut and peg, MJCF.
    pub(super) fn bodies(&self) -> String {
        let [thick, long] = self.segment;
        let h = NUT_HALF_HEIGHT;
        let brass = r#"rgba=".93 .72 .12 1""#;
        let mut ring = String::new();
        let mut segment = |size: [f64; 2], at: [f64; 2], turn: f64| {
            // Writing into a String cannot fail.
            let _ = writeln!(
                ring,
                r#"<geom class="object" type="box" density="100" size="{} {} {h}" pos="{} {} 0" euler="0 0 {turn}" {brass}/>"#,
                size[0], size[1], at[0], at[1]
            );
        };
        match self.shape {
            Shape::Round => {
                for k in 0..8 {
                    let turn = f64::from(k) * TAU / 8.0;
                    segment([thick, long], [self.ring * turn.cos(), self.ring * turn.sin()], turn);
                }
            }
            Shape::Square => {
                let short = 0.03125; // robosuite's: the walls overlap at the corners
                for sign in [1.0, -1.0] {
                    segment([thick, long], [sign * self.ring, 0.0], 0.0);
                    segment([short, thick], [0.0, sign * self.ring], 0.0);
                }
            }
        }
        let feet: String = (0..6)
            .map(|k| {
                let turn = f64::from(k) * TAU / 6.0 + PI / 6.0;
                let r = self.ring;
                format!(r#"<geom class="foot" size="{h}" pos="{} {} 0"/>"#, r * turn.cos(), r * turn.sin())
            })
            .chain([format!(
                r#"<geom class="foot" size="{h}" pos="{} 0 0"/>"#,
                self.handle_at + self.handle_half_length - h
            )])
            .collect();
        let [px, py] = self.peg;
        let pz = PEG_TOP - PEG_HALF_LENGTH;
        let peg = match self.shape {
            Shape::Round => format!(r#"type="cylinder" size="{ROUND_PEG_RADIUS} {PEG_HALF_LENGTH}""#),
            Shape::Square => {
                format!(
                    r#"type="box" size="{SQUARE_PEG_HALF_WIDTH} {SQUARE_PEG_HALF_WIDTH} {PEG_HALF_LENGTH}""#
                )
            }
        };
        format!(
            r#"<body name="nut" pos="{} {} {h}"><freejoint name="nut"/>{ring}{feet}
              <geom class="object" type="box" density="100" size="{} 0.015875 {h}" pos="{} 0 0" rgba=".85 .22 .15 1"/>
            </body>
            <body name="peg" pos="{px} {py} {pz}"><geom name="peg" class="fixture" {peg} rgba=".13 .25 .60 1"/></body>"#,
            self.start_x[0], self.start_y[0], self.handle_half_length, self.handle_at
        )
    }

    /// Distance from the peg's middle beyond which the nut's ring lies beside the peg, m.
    pub(super) fn reach(&self) -> f64 {
        self.ring + self.segment[0] + 2.0 * SQUARE_PEG_HALF_WIDTH
    }

    /// How the nut is turned at a start of the hard task, rad.
    pub(super) fn start_yaw(&self, rng: &mut Rng) -> f64 {
        match self.yaw {
            Yaw::Fixed => PI,
            Yaw::Uniform | Yaw::Quarters => TAU * rng.random::<f64>(),
        }
    }

    /// Offset of a nut on its peg, uniform over the free play that it has at a yaw.
    pub(super) fn offset(&self, yaw: f64, rng: &mut Rng) -> [f64; 2] {
        let inner = self.ring - self.segment[0];
        match self.shape {
            Shape::Round => {
                let radius = (inner - ROUND_PEG_RADIUS) * PLAY * rng.random::<f64>().sqrt();
                let angle = TAU * rng.random::<f64>();
                [radius * angle.cos(), radius * angle.sin()]
            }
            Shape::Square => {
                // In the nut's frame the peg's corners reach this far; the frame then turns with the nut.
                let reach = SQUARE_PEG_HALF_WIDTH * (yaw.cos().abs() + yaw.sin().abs());
                let play = ((inner - reach) * PLAY).max(0.0);
                let [a, b] = [draw(rng, [-play, play]), draw(rng, [-play, play])];
                [a * yaw.cos() - b * yaw.sin(), a * yaw.sin() + b * yaw.cos()]
            }
        }
    }
}
