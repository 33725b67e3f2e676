//! A small tree over a few triangles, built on the spot in slices that the caller gives.

use super::{Bvh, BvhError, Child, Node, check};
use crate::lanes::Simd;
use crate::triangle::TriangleBlock;

/// A triangle to build a [`SmallTree`] over.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SmallTriangle {
    /// Its vertices; finite, and among those of the tree that the small one is asked beside.
    pub corners: [[f32; 3]; 3],
    /// Its number.
    pub id: u32,
}

impl SmallTriangle {
    /// Three times the middle of it along an axis.
    #[inline]
    fn middle(&self, axis: usize) -> f32 {
        self.corners[0][axis] + self.corners[1][axis] + self.corners[2][axis]
    }
}

/// A tree over a few triangles, to build for a point and throw away: the blockers that photons name, or a half of them.
///
/// Ranges are cut in the middle along the axis on which their triangles lie farthest apart, three times a node, until
/// eight are left; no cost is estimated. So it is built in O(n log n), 50 to 160 ns a triangle for 16 to 1024 of them
/// (Zen 1), is balanced, and every block but one is full. A tree by surface area takes 4 to 40 times as long: for a
/// scene, not for a point. It needs no heap: nodes and blocks are written to slices that the caller keeps.
///
/// ```
/// use occlude_kernel::bvh::{SmallTree, SmallTriangle};
/// use occlude_kernel::{Bvh, Node, Ray, TriangleBlock, Uncounted};
///
/// let corners = |x: f32| [[x, -1.0, 1.0], [x + 1.0, -1.0, 1.0], [x, 1.0, 1.0]];
/// let mut few: Vec<SmallTriangle> =
///     (0..20).map(|i| SmallTriangle { corners: corners(i as f32), id: i }).collect();
/// let mut nodes = [Node::EMPTY; SmallTree::nodes(20)];
/// let mut blocks = [TriangleBlock::EMPTY; SmallTree::blocks(20)];
/// let (n, b) = SmallTree::new(&mut few, &mut nodes, &mut blocks).expect("room").build();
/// let tree = Bvh::new(&nodes[..n], &blocks[..b])?;
/// let ray = Ray::segment([7.2, 0.0, 0.0], [7.2, 0.0, 2.0]);
/// assert_eq!(tree.occluder(&ray, None, &mut Uncounted), Some(7));
/// # Ok::<(), occlude_kernel::BvhError>(())
/// ```
///
/// Billen's thesis on stochastic visibility builds one over each half of a point's potential blockers.
#[derive(Debug)]
pub struct SmallTree<'b> {
    triangles: &'b mut [SmallTriangle],
    nodes: &'b mut [Node],
    blocks: &'b mut [TriangleBlock],
}

impl<'b> SmallTree<'b> {
    /// Nodes to give room for.
    pub const fn nodes(triangles: usize) -> usize {
        // Inner nodes have two children at least, and the root stands even above a single block.
        Self::blocks(triangles)
    }

    /// Blocks to give room for.
    pub const fn blocks(triangles: usize) -> usize {
        triangles.div_ceil(TriangleBlock::WIDTH)
    }

    /// Over these triangles, in this memory; `None` if there is too little of it.
    pub fn new(
        triangles: &'b mut [SmallTriangle],
        nodes: &'b mut [Node],
        blocks: &'b mut [TriangleBlock],
    ) -> Option<Self> {
        let count = triangles.len();
        let room = nodes.len() >= Self::nodes(count) && blocks.len() >= Self::blocks(count);
        room.then_some(Self { triangles, nodes, blocks })
    }

    /// Builds it, and says how many nodes and blocks it is, from the first ones on. Puts the triangles in another order;
    /// the tree depends on theirs only where several lie at the same place.
    pub fn build(self) -> (usize, usize) {
        let mut plot = Plot { nodes: self.nodes, blocks: self.blocks, used: (0, 0) };
        match self.triangles.len() {
            0 => {}
            count if count <= TriangleBlock::WIDTH => {
                plot.used.0 = 1;
                let (child, lower, upper) = plot.leaf(self.triangles);
                plot.nodes[0] = Node::EMPTY;
                plot.nodes[0].set(0, lower, upper, child);
            }
            _ => {
                plot.grow(self.triangles);
            }
        }
        plot.used
    }
}

