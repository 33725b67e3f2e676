//! Neighbouring points and one light: what all their segments have in common is asked once.
//!
//! A shaft around the points and the targets goes down the tree first. Often it comes back empty, and every target
//! is visible; or a sheet of triangles stands across it ([`super::cover`]), and none is. Else it yields the few triangles
//! there are, side by side in blocks of their own, or, where they are many, the subtrees to begin with. With many samples
//! a point it is then asked which parts of the light lie behind sheets of the first triangles that the shaft came to
//! ([`super::umbra`]), and long lists and subtrees are cut down by narrower shafts for parts of the points; with few, long
//! lists of which most matter make room for the subtrees. Then the points are asked: abreast against a list
//! ([`super::abreast`]), or from the subtrees on, up to 64 rays together ([`super::stream`]), where the triangles that
//! blocked anything for one point are asked first for the next. What these leave open goes together with the same point's
//! rays, or, where much is in the way of a large light, with other points' to the same part of it ([`super::beams`]).

use super::abreast::{Abreast, Flat};
use super::batch::{BatchScratch, FEW, targets_from};
use super::beams::Beams;
use super::list::{CREDIT, List};
use super::occluders::Walls;
use super::packet::Rays;
use super::pyramid::{Forgetful, Going, Learner, MOST};
use super::shaft::{Around, Shaft, Turned};
use super::single::Place;
use super::stream::{Start, Stream};
use super::umbra::Umbra;
use super::{ALL_LANES, Bvh, CUT, Child, Node, Occluders, Targets};
use crate::counter::Counter;
use crate::lanes::{Lanes, Simd};
use crate::triangle::TriangleBlock;
use crate::vec3x::{self, Vec3x};
use arrayvec::ArrayVec;
use glam::Vec3;

/// A point of a tile, and which of the targets it asks about.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TilePoint {
    /// Where its segments begin.
    pub x: [f32; 3],
    /// The first of its targets.
    pub first: u32,
    /// How many targets it has, one after the other.
    pub count: u32,
}

/// What a tile works in: keep one a thread, so that nothing is cleared between queries. About eighty kilobytes.
pub struct TileScratch {
    batch: BatchScratch,
    cut: Cut,
    given: List,
    learned: List,
    packet: Packet,
    abreast: Abreast,
    inner_cut: Cut,
    inner: List,
    /// Where the last sheet that hid a whole light was grown from.
    sheet: Option<Place>,
    /// For how many tiles with long lists to come these are not asked.
    thick: u32,
    /// For how many tiles to come, where more is in the way than fits a list, they are not asked about part by part.
    coarse: u32,
    beams: Beams,
    umbra: Umbra,
}

impl TileScratch {
    /// Ready for any query.
    pub const fn new() -> Self {
        Self {
            batch: BatchScratch::new(),
            cut: Cut::NOTHING,
            given: List::EMPTY,
            learned: List::EMPTY,
            packet: Packet::EMPTY,
            abreast: Abreast::NOTHING,
            inner_cut: Cut::NOTHING,
            inner: List::EMPTY,
            sheet: None,
            thick: 0,
            coarse: 0,
            beams: Beams::NOTHING,
            umbra: Umbra::NOTHING,
        }
    }
}

impl Default for TileScratch {
    fn default() -> Self {
        Self::new()
    }
}

impl core::fmt::Debug for TileScratch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("TileScratch")
    }
}

/// Subtrees that a shaft meets.
struct Cut {
    /// As children of nodes that are in no tree.
    nodes: [Node; CUT / Node::WIDTH],
    count: usize,
    /// Yet to look into, while the shaft goes down.
    queue: [Entry; QUEUE],
    /// How far the queue had come when it was last short enough for a cut, and the list empty.
    saved: (usize, usize),
}

/// A subtree and its box.
#[derive(Clone, Copy)]
struct Entry {
    child: Child,
    bounds: [[f32; 3]; 2],
    path: Path,
}

/// The places from the top of the tree on, the first in the highest bits: paths are ordered as subtrees are when the first
/// child always comes first, but for those too far down to be told apart.
#[derive(Clone, Copy)]
struct Path {
    places: u64,
    /// Where the next place goes.
    shift: u32,
}

impl Path {
    const TOP: Self = Self { places: 0, shift: 60 };

    #[inline(always)]
    fn below(self, place: usize) -> Self {
        Self { places: self.places | (place as u64) << self.shift, shift: self.shift.saturating_sub(3) }
    }
}

/// Subtrees a shaft keeps track of.
const QUEUE: usize = 128;

impl Cut {
    const NOTHING: Self = Self {
        nodes: [Node::EMPTY; CUT / Node::WIDTH],
        count: 0,
        queue: [Entry { child: Child::NONE, bounds: [[0.0; 3]; 2], path: Path::TOP }; QUEUE],
        saved: (0, 0),
    };

    /// The nodes in use.
    #[inline(always)]
    fn nodes(&self) -> &[Node] {
        &self.nodes[..self.count.div_ceil(Node::WIDTH)]
    }

