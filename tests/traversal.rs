//! Every query of the tree, at every width, against a loop over all triangles.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_kernel::{
    BatchScratch, Bvh, Counts, Hit, Node, Ray, RayPacket, Targets, TilePoint, TileScratch, TriangleBlock,
};
use occlude_tests::{Family, On, Oracle, Random, Triangle, all_bits, bits, families, meshes, single_node};
use proptest::prelude::*;
use std::ops::ControlFlow;

/// Triangles, their tree and the loop over them.
struct Case {
    triangles: Vec<Triangle>,
    accel: Accel,
    oracle: Oracle,
}

impl Case {
    fn new(triangles: Vec<Triangle>) -> Self {
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        let oracle = Oracle::new(&triangles);
        Self { triangles, accel, oracle }
    }

    /// Asks every query of every family about up to 16 rays.
    fn check(&self, rays: &[Ray], ignore: Option<u32>) {
        let want: Vec<Vec<Hit>> = rays
            .iter()
            .map(|ray| {
                let hits = self.oracle.hits(ray, None);
                hits.into_iter().filter(|hit| Some(hit.triangle) != ignore).collect()
            })
            .collect();
        for on in families(self.accel.bvh()) {
            for (ray, want) in rays.iter().zip(&want) {
                check_single(&on, ray, ignore, want);
            }
            check_packet(&on, rays, ignore, &want);
        }
    }

    /// Asks about segments from one point, as a batch.
    fn check_batch(&self, x: Vec3, ends: &[Vec3], ignore: Option<u32>) {
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let targets = Targets::new(&xs, &ys, &zs).expect("of one length");
        assert_eq!(targets.len(), ends.len());
        let want: Vec<bool> = ends
            .iter()
            .map(|&end| {
                self.oracle.hits(&Ray::segment(x, end), ignore).iter().any(|hit| Some(hit.triangle) != ignore)
            })
            .collect();
        for on in families(self.accel.bvh()) {
            let words = ends.len().div_ceil(64);
            let mut blocked = vec![0xdead_beef_dead_beef; words + 1];
            let mut counts = Counts::default();
            on.occluded_batch(
                x.into(),
                &targets,
                ignore,
                &mut counts,
                &mut BatchScratch::new(),
                &mut blocked,
            );
            for (i, want) in want.iter().enumerate() {
                let found = blocked[i / 64] >> (i % 64) & 1 != 0;
                assert_eq!(found, *want, "{}: target {i} of {x} to {}", on.family, ends[i]);
            }
            if !ends.len().is_multiple_of(64) {
                assert_eq!(blocked[words - 1] >> (ends.len() % 64), 0, "bits beyond the targets are 0");
            }
            assert_eq!(blocked[words], 0xdead_beef_dead_beef, "words beyond the last are left alone");
            assert_eq!(counts.rays, ends.len() as u64);
        }
    }

    /// Asks about segments from several points, as a tile, with and without a plane said to hold the targets.
    fn check_tile(&self, points: &[(Vec3, Vec<Vec3>)], ignore: Option<u32>) {
        let ends: Vec<Vec3> = points.iter().flat_map(|point| point.1.iter().copied()).collect();
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let any = Targets::new(&xs, &ys, &zs).expect("of one length");
        let some = |i: usize| ends.get(i).copied().unwrap_or(Vec3::ONE);
        let flat = any.on_parallelogram(some(0), some(1) - some(0), some(2) - some(0));
        let mut first = 0;
        let askers: Vec<TilePoint> = points
            .iter()
            .map(|(x, ends)| {
                first += ends.len() as u32;
                TilePoint { x: x.to_array(), first: first - ends.len() as u32, count: ends.len() as u32 }
            })
            .collect();
        let want: Vec<bool> = points
            .iter()
            .flat_map(|(x, ends)| ends.iter().map(|&end| Ray::segment(*x, end)))
            .map(|ray| self.oracle.hits(&ray, ignore).iter().any(|hit| Some(hit.triangle) != ignore))
            .collect();
        let mut scratch = TileScratch::new();
        for on in families(self.accel.bvh()) {
            for targets in [any, flat] {
                let mut blocked = vec![0xdead_beef_dead_beef; ends.len() / 64 + 2];
                let mut counts = Counts::default();
                on.occluded_tile(&askers, &targets, ignore, &mut counts, &mut scratch, &mut blocked);
                for (i, want) in want.iter().enumerate() {
                    let found = blocked[i / 64] >> (i % 64) & 1 != 0;
                    assert_eq!(found, *want, "{}: target {i}, {points:?}", on.family);
                }
                let beyond = ends.len() % 64;
                assert_eq!(blocked[ends.len() / 64] >> beyond, 0xdead_beef_dead_beef >> beyond, "left alone");
                assert_eq!(counts.rays, ends.len() as u64);
            }
        }
    }

