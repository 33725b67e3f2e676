//! `occlude info`.

use super::print;
use super::render::CameraArgs;
use crate::accel::{Accel, Quality};
use crate::error::{Error, Result};
use crate::light::{self, Shape};
use crate::volumetric::Volumes;
use crate::{mesh, scene};
use clap::Args;
use occlude_kernel::lanes::{Level, detect, level_name, levels};
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Instant;

/// Arguments of `occlude info`.
#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
pub struct InfoArgs {
    /// A folder with scene.obj, or an .obj file. Without it, only the machine.
    scene: Option<PathBuf>,

    /// How long to look for a good tree.
    #[arg(long, value_enum, default_value_t)]
    quality: Quality,

    #[command(flatten)]
    camera: CameraArgs,
}

/// Runs the command.
pub fn run(args: &InfoArgs, level: Level) -> Result<()> {
    if let (None, Some(option)) = (&args.scene, args.camera.given()) {
        return Err(Error::Usage(format!("{option} is for a scene: name one, or leave the option out")));
    }
    let mut text = machine(level);
    if let Some(path) = &args.scene {
        text += "\n";
        text += &scene_info(path, args)?;
    }
    print(&text)
}

/// The features a build without run-time choice would use.
fn compiled_for() -> &'static str {
    if cfg!(target_feature = "avx512f") {
        "avx512"
    } else if cfg!(all(target_feature = "avx2", target_feature = "fma")) {
        "avx2"
    } else if cfg!(target_feature = "sse4.2") {
        "sse4.2"
    } else if cfg!(target_feature = "sse2") {
        "sse2"
    } else if cfg!(target_feature = "neon") {
        "neon"
    } else {
        "none"
    }
}

fn machine(level: Level) -> String {
    let mut text = String::new();
    let known: Vec<&str> = levels().map(level_name).collect();
    let _ = writeln!(text, "SIMD the CPU has     {}", known.join(", "));
    let _ = writeln!(
        text,
        "SIMD in use          {} (chosen at run time; --simd LEVEL forces one)",
        level_name(level)
    );
    let _ = writeln!(text, "compiled for         {} (code outside the kernel's queries)", compiled_for());
    if level_name(level) != level_name(detect()) {
        let _ = writeln!(text, "warning: the CPU could do {}, which is faster", level_name(detect()));
    }
    let _ = writeln!(text, "threads              {}", rayon::current_num_threads());
    text
}

fn scene_info(path: &std::path::Path, args: &InfoArgs) -> Result<String> {
    let start = Instant::now();
    let scene = scene::load(path, &args.camera.request())?;
    let load = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let accel = Accel::build(&scene, args.quality);
    let build = start.elapsed().as_secs_f64();
    let meshes = mesh::stats(&scene);
    let stats = accel.stats();
    let mut text = String::new();
    let mut line = |name: &str, value: String| {
        let _ = writeln!(text, "{name:20} {value}");
    };
    line("scene", scene.name.clone());
    for warning in &scene.warnings {
        line("warning", warning.clone());
    }
    line(
        "triangles",
        format!(
            "{} of {} vertices, {} objects, {} materials",
            scene.triangles.len(),
            scene.positions.len(),
            scene.objects.len(),
            scene.materials.len()
        ),
    );
    line(
        "meshes",
        format!(
            "{} closed ({} triangles), {} open ({} border edges)",
            meshes.closed, meshes.closed_triangles, meshes.open, meshes.border_edges
        ),
    );
    if let Some((lower, upper)) = scene.bounds() {
        line("bounds", format!("{lower} to {upper}"));
    }
    if let Some(camera) = &scene.camera {
        line(
            "camera",
            format!(
                "{}x{} from {} to {}, {} degrees",
                camera.width, camera.height, camera.eye, camera.target, camera.vfov_deg
            ),
        );
    }
    let lights = light::lights(&scene);
    line("lights", format!("{}", lights.len()));
    const SHOWN: usize = 16;
    for (index, light) in lights.iter().take(SHOWN).enumerate() {
        let shape = match light.shape {
            Shape::Parallelogram => "parallelogram",
            Shape::Triangle => "triangle",
        };
        let p = light.power();
        line(
            &format!("  light {index}"),
            format!(
                "{shape}, area {:.6} m², power {:.4} {:.4} {:.4} W, normal {}",
                light.area, p.x, p.y, p.z, light.normal
            ),
        );
    }
    if lights.len() > SHOWN {
        line("", format!("and {} more", lights.len() - SHOWN));
    }
    let volumes = Volumes::build(&scene, &lights).stats;
    line(
        "solid boxes",
        format!(
            "{} in {} of {} closed meshes, {:.1} % of their volume, found in {:.3} s",
            volumes.boxes,
            volumes.filled_meshes,
            volumes.meshes,
            100.0 * volumes.fraction(),
            volumes.time.as_secs_f64()
        ),
    );
    line("loaded in", format!("{load:.3} s"));
    line("tree built in", format!("{build:.3} s"));
    line(
        "tree",
        format!(
            "{} nodes ({:.2} of 8 children), {} blocks ({:.2} of 8 triangles), depth {}, {:.1} expected visits a line",
            stats.nodes,
            stats.children_per_node,
            stats.blocks,
            stats.triangles_per_block,
            stats.depth,
            stats.expected_visits
        ),
    );
    line(
        "tree memory",
        format!(
            "{:.1} MB, {:.1} bytes a triangle",
            stats.bytes as f64 * 1e-6,
            stats.bytes as f64 / scene.triangles.len().max(1) as f64
        ),
    );
    let geometry = scene.positions.len() * 12 + scene.triangles.len() * 16;
    line(
        "scene memory",
        format!(
            "{:.1} MB, {:.1} bytes a triangle",
            geometry as f64 * 1e-6,
            geometry as f64 / scene.triangles.len().max(1) as f64
        ),
    );
    Ok(text)
}
