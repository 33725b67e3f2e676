//! Rounds: more photons from where the light is partly hidden.
//!
//! After the first, even round, emission is cut into cells, a place on the light times a direction. Each photon looks at
//! its neighbours: if they are of both kinds a shadow begins or ends there, and if their lists of blockers disagree,
//! a blocker is likely not named yet. Cells whose photons see much of either get more lines of the next round.
//!
//! What is drawn this way is no even sample of the light, so it stands apart from the first round, and only ever turns
//! calls of lit and dark into penumbrae: see [`Photons::with_later`](occlude_kernel::photons::Photons::with_later).

use super::{PhotonStore, Shower, Sorted};
use crate::scene::Scene;
use glam::Vec3;
use occlude_kernel::Simd;
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::photons::{Nearest, Neighbour, PhotonId, PhotonMap, Place};
use rayon::prelude::*;
use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, TAU};
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Cells along each edge of a light.
const PLACES: usize = 2;

/// Lines of the first round that a cell gets, or more.
const LEAST: u64 = 8;

/// Cells along each edge of the square of directions, at most.
const MOST_EDGE: usize = 64;

/// Neighbours that a photon looks at.
const LOOK: usize = 24;

/// Points of a photon whose neighbours are of both kinds, and as many again if every blocker is named but once.
const MIXED: u64 = 16;

/// No cell is due more than this many times the mean.
const MOST_TIMES: f64 = 32.0;

/// Each cell is due at least this part of the mean: borders finer than the photons are found by chance.
const LEAST_TIMES: f64 = 0.02;

/// Photons of a cell that are judged, on average; of more, evenly spread ones.
const ENOUGH: usize = 16;

/// Photons a task judges.
const CHUNK: usize = 4096;

/// The cells that a light's lines leave from: places on it, times directions on the square that
/// [`disc`] maps to the disc below the hemisphere. All have the same power.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Cells {
    /// Directions along each edge.
    edge: usize,
    /// Lines so far, on average or exactly.
    lines: Vec<f64>,
    /// Running sums of what is due in the next round, and at the end their total.
    sums: Vec<u64>,
}

impl Cells {
    /// As many as this many evenly spread lines can tell apart.
    pub(super) fn new(lines: u64) -> Self {
        let edge = ((lines / (LEAST * (PLACES * PLACES) as u64)) as f64).sqrt() as usize;
        let edge = edge.clamp(1, MOST_EDGE);
        let count = PLACES * PLACES * edge * edge;
        Self { edge, lines: vec![lines as f64 / count as f64; count], sums: Vec::new() }
    }

    /// How many they are.
    pub(super) fn count(&self) -> usize {
        self.lines.len()
    }

    /// The cell of a place and of a direction, both on unit squares.
    pub(super) fn at(&self, place: [f32; 2], square: [f32; 2]) -> u32 {
        let along = |at: f32, cells: usize| ((at * cells as f32) as usize).min(cells - 1);
        let place = along(place[1], PLACES) * PLACES + along(place[0], PLACES);
        let direction = along(square[1], self.edge) * self.edge + along(square[0], self.edge);
        (place * self.edge * self.edge + direction) as u32
    }

    /// The cell of line `i` of `count`, spread systematically over what is due; and a place and a direction in it
    /// for uniform numbers.
    pub(super) fn draw(&self, i: u64, count: u64, uniform: [f32; 4]) -> (u32, [f32; 2], [f32; 2]) {
        let total = u128::from(self.sums.last().copied().unwrap_or(1));
        let at = ((2 * u128::from(i) + 1) * total / (2 * u128::from(count.max(1)))) as u64;
        let cell = self.sums.partition_point(|&sum| sum <= at).min(self.lines.len() - 1);
        let (place, direction) = (cell / (self.edge * self.edge), cell % (self.edge * self.edge));
        let along = |cell: usize, u: f32, cells: usize| {
            // Rounding may reach the next cell's edge, and 1.
            ((cell as f32 + u) / cells as f32).min(1.0 - f32::EPSILON / 2.0)
        };
        let [a, b, c, d] = uniform;
        (
            cell as u32,
            [along(place % PLACES, a, PLACES), along(place / PLACES, b, PLACES)],
            [along(direction % self.edge, c, self.edge), along(direction / self.edge, d, self.edge)],
        )
    }

