//! Text on a page: escaped, lightly marked up, and numbers as people write them.

/// Text that HTML and XML read as itself, between tags and in quoted attributes alike.
///
/// What no document may hold, such as control characters, becomes U+FFFD.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            '\t' | '\n' => escaped.push(c),
            '\u{fffe}' | '\u{ffff}' => escaped.push('\u{fffd}'),
            c if c.is_control() => escaped.push('\u{fffd}'),
            c => escaped.push(c),
        }
    }
    escaped
}

/// Escaped text with four marks: `` `code` ``, `*emphasis*`, `_{below}` and `^{above}`.
///
/// A mark without its end is text like any other, and marks do not nest.
pub fn marked(text: &str) -> String {
    let piece = |(tag, inside): (Option<&str>, &str)| match tag {
        Some(tag) => format!("<{tag}>{}</{tag}>", escape(inside)),
        None => escape(inside),
    };
    pieces(text).map(piece).collect()
}

/// The text without the marks of [`marked`], not escaped: for places that can only hold letters.
pub fn unmarked(text: &str) -> String {
    pieces(text).map(|(_, inside)| inside).collect()
}

/// Text cut where marks begin and end, each piece with the element that it is to be in.
fn pieces(text: &str) -> impl Iterator<Item = (Option<&'static str>, &str)> {
    const MARKS: [(&str, &str, &str); 4] =
        [("`", "`", "code"), ("*", "*", "em"), ("_{", "}", "sub"), ("^{", "}", "sup")];
    let mut rest = text;
    std::iter::from_fn(move || {
        let mark = MARKS.iter().find_map(|&(open, close, tag)| {
            let inside = rest.strip_prefix(open)?;
            let end = inside.find(close).filter(|&end| end > 0)?;
            // A star with space around it is no mark but a star.
            let spaced = open == "*" && inside[..end].trim() != &inside[..end];
            (!spaced).then_some((tag, &inside[..end], &inside[end + close.len()..]))
        });
        if let Some((tag, inside, after)) = mark {
            rest = after;
            return Some((Some(tag), inside));
        }
        let next = rest.char_indices().skip(1).find(|(_, c)| matches!(c, '`' | '*' | '_' | '^'));
        let (piece, after) = rest.split_at(next.map_or(rest.len(), |(at, _)| at));
        rest = after;
        (!piece.is_empty()).then_some((None, piece))
    })
}

/// A number with so many significant digits: `0.0123`, `2186`, `9.30×10⁻⁵`, `−0.5`, `∞`, and a dash for NaN.
///
/// Powers of ten below 10⁻³ and from 10⁶ on.
pub fn number(value: f64, digits: usize) -> String {
    let digits = digits.clamp(1, 17);
    if value.is_nan() {
        return "–".to_owned();
    }
    let sign = if value < 0.0 { "−" } else { "" };
    if value.is_infinite() {
        return format!("{sign}∞");
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    // Rounded first, so that 9.996 with three digits is 10.0 and not 10.00.
    let rounded = format!("{:.*e}", digits - 1, value.abs());
    let (mantissa, exponent) = rounded.split_once('e').unwrap_or((&rounded, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if !(-3..6).contains(&exponent) {
        return format!("{sign}{mantissa}×10{}", superscript(exponent));
    }
    let decimals = (digits as i32 - 1 - exponent).max(0) as usize;
    let plain: f64 = rounded.parse().unwrap_or(value.abs());
    format!("{sign}{plain:.decimals$}")
}

/// The same without trailing zeros, for the ticks of an axis.
pub fn short(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return number(value, 3);
    }
    let (sign, size) = (if value < 0.0 { "−" } else { "" }, value.abs());
    let rounded = format!("{size:.6e}");
    let (mantissa, exponent) = rounded.split_once('e').unwrap_or((&rounded, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if (-3..4).contains(&exponent) {
        let decimals = (6 - exponent).max(0) as usize;
        let text = format!("{size:.decimals$}");
        let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
        return format!("{sign}{text}");
    }
    let mantissa = mantissa.trim_end_matches('0').trim_end_matches('.');
    let power = superscript(exponent);
    if mantissa == "1" { format!("{sign}10{power}") } else { format!("{sign}{mantissa}×10{power}") }
}

fn superscript(exponent: i32) -> String {
    const DIGITS: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let digit = |c: char| match c.to_digit(10) {
        Some(digit) => DIGITS[digit as usize],
        None => '⁻',
    };
    exponent.to_string().chars().map(digit).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_gets_out_of_its_place() {
        assert_eq!(
            escape("<b a=\"x\" c='y'> & \u{0}\u{1b}é"),
            "&lt;b a=&quot;x&quot; c=&#39;y&#39;&gt; &amp; \u{fffd}\u{fffd}é"
        );
        assert_eq!(marked("`<script>` & *<i>*"), "<code>&lt;script&gt;</code> &amp; <em>&lt;i&gt;</em>");
    }

    #[test]
    fn marks_and_the_lack_of_them() {
        assert_eq!(marked("V_{A}² is 3^{n − 1}"), "V<sub>A</sub>² is 3<sup>n − 1</sup>");
        for plain in ["a * b * c", "a * b", "snake_case", "x ^ y", "`", "**", "_{", "_{}", "é*", "``"] {
            assert_eq!(marked(plain), plain);
        }
        assert_eq!(unmarked("V_{A} & `x`"), "VA & x");
        assert_eq!(marked(""), "");
    }

    #[test]
    fn numbers_as_people_write_them() {
        let cases = [
            (9.3e-5, 3, "9.30×10⁻⁵"),
            (2186.0, 4, "2186"),
            (2186.0, 2, "2200"),
            (-0.012_345, 3, "−0.0123"),
            (9.996, 3, "10.0"),
            (0.0, 3, "0"),
            (-0.0, 3, "0"),
            (1e300, 2, "1.0×10³⁰⁰"),
            (f64::NAN, 3, "–"),
            (f64::NEG_INFINITY, 3, "−∞"),
            (5e-324, 1, "5×10⁻³²⁴"),
        ];
        for (value, digits, text) in cases {
            assert_eq!(number(value, digits), text, "{value} {digits}");
        }
        let cases = [
            (1.0, "1"),
            (0.2, "0.2"),
            (1e-6, "10⁻⁶"),
            (2e7, "2×10⁷"),
            (256.0, "256"),
            (-0.5, "−0.5"),
            (0.1 + 0.2, "0.3"),
            (9_999.0, "9999"),
            (20_000.0, "2×10⁴"),
            (1e5, "10⁵"),
            (0.0, "0"),
        ];
        for (value, text) in cases {
            assert_eq!(short(value), text);
        }
    }
}
