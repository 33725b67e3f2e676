//! `occlude photons`: shows the occlusion map.

use super::map::{self, PhotonOptions};
use super::render::CameraArgs;
use super::{note, whole};
use crate::accel::Quality;
use crate::error::{Error, Result};
use crate::film::{Image, Tile};
use crate::integrator::{Exact, PreparedMap, Questions, Stage, Visibility, questions};
use crate::render::{Limits, render};
use crate::sampler::Pattern;
use crate::{light, output, scene};
use clap::{Args, ValueEnum};
use glam::Vec3;
use occlude_kernel::lanes::Level;
use occlude_kernel::photons::{Class, Nearest};
use occlude_kernel::{Counts, Ray, Uncounted};
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

/// Arguments of `occlude photons`.
#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
pub struct PhotonsArgs {
    /// A folder with scene.obj (or exactly one .obj), or an .obj file.
    scene: PathBuf,

    /// Where to write: an image (.png, .exr, .hdr, .pfm), or the photons as points with colours (.ply).
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,

    /// What an image shows [default: both].
    #[arg(long, value_enum)]
    show: Option<Show>,

    /// Photons drawn or written at most; of more, evenly spread ones.
    #[arg(long, default_value_t = 200_000, value_name = "N", value_parser = whole::<u64>(1..=u64::MAX))]
    most: u64,

    /// How long to look for a good tree.
    #[arg(long, value_enum, default_value_t)]
    quality: Quality,

    /// Threads; 0 for one a core. The result is the same for any number.
    #[arg(long, default_value_t = 0, value_name = "T", value_parser = whole::<u16>(0..=1024))]
    threads: u16,

    /// Seed of the random numbers.
    #[arg(long, default_value_t = 0, value_name = "S", value_parser = whole::<u64>(0..=u64::MAX))]
    seed: u64,

    #[command(flatten, next_help_heading = "Photons")]
    map: PhotonOptions,

    #[command(flatten)]
    camera: CameraArgs,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Show {
    /// Both, side by side.
    #[default]
    Both,
    /// Light photons (white), and occlusion photons in the colour of the first blocker on their way.
    Photons,
    /// Lit (green), dark (blue), penumbra (red), no photon near (grey); lit or dark but wrong: white.
    Classes,
}

/// Light samples a point is judged by, when it is asked whether the map is right.
const TRUTH: u32 = 64;
const MOST_TRUTH: u32 = 65536;

/// Runs the command.
pub fn run(args: &PhotonsArgs, level: Level) -> Result<()> {
    let cloud = args.output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("ply"));
    let show = args.show.unwrap_or_default();
    if cloud && args.show.is_some() {
        return Err(Error::Usage(format!(
            "--show is for images, and {} holds photons: leave it out, or name an image",
            args.output.display()
        )));
    }
    if cloud {
        output::check_writable_bytes(&args.output)?;
    } else if output::is_image(&args.output) {
        output::check_writable(&args.output)?;
    } else {
        return Err(Error::Usage(format!(
            "{}: name an image, .png, .exr, .hdr or .pfm, or points, .ply",
            args.output.display()
        )));
    }
    let scene = scene::load(&args.scene, &args.camera.request())?;
    scene.warnings.iter().for_each(|warning| note(&format!("warning: {warning}")));
    output::check_apart(&[("--output", &args.output)], &super::files_of(&scene))?;
    let camera = scene.camera.ok_or_else(|| Error::input(&args.scene, "has no camera"))?;
    let (width, height) = (camera.width, camera.height);
    let accel = map::tree(&scene, args.quality, args.threads.into())?;
    let lights = light::lights(&scene);
    let frame = camera.frame();
    let stage = Stage {
        scene: &scene,
        bvh: accel.bvh(),
        lights: &lights,
        eye: camera.eye,
        camera: &frame,
        shadow_rays: 16,
        pattern: Pattern::default(),
        seed: args.seed,
        level,
        count: false,
    };
    let prepared = map::prepare(&stage, &args.map.options(args.quality), args.threads.into())?;
    let store = &prepared.store;
    let rounds = match store.stats.rounds {
        1 => "evenly".to_owned(),
        rounds => format!(
            "adaptively in {rounds} rounds ({} lines after the first, {:.3} s to find where)",
            store.stats.later_lines,
            store.stats.judged.as_secs_f64()
        ),
    };
    note(&format!(
        "{} lines: {} light and {} occlusion photons, shot {rounds} in {:.3} s, sorted in {:.3} s",
        store.stats.lines,
        store.light().len(),
        store.occlusion().len(),
        store.stats.shot.as_secs_f64(),
        store.stats.sorted.as_secs_f64()
    ));
    let all = (store.light().len() + store.occlusion().len()) as u64;
    let step = all.div_ceil(args.most).max(1) as usize;
    let light = store.light().iter().map(|photon| (photon.position, Vec3::ONE));
    let occlusion = store.occlusion().iter().map(|photon| {
        let first = store.named(photon).first();
        (photon.position, first.map_or(Vec3::splat(0.3), |&blocker| colour(blocker)))
    });
    let points: Vec<([f32; 3], Vec3)> = light.chain(occlusion).step_by(step).collect();
    if cloud {
        return output::write_bytes(&args.output, &ply(&points));
    }

