//! Random numbers and angles that come out the same on every machine.

use glam::Vec3;
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

/// One stream of random numbers; a scene rolls everything from it, in order.
pub(super) struct Dice(Xoshiro256PlusPlus);

impl Dice {
    pub(super) fn new(seed: u64) -> Self {
        Self(Xoshiro256PlusPlus::seed_from_u64(seed))
    }

    /// Uniform in `[0, 1)`, a multiple of 2^-24.
    #[inline]
    pub(super) fn unit(&mut self) -> f32 {
        (self.0.next_u64() >> 40) as f32 * (1.0 / (1 << 24) as f32)
    }

    /// Uniform in `[low, high)`, or `low` if they are equal.
    #[inline]
    pub(super) fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Uniform among `0..n`; 0 if `n` is 0.
    #[inline]
    pub(super) fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.0.next_u64()) * n as u128) >> 64) as usize
    }

    /// Uniform in the unit ball, by rejection: no sine, so no library to disagree with.
    #[inline]
    pub(super) fn ball(&mut self) -> Vec3 {
        loop {
            let p = Vec3::new(self.between(-1.0, 1.0), self.between(-1.0, 1.0), self.between(-1.0, 1.0));
            let d = p.length_squared();
            if d <= 1.0 && d > 1e-4 {
                return p;
            }
        }
    }

    /// Uniform on the unit sphere.
    #[inline]
    pub(super) fn direction(&mut self) -> Vec3 {
        self.ball().normalize()
    }
}

/// `(cos, sin)` of a number of turns, from sums and products alone, to about 1e-9.
///
/// `f32::sin` is the platform's own and may differ in its last bit; this may not.
pub(super) fn circle(turns: f32) -> (f32, f32) {
    let turns = f64::from(turns);
    // Within an eighth of a turn of a quarter, where the series are short.
    let quarter = (turns * 4.0).round();
    let x = (turns - quarter * 0.25) * std::f64::consts::TAU;
    let xx = x * x;
    let cos = 1.0 - xx / 2.0 * (1.0 - xx / 12.0 * (1.0 - xx / 30.0 * (1.0 - xx / 56.0 * (1.0 - xx / 90.0))));
    let sin = x * (1.0 - xx / 6.0 * (1.0 - xx / 20.0 * (1.0 - xx / 42.0 * (1.0 - xx / 72.0))));
    let (cos, sin) = match quarter.rem_euclid(4.0) as u8 {
        0 => (cos, sin),
        1 => (-sin, cos),
        2 => (-cos, -sin),
        _ => (sin, -cos),
    };
    (cos as f32, sin as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn circle_is_the_circle() {
        for i in -400..400 {
            let turns = i as f32 / 97.0;
            let (sin, cos) = (f64::from(turns) * std::f64::consts::TAU).sin_cos();
            let (c, s) = circle(turns);
            assert!((f64::from(c) - cos).abs() < 1e-7 && (f64::from(s) - sin).abs() < 1e-7, "{turns}");
        }
    }

    #[test]
    fn rolls_stay_in_range() {
        let mut dice = Dice::new(3);
        assert_eq!(dice.below(0), 0);
        for _ in 0..1000 {
            assert!((0.0..1.0).contains(&dice.unit()));
            assert!(dice.below(7) < 7);
            assert!((dice.direction().length() - 1.0).abs() < 1e-5);
        }
    }
}
