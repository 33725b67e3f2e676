//! A balanced tree of photons with no pointers in it.

use super::{Nearest, PhotonBlock, Place, PlaceLanes, Point};
use crate::lanes::{Native, Simd};
use bytemuck::{Pod, Zeroable};
use core::fmt;

/// Where a range of photons is cut in two: below the value on this axis, and above.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Split {
    value: f32,
    axis: u32,
}

impl Split {
    /// What to fill a slice with, before a tree is built in it.
    pub const NONE: Self = Self { value: 0.0, axis: 0 };
}

/// Blocks below a node that is not cut any more.
const LEAF: usize = 4;

/// Ranges put off on the way down; a slice that an index of 32 bits can name has no more levels.
const DEPTH: usize = 32;

/// A tree under construction, or a part of one: photons and splits, sorted in place.
///
/// ```
/// use occlude_kernel::photons::{Nearest, Neighbour, PhotonBlock, PhotonId, PhotonMap, PhotonTree, Place, Point, Split};
///
/// let mut blocks = [PhotonBlock::EMPTY; 2];
/// for (i, point) in PhotonBlock::as_points(&mut blocks).iter_mut().take(10).enumerate() {
///     *point = Point { position: [i as f32, 0.0, 0.0], id: PhotonId::light(i as u32) };
/// }
/// let mut splits = [Split::NONE; 2];
/// PhotonTree::new(&mut blocks, &mut splits).expect("a split a block").build();
/// let map = PhotonMap::new(&blocks, &splits)?;
///
/// let mut slots = [Neighbour::NONE; Nearest::room(3)];
/// let mut nearest = Nearest::new(3, &mut slots).expect("room");
/// map.nearest(&Place::ball([6.2, 0.0, 0.0], 10.0), &mut nearest);
/// assert_eq!(nearest.sorted().iter().map(|n| n.id().index()).collect::<Vec<_>>(), [6, 7, 5]);
/// # Ok::<(), occlude_kernel::photons::PhotonMapError>(())
/// ```
#[derive(Debug)]
pub struct PhotonTree<'b> {
    points: &'b mut [Point],
    splits: &'b mut [Split],
}

impl<'b> PhotonTree<'b> {
    /// Of blocks that hold points ([`PhotonBlock::as_points`]), and a split for each; `None` if there are not as
    /// many of one as of the other.
    pub fn new(blocks: &'b mut [PhotonBlock], splits: &'b mut [Split]) -> Option<Self> {
        (blocks.len() == splits.len()).then(|| Self { points: PhotonBlock::as_points(blocks), splits })
    }

    /// Blocks in this part.
    pub fn blocks(&self) -> usize {
        self.splits.len()
    }

    /// Cuts it in two along its longest axis, in linear time; each half can be built by a thread of its own.
    /// `None` if it is a leaf, which then is done.
    pub fn halve(self) -> Option<(Self, Self)> {
        let blocks = self.blocks();
        if blocks <= LEAF {
            PhotonBlock::transpose(self.points);
            return None;
        }
        let (mut lower, mut upper) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for point in self.points.iter() {
            for axis in 0..3 {
                let at = point.position[axis];
                lower[axis] = if at < lower[axis] { at } else { lower[axis] };
                upper[axis] = if at > upper[axis] { at } else { upper[axis] };
            }
        }
        let mut axis = 0;
        for other in 1..3 {
            if upper[other] - lower[other] > upper[axis] - lower[axis] {
                axis = other;
            }
        }
        // Left over places are NaN, which comes last.
        let middle = blocks / 2;
        let key = |point: &Point| point.position[axis];
        let (_, cut, _) =
            self.points.select_nth_unstable_by(middle * PhotonBlock::WIDTH, |a, b| key(a).total_cmp(&key(b)));
        self.splits[middle] = Split { value: key(cut), axis: axis as u32 };
        let (left, right) = self.points.split_at_mut(middle * PhotonBlock::WIDTH);
        let (left_splits, right_splits) = self.splits.split_at_mut(middle);
        Some((Self { points: left, splits: left_splits }, Self { points: right, splits: right_splits }))
    }

    /// Builds it all, in O(n log n). The stack grows with the logarithm of the number.
    pub fn build(self) {
        if let Some((left, right)) = self.halve() {
            left.build();
            right.build();
        }
    }
}

/// Why slices are no map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PhotonMapError {
    /// There must be a split for each block.
    Lengths,
    /// A split along an axis that there is not.
    Axis {
        /// The split.
        split: usize,
    },
    /// More blocks than an index can name.
    TooMany,
}

