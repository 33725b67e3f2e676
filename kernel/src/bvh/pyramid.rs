//! One point and up to 64 targets, asked about all at once.
//!
//! With p a position seen from x, three linear functions S, T and W of p are chosen so that the targets lie at
//! `(s, t) = (S/W, T/W)` in a small rectangle at about one depth W: on a parallelogram light, its own
//! coordinates. Seen that way a segment is a point (s, t) with a depth w, a triangle abc is three linear forms
//!
//! ```text
//!     E_ab = det(a, b, (s, t, 1)),  E_bc,  E_ca,
//! ```
//!
//! and the segment meets the triangle when all of them have the sign of `V = det(a, b, c)` (which also says that
//! the triangle lies ahead of x) and `|V| <= w |E_ab + E_bc + E_ca|` (that it lies before the target). Two
//! multiply-adds a form and target, after a set-up of eight triangles side by side.
//!
//! These forms are filters. Their rounding is bounded; a target that is nearer to an edge than the bound is
//! asked again with the test of [`crate::triangle`]. So the answers are those of a single ray, bit for bit, and
//! as watertight.
//!
//! Boxes are culled against the planes of the pyramid from x over the rectangle, widened by more than that.

use super::batch::BatchScratch;
use super::packet::Rays;
use super::stream::{Start, Stream};
use super::{Bvh, Child, FARTHEST, NEAREST, Node, Part, ROUNDING, STACK, Targets};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::ray::Ray;
use crate::triangle::{Axes, Found, Sheared, Single, TriangleBlock, Turn, shear_one};
use crate::vec3x;
use arrayvec::ArrayVec;
use glam::Vec3;

/// After as many nodes the rest goes on in packets.
const HANDOVER: u32 = 4;

/// Targets a pyramid takes.
pub(super) const MOST: usize = 64;

/// Cells an axis of the rectangle is cut into, to tell which targets a box may hide.
const CELLS: usize = 32;

/// Nodes visited before boxes are asked which targets they may hide: in easy places there is nothing to gain.
const EASY: u32 = 3;

/// A block is tested ray by ray for as many targets or fewer.
const LEAF_LONE: u32 = 3;

/// Positions are taken to be off by 16 times as many roundings of the greatest of them: 32.
///
/// With P the greatest component of a triangle's vertices, seen from x, and u the rounding of one operation: the exact test
/// finds each sheared coordinate to 5 u P, and by their products, where a form is all but 0, to 2 u P more; S, T and W are
/// sums of three products, to 3 u P |row|. That is as if the vertices were off by 10 u P. A form is linear in two of them,
/// hence 20 u P; its own products and sums add 10 u of their terms. All that is less than 32 u P in each place of the bound on
/// a form. The places s and t of targets are off by 4 u of their terms.
pub(super) const CAUTION: f32 = 2.0;

/// Triangles that are nearer to x than this part of all positions count as no nearer, so that no bound vanishes.
const NEAREST_PART: f32 = 1.0 / 1024.0;

/// Volumes below are not told from 0.
const SMALLEST: f32 = 1e-36;

/// Subtrees yet to visit: how deep each begins, and the targets it may hide.
pub(super) type Stack = ArrayVec<(Child, f32, u64), STACK>;

/// Up to 64 targets as seen from x.
pub(super) struct Pyramid {
    pub(super) x: Vec3,
    /// The linear functions S, T and W, by rows.
    rows: [Vec3; 3],
    /// Directions to the targets, by axis.
    pub(super) direction: [[f32; MOST]; 3],
    /// Targets in the pyramid's coordinates.
    s: [f32; MOST],
    t: [f32; MOST],
    w: [f32; MOST],
    pub(super) count: usize,
    /// For each axis, the targets whose direction is longest along it.
    along: [u64; 3],
    /// Least and greatest s, t and w.
    least: Vec3,
    greatest: Vec3,
    /// What S, T and W of the farthest position may be off by.
    rounding: Vec3,
    /// Greatest distance of anything from x, along an axis.
    reach: f32,
    /// One over the least depth, and more where targets are farther away than the reach.
    by_depth: f32,
    planes: [Plane; 5],
    /// `before[axis][k]`: targets in the cells before cell `k` of that axis. Filled when first needed.
    before: [[u64; CELLS + 1]; 2],
    /// How s and t become cells: `(value - least) * scale`.
    scale: [f32; 2],
    /// Directions to the corners of the rectangle at the least and the greatest depth.
    corners: [Vec3; 8],
    /// The greatest component of a direction to a target.
    pub(super) farthest: f32,
    /// The box around x and the targets.
    lower: Vec3,
    upper: Vec3,
}

/// Positions with `normal . position + offset >= 0` may be in the pyramid.
#[derive(Clone, Copy, Default)]
struct Plane {
    normal: Vec3,
    offset: f32,
    /// Which corner of a box reaches farthest inside, by axis: 0 the least, 1 the greatest.
    side: [usize; 3],
}

impl Plane {
    /// With `normal . (p - x) + at >= 0` inside, and as much beyond as the slack says.
    #[inline(always)]
    fn new(normal: Vec3, at: f32, x: Vec3, slack: f32) -> Self {
        Self {
            normal,
            offset: at - normal.dot(x) + slack,
            side: [usize::from(normal.x > 0.0), usize::from(normal.y > 0.0), usize::from(normal.z > 0.0)],
        }
    }
}

impl Plane {
    /// Where a coordinate, which is a row over that of the depth, is beyond `edge` to the side of `sign`, seen from x;
    /// and as much beyond as the slacks of the rows say.
    #[inline(always)]
    fn side([row, depth]: [Vec3; 2], edge: f32, sign: f32, x: Vec3, slack: [f32; 2]) -> Self {
        Self::new((row - depth * edge) * sign, 0.0, x, slack[0] + edge.abs() * slack[1])
    }

    /// How far inside positions are.
    #[inline(always)]
    fn at<L: Lanes>(&self, token: L::Token, [x, y, z]: [L; 3]) -> L {
        x.mul_add(
            L::splat(token, self.normal.x),
            y.mul_add(
                L::splat(token, self.normal.y),
                z.mul_add(L::splat(token, self.normal.z), L::splat(token, self.offset)),
            ),
        )
    }
}