/// A subtree, and the box of it.
type Grown = (Child, [f32; 3], [f32; 3]);

const NOWHERE: ([f32; 3], [f32; 3]) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);

/// Where a tree grows.
struct Plot<'b> {
    nodes: &'b mut [Node],
    blocks: &'b mut [TriangleBlock],
    used: (usize, usize),
}

impl Plot<'_> {
    fn grow(&mut self, triangles: &mut [SmallTriangle]) -> Grown {
        if triangles.len() <= TriangleBlock::WIDTH {
            return self.leaf(triangles);
        }
        let index = self.used.0;
        self.used.0 += 1;
        self.nodes[index] = Node::EMPTY;
        let (mut lower, mut upper) = NOWHERE;
        // Where each of up to eight parts ends.
        let mut ends = [triangles.len(); Node::WIDTH];
        let mut parts = 1;
        while parts < Node::WIDTH {
            let (was, before) = (parts, ends);
            let (mut from, mut to) = (0, 0);
            for end in &before[..was] {
                let part = &mut triangles[from..*end];
                if part.len() > TriangleBlock::WIDTH {
                    ends[to] = from + halve(part);
                    to += 1;
                }
                ends[to] = *end;
                to += 1;
                from = *end;
            }
            parts = to;
            if parts == was {
                break;
            }
        }
        let mut from = 0;
        for (place, end) in ends[..parts].iter().enumerate() {
            let (child, low, high) = self.grow(&mut triangles[from..*end]);
            self.nodes[index].set(place, low, high, child);
            for axis in 0..3 {
                lower[axis] = lower[axis].min(low[axis]);
                upper[axis] = upper[axis].max(high[axis]);
            }
            from = *end;
        }
        (Child::node(index as u32), lower, upper)
    }

    fn leaf(&mut self, triangles: &[SmallTriangle]) -> Grown {
        let index = self.used.1;
        self.used.1 += 1;
        let mut block = TriangleBlock::EMPTY;
        let (mut lower, mut upper) = NOWHERE;
        for (lane, triangle) in triangles.iter().enumerate() {
            block.set(lane, triangle.corners, triangle.id);
            for corner in &triangle.corners {
                for axis in 0..3 {
                    lower[axis] = lower[axis].min(corner[axis]);
                    upper[axis] = upper[axis].max(corner[axis]);
                }
            }
        }
        self.blocks[index] = block;
        (Child::leaf(index as u32), lower, upper)
    }
}

/// Puts the lower half, in whole blocks, before the upper half, and says where that begins.
fn halve(triangles: &mut [SmallTriangle]) -> usize {
    let (mut lower, mut upper) = NOWHERE;
    for triangle in triangles.iter() {
        for axis in 0..3 {
            let at = triangle.middle(axis);
            lower[axis] = lower[axis].min(at);
            upper[axis] = upper[axis].max(at);
        }
    }
    let mut axis = 0;
    for other in 1..3 {
        if upper[other] - lower[other] > upper[axis] - lower[axis] {
            axis = other;
        }
    }
    let cut = SmallTree::blocks(triangles.len()) / 2 * TriangleBlock::WIDTH;
    triangles
        .select_nth_unstable_by(cut, |a, b| a.middle(axis).total_cmp(&b.middle(axis)).then(a.id.cmp(&b.id)));
    cut
}

impl<S: Simd> Bvh<'_, S> {
    /// A [`SmallTree`] of some of this tree's triangles, to ask as this one is asked. An error if it is none.
    ///
    /// Their vertices must be among those of this tree; others may be missed, or hit from too near. Costs one look at
    /// the small tree.
    pub fn with_small<'b>(
        &self,
        nodes: &'b [Node],
        blocks: &'b [TriangleBlock],
    ) -> Result<Bvh<'b, S>, BvhError> {
        check(nodes, blocks)?;
        Ok(Bvh { nodes, blocks, magnitude: self.magnitude, simd: self.simd })
    }
}
