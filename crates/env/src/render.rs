//! A CPU ray caster over the model's geoms: no graphics library, and the same bytes on every thread. It draws planes,
//! spheres, capsules, ellipsoids, cylinders and boxes; only additions, products, quotients and square roots touch a pixel.

mod shape;

use crate::{Error, Result};
use e2h_core::Image;
use mujoco_rs::prelude::{MjData, MjModel, MjtObjBase};
use shape::{Shape, V, add, dot, normal};
use std::sync::Arc;

/// How a picture is lit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Style {
    /// Hard shadows of the sun; off in the images that policies see.
    pub shadows: bool,
}

const SUN: V = [0.25, -0.45, 0.857]; // direction to the sun, unit length to three digits
const AMBIENT: f32 = 0.34;
const HEADLIGHT: f32 = 0.30;
const SUNLIGHT: f32 = 0.48;
const SKY: V = [0.62, 0.70, 0.80];
const FAR: f32 = 1e9;

/// Longest side of a picture, pixels.
pub const MOST_PIXELS: usize = 4096;

/// Buffers that are reused from frame to frame.
#[derive(Default)]
pub(crate) struct Renderer {
    shapes: Vec<Shape>,
    depth: Vec<f32>,
    hit: Vec<(u16, V)>,
}

/// A pinhole camera: where it is, and its axes scaled so that a pixel's ray is `forward + x right + y up`, x and y in
/// [-1, 1].
struct Eye {
    position: V,
    forward: V,
    right: V,
    up: V,
}

impl Renderer {
    /// Draws what a camera sees. The poses in `data` must be up to date.
    pub(crate) fn draw(
        &mut self,
        data: &MjData<Arc<MjModel>>,
        camera: &str,
        width: usize,
        height: usize,
        style: Style,
    ) -> Result<Image> {
        if ![width, height].iter().all(|side| (1..=MOST_PIXELS).contains(side)) {
            return Err(Error::Picture { width, height });
        }
        let eye = eye(data, camera, width as f32 / height as f32)?;
        self.collect(data);
        self.depth.clear();
        self.depth.resize(width * height, FAR);
        self.hit.clear();
        self.hit.resize(width * height, (0, [0.0; 3]));
        for k in 0..self.shapes.len() {
            self.cast(k, &eye, width, height);
        }
        let mut image = vec![0; width * height * 3];
        for (i, pixel) in image.chunks_exact_mut(3).enumerate() {
            let color = self.shade(i, &eye.ray(i % width, i / width, width, height), &eye, style);
            for (out, c) in pixel.iter_mut().zip(color) {
                // Truncation is meant, and the cast saturates.
                *out = (c * 255.0) as u8;
            }
        }
        Ok(Image { height, width, data: image })
    }

    fn collect(&mut self, data: &MjData<Arc<MjModel>>) {
        let model = data.model();
        let (positions, rotations) = (data.geom_xpos(), data.geom_xmat());
        let (kinds, sizes, colors, groups) =
            (model.geom_type(), model.geom_size(), model.geom_rgba(), model.geom_group());
        self.shapes.clear();
        for g in 0..kinds.len() {
            // Groups from 3 on are MuJoCo's for what is not to be seen.
            if groups[g] < 3 && colors[g][3] > 0.05 {
                self.shapes.push(Shape::new(kinds[g], &positions[g], &rotations[g], &sizes[g], colors[g]));
            }
        }
    }

    /// Notes where shape `k` is the nearest thing.
    fn cast(&mut self, k: usize, eye: &Eye, width: usize, height: usize) {
        let shape = &self.shapes[k];
        let Some([left, right, top, bottom]) = eye.bounds(shape, width, height) else { return };
        // In the shape's frame a ray's direction is linear in the pixel's coordinates.
        let origin = shape.point(eye.position);
        let (forward, across, up) =
            (shape.direction(eye.forward), shape.direction(eye.right), shape.direction(eye.up));
        for y in top..bottom {
            let row = add(forward, up, vertical(y, height));
            for x in left..right {
                let at = y * width + x;
                let ray = add(row, across, horizontal(x, width));
                if let Some((t, n)) = shape.hit(origin, ray, self.depth[at]) {
                    self.depth[at] = t;
                    self.hit[at] = (k as u16, n);
                }
            }
        }
    }

