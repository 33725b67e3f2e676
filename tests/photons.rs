//! Photons: look-ups against a sorted list, and what a shower of them says about a scene.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::generate::{Kind, generate};
use occlude_host::light::{AreaLight, lights};
use occlude_host::photons::{BlockerKind, BlockerSet, Shower};
use occlude_host::scene::{CameraRequest, Scene, load};
use occlude_kernel::lanes::{self, Task};
use occlude_kernel::photons::{
    Blockers, Class, GridCell, Nearest, Neighbour, OcclusionPhoton, PhotonBlock, PhotonGrid, PhotonId,
    PhotonMap, PhotonTree, Photons, Place, Point, Split,
};
use occlude_kernel::{Native, Simd};
use occlude_tests::{Family, Oracle, Random};

/// Points to look up among, by the shape of the crowd.
fn crowds() -> Vec<(&'static str, Vec<Vec3>)> {
    let mut random = Random::new(5);
    type At = Box<dyn FnMut(&mut Random, usize) -> Vec3>;
    let mut many =
        |count: usize, mut at: At| -> Vec<Vec3> { (0..count).map(|i| at(&mut random, i)).collect() };
    vec![
        ("empty", Vec::new()),
        ("one", vec![Vec3::new(0.5, -0.25, 2.0)]),
        ("seven", many(7, Box::new(|r, _| r.point()))),
        ("eight", many(8, Box::new(|r, _| r.point()))),
        ("thirty-three", many(33, Box::new(|r, _| r.point()))),
        ("even", many(3000, Box::new(|r, _| r.point()))),
        ("on a plane", many(2000, Box::new(|r, _| r.point() * Vec3::new(1.0, 0.0, 1.0)))),
        ("on a line", many(1000, Box::new(|r, _| Vec3::new(r.unit(), 0.0, 0.0)))),
        ("all alike", many(500, Box::new(|_, _| Vec3::splat(0.25)))),
        (
            "on a lattice",
            many(1000, Box::new(|_, i| Vec3::new((i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32))),
        ),
        ("in clusters", many(2000, Box::new(|r, i| r.point() * 1e-3 + Vec3::splat((i % 7) as f32)))),
        (
            "of all scales",
            many(
                1500,
                Box::new(|r, _| {
                    Vec3::new(r.any_scale(-6.0, 6.0), r.any_scale(-6.0, 6.0), r.any_scale(-6.0, 6.0))
                }),
            ),
        ),
        (
            "twice each",
            many(1200, Box::new(|_, i| Vec3::new((i / 2) as f32 * 0.01, ((i / 2) % 13) as f32, 0.0))),
        ),
        (
            "beside infinity",
            many(
                100,
                Box::new(|r, i| {
                    if i % 9 == 0 {
                        Vec3::new(f32::INFINITY, if i % 2 == 0 { f32::NAN } else { 0.0 }, 0.0)
                    } else {
                        r.point()
                    }
                }),
            ),
        ),
    ]
}

fn points(crowd: &[Vec3]) -> Vec<PhotonBlock> {
    let mut blocks = vec![PhotonBlock::EMPTY; crowd.len().div_ceil(PhotonBlock::WIDTH)];
    for ((point, position), i) in PhotonBlock::as_points(&mut blocks).iter_mut().zip(crowd).zip(0..) {
        let id = if i % 3 == 0 { PhotonId::light(i) } else { PhotonId::occlusion(i) };
        *point = Point { position: position.to_array(), id };
    }
    blocks
}

/// The k nearest by sorting everything.
fn sorted_list(crowd: &[Vec3], place: &Place, radius: f32, k: usize) -> Vec<(u32, PhotonId)> {
    let mut all: Vec<(u32, PhotonId)> = crowd
        .iter()
        .zip(0u32..)
        .map(|(&p, i)| {
            let id = if i % 3 == 0 { PhotonId::light(i) } else { PhotonId::occlusion(i) };
            (place.distance_squared(p), id)
        })
        .filter(|(square, _)| radius >= 0.0 && *square <= radius * radius && square.is_finite())
        .map(|(square, id)| (square.to_bits(), id))
        .collect();
    all.sort_unstable();
    all.truncate(k);
    all
}

struct Look<'a, 'n> {
    map: PhotonMap<'a>,
    place: &'a Place,
    nearest: &'a mut Nearest<'n>,
}

impl Task for Look<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.map.on(simd).nearest(self.place, self.nearest);
    }
}

