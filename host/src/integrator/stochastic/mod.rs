//! Visibility of groups of blockers, of which a random part is evaluated: right on average.
//!
//! All of the scene's triangles stand in two groups (or more, for [`Form::Residual`]), see [`Split`]. A shadow ray asks
//! the groups that its random term wants, and what comes back is an estimate: it may be negative or above one, and is
//! never clamped. No map of blockers is involved; every group is asked through the scene's tree.

mod split;

pub use split::Split;

use super::{Questions, Stage, Visibility};
use crate::error::{Error, Result};
use crate::light::AreaLight;
use crate::sampler::{Pattern, Sampler};
use crate::scene::Scene;
use glam::Vec3;
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::{
    BatchScratch, Bvh, Counter, Counts, Decomposition, Joint, Levels, OneTerm, Probabilities, Quotas, Simd,
    Tally, Targets, Uncounted, offset,
};
use split::{Members, Units};
use std::fmt;
use std::str::FromStr;

/// How the product of visibilities is written as a sum.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Form {
    /// [`Decomposition::InclusionExclusion`].
    InclusionExclusion,
    /// [`Decomposition::Balanced`].
    #[default]
    Balanced,
    /// [`Decomposition::Power`].
    Power(u32),
    /// [`Decomposition::Residual`], and for more than two groups [`Levels`].
    Residual,
}

impl FromStr for Form {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let form = match text {
            "inclusion" => Self::InclusionExclusion,
            "balanced" => Self::Balanced,
            "residual" => Self::Residual,
            _ => {
                let n = text.strip_prefix("power:").and_then(|n| n.parse().ok());
                Self::Power(n.ok_or("wants inclusion, balanced, power:N (like power:8) or residual")?)
            }
        };
        form.decomposition().checked().map(|_| form).map_err(|error| error.to_string())
    }
}

impl fmt::Display for Form {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::InclusionExclusion => f.write_str("inclusion"),
            Self::Balanced => f.write_str("balanced"),
            Self::Power(n) => write!(f, "power:{n}"),
            Self::Residual => f.write_str("residual"),
        }
    }
}

impl Form {
    /// The kernel's; that of `Residual` goes on to the second group half of the time.
    pub fn decomposition(self) -> Decomposition {
        match self {
            Self::InclusionExclusion => Decomposition::InclusionExclusion,
            Self::Balanced => Decomposition::Balanced,
            Self::Power(n) => Decomposition::Power(n),
            Self::Residual => Decomposition::Residual { q: 0.5, u: 1.0 },
        }
    }
}

/// Where the probabilities of the terms come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Rule {
    /// The same for each term; for residual, every number of groups from one to all of them.
    #[default]
    Uniform,
    /// In proportion to the terms' contributions, from 64 test rays for each point and light. Gains nothing: it is the
    /// thesis' rule.
    Importance,
    /// Those of least variance times cost, from 64 test rays for each point and light.
    Optimal,
}

/// What to estimate and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// The sum.
    pub form: Form,
    /// Its probabilities.
    pub rule: Rule,
    /// The groups.
    pub split: Split,
    /// How many groups, from 2 to [`Settings::MOST_GROUPS`]; more than two want [`Form::Residual`].
    pub groups: usize,
    /// Whether of the samples of a point and light exactly the right share takes each term: [`Quotas`].
    pub quotas: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            form: Form::default(),
            rule: Rule::default(),
            split: Split::default(),
            groups: 2,
            quotas: false,
        }
    }
}

impl fmt::Display for Settings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use clap::ValueEnum;
        let name = |value: Option<clap::builder::PossibleValue>| {
            value.map(|value| value.get_name().to_owned()).unwrap_or_default()
        };
        let [rule, split] = [name(self.rule.to_possible_value()), name(self.split.to_possible_value())];
        write!(f, "{} {rule} {split}", self.form)?;
        if self.groups > 2 {
            write!(f, " {} levels", self.groups)?;
        }
        if self.quotas { f.write_str(" quotas") } else { Ok(()) }
    }
}

impl Settings {
    /// The most groups.
    pub const MOST_GROUPS: usize = 64;

    /// The same, if its parts go together.
    pub fn checked(self) -> Result<Self> {
        let wrong = |what: String| Err(Error::Usage(what));
        if !(2..=Self::MOST_GROUPS).contains(&self.groups) {
            return wrong(format!("--levels must be from 2 to {}", Self::MOST_GROUPS));
        }
        if self.groups > 2 && self.form != Form::Residual {
            return wrong(format!(
                "--levels {} wants --decomposition residual: {} is a sum over two groups",
                self.groups, self.form
            ));
        }
        if self.form == Form::Residual && self.rule == Rule::Importance {
            return wrong(
                "--probabilities importance is for sums of three terms: residual takes uniform or optimal"
                    .into(),
            );
        }
        if let Err(error) = self.form.decomposition().checked() {
            return wrong(format!("--decomposition {}: {error}", self.form));
        }
        Ok(self)
    }
}

