//! Between some points and a light: what may lie there at all?
//!
//! The hull of a box around the points and a box around the targets, each turned to fit, is bounded by planes. Any
//! plane with the hull on one side is sound; the normals only decide how tight it is. They are those of the
//! hull's own facets, an edge of one box and a corner of the other, and of the boxes' faces. What lies behind any
//! of the planes blocks nothing.
//!
//! Shafts go back to Haines and Wallace, "Shaft Culling for Efficient Ray-Traced Radiosity" (Eurographics
//! Workshop on Rendering 1991).

use super::pyramid::{Plane, extent};
use super::{FARTHEST, NEAREST, Node, ROUNDING};
use crate::lanes::{Lanes, Mask, Simd};
use crate::triangle::TriangleBlock;
use crate::vec3x;
use glam::Vec3;

/// A box turned any way, from a reference point: its middle and its half axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Turned {
    pub(super) middle: Vec3,
    pub(super) axes: [Vec3; 3],
}

/// Grows around positions, in a frame of three unit vectors.
pub(super) struct Around<L> {
    frame: [Vec3; 3],
    low: [L; 3],
    high: [L; 3],
    /// 0 as long as all positions are finite.
    odd: L,
}

impl<L: Lanes> Around<L> {
    #[inline(always)]
    pub(super) fn new(token: L::Token, frame: [Vec3; 3]) -> Self {
        let (low, high) = (L::splat(token, f32::INFINITY), L::splat(token, f32::NEG_INFINITY));
        Self { frame, low: [low; 3], high: [high; 3], odd: L::splat(token, 0.0) }
    }

    /// Takes in as many positions as there are lanes.
    #[inline(always)]
    pub(super) fn add(&mut self, token: L::Token, position: [L; 3]) {
        let mut k = 0;
        while k < 3 {
            let [x, y, z] = vec3x::splat::<L>(token, self.frame[k].to_array());
            let at = position[0].mul_add(x, position[1].mul_add(y, position[2] * z));
            self.low[k] = self.low[k].min(at);
            self.high[k] = self.high[k].max(at);
            self.odd = self.odd + at * L::splat(token, 0.0);
            k += 1;
        }
    }

    #[inline(always)]
    pub(super) fn finish(&self) -> Turned {
        let mut turned = Turned { middle: Vec3::ZERO, axes: [Vec3::ZERO; 3] };
        let mut k = 0;
        while k < 3 {
            let odd = super::pyramid::sum_of(self.odd);
            let low = super::pyramid::least_of(self.low[k]) + odd;
            let high = super::pyramid::greatest_of(self.high[k]) + odd;
            turned.middle += self.frame[k] * (0.5 * (low + high));
            turned.axes[k] = self.frame[k] * (0.5 * (high - low));
            k += 1;
        }
        turned
    }
}

impl Turned {
    #[inline(always)]
    fn corner(&self, index: usize) -> Vec3 {
        let [a, b, c] = self.axes;
        self.middle
            + if index & 1 == 0 { a } else { -a }
            + if index & 2 == 0 { b } else { -b }
            + if index & 4 == 0 { c } else { -c }
    }

    /// The greatest of a linear function over the box.
    #[inline(always)]
    pub(super) fn most(&self, normal: Vec3) -> f32 {
        -self.least(-normal)
    }

    /// The least of a linear function over the box.
    #[inline(always)]
    pub(super) fn least(&self, normal: Vec3) -> f32 {
        let [a, b, c] = self.axes;
        normal.dot(self.middle) - normal.dot(a).abs() - normal.dot(b).abs() - normal.dot(c).abs()
    }

    /// The corner that is least.
    #[inline(always)]
    fn least_corner(&self, normal: Vec3) -> Vec3 {
        let [a, b, c] = self.axes;
        let toward = |axis: Vec3| if normal.dot(axis) > 0.0 { -axis } else { axis };
        self.middle + toward(a) + toward(b) + toward(c)
    }
}

/// Facets along an edge of either box, and two faces.
const PLANES: usize = 10;

/// Where anything must be to come between the points and the targets.
pub(super) struct Shaft {
    /// What the corners are counted from.
    pub(super) reference: Vec3,
    /// From the middle of the points to that of the targets.
    pub(super) between: Vec3,
    /// The boxes themselves, from the reference.
    pub(super) points: Turned,
    pub(super) targets: Turned,
    planes: [Plane; PLANES],
    lower: Vec3,
    upper: Vec3,
    /// Eight around the points and eight around the targets; `k` and `k ^ 4` are where a flat box is thin.
    pub(super) corners: [Vec3; 16],
    /// The greatest component of a corner around the points, and around the targets.
    pub(super) farthest: [f32; 2],
}

