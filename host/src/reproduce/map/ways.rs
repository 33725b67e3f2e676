//! What the page of the map compares: the plain map, its remedies one by one, and all of them together.

use super::{Setting, Size};
use crate::integrator::{Exact, Form, MapTerms, PreparedMap, Rule, Settings, Split, Visibility};
use crate::photons::BlockerKind;
use crate::reproduce::{Halted, Run};
use crate::volumetric::Volumes;
use std::path::Path;

/// Rounds of adaptive photons.
pub(super) const ROUNDS: u32 = 3;

/// The plain sum over two halves.
pub(super) const PLAIN: Settings =
    Settings { form: Form::Balanced, rule: Rule::Uniform, split: Split::Random, groups: 2, quotas: false };

/// How visibility is asked: without any of these, photons shot evenly name triangles, and all that are named are tested.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Recipe {
    /// Whether photons name subtrees of the scene's tree.
    pub(super) treelets: bool,
    /// Whether photons are shot in rounds.
    pub(super) rounds: bool,
    /// Whether boxes inside closed meshes block.
    pub(super) boxes: bool,
    /// Whether a tree is built over each list.
    pub(super) trees: bool,
    /// Whether rays are traced one by one.
    pub(super) alone: bool,
    /// Random terms of two halves.
    pub(super) terms: Option<Settings>,
    /// Whether what is learned is learned by cells.
    pub(super) cells: bool,
}

/// A row of the tables.
pub(super) struct Way {
    pub(super) name: String,
    /// None for exact.
    pub(super) recipe: Option<Recipe>,
    pub(super) shown: bool,
}

/// A remedy, alone or several, and where it stands among the ways: without and with stochastic visibility.
pub(super) struct Remedy {
    pub(super) name: &'static str,
    pub(super) map: Option<usize>,
    pub(super) terms: usize,
}

/// Everything that is compared, and the rows of the ablation; the first of these is plain.
pub(super) fn ways() -> (Vec<Way>, Vec<Remedy>) {
    type Change = fn(&mut Recipe);
    fn halves(recipe: &mut Recipe, split: Split) {
        recipe.terms = recipe.terms.map(|terms| Settings { split, ..terms });
    }
    fn learned(recipe: &mut Recipe, rule: Rule) {
        recipe.terms = recipe.terms.map(|terms| Settings { rule, ..terms });
    }
    fn trees(recipe: &mut Recipe) {
        recipe.trees = true;
        halves(recipe, Split::Sorted);
    }
    fn treelets(recipe: &mut Recipe) {
        recipe.treelets = true;
        halves(recipe, Split::Treelet);
    }
    fn all(recipe: &mut Recipe) {
        (recipe.boxes, recipe.rounds) = (true, true);
        learned(recipe, Rule::Importance);
    }
    // The name, what it changes, whether it means anything without stochastic visibility, and whether it is shown.
    let remedies: [(&str, Change, bool, bool); 10] = [
        ("plain", |_| (), true, true),
        ("volumetric occluders", |r| r.boxes = true, true, false),
        ("adaptive photons", |r| r.rounds = true, true, false),
        ("sorted halves", |r| halves(r, Split::Sorted), false, false),
        ("trees for each point", trees, true, false),
        ("treelets of the scene", treelets, true, false),
        ("importance for each point", |r| learned(r, Rule::Importance), false, false),
        (
            "importance for each cell",
            |r| {
                learned(r, Rule::Importance);
                r.cells = true;
            },
            false,
            false,
        ),
        (
            OPTIMISED,
            |r| {
                all(r);
                trees(r);
            },
            true,
            true,
        ),
        (
            TREELETS,
            |r| {
                all(r);
                treelets(r);
                r.cells = true;
            },
            true,
            false,
        ),
    ];
    let mut ways = vec![Way { name: "exact".into(), recipe: None, shown: true }];
    let mut rows = Vec::new();
    for (name, change, map, shown) in remedies {
        let mut add = |terms: Option<Settings>, words: &str| {
            let mut recipe = Recipe { terms, ..Recipe::default() };
            change(&mut recipe);
            ways.push(Way { name: format!("{name}: {words}"), recipe: Some(recipe), shown });
            ways.len() - 1
        };
        let map = map.then(|| add(None, "map"));
        rows.push(Remedy { name, map, terms: add(Some(PLAIN), "map + stochastic") });
    }
    let best = Settings { split: Split::Treelet, rule: Rule::Optimal, quotas: true, ..PLAIN };
    let recipe = Recipe {
        treelets: true,
        rounds: true,
        boxes: true,
        cells: true,
        terms: Some(best),
        ..Recipe::default()
    };
    let name = "all with treelets, best probabilities, quotas: map + stochastic".into();
    ways.push(Way { name, recipe: Some(recipe), shown: false });
    (ways, rows)
}

