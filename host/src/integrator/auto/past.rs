//! What a pixel has seen of a light, to take out what its samples have too much or too little of the light itself.
//!
//! The samples of a pass say that `a = mean of V w` arrives. With nothing in the way they would say `m = mean of w`, while
//! what would arrive is known in closed form. So `c = whole - m` is how far off they are, 0 on average, and
//! `a + u c` is right on average for any u that does not depend on them. The best u is about the visible part v, as the
//! *other* passes saw it: for n passes, pass p is given
//!
//! ```text
//!     u_p = (sum of v over the other passes) / (n - 1)
//! ```
//!
//! and as passes come one by one, each adds what the sum `T_n` of all `u_p c_p` has changed by. Where a pixel sees the
//! whole light, the sum is what would arrive, without any noise; where it sees nothing of it, u is 0, and it stays black.
//!
//! Before the first pass a pixel may have been told what to expect, by rays that no pass has part in: that counts as a part of
//! a pass that v is taken from, and no c.
//!
//! On average `T_n` is 0, since c_p and v_q are of different passes and so of different random numbers. But what a pass adds takes
//! back from earlier ones, and is 0 on average only as long as the number of passes does not depend on these. Where it does,
//! in adaptive renders, `u_p` is the [mean](Past::mean) over the *earlier* passes, the same for all samples of a pass, and each
//! `u_p c_p` is 0 on average whatever these were.

use super::kinds::{Kind, Variances};

/// Sums over the passes of a pixel and a light.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Past {
    /// Passes in which the light was asked, and the sum of the parts that were visible; with what was foreseen.
    asked: f32,
    seen: f32,
    /// Sum of c, and of v c.
    off: f32,
    both: f32,
    /// Sum of c over passes that had no sample of the light.
    unasked: f32,
    /// The sum of `u c` so far.
    sum: f32,
    /// The bins of the light in which something was free, and in which something was blocked: a bit each.
    seen_in: [u64; 2],
    /// Sums over batches of n samples: of n v (1 - v), and of n - 1. Their ratio is the variance of a sample of a batch.
    varied: f32,
    degrees: f32,
}

impl Past {
    /// Notes how unlike the `n` samples of a batch were that saw the part `v`.
    #[inline(always)]
    pub(super) fn vary(&mut self, v: f32, n: f32) {
        self.varied += n * v * (1.0 - v);
        self.degrees += n - 1.0;
    }

    /// What a pass adds that saw the part `v`, with samples `c` short of the whole; or a sample of a pass before which the
    /// mean was `before`, if it must follow from earlier ones only.
    #[inline(always)]
    pub(super) fn asked(&mut self, v: f32, c: f32, before: Option<f32>) -> f32 {
        self.asked += 1.0;
        self.seen += v;
        if let Some(mean) = before {
            return mean * c;
        }
        self.off += c;
        self.both += v * c;
        self.change()
    }

    /// Expects the part `v`, as if that had been seen in so much of a pass. Before any pass.
    pub(super) fn foresee(&mut self, v: f32, weight: f32) {
        self.asked += weight;
        self.seen += v * weight;
        // One bin, whichever, tells that something was free or blocked, and leaves the others to passes.
        self.seen_in[0] |= u64::from(v > 0.0);
        self.seen_in[1] |= u64::from(v < 1.0);
    }

    /// What a pass adds that had no sample of the light, where all of it would send `c`; or a sample of the pass at hand, if
    /// it must follow from earlier ones only.
    #[inline(always)]
    pub(super) fn unasked(&mut self, c: f32, only_earlier: bool) -> f32 {
        if only_earlier {
            return self.mean() * c;
        }
        self.unasked += c;
        self.change()
    }

    /// Notes in which bins samples were free and blocked.
    #[inline(always)]
    pub(super) fn mark(&mut self, v: f32, bins: &[u8], estimates: &[f32]) {
        if v >= 1.0 {
            self.seen_in[0] = u64::MAX;
        } else if v <= 0.0 {
            self.seen_in[1] = u64::MAX;
        } else {
            let [mut free, mut blocked] = [0u64; 2];
            for (&bin, &estimate) in bins.iter().zip(estimates) {
                let bit = 1u64 << (bin & 63);
                free |= if estimate > 0.0 { bit } else { 0 };
                blocked |= if estimate > 0.0 { 0 } else { bit };
            }
            self.seen_in[0] |= free;
            self.seen_in[1] |= blocked;
        }
    }