    /// A ray among the triangles: to a point of one, to a vertex, along an edge's middle, or anywhere.
    fn ray(&self, random: &mut Random) -> Ray {
        let any = |random: &mut Random| self.triangles[random.below(self.triangles.len())];
        let span = self.span();
        let x = any(random)[0] + random.point() * span;
        let triangle = any(random);
        let y = match random.below(6) {
            0 => triangle[random.below(3)],
            1 => triangle[0].lerp(triangle[1], 0.5),
            2 | 3 => random.on_triangle(&triangle),
            _ => any(random)[1] + random.point() * span,
        };
        match random.below(6) {
            0 => Ray::segment(x, y),
            1 => Ray::segment(x, x + (y - x) * 2.0),
            2 => Ray::from(x, random.direction() * random.any_scale(-4.0, 4.0)),
            3 => {
                let mut direction = Vec3::ZERO;
                direction[random.below(3)] = random.any_scale(-1.0, 1.0);
                Ray::from(Vec3::select(direction.cmpeq(Vec3::ZERO), y, x), direction)
            }
            4 => Ray::new(x, y - x, random.between(-2.0, 1.0), random.between(0.5, 3.0)),
            _ => Ray::from(x, y - x),
        }
    }

    fn span(&self) -> f32 {
        let (lower, upper) = occlude_tests::bounds(self.triangles.iter().flatten().copied());
        (upper - lower).max_element().max(f32::MIN_POSITIVE)
    }

    /// Random rays, in packets of any directions, and batches of any length.
    fn check_random(&self, random: &mut Random, packets: usize) {
        for _ in 0..packets {
            let rays: Vec<Ray> = (0..16).map(|_| self.ray(random)).collect();
            let ignore = (random.below(3) == 0).then(|| random.below(self.triangles.len()) as u32);
            self.check(&rays, ignore);
            let count = random.below(40);
            let ends: Vec<Vec3> = (0..count).map(|_| self.ray(random).at(1.0)).collect();
            self.check_batch(rays[0].origin, &ends, ignore);
            // Points near each other, or not; targets on a parallelogram, or not.
            let (near, flat) = (random.bits() & 1 == 0, random.bits() & 1 == 0);
            let (corner, u, v) = (self.ray(random).at(1.0), random.point(), random.point());
            let (parts, span) = (1 + random.below(9), self.span());
            let points: Vec<(Vec3, Vec<Vec3>)> = (0..parts)
                .map(|_| {
                    let x = if near {
                        rays[1].origin + random.point() * (1e-2 * span)
                    } else {
                        self.ray(random).origin
                    };
                    let end = |random: &mut Random| match flat {
                        true => corner + (u * random.between(0.0, 1.0) + v * random.between(0.0, 1.0)) * span,
                        false => self.ray(random).at(1.0),
                    };
                    let count = random.below(20);
                    (x, (0..count).map(|_| end(random)).collect())
                })
                .collect();
            self.check_tile(&points, ignore);
        }
    }
}

fn check_single(on: &On<'_>, ray: &Ray, ignore: Option<u32>, want: &[Hit]) {
    let width = on.family;
    let mut counts = Counts::default();
    assert_eq!(on.occluded(ray, ignore, &mut counts), !want.is_empty(), "{width}: {ray:?}");
    let occluder = on.occluder(ray, ignore, &mut counts);
    assert_eq!(occluder.is_some(), !want.is_empty(), "{width}: {ray:?}");
    assert!(occluder.is_none_or(|id| want.iter().any(|hit| hit.triangle == id)), "{width}: {ray:?}");
    let closest = on.closest(ray, ignore, &mut counts);
    assert_eq!(closest.as_ref().map(bits), want.first().map(bits), "{width}: {ray:?}");
    assert_eq!(all_bits(&on.hits(ray, ignore)), all_bits(want), "{width}: {ray:?}");
    assert_eq!(all_bits(&on.hits_in_order(ray, ignore)), all_bits(want), "{width}: {ray:?}");
    assert_eq!(counts.rays, 3);
}

