//! The batch query against single rays, on real scenes.

use occlude_host::accel::{Accel, Quality};
use occlude_host::film::Tile;
use occlude_host::integrator::{Stage, questions};
use occlude_host::light::lights;
use occlude_host::scene::{CameraRequest, load};
use occlude_kernel::lanes::detect;
use occlude_kernel::{BatchScratch, Ray, Scalar, Targets, Uncounted};
use std::path::Path;

#[test]
fn dbg() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes");
    for name in ["sponza_part"] {
        let scene = load(&root.join(name), &CameraRequest::default()).unwrap();
        let accel = Accel::build(&scene, Quality::Medium);
        let lights = lights(&scene);
        let camera = scene.camera.unwrap();
        let frame = camera.frame();
        let stage = Stage {
            scene: &scene,
            bvh: accel.bvh(),
            lights: &lights,
            eye: camera.eye,
            camera: &frame,
            shadow_rays: 64,
            pattern: Default::default(),
            seed: 0,
            level: detect(),
            count: false,
        };
        let mut bad = 0;
        let mut all = 0;
        for pass in 0..2 {
            for tile in Tile::cover(camera.width, camera.height, 16) {
                let q = questions(&stage, tile, camera.width, pass);
                let [x, y, z] = &q.targets;
                let mut scratch = BatchScratch::new();
                for b in &q.batches {
                    let l = &lights[b.light as usize];
                    let p = &q.points[b.point as usize];
                    let r = b.samples.start as usize..b.samples.end as usize;
                    let t = Targets::new(&x[r.clone()], &y[r.clone()], &z[r.clone()])
                        .unwrap()
                        .on_parallelogram(l.corner, l.u, l.v);
                    let mut m = [0u64; 1];
                    stage.bvh.occluded_batch(p.origin, &t, None, &mut Uncounted, &mut scratch, &mut m);
                    for i in 0..t.len() {
                        all += 1;
                        let ray = Ray::segment(p.origin, t.get(i));
                        let a = stage.bvh.on(Scalar).occluder(&ray, None, &mut Uncounted);
                        if a.is_some() != (m[0] >> i & 1 == 1) {
                            bad += 1;
                            let hit = a.and_then(|_| stage.bvh.closest(&ray, None, &mut Uncounted));
                            eprintln!(
                                "{name} light {} point {:?} n {:?} tri {} target {:?}: single {:?} hit {:?} verts {:?} batch {}",
                                b.light,
                                p.origin,
                                p.normal,
                                p.triangle,
                                t.get(i),
                                a,
                                hit,
                                a.map(|a| scene.vertices(a)),
                                m[0] >> i & 1
                            );
                        }
                    }
                }
            }
        }
        eprintln!("{name}: {bad} of {all}");
    }
}