    fn shade(&self, pixel: usize, ray: &V, eye: &Eye, style: Style) -> V {
        let t = self.depth[pixel];
        if t >= FAR {
            return SKY;
        }
        let (k, n) = self.hit[pixel];
        let shape = &self.shapes[usize::from(k)];
        let n = shape.world(n);
        let mut sun = dot(n, SUN).max(0.0);
        if style.shadows && sun > 0.0 {
            let point = add(add(eye.position, *ray, t), n, 1e-3);
            if self.shapes.iter().any(|s| s.hit(s.point(point), s.direction(SUN), 10.0).is_some()) {
                sun = 0.0;
            }
        }
        let head = (-dot(n, normal(*ray))).max(0.0);
        let light = AMBIENT + HEADLIGHT * head + SUNLIGHT * sun;
        shape.color.map(|c| (c * light).min(1.0))
    }
}

fn horizontal(x: usize, width: usize) -> f32 {
    (2 * x + 1) as f32 / width as f32 - 1.0
}

fn vertical(y: usize, height: usize) -> f32 {
    1.0 - (2 * y + 1) as f32 / height as f32
}

fn eye(data: &MjData<Arc<MjModel>>, camera: &str, aspect: f32) -> Result<Eye> {
    let model = data.model();
    let id = model
        .name_to_id(MjtObjBase::mjOBJ_CAMERA, camera)
        .ok_or_else(|| Error::Camera { name: camera.to_owned(), known: crate::env::known_cameras() })?;
    let m = data.cam_xmat()[id].map(|v| v as f32);
    let tan = (model.cam_fovy()[id].to_radians() / 2.0).tan() as f32;
    Ok(Eye {
        position: data.cam_xpos()[id].map(|v| v as f32),
        forward: [-m[2], -m[5], -m[8]],
        right: [m[0], m[3], m[6]].map(|v| v * tan * aspect),
        up: [m[1], m[4], m[7]].map(|v| v * tan),
    })
}

impl Eye {
    fn ray(&self, x: usize, y: usize, width: usize, height: usize) -> V {
        add(add(self.forward, self.right, horizontal(x, width)), self.up, vertical(y, height))
    }

    /// Pixels (left, right, top, bottom; ends exclusive) that a shape may cover: those of its bounding box's corners.
    fn bounds(&self, shape: &Shape, width: usize, height: usize) -> Option<[usize; 4]> {
        let all = Some([0, width, 0, height]);
        let Some(corners) = shape.corners() else { return all };
        let mut span = [f32::MAX, f32::MIN, f32::MAX, f32::MIN];
        let mut behind = 0;
        for corner in corners {
            let v = add(corner, self.position, -1.0);
            let depth = dot(v, self.forward);
            if depth < 0.01 {
                behind += 1;
                continue;
            }
            let x = dot(v, self.right) / (dot(self.right, self.right) * depth);
            let y = dot(v, self.up) / (dot(self.up, self.up) * depth);
            span = [span[0].min(x), span[1].max(x), span[2].min(y), span[3].max(y)];
        }
        match behind {
            0 => {}
            8 => return None,
            _ => return all,
        }
        // One pixel more on every side, for rounding.
        let column = |v: f32, n: usize| ((v + 1.0) * 0.5 * n as f32).clamp(-2.0, n as f32 + 2.0);
        let low = |v: f32| (v - 1.0).max(0.0) as usize;
        let high = |v: f32, n: usize| ((v + 2.0).max(0.0) as usize).min(n);
        let (left, right) = (low(column(span[0], width)), high(column(span[1], width), width));
        let (top, bottom) = (low(column(-span[3], height)), high(column(-span[2], height), height));
        (left < right && top < bottom).then_some([left, right, top, bottom])
    }
}
