//! The numbers of a page as comma-separated values.

/// Rows under named columns.
#[derive(Clone, Debug, PartialEq)]
pub struct Data {
    columns: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Data {
    /// No rows yet.
    pub fn new(columns: &[&str]) -> Self {
        Self { columns: columns.iter().map(|&column| column.to_owned()).collect(), rows: Vec::new() }
    }

    /// Adds a row: cut or filled up with empty cells to the number of columns.
    pub fn row(&mut self, cells: impl IntoIterator<Item = impl Into<Cell>>) {
        let mut row: Vec<String> = cells.into_iter().map(|cell| cell.into().0).collect();
        row.resize(self.columns.len(), String::new());
        self.rows.push(row);
    }

    /// How many rows there are.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Are there none?
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// As CSV (RFC 4180, lines ended by a line feed), the names of the columns first.
    pub fn csv(&self) -> Vec<u8> {
        let mut writer = csv::Writer::from_writer(Vec::new());
        // Into memory, and every row as long as the first: nothing can go wrong.
        for row in std::iter::once(&self.columns).chain(&self.rows) {
            let _ = writer.write_record(row);
        }
        writer.into_inner().unwrap_or_default()
    }
}

/// What stands in a cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cell(String);

impl From<f64> for Cell {
    /// With as many digits as give back the same number; nothing for NaN.
    fn from(number: f64) -> Self {
        let size = number.abs();
        Self(match () {
            () if number.is_nan() => String::new(),
            () if number == 0.0 || (1e-4..1e15).contains(&size) || size.is_infinite() => number.to_string(),
            () => format!("{number:e}"),
        })
    }
}

impl From<u64> for Cell {
    fn from(number: u64) -> Self {
        Self(number.to_string())
    }
}

impl From<u32> for Cell {
    fn from(number: u32) -> Self {
        Self(number.to_string())
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self(text.to_owned())
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commas_quotes_and_numbers() {
        let mut data = Data::new(&["form", "variance, of one", "n"]);
        data.row([Cell::from("a \"b\""), 9.3e-5.into(), 8u32.into()]);
        data.row([Cell::from("line\nbreak"), f64::NAN.into()]);
        data.row([Cell::from("x"), f64::INFINITY.into(), 0.1.into(), "too many".into()]);
        let text = String::from_utf8(data.csv()).unwrap();
        assert_eq!(
            text,
            "form,\"variance, of one\",n\n\"a \"\"b\"\"\",9.3e-5,8\n\"line\nbreak\",,\nx,inf,0.1\n"
        );
    }
}
