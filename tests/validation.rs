//! What [`Bvh::new`] refuses, and that whatever it accepts is safe to ask.

use bytemuck::Zeroable;
use glam::Vec3;
use occlude_kernel::bvh::MAX_DEPTH;
use occlude_kernel::{
    BatchScratch, Bvh, BvhError, Child, Counts, NO_TRIANGLE, Node, Ray, RayPacket, Targets, TriangleBlock,
};
use occlude_tests::{Family, On, Random, families};
use proptest::prelude::*;
use std::ops::ControlFlow;

const LOWER: [f32; 3] = [-1.0; 3];
const UPPER: [f32; 3] = [1.0; 3];

fn node(children: &[Child]) -> Node {
    let mut node = Node::EMPTY;
    for (place, &child) in children.iter().enumerate() {
        node.set(place, LOWER, UPPER, child);
    }
    node
}

fn error(nodes: &[Node], blocks: &[TriangleBlock]) -> Option<BvhError> {
    Bvh::new(nodes, blocks).err()
}

/// Asks everything of every family; what comes back does not matter, that it comes does.
fn ask(nodes: &[Node], blocks: &[TriangleBlock], rays: &[Ray]) {
    let Ok(bvh) = Bvh::new(nodes, blocks) else { return };
    for on in families(bvh) {
        ask_one(&on, rays);
    }
}

fn ask_one(on: &On<'_>, rays: &[Ray]) {
    let mut counts = Counts::default();
    let go = |_| ControlFlow::Continue(());
    for ray in rays {
        on.occluded(ray, None, &mut counts);
        on.closest(ray, Some(1), &mut counts);
        on.each_hit(ray, None, &mut counts, &mut { go });
        on.each_hit_in_order(ray, None, &mut counts, &mut { go });
    }
    let packet = RayPacket::new(rays);
    for active in [u32::MAX, 0x5555, 1, 0] {
        on.occluder_packet(&packet, active, None, &mut counts);
        on.closest_packet(&packet, active, None, &mut counts);
        on.each_hit_packet(&packet, active, None, &mut counts, &mut |_, _| ControlFlow::Continue(()));
    }
    let [x, y, z] = [0, 1, 2].map(|axis| rays.iter().map(|ray| ray.direction[axis]).collect::<Vec<f32>>());
    let mut blocked = [0; 4];
    on.occluded_batch(
        rays[0].origin.into(),
        &Targets::new(&x, &y, &z).unwrap(),
        None,
        &mut counts,
        &mut BatchScratch::new(),
        &mut blocked,
    );
}

#[test]
fn accepted() {
    assert_eq!(error(&[], &[]), None);
    assert_eq!(error(&[Node::EMPTY], &[]), None);
    assert_eq!(error(&[node(&[Child::leaf(0)])], &[TriangleBlock::EMPTY]), None);
    // A block may stand in two places; a node may not.
    assert_eq!(error(&[node(&[Child::leaf(0), Child::leaf(0)])], &[TriangleBlock::EMPTY]), None);
    assert_eq!(error(&[node(&[Child::node(1), Child::node(2)]), Node::EMPTY, Node::EMPTY], &[]), None);
}

#[test]
fn blocks_without_a_tree_are_an_empty_scene() {
    let mut block = TriangleBlock::EMPTY;
    block.set(0, [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]], 0);
    let blocks = [block];
    let bvh = Bvh::new(&[], &blocks).unwrap();
    assert!(!bvh.occluded(&Ray::from([0.0; 3], Vec3::Z), None, &mut Counts::default()));
}

#[test]
fn index_out_of_range() {
    let want = |place| Some(BvhError::OutOfRange { node: 0, place });
    assert_eq!(error(&[node(&[Child::leaf(0)])], &[]), want(0));
    assert_eq!(error(&[node(&[Child::leaf(0), Child::leaf(1)])], &[TriangleBlock::EMPTY]), want(1));
    assert_eq!(error(&[node(&[Child::node(1)])], &[]), want(0));
    assert_eq!(error(&[node(&[Child::node(Child::MAX_INDEX)])], &[]), want(0));
    assert_eq!(error(&[node(&[Child::leaf(Child::MAX_BLOCK)])], &[]), want(0));
}

