//! One ray at a time: eight boxes or eight triangles a step.

use super::slabs::{SHORTEST, Slabs};
use super::{Bvh, Child, MAX_DEPTH, Node, Part, STACK};
use crate::counter::Counter;
use crate::lanes::Simd;
use crate::ray::{Hit, Ray};
use crate::triangle::{Found, Sheared, dominant_axis, shear_one};
use arrayvec::ArrayVec;
use core::ops::ControlFlow;

/// A triangle by where it is kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub(super) block: usize,
    pub(super) lane: usize,
}

/// What becomes of the hits of a block.
trait Visitor {
    /// Whether nodes are visited nearest first and `t_max` shrinks.
    const ORDERED: bool;

    /// Up to where hits matter.
    fn t_max(&self) -> f32;

    /// Takes a hit; `Break` ends the query.
    fn hit(&mut self, triangle: u32, hit: impl FnOnce() -> Hit) -> ControlFlow<()>;
}

struct First {
    t_max: f32,
    found: Option<u32>,
}

impl Visitor for First {
    const ORDERED: bool = false;

    #[inline(always)]
    fn t_max(&self) -> f32 {
        self.t_max
    }

    #[inline(always)]
    fn hit(&mut self, triangle: u32, _: impl FnOnce() -> Hit) -> ControlFlow<()> {
        self.found = Some(triangle);
        ControlFlow::Break(())
    }
}

struct Closest {
    t_max: f32,
    found: Option<Hit>,
}

impl Visitor for Closest {
    const ORDERED: bool = true;

    #[inline(always)]
    fn t_max(&self) -> f32 {
        self.t_max
    }

    #[inline(always)]
    fn hit(&mut self, _: u32, hit: impl FnOnce() -> Hit) -> ControlFlow<()> {
        let hit = hit();
        if self.found.is_none_or(|best| hit.nearer_than(&best)) {
            self.t_max = self.t_max.min(hit.t);
            self.found = Some(hit);
        }
        ControlFlow::Continue(())
    }
}

struct Each<F> {
    t_max: f32,
    visit: F,
}

impl<F: FnMut(Hit) -> ControlFlow<()>> Visitor for Each<F> {
    const ORDERED: bool = false;

    #[inline(always)]
    fn t_max(&self) -> f32 {
        self.t_max
    }

    #[inline(always)]
    fn hit(&mut self, _: u32, hit: impl FnOnce() -> Hit) -> ControlFlow<()> {
        (self.visit)(hit())
    }
}

/// The nearest few hits behind the last one reported.
struct Nearest {
    t_max: f32,
    after: Option<Hit>,
    hits: [Hit; Self::MOST],
    len: usize,
}

impl Nearest {
    const MOST: usize = 16;
}

impl Visitor for Nearest {
    const ORDERED: bool = true;

    #[inline(always)]
    fn t_max(&self) -> f32 {
        if self.len == Self::MOST { self.hits[Self::MOST - 1].t } else { self.t_max }
    }

    #[inline(always)]
    fn hit(&mut self, _: u32, hit: impl FnOnce() -> Hit) -> ControlFlow<()> {
        let hit = hit();
        let known = self.hits[..self.len].iter().any(|other| other.triangle == hit.triangle);
        if known || self.after.is_some_and(|after| !after.nearer_than(&hit)) {
            return ControlFlow::Continue(());
        }
        let place = self.hits[..self.len].partition_point(|other| other.nearer_than(&hit));
        if place < Self::MOST {
            self.len = (self.len + 1).min(Self::MOST);
            self.hits[place..self.len].rotate_right(1);
            self.hits[place] = hit;
        }
        ControlFlow::Continue(())
    }
}

