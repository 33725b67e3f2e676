//! Tiles of neighbouring points under a flat light: sheets that hide all of it, short lists, narrower shafts. Every
//! answer is that of a single ray.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_kernel::{BatchScratch, Counts, Ray, Targets, TilePoint, TileScratch, offset};
use occlude_tests::{Family, On, Random, families};

type Triangle = [Vec3; 3];

/// A parallelogram, skewed as it may be.
struct Light {
    corner: Vec3,
    u: Vec3,
    v: Vec3,
}

impl Light {
    fn at(&self, s: f32, t: f32) -> Vec3 {
        self.corner + self.u * s + self.v * t
    }
}

/// What stands between points around the origin and a light about `away` from it.
fn blockers(random: &mut Random, away: Vec3, size: f32) -> Vec<Triangle> {
    let mut triangles = Vec::new();
    let (across, along) = away.normalize().any_orthonormal_pair();
    for _ in 0..=random.below(3) {
        let middle = away * random.between(-0.05, 1.05);
        let wide = size * random.any_scale(-1.5, 0.7);
        match random.below(4) {
            // A sheet, flat or dented, in few or in many pieces.
            0 | 1 => {
                let pieces = 1 + random.below(5);
                let dent = if random.below(2) == 0 { 0.0 } else { random.between(0.0, 0.3) };
                let shift = random.point() * (wide * 0.8);
                let mut grid = Vec::new();
                for row in 0..=pieces {
                    for column in 0..=pieces {
                        let (x, y) = (column as f32 / pieces as f32 - 0.5, row as f32 / pieces as f32 - 0.5);
                        let bump = away * (dent * random.between(-0.3, 0.3));
                        grid.push(middle + shift + (across * x + along * y) * (2.0 * wide) + bump);
                    }
                }
                let at = |row: usize, column: usize| grid[row * (pieces + 1) + column];
                for row in 0..pieces {
                    for column in 0..pieces {
                        let [a, b] = [at(row, column), at(row, column + 1)];
                        let [c, d] = [at(row + 1, column + 1), at(row + 1, column)];
                        triangles.extend([[a, b, c], [a, c, d]]);
                    }
                }
            }
            // Slivers.
            2 => {
                for _ in 0..random.below(20) {
                    let a = middle + random.point() * wide;
                    let b = a + random.direction() * wide;
                    triangles.push([a, b, a.lerp(b, 0.5) + random.point() * (wide * 0.01)]);
                }
            }
            // Anything.
            _ => {
                for _ in 0..random.below(60) {
                    let a = middle + random.point() * wide;
                    triangles.push([a, a + random.point() * wide, a + random.point() * wide]);
                }
            }
        }
    }
    triangles
}