struct LookGrid<'a, 'n> {
    grid: PhotonGrid<'a>,
    place: &'a Place,
    nearest: &'a mut Nearest<'n>,
}

impl Task for LookGrid<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.grid.on(simd).nearest(self.place, self.nearest);
    }
}

fn told(nearest: &mut Nearest<'_>) -> Vec<(u32, PhotonId)> {
    nearest.sorted().iter().map(|n| (n.distance_squared().to_bits(), n.id())).collect()
}

#[test]
fn tree_and_grid_find_what_a_sorted_list_finds_at_every_width() {
    let mut random = Random::new(11);
    for (name, crowd) in crowds() {
        let mut blocks = points(&crowd);
        let mut splits = vec![Split::NONE; blocks.len()];
        PhotonTree::new(&mut blocks, &mut splits).expect("as many").build();
        let map = PhotonMap::new(&blocks, &splits).expect("a map");
        let mut cells = vec![GridCell::NONE; PhotonGrid::table(crowd.len())];
        let mut in_cells = points(&crowd);
        let edge = [0.01, 0.1, 1.0, 300.0][random.below(4)];
        let grid = PhotonGrid::build(&mut in_cells, &mut cells, edge).expect("a grid");
        for round in 0..60 {
            let x = match round % 3 {
                0 if !crowd.is_empty() => crowd[random.below(crowd.len())],
                1 => random.point() * 3.0,
                _ => random.point(),
            };
            let radius = [f32::INFINITY, 0.0, 0.05, 0.4, 2.0, -1.0, f32::NAN, 1e-30][round % 8];
            let k = [0, 1, 3, 8, 50, 200, 5000][random.below(7)];
            let place = if round % 2 == 0 {
                Place::ball(x, radius)
            } else {
                Place::disc(x, random.direction(), radius, random.between(0.0, 6.0))
            };
            let expected = sorted_list(&crowd, &place, radius, k);
            let mut slots = vec![Neighbour::NONE; Nearest::room(k)];
            for family in Family::all() {
                let mut nearest = Nearest::new(k, &mut slots).expect("room");
                family.run(Look { map, place: &place, nearest: &mut nearest });
                assert_eq!(told(&mut nearest), expected, "tree, {name}, {family}, {place:?}, k = {k}");
                family.run(LookGrid { grid, place: &place, nearest: &mut nearest });
                assert_eq!(told(&mut nearest), expected, "grid {edge}, {name}, {family}, {place:?}, k = {k}");
            }
        }
    }
}

#[test]
fn a_disc_leaves_out_what_is_behind_the_surface() {
    // Two sheets, 0.1 apart.
    let mut random = Random::new(3);
    let crowd: Vec<Vec3> = (0..2000)
        .map(|i| random.point() * Vec3::new(1.0, 1.0, 0.0) + Vec3::Z * if i % 2 == 0 { 0.0 } else { -0.1 })
        .collect();
    let mut blocks = points(&crowd);
    let mut splits = vec![Split::NONE; blocks.len()];
    PhotonTree::new(&mut blocks, &mut splits).expect("as many").build();
    let map = PhotonMap::new(&blocks, &splits).expect("a map");
    let mut slots = vec![Neighbour::NONE; Nearest::room(200)];
    let mut nearest = Nearest::new(200, &mut slots).expect("room");
    let behind = |nearest: &Nearest<'_>| nearest.found().iter().filter(|n| n.id().index() % 2 == 1).count();
    map.nearest(&Place::ball(Vec3::ZERO, 0.3), &mut nearest);
    assert!(behind(&nearest) > 20);
    map.nearest(&Place::disc(Vec3::ZERO, Vec3::Z, 0.3, 4.0), &mut nearest);
    assert_eq!((behind(&nearest), nearest.found().is_empty()), (0, false));
}

