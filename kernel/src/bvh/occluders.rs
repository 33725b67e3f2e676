//! Boxes inside of closed meshes: one box stands for all the triangles around it.
//!
//! If a segment ends outside a closed mesh and passes through a point inside it, it crosses the mesh between the
//! two, wherever it begins. So a segment that meets a box inside the mesh is blocked, and only its end has to be
//! known. No triangle is looked at, and as a box is convex, one answer does for many segments: for a fixed end, the
//! beginnings of segments that meet a convex body are a convex set, and the other way round. When the segments
//! between the corners of two boxes all meet an occluder, those between all of their points do.
//!
//! Every test is made with a box that is smaller by a bound on all rounding, of itself and of the triangle test, so
//! that "blocked" is what [`Bvh::occluded`] answers. "Not blocked" means nothing. One thing is left to rounding: where
//! a segment leaves the mesh within a triangle's plane, to a millionth, the triangle test may place its hit beyond the
//! segment's end and find nothing; the box still says that it is blocked.
//!
//! Djeu, Keely and Hunt, "Accelerating Shadow Rays Using Volumetric Occluders and Modified kd-Tree Traversal" (High
//! Performance Graphics 2009).

use super::pyramid::{MOST, Pyramid};
use super::shaft::Shaft;
use super::{BatchScratch, Bvh, BvhError, Child, Node, ROUNDING, STACK, Targets, check_nodes};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::vec3x;
use arrayvec::ArrayVec;
use glam::Vec3;

/// A tree over boxes that are wholly inside of closed meshes of a scene; its leaves are the boxes themselves.
///
/// A mesh is closed if every edge belongs to as many of its triangles one way as the other, and a point is inside if
/// the mesh winds around it other than 0 times. Inside one mesh each box must be whole; meshes may overlap, contain
/// each other and cross themselves. All of their triangles must be in the tree that is asked, and the segments must
/// end outside of all of them: leave the boxes of a mesh out for lights that it encloses or touches.
///
/// `occlude-host` finds such boxes (`volumetric`).
#[derive(Clone, Copy, Debug)]
pub struct Occluders<'a> {
    nodes: &'a [Node],
}

impl<'a> Occluders<'a> {
    /// No boxes.
    pub const NONE: Self = Self { nodes: &[] };

    /// Boxes as the leaves of nodes, whose indices may be anything. Checked like the nodes of a [`Bvh`].
    pub fn new(nodes: &'a [Node]) -> Result<Self, BvhError> {
        check_nodes(nodes, usize::MAX)?;
        Ok(Self { nodes })
    }

    /// Are there none?
    #[inline(always)]
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }
}

/// Below this length a segment meets nothing.
const SHORTEST: f32 = 1e-27;

/// Components of a direction are at least this part of the longest, which moves no point of a segment by as much as
/// rounding does.
const FLATTEST: f32 = 1e-9;

/// Rounding of the box test and of the triangle test, in roundings of the greatest distance there is.
const MARGIN: f32 = 32.0 * ROUNDING;

/// The same where corners stand for points that were turned and moved.
const TURNED_MARGIN: f32 = 128.0 * ROUNDING;

/// Nodes and boxes looked at for a tile.
const VISITS: u32 = 48;
const CANDIDATES: u32 = 8;

/// One over the components of a direction, all finite; and whether there is a direction.
#[inline(always)]
fn invert<L: Lanes>(token: L::Token, direction: [L; 3]) -> ([L; 3], L::Mask) {
    let longest = vec3x::most(vec3x::abs(direction));
    let least = longest * L::splat(token, FLATTEST);
    let one = L::splat(token, 1.0);
    let x = L::select(direction[0].abs().lt(least), least, direction[0]);
    let y = L::select(direction[1].abs().lt(least), least, direction[1]);
    let z = L::select(direction[2].abs().lt(least), least, direction[2]);
    ([one / x, one / y, one / z], L::splat(token, SHORTEST).lt(longest))
}

