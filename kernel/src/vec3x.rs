//! Three numbers a lane: points, directions, anything by axis.
//!
//! Written out axis by axis: `array::map` and closures are not inlined into code compiled for a higher SIMD
//! level (see [`crate::lanes::Task`]), and then every operation becomes a call.

use crate::lanes::Lanes;

/// A vector in each lane, indexed by axis.
pub(crate) type Vec3x<L> = [L; 3];

/// The same vector in every lane.
#[inline(always)]
pub(crate) fn splat<L: Lanes>(token: L::Token, v: [f32; 3]) -> Vec3x<L> {
    [L::splat(token, v[0]), L::splat(token, v[1]), L::splat(token, v[2])]
}

/// The vectors of lanes `from` on.
#[inline(always)]
pub(crate) fn load<L: Lanes, const N: usize>(token: L::Token, v: &[[f32; N]; 3], from: usize) -> Vec3x<L> {
    [L::load(token, &v[0][from..]), L::load(token, &v[1][from..]), L::load(token, &v[2][from..])]
}

/// The vector of one lane in all of them.
#[inline(always)]
pub(crate) fn broadcast<L: Lanes, const N: usize>(
    token: L::Token,
    v: &[[f32; N]; 3],
    lane: usize,
) -> Vec3x<L> {
    splat(token, [v[0][lane], v[1][lane], v[2][lane]])
}

/// The difference, axis by axis.
#[inline(always)]
pub(crate) fn sub<L: Lanes>(a: Vec3x<L>, b: Vec3x<L>) -> Vec3x<L> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Without signs, axis by axis.
#[inline(always)]
pub(crate) fn abs<L: Lanes>(v: Vec3x<L>) -> Vec3x<L> {
    [v[0].abs(), v[1].abs(), v[2].abs()]
}

/// The greatest of the three.
#[inline(always)]
pub(crate) fn most<L: Lanes>(v: Vec3x<L>) -> L {
    v[0].max(v[1]).max(v[2])
}

/// The box around three positions in each lane: its least and its greatest corner.
#[inline(always)]
pub(crate) fn bounds<L: Lanes>([a, b, c]: [Vec3x<L>; 3]) -> [Vec3x<L>; 2] {
    [
        [a[0].min(b[0]).min(c[0]), a[1].min(b[1]).min(c[1]), a[2].min(b[2]).min(c[2])],
        [a[0].max(b[0]).max(c[0]), a[1].max(b[1]).max(c[1]), a[2].max(b[2]).max(c[2])],
    ]
}

/// The cross product, each product rounded.
#[inline(always)]
pub(crate) fn cross<L: Lanes>(a: Vec3x<L>, b: Vec3x<L>) -> Vec3x<L> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The scalar product, each product rounded.
#[inline(always)]
pub(crate) fn dot<L: Lanes>(a: Vec3x<L>, b: Vec3x<L>) -> L {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
