//! Ray and box, widened so that no triangle the ray meets is culled.
//!
//! A ray enters a slab at `b_near * inv - o * inv`, one multiply-add a plane. The origin is moved back for near
//! planes and on for far ones by the tree's slack, folded into the constants, so the bound on all rounding costs
//! nothing in the loop.

use super::Node;
use crate::lanes::{Lanes, Mask};

/// Below this length a direction counts as zero.
pub(super) const SHORTEST: f32 = 1e-27;

/// Components smaller than this part of the longest are taken as that: over the length of a scene the ray moves
/// by less than the slack.
const FLATTEST: f32 = 1e-9;

/// Where slack, inverse and their product must lie. Beyond, a plane's product could overflow (planes and origin
/// are within `2^20` slacks of 0) or lose digits to underflow, and the axis culls nothing.
const SOUND: [f32; 2] = [f32::MIN_POSITIVE, 1e31];

/// One ray in every lane, for the boxes of a node's children.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slabs<L> {
    inverse: [L; 3],
    near: [L; 3],
    far: [L; 3],
    /// Which side is near: 0 where the ray grows, 1 where it falls.
    near_side: [usize; 3],
    t_min: L,
}

/// The inverse of a direction's component, finite.
#[inline(always)]
fn inverse(component: f32, longest: f32) -> f32 {
    let least = longest * FLATTEST;
    if component.abs() < least { 1.0 / least.copysign(component) } else { 1.0 / component }
}

impl<L: Lanes> Slabs<L> {
    #[inline(always)]
    pub(super) fn new(token: L::Token, ray: &crate::Ray, slack: f32) -> Self {
        let longest = ray.direction.abs().max_element();
        let inverse = ray.direction.to_array().map(|component| inverse(component, longest));
        let sound = inverse.map(|inverse| {
            let (inverse, [least, most]) = (inverse.abs(), SOUND);
            slack > least && inverse > least && slack * inverse > least && slack * inverse < most
        });
        let splat = |value| L::splat(token, value);
        let shift = |axis: usize, slack: f32| {
            splat(if sound[axis] {
                slack * inverse[axis].abs() - ray.origin[axis] * inverse[axis]
            } else {
                f32::INFINITY.copysign(slack)
            })
        };
        let inverse: [f32; 3] = core::array::from_fn(|axis| if sound[axis] { inverse[axis] } else { 0.0 });
        Self {
            inverse: inverse.map(splat),
            near: [shift(0, -slack), shift(1, -slack), shift(2, -slack)],
            far: [shift(0, slack), shift(1, slack), shift(2, slack)],
            near_side: inverse.map(|inverse| usize::from(inverse < 0.0)),
            t_min: splat(ray.t_min),
        }
    }

    /// Which children the ray may meet up to `t_max`, as bits, and from which `t` on.
    #[inline(always)]
    pub(super) fn children(&self, token: L::Token, node: &Node, t_max: f32, entry: &mut [f32; 8]) -> u32 {
        let t_max = L::splat(token, t_max);
        let mut met = 0;
        for from in (0..Node::WIDTH).step_by(L::WIDTH) {
            let near = |axis: usize| {
                let plane = L::load(token, &node.bounds[self.near_side[axis] & 1][axis][from..]);
                plane.mul_add(self.inverse[axis], self.near[axis])
            };
            let far = |axis: usize| {
                let plane = L::load(token, &node.bounds[(self.near_side[axis] & 1) ^ 1][axis][from..]);
                plane.mul_add(self.inverse[axis], self.far[axis])
            };
            let enter = near(0).max(near(1)).max(near(2).max(self.t_min));
            let leave = far(0).min(far(1)).min(far(2).min(t_max));
            enter.store(&mut entry[from..]);
            met |= enter.le(leave).bits() << from;
        }
        met
    }
}

/// One ray a lane, for one box at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct PacketSlabs<L> {
    inverse: [L; 3],
    near: [L; 3],
    far: [L; 3],
    t_min: L,
}

impl<L: Lanes> PacketSlabs<L> {
    #[inline(always)]
    pub(super) fn new(token: L::Token, origin: [L; 3], direction: [L; 3], t_min: L, slack: L) -> Self {
        let length = direction.map(L::abs);
        let least = length[0].max(length[1]).max(length[2]) * L::splat(token, FLATTEST);
        let (zero, one) = (L::splat(token, 0.0), L::splat(token, 1.0));
        let inverse: [L; 3] = core::array::from_fn(|axis| {
            let flat = L::select(direction[axis].lt(zero), -least, least);
            one / L::select(length[axis].lt(least), flat, direction[axis])
        });
        let [least, most] = SOUND.map(|bound| L::splat(token, bound));
        let sound = inverse.map(|inverse| {
            let (inverse, moved) = (inverse.abs(), slack * inverse.abs());
            least.lt(slack) & least.lt(inverse) & least.lt(moved) & moved.lt(most)
        });
        let infinity = L::splat(token, f32::INFINITY);
        let shift = |axis: usize, sign: L| {
            let moved = sign * slack * inverse[axis].abs() - origin[axis] * inverse[axis];
            L::select(sound[axis], moved, sign * infinity)
        };
        let slab = |sign: f32| core::array::from_fn(|axis| shift(axis, L::splat(token, sign)));
        Self {
            inverse: core::array::from_fn(|axis| L::select(sound[axis], inverse[axis], zero)),
            near: slab(-1.0),
            far: slab(1.0),
            t_min,
        }
    }

    /// Which rays may meet a box up to `t_max`, and from which `t` on.
    #[inline(always)]
    pub(super) fn meet(&self, token: L::Token, node: &Node, place: usize, t_max: L) -> (L::Mask, L) {
        let side =
            |side: usize, axis: usize| L::splat(token, node.bounds[side][axis][place]) * self.inverse[axis];
        let near = |axis: usize| side(0, axis).min(side(1, axis)) + self.near[axis];
        let far = |axis: usize| side(0, axis).max(side(1, axis)) + self.far[axis];
        let enter = near(0).max(near(1)).max(near(2).max(self.t_min));
        let leave = far(0).min(far(1)).min(far(2).min(t_max));
        (enter.le(leave), enter)
    }
}