/// Which segments meet which boxes, lane by lane; either side may be splatted. Everything must be finite.
#[inline(always)]
fn meets<L: Lanes>(
    token: L::Token,
    origin: [L; 3],
    inverse: [L; 3],
    lower: [L; 3],
    upper: [L; 3],
) -> L::Mask {
    let (mut enter, mut leave) = (L::splat(token, 0.0), L::splat(token, 1.0));
    let mut axis = 0;
    while axis < 3 {
        let a = (lower[axis] - origin[axis]) * inverse[axis];
        let b = (upper[axis] - origin[axis]) * inverse[axis];
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
        axis += 1;
    }
    enter.le(leave)
}

/// The box of a place, smaller by a margin on every side; `None` if nothing is left of it.
#[inline(always)]
fn shrunk(node: &Node, place: usize, margin: f32) -> Option<[Vec3; 2]> {
    let [low, high] = &node.bounds;
    let lower = Vec3::new(low[0][place], low[1][place], low[2][place]) + margin;
    let upper = Vec3::new(high[0][place], high[1][place], high[2][place]) - margin;
    if lower.x < upper.x && lower.y < upper.y && lower.z < upper.z { Some([lower, upper]) } else { None }
}

/// Segments between the corners of two boxes.
struct Pairs {
    origin: [[f32; 64]; 3],
    inverse: [[f32; 64]; 3],
    count: usize,
}

impl Pairs {
    /// All that matter of a shaft, and by how much occluders must be smaller. `None` where a segment has no length.
    #[inline(always)]
    fn of<S: Simd>(simd: S, shaft: &Shaft, reach: f32) -> Option<(Self, f32)> {
        type P<S> = <S as Simd>::Packet;
        let token = simd.token();
        let mut margin = TURNED_MARGIN * reach;
        // Points of a surface lie in a plane, and so do those of a light: half of the corners stand for all.
        let mut corners = [8, 8];
        let mut side = 0;
        while side < 2 {
            let thickness = (shaft.corner(8 * side) - shaft.corner(8 * side + 4)).length();
            if thickness <= TURNED_MARGIN * reach {
                corners[side] = 4;
                margin += thickness;
            }
            side += 1;
        }
        let mut pairs = Self { origin: [[0.0; 64]; 3], inverse: [[0.0; 64]; 3], count: 0 };
        let mut direction = [[0.0f32; 64]; 3];
        let mut i = 0;
        while i < corners[0] {
            let mut k = 0;
            while k < corners[1] {
                let from = shaft.reference + shaft.corner(i);
                let along = shaft.corner(8 + k) - shaft.corner(i);
                let n = pairs.count;
                (pairs.origin[0][n], pairs.origin[1][n], pairs.origin[2][n]) = (from.x, from.y, from.z);
                (direction[0][n], direction[1][n], direction[2][n]) = (along.x, along.y, along.z);
                pairs.count += 1;
                k += 1;
            }
            i += 1;
        }
        // 16, 32 or 64 of them: no vector is half full.
        let mut from = 0;
        while from < pairs.count {
            let (inverse, sound) = invert::<P<S>>(token, vec3x::load(token, &direction, from));
            if sound.bits().count_ones() as usize != P::<S>::WIDTH {
                return None;
            }
            inverse[0].store(&mut pairs.inverse[0][from..]);
            inverse[1].store(&mut pairs.inverse[1][from..]);
            inverse[2].store(&mut pairs.inverse[2][from..]);
            from += P::<S>::WIDTH;
        }
        Some((pairs, margin))
    }

    /// Do all of them meet the box?
    #[inline(always)]
    fn all_meet<S: Simd>(&self, simd: S, [lower, upper]: [Vec3; 2], counter: &mut impl Counter) -> bool {
        type P<S> = <S as Simd>::Packet;
        let token = simd.token();
        let lower = vec3x::splat::<P<S>>(token, lower.to_array());
        let upper = vec3x::splat::<P<S>>(token, upper.to_array());
        let mut from = 0;
        while from < self.count {
            counter.node_tests(P::<S>::WIDTH as u32);
            let origin = vec3x::load::<P<S>, 64>(token, &self.origin, from);
            let inverse = vec3x::load::<P<S>, 64>(token, &self.inverse, from);
            let met = meets(token, origin, inverse, lower, upper);
            if met.bits().count_ones() as usize != P::<S>::WIDTH {
                return false;
            }
            from += P::<S>::WIDTH;
        }
        true
    }
}