/// As a packet: all of them, then with every third lane inactive and full of garbage.
fn check_packet(on: &On<'_>, rays: &[Ray], ignore: Option<u32>, want: &[Vec<Hit>]) {
    let width = on.family;
    let garbage = Ray::new([f32::NAN; 3], [f32::NAN, f32::INFINITY, 1.0], f32::NAN, f32::NAN);
    for hole in [usize::MAX, 0, 1, 2] {
        let mut packet = RayPacket::new(rays);
        let mut active = 0u32;
        for place in 0..RayPacket::WIDTH {
            if place % 3 == hole || place >= rays.len() {
                packet.set(place, &garbage);
            } else {
                active |= 1 << place;
            }
        }
        let mut counts = Counts::default();
        let blocked = on.occluded_packet(&packet, active, ignore, &mut counts);
        let occluders = on.occluder_packet(&packet, active, ignore, &mut counts);
        let closest = on.closest_packet(&packet, active, ignore, &mut counts);
        let each = on.hits_packet(&packet, active, ignore);
        assert_eq!(counts.rays, 3 * u64::from(active.count_ones()), "{width}");
        for place in 0..RayPacket::WIDTH {
            let nothing = Vec::new();
            let want = if active >> place & 1 != 0 { &want[place] } else { &nothing };
            let ray = packet.get(place);
            assert_eq!(blocked >> place & 1 != 0, !want.is_empty(), "{width}: {ray:?}");
            assert_eq!(occluders[place].is_some(), !want.is_empty(), "{width}: {ray:?}");
            assert!(occluders[place].is_none_or(|id| want.iter().any(|hit| hit.triangle == id)), "{width}");
            let found = (closest.hit >> place & 1 != 0).then_some(&closest.hits[place]);
            assert_eq!(found.map(bits), want.first().map(bits), "{width}: {ray:?}");
            assert_eq!(all_bits(&each[place]), all_bits(want), "{width}: {ray:?}");
        }
    }
}

#[test]
fn soups() {
    let mut random = Random::new(21);
    for (count, size) in [(1, 1.0), (7, 1.0), (8, 0.5), (9, 0.5), (65, 0.3), (1000, 0.1), (3000, 0.5)] {
        Case::new(meshes::soup(&mut random, count, size)).check_random(&mut random, 40);
    }
}

#[test]
fn every_scale_and_place() {
    let mut random = Random::new(22);
    for scale in [1e-4, 1e-2, 1.0, 1e3, 1e5] {
        for shift in [0.0, 10.0, 1000.0] {
            let shift = random.direction() * shift * scale;
            let soup = meshes::soup(&mut random, 200, 0.3);
            Case::new(meshes::moved(&soup, scale, shift)).check_random(&mut random, 15);
        }
    }
}

/// Any tree, larger or smaller by a power of 2: nothing is rounded by that.
fn scaled(accel: &Accel, by: f32) -> (Vec<Node>, Vec<TriangleBlock>) {
    let bvh = accel.bvh();
    let (mut nodes, mut blocks) = (bvh.nodes().to_vec(), bvh.blocks().to_vec());
    nodes
        .iter_mut()
        .flat_map(|node| node.bounds.as_flattened_mut().as_flattened_mut())
        .for_each(|at| *at *= by);
    let vertices = blocks.iter_mut().flat_map(|block| block.vertices.as_flattened_mut().as_flattened_mut());
    vertices.for_each(|at| *at *= by);
    (nodes, blocks)
}

/// What a query says of rays: hits as bits, and what is blocked.
type Answers = (String, Vec<Option<[u32; 4]>>, Vec<bool>);

