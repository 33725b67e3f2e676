//! Random numbers from a seed, a pixel and a pass, and point sets for the lights.

use rand_xoshiro::Xoshiro128PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::sync::LazyLock;

/// How the samples of a light are spread over it. All are unbiased: every single point is uniform.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Pattern {
    /// A rank-1 lattice moved as a whole by a random shift.
    #[default]
    Lattice,
    /// The Sobol' (0, 2)-sequence under nested uniform (Owen) scrambling.
    Sobol,
    /// One point at random in each cell of a grid.
    Jittered,
    /// A grid moved as a whole by a random shift (uniform jitter).
    UniformJitter,
    /// Independent points: the yardstick.
    Random,
}

/// A generator for one pixel and one pass; the same wherever and whenever that pixel is rendered.
#[derive(Clone, Debug)]
pub struct Sampler(Xoshiro128PlusPlus);

impl Sampler {
    /// Seeded from the render's seed, the pixel's number (row by row) and the pass.
    #[inline]
    pub fn new(seed: u64, pixel: u64, pass: u32) -> Self {
        let mixed = mix(mix(seed ^ 0x9e37_79b9_7f4a_7c15).wrapping_add(pixel)).wrapping_add(u64::from(pass));
        Self(Xoshiro128PlusPlus::seed_from_u64(mix(mixed)))
    }

    /// The seed of a round of samples: that of the render for the first one, and others, unlike it, for the rest.
    #[inline]
    pub fn seed_of_round(seed: u64, round: u32) -> u64 {
        if round == 0 { seed } else { mix(seed ^ mix(0x3c6e_f372_fe94_f82b ^ u64::from(round))) }
    }

    /// A generator of its own for each key.
    #[inline]
    pub fn from_key(key: u64) -> Self {
        Self(Xoshiro128PlusPlus::seed_from_u64(mix(key ^ 0xbb67_ae85_84ca_a73b)))
    }

    /// The key of another generator. Takes no number from this one.
    #[inline]
    pub fn key(&self) -> u64 {
        let mut copy = self.0.clone();
        u64::from(copy.next_u32()) << 32 | u64::from(copy.next_u32())
    }

    /// Where in its pixel a camera sample lies: passes together form a scrambled (0, 2)-sequence over the square.
    ///
    /// Each alone is uniform. Their spread makes the mean of a pixel at an edge converge faster than the variance
    /// between passes, from which its error is estimated, would let one expect.
    #[inline]
    pub fn in_pixel(seed: u64, pixel: u64, pass: u32) -> [f32; 2] {
        let scramble = mix(mix(seed ^ 0x6a09_e667_f3bc_c909).wrapping_add(pixel));
        let [x, y] = sobol(pass);
        [unit(owen(x, scramble as u32)), unit(owen(y, (scramble >> 32) as u32))]
    }