    /// Keeps the subtrees that were saved, in the tree's order: it puts first what is likeliest to block for the work
    /// that it takes.
    #[inline(always)]
    fn keep(&mut self) {
        let (head, len) = self.saved;
        let mut order = ArrayVec::<(u64, usize), CUT>::new();
        let mut k = head;
        while k < len {
            let places = self.queue[k].path.places;
            let mut slot = order.len();
            order.push((places, k));
            while slot > 0 && order[slot - 1].0 > places {
                order[slot] = order[slot - 1];
                slot -= 1;
            }
            order[slot] = (places, k);
            k += 1;
        }
        self.count = 0;
        let mut k = 0;
        while k < order.len() {
            let entry = self.queue[order[k].1];
            self.push(&entry);
            k += 1;
        }
    }

    /// Adds a subtree. There must be room.
    #[inline(always)]
    fn push(&mut self, entry: &Entry) {
        let (node, place) = (self.count / Node::WIDTH, self.count % Node::WIDTH);
        if place == 0 {
            self.nodes[node] = Node::EMPTY;
        }
        self.nodes[node].set(place, entry.bounds[0], entry.bounds[1], entry.child);
        self.count += 1;
    }
}

/// Rays of several points, side by side.
struct Packet {
    origin: [[f32; MOST]; 3],
    direction: [[f32; MOST]; 3],
    target: [u32; MOST],
    count: usize,
}

impl Packet {
    const EMPTY: Self =
        Self { origin: [[0.0; MOST]; 3], direction: [[0.0; MOST]; 3], target: [0; MOST], count: 0 };
}

/// Points with fewer rays go down with their neighbours' from the start, where there is no complete list.
const MIXED: usize = 12;

/// Points with fewer rays do not sort them.
const SORTED: usize = 6;

/// Points with as many or fewer share what the learned triangles leave open.
const SHARED: usize = 32;

/// With fewer rays a shaft costs more than it saves.
const WORTHWHILE: usize = 32;

/// Tiles with as many samples a point and more points than a part has are asked about part by part, unless the list is
/// short. Where there is more in the way than fits a list, so many parts must gain something for the others to be tried.
const FINE: usize = 32;
const PART: usize = 16;
const SHORT: usize = 12;
const TRIED: usize = 2;

/// For so many tiles after one where they gain nothing, parts are not tried.
const COARSE: u32 = 7;

/// With fewer samples a point, a list that is longer is asked for some points, and for the others only if no more of its
/// triangles than this come before the targets of a point: else going down the tree is quicker.
const LONG: usize = 16;
const PAIRS: usize = 6;

/// Of so many tiles with such lists after one where it is, they are not asked at all.
const AGAIN: u32 = 3;

/// What points are asked with.
struct Work<'w> {
    batch: &'w mut BatchScratch,
    learned: &'w mut List,
    packet: &'w mut Packet,
    abreast: &'w mut Abreast,
    walls: &'w mut Walls,
    beams: &'w mut Beams,
}

/// Steps a shaft may take for each ray of its tile, and at most.
const STEPS: [usize; 3] = [16, 8, 192];