/// A tile and its light, and how many rays were blocked and free.
fn trial(random: &mut Random, each: usize) -> [usize; 2] {
    let scale = random.any_scale(-3.0, 3.0);
    let away = random.direction() * scale * random.between(0.5, 5.0);
    let size = scale * random.any_scale(-1.5, 0.3);
    let (u, v) = away.normalize().any_orthonormal_pair();
    let skew = random.between(-0.9, 0.9);
    let light = Light {
        corner: away - (u + v) * (0.5 * size),
        u: (u + random.point() * 0.5) * size,
        v: (v + u * skew + random.point() * 0.5) * (size * random.any_scale(-1.0, 0.5)),
    };
    let facing = light.u.cross(light.v).normalize_or_zero();
    let facing = if facing.dot(away) > 0.0 { -facing } else { facing };
    let place = random.point() * (scale * random.any_scale(-1.0, 3.0));
    let mut triangles = blockers(random, away, size);
    // The surface the points lie on, flat or round.
    let (a, b) = match random.below(4) {
        0 => [(Vec3::X, Vec3::Y), (Vec3::Y, Vec3::Z), (Vec3::Z, Vec3::X)][random.below(3)],
        _ => random.direction().any_orthonormal_pair(),
    };
    let spread = scale * random.any_scale(-3.0, 0.3);
    let round = if random.below(2) == 0 { 0.0 } else { random.between(0.0, 2.0) };
    let normal = if a.cross(b).dot(away) < 0.0 { b.cross(a) } else { a.cross(b) };
    let ground = |x: f32, y: f32| (a * x + b * y - normal * (round * (x * x + y * y))) * spread;
    for row in 0..4 {
        for column in 0..4 {
            let [x0, x1] = [column, column + 1].map(|k| k as f32 * 0.5 - 1.0);
            let [y0, y1] = [row, row + 1].map(|k| k as f32 * 0.5 - 1.0);
            let [p, q, r, s] = [ground(x0, y0), ground(x1, y0), ground(x1, y1), ground(x0, y1)];
            triangles.extend([[p, q, r], [p, r, s]]);
        }
    }
    // The light's own surface, and points that are not as far off theirs as they should be.
    if random.below(3) == 0 {
        let [p, q, r, s] = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|[s, t]| light.at(s, t));
        triangles.extend([[p, q, r], [p, r, s]]);
    }
    let height = [1.0, 1.0, 1.0, 0.3, 0.1, 0.0][random.below(6)];
    triangles.iter_mut().flatten().for_each(|vertex| *vertex += place);
    let accel = Accel::from_triangles(&triangles, Quality::Medium);
    let bvh = accel.bvh();
    let clearance = bvh.clearance();

    let edge = 8;
    let (mut points, mut ends) = (Vec::new(), Vec::new());
    let loose = if random.below(4) == 0 { 1e4 } else { 1.0 };
    for row in 0..edge {
        for column in 0..edge {
            let [x, y] = [column, row].map(|k| (k as f32 + random.unit()) / edge as f32 * 2.0 - 1.0);
            let x = offset(ground(x, y) + place, normal, clearance * height);
            points.push(TilePoint { x: x.into(), first: ends.len() as u32, count: each as u32 });
            for _ in 0..each {
                let y = light.at(random.unit(), random.unit()) + place;
                ends.push(offset(
                    y,
                    facing,
                    clearance * if loose > 1.0 { loose * random.unit() } else { 1.0 },
                ));
            }
        }
    }
    let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
    let any = Targets::new(&xs, &ys, &zs).expect("of one length");
    let flat = any.on_parallelogram(light.corner + place, light.u, light.v);
    let single = On { bvh, family: Family::Scalar };
    let mut want = vec![0u64; ends.len().div_ceil(64)];
    for point in &points {
        for i in point.first as usize..(point.first + point.count) as usize {
            let ray = Ray::segment(point.x, ends[i]);
            let hit = single.occluded(&ray, None, &mut Counts::default());
            want[i / 64] |= u64::from(hit) << (i % 64);
        }
    }
    let mut scratch = TileScratch::new();
    for on in families(bvh) {
        for targets in [any, flat] {
            let mut blocked = vec![0; want.len()];
            let mut counts = Counts::default();
            on.occluded_tile(&points, &targets, None, &mut counts, &mut scratch, &mut blocked);
            assert_eq!(counts.rays, ends.len() as u64);
            let differ: u32 = want.iter().zip(&blocked).map(|(a, b)| (a ^ b).count_ones()).sum();
            assert!(
                differ == 0,
                "{}: {differ} of {} rays, {each} each, {triangles:?}",
                on.family,
                ends.len()
            );
        }
    }
    let hits = want.iter().map(|word| word.count_ones() as usize).sum();
    [hits, ends.len() - hits]
}

#[test]
fn tiles_answer_as_single_rays_do() {
    let mut random = Random::new(20);
    for (each, trials) in [(1, 600), (4, 400), (16, 300), (64, 150), (100, 20)] {
        let mut total = [0, 0];
        let mut whole = 0;
        for _ in 0..trials {
            let [blocked, free] = trial(&mut random, each);
            whole += usize::from(blocked == 0 || free == 0);
            total = [total[0] + blocked, total[1] + free];
        }
        // Scenes where everything or nothing is hidden, and others, in numbers.
        assert!(total.iter().all(|&rays| rays > 20 * each * trials), "{each} rays a point: {total:?}");
        assert!(whole > trials / 20 && whole < trials * 19 / 20, "{each} rays a point: {whole} of {trials}");
    }
}

/// Much in the way of a light that is larger than the tile, and runs of points with many targets, with one and with none.
#[test]
fn rays_that_are_sorted_and_rays_that_are_not() {
    let mut random = Random::new(23);
    let triangles: Vec<Triangle> = (0..3000)
        .map(|_| {
            let a = Vec3::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0), random.between(0.2, 1.8));
            [a, a + random.direction() * 0.05, a + random.direction() * 0.05]
        })
        .collect();
    let accel = Accel::from_triangles(&triangles, Quality::Fast);
    let single = On { bvh: accel.bvh(), family: Family::Scalar };
    let corner = Vec3::new(-0.6, -0.6, 2.0);
    let (u, v) = (Vec3::X * 1.2, Vec3::Y * 1.2);
    let mut scratch = TileScratch::new();
    let mut total = [0, 0];
    for trial in 0..40 {
        let (mut points, mut ends) = (Vec::new(), Vec::new());
        while points.len() < 100 {
            let each =
                [0, 1, 8, 16, 64, 70][if trial % 2 == 0 { random.below(6) } else { points.len() / 20 % 6 }];
            for _ in 0..1 + random.below(40) {
                let x = (Vec3::X * random.unit() + Vec3::Y * random.unit()) * 0.02;
                points.push(TilePoint { x: x.to_array(), first: ends.len() as u32, count: each as u32 });
                ends.extend((0..each).map(|_| corner + u * random.unit() + v * random.unit()));
            }
        }
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let any = Targets::new(&xs, &ys, &zs).expect("of one length");
        let mut want = vec![0u64; ends.len().div_ceil(64)];
        for point in &points {
            for i in point.first as usize..(point.first + point.count) as usize {
                let hit = single.occluded(&Ray::segment(point.x, ends[i]), None, &mut Counts::default());
                want[i / 64] |= u64::from(hit) << (i % 64);
                total[usize::from(hit)] += 1;
            }
        }
        for on in families(accel.bvh()) {
            for targets in [any, any.on_parallelogram(corner, u, v)] {
                let mut blocked = vec![0; want.len()];
                let mut counts = Counts::default();
                on.occluded_tile(&points, &targets, None, &mut counts, &mut scratch, &mut blocked);
                assert_eq!(counts.rays, ends.len() as u64, "{}, trial {trial}", on.family);
                assert_eq!(blocked, want, "{}, trial {trial}", on.family);
            }
        }
    }
    assert!(total.iter().all(|&rays| rays > 10_000), "{total:?}");
}

