//! `occlude render`.

use super::map::{self, MapArgs};
use super::{Ended, learn, note, whole};
use crate::accel::Quality;
use crate::error::{Error, Result};
use crate::integrator::{
    Auto, AutoOptions, Exact, Form, Map, MapOptions, MapTerms, Rule, Settings, Split, Stage, Stochastic,
    Visibility, Walled,
};
use crate::photons::BlockerKind;
use crate::render::{Limits, render, render_adaptively};
use crate::report::{ErrorFigures, Memory, Report, SettledFigures, Times, WorkCounts};
use crate::sampler::Pattern;
use crate::scene::CameraRequest;
use crate::volumetric::Volumes;
use crate::{light, metrics, output, scene};
use clap::{Args, ValueEnum};
use glam::Vec3;
use indicatif::{ProgressBar, ProgressStyle};
use occlude_kernel::lanes::{Level, level_name};
use std::io::IsTerminal;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Arguments of `occlude render`.
#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
pub struct RenderArgs {
    /// A folder with scene.obj (or exactly one .obj), or an .obj file.
    scene: PathBuf,

    /// Where to write the image: .png (sRGB), .exr (float, with a variance layer), .hdr or .pfm. May be given
    /// several times. Without it, NAME.png in the current folder.
    #[arg(short, long, value_name = "FILE")]
    output: Vec<PathBuf>,

    /// Camera samples a pixel, one a pass.
    #[arg(long, default_value_t = 16, value_name = "P", value_parser = whole::<u32>(1..=u64::from(u32::MAX)))]
    spp: u32,

    /// Shadow rays a camera sample, over all lights together; with --method auto about so many on average, and with
    /// --adaptive on so many at most.
    #[arg(long, default_value_t = 16, value_name = "N", value_parser = whole::<u32>(1..=65536))]
    shadow_rays: u32,

    /// How visibility is found.
    #[arg(long, value_enum, default_value_t)]
    method: Method,

    /// Boxes inside closed meshes, which block rays without a look at triangles. The exact method gives the same image
    /// with and without; the map misses fewer blockers with them [default: off for exact, on for map and for stochastic
    /// with --blockers map].
    #[arg(long, value_enum, value_name = "SWITCH")]
    volumetric: Option<Switch>,

    /// Whether camera samples go where the picture is not sure yet, and get fewer shadow rays where these are not what it
    /// lacks: --spp then stands for the work of so many, from 8 on [default: on for --method auto].
    #[arg(long, value_enum)]
    adaptive: Option<Switch>,

    /// How the shadow rays are spread over a light.
    #[arg(long, value_enum, default_value_t)]
    pattern: Pattern,

    /// How long to look for a good tree.
    #[arg(long, value_enum, default_value_t)]
    quality: Quality,

    /// Threads; 0 for one a core. The image is the same for any number.
    #[arg(long, default_value_t = 0, value_name = "T", value_parser = whole::<u16>(0..=1024))]
    threads: u16,

    /// Seed of the random numbers.
    #[arg(long, default_value_t = 0, value_name = "S", value_parser = whole::<u64>(0..=u64::MAX))]
    seed: u64,

    /// Begin no pass after this many seconds of rendering.
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    time_limit: Option<Duration>,

    /// Brightness of .png files, in stops.
    #[arg(long, default_value_t = 0.0, value_name = "EV", value_parser = finite)]
    exposure: f32,

    /// Compare the result with this image (.exr, .hdr or .pfm).
    #[arg(long, value_name = "FILE")]
    reference: Option<PathBuf>,

    /// Write times, counts, memory and error as JSON. Counting slows the render a little.
    #[arg(long, value_name = "FILE")]
    stats: Option<PathBuf>,

    /// Print nothing but errors.
    #[arg(short, long)]
    quiet: bool,

    #[command(flatten)]
    auto: AutoArgs,

    #[command(flatten)]
    stochastic: StochasticArgs,

    #[command(flatten)]
    map: MapArgs,

    #[command(flatten)]
    camera: CameraArgs,
}

