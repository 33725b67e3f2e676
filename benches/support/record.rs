//! What a comparison gives: figures for each scene, number of rays and class, as CSV, Markdown and a summary.

use std::fmt::Write as _;
use std::path::Path;

/// All of a comparison.
#[derive(Debug, Default)]
pub struct Record {
    /// The SIMD level of our queries.
    pub level: String,
    /// Embree's version, as 31305 for 3.13.5, if it took part.
    pub embree: Option<isize>,
    /// What was built.
    pub scenes: Vec<SceneRow>,
    /// What was asked.
    pub cells: Vec<Cell>,
}

/// A scene and its trees. Times in s, for two trees of Embree: fast and robust.
#[derive(Debug, Default)]
pub struct SceneRow {
    /// Its name.
    pub scene: String,
    /// How many triangles.
    pub triangles: usize,
    /// Shaded points asked about.
    pub points: usize,
    /// Share of point and light pairs that are lit, dark and in penumbra.
    pub shares: [f64; 3],
    /// Bytes of our tree, vertices included.
    pub our_bytes: usize,
    /// Time to build ours.
    pub our_build: f64,
    /// Bytes of Embree's trees, without the vertex and index buffers.
    pub embree_bytes: [usize; 2],
    /// Time to build Embree's.
    pub embree_build: [f64; 2],
}

/// One peer's answer to one kind of question.
#[derive(Debug, Default, Clone)]
pub struct Cell {
    /// The scene.
    pub scene: String,
    /// N.
    pub rays_per_point: usize,
    /// `all`, or a class.
    pub class: &'static str,
    /// Who.
    pub peer: String,
    /// `ours`, `embree` or `obvhs`.
    pub family: &'static str,
    /// Median time for all of it, CPU time of the thread.
    pub seconds: f64,
    /// Interleaved runs behind the median; 0 where only the first, slow one was made.
    pub runs: usize,
    /// Rays asked about.
    pub rays: usize,
    /// Pairs of a point and a light.
    pub batches: usize,
    /// Fraction of rays answered otherwise than by our single rays.
    pub differ: f64,
}

impl Cell {
    /// ns a ray.
    pub fn ns_per_ray(&self) -> f64 {
        self.seconds * 1e9 / self.rays as f64
    }
}

/// The one of ours that a renderer uses.
const OURS: &str = "tile";

impl SceneRow {
    /// One line of plain text.
    pub fn describe(&self) -> String {
        let bytes = |bytes: usize| bytes as f64 / self.triangles.max(1) as f64;
        format!(
            "{}: {} triangles, {} points, {:.0}/{:.0}/{:.0} % lit/dark/penumbra, bytes a triangle {:.0} (Embree {:.0}, \
             robust {:.0}), build {:.3} s (Embree {:.3}, robust {:.3})",
            self.scene,
            self.triangles,
            self.points,
            self.shares[0] * 100.0,
            self.shares[1] * 100.0,
            self.shares[2] * 100.0,
            bytes(self.our_bytes),
            bytes(self.embree_bytes[0]),
            bytes(self.embree_bytes[1]),
            self.our_build,
            self.embree_build[0],
            self.embree_build[1],
        )
    }
}

impl Record {
    /// An empty one.
    pub fn new(level: &str) -> Self {
        Self { level: level.to_owned(), ..Self::default() }
    }

