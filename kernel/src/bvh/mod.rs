//! A tree of boxes over triangles, eight children a node, and the questions asked of it.
//!
//! | question | one ray | up to 16 rays | one point, many light samples | neighbouring points, one light |
//! |---|---|---|---|---|
//! | is anything there? | [`Bvh::occluded`] | [`Bvh::occluded_packet`] | [`Bvh::occluded_batch`] | [`Bvh::occluded_tile`] |
//! | which triangle? | [`Bvh::occluder`] | [`Bvh::occluder_packet`] | | |
//! | the nearest one | [`Bvh::closest`] | [`Bvh::closest_packet`] | | |
//! | all of them | [`Bvh::each_hit`], [`Bvh::each_hit_in_order`] | [`Bvh::each_hit_packet`] | | |
//! | do boxes inside of closed meshes block it? | | | [`Bvh::hidden_batch`] | [`Bvh::occluded_tile_with`] |
//! | is any of these there? | [`Bvh::occluded_among`] | | [`Bvh::occluded_batch_among`], [`Bvh::occluded_batch_by`] | |
//!
//! Which to use: for shadows, the tile wherever points come in neighbourhoods (about 8 by 8 pixels or texels at several
//! samples a light, 16 by 16 at one, best in the order of a Z curve); the batch for a point by itself with four samples
//! or more; packets for other rays, camera rays above all, of which some start and end near each other; single rays for
//! the rest.
//!
//! Every one gives the answer of a loop over all triangles with the test of [`crate::triangle`]: boxes are
//! widened by a bound on all rounding, of the box test as of the triangle test, so no hit is culled. One thing is
//! left to rounding: where a ray runs within a triangle's plane (to a thousandth), `t` may be that of any point of the
//! triangle, and a hit that rounding puts outside its box counts only if `t_min` and `t_max` let that box, or one around
//! it, count.

mod abreast;
mod batch;
mod beams;
mod cover;
mod grid;
mod hull;
mod list;
mod occluders;
mod packet;
mod part;
mod pyramid;
mod shaft;
mod single;
mod slabs;
mod small;
mod stream;
mod tile;
mod umbra;

pub use batch::{BatchScratch, Targets};
pub use occluders::Occluders;
pub use packet::HitPacket;
pub use part::Part;
pub use small::{SmallTree, SmallTriangle};
pub use tile::{TilePoint, TileScratch};

use crate::lanes::{Native, Simd};
use crate::triangle::TriangleBlock;
use bytemuck::{Pod, Zeroable};
use core::fmt;
use glam::Vec3;

/// An inner node: the boxes of eight children, and what they are.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(32))]
pub struct Node {
    /// `bounds[0]` the least, `bounds[1]` the greatest corners: `bounds[side][axis][child]`. An unused child has
    /// an empty box: infinity below minus infinity.
    pub bounds: [[[f32; 8]; 3]; 2],
    /// The children.
    pub children: [Child; 8],
}

impl Node {
    /// Children a node holds.
    pub const WIDTH: usize = 8;

    /// No children.
    pub const EMPTY: Self =
        Self { bounds: [[[f32::INFINITY; 8]; 3], [[f32::NEG_INFINITY; 8]; 3]], children: [Child::NONE; 8] };

    /// Writes a child. Panics if there is no such place.
    pub fn set(&mut self, place: usize, lower: [f32; 3], upper: [f32; 3], child: Child) {
        for axis in 0..3 {
            self.bounds[0][axis][place] = lower[axis];
            self.bounds[1][axis][place] = upper[axis];
        }
        self.children[place] = child;
    }
}

/// What a place of a [`Node`] refers to: another node, triangles of a block, or nothing.
///
/// Leaves may share a block, so that blocks are full where leaves are not.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct Child(u32);

/// What a leaf refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Leaf {
    /// The index of the block.
    pub block: usize,
    /// The first of its lanes that belong to the leaf.
    pub first: usize,
    /// How many do, one after the other; unused lanes are none of its triangles.
    pub count: usize,
}

impl Leaf {
    /// The lanes.
    #[inline]
    pub const fn lanes(self) -> core::ops::Range<usize> {
        self.first..self.first + self.count
    }

    /// The numbers of its triangles. Panics if there is no such block.
    #[inline]
    pub fn ids(self, blocks: &[TriangleBlock]) -> &[u32] {
        let block = &blocks[self.block];
        let end = (self.first + self.count).min(block.len());
        &block.ids[self.first.min(end)..end]
    }
}

impl Child {
    const LEAF: u32 = 1 << 31;

