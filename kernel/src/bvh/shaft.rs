//! Between some points and a light: what may lie there at all?
//!
//! The hull of a box around the points and a box around the targets, each turned to fit, is bounded by planes. Any
//! plane with the hull on one side is sound; the normals only decide how tight it is. They are those of the
//! hull's own facets, an edge of one box and a corner of the other, and of the boxes' faces. What lies behind any
//! of the planes blocks nothing.
//!
//! Shafts go back to Haines and Wallace, "Shaft Culling for Efficient Ray-Traced Radiosity" (Eurographics
//! Workshop on Rendering 1991).

use super::{FARTHEST, NEAREST, Node, ROUNDING};
use crate::lanes::{Lanes, Mask, Simd};
use crate::triangle::TriangleBlock;
use crate::vec3x::{self, Vec3x};
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
    /// The greatest distance along each axis of the corners from the reference, or a little more.
    #[inline(always)]
    fn reach(&self) -> Vec3 {
        self.middle.abs() + self.spread()
    }

    /// The same from the middle.
    #[inline(always)]
    fn spread(&self) -> Vec3 {
        let [a, b, c] = self.axes;
        a.abs() + b.abs() + c.abs()
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
}

/// A box a lane.
struct Boxes<L> {
    middle: Vec3x<L>,
    axes: [Vec3x<L>; 3],
}

impl<L: Lanes> Boxes<L> {
    /// One of two boxes in each lane, as the weights say.
    #[inline(always)]
    fn either(token: L::Token, boxes: [&Turned; 2], weights: [L; 2]) -> Self {
        let [a, b] = boxes;
        Self {
            middle: weighted(token, [a.middle, b.middle], weights),
            axes: [
                weighted(token, [a.axes[0], b.axes[0]], weights),
                weighted(token, [a.axes[1], b.axes[1]], weights),
                weighted(token, [a.axes[2], b.axes[2]], weights),
            ],
        }
    }

    /// The corner where a linear function is least.
    #[inline(always)]
    fn least_corner(&self, token: L::Token, normal: Vec3x<L>) -> Vec3x<L> {
        let mut corner = self.middle;
        let mut k = 0;
        while k < 3 {
            let up = L::splat(token, 0.0).lt(vec3x::dot(normal, self.axes[k]));
            let mut axis = 0;
            while axis < 3 {
                let step = self.axes[k][axis];
                corner[axis] = corner[axis] + L::select(up, -step, step);
                axis += 1;
            }
            k += 1;
        }
        corner
    }
}

/// Sums of vectors, weighted lane by lane.
#[inline(always)]
fn weighted<L: Lanes, const N: usize>(token: L::Token, vectors: [Vec3; N], weights: [L; N]) -> Vec3x<L> {
    let mut sum = vec3x::splat(token, [0.0; 3]);
    let mut k = 0;
    while k < N {
        let [x, y, z] = vec3x::splat::<L>(token, vectors[k].to_array());
        sum = [x.mul_add(weights[k], sum[0]), y.mul_add(weights[k], sum[1]), z.mul_add(weights[k], sum[2])];
        k += 1;
    }
    sum
}

/// Weights of lanes from the `from`th on.
#[inline(always)]
fn weights<L: Lanes, const N: usize>(token: L::Token, lanes: &[[f32; 8]; N], from: usize) -> [L; N] {
    let mut weights = [L::splat(token, 0.0); N];
    let mut k = 0;
    while k < N {
        weights[k] = L::load(token, &lanes[k][from..]);
        k += 1;
    }
    weights
}

/// The least of a linear function over a box, by lane.
#[inline(always)]
fn least<L: Lanes>(token: L::Token, turned: &Turned, normal: Vec3x<L>) -> L {
    let [a, b, c] = turned.axes;
    vec3x::dot(normal, vec3x::splat(token, turned.middle.to_array()))
        - vec3x::dot(normal, vec3x::splat(token, a.to_array())).abs()
        - vec3x::dot(normal, vec3x::splat(token, b.to_array())).abs()
        - vec3x::dot(normal, vec3x::splat(token, c.to_array())).abs()
}

/// Where `normal` leads to the positive side of `side`, it is turned about.
#[inline(always)]
fn turned_from<L: Lanes>(token: L::Token, normal: Vec3x<L>, side: Vec3x<L>) -> Vec3x<L> {
    let up = L::splat(token, 0.0).lt(vec3x::dot(normal, side));
    [
        L::select(up, -normal[0], normal[0]),
        L::select(up, -normal[1], normal[1]),
        L::select(up, -normal[2], normal[2]),
    ]
}

/// The lengths of normals, as sums of components, that planes are made of.
const SIZES: [f32; 2] = [1e-30, 1e30];

