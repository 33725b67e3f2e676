//! Neighbouring points abreast, one a lane, against a few triangles and one flat light.
//!
//! What [`super::pyramid`] does for eight triangles and one point, done for one triangle and as many points as a vector
//! holds: most of a tile's points find at once that nothing of the list stands before them, and for the others the
//! triangle's forms are ready. The samples' places on the light, s and t, are the same for all points; seen from x they
//! become homogeneous coordinates
//!
//! ```text
//!     (S, T, W) = (s + o S(n), t + o T(n), 1 + o W(n))
//! ```
//!
//! where o is how far the samples stand off the light's plane, in units of n = u x v.

use super::batch::targets_from;
use super::pyramid::{CAUTION, Forms, Shift, View, extent, in_range, span_of};
use super::shaft::Shaft;
use super::tile::TilePoint;
use super::{Bvh, FARTHEST, ROUNDING, Targets};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::triangle::{NO_TRIANGLE, Sheared, Single, TriangleBlock, Turn};
use crate::vec3x::{self, Vec3x};
use glam::Vec3;

/// Points abreast, at most.
pub(super) const ABREAST: usize = 16;

/// Targets a point may have.
pub(super) const MOST: usize = 64;

/// A flat light and how far a tile's targets are spread on it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flat {
    corner: Vec3,
    u: Vec3,
    v: Vec3,
    normal: Vec3,
    /// s, t and o of a position, counted from the corner.
    rows: [Vec3; 3],
    least: [f32; 3],
    greatest: [f32; 3],
    /// What rounding may do to s, t and o.
    slack: [f32; 3],
    /// Bounds: what any coordinate is off by; greatest distances along an axis of points and targets.
    position: f32,
    near: f32,
    far: f32,
    reference: Vec3,
}

impl Flat {
    /// `None` where the light is not known to be flat, or is no parallelogram.
    #[inline(always)]
    pub(super) fn new(targets: &Targets<'_>, shaft: &Shaft, magnitude: f32) -> Option<Self> {
        let [corner, u, v] = targets.plane()?;
        let normal = u.cross(v);
        let size = normal.length_squared();
        let rows = [v.cross(normal) / size, normal.cross(u) / size, normal / size];
        if !(size > 1e-30 && size < 1e36 && rows[0].is_finite() && rows[1].is_finite() && rows[2].is_finite())
        {
            return None;
        }
        let from = shaft.targets.middle + (shaft.reference - corner);
        let far = shaft.farthest[1] + (shaft.reference - corner).abs().max_element();
        let (mut least, mut greatest, mut slack) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        let mut k = 0;
        while k < 3 {
            let row = rows[k].abs();
            slack[k] = 16.0 * ROUNDING * far * (row.x + row.y + row.z);
            let [a, b, c] = shaft.targets.axes;
            let spread = rows[k].dot(a).abs() + rows[k].dot(b).abs() + rows[k].dot(c).abs() + slack[k];
            let at = rows[k].dot(from);
            (least[k], greatest[k]) = (at - spread, at + spread);
            k += 1;
        }
        // How far the corners are that planes are asked about.
        let along_u = extent(u) * least[0].abs().max(greatest[0].abs());
        let along_v = extent(v) * least[1].abs().max(greatest[1].abs());
        let corners = far + along_u + along_v;
        if !corners.is_finite() || corners > 1e3 * FARTHEST {
            return None;
        }
        let reach = magnitude + shaft.reference.abs().max_element() + shaft.farthest[0];
        Some(Self {
            corner,
            u,
            v,
            normal,
            rows,
            least,
            greatest,
            slack,
            position: 16.0 * ROUNDING * reach,
            near: shaft.farthest[0],
            far: shaft.farthest[1],
            reference: shaft.reference,
        })
    }
}

/// What points abreast are asked in.
pub(super) struct Abreast {
    /// Places on the light of the targets of each point, once they are wanted.
    s: [[f32; MOST]; ABREAST],
    t: [[f32; MOST]; ABREAST],
    placed: u32,
    /// How many times a triangle was held against a point's targets, until it is set back.
    pub(super) pairs: u32,
    forms: Forms,
    /// Targets of each point that are blocked.
    pub(super) blocked: [u64; ABREAST],
}

