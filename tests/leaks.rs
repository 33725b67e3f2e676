//! From inside a closed mesh nothing leaks out.

use glam::{DVec3, Vec3};
use occlude_host::accel::{Accel, Quality};
use occlude_kernel::{BatchScratch, Counts, Ray, RayPacket, Targets, TilePoint, TileScratch, Uncounted};
use occlude_tests::meshes::{self, Indexed};
use occlude_tests::{Family, On, Random};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Is a point inside the mesh as it was made, by a margin?
type Inside = Box<dyn Fn(DVec3) -> bool + Sync>;

/// A closed mesh somewhere, and what is inside.
struct Closed {
    name: String,
    accel: Accel,
    vertices: Vec<Vec3>,
    edges: Vec<[Vec3; 2]>,
    scale: Vec3,
    shift: Vec3,
    inside: Inside,
}

impl Closed {
    fn new(name: &str, mesh: &Indexed, inside: Inside, scale: Vec3, shift: Vec3) -> Self {
        assert!(mesh.is_closed(), "{name}");
        let place = |vertex: DVec3| vertex.as_vec3() * scale + shift;
        let edges: BTreeSet<[usize; 2]> = mesh
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a.min(b), a.max(b)], [b.min(c), b.max(c)], [c.min(a), c.max(a)]])
            .collect();
        Self {
            name: format!("{name} x {scale} + {shift}"),
            accel: Accel::from_triangles(&mesh.triangles(place), Quality::Medium),
            vertices: mesh.vertices.iter().map(|&vertex| place(vertex)).collect(),
            edges: edges.iter().map(|edge| edge.map(|index| place(mesh.vertices[index]))).collect(),
            scale,
            shift,
            inside,
        }
    }

    fn holds(&self, point: Vec3) -> bool {
        (self.inside)((point - self.shift).as_dvec3() / self.scale.as_dvec3())
    }

    fn inner_point(&self, random: &mut Random) -> Vec3 {
        loop {
            let point = random.point() * 1.3 * self.scale + self.shift;
            if self.holds(point) {
                return point;
            }
        }
    }

    /// Where to, of the kinds that tend to leak.
    fn target(&self, random: &mut Random) -> Vec3 {
        let [a, b] = self.edges[random.below(self.edges.len())];
        match random.below(8) {
            0..2 => self.vertices[random.below(self.vertices.len())],
            2 => (a + b) * 0.5,
            3 => a.lerp(b, random.unit()),
            _ => random.point() * 1.5 * self.scale + self.shift,
        }
    }

    /// A ray from a point inside; some start elsewhere and go along an axis through a vertex.
    fn ray(&self, x: Vec3, random: &mut Random) -> Ray {
        if random.below(8) == 0 {
            let vertex = self.vertices[random.below(self.vertices.len())];
            let axis = random.below(3);
            let mut start = vertex;
            start[axis] = x[axis];
            if self.holds(start) {
                let mut direction = Vec3::ZERO;
                direction[axis] = if random.bits() & 1 == 0 { 1.0 } else { -1.0 };
                return Ray::from(start, direction);
            }
        }
        let target = self.target(random);
        if target == x { Ray::from(x, Vec3::X) } else { Ray::from(x, target - x) }
    }

    /// How many of about this many rays leave, as packets of 16 from one point each, batches of 16 and tiles of 64.
    fn leaks(&self, family: Family, seed: u64, rays: usize) -> usize {
        let on = On { bvh: self.accel.bvh(), family };
        let mut random = Random::new(seed);
        let mut leaks = 0;
        for round in 0..rays / 16 {
            let x = self.inner_point(&mut random);
            if round % 8 == 7 {
                leaks += self.tile_leaks(&on, &mut random, if round % 16 == 7 { 1 } else { 8 });
            } else if round % 2 == 0 {
                let rays: [Ray; 16] = std::array::from_fn(|_| self.ray(x, &mut random));
                let packet = RayPacket::new(&rays);
                let blocked = family.run(Packet { on: &on, packet: &packet });
                leaks += blocked.count_zeros() as usize - 16;
            } else {
                let ends: [Vec3; 16] = std::array::from_fn(|_| self.beyond(x, &mut random));
                let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.map(|end| end[axis]));
                let targets = Targets::new(&xs, &ys, &zs).expect("of one length");
                let mut blocked = [0];
                on.occluded_batch(
                    x.into(),
                    &targets,
                    None,
                    &mut Counts::default(),
                    &mut BatchScratch::new(),
                    &mut blocked,
                );
                leaks += blocked[0].count_zeros() as usize - 48;
            }
        }
        leaks
    }

    /// Beyond the mesh, so that the segment must cross it.
    fn beyond(&self, x: Vec3, random: &mut Random) -> Vec3 {
        let target = self.target(random);
        let toward = if target == x { self.scale } else { target - x };
        x + toward * (4.0 * self.scale.max_element() / toward.abs().max_element())
    }

    /// How many of 64 rays leave, as a tile of points with so many targets each: half of the tiles anywhere inside,
    /// half of them around one point.
    fn tile_leaks(&self, on: &On<'_>, random: &mut Random, each: usize) -> usize {
        let (mut points, mut ends) = (Vec::new(), Vec::new());
        let middle = self.inner_point(random);
        let near = random.bits() & 1 == 0;
        while points.len() < 64 / each {
            let mut x = self.inner_point(random);
            let close = middle + (x - middle) * 1e-2;
            if near && self.holds(close) {
                x = close;
            }
            points.push(TilePoint { x: x.into(), first: ends.len() as u32, count: each as u32 });
            ends.extend((0..each).map(|_| self.beyond(x, random)));
        }
        let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
        let targets = Targets::new(&xs, &ys, &zs).expect("of one length");
        let mut blocked = [0];
        on.occluded_tile(
            &points,
            &targets,
            None,
            &mut Counts::default(),
            &mut TileScratch::new(),
            &mut blocked,
        );
        blocked[0].count_zeros() as usize
    }
}

