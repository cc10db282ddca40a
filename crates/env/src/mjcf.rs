//! Pieces of scenes, MJCF.

use std::f64::consts::TAU;
use std::fmt::Write as _;

/// A wall round an upright hole, of boxes: its inside is a regular polygon whose sides are `apothem` from the middle.
pub(crate) struct Ring<'a> {
    /// Class and colour of every box, attributes.
    pub(crate) look: &'a str,
    /// Sides.
    pub(crate) sides: u32,
    /// Distance of the inner sides from the middle, m.
    pub(crate) apothem: f64,
    /// Thickness of the wall, m.
    pub(crate) thickness: f64,
    /// Half its height, m.
    pub(crate) half_height: f64,
    /// Height of its middle, m.
    pub(crate) z: f64,
}

impl Ring<'_> {
    /// The boxes, elements of a body.
    pub(crate) fn geoms(&self) -> String {
        let Self { look, sides, apothem, thickness, half_height, z } = *self;
        let mut text = String::new();
        let step = TAU / f64::from(sides);
        // Long enough for the outer corners to meet: neighbours overlap inside the wall.
        let half_length = (apothem + thickness) * (step / 2.0).tan();
        for k in 0..sides {
            let angle = f64::from(k) * step;
            let at = apothem + thickness / 2.0;
            // Writing into a String cannot fail.
            let _ = writeln!(
                text,
                r#"<geom {look} type="box" size="{} {half_length} {half_height}" pos="{} {} {z}" euler="0 0 {angle}"/>"#,
                thickness / 2.0,
                at * angle.cos(),
                at * angle.sin()
            );
        }
        text
    }
}

/// Small invisible balls in a circle, which a round thing stands on: a cylinder would meet a box in a single point.
pub(crate) fn feet(count: u32, circle: f64, ball: f64, bottom: f64) -> String {
    let step = TAU / f64::from(count);
    (0..count)
        .map(|k| {
            let (x, y) = (circle * (f64::from(k) * step).cos(), circle * (f64::from(k) * step).sin());
            // Feet meet the table as feet and fixtures as objects do.
            format!(r#"<geom class="foot" contype="10" solimp="0.98 0.9995 0.0005" size="{ball}" pos="{x} {y} {}"/>"#, bottom + ball)
        })
        .collect()
}
