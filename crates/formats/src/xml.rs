//! The tags of an XML document with their places.
//!
//! `quick-xml` reads them as a stream. `roxmltree` needs the document as one text in memory, and a VTK file has
//! gigabytes of numbers between its tags.

use std::borrow::Cow;
use std::io::{self, BufRead};

use quick_xml::events::attributes::Attribute;
use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct XmlTag {
    pub(crate) name: String,
    /// Whether it ends an element, `</name>`.
    pub(crate) is_end: bool,
    attributes: Vec<(String, String)>,
    /// Offset of the byte after it.
    pub(crate) end: u64,
}

impl XmlTag {
    pub(crate) fn get(&self, name: &str) -> Option<&str> {
        self.attributes.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    /// Whether it has any attribute.
    pub(crate) fn has_attributes(&self) -> bool {
        !self.attributes.is_empty()
    }
}

/// The tags of a document, in order. The document is not validated.
pub(crate) struct Tags<R>(Reader<io::Take<R>>);

impl<R: BufRead> Tags<R> {
    pub(crate) fn new(reader: R) -> Self {
        let mut reader = Reader::from_reader(reader.take(0));
        let config = reader.config_mut();
        (config.check_end_names, config.allow_unmatched_ends) = (false, true);
        Self(reader)
    }

    /// The next tag, `None` at the end. An error of kind `InvalidData` says what is wrong.
    pub(crate) fn next(&mut self) -> io::Result<Option<XmlTag>> {
        loop {
            // `quick-xml` would keep the text between two tags in memory.
            self.skip_to(b'<')?;
            self.0.get_mut().set_limit(MAX_TAG_BYTES);
            let mut buffer = Vec::new();
            let event = self.0.read_event_into(&mut buffer).map_err(|e| match e {
                quick_xml::Error::Io(e) => io::Error::new(e.kind(), e.to_string()),
                other => io::Error::new(io::ErrorKind::InvalidData, other.to_string()),
            })?;
            let (name, attributes, is_end) = match &event {
                Event::Start(tag) | Event::Empty(tag) => (tag.local_name(), attributes(tag), false),
                Event::End(tag) => (tag.local_name(), Vec::new(), true),
                Event::Eof => return Ok(None),
                _ => continue,
            };
            let name = lossy(name.as_ref());
            return Ok(Some(XmlTag { name, is_end, attributes, end: self.0.buffer_position() }));
        }
    }

    /// The offset after the next `byte`; `None` if there is none.
    pub(crate) fn offset_after(&mut self, byte: u8) -> io::Result<Option<u64>> {
        let is_found = self.skip_to(byte)?;
        Ok(is_found.then_some(self.0.buffer_position() + 1))
    }

    /// Reads up to the next `byte`, without it; `false` if there is none.
    fn skip_to(&mut self, byte: u8) -> io::Result<bool> {
        self.0.get_mut().set_limit(u64::MAX);
        let mut stream = self.0.stream();
        loop {
            let buffer = stream.fill_buf()?;
            let (found, length) = (buffer.iter().position(|&b| b == byte), buffer.len());
            stream.consume(found.unwrap_or(length));
            if found.is_some() || length == 0 {
                return Ok(found.is_some());
            }
        }
    }
}

/// The attributes up to the first that is malformed. A value with an unknown entity stays as it is written.
fn attributes(tag: &BytesStart) -> Vec<(String, String)> {
    let value = |a: &Attribute| {
        let text = a.normalized_value(XmlVersion::Implicit1_0).ok();
        text.map_or_else(|| lossy(&a.value), Cow::into_owned)
    };
    let mut attributes = tag.attributes();
    let valid = attributes.with_checks(false).map_while(Result::ok);
    valid.map(|a| (lossy(a.key.local_name().as_ref()), value(&a))).collect()
}

fn lossy(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Longest tag or comment.
const MAX_TAG_BYTES: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn tags(text: &str) -> Vec<XmlTag> {
        let mut tags = Tags::new(text.as_bytes());
        std::iter::from_fn(|| tags.next().unwrap()).collect()
    }

    #[test]
    fn tags_come_with_their_attributes_and_places() {
        let text = "<?xml version=\"1.0\"?>\n<!-- <no a=\"1\"> > -- -->\n<o:A b = '>\"' c:d=\"&lt;&#181;&amp;\" e=\"&x;\">text<B/></o:A >";
        let found = tags(text);
        let names: Vec<(&str, bool)> = found.iter().map(|t| (t.name.as_str(), t.is_end)).collect();
        assert_eq!(names, [("A", false), ("B", false), ("A", true)]);
        assert_eq!(["b", "d", "e"].map(|name| found[0].get(name)), [Some(">\""), Some("<µ&"), Some("&x;")]);
        assert_eq!(&text[found[0].end as usize..][..4], "text");
        assert!(found[0].has_attributes() && !found[1].has_attributes());
        assert!(tags("no tags").is_empty());
        assert_eq!(tags(&format!("<A>{}</B>", "& ".repeat(1 << 20))).len(), 2, "neither balanced nor short");
    }

    #[test]
    fn data_between_tags_are_found_by_a_mark() {
        let mut tags = Tags::new(&b"<A> _\xff<"[..]);
        assert_eq!(tags.next().unwrap().unwrap().end, 3);
        assert_eq!(tags.offset_after(b'_').unwrap(), Some(5));
        assert_eq!(tags.offset_after(b'!').unwrap(), None);
    }

    #[test]
    fn what_does_not_end_is_an_error() {
        for text in ["<A b=\"", "<", "<A", "<!-- open > -- >"] {
            assert!(Tags::new(text.as_bytes()).next().is_err(), "{text}");
        }
        let long = format!("<A b=\"{}\">", "x".repeat(MAX_TAG_BYTES as usize));
        assert!(Tags::new(long.as_bytes()).next().is_err());
    }
}
