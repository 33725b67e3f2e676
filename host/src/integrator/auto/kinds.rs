//! How unlike samples of a light are at pixels of a kind.
//!
//! Where all samples of a batch saw the same, fewer would have told as much. A pixel that has seen nothing else so far may
//! yet be crossed by a border, and how likely that is it cannot say by itself; but all pixels like it together can, from
//! pass to pass: this is what empirical Bayes methods do. Pixels are alike that have seen as much, over as many passes,
//! beside neighbours that have. Of each kind it is counted what its pixels saw *after* they were known to be of it, so
//! that being sure for a long time counts for no more than it is worth in this picture: little at the borders of fine
//! things, and much in the middle of a wall.

use super::past::Nearby;

/// What a pixel has seen: all of a light, nothing of it, one or the other depending on where in the pixel, or both at
/// once; and whether those around it saw the same, the one or the other, or both at once.
const STATES: usize = 4;
const AROUND: usize = 3;

/// Passes by their power of two, and as many in the last.
const AGES: usize = 6;

pub(super) const KINDS: usize = STATES * AROUND * AGES;

/// The kind of a pixel, or of one that has not been asked yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) struct Kind(u8);

impl Kind {
    /// Nothing is known.
    pub(super) const NEW: Self = Self(KINDS as u8);

    /// What a pixel has seen in so many passes.
    #[inline(always)]
    pub(super) fn new(state: usize, around: usize, passes: f32) -> Self {
        // The exponent is the logarithm.
        let age = (passes.max(1.0).to_bits() >> 23) as usize - 127;
        Self(((state * AROUND + around) * AGES + age.min(AGES - 1)) as u8)
    }
}

/// Sums over batches of n samples that saw the part v: of n v (1 - v), in units of 1/[`PARTS`], and of n - 1. Their ratio is
/// the variance of a sample. In whole numbers, so that their order does not matter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Seen(pub(super) [[u64; 2]; KINDS]);

const PARTS: f32 = 4096.0;

impl Default for Seen {
    fn default() -> Self {
        Self([[0; 2]; KINDS])
    }
}

impl Seen {
    /// Adds a batch of a pixel that was of the kind before.
    #[inline(always)]
    pub(super) fn add(&mut self, kind: Kind, v: f32, n: f32) {
        if let Some(sums) = self.0.get_mut(usize::from(kind.0)) {
            sums[0] += (n * v * (1.0 - v) * PARTS) as u64;
            sums[1] += (n - 1.0) as u64;
        }
    }

    pub(super) fn merge(&mut self, other: &Self) {
        for (sums, more) in self.0.iter_mut().flatten().zip(other.0.iter().flatten()) {
            *sums = sums.saturating_add(*more);
        }
    }

    /// What to expect of each kind. Of a kind that few have been of: what those had that were of it for half as long, or what
    /// is usual.
    pub(super) fn variances(&self) -> Variances {
        let mut of = [0.0; KINDS];
        for state in 0..STATES {
            for around in 0..AROUND {
                let mut expected = match (state, around) {
                    (0 | 1, 0) => SURE,
                    (3, _) => MIXED,
                    _ => EDGE,
                };
                for age in 0..AGES {
                    let kind = (state * AROUND + around) * AGES + age;
                    let [varied, degrees] = self.0[kind].map(|sum| sum as f32);
                    expected = (varied / PARTS + expected * ENOUGH) / (degrees + ENOUGH);
                    of[kind] = expected;
                }
            }
        }
        Variances(of)
    }
}

/// Samples of a kind that tell as much as what is thought before.
const ENOUGH: f32 = 4096.0;

/// What is usual where all around agree, at an edge, and where borders are. A variance is 1/4 at most.
const SURE: f32 = 0.0025;
const EDGE: f32 = 0.0625;
const MIXED: f32 = 0.125;

/// Samples of a pixel that tell as much as its kind.
const OWN: f32 = 512.0;

/// What to expect of a sample of each kind.
#[derive(Clone, Copy, Debug)]
pub(super) struct Variances([f32; KINDS]);

impl Variances {
    /// That of pixels like this one.
    #[inline(always)]
    pub(super) fn of(&self, near: &Nearby) -> f32 {
        let (kind, [varied, degrees]) = (near.kind(), near.varied());
        let like = self.0.get(usize::from(kind.0)).copied().unwrap_or(0.25);
        // That nothing was seen is in the kind.
        if varied > 0.0 { (varied + OWN * like) / (degrees + OWN) } else { like }
    }
}

impl Default for Variances {
    fn default() -> Self {
        Seen::default().variances()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_differ_and_are_all_counted() {
        let mut seen = Seen::default();
        let kinds: Vec<Kind> = (0..STATES)
            .flat_map(|state| (0..AROUND).map(move |around| (state, around)))
            .flat_map(|(state, around)| {
                [0.5, 1.0, 2.0, 3.0, 4.0, 8.0, 16.0, 31.0, 32.0, 1e6].map(|n| Kind::new(state, around, n))
            })
            .collect();
        kinds.iter().for_each(|&kind| seen.add(kind, 0.5, 2.0));
        // Half a pass counts as one, three as two, 31 as 16, and a million as 32.
        let ages = [2, 2, 1, 1, 2, 2];
        for (kind, sums) in seen.0.iter().enumerate() {
            let times = ages[kind % AGES];
            assert_eq!(*sums, [times * (PARTS / 2.0) as u64, times], "{kind}");
        }
        let before = seen;
        seen.add(Kind::NEW, 0.5, 8.0);
        assert_eq!(seen, before, "of those that nobody asked before there is no kind");
    }

    #[test]
    fn variances_are_what_was_seen_or_what_those_before_saw() {
        let usual = Variances::default().0;
        assert_eq!([usual[0], usual[AGES], usual[3 * AROUND * AGES]], [SURE, EDGE, MIXED]);
        assert!(usual.iter().all(|&variance| variance > 0.0 && variance <= 0.25));
        let mut seen = Seen::default();
        // In each batch one of four differs: the variance of a sample is 1/4, by four thirds of v (1 - v).
        (0..100_000).for_each(|_| seen.add(Kind::new(0, 0, 2.0), 0.75, 4.0));
        (0..100_000).for_each(|_| seen.add(Kind::new(0, 0, 4.0), 1.0, 4.0));
        let found = seen.variances().0;
        assert!((found[1] - 0.25).abs() < 0.004, "{}", found[1]);
        assert_eq!(found[0], SURE, "shorter than that is another kind");
        assert!(found[2] < 0.004 && found[3..AGES] == [found[2]; AGES - 3], "{:?}", &found[..AGES]);
        assert_eq!(found[AGES..], usual[AGES..]);
        let mut both = seen;
        both.merge(&seen);
        let twice = both.variances().0;
        assert!(twice[2] < found[2] && (twice[1] - 0.25).abs() < (found[1] - 0.25).abs());
    }
}