#[test]
fn references_backwards() {
    assert_eq!(error(&[node(&[Child::node(0)])], &[]), Some(BvhError::Backwards { node: 0, place: 0 }));
    let nodes = [node(&[Child::node(1)]), node(&[Child::node(0)])];
    assert_eq!(error(&nodes, &[]), Some(BvhError::Backwards { node: 1, place: 0 }));
    let nodes = [node(&[Child::node(1)]), node(&[Child::node(1)])];
    assert_eq!(error(&nodes, &[]), Some(BvhError::Backwards { node: 1, place: 0 }));
}

#[test]
fn shared_nodes() {
    let nodes = [node(&[Child::node(1), Child::node(1)]), Node::EMPTY];
    assert!(matches!(error(&nodes, &[]), Some(BvhError::Shared { .. })));
    // Doubling on every level: as many paths as atoms, were they followed.
    let mut nodes: Vec<Node> = (1..31).map(|next| node(&[Child::node(next); 8])).collect();
    nodes.push(Node::EMPTY);
    assert!(matches!(error(&nodes, &[]), Some(BvhError::Shared { .. })));
}

#[test]
fn shared_nodes_beside_unreached_ones() {
    // As many visits as nodes, though one is met twice and one never.
    let nodes = [node(&[Child::node(1), Child::node(1)]), Node::EMPTY, Node::EMPTY];
    assert!(matches!(error(&nodes, &[]), None | Some(BvhError::Shared { .. })));
    ask(&nodes, &[], &[Ray::from([0.0; 3], Vec3::Z); 16]);
}

#[test]
fn boxes() {
    let blocks = [TriangleBlock::EMPTY];
    for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for axis in 0..3 {
            for (mut lower, mut upper, side) in [(LOWER, UPPER, 0), (LOWER, UPPER, 1)] {
                [&mut lower, &mut upper][side][axis] = wrong;
                let mut root = node(&[Child::leaf(0)]);
                root.set(3, lower, upper, Child::leaf(0));
                assert_eq!(error(&[root], &blocks), Some(BvhError::Box { node: 0, place: 3 }));
            }
        }
    }
    let mut inside_out = Node::EMPTY;
    inside_out.set(0, [0.0, 0.5, 0.0], [1.0, 0.4, 1.0], Child::leaf(0));
    assert_eq!(error(&[inside_out], &blocks), Some(BvhError::Box { node: 0, place: 0 }));
    let mut flat = Node::EMPTY;
    flat.set(0, [0.0; 3], [0.0; 3], Child::leaf(0));
    assert_eq!(error(&[flat], &blocks), None);
}

#[test]
fn boxes_of_unused_places_do_not_matter() {
    // Zeroed memory, NaN, everything: no child is there to be met.
    for bound in [0.0, f32::NAN, f32::INFINITY, 1e30] {
        let mut root = Node { bounds: Node::zeroed().bounds, children: [Child::NONE; 8] };
        root.bounds = [[[-bound; 8]; 3], [[bound; 8]; 3]];
        root.set(2, LOWER, UPPER, Child::leaf(0));
        let mut block = TriangleBlock::EMPTY;
        block.set(0, [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]], 5);
        let (nodes, blocks) = ([root], [block]);
        let ray = Ray::from([0.0; 3], Vec3::Z);
        for on in families(Bvh::new(&nodes, &blocks).unwrap()) {
            assert_eq!(on.occluder(&ray, None, &mut Counts::default()), Some(5), "{} {bound}", on.family);
        }
        ask(&nodes, &blocks, &[ray; 16]);
    }
}

