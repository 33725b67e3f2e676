//! Ray and triangle: the same bits at every width, and what mathematics says where it is clear.

use glam::Vec3;
use occlude_kernel::{BatchScratch, Bvh, Counts, NO_TRIANGLE, Ray, RayPacket, Targets, TriangleBlock};
use occlude_tests::{
    Clear, Oracle, Random, Triangle, all_bits, bits, families, in_double, meshes, single_node,
};

/// Asks every query of every family about these triangles, which must be few, and wants the same bits.
fn agree(triangles: &[Triangle], rays: &[Ray]) {
    let (nodes, blocks) = single_node(triangles);
    let bvh = Bvh::new(&nodes, &blocks).expect("a sound tree");
    let oracle = Oracle::new(triangles);
    for on in families(bvh) {
        let width = on.family;
        for rays in rays.chunks(RayPacket::WIDTH) {
            let mut counts = Counts::default();
            let packet = RayPacket::new(rays);
            let active = ((1u32 << rays.len()) - 1) & 0xffff;
            let blocked = on.occluded_packet(&packet, active, None, &mut counts);
            let occluders = on.occluder_packet(&packet, active, None, &mut counts);
            let closest = on.closest_packet(&packet, active, None, &mut counts);
            let each = on.hits_packet(&packet, active, None);
            for (i, ray) in rays.iter().enumerate() {
                let want = oracle.hits(ray, None);
                let nearest = want.first();
                assert_eq!(all_bits(&on.hits(ray, None)), all_bits(&want), "{width}: {ray:?}");
                assert_eq!(all_bits(&each[i]), all_bits(&want), "{width}, packet: {ray:?}");
                let found = on.closest(ray, None, &mut counts);
                assert_eq!(found.as_ref().map(bits), nearest.map(bits), "{width}: {ray:?}");
                let found = (closest.hit >> i & 1 != 0).then_some(&closest.hits[i]);
                assert_eq!(found.map(bits), nearest.map(bits), "{width}, packet: {ray:?}");
                assert_eq!(on.occluded(ray, None, &mut counts), nearest.is_some(), "{width}: {ray:?}");
                assert_eq!(blocked >> i & 1 != 0, nearest.is_some(), "{width}, packet: {ray:?}");
                assert_eq!(occluders[i].is_some(), nearest.is_some(), "{width}, packet: {ray:?}");
            }
        }
        for ray in rays {
            let end = ray.origin + ray.direction;
            let segment = Ray::segment(ray.origin, end);
            let targets =
                Targets::new(&end.as_ref()[0..1], &end.as_ref()[1..2], &end.as_ref()[2..3]).unwrap();
            let mut blocked = [0];
            on.occluded_batch(
                ray.origin.into(),
                &targets,
                None,
                &mut Counts::default(),
                &mut BatchScratch::new(),
                &mut blocked,
            );
            assert_eq!(
                blocked[0] != 0,
                !oracle.hits(&segment, None).is_empty(),
                "{width}, batch: {segment:?}"
            );
        }
    }
}

/// Does the ray hit the triangle, whatever the width?
fn hits(triangle: Triangle, ray: Ray) -> bool {
    agree(&[triangle], &[ray]);
    !Oracle::new(&[triangle]).hits(&ray, None).is_empty()
}

const TRIANGLE: Triangle = [Vec3::new(-1.0, -1.0, 2.0), Vec3::new(1.0, -1.0, 2.0), Vec3::new(0.0, 1.0, 2.0)];

fn towards(target: Vec3) -> Ray {
    Ray::from([0.0; 3], target)
}

#[test]
fn random_rays_agree_with_double_precision() {
    let mut random = Random::new(1);
    let (mut hit, mut miss, mut unclear) = (0, 0, 0);
    for round in 0..300 {
        let scale = 10.0f32.powf(random.between(-4.0, 5.0));
        let shift = if round % 3 == 0 { random.point() * scale * 10.0 } else { Vec3::ZERO };
        let size = random.between(0.2, 2.0);
        let triangles = meshes::moved(&meshes::soup(&mut random, 16, size), scale, shift);
        let rays: Vec<Ray> = (0..16)
            .map(|i| {
                let x = random.point() * scale * 2.0 + shift;
                let y = if i % 2 == 0 {
                    random.point() * scale * 2.0 + shift
                } else {
                    random.on_triangle(&triangles[i]) * 2.0 - x
                };
                Ray::segment(x, y)
            })
            .collect();
        agree(&triangles, &rays);
        for triangle in &triangles {
            let oracle = Oracle::new(&[*triangle]);
            for ray in &rays {
                let found = oracle.hits(ray, None);
                match in_double(ray, triangle) {
                    Clear::Unclear => unclear += 1,
                    Clear::Miss => {
                        miss += 1;
                        assert!(found.is_empty(), "{ray:?} misses {triangle:?}");
                    }
                    Clear::Hit(t) => {
                        hit += 1;
                        assert_eq!(found.len(), 1, "{ray:?} hits {triangle:?} at {t}");
                        let near = (f64::from(found[0].t) - t).abs();
                        // In units of the way there and back: far-off scenes lose digits before the test begins.
                        let reach =
                            (ray.origin.length() + ray.at(found[0].t).length()) / ray.direction.length();
                        assert!(
                            near <= 1e-4 * f64::from(reach.max(1.0)),
                            "t of {ray:?}: {} and {t}",
                            found[0].t
                        );
                    }
                }
            }
        }
    }
    println!("hits {hit}, misses {miss}, unclear {unclear}");
    assert!(hit > 2000 && miss > 20_000);
}