#[test]
fn too_little_room_and_damaged_slices_are_refused() {
    let mut slots = vec![Neighbour::NONE; Nearest::room(8) - 1];
    assert!(Nearest::new(8, &mut slots).is_none());
    assert!(Nearest::new(usize::MAX, &mut slots).is_none());
    let mut blocks = vec![PhotonBlock::EMPTY; 3];
    assert!(PhotonTree::new(&mut blocks, &mut [Split::NONE; 2]).is_none());
    assert!(PhotonMap::new(&blocks, &[Split::NONE; 2]).is_err());
    let bad: Split = bytemuck::cast([0u32, 3]);
    let message = PhotonMap::new(&blocks, &[Split::NONE, bad, Split::NONE]).unwrap_err().to_string();
    assert!(message.contains("split 1"), "{message}");
    for (edge, cells) in [(0.0, 64), (f32::NAN, 64), (-1.0, 64), (1.0, 63), (1e-42, 64), (f32::INFINITY, 64)]
    {
        assert!(
            PhotonGrid::build(&mut blocks, &mut vec![GridCell::NONE; cells], edge).is_none(),
            "{edge} {cells}"
        );
    }
    let mut crowd = points(&[Vec3::ZERO, Vec3::X]);
    assert!(PhotonGrid::build(&mut crowd, &mut [GridCell::NONE; 2], 0.1).is_none(), "full");
}

#[test]
fn three_cases_and_the_union_of_the_names() {
    // Light photons at x < 0, occlusion photons at x > 0; names overlap.
    let names = [7, 3, 9, 3, 3, 11];
    let occlusion = |position, first, len| OcclusionPhoton { position, light: 0, first, len };
    let dark = [
        occlusion([1.0, 0.0, 0.0], 0, 3),
        occlusion([1.1, 0.0, 0.0], 3, 3),
        occlusion([5.0, 0.0, 0.0], 5, 1),
    ];
    let mut blocks = [PhotonBlock::EMPTY; 1];
    let all = PhotonBlock::as_points(&mut blocks);
    all[0] = Point { position: [-1.0, 0.0, 0.0], id: PhotonId::light(0) };
    for (i, photon) in dark.iter().enumerate() {
        all[i + 1] = Point { position: photon.position, id: PhotonId::occlusion(i as u32) };
    }
    let mut splits = [Split::NONE];
    PhotonTree::new(&mut blocks, &mut splits).expect("as many").build();
    let map = PhotonMap::new(&blocks, &splits).expect("a map").on(Native);
    assert!(Photons::new(map, &dark[..2], &names).is_err());
    assert_eq!(Photons::new(map, &dark, &names[..5]).unwrap_err().photon, 1);
    let photons = Photons::new(map, &dark, &names).expect("sound");
    let mut slots = [Neighbour::NONE; Nearest::room(3)];
    let mut nearest = Nearest::new(3, &mut slots).expect("room");
    let mut room = [0; 8];
    let mut ask = |x: f32, radius: f32, room: &mut [u32]| match photons.classify(
        &Place::ball([x, 0.0, 0.0], radius),
        &mut nearest,
        room,
    ) {
        Class::Penumbra(Blockers { list, dropped }) => Err((list.to_vec(), dropped)),
        other => Ok(format!("{other:?}")),
    };
    assert_eq!(ask(-1.0, 0.5, &mut room), Ok("Lit".into()));
    assert_eq!(ask(1.0, 0.5, &mut room), Ok("Dark".into()));
    assert_eq!(ask(-9.0, 0.5, &mut room), Ok("Unknown".into()));
    assert_eq!(ask(0.0, 2.0, &mut room), Err((vec![3, 7, 9, 11], 0)));
    assert_eq!(ask(0.0, 2.0, &mut [0; 4]), Err((vec![3, 7, 9, 11], 0)), "just enough room");
    let (list, dropped) = ask(0.0, 2.0, &mut [0; 3]).unwrap_err();
    assert_eq!((list.len(), dropped > 0), (3, true));
}

