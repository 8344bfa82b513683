//! The tags of an XML document with their places, as far as headers of volumes need them: text between tags is passed over,
//! and documents are not validated.

use std::io::{self, BufRead};

/// A tag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Tag {
    /// Its name, without a prefix.
    pub(crate) name: String,
    /// Whether it ends an element, `</name>`.
    pub(crate) is_end: bool,
    attributes: Vec<(String, String)>,
    /// Byte after it.
    pub(crate) end: u64,
}

impl Tag {
    /// The value of an attribute.
    pub(crate) fn get(&self, name: &str) -> Option<&str> {
        self.attributes.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    /// Whether it has any attribute.
    pub(crate) fn has_attributes(&self) -> bool {
        !self.attributes.is_empty()
    }
}

/// Tags of a document, in order.
pub(crate) struct Tags<R> {
    reader: R,
    at: u64,
}

impl<R: BufRead> Tags<R> {
    pub(crate) fn new(reader: R) -> Self {
        Self { reader, at: 0 }
    }

    /// The next tag, `None` at the end. An error of kind `InvalidData` says what is wrong.
    pub(crate) fn next(&mut self) -> io::Result<Option<Tag>> {
        loop {
            if !self.pass(b'<')? {
                return Ok(None);
            }
            let mut bytes = Vec::new();
            if !self.inside(&mut bytes)? {
                return Ok(None);
            }
            if !matches!(bytes.first(), Some(b'?' | b'!')) {
                return Ok(Some(Tag::parse(&bytes, self.at)));
            }
        }
    }

    /// The place after the next `byte`, wherever it is; `None` if there is none.
    pub(crate) fn place_after(&mut self, byte: u8) -> io::Result<Option<u64>> {
        Ok(self.pass(byte)?.then_some(self.at))
    }

    /// Reads up to the `>` that is not in quotes, without it; of a comment, which may be long, only its beginning is kept.
    /// `false` if a comment does not end.
    fn inside(&mut self, bytes: &mut Vec<u8>) -> io::Result<bool> {
        let invalid = |what: &str| Err(io::Error::new(io::ErrorKind::InvalidData, what));
        let mut quote = None;
        // How many of the bytes before are dashes, for the end of a comment.
        let mut dashes = 0;
        loop {
            let is_comment = bytes.starts_with(b"!--");
            let Some(byte) = self.byte()? else {
                return if is_comment { Ok(false) } else { invalid("the document ends within a tag") };
            };
            match (quote, byte) {
                (_, b'>') if is_comment && dashes >= 2 => return Ok(true),
                _ if is_comment => {
                    dashes = if byte == b'-' { dashes + 1 } else { 0 };
                    continue;
                }
                (None, b'>') => return Ok(true),
                (None, b'"' | b'\'') => quote = Some(byte),
                (Some(q), b) if q == b => quote = None,
                _ => {}
            }
            if bytes.len() == MAX_TAG_BYTES {
                return invalid("a tag is too long");
            }
            bytes.push(byte);
        }
    }

    fn byte(&mut self) -> io::Result<Option<u8>> {
        let byte = self.reader.fill_buf()?.first().copied();
        if byte.is_some() {
            self.reader.consume(1);
            self.at += 1;
        }
        Ok(byte)
    }

    /// Passes everything up to and including `byte`; `false` if it does not come.
    fn pass(&mut self, byte: u8) -> io::Result<bool> {
        loop {
            let buffer = self.reader.fill_buf()?;
            let found = buffer.iter().position(|&b| b == byte);
            let n = found.map_or(buffer.len(), |i| i + 1);
            let is_end = buffer.is_empty();
            self.reader.consume(n);
            self.at += n as u64;
            if found.is_some() || is_end {
                return Ok(found.is_some());
            }
        }
    }
}

impl Tag {
    /// From what is between `<` and `>`.
    fn parse(bytes: &[u8], end: u64) -> Self {
        let text = String::from_utf8_lossy(bytes);
        let text = text.trim().trim_end_matches('/');
        let (is_end, text) = text.strip_prefix('/').map_or((false, text), |rest| (true, rest));
        let (name, mut rest) = text.split_once(|c: char| c.is_ascii_whitespace()).unwrap_or((text, ""));
        let mut attributes = Vec::new();
        while let Some((name, after)) = rest.split_once('=') {
            let after = after.trim_start();
            let Some(quote) = after.chars().next().filter(|c| matches!(c, '"' | '\'')) else { break };
            let Some((value, after)) = after[1..].split_once(quote) else { break };
            attributes.push((local(name.trim()).to_owned(), unescaped(value)));
            rest = after;
        }
        Self { name: local(name).to_owned(), is_end, attributes, end }
    }
}

fn local(name: &str) -> &str {
    name.rsplit_once(':').map_or(name, |(_, local)| local)
}

/// Text with its entities replaced; what is none stays.
fn unescaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('&') {
        out += before;
        let entity = after.split_once(';').and_then(|(name, after)| {
            let number =
                |digits: &str, radix| u32::from_str_radix(digits, radix).ok().and_then(char::from_u32);
            let c = match name {
                "lt" => '<',
                "gt" => '>',
                "amp" => '&',
                "quot" => '"',
                "apos" => '\'',
                _ => match name.strip_prefix('#')?.strip_prefix(['x', 'X']) {
                    Some(hex) => number(hex, 16)?,
                    None => number(name.strip_prefix('#')?, 10)?,
                },
            };
            Some((c, after))
        });
        match entity {
            Some((c, after)) => {
                out.push(c);
                rest = after;
            }
            None => {
                out.push('&');
                rest = after;
            }
        }
    }
    out + rest
}

/// A longer tag is none.
const MAX_TAG_BYTES: usize = 1 << 16;

#[cfg(test)]
mod tests {
    use super::*;

    fn tags(text: &str) -> Vec<Tag> {
        let mut tags = Tags::new(text.as_bytes());
        std::iter::from_fn(|| tags.next().unwrap()).collect()
    }

    #[test]
    fn tags_come_with_their_attributes_and_places() {
        let text = "<?xml version=\"1.0\"?>\n<!-- <no a=\"1\"> > -- -->\n<o:A b = '>\"' c:d=\"&lt;&#181;&amp;&x\">text<B/></o:A >";
        let found = tags(text);
        let names: Vec<(&str, bool)> = found.iter().map(|t| (t.name.as_str(), t.is_end)).collect();
        assert_eq!(names, [("A", false), ("B", false), ("A", true)]);
        assert_eq!((found[0].get("b"), found[0].get("d")), (Some(">\""), Some("<µ&&x")));
        assert_eq!(&text[found[0].end as usize..][..4], "text");
        assert!(found[0].has_attributes() && !found[1].has_attributes());
        assert!(tags("no tags").is_empty() && tags("<!-- open > -- >").is_empty());
    }

    #[test]
    fn what_does_not_end_is_an_error() {
        for text in ["<A b=\"", "<", "<A"] {
            assert!(Tags::new(text.as_bytes()).next().is_err(), "{text}");
        }
        let long = format!("<A b=\"{}\">", "x".repeat(MAX_TAG_BYTES));
        assert!(Tags::new(long.as_bytes()).next().is_err());
    }
}