impl Shaft {
    /// Around two boxes, both from `reference`. `magnitude` bounds every coordinate of the scene. `None` where
    /// anything is not finite, or too far away for the planes.
    #[inline(always)]
    pub(super) fn new(reference: Vec3, points: &Turned, targets: &Turned, magnitude: f32) -> Option<Self> {
        let reach = magnitude + reference.abs().max_element();
        let position = 16.0 * ROUNDING * reach;
        let mut corners = [Vec3::ZERO; 16];
        let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let mut farthest = [0.0f32; 2];
        // Not finite if any corner is not; the least and the greatest may lose what is not a number.
        let mut sum = Vec3::ZERO;
        let mut k = 0;
        while k < 16 {
            let corner = if k < 8 { points.corner(k) } else { targets.corner(k & 7) };
            (lower, upper) = (lower.min(corner), upper.max(corner));
            corners[k] = corner;
            sum += corner;
            farthest[k / 8] = farthest[k / 8].max(corner.abs().max_element());
            k += 1;
        }
        let most = farthest[0].max(farthest[1]).max(reference.abs().max_element());
        // Written so that NaN fails.
        if !(sum.is_finite() && most < FARTHEST && reach > NEAREST) {
            return None;
        }
        let mut planes = [Plane::default(); PLANES];
        let mut count = 0;
        // Facets through an edge of one box and the corner of the other that lies farthest out. The boxes are flat
        // as a rule, so two of the axes matter.
        let mut turn = 0;
        while turn < 2 {
            let (this, other) = if turn == 0 { (targets, points) } else { (points, targets) };
            let mut k = 0;
            while k < 4 {
                let (edge, side) = (this.axes[k & 1], this.axes[(k & 1) ^ 1]);
                let side = if k < 2 { side } else { -side };
                let at = this.middle + side;
                let mut normal = edge.cross(at - other.middle);
                let mut step = 0;
                while step < 2 {
                    if normal.dot(side) > 0.0 {
                        normal = -normal;
                    }
                    if step == 0 {
                        normal = edge.cross(at - other.least_corner(normal));
                    }
                    step += 1;
                }
                planes[count] = Self::plane(reference, normal, points, targets, position);
                count += 1;
                k += 1;
            }
            turn += 1;
        }
        let between = targets.middle - points.middle;
        let face = |normal: Vec3, toward: Vec3| if normal.dot(toward) < 0.0 { -normal } else { normal };
        planes[8] = Self::plane(
            reference,
            face(points.axes[0].cross(points.axes[1]), between),
            points,
            targets,
            position,
        );
        planes[9] = Self::plane(
            reference,
            face(targets.axes[0].cross(targets.axes[1]), -between),
            points,
            targets,
            position,
        );
        // Positions are rounded when they are counted from the reference, and again when the result is moved back.
        let slack = Vec3::splat(4.0 * position);
        let (lower, upper) = (reference + lower - slack, reference + upper + slack);
        Some(Self {
            reference,
            between,
            points: *points,
            targets: *targets,
            planes,
            lower,
            upper,
            corners,
            farthest,
        })
    }

    /// Both boxes are on the positive side. A normal of next to no length culls nothing.
    #[inline(always)]
    fn plane(reference: Vec3, normal: Vec3, points: &Turned, targets: &Turned, position: f32) -> Plane {
        let size = extent(normal);
        if !(size > 1e-30 && size < 1e30) {
            return Plane::default();
        }
        let normal = normal / size;
        let least = points.least(normal).min(targets.least(normal));
        Plane::new(normal, -least, reference, 4.0 * position)
    }

    /// Which children of a node the shaft may meet.
    #[inline(always)]
    pub(super) fn children<S: Simd>(&self, simd: S, node: &Node) -> u32 {
        type N<S> = <S as Simd>::Node;
        let token = simd.token();
        let mut met = 0;
        let mut from = 0;
        let zero = N::<S>::splat(token, 0.0);
        while from < Node::WIDTH {
            let bounds = [
                vec3x::load::<N<S>, 8>(token, &node.bounds[0], from),
                vec3x::load::<N<S>, 8>(token, &node.bounds[1], from),
            ];
            let lower = vec3x::splat::<N<S>>(token, self.lower.to_array());
            let upper = vec3x::splat::<N<S>>(token, self.upper.to_array());
            let mut inside = lower[0].le(bounds[1][0]) & bounds[0][0].le(upper[0]);
            inside = inside & lower[1].le(bounds[1][1]) & bounds[0][1].le(upper[1]);
            inside = inside & lower[2].le(bounds[1][2]) & bounds[0][2].le(upper[2]);
            if inside.any() {
                let mut k = 0;
                while k < PLANES {
                    let plane = &self.planes[k];
                    let x = bounds[plane.side[0] & 1][0];
                    let y = bounds[plane.side[1] & 1][1];
                    let z = bounds[plane.side[2] & 1][2];
                    inside = inside & zero.le(plane.at::<N<S>>(token, [x, y, z]));
                    k += 1;
                }
            }
            met |= inside.bits() << from;
            from += N::<S>::WIDTH;
        }
        met
    }