/// Triangles as forms, by lane.
pub(super) struct Forms {
    /// The forms' coefficients of s, t and 1.
    pub(super) edges: [[[f32; 16]; 3]; 3],
    /// `|V|`: what the sum of the edges must reach at depth 1.
    pub(super) volume: [f32; 16],
    /// Above this a form is surely positive, below minus this surely negative.
    pub(super) edge_bound: [f32; 16],
    pub(super) depth_bound: [f32; 16],
}

impl Forms {
    pub(super) const NOTHING: Self =
        Self { edges: [[[0.0; 16]; 3]; 3], volume: [0.0; 16], edge_bound: [0.0; 16], depth_bound: [0.0; 16] };
}

/// The targets as seen from x, in the coordinates S, T and W: a triangle a lane, or a point a lane.
pub(super) struct View<L> {
    /// What S, T and W of the farthest position may be off by; of nearer ones as much less as they are nearer.
    pub(super) rounding: [L; 3],
    /// One over the greatest component of any position from x.
    pub(super) by_reach: L,
    /// Least and greatest S/W, then T/W, of the targets.
    pub(super) sides: [L; 4],
    /// Least and greatest W of the targets.
    pub(super) depth: [L; 2],
    /// One over the least. More where the targets are farther away than anything in the scene, unless a shift tells
    /// what they are off by.
    pub(super) by_depth: L,
    /// Least and greatest s, then t, that forms are asked for.
    pub(super) rectangle: [L; 4],
    /// What forms are to be multiplied by at least and at most to be those of the targets.
    pub(super) scale: [L; 2],
}

/// Triangles as forms, and what is clear of them already.
pub(super) struct Outline<L: Lanes> {
    edges: [[L; 3]; 3],
    volume: L,
    bound: L,
    depth_bound: L,
    /// Large enough to be told from one seen edge-on.
    pub(super) known: L::Mask,
    /// If known, may block something.
    pub(super) open: L::Mask,
    /// If known, hides all directions.
    pub(super) every: L::Mask,
    /// If known, stands before every target.
    pub(super) before: L::Mask,
}

/// How forms of S, T and W become forms of other coordinates, s and t: with (s + a, t + b, c) in their place; and what
/// these three may be off by.
pub(super) struct Shift<L> {
    pub(super) to: [L; 3],
    pub(super) error: [L; 3],
}

impl<L: Lanes> View<L> {
    /// Triangles that have not all vertices behind one side of the pyramid, widened.
    #[inline(always)]
    pub(super) fn meets(&self, [a, b, c]: [[L; 3]; 3]) -> L::Mask {
        let [ds, dt, dw] = self.rounding;
        let [s0, s1, t0, t1] = self.sides;
        let deepest = a[2].max(b[2]).max(c[2]);
        let nearest = a[2].min(b[2]).min(c[2]);
        let (far_s, far_t) = (s0.abs().max(s1.abs()), t0.abs().max(t1.abs()));
        let (wide_s, wide_t) = (dw.mul_add(far_s, ds), dw.mul_add(far_t, dt));
        let mut open = (-wide_s).le(beyond(a, s0, 0).max(beyond(b, s0, 0)).max(beyond(c, s0, 0)));
        open = open & (-wide_s).le(short(a, s1, 0).max(short(b, s1, 0)).max(short(c, s1, 0)));
        open = open & (-wide_t).le(beyond(a, t0, 1).max(beyond(b, t0, 1)).max(beyond(c, t0, 1)));
        open = open & (-wide_t).le(short(a, t1, 1).max(short(b, t1, 1)).max(short(c, t1, 1)));
        open & (-dw).le(deepest) & nearest.le(self.depth[1] + dw)
    }

    /// The forms of triangles; `span` is the greatest component of their vertices from x.
    #[inline(always)]
    pub(super) fn outline(
        &self,
        token: L::Token,
        [a, b, c]: [[L; 3]; 3],
        span: L,
        shift: Option<&Shift<L>>,
    ) -> Outline<L> {
        let one = |value: f32| L::splat(token, value);
        let zero = one(0.0);
        let [ds, dt, dw] = self.rounding;
        let [s0, s1, t0, t1] = self.sides;
        let [w0, w1] = self.depth;
        let (far_s, far_t) = (s0.abs().max(s1.abs()), t0.abs().max(t1.abs()));
        let deepest = a[2].max(b[2]).max(c[2]);
        let (ab, bc, ca) = (vec3x::cross(a, b), vec3x::cross(b, c), vec3x::cross(c, a));
        let volume = ab[0] * c[0] + ab[1] * c[1] + ab[2] * c[2];

        // What a vertex is off by goes with how far the triangle is from x. No size counts as less than that, so that
        // the second order is bounded too.
        let part = (span * self.by_reach).max(one(NEAREST_PART));
        let big_s = a[0].abs().max(b[0].abs()).max(c[0].abs().max(ds * part));
        let big_t = a[1].abs().max(b[1].abs()).max(c[1].abs().max(dt * part));
        let big_w = a[2].abs().max(b[2].abs()).max(c[2].abs().max(dw * part));
        // Bounds on a form: by its vertices, and by the coordinates of targets.
        let aside = ds * big_t + dt * big_s + dw * (far_s * big_t + far_t * big_s);
        let of_vertices = (aside + (ds * far_t + dt * far_s) * big_w) * part;
        let far = big_w * self.by_depth;
        let of_targets = aside * far;
        let mut bound = match shift {
            // Of targets the shift tells.
            Some(_) => of_vertices * w1,
            None => of_vertices + of_targets * one(0.5),
        };
        // Depth is told with more care: the test of a single ray finds it in another way.
        let with_care = (of_vertices + of_targets) * one(4.0);
        let across = dw * big_s * big_t;
        let volume_bound = (ds * big_t * big_w + dt * big_s * big_w + across) * (part * one(6.0));
        let sign = L::select(volume.lt(zero), one(-1.0), one(1.0));
        let volume = volume.abs();

        let (mut ab, mut bc, mut ca) = (scale(ab, sign), scale(bc, sign), scale(ca, sign));
        if let Some(shift) = shift {
            let mut k = 0;
            while k < 3 {
                let most = ab[k].abs().max(bc[k].abs()).max(ca[k].abs());
                bound = bound + most * shift.error[k];
                k += 1;
            }
            (ab[2], bc[2], ca[2]) = (shift.apply(ab), shift.apply(bc), shift.apply(ca));
        }
        // Each form over the rectangle: nowhere positive, or everywhere.
        let [s0, s1, t0, t1] = self.rectangle;
        let high = highest(ab, s0, s1, t0, t1).min(highest(bc, s0, s1, t0, t1));
        let high = high.min(highest(ca, s0, s1, t0, t1));
        let low = lowest(ab, s0, s1, t0, t1).min(lowest(bc, s0, s1, t0, t1));
        let low = low.min(lowest(ca, s0, s1, t0, t1));
        let every = bound.lt(low);
        // Beyond every target, or before all of them.
        let sum = [ab[0] + bc[0] + ca[0], ab[1] + bc[1] + ca[1], ab[2] + bc[2] + ca[2]];
        let forms_bound = (bound + with_care) * one(3.0);
        let forms_bound = match shift {
            Some(_) => forms_bound * w1.max(one(1.0)),
            None => forms_bound * w1,
        };
        let depth_bound = volume_bound + across * far + forms_bound;
        let (low_sum, high_sum) = (lowest(sum, s0, s1, t0, t1), highest(sum, s0, s1, t0, t1));
        let [m0, m1] = self.scale;
        let reached = volume.le((high_sum * m1).max(high_sum * m0) + depth_bound);
        let before = (volume + depth_bound).lt((low_sum * m0).min(low_sum * m1)) | deepest.lt(w0 * one(0.5));
        Outline {
            edges: [ab, bc, ca],
            volume,
            bound,
            depth_bound,
            known: volume_bound.max(one(SMALLEST)).lt(volume),
            open: (-bound).le(high) & reached,
            every,
            before,
        }
    }
}