impl fmt::Display for PhotonMapError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Lengths => write!(f, "there are not as many splits as blocks"),
            Self::Axis { split } => write!(f, "split {split}: the axis is not 0, 1 or 2"),
            Self::TooMany => write!(f, "more than {} blocks", u32::MAX),
        }
    }
}

impl core::error::Error for PhotonMapError {}

/// Photons sorted for look-ups: a balanced kd-tree over borrowed slices.
///
/// A node is a range of blocks, cut in the middle; the split of a node stands where it cuts, so a tree is two plain
/// slices: 16 bytes a photon, and one for the split. Leaves are up to 32 photons, looked at eight at a time.
#[derive(Clone, Copy, Debug)]
pub struct PhotonMap<'a, S = Native> {
    blocks: &'a [PhotonBlock],
    splits: &'a [Split],
    simd: S,
}

impl<'a> PhotonMap<'a> {
    /// What [`PhotonTree::build`] left behind. Checked is what could make a look-up panic or run on; not that the
    /// photons are in order.
    pub fn new(blocks: &'a [PhotonBlock], splits: &'a [Split]) -> Result<Self, PhotonMapError> {
        if blocks.len() != splits.len() {
            return Err(PhotonMapError::Lengths);
        }
        if blocks.len() as u64 > u64::from(u32::MAX) {
            return Err(PhotonMapError::TooMany);
        }
        match splits.iter().position(|split| split.axis > 2) {
            Some(split) => Err(PhotonMapError::Axis { split }),
            None => Ok(Self { blocks, splits, simd: Native }),
        }
    }
}

/// A range put off, and how far x is from it along each axis.
#[derive(Clone, Copy)]
struct Later {
    from: u32,
    to: u32,
    off: [f32; 3],
    square: f32,
}

impl<'a, S: Simd> PhotonMap<'a, S> {
    /// The same map, asked with other vectors.
    #[inline(always)]
    pub fn on<T: Simd>(&self, simd: T) -> PhotonMap<'a, T> {
        PhotonMap { blocks: self.blocks, splits: self.splits, simd }
    }

    /// A map that holds nothing.
    #[inline(always)]
    pub(super) fn without_photons(&self) -> Self {
        Self { blocks: &[], splits: &[], simd: self.simd }
    }

    /// The photons.
    #[inline]
    pub fn blocks(&self) -> &'a [PhotonBlock] {
        self.blocks
    }

    /// Finds the nearest photons of a place, at its radius or nearer; of several at the same distance those of
    /// the lowest numbers. Photons whose coordinates are not finite are nowhere near.
    ///
    /// The same answer as a loop over all photons, at any width: a range is passed over only if its nearest
    /// corner is farther than the k-th photon, and that distance is computed by the same operations, rounded
    /// alike, as those of the photons.
    #[inline(always)]
    pub fn nearest(&self, place: &Place, nearest: &mut Nearest<'_>) {
        nearest.start(place.reach());
        if self.blocks.is_empty() || nearest.reach() < 0.0 {
            return;
        }
        let token = self.simd.token();
        let lanes = PlaceLanes::<S::Node>::new(token, place);
        let x = place.x.to_array();
        let mut stack = [Later { from: 0, to: 0, off: [0.0; 3], square: 0.0 }; DEPTH];
        let mut len = 0;
        let (mut from, mut to, mut off) = (0, self.blocks.len(), [0.0f32; 3]);
        loop {
            while to - from > LEAF {
                let middle = from + (to - from) / 2;
                let split = self.splits[middle];
                let axis = split.axis as usize;
                let step = x[axis] - split.value;
                let mut beyond = off;
                beyond[axis] = step;
                let square = beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2];
                let (mut first, mut last) = (middle, to);
                if step < 0.0 {
                    to = middle;
                } else {
                    (first, last) = (from, middle);
                    from = middle;
                }
                // Not the opposite comparison: what is NaN is looked at.
                let far = square > nearest.reach();
                if !far {
                    stack[len & (DEPTH - 1)] =
                        Later { from: first as u32, to: last as u32, off: beyond, square };
                    len += 1;
                }
            }
            for block in &self.blocks[from..to] {
                lanes.offer(token, block, 0xff, nearest);
            }
            nearest.leaf_done();
            loop {
                if len == 0 {
                    nearest.finish();
                    return;
                }
                len -= 1;
                let later = stack[len & (DEPTH - 1)];
                if later.square > nearest.reach() {
                    continue;
                }
                (from, to, off) = (later.from as usize, later.to as usize, later.off);
                break;
            }
        }
    }
}
