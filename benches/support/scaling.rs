//! Time a ray against the number of triangles: a table and a plot, both axes logarithmic.

use std::fmt::Write as _;

/// One measured point.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The kind of scene.
    pub kind: String,
    /// Who answered: `ours` or `embree`, `exact` or `auto`. The first one's lines are drawn solid.
    pub peer: &'static str,
    /// Triangles of the scene.
    pub triangles: usize,
    /// Median ns a ray.
    pub ns: f64,
    /// Building the tree, s on all cores.
    pub build: f64,
    /// Bytes of the tree, a triangle.
    pub bytes: f64,
}

/// The samples as CSV.
pub fn csv(samples: &[Sample]) -> String {
    let mut text = String::from("scene,peer,triangles,ns_per_ray,build_s,bytes_per_triangle\n");
    for Sample { kind, peer, triangles, ns, build, bytes } in samples {
        let _ = writeln!(text, "{kind},{peer},{triangles},{ns:.3},{build:.3},{bytes:.1}");
    }
    text
}

const SIZE: (f64, f64) = (720.0, 440.0);
const LEFT: f64 = 70.0;
const BOTTOM: f64 = 56.0;
const TOP: f64 = 40.0;
const RIGHT: f64 = 130.0;

/// The samples as a plot, legible on light and dark pages.
pub fn svg(samples: &[Sample], title: &str) -> String {
    let decades = |values: &dyn Fn(&Sample) -> f64| {
        let logs = || samples.iter().map(|sample| values(sample).log10());
        let (low, high) = (logs().fold(f64::INFINITY, f64::min), logs().fold(f64::NEG_INFINITY, f64::max));
        if low.is_finite() { (low.floor(), high.ceil().max(low.floor() + 1.0)) } else { (0.0, 1.0) }
    };
    let (x_low, x_high) = decades(&|sample| sample.triangles as f64 * 0.999_999);
    let (y_low, y_high) = decades(&|sample| sample.ns);
    let x_at = |value: f64| LEFT + (value.log10() - x_low) / (x_high - x_low) * (SIZE.0 - LEFT - RIGHT);
    let y_at =
        |value: f64| SIZE.1 - BOTTOM - (value.log10() - y_low) / (y_high - y_low) * (SIZE.1 - BOTTOM - TOP);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" font-size=\"13\">\n\
         <title>{title}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n\
         <text x=\"{LEFT}\" y=\"24\" font-size=\"15\">{title}</text>\n",
        SIZE.0, SIZE.1
    );
    let (right, bottom) = (SIZE.0 - RIGHT, SIZE.1 - BOTTOM);
    for decade in x_low as i32..=x_high as i32 {
        let x = x_at(10f64.powi(decade));
        let _ = writeln!(
            text,
            "<path d=\"M{x:.1} {TOP}V{bottom}\" stroke=\"#ddd\"/><text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">10<tspan \
             dy=\"-5\" font-size=\"10\">{decade}</tspan></text>",
            bottom + 20.0
        );
    }
    for decade in y_low as i32..=y_high as i32 {
        for step in [1.0, 2.0, 5.0] {
            let value = step * 10f64.powi(decade);
            if value > 10f64.powf(y_high) * 1.0001 {
                continue;
            }
            let y = y_at(value);
            let _ = writeln!(
                text,
                "<path d=\"M{LEFT} {y:.1}H{right}\" stroke=\"#ddd\"/><text x=\"{:.1}\" y=\"{:.1}\" \
                 text-anchor=\"end\">{value}</text>",
                LEFT - 8.0,
                y + 4.0
            );
        }
    }
    let _ = writeln!(
        text,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">triangles</text>\
         <text transform=\"translate(18 {:.1}) rotate(-90)\" text-anchor=\"middle\">ns a shadow ray</text>",
        (LEFT + right) / 2.0,
        SIZE.1 - 12.0,
        (TOP + bottom) / 2.0
    );
    let mut lines: Vec<(&str, &str)> = Vec::new();
    for sample in samples {
        if !lines.contains(&(&sample.kind, sample.peer)) {
            lines.push((&sample.kind, sample.peer));
        }
    }
    let mut kinds: Vec<&str> = lines.iter().map(|line| line.0).collect();
    kinds.dedup();
    // Names apart from each other at the right.
    let mut taken: Vec<f64> = Vec::new();
    for (kind, peer) in lines {
        let colour = ["#c0392b", "#1f5fa8", "#2e7d32", "#7b4fa3"]
            [kinds.iter().position(|k| *k == kind).unwrap_or(0) % 4];
        let dash = if samples.first().is_some_and(|first| first.peer == peer) {
            ""
        } else {
            " stroke-dasharray=\"6 4\""
        };
        let (mut path, mut last) = (String::new(), (0.0, 0.0));
        for sample in samples.iter().filter(|sample| sample.kind == kind && sample.peer == peer) {
            last = (x_at(sample.triangles as f64), y_at(sample.ns));
            let _ = write!(path, "{}{:.1} {:.1}", if path.is_empty() { "M" } else { "L" }, last.0, last.1);
            let _ = writeln!(
                text,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{colour}\"/>",
                last.0, last.1
            );
        }
        let mut y = last.1 + 4.0;
        while taken.iter().any(|other| (other - y).abs() < 15.0) {
            y += 5.0;
        }
        taken.push(y);
        let _ = writeln!(
            text,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"{dash}/>\
             <text x=\"{:.1}\" y=\"{y:.1}\" fill=\"{colour}\">{kind}, {peer}</text>",
            right + 8.0
        );
    }
    text.push_str("</svg>\n");
    text
}
