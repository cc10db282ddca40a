//! Shapes and where rays meet them.

use mujoco_rs::prelude::MjtGeomBase;
use std::ops::Range;

pub(super) type V = [f32; 3];

pub(super) fn dot(a: V, b: V) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// `a + s b`.
pub(super) fn add(a: V, b: V, s: f32) -> V {
    [a[0] + b[0] * s, a[1] + b[1] * s, a[2] + b[2] * s]
}

pub(super) fn normal(a: V) -> V {
    let scale = 1.0 / dot(a, a).sqrt();
    a.map(|v| v * scale)
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Plane,
    Ellipsoid,
    Capsule,
    Cylinder,
    Box,
    Other,
}

/// A geom placed in the world.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shape {
    kind: Kind,
    position: V,
    axes: [V; 3], // of the shape, in the world
    size: V,
    pub(super) color: V,
}

impl Shape {
    pub(super) fn new(
        kind: MjtGeomBase,
        position: &[f64; 3],
        matrix: &[f64; 9],
        size: &[f64; 3],
        color: [f32; 4],
    ) -> Self {
        let m = matrix.map(|v| v as f32);
        let mut size = size.map(|v| v as f32);
        let kind = match kind {
            MjtGeomBase::mjGEOM_PLANE => Kind::Plane,
            MjtGeomBase::mjGEOM_SPHERE => {
                size = [size[0]; 3];
                Kind::Ellipsoid
            }
            MjtGeomBase::mjGEOM_ELLIPSOID => Kind::Ellipsoid,
            MjtGeomBase::mjGEOM_CAPSULE => Kind::Capsule,
            MjtGeomBase::mjGEOM_CYLINDER => Kind::Cylinder,
            MjtGeomBase::mjGEOM_BOX => Kind::Box,
            _ => Kind::Other,
        };
        Self {
            kind,
            position: position.map(|v| v as f32),
            axes: [[m[0], m[3], m[6]], [m[1], m[4], m[7]], [m[2], m[5], m[8]]],
            size,
            color: [color[0], color[1], color[2]],
        }
    }

    /// A world point in the shape's frame.
    pub(super) fn point(&self, p: V) -> V {
        self.direction(add(p, self.position, -1.0))
    }

    /// A world direction in the shape's frame.
    pub(super) fn direction(&self, d: V) -> V {
        self.axes.map(|axis| dot(d, axis))
    }

    /// A direction of the shape's frame in the world.
    pub(super) fn world(&self, d: V) -> V {
        let [x, y, z] = self.axes;
        add(add(x.map(|v| v * d[0]), y, d[1]), z, d[2])
    }

    /// Corners of the bounding box; none for a plane.
    pub(super) fn corners(&self) -> Option<[V; 8]> {
        let s = self.size;
        let half = match self.kind {
            Kind::Plane => return None,
            Kind::Ellipsoid | Kind::Box | Kind::Other => s,
            Kind::Cylinder => [s[0], s[0], s[1]],
            Kind::Capsule => [s[0], s[0], s[0] + s[1]],
        };
        Some(std::array::from_fn(|i| {
            let sign = |bit: usize| if i >> bit & 1 == 0 { -1.0 } else { 1.0 };
            add(self.position, self.world([half[0] * sign(0), half[1] * sign(1), half[2] * sign(2)]), 1.0)
        }))
    }

    /// First meeting of a ray (in the shape's frame) with the surface before `limit`: distance in units of `d`, normal.
    #[inline]
    pub(super) fn hit(&self, o: V, d: V, limit: f32) -> Option<(f32, V)> {
        match self.kind {
            Kind::Plane => plane(self.size, o, d, 0.0..limit),
            Kind::Box => cuboid(self.size, o, d, 0.0..limit),
            Kind::Ellipsoid => ellipsoid(self.size, o, d, 0.0..limit),
            Kind::Cylinder => {
                let side = tube(self.size[0], self.size[1], o, d, 0.0..limit);
                let end = |sign| disk(self.size[0], self.size[1] * sign, o, d, 0.0..limit);
                nearest([side, end(1.0), end(-1.0)])
            }
            Kind::Capsule => {
                let side = tube(self.size[0], self.size[1], o, d, 0.0..limit);
                let end = |sign| cap(self.size[0], self.size[1] * sign, o, d, 0.0..limit);
                nearest([side, end(1.0), end(-1.0)])
            }
            Kind::Other => None,
        }
    }
}

type Hit = Option<(f32, V)>;

fn nearest(hits: [Hit; 3]) -> Hit {
    hits.into_iter().flatten().reduce(|a, b| if b.0 < a.0 { b } else { a })
}