    /// Of a leaf: three bits for the lanes but one, three for the first lane, the block.
    const LANES: u32 = 6;

    /// The greatest index of a block that fits.
    pub const MAX_BLOCK: u32 = (Self::LEAF >> Self::LANES) - 2;

    /// Nothing.
    pub const NONE: Self = Self(u32::MAX);

    /// The greatest index of a node that fits.
    pub const MAX_INDEX: u32 = Self::LEAF - 2;

    /// An inner node, by its index. Panics if that is above [`Child::MAX_INDEX`].
    #[inline(always)]
    pub const fn node(index: u32) -> Self {
        assert!(index <= Self::MAX_INDEX, "no child can name this node");
        Self(index)
    }

    /// A block of triangles, by its index. Panics if that is above [`Child::MAX_BLOCK`].
    #[inline(always)]
    pub const fn leaf(index: u32) -> Self {
        Self::lanes(index, 0, TriangleBlock::WIDTH as u32)
    }

    /// `count` lanes of a block from the `first` on, by its index. Panics if that is above [`Child::MAX_BLOCK`], or if
    /// there are no such lanes.
    #[inline(always)]
    pub const fn lanes(index: u32, first: u32, count: u32) -> Self {
        assert!(index <= Self::MAX_BLOCK, "no leaf can name this block");
        assert!(count >= 1 && first < 8 && first + count <= 8, "a block has eight lanes");
        Self(Self::LEAF | index << Self::LANES | first << 3 | (count - 1))
    }

    /// The index of the inner node it refers to, if it does.
    #[inline]
    pub const fn as_node(self) -> Option<usize> {
        if self.is_leaf() { None } else { Some(self.index()) }
    }

    /// The triangles it refers to, if it does.
    #[inline]
    pub const fn as_leaf(self) -> Option<Leaf> {
        if !self.is_leaf() || self.0 == Self::NONE.0 {
            return None;
        }
        let (first, rest) = (self.0 as usize >> 3 & 7, self.0 as usize & 7);
        // Bytes of anyone's may name lanes that there are not.
        let count = if first + rest < 8 { rest + 1 } else { 8 - first };
        Some(Leaf { block: self.block(), first, count })
    }

    #[inline(always)]
    const fn is_leaf(self) -> bool {
        self.0 & Self::LEAF != 0
    }

    /// Of a node.
    #[inline(always)]
    const fn index(self) -> usize {
        (self.0 & !Self::LEAF) as usize
    }

    /// Of a leaf.
    #[inline(always)]
    const fn block(self) -> usize {
        ((self.0 & !Self::LEAF) >> Self::LANES) as usize
    }

    /// The lanes of a leaf, as bits.
    #[inline(always)]
    const fn bits(self) -> u32 {
        ((2 << (self.0 & 7)) - 1) << (self.0 >> 3 & 7) & 0xff
    }
}

/// Why slices are no tree. Every variant names the node or block at fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BvhError {
    /// A child's index lies beyond the slice.
    OutOfRange {
        /// The node.
        node: u32,
        /// The child's place in it.
        place: u32,
    },
    /// A node refers to itself or to one before it. Children come after their parents.
    Backwards {
        /// The node.
        node: u32,
        /// The child's place in it.
        place: u32,
    },
    /// A box is NaN, infinite or inside out though the place is used.
    Box {
        /// The node.
        node: u32,
        /// The child's place in it.
        place: u32,
    },
    /// More than [`MAX_DEPTH`] levels.
    TooDeep {
        /// A node on the lowest level allowed.
        node: u32,
    },
    /// Two places refer to the same node, so this is no tree.
    Shared {
        /// A node met when all were counted already.
        node: u32,
    },
    /// A lane of a block, used or not, holds a vertex that is NaN or infinite.
    Vertex {
        /// The block.
        block: u32,
        /// The lane.
        lane: u32,
    },
    /// A lane of a block, used or not, holds a vertex beyond [`Bvh::MAX_COORDINATE`].
    TooFar {
        /// The block.
        block: u32,
        /// The lane.
        lane: u32,
    },
    /// More nodes or blocks than an index can name.
    TooMany,
}

