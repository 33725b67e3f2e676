//! What a render did, as a table and as JSON.

use crate::error::{Error, Result};
use crate::volumetric::VolumeStats;
use serde::Serialize;
use std::path::Path;

/// Everything about one render. `--stats` writes it as JSON.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// The scene's name.
    pub scene: String,
    /// How visibility was found.
    pub method: String,
    /// Pixels across and down.
    pub size: [u32; 2],
    /// Whole passes: camera samples a pixel.
    pub spp: u32,
    /// Shadow rays a camera sample.
    pub shadow_rays: u32,
    /// Threads.
    pub threads: usize,
    /// The seed.
    pub seed: u64,
    /// The SIMD level.
    pub simd: String,
    /// Whether it was stopped early.
    pub interrupted: bool,
    /// Where the time went.
    pub time: Times,
    /// The work done.
    pub counts: WorkCounts,
    /// Memory.
    pub memory: Memory,
    /// The occlusion map, if there was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map: Option<MapFigures>,
    /// The boxes inside closed meshes, if they were looked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volumes: Option<VolumeFigures>,
    /// What was below 0 in the average, and was taken from pixels around, if the method leaves such.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settled: Option<SettledFigures>,
    /// Against the reference, if one was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<ErrorFigures>,
}

/// Seconds. The first four on the clock, the others summed over threads.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Times {
    /// Reading the files.
    pub load_s: f64,
    /// Building the tree.
    pub build_s: f64,
    /// What a method prepares before the first pass.
    pub preprocess_s: f64,
    /// All passes.
    pub render_s: f64,
    /// Camera rays.
    pub camera_s: f64,
    /// Light samples.
    pub light_s: f64,
    /// Visibility.
    pub visibility_s: f64,
    /// Shading.
    pub shade_s: f64,
}

/// Work done; tests count lanes in use.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct WorkCounts {
    /// Camera rays.
    pub camera_rays: u64,
    /// Shadow rays.
    pub shadow_rays: u64,
    /// Ray and triangle, of shadow rays.
    pub triangle_tests: u64,
    /// Ray and box, of shadow rays.
    pub node_tests: u64,
    /// Ray and triangle, of camera rays.
    pub camera_triangle_tests: u64,
    /// Ray and box, of camera rays.
    pub camera_node_tests: u64,
}

/// Bytes.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Memory {
    /// Nodes and triangle blocks.
    pub bvh_bytes: usize,
    /// The same for each triangle.
    pub bvh_bytes_per_triangle: f64,
    /// Triangles.
    pub triangles: usize,
}

/// What an occlusion map holds and what it said.
#[derive(Clone, Debug, Default, Serialize)]
pub struct MapFigures {
    /// Lines shot.
    pub lines: u64,
    /// Whether later rounds went where shadows begin and end.
    pub adaptive: bool,
    /// Rounds they were shot in.
    pub rounds: u32,
    /// Lines of the rounds after the first, even one.
    pub later_lines: u64,
    /// Lines that met nothing.
    pub lines_lost: u64,
    /// Photons on the first surface of a line.
    pub light_photons: usize,
    /// Photons behind it.
    pub occlusion_photons: usize,
    /// Photons left out of lines with too many.
    pub dropped_photons: u64,
    /// Names of blockers left out of lines with too many.
    pub dropped_blockers: u64,
    /// What blockers are.
    pub blockers: String,
    /// Photons looked up.
    pub k: usize,
    /// Shooting, s on the clock.
    pub shoot_s: f64,
    /// Finding where later rounds should go, s on the clock.
    pub judge_s: f64,
    /// Sorting, s on the clock.
    pub sort_s: f64,
    /// Bytes of the photons.
    pub bytes: usize,
    /// Points and lights said to be lit.
    pub lit: u64,
    /// Said to be dark.
    pub dark: u64,
    /// Said to be in a penumbra.
    pub penumbra: u64,
    /// With no photon near, and so traced through the scene.
    pub unknown: u64,
}