/// A packet, uncounted: what a renderer would ask.
struct Packet<'a> {
    on: &'a On<'a>,
    packet: &'a RayPacket,
}

impl occlude_kernel::lanes::Task for Packet<'_> {
    type Output = u32;
    #[inline(always)]
    fn run<S: occlude_kernel::Simd>(self, simd: S) -> u32 {
        self.on.bvh.on(simd).occluded_packet(self.packet, 0xffff, None, &mut Uncounted)
    }
}

fn ball(radius: f64) -> Inside {
    Box::new(move |p| p.length() < radius)
}

fn cells(level: u32) -> Inside {
    Box::new(move |p| {
        let size = f64::from(3i32.pow(level));
        let at = (p + 1.0) * 0.5 * size;
        let part = at - at.floor();
        // Rounding may move a wall: keep off the cell's own.
        part.min_element() > 0.02
            && part.max_element() < 0.98
            && meshes::sponge_holds([at.x.floor() as i32, at.y.floor() as i32, at.z.floor() as i32], level)
    })
}

/// `meridians` says how thin the slivers are; many make slow trees, for they all meet at the poles.
fn closed_meshes(meridians: usize) -> Vec<Closed> {
    let one = Vec3::ONE;
    let mut all = Vec::new();
    for (subdivisions, radius) in [(0, 0.75), (1, 0.9), (3, 0.95), (5, 0.95)] {
        all.push(Closed::new("icosphere", &meshes::icosphere(subdivisions), ball(radius), one, Vec3::ZERO));
    }
    let sphere = meshes::icosphere(3);
    for (scale, shift) in [
        (one * 1e-4, Vec3::ZERO),
        (one * 1e5, Vec3::ZERO),
        (one, Vec3::new(1000.0, -3000.0, 500.0)),
        (one * 1e-4, Vec3::new(0.1, 0.7, -0.3)),
        (one * 100.0, Vec3::new(-1e5, 1e5, 7e4)),
        (Vec3::new(1.0, 1e-3, 1.0), Vec3::new(0.3, 0.2, 0.1)),
    ] {
        all.push(Closed::new("icosphere", &sphere, ball(0.9), scale, shift));
    }
    let torus = || -> Inside {
        Box::new(|p| DVec3::new(DVec3::new(p.x, p.y, 0.0).length() - 1.0, p.z, 0.0).length() < 0.2)
    };
    all.push(Closed::new("torus", &meshes::torus(0.25, 40, 20), torus(), one, Vec3::ZERO));
    all.push(Closed::new(
        "torus",
        &meshes::torus(0.25, 40, 20),
        torus(),
        one * 3.0,
        Vec3::new(200.0, 0.3, -70.0),
    ));
    for level in 0..3 {
        all.push(Closed::new("sponge", &meshes::sponge(level), cells(level), one, Vec3::ZERO));
        let shift = Vec3::new(12.34, -0.77, 3.21);
        all.push(Closed::new("sponge", &meshes::sponge(level), cells(level), one * 0.37, shift));
    }
    let slivers = || -> Inside {
        // Within the cone frusta of eight rings.
        Box::new(|p| p.length() < 0.85)
    };
    all.push(Closed::new("globe of slivers", &meshes::globe(8, meridians), slivers(), one, Vec3::ZERO));
    all.push(Closed::new("globe of slivers", &meshes::globe(8, meridians), slivers(), one * 7.0, one * 50.0));
    all.push(Closed::new(
        "globe of slivers",
        &meshes::globe(8, meridians / 10),
        slivers(),
        Vec3::new(1.0, 1.0, 1e-3),
        one,
    ));
    all
}