/// Photons of later rounds, against a loop over all of them.
#[test]
fn later_photons_only_object() {
    let mut random = Random::new(23);
    let mut seen = [0; 5];
    for round in 0..1500 {
        // Light photons at x < 0, mostly; each occlusion photon names a blocker of its own.
        let spread = random.between(0.0, 0.4);
        let counts = [random.below(60), random.below(200)];
        let mut crowd: [Vec<(Vec3, PhotonId)>; 2] = [Vec::new(), Vec::new()];
        let (mut lit, mut dark) = (0, Vec::new());
        for (part, &count) in crowd.iter_mut().zip(&counts) {
            for _ in 0..count {
                let at = random.point();
                if at.x + spread * random.between(-1.0, 1.0) < 0.0 {
                    part.push((at, PhotonId::light(lit)));
                    lit += 1;
                } else {
                    let id = dark.len() as u32;
                    part.push((at, PhotonId::occlusion(id)));
                    dark.push(OcclusionPhoton { position: at.to_array(), light: 0, first: id, len: 1 });
                }
            }
        }
        let names: Vec<u32> = (0..dark.len() as u32).map(|name| 3 * name).collect();
        let maps = crowd.each_ref().map(|part| {
            let mut blocks = vec![PhotonBlock::EMPTY; part.len().div_ceil(8)];
            for (point, &(at, id)) in PhotonBlock::as_points(&mut blocks).iter_mut().zip(part) {
                *point = Point { position: at.to_array(), id };
            }
            let mut splits = vec![Split::NONE; blocks.len()];
            PhotonTree::new(&mut blocks, &mut splits).expect("as many").build();
            (blocks, splits)
        });
        let [even, later] = maps.each_ref().map(|(b, s)| PhotonMap::new(b, s).expect("a map"));
        let alone = Photons::new(even, &dark, &names).expect("sound");
        let both = alone.with_later(later).expect("sound");
        if dark.len() > 1 {
            assert!(Photons::new(even, &dark[..1], &names).and_then(|p| p.with_later(later)).is_err());
        }
        let (k, most) = ([1, 4, 10][round % 3], [0, 3, 1000][round / 3 % 3]);
        let radius = [0.2, 0.5, 4.0][round % 3];
        let x = random.point();
        let place = if round % 2 == 0 {
            Place::ball(x, radius)
        } else {
            Place::disc(x, random.direction(), radius, 3.0)
        };
        let near = |part: &[(Vec3, PhotonId)], reach: f32| {
            let far = |&(at, id): &(Vec3, PhotonId)| (place.distance_squared(at), id);
            let mut all: Vec<_> = part.iter().map(far).filter(|(square, _)| *square <= reach).collect();
            all.sort_by(|a, b| a.partial_cmp(b).expect("numbers"));
            all
        };
        let mut expected = near(&crowd[0], radius * radius);
        expected.truncate(k);
        if !expected.is_empty() && most > 0 {
            let last = expected.last().map_or(0.0, |(square, _)| *square);
            let reach = if expected.len() == k { last.sqrt() * last.sqrt() } else { radius * radius };
            let mut more = near(&crowd[1], reach);
            more.truncate(most);
            expected.extend(more);
        }
        let light = expected.iter().filter(|(_, id)| id.is_light()).count();
        let mut named: Vec<u32> =
            expected.iter().filter(|(_, id)| !id.is_light()).map(|(_, id)| 3 * id.index() as u32).collect();
        named.sort_unstable();
        let want = match (expected.len(), light) {
            (0, _) => Class::Unknown,
            (all, light) if all == light => Class::Lit,
            (_, 0) => Class::Dark,
            _ => Class::Penumbra(Blockers { list: &named, dropped: 0 }),
        };
        let spare = if most == 0 { 0 } else { Nearest::room(most) };
        let mut slots = vec![Neighbour::NONE; Nearest::room(k) + spare];
        let mut nearest = Nearest::new(k, &mut slots).expect("room");
        let (mut room, mut other) = ([0; 512], [0; 512]);
        let told = both.classify(&place, &mut nearest, &mut room);
        assert_eq!(told, want, "round {round}");
        // A later photon objects, or changes nothing.
        let without = alone.classify(&place, &mut nearest, &mut other);
        match (without, told) {
            (Class::Penumbra(few), Class::Penumbra(all)) => {
                assert!(few.list.iter().all(|name| all.list.contains(name)));
                seen[usize::from(few.list.len() < all.list.len())] += 1;
            }
            (Class::Lit, Class::Penumbra(_)) => seen[2] += 1,
            (Class::Dark, Class::Penumbra(_)) => seen[3] += 1,
            (before, after) => {
                assert_eq!(before, after);
                seen[4] += 1;
            }
        }
    }
    assert!(seen.iter().all(|&count| count > 10), "{seen:?}");
}