/// Test rays for each point and light, as many as the thesis takes.
pub(super) const TEST_RAYS: usize = 64;

/// The least probability of a term that test rays speak for: half a ray of them.
const LEAST: f64 = 0.5 / TEST_RAYS as f64;

/// The least chance to go on to further groups that test rays speak for.
const LEAST_REACH: f32 = 1.0 / 16.0;

/// Estimates visibility by random terms over groups of all the scene's blockers.
#[derive(Clone, Debug)]
pub struct Stochastic {
    settings: Settings,
    units: Units,
    /// Of what is not learned.
    fixed: Plan,
}

/// What is asked and returned.
#[derive(Clone, Debug)]
enum Plan {
    /// Three terms, or a coin, over two groups.
    Terms(OneTerm),
    /// The chances to get to each group.
    Reach(Vec<f32>),
}

impl Stochastic {
    /// For a scene and its tree; an error if the settings do not go together, or not with the scene.
    pub fn new(settings: Settings, scene: &Scene, bvh: &Bvh<'_>) -> Result<Self> {
        let settings = settings.checked()?;
        if settings.split == Split::Treelet {
            return Err(Error::Usage(
                "--split treelet wants --blockers map: it halves the subtrees that photons name; over all blockers \
                 give --split sorted"
                    .into(),
            ));
        }
        let units = Units::new(scene, bvh, settings.split, settings.groups)?;
        let fixed = if settings.groups > 2 {
            let mut reach = vec![0.0; settings.groups];
            Levels::even(&mut reach);
            Plan::Reach(reach)
        } else {
            let one = OneTerm::new(settings.form.decomposition(), &Probabilities::UNIFORM);
            Plan::Terms(one.map_err(|error| Error::Usage(error.to_string()))?)
        };
        Ok(Self { settings, units, fixed })
    }

    /// What was asked for.
    pub fn settings(&self) -> Settings {
        self.settings
    }
}

impl Visibility for Stochastic {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        estimates.clear();
        let work = Work::new(self, stage, questions, estimates);
        if stage.count {
            dispatch(stage.level, Trace { work, counter: counts });
        } else {
            dispatch(stage.level, Trace { work, counter: &mut Uncounted });
        }
    }
}

/// All batches of a tile.
struct Trace<'a, C> {
    work: Work<'a>,
    counter: &'a mut C,
}

impl<C: Counter> Task for Trace<'_, C> {
    type Output = ();

    /// Everything but the query is bookkeeping, and stands in [`Work`].
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut work, counter } = self;
        let bvh = work.bvh.on(simd);
        let mut scratch = BatchScratch::new();
        for batch in 0..work.questions.batches.len() {
            work.begin(batch);
            loop {
                for group in 0..work.method.settings.groups {
                    work.gather(group);
                    let [x, y, z] = &work.asked;
                    let Some(targets) = Targets::new(x, y, z) else { continue };
                    if targets.is_empty() {
                        continue;
                    }
                    let light = work.light;
                    let targets = targets.on_parallelogram(light.corner, light.u, light.v);
                    let part =
                        Members { units: &work.method.units, groups: &work.groups, group: group as u8 };
                    let blocked = &mut work.blocked;
                    bvh.occluded_batch_among(work.origin, &targets, part, counter, &mut scratch, blocked);
                    work.scatter(group);
                }
                if work.finish() {
                    break;
                }
            }
        }
    }
}

/// What is known of a sample.
#[derive(Clone, Copy, Debug)]
struct Sample {
    /// The choice of [`OneTerm`], or how many levels to ask.
    choice: u32,
    /// Which of two groups lets light through, as far as was asked.
    visible: [bool; 2],
    /// Of more groups the first found to block, or [`NONE`].
    blocked: u32,
}

/// No group.
const NONE: u32 = u32::MAX;

impl Sample {
    fn new(choice: u32) -> Self {
        Self { choice, visible: [false; 2], blocked: NONE }
    }
}

