//! One point and many points on a light: which of the segments are blocked?

use super::packet::Rays;
use super::pyramid::{Forgetful, Going, Learner, MOST, Pyramid, Stack};
use super::stream::{Start, Stream};
use super::{Bvh, CUT, Child, Part};
use crate::counter::Counter;
use crate::lanes::{Lanes, Simd};
use crate::ray::Ray;
use crate::vec3x;
use glam::Vec3;

/// The less a parallelogram is one, the less exactly are its normal and places on it told: the least square of the sine
/// between its edges.
const THIN: f32 = 1e-5;

/// The far ends of a batch: points on a light, one coordinate a slice, all of one length.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    x: &'a [f32],
    y: &'a [f32],
    z: &'a [f32],
    plane: Option<[Vec3; 3]>,
}

impl<'a> Targets<'a> {
    /// Points by their coordinates. `None` if the slices differ in length.
    #[inline(always)]
    pub fn new(x: &'a [f32], y: &'a [f32], z: &'a [f32]) -> Option<Self> {
        if x.len() == y.len() && y.len() == z.len() { Some(Self { x, y, z, plane: None }) } else { None }
    }

    /// Says that the points lie on, or very near, the parallelogram of a corner and the edges u and v at it.
    ///
    /// This only makes queries quicker, by a pyramid that fits the light; the answers are the same.
    #[inline(always)]
    pub fn on_parallelogram(
        self,
        corner: impl Into<[f32; 3]>,
        u: impl Into<[f32; 3]>,
        v: impl Into<[f32; 3]>,
    ) -> Self {
        let [corner, u, v] = [Vec3::from(corner.into()), Vec3::from(u.into()), Vec3::from(v.into())];
        // Written so that NaN is no plane.
        let known = u.cross(v).length_squared() > THIN * u.length_squared() * v.length_squared();
        Self { plane: if known { Some([corner, u, v]) } else { None }, ..self }
    }

    /// A corner and the edges at it of the light they lie on, if that is known.
    #[inline(always)]
    pub(super) fn plane(&self) -> Option<[Vec3; 3]> {
        self.plane
    }

    /// Three unit vectors at right angles, two of them in the light's plane if it is known.
    #[inline(always)]
    pub(super) fn turn(&self) -> [Vec3; 3] {
        match self.plane {
            Some([_, u, v]) => super::tile::frame(u.cross(v), u),
            None => [Vec3::X, Vec3::Y, Vec3::Z],
        }
    }

    /// The coordinates along an axis.
    #[inline(always)]
    pub(super) fn axis(&self, axis: usize) -> &'a [f32] {
        match axis {
            0 => self.x,
            1 => self.y,
            _ => self.z,
        }
    }

    /// Three linear functions of positions from x, by rows, such that the targets lie at about one depth (the
    /// third), and near together once the first two are divided by it; and their inverse, by columns.
    #[inline(always)]
    pub(super) fn frame<const N: usize>(
        &self,
        x: Vec3,
        direction: &[[f32; N]; 3],
        count: usize,
    ) -> Option<([Vec3; 3], [Vec3; 3])> {
        if let Some([corner, u, v]) = self.plane {
            let c = corner - x;
            let n = u.cross(v);
            let height = n.dot(c);
            // So near the light's plane that its coordinates would say little, an axis serves better.
            if height.abs() > 1e-4 * (n.abs().max_element() * c.abs().max_element()) {
                let inverse = 1.0 / height;
                return Some(([v.cross(c) * inverse, c.cross(u) * inverse, n * inverse], [u, v, c]));
            }
        }
        let mut sum = Vec3::ZERO;
        let mut i = 0;
        while i < count {
            sum += Vec3::new(direction[0][i], direction[1][i], direction[2][i]);
            i += 1;
        }
        let (size, mut rows) = (sum.abs(), [Vec3::X, Vec3::Y, Vec3::Z]);
        if size.x >= size.y && size.x >= size.z {
            rows = [Vec3::Y, Vec3::Z, Vec3::X];
        } else if size.y >= size.z {
            rows = [Vec3::Z, Vec3::X, Vec3::Y];
        }
        if rows[2].dot(sum) < 0.0 {
            rows[2] = -rows[2];
        }
        if sum.is_finite() { Some((rows, rows)) } else { None }
    }

    /// How many.
    #[inline]
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Are there none?
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Point `i`. Panics if there is no such point.
    #[inline]
    pub fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.x[i], self.y[i], self.z[i])
    }
}