/// A ceiling with holes under a large light, amid confetti: too much for a list, and no sheet hides all.
#[test]
fn parts_of_a_large_light_behind_a_ceiling() {
    let mut random = Random::new(31);
    let corner = Vec3::new(-1.0, -1.0, 2.0);
    let (u, v) = (Vec3::X * 2.0, Vec3::Y * 2.0);
    let mut scratch = TileScratch::new();
    let (mut total, mut nodes) = ([0, 0], [0, 0]);
    for trial in 0..24 {
        let mut triangles: Vec<Triangle> = (0..200)
            .map(|_| {
                let at = [random.between(-1.0, 1.0), random.between(-1.0, 1.0), random.between(0.2, 1.8)];
                [Vec3::from(at); 3].map(|corner| corner + random.direction() * 0.02)
            })
            .collect();
        let height = random.between(0.4, 1.6);
        let dent = if trial % 3 == 0 { 0.0 } else { 0.1 };
        let grid: Vec<Vec3> = (0..25)
            .map(|k| Vec3::new((k % 5) as f32 * 0.5 - 1.0, (k / 5) as f32 * 0.5 - 1.0, height))
            .map(|at| at + Vec3::Z * random.between(-dent, dent))
            .collect();
        for k in (0..19).filter(|k| k % 5 < 4 && random.unit() < 0.7) {
            let [a, b, c, d] = [grid[k], grid[k + 1], grid[k + 6], grid[k + 5]];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
        let accel = Accel::from_triangles(&triangles, Quality::High);
        let single = On { bvh: accel.bvh(), family: Family::Scalar };
        let each = [32, 64, 100][trial % 3];
        let points: Vec<TilePoint> = (0..64)
            .map(|k| {
                let at = Vec3::new((k % 8) as f32, (k / 8) as f32, 0.0) * [0.001, 0.01][trial % 2];
                TilePoint { x: at.to_array(), first: k * each, count: each }
            })
            .collect();
        let ends: Vec<Vec3> =
            (0..64 * each).map(|_| corner + u * random.unit() + v * random.unit()).collect();
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let targets = Targets::new(&xs, &ys, &zs).expect("of one length").on_parallelogram(corner, u, v);
        let mut want = vec![0u64; ends.len() / 64];
        for (i, &end) in ends.iter().enumerate() {
            let ray = Ray::segment(points[i / each as usize].x, end);
            let hit = single.occluded(&ray, None, &mut Counts::default());
            want[i / 64] |= u64::from(hit) << (i % 64);
            total[usize::from(hit)] += 1;
        }
        for on in families(accel.bvh()) {
            // With a triangle to ignore, be there none of the number, rays are traced to all parts of the light.
            for (way, ignore) in [None, Some(u32::MAX - 1)].into_iter().enumerate() {
                let (mut blocked, mut counts) = (vec![0; want.len()], Counts::default());
                on.occluded_tile(&points, &targets, ignore, &mut counts, &mut scratch, &mut blocked);
                assert_eq!(blocked, want, "{}, trial {trial}", on.family);
                assert_eq!(counts.rays, ends.len() as u64, "{}, trial {trial}", on.family);
                nodes[way] += counts.node_tests;
            }
        }
    }
    assert!(total.iter().all(|&rays| rays > 20_000), "{total:?}");
    assert!(nodes[0] * 10 < nodes[1] * 8, "{nodes:?}");
}

/// A light that is next to no parallelogram, and a wall next to it: the box around its targets must hold them.
#[test]
fn lights_whose_edges_are_all_but_parallel() {
    let mut random = Random::new(77);
    let mut scratch = TileScratch::new();
    let mut total = [0, 0];
    for trial in 0..600 {
        let along = random.direction();
        let across = along.cross(random.direction()).normalize();
        let thin = random.any_scale(-6.0, -1.0);
        let (u, v) = (along, along * 0.9 + across * thin);
        let middle = random.direction() * 3.0;
        let corner = middle - (u + v) * 0.5;
        let wall = middle + middle.normalize() * [1e-4, -1e-4][trial % 2];
        let side = along.cross(middle).normalize();
        let wall = [wall - (along + side) * 9.0, wall + (along - side) * 9.0, wall + side * 9.0];
        let accel = Accel::from_triangles(&[wall], Quality::High);
        let single = On { bvh: accel.bvh(), family: Family::Scalar };
        let points: Vec<TilePoint> = (0..64)
            .map(|k| {
                let at = Vec3::new((k % 8) as f32, (k / 8) as f32, 0.0) * 0.001;
                TilePoint { x: at.to_array(), first: k * 16, count: 16 }
            })
            .collect();
        let ends: Vec<Vec3> = (0..1024).map(|_| corner + u * random.unit() + v * random.unit()).collect();
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let targets = Targets::new(&xs, &ys, &zs).expect("of one length").on_parallelogram(corner, u, v);
        let mut want = [0u64; 16];
        for (i, &end) in ends.iter().enumerate() {
            let hit = single.occluded(&Ray::segment(points[i / 16].x, end), None, &mut Counts::default());
            want[i / 64] |= u64::from(hit) << (i % 64);
            total[usize::from(hit)] += 1;
        }
        for on in families(accel.bvh()) {
            let mut blocked = [0; 16];
            on.occluded_tile(&points, &targets, None, &mut Counts::default(), &mut scratch, &mut blocked);
            assert_eq!(blocked, want, "{}, trial {trial}, {thin}", on.family);
        }
    }
    assert!(total.iter().all(|&rays| rays > 10_000), "{total:?}");
}

/// Segments that pass within some last bits of the edges of triangles, near to the points and far from them, and of their
/// planes where the light is: what is told from them by linear forms must be told as by a single ray.
#[test]
fn targets_beside_the_edges_of_triangles() {
    let mut random = Random::new(91);
    let mut scratch = TileScratch::new();
    let mut batch = BatchScratch::new();
    let mut total = [0, 0];
    for _ in 0..4000 {
        let away = random.direction() * random.any_scale(-1.0, 1.0);
        let (a, b) = away.normalize().any_orthonormal_pair();
        let size = away.length() * random.any_scale(-1.5, 0.3);
        let light = Light {
            corner: away - (a + b) * (0.5 * size),
            u: (a + random.point() * 0.3) * size,
            v: (b + random.point() * 0.3) * size,
        };
        let normal = light.u.cross(light.v).as_dvec3();
        // What the error is in proportion to: the triangle, or all of the scene, where the points are.
        let place = random.direction() * random.any_scale(-2.0, 2.0);
        let mut triangles = Vec::new();
        for _ in 0..1 + random.below(6) {
            let t = if random.below(4) == 0 { random.between(0.9, 1.1) } else { random.between(0.05, 1.0) };
            let middle = away * t + random.point() * (0.5 * t * size);
            let wide = t * size * random.any_scale(-1.0, 1.0);
            let thin = random.any_scale(-3.0, 0.0);
            let (p, q) = (middle + random.point() * wide, middle + random.point() * wide);
            triangles.push([p, q, p.lerp(q, random.unit()) + random.point() * (wide * thin)]);
            if random.below(4) == 0 {
                // Slivers in a line with the segments, around where they begin.
                let (long, thin) = (random.any_scale(-3.0, 0.0), random.any_scale(-5.0, -1.0));
                let mut vertex =
                    || (away * random.between(-1.0, 1.0) + random.point() * (thin * size)) * long;
                triangles.push([vertex(), vertex(), vertex()]);
            }
        }
        let near = triangles.len();
        if random.below(2) == 0 {
            let far = -away.normalize() * random.any_scale(1.0, 4.0);
            triangles.push([far, far + Vec3::X, far + Vec3::Y]);
        }
        triangles.iter_mut().flatten().for_each(|vertex| *vertex += place);
        let (mut points, mut ends) = (Vec::new(), Vec::new());
        for _ in 0..16 {
            let x = place + random.point() * (size * random.any_scale(-6.0, -1.3));
            let first = ends.len() as u32;
            for _ in 0..32 {
                let triangle = triangles[random.below(near)];
                let edge = random.below(3);
                let on =
                    triangle[edge].as_dvec3().lerp(triangle[(edge + 1) % 3].as_dvec3(), random.unit().into());
                let direction = on - x.as_dvec3();
                let steps =
                    normal.dot((light.corner + place).as_dvec3() - x.as_dvec3()) / normal.dot(direction);
                let mut end = x.as_dvec3() + direction * steps;
                let at = end - (light.corner + place).as_dvec3();
                let [s, t] = [at.dot(light.u.as_dvec3()), at.dot(light.v.as_dvec3())];
                let [s, t] =
                    [s / f64::from(light.u.length_squared()), t / f64::from(light.v.length_squared())];
                if !(steps > 0.0 && s.abs() < 3.0 && t.abs() < 3.0) {
                    end = (light.at(random.unit(), random.unit()) + place).as_dvec3();
                }
                let bits = f64::from(f32::EPSILON * random.any_scale(-1.0, 2.0) * end.length() as f32);
                ends.push((end + random.point().as_dvec3() * bits).as_vec3());
            }
            points.push(TilePoint { x: x.into(), first, count: 32 });
        }
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let any = Targets::new(&xs, &ys, &zs).expect("of one length");
        let flat = any.on_parallelogram(light.corner + place, light.u, light.v);
        let single = On { bvh: accel.bvh(), family: Family::Scalar };
        let mut want = vec![0u64; ends.len() / 64];
        for (i, &end) in ends.iter().enumerate() {
            let hit = single.occluded(&Ray::segment(points[i / 32].x, end), None, &mut Counts::default());
            want[i / 64] |= u64::from(hit) << (i % 64);
            total[usize::from(hit)] += 1;
        }
        for on in families(accel.bvh()) {
            for targets in [any, flat] {
                let mut blocked = vec![0; want.len()];
                on.occluded_tile(&points, &targets, None, &mut Counts::default(), &mut scratch, &mut blocked);
                assert_eq!(blocked, want, "{}: {triangles:?}", on.family);
            }
            for (k, point) in points.iter().enumerate() {
                let some = point.first as usize..point.first as usize + 32;
                let targets =
                    Targets::new(&xs[some.clone()], &ys[some.clone()], &zs[some]).expect("of one length");
                let mut blocked = [0];
                on.occluded_batch(point.x, &targets, None, &mut Counts::default(), &mut batch, &mut blocked);
                assert_eq!(
                    blocked[0],
                    want[k / 2] >> (k % 2 * 32) & 0xffff_ffff,
                    "{}: {triangles:?}",
                    on.family
                );
            }
        }
    }
    assert!(total.iter().all(|&rays| rays > 200_000), "{total:?}");
}

/// Slivers around a point, in a line with its segments: on which side of their planes it is, the exact test finds by other
/// products than the forms do. It may find, by rounding, that one stands before the point which is behind it, and of that
/// queries differ; but nothing is blocked that is not blocked for it.
#[test]
fn slivers_around_a_point() {
    let mut random = Random::new(5);
    let (mut batch, mut scratch) = (BatchScratch::new(), TileScratch::new());
    let mut total = [0, 0];
    for trial in 0..40_000 {
        let away = random.direction();
        let (a, b) = away.any_orthonormal_pair();
        let size = random.any_scale(-4.0, -2.0);
        let (corner, u, v) = (away - (a + b) * (0.5 * size), a * size, b * size);
        let long = random.any_scale(-4.0, 0.0);
        let thin = long * random.any_scale(-5.0, -3.0);
        let mut vertex = || away * (long * random.between(-1.0, 1.0)) + random.point() * thin;
        let sliver = [vertex(), vertex(), vertex()];
        let accel = Accel::from_triangles(&[sliver], Quality::High);
        let ends: Vec<Vec3> = (0..32).map(|_| corner + u * random.unit() + v * random.unit()).collect();
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let targets = Targets::new(&xs, &ys, &zs).expect("of one length").on_parallelogram(corner, u, v);
        let single = On { bvh: accel.bvh(), family: Family::Scalar };
        let mut want = 0;
        for (i, &end) in ends.iter().enumerate() {
            let hit = single.occluded(&Ray::segment(Vec3::ZERO, end), None, &mut Counts::default());
            want |= u64::from(hit) << i;
            total[usize::from(hit)] += 1;
        }
        let points = [0, 16].map(|first| TilePoint { x: [0.0; 3], first, count: 16 });
        let mut count = Counts::default();
        for on in families(accel.bvh()) {
            let mut blocked = [0];
            on.occluded_batch([0.0; 3], &targets, None, &mut count, &mut batch, &mut blocked);
            assert_eq!(blocked[0] & !want, 0, "{}, batch, trial {trial}: {sliver:?}", on.family);
            on.occluded_tile(&points, &targets, None, &mut count, &mut scratch, &mut blocked);
            assert_eq!(blocked[0] & !want, 0, "{}, tile, trial {trial}: {sliver:?}", on.family);
        }
    }
    assert!(total.iter().all(|&rays| rays > 10_000), "{total:?}");
}

/// Walls along the axes that a light touches, which is turned to them: their planes are told from its corners by the last
/// bits of either.
#[test]
fn walls_at_the_corner_of_a_light() {
    let mut random = Random::new(23);
    let mut scratch = TileScratch::new();
    let mut total = [0, 0];
    for _ in 0..3000 {
        let axis = random.below(3);
        let world = |v: Vec3| match axis {
            0 => v,
            1 => Vec3::new(v.z, v.x, v.y),
            _ => Vec3::new(v.y, v.z, v.x),
        };
        let size = random.any_scale(-4.0, -1.0);
        let away =
            Vec3::new(random.between(-1e-3, 1e-3), random.between(-1.0, 1.0), random.between(5.0, 20.0));
        let half = std::f32::consts::FRAC_1_SQRT_2 * size;
        let (u, v) = (Vec3::new(half, 0.0, half), Vec3::new(0.0, size, 0.0));
        let mut ends = Vec::new();
        let count = 1 + random.below(4);
        let xs: Vec<Vec3> = (0..count).map(|_| random.point() * Vec3::new(1.0, 0.1, 0.1) - Vec3::X).collect();
        let mut points = Vec::new();
        for (k, x) in xs.iter().enumerate() {
            // The first where all of it is counted from, so that nothing moves the light.
            let x = if k == 0 { Vec3::ZERO } else { *x };
            points.push(TilePoint { x: world(x).to_array(), first: ends.len() as u32, count: 32 });
            ends.extend((0..32).map(|_| {
                let [s, t] = [0, 1].map(|_| if random.below(3) == 0 { 1.0 } else { random.unit() });
                away + u * (2.0 * s - 1.0) + v * (2.0 * t - 1.0)
            }));
        }
        // Some last bits beside the light's greatest x.
        let last = ends.iter().map(|end| end.x).fold(f32::MIN, f32::max);
        let wall = last - random.between(-3.0, 3.0) * f32::EPSILON * 20.0 * random.any_scale(-3.0, 0.0);
        let [p, q, r, s] = [[-50.0, -1.0], [50.0, -1.0], [50.0, 50.0], [-50.0, 50.0]]
            .map(|[y, z]| world(Vec3::new(wall, y, z)));
        let accel = Accel::from_triangles(&[[p, q, r], [p, r, s]], Quality::Medium);
        let ends: Vec<Vec3> = ends.into_iter().map(world).collect();
        let [x, y, z] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let any = Targets::new(&x, &y, &z).expect("of one length");
        let flat = any.on_parallelogram(world(away - u - v), world(u * 2.0), world(v * 2.0));
        for on in families(accel.bvh()) {
            for targets in [any, flat] {
                let mut blocked = vec![0; ends.len().div_ceil(64)];
                on.occluded_tile(&points, &targets, None, &mut Counts::default(), &mut scratch, &mut blocked);
                for point in &points {
                    for i in point.first as usize..(point.first + point.count) as usize {
                        let ray = Ray::segment(point.x, ends[i]);
                        let want = on.occluded(&ray, None, &mut Counts::default());
                        assert_eq!(
                            blocked[i / 64] >> (i % 64) & 1 != 0,
                            want,
                            "{}: {ray:?}, {wall}",
                            on.family
                        );
                        total[usize::from(want)] += 1;
                    }
                }
            }
        }
    }
    assert!(total.iter().all(|&rays| rays > 10_000), "{total:?}");
}

/// The plane of the surface that the points lie on passes through the light, and targets are on either side of it.
#[test]
fn lights_that_reach_below_the_surface() {
    let mut random = Random::new(29);
    let mut scratch = TileScratch::new();
    let mut total = [0, 0];
    for trial in 0..1500 {
        let x = if trial % 3 == 0 { Vec3::X } else { random.direction() };
        let (y, z) = x.any_orthonormal_pair();
        let place = random.point() * random.any_scale(-1.0, 1.5);
        let world = |[a, b, c]: [f32; 3]| x * a + y * b + z * c + place;
        // A floor at height 0, whole or ending before the light, in two triangles or many, and some things on it.
        let (far, pieces) = (random.between(1.2, 3.0), 1 + random.below(3));
        let mut triangles = Vec::new();
        for row in 0..pieces {
            for column in 0..pieces {
                let at = |row: usize, column: usize| {
                    let [s, t] = [row, column].map(|k| k as f32 / pieces as f32);
                    world([-1.0 + (far + 1.0) * s, 0.0, 2.0 * t - 1.0])
                };
                let [p, q] = [at(row, column), at(row, column + 1)];
                let [r, s] = [at(row + 1, column + 1), at(row + 1, column)];
                triangles.extend([[p, q, r], [p, r, s]]);
            }
        }
        for _ in 0..random.below(4) {
            let at = world([random.between(0.5, 1.5), random.between(-0.1, 0.3), random.between(-0.5, 0.5)]);
            triangles.push([at, at + random.point() * 0.3, at + random.point() * 0.3]);
        }
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        let clearance = accel.bvh().clearance();
        let (low, high) = (-random.unit(), random.unit());
        let (corner, u, v) = (world([2.0, low, -0.5]), y * (high - low), z);
        let (mut points, mut ends) = (Vec::new(), Vec::new());
        let (count, height) = (8 + random.below(57), [1.0, 1.0, 0.3, 0.0, -1.0][random.below(5)]);
        for _ in 0..32 {
            let at = world([random.between(-0.2, 0.2), clearance * height, random.between(-0.2, 0.2)]);
            points.push(TilePoint { x: at.into(), first: ends.len() as u32, count: count as u32 });
            ends.extend((0..count).map(|_| {
                let above = match random.below(4) {
                    // Some last bits beside the plane.
                    0 => clearance * random.between(-2.0, 2.0),
                    1 => random.between(low, high),
                    _ => random.between(0.0, high),
                };
                // There is no telling in the plane, if the point is in it too.
                let above = if height == 0.0 && above.abs() < 0.01 { above.signum() * 0.01 } else { above };
                corner + y * (above - low) + v * random.unit()
            }));
        }
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let any = Targets::new(&xs, &ys, &zs).expect("of one length");
        let rays = |point: &TilePoint| {
            let (x, all) = (point.x, point.first as usize..(point.first + point.count) as usize);
            all.map(|i| (i, Ray::segment(x, ends[i]))).collect::<Vec<_>>()
        };
        for on in families(accel.bvh()) {
            let want: Vec<bool> = points
                .iter()
                .flat_map(rays)
                .map(|(_, ray)| on.occluded(&ray, None, &mut Counts::default()))
                .collect();
            want.iter().for_each(|&hit| total[usize::from(hit)] += 1);
            for targets in [any, any.on_parallelogram(corner, u, v)] {
                let mut blocked = vec![0; ends.len().div_ceil(64)];
                on.occluded_tile(&points, &targets, None, &mut Counts::default(), &mut scratch, &mut blocked);
                for (i, ray) in points.iter().flat_map(rays) {
                    let got = blocked[i / 64] >> (i % 64) & 1 != 0;
                    assert_eq!(got, want[i], "{}: {ray:?}, {triangles:?}", on.family);
                }
            }
        }
    }
    assert!(total.iter().all(|&rays| rays > 100_000), "{total:?}");
}

#[test]
fn a_target_that_is_no_number_is_free() {
    // A sheet hides all of the light, but nothing hides what is nowhere.
    let sheet = [[Vec3::new(-9.0, -9.0, 1.0), Vec3::new(9.0, -9.0, 1.0), Vec3::new(0.0, 9.0, 1.0)]];
    let accel = Accel::from_triangles(&sheet, Quality::Fast);
    let points: Vec<TilePoint> =
        (0..64).map(|k| TilePoint { x: [k as f32 * 1e-3, 0.0, 0.0], first: 16 * k, count: 16 }).collect();
    let at = |i: usize| (i % 16) as f32 / 16.0;
    let [mut xs, ys, zs]: [Vec<f32>; 3] =
        [(0..1024).map(at).collect(), (0..1024).map(|i| at(i / 4)).collect(), vec![2.0; 1024]];
    for odd in [f32::NAN, f32::INFINITY] {
        xs[500] = odd;
        let targets = Targets::new(&xs, &ys, &zs).expect("of one length");
        let targets = targets.on_parallelogram(Vec3::Z * 2.0, Vec3::X, Vec3::Y);
        for on in families(accel.bvh()) {
            let mut blocked = [0; 16];
            let scratch = &mut TileScratch::new();
            on.occluded_tile(&points, &targets, None, &mut Counts::default(), scratch, &mut blocked);
            for (i, word) in blocked.iter().enumerate() {
                let want = if i == 500 / 64 { !(1 << (500 % 64)) } else { u64::MAX };
                assert_eq!(*word, want, "{}: word {i}", on.family);
            }
        }
    }
}

/// Numbers that no scene has.
const ODD: [f32; 10] =
    [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38, -1e38, f32::MAX, -1e30, 1e20, 1e13, -1e12];

/// Now and then writes such a number to a coordinate, or to all of them.
fn spoil(random: &mut Random, chance: f32, at: &mut [f32; 3]) {
    if random.unit() < chance {
        let odd = ODD[random.below(ODD.len())];
        match random.below(4) {
            3 => *at = [odd; 3],
            axis => at[axis] = odd,
        }
    }
}

#[test]
fn odd_points_and_targets_say_nothing_of_the_others() {
    let mut random = Random::new(21);
    let (mut odd, mut total) = (0, [0, 0]);
    for trial in 0..1200 {
        let away = random.direction() * random.between(1.0, 3.0);
        let (u, v) = away.normalize().any_orthonormal_pair();
        let size = random.any_scale(-1.0, 0.5).abs();
        let mut triangles = blockers(&mut random, away, size);
        if trial % 3 == 0 {
            // A wall that hides all that is something.
            let [a, b, c] = [-u - v, u - v, v].map(|at| away * 0.5 + at * 40.0);
            triangles.push([a, b, c]);
        }
        let accel = Accel::from_triangles(&triangles, Quality::Fast);
        let count = 1 + random.below(128);
        let each = [1, 1, 2, 4, 16, 64, 70][random.below(7)];
        let (planar, mixed) = (random.below(2) == 0, random.below(4) == 0);
        let [of_points, of_targets] = [0; 2].map(|_| [0.0, 0.0, 0.02, 0.3][random.below(4)]);
        let (mut points, mut ends) = (Vec::new(), Vec::new());
        for k in 0..count {
            let near = if planar { u * random.unit() + v * (k as f32 / 64.0) } else { random.point() };
            let mut x = (near * 0.2).to_array();
            spoil(&mut random, of_points, &mut x);
            let each = if mixed { random.below(each + 1) } else { each };
            points.push(TilePoint { x, first: ends.len() as u32, count: each as u32 });
            for _ in 0..each {
                let mut end = (away + (u * random.unit() + v * random.unit()) * size).to_array();
                spoil(&mut random, of_targets, &mut end);
                ends.push(end);
            }
        }
        let first = random.below(points.len());
        if of_points > 0.0 && trial % 2 == 0 {
            spoil(&mut random, 1.0, &mut points[first].x);
        }
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let any = Targets::new(&xs, &ys, &zs).expect("of one length");
        let flat = any.on_parallelogram(away, u * size, v * size);
        let single = On { bvh: accel.bvh(), family: Family::Scalar };
        let mut want = vec![0u64; ends.len().div_ceil(64)];
        for point in &points {
            let usual = point.x.iter().all(|at| at.abs() < 1e3);
            odd += usize::from(!usual);
            for i in point.first as usize..(point.first + point.count) as usize {
                let hit = single.occluded(&Ray::segment(point.x, ends[i]), None, &mut Counts::default());
                want[i / 64] |= u64::from(hit) << (i % 64);
                total[usize::from(hit)] += 1;
            }
        }
        let mut scratch = TileScratch::new();
        for on in families(accel.bvh()) {
            for targets in [any, flat] {
                let mut blocked = vec![0; want.len()];
                let mut counts = Counts::default();
                on.occluded_tile(&points, &targets, None, &mut counts, &mut scratch, &mut blocked);
                assert_eq!(counts.rays, ends.len() as u64);
                assert_eq!(blocked, want, "{}, trial {trial}: {points:?}, {ends:?}", on.family);
            }
        }
    }
    assert!(odd > 1000 && total.iter().all(|&rays| rays > 100_000), "{odd} odd points, rays: {total:?}");
}

#[test]
fn a_point_that_is_no_number_leaves_the_others_dark() {
    let square = [Vec3::new(-1.0, -1.0, 1.0), Vec3::new(1.0, -1.0, 1.0), Vec3::new(1.0, 1.0, 1.0)];
    let other = [square[0], square[2], Vec3::new(-1.0, 1.0, 1.0)];
    let accel = Accel::from_triangles(&[square, other], Quality::Fast);
    let [xs, ys] = [8, 1].map(|by| (0..192).map(|i| (i / by % 8) as f32 * 0.05).collect::<Vec<f32>>());
    let zs = vec![2.0; 192];
    let targets = Targets::new(&xs, &ys, &zs).expect("of one length");
    for k in 0..3 {
        for odd in ODD {
            let mut points =
                [0u32, 1, 2].map(|k| TilePoint { x: [k as f32 * 0.01, 0.0, 0.0], first: 64 * k, count: 64 });
            points[k].x[1] = odd;
            let mut want = [u64::MAX; 3];
            want[k] = 0;
            for on in families(accel.bvh()) {
                let (mut blocked, mut scratch) = ([0; 3], TileScratch::new());
                let counts = &mut Counts::default();
                on.occluded_tile(&points, &targets, None, counts, &mut scratch, &mut blocked);
                assert_eq!(blocked, want, "{}: {odd} in point {k}", on.family);
            }
        }
    }
}

/// Asks for points that name targets there are not, of an empty scene or of another.
fn ask_beyond(triangles: &[Triangle], first: u32, count: u32) {
    let accel = Accel::from_triangles(triangles, Quality::Fast);
    let on = On { bvh: accel.bvh(), family: Family::Scalar };
    let targets = Targets::new(&[0.0; 3], &[0.0; 3], &[2.0; 3]).expect("of one length");
    let points = [TilePoint { x: [0.0; 3], first, count }];
    let (mut scratch, mut blocked) = (TileScratch::new(), [0; 4]);
    on.occluded_tile(&points, &targets, None, &mut Counts::default(), &mut scratch, &mut blocked);
}

#[test]
#[should_panic(expected = "targets that do not exist")]
fn targets_beyond_the_slice_of_an_empty_scene() {
    ask_beyond(&[], 2, 2);
}

#[test]
#[should_panic(expected = "targets that do not exist")]
fn targets_beyond_all_numbers() {
    ask_beyond(&[[Vec3::ZERO, Vec3::X, Vec3::Y]], u32::MAX, 2);
}

#[test]
fn a_point_without_targets_may_name_any() {
    ask_beyond(&[], u32::MAX, 0);
    ask_beyond(&[[Vec3::ZERO, Vec3::X, Vec3::Y]], 5, 0);
}
