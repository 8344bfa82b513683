//! Imports transfer functions and colour maps of other programs: ParaView's colour maps in JSON, and Slicer's
//! `presets.xml` and `.vp.json`. Any XML with `VolumeProperty` elements works. Missing fields have the defaults of
//! their program, and invalid ones are ignored.

use std::path::Path;

use isinglass_core::look::MAX_NAME_BYTES;
use isinglass_core::text::printable;
use isinglass_core::transfer::{ControlPoint, Domain, MAX_POINTS, TransferFunction, UnitLength};

use crate::error::{FormatError, shown};
use crate::transfer::{read_text, transfer_from_toml};
use crate::transfer_json::{Json, lenient_number, parse};
use crate::transfer_maps::{ColorSpace, color_between, recolored};
use crate::xml::{Tags, XmlTag};

/// A look in a file. [`ImportedTransfer::onto`] turns it into a transfer function.
#[derive(Clone, Debug)]
pub struct ImportedTransfer {
    name: String,
    shaded: Option<bool>,
    kind: LookKind,
}

#[derive(Clone, Debug)]
enum LookKind {
    /// A complete transfer function.
    Whole(TransferFunction),
    /// Colours over positions in any unit.
    Colors(Curve),
    /// Colours and opacities over values of the volume, or over any unit.
    Curves { colors: Curve, opacities: Vec<(f32, f32)>, unit_length: Option<UnitLength>, is_physical: bool },
}

#[derive(Clone, Debug)]
struct Curve {
    points: Vec<(f32, [f32; 3])>,
    space: ColorSpace,
}

impl ImportedTransfer {
    /// Its name in the file.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether it is shaded by gradients, if the file says.
    pub fn shaded(&self) -> Option<bool> {
        self.shaded
    }

    /// The transfer function. Missing parts come from `current`, such as the opacities of a colour map.
    pub fn onto(&self, current: &TransferFunction) -> TransferFunction {
        let mut transfer = match &self.kind {
            LookKind::Whole(transfer) => transfer.clone(),
            LookKind::Colors(colors) => {
                let (lo, hi) = span(colors.points.iter().map(|p| p.0));
                recolored(current, &|x| color_between(&colors.points, colors.space, lo + (hi - lo) * x))
            }
            LookKind::Curves { colors, opacities, unit_length, is_physical } => {
                let positions = colors.points.iter().map(|p| p.0).chain(opacities.iter().map(|p| p.0));
                let (lo, hi) = span(positions);
                let color_at = |x: f32| color_between(&colors.points, colors.space, lo + (hi - lo) * x);
                let point = |&(value, opacity): &(f32, f32)| ControlPoint {
                    x: ((value - lo) / (hi - lo)).clamp(0.0, 1.0),
                    color: [0.0; 3],
                    opacity,
                };
                let curve = TransferFunction {
                    name: String::new(),
                    domain: if *is_physical { Domain::Values(lo, hi) } else { current.domain },
                    unit_length: unit_length.unwrap_or(current.unit_length),
                    points: opacities.iter().map(point).take(MAX_POINTS).collect(),
                };
                recolored(&curve, &color_at)
            }
        };
        transfer.name = self.name.clone();
        transfer
    }
}

/// Reads all looks in a file. A TOML file has one, files of other programs have one or many.
///
/// # Errors
/// The file cannot be read, or it has no look.
pub fn import_transfers(path: &Path) -> Result<Vec<ImportedTransfer>, FormatError> {
    let text = read_text(path)?;
    imported_from_text(&text, path)
}

/// The same for the text of a file. `path` is for messages and for looks without a name.
pub(crate) fn imported_from_text(text: &str, path: &Path) -> Result<Vec<ImportedTransfer>, FormatError> {
    let stem = path.file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned());
    let stem = stem.trim_end_matches(".vp");
    let start = text.trim_start_matches('\u{feff}').trim_start();
    let mut found = match start.chars().next() {
        Some('<') => volume_properties(start).filter_map(|tag| slicer_preset(&tag)).collect(),
        Some('{' | '[') if !looks_like_toml(start) => {
            let json = parse(text).map_err(|problem| FormatError::Syntax {
                path: shown(path),
                line: problem.line,
                problem: format!("expected {}", problem.expected),
            })?;
            match json.get("volumeProperties") {
                Some(properties) => properties.list().iter().filter_map(vp_property).collect(),
                None if matches!(json, Json::Map(_)) => paraview_map(&json).into_iter().collect(),
                None => json.list().iter().filter_map(paraview_map).collect::<Vec<_>>(),
            }
        }
        _ => {
            let transfer = transfer_from_toml(text, &path.to_string_lossy())?;
            vec![ImportedTransfer {
                name: transfer.name.clone(),
                shaded: None,
                kind: LookKind::Whole(transfer),
            }]
        }
    };
    found.truncate(MAX_FOUND);
    for item in &mut found {
        let name = if item.name.trim().is_empty() { stem } else { item.name.trim() };
        // Four bytes a character at most.
        item.name = printable(name, MAX_NAME_BYTES / 4);
    }
    if found.is_empty() {
        let found = "no transfer function that can be used";
        return Err(FormatError::Unsupported { path: shown(path), found, expected: EXPECTED });
    }
    Ok(found)
}