/// What a batch works in: keep one a thread, so that nothing is cleared between queries. About twelve kilobytes.
pub struct BatchScratch {
    pub(super) pyramid: Pyramid,
    pub(super) stack: Stack,
    pub(super) stream: Stream,
}

impl BatchScratch {
    /// Ready for any query.
    pub const fn new() -> Self {
        Self { pyramid: Pyramid::EMPTY, stack: Stack::new_const(), stream: Stream::EMPTY }
    }
}

impl Default for BatchScratch {
    fn default() -> Self {
        Self::new()
    }
}

impl core::fmt::Debug for BatchScratch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("BatchScratch")
    }
}

impl<S: Simd> Bvh<'_, S> {
    /// Which of the segments from `x` to the targets does anything but `ignore` block?
    ///
    /// Bit `i % 64` of `blocked[i / 64]` answers for target `i`, as [`Bvh::occluded`] would for
    /// [`Ray::segment(x, target)`](crate::Ray::segment). Words are overwritten; bits beyond the targets are 0, and
    /// words beyond the last target are left alone. Panics if `blocked` is too short for the targets. Of segments in the
    /// plane of a triangle see [`crate::triangle`].
    ///
    /// One traversal for 64 targets. Say what light they lie on if it is flat ([`Targets::on_parallelogram`]).
    #[inline(always)]
    pub fn occluded_batch(
        &self,
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        scratch: &mut BatchScratch,
        blocked: &mut [u64],
    ) {
        self.occluded_batch_among(x, targets, ignore, counter, scratch, blocked);
    }

    /// The same of the triangles of a part of the scene, as [`Bvh::occluded_among`] would answer.
    #[inline(always)]
    pub fn occluded_batch_among(
        &self,
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        part: impl Part,
        counter: &mut impl Counter,
        scratch: &mut BatchScratch,
        blocked: &mut [u64],
    ) {
        let x = x.into();
        let mut from = 0;
        while from < targets.len() {
            let count = (targets.len() - from).min(MOST);
            blocked[from / MOST] = if count < FEW || self.nodes.is_empty() {
                self.rays_from_root(&mut scratch.stream, x, targets, from, count, part, counter)
            } else if scratch.pyramid.aim(self.simd, x.into(), targets, from, count, self.magnitude) {
                self.pyramid_blocked(scratch, part, counter)
            } else {
                self.rays_from_root(&mut scratch.stream, x, targets, from, count, part, counter)
            };
            from += MOST;
        }
    }

    /// The same, but only the triangles below these subtrees count: blockers that may be in the way, named by
    /// whoever knows. Costs a traversal of each, until nothing is left to hide.
    ///
    /// Panics if one of them is beyond the tree's nodes or blocks.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub fn occluded_batch_by(
        &self,
        subtrees: &[Child],
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        part: impl Part,
        counter: &mut impl Counter,
        scratch: &mut BatchScratch,
        blocked: &mut [u64],
    ) {
        let x = x.into();
        let mut from = 0;
        while from < targets.len() {
            let count = (targets.len() - from).min(MOST);
            let every = u64::MAX >> (64 - count);
            counter.rays(count as u32);
            let BatchScratch { pyramid, stack, stream } = &mut *scratch;
            let free =
                if count >= FEW && pyramid.aim(self.simd, x.into(), targets, from, count, self.magnitude) {
                    self.pyramid_left_by(subtrees, pyramid, stack, stream, part, counter)
                } else {
                    let mut free = every;
                    let mut i = 0;
                    while i < count {
                        let ray = Ray::segment(x, targets.get(from + i));
                        let mut next = 0;
                        while next < subtrees.len() && free >> i & 1 == 1 {
                            if self.occluded_below(subtrees[next], &ray, part, counter) {
                                free &= !(1 << i);
                            }
                            next += 1;
                        }
                        i += 1;
                    }
                    free
                };
            blocked[from / MOST] = every & !free;
            from += MOST;
        }
    }

    /// Which of the pyramid's targets these subtrees leave free.
    #[inline(always)]
    fn pyramid_left_by(
        &self,
        subtrees: &[Child],
        pyramid: &mut Pyramid,
        stack: &mut Stack,
        stream: &mut Stream,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> u64 {
        let every = pyramid.every();
        let mut going = Going::new(every);
        let mut from = 0;
        while from < subtrees.len() && going.free != 0 {
            let end = (from + AT_ONCE).min(subtrees.len());
            stack.clear();
            let mut next = end;
            while next > from {
                next -= 1;
                if subtrees[next] != Child::NONE {
                    stack.push((subtrees[next], 0.0, every));
                }
            }
            going.starts_again();
            self.pyramid_goes_on(pyramid, stack, &mut going, part, counter, &mut Forgetful);
            self.rays_go_on(pyramid, stack, stream, &mut going, part, counter, &mut Forgetful);
            from = end;
        }
        going.free
    }

    /// The same for up to 64 targets, ray by ray.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn rays_from_root(
        &self,
        stream: &mut Stream,
        x: [f32; 3],
        targets: &Targets<'_>,
        first: usize,
        count: usize,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> u64 {
        let ask = u64::MAX >> (64 - count);
        self.rays_blocked(stream, &Start::ROOT, x, targets, first, ask, part, counter, &mut Forgetful)
    }

    /// The same for those of `ask` of the 64 targets from the `first`th on.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn rays_blocked(
        &self,
        stream: &mut Stream,
        start: &Start<'_>,
        x: [f32; 3],
        targets: &Targets<'_>,
        first: usize,
        ask: u64,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
    ) -> u64 {
        let token = self.simd.token();
        counter.rays(ask.count_ones());
        stream.clear();
        let mut tail = [0.0; 16];
        let mut from = 0;
        while from < MOST {
            let active = (ask >> from) as u32 & ((1 << S::Packet::WIDTH) - 1);
            if active != 0 {
                let origin = vec3x::splat(token, x);
                let (at, rest) = (first + from, (32 - active.leading_zeros()) as usize);
                let ends = [
                    ends_of::<S>(token, targets.x, at, rest, &mut tail),
                    ends_of::<S>(token, targets.y, at, rest, &mut tail),
                    ends_of::<S>(token, targets.z, at, rest, &mut tail),
                ];
                let rays = Rays {
                    origin,
                    direction: vec3x::sub(ends, origin),
                    t_min: S::Packet::splat(token, 0.0),
                    t_max: S::Packet::splat(token, 1.0),
                };
                self.join(stream, from, &rays, active);
            }
            from += S::Packet::WIDTH;
        }
        if ask.count_ones() as usize >= MOST / 2 {
            stream.surround(self.simd, self.magnitude);
        }
        self.stream_blocked(stream, start, ask, part, counter, learner)
    }
}