    fn of<'a>(&'a self, scene: &'a str, rays: usize, class: &'a str) -> impl Iterator<Item = &'a Cell> {
        self.cells
            .iter()
            .filter(move |cell| cell.scene == scene && cell.rays_per_point == rays && cell.class == class)
    }

    fn best<'a>(&'a self, scene: &'a str, rays: usize, class: &'a str, family: &str) -> Option<&'a Cell> {
        self.of(scene, rays, class)
            .filter(|cell| cell.family == family)
            .min_by(|a, b| a.seconds.total_cmp(&b.seconds))
    }

    fn named<'a>(&'a self, scene: &'a str, rays: usize, class: &'a str, peer: &str) -> Option<&'a Cell> {
        self.of(scene, rays, class).find(|cell| cell.peer == peer)
    }

    /// One line of plain text for a scene, a number of rays and a class.
    pub fn line(&self, scene: &str, rays: usize, class: &str) -> String {
        let mut line = format!("{scene:>16} N={rays:<3} {class:>8}:");
        for cell in self.of(scene, rays, class).filter(|cell| cell.family == "ours") {
            let _ = write!(line, " {} {:.2}", cell.peer, cell.ns_per_ray());
        }
        let ours = self.named(scene, rays, class, OURS).map_or(f64::NAN, Cell::ns_per_ray);
        if let Some(cell) = self.best(scene, rays, class, "embree") {
            let theirs = cell.ns_per_ray();
            let _ = write!(line, " | {} {theirs:.2} = {:.2} x", cell.peer, theirs / ours);
        }
        if let Some(cell) = self.best(scene, rays, class, "obvhs") {
            let _ = write!(line, " | {} {:.2}", cell.peer, cell.ns_per_ray());
        }
        line
    }

    /// N, in order of appearance.
    fn numbers(&self) -> Vec<usize> {
        let mut numbers = Vec::new();
        for cell in &self.cells {
            if !numbers.contains(&cell.rays_per_point) {
                numbers.push(cell.rays_per_point);
            }
        }
        numbers
    }

    /// Ratios of all points, the best of Embree over ours, and their geometric mean.
    pub fn ratios(&self, rays: usize, class: &str) -> (Vec<(&str, f64)>, f64) {
        let ratio = |row: &SceneRow| {
            let ours = self.named(&row.scene, rays, class, OURS)?;
            Some(self.best(&row.scene, rays, class, "embree")?.seconds / ours.seconds)
        };
        let ratios: Vec<_> =
            self.scenes.iter().filter_map(|row| Some((row.scene.as_str(), ratio(row)?))).collect();
        let mean = ratios.iter().map(|ratio| ratio.1.ln()).sum::<f64>() / ratios.len() as f64;
        (ratios, mean.exp())
    }

    /// A few lines: how we stand to Embree.
    pub fn summary(&self) -> String {
        let mut text = String::new();
        for rays in self.numbers() {
            let (ratios, mean) = self.ratios(rays, "all");
            if ratios.is_empty() {
                continue;
            }
            let worst =
                ratios.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(("", f64::NAN), |&worst| worst);
            let _ = writeln!(
                text,
                "N = {rays}: best of Embree over ours, geometric mean of {} scenes {mean:.2}, least {:.2} ({})",
                ratios.len(),
                worst.1,
                worst.0
            );
        }
        text
    }

    /// Everything measured, one line a peer and question.
    pub fn csv(&self) -> String {
        let mut text =
            String::from("scene,rays_per_point,class,peer,ns_per_ray,us_per_point,rays,runs,differ\n");
        for cell in &self.cells {
            let _ = writeln!(
                text,
                "{},{},{},{},{:.3},{:.4},{},{},{:.3e}",
                cell.scene,
                cell.rays_per_point,
                cell.class,
                cell.peer,
                cell.ns_per_ray(),
                cell.seconds * 1e6 / cell.batches as f64,
                cell.rays,
                cell.runs,
                cell.differ
            );
        }
        text
    }

    /// The tables.
    pub fn markdown(&self) -> String {
        let version = self.embree.map_or_else(
            || "without Embree".to_owned(),
            |v| format!("Embree {}.{}.{}", v / 10000, v / 100 % 100, v % 100),
        );
        let mut text = format!(
            "# Any-hit visibility beside other libraries\n\n{version}, obvhs 0.4, ours at SIMD level `{}`. One thread, its CPU \
             time, medians of interleaved runs, ns a shadow ray, filling of rays included. `best Embree` is the best of twelve \
             modes for that row (rtcOccluded1, 8, 16; coherent or not; fast or robust), built for high quality. The ratio is \
             best Embree over `tile`.\n\nMade by `cargo run --release -p occlude-benches --features embree --bin peers`.\n",
            self.level
        );
        for rays in self.numbers() {
            let (_, mean) = self.ratios(rays, "all");
            let _ = write!(text, "\n## N = {rays}");
            let names: Vec<_> =
                self.cells.iter().filter(|cell| cell.family == "ours").map(|cell| &cell.peer).fold(
                    Vec::new(),
                    |mut names, name| {
                        if !names.contains(&name) {
                            names.push(name);
                        }
                        names
                    },
                );
            if mean.is_finite() {
                let _ = write!(text, ": geometric mean of the ratios {mean:.2}");
            }
            text.push_str("\n\n| scene | points |");
            for name in &names {
                let _ = write!(text, " {name} |");
            }
            text.push_str(" best Embree | mode | best obvhs | ratio |\n| --- | --- |");
            text.push_str(&" ---: |".repeat(names.len()));
            text.push_str(" ---: | --- | ---: | ---: |\n");
            for row in &self.scenes {
                for class in ["all", "lit", "dark", "penumbra"] {
                    let Some(ours) = self.named(&row.scene, rays, class, OURS) else { continue };
                    let _ = write!(text, "| {} | {class} |", row.scene);
                    for name in &names {
                        let ns = self.named(&row.scene, rays, class, name).map_or(f64::NAN, Cell::ns_per_ray);
                        let _ = write!(text, " {ns:.2} |");
                    }
                    match self.best(&row.scene, rays, class, "embree") {
                        Some(cell) => {
                            let mode = cell.peer.trim_start_matches("embree ");
                            let _ = write!(text, " {:.2} | {mode} |", cell.ns_per_ray());
                        }
                        None => text.push_str(" | |"),
                    }
                    let obvhs =
                        self.best(&row.scene, rays, class, "obvhs").map_or(f64::NAN, Cell::ns_per_ray);
                    let embree =
                        self.best(&row.scene, rays, class, "embree").map_or(f64::NAN, |cell| cell.seconds);
                    let _ = writeln!(text, " {obvhs:.2} | {:.2} |", embree / ours.seconds);
                }
            }
        }
        text.push_str("\n## Agreement\n\nRays that are answered otherwise than by our single rays, at the greatest N, all points.\n\n| scene | rays |");
        let most = self.numbers().into_iter().max().unwrap_or(0);
        let peers = ["embree 16", "embree robust 16", "obvhs binary", "obvhs wide"];
        for peer in peers {
            let _ = write!(text, " {peer} |");
        }
        text.push_str("\n| --- | ---: |");
        text.push_str(&" ---: |".repeat(peers.len()));
        text.push('\n');
        for row in &self.scenes {
            let count = self.of(&row.scene, most, "all").next().map_or(0, |cell| cell.rays);
            let _ = write!(text, "| {} | {count} |", row.scene);
            for peer in peers {
                match self.named(&row.scene, most, "all", peer) {
                    Some(cell) => {
                        let _ = write!(text, " {:.1e} |", cell.differ);
                    }
                    None => text.push_str(" |"),
                }
            }
            text.push('\n');
        }
        text.push_str(
            "\n## Trees\n\nBytes a triangle: ours with the triangles in it, Embree's without the vertex and index buffers that it \
             is given (its leaves hold vertices too). Build times on all cores, the least of up to 25, the fewer the larger, \
             Embree's at high quality.\n\n\
             | scene | triangles | points | lit / dark / penumbra, % | ours, B | Embree fast, B | robust, B | ours, s | Embree \
             fast, s | robust, s |\n| --- | ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |\n",
        );
        for row in &self.scenes {
            let bytes = |bytes: usize| bytes as f64 / row.triangles.max(1) as f64;
            let _ = writeln!(
                text,
                "| {} | {} | {} | {:.0} / {:.0} / {:.0} | {:.0} | {:.0} | {:.0} | {:.3} | {:.3} | {:.3} |",
                row.scene,
                row.triangles,
                row.points,
                row.shares[0] * 100.0,
                row.shares[1] * 100.0,
                row.shares[2] * 100.0,
                bytes(row.our_bytes),
                bytes(row.embree_bytes[0]),
                bytes(row.embree_bytes[1]),
                row.our_build,
                row.embree_build[0],
                row.embree_build[1],
            );
        }
        text
    }

    /// Writes NAME.csv and NAME.md.
    pub fn write(&self, name: &Path) -> std::io::Result<()> {
        std::fs::write(name.with_extension("csv"), self.csv())?;
        std::fs::write(name.with_extension("md"), self.markdown())
    }
}