    /// Uniform in [0, 1), a multiple of 2⁻²⁴.
    #[inline]
    pub fn uniform(&mut self) -> f32 {
        (self.0.next_u32() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// A random word.
    #[inline]
    pub fn word(&mut self) -> u32 {
        self.0.next_u32()
    }

    /// `count` points of the unit square, appended. Coordinates are below 1.
    pub fn points(&mut self, pattern: Pattern, count: usize, points: &mut Vec<[f32; 2]>) {
        match pattern {
            Pattern::Random => points.extend((0..count).map(|_| [self.uniform(), self.uniform()])),
            Pattern::Lattice => {
                let known = GENERATORS.get(count).copied();
                let generator = u64::from(known.unwrap_or_else(|| lattice_generator(count as u32)));
                let shift = [self.word(), self.word()];
                // i/n and i g/n as fractions of 2^64, without a division for each; what is whole drops out.
                let step = u64::MAX / count.max(1) as u64;
                let steps = [step, step.wrapping_mul(generator)];
                let first = points.len();
                points.resize(first + count, [0.0; 2]);
                let mut at = [0u64; 2];
                for point in &mut points[first..] {
                    for k in 0..2 {
                        point[k] = unit(shift[k].wrapping_add((at[k] >> 32) as u32));
                        at[k] = at[k].wrapping_add(steps[k]);
                    }
                }
            }
            Pattern::Sobol => {
                let scramble = [self.word(), self.word()];
                points.extend((0..count as u32).map(|i| {
                    let [x, y] = sobol(i);
                    [unit(owen(x, scramble[0])), unit(owen(y, scramble[1]))]
                }));
            }
            Pattern::Jittered | Pattern::UniformJitter => {
                let (columns, rows) = grid(count);
                let cells = columns * rows;
                let mut jitter = [self.uniform(), self.uniform()];
                let first = points.len();
                for cell in 0..cells {
                    if pattern == Pattern::Jittered && cell > 0 {
                        jitter = [self.uniform(), self.uniform()];
                    }
                    let x = ((cell % columns) as f32 + jitter[0]) / columns as f32;
                    let y = ((cell / columns) as f32 + jitter[1]) / rows as f32;
                    points.push([x.min(BELOW_ONE), y.min(BELOW_ONE)]);
                }
                // What no grid holds is spread at random.
                for _ in cells..count {
                    let point = [self.uniform(), self.uniform()];
                    points.push(point);
                }
                debug_assert_eq!(points.len() - first, count);
            }
        }
    }
}

const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

/// [`lattice_generator`] of small numbers: looking for it takes as long as a dozen points.
static GENERATORS: LazyLock<Vec<u32>> = LazyLock::new(|| (0..=1024).map(lattice_generator).collect());

#[inline]
fn unit(word: u32) -> f32 {
    (word >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Columns and rows of a grid of at most `count` cells, as square as can be: exactly `count` cells where a grid
/// no longer than twice its width has them.
fn grid(count: usize) -> (usize, usize) {
    let root = (1..=count).take_while(|edge| edge * edge <= count).last().unwrap_or(0);
    let exact = (1..=root).rev().find(|&rows| count.is_multiple_of(rows) && count / rows <= 2 * rows);
    let rows = exact.unwrap_or(root).max(1);
    (count / rows, rows)
}

/// The generator `g` of a good lattice (i/n, i g/n): near n divided by the golden ratio and without a common
/// factor, which for Fibonacci numbers n gives the Fibonacci lattice.
fn lattice_generator(count: u32) -> u32 {
    let ideal = (f64::from(count) * 0.618_033_988_749_894_9).round() as u32;
    let coprime = |g: u32| gcd(g, count) == 1;
    (0..=count)
        .flat_map(|off| [ideal.saturating_sub(off), ideal + off])
        .find(|&g| g > 0 && g < count.max(2) && coprime(g))
        .unwrap_or(1)
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// The first two dimensions of Sobol's sequence, as 32-bit fractions.
#[inline]
fn sobol(index: u32) -> [u32; 2] {
    let mut y = 0u32;
    let mut direction = 1u32 << 31;
    let mut rest = index;
    while rest != 0 {
        if rest & 1 != 0 {
            y ^= direction;
        }
        rest >>= 1;
        direction ^= direction >> 1;
    }
    [index.reverse_bits(), y]
}

/// A nested uniform scramble by a hash in which each bit is flipped by those above it: Laine and Karras,
/// "Stratified Sampling for Stochastic Transparency" (EGSR 2011), with the constants of Vegdahl (2021).
#[inline]
fn owen(fraction: u32, seed: u32) -> u32 {
    let mut x = fraction.reverse_bits();
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^= x.wrapping_mul(0x53a2_2864);
    x.reverse_bits()
}

/// The finaliser of SplitMix64: every bit of the input moves about half the bits of the output.
#[inline]
fn mix(mut word: u64) -> u64 {
    word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ (word >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATTERNS: [Pattern; 5] =
        [Pattern::Lattice, Pattern::Sobol, Pattern::Jittered, Pattern::UniformJitter, Pattern::Random];

    #[test]
    fn every_pattern_gives_what_was_asked_inside_the_square() {
        for pattern in PATTERNS {
            for count in 0..130 {
                let mut points = Vec::new();
                Sampler::new(1, 2, count as u32).points(pattern, count, &mut points);
                assert_eq!(points.len(), count, "{pattern:?}");
                assert!(points.iter().flatten().all(|&x| (0.0..1.0).contains(&x)), "{pattern:?} {count}");
            }
        }
    }

    /// Each point alone is uniform: the means of x, y, x², xy over many seeds, within five standard errors.
    #[test]
    fn every_point_is_uniform() {
        let seeds = 20_000u64;
        for pattern in PATTERNS {
            for count in [1usize, 3, 7, 16] {
                for place in [0, count / 2, count - 1] {
                    let mut sums = [0.0f64; 4];
                    for seed in 0..seeds {
                        let mut points = Vec::new();
                        Sampler::new(seed, 7, 3).points(pattern, count, &mut points);
                        let [x, y] = points[place].map(f64::from);
                        // A single stratum is not uniform over the square; a random one of them is.
                        let (x, y) = if pattern == Pattern::Jittered || pattern == Pattern::UniformJitter {
                            let [a, b] = points[seed as usize % count].map(f64::from);
                            (a, b)
                        } else {
                            (x, y)
                        };
                        for (sum, value) in sums.iter_mut().zip([x, y, x * x, x * y]) {
                            *sum += value;
                        }
                    }
                    let expected = [0.5, 0.5, 1.0 / 3.0, 0.25];
                    let deviation = [0.2887, 0.2887, 0.2982, 0.2205];
                    for ((sum, expected), deviation) in sums.iter().zip(expected).zip(deviation) {
                        let z = (sum / seeds as f64 - expected) / (deviation / (seeds as f64).sqrt());
                        assert!(z.abs() < 5.0, "{pattern:?} {count} {place}: z = {z}");
                    }
                }
            }
        }
    }

    #[test]
    fn sobol_points_are_a_net_under_scrambling() {
        let mut points = Vec::new();
        Sampler::new(3, 4, 5).points(Pattern::Sobol, 16, &mut points);
        for (columns, rows) in [(16, 1), (8, 2), (4, 4), (2, 8), (1, 16)] {
            let mut seen = [0; 16];
            for [x, y] in &points {
                seen[(x * columns as f32) as usize + columns * (y * rows as f32) as usize] += 1;
            }
            assert!(seen.iter().all(|&n| n == 1), "{columns} x {rows}: {seen:?}");
        }
    }

    #[test]
    fn the_lattice_of_a_fibonacci_number_is_the_fibonacci_lattice() {
        assert_eq!([13, 21, 34, 55].map(lattice_generator), [8, 13, 21, 34]);
        assert_eq!((grid(16), grid(12), grid(7), grid(8)), ((4, 4), (4, 3), (3, 2), (4, 2)));
    }

    #[test]
    fn a_lattice_has_a_point_in_every_column_and_row() {
        for count in [1usize, 2, 3, 7, 16, 64, 100, 1000, 65_536] {
            let mut points = vec![[2.0, 2.0]];
            let mut sampler = Sampler::new(5, 6, count as u32);
            sampler.points(Pattern::Lattice, count, &mut points);
            assert_eq!(points.remove(0), [2.0, 2.0], "appended");
            let (first, generator) = (points[0], lattice_generator(count as u32) as usize);
            for (i, point) in points.iter().enumerate() {
                for (k, place) in [i, i * generator % count].into_iter().enumerate() {
                    let off = f64::from(point[k]) - f64::from(first[k]) - place as f64 / count as f64;
                    let off = off - off.round();
                    assert!(off.abs() < 1e-6, "{count} {i}: {point:?} is off by {off}");
                }
            }
        }
    }

    #[test]
    fn pixels_and_passes_differ_and_repeat() {
        let first = |pixel, pass| Sampler::new(9, pixel, pass).word();
        assert_eq!(first(5, 6), first(5, 6));
        assert_ne!(first(5, 6), first(6, 5));
        assert_ne!(first(5, 6), first(5, 7));
    }
}
