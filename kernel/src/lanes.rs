//! How wide a packet is: the one place that knows about SIMD.
//!
//! Every algorithm of this crate is written once, over [`Simd`]. Three families implement it:
//!
//! | family | lanes | chosen |
//! |---|---|---|
//! | [`Scalar`] | one `f32` | by the caller; the reference for the others |
//! | [`Native`] | the vectors of `wide` | when the crate is compiled, by `-C target-cpu` |
//! | `Dispatched` (feature `dispatch`) | the vectors of `fearless_simd` | at run time, by the CPU: see the example of `Task` |
//!
//! Whatever decides an answer is computed with single operations, each rounded as IEEE 754 says, in the same
//! order at every width. So all families give the same answers, bit for bit. Only bounds, which are
//! conservative, use [`Lanes::mul_add`], whose rounding differs between families.

use core::fmt::Debug;
use core::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Sub};

#[cfg(feature = "dispatch")]
mod dispatched;
#[cfg(all(feature = "dispatch", any(target_arch = "x86", target_arch = "x86_64")))]
pub use dispatched::Dispatched16;
#[cfg(feature = "dispatch")]
pub use dispatched::{Dispatched, Level, Task, detect, dispatch, level_name, level_named, levels};

/// From here to twice as much, the last bit of a number is worth one: what is added to it is rounded to whole numbers, without
/// a conversion.
pub(crate) const UNIT: f32 = 8_388_608.0;

/// One bool for each lane.
pub trait Mask: Copy + Debug + BitAnd<Output = Self> + BitOr<Output = Self> + BitXor<Output = Self> {
    /// The lanes as bits, lane 0 in the lowest.
    fn bits(self) -> u32;
    /// Is any lane set?
    fn any(self) -> bool;
}

/// Floats that move together.
pub trait Lanes:
    Copy
    + Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// How many.
    const WIDTH: usize;
    /// What a comparison gives.
    type Mask: Mask;
    /// What shows that the CPU has the instructions; nothing at run time.
    type Token: Copy;

    /// The same number in every lane.
    fn splat(token: Self::Token, value: f32) -> Self;
    /// The first `WIDTH` numbers of a slice. Panics if it is shorter.
    fn load(token: Self::Token, from: &[f32]) -> Self;
    /// Writes the lanes to the first `WIDTH` places of a slice. Panics if it is shorter.
    fn store(self, to: &mut [f32]);
    /// `self * factor + addend`, rounded once or twice: for bounds only.
    fn mul_add(self, factor: Self, addend: Self) -> Self;
    /// The lesser one; if either is NaN, either.
    fn min(self, other: Self) -> Self;
    /// The greater one; if either is NaN, either.
    fn max(self, other: Self) -> Self;
    /// Without its sign.
    fn abs(self) -> Self;
    /// `self < other`; false where either is NaN.
    fn lt(self, other: Self) -> Self::Mask;
    /// `self <= other`; false where either is NaN.
    fn le(self, other: Self) -> Self::Mask;
    /// `if_true` where the mask is set, else `if_false`.
    fn select(mask: Self::Mask, if_true: Self, if_false: Self) -> Self;
}

/// A family of vectors: one for the eight children of a node, one for a packet of rays or samples.
pub trait Simd: Copy + Debug + Send + Sync + 'static {
    /// The token of both.
    type Token: Copy;
    /// Lanes for a node's children and a block's triangles. `WIDTH` divides 8.
    type Node: Lanes<Token = Self::Token>;
    /// Lanes for rays and samples, as many as the registers hold. `WIDTH` divides 16.
    type Packet: Lanes<Token = Self::Token>;
    /// The token.
    fn token(self) -> Self::Token;
    /// Does work in a function of its own that is compiled for this family's instructions: for what is large and
    /// stands in several places, so that each does not get a copy. `work` and all it calls must be `#[inline(always)]`.
    fn apart<R>(self, work: impl FnOnce() -> R) -> R;
}

/// One lane: the reference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Scalar;

impl Simd for Scalar {
    type Token = ();
    type Node = f32;
    type Packet = f32;

    #[inline(always)]
    fn token(self) {}

    #[inline]
    fn apart<R>(self, work: impl FnOnce() -> R) -> R {
        work()
    }
}

impl Mask for bool {
    #[inline(always)]
    fn bits(self) -> u32 {
        u32::from(self)
    }

