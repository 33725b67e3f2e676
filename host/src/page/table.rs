//! Tables.

use super::text::{escape, marked, number, unmarked};
use super::{Html, Part};

/// Columns under a caption; the first cell of a row is its header.
#[derive(Clone, Debug, Default)]
pub struct Table {
    caption: String,
    columns: Vec<(String, bool)>,
    rows: Vec<Row>,
    notes: Vec<String>,
}

#[derive(Clone, Debug)]
enum Row {
    Group(String),
    Cells(Vec<Entry>),
}

/// What stands in a cell: text with the marks of [`marked`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Entry {
    text: String,
    tone: Option<Tone>,
    note: Option<usize>,
}

/// Digits that are worth reading.
const MOST_DIGITS: i32 = 6;

/// How a cell is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tone {
    /// As it should be.
    Good,
    /// Not as it should be.
    Bad,
    /// Beside the point.
    Faint,
}

impl Entry {
    /// A number with so many significant digits.
    pub fn number(value: f64, digits: usize) -> Self {
        number(value, digits).into()
    }

    /// A number and what it is uncertain by, with as many decimals as the uncertainty's second digit has.
    pub fn with_error(value: f64, error: f64) -> Self {
        if !(value.is_finite() && error.is_finite() && error > 0.0) || value.abs() >= 1e15 {
            return format!("{} ± {}", number(value, 4), number(error, 2)).into();
        }
        let place = error.log10().floor() as i32 - 1;
        let digits = |of: f64| {
            if of == 0.0 { 1 } else { (of.abs().log10().floor() as i32 - place + 1).clamp(1, MOST_DIGITS) }
        };
        format!("{} ± {}", number(value, digits(value) as usize), number(error, 2)).into()
    }

    /// The same in a tone.
    pub fn tone(mut self, tone: Tone) -> Self {
        self.tone = Some(tone);
        self
    }

    /// The same with the mark of a note, which [`Table::note`] numbers.
    pub fn noted(mut self, note: usize) -> Self {
        self.note = Some(note);
        self
    }
}

impl<T: Into<String>> From<T> for Entry {
    fn from(text: T) -> Self {
        Self { text: text.into(), tone: None, note: None }
    }
}

impl Table {
    /// An empty one.
    pub fn new(caption: impl Into<String>) -> Self {
        Self { caption: caption.into(), ..Self::default() }
    }

    /// The same with a column of words.
    pub fn words(mut self, header: impl Into<String>) -> Self {
        self.columns.push((header.into(), false));
        self
    }

    /// The same with a column of numbers.
    pub fn numbers(mut self, header: impl Into<String>) -> Self {
        self.columns.push((header.into(), true));
        self
    }

    /// A row across all columns that says what the next ones are.
    pub fn group(&mut self, name: impl Into<String>) {
        self.rows.push(Row::Group(name.into()));
    }

    /// A row: cut or filled up with empty cells to the number of columns.
    pub fn row(&mut self, cells: impl IntoIterator<Item = impl Into<Entry>>) {
        let mut cells: Vec<Entry> = cells.into_iter().map(Into::into).collect();
        cells.resize(self.columns.len(), Entry::default());
        self.rows.push(Row::Cells(cells));
    }

    /// A note below the table; its number is for [`Entry::noted`].
    pub fn note(&mut self, text: impl Into<String>) -> usize {
        self.notes.push(text.into());
        self.notes.len()
    }
}

impl Part for Table {
    fn html(&self, html: &mut Html) {
        let label =
            if self.caption.is_empty() { "Table".to_owned() } else { escape(&unmarked(&self.caption)) };
        html.raw(&format!(
            "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"{label}\"><table>"
        ));
        if !self.caption.is_empty() {
            html.raw(&format!("<caption>{}</caption>", marked(&self.caption)));
        }
        html.raw("<thead><tr>");
        for (header, number) in &self.columns {
            let class = if *number { " class=\"n\"" } else { "" };
            html.raw(&format!("<th scope=\"col\"{class}>{}</th>", marked(header)));
        }
        html.raw("</tr></thead>\n<tbody>");
        for row in &self.rows {
            match row {
                Row::Group(name) => {
                    let span = self.columns.len().max(1);
                    html.raw(&format!(
                        "<tr class=\"group\"><th colspan=\"{span}\" scope=\"colgroup\">{}</th></tr>\n",
                        marked(name)
                    ));
                }
                Row::Cells(cells) => {
                    html.raw("<tr>");
                    for (i, (cell, (_, number))) in cells.iter().zip(&self.columns).enumerate() {
                        cell_html(html, cell, i == 0, *number);
                    }
                    html.raw("</tr>\n");
                }
            }
        }
        html.raw("</tbody></table>");
        if !self.notes.is_empty() {
            html.raw("<ol class=\"notes\">");
            self.notes.iter().for_each(|note| html.raw(&format!("<li>{}</li>", marked(note))));
            html.raw("</ol>");
        }
        html.raw("</div>\n");
    }
}

fn cell_html(html: &mut Html, cell: &Entry, header: bool, number: bool) {
    let tone = match cell.tone {
        Some(Tone::Good) => "good",
        Some(Tone::Bad) => "bad",
        Some(Tone::Faint) => "faint",
        None => "",
    };
    let class = [if number { "n" } else { "" }, tone]
        .into_iter()
        .filter(|c| !c.is_empty())
        .collect::<Vec<_>>()
        .join(" ");
    let class = if class.is_empty() { class } else { format!(" class=\"{class}\"") };
    let note = cell.note.map(|note| format!(" <sup>{}</sup>", letter(note))).unwrap_or_default();
    let (tag, scope) = if header { ("th", " scope=\"row\"") } else { ("td", "") };
    html.raw(&format!("<{tag}{scope}{class}>{}{note}</{tag}>", marked(&cell.text)));
}

/// A note's letter: a figure would look like an exponent.
fn letter(note: usize) -> char {
    char::from(b'a' + ((note + 25) % 26) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::tests::parsed;

    #[test]
    fn rows_fit_the_columns_and_escape() {
        let mut table = Table::new("<caption>").words("a").numbers("b & c");
        let note = table.note("it is `x < y`");
        table.row([Entry::from("only one").tone(Tone::Bad).noted(note)]);
        table.row(["1", "2", "three is too many"]);
        table.group("<group>");
        let mut html = Html::default();
        table.html(&mut html);
        let (document, text) = parsed(&html);
        assert_eq!(document.matches("<tr").count(), 4);
        assert!(
            !text.contains("too many") && text.contains("it is x < y") && text.contains("<group>"),
            "{text}"
        );
        assert!(document.contains("class=\"bad\">only one <sup>a</sup>"));
    }

    #[test]
    fn errors_say_how_many_digits_count() {
        assert_eq!(Entry::with_error(2.00314, 0.0021), "2.0031 ± 0.0021".into());
        assert_eq!(Entry::with_error(2186.4, 31.0), "2186 ± 31".into());
        assert_eq!(Entry::with_error(1.0, 7e-7), "1.00000 ± 7.0×10⁻⁷".into());
        assert_eq!(Entry::with_error(f64::NAN, 1.0), "– ± 1.0".into());
        assert_eq!(Entry::with_error(1.0, 0.0), "1.000 ± 0".into());
    }
}