#[test]
fn depth() {
    let chain = |levels: usize| -> Vec<Node> {
        (1..=levels as u32)
            .map(|next| {
                // The deepest child last, so that a traversal leaves as much behind as it can.
                let mut children = [Child::leaf(0); 8];
                if next < levels as u32 {
                    children[7] = Child::node(next);
                }
                node(&children)
            })
            .collect()
    };
    let mut block = TriangleBlock::EMPTY;
    block.set(0, [[-1.0, -1.0, 9.0], [1.0, -1.0, 9.0], [0.0, 1.0, 9.0]], 5);
    assert_eq!(error(&chain(MAX_DEPTH), &[block]), None);
    assert!(matches!(error(&chain(MAX_DEPTH + 1), &[block]), Some(BvhError::TooDeep { .. })));
    ask(&chain(MAX_DEPTH), &[block], &[Ray::segment([0.0, 0.0, -2.0], [0.0, 0.1, 2.0]); 16]);
    // Full on every level, whichever place the deep child has.
    for place in 0..8 {
        let mut nodes = chain(MAX_DEPTH);
        for node in &mut nodes {
            node.children.swap(place, 7);
        }
        ask(&nodes, &[block], &[Ray::segment([0.0, 0.0, -2.0], [0.0, 0.1, 2.0]); 16]);
    }
}

#[test]
fn vertices() {
    for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut block = TriangleBlock::EMPTY;
        for lane in 0..3 {
            block.set(lane, [[0.0; 3], [1.0; 3], [2.0; 3]], lane as u32);
        }
        block.vertices[1][2][2] = wrong;
        let nodes = [node(&[Child::leaf(1)])];
        let want = Some(BvhError::Vertex { block: 1, lane: 2 });
        assert_eq!(error(&nodes, &[TriangleBlock::EMPTY, block]), want);
        // Also where no triangle is.
        block.ids = [NO_TRIANGLE; 8];
        assert_eq!(error(&nodes, &[TriangleBlock::EMPTY, block]), want);
    }
}

#[test]
fn vertices_too_far_away() {
    let most = Bvh::MAX_COORDINATE;
    for (at, far) in [(most, false), (most.next_up(), true), (1e13, true), (f32::MAX, true)] {
        for at in [at, -at] {
            let mut block = TriangleBlock::EMPTY;
            block.vertices[2][1][5] = at;
            let want = far.then_some(BvhError::TooFar { block: 0, lane: 5 });
            assert_eq!(error(&[], &[block]), want, "{at:e}");
        }
    }
    let message = BvhError::TooFar { block: 3, lane: 5 }.to_string();
    assert!(["3", "5", "1e10"].iter().all(|part| message.contains(part)), "{message}");
}

#[test]
#[should_panic(expected = "no child can name this node")]
fn indices_of_nodes_that_look_like_leaves() {
    let _ = Child::node(Child::MAX_INDEX + 1);
}

#[test]
fn errors_name_the_place() {
    let message = BvhError::OutOfRange { node: 3, place: 5 }.to_string();
    assert!(message.contains('3') && message.contains('5'), "{message}");
    assert!(BvhError::TooDeep { node: 1 }.to_string().contains("32"));
}

#[test]
fn a_hole_among_the_lanes_is_no_panic() {
    // Used lanes come first; what stands behind a hole may be found or not.
    let mut block = TriangleBlock::EMPTY;
    for lane in [0, 2, 7] {
        block.set(lane, [[-1.0, -1.0, 0.5], [1.0, -1.0, 0.5], [0.0, 1.0, 0.5]], lane as u32);
    }
    assert_eq!(block.ids[1], NO_TRIANGLE);
    ask(&[node(&[Child::leaf(0)])], &[block], &[Ray::from([0.0; 3], Vec3::Z); 16]);
}

#[test]
#[should_panic]
fn too_few_words_panic() {
    let (nodes, blocks) = ([node(&[Child::leaf(0)])], [TriangleBlock::EMPTY]);
    let on = On { bvh: Bvh::new(&nodes, &blocks).unwrap(), family: Family::Scalar };
    let ends = [0.0; 65];
    let targets = Targets::new(&ends, &ends, &ends).unwrap();
    on.occluded_batch([0.0; 3], &targets, None, &mut Counts::default(), &mut BatchScratch::new(), &mut [0]);
}

