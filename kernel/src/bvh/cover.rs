//! Is all of a light hidden from all of a tile by one sheet of triangles?
//!
//! A segment from p to q passes an edge ab on the side that the sign of `side = det(a - p, b - p, q - p)` tells. For
//! fixed edges that is linear in q, and in p, so its least value over two boxes is taken at their corners. A
//! triangle whose plane lies between the boxes, and whose edges have all segments on their inner side, blocks all of
//! them.
//!
//! Where an edge fails, the triangle across it in the same block may help out: if all *outer* edges of triangles grown
//! together that way have the segments on their inner sides, each segment meets one of them. For if it passes the
//! first triangle beyond an edge, that edge is no outer one; it enters the triangle across on the inner side of that
//! edge, and so on. As the triangles were grown as a tree, this never comes back, and ends in a triangle that is met.
//!
//! Signs must be as large as rounding could make them, here and in the test of [`crate::triangle`]. Of edges inside the
//! sheet nothing is asked: that test is watertight there.

use super::shaft::Shaft;
use super::{Bvh, Part, ROUNDING};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::ray::Ray;
use crate::triangle::{Found, NO_TRIANGLE, TriangleBlock, dominant_axis, shear_one};
use crate::vec3x::{self, Vec3x};
use arrayvec::ArrayVec;
use glam::Vec3;

/// The corners of the tile's box, a lane each, and what one asks of edges and planes.
struct Sides<'s, L> {
    shaft: &'s Shaft,
    corners: [Vec3x<L>; 8],
    /// Greatest distance along an axis from a point of the tile to a target, and from the reference to a point.
    length: f32,
    near: f32,
}

impl<'s, L: Lanes> Sides<'s, L> {
    #[inline(always)]
    fn new(token: L::Token, shaft: &'s Shaft) -> Self {
        let mut corners = [vec3x::splat(token, [0.0; 3]); 8];
        let mut k = 0;
        while k * L::WIDTH < 8 {
            corners[k] = vec3x::load(token, &shaft.corners, k * L::WIDTH);
            k += 1;
        }
        let [near, far] = shaft.farthest;
        Self { shaft, corners, length: near + far, near }
    }

    /// Do all segments pass the edge on the side of `sign`? Positions are counted from the reference.
    #[inline(always)]
    fn pass(&self, token: L::Token, a: Vec3, b: Vec3, sign: f32) -> bool {
        let targets = &self.shaft.targets;
        let far = self.near + a.abs().max(b.abs()).max_element();
        let margin = 128.0 * ROUNDING * far * far * self.length;
        let (a, b) = (vec3x::splat::<L>(token, a.to_array()), vec3x::splat::<L>(token, b.to_array()));
        let middle = vec3x::splat::<L>(token, targets.middle.to_array());
        let axes = [
            vec3x::splat::<L>(token, targets.axes[0].to_array()),
            vec3x::splat::<L>(token, targets.axes[1].to_array()),
            vec3x::splat::<L>(token, targets.axes[2].to_array()),
        ];
        let (sign, margin) = (L::splat(token, sign), L::splat(token, margin));
        let mut k = 0;
        while k * L::WIDTH < 8 {
            let p = self.corners[k];
            let n = vec3x::cross(vec3x::sub(a, p), vec3x::sub(b, p));
            let at = vec3x::dot(n, vec3x::sub(middle, p)) * sign;
            let spread =
                vec3x::dot(n, axes[0]).abs() + vec3x::dot(n, axes[1]).abs() + vec3x::dot(n, axes[2]).abs();
            // Written so that NaN fails.
            if (margin + spread).lt(at).bits() != every::<L>() {
                return false;
            }
            k += 1;
        }
        true
    }

    /// Does the plane of a triangle lie between all points and all targets, which are to the side of `sign`?
    #[inline(always)]
    fn between(&self, [a, b, c]: [Vec3; 3], sign: f32) -> bool {
        let shaft = self.shaft;
        let (e, f) = (b - a, c - a);
        let n = e.cross(f) * sign;
        let (e, f) = (e.abs(), f.abs());
        let size = (e.y * f.z + e.z * f.y) + (e.z * f.x + e.x * f.z) + (e.x * f.y + e.y * f.x);
        let far = self.length + a.abs().max_element();
        let margin = 64.0 * ROUNDING * size * far;
        let at = n.dot(a);
        shaft.points.most(n) + margin < at && at + margin < shaft.targets.least(n)
    }
}

#[inline(always)]
fn every<L: Lanes>() -> u32 {
    u32::MAX >> (32 - L::WIDTH)
}

/// A vertex of a block's lane, from the reference.
#[inline(always)]
fn vertex(block: &TriangleBlock, lane: usize, k: usize, reference: Vec3) -> Vec3 {
    let [x, y, z] = &block.vertices[k];
    Vec3::new(x[lane], y[lane], z[lane]) - reference
}