    /// Which triangles of a block may come between, as bits. Unused lanes may be among them.
    #[inline(always)]
    pub(super) fn triangles<S: Simd>(&self, simd: S, block: &TriangleBlock) -> u32 {
        type N<S> = <S as Simd>::Node;
        let token = simd.token();
        let mut open = 0;
        let mut from = 0;
        let zero = N::<S>::splat(token, 0.0);
        while from < TriangleBlock::WIDTH {
            let a = vec3x::load::<N<S>, 8>(token, &block.vertices[0], from);
            let b = vec3x::load::<N<S>, 8>(token, &block.vertices[1], from);
            let c = vec3x::load::<N<S>, 8>(token, &block.vertices[2], from);
            let lower = vec3x::splat::<N<S>>(token, self.lower.to_array());
            let upper = vec3x::splat::<N<S>>(token, self.upper.to_array());
            let mut inside = lower[0].le(a[0].max(b[0]).max(c[0])) & a[0].min(b[0]).min(c[0]).le(upper[0]);
            inside = inside & lower[1].le(a[1].max(b[1]).max(c[1])) & a[1].min(b[1]).min(c[1]).le(upper[1]);
            inside = inside & lower[2].le(a[2].max(b[2]).max(c[2])) & a[2].min(b[2]).min(c[2]).le(upper[2]);
            let mut k = 0;
            while k < PLANES && inside.any() {
                let plane = &self.planes[k];
                let at = plane.at(token, a).max(plane.at(token, b)).max(plane.at(token, c));
                inside = inside & zero.le(at);
                k += 1;
            }
            if inside.any() {
                let reference = vec3x::splat::<N<S>>(token, self.reference.to_array());
                inside = inside
                    & self.crosses::<S>(
                        token,
                        [vec3x::sub(a, reference), vec3x::sub(b, reference), vec3x::sub(c, reference)],
                    );
            }
            open |= inside.bits() << from;
            from += N::<S>::WIDTH;
        }
        open
    }

    /// Triangles, by their vertices from the reference, whose planes have corners of the hull on both sides.
    #[inline(always)]
    fn crosses<S: Simd>(&self, token: S::Token, [a, b, c]: [[S::Node; 3]; 3]) -> <S::Node as Lanes>::Mask {
        let (e, f) = (vec3x::sub(b, a), vec3x::sub(c, a));
        let (e_size, f_size) = (vec3x::abs(e), vec3x::abs(f));
        let n = vec3x::cross(e, f);
        let n_size = (e_size[1] * f_size[2] + e_size[2] * f_size[1])
            + (e_size[2] * f_size[0] + e_size[0] * f_size[2])
            + (e_size[0] * f_size[1] + e_size[1] * f_size[0]);
        let far = vec3x::most(vec3x::abs(a)).max(vec3x::most(vec3x::abs(b))).max(vec3x::most(vec3x::abs(c)));
        let plane = vec3x::dot(n, a);
        // The corners around the points are close to the reference, and so hardly rounded; those around the targets
        // are not. The surface that the points lie on is told from things in between by the clearance alone.
        let rounding = n_size * S::Node::splat(token, 8.0 * ROUNDING);
        let mut low = S::Node::splat(token, f32::INFINITY);
        let mut high = S::Node::splat(token, f32::NEG_INFINITY);
        let mut side = 0;
        while side < 2 {
            let bound = rounding * (far + S::Node::splat(token, 2.0 * self.farthest[side]));
            let mut k = 8 * side;
            while k < 8 * side + 8 {
                let [x, y, z] = vec3x::splat::<S::Node>(token, self.corners[k].to_array());
                let at = n[0].mul_add(x, n[1].mul_add(y, n[2] * z));
                (low, high) = (low.min(at - bound), high.max(at + bound));
                k += 1;
            }
            side += 1;
        }
        low.le(plane) & plane.le(high)
    }
}