impl Abreast {
    pub(super) const NOTHING: Self = Self {
        s: [[0.0; MOST]; ABREAST],
        t: [[0.0; MOST]; ABREAST],
        placed: 0,
        pairs: 0,
        forms: Forms::NOTHING,
        blocked: [0; ABREAST],
    };
}

/// The points' views of the light.
struct Views<L> {
    x: Vec3x<L>,
    /// S, T and W, by rows.
    rows: [Vec3x<L>; 3],
    view: View<L>,
    shift: Shift<L>,
    /// Directions to the corners of the part of the light that has targets.
    corners: [Vec3x<L>; 4],
}

/// A triangle and its plane.
struct Facet {
    corners: [Vec3; 3],
    normal: Vec3,
    /// What the products of the normal are at most.
    sizes: Vec3,
    /// What rounding may do to how far any point or target is along the normal.
    bound: f32,
}

impl Facet {
    #[inline(always)]
    fn new(flat: &Flat, block: &TriangleBlock, lane: usize) -> Self {
        let [p, q, r] = block.get(lane);
        let (p, q, r) = (Vec3::from(p), Vec3::from(q), Vec3::from(r));
        let (e, f) = (q - p, r - p);
        let normal = e.cross(f);
        let (e, f) = (e.abs(), f.abs());
        let sizes = Vec3::new(e.y * f.z + e.z * f.y, e.z * f.x + e.x * f.z, e.x * f.y + e.y * f.x);
        let from = |v: Vec3| (v - flat.reference).abs().max_element();
        let far = flat.near + from(p).max(from(q)).max(from(r)).max(flat.far);
        Self { corners: [p, q, r], normal, sizes, bound: sizes.element_sum() * far * (8.0 * ROUNDING) }
    }
}