/// The boxes that were found inside closed meshes.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct VolumeFigures {
    /// Closed meshes.
    pub closed_meshes: usize,
    /// Those with boxes that some light may use.
    pub filled_meshes: usize,
    /// Boxes.
    pub boxes: usize,
    /// The part of the volume of closed meshes that they fill.
    pub fraction: f64,
    /// Time to find them, s on the clock.
    pub build_s: f64,
}

impl From<&VolumeStats> for VolumeFigures {
    fn from(stats: &VolumeStats) -> Self {
        Self {
            closed_meshes: stats.meshes,
            filled_meshes: stats.filled_meshes,
            boxes: stats.boxes,
            fraction: stats.fraction(),
            build_s: stats.time.as_secs_f64(),
        }
    }
}

/// What was below 0 in the average.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct SettledFigures {
    /// Pixels.
    pub pixels: u64,
    /// What they were short of 0, over the sum of the image.
    pub part: f64,
}

/// How far the image is from a reference.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct ErrorFigures {
    /// Root of the mean square difference.
    pub rmse: f64,
    /// Mean square difference relative to the reference's square.
    pub relmse: f64,
    /// Mean of the image over mean of the reference.
    pub mean_ratio: f64,
}

impl Report {
    /// Writes it as JSON, whole or not at all.
    pub fn write(&self, path: &Path) -> Result<()> {
        let json = serde_json::to_string_pretty(self)
            .map_err(|error| Error::input(path, format!("cannot be written as JSON: {error}")))?;
        crate::output::write_bytes(path, format!("{json}\n").as_bytes())
    }

    /// A few lines for a person.
    pub fn summary(&self) -> String {
        let rays = self.counts.shadow_rays as f64;
        let t = &self.time;
        let mut text = format!(
            "{}x{}, {} spp, {} shadow rays, {} threads, {}\n\
             load {:.3} s, build {:.3} s, render {:.3} s (thread seconds: camera {:.3}, light {:.3}, visibility {:.3}, shade {:.3})\n",
            self.size[0],
            self.size[1],
            self.spp,
            self.shadow_rays,
            self.threads,
            self.simd,
            t.load_s,
            t.build_s,
            t.render_s,
            t.camera_s,
            t.light_s,
            t.visibility_s,
            t.shade_s,
        );
        if rays > 0.0 {
            text += &format!(
                "{:.1} M shadow rays, {:.1} M a thread second; {:.2} triangle and {:.2} node tests a ray\n",
                rays * 1e-6,
                rays * 1e-6 / t.visibility_s.max(1e-9),
                self.counts.triangle_tests as f64 / rays,
                self.counts.node_tests as f64 / rays,
            );
        }
        if let Some(map) = &self.map {
            let all = (map.lit + map.dark + map.penumbra + map.unknown).max(1) as f64;
            let part = |count: u64| 100.0 * count as f64 / all;
            text += &format!(
                "map: {} lines, {} light and {} occlusion photons, {:.1} MB, shot in {:.3} s, sorted in {:.3} s; \
                 lit {:.1} %, dark {:.1} %, penumbra {:.1} %, no photon near {:.1} %\n",
                map.lines,
                map.light_photons,
                map.occlusion_photons,
                map.bytes as f64 * 1e-6,
                map.shoot_s,
                map.sort_s,
                part(map.lit),
                part(map.dark),
                part(map.penumbra),
                part(map.unknown),
            );
        }
        if let Some(volumes) = &self.volumes {
            text += &format!(
                "volumetric: {} boxes in {} of {} closed meshes fill {:.1} % of them, found in {:.3} s\n",
                volumes.boxes,
                volumes.filled_meshes,
                volumes.closed_meshes,
                100.0 * volumes.fraction,
                volumes.build_s,
            );
        }
        if let Some(settled) = self.settled.filter(|settled| settled.pixels > 0) {
            text += &format!(
                "{} pixels were below 0, by {:.1e} of the image's light in all, which is taken from those around\n",
                settled.pixels, settled.part
            );
        }
        if let Some(error) = &self.error {
            text += &format!(
                "against the reference: RMSE {:.6}, relMSE {:.6}, ratio of means {:.5}\n",
                error.rmse, error.relmse, error.mean_ratio
            );
        }
        text
    }
}