/// What every query of every family says of a tile at a scale.
fn at_scale(accel: &Accel, scale: i32, points: &[Vec3], ends: &[Vec3], light: [Vec3; 3]) -> Vec<Answers> {
    let by = 2f32.powi(scale);
    let (nodes, blocks) = scaled(accel, by);
    let bvh = Bvh::new(&nodes, &blocks).expect("within the limit");
    let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis] * by).collect::<Vec<f32>>());
    let any = Targets::new(&xs, &ys, &zs).expect("of one length");
    let [corner, u, v] = light.map(|at| at * by);
    let each = ends.len() / points.len();
    let counts = &mut Counts::default();
    let rays: Vec<Ray> = (0..ends.len()).map(|i| Ray::segment(points[i / each] * by, ends[i] * by)).collect();
    let mut answers = Vec::new();
    for on in families(bvh) {
        let hits =
            rays.iter().map(|ray| on.closest(ray, None, counts).map(|hit| bits(&hit))).collect::<Vec<_>>();
        let blocked = rays.iter().map(|ray| on.occluded(ray, None, counts)).collect();
        answers.push((format!("{}, single", on.family), hits, blocked));
        let (mut hits, mut blocked) = (Vec::new(), Vec::new());
        for rays in rays.chunks(16) {
            let (packet, active) = (RayPacket::new(rays), u32::MAX >> (32 - rays.len()));
            let found = on.closest_packet(&packet, active, None, counts);
            let any = on.occluded_packet(&packet, active, None, counts);
            for i in 0..rays.len() {
                hits.push((found.hit >> i & 1 != 0).then(|| bits(&found.hits[i])));
                blocked.push(any >> i & 1 != 0);
            }
        }
        answers.push((format!("{}, packet", on.family), hits.clone(), blocked));
        for (name, targets) in [("any", any), ("flat", any.on_parallelogram(corner, u, v))] {
            let mut blocked = Vec::new();
            for (k, &x) in points.iter().enumerate() {
                let [xs, ys, zs] = [&xs, &ys, &zs].map(|at| &at[k * each..(k + 1) * each]);
                let mut targets = Targets::new(xs, ys, zs).expect("of one length");
                if name == "flat" {
                    targets = targets.on_parallelogram(corner, u, v);
                }
                let (mut words, scratch) = ([0; 2], &mut BatchScratch::new());
                on.occluded_batch((x * by).into(), &targets, None, counts, scratch, &mut words);
                blocked.extend((0..each).map(|i| words[i / 64] >> (i % 64) & 1 != 0));
            }
            answers.push((format!("{}, batch, {name}", on.family), hits.clone(), blocked));
            let tile: Vec<TilePoint> = points
                .iter()
                .enumerate()
                .map(|(k, &x)| TilePoint { x: (x * by).into(), first: (k * each) as u32, count: each as u32 })
                .collect();
            let (mut words, scratch) = (vec![0; ends.len().div_ceil(64)], &mut TileScratch::new());
            on.occluded_tile(&tile, &targets, None, counts, scratch, &mut words);
            let blocked = (0..ends.len()).map(|i| words[i / 64] >> (i % 64) & 1 != 0).collect();
            answers.push((format!("{}, tile, {name}", on.family), hits.clone(), blocked));
        }
    }
    answers
}

