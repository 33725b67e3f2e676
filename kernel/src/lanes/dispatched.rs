//! Vectors chosen at run time, by `fearless_simd`.

use super::{Lanes, Mask, Simd};
#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
use fearless_simd::Avx512;
use fearless_simd::{Select, SimdBase, SimdFloat, SimdMask, f32x8, f32x16, mask32x8, mask32x16};

pub use fearless_simd::Level;

/// Eight lanes at the level `S`.
#[derive(Clone, Copy, Debug)]
pub struct Dispatched<S>(S);

/// Sixteen lanes a packet, where a register holds them.
#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
#[derive(Clone, Copy, Debug)]
pub struct Dispatched16(Avx512);

impl<S: fearless_simd::Simd> Simd for Dispatched<S> {
    type Token = S;
    type Node = f32x8<S>;
    type Packet = f32x8<S>;

    #[inline(always)]
    fn token(self) -> S {
        self.0
    }

    #[inline(always)]
    fn apart<R>(self, work: impl FnOnce() -> R) -> R {
        apart(self.0, work)
    }
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
impl Simd for Dispatched16 {
    type Token = Avx512;
    type Node = f32x8<Avx512>;
    type Packet = f32x16<Avx512>;

    #[inline(always)]
    fn token(self) -> Avx512 {
        self.0
    }