impl<S: Simd> Bvh<'_, S> {
    /// Which targets of points, as many as a packet holds at most, the triangles of some blocks block. Gives the points
    /// that were answered, as bits; the others see the light too flat, or have too many targets.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn ask_abreast(
        &self,
        flat: &Flat,
        points: &[TilePoint],
        targets: &Targets<'_>,
        blocks: &[TriangleBlock],
        ignore: Option<u32>,
        counter: &mut impl Counter,
        abreast: &mut Abreast,
    ) -> u32 {
        self.simd.apart(
            #[inline(always)]
            || self.ask_abreast_here(flat, points, targets, blocks, ignore, counter, abreast),
        )
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn ask_abreast_here(
        &self,
        flat: &Flat,
        points: &[TilePoint],
        targets: &Targets<'_>,
        blocks: &[TriangleBlock],
        ignore: Option<u32>,
        counter: &mut impl Counter,
        abreast: &mut Abreast,
    ) -> u32 {
        let token = self.simd.token();
        let mut lanes = [[0.0; ABREAST]; 3];
        let mut fit = 0u32;
        let mut k = 0;
        while k < S::Packet::WIDTH {
            // The first point once more beyond the last.
            let x = points[if k < points.len() { k } else { 0 }].x;
            (lanes[0][k], lanes[1][k], lanes[2][k]) = (x[0], x[1], x[2]);
            if k < points.len() && points[k].count as usize <= MOST {
                fit |= 1 << k;
            }
            abreast.blocked[k] = 0;
            k += 1;
        }
        abreast.placed = 0;
        let x = vec3x::load::<S::Packet, ABREAST>(token, &lanes, 0);
        let (views, clear) = views::<S::Packet>(token, flat, x);
        let fit = fit & clear;
        let mut open = fit;
        let mut block = 0;
        while block < blocks.len() && open != 0 {
            let at = &blocks[block];
            let mut lane = 0;
            while lane < TriangleBlock::WIDTH && open != 0 {
                let id = at.ids[lane];
                if id == NO_TRIANGLE {
                    break;
                }
                if ignore != Some(id) {
                    counter.triangle_tests(open.count_ones());
                    self.meet_abreast(flat, &views, points, targets, at, lane, &mut open, counter, abreast);
                }
                lane += 1;
            }
            block += 1;
        }
        fit
    }

    /// One triangle against the points of `open`, and those that it leaves with free targets.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn meet_abreast(
        &self,
        flat: &Flat,
        views: &Views<S::Packet>,
        points: &[TilePoint],
        targets: &Targets<'_>,
        block: &TriangleBlock,
        lane: usize,
        open: &mut u32,
        counter: &mut impl Counter,
        abreast: &mut Abreast,
    ) {
        let token = self.simd.token();
        let from_x = [
            vec3x::sub(vec3x::broadcast(token, &block.vertices[0], lane), views.x),
            vec3x::sub(vec3x::broadcast(token, &block.vertices[1], lane), views.x),
            vec3x::sub(vec3x::broadcast(token, &block.vertices[2], lane), views.x),
        ];
        let seen = [views.project(from_x[0]), views.project(from_x[1]), views.project(from_x[2])];
        let met = views.view.meets(seen);
        if met.bits() & *open == 0 {
            return;
        }
        let facet = Facet::new(flat, block, lane);
        let [crosses, aside] = views.crosses(token, flat, &facet, from_x);
        let met = (met & crosses).bits() & *open;
        if met == 0 {
            return;
        }
        let outline = views.view.outline(token, seen, span_of(from_x), Some(&views.shift));
        let known = (outline.known & aside).bits();
        let mut left = met & (!known | outline.open.bits());
        if left == 0 {
            return;
        }
        abreast.pairs += left.count_ones();
        let before = known & outline.before.bits();
        let all = before & outline.every.bits();
        outline.store(&mut abreast.forms, 0);
        while left != 0 {
            let k = left.trailing_zeros() as usize & (ABREAST - 1);
            left &= left - 1;
            let TilePoint { x, first, count } = points[k];
            let every = if count == 0 { 0 } else { u64::MAX >> (64 - count) };
            let ask = every & !abreast.blocked[k];
            if all >> k & 1 != 0 {
                abreast.blocked[k] = every;
            } else if known >> k & 1 == 0 {
                // Seen edge on. Most often it is the surface that x lies on, and all that is asked about is above it.
                let (first, count) = (first as usize, count as usize);
                let ask = ask & self.beyond(&facet, x, targets, first, count);
                counter.triangle_tests(ask.count_ones());
                abreast.blocked[k] |= self.exact_of(x, targets, first, count, block, lane, ask);
            } else {
                if abreast.placed >> k & 1 == 0 {
                    abreast.placed |= 1 << k;
                    place::<S>(token, flat, targets, first as usize, count as usize, abreast, k);
                }
                counter.triangle_tests(ask.count_ones());
                let deep = before >> k & 1 == 0;
                let (blocked, unsure) = test::<S>(token, abreast, k, count as usize, deep, ask);
                abreast.blocked[k] |= blocked;
                if unsure != 0 {
                    abreast.blocked[k] |=
                        self.exact_of(x, targets, first as usize, count as usize, block, lane, unsure);
                }
            }
            if every & !abreast.blocked[k] == 0 {
                *open &= !(1 << k);
            }
        }
    }

    /// Which targets of a point may be on the other side of a triangle's plane, as [`Views::crosses`] tells it of all.
    #[inline(always)]
    fn beyond(&self, facet: &Facet, x: [f32; 3], targets: &Targets<'_>, first: usize, count: usize) -> u64 {
        let token = self.simd.token();
        let [a, b, c] = facet.corners;
        let x = Vec3::from(x);
        let [a, b, c] = [a - x, b - x, c - x];
        let plane = S::Packet::splat(token, facet.normal.dot(a));
        let here = (facet.sizes * (8.0 * ROUNDING)).dot(a.abs().max(b.abs()).max(c.abs()));
        let [low, high] = [S::Packet::splat(token, -here), S::Packet::splat(token, here)];
        let bound = S::Packet::splat(token, facet.bound);
        let origin = vec3x::splat::<S::Packet>(token, x.to_array());
        let normal = vec3x::splat::<S::Packet>(token, facet.normal.to_array());
        let mut bits = 0;
        let mut i = 0;
        while i < count {
            let direction = vec3x::sub(targets_from::<S>(token, targets, first + i, first + count), origin);
            let at = vec3x::dot(normal, direction);
            let may = low.min(at - bound).le(plane) & plane.le(high.max(at + bound));
            bits |= u64::from(may.bits()) << i;
            i += S::Packet::WIDTH;
        }
        bits
    }

    /// The test of [`crate::triangle`], of the targets of `ask`.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn exact_of(
        &self,
        x: [f32; 3],
        targets: &Targets<'_>,
        first: usize,
        count: usize,
        block: &TriangleBlock,
        lane: usize,
        ask: u64,
    ) -> u64 {
        let token = self.simd.token();
        let origin = vec3x::splat::<S::Packet>(token, x);
        let (begin, end) = (S::Packet::splat(token, 0.0), S::Packet::splat(token, 1.0));
        let mut blocked = 0;
        let mut i = 0;
        while i < count {
            let asked = ask >> i & ((1 << S::Packet::WIDTH) - 1);
            if asked != 0 {
                let direction =
                    vec3x::sub(targets_from::<S>(token, targets, first + i, first + count), origin);
                let turn = Turn::of(direction);
                let sheared = Sheared::new(token, turn, origin, direction, begin, end);
                blocked |= (u64::from(sheared.cross(token, Single { block, lane }).hit.bits()) & asked) << i;
            }
            i += S::Packet::WIDTH;
        }
        blocked
    }
}