    #[inline(always)]
    fn any(self) -> bool {
        self
    }
}

impl Lanes for f32 {
    const WIDTH: usize = 1;
    type Mask = bool;
    type Token = ();

    #[inline(always)]
    fn splat((): (), value: f32) -> Self {
        value
    }

    #[inline(always)]
    fn load((): (), from: &[f32]) -> Self {
        from[0]
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        to[0] = self;
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        self * factor + addend
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        if self < other { self } else { other }
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        if self > other { self } else { other }
    }

    #[inline(always)]
    fn abs(self) -> Self {
        f32::abs(self)
    }

    #[inline(always)]
    fn lt(self, other: Self) -> bool {
        self < other
    }

    #[inline(always)]
    fn le(self, other: Self) -> bool {
        self <= other
    }

    #[inline(always)]
    fn select(mask: bool, if_true: Self, if_false: Self) -> Self {
        if mask { if_true } else { if_false }
    }
}

/// The width this build was compiled for.
///
/// Packets are sixteen lanes where a register holds them (AVX-512) and eight elsewhere: sixteen lanes in pairs
/// of AVX2 registers spill.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Native;

impl Simd for Native {
    type Token = ();
    type Node = wide::f32x8;
    #[cfg(target_feature = "avx512f")]
    type Packet = wide::f32x16;
    #[cfg(not(target_feature = "avx512f"))]
    type Packet = wide::f32x8;

    #[inline(always)]
    fn token(self) {}

    #[inline]
    fn apart<R>(self, work: impl FnOnce() -> R) -> R {
        work()
    }
}

/// Implements [`Lanes`] for a vector of `wide`, whose masks are vectors too.
macro_rules! wide_lanes {
    ($vector:ident, $mask:ident, $width:literal) => {
        /// A mask of `wide`, which is a vector of all-ones and all-zeros lanes.
        #[derive(Clone, Copy, Debug)]
        pub struct $mask(wide::$vector);

        impl BitAnd for $mask {
            type Output = Self;
            #[inline(always)]
            fn bitand(self, other: Self) -> Self {
                Self(self.0 & other.0)
            }
        }

        impl BitOr for $mask {
            type Output = Self;
            #[inline(always)]
            fn bitor(self, other: Self) -> Self {
                Self(self.0 | other.0)
            }
        }

        impl BitXor for $mask {
            type Output = Self;
            #[inline(always)]
            fn bitxor(self, other: Self) -> Self {
                Self(self.0 ^ other.0)
            }
        }

        impl Mask for $mask {
            #[inline(always)]
            fn bits(self) -> u32 {
                self.0.to_bitmask()
            }

            #[inline(always)]
            fn any(self) -> bool {
                self.0.any()
            }
        }

        impl Lanes for wide::$vector {
            const WIDTH: usize = $width;
            type Mask = $mask;
            type Token = ();

            #[inline(always)]
            fn splat((): (), value: f32) -> Self {
                Self::splat(value)
            }

            #[inline(always)]
            fn load((): (), from: &[f32]) -> Self {
                let lanes: [f32; $width] = bytemuck::cast_slice(&from[..$width])[0];
                Self::new(lanes)
            }

            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                to[..$width].copy_from_slice(self.as_array());
            }

            #[inline(always)]
            fn mul_add(self, factor: Self, addend: Self) -> Self {
                wide::$vector::mul_add(self, factor, addend)
            }

            #[inline(always)]
            fn min(self, other: Self) -> Self {
                self.fast_min(other)
            }

            #[inline(always)]
            fn max(self, other: Self) -> Self {
                self.fast_max(other)
            }

            #[inline(always)]
            fn abs(self) -> Self {
                wide::$vector::abs(self)
            }

            #[inline(always)]
            fn lt(self, other: Self) -> $mask {
                $mask(self.simd_lt(other))
            }

            #[inline(always)]
            fn le(self, other: Self) -> $mask {
                $mask(self.simd_le(other))
            }

            #[inline(always)]
            fn select(mask: $mask, if_true: Self, if_false: Self) -> Self {
                mask.0.select(if_true, if_false)
            }
        }
    };
}

wide_lanes!(f32x4, WideMask4, 4);
wide_lanes!(f32x8, WideMask8, 8);
wide_lanes!(f32x16, WideMask16, 16);
