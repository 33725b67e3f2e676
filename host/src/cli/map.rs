//! The options of the occlusion map, which several commands share.

use super::whole;
use crate::accel::{Accel, Quality};
use crate::error::{Error, Result};
use crate::integrator::{MapOptions, PreparedMap, Stage};
use crate::light::AreaLight;
use crate::photons::BlockerKind;
use crate::scene::Scene;
use crate::volumetric::Volumes;
use clap::Args;

/// The options of photons, under the heading of whoever has them.
#[derive(Debug, Args)]
pub struct PhotonOptions {
    /// Photons to shoot: lines from the lights [default: four a triangle, 250 000 to 4 000 000].
    #[arg(long, value_name = "N", value_parser = whole::<u64>(1..=100_000_000))]
    photons: Option<u64>,

    /// Rounds to shoot them in. 1 shoots evenly; of more, the first half is even, and the rest goes where photons saw
    /// shadows begin and end, or blockers that few of them named [default: 1].
    #[arg(long, value_name = "N", value_parser = whole::<u32>(1..=64))]
    photon_rounds: Option<u32>,

    /// Photons to look up around a point [default: 50].
    #[arg(long, value_name = "K", value_parser = whole::<u32>(1..=100_000))]
    photon_k: Option<u32>,

    /// How far to look for them [default: three times as far as those of the even round are on average].
    #[arg(long, value_name = "R", value_parser = radius)]
    photon_radius: Option<f32>,

    /// What a photon names when something is in its way: triangle, object (of the file), or treelet:SIZE (a
    /// subtree of the scene's tree with at most SIZE triangles) [default: treelet:128].
    #[arg(long, value_name = "KIND")]
    blocker_kind: Option<BlockerKind>,
}

/// The occlusion map's options.
#[derive(Debug, Args)]
#[command(next_help_heading = "Occlusion map (--method map, or stochastic --blockers map)")]
pub struct MapArgs {
    #[command(flatten)]
    photons: PhotonOptions,

    /// A tree over the triangles that photons name, built for each point and light, as the thesis does; with --method
    /// stochastic one over each half of them. Photons then name triangles.
    #[arg(long)]
    blocker_trees: bool,

    /// Of --method stochastic, what is in the groups: all of the scene (the default), or what the photons of a map
    /// name. With --method map, short for --blocker-kind.
    #[arg(long, value_name = "all|map|KIND")]
    blockers: Option<Asked>,
}

/// Which blockers, or of what kind.
#[derive(Clone, Copy, Debug)]
enum Asked {
    All,
    Map,
    Kind(BlockerKind),
}

impl std::str::FromStr for Asked {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "all" => Ok(Self::All),
            "map" => Ok(Self::Map),
            kind => kind
                .parse()
                .map(Self::Kind)
                .map_err(|error: String| format!("wants all, map, or a kind: {error}")),
        }
    }
}

fn radius(text: &str) -> std::result::Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| "not a number".to_owned())?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err("must be finite and above 0".to_owned()) }
}

impl PhotonOptions {
    /// The first option that was given.
    fn given(&self) -> Option<&'static str> {
        let given = [
            (self.photons.is_some(), "--photons"),
            (self.photon_rounds.is_some(), "--photon-rounds"),
            (self.photon_k.is_some(), "--photon-k"),
            (self.photon_radius.is_some(), "--photon-radius"),
            (self.blocker_kind.is_some(), "--blocker-kind"),
        ];
        given.into_iter().find(|(given, _)| *given).map(|(_, name)| name)
    }

    /// What they ask for.
    pub fn options(&self, quality: Quality) -> MapOptions {
        self.of_kind(self.blocker_kind, quality)
    }

    fn of_kind(&self, kind: Option<BlockerKind>, quality: Quality) -> MapOptions {
        MapOptions {
            lines: self.photons,
            rounds: self.photon_rounds.unwrap_or(1),
            k: self.photon_k.unwrap_or(50) as usize,
            radius: self.photon_radius,
            blockers: kind.unwrap_or_default(),
            quality,
        }
    }
}

impl MapArgs {
    /// The first option that was given.
    pub fn given(&self) -> Option<&'static str> {
        self.photons.given().or(self.blocker_trees.then_some("--blocker-trees"))
    }

    /// Whether `--blockers` was given.
    pub fn names_blockers(&self) -> bool {
        self.blockers.is_some()
    }

    /// Whether trees are built over what photons name.
    pub fn builds_trees(&self) -> bool {
        self.blocker_trees
    }

    /// What they ask for.
    pub fn options(&self, quality: Quality) -> Result<MapOptions> {
        let kind = match (self.blockers, self.photons.blocker_kind) {
            (Some(Asked::All), _) => {
                return Err(Error::Usage(
                    "--blockers all is for --method stochastic: a map asks what its photons name; give a kind, \
                     like --blocker-kind treelet:128"
                        .into(),
                ));
            }
            (Some(Asked::Kind(_)), Some(_)) => {
                return Err(Error::Usage(
                    "--blockers and --blocker-kind both name a kind: give --blocker-kind alone".into(),
                ));
            }
            (Some(Asked::Kind(kind)), None) => Some(kind),
            (_, kind) => kind,
        };
        self.of_kind(kind, quality)
    }

    /// The map that `--method stochastic` is to ask, if any.
    pub fn below_stochastic(&self, quality: Quality) -> Result<Option<MapOptions>> {
        match (self.blockers, self.given()) {
            (Some(Asked::Map), _) => self.of_kind(self.photons.blocker_kind, quality).map(Some),
            (Some(Asked::Kind(kind)), _) => Err(Error::Usage(format!(
                "--blockers is all or map with --method stochastic: give --blockers map --blocker-kind {kind}"
            ))),
            (_, Some(option)) => Err(Error::Usage(format!(
                "{option} is an option of --method map, or of --method stochastic with --blockers map"
            ))),
            (_, None) => Ok(None),
        }
    }

    fn of_kind(&self, kind: Option<BlockerKind>, quality: Quality) -> Result<MapOptions> {
        let kind = match kind {
            Some(BlockerKind::Treelet(_) | BlockerKind::Object) if self.blocker_trees => {
                return Err(Error::Usage(
                    "--blocker-trees builds trees over triangles: give --blocker-kind triangle with it, or no kind"
                        .into(),
                ));
            }
            None if self.blocker_trees => Some(BlockerKind::Triangle),
            kind => kind,
        };
        Ok(self.photons.of_kind(kind, quality))
    }
}

/// Finds the boxes inside closed meshes.
pub fn volumes(scene: &Scene, lights: &[AreaLight], threads: usize) -> Result<Volumes> {
    Ok(pool(threads)?.install(|| Volumes::build(scene, lights)))
}

/// Builds the tree; the same for any number of threads, of which 0 is one a core.
pub fn tree(scene: &Scene, quality: Quality, threads: usize) -> Result<Accel> {
    if threads == 0 {
        return Ok(Accel::build(scene, quality));
    }
    Ok(pool(threads)?.install(|| Accel::build(scene, quality)))
}

fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|error| Error::Usage(format!("cannot start {threads} threads: {error}")))
}

/// Shoots the photons.
pub fn prepare(stage: &Stage<'_>, options: &MapOptions, threads: usize) -> Result<PreparedMap> {
    Ok(pool(threads)?.install(|| PreparedMap::new(stage, options)))
}