impl<S: Simd> Bvh<'_, S> {
    /// Does anything but `ignore` block the ray? Stops at the first triangle that does.
    ///
    /// For one ray whose neighbours are unknown; rays that share an origin are cheaper as a batch.
    #[inline(always)]
    pub fn occluded(&self, ray: &Ray, ignore: Option<u32>, counter: &mut impl Counter) -> bool {
        self.occluder(ray, ignore, counter).is_some()
    }

    /// Which triangle blocks the ray: some one of them, not the nearest. Costs what [`Bvh::occluded`] does.
    #[inline(always)]
    pub fn occluder(&self, ray: &Ray, ignore: Option<u32>, counter: &mut impl Counter) -> Option<u32> {
        let mut visitor = First { t_max: ray.t_max, found: None };
        self.traverse(ray, ignore, counter, &mut visitor);
        visitor.found
    }

    /// Does any triangle of this part of the scene block the ray?
    #[inline(always)]
    pub fn occluded_among(&self, ray: &Ray, part: impl Part, counter: &mut impl Counter) -> bool {
        let mut visitor = First { t_max: ray.t_max, found: None };
        self.traverse(ray, part, counter, &mut visitor);
        visitor.found.is_some()
    }

    /// The nearest hit. Of several at the same `t`, that of the lowest number.
    #[inline(always)]
    pub fn closest(&self, ray: &Ray, ignore: Option<u32>, counter: &mut impl Counter) -> Option<Hit> {
        let mut visitor = Closest { t_max: ray.t_max, found: None };
        self.traverse(ray, ignore, counter, &mut visitor);
        visitor.found
    }

    /// Every hit, in no order, until `visit` breaks. A triangle that stands in several blocks comes as often.
    #[inline(always)]
    pub fn each_hit(
        &self,
        ray: &Ray,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        visit: impl FnMut(Hit) -> ControlFlow<()>,
    ) {
        self.traverse(ray, ignore, counter, &mut Each { t_max: ray.t_max, visit });
    }

    /// Every hit in the order of `t`, and of the triangles' numbers where `t` is the same, until `visit` breaks.
    ///
    /// Finds 16 at a time and starts again behind the last: a traversal for each 16 hits reported.
    #[inline(always)]
    pub fn each_hit_in_order(
        &self,
        ray: &Ray,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        mut visit: impl FnMut(Hit) -> ControlFlow<()>,
    ) {
        let nothing = Hit { t: 0.0, u: 0.0, v: 0.0, triangle: 0 };
        let mut nearest = Nearest { t_max: ray.t_max, after: None, hits: [nothing; Nearest::MOST], len: 0 };
        loop {
            nearest.len = 0;
            self.traverse(ray, ignore, counter, &mut nearest);
            for &hit in &nearest.hits[..nearest.len] {
                if visit(hit).is_break() {
                    return;
                }
            }
            if nearest.len < Nearest::MOST {
                return;
            }
            nearest.after = Some(nearest.hits[Nearest::MOST - 1]);
        }
    }

    #[inline(always)]
    fn traverse<V: Visitor>(&self, ray: &Ray, part: impl Part, counter: &mut impl Counter, visitor: &mut V) {
        counter.rays(1);
        let (Some(axis), false) = (dominant_axis(ray.origin, ray.direction), self.nodes.is_empty()) else {
            return;
        };
        if ray.direction.abs().max_element() < SHORTEST {
            return;
        }
        self.traverse_below(Child::node(0), ray, axis, part, counter, visitor);
    }

    /// Does any triangle of the part in this subtree block the ray?
    #[inline(always)]
    pub(super) fn occluded_below(
        &self,
        subtree: Child,
        ray: &Ray,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> bool {
        let Some(axis) = dominant_axis(ray.origin, ray.direction) else {
            return false;
        };
        if subtree == Child::NONE || ray.direction.abs().max_element() < SHORTEST {
            return false;
        }
        let mut visitor = First { t_max: ray.t_max, found: None };
        self.traverse_below(subtree, ray, axis, part, counter, &mut visitor);
        visitor.found.is_some()
    }

    /// Which triangle of the part in this subtree blocks a ray made ready, if any does?
    #[inline(always)]
    pub(super) fn blocker_of(
        &self,
        subtree: Child,
        slabs: &Slabs<S::Node>,
        sheared: &Sheared<S::Node>,
        t_max: f32,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> Option<Place> {
        self.traverse_in_no_order(subtree, slabs, sheared, part, counter, &mut First { t_max, found: None })
    }

    /// Where a triangle stands that blocks a ray, if any does.
    #[inline(always)]
    pub(super) fn blocker_place(
        &self,
        ray: &Ray,
        part: impl Part,
        counter: &mut impl Counter,
    ) -> Option<Place> {
        let axis = dominant_axis(ray.origin, ray.direction)?;
        if ray.direction.abs().max_element() < SHORTEST {
            return None;
        }
        let slabs = Slabs::<S::Node>::new(self.simd.token(), ray, self.slack(ray.origin));
        let sheared = shear_one(self.simd, ray, axis);
        self.blocker_of(Child::node(0), &slabs, &sheared, ray.t_max, part, counter)
    }

    #[inline(always)]
    fn traverse_below<V: Visitor>(
        &self,
        subtree: Child,
        ray: &Ray,
        axis: usize,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        if V::ORDERED {
            self.traverse_in_order(subtree, ray, axis, part, counter, visitor);
        } else {
            let slabs = Slabs::<S::Node>::new(self.simd.token(), ray, self.slack(ray.origin));
            let sheared = shear_one(self.simd, ray, axis);
            self.traverse_in_no_order(subtree, &slabs, &sheared, part, counter, visitor);
        }
    }

    /// Gives where the visitor broke off. What is left to visit is a node and a bit for each of its children, level
    /// by level: nothing is copied for children that are never come to.
    #[inline(always)]
    fn traverse_in_no_order<V: Visitor>(
        &self,
        subtree: Child,
        slabs: &Slabs<S::Node>,
        sheared: &Sheared<S::Node>,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) -> Option<Place> {
        let token = self.simd.token();
        let mut found = Found::NOTHING;
        let mut entry = [0.0; 8];
        // A level's node, and a bit for each of its children that is left to visit. None waits that has no bit.
        let mut waiting = [(0u32, 0u32); MAX_DEPTH];
        let mut level = 0;
        let mut next = subtree;
        let (mut node, mut left) = (0, 0);
        loop {
            if next.is_leaf() {
                let (block, lanes) = (&self.blocks[next.block()], next.bits());
                counter.triangle_tests(part.count(block, lanes));
                let mut hits = sheared.cross_block(token, block, &mut found) & lanes;
                while hits != 0 {
                    let lane = hits.trailing_zeros() as usize & 7;
                    hits &= hits - 1;
                    let id = block.ids[lane];
                    if part.holds(id) && visitor.hit(id, || found.hit(lane, id)).is_break() {
                        return Some(Place { block: next.block(), lane });
                    }
                }
            } else {
                if left != 0 {
                    // Depth is checked at construction, so there is always room.
                    waiting[level] = (node, left);
                    level += 1;
                }
                node = next.index() as u32;
                let here = &self.nodes[next.index()];
                counter.node_tests(here.len());
                left = slabs.children(token, here, visitor.t_max(), &mut entry);
            }
            next = loop {
                if left == 0 {
                    if level == 0 {
                        return None;
                    }
                    level -= 1;
                    (node, left) = waiting[level];
                }
                let child = self.nodes[node as usize].children[left.trailing_zeros() as usize & 7];
                left &= left - 1;
                // Its box is empty, or was never looked at: nothing promises that no ray meets it.
                if child != Child::NONE && part.below(child) {
                    break child;
                }
            };
        }
    }

    /// Nearest first, and no farther than what was found.
    #[inline(always)]
    fn traverse_in_order<V: Visitor>(
        &self,
        subtree: Child,
        ray: &Ray,
        axis: usize,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        let token = self.simd.token();
        let slabs = Slabs::<S::Node>::new(token, ray, self.slack(ray.origin));
        let sheared = shear_one(self.simd, ray, axis);
        let mut stack = ArrayVec::<(Child, f32), STACK>::new();
        let mut next = subtree;
        let mut entry = [0.0; 8];
        let mut found = Found::NOTHING;
        loop {
            if next.is_leaf() {
                let (block, lanes) = (&self.blocks[next.block()], next.bits());
                counter.triangle_tests(part.count(block, lanes));
                let mut hits = sheared.cross_block(token, block, &mut found) & lanes;
                while hits != 0 {
                    let lane = hits.trailing_zeros() as usize & 7;
                    hits &= hits - 1;
                    let id = block.ids[lane];
                    if part.holds(id) && visitor.hit(id, || found.hit(lane, id)).is_break() {
                        return;
                    }
                }
            } else {
                let node = &self.nodes[next.index()];
                counter.node_tests(node.len());
                let mut met = slabs.children(token, node, visitor.t_max(), &mut entry);
                let first = stack.len();
                while met != 0 {
                    let place = met.trailing_zeros() as usize & 7;
                    met &= met - 1;
                    let (child, at) = (node.children[place], entry[place]);
                    if child == Child::NONE || !part.below(child) {
                        continue;
                    }
                    // Farthest first, so that the nearest is on top. Depth is checked at construction, so there
                    // is always room.
                    let mut slot = stack.len();
                    stack.push((child, at));
                    while slot > first && stack[slot - 1].1 < at {
                        stack[slot] = stack[slot - 1];
                        slot -= 1;
                    }
                    stack[slot] = (child, at);
                }
            }
            loop {
                let Some((child, at)) = stack.pop() else { return };
                if at <= visitor.t_max() {
                    next = child;
                    break;
                }
            }
        }
    }
}

impl Node {
    /// Children in use.
    #[inline(always)]
    pub(super) fn len(&self) -> u32 {
        self.children.iter().filter(|&&child| child != Child::NONE).count() as u32
    }
}