    #[inline(always)]
    fn apart<R>(self, work: impl FnOnce() -> R) -> R {
        apart(self.0, work)
    }
}

/// Never inlined: where there is one caller, its function would grow beyond what a compiler does well, and soon.
#[inline(never)]
fn apart<S: fearless_simd::Simd, R>(token: S, work: impl FnOnce() -> R) -> R {
    token.vectorize(work)
}

/// Work that is compiled once for each level. `run` and all it calls must be `#[inline(always)]`, or they are
/// compiled for the lowest level.
///
/// A tile of work is a struct of what it needs, and `run` asks a tree that is told the level's vectors:
///
/// ```
/// use occlude_kernel::lanes::{Task, detect, dispatch};
/// use occlude_kernel::{Bvh, Child, Node, Simd, Targets, TilePoint, TileScratch, TriangleBlock, Uncounted};
///
/// struct Shadows<'t> {
///     bvh: Bvh<'t>,
///     points: &'t [TilePoint],
///     light: Targets<'t>,
///     scratch: &'t mut TileScratch,
///     blocked: &'t mut [u64],
/// }
///
/// impl Task for Shadows<'_> {
///     type Output = u32;
///
///     #[inline(always)]
///     fn run<S: Simd>(self, simd: S) -> u32 {
///         let bvh = self.bvh.on(simd);
///         bvh.occluded_tile(self.points, &self.light, None, &mut Uncounted, self.scratch, self.blocked);
///         count(self.blocked)
///     }
/// }
///
/// // Whatever a task calls, too.
/// #[inline(always)]
/// fn count(blocked: &[u64]) -> u32 {
///     let mut sum = 0;
///     for word in blocked {
///         sum += word.count_ones();
///     }
///     sum
/// }
///
/// let mut block = TriangleBlock::EMPTY;
/// block.set(0, [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]], 0);
/// let mut root = Node::EMPTY;
/// root.set(0, [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0], Child::leaf(0));
/// let (nodes, blocks) = ([root], [block]);
/// let bvh = Bvh::new(&nodes, &blocks)?;
///
/// let points = [0u32, 1].map(|k| TilePoint { x: [0.1 * k as f32, 0.0, 0.0], first: 2 * k, count: 2 });
/// let light = Targets::new(&[0.0, 9.0, 0.0, 9.0], &[0.0; 4], &[2.0; 4]).expect("of one length");
/// let (mut scratch, mut blocked) = (TileScratch::new(), [0]);
/// let level = detect(); // once, at the start
/// let (scratch, blocked) = (&mut scratch, &mut blocked[..]);
/// assert_eq!(dispatch(level, Shadows { bvh, points: &points, light, scratch, blocked }), 2);
/// # Ok::<(), occlude_kernel::BvhError>(())
/// ```
pub trait Task {
    /// What it gives.
    type Output;
    /// Does it.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Runs a task with the vectors of a level. Costs a branch: enter once for a tile of work, not once a ray.
#[inline]
pub fn dispatch<T: Task>(level: Level, task: T) -> T::Output {
    // Not the macro of `fearless_simd`: it would compile the task for AVX-512 a second time, in eight lanes.
    #[cfg(target_arch = "x86_64")]
    {
        #[cfg(not(occlude_one_level = "avx2"))]
        if let Some(token) = level.as_avx512() {
            return vectorize(token, task, Dispatched16(token));
        }
        #[cfg(any(not(occlude_one_level), occlude_one_level = "avx2"))]
        if let Some(token) = level.as_avx2() {
            return vectorize(token, task, Dispatched(token));
        }
        #[cfg(not(occlude_one_level))]
        {
            if let Some(token) = level.as_sse4_2() {
                return vectorize(token, task, Dispatched(token));
            }
            if let Some(token) = level.as_sse2() {
                return vectorize(token, task, Dispatched(token));
            }
        }
    }
    #[cfg(target_arch = "x86")]
    if let Some(token) = level.as_avx512() {
        return vectorize(token, task, Dispatched16(token));
    }
    dispatch_rest(level, task)
}

/// Levels of other machines. Nobody comes here but with levels left out of the build: SSE2 is part of x86-64, unless it is
/// switched off. One number at a time would be one more copy of every task to compile.
#[cfg(all(target_arch = "x86_64", any(target_feature = "sse2", occlude_one_level)))]
fn dispatch_rest<T: Task>(_: Level, _: T) -> T::Output {
    unreachable!("a level that this was not compiled for")
}

#[cfg(all(target_arch = "x86_64", not(target_feature = "sse2"), not(occlude_one_level)))]
fn dispatch_rest<T: Task>(_: Level, task: T) -> T::Output {
    task.run(super::Scalar)
}

#[cfg(not(target_arch = "x86_64"))]
#[inline]
fn dispatch_rest<T: Task>(level: Level, task: T) -> T::Output {
    fearless_simd::dispatch!(level, token => task.run(Dispatched(token)))
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
#[inline]
fn vectorize<F: fearless_simd::Simd, T: Task>(token: F, task: T, simd: impl Simd) -> T::Output {
    fearless_simd::Simd::vectorize(
        token,
        #[inline(always)]
        || task.run(simd),
    )
}

/// The best level of this CPU (with the feature `std`), or of the target this was compiled for.
pub fn detect() -> Level {
    #[cfg(feature = "std")]
    return Level::new();
    #[cfg(not(feature = "std"))]
    Level::baseline()
}

/// What a level is called.
pub fn level_name(level: Level) -> &'static str {
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    {
        if level.as_avx512().is_some() {
            return "avx512";
        }
        if level.as_avx2().is_some() {
            return "avx2";
        }
        if level.as_sse4_2().is_some() {
            return "sse4.2";
        }
        if level.as_sse2().is_some() {
            return "sse2";
        }
    }
    #[cfg(target_arch = "aarch64")]
    if level.as_neon().is_some() {
        return "neon";
    }
    if level.is_fallback() { "fallback" } else { "simd128" }
}

/// The levels this CPU can run, best first.
pub fn levels() -> impl Iterator<Item = Level> {
    let best = detect();
    #[cfg(all(any(target_arch = "x86", target_arch = "x86_64"), not(occlude_one_level)))]
    let lower = [
        best.as_avx2().map(Level::Avx2),
        best.as_sse4_2().map(Level::Sse4_2),
        best.as_sse2().map(Level::Sse2),
    ];
    #[cfg(any(occlude_one_level, not(any(target_arch = "x86", target_arch = "x86_64"))))]
    let lower: [Option<Level>; 0] = [];
    let name = level_name(best);
    core::iter::once(best).chain(lower.into_iter().flatten().filter(move |&level| level_name(level) != name))
}

/// The level of a name, if this CPU can run it.
pub fn level_named(name: &str) -> Option<Level> {
    levels().find(|&level| level_name(level) == name)
}

/// Implements [`Lanes`] and [`Mask`] for a vector of `fearless_simd`.
macro_rules! dispatched_lanes {
    ($vector:ident, $mask:ident, $width:literal) => {
        impl<S: fearless_simd::Simd> Mask for $mask<S> {
            #[inline(always)]
            fn bits(self) -> u32 {
                self.to_bitmask() as u32
            }

            #[inline(always)]
            fn any(self) -> bool {
                self.any_true()
            }
        }

        impl<S: fearless_simd::Simd> Lanes for $vector<S> {
            const WIDTH: usize = $width;
            type Mask = $mask<S>;
            type Token = S;

            #[inline(always)]
            fn splat(token: S, value: f32) -> Self {
                SimdBase::splat(token, value)
            }

            #[inline(always)]
            fn load(token: S, from: &[f32]) -> Self {
                SimdBase::from_slice(token, &from[..$width])
            }

            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                self.store_slice(&mut to[..$width]);
            }

            #[inline(always)]
            fn mul_add(self, factor: Self, addend: Self) -> Self {
                SimdFloat::mul_add(self, factor, addend)
            }

            #[inline(always)]
            fn min(self, other: Self) -> Self {
                SimdBase::min(self, other)
            }

            #[inline(always)]
            fn max(self, other: Self) -> Self {
                SimdBase::max(self, other)
            }

            #[inline(always)]
            fn abs(self) -> Self {
                SimdBase::abs(self)
            }

            #[inline(always)]
            fn lt(self, other: Self) -> $mask<S> {
                self.simd_lt(other)
            }

            #[inline(always)]
            fn le(self, other: Self) -> $mask<S> {
                self.simd_le(other)
            }

            #[inline(always)]
            fn select(mask: $mask<S>, if_true: Self, if_false: Self) -> Self {
                Select::select(mask, if_true, if_false)
            }
        }
    };
}

dispatched_lanes!(f32x8, mask32x8, 8);
dispatched_lanes!(f32x16, mask32x16, 16);