    /// Divides the next round, of this many lines, by the points that each cell's photons scored: in proportion to points a
    /// line. Without any, evenly.
    pub(super) fn divide(&mut self, points: &[u64], next: u64) {
        let due: Vec<f64> =
            points.iter().zip(&self.lines).map(|(&points, &lines)| points as f64 / (lines + 1.0)).collect();
        let mean = due.iter().sum::<f64>() / due.len() as f64;
        let held = |due: f64| if mean > 0.0 { (due / mean).clamp(LEAST_TIMES, MOST_TIMES) } else { 1.0 };
        let mut sum = 0;
        self.sums = due
            .iter()
            .map(|&due| {
                sum += (held(due) * f64::from(1 << 16)) as u64;
                sum
            })
            .collect();
        let mut before = 0;
        for (lines, &sum_to) in self.lines.iter_mut().zip(&self.sums) {
            *lines += next as f64 * (sum_to - before) as f64 / sum as f64;
            before = sum_to;
        }
    }
}

/// The square mapped to the disc, areas in proportion: Shirley and Chiu, "A Low Distortion Map Between Disk and
/// Square" (1997).
pub(super) fn disc([a, b]: [f32; 2]) -> [f32; 2] {
    let (u, v) = (2.0 * a - 1.0, 2.0 * b - 1.0);
    if u == 0.0 && v == 0.0 {
        return [0.0; 2];
    }
    let (radius, angle) =
        if u.abs() > v.abs() { (u, FRAC_PI_4 * (v / u)) } else { (v, FRAC_PI_2 - FRAC_PI_4 * (u / v)) };
    [radius * angle.cos(), radius * angle.sin()]
}

/// The way back, from a radius and an angle of 0 to 2 pi.
pub(super) fn square(radius: f32, angle: f32) -> [f32; 2] {
    let turned = if angle > TAU - FRAC_PI_4 { angle - TAU } else { angle };
    let quarter = (turned / FRAC_PI_2 + 0.5) as usize;
    let off = radius * ((turned - quarter as f32 * FRAC_PI_2) / FRAC_PI_4);
    let [u, v] = match quarter {
        0 => [radius, off],
        1 => [-off, radius],
        2 => [-radius, -off],
        _ => [off, -radius],
    };
    [0.5 * (u + 1.0), 0.5 * (v + 1.0)].map(|at| at.clamp(0.0, 1.0))
}

/// The points of each cell of a light, from all its photons so far. `cells` are those of the photons.
pub(super) fn score(
    shower: &Shower<'_>,
    scene: &Scene,
    store: &PhotonStore,
    cells: [&[u32]; 2],
    photons: [&[Range<usize>]; 2],
    count: usize,
) -> Vec<u64> {
    let sorted = Sorted::new(photons, &store.light, &store.occlusion);
    let Ok(map) = PhotonMap::new(&sorted.blocks, &sorted.splits) else { return vec![0; count] };
    let many: usize = photons.iter().flat_map(|ranges| ranges.iter()).map(Range::len).sum();
    let radius = super::reach(LOOK, scene_area(scene), many);
    // In the order of the map neighbours are near each other, so these are spread over the scene.
    let ids = sorted.blocks.iter().flat_map(|block| block.ids).filter(|&id| id != PhotonId::NONE);
    let ids: Vec<PhotonId> = ids.step_by(many.div_ceil(ENOUGH * count).max(1)).collect();
    let points: Vec<AtomicU64> = (0..count).map(|_| AtomicU64::new(0)).collect();
    ids.par_chunks(CHUNK).for_each(|ids| {
        dispatch(shower.level, Judge { scene, store, map, ids, radius, cells, points: &points });
    });
    points.into_iter().map(AtomicU64::into_inner).collect()
}

/// The area of all triangles.
pub(crate) fn scene_area(scene: &Scene) -> f64 {
    let area = |triangle: u32| {
        let [a, b, c] = scene.vertices(triangle).map(|v| v.as_dvec3());
        0.5 * (b - a).cross(c - a).length()
    };
    (0..scene.triangles.len() as u32).map(area).sum()
}

/// Judges some photons by their neighbours.
struct Judge<'a> {
    scene: &'a Scene,
    store: &'a PhotonStore,
    map: PhotonMap<'a>,
    ids: &'a [PhotonId],
    radius: f32,
    cells: [&'a [u32]; 2],
    points: &'a [AtomicU64],
}