impl<L: Lanes> Shift<L> {
    #[inline(always)]
    fn apply(&self, e: [L; 3]) -> L {
        e[0].mul_add(self.to[0], e[1].mul_add(self.to[1], e[2] * self.to[2]))
    }
}

impl<L: Lanes> Outline<L> {
    /// Writes the forms of lanes from the `from`th on.
    #[inline(always)]
    pub(super) fn store(&self, forms: &mut Forms, from: usize) {
        let mut edge = 0;
        while edge < 3 {
            let mut k = 0;
            while k < 3 {
                self.edges[edge][k].store(&mut forms.edges[edge][k][from..]);
                k += 1;
            }
            edge += 1;
        }
        self.volume.store(&mut forms.volume[from..]);
        self.bound.store(&mut forms.edge_bound[from..]);
        self.depth_bound.store(&mut forms.depth_bound[from..]);
    }
}

/// What the set-up says of the triangles of a block.
struct Verdict {
    /// May block some target.
    open: u32,
    /// Blocks every target.
    all: u32,
    /// Needs the exact test for every target.
    unclear: u32,
    /// May reach beyond a target, so that depth must be tested.
    deep: u32,
}

/// What S, T and W of the scene must each exceed, and multiplied with each other, so that no form vanishes by underflow;
/// and what they must not exceed, multiplied with each other and with what is asked of the forms.
const RANGE: [f32; 3] = [1e-12, 1e-24, 1e34];

/// Are these greatest S, T and W in range, with targets as far aside, and from as near to as far? NaN is not.
#[inline(always)]
pub(super) fn in_range<L: Lanes>(
    token: L::Token,
    [s, t, w]: [L; 3],
    aside: [L; 2],
    [near, far]: [L; 2],
) -> L::Mask {
    let [least, little, much] =
        [L::splat(token, RANGE[0]), L::splat(token, RANGE[1]), L::splat(token, RANGE[2])];
    let deep = w + far;
    let most = (s + aside[0] * deep) * (t + aside[1] * deep) * deep;
    let large = least.lt(s) & least.lt(t) & least.lt(w) & little.lt(s * t * w);
    large & most.lt(much) & most.lt(much * near)
}

/// The sum of absolute components.
#[inline(always)]
pub(super) fn extent(v: Vec3) -> f32 {
    let v = v.abs();
    v.x + v.y + v.z
}

impl Pyramid {
    /// Aims at `count` targets from the `from`th on. False where they do not lie in one pyramid: on both sides of
    /// x, at very different depths, or where anything is not finite or too far away for the forms.
    #[inline(always)]
    pub(super) fn aim<S: Simd>(
        &mut self,
        simd: S,
        x: Vec3,
        targets: &Targets<'_>,
        from: usize,
        count: usize,
        magnitude: f32,
    ) -> bool {
        simd.apart(
            #[inline(always)]
            || self.aim_here(simd, x, targets, from, count, magnitude),
        )
    }