/// A few boxes that a tile's points ask before any triangle.
pub(super) struct Walls {
    boxes: [[Vec3; 2]; Walls::MOST],
    count: usize,
    /// What they hid so far, and what they should have.
    worth: i32,
}

impl Walls {
    const MOST: usize = 4;

    pub(super) const NONE: Self = Self { boxes: [[Vec3::ZERO; 2]; Self::MOST], count: 0, worth: 0 };

    #[inline(always)]
    fn add(&mut self, wall: [Vec3; 2]) {
        if self.count < Self::MOST {
            self.boxes[self.count] = wall;
            self.count += 1;
        }
    }

    #[inline(always)]
    pub(super) fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Which of the pyramid's targets they hide. They are given up where that is too few of them.
    #[inline(always)]
    pub(super) fn hide<S: Simd>(&mut self, simd: S, pyramid: &Pyramid, counter: &mut impl Counter) -> u64 {
        type P<S> = <S as Simd>::Packet;
        let token = simd.token();
        let origin = vec3x::splat::<P<S>>(token, pyramid.x.to_array());
        let mut hidden = 0;
        let mut i = 0;
        while i < pyramid.count {
            let (inverse, sound) = invert::<P<S>>(token, vec3x::load(token, &pyramid.direction, i));
            let mut bits = 0;
            let mut k = 0;
            while k < self.count {
                let lower = vec3x::splat::<P<S>>(token, self.boxes[k][0].to_array());
                let upper = vec3x::splat::<P<S>>(token, self.boxes[k][1].to_array());
                bits |= meets(token, origin, inverse, lower, upper).bits();
                counter.node_tests(P::<S>::WIDTH as u32);
                k += 1;
            }
            hidden |= u64::from(bits & sound.bits()) << i;
            i += P::<S>::WIDTH;
        }
        hidden &= pyramid.every();
        self.worth += 2 * hidden.count_ones() as i32 - pyramid.count as i32;
        if self.worth < -PATIENCE {
            self.count = 0;
        }
        hidden
    }
}

/// Rays that walls may leave free, more than they hide, before they are no longer asked.
const PATIENCE: i32 = 64;