/// A lamp over two crossed boards, a slab with a hole and a floor.
fn boards() -> Scene {
    let text = "o lamp\nv -1 4 -1\nv 1 4 -1\nv 1 4 1\nv -1 4 1\nusemtl lamp\nf 1 2 3 4\n\
        o floor\nv -6 0 -6\nv -6 0 6\nv 6 0 6\nv 6 0 -6\nusemtl grey\nf 5 6 7 8\n\
        o first\nv -2 2 -2\nv -2 2 1\nv 1 2 1\nv 1 2 -2\nf 9 10 11 12\n\
        o second\nv -1 1 -1\nv -1 1.3 2\nv 2 1 2\nv 2 0.7 -1\nf 13 14 15\nf 13 15 16\n\
        o spot\nv 3 3 0\nv 3.2 3 0\nv 3 3 0.4\nusemtl spot\nf 17 19 18\n";
    let folder = tempfile::tempdir().expect("a folder");
    let materials = "newmtl lamp\nKe 3 3 3\nnewmtl grey\nKd 0.5 0.5 0.5\nnewmtl spot\nKe 40 20 10\n";
    std::fs::write(folder.path().join("scene.obj"), format!("mtllib scene.mtl\n{text}")).expect("written");
    std::fs::write(folder.path().join("scene.mtl"), materials).expect("written");
    load(folder.path(), &CameraRequest::default()).expect("a scene")
}

fn shower<'a>(accel: &'a Accel, lights: &'a [AreaLight], blockers: &'a BlockerSet, lines: u64) -> Shower<'a> {
    Shower { bvh: accel.bvh(), lights, blockers, lines, seed: 7, level: lanes::detect() }
}

#[test]
fn photons_and_their_blockers_are_those_of_a_loop_over_all_triangles() {
    for scene in [boards(), generate(Kind::Spheres, 3, 600)] {
        let accel = Accel::build(&scene, Quality::Medium);
        let lights = lights(&scene);
        let corners: Vec<_> = (0..scene.triangles.len() as u32).map(|i| scene.vertices(i)).collect();
        let oracle = Oracle::new(&corners);
        for kind in [BlockerKind::Triangle, BlockerKind::Object, BlockerKind::Treelet(16)] {
            let blockers = BlockerSet::new(kind, &scene, &accel.bvh(), Quality::Fast);
            let shower = shower(&accel, &lights, &blockers, 1500);
            let store = shower.shoot();
            let firsts = shower.shares();
            let clearance = accel.bvh().clearance();
            let (mut light, mut occlusion) = (store.light().iter(), store.occlusion().iter());
            for line in 0..1500 {
                let of = firsts[1..].partition_point(|&end| end <= line) as u32;
                let ray = shower.ray(line, of);
                let hits = oracle.hits(&ray, None);
                let (mut named, mut surface): (Vec<u32>, Option<f32>) = (Vec::new(), None);
                let mut waiting: Vec<u32> = Vec::new();
                for hit in hits {
                    if surface.is_none_or(|t| hit.t > t + clearance) {
                        for &triangle in &waiting {
                            let blocker = blockers.of(triangle);
                            if !named.contains(&blocker) {
                                named.push(blocker);
                            }
                        }
                        waiting.clear();
                        if surface.is_none() {
                            let photon = light.next().expect("a light photon");
                            assert_eq!((photon.position, photon.light), (ray.at(hit.t).to_array(), of));
                        } else {
                            let photon = occlusion.next().expect("an occlusion photon");
                            assert_eq!((photon.position, photon.light), (ray.at(hit.t).to_array(), of));
                            assert_eq!(store.named(photon), named, "{kind}, line {line}");
                        }
                        surface = Some(hit.t);
                    }
                    waiting.push(hit.triangle);
                }
            }
            assert!(light.next().is_none() && occlusion.next().is_none());
            assert!(store.occlusion().len() > 300 && store.stats.dropped_blockers == 0);
        }
    }
}