    #[inline(always)]
    fn aim_here<S: Simd>(
        &mut self,
        simd: S,
        x: Vec3,
        targets: &Targets<'_>,
        from: usize,
        count: usize,
        magnitude: f32,
    ) -> bool {
        let token = simd.token();
        let this = self;
        this.x = x;
        this.count = count;
        for axis in 0..3 {
            let ends = &targets.axis(axis)[from..from + count];
            let at = x[axis];
            let directions = &mut this.direction[axis];
            let mut i = 0;
            while i < count {
                directions[i] = ends[i] - at;
                i += 1;
            }
            // Unused lanes repeat the last target, so that no vector holds anything odd.
            let last = directions[count - 1];
            let until = count.next_multiple_of(16);
            while i < until {
                directions[i] = last;
                i += 1;
            }
        }
        let Some((rows, columns)) = targets.frame(x, &this.direction, count) else { return false };
        this.rows = rows;
        this.reach = magnitude + x.abs().max_element();

        type P<S> = <S as Simd>::Packet;
        let (first, last) = (P::<S>::splat(token, f32::INFINITY), P::<S>::splat(token, f32::NEG_INFINITY));
        let (mut low, mut high) = ([first; 3], [last; 3]);
        let (mut near, mut far) = ([first; 3], [last; 3]);
        // Stays 0 as long as all is finite; the least and the greatest may lose what is not a number.
        let mut odd = P::<S>::splat(token, 0.0);
        let mut along = [0u64; 3];
        let mut i = 0;
        while i < count {
            let d = [
                P::<S>::load(token, &this.direction[0][i..]),
                P::<S>::load(token, &this.direction[1][i..]),
                P::<S>::load(token, &this.direction[2][i..]),
            ];
            let w = dot::<S>(token, rows[2], d);
            let s = dot::<S>(token, rows[0], d) / w;
            let t = dot::<S>(token, rows[1], d) / w;
            s.store(&mut this.s[i..]);
            t.store(&mut this.t[i..]);
            w.store(&mut this.w[i..]);
            odd = odd + (s + t + w) * P::<S>::splat(token, 0.0);
            let [a, b, c] = vec3x::abs(d);
            let first = (b.le(a) & c.le(a)).bits();
            let second = c.le(b).bits() & !first;
            along[0] |= u64::from(first) << i;
            along[1] |= u64::from(second) << i;
            low = [low[0].min(s), low[1].min(t), low[2].min(w)];
            high = [high[0].max(s), high[1].max(t), high[2].max(w)];
            near = [near[0].min(d[0]), near[1].min(d[1]), near[2].min(d[2])];
            far = [far[0].max(d[0]), far[1].max(d[1]), far[2].max(d[2])];
            i += P::<S>::WIDTH;
        }
        let every = u64::MAX >> (64 - count);
        this.along = [along[0] & every, along[1] & every, !(along[0] | along[1]) & every];
        let least = Vec3::new(least_of(low[0]), least_of(low[1]), least_of(low[2]));
        let greatest = Vec3::new(greatest_of(high[0]), greatest_of(high[1]), greatest_of(high[2]));
        (this.least, this.greatest) = (least, greatest);
        // Written so that NaN fails.
        let finite = greatest.is_finite() && least.is_finite() && sum_of(odd) == 0.0;
        if !(least.z > 0.0 && greatest.z <= 4.0 * least.z && finite) {
            return false;
        }
        let sizes = Vec3::new(extent(rows[0]), extent(rows[1]), extent(rows[2]));
        let aside = least.abs().max(greatest.abs());
        let long = extent(columns[0]) * aside.x + extent(columns[1]) * aside.y + extent(columns[2]);
        let spans = [sizes.x * this.reach, sizes.y * this.reach, sizes.z * this.reach];
        if !(in_range((), spans, [aside.x, aside.y], [least.z, greatest.z])
            && this.reach > NEAREST
            && long * greatest.z < FARTHEST)
        {
            return false;
        }
        let position = 16.0 * ROUNDING * this.reach;
        this.rounding = sizes * (CAUTION * position);
        let slack = [4.0 * position * sizes.x, 4.0 * position * sizes.y, 4.0 * position * sizes.z];
        this.planes = [
            Plane::side([rows[0], rows[2]], least.x, 1.0, x, [slack[0], slack[2]]),
            Plane::side([rows[0], rows[2]], greatest.x, -1.0, x, [slack[0], slack[2]]),
            Plane::side([rows[1], rows[2]], least.y, 1.0, x, [slack[1], slack[2]]),
            Plane::side([rows[1], rows[2]], greatest.y, -1.0, x, [slack[1], slack[2]]),
            Plane::new(-rows[2], greatest.z, x, slack[2]),
        ];
        let mut k = 0;
        while k < 8 {
            let s = if k & 1 == 0 { least.x } else { greatest.x };
            let t = if k & 2 == 0 { least.y } else { greatest.y };
            let w = if k & 4 == 0 { least.z } else { greatest.z };
            this.corners[k] = (columns[0] * s + columns[1] * t + columns[2]) * w;
            k += 1;
        }
        let near = Vec3::new(least_of(near[0]), least_of(near[1]), least_of(near[2])).min(Vec3::ZERO);
        let far = Vec3::new(greatest_of(far[0]), greatest_of(far[1]), greatest_of(far[2])).max(Vec3::ZERO);
        this.farthest = far.max(-near).max_element();
        this.by_depth = (this.farthest / this.reach).max(1.0) / least.z;
        if !this.by_depth.is_finite() {
            return false;
        }
        this.lower = x + near - position;
        this.upper = x + far + position;
        true
    }

    /// One bit for each target.
    #[inline(always)]
    pub(super) fn every(&self) -> u64 {
        u64::MAX >> (64 - self.count)
    }

    pub(super) const EMPTY: Self = Self {
        x: Vec3::ZERO,
        rows: [Vec3::ZERO; 3],
        direction: [[0.0; MOST]; 3],
        s: [0.0; MOST],
        t: [0.0; MOST],
        w: [0.0; MOST],
        count: 0,
        along: [0; 3],
        least: Vec3::ZERO,
        greatest: Vec3::ZERO,
        rounding: Vec3::ZERO,
        reach: 0.0,
        by_depth: 0.0,
        planes: [Plane { normal: Vec3::ZERO, offset: 0.0, side: [0; 3] }; 5],
        before: [[0; CELLS + 1]; 2],
        scale: [0.0; 2],
        corners: [Vec3::ZERO; 8],
        farthest: 0.0,
        lower: Vec3::ZERO,
        upper: Vec3::ZERO,
    };