#[test]
fn a_million_rays_at_every_width() {
    let meshes = closed_meshes(5000);
    let families = Family::all();
    let share = 1_000_000usize.div_ceil(meshes.len() * families.len() * 16) * 16;
    let rays = share * meshes.len() * families.len();
    println!("{rays} rays in {} meshes with {} families", meshes.len(), families.len());
    for (mesh, seed) in meshes.iter().zip(0..) {
        for &family in &families {
            assert_eq!(mesh.leaks(family, 50 + seed, share), 0, "{family}: {}", mesh.name);
        }
    }
}

#[test]
fn single_rays() {
    for (mesh, seed) in closed_meshes(5000).iter().zip(0..) {
        let mut random = Random::new(80 + seed);
        let rays: Vec<Ray> = (0..2000)
            .map(|_| {
                let x = mesh.inner_point(&mut random);
                mesh.ray(x, &mut random)
            })
            .collect();
        for on in occlude_tests::families(mesh.accel.bvh()) {
            for ray in &rays {
                let mut counts = Counts::default();
                assert!(on.occluded(ray, None, &mut counts), "{}: {} {ray:?}", on.family, mesh.name);
                assert!(on.closest(ray, None, &mut counts).is_some(), "{}: {} {ray:?}", on.family, mesh.name);
            }
        }
    }
}

/// From outside through a watertight wall into the mesh and out again: at least two hits.
#[test]
fn through_and_out_again() {
    for (mesh, seed) in closed_meshes(5000).iter().zip(0..) {
        let mut random = Random::new(110 + seed);
        let on = On { bvh: mesh.accel.bvh(), family: Family::best() };
        for _ in 0..1000 {
            let x = mesh.inner_point(&mut random);
            let ray = mesh.ray(x, &mut random);
            let line = Ray { t_min: f32::NEG_INFINITY, ..ray };
            let hits = on.hits(&line, None);
            assert!(hits.iter().any(|hit| hit.t > 0.0), "{}: {ray:?}", mesh.name);
            assert!(hits.iter().any(|hit| hit.t < 0.0), "{}: {ray:?}", mesh.name);
        }
    }
}

#[test]
#[ignore = "ten minutes"]
fn a_thousand_million_rays() {
    const RAYS: usize = 1_000_000_000;
    const SHARE: usize = 160_000;
    let meshes = closed_meshes(400);
    let (start, done) = (std::time::Instant::now(), AtomicUsize::new(0));
    let leaks: usize = (0..RAYS / SHARE)
        .into_par_iter()
        .map(|task| {
            let mesh = &meshes[task % meshes.len()];
            let leaks = mesh.leaks(Family::best(), 1_000_000 + task as u64, SHARE);
            if leaks > 0 {
                println!("{leaks} leaks, task {task}: {}", mesh.name);
            }
            let done = done.fetch_add(SHARE, Ordering::Relaxed) + SHARE;
            if done.is_multiple_of(RAYS / 50) {
                println!("{done} rays, {:.0?}", start.elapsed());
            }
            leaks
        })
        .sum();
    println!("{RAYS} rays, {leaks} leaks, {:.0?}", start.elapsed());
    assert_eq!(leaks, 0);
}