/// The batch at hand: first its test rays, if probabilities are learned, and then its samples.
struct Work<'a> {
    method: &'a Stochastic,
    bvh: Bvh<'a>,
    lights: &'a [AreaLight],
    pattern: Pattern,
    questions: &'a Questions,
    estimates: &'a mut Vec<f32>,

    /// The point that groups were drawn for.
    point: Option<u32>,
    random: Sampler,
    groups: Vec<u8>,
    order: Vec<u64>,

    origin: Vec3,
    light: &'a AreaLight,
    batch: usize,
    plan: Plan,
    /// Whether the samples are test rays.
    testing: bool,
    samples: Vec<Sample>,
    /// The far ends of test rays.
    tests: [Vec<f32>; 3],
    square: Vec<[f32; 2]>,

    /// The samples asked about, and their far ends.
    places: Vec<u32>,
    asked: [Vec<f32>; 3],
    blocked: Vec<u64>,
}

impl<'a> Work<'a> {
    fn new(
        method: &'a Stochastic,
        stage: &Stage<'a>,
        questions: &'a Questions,
        estimates: &'a mut Vec<f32>,
    ) -> Self {
        const NOWHERE: &AreaLight = &AreaLight {
            shape: crate::light::Shape::Triangle,
            corner: Vec3::ZERO,
            u: Vec3::ZERO,
            v: Vec3::ZERO,
            normal: Vec3::ZERO,
            area: 0.0,
            radiance: Vec3::ZERO,
            triangles: [0; 2],
        };
        Self {
            method,
            bvh: stage.bvh,
            lights: stage.lights,
            pattern: stage.pattern,
            questions,
            estimates,
            point: None,
            random: Sampler::from_key(0),
            groups: Vec::new(),
            order: Vec::new(),
            origin: Vec3::ZERO,
            light: NOWHERE,
            batch: 0,
            plan: method.fixed.clone(),
            testing: false,
            samples: Vec::new(),
            tests: Default::default(),
            square: Vec::new(),
            places: Vec::new(),
            asked: Default::default(),
            blocked: Vec::new(),
        }
    }

    /// Turns to a batch: groups for its point, if it is a new one, and test rays or samples.
    fn begin(&mut self, batch: usize) {
        self.batch = batch;
        let batch = &self.questions.batches[batch];
        let point = &self.questions.points[batch.point as usize];
        self.origin = point.origin;
        self.light = &self.lights[batch.light as usize];
        if self.point != Some(batch.point) {
            self.point = Some(batch.point);
            self.random = Sampler::from_key(point.key);
            self.method.units.draw(point.origin, &mut self.random, &mut self.groups, &mut self.order);
        }
        self.testing = self.method.settings.rule != Rule::Uniform;
        if self.testing {
            self.tests.iter_mut().for_each(Vec::clear);
            self.square.clear();
            self.random.points(self.pattern, TEST_RAYS, &mut self.square);
            for &at in &self.square {
                let y = self.light.point(at);
                let path = y - point.x;
                if self.light.normal.dot(path) < 0.0 && point.normal.dot(path) > 0.0 {
                    let target = offset(y, self.light.normal, self.bvh.clearance());
                    (0..3).for_each(|axis| self.tests[axis].push(target[axis]));
                }
            }
            self.samples.clear();
            self.samples.resize(self.tests[0].len(), Sample::new(0));
        } else {
            self.choose();
        }
    }

    /// Draws what to ask of each sample.
    fn choose(&mut self) {
        let count = self.questions.batches[self.batch].samples.len();
        let (offset, seed) = (self.random.uniform(), self.random.word());
        let quotas = self.method.settings.quotas.then(|| Quotas::new(count as u32, offset, seed));
        let levels = match &self.plan {
            Plan::Terms(_) => None,
            Plan::Reach(reach) => Some(falling(reach)),
        };
        self.samples.clear();
        for k in 0..count as u32 {
            let u = match &quotas {
                Some(quotas) => quotas.number(k),
                None => self.random.uniform(),
            };
            let choice = match (&self.plan, &levels) {
                (Plan::Terms(one), _) => one.choose(u),
                (_, Some(levels)) => levels.depth(u),
                (_, None) => 0,
            };
            self.samples.push(Sample::new(choice as u32));
        }
    }

