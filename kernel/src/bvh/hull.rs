//! What segments have in common: a box around where they begin, and one around where they end.
//!
//! Segments from o to e are at `o + t (e - o)`, and so all of them, at t, in a box whose sides are linear in t. What
//! they meet, this moving box meets at some t from 0 to 1. Each side of another box gives a bound on such t: six
//! multiply-adds for eight boxes, as for a single ray, and for segments that keep together it leaves few boxes to test
//! ray by ray.

use super::{FARTHEST, NEAREST, Node, ROUNDING};
use crate::lanes::{Lanes, Mask, Simd};
use crate::triangle::TriangleBlock;
use crate::vec3x::{self, Vec3x};
use glam::Vec3;

/// Bounds on t by the lower sides of a box, and by the upper ones: `factor * side + addend`.
#[derive(Clone, Copy)]
pub(super) struct Hull {
    factor: [[f32; 3]; 2],
    addend: [[f32; 3]; 2],
    /// Does the bound tell the least t there is, or the greatest?
    least: [[bool; 3]; 2],
}

/// How much wider it is than the segments, in roundings of the greatest coordinate: for the triangle test, as boxes are
/// ([`super::slabs`]), for the sums of origin and direction that the ends are, and for the bounds' own rounding; together
/// about 30.
const SLACK: f32 = 128.0 * ROUNDING;

impl Hull {
    /// Around segments that begin and end within these corners, which are no NaN. `magnitude` bounds every coordinate of
    /// the scene. `None` where they are too far away.
    #[inline(always)]
    pub(super) fn new(begin: [Vec3; 2], end: [Vec3; 2], magnitude: f32) -> Option<Self> {
        let reach = begin[0].abs().max(begin[1].abs()).max(end[0].abs()).max(end[1].abs());
        let reach = magnitude + reach.max_element();
        if reach <= NEAREST || reach >= FARTHEST {
            return None;
        }
        let slack = SLACK * reach;
        let mut hull = Self { factor: [[0.0; 3]; 2], addend: [[0.0; 3]; 2], least: [[false; 3]; 2] };
        let mut axis = 0;
        while axis < 3 {
            // A lower side must not be above the upper sides of the segments, nor an upper one below their lower ones.
            let mut side = 0;
            while side < 2 {
                let out = if side == 0 { slack } else { -slack };
                let from = begin[1 - side][axis] + out;
                let step = end[1 - side][axis] + out - from;
                // One that hardly moves may as well move outwards.
                let step = if step.abs() < slack { out } else { step };
                let factor = 1.0 / step;
                hull.factor[side][axis] = factor;
                hull.addend[side][axis] = -from * factor;
                hull.least[side][axis] = (step > 0.0) == (side == 0);
                side += 1;
            }
            axis += 1;
        }
        Some(hull)
    }

    /// Which boxes the segments may meet.
    #[inline(always)]
    fn meets<L: Lanes>(&self, token: L::Token, bounds: [Vec3x<L>; 2]) -> L::Mask {
        let (mut first, mut last) = (L::splat(token, 0.0), L::splat(token, 1.0));
        let mut axis = 0;
        while axis < 3 {
            let mut side = 0;
            while side < 2 {
                let factor = L::splat(token, self.factor[side][axis]);
                let bound = bounds[side][axis].mul_add(factor, L::splat(token, self.addend[side][axis]));
                if self.least[side][axis] {
                    first = first.max(bound);
                } else {
                    last = last.min(bound);
                }
                side += 1;
            }
            axis += 1;
        }
        first.le(last)
    }

    /// Which children of a node they may meet. Unused ones may be among them.
    #[inline(always)]
    pub(super) fn children<S: Simd>(&self, simd: S, node: &Node) -> u32 {
        type N<S> = <S as Simd>::Node;
        let token = simd.token();
        let mut met = 0;
        let mut from = 0;
        while from < Node::WIDTH {
            let bounds = [
                vec3x::load::<N<S>, 8>(token, &node.bounds[0], from),
                vec3x::load::<N<S>, 8>(token, &node.bounds[1], from),
            ];
            met |= self.meets(token, bounds).bits() << from;
            from += N::<S>::WIDTH;
        }
        met
    }