/// How the points see the light, and which of them see it well.
#[inline(always)]
fn views<L: Lanes>(token: L::Token, flat: &Flat, x: Vec3x<L>) -> (Views<L>, u32) {
    let one = |value: f32| L::splat(token, value);
    let corner = vec3x::splat::<L>(token, flat.corner.to_array());
    let u = vec3x::splat::<L>(token, flat.u.to_array());
    let v = vec3x::splat::<L>(token, flat.v.to_array());
    let n = vec3x::splat::<L>(token, flat.normal.to_array());
    let c = vec3x::sub(corner, x);
    let height = vec3x::dot(n, c);
    let by_height = one(1.0) / height;
    let (c_size, n_most) = (vec3x::abs(c), flat.normal.abs().max_element());
    let clear = (vec3x::most(c_size) * one(1e-3 * n_most)).lt(height.abs());
    let rows =
        [times(vec3x::cross(v, c), by_height), times(vec3x::cross(c, u), by_height), times(n, by_height)];
    // Off the light's plane.
    let middle = one(0.5 * (flat.least[2] + flat.greatest[2]));
    let half = one(0.5 * (flat.greatest[2] - flat.least[2]));
    let off = [vec3x::dot(rows[0], n), vec3x::dot(rows[1], n), vec3x::dot(rows[2], n)];
    let to = [middle * off[0], middle * off[1], one(1.0) + middle * off[2]];
    // First-order bounds on what rounding does to the rows and to the height, in units of s, t and 1.
    let farthest = one(flat.near + flat.far);
    let sizes = [extent(flat.v), extent(flat.u), extent(flat.u) * extent(flat.v)];
    let steep = by_height.abs() * vec3x::most(c_size) * one(16.0 * ROUNDING);
    let lean = steep * one(sizes[2]);
    let (s_most, t_most) = (
        one(flat.least[0].abs().max(flat.greatest[0].abs())),
        one(flat.least[1].abs().max(flat.greatest[1].abs())),
    );
    let error = [
        one(flat.slack[0]) + half * off[0].abs() + steep * one(sizes[0]) * farthest + lean * s_most,
        one(flat.slack[1]) + half * off[1].abs() + steep * one(sizes[1]) * farthest + lean * t_most,
        half * off[2].abs() + lean + by_height.abs() * farthest * one(16.0 * ROUNDING * sizes[2]),
    ];
    // And what it does to a form where it is moved and asked.
    let forms = one(8.0 * ROUNDING);
    let error = [
        forms.mul_add(s_most + to[0].abs(), error[0]),
        forms.mul_add(t_most + to[1].abs(), error[1]),
        forms.mul_add(to[2].abs(), error[2]),
    ];
    let depth = to[2];
    let by_depth = one(1.0) / depth;
    let wide = [error[0] * one(4.0), error[1] * one(4.0), error[2] * one(4.0)];
    let far_s = s_most * wide[2] + wide[0];
    let far_t = t_most * wide[2] + wide[1];
    let sides = [
        (one(flat.least[0]) + to[0]) * by_depth - far_s,
        (one(flat.greatest[0]) + to[0]) * by_depth + far_s,
        (one(flat.least[1]) + to[1]) * by_depth - far_t,
        (one(flat.greatest[1]) + to[1]) * by_depth + far_t,
    ];
    let position = one(CAUTION * flat.position);
    let rounding = [sum(rows[0]) * position, sum(rows[1]) * position, sum(rows[2]) * position];
    let spans = one(1.0 / (16.0 * ROUNDING * CAUTION));
    let spans = [rounding[0] * spans, rounding[1] * spans, rounding[2] * spans];
    let aside = [s_most + to[0].abs() + wide[0], t_most + to[1].abs() + wide[1]];
    let clear = clear & in_range(token, spans, aside, [one(0.5), one(2.0)]);
    let clear = clear & one(0.5).lt(depth) & depth.lt(one(2.0)) & error[2].lt(one(0.01));
    let view = View {
        rounding,
        by_reach: one(16.0 * ROUNDING / flat.position),
        sides,
        depth: [depth - wide[2], depth + wide[2]],
        by_depth: by_depth * one(1.05),
        rectangle: [one(flat.least[0]), one(flat.greatest[0]), one(flat.least[1]), one(flat.greatest[1])],
        scale: [one(1.0), one(1.0)],
    };
    let plane = [n[0].mul_add(middle, c[0]), n[1].mul_add(middle, c[1]), n[2].mul_add(middle, c[2])];
    let [s0, s1, t0, t1] = view.rectangle;
    let corners = [
        away(plane, u, s0, v, t0),
        away(plane, u, s1, v, t0),
        away(plane, u, s0, v, t1),
        away(plane, u, s1, v, t1),
    ];
    (Views { x, rows, view, shift: Shift { to, error }, corners }, clear.bits())
}