/// The options of `--method auto`.
#[derive(Debug, Args)]
#[command(next_help_heading = "With --method auto")]
struct AutoArgs {
    /// Begin with what was learned before: a map that `occlude map SCENE -o FILE` wrote.
    #[arg(long = "map", value_name = "FILE")]
    file: Option<PathBuf>,

    /// Bytes that the map may take, like 64M [default: 256M].
    #[arg(long, value_name = "BYTES", allow_hyphen_values = true, value_parser = learn::memory)]
    map_memory: Option<usize>,
}

impl AutoArgs {
    /// The first option that was given.
    fn given(&self) -> Option<&'static str> {
        let given = [(self.file.is_some(), "--map"), (self.map_memory.is_some(), "--map-memory")];
        given.into_iter().find(|(given, _)| *given).map(|(_, name)| name)
    }
}

/// The options of `--method stochastic`.
#[derive(Debug, Args)]
#[command(next_help_heading = "With --method stochastic")]
struct StochasticArgs {
    /// The sum that the visibility of two groups of blockers is written as: inclusion, balanced, power:N (like power:8)
    /// or residual [default: balanced].
    #[arg(long, value_name = "FORM")]
    decomposition: Option<Form>,

    /// Where the probabilities of its terms come from [default: uniform].
    #[arg(long, value_enum, value_name = "RULE")]
    probabilities: Option<Rule>,

    /// How blockers are divided into groups [default: random].
    #[arg(long, value_enum)]
    split: Option<Split>,

    /// How many groups; more than 2 with --decomposition residual, which asks the later ones the more rarely
    /// [default: 2].
    #[arg(long, value_name = "K", value_parser = whole::<usize>(0..=u64::from(u32::MAX)))]
    levels: Option<usize>,

    /// Of the shadow rays of a point and light, exactly the right share takes each term.
    #[arg(long)]
    quotas: bool,

    /// Where the 64 test rays start that say what probabilities should be: anew at each point, or with --blockers map once
    /// for each cell of a grid over the map, whose points share them [default: point].
    #[arg(long, value_enum, value_name = "WHERE")]
    test_rays: Option<TestRays>,
}

/// What test rays are shot for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum TestRays {
    /// For each point and light.
    Point,
    /// For each cell of the map and light.
    Cell,
}

impl StochasticArgs {
    /// The first option that was given.
    fn given(&self) -> Option<&'static str> {
        let given = [
            (self.decomposition.is_some(), "--decomposition"),
            (self.probabilities.is_some(), "--probabilities"),
            (self.split.is_some(), "--split"),
            (self.levels.is_some(), "--levels"),
            (self.quotas, "--quotas"),
            (self.test_rays.is_some(), "--test-rays"),
        ];
        given.into_iter().find(|(given, _)| *given).map(|(_, name)| name)
    }

    /// With or without a map.
    fn settings(&self, map: Option<&MapOptions>) -> Result<Settings> {
        let rule = self.probabilities.unwrap_or_default();
        if self.test_rays.is_some() && rule == Rule::Uniform {
            return Err(Error::Usage(
                "--test-rays wants --probabilities importance or optimal: uniform ones need no test rays"
                    .into(),
            ));
        }
        if self.test_rays == Some(TestRays::Cell) && map.is_none() {
            return Err(Error::Usage(
                "--test-rays cell wants --blockers map: the cells are the map's".into(),
            ));
        }
        if let (Some(Split::Treelet), Some(map)) = (self.split, map)
            && !matches!(map.blockers, BlockerKind::Treelet(_))
        {
            return Err(Error::Usage(format!(
                "--split treelet halves subtrees of the scene's tree, and photons name {}: give --blocker-kind \
                 treelet:128, or --split sorted",
                map.blockers
            )));
        }
        Settings {
            form: self.decomposition.unwrap_or_default(),
            rule,
            split: self.split.unwrap_or_default(),
            groups: self.levels.unwrap_or(2),
            quotas: self.quotas,
        }
        .checked()
    }
}

