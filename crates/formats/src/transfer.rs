//! Reads and writes transfer functions as TOML files of control points.
//!
//! ```toml
//! name = "bone"                        # optional, else the name of the file
//! domain = "full"                      # or { values = [lo, hi] } or { percentiles = [lo, hi] }
//! unit_length = "voxel"                # or { world = 0.5 } or { radius = 0.01 }
//!
//! [[point]]                            # positions ascending; 0 and 1 are the ends of the domain
//! x = 0.1
//! color = "#aabbcc"                    # sRGB; or three numbers from 0 to 1
//! opacity = 0.02                       # of matter one unit length thick
//! ```

use std::fmt;
use std::path::Path;

use isinglass_core::transfer::{ControlPoint, Domain, TransferError, TransferFunction, UnitLength};
use serde::de::{Deserializer, Error, SeqAccess, Visitor};
use serde::{Deserialize, de};

use crate::error::{FormatError, quoted, shown, syntax_error};
use crate::presets::{preset, preset_names};
use crate::source::read_file;
use crate::transfer_import::{EXPECTED, first_transfer};

/// Loads the preset with this name, or else the file at this path. It may be TOML, or a file of another program,
/// whose first look counts. A colour map gets a plain ramp of opacity.
///
/// # Errors
/// The name is unknown, or the file has no valid transfer function. The message is one line.
pub fn load_transfer(name_or_path: &str) -> Result<TransferFunction, FormatError> {
    if let Some(transfer) = preset(name_or_path) {
        return Ok(transfer);
    }
    let path = Path::new(name_or_path);
    if !path.exists() {
        let expected = preset_names().collect::<Vec<_>>().join(", ");
        return Err(FormatError::UnknownPreset { found: quoted(name_or_path), expected });
    }
    let text = read_text(path)?;
    first_transfer(&text, path)
}

/// The text of a file of at most [`MAX_TRANSFER_BYTES`].
pub(crate) fn read_text(path: &Path) -> Result<String, FormatError> {
    let unsupported = |found| FormatError::Unsupported { path: shown(path), found, expected: EXPECTED };
    let bytes = read_file(path, MAX_TRANSFER_BYTES)?.ok_or_else(|| unsupported("more than 8 MiB"))?;
    String::from_utf8(bytes).map_err(|_| unsupported("bytes that are not UTF-8"))
}

/// The text of a file that reads back as `transfer`, to the last bit.
pub fn transfer_to_toml(transfer: &TransferFunction) -> String {
    let mut out = format!("name = {}\n", text_literal(&transfer.name));
    let [a, b] = match transfer.domain {
        Domain::Full => [0.0; 2],
        Domain::Values(a, b) | Domain::Percentiles(a, b) => [a, b],
        Domain::AboutZero(percent) => [percent; 2],
    };
    let (a, b) = (number_literal(a), number_literal(b));
    out += &match transfer.domain {
        Domain::Full => "domain = \"full\"\n".to_owned(),
        Domain::Values(..) => format!("domain = {{ values = [{a}, {b}] }}\n"),
        Domain::Percentiles(..) => format!("domain = {{ percentiles = [{a}, {b}] }}\n"),
        Domain::AboutZero(..) => format!("domain = {{ about-zero = {a} }}\n"),
    };
    out += &match transfer.unit_length {
        UnitLength::Voxel => "unit_length = \"voxel\"\n".to_owned(),
        UnitLength::World(l) => format!("unit_length = {{ world = {} }}\n", number_literal(l)),
        UnitLength::Radius(r) => format!("unit_length = {{ radius = {} }}\n", number_literal(r)),
    };
    for p in &transfer.points {
        let bytes = p.color.map(|c| (c * 255.0).round() as u8);
        let color = if bytes.map(|c| f32::from(c) / 255.0) == p.color {
            format!("\"#{:02x}{:02x}{:02x}\"", bytes[0], bytes[1], bytes[2])
        } else {
            format!("[{}]", p.color.map(number_literal).join(", "))
        };
        let (x, opacity) = (number_literal(p.x), number_literal(p.opacity));
        out += &format!("\n[[point]]\nx = {x}\ncolor = {color}\nopacity = {opacity}\n");
    }
    out
}

/// The shortest literal that reads back as this number. Readers parse in double precision first.
pub(crate) fn number_literal(x: f32) -> String {
    let short = format!("{x:?}");
    if short.parse::<f64>().is_ok_and(|y| y as f32 == x) { short } else { format!("{:?}", f64::from(x)) }
}