    /// The mean of the parts that were visible.
    #[inline(always)]
    pub(super) fn mean(&self) -> f32 {
        if self.asked > 0.0 { (self.seen / self.asked).clamp(0.0, 1.0) } else { 0.0 }
    }

    /// Whether all of the light was seen each time, or nothing of it.
    #[inline(always)]
    pub(super) fn is_sure(&self) -> bool {
        self.asked > 0.0 && (self.seen <= 0.0 || self.seen >= self.asked * 0.99999)
    }

    #[inline(always)]
    fn change(&mut self) -> f32 {
        let before = self.sum;
        let others =
            if self.asked > 1.0 { (self.seen * self.off - self.both) / (self.asked - 1.0) } else { 0.0 };
        let none = if self.asked > 0.0 { self.seen * self.unasked / self.asked } else { 0.0 };
        self.sum = others + none;
        self.sum - before
    }
}

/// Lets pixels that expect nothing of a light expect what those around them do.
pub(super) fn spread(pasts: &mut [Past], width: usize, lights: usize) {
    let told: Vec<Past> = pasts.to_vec();
    for (at, past) in pasts.iter_mut().enumerate().filter(|(_, past)| past.asked <= 0.0) {
        let (pixel, light) = (at / lights, at % lights);
        let (x, y) = (pixel % width, pixel / width);
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        for row in y.saturating_sub(1)..y + 2 {
            for column in columns.clone() {
                let Some(near) = told.get((row * width + column) * lights + light) else { continue };
                past.asked += near.asked;
                past.seen += near.seen;
                past.seen_in[0] |= near.seen_in[0];
                past.seen_in[1] |= near.seen_in[1];
                past.varied += near.varied;
                past.degrees += near.degrees;
            }
        }
    }
}

/// The least doubt.
const LEAST_DOUBT: f32 = 0.05;

/// Rays before a pixel's bins tell anything.
const ENOUGH: f32 = 128.0;

/// With more bins in doubt, what is saved in the others is less than what it costs.
const MOST_IN_DOUBT: u32 = 22;

/// What a pixel and those around it have seen of a light.
#[derive(Clone, Copy, Debug)]
pub(super) struct Nearby {
    own: Past,
    /// As [`Past::seen_in`], of all.
    seen_in: [u64; 2],
    kind: Kind,
}

impl Nearby {
    /// Of the neighbours in the same tile, which has so many columns.
    #[inline]
    pub(super) fn new(pasts: &[Past], width: u32, pixel: u32, light: usize, lights: usize) -> Option<Self> {
        if light >= lights {
            return None;
        }
        let own = *pasts.get(pixel as usize * lights + light)?;
        let (mut seen_in, mut varied) = ([0u64; 2], false);
        let width = width as usize;
        let (x, y) = (pixel as usize % width, pixel as usize / width);
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        for row in y.saturating_sub(1)..y + 2 {
            for column in columns.clone() {
                let Some(near) = pasts.get((row * width + column) * lights + light) else { continue };
                seen_in[0] |= near.seen_in[0];
                seen_in[1] |= near.seen_in[1];
                varied |= near.varied > 0.0;
            }
        }
        let mut nearby = Self { own, seen_in, kind: Kind::NEW };
        if !nearby.is_new() {
            let state = match own.is_sure() {
                true => usize::from(own.seen <= 0.0),
                false => 2 + usize::from(own.varied > 0.0),
            };
            let around = if nearby.is_sure() { 0 } else { 1 + usize::from(varied) };
            nearby.kind = Kind::new(state, around, own.asked);
        }
        Some(nearby)
    }

    /// Whether nothing was ever seen but all of the light, or nothing of it.
    #[inline(always)]
    fn is_sure(&self) -> bool {
        self.own.asked > 0.0 && (self.seen_in[0] == 0 || self.seen_in[1] == 0)
    }

    /// Whether the pixel itself never saw anything else, whatever those around it saw.
    #[inline(always)]
    pub(super) fn own_is_sure(&self) -> bool {
        self.own.is_sure()
    }

    /// Whether the pixel has not been asked yet.
    #[inline(always)]
    pub(super) fn is_new(&self) -> bool {
        self.own.asked <= 0.0
    }

    /// The mean of the parts that the pixel saw.
    #[inline(always)]
    pub(super) fn mean(&self) -> f32 {
        self.own.mean()
    }

    /// What kind of pixel it is.
    #[inline(always)]
    pub(super) fn kind(&self) -> Kind {
        self.kind
    }

    /// Sums over batches of n samples: of n v (1 - v), and of n - 1.
    #[inline(always)]
    pub(super) fn varied(&self) -> [f32; 2] {
        [self.own.varied, self.own.degrees]
    }