    /// Which children of a node the pyramid may meet, and how deep each begins.
    #[inline(always)]
    pub(super) fn children<S: Simd>(&self, simd: S, node: &Node, depth: &mut [f32; 8]) -> u32 {
        type N<S> = <S as Simd>::Node;
        let token = simd.token();
        let mut met = 0;
        let mut from = 0;
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
            let mut k = 0;
            let zero = N::<S>::splat(token, 0.0);
            let mut reach = zero;
            while k < 5 {
                let plane = &self.planes[k];
                let x = bounds[plane.side[0] & 1][0];
                let y = bounds[plane.side[1] & 1][1];
                let z = bounds[plane.side[2] & 1][2];
                reach = plane.at::<N<S>>(token, [x, y, z]);
                inside = inside & zero.le(reach);
                k += 1;
            }
            // The last plane looks back from the targets: the deeper inside, the nearer to x.
            (-reach).store(&mut depth[from..]);
            met |= inside.bits() << from;
            from += N::<S>::WIDTH;
        }
        met
    }

    /// Sorts the targets into cells.
    #[inline(always)]
    fn sort(&mut self) {
        let mut axis = 0;
        while axis < 2 {
            let (least, greatest) = (self.least[axis], self.greatest[axis]);
            let width = greatest - least;
            // So narrow a range is not cut, for the scale must be finite.
            let scale = if width > 1e-30 { CELLS as f32 / width } else { 0.0 };
            self.scale[axis] = scale;
            let values = if axis == 0 { &self.s } else { &self.t };
            let mut cells = [0u64; CELLS];
            let mut i = 0;
            while i < self.count {
                cells[cell((values[i] - least) * scale)] |= 1 << i;
                i += 1;
            }
            let mut sum = 0;
            let mut k = 0;
            while k < CELLS {
                self.before[axis][k] = sum;
                sum |= cells[k];
                k += 1;
            }
            self.before[axis][CELLS] = sum;
            axis += 1;
        }
    }

    /// Which targets each child of a node may hide, of those it meets.
    #[inline(always)]
    fn hidden<S: Simd>(&self, simd: S, node: &Node, mut met: u32, ask: &mut [u64; 8]) {
        type N<S> = <S as Simd>::Node;
        let token = simd.token();
        let one = |value: f32| N::<S>::splat(token, value);
        let mut ranges = [[0.0f32; 8]; 4];
        let mut from = 0;
        let x = vec3x::splat::<N<S>>(token, self.x.to_array());
        let half = one(0.5);
        while from < Node::WIDTH {
            let low = vec3x::load::<N<S>, 8>(token, &node.bounds[0], from);
            let high = vec3x::load::<N<S>, 8>(token, &node.bounds[1], from);
            // Unused children hold infinities and come out as NaN; they are not among those met.
            let centre = [
                (low[0] + high[0]) * half - x[0],
                (low[1] + high[1]) * half - x[1],
                (low[2] + high[2]) * half - x[2],
            ];
            let size = [(high[0] - low[0]) * half, (high[1] - low[1]) * half, (high[2] - low[2]) * half];
            let (s, s_half) = self.span(simd, centre, size, 0);
            let (t, t_half) = self.span(simd, centre, size, 1);
            let (w, w_half) = self.span(simd, centre, size, 2);
            let (near, far) = (w - w_half, w + w_half);
            let zero = one(0.0);
            let ahead = zero.lt(near);
            let (by_near, by_far) = (one(1.0) / near, one(1.0) / far);
            let mut axis = 0;
            while axis < 2 {
                let (centre, size) = if axis == 0 { (s, s_half) } else { (t, t_half) };
                let (least, most) = (centre - size, centre + size);
                let (least, scale) =
                    ((least * by_near).min(least * by_far), (one(self.least[axis]), one(self.scale[axis])));
                let most = (most * by_near).max(most * by_far);
                let (low, high) = ((least - scale.0) * scale.1, (most - scale.0) * scale.1);
                let last = one(CELLS as f32 - 1.0);
                // Rounding of the last steps, in cells.
                let slip = one(1e-3);
                N::<S>::select(ahead, low - slip, zero)
                    .max(zero)
                    .min(last)
                    .store(&mut ranges[2 * axis][from..]);
                N::<S>::select(ahead, high + slip, last)
                    .max(zero)
                    .min(last)
                    .store(&mut ranges[2 * axis + 1][from..]);
                axis += 1;
            }
            from += N::<S>::WIDTH;
        }
        while met != 0 {
            let place = met.trailing_zeros() as usize & 7;
            met &= met - 1;
            let [s, t] = &self.before;
            let within_s = s[cell(ranges[1][place]) + 1] & !s[cell(ranges[0][place])];
            let within_t = t[cell(ranges[3][place]) + 1] & !t[cell(ranges[2][place])];
            ask[place] = within_s & within_t;
        }
    }

    /// The middle and the half width of a linear function over boxes, widened by its rounding.
    #[inline(always)]
    fn span<S: Simd>(
        &self,
        simd: S,
        centre: [S::Node; 3],
        size: [S::Node; 3],
        k: usize,
    ) -> (S::Node, S::Node) {
        let [x, y, z] = vec3x::splat::<S::Node>(simd.token(), self.rows[k].abs().to_array());
        let half = size[0].mul_add(x, size[1].mul_add(y, size[2] * z));
        (self.row(simd, centre, k), half + S::Node::splat(simd.token(), self.rounding[k]))
    }

    /// The ray to a target.
    #[inline(always)]
    fn ray(&self, i: usize) -> Ray {
        let i = i & (MOST - 1);
        let direction = Vec3::new(self.direction[0][i], self.direction[1][i], self.direction[2][i]);
        Ray { origin: self.x, direction, t_min: 0.0, t_max: 1.0 }
    }

    /// The dominant axis of the ray to a target.
    #[inline(always)]
    fn axis(&self, i: usize) -> usize {
        if self.along[0] >> i & 1 != 0 {
            0
        } else if self.along[1] >> i & 1 != 0 {
            1
        } else {
            2
        }
    }

    /// Turns the triangles of a block into forms and says what is clear already.
    #[inline(always)]
    fn set_up<S: Simd>(&self, simd: S, block: &TriangleBlock, forms: &mut Forms) -> Verdict {
        let token = simd.token();
        let mut verdict = Verdict { open: 0, all: 0, unclear: 0, deep: 0 };
        let mut from = 0;
        while from < TriangleBlock::WIDTH {
            self.set_up_lanes(token, simd, block, from, forms, &mut verdict);
            from += S::Node::WIDTH;
        }
        verdict
    }

    #[inline(always)]
    fn set_up_lanes<S: Simd>(
        &self,
        token: S::Token,
        simd: S,
        block: &TriangleBlock,
        from: usize,
        forms: &mut Forms,
        verdict: &mut Verdict,
    ) {
        type N<S> = <S as Simd>::Node;
        let one = |value: f32| N::<S>::splat(token, value);
        let x = vec3x::splat::<N<S>>(token, self.x.to_array());
        // Positions from x: the same differences, with the same rounding, as in the exact test.
        let a = vec3x::sub(vec3x::load(token, &block.vertices[0], from), x);
        let b = vec3x::sub(vec3x::load(token, &block.vertices[1], from), x);
        let c = vec3x::sub(vec3x::load(token, &block.vertices[2], from), x);
        let from_x = [a, b, c];
        let a = self.project(simd, a);
        let b = self.project(simd, b);
        let c = self.project(simd, c);
        let (w0, w1) = (one(self.least.z), one(self.greatest.z));
        let rectangle = [one(self.least.x), one(self.greatest.x), one(self.least.y), one(self.greatest.y)];
        let view = View {
            rounding: [one(self.rounding.x), one(self.rounding.y), one(self.rounding.z)],
            by_reach: one(1.0 / self.reach),
            sides: rectangle,
            depth: [w0, w1],
            by_depth: one(self.by_depth),
            rectangle,
            scale: [w0, w1],
        };
        let mut open = view.meets([a, b, c]);
        if !open.any() {
            return;
        }

        // Planes with x and all targets on one side, from unscaled positions: the surface x lies on and the
        // light's own plane are told from things in between by the clearance alone.
        let span = span_of(from_x);
        let [crosses, aside] = self.crosses(simd, from_x, span);
        open = open & crosses;
        let mut left = open.bits();
        if left == 0 {
            return;
        }
        let outline = view.outline(token, [a, b, c], span, None);
        let known = (outline.known & aside).bits();
        left &= !known | outline.open.bits();
        if left == 0 {
            return;
        }
        let before = outline.before.bits() & known;
        verdict.open |= left << from;
        verdict.all |= (left & before & outline.every.bits()) << from;
        verdict.unclear |= (left & !known) << from;
        verdict.deep |= (left & !before) << from;
        outline.store(forms, from);
    }

    /// Triangles, by their vertices from x, whose planes may pass between x and a target; and those whose planes x is
    /// surely off, on the side that the exact test finds too.
    #[inline(always)]
    fn crosses<S: Simd>(
        &self,
        simd: S,
        [a, b, c]: [[S::Node; 3]; 3],
        span: S::Node,
    ) -> [<S::Node as Lanes>::Mask; 2] {
        let token = simd.token();
        let (e, f) = (vec3x::sub(b, a), vec3x::sub(c, a));
        let (e_size, f_size) = (vec3x::abs(e), vec3x::abs(f));
        let n = vec3x::cross(e, f);
        // What the products of the normal are at most, and so what its rounding goes by.
        let n_size = (e_size[1] * f_size[2] + e_size[2] * f_size[1])
            + (e_size[2] * f_size[0] + e_size[0] * f_size[2])
            + (e_size[0] * f_size[1] + e_size[1] * f_size[0]);
        let far = span.max(S::Node::splat(token, self.farthest));
        let n_bound = n_size * S::Node::splat(token, 8.0 * ROUNDING);
        let bound = n_bound * far;
        let plane = vec3x::dot(n, a);
        let mut low = S::Node::splat(token, 0.0);
        let mut high = low;
        let mut k = 0;
        while k < 8 {
            let d = self.corners[k];
            let at = n[0].mul_add(
                S::Node::splat(token, d.x),
                n[1].mul_add(S::Node::splat(token, d.y), n[2] * S::Node::splat(token, d.z)),
            );
            (low, high) = (low.min(at), high.max(at));
            k += 1;
        }
        // `low` and `high` start at 0, where x is.
        let aside = (n_bound * (span + span)).lt(plane.abs());
        [(low - bound).le(plane) & plane.le(high + bound), aside]
    }

    /// A position in the pyramid's coordinates.
    #[inline(always)]
    fn project<S: Simd>(&self, simd: S, p: [S::Node; 3]) -> [S::Node; 3] {
        [self.row(simd, p, 0), self.row(simd, p, 1), self.row(simd, p, 2)]
    }

    #[inline(always)]
    fn row<S: Simd>(&self, simd: S, p: [S::Node; 3], k: usize) -> S::Node {
        let [x, y, z] = vec3x::splat::<S::Node>(simd.token(), self.rows[k].to_array());
        p[0].mul_add(x, p[1].mul_add(y, p[2] * z))
    }

    /// Which targets of `ask` the triangle of a lane blocks.
    #[inline(always)]
    fn test<S: Simd>(
        &self,
        simd: S,
        forms: &Forms,
        block: &TriangleBlock,
        lane: usize,
        deep: bool,
        ask: u64,
    ) -> u64 {
        type P<S> = <S as Simd>::Packet;
        let token = simd.token();
        let one = |value: f32| P::<S>::splat(token, value);
        let e = [
            [one(forms.edges[0][0][lane]), one(forms.edges[0][1][lane]), one(forms.edges[0][2][lane])],
            [one(forms.edges[1][0][lane]), one(forms.edges[1][1][lane]), one(forms.edges[1][2][lane])],
            [one(forms.edges[2][0][lane]), one(forms.edges[2][1][lane]), one(forms.edges[2][2][lane])],
        ];
        let bound = one(forms.edge_bound[lane]);
        let volume = one(forms.volume[lane]);
        let depth_bound = one(forms.depth_bound[lane]);
        let width = (1u64 << P::<S>::WIDTH) - 1;
        let mut blocked = 0;
        let mut i = 0;
        while i < self.count {
            let asked = ask >> i & width;
            if asked != 0 {
                let s = P::<S>::load(token, &self.s[i..]);
                let t = P::<S>::load(token, &self.t[i..]);
                let ab = s.mul_add(e[0][0], t.mul_add(e[0][1], e[0][2]));
                let bc = s.mul_add(e[1][0], t.mul_add(e[1][1], e[1][2]));
                let ca = s.mul_add(e[2][0], t.mul_add(e[2][1], e[2][2]));
                let inner = ab.min(bc).min(ca);
                let mut sure = bound.lt(inner);
                let mut maybe = (-bound).le(inner);
                if deep {
                    let w = P::<S>::load(token, &self.w[i..]);
                    let spare = (ab + bc + ca) * w - volume;
                    sure = sure & depth_bound.lt(spare);
                    maybe = maybe & (-depth_bound).le(spare);
                }
                let sure = u64::from(sure.bits()) & asked;
                let unsure = u64::from(maybe.bits()) & asked & !sure;
                blocked |= sure << i;
                if unsure != 0 {
                    blocked |= self.exact(simd, block, lane, i, unsure) << i;
                }
            }
            i += P::<S>::WIDTH;
        }
        blocked
    }

    /// The exact test of targets `i` on, those of `ask`.
    #[inline(always)]
    fn exact<S: Simd>(&self, simd: S, block: &TriangleBlock, lane: usize, i: usize, ask: u64) -> u64 {
        let token = simd.token();
        let direction = [
            S::Packet::load(token, &self.direction[0][i..]),
            S::Packet::load(token, &self.direction[1][i..]),
            S::Packet::load(token, &self.direction[2][i..]),
        ];
        let origin = vec3x::splat(token, self.x.to_array());
        let (begin, end) = (S::Packet::splat(token, 0.0), S::Packet::splat(token, 1.0));
        let mut blocked = 0;
        let mut axis = 0;
        while axis < 3 {
            let asked = ask & (self.along[axis] >> i);
            if asked != 0 {
                let sheared = Sheared::new(token, Turn::Same(Axes::of(axis)), origin, direction, begin, end);
                blocked |= u64::from(sheared.cross(token, Single { block, lane }).hit.bits()) & asked;
            }
            axis += 1;
        }
        blocked
    }
}