#[test]
fn treelets_hold_every_triangle_once_and_no_more_than_asked() {
    let scene = generate(Kind::Spheres, 1, 5000);
    let accel = Accel::build(&scene, Quality::Fast);
    for size in [8, 64, 1000, 1_000_000] {
        let set = BlockerSet::new(BlockerKind::Treelet(size), &scene, &accel.bvh(), Quality::Fast);
        let mut sizes = vec![0; set.count(scene.triangles.len())];
        (0..scene.triangles.len() as u32).for_each(|i| sizes[set.of(i) as usize] += 1);
        assert!(sizes.iter().all(|&count| count > 0 && count <= size), "{size}");
        assert_eq!(sizes.len() == 1, size == 1_000_000);
    }
}

#[test]
fn any_number_of_threads_shoots_the_same_photons() {
    let scene = boards();
    let accel = Accel::build(&scene, Quality::Fast);
    let lights = lights(&scene);
    let blockers = BlockerSet::new(BlockerKind::Triangle, &scene, &accel.bvh(), Quality::Fast);
    let shot = |rounds, threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let shower = shower(&accel, &lights, &blockers, 60_000);
        let store = pool.install(|| shower.shoot_in_rounds(rounds, &scene));
        assert_eq!((store.stats.rounds, store.stats.lines), (rounds, 60_000));
        let maps: Vec<Vec<u8>> = store
            .by_light()
            .iter()
            .flat_map(|photons| [Some(photons.map()), photons.later()])
            .flatten()
            .map(|map| bytemuck::cast_slice(map.blocks()).to_vec())
            .collect();
        assert_eq!(maps.len(), if rounds > 1 { 4 } else { 2 }, "two lights");
        let names: Vec<Vec<u32>> =
            store.occlusion().iter().map(|photon| store.named(photon).to_vec()).collect();
        (store.light().to_vec(), store.occlusion().to_vec(), names, maps)
    };
    for rounds in [1, 2, 4] {
        let one = shot(rounds, 1);
        assert!(one == shot(rounds, 2) && one == shot(rounds, 5));
    }
    assert!(shot(1, 2).0 != shot(2, 2).0);
    let even = shower(&accel, &lights, &blockers, 60_000).shoot();
    assert!(even.light() == shot(1, 2).0);
}