    /// Which triangles of a block they may meet. Unused ones may be among them.
    #[inline(always)]
    pub(super) fn triangles<S: Simd>(&self, simd: S, block: &TriangleBlock) -> u32 {
        type N<S> = <S as Simd>::Node;
        let token = simd.token();
        let mut met = 0;
        let mut from = 0;
        while from < TriangleBlock::WIDTH {
            let a = vec3x::load::<N<S>, 8>(token, &block.vertices[0], from);
            let b = vec3x::load::<N<S>, 8>(token, &block.vertices[1], from);
            let c = vec3x::load::<N<S>, 8>(token, &block.vertices[2], from);
            let bounds = vec3x::bounds([a, b, c]);
            met |= self.meets(token, bounds).bits() << from;
            from += N::<S>::WIDTH;
        }
        met
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::Child;
    use crate::lanes::{Native, Scalar};
    use crate::triangle::TriangleBlock;

    struct Numbers(u32);

    impl Numbers {
        /// From -1 to 1.
        fn one(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (self.0 >> 8) as f32 / 8_388_608.0 - 1.0
        }

        fn position(&mut self, about: Vec3, spread: f32) -> Vec3 {
            about + Vec3::new(self.one(), self.one(), self.one()) * spread
        }
    }

    /// Does a segment meet a box? In twice the digits.
    fn meets(from: Vec3, to: Vec3, lower: Vec3, upper: Vec3) -> bool {
        let (mut first, mut last) = (0.0f64, 1.0f64);
        for axis in 0..3 {
            let (o, d) = (f64::from(from[axis]), f64::from(to[axis]) - f64::from(from[axis]));
            let (low, high) = (f64::from(lower[axis]), f64::from(upper[axis]));
            if d == 0.0 {
                if o < low || o > high {
                    return false;
                }
            } else {
                let (a, b) = ((low - o) / d, (high - o) / d);
                first = first.max(a.min(b));
                last = last.min(a.max(b));
            }
        }
        first <= last
    }

    /// Boxes and triangles beside segments between two places, some of them points, and some of no length.
    fn compare<S: Simd>(simd: S, spread: [f32; 2], flat: bool) -> [u32; 2] {
        let mut numbers = Numbers(7);
        // Boxes that no segment meets, and those of them that the hull leaves out.
        let (mut apart, mut culled) = (0, 0);
        for _ in 0..300 {
            let (here, there) = (numbers.position(Vec3::ZERO, 1.0), numbers.position(Vec3::ZERO, 1.0));
            let mut segments = [[Vec3::ZERO; 2]; 16];
            for segment in &mut segments {
                *segment = [numbers.position(here, spread[0]), numbers.position(there, spread[1])];
                if flat {
                    (segment[0].z, segment[1].z) = (0.25, 0.25);
                }
            }
            let (mut begin, mut end) = ([segments[0][0]; 2], [segments[0][1]; 2]);
            for [from, to] in segments {
                begin = [begin[0].min(from), begin[1].max(from)];
                end = [end[0].min(to), end[1].max(to)];
            }
            let hull = Hull::new(begin, end, 4.0).unwrap();
            let (mut node, mut block) = (Node::EMPTY, TriangleBlock::EMPTY);
            let mut boxes = [[Vec3::ZERO; 2]; 8];
            for (place, bounds) in boxes.iter_mut().enumerate() {
                let at = numbers.position(Vec3::ZERO, 1.0);
                let corners =
                    [numbers.position(at, 0.2), numbers.position(at, 0.2), numbers.position(at, 0.2)];
                *bounds =
                    [corners[0].min(corners[1]).min(corners[2]), corners[0].max(corners[1]).max(corners[2])];
                node.set(place, bounds[0].into(), bounds[1].into(), Child::node(1));
                for (k, corner) in corners.iter().enumerate() {
                    for axis in 0..3 {
                        block.vertices[k][axis][place] = corner[axis];
                    }
                }
            }
            let met = hull.children(simd, &node);
            assert_eq!(hull.triangles(simd, &block), met);
            for (place, [lower, upper]) in boxes.into_iter().enumerate() {
                let bit = met >> place & 1;
                if segments.iter().any(|&[from, to]| meets(from, to, lower, upper)) {
                    assert_eq!(bit, 1, "{segments:?} {lower} {upper}");
                } else {
                    apart += 1;
                    culled += 1 - bit;
                }
            }
        }
        [apart, culled]
    }

    #[test]
    fn whatever_a_segment_meets_is_met_and_little_else() {
        for (spread, share) in [
            ([0.05, 0.05], 0.95),
            ([0.0, 0.3], 0.9),
            ([0.0, 0.0], 0.99),
            ([0.3, 0.02], 0.9),
            ([1.0, 1.0], 0.0),
        ] {
            let [apart, culled] = compare(Native, spread, false);
            assert!(
                apart > 500 && f64::from(culled) >= share * f64::from(apart),
                "{spread:?} {culled}/{apart}"
            );
            assert_eq!(compare(Scalar, spread, false), [apart, culled]);
            compare(Native, spread, true);
        }
    }

    #[test]
    fn what_is_too_far_away_has_no_hull() {
        let near = [Vec3::ZERO, Vec3::ONE];
        for far in [1e12, f32::INFINITY] {
            let beyond = [Vec3::ZERO, Vec3::splat(far)];
            assert!(Hull::new(near, beyond, 1.0).is_none());
            assert!(Hull::new(beyond, near, 1.0).is_none());
        }
        assert!(Hull::new([Vec3::ZERO; 2], [Vec3::ZERO; 2], 0.0).is_none());
        assert!(Hull::new(near, near, 1.0).is_some());
    }
}
