//! The k nearest so far.

use super::PhotonId;
use bytemuck::{Pod, Zeroable};

/// A photon found, and how far away it is.
///
/// Ordered by distance, and by number where that is the same: so the k nearest are the same whatever the order in
/// which photons are met. Distances are never negative, so their bits are in order too, and one comparison of
/// integers decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Pod, Zeroable)]
#[repr(transparent)]
pub struct Neighbour(u64);

impl Neighbour {
    /// What to fill slots with.
    pub const NONE: Self = Self(u64::MAX);

    #[inline(always)]
    fn new(squared: f32, id: PhotonId) -> Self {
        Self(u64::from(squared.to_bits()) << 32 | u64::from(id.0))
    }

    /// The square of its distance, by the measure asked with.
    #[inline(always)]
    pub fn distance_squared(self) -> f32 {
        f32::from_bits((self.0 >> 32) as u32)
    }

    /// Which photon.
    #[inline(always)]
    pub fn id(self) -> PhotonId {
        PhotonId(self.0 as u32)
    }
}

/// Room for the k nearest photons of a look-up, in a slice that the caller gives.
///
/// No heap: what comes near enough is appended, and when the slice is full the k nearest are selected, which also
/// says how near the next must be. A photon so costs a constant time on average, and not the logarithm of k.
///
/// Slots beyond [`room(k)`](Self::room) are for the photons of later rounds
/// ([`Photons::with_later`](super::Photons::with_later)): with `room(k) + room(m)` slots up to m of them count.
#[derive(Debug)]
pub struct Nearest<'a> {
    slots: &'a mut [Neighbour],
    spare: &'a mut [Neighbour],
    k: usize,
    len: usize,
    full: usize,
    reach: f32,
}

impl<'a> Nearest<'a> {
    /// Slots to give for k neighbours.
    pub const fn room(k: usize) -> usize {
        k.saturating_mul(2).saturating_add(SPARE)
    }

    /// For the `k` nearest, in at least [`room(k)`](Self::room) slots; `None` if there are fewer.
    pub fn new(k: usize, slots: &'a mut [Neighbour]) -> Option<Self> {
        let room = Self::room(k);
        let (slots, spare) = slots.split_at_mut_checked(room)?;
        Some(Self { slots, spare, k, len: 0, full: room, reach: -1.0 })
    }

    /// How many are looked for.
    #[inline]
    pub fn k(&self) -> usize {
        self.k
    }

    /// The neighbours found by the last look-up, in no order, at most k.
    #[inline]
    pub fn found(&self) -> &[Neighbour] {
        &self.slots[..self.len]
    }

    /// The neighbours found, and room for as many more as the spare slots hold; `None` if that is no photon.
    #[inline(always)]
    pub(super) fn and_more(&mut self) -> (&[Neighbour], Option<Nearest<'_>>) {
        let k = self.spare.len().saturating_sub(SPARE) / 2;
        let more = if k > 0 { Nearest::new(k, self.spare) } else { None };
        (&self.slots[..self.len], more)
    }

    /// The same, the nearest first.
    pub fn sorted(&mut self) -> &[Neighbour] {
        self.slots[..self.len].sort_unstable();
        self.found()
    }

    /// Begins a look-up within the root of `reach`.
    #[inline(always)]
    pub(super) fn start(&mut self, reach: f32) {
        self.len = 0;
        self.reach = if self.k == 0 { -1.0 } else { reach };
    }

    /// Photons beyond the root of this do not count.
    #[inline(always)]
    pub(super) fn reach(&self) -> f32 {
        self.reach
    }

    /// Adds a photon within reach.
    #[inline(always)]
    pub(super) fn push(&mut self, squared: f32, id: PhotonId) {
        if self.len == self.full {
            self.shrink();
            // What was in reach a moment ago need not be any longer.
            if squared > self.reach {
                return;
            }
        }
        self.slots[self.len] = Neighbour::new(squared, id);
        self.len += 1;
    }

    /// As soon as k are known it pays to know how far the farthest of them is.
    #[inline(always)]
    pub(super) fn leaf_done(&mut self) {
        if self.len >= self.k + self.k / 8 + 4 || (self.len >= self.k && self.reach == f32::MAX) {
            self.shrink();
        }
    }

    /// Ends a look-up.
    #[inline(always)]
    pub(super) fn finish(&mut self) {
        if self.len > self.k {
            self.shrink();
        }
    }

    /// Keeps the k nearest.
    #[inline]
    fn shrink(&mut self) {
        if self.len >= self.k && self.k > 0 {
            let (_, last, _) = self.slots[..self.len].select_nth_unstable(self.k - 1);
            self.reach = last.distance_squared();
            self.len = self.k;
        }
    }
}

/// Slots beyond twice k.
const SPARE: usize = 32;