/// The greatest component of three vectors.
#[inline(always)]
pub(super) fn span_of<L: Lanes>([a, b, c]: [[L; 3]; 3]) -> L {
    vec3x::most(vec3x::abs(a)).max(vec3x::most(vec3x::abs(b))).max(vec3x::most(vec3x::abs(c)))
}

/// The cell of a scaled coordinate; what lies outside goes to the first or the last.
#[inline(always)]
fn cell(at: f32) -> usize {
    (at as usize).min(CELLS - 1)
}

#[inline(always)]
fn scale<L: Lanes>(v: [L; 3], by: L) -> [L; 3] {
    [v[0] * by, v[1] * by, v[2] * by]
}

/// How far a vertex is beyond the plane where coordinate `k` over depth is `at`.
#[inline(always)]
fn beyond<L: Lanes>(v: [L; 3], at: L, k: usize) -> L {
    v[k] - v[2] * at
}

/// How far it is short of that plane.
#[inline(always)]
fn short<L: Lanes>(v: [L; 3], at: L, k: usize) -> L {
    v[2] * at - v[k]
}

/// The least value of a form over a rectangle.
#[inline(always)]
fn lowest<L: Lanes>(e: [L; 3], s0: L, s1: L, t0: L, t1: L) -> L {
    (e[0] * s0).min(e[0] * s1) + (e[1] * t0).min(e[1] * t1) + e[2]
}