/// Coordinates: tame ones, and any bits at all.
fn float() -> impl Strategy<Value = f32> {
    prop_oneof![6 => -2.0f32..2.0, 2 => any::<u32>().prop_map(f32::from_bits), 1 => Just(0.0)]
}

fn any_ray() -> impl Strategy<Value = Ray> {
    (prop::array::uniform3(float()), prop::array::uniform3(float()), float(), float())
        .prop_map(|(x, d, t_min, t_max)| Ray::new(x, d, t_min, t_max))
}

/// Nodes whose indices are about right, with boxes about right; small lies included.
fn plausible_nodes() -> impl Strategy<Value = Vec<Node>> {
    let child = (0u32..12, 0..3, prop::array::uniform3(float()), prop::array::uniform3(float()), any::<u8>());
    prop::collection::vec(prop::collection::vec(child, 8), 0..10).prop_map(|nodes| {
        let count = nodes.len() as u32;
        nodes
            .into_iter()
            .zip(0u32..)
            .map(|(children, index)| {
                let mut node = Node::EMPTY;
                for (place, (to, kind, a, b, whim)) in children.into_iter().enumerate() {
                    let child = match kind {
                        0 => Child::NONE,
                        1 => {
                            let first = u32::from(whim) % 8;
                            Child::lanes(to % 4, first, 1 + to % (8 - first))
                        }
                        _ if whim > 10 && index + 1 < count => {
                            Child::node(index + 1 + to % (count - index - 1))
                        }
                        _ if whim > 10 => Child::NONE,
                        _ => Child::node(to),
                    };
                    let (lower, upper) = if whim < 250 {
                        (Vec3::from(a).min(b.into()).to_array(), Vec3::from(a).max(b.into()).to_array())
                    } else {
                        (a, b)
                    };
                    node.set(place, lower, upper, child);
                }
                node
            })
            .collect()
    })
}

fn plausible_blocks() -> impl Strategy<Value = Vec<TriangleBlock>> {
    let triangle = (prop::array::uniform3(prop::array::uniform3(-2.0f32..2.0)), 0u32..20);
    prop::collection::vec(prop::collection::vec(triangle, 0..=8), 4).prop_map(|blocks| {
        blocks
            .into_iter()
            .map(|triangles| {
                let mut block = TriangleBlock::EMPTY;
                for (lane, (vertices, id)) in triangles.into_iter().enumerate() {
                    block.set(lane, vertices, id);
                }
                block
            })
            .collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn plausible_garbage(
        nodes in plausible_nodes(),
        blocks in plausible_blocks(),
        rays in prop::collection::vec(any_ray(), 16),
    ) {
        ask(&nodes, &blocks, &rays);
    }

    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..1024), rays in prop::collection::vec(any_ray(), 16)) {
        let mut nodes = vec![Node::zeroed(); bytes.len().div_ceil(size_of::<Node>())];
        bytemuck::cast_slice_mut(&mut nodes)[..bytes.len()].copy_from_slice(&bytes);
        let mut blocks = vec![TriangleBlock::EMPTY; bytes.len().div_ceil(size_of::<TriangleBlock>())];
        bytemuck::cast_slice_mut(&mut blocks)[..bytes.len()].copy_from_slice(&bytes);
        ask(&nodes, &blocks, &rays);
        ask(&nodes, &[TriangleBlock::EMPTY; 4], &rays);
    }

    #[test]
    fn any_rays(rays in prop::collection::vec(any_ray(), 16), seed in any::<u64>()) {
        let mut random = Random::new(seed);
        let triangles = occlude_tests::meshes::soup(&mut random, 60, 1.0);
        let (nodes, blocks) = occlude_tests::single_node(&triangles);
        ask(&nodes, &blocks, &rays);
    }
}