/// Half of the lines of rounds are even: as if no more had been asked for. Of the other half more meet a border than of
/// the even ones.
#[test]
fn rounds_begin_evenly_and_go_where_shadows_end() {
    let scene = boards();
    let accel = Accel::build(&scene, Quality::Fast);
    let lights = lights(&scene);
    let blockers = BlockerSet::new(BlockerKind::Triangle, &scene, &accel.bvh(), Quality::Fast);
    let store = shower(&accel, &lights, &blockers, 40_000).shoot_in_rounds(3, &scene);
    let half = shower(&accel, &lights, &blockers, 20_000).shoot();
    assert_eq!((store.stats.later_lines, half.stats.later_lines), (20_000, 0));
    let ids = |blocks: &[PhotonBlock]| {
        blocks.iter().flat_map(|block| block.ids).filter(|id| *id != PhotonId::NONE).count()
    };
    let even = half.by_light()[0];
    for (rounds, alone) in store.by_light().iter().zip(half.by_light()) {
        assert_eq!(ids(rounds.map().blocks()), ids(alone.map().blocks()));
    }
    // On the floor, where the lamp is seen in part: between the shadows of the boards' ends.
    let share = |map: PhotonMap<'_>| {
        let (mut near, mut all) = (0, 0);
        let mut room = [0; 512];
        let mut slots = vec![Neighbour::NONE; Nearest::room(24)];
        let mut nearest = Nearest::new(24, &mut slots).expect("room");
        for block in map.blocks() {
            for lane in (0..8).filter(|&lane| block.ids[lane] != PhotonId::NONE) {
                let at = [0, 1, 2].map(|axis| block.position[axis][lane]);
                let class = even.classify(&Place::ball(at, 1.0), &mut nearest, &mut room);
                near += u32::from(matches!(class, Class::Penumbra(_)));
                all += 1;
            }
        }
        f64::from(near) / f64::from(all)
    };
    let rounds = store.by_light()[0];
    let (before, after) = (share(rounds.map()), share(rounds.later().expect("later rounds")));
    assert!(after > 1.2 * before && before > 0.05, "{before} {after}");
}

#[test]
fn lights_get_lines_in_proportion_to_their_power() {
    let scene = boards();
    let accel = Accel::build(&scene, Quality::Fast);
    let lights = lights(&scene);
    let blockers = BlockerSet::new(BlockerKind::Triangle, &scene, &accel.bvh(), Quality::Fast);
    let shares = shower(&accel, &lights, &blockers, 100_000).shares();
    let power: Vec<f64> = lights.iter().map(|light| f64::from(light.power().element_sum())).collect();
    let total: f64 = power.iter().sum();
    assert_eq!((lights.len(), shares.len(), shares[2]), (2, 3, 100_000));
    // Systematic: closer than any sampling, so no test of significance is called for.
    for (light, lines) in shares.windows(2).enumerate() {
        let due = 100_000.0 * power[light] / total;
        assert!(((lines[1] - lines[0]) as f64 - due).abs() <= 1.0, "{light}");
    }
}

/// Chi squared over 8 x 8 cells, 63 degrees of freedom: above 114.8 with a chance of 1 in 10 000 each.
#[test]
fn lines_leave_uniform_points_in_cosine_distributed_directions() {
    let scene = boards();
    let accel = Accel::build(&scene, Quality::Fast);
    let lights = lights(&scene);
    let blockers = BlockerSet::new(BlockerKind::Triangle, &scene, &accel.bvh(), Quality::Fast);
    let shower = shower(&accel, &lights, &blockers, 64_000);
    let light = &lights[0];
    let (u, v) = light.normal.any_orthonormal_pair();
    let (mut by_direction, mut by_point) = ([0u32; 64], [0u32; 64]);
    for line in 0..64_000 {
        let ray = shower.ray(line, 0);
        let cosine = ray.direction.dot(light.normal);
        assert!(cosine >= 0.0 && (ray.direction.length() - 1.0).abs() < 1e-5);
        let cell = |at: f32| ((at * 8.0) as usize).min(7);
        // The square of the sine and the angle around the normal are uniform, and so are shares of the edges.
        let angle = ray.direction.dot(v).atan2(ray.direction.dot(u)) / std::f32::consts::TAU + 0.5;
        by_direction[cell(1.0 - cosine * cosine) * 8 + cell(angle)] += 1;
        let at = ray.origin - light.corner;
        let (s, t) = (at.dot(light.u) / light.u.length_squared(), at.dot(light.v) / light.v.length_squared());
        by_point[cell(s) * 8 + cell(t)] += 1;
    }
    for counts in [by_direction, by_point] {
        let chi: f64 = counts.iter().map(|&n| (f64::from(n) - 1000.0).powi(2) / 1000.0).sum();
        assert!(chi < 114.8, "{chi}");
    }
}