    /// How much in doubt the light is, in units of the greatest: what part of the samples it is due.
    ///
    /// With errors that go down as n^-1 to n^-1.5, the best is the power 0.5 to 0.4 of the variance if all samples cost the
    /// same; in penumbrae they cost more. Of 0.3 to 0.5 the least was best in ten scenes.
    #[inline(always)]
    pub(super) fn doubt(&self, variances: &Variances) -> f32 {
        if self.is_new() {
            return 1.0;
        }
        let part = (4.0 * variances.of(self)).min(1.0);
        // The power 5/16.
        (part * part.sqrt().sqrt()).sqrt().sqrt().max(LEAST_DOUBT)
    }

    /// The bins that are in doubt, and those that are free; `None` if it has not been asked often enough to tell, or
    /// if most are in doubt.
    #[inline]
    pub(super) fn bins(&self, rays: f32) -> Option<[u64; 2]> {
        if self.own.asked * rays < ENOUGH || self.own.is_sure() {
            return None;
        }
        let doubt = !(self.own.seen_in[0] ^ self.own.seen_in[1]) | (self.seen_in[0] & self.seen_in[1]);
        (1..=MOST_IN_DOUBT).contains(&doubt.count_ones()).then_some([doubt, self.own.seen_in[0] & !doubt])
    }
}

#[cfg(test)]
mod tests {
    use super::super::kinds::Seen;
    use super::*;
    use std::collections::HashMap;

    /// Four passes, each with one of three outcomes at random: nothing asked, or samples whose c is 0 on average.
    #[test]
    fn over_all_outcomes_what_is_added_is_zero() {
        // Parts seen and c of each outcome, of passes that differ; without samples c is the whole.
        let outcomes = [
            [(None, 1.0), (Some(1.0), -0.2), (Some(0.25), -0.8)],
            [(None, 0.5), (Some(0.0), 0.1), (Some(0.75), -0.6)],
            [(None, 0.0), (Some(1.0), -0.3), (Some(1.0), 0.3)],
            [(None, 2.0), (Some(0.5), -1.5), (Some(0.125), -0.5)],
        ];
        let cases = [(1, 0.0), (2, 0.0), (3, 0.0), (4, 0.0), (1, 0.5), (2, 0.5), (3, 0.125), (4, 0.5)];
        for ((passes, foreseen), only_earlier) in
            cases.into_iter().flat_map(|case| [(case, false), (case, true)])
        {
            // Of each history, what the last pass adds.
            let mut last = HashMap::<usize, f32>::new();
            let (mut sum, mut most) = (0.0, 0.0f32);
            let cases = 3usize.pow(passes);
            for case in 0..cases {
                let mut past = Past::default();
                if foreseen > 0.0 {
                    past.foresee(0.75, foreseen);
                }
                let mut total = 0.0;
                for (pass, of) in outcomes.iter().enumerate().take(passes as usize) {
                    let (seen, c) = of[case / 3usize.pow(pass as u32) % 3];
                    let before = only_earlier.then(|| past.mean());
                    let more = match seen {
                        Some(v) => past.asked(v, c, before),
                        None => past.unasked(c, only_earlier),
                    };
                    total += more;
                    if pass + 1 == passes as usize {
                        *last.entry(case % 3usize.pow(pass as u32)).or_default() += more;
                    }
                }
                sum += total;
                most = most.max(total.abs());
            }
            assert!((sum / cases as f32).abs() < 1e-6, "{passes} passes: {sum}");
            // Of one pass with nothing foreseen there is nothing to take out.
            assert!(most > 0.1 || passes < 2 && foreseen == 0.0, "{passes} passes: {most}");
            let alone = last.values().all(|more| more.abs() < 1e-6);
            assert!(alone || !only_earlier, "{passes} passes: {last:?}");
            assert!(!alone || only_earlier || passes < 2, "{passes} passes: what is taken back can be told");
        }
    }

    #[test]
    fn what_is_seen_whole_has_no_noise_and_what_is_dark_stays_black() {
        let (mut lit, mut dark) = (Past::default(), Past::default());
        let (mut total, mut black) = (0.0, 0.0);
        for mean in [0.9, 1.2, 0.7, 1.05] {
            total += mean + lit.asked(1.0, 1.0 - mean, None);
            black += dark.asked(0.0, 1.0 - mean, None);
        }
        assert!((total - 4.0f32).abs() < 1e-5 && black == 0.0, "{total} {black}");
    }