impl fmt::Display for BvhError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OutOfRange { node, place } => {
                write!(f, "node {node}, child {place}: index beyond the slice")
            }
            Self::Backwards { node, place } => {
                write!(f, "node {node}, child {place}: refers to a node that is not behind it")
            }
            Self::Box { node, place } => write!(f, "node {node}, child {place}: not a finite box"),
            Self::TooDeep { node } => write!(f, "node {node}: deeper than {} levels", MAX_DEPTH),
            Self::Shared { node } => write!(f, "node {node}: has more than one parent"),
            Self::Vertex { block, lane } => write!(f, "block {block}, lane {lane}: a vertex is not finite"),
            Self::TooFar { block, lane } => {
                write!(f, "block {block}, lane {lane}: a vertex is beyond {:e}", Bvh::MAX_COORDINATE)
            }
            Self::TooMany => {
                write!(f, "more than {} nodes or {} blocks", Child::MAX_INDEX, Child::MAX_BLOCK)
            }
        }
    }
}

impl core::error::Error for BvhError {}

/// A tree over borrowed slices, checked once; after that no query can fail, overflow or run for ever.
///
/// `S` says which vectors the queries use; [`Bvh::on`] changes it. Copying one copies two slices.
#[derive(Clone, Copy, Debug)]
pub struct Bvh<'a, S = Native> {
    nodes: &'a [Node],
    blocks: &'a [TriangleBlock],
    magnitude: f32,
    simd: S,
}

/// Levels of nodes a tree may have.
pub const MAX_DEPTH: usize = 32;

/// Subtrees that a tile's shaft may leave to begin with.
const CUT: usize = 16;

/// What a stack of nodes yet to visit must hold: each level leaves up to seven behind.
const STACK: usize = MAX_DEPTH * (Node::WIDTH - 1) + CUT;

/// Every lane of a block.
const ALL_LANES: u32 = 0xff;

/// One unit in the last place of 1, halved: how far rounding moves a number, relative to it.
const ROUNDING: f32 = f32::EPSILON / 2.0;

/// Where what several segments have in common is asked at once, nothing is farther away than this along an axis, so that
/// products of three differences are finite. Beyond, each segment is asked by itself.
const FARTHEST: f32 = 1e11;

/// And the greatest coordinate is not below this, so that the same products, times their rounding, do not vanish.
const NEAREST: f32 = 1e-8;

impl<'a> Bvh<'a> {
    /// The greatest coordinate that vertices may have, of either sign.
    ///
    /// The triangle test multiplies three differences of positions; beyond 1e12 that overflows, and hits get lost.
    pub const MAX_COORDINATE: f32 = 1e10;

    /// A tree whose root is the first node; no nodes make an empty scene.
    ///
    /// Checked: indices, order (children come after their parents), depth, boxes and vertices. Not checked: that
    /// a box holds what is below it; triangles outside their boxes are not found. Costs one look at everything.
    ///
    /// What scale a scene has does not matter, within limits: from a greatest coordinate of 1e-9 to
    /// [`Bvh::MAX_COORDINATE`] all queries give the answers that they give of the same scene at any other scale. The
    /// products of smaller scenes vanish, and hits get lost, or lose their `t`: measure those in smaller units. Points and
    /// targets may be anywhere. Beyond 1e11 each segment is asked by itself, which takes longer, and beyond 1e12 it may
    /// miss what it should hit; but all queries agree about that too.
    pub fn new(nodes: &'a [Node], blocks: &'a [TriangleBlock]) -> Result<Self, BvhError> {
        check(nodes, blocks)?;
        let magnitude = nodes.first().map_or(0.0, |root| {
            let used = |place: &usize| root.children[*place] != Child::NONE;
            (0..Node::WIDTH).filter(used).fold(0.0f32, |most, place| {
                root.bounds.iter().flatten().fold(most, |most, axis| most.max(axis[place].abs()))
            })
        });
        Ok(Self { nodes, blocks, magnitude, simd: Native })
    }
}

impl<'a, S: Simd> Bvh<'a, S> {
    /// The same tree, asked with other vectors.
    #[inline(always)]
    pub fn on<T: Simd>(&self, simd: T) -> Bvh<'a, T> {
        Bvh { nodes: self.nodes, blocks: self.blocks, magnitude: self.magnitude, simd }
    }

    /// Blocks of some of this tree's triangles, with no nodes above them, to ask by [`Bvh::occluded_batch_by`].
    ///
    /// Their vertices must be among those of the tree; others may be missed, or hit from too near.
    #[inline(always)]
    pub fn with_blocks<'b>(&self, blocks: &'b [TriangleBlock]) -> Bvh<'b, S> {
        Bvh { nodes: &[], blocks, magnitude: self.magnitude, simd: self.simd }
    }

    /// The nodes.
    #[inline]
    pub fn nodes(&self) -> &'a [Node] {
        self.nodes
    }

    /// The triangles.
    #[inline]
    pub fn blocks(&self) -> &'a [TriangleBlock] {
        self.blocks
    }

    /// How far a point must stand off a surface so that no rounding makes it hit that surface, or one in the
    /// same plane: 32 roundings of the scene's greatest coordinate. For [`offset`].
    ///
    /// It covers the error of a point computed on a triangle and the error of the triangle test (see
    /// [`crate::triangle`]; each sheared vertex is off by up to five roundings of its distance from the origin,
    /// which two points of the scene bound by twice the greatest coordinate).
    #[inline]
    pub fn clearance(&self) -> f32 {
        32.0 * ROUNDING * self.magnitude
    }

    /// What bounds are widened by, for a ray from here: all rounding of box and triangle tests.
    #[inline(always)]
    fn slack(&self, origin: Vec3) -> f32 {
        16.0 * ROUNDING * (self.magnitude + origin.abs().max_element())
    }
}