/// The camera's options, which `info` and `render` share.
#[derive(Debug, Args)]
#[command(next_help_heading = "Camera")]
pub struct CameraArgs {
    /// Image size in pixels.
    #[arg(long, value_name = "WxH", allow_hyphen_values = true, value_parser = size)]
    size: Option<(u32, u32)>,

    /// A camera file, and not the camera.json beside the scene.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,

    /// Where the camera is.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, value_parser = vector)]
    eye: Option<Vec3>,

    /// The point in the middle of the image.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, value_parser = vector)]
    target: Option<Vec3>,

    /// Which way is up.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, value_parser = vector)]
    up: Option<Vec3>,

    /// The vertical angle of view in degrees.
    #[arg(long, value_name = "DEGREES", value_parser = finite)]
    vfov: Option<f32>,
}

impl CameraArgs {
    /// The first option that was given.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (self.size.is_some(), "--size"),
            (self.camera.is_some(), "--camera"),
            (self.eye.is_some(), "--eye"),
            (self.target.is_some(), "--target"),
            (self.up.is_some(), "--up"),
            (self.vfov.is_some(), "--vfov"),
        ];
        given.into_iter().find(|(given, _)| *given).map(|(_, name)| name)
    }

    /// The same for [`scene::load`].
    pub fn request(&self) -> CameraRequest {
        CameraRequest {
            file: self.camera.clone(),
            eye: self.eye,
            target: self.target,
            up: self.up,
            vfov_deg: self.vfov,
            size: self.size,
        }
    }
}

/// How visibility is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Method {
    /// Every shadow ray is traced through the scene.
    Exact,
    /// A random part of the blockers is asked, by a sum over two groups of them: right on average, noisier.
    Stochastic,
    /// Photons say what may be in the way, and only that is traced: quick or slow, and biased.
    Map,
    /// A map learns where shadows begin and end, and rays go there: right on average, and the quickest.
    #[default]
    Auto,
}

/// Whether something is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Switch {
    /// Use it.
    On,
    /// Do without.
    Off,
}

/// What `--method` and its options ask for.
enum Chosen {
    Exact,
    Stochastic(Settings),
    MapTerms(Settings, MapOptions),
    Map(MapOptions),
    Auto(AutoOptions),
}

impl Chosen {
    fn from(args: &RenderArgs) -> Result<Self> {
        if let (true, Some(option)) = (args.method != Method::Stochastic, args.stochastic.given()) {
            return Err(Error::Usage(format!("{option} is an option of --method stochastic")));
        }
        if let (true, Some(option)) = (args.method != Method::Auto, args.auto.given()) {
            return Err(Error::Usage(format!("{option} is an option of --method auto")));
        }
        let (mapped, blockers) = (args.map.given(), args.map.names_blockers().then_some("--blockers"));
        if let (Method::Exact | Method::Auto, Some(option)) = (args.method, mapped.or(blockers)) {
            return Err(Error::Usage(format!(
                "{option} is an option of --method map, or of --method stochastic with --blockers map"
            )));
        }
        let no_map = args.method == Method::Stochastic && args.map.below_stochastic(args.quality)?.is_none();
        if (no_map || args.method == Method::Auto) && args.volumetric.is_some() {
            return Err(Error::Usage(
                "--volumetric is an option of --method exact and map, and of stochastic with --blockers map"
                    .to_owned(),
            ));
        }
        Ok(match args.method {
            Method::Exact => Self::Exact,
            Method::Stochastic => match args.map.below_stochastic(args.quality)? {
                None => Self::Stochastic(args.stochastic.settings(None)?),
                Some(options) => {
                    Self::MapTerms(MapTerms::checked(args.stochastic.settings(Some(&options))?)?, options)
                }
            },
            Method::Map => Self::Map(args.map.options(args.quality)?),
            Method::Auto => Self::Auto(learn::options(args.auto.map_memory)),
        })
    }