/// A TOML file may begin with `[[point]]`.
fn looks_like_toml(start: &str) -> bool {
    start
        .strip_prefix("[[")
        .is_some_and(|rest| rest.trim_start().starts_with(|c: char| c.is_ascii_alphabetic()))
}

/// An entry of ParaView's list of colour maps. `RGBPoints` has position, red, green and blue. The optional `Points`
/// has position, opacity, midpoint and sharpness. Indexed maps for categories are ignored.
fn paraview_map(map: &Json) -> Option<ImportedTransfer> {
    let space = match map.get("ColorSpace").and_then(Json::text).unwrap_or("RGB") {
        "HSV" => ColorSpace::Hsv,
        // The newer formula for colour differences changes the path between two colours invisibly.
        "Lab" | "CIELAB" | "LabCIEDE2000" => ColorSpace::Lab,
        "Diverging" => ColorSpace::Diverging,
        "Step" => ColorSpace::Step,
        _ => ColorSpace::Rgb,
    };
    let numbers = map.get("RGBPoints")?.numbers();
    let colors = Curve { points: color_points(&numbers)?, space };
    let points = map.get("Points").map(|p| pairs(&p.numbers(), 4)).filter(|p| !p.is_empty());
    let kind = match points {
        None => LookKind::Colors(colors),
        Some(opacities) => LookKind::Curves { colors, opacities, unit_length: None, is_physical: false },
    };
    let name = map.get("Name").and_then(Json::text).unwrap_or_default();
    Some(ImportedTransfer { name: name.into(), shaded: None, kind })
}

/// An entry of `volumeProperties` in version 1.0.0 of the schema. Only the first component is read.
fn vp_property(property: &Json) -> Option<ImportedTransfer> {
    let component = property.get("components")?.list().first()?;
    let points = |key: &str| component.get(key).and_then(|f| f.get("points")).map_or(&[][..], Json::list);
    let at = |p: &Json| p.get("x").and_then(Json::number);
    let mut numbers = Vec::new();
    for p in points("rgbTransferFunction") {
        if let (Some(x), [r, g, b, ..]) = (at(p), &p.get("color")?.numbers()[..]) {
            numbers.extend([x, *r, *g, *b]);
        }
    }
    if numbers.is_empty() {
        for p in points("grayTransferFunction") {
            if let (Some(x), Some(y)) = (at(p), p.get("y").and_then(Json::number)) {
                numbers.extend([x, y, y, y]);
            }
        }
    }
    let opacities = points("scalarOpacity").iter().filter_map(|p| Some([at(p)?, p.get("y")?.number()?]));
    let opacities: Vec<f32> = opacities.flatten().collect();
    let unit = component.get("scalarOpacityUnitDistance").and_then(Json::number);
    let name = property.get("name").and_then(Json::text).unwrap_or_default();
    let shaded = component.get("shade").and_then(Json::flag);
    slicer_look(name, shaded, &numbers, &opacities, unit)
}

/// A `VolumeProperty` element of Slicer. Lists are strings of numbers that begin with their count.
fn slicer_preset(tag: &XmlTag) -> Option<ImportedTransfer> {
    let numbers = |key: &str| -> Vec<f32> {
        let mut words = tag.get(key).unwrap_or_default().split_whitespace();
        let count = words.next().and_then(lenient_number).unwrap_or(0.0) as usize;
        words.take(count).map_while(|w| lenient_number(w).map(|n| n as f32)).collect()
    };
    let unit = tag.get("scalarOpacityUnitDistance").and_then(lenient_number).map(|n| n as f32);
    let shaded = tag.get("shade").and_then(lenient_number).map(|n| n != 0.0);
    let name = tag.get("name").unwrap_or_default();
    slicer_look(name, shaded, &numbers("colorTransfer"), &numbers("scalarOpacity"), unit)
}