/// Moves a point off a surface, along its unit normal, to the side the normal points to.
///
/// With [`Bvh::clearance`], a ray that leaves to that side cannot hit the surface or another in its plane, and
/// one that enters meets it; there is no epsilon to tune, since the distance follows from the scene's numbers.
/// Move both ends of a shadow ray: x along the normal of its surface, y along the light's.
///
/// After Wächter and Binder, "A Fast and Robust Method for Avoiding Self-Intersection" (Ray Tracing Gems,
/// 2019), who offset by units in the last place of the point; here the unit is that of the whole scene, since
/// the planes that must be cleared may be spanned by vertices far from the point.
#[inline]
pub fn offset(point: impl Into<[f32; 3]>, normal: impl Into<[f32; 3]>, clearance: f32) -> Vec3 {
    Vec3::from(point.into()) + Vec3::from(normal.into()) * clearance
}

fn check(nodes: &[Node], blocks: &[TriangleBlock]) -> Result<(), BvhError> {
    if blocks.len() > Child::MAX_BLOCK as usize {
        return Err(BvhError::TooMany);
    }
    for (index, block) in blocks.iter().enumerate() {
        for lane in 0..TriangleBlock::WIDTH {
            // NaN is within nothing.
            let within = |most: f32| block.vertices.iter().flatten().all(|axis| axis[lane].abs() <= most);
            if !within(Bvh::MAX_COORDINATE) {
                let finite = within(f32::MAX);
                let (block, lane) = (index as u32, lane as u32);
                return Err(if finite {
                    BvhError::TooFar { block, lane }
                } else {
                    BvhError::Vertex { block, lane }
                });
            }
        }
    }
    check_nodes(nodes, blocks.len())
}

/// The nodes alone; leaves have indices below `leaves`.
fn check_nodes(nodes: &[Node], leaves: usize) -> Result<(), BvhError> {
    if nodes.len() > Child::MAX_INDEX as usize {
        return Err(BvhError::TooMany);
    }
    for (index, node) in nodes.iter().enumerate() {
        for place in 0..Node::WIDTH {
            let child = node.children[place];
            if child == Child::NONE {
                continue;
            }
            let at = (index as u32, place as u32);
            let beyond = if child.is_leaf() { child.block() >= leaves } else { child.index() >= nodes.len() };
            if beyond {
                return Err(BvhError::OutOfRange { node: at.0, place: at.1 });
            }
            if !child.is_leaf() && child.index() <= index {
                return Err(BvhError::Backwards { node: at.0, place: at.1 });
            }
            let sound = (0..3).all(|axis| {
                let (lower, upper) = (node.bounds[0][axis][place], node.bounds[1][axis][place]);
                lower.is_finite() && upper.is_finite() && lower <= upper
            });
            if !sound {
                return Err(BvhError::Box { node: at.0, place: at.1 });
            }
        }
    }
    if nodes.is_empty() {
        return Ok(());
    }
    // Depth first, a frame a level: the node and the next of its places. Indices only grow on the way down, and
    // more visits than nodes mean that one has two parents, so this ends.
    let mut path = [(0usize, 0usize); MAX_DEPTH];
    let (mut level, mut visits) = (0, 1);
    loop {
        let (index, place) = path[level];
        if place == Node::WIDTH {
            if level == 0 {
                return Ok(());
            }
            level -= 1;
            continue;
        }
        path[level].1 += 1;
        let child = nodes[index].children[place];
        if child == Child::NONE || child.is_leaf() {
            continue;
        }
        visits += 1;
        if visits > nodes.len() {
            return Err(BvhError::Shared { node: child.0 });
        }
        level += 1;
        if level == MAX_DEPTH {
            return Err(BvhError::TooDeep { node: index as u32 });
        }
        path[level] = (child.index(), 0);
    }
}