    fn name(&self, args: &RenderArgs) -> String {
        let trees = if args.map.builds_trees() { ", trees" } else { "" };
        let cells = if args.stochastic.test_rays == Some(TestRays::Cell) { ", by cells" } else { "" };
        match self {
            Self::Exact => "exact".to_owned(),
            Self::Stochastic(settings) => format!("stochastic {settings}"),
            Self::MapTerms(settings, _) => format!("map + stochastic {settings}{trees}{cells}"),
            Self::Map(_) => format!("map{trees}"),
            Self::Auto(_) => "auto".to_owned(),
        }
    }
}

pub(super) fn finite(text: &str) -> std::result::Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| "not a number".to_owned())?;
    if value.is_finite() { Ok(value) } else { Err("must be finite".to_owned()) }
}

fn seconds(text: &str) -> std::result::Result<Duration, String> {
    let value: f64 = text.parse().map_err(|_| "not a number of seconds".to_owned())?;
    Duration::try_from_secs_f64(value).map_err(|_| "must be a time from 0 on, in seconds".to_owned())
}

fn vector(text: &str) -> std::result::Result<Vec3, String> {
    let parts = text.split(',').map(|part| finite(part.trim())).collect::<std::result::Result<Vec<f32>, _>>();
    match parts.as_deref() {
        Ok(&[x, y, z]) => Ok(Vec3::new(x, y, z)),
        _ => Err("wants three numbers with commas between, like 0,1.5,-3".to_owned()),
    }
}

fn size(text: &str) -> std::result::Result<(u32, u32), String> {
    text.split_once(['x', 'X'])
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)))
        .ok_or_else(|| "wants width x height in pixels, like 1280x720".to_owned())
}