#[test]
fn weights_give_the_point() {
    let mut random = Random::new(2);
    for _ in 0..2000 {
        let triangle = [0; 3].map(|_| random.point());
        let ray = Ray::segment(random.point() * 2.0, random.on_triangle(&triangle));
        let ray = Ray { t_max: 2.0, ..ray };
        for hit in Oracle::new(&[triangle]).hits(&ray, None) {
            let [a, b, c] = triangle;
            let point = a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v;
            let normal = (b - a).cross(c - a);
            let steep = normal.dot(ray.direction).abs() / ray.direction.length();
            if steep > 1e-2 {
                assert!(point.distance(ray.at(hit.t)) < 1e-4, "{triangle:?} {ray:?} {hit:?}");
            }
        }
    }
}

#[test]
fn nan_is_a_miss() {
    for component in 0..3 {
        let mut ray = towards(Vec3::Z);
        ray.origin[component] = f32::NAN;
        assert!(!hits(TRIANGLE, ray));
        let mut ray = towards(Vec3::Z);
        ray.direction[component] = f32::NAN;
        assert!(!hits(TRIANGLE, ray));
    }
    assert!(!hits(TRIANGLE, Ray { t_min: f32::NAN, ..towards(Vec3::Z) }));
    assert!(!hits(TRIANGLE, Ray { t_max: f32::NAN, ..towards(Vec3::Z) }));
}

#[test]
fn infinities_are_misses() {
    for infinity in [f32::INFINITY, f32::NEG_INFINITY] {
        for component in 0..3 {
            let mut ray = towards(Vec3::Z);
            ray.origin[component] = infinity;
            assert!(!hits(TRIANGLE, ray));
            let mut ray = towards(Vec3::Z);
            ray.direction[component] = infinity;
            assert!(!hits(TRIANGLE, ray));
        }
    }
    assert!(!hits(TRIANGLE, Ray { t_min: f32::INFINITY, ..towards(Vec3::Z) }));
    assert!(!hits(TRIANGLE, Ray { t_max: f32::NEG_INFINITY, ..towards(Vec3::Z) }));
    assert!(hits(TRIANGLE, Ray { t_max: f32::INFINITY, ..towards(Vec3::Z) }));
    // A line rather than a ray: also what lies behind.
    assert!(hits(TRIANGLE, Ray { t_min: f32::NEG_INFINITY, ..towards(-Vec3::Z) }));
}

#[test]
fn zero_direction() {
    assert!(!hits(TRIANGLE, towards(Vec3::ZERO)));
    assert!(!hits(TRIANGLE, Ray::from([0.0, 0.0, 2.0], [0.0, 0.0, -0.0])));
}

#[test]
fn empty_range() {
    assert!(!hits(TRIANGLE, Ray::new([0.0; 3], Vec3::Z, 2.0, 2.0)));
    assert!(!hits(TRIANGLE, Ray::new([0.0; 3], Vec3::Z, 3.0, 1.0)));
}

#[test]
fn behind() {
    assert!(!hits(TRIANGLE, towards(-Vec3::Z)));
    assert!(hits(TRIANGLE, Ray::new([0.0; 3], -Vec3::Z, -3.0, 0.0)));
}

#[test]
fn both_sides() {
    let [a, b, c] = TRIANGLE;
    for triangle in [[a, b, c], [a, c, b], [c, b, a]] {
        assert!(hits(triangle, towards(Vec3::Z)));
        assert!(hits(triangle, Ray::from([0.1, 0.1, 5.0], -Vec3::Z)));
    }
}

#[test]
fn t_max_exactly_at_the_hit() {
    let ray = towards(Vec3::Z);
    assert!(hits(TRIANGLE, Ray { t_max: 2.0, ..ray }));
    assert!(!hits(TRIANGLE, Ray { t_max: 2.0f32.next_down(), ..ray }));
}