fn plane(size: V, o: V, d: V, span: Range<f32>) -> Hit {
    if o[2] < 0.0 || d[2] > -1e-9 {
        return None;
    }
    let t = -o[2] / d[2];
    let inside = |i: usize| size[i] <= 0.0 || (o[i] + t * d[i]).abs() < size[i];
    (t < span.end && inside(0) && inside(1)).then_some((t, [0.0, 0.0, 1.0]))
}

#[inline]
fn cuboid(size: V, o: V, d: V, span: Range<f32>) -> Hit {
    let (mut near, mut far, mut face) = (span.start, span.end, None);
    for i in 0..3 {
        let inverse = 1.0 / d[i];
        let (a, b) = ((-size[i] - o[i]) * inverse, (size[i] - o[i]) * inverse);
        let (a, b, sign) = if a < b { (a, b, -1.0) } else { (b, a, 1.0) };
        if a > near {
            (near, face) = (a, Some((i, sign)));
        }
        far = far.min(b);
    }
    let (axis, sign) = face?;
    let mut n = [0.0; 3];
    n[axis] = sign;
    (near < far).then_some((near, n))
}

fn ellipsoid(size: V, o: V, d: V, span: Range<f32>) -> Hit {
    let scaled = |v: V| [v[0] / size[0], v[1] / size[1], v[2] / size[2]];
    let (o, d) = (scaled(o), scaled(d));
    let t = root(dot(d, d), dot(o, d), dot(o, o) - 1.0)?;
    span.contains(&t).then(|| (t, normal(scaled(add(o, d, t)))))
}

/// The side of a cylinder along z.
#[inline]
fn tube(r: f32, half: f32, o: V, d: V, span: Range<f32>) -> Hit {
    let t = root(d[0] * d[0] + d[1] * d[1], o[0] * d[0] + o[1] * d[1], o[0] * o[0] + o[1] * o[1] - r * r)?;
    let p = add(o, d, t);
    (span.contains(&t) && p[2].abs() < half).then_some((t, [p[0] / r, p[1] / r, 0.0]))
}

/// The flat end of a cylinder, at height `z`.
fn disk(r: f32, z: f32, o: V, d: V, span: Range<f32>) -> Hit {
    if d[2] * z >= 0.0 {
        return None;
    }
    let t = (z - o[2]) / d[2];
    let p = add(o, d, t);
    let n = [0.0, 0.0, if z < 0.0 { -1.0 } else { 1.0 }];
    (span.contains(&t) && p[0] * p[0] + p[1] * p[1] < r * r).then_some((t, n))
}

/// The round end of a capsule, centred at height `z`.
fn cap(r: f32, z: f32, o: V, d: V, span: Range<f32>) -> Hit {
    let o = [o[0], o[1], o[2] - z];
    let t = root(dot(d, d), dot(o, d), dot(o, o) - r * r)?;
    let p = add(o, d, t);
    (span.contains(&t) && p[2] * z >= 0.0).then_some((t, p.map(|v| v / r)))
}

/// Smaller root of `a t^2 + 2 b t + c`.
#[inline]
fn root(a: f32, b: f32, c: f32) -> Option<f32> {
    let h = b * b - a * c;
    (h > 0.0 && a > 1e-12).then(|| (-b - h.sqrt()) / a)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPAN: Range<f32> = 0.0..100.0;
    const DOWN: V = [0.0, 0.0, -1.0];

    #[test]
    fn a_ray_from_above_meets_each_shape_at_its_top() {
        let o = [0.01, 0.02, 5.0];
        assert!((cuboid([1.0, 1.0, 2.0], o, DOWN, SPAN).unwrap().0 - 3.0).abs() < 1e-6);
        assert!((disk(1.0, 2.0, o, DOWN, SPAN).unwrap().0 - 3.0).abs() < 1e-6);
        assert!((cap(1.0, 1.0, o, DOWN, SPAN).unwrap().0 - 3.0).abs() < 1e-3);
        assert!((ellipsoid([1.0, 1.0, 2.0], o, DOWN, SPAN).unwrap().0 - 3.0).abs() < 1e-2);
        assert!((plane([0.0; 3], o, DOWN, SPAN).unwrap().0 - 5.0).abs() < 1e-6);
    }

    #[test]
    fn what_lies_behind_or_beyond_is_not_met() {
        let o = [0.0, 0.0, 5.0];
        let up = [0.0, 0.0, 1.0];
        assert!(cuboid([1.0; 3], o, up, SPAN).is_none() && disk(1.0, 1.0, o, up, SPAN).is_none());
        assert!(cuboid([1.0; 3], o, DOWN, 0.0..3.0).is_none());
        assert!(tube(1.0, 1.0, [5.0, 0.0, 0.0], [-1.0, 0.0, 0.0], SPAN).is_some());
        assert!(tube(1.0, 1.0, [5.0, 0.0, 2.0], [-1.0, 0.0, 0.0], SPAN).is_none());
    }
}
