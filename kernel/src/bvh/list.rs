//! A few triangles of a tile, side by side in blocks of their own.

use super::Part;
use super::pyramid::Learner;
use super::shaft::Shaft;
use crate::counter::Counter;
use crate::lanes::Simd;
use crate::triangle::{NO_TRIANGLE, TriangleBlock};

/// A learned block that blocks fewer targets a point than this, by and by, is dropped: looking for them in the tree
/// is then cheaper than asking it every time.
const WORTH: f32 = 3.0;
const FADING: f32 = 0.75;

/// A triangle that blocks as many targets at once is learned.
const LEARN: u32 = 1;
pub(super) const CREDIT: u32 = 3;
const LEAST_SCORE: f32 = -4.0;

/// Triangles to ask first.
pub(super) struct List {
    pub(super) blocks: [TriangleBlock; List::MOST / TriangleBlock::WIDTH],
    /// How much more a block blocks than it must to be worth asking.
    scores: [f32; List::MOST / TriangleBlock::WIDTH],
    pub(super) count: usize,
    /// Blocks that may yet prove not worth asking before no more triangles are learned.
    pub(super) credit: u32,
}

impl List {
    pub(super) const MOST: usize = 128;

    /// As many a shaft may list at most.
    pub(super) const ROOM: usize = 64;

    pub(super) const EMPTY: Self = Self {
        blocks: [TriangleBlock::EMPTY; List::MOST / TriangleBlock::WIDTH],
        scores: [0.0; List::MOST / TriangleBlock::WIDTH],
        count: 0,
        credit: 0,
    };

    /// The blocks in use.
    #[inline(always)]
    pub(super) fn blocks(&self) -> &[TriangleBlock] {
        &self.blocks[..self.count.div_ceil(TriangleBlock::WIDTH)]
    }

    /// Copies a triangle to the end. There must be room.
    #[inline(always)]
    pub(super) fn push(&mut self, from: &TriangleBlock, lane: usize) {
        let (block, place) = (self.count / TriangleBlock::WIDTH, self.count % TriangleBlock::WIDTH);
        if place == 0 {
            self.blocks[block] = TriangleBlock::EMPTY;
            self.scores[block] = WORTH;
        }
        let to = &mut self.blocks[block];
        let mut vertex = 0;
        while vertex < 3 {
            let mut axis = 0;
            while axis < 3 {
                to.vertices[vertex][axis][place] = from.vertices[vertex][axis][lane];
                axis += 1;
            }
            vertex += 1;
        }
        to.ids[place] = from.ids[lane];
        self.count += 1;
    }

    /// Takes in the triangles of a block that the shaft meets. False if there is no room for them.
    #[inline(always)]
    pub(super) fn take<S: Simd>(
        &mut self,
        shaft: &Shaft,
        simd: S,
        (block, lanes): (&TriangleBlock, u32),
        room: usize,
        counter: &mut impl Counter,
    ) -> bool {
        counter.triangle_tests(None::<u32>.count(block, lanes));
        let mut open = shaft.triangles(simd, block) & lanes;
        while open != 0 {
            let lane = open.trailing_zeros() as usize & 7;
            open &= open - 1;
            if block.ids[lane] != NO_TRIANGLE {
                if self.count == room {
                    return false;
                }
                self.push(block, lane);
            }
        }
        true
    }

    /// Notes that the list did not do for a point. It is given up when that comes too often.
    #[inline(always)]
    pub(super) fn fail(&mut self) {
        self.credit = self.credit.saturating_sub(1);
        if self.credit == 0 {
            self.count = 0;
        }
    }

    /// Notes how many targets a block blocked, moves it up if it does better than the one before it, and drops it if
    /// it does too little and may go. False if another now stands in its place.
    #[inline(always)]
    pub(super) fn judge(&mut self, k: usize, blocked: u32, may_go: bool) -> bool {
        let score = self.scores[k] * FADING + blocked as f32 - WORTH;
        self.scores[k] = score;
        // The last block may have room; it stays the last.
        if (k + 1) * TriangleBlock::WIDTH > self.count {
            return true;
        }
        if may_go && score < LEAST_SCORE {
            // The last full one takes its place, and the one with room, if any, that one's.
            let full = self.count / TriangleBlock::WIDTH - 1;
            (self.blocks[k], self.scores[k]) = (self.blocks[full], self.scores[full]);
            if !self.count.is_multiple_of(TriangleBlock::WIDTH) {
                (self.blocks[full], self.scores[full]) = (self.blocks[full + 1], self.scores[full + 1]);
            }
            self.count -= TriangleBlock::WIDTH;
            self.credit = self.credit.saturating_sub(1);
            return false;
        }
        if k > 0 && score > self.scores[k - 1] {
            self.blocks.swap(k, k - 1);
            self.scores.swap(k, k - 1);
        }
        true
    }
}

impl Learner for List {
    #[inline(always)]
    fn learn(&mut self, block: &TriangleBlock, lane: usize, blocked: u32) {
        if blocked >= LEARN && self.count < Self::MOST && self.credit > 0 {
            self.push(block, lane);
        }
    }
}
