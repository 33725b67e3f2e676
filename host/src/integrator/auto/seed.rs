//! Photons that say which cells light reaches, before the first pass.

use super::super::Stage;
use super::Map;
use crate::photons::Shower;
use occlude_kernel::lanes::Task;
use occlude_kernel::occlusion_map::{BINS, bin};
use occlude_kernel::{Hit, Simd, Uncounted};
use std::ops::{ControlFlow, Range};

/// Photons of a light.
pub(super) struct Photons<'a> {
    pub(super) map: &'a Map,
    pub(super) stage: &'a Stage<'a>,
    pub(super) shower: &'a Shower<'a>,
    pub(super) light: u32,
    pub(super) lines: Range<u64>,
}

impl Task for Photons<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { map, stage, shower, light, lines } = self;
        let (bvh, view, clearance) = (stage.bvh.on(simd), map.view(), stage.bvh.clearance());
        let mut hits: Vec<Hit> = Vec::new();
        for line in lines {
            let (ray, at) = shower.ray_and_place(line, light);
            hits.clear();
            bvh.each_hit(&ray, None, &mut Uncounted, |hit| {
                hits.push(hit);
                ControlFlow::Continue(())
            });
            hits.sort_unstable_by(|a, b| a.t.total_cmp(&b.t).then(a.triangle.cmp(&b.triangle)));
            let Some(first) = hits.first().map(|hit| hit.t + clearance) else { continue };
            for hit in &hits {
                let [a, b, c] = stage.scene.vertices(hit.triangle);
                let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
                let normal = if normal.dot(ray.direction) < 0.0 { normal } else { -normal };
                let key = map.key(stage.eye, ray.at(hit.t), normal, light);
                if let Some(cell) = key.and_then(|key| view.find(key)) {
                    map.count(cell * BINS + bin(at), hit.t <= first);
                }
            }
        }
    }
}
