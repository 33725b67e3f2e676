//! Shadow rays of many batches into packets, the same way for everybody.
//!
//! As many rays of a batch as fill a packet go together. What is left over of it waits for the left-overs of the
//! batches behind it, so at one sample a light a packet holds neighbouring points, and only the very last packet
//! is not full.

use crate::{Batch, Work};
use glam::Vec3;
use occlude_kernel::Simd;
use occlude_kernel::lanes::Task;

/// Somebody who takes `W` rays at a time.
pub trait Tracer<const W: usize> {
    /// The rays.
    type Packet;
    /// A packet in which all that [`Self::fill`] and [`Self::put`] leave alone is written.
    fn packet(&self) -> Self::Packet;
    /// Writes all rays, from one point.
    fn fill(packet: &mut Self::Packet, origin: Vec3, targets: [&[f32; W]; 3]);
    /// Writes one ray.
    fn put(packet: &mut Self::Packet, lane: usize, origin: Vec3, target: [f32; 3]);
    /// Which of the rays whose bits are set are blocked. The others' bits may be anything.
    fn trace(&mut self, packet: &mut Self::Packet, active: u32) -> u32;
}

/// All of the work, one packet after the other: bit `i` of a batch's word answers for its ray `i`.
///
/// A task so that the filling is compiled for the CPU at hand, whoever traces.
pub struct Packed<'a, T, const W: usize> {
    /// Who traces.
    pub tracer: T,
    /// What is asked.
    pub work: &'a Work,
    /// A word a batch.
    pub blocked: &'a mut [u64],
}

impl<T: Tracer<W>, const W: usize> Task for Packed<'_, T, W> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        pack(self.tracer, self.work, self.blocked);
    }
}

/// See [`Packed`].
#[inline(always)]
pub fn pack<T: Tracer<W>, const W: usize>(mut tracer: T, work: &Work, blocked: &mut [u64]) {
    let [x, y, z] = &work.targets;
    let all = u32::MAX >> (32 - W);
    let (mut whole, mut mixed) = (tracer.packet(), tracer.packet());
    // Where the bits of the mixed packet's lanes belong.
    let mut homes = [(0usize, 0u32); W];
    let mut waiting = 0;
    let mut index = 0;
    while index < work.batches.len() {
        let Batch { origin, first, last, .. } = work.batches[index];
        let (first, last) = (first as usize, last as usize);
        let mut word = 0;
        let mut at = first;
        while let (true, Some(x), Some(y), Some(z)) =
            (at + W <= last, x[at..].first_chunk(), y[at..].first_chunk(), z[at..].first_chunk())
        {
            T::fill(&mut whole, origin, [x, y, z]);
            word |= u64::from(tracer.trace(&mut whole, all) & all) << (at - first);
            at += W;
        }
        blocked[index] = word;
        while at < last {
            T::put(&mut mixed, waiting, origin, [x[at], y[at], z[at]]);
            homes[waiting] = (index, (at - first) as u32);
            waiting += 1;
            at += 1;
            if waiting == W {
                send_home(tracer.trace(&mut mixed, all), &homes, W, blocked);
                waiting = 0;
            }
        }
        index += 1;
    }
    if waiting > 0 {
        let bits = tracer.trace(&mut mixed, (1 << waiting) - 1);
        send_home(bits, &homes, waiting, blocked);
    }
}

#[inline(always)]
fn send_home<const W: usize>(bits: u32, homes: &[(usize, u32); W], count: usize, blocked: &mut [u64]) {
    let mut lane = 0;
    while lane < count {
        let (batch, bit) = homes[lane];
        blocked[batch] |= u64::from(bits >> lane & 1) << bit;
        lane += 1;
    }
}
