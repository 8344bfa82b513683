//! A lenient JSON parser, because `serde_json` refuses what ParaView and Slicer write: comments, commas before a
//! closing bracket, `NaN`, and numbers such as `-250.0.0`. Depth and number of values are bounded.

/// A value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Json {
    /// `null`.
    Null,
    /// `true` or `false`.
    Bool(bool),
    /// A number, not always finite.
    Number(f64),
    /// A string.
    Text(String),
    /// `[…]`.
    List(Vec<Json>),
    /// `{…}`, with keys in the order of the file.
    Map(Vec<(String, Json)>),
}

#[derive(Debug, PartialEq)]
pub(crate) struct JsonError {
    /// The line, counted from 1.
    pub(crate) line: usize,
    pub(crate) expected: &'static str,
}

impl Json {
    /// The value of a key. If it occurs twice, the last one counts.
    pub(crate) fn get(&self, key: &str) -> Option<&Self> {
        let Self::Map(entries) = self else { return None };
        entries.iter().rev().find(|(k, _)| k == key).map(|(_, v)| v)
    }

    /// A finite number, which may be a string.
    pub(crate) fn number(&self) -> Option<f32> {
        let number = match self {
            Self::Number(n) => *n,
            Self::Text(text) => lenient_number(text)?,
            _ => return None,
        };
        Some(number as f32).filter(|n| n.is_finite())
    }

    pub(crate) fn text(&self) -> Option<&str> {
        if let Self::Text(text) = self { Some(text) } else { None }
    }

    /// The elements of a list; none for other values.
    pub(crate) fn list(&self) -> &[Self] {
        if let Self::List(list) = self { list } else { &[] }
    }

    /// The numbers of a list. Other elements become NaN, so that all keep their places.
    pub(crate) fn numbers(&self) -> Vec<f32> {
        self.list().iter().map(|value| value.number().unwrap_or(f32::NAN)).collect()
    }

    /// Whether it is `true`, or a number other than 0.
    pub(crate) fn flag(&self) -> Option<bool> {
        match self {
            Self::Bool(b) => Some(*b),
            other => other.number().map(|n| n != 0.0),
        }
    }
}

/// The number at the start of a text. Slicer's own file has `-250.0.0`.
pub(crate) fn lenient_number(text: &str) -> Option<f64> {
    let text = text.trim();
    let ends = text.char_indices().map(|(i, c)| i + c.len_utf8()).take(MAX_NUMBER_CHARS);
    ends.collect::<Vec<_>>().into_iter().rev().find_map(|end| text[..end].parse().ok())
}

/// Parses a text with exactly one value.
pub(crate) fn parse(text: &str) -> Result<Json, JsonError> {
    let mut parser = JsonParser { text, at: 0, values_left: MAX_VALUES };
    parser.skip_byte_order_mark();
    let value = parser.value(0)?;
    parser.skip_blanks();
    if parser.at < text.len() { Err(parser.problem("the end of the text")) } else { Ok(value) }
}

struct JsonParser<'a> {
    text: &'a str,
    at: usize,
    values_left: usize,
}

