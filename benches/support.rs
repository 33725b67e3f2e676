//! Shared set-up for the benchmarks: scenes, the rays they ask about, and obvhs beside us.

use glam::Vec3;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2_from_tris;
use obvhs::cwbvh::CwBvh;
use obvhs::cwbvh::builder::build_cwbvh_from_tris;
use obvhs::{BvhBuildParams, triangle};
use occlude_host::accel::{Accel, Quality};
use occlude_host::film::Tile;
use occlude_host::generate::{Kind, generate};
use occlude_host::integrator::{Questions, Stage, questions};
use occlude_host::light::{AreaLight, lights};
use occlude_host::sampler::Pattern;
use occlude_host::scene::{CameraRequest, Scene, load};
use occlude_kernel::lanes::detect;
use occlude_kernel::{Bvh, Ray};
use std::path::Path;
use std::time::Duration;

/// A scene, its trees, and the shadow rays of some tiles of its picture.
#[derive(Debug)]
pub struct Setting {
    /// What it is called.
    pub name: String,
    /// Its triangles.
    pub scene: Scene,
    /// Its lights.
    pub lights: Vec<AreaLight>,
    accel: Accel,
    /// Shading points, their batches and targets, tile by tile.
    pub questions: Vec<Questions>,
}

impl Setting {
    fn new(name: &str, scene: Scene, shadow_rays: u32) -> Self {
        let accel = Accel::build(&scene, Quality::Medium);
        let lights = lights(&scene);
        let camera = scene.camera.expect("loaded and generated scenes have one");
        let frame = camera.frame();
        let stage = Stage {
            scene: &scene,
            bvh: accel.bvh(),
            lights: &lights,
            eye: camera.eye,
            camera: &frame,
            shadow_rays,
            pattern: Pattern::Jittered,
            seed: 1,
            level: detect(),
            count: false,
        };
        // Tiles spread over the picture, about 8000 points.
        let tiles: Vec<Tile> = Tile::cover(camera.width, camera.height, 16).collect();
        let step = (tiles.len() / 32).max(1);
        let questions =
            tiles.iter().step_by(step).map(|&tile| questions(&stage, tile, camera.width, 0)).collect();
        Self { name: name.to_owned(), lights, accel, questions, scene }
    }

    /// Our tree.
    pub fn bvh(&self) -> Bvh<'_> {
        self.accel.bvh()
    }

    /// Every shadow ray, in the order of the batches.
    pub fn rays(&self) -> Vec<Ray> {
        let mut rays = Vec::new();
        for questions in &self.questions {
            let [x, y, z] = &questions.targets;
            for batch in &questions.batches {
                let origin = questions.points[batch.point as usize].origin;
                rays.extend(batch.samples.clone().map(|i| {
                    let i = i as usize;
                    Ray::segment(origin, [x[i], y[i], z[i]])
                }));
            }
        }
        rays
    }

    /// The same triangles as obvhs takes them.
    pub fn triangles(&self) -> Vec<triangle::Triangle> {
        (0..self.scene.triangles.len() as u32)
            .map(|i| {
                let [v0, v1, v2] = self.scene.vertices(i).map(|v: Vec3| v.into());
                triangle::Triangle { v0, v1, v2 }
            })
            .collect()
    }

    /// obvhs' binary tree, of its medium preset.
    pub fn obvhs_binary(&self) -> Bvh2 {
        build_bvh2_from_tris(&self.triangles(), BvhBuildParams::medium_build(), &mut Duration::default())
    }

    /// obvhs' compressed wide tree, of its medium preset.
    pub fn obvhs_wide(&self) -> CwBvh {
        build_cwbvh_from_tris(&self.triangles(), BvhBuildParams::medium_build(), &mut Duration::default())
    }
}

/// Scenes of the repository, generated ones, and those of `../shared/scenes` where there are any.
pub fn settings(shadow_rays: u32) -> Vec<Setting> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut settings = Vec::new();
    for name in ["cornell", "columns"] {
        match load(&root.join("scenes").join(name), &CameraRequest::default()) {
            Ok(scene) => settings.push(Setting::new(name, scene, shadow_rays)),
            Err(error) => eprintln!("skipped: {error}"),
        }
    }
    for kind in [Kind::Spheres, Kind::Hair] {
        settings.push(Setting::new(kind.name(), generate(kind, 1, 100_000), shadow_rays));
    }
    for name in
        ["cornell_original", "bunny_penumbra", "sponza_part", "teapot_toys", "apple_tree", "vented_case"]
    {
        let folder = root.join("../shared/scenes").join(name);
        if !folder.exists() {
            eprintln!("skipped: {name} is not at ../shared/scenes");
            continue;
        }
        match load(&folder, &CameraRequest::default()) {
            Ok(scene) => settings.push(Setting::new(name, scene, shadow_rays)),
            Err(error) => eprintln!("skipped: {error}"),
        }
    }
    settings
}