/// The greatest value of a form over a rectangle.
#[inline(always)]
fn highest<L: Lanes>(e: [L; 3], s0: L, s1: L, t0: L, t1: L) -> L {
    (e[0] * s0).max(e[0] * s1) + (e[1] * t0).max(e[1] * t1) + e[2]
}

#[inline(always)]
fn dot<S: Simd>(token: S::Token, row: Vec3, d: [S::Packet; 3]) -> S::Packet {
    let [x, y, z] = vec3x::splat::<S::Packet>(token, row.to_array());
    d[0].mul_add(x, d[1].mul_add(y, d[2] * z))
}

/// May lose what is not a number, and others beside it.
#[inline(always)]
pub(super) fn least_of<L: Lanes>(v: L) -> f32 {
    let mut lanes = [f32::INFINITY; 16];
    v.store(&mut lanes);
    // Each half against the other: one by one, every step would wait for the last.
    let mut half = L::WIDTH / 2;
    while half > 0 {
        let mut i = 0;
        while i < half {
            lanes[i] = if lanes[i + half] < lanes[i] { lanes[i + half] } else { lanes[i] };
            i += 1;
        }
        half /= 2;
    }
    lanes[0]
}

/// NaN if any lane is.
#[inline(always)]
pub(super) fn sum_of<L: Lanes>(v: L) -> f32 {
    let mut lanes = [0.0; 16];
    v.store(&mut lanes);
    let mut half = L::WIDTH / 2;
    while half > 0 {
        let mut i = 0;
        while i < half {
            lanes[i] += lanes[i + half];
            i += 1;
        }
        half /= 2;
    }
    lanes[0]
}

#[inline(always)]
pub(super) fn greatest_of<L: Lanes>(v: L) -> f32 {
    -least_of(-v)
}