impl<S: Simd> Bvh<'_, S> {
    /// Which of the segments from `x` to the targets do boxes block?
    ///
    /// Bit `i % 64` of `blocked[i / 64]` answers for target `i`. A bit that is set is right: [`Bvh::occluded`] says
    /// the same. A bit that is not set means nothing. Words are overwritten as by [`Bvh::occluded_batch`]; `x` may
    /// be anywhere, also inside a box, but the targets must be outside, as [`Occluders`] says.
    #[inline(always)]
    pub fn hidden_batch(
        &self,
        occluders: &Occluders<'_>,
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        counter: &mut impl Counter,
        scratch: &mut BatchScratch,
        blocked: &mut [u64],
    ) {
        let x = Vec3::from(x.into());
        let mut from = 0;
        while from < targets.len() {
            let count = (targets.len() - from).min(MOST);
            let pyramid = &mut scratch.pyramid;
            blocked[from / MOST] =
                if !occluders.is_empty() && pyramid.aim(self.simd, x, targets, from, count, self.magnitude) {
                    self.pyramid_hidden(occluders, pyramid, counter)
                } else {
                    0
                };
            from += MOST;
        }
    }

    /// Which of the pyramid's targets boxes block.
    #[inline(always)]
    pub(super) fn pyramid_hidden(
        &self,
        occluders: &Occluders<'_>,
        pyramid: &Pyramid,
        counter: &mut impl Counter,
    ) -> u64 {
        type P<S> = <S as Simd>::Packet;
        let token = self.simd.token();
        let reach = self.magnitude + pyramid.x.abs().max_element() + pyramid.farthest;
        let origin = vec3x::splat::<P<S>>(token, pyramid.x.to_array());
        let mut inverse = [[0.0f32; MOST]; 3];
        let (mut sound, mut ready) = (0u64, false);
        let mut free = pyramid.every();
        let mut stack = ArrayVec::<u32, STACK>::new();
        stack.push(0);
        while let Some(next) = stack.pop() {
            let node = &occluders.nodes[next as usize];
            let mut depth = [0.0; 8];
            counter.node_tests(node.len());
            let mut met = pyramid.children(self.simd, node, &mut depth);
            while met != 0 {
                let place = met.trailing_zeros() as usize & 7;
                met &= met - 1;
                let child = node.children[place];
                if child == Child::NONE {
                    continue;
                }
                if !child.is_leaf() {
                    stack.push(child.index() as u32);
                    continue;
                }
                let Some([lower, upper]) = shrunk(node, place, MARGIN * reach) else { continue };
                if !ready {
                    let mut i = 0;
                    while i < pyramid.count {
                        let (by, good) = invert::<P<S>>(token, vec3x::load(token, &pyramid.direction, i));
                        by[0].store(&mut inverse[0][i..]);
                        by[1].store(&mut inverse[1][i..]);
                        by[2].store(&mut inverse[2][i..]);
                        sound |= u64::from(good.bits()) << i;
                        i += P::<S>::WIDTH;
                    }
                    ready = true;
                }
                let lower = vec3x::splat::<P<S>>(token, lower.to_array());
                let upper = vec3x::splat::<P<S>>(token, upper.to_array());
                counter.node_tests(free.count_ones());
                let mut i = 0;
                while i < pyramid.count {
                    let by = vec3x::load::<P<S>, MOST>(token, &inverse, i);
                    let hit = meets(token, origin, by, lower, upper);
                    free &= !((u64::from(hit.bits()) << i) & sound);
                    i += P::<S>::WIDTH;
                }
                if free == 0 {
                    return pyramid.every();
                }
            }
        }
        pyramid.every() & !free
    }

    /// Does one box stand between all points and all targets of a shaft? If none does, `walls` are those that stand
    /// between their middles.
    #[inline(always)]
    pub(super) fn walled_off(
        &self,
        occluders: &Occluders<'_>,
        shaft: &Shaft,
        walls: &mut Walls,
        counter: &mut impl Counter,
    ) -> bool {
        type N<S> = <S as Simd>::Node;
        let token = self.simd.token();
        let reach =
            self.magnitude + shaft.reference.abs().max_element() + shaft.farthest[0].max(shaft.farthest[1]);
        // Such a box stands also between their middles.
        let middle = shaft.reference + (shaft.corner(0) + shaft.corner(7)) * 0.5;
        let origin = vec3x::splat::<N<S>>(token, middle.to_array());
        let (inverse, sound) = invert::<N<S>>(token, vec3x::splat::<N<S>>(token, shaft.between.to_array()));
        if !sound.any() {
            return false;
        }
        let mut pairs = None;
        let (mut visits, mut candidates) = (0, 0);
        let mut stack = ArrayVec::<u32, STACK>::new();
        stack.push(0);
        while let Some(next) = stack.pop() {
            let node = &occluders.nodes[next as usize];
            counter.node_tests(node.len());
            let mut met = 0;
            let mut from = 0;
            while from < Node::WIDTH {
                let lower = vec3x::load::<N<S>, 8>(token, &node.bounds[0], from);
                let upper = vec3x::load::<N<S>, 8>(token, &node.bounds[1], from);
                met |= meets(token, origin, inverse, lower, upper).bits() << from;
                from += N::<S>::WIDTH;
            }
            while met != 0 {
                let place = met.trailing_zeros() as usize & 7;
                met &= met - 1;
                let child = node.children[place];
                // The box of an unused place is inside out, but here that does not show.
                if child == Child::NONE {
                    continue;
                }
                if !child.is_leaf() {
                    stack.push(child.index() as u32);
                    continue;
                }
                if pairs.is_none() {
                    pairs = Pairs::of(self.simd, shaft, reach);
                }
                let Some((pairs, margin)) = &pairs else { return false };
                if let Some(occluder) = shrunk(node, place, *margin) {
                    if pairs.all_meet(self.simd, occluder, counter) {
                        return true;
                    }
                    walls.add(occluder);
                }
                candidates += 1;
            }
            visits += 1;
            if visits == VISITS || candidates >= CANDIDATES {
                return false;
            }
        }
        false
    }
}