/// A TOML string in quotes.
pub(crate) fn text_literal(text: &str) -> String {
    let mut out = String::from('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => out += &format!("\\U{:08x}", u32::from(c)),
            c => out.push(c),
        }
    }
    out + "\""
}

/// Parses a transfer function. `path` is for messages, and its stem is the default name.
///
/// # Errors
/// The text is not valid TOML, or its control points are invalid. The message is one line.
pub fn transfer_from_toml(text: &str, path: &str) -> Result<TransferFunction, FormatError> {
    let path = Path::new(path);
    let file: TransferFile = toml::from_str(text).map_err(syntax_error(path, text))?;
    let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
    let transfer = TransferFunction {
        name: file.name.or(stem).unwrap_or_default(),
        domain: file.domain,
        unit_length: file.unit_length,
        points: file.point.into_iter().map(ControlPoint::from).collect(),
    };
    let transfer_error = |cause| FormatError::Transfer { path: shown(path), cause };
    transfer.validate().map_err(transfer_error)?;
    match transfer.domain {
        Domain::Percentiles(a, b) if a < 0.0 || b > 100.0 => Err(transfer_error(TransferError::Domain(a, b))),
        _ => Ok(transfer),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TransferFile {
    name: Option<String>,
    #[serde(default = "full")]
    domain: Domain,
    #[serde(default = "voxel")]
    unit_length: UnitLength,
    #[serde(default)]
    point: Vec<PointText>,
}

fn full() -> Domain {
    Domain::Full
}

fn voxel() -> UnitLength {
    UnitLength::Voxel
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PointText {
    x: f32,
    color: ColorText,
    opacity: f32,
}

impl From<PointText> for ControlPoint {
    fn from(point: PointText) -> Self {
        Self { x: point.x, color: point.color.0, opacity: point.opacity }
    }
}

/// A colour as `"#rrggbb"` or three numbers.
struct ColorText([f32; 3]);

impl<'de> Deserialize<'de> for ColorText {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ColorVisitor;
        impl<'de> Visitor<'de> for ColorVisitor {
            type Value = ColorText;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a colour like \"#aabbcc\" or three numbers from 0 to 1")
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<ColorText, E> {
                let rgb =
                    rgb_from_hex(text).ok_or_else(|| E::invalid_value(de::Unexpected::Str(text), &self))?;
                Ok(ColorText(rgb.map(|c| f32::from(c) / 255.0)))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<ColorText, A::Error> {
                let mut rgb = [0.0; 3];
                for (i, c) in rgb.iter_mut().enumerate() {
                    *c = list.next_element()?.ok_or_else(|| A::Error::invalid_length(i, &self))?;
                }
                if list.next_element::<de::IgnoredAny>()?.is_some() {
                    return Err(A::Error::invalid_length(4, &self));
                }
                Ok(ColorText(rgb))
            }
        }
        deserializer.deserialize_any(ColorVisitor)
    }
}

/// The bytes of a colour such as `#aabbcc`.
pub(crate) fn rgb_from_hex(text: &str) -> Option<[u8; 3]> {
    let digits =
        text.strip_prefix('#').filter(|h| h.len() == 6 && h.bytes().all(|b| b.is_ascii_hexdigit()))?;
    let [_, rgb @ ..] = u32::from_str_radix(digits, 16).ok()?.to_be_bytes();
    Some(rgb)
}

/// Longest file of transfer functions. ParaView's list of 199 maps has 0.3 MB.
pub const MAX_TRANSFER_BYTES: u64 = 8 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "domain = { percentiles = [1, 99.5] }\nunit_length = { radius = 0.01 }\n\
                        [[point]]\nx = 0\ncolor = \"#ff8000\"\nopacity = 0\n\
                        [[point]]\nx = 1.0\ncolor = [1, 0.5, 0]\nopacity = 0.5\n";

    /// Parsers quote what they do not understand, however long it is.
    #[test]
    fn what_a_message_quotes_is_cut_and_has_no_control_characters() {
        for quoted in ["vox".repeat(3000), "\\u001b[2J".into()] {
            let text = format!("unit_length = \"{quoted}\"\n");
            let message = transfer_from_toml(&text, "a.toml").unwrap_err().to_string();
            assert!(message.starts_with("a.toml: line 1: ") && message.len() < 400, "{}", message.len());
            assert!(!message.contains(char::is_control), "{message:?}");
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let tf = transfer_from_toml(GOOD, "some/soft.toml").unwrap();
        assert_eq!((tf.name.as_str(), tf.domain), ("soft", Domain::Percentiles(1.0, 99.5)));
        assert_eq!(tf.unit_length, UnitLength::Radius(0.01));
        assert_eq!(tf.points[0].color, [1.0, 128.0 / 255.0, 0.0]);
        assert_eq!(tf.points[1], ControlPoint { x: 1.0, color: [1.0, 0.5, 0.0], opacity: 0.5 });
        let tf = transfer_from_toml("[[point]]\nx = 0\ncolor = [0, 0, 0]\nopacity = 1", "a").unwrap();
        assert_eq!((tf.domain, tf.unit_length), (Domain::Full, UnitLength::Voxel));
        let tf = transfer_from_toml(&GOOD.replace("percentiles = [1, 99.5]", "values = [-1000, 3e3]"), "a")
            .unwrap();
        assert_eq!(tf.domain, Domain::Values(-1000.0, 3000.0));
    }

    #[test]
    fn what_is_written_reads_back_to_the_bit() {
        let mut transfers: Vec<_> = preset_names().map(|n| preset(n).unwrap()).collect();
        let odd =
            [0.0, f32::MIN_POSITIVE, 1e-30, 0.1, 1.0 / 3.0, f32::from_bits(0x3eaa_aaab), 0.999_999_94, 1.0];
        let points = odd.map(|x| ControlPoint { x, color: [x, 1.0 - x, 0.5], opacity: x }).to_vec();
        for (domain, unit_length) in [
            (Domain::Full, UnitLength::Voxel),
            (Domain::Values(-1e37, 3.4e37), UnitLength::World(1e-12)),
            (Domain::Percentiles(0.1, 99.9), UnitLength::Radius(1e12)),
        ] {
            let name = "a \"quoted\\ name\tµ".into();
            transfers.push(TransferFunction { name, domain, unit_length, points: points.clone() });
        }
        for transfer in transfers {
            let text = transfer_to_toml(&transfer);
            assert_eq!(transfer_from_toml(&text, "b.toml").unwrap(), transfer, "{text}");
            // Control: a digit more or less is another function.
            let other = text.replacen("opacity = 0.", "opacity = 0.1", 2);
            assert!(other == text || transfer_from_toml(&other, "b.toml").unwrap() != transfer, "{text}");
        }
    }

    #[test]
    fn each_mistake_is_named_in_one_line() {
        for (from, to, what) in [
            ("x = 1.0", "x = 1.5", "control point 1: position is 1.5, expected 0 to 1"),
            ("x = 0\n", "x = nan\n", "control point 0: position is NaN"),
            ("opacity = 0.5", "opacity = -0.5", "control point 1: opacity is -0.5"),
            ("[1, 0.5, 0]", "[1, 2, 0]", "control point 1: green is 2"),
            ("[1, 99.5]", "[99.5, 1]", "domain runs from 99.5 to 1"),
            ("[1, 99.5]", "[1, 101]", "domain runs from 1 to 101"),
            ("radius = 0.01", "radius = 0", "unit length is 0"),
            ("#ff8000", "#ff800", "line 5: invalid value: string \"#ff800\", expected a colour"),
            ("#ff8000", "ff8000", "expected a colour"),
            ("[1, 0.5, 0]", "[1, 0.5]", "invalid length 2, expected a colour"),
            ("[1, 0.5, 0]", "[1, 0.5, 0, 1]", "invalid length 4, expected a colour"),
            ("opacity = 0.5", "opacity = 0.5\nalpha = 1", "line 11: unknown field `alpha`"),
            ("opacity = 0.5", "", "missing field `opacity`"),
            ("opacity = 0.5", "opacity = 0.5\nopacity = 1", "duplicate key"),
            ("radius = 0.01", "radius = 0.01, world = 1", "line 2"),
            ("percentiles", "percent", "unknown variant `percent`"),
            ("[[point]]", "[[points]]", "unknown field `points`"),
            ("x = 0\n", "x = \n", "line 4"),
        ] {
            let text = GOOD.replacen(from, to, 1);
            assert_ne!(text, GOOD, "{from} is not in the text");
            let e = transfer_from_toml(&text, "a.toml").unwrap_err().to_string();
            assert!(e.starts_with("a.toml: ") && e.contains(what) && !e.contains('\n'), "{to:?}: {e}");
        }
        let unordered = GOOD.replace("x = 0\n", "x = 0.5\n").replace("x = 1.0", "x = 0.25");
        let e = transfer_from_toml(&unordered, "a.toml").unwrap_err().to_string();
        assert_eq!(
            e,
            "a.toml: control point 1 is at 0.25, before the point at 0.5; expected ascending positions"
        );
        let e = transfer_from_toml("", "a.toml").unwrap_err().to_string();
        assert_eq!(e, "a.toml: 0 control points, expected 1 to 256");
    }
}