/// The default unit length of Slicer's opacities is one world unit.
fn slicer_look(
    name: &str,
    shaded: Option<bool>,
    colors: &[f32],
    opacities: &[f32],
    unit: Option<f32>,
) -> Option<ImportedTransfer> {
    let colors = Curve { points: color_points(colors)?, space: ColorSpace::Rgb };
    let opacities = pairs(opacities, 2);
    let unit = unit.filter(|u| *u > 0.0 && u.is_finite()).unwrap_or(1.0);
    let unit_length = Some(UnitLength::World(unit));
    let kind = LookKind::Curves { colors, opacities, unit_length, is_physical: true };
    let has_opacity = !matches!(&kind, LookKind::Curves { opacities, .. } if opacities.is_empty());
    has_opacity.then(|| ImportedTransfer { name: name.into(), shaded, kind })
}

/// Position and colour from every four numbers, sorted; `None` if there are none.
fn color_points(numbers: &[f32]) -> Option<Vec<(f32, [f32; 3])>> {
    let point = |p: &[f32]| (bounded(p[0]), [p[1], p[2], p[3]].map(|c| c.clamp(0.0, 1.0)));
    let is_finite = |p: &&[f32]| p.iter().all(|n| n.is_finite());
    let mut points: Vec<_> = numbers.chunks_exact(4).filter(is_finite).map(point).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    (!points.is_empty()).then_some(points)
}

/// Position and opacity, the first two of every `stride` numbers, sorted.
fn pairs(numbers: &[f32], stride: usize) -> Vec<(f32, f32)> {
    let is_finite = |p: &&[f32]| p[0].is_finite() && p[1].is_finite();
    let chunks = numbers.chunks_exact(stride).filter(is_finite);
    let mut points: Vec<_> = chunks.map(|p| (bounded(p[0]), p[1].clamp(0.0, 1.0))).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    points
}

/// Limits a position to the numbers of a volume, so that differences are finite.
fn bounded(position: f32) -> f32 {
    position
        .clamp(-isinglass_core::volume::Volume::MAX_MAGNITUDE, isinglass_core::volume::Volume::MAX_MAGNITUDE)
}

/// Least and greatest position. They differ even for a single position.
fn span(positions: impl Iterator<Item = f32>) -> (f32, f32) {
    let (lo, hi) = positions.fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), x| (lo.min(x), hi.max(x)));
    if hi > lo { (lo, hi) } else { (lo, lo + (lo.abs() * 1e-3).max(1e-3)) }
}

/// The first `VolumeProperty` elements of an XML document, up to where it is damaged.
fn volume_properties(text: &str) -> impl Iterator<Item = XmlTag> {
    let mut tags = Tags::new(text.as_bytes());
    let all = std::iter::from_fn(move || tags.next().ok().flatten());
    all.filter(|tag| !tag.is_end && tag.name.ends_with("VolumeProperty")).take(MAX_FOUND)
}

/// The first look of a file on a plain ramp of opacity.
pub(crate) fn first_transfer(text: &str, path: &Path) -> Result<TransferFunction, FormatError> {
    let p = |x, opacity| ControlPoint { x, color: [x; 3], opacity };
    let ramp = TransferFunction {
        name: String::new(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0, 0.0), p(1.0, 0.3)],
    };
    let mut found = imported_from_text(text, path)?;
    let transfer = found.swap_remove(0).onto(&ramp);
    transfer.validate().map_err(|cause| FormatError::Transfer { path: shown(path), cause })?;
    Ok(transfer)
}

/// The supported formats, for messages.
pub(crate) const EXPECTED: &str =
    "control points in TOML, ParaView's colour maps in JSON, or Slicer's presets.xml or .vp.json";
/// Most looks of a file.
const MAX_FOUND: usize = 1000;

#[cfg(test)]
mod tests {
    use super::*;

    fn import(text: &str, path: &str) -> Result<Vec<ImportedTransfer>, FormatError> {
        imported_from_text(text, Path::new(path))
    }

    fn ramp() -> TransferFunction {
        let p = |x, opacity| ControlPoint { x, color: [0.3; 3], opacity };
        TransferFunction {
            name: "ramp".into(),
            domain: Domain::Percentiles(1.0, 99.0),
            unit_length: UnitLength::Radius(0.5),
            points: vec![p(0.0, 0.0), p(1.0, 0.5)],
        }
    }

