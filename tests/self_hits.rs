//! A point set off a plane by the tree's clearance does not hit that plane.

use glam::{DVec3, Mat3, Vec3};
use occlude_host::accel::{Accel, Quality};
use occlude_kernel::{Counts, Ray, RayPacket, offset};
use occlude_tests::{Family, On, Random, Triangle, families, meshes};

/// A square tessellated twice, differently: every point lies on two coplanar triangles.
struct Plane {
    accel: Accel,
    triangles: Vec<Triangle>,
    normal: Vec3,
    scale: f32,
    turn: Mat3,
}

impl Plane {
    fn new(random: &mut Random, scale: f32, shift: Vec3) -> Self {
        let turn = match random.below(3) {
            0 => Mat3::IDENTITY,
            1 => Mat3::from_rotation_x(random.unit()),
            _ => meshes::rotation(random),
        };
        let place = |x: f32, y: f32| turn * Vec3::new(x, y, 0.0) * scale + shift;
        let cells = 1 + random.below(8);
        let mut triangles = Vec::new();
        // The inner vertices anywhere near their place of the grid.
        let mut grid = vec![vec![Vec3::ZERO; cells + 1]; cells + 1];
        for (i, row) in grid.iter_mut().enumerate() {
            for (j, vertex) in row.iter_mut().enumerate() {
                let at = |k: usize, random: &mut Random| {
                    let inner = k > 0 && k < cells;
                    let wander = if inner { random.between(-0.3, 0.3) } else { 0.0 };
                    (k as f32 + wander) / cells as f32 * 2.0 - 1.0
                };
                *vertex = place(at(i, random), at(j, random));
            }
        }
        for i in 0..cells {
            for j in 0..cells {
                let [a, b, c, d] = [grid[i][j], grid[i + 1][j], grid[i + 1][j + 1], grid[i][j + 1]];
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        let [a, b, c, d] = [place(-1.0, -1.0), place(1.0, -1.0), place(1.0, 1.0), place(-1.0, 1.0)];
        triangles.extend([[a, b, d], [b, c, d]]);
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        Self { accel, triangles, normal: turn * Vec3::Z, scale, turn }
    }

    /// A point of a triangle, and the normal a renderer would take: the triangle's own.
    fn point(&self, random: &mut Random) -> (Vec3, Vec3) {
        let triangle = self.triangles[random.below(self.triangles.len())];
        let [a, b, c] = triangle.map(|vertex| vertex.as_dvec3());
        let normal: DVec3 = (b - a).cross(c - a).normalize();
        // Wandering vertices turn a few triangles over.
        let up = normal.dot(self.normal.as_dvec3()).signum();
        (random.on_triangle(&triangle), (normal * up).as_vec3())
    }

    /// Away from the plane, on the side of its normal, by this sine and more.
    fn leaving(&self, random: &mut Random, least: f32) -> Vec3 {
        let flat = loop {
            let flat = random.point() * Vec3::new(1.0, 1.0, 0.0);
            if flat.length() > 0.1 {
                break flat.normalize();
            }
        };
        let rise = match random.below(4) {
            0 => least,
            1 => 1e-3f32.max(least),
            2 => random.any_scale(-3.0, 0.0).abs(),
            _ => 0.0f32.max(least),
        };
        self.turn * (flat + Vec3::Z * rise) * self.scale * random.between(0.1, 3.0)
    }
}

/// Planes of any orientation and size: about the origin, beside it, and far from it.
fn planes() -> impl Iterator<Item = Plane> {
    let mut random = Random::new(61);
    (0..600).map(move |round| {
        let scale = 10.0f32.powf(random.between(-4.0, 5.0));
        let away = [0.0, 1.0, 30.0, 1000.0][round % 4];
        let shift = random.direction() * scale * away;
        Plane::new(&mut random, scale, shift)
    })
}

/// Rays asked and hits found with this multiple of the clearance, at any of these least sines.
fn self_hits(multiple: f32, least: f32) -> (usize, usize) {
    let (mut rays, mut hits) = (0, 0);
    for (plane, seed) in planes().zip(0..) {
        let mut random = Random::new(200 + seed);
        let on = On { bvh: plane.accel.bvh(), family: Family::best() };
        let clearance = on.bvh.clearance() * multiple;
        for _ in 0..20 {
            let packet: [Ray; 16] = std::array::from_fn(|i| {
                let (point, normal) = plane.point(&mut random);
                let start = offset(point, normal, clearance);
                let direction = plane.leaving(&mut random, least);
                if i % 2 == 0 { Ray::from(start, direction) } else { Ray::segment(start, start + direction) }
            });
            rays += 16;
            let packet = RayPacket::new(&packet);
            hits += on.occluded_packet(&packet, 0xffff, None, &mut Counts::default()).count_ones() as usize;
        }
    }
    (rays, hits)
}

#[test]
fn rays_that_leave_a_plane_do_not_hit_it() {
    for least in [0.0, 1e-6, 1e-3] {
        for multiple in [1.0, 0.5, 0.25, 0.125, 0.0625, 0.0] {
            let (rays, hits) = self_hits(multiple, least);
            println!("sine from {least:.0e}, {multiple} clearances: {hits} of {rays} rays hit");
            if multiple == 1.0 {
                assert_eq!(hits, 0);
            }
        }
    }
}

#[test]
fn every_width_clears_the_plane() {
    let mut random = Random::new(62);
    for plane in planes().step_by(10) {
        for on in families(plane.accel.bvh()) {
            for _ in 0..50 {
                let (point, normal) = plane.point(&mut random);
                let start = offset(point, normal, on.bvh.clearance());
                let ray = Ray::from(start, plane.leaving(&mut random, 0.0));
                assert!(!on.occluded(&ray, None, &mut Counts::default()), "{}: {ray:?}", on.family);
            }
        }
    }
}

#[test]
fn rays_that_enter_meet_the_plane() {
    let mut random = Random::new(63);
    for plane in planes() {
        let on = On { bvh: plane.accel.bvh(), family: Family::best() };
        let clearance = on.bvh.clearance();
        // Far from the origin the clearance may exceed the plane.
        if clearance > 1e-3 * plane.scale {
            continue;
        }
        for _ in 0..50 {
            let (point, normal) = plane.point(&mut random);
            let ray = Ray::from(offset(point, normal, clearance), -plane.normal * plane.scale);
            let beside = ray.at(clearance / plane.scale);
            let inner = plane.turn.transpose() * (beside - middle(&plane)) / plane.scale;
            if inner.x.abs().max(inner.y.abs()) < 0.99 {
                assert!(on.occluded(&ray, None, &mut Counts::default()), "{ray:?}");
            }
        }
    }
}

fn middle(plane: &Plane) -> Vec3 {
    let [[a, ..], [.., c, _]] =
        [plane.triangles[plane.triangles.len() - 2], plane.triangles[plane.triangles.len() - 1]];
    (a + c) * 0.5
}

/// The segments of a renderer: from one surface to another, both ends set off.
#[test]
fn segments_between_planes() {
    let mut random = Random::new(64);
    let (mut segments, mut wrong) = (0, [0; 4]);
    for round in 0..400 {
        let scale = 10.0f32.powf(random.between(-4.0, 5.0));
        let shift = random.direction() * scale * [0.0, 1.0, 30.0, 300.0][round % 4];
        let turn = if round % 2 == 0 { Mat3::IDENTITY } else { meshes::rotation(&mut random) };
        let place = |p: Vec3| turn * p * scale + shift;
        let square = |corner: Vec3, u: Vec3, v: Vec3| {
            let [a, b, c, d] = [corner, corner + u, corner + u + v, corner + v].map(place);
            [[a, b, c], [a, c, d]]
        };
        // The six walls of a room, seen from inside.
        let (lower, upper) = (Vec3::splat(-1.0), Vec3::splat(1.0));
        let mut walls = Vec::new();
        for (axis, u, v) in
            [(Vec3::X, Vec3::Y, Vec3::Z), (Vec3::Y, Vec3::Z, Vec3::X), (Vec3::Z, Vec3::X, Vec3::Y)]
        {
            walls.push((square(lower, u * 2.0, v * 2.0), turn * axis));
            walls.push((square(upper, u * -2.0, v * -2.0), turn * -axis));
        }
        let triangles: Vec<Triangle> = walls.iter().flat_map(|(wall, _)| *wall).collect();
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        let on = On { bvh: accel.bvh(), family: Family::best() };
        for (multiple, wrong) in [1.0, 0.5, 0.25, 0.125].into_iter().zip(&mut wrong) {
            let clearance = on.bvh.clearance() * multiple;
            for _ in 0..100 {
                let (from, to) = (random.below(6), random.below(6));
                let mut end = |wall: usize| {
                    let (triangles, normal) = walls[wall];
                    let half = random.below(2);
                    let mut point = random.on_triangle(&triangles[half]);
                    // Some right beside the next wall.
                    if random.below(4) == 0 {
                        let corner = triangles[0][random.below(3)];
                        point = corner + (point - corner) * 1e-3;
                    }
                    (point, normal)
                };
                let ((x, n), (y, m)) = (end(from), end(to));
                // A point within the clearance of another wall may be set off through it.
                let near = |point: Vec3| {
                    let inner = turn.transpose() * (point - shift) / scale;
                    inner.abs().to_array().iter().filter(|&&c| c > 1.0 - 4.0 * clearance / scale).count() > 1
                };
                if near(x) || near(y) {
                    continue;
                }
                let segment = Ray::segment(offset(x, n, clearance), offset(y, m, clearance));
                segments += 1;
                *wrong += usize::from(on.occluded(&segment, None, &mut Counts::default()));
            }
        }
    }
    println!("{segments} segments; blocked at 1, 1/2, 1/4, 1/8 clearances: {wrong:?}");
    assert!(segments > 100_000);
    assert_eq!(wrong[0], 0);
}
