//! Where light arrived, where it would have, and what the photons around a point say about it.
//!
//! Photons leave a light and go straight through everything. The first surface a photon meets keeps a
//! [`LightPhoton`], every later one an [`OcclusionPhoton`] with the blockers crossed before it. Around a point
//! ([`PhotonMap::nearest`]) they tell three cases apart ([`Photons::classify`]): only light photons, *lit*; only
//! occlusion photons, *dark*; both, *penumbra*, and the blockers they name are what may be in the way.
//!
//! **The answer is a guess.** Photons miss fine geometry, and of k photons around a point of partial visibility
//! all may be of one kind: with visibility spread evenly, a point called lit or dark is wrong by `1/(e(k+1))` at
//! most, on average. What must be right asks the scene.
//!
//! The occlusion map of N. Billen's thesis on stochastic visibility (KU Leuven); the maps after Jensen, "Realistic
//! Image Synthesis Using Photon Mapping" (2001).

mod grid;
mod nearest;
mod tree;

pub use grid::{GridCell, PhotonGrid};
pub use nearest::{Nearest, Neighbour};
pub use tree::{PhotonMap, PhotonMapError, PhotonTree, Split};

use crate::lanes::{Lanes, Simd};
use crate::vec3x::{self, Vec3x};
use bytemuck::{Pod, Zeroable};
use core::fmt;
use glam::Vec3;

/// Where light arrived: the first surface on a line from a light.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct LightPhoton {
    /// The point on the surface.
    pub position: [f32; 3],
    /// The light it left.
    pub light: u32,
}

/// Where light would have arrived, and what was in the way.
///
/// Photons of one line share a list: the blockers of each are a prefix of those of the next.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct OcclusionPhoton {
    /// The point on the surface.
    pub position: [f32; 3],
    /// The light it left.
    pub light: u32,
    /// Where its blockers begin in the list that its owner keeps.
    pub first: u32,
    /// How many they are.
    pub len: u32,
}

/// A photon as a map knows it: which kind, and its place among those of its kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Pod, Zeroable)]
#[repr(transparent)]
pub struct PhotonId(u32);

impl PhotonId {
    const LIGHT: u32 = 1 << 31;

    /// Marks a place that holds no photon.
    pub const NONE: Self = Self(u32::MAX);

    /// Photons of a kind there may be.
    pub const MOST: usize = Self::LIGHT as usize - 1;

    /// A light photon, by its index.
    #[inline(always)]
    pub const fn light(index: u32) -> Self {
        Self(index | Self::LIGHT)
    }

    /// An occlusion photon, by its index.
    #[inline(always)]
    pub const fn occlusion(index: u32) -> Self {
        Self(index & !Self::LIGHT)
    }

    /// Is it a light photon?
    #[inline(always)]
    pub const fn is_light(self) -> bool {
        self.0 & Self::LIGHT != 0
    }

    /// Its place among those of its kind.
    #[inline(always)]
    pub const fn index(self) -> usize {
        (self.0 & !Self::LIGHT) as usize
    }
}

/// A photon while a map is being built.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Point {
    /// Where it is.
    pub position: [f32; 3],
    /// Which it is.
    pub id: PhotonId,
}

impl Point {
    /// No photon: it is nowhere, and nothing is near it.
    pub const NONE: Self = Self { position: [f32::NAN; 3], id: PhotonId::NONE };
}

/// Eight photons side by side: what a map's leaves hold. Places not used are nowhere.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(32))]
pub struct PhotonBlock {
    /// Coordinates: x, y and z.
    pub position: [[f32; 8]; 3],
    /// Which they are.
    pub ids: [PhotonId; 8],
}

impl PhotonBlock {
    /// Photons a block holds.
    pub const WIDTH: usize = 8;

    /// No photons.
    pub const EMPTY: Self = Self { position: [[f32::NAN; 8]; 3], ids: [PhotonId::NONE; 8] };

    /// The same memory as eight points a block, to fill before a map is built in it. A point whose place is not a
    /// number is no photon, so what is left over of [`PhotonBlock::EMPTY`] may stay as it is.
    pub fn as_points(blocks: &mut [Self]) -> &mut [Point] {
        bytemuck::cast_slice_mut(blocks)
    }

    /// Turns points, eight a block, into blocks where they stand.
    fn transpose(points: &mut [Point]) {
        for eight in points.chunks_exact_mut(Self::WIDTH) {
            let mut block = Self::EMPTY;
            for (lane, point) in eight.iter().enumerate() {
                for axis in 0..3 {
                    block.position[axis][lane] = point.position[axis];
                }
                block.ids[lane] = if point.position[0].is_nan() { PhotonId::NONE } else { point.id };
            }
            eight.copy_from_slice(bytemuck::cast_slice(core::slice::from_ref(&block)));
        }
    }
}

/// Around what to look, how far, and what counts as near.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    x: Vec3,
    normal: Vec3,
    stretch: f32,
    radius: f32,
}