/// Runs the command.
pub fn run(args: &RenderArgs, level: Level) -> Result<Ended> {
    let chosen = Chosen::from(args)?;
    for path in &args.output {
        output::check_writable(path)?;
    }
    if let Some(path) = &args.stats {
        output::check_writable_bytes(path)?;
    }
    let reference = args.reference.as_ref().map(output::read).transpose()?;
    let learned = args.auto.file.as_deref().map(learn::read).transpose()?;

    let start = Instant::now();
    let scene = scene::load(&args.scene, &args.camera.request())?;
    let load = start.elapsed();
    if !args.quiet {
        scene.warnings.iter().for_each(|warning| note(&format!("warning: {warning}")));
    }
    let camera = scene.camera.ok_or_else(|| Error::input(&args.scene, "has no camera"))?;
    let size = (camera.width, camera.height);
    if let (Some(reference), Some(path)) = (&reference, &args.reference) {
        metrics::check_finite(reference).map_err(|error| Error::input(path, error.to_string()))?;
        let has = (reference.width, reference.height);
        if has != size {
            return Err(Error::Usage(format!(
                "the reference is {}x{} but the image is {}x{}: give --size {}x{}, or another reference",
                has.0, has.1, size.0, size.1, has.0, has.1
            )));
        }
    }
    let outputs = if args.output.is_empty() {
        vec![PathBuf::from(format!("{}.png", scene.name))]
    } else {
        args.output.clone()
    };
    for path in &outputs {
        output::check_writable(path)?;
    }
    let mut written: Vec<_> = outputs.iter().map(|path| ("--output", &**path)).collect();
    written.extend(args.stats.as_deref().map(|path| ("--stats", path)));
    let mut read = super::files_of(&scene);
    read.extend(args.auto.file.as_deref().map(|path| ("--map", path)));
    read.extend(args.reference.as_deref().map(|path| ("--reference", path)));
    output::check_apart(&written, &read)?;

    let start = Instant::now();
    let accel = map::tree(&scene, args.quality, args.threads.into())?;
    let build = start.elapsed();
    let lights = light::lights(&scene);
    let frame = camera.frame();
    let stage = Stage {
        scene: &scene,
        bvh: accel.bvh(),
        lights: &lights,
        eye: camera.eye,
        camera: &frame,
        shadow_rays: args.shadow_rays,
        pattern: args.pattern,
        seed: args.seed,
        level,
        count: args.stats.is_some(),
    };

    let start = Instant::now();
    let (mut stochastic, mut prepared, mut auto) = (None, None, None);
    match &chosen {
        Chosen::Exact => {}
        Chosen::Stochastic(settings) => stochastic = Some(Stochastic::new(*settings, &scene, &stage.bvh)?),
        Chosen::Auto(options) => {
            auto = Some(match (learned, &args.auto.file) {
                (Some(learned), Some(path)) => {
                    learned.check(path, &stage)?;
                    Auto::with_saved(*options, learned)
                }
                _ => Auto::new(*options),
            });
        }
        Chosen::MapTerms(_, options) | Chosen::Map(options) => {
            prepared = Some(map::prepare(&stage, options, args.threads.into())?)
        }
    }
    let volumetric = match (&chosen, args.volumetric) {
        (_, Some(switch)) => switch == Switch::On,
        (chosen, None) => matches!(chosen, Chosen::Map(_) | Chosen::MapTerms(..)),
    };
    let volumes = volumetric.then(|| map::volumes(&scene, &lights, args.threads.into())).transpose()?;
    let occluders = volumes.as_ref().map(Volumes::occluders).unwrap_or_default();
    let mut map = prepared.as_ref().map(|prepared| prepared.visibility().with_occluders(occluders.clone()));
    if args.map.builds_trees() {
        map = map.map(Map::with_trees).transpose()?;
    }
    let mut terms = match (&chosen, &mut map) {
        (Chosen::MapTerms(settings, _), map) => {
            map.take().map(|map| MapTerms::new(map, *settings, &scene)).transpose()?
        }
        _ => None,
    };
    if args.stochastic.test_rays == Some(TestRays::Cell) {
        terms = terms.map(MapTerms::by_cells);
    }
    let map = terms.as_ref().map(MapTerms::map).or(map.as_ref());
    let walled = volumes.is_some().then(|| Walled::new(occluders));
    let method: &dyn Visibility = match (&stochastic, &terms, map, &auto, &walled) {
        (Some(stochastic), ..) => stochastic,
        (_, Some(terms), ..) => terms,
        (_, _, Some(map), ..) => map,
        (_, _, _, Some(auto), _) => auto,
        (.., Some(walled)) => walled,
        _ => &Exact,
    };
    let preprocess = start.elapsed();

    let stop = super::interruptible("the picture");
    let progress = Progress::new(args.quiet, args.spp, u64::from(size.0) * u64::from(size.1));
    let limits = Limits { passes: args.spp, time: args.time_limit };
    let passed = |pass| progress.passed(pass);
    let adaptive = args.adaptive.map_or(args.method == Method::Auto, |switch| switch == Switch::On);
    let rendered = if adaptive {
        render_adaptively(&stage, method, size, limits, args.threads.into(), &stop, passed)?
    } else {
        render(&stage, method, size, limits, args.threads.into(), &stop, passed)?
    };
    progress.finish();
    if rendered.passes == 0 {
        return Ok(super::interrupted_before_the_first_pass(args.quiet));
    }

    let mut image = rendered.film.develop();
    // Estimates are averaged as they are; the picture that is written holds light.
    let settled = (args.method == Method::Auto).then(|| image.settle());
    let variance = rendered.film.variance_of_mean();
    for path in &outputs {
        output::write(path, &image, Some(&variance), args.exposure)?;
    }
    let compared = reference.map(|reference| metrics::compare(&image, &reference)).transpose();
    let figures = compared.as_ref().ok().and_then(Option::as_ref);
    let error =
        figures.map(|c| ErrorFigures { rmse: c.rmse, relmse: c.relmse, mean_ratio: c.mean_ratio_all.ratio });
    let seconds = |time: Duration| time.as_secs_f64();
    let report = Report {
        scene: scene.name.clone(),
        method: chosen.name(args),
        size: [size.0, size.1],
        spp: rendered.passes,
        shadow_rays: args.shadow_rays,
        threads: if args.threads == 0 { rayon::current_num_threads() } else { args.threads.into() },
        seed: args.seed,
        simd: level_name(level).to_owned(),
        interrupted: rendered.interrupted,
        time: Times {
            load_s: seconds(load),
            build_s: seconds(build),
            preprocess_s: seconds(preprocess),
            render_s: seconds(rendered.elapsed),
            camera_s: seconds(rendered.times.camera),
            light_s: seconds(rendered.times.light),
            visibility_s: seconds(rendered.times.visibility),
            shade_s: seconds(rendered.times.shade),
        },
        counts: WorkCounts {
            camera_rays: rendered.camera_counts.rays,
            shadow_rays: rendered.shadow_counts.rays,
            triangle_tests: rendered.shadow_counts.triangle_tests,
            node_tests: rendered.shadow_counts.node_tests,
            camera_triangle_tests: rendered.camera_counts.triangle_tests,
            camera_node_tests: rendered.camera_counts.node_tests,
        },
        memory: Memory {
            bvh_bytes: accel.bytes(),
            bvh_bytes_per_triangle: accel.bytes() as f64 / accel.triangles().max(1) as f64,
            triangles: accel.triangles(),
        },
        map: prepared.as_ref().zip(map).map(|(prepared, map)| prepared.figures(map)),
        volumes: volumes.as_ref().map(|volumes| (&volumes.stats).into()),
        settled: settled.map(|settled| {
            let sum: f64 = image.pixels.iter().flatten().copied().map(f64::from).sum();
            SettledFigures { pixels: settled.pixels, part: settled.sum / sum.max(f64::MIN_POSITIVE) }
        }),
        error,
    };
    if let Some(path) = &args.stats {
        report.write(path)?;
    }
    compared?;
    if !args.quiet {
        let written: Vec<String> = outputs.iter().map(|path| path.display().to_string()).collect();
        note(report.summary().trim_end());
        if rendered.interrupted {
            note(&format!("interrupted after {} of {} passes", rendered.passes, args.spp));
        }
        note(&format!("wrote {}", written.join(", ")));
    }
    Ok(if rendered.interrupted { Ended::Interrupted } else { Ended::Done })
}