    let limits = Limits { passes: 1, time: None };
    let rendered = render(
        &stage,
        &Exact,
        (width, height),
        limits,
        args.threads.into(),
        &AtomicBool::new(false),
        |_| (),
    )?;
    let mut base = rendered.film.develop();
    for pixel in &mut base.pixels {
        let grey = 0.3 * output::clamp_to_screen((pixel[0] + pixel[1] + pixel[2]) / 3.0);
        *pixel = [grey; 3];
    }
    let dots = || dotted(&stage, base.clone(), &points);
    let classes =
        || classified(&Stage { shadow_rays: truth(lights.len()), ..stage }, &prepared, base.clone());
    let image = match show {
        Show::Photons => dots(),
        Show::Classes => classes(),
        Show::Both => beside(&dots(), &classes()),
    };
    output::write(&args.output, &image, None, 0.0)
}

/// Rays of a point to so many lights: as many to each, but no more in all than there is memory for in a tile.
fn truth(lights: usize) -> u32 {
    u32::try_from(lights).unwrap_or(u32::MAX).saturating_mul(TRUTH).min(MOST_TRUTH)
}

/// A colour for a number, far from those of its neighbours.
fn colour(number: u32) -> Vec3 {
    let hue = (f64::from(number) * 0.618_033_988_749_894_9).fract() as f32 * 6.0;
    let ramp = |at: f32| ((hue - at).abs() - 1.0).clamp(0.0, 1.0);
    Vec3::new(ramp(3.0), 1.0 - ramp(2.0), 1.0 - ramp(4.0)) * 0.9 + 0.1 * Vec3::ONE
}

/// Points with colours, for any viewer of clouds.
fn ply(points: &[([f32; 3], Vec3)]) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n\
         property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for (position, colour) in points {
        position.iter().for_each(|at| bytes.extend(at.to_le_bytes()));
        bytes.extend(colour.to_array().map(|c| (c * 255.0).round() as u8));
    }
    bytes
}

/// Draws the photons that the camera sees.
fn dotted(stage: &Stage<'_>, mut image: Image, points: &[([f32; 3], Vec3)]) -> Image {
    let frame = stage.camera;
    let (width, height) = (image.width, image.height);
    // How far apart pixels are, one unit before the pinhole.
    let corner = frame.ray_direction(0.0, 0.0);
    let half = Vec3::new(-corner.dot(frame.right), corner.dot(frame.up), corner.dot(frame.forward));
    let reach = 2.0 * stage.bvh.clearance();
    for &(position, colour) in points {
        let path = Vec3::from(position) - stage.eye;
        let depth = path.dot(frame.forward);
        if depth <= 0.0 {
            continue;
        }
        let across = path.dot(frame.right) / depth * half.z / half.x;
        let upwards = path.dot(frame.up) / depth * half.z / half.y;
        let (x, y) = ((across + 1.0) * 0.5 * width as f32, (1.0 - upwards) * 0.5 * height as f32);
        if !(x >= 0.0 && y >= 0.0 && x < width as f32 && y < height as f32) {
            continue;
        }
        // Stop short of the surface the photon lies on, as far as rounding asks.
        let short = 1.0 - (1e-3 + reach / path.length());
        let ray = Ray::new(stage.eye, path, 0.0, short);
        if !stage.bvh.occluded(&ray, None, &mut Uncounted) {
            image.pixels[y as usize * width as usize + x as usize] = colour.to_array();
        }
    }
    image
}

/// Draws what the photons say about every pixel, and where a look shows that it is wrong.
fn classified(stage: &Stage<'_>, prepared: &PreparedMap, mut image: Image) -> Image {
    let photons = prepared.store.by_light();
    let mut slots = crate::photons::slots(prepared.k());
    let mut nearest = Nearest::new(prepared.k(), &mut slots).expect("room for k");
    let mut room = vec![0; 8192];
    let mut estimates = Vec::new();
    for tile in Tile::cover(image.width, image.height, 16) {
        let asked: Questions = questions(stage, tile, image.width, 0);
        Exact.estimate(stage, &asked, &mut estimates, &mut Counts::default());
        let mut drawn = vec![(Vec3::ZERO, 0.0, false); asked.points.len()];
        for batch in &asked.batches {
            let point = &asked.points[batch.point as usize];
            let place = prepared.place(batch.light as usize, point.x, point.normal);
            let class = photons[batch.light as usize].classify(&place, &mut nearest, &mut room);
            let truth = &estimates[batch.samples.start as usize..batch.samples.end as usize];
            let (colour, wrong) = match class {
                Class::Lit => (Vec3::new(0.1, 0.7, 0.1), truth.contains(&0.0)),
                Class::Dark => (Vec3::new(0.1, 0.2, 0.9), truth.contains(&1.0)),
                Class::Penumbra(_) => (Vec3::new(0.9, 0.15, 0.05), false),
                Class::Unknown => (Vec3::splat(0.4), false),
            };
            let pixel = &mut drawn[batch.point as usize];
            *pixel = (pixel.0 + colour, pixel.1 + 1.0, pixel.2 | wrong);
        }
        for (point, (sum, count, wrong)) in asked.points.iter().zip(drawn) {
            let (x, y) = tile.position(point.pixel as usize);
            let at = &mut image.pixels[y as usize * image.width as usize + x as usize];
            if wrong {
                *at = [1.0; 3];
            } else if count > 0.0 {
                *at = (Vec3::from(*at) + 0.6 * sum / count).to_array();
            }
        }
    }
    image
}

/// Two images of the same height as one.
fn beside(left: &Image, right: &Image) -> Image {
    let rows = left.pixels.chunks(left.width as usize).zip(right.pixels.chunks(right.width as usize));
    let pixels = rows.flat_map(|(left, right)| left.iter().chain(right).copied()).collect();
    Image { width: left.width + right.width, height: left.height, pixels }
}