impl Place {
    /// Photons in a ball, the nearest first.
    #[inline(always)]
    pub fn ball(x: impl Into<[f32; 3]>, radius: f32) -> Self {
        Self { x: Vec3::from(x.into()), normal: Vec3::ZERO, stretch: 0.0, radius }
    }

    /// Photons near a surface, and not behind or before it: a ball pressed flat along the unit normal.
    ///
    /// ```text
    ///     distance² = |p - x|² + (flatness² - 1) (n . (p - x))²
    /// ```
    ///
    /// A step along the normal counts `flatness` times as much as one along the surface, so of the photons on
    /// the far side of a wall only those nearer than `radius / flatness` count. 1 is a ball; less counts as 1.
    #[inline(always)]
    pub fn disc(x: impl Into<[f32; 3]>, normal: impl Into<[f32; 3]>, radius: f32, flatness: f32) -> Self {
        let flatness = flatness.max(1.0);
        Self {
            x: Vec3::from(x.into()),
            normal: Vec3::from(normal.into()),
            stretch: flatness * flatness - 1.0,
            radius,
        }
    }

    /// The same place, looked at no farther than the root of `square`.
    #[inline(always)]
    fn within(&self, square: f32) -> Self {
        let radius = libm::sqrtf(square);
        Self { radius: if radius < self.radius { radius } else { self.radius }, ..*self }
    }

    /// The square of the radius; negative, so that nothing is near, if that is negative or NaN.
    #[inline(always)]
    fn reach(&self) -> f32 {
        // Never infinite, so that what is at infinity is not near.
        if self.radius >= 0.0 { (self.radius * self.radius).min(f32::MAX) } else { -1.0 }
    }

    /// The squared distance of a point, by the operations the lanes do.
    #[inline(always)]
    pub fn distance_squared(&self, p: impl Into<[f32; 3]>) -> f32 {
        let d = vec3x::sub::<f32>(p.into(), self.x.to_array());
        let height = vec3x::dot::<f32>(self.normal.to_array(), d);
        vec3x::dot::<f32>(d, d) + self.stretch * height * height
    }
}

/// A [`Place`] in every lane.
struct PlaceLanes<L> {
    x: Vec3x<L>,
    normal: Vec3x<L>,
    stretch: L,
}

impl<L: Lanes> PlaceLanes<L> {
    #[inline(always)]
    fn new(token: L::Token, place: &Place) -> Self {
        Self {
            x: vec3x::splat(token, place.x.to_array()),
            normal: vec3x::splat(token, place.normal.to_array()),
            stretch: L::splat(token, place.stretch),
        }
    }

    /// Offers the photons of a block, of the lanes asked for, that are within reach.
    #[inline(always)]
    fn offer(&self, token: L::Token, block: &PhotonBlock, lanes: u32, nearest: &mut Nearest<'_>) {
        let mut squares = [0.0f32; 8];
        let mut from = 0;
        while from < PhotonBlock::WIDTH {
            let d = vec3x::sub(vec3x::load::<L, 8>(token, &block.position, from), self.x);
            let height = vec3x::dot(self.normal, d);
            let square = vec3x::dot(d, d) + self.stretch * height * height;
            let mut near =
                crate::lanes::Mask::bits(square.le(L::splat(token, nearest.reach()))) & lanes >> from;
            if near != 0 {
                square.store(&mut squares);
                while near != 0 {
                    let lane = near.trailing_zeros() as usize & 7;
                    near &= near - 1;
                    nearest.push(squares[lane], block.ids[(from + lane) & 7]);
                }
            }
            from += L::WIDTH;
        }
    }
}

/// What the photons around a point say about a light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class<'b> {
    /// No photon is near, so they say nothing.
    Unknown,
    /// All of the light arrives.
    Lit,
    /// None of it does.
    Dark,
    /// Some of it may; what may be in the way is known by these.
    Penumbra(Blockers<'b>),
}

/// The blockers that photons name, each once, in the order of their numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Blockers<'b> {
    /// Their numbers.
    pub list: &'b [u32],
    /// Names of photons' lists left out for want of room.
    pub dropped: usize,
}

/// The photons of one light, both kinds in one map, and what they name.
///
/// Photons that were not shot evenly, but more of them where shadows seem to begin and end, stand in a map of their
/// own ([`Photons::with_later`]).
#[derive(Clone, Copy, Debug)]
pub struct Photons<'a, S> {
    map: PhotonMap<'a, S>,
    later: PhotonMap<'a, S>,
    occlusion: &'a [OcclusionPhoton],
    blockers: &'a [u32],
}

/// A photon names blockers beyond the list, or a map names photons that are not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PhotonsError {
    /// The occlusion photon at fault.
    pub photon: u32,
}

impl fmt::Display for PhotonsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "occlusion photon {}: it is not there, or names blockers beyond the list", self.photon)
    }
}

impl core::error::Error for PhotonsError {}

