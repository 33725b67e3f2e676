//! `occlude compare-methods`.

use super::render::CameraArgs;
use super::reproduce::{Progress, write};
use super::{Ended, note, whole};
use crate::accel::Quality;
use crate::compare_methods::{Comparison, FILES, MAKER, Method, compare_methods};
use crate::error::{Error, Result};
use crate::integrator::{MapOptions, Stage};
use crate::page::Folder;
use crate::photons::BlockerKind;
use crate::reproduce::Run;
use crate::sampler::Pattern;
use crate::{light, scene};
use clap::Args;
use occlude_kernel::lanes::Level;
use std::path::PathBuf;

/// Arguments of `occlude compare-methods`.
#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct CompareMethodsArgs {
    /// The scene: a folder with one .obj, or an .obj.
    scene: PathBuf,

    /// Which methods; gains are against the first.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "exact,auto,stochastic,map")]
    methods: Vec<Method>,

    /// The folder to write index.html and the .csv files to.
    #[arg(short, long, value_name = "FOLDER", default_value = "methods")]
    output: PathBuf,

    /// Passes: camera samples a pixel.
    #[arg(long, default_value_t = 16, value_name = "N", value_parser = whole::<u32>(1..=1_000_000))]
    spp: u32,

    /// Shadow rays a camera sample, over all lights together.
    #[arg(long, default_value_t = 64, value_name = "N", value_parser = whole::<u32>(1..=65536))]
    shadow_rays: u32,

    /// Shadow rays of the reference.
    #[arg(long, default_value_t = 1024, value_name = "N", value_parser = whole::<u32>(1..=65536))]
    reference_rays: u32,

    /// How long to look for a good tree.
    #[arg(long, value_enum, default_value_t)]
    quality: Quality,

    /// Threads; 0 for one a core. All but the times is the same for any number.
    #[arg(long, default_value_t = 0, value_name = "T", value_parser = whole::<u16>(0..=1024))]
    threads: u16,

    /// Seed of the random numbers.
    #[arg(long, default_value_t = 0, value_name = "S", value_parser = whole::<u64>(0..=u64::MAX))]
    seed: u64,

    /// Write to the folder whatever is in it.
    #[arg(long)]
    force: bool,

    /// Print nothing but errors.
    #[arg(short, long)]
    quiet: bool,

    #[command(flatten)]
    camera: CameraArgs,
}

/// Runs the command.
pub(super) fn run(args: &CompareMethodsArgs, level: Level) -> Result<Ended> {
    for (k, method) in args.methods.iter().enumerate() {
        if args.methods[..k].contains(method) {
            return Err(Error::Usage("--methods names one twice: leave one of them out".to_owned()));
        }
    }
    let scene = scene::load(&args.scene, &args.camera.request())?;
    if !args.quiet {
        scene.warnings.iter().for_each(|warning| note(&format!("warning: {warning}")));
    }
    let camera = scene.camera.ok_or_else(|| Error::input(&args.scene, "has no camera"))?;
    let folder = Folder::claim(&args.output, MAKER, &FILES, args.force)?;
    let accel = super::map::tree(&scene, args.quality, args.threads.into())?;
    let lights = light::lights(&scene);
    let frame = camera.frame();
    let stage = Stage {
        scene: &scene,
        bvh: accel.bvh(),
        lights: &lights,
        eye: camera.eye,
        camera: &frame,
        shadow_rays: args.shadow_rays,
        pattern: Pattern::default(),
        seed: args.seed,
        level,
        count: false,
    };
    let options = MapOptions {
        lines: None,
        rounds: 1,
        k: 50,
        radius: None,
        blockers: BlockerKind::default(),
        quality: args.quality,
    };
    let comparison = Comparison {
        methods: args.methods.clone(),
        passes: args.spp,
        reference_rays: args.reference_rays,
        size: (camera.width, camera.height),
    };
    let stop = super::interruptible("the page");
    let progress = Progress::new(args.quiet);
    let run = Run {
        quick: false,
        seed: args.seed,
        threads: usize::from(args.threads),
        level,
        stop: &stop,
        watch: &progress,
    };
    write(&folder, compare_methods(&stage, &options, &comparison, &run), &progress, args.quiet)
}
