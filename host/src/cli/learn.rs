//! `occlude map`: what `--method auto` learns, kept in a file.

use super::render::{CameraArgs, Progress};
use super::{Ended, note, print, whole};
use crate::accel::Quality;
use crate::error::{Error, Result};
use crate::integrator::{Auto, AutoOptions, SavedMap, Stage};
use crate::render::{Limits, render};
use crate::sampler::Pattern;
use crate::{light, output, scene};
use clap::Args;
use occlude_kernel::lanes::Level;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Arguments of `occlude map`.
#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct LearnArgs {
    /// The scene to learn: a folder with one .obj, or an .obj. Without -o, a map to look into.
    input: PathBuf,

    /// Where to write the map, for `occlude render --method auto --map FILE`.
    #[arg(short, long, value_name = "FILE", conflicts_with = "inspect")]
    output: Option<PathBuf>,

    /// Say what a map holds; the same as no -o.
    #[arg(long)]
    inspect: bool,

    /// Passes to learn from.
    #[arg(requires = "output", conflicts_with = "inspect")]
    #[arg(long, default_value_t = 8, value_name = "N", value_parser = whole::<u32>(1..=1_000_000))]
    passes: u32,

    /// Shadow rays a camera sample, over all lights together.
    #[arg(requires = "output", conflicts_with = "inspect")]
    #[arg(long, default_value_t = 64, value_name = "N", value_parser = whole::<u32>(1..=65536))]
    shadow_rays: u32,

    /// Bytes that the map may take, like 64M [default: 256M].
    #[arg(requires = "output", conflicts_with = "inspect")]
    #[arg(long, value_name = "BYTES", allow_hyphen_values = true, value_parser = memory)]
    map_memory: Option<usize>,

    /// How long to look for a good tree.
    #[arg(requires = "output", conflicts_with = "inspect")]
    #[arg(long, value_enum, default_value_t)]
    quality: Quality,

    /// Threads; 0 for one a core. The map is the same for any number.
    #[arg(requires = "output", conflicts_with = "inspect")]
    #[arg(long, default_value_t = 0, value_name = "T", value_parser = whole::<u16>(0..=1024))]
    threads: u16,

    /// Seed of the random numbers.
    #[arg(requires = "output", conflicts_with = "inspect")]
    #[arg(long, default_value_t = 0, value_name = "S", value_parser = whole::<u64>(0..=u64::MAX))]
    seed: u64,

    /// Print nothing but errors.
    #[arg(short, long)]
    quiet: bool,

    #[command(flatten)]
    camera: CameraArgs,
}

/// A number of bytes: 1000000, 64k, 256M, 2G; in powers of 1024.
pub(super) fn memory(text: &str) -> std::result::Result<usize, String> {
    let wanted = || "wants a number of bytes, like 64M or 2G".to_owned();
    let (digits, shift) = match text.char_indices().last() {
        Some((at, 'k' | 'K')) => (&text[..at], 10),
        Some((at, 'm' | 'M')) => (&text[..at], 20),
        Some((at, 'g' | 'G')) => (&text[..at], 30),
        _ => (text, 0),
    };
    let number: u64 = digits.parse().map_err(|_| wanted())?;
    let bytes = number.checked_mul(1 << shift).ok_or_else(wanted)?;
    usize::try_from(bytes).map_err(|_| wanted())
}

/// Options for so much memory.
pub(super) fn options(memory: Option<usize>) -> AutoOptions {
    let default = AutoOptions::default();
    AutoOptions { memory: memory.unwrap_or(default.memory), ..default }
}

/// Reads a map.
pub(super) fn read(path: &Path) -> Result<SavedMap> {
    SavedMap::read(path).map_err(|error| match error {
        Error::Io { source, .. } if source.kind() == ErrorKind::NotFound => Error::Usage(format!(
            "reading {0}: there is no such map; mend the name, or make one with `occlude map SCENE -o {0}`",
            path.display()
        )),
        error => error,
    })
}

/// Runs the command.
pub(super) fn run(args: &LearnArgs, level: Level) -> Result<Ended> {
    let Some(path) = &args.output else {
        let looks_like_a_scene =
            args.input.is_dir() || args.input.extension().is_some_and(|end| end.eq_ignore_ascii_case("obj"));
        if looks_like_a_scene && !args.inspect {
            return Err(Error::Usage(format!(
                "{} is a scene: say where to write its map, with -o FILE",
                args.input.display()
            )));
        }
        if let Some(option) = args.camera.given() {
            return Err(Error::Usage(format!(
                "{option} is for a scene: a map is only looked into without -o"
            )));
        }
        print(&read(&args.input)?.describe())?;
        return Ok(Ended::Done);
    };
    output::check_writable_bytes(path)?;
    let scene = scene::load(&args.input, &args.camera.request())?;
    if !args.quiet {
        scene.warnings.iter().for_each(|warning| note(&format!("warning: {warning}")));
    }
    output::check_apart(&[("--output", path)], &super::files_of(&scene))?;
    let camera = scene.camera.ok_or_else(|| Error::input(&args.input, "has no camera"))?;
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
    let auto = Auto::new(options(args.map_memory)).restless();
    let stop = super::interruptible("the map");
    let limits = Limits { passes: args.passes, time: None };
    let size = (camera.width, camera.height);
    let progress = Progress::new(args.quiet, args.passes, u64::from(size.0) * u64::from(size.1));
    let passed = |pass| progress.passed(pass);
    let rendered = render(&stage, &auto, size, limits, args.threads.into(), &stop, passed)?;
    progress.finish();
    if rendered.passes == 0 {
        return Ok(super::interrupted_before_the_first_pass(args.quiet));
    }
    let saved = auto.save(&stage);
    saved.write(path)?;
    if !args.quiet {
        note(saved.describe().trim_end());
        note(&format!("wrote {}", path.display()));
    }
    Ok(if rendered.interrupted { Ended::Interrupted } else { Ended::Done })
}

#[cfg(test)]
mod tests {
    use super::memory;

    #[test]
    fn bytes_as_people_write_them() {
        assert_eq!(memory("4096"), Ok(4096));
        assert_eq!(memory("64k"), Ok(64 << 10));
        assert_eq!(memory("256M"), Ok(256 << 20));
        assert_eq!(memory("2G"), Ok(2 << 30));
        for wrong in ["", "M", "-1", "1.5G", "12T", "99999999999G", "é"] {
            assert!(memory(wrong).is_err(), "{wrong}");
        }
    }
}