    const PARAVIEW: &str = r#"[ // two maps and one for categories
        {"ColorSpace": "Diverging", "Name": "Cool", "NanColor": [1, 1, 0],
         "RGBPoints": [-1, 0.23137254902, 0.298039215686, 0.752941176471, 0, 0.865, 0.865, 0.865,
                       1, 0.705882352941, 0.0156862745098, 0.149019607843,],},
        {"Name": "Step", "ColorSpace": "Step", "RGBPoints": [10, 1, 0, 0, 20, 0, 1, 0], "Points": [10, 0, 0.5, 0, 20, 1, 0.5, NaN]},
        {"Name": "Set", "IndexedColors": [1, 0, 0], "Annotations": ["0", "a"]},
    ]"#;

    #[test]
    fn colour_maps_of_paraview_come_onto_the_opacities_there_are() {
        let found = import(PARAVIEW, "maps.json").unwrap();
        assert_eq!(found.iter().map(ImportedTransfer::name).collect::<Vec<_>>(), ["Cool", "Step"]);
        let cool = found[0].onto(&ramp());
        assert_eq!(
            (cool.name.as_str(), cool.domain, cool.unit_length),
            ("Cool", ramp().domain, ramp().unit_length)
        );
        assert_eq!(cool.at(0.3).1, ramp().at(0.3).1);
        let middle = cool.points.iter().find(|p| (p.x - 0.5).abs() < 0.02).unwrap();
        // The lightness in the middle is 0.865.
        assert!(middle.color.iter().all(|c| (c - 0.865).abs() < 0.03), "{middle:?}");
        let step = found[1].onto(&ramp());
        assert_eq!(step.at(0.25).1, 0.25, "its own opacities, to the third of four points");
        assert_eq!((step.domain, step.points[0].color), (ramp().domain, [1.0, 0.0, 0.0]));
        let nearly_at_its_end = step.points.iter().rev().find(|p| p.x < 0.999).unwrap();
        assert_eq!(nearly_at_its_end.color, [1.0, 0.0, 0.0], "no colour in between");
    }

    /// The second look has a malformed number, as in Slicer's own file.
    const SLICER: &str = r#"<?xml version="1.0"?><!-- <VolumeProperty name="not this"/> -->
        <SlicerVolumeRenderingPresets version="2">
        <VolumeProperty id="v1" name="CT &amp; bone" interpolation="1" shade="1" ambient="0.2"
            scalarOpacity="8 -1000 0 150 0 300 0.5 3000 0.9" gradientOpacity="4 0 1 255 1"
            colorTransfer="12 -1000 0 0 0 300 0.8 0.4 0.2 3000 1 1 1" effectiveRange="150 3000"/>
        <VolumeProperty name='air' scalarOpacity="4 -250.0.0 0 100 1" colorTransfer="8 -1000 1 0 0 100 0 0 1" shade="0"></VolumeProperty>
        <VolumeProperty name="empty" scalarOpacity="0" colorTransfer="0"/>
        </SlicerVolumeRenderingPresets>"#;

    #[test]
    fn presets_of_slicer_keep_their_values() {
        let found = import(SLICER, "presets.xml").unwrap();
        assert_eq!(found.iter().map(ImportedTransfer::name).collect::<Vec<_>>(), ["CT & bone", "air"]);
        assert_eq!(found.iter().map(ImportedTransfer::shaded).collect::<Vec<_>>(), [Some(true), Some(false)]);
        let bone = found[0].onto(&ramp());
        assert_eq!(
            (bone.domain, bone.unit_length),
            (Domain::Values(-1000.0, 3000.0), UnitLength::World(1.0))
        );
        assert_eq!(bone.validate(), Ok(()));
        let opacity = |value: f32| bone.at((value + 1000.0) / 4000.0).1;
        // Positions are rounded to 2⁻²⁴ of the domain.
        for (value, expected) in [(-500.0, 0.0), (150.0, 0.0), (225.0, 0.25), (300.0, 0.5), (1650.0, 0.7)] {
            assert!((opacity(value) - expected).abs() < 1e-4, "{value}: {}", opacity(value));
        }
        let at_300 = bone.points.iter().find(|p| (p.x - 0.325).abs() < 1e-4).unwrap();
        assert_eq!(at_300.color, [0.8, 0.4, 0.2]);
        assert_eq!(found[1].onto(&ramp()).domain, Domain::Values(-1000.0, 100.0));
        let air = found[1].onto(&ramp());
        assert!((air.at((-250.0 + 1000.0) / 1100.0).1).abs() < 1e-6 && air.at(0.95).1 > 0.5);
    }

    #[test]
    fn volume_properties_in_json_are_read() {
        let text = r#"{"@schema": "volume-property-schema-v1.0.0.json#", "volumeProperties": [{
            "effectiveRange": [0.0, 200.0], "components": [{"shade": true, "scalarOpacityUnitDistance": 0.5,
            "rgbTransferFunction": {"type": "colorTransferFunction", "points": [
                {"x": 0.0, "color": [0.0, 0.0, 0.0], "midpoint": 0.5, "sharpness": 0.0},
                {"x": 200.0, "color": [1.0, 0.5, 0.25], "midpoint": 0.5, "sharpness": 0.0}]},
            "scalarOpacity": {"points": [{"x": 0, "y": 0}, {"x": 100, "y": "0.2.1"}, {"x": 200, "y": 0.8}]}}]}]}"#;
        let found = import(text, "some/liver.vp.json").unwrap();
        assert_eq!((found.len(), found[0].name(), found[0].shaded()), (1, "liver", Some(true)));
        let transfer = found[0].onto(&ramp());
        assert_eq!(
            (transfer.domain, transfer.unit_length),
            (Domain::Values(0.0, 200.0), UnitLength::World(0.5))
        );
        assert_eq!(transfer.points.last().unwrap().color, [1.0, 0.5, 0.25]);
        assert!((transfer.at(0.5).1 - 0.2).abs() < 1e-6);
    }

    #[test]
    fn our_own_files_are_taken_whole() {
        let text = "[[point]]\nx = 0.5\ncolor = \"#ff0000\"\nopacity = 0.5\n";
        let found = import(text, "mine.toml").unwrap();
        assert_eq!(found[0].onto(&ramp()), transfer_from_toml(text, "mine.toml").unwrap());
        assert_eq!(first_transfer(text, Path::new("mine.toml")).unwrap().name, "mine");
    }

    #[test]
    fn what_is_none_of_these_is_named_in_one_line() {
        for (text, what) in [
            ("[1, 2", "line 1: expected a comma or ]"),
            ("{\"a\": \n}}", "line 2: expected a value"),
            ("[]", "found no transfer function that can be used, expected control points in TOML"),
            ("<a><b/></a>", "found no transfer function"),
            ("hello", "line 1"),
        ] {
            let e = import(text, "a.json").unwrap_err().to_string();
            assert!(e.starts_with("a.json: ") && e.contains(what) && !e.contains('\n'), "{text:?}: {e}");
        }
    }

    /// Damaged texts give errors or valid transfer functions, and never a panic.
    #[test]
    fn any_text_is_survived() {
        let vp = r#"{"volumeProperties": [{"components": [{"rgbTransferFunction": {"points": [{"x": 1e38, "color": [1, 2, -3]}]}, "scalarOpacity": {"points": [{"x": -1e38, "y": 7}, {"x": "nan", "y": 0}]}}]}]}"#;
        let mut state = 0x2545_f491_4f6c_dd1d_u64;
        let mut next = move |below: usize| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as usize % below
        };
        let mut used = 0;
        for text in [PARAVIEW, SLICER, vp] {
            for _ in 0..1500 {
                let mut bytes = text.as_bytes().to_vec();
                for _ in 0..=next(4) {
                    let (a, b) = (next(bytes.len()), next(bytes.len()));
                    match next(4) {
                        0 => bytes[a] = b"\"'<>[]{},:0.9e-N\n"[next(17)],
                        1 => bytes.truncate(a.max(1)),
                        2 => bytes.copy_within(a.min(b)..a.max(b), 0),
                        _ => drop(bytes.splice(a..a, (0..next(20)).map(|_| b'9').collect::<Vec<_>>())),
                    }
                }
                let text = String::from_utf8_lossy(&bytes);
                let Ok(found) = import(&text, "fuzz") else { continue };
                for item in found {
                    let transfer = item.onto(&ramp());
                    assert_eq!(transfer.validate(), Ok(()), "{text}");
                    used += 1;
                }
            }
        }
        assert!(used > 500, "most mutants would be refused: {used}");
    }
}