impl<S: Simd> Bvh<'_, S> {
    /// Which of the segments from each point to its targets does anything but `ignore` block?
    ///
    /// Bit `i % 64` of `blocked[i / 64]` answers for target `i`, as [`Bvh::occluded`] would for
    /// [`Ray::segment(x, target)`](crate::Ray::segment) with the point it belongs to; the bits of targets that
    /// belong to no point are left alone. Panics if a point names targets that do not exist, or if `blocked` is
    /// too short. Of segments in the plane of a triangle see [`crate::triangle`].
    ///
    /// Any points and any targets get right answers. It pays where the points are neighbours, such as those of 8
    /// by 8 pixels, also in their order (a Z curve is best), and the targets lie on one light.
    #[inline(always)]
    pub fn occluded_tile(
        &self,
        points: &[TilePoint],
        targets: &Targets<'_>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        scratch: &mut TileScratch,
        blocked: &mut [u64],
    ) {
        self.occluded_tile_with(&Occluders::NONE, points, targets, ignore, counter, scratch, blocked);
    }

    /// The same answers, quicker where one of these boxes stands between all of the points and all of the targets:
    /// then no ray is traced.
    ///
    /// The targets must be outside the meshes that the boxes are inside of (see [`Occluders`]). With a triangle to
    /// ignore the boxes are not asked, as it may be of such a mesh.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub fn occluded_tile_with(
        &self,
        occluders: &Occluders<'_>,
        points: &[TilePoint],
        targets: &Targets<'_>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        scratch: &mut TileScratch,
        blocked: &mut [u64],
    ) {
        let mut rays = 0;
        let mut k = 0;
        let mut runs = 0;
        let mut whole = (0, 0);
        while k < points.len() {
            let (first, end) = run(points, &mut k);
            assert!(end == first || end <= targets.len(), "a point names targets that do not exist");
            clear(blocked, first, end - first);
            rays += end - first;
            whole = (first, end);
            runs += 1;
        }
        // Most often all targets follow each other.
        let whole = if runs == 1 { Some(whole) } else { None };
        if rays == 0 || self.nodes.is_empty() {
            counter.rays(rays as u32);
            return;
        }
        let wanted = rays >= WORTHWHILE;
        let shaft = if wanted { self.shaft(points, whole, targets, frame_of_points(points)) } else { None };
        let mut walls = Walls::NONE;
        if let (Some(shaft), false, None) = (&shaft, occluders.is_empty(), ignore)
            && self.walled_off(occluders, shaft, &mut walls, counter)
        {
            counter.rays(rays as u32);
            fill_all(blocked, points);
            return;
        }
        let TileScratch {
            batch,
            cut,
            given,
            learned,
            packet,
            abreast,
            inner_cut,
            inner,
            sheet,
            thick,
            coarse,
            beams,
            umbra,
        } = scratch;
        (given.count, learned.count, learned.credit) = (0, 0, CREDIT);
        let complete = match &shaft {
            Some(shaft) => self.gather(shaft, &self.nodes[..1], rays, points.len(), cut, given, counter),
            None => {
                self.whole(cut);
                false
            }
        };
        if complete && given.count == 0 {
            counter.rays(rays as u32);
            return;
        }
        (packet.count, abreast.pairs) = (0, 0);
        if let Some(shaft) = &shaft
            && self.sheet_between(shaft, if complete { Some(given) } else { None }, sheet, ignore, counter)
        {
            counter.rays(rays as u32);
            fill_all(blocked, points);
            return;
        }
        match &shaft {
            Some(shaft) if rays >= SORTED * points.len() => beams.aim(shaft, rays / points.len()),
            _ => beams.skip(),
        }
        let fine = rays >= FINE * points.len();
        if !complete {
            if let Some(shaft) = &shaft
                && fine
                && beams.group > 0
                && ignore.is_none()
            {
                beams.hidden =
                    umbra.hidden_cells(self.simd, shaft, &beams.grid, given, self.magnitude, counter);
                if beams.hidden == u64::MAX {
                    counter.rays(rays as u32);
                    fill_all(blocked, points);
                    return;
                }
            }
            // A list that is not all there is would be asked for nothing as often as not.
            given.count = 0;
        }
        let mut apart = fine && shaft.is_some() && points.len() > PART;
        if complete {
            apart &= given.count > SHORT;
        } else if apart && !beams.instead_of_parts() {
            apart = *coarse == 0;
            *coarse = coarse.saturating_sub(1);
        } else {
            apart = false;
        }
        let work = &mut Work { batch, learned, packet, abreast, walls: &mut walls, beams };
        let Some(whole) = shaft.as_ref().filter(|_| apart) else {
            let shaft = shaft.as_ref();
            let mut rest = points;
            let mut complete = complete;
            if complete && given.count > LONG && !fine && points.len() > S::Packet::WIDTH {
                let mut many = *thick > 0;
                *thick = thick.saturating_sub(1);
                if !many {
                    let some = &points[..S::Packet::WIDTH];
                    rest = &points[S::Packet::WIDTH..];
                    self.ask_points(shaft, true, some, targets, cut, given, ignore, counter, work, blocked);
                    many = work.abreast.pairs as usize > PAIRS * some.len();
                    if many {
                        *thick = AGAIN;
                    }
                }
                if many {
                    (complete, given.count) = (false, 0);
                    cut.keep();
                }
            }
            self.ask_points(shaft, complete, rest, targets, cut, given, ignore, counter, work, blocked);
            return;
        };
        // Neighbours among the neighbours have narrower shafts.
        let (mut useful, mut tried) = (0, 0);
        let mut k = 0;
        while k < points.len() {
            if !complete && tried == TRIED && useful == 0 {
                *coarse = COARSE;
                let rest = &points[k..];
                self.ask_points(None, false, rest, targets, cut, given, ignore, counter, work, blocked);
                return;
            }
            let part = &points[k..(k + PART).min(points.len())];
            (k, tried) = (k + PART, tried + 1);
            let rays = rays_of(part);
            let Some(narrow) = self.narrower(whole, part).filter(|_| rays > 0) else {
                self.ask_points(None, complete, part, targets, cut, given, ignore, counter, work, blocked);
                continue;
            };
            let closed = if complete {
                (inner.count, inner_cut.count) = (0, 0);
                let mut block = 0;
                while block < given.blocks().len() {
                    let all = (&given.blocks[block], ALL_LANES);
                    inner.take(&narrow, self.simd, all, List::MOST, counter);
                    block += 1;
                }
                true
            } else {
                self.gather(&narrow, cut.nodes(), rays, part.len(), inner_cut, inner, counter)
            };
            if !closed {
                inner.count = 0;
            }
            useful += u32::from(closed);
            if closed && inner.count == 0 {
                counter.rays(rays as u32);
                continue;
            }
            if self.sheet_between(&narrow, if closed { Some(inner) } else { None }, sheet, ignore, counter) {
                useful += 1;
                counter.rays(rays as u32);
                fill_all(blocked, part);
                continue;
            }
            let narrow = Some(&narrow);
            self.ask_points(narrow, closed, part, targets, inner_cut, inner, ignore, counter, work, blocked);
        }
    }

    /// Asks for each point. If the list is complete, nothing else is there;
    /// else it is empty, and all there is stands below the cut.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn ask_points(
        &self,
        shaft: Option<&Shaft>,
        complete: bool,
        points: &[TilePoint],
        targets: &Targets<'_>,
        cut: &Cut,
        given: &mut List,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        work: &mut Work<'_>,
        blocked: &mut [u64],
    ) {
        self.simd.apart(
            #[inline(always)]
            || {
                self.ask_points_here(
                    shaft, complete, points, targets, cut, given, ignore, counter, work, blocked,
                )
            },
        )
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn ask_points_here(
        &self,
        shaft: Option<&Shaft>,
        complete: bool,
        points: &[TilePoint],
        targets: &Targets<'_>,
        cut: &Cut,
        given: &mut List,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        work: &mut Work<'_>,
        blocked: &mut [u64],
    ) {
        let Work { batch, learned, packet, abreast, walls, beams } = work;
        let flat = match shaft {
            Some(shaft) if complete && rays_of(points) >= FEW * points.len() => {
                Flat::new(targets, shaft, self.magnitude)
            }
            _ => None,
        };
        // Points that were answered abreast, and the first that was not asked.
        let (mut answered, mut next) = (0u32, 0);
        let mut k = 0;
        while k < points.len() {
            if let Some(flat) = &flat {
                if k == next {
                    next = (k + S::Packet::WIDTH).min(points.len());
                    let list = given.blocks();
                    answered =
                        self.ask_abreast(flat, &points[k..next], targets, list, ignore, counter, abreast);
                    let mut lane = 0;
                    while k + lane < next {
                        let TilePoint { first, count, .. } = points[k + lane];
                        if answered >> lane & 1 != 0 {
                            counter.rays(count);
                            set(blocked, first as usize, abreast.blocked[lane]);
                        }
                        lane += 1;
                    }
                }
                let this = answered & 1 != 0;
                answered >>= 1;
                if this {
                    k += 1;
                    continue;
                }
            }
            let row = if packet.count == 0 { one_each(&points[k..]) } else { 0 };
            if row >= S::Packet::WIDTH {
                let row = &points[k..k + row];
                self.send_row(&mut batch.stream, row, targets, cut, given, ignore, counter, blocked);
                k += row.len();
                continue;
            }
            let TilePoint { x, first, count } = points[k];
            let (mut from, end) = (first as usize, first as usize + count as usize);
            while from < end {
                let part = (end - from).min(MOST);
                let mut word = 0;
                if !complete && part >= MIXED && beams.hidden != 0 {
                    word = self.simd.apart(
                        #[inline(always)]
                        || beams.hides(self.simd, targets, from, part),
                    );
                    counter.rays(word.count_ones());
                }
                if !complete && (SORTED..MIXED).contains(&part) && beams.wanted() {
                    self.put_by(beams, x, targets, from, u64::MAX >> (64 - part));
                } else if part < FEW || (!complete && part < MIXED) {
                    let mut i = from;
                    while i < from + part {
                        packet.put(x, targets.get(i), i);
                        if packet.count == MOST {
                            self.send(
                                &mut batch.stream,
                                packet,
                                cut,
                                given,
                                ignore,
                                counter,
                                *learned,
                                blocked,
                            );
                            beams.judge(&batch.stream, MOST as u32);
                        }
                        i += 1;
                    }
                } else if complete {
                    let word = if batch.pyramid.aim(self.simd, x.into(), targets, from, part, self.magnitude)
                    {
                        counter.rays(part as u32);
                        let every = batch.pyramid.every();
                        every & !self.list_leaves(batch, given, every, false, ignore, counter)
                    } else {
                        self.rays_from_root(&mut batch.stream, x, targets, from, part, ignore, counter)
                    };
                    set(blocked, from, word);
                } else {
                    let mut ask = u64::MAX >> (64 - part) & !word;
                    let aimed = ask != 0
                        && (learned.count > 0 || !walls.is_empty())
                        && batch.pyramid.aim(self.simd, x.into(), targets, from, part, self.magnitude);
                    if aimed && !walls.is_empty() {
                        let hidden = ask & walls.hide(self.simd, &batch.pyramid, counter);
                        (word, ask) = (word | hidden, ask & !hidden);
                        counter.rays(hidden.count_ones());
                    }
                    if aimed && learned.count > 0 && ask != 0 {
                        let asked = ask.count_ones();
                        let left = self.list_leaves(batch, learned, ask, true, ignore, counter);
                        counter.rays((ask & !left).count_ones());
                        (word, ask) = (word | ask & !left, left);
                        if left.count_ones() * 4 > asked {
                            learned.fail();
                        }
                    }
                    if beams.wanted() {
                        self.put_by(beams, x, targets, from, ask);
                    } else if part <= SHARED {
                        while ask != 0 {
                            let i = from + ask.trailing_zeros() as usize;
                            ask &= ask - 1;
                            packet.put(x, targets.get(i), i);
                            if packet.count == MOST {
                                let stream = &mut batch.stream;
                                self.send(stream, packet, cut, given, ignore, counter, *learned, blocked);
                                beams.judge(&batch.stream, MOST as u32);
                            }
                        }
                    } else if ask != 0 {
                        let start = Start { root: false, blocks: &[], nodes: cut.nodes(), entries: &[] };
                        word |= self.rays_blocked(
                            &mut batch.stream,
                            &start,
                            x,
                            targets,
                            from,
                            ask,
                            ignore,
                            counter,
                            *learned,
                        );
                        beams.judge(&batch.stream, ask.count_ones());
                    }
                    set(blocked, from, word);
                }
                from += part;
                let grouped = from == end && (k + 1).is_multiple_of(beams.group);
                if beams.is_full() || (grouped && !beams.is_empty()) {
                    let stream = &mut batch.stream;
                    self.send_sorted(
                        beams, stream, packet, targets, cut, given, ignore, counter, learned, blocked,
                    );
                }
            }
            k += 1;
        }
        if !beams.is_empty() {
            let stream = &mut batch.stream;
            self.send_sorted(beams, stream, packet, targets, cut, given, ignore, counter, learned, blocked);
        }
        if packet.count > 0 {
            self.send(&mut batch.stream, packet, cut, given, ignore, counter, *learned, blocked);
        }
    }

    /// Which of the pyramid's targets, of those asked about, the triangles of a list leave free.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn list_leaves(
        &self,
        batch: &mut BatchScratch,
        list: &mut List,
        ask: u64,
        may_go: bool,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> u64 {
        self.simd.apart(
            #[inline(always)]
            || self.list_asked(batch, list, ask, may_go, ignore, counter),
        )
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn list_asked(
        &self,
        batch: &mut BatchScratch,
        list: &mut List,
        ask: u64,
        may_go: bool,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> u64 {
        let pyramid = &batch.pyramid;
        let mut going = Going::new(ask);
        let mut k = 0;
        while k * TriangleBlock::WIDTH < list.count && going.free != 0 {
            let ask = going.free;
            let block = (&list.blocks[k], ALL_LANES);
            let hidden =
                self.block_blocked(pyramid, block, &mut going.forms, ask, ignore, counter, &mut Forgetful);
            going.free &= !hidden;
            k += usize::from(list.judge(k, (ask & hidden).count_ones(), may_go));
        }
        going.free
    }

    /// The rays of up to 64 points, which have a target each, one after the other.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn send_row(
        &self,
        stream: &mut Stream,
        points: &[TilePoint],
        targets: &Targets<'_>,
        cut: &Cut,
        list: &List,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        blocked: &mut [u64],
    ) {
        let token = self.simd.token();
        let first = points[0].first as usize;
        stream.clear();
        let mut from = 0;
        while from < points.len() {
            let origin = points_from(token, points, from);
            let ends = targets_from::<S>(token, targets, first + from, first + points.len());
            let rays = Rays {
                origin,
                direction: vec3x::sub(ends, origin),
                t_min: S::Packet::splat(token, 0.0),
                t_max: S::Packet::splat(token, 1.0),
            };
            let active = u32::MAX >> (32 - (points.len() - from).min(S::Packet::WIDTH));
            self.join(stream, from, &rays, active);
            from += S::Packet::WIDTH;
        }
        let start = Start { root: false, blocks: list.blocks(), nodes: cut.nodes(), entries: &[] };
        counter.rays(points.len() as u32);
        let ask = u64::MAX >> (64 - points.len());
        let word = self.stream_blocked(stream, &start, ask, ignore, counter, &mut Forgetful);
        set(blocked, first, word);
    }

    /// Puts a point's rays by, to be sorted. There must be room.
    #[inline(always)]
    fn put_by(&self, beams: &mut Beams, x: [f32; 3], targets: &Targets<'_>, first: usize, ask: u64) {
        if ask != 0 {
            self.simd.apart(
                #[inline(always)]
                || beams.put(self.simd, x, targets, first, ask),
            );
        }
    }

    /// The rays that were to be sorted, in their order.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn send_sorted(
        &self,
        beams: &mut Beams,
        stream: &mut Stream,
        packet: &mut Packet,
        targets: &Targets<'_>,
        cut: &Cut,
        list: &List,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        learned: &mut List,
        blocked: &mut [u64],
    ) {
        self.simd.apart(
            #[inline(always)]
            || {
                let count = beams.sort();
                let mut k = 0;
                while k < count {
                    let (x, target) = beams.ray(k);
                    packet.put(x, targets.get(target), target);
                    k += 1;
                    if packet.count == MOST || k == count {
                        self.send(stream, packet, cut, list, ignore, counter, learned, blocked);
                    }
                }
            },
        );
    }

    /// The rays that have been put together.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn send(
        &self,
        stream: &mut Stream,
        packet: &mut Packet,
        cut: &Cut,
        list: &List,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
        blocked: &mut [u64],
    ) {
        self.simd.apart(
            #[inline(always)]
            || self.send_all(stream, packet, cut, list, ignore, counter, learner, blocked),
        );
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn send_all(
        &self,
        stream: &mut Stream,
        packet: &mut Packet,
        cut: &Cut,
        list: &List,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        learner: &mut impl Learner,
        blocked: &mut [u64],
    ) {
        let token = self.simd.token();
        stream.clear();
        let mut from = 0;
        while from < packet.count {
            let rays = Rays {
                origin: vec3x::load(token, &packet.origin, from),
                direction: vec3x::load(token, &packet.direction, from),
                t_min: S::Packet::splat(token, 0.0),
                t_max: S::Packet::splat(token, 1.0),
            };
            let active = u32::MAX >> (32 - (packet.count - from).min(S::Packet::WIDTH));
            self.join(stream, from, &rays, active);
            from += S::Packet::WIDTH;
        }
        stream.surround(self.simd, self.magnitude);
        let start = Start { root: false, blocks: list.blocks(), nodes: cut.nodes(), entries: &[] };
        counter.rays(packet.count as u32);
        let ask = u64::MAX >> (64 - packet.count);
        let mut bits = self.stream_blocked(stream, &start, ask, ignore, counter, learner);
        while bits != 0 {
            let i = packet.target[bits.trailing_zeros() as usize] as usize;
            bits &= bits - 1;
            blocked[i / 64] |= 1 << (i % 64);
        }
        packet.count = 0;
    }

    /// Is there nothing at all between a box, turned any way, and the targets? `true` is certain: every segment from
    /// a point of the box to a point of the targets' hull is free. `false` says that there may be something.
    ///
    /// Corner `i` of the box lies to the greater side along its first, second and third edge where bit 0, 1 and 2 of
    /// `i` is set. Costs what the shaft of one tile does, some microseconds.
    #[inline(always)]
    pub fn nothing_between(
        &self,
        corners: &[[f32; 3]; 8],
        targets: &Targets<'_>,
        counter: &mut impl Counter,
        scratch: &mut TileScratch,
    ) -> bool {
        let count = targets.len();
        if self.nodes.is_empty() || count == 0 {
            return true;
        }
        let mut points = [TilePoint { x: corners[0], first: 0, count: count as u32 }; 8];
        let mut k = 1;
        while k < points.len() {
            points[k] = TilePoint { x: corners[k], first: count as u32, count: 0 };
            k += 1;
        }
        let at = |index: usize| Vec3::from(corners[index]) - Vec3::from(corners[0]);
        let frame = frame(at(1).cross(at(2)), at(1));
        let Some(shaft) = self.shaft(&points, None, targets, frame) else { return false };
        let TileScratch { cut, given, .. } = scratch;
        given.count = 0;
        let (root, rays) = (&self.nodes[..1], STEPS[0] * STEPS[2]);
        self.gather(&shaft, root, rays, points.len(), cut, given, counter) && given.count == 0
    }

    /// The shaft around a tile's segments; `None` where it would say nothing. `whole` is where the targets of all points
    /// begin and end, if they follow each other.
    #[inline(always)]
    fn shaft(
        &self,
        points: &[TilePoint],
        whole: Option<(usize, usize)>,
        targets: &Targets<'_>,
        frame: [Vec3; 3],
    ) -> Option<Shaft> {
        type P<S> = <S as Simd>::Packet;
        let token = self.simd.token();
        let reference = Vec3::from(points[0].x);
        if !reference.is_finite() {
            return None;
        }
        let here = self.around(points, reference, frame);
        let mut there = Around::<P<S>>::new(token, targets.turn());
        let mut k = 0;
        while k < points.len() {
            let (first, end) = match whole {
                Some(whole) => {
                    k = points.len();
                    whole
                }
                None => run(points, &mut k),
            };
            let origin = vec3x::splat::<P<S>>(token, reference.to_array());
            let mut i = first;
            while i < end {
                let position = targets_from::<S>(token, targets, i, end);
                there.add(token, vec3x::sub(position, origin));
                i += P::<S>::WIDTH;
            }
        }
        Shaft::new(self.simd, reference, &here, &there.finish(), self.magnitude)
    }

    /// The shaft of some of the points.
    #[inline(always)]
    fn narrower(&self, shaft: &Shaft, points: &[TilePoint]) -> Option<Shaft> {
        let here = self.around(points, shaft.reference, frame_of_points(points));
        Shaft::new(self.simd, shaft.reference, &here, &shaft.targets, self.magnitude)
    }

    /// A box around points, from the reference.
    #[inline(always)]
    fn around(&self, points: &[TilePoint], reference: Vec3, frame: [Vec3; 3]) -> Turned {
        let token = self.simd.token();
        let mut here = Around::<S::Packet>::new(token, frame);
        let mut k = 0;
        while k < points.len() {
            let origin = vec3x::splat::<S::Packet>(token, reference.to_array());
            here.add(token, vec3x::sub(points_from(token, points, k), origin));
            k += S::Packet::WIDTH;
        }
        here.finish()
    }

    /// The whole tree as the only subtree.
    #[inline(always)]
    fn whole(&self, cut: &mut Cut) {
        cut.count = 0;
        let most = self.magnitude;
        cut.push(&Entry { child: Child::node(0), bounds: [[-most; 3], [most; 3]], path: Path::TOP });
    }

    /// Puts the children of a node that the shaft meets into the queue. False if there is no room for them.
    #[inline(always)]
    fn enqueue(
        &self,
        shaft: &Shaft,
        node: &Node,
        cut: &mut Cut,
        len: &mut usize,
        path: Path,
        counter: &mut impl Counter,
    ) -> bool {
        counter.node_tests(node.len());
        let mut met = shaft.children(self.simd, node);
        while met != 0 {
            let place = met.trailing_zeros() as usize & 7;
            met &= met - 1;
            if node.children[place] == Child::NONE {
                continue;
            }
            if *len == QUEUE {
                return false;
            }
            let [[a, b, c], [d, e, f]] = &node.bounds;
            let bounds = [[a[place], b[place], c[place]], [d[place], e[place], f[place]]];
            cut.queue[*len] = Entry { child: node.children[place], bounds, path: path.below(place) };
            *len += 1;
        }
        true
    }

    /// Does a sheet of triangles stand between all points and all targets of a shaft? `list` is all that the shaft
    /// meets, if that is known.
    #[inline(always)]
    fn sheet_between(
        &self,
        shaft: &Shaft,
        list: Option<&List>,
        sheet: &mut Option<Place>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> bool {
        if let Some(list) = list {
            return match self.met_in_the_middle(shaft, list.blocks(), counter) {
                Some((block, lane)) => self.sheet_hides(shaft, block, lane, ignore, counter),
                None => false,
            };
        }
        if let Some(place) = *sheet
            && let Some(block) = self.blocks.get(place.block)
            && self.sheet_hides(shaft, block, place.lane, ignore, counter)
        {
            return true;
        }
        let Some(place) = self.blocker_place(&shaft.axis(), ignore, counter) else { return false };
        let hides = self.sheet_hides(shaft, &self.blocks[place.block], place.lane, ignore, counter);
        if hides {
            *sheet = Some(place);
        }
        hides
    }

    /// Goes down the tree with the shaft. True if the list holds all that may block anything; else it holds what was come
    /// to, and the cut all there is.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn gather(
        &self,
        shaft: &Shaft,
        roots: &[Node],
        rays: usize,
        points: usize,
        cut: &mut Cut,
        list: &mut List,
        counter: &mut impl Counter,
    ) -> bool {
        self.simd.apart(
            #[inline(always)]
            || self.gather_here(shaft, roots, rays, points, cut, list, counter),
        )
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn gather_here(
        &self,
        shaft: &Shaft,
        roots: &[Node],
        rays: usize,
        points: usize,
        cut: &mut Cut,
        list: &mut List,
        counter: &mut impl Counter,
    ) -> bool {
        let [share, least, most] = STEPS;
        let steps = (rays / share).clamp(least, most);
        let room = if rays < FEW * points { 8 } else { List::ROOM };
        (cut.count, list.count) = (0, 0);
        let (mut head, mut len) = (0, 0);
        let mut done = 0;
        while done < roots.len() {
            // At most sixteen children, for which there is room.
            self.enqueue(shaft, &roots[done], cut, &mut len, Path::TOP.below(done), counter);
            done += 1;
        }
        cut.saved = (0, len);
        loop {
            if head == len {
                return true;
            }
            if len - head <= CUT && list.count == 0 {
                cut.saved = (head, len);
            }
            if done > steps {
                break;
            }
            let Entry { child: next, path, .. } = cut.queue[head];
            head += 1;
            done += 1;
            let enough = if next.is_leaf() {
                list.take(shaft, self.simd, (&self.blocks[next.block()], next.bits()), room, counter)
            } else {
                self.enqueue(shaft, &self.nodes[next.index()], cut, &mut len, path, counter)
            };
            if !enough {
                break;
            }
        }
        cut.keep();
        false
    }
}

impl Packet {
    #[inline(always)]
    fn put(&mut self, x: [f32; 3], target: Vec3, index: usize) {
        let lane = self.count % MOST;
        let target_at = target.to_array();
        let mut axis = 0;
        while axis < 3 {
            self.origin[axis][lane] = x[axis];
            self.direction[axis][lane] = target_at[axis] - x[axis];
            axis += 1;
        }
        self.target[lane] = index as u32;
        self.count += 1;
    }
}

/// Three unit vectors at right angles: the first two in the plane of the points, as far as they have one.
#[inline(always)]
fn frame_of_points(points: &[TilePoint]) -> [Vec3; 3] {
    let n = points.len();
    let at = |index: usize| Vec3::from(points[index].x);
    let first = at(0);
    let (mut normal, mut edge, mut most) = (Vec3::ZERO, Vec3::ZERO, 0.0);
    // Corners of a square, whether it is stored row by row or along a Z curve, with some points missing or not.
    let candidates = [[n - 1, n / 8], [n - 1, n / 3], [n / 3, 2 * n / 3], [n - 1, n / 2], [n / 2, n / 8]];
    let mut k = 0;
    while k < candidates.len() {
        let (a, b) = (at(candidates[k][0]) - first, at(candidates[k][1].min(n - 1)) - first);
        let cross = a.cross(b);
        let size = cross.length_squared();
        if size > most {
            (normal, edge, most) = (cross, b, size);
        }
        k += 1;
    }
    frame(normal, edge)
}

/// Three unit vectors at right angles, the last about along `normal` and the first along `edge`; the axes where these
/// are no good.
#[inline(always)]
pub(super) fn frame(normal: Vec3, edge: Vec3) -> [Vec3; 3] {
    let (normal, edge) = (normal.normalize_or_zero(), edge.normalize_or_zero());
    let third = normal.cross(edge);
    let size = third.length_squared();
    if size > 0.25 && size < 2.0 {
        // The normal of a sliver is far from being at right angles to its edges.
        let third = third.normalize();
        [edge, third, edge.cross(third)]
    } else {
        [Vec3::X, Vec3::Y, Vec3::Z]
    }
}

/// Points from the `from`th on, one a lane; the last of all once more in the lanes beyond it.
#[inline(always)]
fn points_from<L: Lanes>(token: L::Token, points: &[TilePoint], from: usize) -> Vec3x<L> {
    let points = &points[from..];
    let mut lanes = [[0.0; 16]; 3];
    let mut lane = 0;
    if points.len() >= L::WIDTH {
        let points = &points[..L::WIDTH];
        while lane < L::WIDTH {
            let x = points[lane].x;
            (lanes[0][lane], lanes[1][lane], lanes[2][lane]) = (x[0], x[1], x[2]);
            lane += 1;
        }
        return vec3x::load(token, &lanes, 0);
    }
    while lane < L::WIDTH {
        let x = points[lane.min(points.len() - 1)].x;
        (lanes[0][lane], lanes[1][lane], lanes[2][lane]) = (x[0], x[1], x[2]);
        lane += 1;
    }
    vec3x::load(token, &lanes, 0)
}

/// The targets of points from the `k`th on that follow each other; `k` becomes the first point that breaks off.
#[inline(always)]
fn run(points: &[TilePoint], k: &mut usize) -> (usize, usize) {
    let rest = &points[*k..];
    let first = rest[0].first as usize;
    let mut end = first;
    let mut i = 0;
    while i < rest.len() && rest[i].first as usize == end {
        // Beyond the greatest index there is no target, whatever the width of an index.
        end = end.saturating_add(rest[i].count as usize);
        i += 1;
    }
    *k += i;
    (first, end)
}

/// How many of the first points, up to 64, have a target each, one after the other?
#[inline(always)]
fn one_each(points: &[TilePoint]) -> usize {
    let points = &points[..points.len().min(MOST)];
    let mut next = points[0].first as usize;
    let mut k = 0;
    while k < points.len() && points[k].count == 1 && points[k].first as usize == next {
        next += 1;
        k += 1;
    }
    k
}

/// How many targets points have.
#[inline(always)]
fn rays_of(points: &[TilePoint]) -> usize {
    let mut rays = 0;
    let mut k = 0;
    while k < points.len() {
        rays += points[k].count as usize;
        k += 1;
    }
    rays
}

/// Sets the bits of all targets of points.
#[inline(always)]
fn fill_all(blocked: &mut [u64], points: &[TilePoint]) {
    let mut k = 0;
    while k < points.len() {
        let (first, end) = run(points, &mut k);
        fill(blocked, first, end - first);
    }
}

/// Clears the bits of `count` targets from the `first`th on.
#[inline(always)]
fn clear(blocked: &mut [u64], first: usize, count: usize) {
    let mut i = first;
    let end = first + count;
    while i < end {
        let (bit, part) = (i % 64, (end - i).min(64 - i % 64));
        blocked[i / 64] &= !((u64::MAX >> (64 - part)) << bit);
        i += part;
    }
}

/// Sets the bits of `count` targets from the `first`th on.
#[inline(always)]
fn fill(blocked: &mut [u64], first: usize, count: usize) {
    let mut i = first;
    let end = first + count;
    while i < end {
        let (bit, part) = (i % 64, (end - i).min(64 - i % 64));
        blocked[i / 64] |= (u64::MAX >> (64 - part)) << bit;
        i += part;
    }
}

/// Sets bits of targets from the `first`th on.
#[inline(always)]
fn set(blocked: &mut [u64], first: usize, word: u64) {
    let bit = first % 64;
    if word != 0 {
        blocked[first / 64] |= word << bit;
        if bit != 0 && word >> (64 - bit) != 0 {
            blocked[first / 64 + 1] |= word >> (64 - bit);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_at_right_angles_whatever_they_are_made_of() {
        let edge = Vec3::new(0.8, -0.36, 0.48);
        for away in [Vec3::new(0.6, 0.48, -0.64), Vec3::new(0.0, 0.8, 0.6), Vec3::ONE] {
            for lean in [0.0, 1e-3, 0.1, 0.5, 1.0, 10.0] {
                let frame = frame(away + edge * lean, edge * 1e-3);
                for k in 0..3 {
                    assert!((frame[k].length() - 1.0).abs() < 1e-6, "{away} {lean} {frame:?}");
                    assert!(frame[k].dot(frame[(k + 1) % 3]).abs() < 1e-6, "{away} {lean} {frame:?}");
                }
            }
        }
    }
}
