//! NeXus: the data that a file shows by default, and their axes (NXdata of the NeXus manual, 2024.02).

use super::contents::{ArrayFile, Attributes, Listed};
use super::links::Place;
use crate::cf::{Coordinates, Unit, kind_of_name, unit_of};
use crate::plan::AxisKind;

/// The array that a file shows by default.
pub(super) struct DefaultSignal {
    /// The byte at which its header begins.
    at: u64,
    /// The group of data that has it or a link to it.
    group: String,
}

impl DefaultSignal {
    /// Whether `array` is it, by whatever path.
    pub(super) fn is_it(&self, array: &Listed) -> bool {
        array.at == self.at
    }
}

/// The array that `contents` shows by default; `None` if it is no NeXus file, or does not say.
pub(super) fn shown(contents: &ArrayFile) -> Option<DefaultSignal> {
    let group = default_data(contents)?;
    let signal = signal(contents, &group)?;
    match contents.resolve(&format!("{group}/{signal}")) {
        Ok(Place::Here(place)) => Some(DefaultSignal { at: place.at, group }),
        _ => None,
    }
}

/// The group of data that is shown by default. Each group names the next, or else the first of the right class is.
fn default_data(contents: &ArrayFile) -> Option<String> {
    let mut group = String::new();
    for _ in 0..MAX_GROUPS {
        let attributes = contents.attributes(if group.is_empty() { "/" } else { &group })?;
        let class = attributes.text("NX_class").unwrap_or_default();
        if class == "NXdata" {
            return Some(group);
        }
        let child = match attributes.text("default").filter(|name| !name.trim().is_empty()) {
            Some(name) => name.trim().trim_end_matches('/').to_owned(),
            None => {
                let wanted = if group.is_empty() { "NXentry" } else { "NXdata" };
                first_of_class(contents, &group, wanted)?
            }
        };
        group = if child.starts_with('/') { child } else { format!("{group}/{child}") };
    }
    None
}

fn first_of_class(contents: &ArrayFile, group: &str, class: &str) -> Option<String> {
    let names = contents.names(if group.is_empty() { "/" } else { group });
    names.into_iter().take(MAX_CHILDREN).find(|name| {
        let attributes = contents.attributes(&format!("{group}/{name}"));
        attributes.and_then(|a| a.text("NX_class")).as_deref() == Some(class)
    })
}

/// The array of a group of data that is the signal, by the group, or by the array itself as in old files.
fn signal(contents: &ArrayFile, group: &str) -> Option<String> {
    if let Some(name) = contents.attributes(group)?.text("signal") {
        return Some(name);
    }
    let names = contents.names(group);
    let is_marked = |name: &&String| {
        let attributes = contents.attributes(&format!("{group}/{name}"));
        attributes
            .is_some_and(|a| a.number("signal") == Some(1.0) || a.text("signal").as_deref() == Some("1"))
    };
    let marked = names.iter().take(MAX_CHILDREN).find(is_marked);
    marked.or_else(|| names.iter().find(|name| *name == "data")).cloned()
}

/// The axes of an array, by the group of data that shows it; `None` if there is none, or it names no axes.
pub(super) fn axes(contents: &ArrayFile, array: &Listed, shown: &DefaultSignal) -> Option<Vec<Coordinates>> {
    let group = if shown.is_it(array) { shown.group.clone() } else { array.folder().to_owned() };
    let attributes = contents.attributes(&group)?;
    if attributes.text("NX_class").as_deref() != Some("NXdata") {
        return None;
    }
    let names = names(contents, &group, &attributes, array);
    if names.iter().all(Option::is_none) {
        return None;
    }
    let axis = |(name, length): (&Option<String>, &u64)| match name {
        Some(name) => coordinates(contents, &group, name, *length),
        None => Coordinates::default(),
    };
    Some(names.iter().zip(&array.shape).map(axis).collect())
}

/// The array with the coordinates of each axis, the slowest first, as far as they are named.
fn names(contents: &ArrayFile, group: &str, attributes: &Attributes, array: &Listed) -> Vec<Option<String>> {
    let mut found = vec![None; array.shape.len()];
    let own = contents.attributes(&format!("{group}/{}", array.name()));
    let listed = |attributes: &Attributes| -> Vec<String> {
        let list = attributes.texts("axes");
        if list.len() > 1 {
            return list.to_vec();
        }
        let text = attributes.text("axes").unwrap_or_default();
        let text = text.trim_matches(['[', ']']);
        text.split([':', ',']).map(|name| name.trim().to_owned()).collect()
    };
    let mut list = listed(attributes);
    if list == [""] {
        list = own.map_or_else(|| listed(&array.attributes), |own| listed(&own));
    }
    for (i, name) in list.into_iter().enumerate().filter(|(_, name)| !name.is_empty() && name != ".") {
        let indices = attributes.numbers(&format!("{name}_indices"));
        let axis = indices.first().map_or(i, |index| *index as usize);
        if let Some(place) = found.get_mut(axis).filter(|_| indices.len() <= 1) {
            *place = Some(name);
        }
    }
    if found.iter().all(Option::is_none) {
        // The oldest files number the axes at the arrays of coordinates.
        for name in contents.names(group).into_iter().take(MAX_CHILDREN) {
            let number = contents.attributes(&format!("{group}/{name}")).and_then(|a| a.number("axis"));
            let index = number.filter(|number| *number >= 1.0).map(|number| number as usize - 1);
            if let Some(place) = index.and_then(|i| found.get_mut(i)) {
                place.get_or_insert(name);
            }
        }
    }
    found
}

/// What the array `name` says of an axis of `length` numbers.
fn coordinates(contents: &ArrayFile, group: &str, name: &str, length: u64) -> Coordinates {
    let path = format!("{group}/{name}");
    let unit =
        contents.attributes(&path).and_then(|a| a.text("units")).map_or(Unit::None, |text| unit_of(&text));
    let kind = kind_of_name(name).or(match unit {
        Unit::Time(_) => Some(AxisKind::Time),
        _ => None,
    });
    let mut axis = Coordinates::told(kind, None, unit);
    let Some(mut numbers) = contents.numbers(&path) else { return axis };
    if numbers.len() as u64 == length + 1 {
        // The edges of the voxels.
        numbers = numbers.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0).collect();
    }
    if numbers.len() as u64 == length {
        axis.set_numbers(&numbers);
    }
    axis
}

/// Most groups from the root to the data, and most members of a group that are looked at.
const MAX_GROUPS: usize = 8;
const MAX_CHILDREN: usize = 256;