impl<'a, S: Simd> Photons<'a, S> {
    /// A map with the photons it names and the list that they refer to. Costs one look at everything.
    pub fn new(
        map: PhotonMap<'a, S>,
        occlusion: &'a [OcclusionPhoton],
        blockers: &'a [u32],
    ) -> Result<Self, PhotonsError> {
        Self { map, later: map.without_photons(), occlusion, blockers }.checked(map)
    }

    /// The same with the photons of later rounds, of which more were shot here than there, sorted apart. They refer to
    /// the same lists. Costs one look at them.
    ///
    /// How many photons of a kind are near a point then says nothing about how much of the light it sees, so the later
    /// ones must not push even ones out of a look-up. The k nearest even photons are found first, and of the later
    /// ones those that are as near as the k-th ([`Nearest`] says how many). A point is *lit* or *dark* if the even
    /// photons say so and no later one objects: later photons turn calls into penumbrae and add names, and no point is
    /// called wrongly that the even photons alone call rightly. Where no even photon is near, nothing is known.
    pub fn with_later(self, later: PhotonMap<'a, S>) -> Result<Self, PhotonsError> {
        Self { later, ..self }.checked(later)
    }

    fn checked(self, map: PhotonMap<'a, S>) -> Result<Self, PhotonsError> {
        for id in map.blocks().iter().flat_map(|block| block.ids) {
            if id != PhotonId::NONE && !id.is_light() {
                let photon = self.occlusion.get(id.index());
                let sound = photon.is_some_and(|photon| {
                    u64::from(photon.first) + u64::from(photon.len) <= self.blockers.len() as u64
                });
                if !sound {
                    return Err(PhotonsError { photon: id.index() as u32 });
                }
            }
        }
        Ok(self)
    }

    /// The same photons, asked with other vectors.
    #[inline(always)]
    pub fn on<T: Simd>(&self, simd: T) -> Photons<'a, T> {
        let (map, later) = (self.map.on(simd), self.later.on(simd));
        Photons { map, later, occlusion: self.occlusion, blockers: self.blockers }
    }

    /// The map alone, of the photons shot evenly.
    #[inline]
    pub fn map(&self) -> PhotonMap<'a, S> {
        self.map
    }

    /// The map of those of later rounds, if there are any.
    #[inline]
    pub fn later(&self) -> Option<PhotonMap<'a, S>> {
        (!self.later.blocks().is_empty()).then_some(self.later)
    }

    /// What the nearest photons say: of one kind, *lit* or *dark*; of both, *penumbra*, and `room` receives the
    /// blockers they name.
    ///
    /// Costs a look-up, or two with [later](Photons::with_later) photons, and in a penumbra the sorting of all names.
    #[inline(always)]
    pub fn classify<'b>(&self, place: &Place, nearest: &mut Nearest<'_>, room: &'b mut [u32]) -> Class<'b> {
        self.map.nearest(place, nearest);
        let k = nearest.k();
        let (found, more) = nearest.and_more();
        let asked = !found.is_empty() && !self.later.blocks().is_empty();
        let (Some(mut more), true) = (more, asked) else { return self.judge_all(found, &[], room) };
        let mut reach = f32::INFINITY;
        if found.len() == k {
            reach = 0.0;
            for neighbour in found {
                reach = reach.max(neighbour.distance_squared());
            }
        }
        self.later.nearest(&place.within(reach), &mut more);
        self.judge_all(found, more.found(), room)
    }

    /// The same for photons already found.
    pub fn judge<'b>(&self, found: &[Neighbour], room: &'b mut [u32]) -> Class<'b> {
        self.judge_all(found, &[], room)
    }

    fn judge_all<'b>(&self, even: &[Neighbour], later: &[Neighbour], room: &'b mut [u32]) -> Class<'b> {
        let found = || even.iter().chain(later);
        let light = found().filter(|neighbour| neighbour.id().is_light()).count();
        if even.is_empty() {
            return Class::Unknown;
        }
        if light == even.len() + later.len() {
            return Class::Lit;
        }
        if light == 0 {
            return Class::Dark;
        }
        // Sorted and without repetition are the first `neat` of the names.
        let (mut len, mut neat, mut dropped) = (0, 0, 0);
        for neighbour in found() {
            if neighbour.id().is_light() {
                continue;
            }
            let photon = &self.occlusion[neighbour.id().index()];
            for &name in &self.blockers[photon.first as usize..(photon.first + photon.len) as usize] {
                if len == room.len() && neat < len {
                    len = distinct(&mut room[..len]);
                    neat = len;
                }
                if len < room.len() {
                    room[len] = name;
                    len += 1;
                } else if room[..len].binary_search(&name).is_err() {
                    dropped += 1;
                }
            }
        }
        len = distinct(&mut room[..len]);
        Class::Penumbra(Blockers { list: &room[..len], dropped })
    }
}

/// Sorts, moves one of each to the front, and says how many these are.
fn distinct(numbers: &mut [u32]) -> usize {
    numbers.sort_unstable();
    let mut len = 0;
    for i in 0..numbers.len() {
        if len == 0 || numbers[len - 1] != numbers[i] {
            numbers[len] = numbers[i];
            len += 1;
        }
    }
    len
}