/// Facets along an edge of either box, and two faces.
const PLANES: usize = 10;

/// The first eight planes, of which four have an edge of the targets' box and four one of the points'.
const OF: [[f32; 8]; 2] =
    [[1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]];

/// Their edges: along the first axis of the targets' box, its second, and the same of the points'.
const EDGE: [[f32; 8]; 4] = [
    [1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
    [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0],
];

/// Where the edges lie, from the middle of the box, along the same four axes.
const SIDE: [[f32; 8]; 4] = [
    [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0],
    [1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0],
    [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0],
];

/// To which side of a box's middle its corners lie, by axis of the box.
const CORNER: [[f32; 8]; 3] = [
    [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0],
    [1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0],
    [1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0],
];

/// Where anything must be to come between the points and the targets.
pub(super) struct Shaft {
    /// What the corners are counted from.
    pub(super) reference: Vec3,
    /// From the middle of the points to that of the targets.
    pub(super) between: Vec3,
    /// The boxes themselves, from the reference.
    pub(super) points: Turned,
    pub(super) targets: Turned,
    planes: Planes,
    lower: Vec3,
    upper: Vec3,
    /// Eight around the points and eight around the targets; `k` and `k ^ 4` are where a flat box is thin.
    pub(super) corners: [[f32; 16]; 3],
    /// The greatest component of a corner around the points, and around the targets, or a little more.
    pub(super) farthest: [f32; 2],
}

/// Planes with `normal . position + offset >= 0` where the shaft may be.
struct Planes {
    normal: [[f32; PLANES]; 3],
    offset: [f32; PLANES],
}

impl Planes {
    /// How far inside of a plane the corners of boxes are that are farthest inside.
    #[inline(always)]
    fn most<L: Lanes>(&self, token: L::Token, k: usize, bounds: &[Vec3x<L>; 2]) -> L {
        let mut at = L::splat(token, self.offset[k]);
        let mut axis = 0;
        while axis < 3 {
            let normal = self.normal[axis][k];
            at = bounds[usize::from(normal > 0.0)][axis].mul_add(L::splat(token, normal), at);
            axis += 1;
        }
        at
    }

    /// How far inside of a plane positions are.
    #[inline(always)]
    fn at<L: Lanes>(&self, token: L::Token, k: usize, [x, y, z]: Vec3x<L>) -> L {
        let [a, b, c] = vec3x::broadcast::<L, PLANES>(token, &self.normal, k);
        x.mul_add(a, y.mul_add(b, z.mul_add(c, L::splat(token, self.offset[k]))))
    }
}

impl Shaft {
    /// Around two boxes, both from `reference`. `magnitude` bounds every coordinate of the scene. `None` where
    /// anything is not finite, or too far away for the planes.
    #[inline(always)]
    pub(super) fn new<S: Simd>(
        simd: S,
        reference: Vec3,
        points: &Turned,
        targets: &Turned,
        magnitude: f32,
    ) -> Option<Self> {
        let token = simd.token();
        let reach = magnitude + reference.abs().max_element();
        let position = 16.0 * ROUNDING * reach;
        let [near, far] = [points.reach(), targets.reach()];
        let farthest = [near.max_element(), far.max_element()];
        let most = farthest[0].max(farthest[1]).max(reference.abs().max_element());
        // Written so that NaN fails; of NaN and a number the greater may be the number.
        if !((near + far).is_finite() && most < FARTHEST && reach > NEAREST) {
            return None;
        }
        let mut corners = [[0.0; 16]; 3];
        let mut planes = Planes { normal: [[0.0; PLANES]; 3], offset: [0.0; PLANES] };
        let mut from = 0;
        while from < 8 {
            let signs = weights::<S::Node, 3>(token, &CORNER, from);
            let mut side = 0;
            while side < 2 {
                let turned = if side == 0 { points } else { targets };
                let [x, y, z] = vec3x::splat::<S::Node>(token, turned.middle.to_array());
                let [a, b, c] = weighted(token, turned.axes, signs);
                (x + a).store(&mut corners[0][8 * side + from..]);
                (y + b).store(&mut corners[1][8 * side + from..]);
                (z + c).store(&mut corners[2][8 * side + from..]);
                side += 1;
            }
            // Facets through an edge of one box and the corner of the other that lies farthest out. The boxes are flat
            // as a rule, so two of the axes matter.
            let axes = [targets.axes[0], targets.axes[1], points.axes[0], points.axes[1]];
            let edge = weighted(token, axes, weights::<S::Node, 4>(token, &EDGE, from));
            let side = weighted(token, axes, weights::<S::Node, 4>(token, &SIDE, from));
            let of = weights::<S::Node, 2>(token, &OF, from);
            let [x, y, z] = weighted(token, [targets.middle, points.middle], of);
            let at = [x + side[0], y + side[1], z + side[2]];
            let other = Boxes::either(token, [points, targets], of);
            let normal = vec3x::cross(edge, vec3x::sub(at, other.middle));
            let normal = turned_from(token, normal, side);
            let corner = other.least_corner(token, normal);
            let normal = turned_from(token, vec3x::cross(edge, vec3x::sub(at, corner)), side);
            // A normal of next to no length culls nothing.
            let size = normal[0].abs() + normal[1].abs() + normal[2].abs();
            let fit = S::Node::splat(token, SIZES[0]).lt(size) & size.lt(S::Node::splat(token, SIZES[1]));
            let zero = S::Node::splat(token, 0.0);
            let by_size = S::Node::splat(token, 1.0) / size;
            let normal = [
                S::Node::select(fit, normal[0] * by_size, zero),
                S::Node::select(fit, normal[1] * by_size, zero),
                S::Node::select(fit, normal[2] * by_size, zero),
            ];
            let least = least(token, points, normal).min(least(token, targets, normal));
            let back = vec3x::dot(normal, vec3x::splat(token, reference.to_array()));
            let offset = (-least - back) + S::Node::splat(token, 4.0 * position);
            normal[0].store(&mut planes.normal[0][from..]);
            normal[1].store(&mut planes.normal[1][from..]);
            normal[2].store(&mut planes.normal[2][from..]);
            S::Node::select(fit, offset, zero).store(&mut planes.offset[from..]);
            from += S::Node::WIDTH;
        }
        let between = targets.middle - points.middle;
        let mut side = 0;
        while side < 2 {
            let ([a, b, _], toward) =
                if side == 0 { (points.axes, between) } else { (targets.axes, -between) };
            let normal = a.cross(b);
            let size = normal.abs().element_sum();
            if size > SIZES[0] && size < SIZES[1] {
                let normal = normal * (if normal.dot(toward) < 0.0 { -1.0 } else { 1.0 } / size);
                let least = points.least(normal).min(targets.least(normal));
                let k = 8 + side;
                (planes.normal[0][k], planes.normal[1][k], planes.normal[2][k]) = normal.into();
                planes.offset[k] = (-least - normal.dot(reference)) + 4.0 * position;
            }
            side += 1;
        }
        // Positions are rounded when they are counted from the reference, and again when the result is moved back.
        let slack = Vec3::splat(4.0 * position);
        let (here, there) = (points.spread(), targets.spread());
        let lower = (points.middle - here).min(targets.middle - there);
        let upper = (points.middle + here).max(targets.middle + there);
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

    /// A corner, as in `corners`.
    #[inline(always)]
    pub(super) fn corner(&self, k: usize) -> Vec3 {
        Vec3::new(self.corners[0][k], self.corners[1][k], self.corners[2][k])
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
                    inside = inside & zero.le(self.planes.most(token, k, &bounds));
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
            let bounds = vec3x::bounds([a, b, c]);
            let mut inside = lower[0].le(bounds[1][0]) & bounds[0][0].le(upper[0]);
            inside = inside & lower[1].le(bounds[1][1]) & bounds[0][1].le(upper[1]);
            inside = inside & lower[2].le(bounds[1][2]) & bounds[0][2].le(upper[2]);
            let mut k = 0;
            while k < PLANES && inside.any() {
                let at = self.planes.at(token, k, a);
                let at = at.max(self.planes.at(token, k, b)).max(self.planes.at(token, k, c));
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
        // are not, and where a segment ends is rounded as far as it is long. The surface that the points lie on is told
        // from things in between by the clearance alone. Axis by axis the bound would be too small: corners are sums along
        // turned axes, whose rounding does not cancel where they do.
        let rounding = n_size * S::Node::splat(token, 8.0 * ROUNDING);
        let [near, away] = self.farthest;
        let reach = [near, near + away];
        let mut low = S::Node::splat(token, f32::INFINITY);
        let mut high = S::Node::splat(token, f32::NEG_INFINITY);
        let mut side = 0;
        while side < 2 {
            let bound = rounding * (far + S::Node::splat(token, 2.0 * reach[side]));
            let mut k = 8 * side;
            while k < 8 * side + 8 {
                let [x, y, z] = vec3x::broadcast::<S::Node, 16>(token, &self.corners, k);
                let at = n[0].mul_add(x, n[1].mul_add(y, n[2] * z));
                (low, high) = (low.min(at - bound), high.max(at + bound));
                k += 1;
            }
            side += 1;
        }
        low.le(plane) & plane.le(high)
    }
}
