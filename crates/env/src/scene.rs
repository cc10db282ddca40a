//! Puts a task's bodies and cameras into the robot's scene.

use nalgebra::Vector3;

const PANDA: &str = include_str!("../assets/panda.xml");

/// A fixed camera called `table`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TableCamera {
    /// Where it stands, m.
    pub position: [f64; 3],
    /// What it looks at, m.
    pub target: [f64; 3],
    /// Vertical field of view, degrees.
    pub fovy: f64,
}

impl Default for TableCamera {
    /// From the far side of the table, over the middle of what the arm reaches.
    fn default() -> Self {
        Self { position: [1.02, 0.26, 0.50], target: [0.55, 0.015, 0.04], fovy: 29.0 }
    }
}

/// The robot's scene (MJCF) with the bodies of a task (`bodies`, MJCF elements of the world body), the fixed camera
/// `table` and the camera `wrist` on the hand.
#[must_use]
pub fn compose(bodies: &str, camera: &TableCamera) -> String {
    cameras(PANDA, camera).replace("<!--TASK-->", bodies)
}

/// The scene at half the physics step and twice the contact stiffness, for tasks whose held part meets a fixture at speed: a
/// contact sinks in by about its speed times its time constant over e, and the time constant may not be below two steps.
#[must_use]
pub fn finer(scene: &str) -> String {
    scene
        .replace(r#"timestep="0.002""#, r#"timestep="0.001""#)
        .replace(r#"solref="0.004 1""#, r#"solref="0.002 1""#)
}

/// A scene of two arms without grippers, with tools (MJCF elements of the hand's body, where z points out of the flange)
/// instead. The first arm has the camera `wrist`, and its tool the site `tcp`; the second stands at `base`, m, and its names
/// begin with `second_`.
pub(crate) fn compose_two_arms(
    tools: [&str; 2],
    base: [f64; 3],
    bodies: &str,
    camera: &TableCamera,
) -> String {
    let bare = without(PANDA, "gripper");
    let mut parts = sections(&bare, "arm").map(|text| {
        let text = text.replace("name=\"", "name=\"second_").replace("joint=\"", "joint=\"second_");
        text.replace("<!--WRIST-->", "").replace("<!--TOOL-->", tools[1])
    });
    let [body, actuators] = [parts.next(), parts.next()].map(Option::unwrap_or_default);
    let [x, y, z] = base;
    let second = format!(r#"<body name="second_base" pos="{x} {y} {z}">{body}</body>{bodies}"#);
    let scene = cameras(&bare, camera).replace("<!--TOOL-->", tools[0]);
    scene.replace("<!--TASK-->", &second).replace("<!--ACTUATORS-->", &actuators)
}

/// What stands between each pair of markers of a name.
fn sections<'a>(text: &'a str, name: &str) -> impl Iterator<Item = &'a str> {
    let end = format!("<!--/{name}-->");
    text.split(&*format!("<!--{name}-->"))
        .skip(1)
        .filter_map(move |rest| rest.split_once(&*end).map(|(section, _)| section))
        .collect::<Vec<_>>()
        .into_iter()
}

/// The text without those sections.
fn without(text: &str, name: &str) -> String {
    sections(text, name).fold(text.to_owned(), |text, section| text.replace(section, ""))
}

fn cameras(text: &str, camera: &TableCamera) -> String {
    let table = camera_xml("table", camera.position, camera.target, [0.0, 0.0, 1.0], camera.fovy);
    // In the frame of the hand z points to the fingertips and x forward. The camera hangs in front of the hand, so that the
    // fingertips are at the lower edge of the image and what they hold above them.
    let wrist = camera_xml("wrist", [0.11, 0.0, -0.03], [0.086, 0.0, 0.2], [1.0, 0.0, 0.0], 84.0);
    text.replace("<!--CAMERAS-->", &table).replace("<!--WRIST-->", &wrist)
}

/// A camera element that looks from `position` at `target` with `up` upwards in the image.
fn camera_xml(name: &str, position: [f64; 3], target: [f64; 3], up: [f64; 3], fovy: f64) -> String {
    let [eye, target, up] = [position, target, up].map(Vector3::from);
    let back = (eye - target).normalize();
    let right = up.cross(&back).normalize();
    let up = back.cross(&right);
    format!(
        r#"<camera name="{name}" pos="{} {} {}" xyaxes="{} {} {} {} {} {}" fovy="{fovy}"/>"#,
        eye.x, eye.y, eye.z, right.x, right.y, right.z, up.x, up.y, up.z
    )
}