/// Given subtrees that are on the stack together.
const AT_ONCE: usize = CUT;

/// Below this many targets a pyramid costs more than it saves.
pub(super) const FEW: usize = 4;

/// The coordinates of up to a vector's width of targets; lanes beyond the last hold anything.
#[inline(always)]
fn ends_of<S: Simd>(
    token: S::Token,
    all: &[f32],
    from: usize,
    count: usize,
    tail: &mut [f32; 16],
) -> S::Packet {
    if count == S::Packet::WIDTH {
        return S::Packet::load(token, &all[from..]);
    }
    tail[..count].copy_from_slice(&all[from..from + count]);
    S::Packet::load(token, tail)
}

/// Targets from the `i`th on, as many as a vector holds; the last one before `end` once more beyond it.
#[inline(always)]
pub(super) fn targets_from<S: Simd>(
    token: S::Token,
    targets: &Targets<'_>,
    i: usize,
    end: usize,
) -> [S::Packet; 3] {
    if i + S::Packet::WIDTH <= end {
        return [
            S::Packet::load(token, &targets.axis(0)[i..]),
            S::Packet::load(token, &targets.axis(1)[i..]),
            S::Packet::load(token, &targets.axis(2)[i..]),
        ];
    }
    let mut lanes = [[0.0; 16]; 3];
    let mut axis = 0;
    while axis < 3 {
        let all = &targets.axis(axis)[i..end];
        lanes[axis] = [all[all.len() - 1]; 16];
        lanes[axis][..all.len()].copy_from_slice(all);
        axis += 1;
    }
    vec3x::load(token, &lanes, 0)
}
