//! Which of the scene's triangles a query is about.

use super::Child;
use crate::triangle::{NO_TRIANGLE, TriangleBlock};

/// Some of the triangles. Queries behave as if there were no others, and skip subtrees where there are none.
///
/// All that is not `below` must not be `holds` either, or the answer depends on the tree. `Option<u32>` is the part
/// that leaves out one triangle, or none. Implementations should be `#[inline(always)]`, as they stand in the
/// innermost loops.
pub trait Part: Copy {
    /// May something below this child belong to it?
    fn below(self, child: Child) -> bool;

    /// Does this triangle belong to it? Asked only of triangles whose parents are all `below`.
    fn holds(self, id: u32) -> bool;

    /// How many triangles of a block, those in the lanes of `lanes`, belong to it: for counters, and not called for
    /// [`Uncounted`](crate::Uncounted).
    #[inline(always)]
    fn count(self, block: &TriangleBlock, lanes: u32) -> u32 {
        let mut count = 0;
        for (lane, id) in block.ids.into_iter().enumerate() {
            count += u32::from(lanes >> lane & 1 != 0 && id != NO_TRIANGLE && self.holds(id));
        }
        count
    }
}

/// All triangles but this one.
impl Part for Option<u32> {
    #[inline(always)]
    fn below(self, _: Child) -> bool {
        true
    }

    #[inline(always)]
    fn holds(self, id: u32) -> bool {
        id != self.unwrap_or(NO_TRIANGLE)
    }

    #[inline(always)]
    fn count(self, block: &TriangleBlock, lanes: u32) -> u32 {
        (((1 << block.len()) - 1) & lanes).count_ones()
    }
}