    /// Collects the samples that want to know of a group.
    fn gather(&mut self, group: usize) {
        // No branches: which samples want to know is as random as can be.
        self.places.clear();
        self.places.resize(self.samples.len(), 0);
        let mut len = 0;
        match &self.plan {
            Plan::Terms(one) => {
                let mut wants = [[self.testing; 2]; 3];
                for (choice, wants) in wants.iter_mut().enumerate().filter(|_| !self.testing) {
                    let needs = one.needs(choice);
                    *wants = [false, true].map(|a| if group == 0 { needs.a } else { needs.b.given(a) });
                }
                for (place, sample) in (0u32..).zip(&self.samples) {
                    self.places[len] = place;
                    len += usize::from(wants[sample.choice as usize % 3][usize::from(sample.visible[0])]);
                }
            }
            Plan::Reach(_) => {
                let least = if self.testing { 0 } else { group as u32 + 1 };
                for (place, sample) in (0u32..).zip(&self.samples) {
                    self.places[len] = place;
                    len += usize::from(sample.blocked == NONE && sample.choice >= least);
                }
            }
        }
        self.places.truncate(len);
        let samples = &self.questions.batches[self.batch].samples;
        for (axis, asked) in self.asked.iter_mut().enumerate() {
            let from = if self.testing {
                &self.tests[axis][..]
            } else {
                &self.questions.targets[axis][samples.start as usize..samples.end as usize]
            };
            asked.clear();
            asked.extend(self.places.iter().map(|&place| from[place as usize]));
        }
        self.blocked.clear();
        self.blocked.resize(self.places.len().div_ceil(64), 0);
    }

    /// Hands the answers back to the samples that asked.
    fn scatter(&mut self, group: usize) {
        let visible = |blocked: &[u64], i: usize| blocked[i / 64] >> (i % 64) & 1 == 0;
        match &self.plan {
            Plan::Terms(_) => {
                for (i, &place) in self.places.iter().enumerate() {
                    self.samples[place as usize].visible[group & 1] = visible(&self.blocked, i);
                }
            }
            // Only samples that were free so far have asked.
            Plan::Reach(_) => {
                for (i, &place) in self.places.iter().enumerate() {
                    let answer = if visible(&self.blocked, i) { NONE } else { group as u32 };
                    self.samples[place as usize].blocked = answer;
                }
            }
        }
    }

    /// After test rays, turns to the samples; after samples, writes their estimates and is done.
    fn finish(&mut self) -> bool {
        if self.testing {
            self.testing = false;
            self.learn();
            self.choose();
            return false;
        }
        match &self.plan {
            Plan::Terms(one) => self.estimates.extend(
                self.samples
                    .iter()
                    .map(|sample| one.value(sample.choice as usize, sample.visible[0], sample.visible[1])),
            ),
            Plan::Reach(reach) => {
                let levels = falling(reach);
                let blocked = |sample: &Sample| (sample.blocked != NONE).then_some(sample.blocked as usize);
                let value = |sample: &Sample| levels.value(blocked(sample));
                self.estimates.extend(self.samples.iter().map(value));
            }
        }
        true
    }

    /// Makes the plan that the test rays speak for. Asking any group is taken to cost the same.
    fn learn(&mut self) {
        if let Plan::Reach(reach) = &mut self.plan {
            // Half a ray more for each group, so that none counts as never blocking.
            let mut first = [0.5; Settings::MOST_GROUPS];
            for sample in &self.samples {
                if let Some(first) = first.get_mut(sample.blocked as usize) {
                    *first += 1.0;
                }
            }
            let rays = self.samples.len() as f64 + 0.5 * (reach.len() + 1) as f64;
            first.iter_mut().for_each(|first| *first /= rays);
            let costs = [1.0; Settings::MOST_GROUPS];
            Levels::best(&first[..reach.len()], &costs[..reach.len()], LEAST_REACH, reach);
            return;
        }
        let mut tally = Tally::default();
        self.samples.iter().for_each(|sample| tally.add(sample.visible[0], sample.visible[1]));
        if let Some(one) = tally.joint().and_then(|joint| learned(self.method.settings, &joint)) {
            self.plan = Plan::Terms(one);
        } else {
            self.plan = self.method.fixed.clone();
        }
    }
}

/// The terms of least cost, or the thesis', for these answers of test rays.
pub(super) fn learned(settings: Settings, joint: &Joint) -> Option<OneTerm> {
    let form = settings.form.decomposition();
    if settings.form == Form::Residual {
        let best = Decomposition::best_residual(joint, 1.0, 1.0, LEAST_REACH);
        return OneTerm::new(best, &Probabilities::UNIFORM).ok();
    }
    let probabilities = match settings.rule {
        Rule::Uniform => Probabilities::UNIFORM,
        Rule::Importance => Probabilities::importance(&form, joint, LEAST).ok()?,
        Rule::Optimal => {
            Probabilities::optimal(&form, joint, &form.costs(joint, 0.0, 1.0, 1.0), LEAST).ok()?
        }
    };
    OneTerm::new(form, &probabilities).ok()
}

/// The levels of chances that were made to fall.
fn falling(reach: &[f32]) -> Levels<'_> {
    Levels::new(reach).expect("even and best chances fall")
}