#[test]
fn t_min_exactly_at_the_hit() {
    let ray = towards(Vec3::Z);
    assert!(!hits(TRIANGLE, Ray { t_min: 2.0, ..ray }));
    assert!(hits(TRIANGLE, Ray { t_min: 2.0f32.next_down(), ..ray }));
}

#[test]
fn ends_at_computed_hits_agree() {
    let mut random = Random::new(3);
    for _ in 0..300 {
        let triangles = meshes::soup(&mut random, 8, 1.0);
        let mut rays = Vec::new();
        for triangle in &triangles {
            let ray = Ray::from(random.point() * 2.0, random.direction() * random.any_scale(-2.0, 2.0));
            let ray = Ray { direction: random.on_triangle(triangle) - ray.origin, ..ray };
            for hit in Oracle::new(&triangles).hits(&ray, None) {
                for t in [hit.t.next_down(), hit.t, hit.t.next_up()] {
                    rays.extend([Ray { t_max: t, ..ray }, Ray { t_min: t, ..ray }]);
                }
            }
        }
        agree(&triangles, &rays);
    }
}

#[test]
fn point_on_the_plane() {
    // From a point of the triangle its plane lies at t = 0, which is not part of the ray.
    for towards in [Vec3::Z, -Vec3::Z, Vec3::new(0.3, -0.2, 0.4)] {
        assert!(!hits(TRIANGLE, Ray::from([0.0, 0.0, 2.0], towards)));
    }
    // Within the plane: seen edge-on, so missed.
    for towards in [Vec3::X, Vec3::Y, Vec3::new(0.3, -0.2, 0.0)] {
        assert!(!hits(TRIANGLE, Ray::from([0.0, 0.0, 2.0], towards)));
        assert!(!hits(TRIANGLE, Ray::from([-5.0, 0.0, 2.0], towards)));
    }
}

#[test]
fn within_a_tilted_plane() {
    let mut random = Random::new(4);
    for _ in 0..500 {
        let triangles: Vec<Triangle> = {
            let turn = meshes::rotation(&mut random);
            let shift = random.point();
            (0..8)
                .map(|_| [0; 3].map(|_| turn * (random.point() * Vec3::new(1.0, 1.0, 0.0)) + shift))
                .collect()
        };
        let rays: Vec<Ray> = (0..16)
            .map(|i| {
                let x = random.on_triangle(&triangles[i % 8]);
                let y = random.on_triangle(&triangles[(i + 1) % 8]);
                if i % 3 == 0 { Ray::from(x, y - x) } else { Ray::segment(x, y) }
            })
            .collect();
        agree(&triangles, &rays);
    }
}

#[test]
fn shared_edge() {
    // Two triangles of a square; the ray meets the diagonal, both sides answer, or at least one does.
    let square = |turn: glam::Mat3| {
        let corner = |x: f32, y: f32| turn * Vec3::new(x, y, 2.0);
        let [a, b, c, d] = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        [[a, b, c], [a, c, d]]
    };
    let mut random = Random::new(5);
    for _ in 0..2000 {
        let triangles = square(meshes::rotation(&mut random));
        let [a, _, c] = triangles[0];
        let origin = random.point() * 0.2;
        let ray = Ray::from(origin, a.lerp(c, random.between(0.05, 0.95)) - origin);
        assert!(!Oracle::new(&triangles).hits(&ray, None).is_empty(), "{triangles:?} {ray:?}");
        agree(&triangles, &[ray]);
    }
}

#[test]
fn shared_vertex() {
    let mut random = Random::new(6);
    for _ in 0..2000 {
        let turn = meshes::rotation(&mut random);
        let centre = turn * Vec3::new(random.between(-0.3, 0.3), random.between(-0.3, 0.3), 2.0);
        let rim: Vec<Vec3> = (0..7)
            .map(|i| {
                let (y, x) = (i as f32 * std::f32::consts::TAU / 7.0).sin_cos();
                turn * Vec3::new(x, y, 2.0 + random.between(-0.1, 0.1))
            })
            .collect();
        let fan: Vec<Triangle> = (0..7).map(|i| [centre, rim[i], rim[(i + 1) % 7]]).collect();
        let origin = random.point() * 0.2;
        let ray = Ray::from(origin, centre - origin);
        assert!(!Oracle::new(&fan).hits(&ray, None).is_empty(), "{fan:?} {ray:?}");
        agree(&fan, &[ray]);
    }
}

#[test]
fn slivers_agree() {
    let mut random = Random::new(7);
    for _ in 0..300 {
        let triangles = meshes::slivers(&mut random, 16);
        let rays: Vec<Ray> = (0..16)
            .map(|i| {
                let x = random.point() * 2.0;
                let target = match i % 3 {
                    0 => triangles[i][0],
                    1 => triangles[i][0].lerp(triangles[i][1], random.unit()),
                    _ => random.on_triangle(&triangles[i]),
                };
                Ray::from(x, target - x)
            })
            .collect();
        agree(&triangles, &rays);
    }
}

