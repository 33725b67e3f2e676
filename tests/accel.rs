//! What the builder promises the kernel.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::generate::{Kind, generate};
use occlude_kernel::bvh::MAX_DEPTH;
use occlude_kernel::{Bvh, Child, NO_TRIANGLE, Node, TriangleBlock};
use occlude_tests::{Random, Triangle, bounds, meshes};

const QUALITIES: [Quality; 3] = [Quality::Fast, Quality::Medium, Quality::High];

/// Is every triangle in exactly one block, every box around what is below it, and no level too many?
fn check(triangles: &[Triangle]) {
    for quality in QUALITIES {
        let accel = Accel::from_triangles(triangles, quality);
        assert_eq!(accel.triangles(), triangles.len());
        let bvh = accel.bvh();
        let mut seen = vec![0u32; triangles.len()];
        for block in bvh.blocks() {
            assert!(!block.is_empty(), "no block is empty");
            assert!(block.ids[block.len()..].iter().all(|&id| id == NO_TRIANGLE), "used lanes come first");
            for lane in 0..block.len() {
                let id = block.ids[lane] as usize;
                seen[id] += 1;
                assert_eq!(block.get(lane), triangles[id].map(|vertex| vertex.to_array()));
            }
        }
        assert!(seen.iter().all(|&times| times == 1), "every triangle is in one block");
        let mut reached = vec![[0; TriangleBlock::WIDTH]; bvh.blocks().len()];
        let mut deepest = 0;
        if !bvh.nodes().is_empty() {
            below(&bvh, Child::node(0), 0, &mut reached, &mut deepest);
        }
        for (block, lanes) in bvh.blocks().iter().zip(&reached) {
            let used = |lane: usize| u32::from(lane < block.len());
            assert!(
                lanes.iter().enumerate().all(|(lane, &times)| times == used(lane)),
                "every triangle is in one leaf"
            );
        }
        assert!(deepest <= MAX_DEPTH, "{deepest} levels");
        let stats = accel.stats();
        assert_eq!(
            (stats.nodes, stats.blocks, stats.depth),
            (bvh.nodes().len(), bvh.blocks().len(), deepest)
        );
    }
}

/// The bounds of what is below, after checking them all the way down.
fn below(
    bvh: &Bvh<'_>,
    child: Child,
    level: usize,
    reached: &mut [[u32; TriangleBlock::WIDTH]],
    deepest: &mut usize,
) -> (Vec3, Vec3) {
    if let Some(leaf) = child.as_leaf() {
        leaf.lanes().for_each(|lane| reached[leaf.block][lane] += 1);
        let block = &bvh.blocks()[leaf.block];
        return bounds(leaf.lanes().flat_map(|lane| block.get(lane)).map(Vec3::from));
    }
    let node = &bvh.nodes()[child.as_node().expect("not nothing")];
    *deepest = (*deepest).max(level + 1);
    let corner = |side: usize, place: usize| Vec3::from(node.bounds[side].map(|axis| axis[place]));
    let used = (0..Node::WIDTH).filter(|&place| node.children[place] != Child::NONE);
    let mut whole = Vec::new();
    for place in used {
        let (lower, upper) = below(bvh, node.children[place], level + 1, reached, deepest);
        assert!(
            corner(0, place).cmple(lower).all() && upper.cmple(corner(1, place)).all(),
            "a box is too small"
        );
        whole.extend([corner(0, place), corner(1, place)]);
    }
    assert!(!whole.is_empty(), "no node is empty");
    bounds(whole)
}

#[test]
fn none_and_few() {
    let mut random = Random::new(41);
    check(&[]);
    for count in [1, 2, 7, 8, 9, 16, 17, 63, 64, 65, 100] {
        check(&meshes::soup(&mut random, count, 0.5));
    }
}

#[test]
fn soups_and_meshes() {
    let mut random = Random::new(42);
    check(&meshes::soup(&mut random, 20_000, 0.05));
    check(&meshes::slivers(&mut random, 5000));
    check(&meshes::sponge(3).triangles(|vertex| vertex.as_vec3()));
    check(&meshes::globe(3, 5000).triangles(|vertex| vertex.as_vec3()));
    check(&meshes::moved(&meshes::soup(&mut random, 5000, 0.1), 1e-4, Vec3::splat(1e5)));
}

#[test]
fn sizes_of_a_geometric_series() {
    // Each half as large and half as far as the one before: the most lopsided tree there is.
    for ratio in [0.5f32, 0.9, 0.99] {
        let mut scale = 1.0;
        let mut triangles = Vec::new();
        while scale > 1e-36 && triangles.len() < 5000 {
            triangles.push([Vec3::new(scale, 0.0, 0.0), Vec3::new(scale, scale, 0.0), Vec3::splat(scale)]);
            scale *= ratio;
        }
        check(&triangles);
        triangles.reverse();
        check(&triangles);
    }
}

#[test]
fn identical_triangles() {
    check(&vec![[Vec3::X, Vec3::Y, Vec3::Z]; 100_000]);
    check(&vec![[Vec3::ONE; 3]; 1000]);
}

#[test]
fn collinear_triangles() {
    let at = |i: i32| Vec3::new(i as f32, 0.0, 0.0);
    check(&(0..20_000).map(|i| [at(i), at(i + 1), at(i + 2)]).collect::<Vec<_>>());
    check(&(0..20_000).map(|i| [at(i), at(i), at(i)]).collect::<Vec<_>>());
    check(&(0..2000).map(|i| [at(0), at(i), Vec3::Y]).collect::<Vec<_>>());
}

#[test]
fn one_huge_and_many_tiny() {
    let mut random = Random::new(43);
    let mut triangles = meshes::moved(&meshes::soup(&mut random, 20_000, 0.01), 1e-3, Vec3::splat(0.3));
    triangles.push([Vec3::new(-1e5, -1e5, 0.0), Vec3::new(1e5, -1e5, 0.0), Vec3::new(0.0, 1e5, 0.0)]);
    check(&triangles);
    triangles.rotate_right(1);
    check(&triangles);
}

#[test]
fn the_same_again() {
    let mut random = Random::new(44);
    let mut soup = meshes::soup(&mut random, 30_000, 0.05);
    // Far off and deep, so that what is cut apart is of all sizes.
    soup.extend(meshes::moved(&meshes::soup(&mut random, 3000, 0.05), 1e-3, Vec3::splat(3.0)));
    // Ties too.
    soup.extend_from_within(..3000);
    for quality in QUALITIES {
        let first = Accel::from_triangles(&soup, quality);
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let again = pool.install(|| Accel::from_triangles(&soup, quality));
            assert_eq!(
                bytemuck::cast_slice::<_, u32>(first.bvh().nodes()),
                bytemuck::cast_slice::<_, u32>(again.bvh().nodes())
            );
            assert_eq!(first.bvh().blocks(), again.bvh().blocks());
        }
    }
}

/// Leaves share blocks, so what a tree takes hardly depends on how many triangles its leaves have.
#[test]
fn trees_are_small() {
    for kind in Kind::ALL {
        let scene = generate(kind, 5, 20_000);
        let accel = Accel::build(&scene, Quality::Medium);
        let stats = accel.stats();
        let bytes = stats.bytes as f64 / accel.triangles() as f64;
        println!("{}: {bytes:.1} bytes a triangle, {:.2} a block", kind.name(), stats.triangles_per_block);
        assert!(bytes < 64.0, "{}: {bytes:.1} bytes a triangle", kind.name());
        assert!(stats.triangles_per_block > 6.0, "{}: {:.2} a block", kind.name(), stats.triangles_per_block);
    }
}