/// The vertices of a block's lane, from the reference.
#[inline(always)]
pub(super) fn triangle(block: &TriangleBlock, lane: usize, reference: Vec3) -> [Vec3; 3] {
    [vertex(block, lane, 0, reference), vertex(block, lane, 1, reference), vertex(block, lane, 2, reference)]
}

impl<S: Simd> Bvh<'_, S> {
    /// Do the triangles of a block, grown from one of them, hide all targets of the shaft from all of its points?
    #[inline(always)]
    pub(super) fn sheet_hides(
        &self,
        shaft: &Shaft,
        block: &TriangleBlock,
        lane: usize,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> bool {
        self.simd.apart(
            #[inline(always)]
            || self.grown_sheet_hides(shaft, block, lane, part, counter),
        )
    }

    #[inline(always)]
    fn grown_sheet_hides(
        &self,
        shaft: &Shaft,
        block: &TriangleBlock,
        lane: usize,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> bool {
        let token = self.simd.token();
        let reference = shaft.reference;
        let sides = Sides::<S::Node>::new(token, shaft);
        let mut grown = 1u32 << lane;
        // Edges yet to ask, as a lane and its first vertex.
        let mut edges = ArrayVec::<(usize, usize), 24>::new();
        let [a, b, c] = triangle(block, lane, reference);
        let toward = (b - a).cross(c - a).dot(shaft.between);
        let sign = if toward < 0.0 { -1.0 } else { 1.0 };
        counter.triangle_tests(1);
        if !part.holds(block.ids[lane]) || !sides.between([a, b, c], sign) {
            return false;
        }
        edges.push((lane, 0));
        edges.push((lane, 1));
        edges.push((lane, 2));
        while let Some((lane, k)) = edges.pop() {
            let next = if k == 2 { 0 } else { k + 1 };
            let (a, b) = (vertex(block, lane, k, reference), vertex(block, lane, next, reference));
            if sides.pass(token, a, b, sign) {
                continue;
            }
            let Some((other, first)) = across(block, lane, k, grown) else { return false };
            counter.triangle_tests(1);
            if !part.holds(block.ids[other]) || !sides.between(triangle(block, other, reference), sign) {
                return false;
            }
            grown |= 1 << other;
            edges.push((other, if first == 2 { 0 } else { first + 1 }));
            edges.push((other, if first == 0 { 2 } else { first - 1 }));
        }
        true
    }

    /// The triangle of some blocks that the segment from the middle of the points to that of the targets meets.
    #[inline(always)]
    pub(super) fn met_in_the_middle<'b>(
        &self,
        shaft: &Shaft,
        blocks: &'b [TriangleBlock],
        counter: &mut impl Counter,
    ) -> Option<(&'b TriangleBlock, usize)> {
        let ray = shaft.axis();
        let axis = dominant_axis(ray.origin, ray.direction)?;
        let sheared = shear_one(self.simd, &ray, axis);
        let mut found = Found::NOTHING;
        let mut k = 0;
        while k < blocks.len() {
            let block = &blocks[k];
            counter.triangle_tests(block.len() as u32);
            let hits = sheared.cross_block(self.simd.token(), block, &mut found);
            if hits != 0 {
                return Some((block, hits.trailing_zeros() as usize & 7));
            }
            k += 1;
        }
        None
    }
}

impl Shaft {
    /// From the middle of the points to that of the targets.
    #[inline(always)]
    pub(super) fn axis(&self) -> Ray {
        Ray { origin: self.reference + self.points.middle, direction: self.between, t_min: 0.0, t_max: 1.0 }
    }
}

/// The triangle of the block across an edge, turned the same way, and which of its edges that is.
#[inline(always)]
fn across(block: &TriangleBlock, lane: usize, k: usize, grown: u32) -> Option<(usize, usize)> {
    let (a, b) = (at(block, lane, k), at(block, lane, if k == 2 { 0 } else { k + 1 }));
    let mut other = 0;
    while other < TriangleBlock::WIDTH {
        if grown >> other & 1 == 0 && block.ids[other] != NO_TRIANGLE {
            let mut first = 0;
            while first < 3 {
                if at(block, other, first) == b
                    && at(block, other, if first == 2 { 0 } else { first + 1 }) == a
                {
                    return Some((other, first));
                }
                first += 1;
            }
        }
        other += 1;
    }
    None
}

/// A vertex of a block's lane.
#[inline(always)]
pub(super) fn at(block: &TriangleBlock, lane: usize, k: usize) -> [f32; 3] {
    let [x, y, z] = &block.vertices[k];
    [x[lane], y[lane], z[lane]]
}