impl<S: Simd> Bvh<'_, S> {
    /// Which of the pyramid's targets anything of the part blocks.
    #[inline(always)]
    pub(super) fn pyramid_blocked(
        &self,
        scratch: &mut BatchScratch,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> u64 {
        let BatchScratch { pyramid, stack, stream } = scratch;
        let every = pyramid.every();
        counter.rays(pyramid.count as u32);
        stack.clear();
        stack.push((Child::node(0), 0.0, every));
        let mut going = Going::new(every);
        self.pyramid_goes_on(pyramid, stack, &mut going, part, counter, &mut Forgetful);
        self.rays_go_on(pyramid, stack, stream, &mut going, part, counter, &mut Forgetful);
        every & !going.free
    }

    /// Takes the targets that the subtrees of the stack block from those that are free. Where there is too much of
    /// it, the rest is left on the stack.
    #[inline(always)]
    pub(super) fn pyramid_goes_on(
        &self,
        pyramid: &mut Pyramid,
        stack: &mut Stack,
        going: &mut Going,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
    ) {
        self.simd.apart(
            #[inline(always)]
            || self.pyramid_visits(pyramid, stack, going, part, counter, learner),
        );
    }

    #[inline(always)]
    fn pyramid_visits(
        &self,
        pyramid: &mut Pyramid,
        stack: &mut Stack,
        going: &mut Going,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
    ) {
        let simd = self.simd;
        let token = simd.token();
        let mut found = Found::NOTHING;
        while going.visits < HANDOVER {
            let Some((next, _, may)) = stack.pop() else { return };
            let ask = may & going.free;
            if ask == 0 {
                continue;
            }
            if next.is_leaf() {
                let (block, lanes) = (&self.blocks[next.block()], next.bits());
                if ask.count_ones() <= LEAF_LONE {
                    let mut rest = ask;
                    while rest != 0 {
                        let i = rest.trailing_zeros() as usize;
                        rest &= rest - 1;
                        let sheared = shear_one(simd, &pyramid.ray(i), pyramid.axis(i));
                        counter.triangle_tests(part.count(block, lanes));
                        let mut hits = sheared.cross_block(token, block, &mut found) & lanes;
                        while hits != 0 {
                            let lane = hits.trailing_zeros() as usize & 7;
                            hits &= hits - 1;
                            if part.holds(block.ids[lane]) {
                                going.free &= !(1 << i);
                            }
                        }
                    }
                } else {
                    let block = (block, lanes);
                    let blocked =
                        self.block_blocked(pyramid, block, &mut going.forms, ask, part, counter, learner);
                    going.free &= !blocked;
                }
            } else {
                self.push_children(pyramid, &self.nodes[next.index()], ask, stack, going, part, counter);
            }
            if going.free == 0 {
                return;
            }
        }
    }

    /// The same with the rest of the stack, ray by ray.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn rays_go_on(
        &self,
        pyramid: &Pyramid,
        stack: &Stack,
        stream: &mut Stream,
        going: &mut Going,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
    ) {
        if stack.is_empty() || going.free == 0 {
            return;
        }
        let token = self.simd.token();
        stream.clear();
        let mut from = 0;
        while from < pyramid.count {
            let ask = (going.free >> from) as u32 & ((1 << S::Packet::WIDTH) - 1);
            if ask != 0 {
                let rays = Rays {
                    origin: vec3x::splat(token, pyramid.x.to_array()),
                    direction: [
                        S::Packet::load(token, &pyramid.direction[0][from..]),
                        S::Packet::load(token, &pyramid.direction[1][from..]),
                        S::Packet::load(token, &pyramid.direction[2][from..]),
                    ],
                    t_min: S::Packet::splat(token, 0.0),
                    t_max: S::Packet::splat(token, 1.0),
                };
                self.join(stream, from, &rays, ask);
            }
            from += S::Packet::WIDTH;
        }
        let start = Start { root: false, blocks: &[], nodes: &[], entries: stack };
        going.free &= !self.stream_blocked(stream, &start, going.free, part, counter, learner);
    }

    /// Puts the children of a node that may block any of `ask` on the stack, the nearest on top.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn push_children(
        &self,
        pyramid: &mut Pyramid,
        node: &Node,
        ask: u64,
        stack: &mut Stack,
        going: &mut Going,
        part: impl Part,
        counter: &mut impl Counter,
    ) {
        let simd = self.simd;
        let mut depth = [0.0; 8];
        let mut hides = [u64::MAX; 8];
        counter.node_tests(node.len());
        let mut met = pyramid.children(simd, node, &mut depth);
        if going.visits >= EASY && met != 0 {
            if !going.sorted {
                pyramid.sort();
                going.sorted = true;
            }
            pyramid.hidden(simd, node, met, &mut hides);
        }
        going.visits += 1;
        let first = stack.len();
        while met != 0 {
            let place = met.trailing_zeros() as usize & 7;
            met &= met - 1;
            let (child, at, may) = (node.children[place], depth[place], hides[place] & ask);
            if may == 0 || child == Child::NONE || !part.below(child) {
                continue;
            }
            // Depth is checked at construction, so there is always room.
            let mut slot = stack.len();
            stack.push((child, at, may));
            while slot > first && stack[slot - 1].1 < at {
                stack[slot] = stack[slot - 1];
                slot -= 1;
            }
            stack[slot] = (child, at, may);
        }
    }

    /// Which targets of `ask` the triangles of a block hide.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn block_blocked(
        &self,
        pyramid: &Pyramid,
        (block, lanes): (&TriangleBlock, u32),
        forms: &mut Forms,
        ask: u64,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
    ) -> u64 {
        let simd = self.simd;
        let verdict = pyramid.set_up(simd, block, forms);
        let mut blocked = 0;
        let mut open = verdict.open & lanes;
        while open != 0 {
            let lane = open.trailing_zeros() as usize & 7;
            open &= open - 1;
            let id = block.ids[lane];
            if id == crate::triangle::NO_TRIANGLE || !part.holds(id) {
                continue;
            }
            if verdict.all >> lane & 1 != 0 {
                counter.triangle_tests(1);
                learner.learn(block, lane, ask.count_ones());
                return u64::MAX;
            }
            let before = blocked;
            let ask = ask & !blocked;
            counter.triangle_tests(ask.count_ones());
            if verdict.unclear >> lane & 1 != 0 {
                let mut i = 0;
                while i < pyramid.count {
                    let asked = ask >> i & ((1 << S::Packet::WIDTH) - 1);
                    if asked != 0 {
                        blocked |= pyramid.exact(simd, block, lane, i, asked) << i;
                    }
                    i += S::Packet::WIDTH;
                }
            } else {
                let deep = verdict.deep >> lane & 1 != 0;
                blocked |= pyramid.test(simd, forms, block, lane, deep, ask);
            }
            if blocked != before {
                learner.learn(block, lane, (blocked & !before).count_ones());
            }
            if ask & !blocked == 0 {
                break;
            }
        }
        blocked
    }
}

/// How far a query has come.
pub(super) struct Going {
    pub(super) forms: Forms,
    /// Targets that nothing blocks so far.
    pub(super) free: u64,
    /// Nodes visited, counted up to where that matters.
    visits: u32,
    sorted: bool,
}

impl Going {
    #[inline(always)]
    pub(super) fn new(free: u64) -> Self {
        Self { forms: Forms::NOTHING, free, visits: 0, sorted: false }
    }

    /// As many nodes once more before packets take over.
    #[inline(always)]
    pub(super) fn starts_again(&mut self) {
        self.visits = 0;
    }
}

/// Hears of triangles that blocked something.
pub(super) trait Learner {
    fn learn(&mut self, block: &TriangleBlock, lane: usize, blocked: u32);
}

/// Does not care.
pub(super) struct Forgetful;

impl Learner for Forgetful {
    #[inline(always)]
    fn learn(&mut self, _: &TriangleBlock, _: usize, _: u32) {}
}