/// A bar on a terminal; in a pipe lines, at most one a second and one for the last pass.
pub(super) enum Progress {
    Quiet,
    Bar(ProgressBar, u64),
    Lines { passes: u32, start: Instant, said: Mutex<Duration> },
}

impl Progress {
    pub(super) fn new(quiet: bool, passes: u32, pixels: u64) -> Self {
        if quiet {
            return Self::Quiet;
        }
        if !std::io::stderr().is_terminal() {
            return Self::Lines { passes, start: Instant::now(), said: Mutex::default() };
        }
        let bar = ProgressBar::new(u64::from(passes) * pixels);
        let template = "{bar:30} {percent:>3}%  {per_sec} paths, {eta} left";
        if let Ok(style) = ProgressStyle::with_template(template) {
            let rate = |state: &indicatif::ProgressState, out: &mut dyn std::fmt::Write| {
                let _ = write!(out, "{:.2} M/s", state.per_sec() * 1e-6);
            };
            bar.set_style(style.with_key("per_sec", rate));
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Self::Bar(bar, pixels)
    }

    pub(super) fn passed(&self, pass: u32) {
        match self {
            Self::Quiet => {}
            Self::Bar(bar, pixels) => bar.set_position(u64::from(pass) * pixels),
            Self::Lines { passes, start, said } => {
                let spent = start.elapsed();
                let mut said = said.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                if pass < *passes && spent - *said < Duration::from_secs(1) {
                    return;
                }
                *said = spent;
                let spent = spent.as_secs_f64();
                let left = spent / f64::from(pass) * f64::from(passes - pass);
                note(&format!("pass {pass} of {passes}, {spent:.1} s, {left:.1} s left"));
            }
        }
    }

    pub(super) fn finish(&self) {
        if let Self::Bar(bar, _) = self {
            bar.finish_and_clear();
        }
    }
}