#[inline(always)]
fn times<L: Lanes>(v: Vec3x<L>, by: L) -> Vec3x<L> {
    [v[0] * by, v[1] * by, v[2] * by]
}

#[inline(always)]
fn sum<L: Lanes>(v: Vec3x<L>) -> L {
    v[0].abs() + v[1].abs() + v[2].abs()
}

/// From a place, s along u and t along v.
#[inline(always)]
fn away<L: Lanes>(from: Vec3x<L>, u: Vec3x<L>, s: L, v: Vec3x<L>, t: L) -> Vec3x<L> {
    [
        u[0].mul_add(s, v[0].mul_add(t, from[0])),
        u[1].mul_add(s, v[1].mul_add(t, from[1])),
        u[2].mul_add(s, v[2].mul_add(t, from[2])),
    ]
}

impl<L: Lanes> Views<L> {
    /// A position from x in the coordinates of the light.
    #[inline(always)]
    fn project(&self, p: Vec3x<L>) -> Vec3x<L> {
        let [s, t, w] = &self.rows;
        [
            p[0].mul_add(s[0], p[1].mul_add(s[1], p[2] * s[2])),
            p[0].mul_add(t[0], p[1].mul_add(t[1], p[2] * t[2])),
            p[0].mul_add(w[0], p[1].mul_add(w[1], p[2] * w[2])),
        ]
    }

    /// Points that have some target on the other side of the triangle's plane, and those that are surely off it, on the
    /// side that the exact test finds too. `from_x` are its vertices from x.
    #[inline(always)]
    fn crosses(&self, token: L::Token, flat: &Flat, facet: &Facet, from_x: [Vec3x<L>; 3]) -> [L::Mask; 2] {
        let &Facet { normal, sizes, bound, .. } = facet;
        let thick = 0.5 * (flat.greatest[2] - flat.least[2]) * normal.dot(flat.normal).abs();
        let bound = L::splat(token, bound + thick);
        let n = vec3x::splat::<L>(token, normal.to_array());
        let plane = vec3x::dot(n, from_x[0]);
        // Seen from x, it is x itself that is not rounded: triangles of the surface that x lies on do not come between.
        let [x, y, z] = vec3x::splat::<L>(token, (sizes * (8.0 * ROUNDING)).to_array());
        let away = [farthest(from_x, 0), farthest(from_x, 1), farthest(from_x, 2)];
        let mut high = x.mul_add(away[0], y.mul_add(away[1], z * away[2]));
        let mut low = -high;
        let aside = (high + high).lt(plane.abs());
        let mut k = 0;
        while k < 4 {
            let [x, y, z] = self.corners[k];
            let at = n[0].mul_add(x, n[1].mul_add(y, n[2] * z));
            (low, high) = (low.min(at - bound), high.max(at + bound));
            k += 1;
        }
        [low.le(plane) & plane.le(high), aside]
    }
}