/// The thesis' last variant.
pub(super) const OPTIMISED: &str = "all, trees for each point";

/// The same without building a tree or asking test rays at each point.
pub(super) const TREELETS: &str = "all, treelets, importance for each cell";

/// The maps that the ways ask, each shot once, and the boxes.
pub(super) struct Maps {
    /// Of triangles and of treelets, evenly and in rounds.
    all: [[PreparedMap; 2]; 2],
    pub(super) volumes: Volumes,
}

impl Maps {
    /// On the threads of the current pool.
    pub(super) fn new(setting: &Setting, run: &Run<'_>, size: &Size) -> Self {
        let shoot = |kind| [1, ROUNDS].map(|rounds| setting.prepare(run, kind, size.lines, rounds, 50));
        Self {
            all: [BlockerKind::Triangle, BlockerKind::Treelet(128)].map(shoot),
            volumes: Volumes::build(&setting.scene, &setting.lights),
        }
    }

    /// The map that a recipe asks.
    pub(super) fn of(&self, recipe: &Recipe) -> &PreparedMap {
        &self.all[usize::from(recipe.treelets)][usize::from(recipe.rounds)]
    }

    /// Asks as a recipe says; exactly if there is none.
    pub(super) fn with<T>(
        &self,
        setting: &Setting,
        recipe: Option<&Recipe>,
        what: impl FnOnce(&dyn Visibility) -> Result<T, Halted>,
    ) -> Result<T, Halted> {
        let Some(recipe) = recipe else { return what(&Exact) };
        let mut map = self.of(recipe).visibility();
        if recipe.boxes {
            map = map.with_occluders(self.volumes.occluders());
        }
        if recipe.trees {
            map = map.with_trees()?;
        }
        if recipe.alone {
            map = map.one_by_one();
        }
        let Some(settings) = recipe.terms else { return what(&map) };
        let terms = MapTerms::new(map, settings, &setting.scene)?;
        if recipe.cells { what(&terms.by_cells()) } else { what(&terms) }
    }
}

/// Folders of the repository's scenes that the page shows.
const OWN: [&str; 2] = ["columns", "fence"];

/// Those found in a folder, and the names of those not found.
pub(super) fn own(folder: Option<&Path>) -> (Vec<std::path::PathBuf>, Vec<&'static str>) {
    let (mut found, mut skipped) = (Vec::new(), Vec::new());
    for name in OWN {
        match folder.map(|folder| folder.join(name)).filter(|path| path.is_dir()) {
            Some(path) => found.push(path),
            None => skipped.push(name),
        }
    }
    (found, skipped)
}

/// Refuses a folder that has none of them.
pub fn check_scenes(folder: &Path) -> crate::Result<()> {
    if own(Some(folder)).0.is_empty() {
        let what = format!("has no folder {}: name the folder that the scenes are in", OWN.join(" or "));
        return Err(crate::Error::input(folder, what));
    }
    Ok(())
}

/// The names of the repository's scenes.
pub(super) fn own_names() -> String {
    OWN.join(" and ")
}