#[test]
fn every_query_says_the_same_at_every_scale() {
    let mut random = Random::new(31);
    let largest = Bvh::MAX_COORDINATE.log2() as i32 - 3;
    let mut total = [0, 0];
    for trial in 0..60 {
        let away = random.direction() * random.between(1.0, 3.0);
        let (u, v) = away.normalize().any_orthonormal_pair();
        let size = random.any_scale(-1.5, 0.0).abs();
        let (u, v) = (u * size, v * size);
        let count = [0, 8, 100][random.below(3)];
        let mut triangles: Vec<Triangle> = (0..count)
            .map(|_| {
                let (middle, wide) =
                    (away * random.unit() + random.point(), random.any_scale(-2.0, 0.0).abs());
                [middle, middle + random.point() * wide, middle + random.point() * wide]
            })
            .collect();
        // A square hides all of the light, half of it, or nothing.
        let middle = (away + (u + v) * 0.5) * 0.5 + u * (random.below(3) as f32 / size);
        let [a, b, c, d] = [-u - v, u - v, u + v, v - u].map(|at| middle + at / size);
        triangles.extend([[a, b, c], [a, c, d]]);
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        let each = [1, 4, 16, 64][random.below(4)];
        let points: Vec<Vec3> = (0..64)
            .map(|k| (u * (k % 8) as f32 + v * (k / 8) as f32) * 0.02 + random.point() * 1e-3)
            .collect();
        let ends: Vec<Vec3> = (0..64 * each).map(|_| away + u * random.unit() + v * random.unit()).collect();
        let want = at_scale(&accel, 0, &points, &ends, [away, u, v]);
        want[0].2.iter().for_each(|&blocked| total[usize::from(blocked)] += 1);
        want.iter().for_each(|(query, _, blocked)| assert_eq!(*blocked, want[0].2, "{query}, trial {trial}"));
        for scale in [-33, -30, -20, -10, 10, 20, largest] {
            let got = at_scale(&accel, scale, &points, &ends, [away, u, v]);
            for (want, got) in want.iter().zip(&got) {
                assert_eq!(want.0, got.0);
                let differ = want.1.iter().zip(&got.1).filter(|(a, b)| a != b).count();
                let other = want.2.iter().zip(&got.2).filter(|(a, b)| a != b).count();
                assert!(
                    differ + other == 0,
                    "{}, trial {trial}, scale {scale}: {differ} hits, {other} answers",
                    want.0
                );
            }
        }
    }
    assert!(total.iter().all(|&rays| rays > 10_000), "{total:?}");
}

#[test]
fn slivers() {
    let mut random = Random::new(23);
    Case::new(meshes::slivers(&mut random, 500)).check_random(&mut random, 60);
}

#[test]
fn closed_meshes() {
    let mut random = Random::new(24);
    for mesh in [
        meshes::icosphere(3),
        meshes::globe(4, 300),
        meshes::torus(0.3, 40, 20),
        meshes::sponge(0),
        meshes::sponge(2),
    ] {
        let turn = meshes::rotation(&mut random);
        Case::new(mesh.triangles(|vertex| vertex.as_vec3())).check_random(&mut random, 20);
        Case::new(mesh.triangles(|vertex| turn * vertex.as_vec3())).check_random(&mut random, 20);
    }
}