impl Task for Judge<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { scene, store, map, ids, radius, cells, points } = self;
        let map = map.on(simd);
        let mut slots = vec![Neighbour::NONE; Nearest::room(LOOK)];
        let mut nearest = Nearest::new(LOOK, &mut slots).expect("room for all");
        let mut names = Vec::new();
        for &id in ids {
            let place = store.place(scene, id, radius);
            map.nearest(&place, &mut nearest);
            let points_here = points_of(store, nearest.found(), &mut names);
            if points_here > 0 {
                let cell = cells[usize::from(!id.is_light())][id.index()];
                points[cell as usize].fetch_add(points_here, Ordering::Relaxed);
            }
        }
    }
}

/// What a photon with these neighbours is worth.
///
/// Among neighbours of both kinds a shadow begins or ends. There a blocker that only one of them names is likely not the
/// last: after Good and Turing, the chance that the next photon brings a new name is about the number of names met
/// once, over that of photons. Where all are dark or all are lit no list is asked.
fn points_of(store: &PhotonStore, found: &[Neighbour], names: &mut Vec<u32>) -> u64 {
    let light = found.iter().filter(|neighbour| neighbour.id().is_light()).count();
    let dark = found.len() - light;
    if light == 0 || dark == 0 {
        return 0;
    }
    names.clear();
    for neighbour in found {
        if !neighbour.id().is_light() {
            names.extend_from_slice(store.named(&store.occlusion[neighbour.id().index()]));
        }
    }
    names.sort_unstable();
    let single = names.chunk_by(|a, b| a == b).filter(|same| same.len() == 1).count();
    MIXED + MIXED * single.min(dark) as u64 / dark as u64
}

impl PhotonStore {
    /// Around a photon, along the surface it lies on.
    pub(crate) fn place(&self, scene: &Scene, id: PhotonId, radius: f32) -> Place {
        let x = self.position(id);
        match normal(scene, self.surface(id)) {
            Some(normal) => Place::disc(x, normal, radius, crate::integrator::FLATNESS),
            None => Place::ball(x, radius),
        }
    }
}

/// The unit normal of a triangle, if it has one.
pub(crate) fn normal(scene: &Scene, triangle: u32) -> Option<Vec3> {
    let [a, b, c] = scene.vertices(triangle);
    (b - a).as_dvec3().cross((c - a).as_dvec3()).try_normalize().map(|normal| normal.as_vec3())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampler::Sampler;

    #[test]
    fn disc_and_square_are_inverse() {
        let mut random = Sampler::from_key(1);
        for _ in 0..10_000 {
            let at = [random.uniform(), random.uniform()];
            let [x, y] = disc(at);
            let angle = y.atan2(x);
            let back = square(x.hypot(y), if angle < 0.0 { angle + TAU } else { angle });
            assert!((back[0] - at[0]).abs() < 1e-5 && (back[1] - at[1]).abs() < 1e-5, "{at:?} {back:?}");
        }
    }

    /// A cell gets its due to within a line, and the line is inside it.
    #[test]
    fn lines_are_drawn_where_they_are_due() {
        let mut cells = Cells::new(20_000);
        assert_eq!(cells.edge, 25);
        let count = cells.lines.len();
        let points: Vec<u64> = (0..count as u64).map(|i| i % 7 * 100).collect();
        let before = cells.lines.clone();
        cells.divide(&points, 10_000);
        let mut random = Sampler::from_key(2);
        let mut drawn = vec![0.0; count];
        for i in 0..10_000 {
            let uniform = [0; 4].map(|_| random.uniform());
            let (cell, place, direction) = cells.draw(i, 10_000, uniform);
            assert_eq!(cells.at(place, direction), cell);
            drawn[cell as usize] += 1.0;
        }
        for cell in 0..count {
            let due = cells.lines[cell] - before[cell];
            assert!((drawn[cell] - due).abs() <= 1.0, "{cell}: {} of {due}", drawn[cell]);
        }
        assert!(drawn[6] > 3.0 * drawn[1]);
        cells.divide(&vec![0; count], 1);
        assert_eq!(cells.sums[count - 1], count as u64 * cells.sums[0], "evenly");
    }
}