    #[test]
    fn what_is_foreseen_goes_to_those_around_that_know_nothing() {
        let mut pasts = vec![Past::default(); 2 * 15];
        pasts[0].foresee(1.0, 0.5);
        pasts[4].foresee(0.0, 0.5);
        spread(&mut pasts, 5, 2);
        let seen = |pixel: usize| (pasts[2 * pixel].asked, pasts[2 * pixel].mean());
        assert_eq!([seen(0), seen(1), seen(2), seen(5)], [(0.5, 1.0), (1.0, 0.5), (0.5, 0.0), (0.5, 1.0)]);
        assert_eq!([seen(4), seen(10)], [(0.0, 0.0); 2], "too far away");
        assert!(pasts.iter().skip(1).step_by(2).all(|other| other.asked == 0.0), "the other light");
        let near = |pixel| Nearby::new(&pasts, 5, pixel, 0, 2).expect("one of them");
        assert!(near(0).own_is_sure() && !near(1).own_is_sure());
        assert_ne!(near(0).kind(), near(1).kind());
    }

    #[test]
    fn doubt_is_what_pixels_of_the_kind_saw() {
        let mut pasts = vec![Past::default(); 5 * 3];
        for past in &mut pasts {
            past.asked(1.0, 0.0, None);
            past.vary(1.0, 64.0);
            past.mark(1.0, &[], &[]);
        }
        let near = |pasts: &[Past], pixel| Nearby::new(pasts, 5, pixel, 0, 1).expect("one of them");
        let kind = |pasts: &[Past], pixel| near(pasts, pixel).kind();
        let sure = kind(&pasts, 0);
        assert_eq!([1, 7, 14].map(|pixel| kind(&pasts, pixel)), [sure; 3]);
        // One with another surface, which is dark, and one in a penumbra.
        pasts[0].asked(0.0, 0.0, None);
        pasts[0].vary(0.0, 64.0);
        pasts[0].mark(0.0, &[], &[]);
        pasts[4].asked(0.5, 0.0, None);
        pasts[4].vary(0.5, 64.0);
        pasts[4].mark(0.5, &[0, 63], &[0.0, 1.0]);
        assert_eq!([2, 7, 12].map(|pixel| kind(&pasts, pixel)), [sure; 3]);
        let kinds = [0, 1, 2, 3, 4].map(|pixel| kind(&pasts, pixel));
        for (k, one) in kinds.iter().enumerate() {
            assert!(kinds[..k].iter().all(|other| other != one), "{kinds:?}");
        }
        // At first what is usual, and then what they saw: nothing more of borders at these, but at all that are sure.
        let doubts = |pasts: &[Past], variances: &Variances| {
            [0, 1, 2, 4].map(|pixel| near(pasts, pixel).doubt(variances))
        };
        let usual = doubts(&pasts, &Variances::default());
        assert!(usual[2] < usual[1] && usual[1] < usual[3], "{usual:?}");
        let mut seen = Seen::default();
        (0..10_000).for_each(|_| seen.add(sure, 0.5, 64.0));
        (0..10_000).for_each(|_| seen.add(kinds[0], 1.0, 64.0));
        (0..10_000).for_each(|_| seen.add(kinds[1], 1.0, 64.0));
        let learned = doubts(&pasts, &seen.variances());
        assert!(learned[0] < 0.3 && learned[1] < 0.3 && learned[2] > 0.99, "{learned:?}");
        assert_eq!(learned[3], usual[3]);
        assert!(near(&[Past::default(); 4], 0).doubt(&Variances::default()) == 1.0, "not asked yet");
    }

    #[test]
    fn bins_are_in_doubt_where_a_pixel_or_its_neighbours_saw_both() {
        let mut pasts = vec![Past::default(); 9];
        for past in &mut pasts {
            for _ in 0..2 {
                past.asked(0.5, 0.0, None);
                past.mark(0.5, &(0..64).collect::<Vec<u8>>(), &[[1.0; 32], [0.0; 32]].concat());
            }
        }
        pasts[0].mark(0.5, &[3], &[0.0]);
        let near = |pixel| Nearby::new(&pasts, 3, pixel, 0, 1).expect("one of them");
        assert_eq!(near(4).bins(64.0), Some([1 << 3, 0xffff_ffff & !(1 << 3)]));
        assert_eq!(near(8).bins(64.0), None, "none is in doubt");
        assert_eq!(near(4).bins(8.0), None, "too few rays");
        assert!(Nearby::new(&pasts, 3, 9, 0, 1).is_none());
    }
}