#[test]
fn rays_within_a_tessellated_plane() {
    // Every triangle in line with the ray is seen edge-on; only those it passes may answer.
    const CELLS: usize = 16;
    let mut random = Random::new(30);
    for _ in 0..10 {
        let (turn, shift) = (meshes::rotation(&mut random), random.point());
        let at = |i: usize, j: usize| {
            turn * Vec3::new(i as f32 / CELLS as f32 - 0.5, j as f32 / CELLS as f32 - 0.5, 0.0) + shift
        };
        let triangles: Vec<Triangle> = (0..CELLS * CELLS)
            .flat_map(|cell| {
                let (i, j) = (cell / CELLS, cell % CELLS);
                let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        let case = Case::new(triangles);
        for tilt in [0.0, 1e-8, 1e-7, 1e-6, 1e-5, 1e-3] {
            let rays: Vec<Ray> = (0..16)
                .map(|_| {
                    let along = random.direction() * Vec3::new(1.0, 1.0, 0.0);
                    let direction = turn * (along.normalize() + Vec3::Z * tilt);
                    let triangle = case.triangles[random.below(case.triangles.len())];
                    let target = random.on_triangle(&triangle);
                    Ray::from(target - direction * random.unit(), direction)
                })
                .collect();
            for ray in &rays {
                for on in families(case.accel.bvh()) {
                    let want = case.oracle.hits(ray, None);
                    assert_eq!(all_bits(&on.hits(ray, None)), all_bits(&want), "{}: {ray:?}", on.family);
                    // A row of cells and of diagonals, and the neighbours on both sides of a line of the grid.
                    assert!(want.len() < 8 * CELLS, "{}: {ray:?}", want.len());
                }
            }
        }
    }
}

#[test]
fn empty_scene() {
    let case = Case::new(Vec::new());
    case.check(&[Ray::from([0.0; 3], Vec3::Z); 16], None);
    case.check(&[], None);
    case.check_batch(Vec3::ZERO, &[Vec3::Z; 20], None);
    assert_eq!(case.accel.bvh().clearance(), 0.0);
}

#[test]
fn one_triangle() {
    let mut random = Random::new(25);
    let case = Case::new(vec![[Vec3::ZERO, Vec3::X, Vec3::Y]]);
    case.check_random(&mut random, 50);
    let ray = Ray::from([0.2, 0.2, -1.0], Vec3::Z);
    case.check(&[ray], Some(0));
    case.check(&[ray], Some(1));
    assert!(case.accel.bvh().occluded(&ray, None, &mut Counts::default()));
    assert!(!case.accel.bvh().occluded(&ray, Some(0), &mut Counts::default()));
}

#[test]
fn identical_triangles() {
    const COUNT: u32 = 50_000;
    let triangle = [Vec3::new(-1.0, -1.0, 2.0), Vec3::new(1.0, -1.0, 2.0), Vec3::new(0.0, 1.0, 2.0)];
    let accel = Accel::from_triangles(&vec![triangle; COUNT as usize], Quality::Fast);
    let ray = Ray::from([0.0; 3], Vec3::Z);
    for on in families(accel.bvh()) {
        // All lie at the same t, so the lowest number is nearest.
        let mut counts = Counts::default();
        assert_eq!(on.closest(&ray, None, &mut counts).map(|hit| hit.triangle), Some(0));
        assert_eq!(on.closest(&ray, Some(0), &mut counts).map(|hit| hit.triangle), Some(1));
        assert!(on.occluded(&ray, Some(7), &mut counts));
        let numbers: Vec<u32> = on.hits(&ray, None).iter().map(|hit| hit.triangle).collect();
        assert_eq!(numbers, (0..COUNT).collect::<Vec<_>>());
        let packet = RayPacket::new(&[ray; 16]);
        let closest = on.closest_packet(&packet, 0xffff, Some(0), &mut counts);
        assert!(closest.hit == 0xffff && closest.hits.iter().all(|hit| hit.triangle == 1));
        let mut told = Vec::new();
        on.each_hit_in_order(&ray, Some(3), &mut counts, &mut |hit| {
            told.push(hit.triangle);
            if told.len() == 100 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert_eq!(told, (0..101).filter(|&id| id != 3).collect::<Vec<_>>());
    }
}

#[test]
fn ties_at_zero_of_either_sign() {
    // Both triangles hold the ray's origin: one is hit at 0, the other at -0.
    let ray = Ray::new([0.0; 3], [0.5, 0.5, 0.0], -0.5, 0.0);
    let minus = [Vec3::new(-1.0, -1.0, -1.0), Vec3::new(0.0, -1.0, -1.0), Vec3::ZERO];
    let plus = [Vec3::new(0.0, -1.0, -1.0), Vec3::new(0.0, 1.0, -1.0), Vec3::Z];
    for (triangles, negative) in [(vec![minus, plus], [true, false]), (vec![plus, minus], [false, true])] {
        let case = Case::new(triangles);
        let signs: Vec<bool> =
            case.oracle.hits(&ray, None).iter().map(|hit| hit.t.is_sign_negative()).collect();
        assert_eq!(signs, negative);
        case.check(&[ray; 16], None);
        case.check(&[ray; 16], Some(0));
    }
}

#[test]
fn collinear_triangles() {
    // All along a diagonal, so that any axis sorts them alike; each tilted a little.
    let mut random = Random::new(26);
    let triangles: Vec<Triangle> = (0..500)
        .map(|i| {
            let centre = Vec3::splat(i as f32 * 0.01);
            [0; 3].map(|_| centre + random.point() * 0.05)
        })
        .collect();
    let case = Case::new(triangles);
    case.check_random(&mut random, 40);
    // Down the line: hundreds of hits.
    let rays: Vec<Ray> =
        (0..16).map(|_| Ray::from(Vec3::splat(-1.0), Vec3::splat(1.0) + random.point() * 1e-4)).collect();
    case.check(&rays, None);
}

#[test]
fn degenerate_triangles() {
    let mut random = Random::new(27);
    let mut triangles = meshes::soup(&mut random, 100, 0.4);
    for (i, triangle) in triangles.iter_mut().enumerate() {
        match i % 4 {
            0 => triangle[1] = triangle[0],
            1 => triangle[2] = triangle[0].lerp(triangle[1], 0.5),
            2 => *triangle = [triangle[0]; 3],
            _ => (),
        }
    }
    Case::new(triangles).check_random(&mut random, 60);
}

#[test]
fn stacks_of_more_than_sixteen() {
    let triangles: Vec<Triangle> = (0..137)
        .map(|i| {
            // Pairs at the same height, so that ties come in the middle too.
            let z = (i * 31 % 137 / 2) as f32;
            [Vec3::new(-1.0, -1.0, z), Vec3::new(1.0, -1.0, z), Vec3::new(0.0, 1.0, z)]
        })
        .collect();
    let case = Case::new(triangles);
    let ray = Ray::from([0.01, 0.02, -1.0], Vec3::Z);
    assert_eq!(case.oracle.hits(&ray, None).len(), 137);
    case.check(&[ray, Ray { t_max: 16.5, ..ray }, Ray { t_min: 3.0, ..ray }], None);
    case.check(&[ray], Some(40));
}

#[test]
fn breaking_ends_the_query() {
    let triangles: Vec<Triangle> = (0..200)
        .map(|i| {
            let z = i as f32;
            [Vec3::new(-1.0, -1.0, z), Vec3::new(1.0, -1.0, z), Vec3::new(0.0, 1.0, z)]
        })
        .collect();
    let case = Case::new(triangles);
    let ray = Ray::from([0.0, 0.0, -1.0], Vec3::Z);
    for on in families(case.accel.bvh()) {
        let mut all = Counts::default();
        on.each_hit(&ray, None, &mut all, &mut |_| ControlFlow::Continue(()));
        for most in [1, 5, 16, 17, 40] {
            let (mut told, mut counts) = (0, Counts::default());
            on.each_hit(&ray, None, &mut counts, &mut |_| {
                told += 1;
                if told == most { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            });
            assert_eq!(told, most);
            assert!(counts.triangle_tests < all.triangle_tests);
            let mut told = Vec::new();
            on.each_hit_in_order(&ray, None, &mut counts, &mut |hit| {
                told.push(hit.triangle);
                if told.len() == most { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            });
            assert_eq!(told, (0..most as u32).collect::<Vec<_>>());
        }
        // Breaking for one ray of a packet leaves the others alone.
        let packet = RayPacket::new(&[ray; 16]);
        let mut told = [0; 16];
        on.each_hit_packet(&packet, 0xffff, None, &mut Counts::default(), &mut |ray, _| {
            told[ray] += 1;
            if ray == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!((0..16).all(|i| told[i] == if i == 3 { 1 } else { 200 }), "{}: {told:?}", on.family);
    }
}

#[test]
fn batches_of_every_length() {
    let mut random = Random::new(28);
    let case = Case::new(meshes::soup(&mut random, 60, 0.4));
    let ends: Vec<Vec3> = (0..256).map(|_| random.point() * 1.5).collect();
    for count in 0..=256 {
        case.check_batch(random.point(), &ends[..count], (count % 5 == 0).then_some(3));
    }
}

#[test]
fn batches_with_ends_that_are_nothing() {
    let mut random = Random::new(29);
    let case = Case::new(meshes::soup(&mut random, 60, 0.4));
    let mut ends: Vec<Vec3> = (0..64).map(|_| random.point() * 1.5).collect();
    let x = random.point();
    for (i, end) in ends.iter_mut().enumerate() {
        match i % 8 {
            0 => end.x = f32::NAN,
            1 => *end = x,
            2 => end.y = f32::INFINITY,
            3 => *end *= 1e-30,
            4 => *end *= 1e30,
            _ => (),
        }
    }
    case.check_batch(x, &ends, None);
    case.check_batch(Vec3::NAN, &ends, None);
    case.check_tile(&[(x, ends.clone()), (Vec3::NAN, ends.clone()), (x, ends.clone())], None);
    case.check_tile(&[], None);
}

#[test]
fn targets_must_match() {
    assert!(Targets::new(&[0.0], &[0.0], &[]).is_none());
    assert!(Targets::new(&[], &[], &[]).is_some_and(|targets| targets.is_empty()));
}

#[test]
fn counts_are_lanes_in_use() {
    // Two blocks, of eight and of two triangles, far apart; the ray meets the first only.
    let triangle =
        |x: f32, z: f32| [Vec3::new(x - 1.0, -1.0, z), Vec3::new(x + 1.0, -1.0, z), Vec3::new(x, 1.0, z)];
    let triangles: Vec<Triangle> =
        (0..10).map(|i| triangle(if i < 8 { 0.0 } else { 100.0 }, 1.0 + i as f32)).collect();
    let (nodes, blocks) = single_node(&triangles);
    let bvh = Bvh::new(&nodes, &blocks).unwrap();
    let (here, there) = (Ray::from([0.0; 3], Vec3::Z), Ray::from([100.0, 0.0, 0.0], Vec3::Z));
    let nowhere = Ray::from([0.0; 3], Vec3::ZERO);
    for on in families(bvh) {
        let counted = |ray: &Ray| {
            let mut counts = Counts::default();
            on.closest(ray, None, &mut counts);
            counts
        };
        assert_eq!(counted(&here), Counts { rays: 1, triangle_tests: 8, node_tests: 2 });
        assert_eq!(counted(&there), Counts { rays: 1, triangle_tests: 2, node_tests: 2 });
        assert_eq!(counted(&nowhere), Counts { rays: 1, triangle_tests: 0, node_tests: 0 });
        let mut counts = Counts::default();
        let packet = RayPacket::new(&[here, there, here, nowhere]);
        on.closest_packet(&packet, 0b1111, None, &mut counts);
        assert_eq!(counts, Counts { rays: 4, triangle_tests: 8 + 2 + 8, node_tests: 3 * 2 }, "{}", on.family);
        // So few rays go on one by one, and one ray tests a block at once.
        let mut counts = Counts::default();
        on.occluded_packet(&packet, 0b1111, None, &mut counts);
        assert_eq!(counts, Counts { rays: 4, triangle_tests: 8 + 2 + 8, node_tests: 3 * 2 }, "{}", on.family);
    }
    // In a packet that stays together only one triangle is needed to know that there is one.
    for on in families(bvh).into_iter().filter(|on| !matches!(on.family, Family::Scalar)) {
        let mut counts = Counts::default();
        let packet = RayPacket::new(&[here; 6]);
        on.occluded_packet(&packet, 0b11_1111, None, &mut counts);
        assert_eq!(counts, Counts { rays: 6, triangle_tests: 6, node_tests: 6 * 2 }, "{}", on.family);
    }
    let mut sum = Counts { rays: 1, triangle_tests: 2, node_tests: 3 };
    sum += sum;
    assert_eq!(sum, Counts { rays: 2, triangle_tests: 4, node_tests: 6 });
}

fn coordinate() -> impl Strategy<Value = f32> {
    // A coarse grid makes shared vertices, edge-on rays and ties common.
    prop_oneof![
        4 => (-4i8..=4).prop_map(|i| f32::from(i) * 0.5),
        4 => -2.0f32..2.0,
        1 => Just(0.0f32),
        1 => (-4i8..=4).prop_map(|i| f32::from(i) * 0.5 + 1e-6),
    ]
}

fn point() -> impl Strategy<Value = Vec3> {
    (coordinate(), coordinate(), coordinate()).prop_map(|(x, y, z)| Vec3::new(x, y, z))
}

fn ray() -> impl Strategy<Value = Ray> {
    let ends = prop_oneof![
        3 => Just((0.0, f32::INFINITY)),
        3 => Just((0.0, 1.0)),
        1 => (coordinate(), coordinate()),
    ];
    (point(), point(), ends).prop_map(|(x, y, (t_min, t_max))| Ray::new(x, y - x, t_min, t_max))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 800, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_small_scene(
        triangles in prop::collection::vec([point(), point(), point()], 0..40),
        rays in prop::collection::vec(ray(), 16),
        ends in prop::collection::vec(point(), 0..20),
        ignore in prop::option::of(0u32..40),
    ) {
        let case = Case::new(triangles);
        case.check(&rays, ignore);
        case.check_batch(rays[0].origin, &ends, ignore);
    }
}
