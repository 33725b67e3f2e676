//! Bars in groups.

use super::axis::Axis;
use super::text::{escape, marked, number, unmarked};
use super::{Html, Part, TONES};

/// Horizontal bars, in groups, each from a common base to its value.
#[derive(Clone, Debug, Default)]
pub struct Bars {
    title: String,
    words: String,
    axis: Axis,
    base: f64,
    groups: Vec<(String, Vec<Bar>)>,
}

/// One bar.
#[derive(Clone, Debug, Default)]
pub struct Bar {
    /// What it stands for.
    pub name: String,
    /// How far it goes.
    pub value: f64,
    /// Half the length of its error bar, 0 for none.
    pub error: f64,
    /// Its colour.
    pub tone: usize,
}

impl Bars {
    /// Bars from `base` on.
    pub fn new(title: impl Into<String>, words: impl Into<String>, axis: Axis, base: f64) -> Self {
        Self { title: title.into(), words: words.into(), axis: axis.with(base), base, groups: Vec::new() }
    }

    /// One more group.
    pub fn group(&mut self, name: impl Into<String>, bars: impl IntoIterator<Item = Bar>) {
        self.groups.push((name.into(), bars.into_iter().collect()));
    }
}

const LEFT: f64 = 190.0;
const WIDTH: f64 = 400.0;
const RIGHT: f64 = 66.0;
const BAR: f64 = 20.0;

impl Part for Bars {
    fn html(&self, html: &mut Html) {
        let bars = || self.groups.iter().flat_map(|(_, bars)| bars);
        let layout = self.axis.layout(bars().flat_map(|bar| [bar.value, bar.value + bar.error]));
        html.raw("<figure>");
        html.caption(&self.title, &self.words);
        html.raw("<div class=\"plots bars\">");
        for (name, bars) in &self.groups {
            html.raw(&format!("<div><h4>{}</h4>", marked(name)));
            let bottom = 4.0 + bars.len() as f64 * BAR;
            let label = escape(&unmarked(&format!("{}, {name}", self.title)));
            html.raw(&format!(
                "<svg viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{label}\">",
                LEFT + WIDTH + RIGHT,
                bottom + 42.0
            ));
            let at = |share: f64| LEFT + share * WIDTH;
            let mut grid = String::new();
            for (share, tick) in layout.ticks() {
                grid += &format!("M{:.1} 2V{bottom}", at(share));
                html.raw(&format!(
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                    at(share),
                    bottom + 17.0,
                    escape(tick)
                ));
            }
            html.raw(&format!("<path class=\"grid\" d=\"{grid}\"/>"));
            let base = layout.place(self.base).unwrap_or(0.0);
            for (i, bar) in bars.iter().enumerate() {
                bar_svg(html, bar, 4.0 + i as f64 * BAR, base, |value| layout.place(value), at);
            }
            html.raw(&format!(
                "<path class=\"axis\" d=\"M{:.1} 2V{bottom}\"/><text class=\"soft\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text></svg></div>\n",
                at(base),
                LEFT + WIDTH / 2.0,
                bottom + 35.0,
                escape(&unmarked(&self.axis.label))
            ));
        }
        html.raw("</div></figure>\n");
    }
}

fn bar_svg(
    html: &mut Html,
    bar: &Bar,
    top: f64,
    base: f64,
    place: impl Fn(f64) -> Option<f64>,
    at: impl Fn(f64) -> f64,
) {
    let middle = top + BAR / 2.0;
    let tone = bar.tone % TONES;
    html.raw(&format!(
        "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
        LEFT - 8.0,
        middle + 4.0,
        escape(&unmarked(&bar.name))
    ));
    let end = place(bar.value);
    let (from, to) = (at(base.min(end.unwrap_or(base))), at(base.max(end.unwrap_or(base))));
    html.raw(&format!(
        "<rect class=\"t{tone}\" x=\"{from:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" style=\"stroke:none\"/>",
        top + 3.0,
        (to - from).max(0.5),
        BAR - 6.0
    ));
    let mut reach = to;
    if bar.error > 0.0 && bar.error.is_finite() {
        let low = place(bar.value - bar.error).map_or(from, &at);
        let high = place(bar.value + bar.error).map_or(to, &at);
        if high - low > 1.0 {
            html.raw(&format!("<path class=\"axis\" d=\"M{low:.1} {middle:.1}H{high:.1}M{low:.1} {:.1}v6M{high:.1} {:.1}v6\"/>", middle - 3.0, middle - 3.0));
        }
        reach = reach.max(high);
    }
    html.raw(&format!(
        "<text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
        reach + 6.0,
        middle + 4.0,
        number(bar.value, 3)
    ));
}