/// The greatest distance along an axis.
#[inline(always)]
fn farthest<L: Lanes>([a, b, c]: [Vec3x<L>; 3], axis: usize) -> L {
    a[axis].abs().max(b[axis].abs()).max(c[axis].abs())
}

/// Where the targets of a point lie on the light.
#[inline(always)]
fn place<S: Simd>(
    token: S::Token,
    flat: &Flat,
    targets: &Targets<'_>,
    first: usize,
    count: usize,
    abreast: &mut Abreast,
    k: usize,
) {
    let corner = vec3x::splat::<S::Packet>(token, flat.corner.to_array());
    let [sx, sy, sz] = vec3x::splat::<S::Packet>(token, flat.rows[0].to_array());
    let [tx, ty, tz] = vec3x::splat::<S::Packet>(token, flat.rows[1].to_array());
    let mut i = 0;
    while i < count {
        let [x, y, z] = vec3x::sub(targets_from::<S>(token, targets, first + i, first + count), corner);
        x.mul_add(sx, y.mul_add(sy, z * sz)).store(&mut abreast.s[k][i..]);
        x.mul_add(tx, y.mul_add(ty, z * tz)).store(&mut abreast.t[k][i..]);
        i += S::Packet::WIDTH;
    }
}

/// Targets of a point that its forms block for sure, and those that they may block.
#[inline(always)]
fn test<S: Simd>(
    token: S::Token,
    abreast: &Abreast,
    k: usize,
    count: usize,
    deep: bool,
    ask: u64,
) -> (u64, u64) {
    type P<S> = <S as Simd>::Packet;
    let forms = &abreast.forms;
    let one = |value: f32| P::<S>::splat(token, value);
    let e = [
        [one(forms.edges[0][0][k]), one(forms.edges[0][1][k]), one(forms.edges[0][2][k])],
        [one(forms.edges[1][0][k]), one(forms.edges[1][1][k]), one(forms.edges[1][2][k])],
        [one(forms.edges[2][0][k]), one(forms.edges[2][1][k]), one(forms.edges[2][2][k])],
    ];
    let bound = one(forms.edge_bound[k]);
    let volume = one(forms.volume[k]);
    let depth_bound = one(forms.depth_bound[k]);
    let width = (1u64 << P::<S>::WIDTH) - 1;
    let (mut blocked, mut unsure) = (0, 0);
    let mut i = 0;
    while i < count {
        let asked = ask >> i & width;
        if asked != 0 {
            let s = P::<S>::load(token, &abreast.s[k][i..]);
            let t = P::<S>::load(token, &abreast.t[k][i..]);
            let ab = s.mul_add(e[0][0], t.mul_add(e[0][1], e[0][2]));
            let bc = s.mul_add(e[1][0], t.mul_add(e[1][1], e[1][2]));
            let ca = s.mul_add(e[2][0], t.mul_add(e[2][1], e[2][2]));
            let inner = ab.min(bc).min(ca);
            let mut sure = bound.lt(inner);
            let mut maybe = (-bound).le(inner);
            if deep {
                let spare = (ab + bc + ca) - volume;
                sure = sure & depth_bound.lt(spare);
                maybe = maybe & (-depth_bound).le(spare);
            }
            let sure = u64::from(sure.bits()) & asked;
            blocked |= sure << i;
            unsure |= (u64::from(maybe.bits()) & asked & !sure) << i;
        }
        i += P::<S>::WIDTH;
    }
    (blocked, unsure)
}