impl JsonParser<'_> {
    fn skip_byte_order_mark(&mut self) {
        if self.text.starts_with('\u{feff}') {
            self.at = '\u{feff}'.len_utf8();
        }
    }

    fn problem(&self, expected: &'static str) -> JsonError {
        let line = 1 + self.text.as_bytes()[..self.at].iter().filter(|&&b| b == b'\n').count();
        JsonError { line, expected }
    }

    fn rest(&self) -> &str {
        &self.text[self.at..]
    }

    /// Skips white space and comments.
    fn skip_blanks(&mut self) {
        loop {
            let rest = self.rest();
            let blanks = rest.len() - rest.trim_start().len();
            let after = &rest[blanks..];
            let comment = if after.starts_with("//") || after.starts_with('#') {
                after.find('\n').unwrap_or(after.len())
            } else if after.starts_with("/*") {
                after.find("*/").map_or(after.len(), |end| end + 2)
            } else {
                0
            };
            self.at += blanks + comment;
            if comment == 0 {
                return;
            }
        }
    }

    /// Consumes `c` if it is next.
    fn takes(&mut self, c: char) -> bool {
        self.skip_blanks();
        let is_next = self.rest().starts_with(c);
        self.at += if is_next { c.len_utf8() } else { 0 };
        is_next
    }

    fn value(&mut self, depth: usize) -> Result<Json, JsonError> {
        self.skip_blanks();
        if depth > MAX_DEPTH {
            return Err(self.problem("lists no deeper than 32"));
        }
        self.values_left = self.values_left.checked_sub(1).ok_or_else(|| self.problem("fewer values"))?;
        match self.rest().chars().next() {
            Some('[') => self.list(depth),
            Some('{') => self.map(depth),
            Some('"') => self.string().map(Json::Text),
            Some(c) if c.is_ascii_alphanumeric() || "+-.".contains(c) => self.word(),
            _ => Err(self.problem("a value")),
        }
    }

    fn list(&mut self, depth: usize) -> Result<Json, JsonError> {
        self.at += 1;
        let mut list = Vec::new();
        while !self.takes(']') {
            list.push(self.value(depth + 1)?);
            if !self.takes(',') && !self.rest().starts_with(']') {
                return Err(self.problem("a comma or ]"));
            }
        }
        Ok(Json::List(list))
    }

    fn map(&mut self, depth: usize) -> Result<Json, JsonError> {
        self.at += 1;
        let mut map = Vec::new();
        while !self.takes('}') {
            if !self.rest().starts_with('"') {
                return Err(self.problem("a key in quotes or }"));
            }
            let key = self.string()?;
            if !self.takes(':') {
                return Err(self.problem("a colon"));
            }
            map.push((key, self.value(depth + 1)?));
            if !self.takes(',') && !self.rest().starts_with('}') {
                return Err(self.problem("a comma or }"));
            }
        }
        Ok(Json::Map(map))
    }

    /// Parses a string. The parser is at its opening quote.
    fn string(&mut self) -> Result<String, JsonError> {
        let mut out = String::new();
        let mut chars = self.text[self.at + 1..].char_indices();
        while let Some((i, c)) = chars.next() {
            match c {
                '"' => {
                    self.at += 1 + i + 1;
                    return Ok(out);
                }
                '\\' => match chars.next().map(|(_, c)| c) {
                    Some('n') => out.push('\n'),
                    Some('t') => out.push('\t'),
                    Some('r') => out.push('\r'),
                    Some('b') => out.push('\u{8}'),
                    Some('f') => out.push('\u{c}'),
                    Some('u') => {
                        let code =
                            chars.by_ref().take(4).try_fold(0, |n, (_, c)| Some(n * 16 + c.to_digit(16)?));
                        out.push(code.and_then(char::from_u32).unwrap_or(char::REPLACEMENT_CHARACTER));
                    }
                    Some(c) => out.push(c),
                    None => break,
                },
                c => out.push(c),
            }
        }
        Err(self.problem("a closing quote"))
    }

    fn word(&mut self) -> Result<Json, JsonError> {
        let is_part = |c: char| c.is_ascii_alphanumeric() || "+-.".contains(c);
        let length = self.rest().find(|c| !is_part(c)).unwrap_or(self.rest().len());
        let word = &self.text[self.at..self.at + length];
        let value = match word {
            "null" | "None" => Json::Null,
            "true" | "True" => Json::Bool(true),
            "false" | "False" => Json::Bool(false),
            word => match lenient_number(word) {
                Some(number) => Json::Number(number),
                None => return Err(self.problem("a value")),
            },
        };
        self.at += length;
        Ok(value)
    }
}

/// Deepest nesting. Files with presets have six levels.
const MAX_DEPTH: usize = 32;
/// Most values of a file. ParaView's own has 40 000.
const MAX_VALUES: usize = 1 << 20;
/// Longest number, in characters.
const MAX_NUMBER_CHARS: usize = 40;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_json_is_read() {
        let text = r#" {"a": [1, -2.5e3, true, null], "b": {"c": "x\"\u00e9\n"}, "a": []} "#;
        let json = parse(text).unwrap();
        assert_eq!(json.get("a"), Some(&Json::List(vec![])));
        assert_eq!(json.get("b").and_then(|b| b.get("c")?.text()), Some("x\"é\n"));
        assert_eq!(parse("[1, -2.5e3, 7]").unwrap().numbers(), [1.0, -2500.0, 7.0]);
    }

    #[test]
    fn what_people_write_is_read_too() {
        let text = "\u{feff}[ // maps\n 1, NaN, /* two */ -Infinity, -250.0.0, \"4\",\n # end\n]\n";
        let Json::List(list) = parse(text).unwrap() else { panic!("no list") };
        let numbers: Vec<_> = list.iter().map(Json::number).collect();
        assert_eq!(numbers, [Some(1.0), None, None, Some(-250.0), Some(4.0)]);
        assert_eq!(parse("[1,]").unwrap().numbers(), [1.0]);
        let numbers = parse("[1, nan, 3]").unwrap().numbers();
        assert!(numbers[1].is_nan() && [numbers[0], numbers[2]] == [1.0, 3.0], "{numbers:?}");
    }

    #[test]
    fn mistakes_have_a_line() {
        for (text, line, expected) in [
            ("", 1, "a value"),
            ("[1\n2]", 2, "a comma or ]"),
            ("{\n\n1: 2}", 3, "a key in quotes or }"),
            ("{\"a\" 2}", 1, "a colon"),
            ("\"abc", 1, "a closing quote"),
            ("[]\n[]", 2, "the end of the text"),
            ("[1, x]", 1, "a value"),
        ] {
            assert_eq!(parse(text), Err(JsonError { line, expected }), "{text:?}");
        }
        assert_eq!(parse(&"[".repeat(100_000)).unwrap_err().expected, "lists no deeper than 32");
        assert_eq!(parse(&format!("[{}]", "0,".repeat(MAX_VALUES))).unwrap_err().expected, "fewer values");
    }
}