#[test]
fn degenerate_triangles_are_missed() {
    let (a, b) = (Vec3::new(-1.0, 0.0, 2.0), Vec3::new(1.0, 0.0, 2.0));
    for triangle in [[a, a, a], [a, a, b], [a, b, a], [b, a, a], [a, b, Vec3::new(0.0, 0.0, 2.0)]] {
        assert!(!hits(triangle, towards(a)));
        assert!(!hits(triangle, towards(Vec3::Z)));
        assert!(!hits(triangle, towards(Vec3::new(0.5, 0.0, 2.0))));
    }
}

#[test]
fn unused_lanes_are_missed() {
    for used in 0..=TriangleBlock::WIDTH {
        let mut block = TriangleBlock::EMPTY;
        for lane in 0..used {
            block.set(lane, TRIANGLE.map(|vertex| vertex.to_array()), lane as u32);
        }
        assert_eq!(block.len(), used);
        assert_eq!(block.is_empty(), used == 0);
        assert!((used..TriangleBlock::WIDTH).all(|lane| block.ids[lane] == NO_TRIANGLE));
        let (nodes, _) = single_node(&[[Vec3::splat(-3.0), Vec3::splat(3.0), Vec3::ZERO]]);
        let blocks = [block];
        for on in families(Bvh::new(&nodes, &blocks).unwrap()) {
            // Unused lanes stand at the origin, and the ray goes through it.
            let ray = Ray::from([0.0, 0.0, -1.0], Vec3::Z);
            assert_eq!(on.hits(&ray, None).len(), used, "{}", on.family);
            let packet = RayPacket::new(&[ray; 16]);
            assert!(on.hits_packet(&packet, 0xffff, None).iter().all(|hits| hits.len() == used));
        }
    }
}

#[test]
fn denormals_agree() {
    let mut random = Random::new(8);
    for scale in [1e-45, 1e-42, 1e-38, 1e-30, 1e-25, 1e-20, 1e-12] {
        for _ in 0..20 {
            let triangles = meshes::moved(&meshes::soup(&mut random, 16, 1.0), scale, Vec3::ZERO);
            let rays: Vec<Ray> = (0..32)
                .map(|i| match i % 3 {
                    0 => Ray::segment(random.point() * scale, random.point() * scale),
                    1 => Ray::from(random.point() * scale, random.direction()),
                    _ => Ray::from(random.point(), random.point() * scale),
                })
                .collect();
            agree(&triangles, &rays);
        }
    }
}

#[test]
fn short_and_long_directions_agree() {
    let mut random = Random::new(9);
    for _ in 0..100 {
        let triangles = meshes::soup(&mut random, 16, 1.0);
        let rays: Vec<Ray> = (0..32)
            .map(|i| {
                let x = random.point() * 2.0;
                let mut direction = random.on_triangle(&triangles[i % 16]) - x;
                if i % 4 == 0 {
                    direction[i / 4 % 3] *= random.any_scale(-30.0, -5.0);
                }
                Ray::from(x, direction * random.any_scale(-26.0, 30.0))
            })
            .collect();
        agree(&triangles, &rays);
    }
}

#[test]
fn huge_numbers_agree() {
    let mut random = Random::new(10);
    for scale in [1e5f32, 1e8, 1e12, 1e15, 1e18, 1e25, 1e37] {
        for _ in 0..20 {
            let soup = meshes::soup(&mut random, 16, 1.0);
            // Beyond this only rays may be.
            let triangles = meshes::moved(&soup, scale.min(3e9), Vec3::ZERO);
            let rays: Vec<Ray> = (0..32)
                .map(|i| match i % 4 {
                    0 => Ray::segment(random.point() * scale, random.point() * scale),
                    1 => Ray::from(random.point() * scale, random.direction()),
                    2 => Ray::from(random.point() * scale, random.direction() * 1e-20),
                    _ => Ray::from(random.point(), random.point() * scale),
                })
                .collect();
            agree(&triangles, &rays);
        }
    }
}

#[test]
fn every_lane_and_every_place_answer() {
    let mut random = Random::new(11);
    let ray = towards(Vec3::Z);
    for lane in 0..8 {
        for place in 0..16 {
            let far = Vec3::new(50.0, 0.0, 0.0);
            let mut triangles: Vec<Triangle> = (0..8).map(|_| TRIANGLE.map(|vertex| vertex + far)).collect();
            triangles[lane] = TRIANGLE;
            let mut rays = [Ray::from(random.point(), -Vec3::Z); 16];
            rays[place] = ray;
            agree(&triangles, &rays);
        }
    }
}
