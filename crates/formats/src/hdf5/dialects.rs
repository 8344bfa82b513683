//! What programs say of the axes of their arrays, each in its own way. An array that none of them knows has what
//! [`super::coordinates`] finds.

use super::contents::{ArrayFile, Listed};
use super::{dream3d, emd, nexus};
use crate::cf::{Coordinates, Standing, Unit, unit_of};
use crate::plan::AxisKind;

/// Tells `arrays` what the programs that wrote the file say of them, and which of them is to be shown.
pub(super) fn tell(contents: &ArrayFile, arrays: &mut [Listed]) {
    let shown = nexus::shown(contents);
    for array in arrays.iter_mut().filter(|array| array.shape.len() > 1) {
        let told = if array.attributes.has("MATLAB_class") {
            set_matlab_standing(array);
            Some(matlab_axes(&array.shape))
        } else {
            let from_nexus = || nexus::axes(contents, array, shown.as_ref()?);
            emd::axes(contents, array).or_else(|| dream3d::axes(contents, array)).or_else(from_nexus)
        };
        if shown.as_ref().is_some_and(|shown| shown.is_it(array)) {
            array.standing = Standing::First;
        } else if emd::is_description(array) {
            array.standing = Standing::Aside;
        }
        array.told = told.filter(|axes| axes.len() == array.shape.len());
    }
}

/// Masks, and what is only a part of a cell or of another value, are not shown first.
fn set_matlab_standing(array: &mut Listed) {
    let class = array.attributes.text("MATLAB_class").unwrap_or_default();
    if ["logical", "char", "cell"].contains(&class.as_str()) || array.path.starts_with("/#refs#") {
        array.standing = Standing::Aside;
    }
}

/// The axes of MATLAB, whose first runs fastest: rows, columns, slices and more. Rows run along y, and columns along x.
fn matlab_axes(shape: &[u64]) -> Vec<Coordinates> {
    let kind = |i: usize| match i {
        0 => Some(AxisKind::Space(1)),
        1 => Some(AxisKind::Space(0)),
        // A picture in colours has these before its slices.
        2 if shape.len() == 4 && shape[1] == 3 => Some(AxisKind::Channel),
        _ => None,
    };
    (0..shape.len()).rev().map(|i| Coordinates::told(kind(i), None, Unit::None)).collect()
}

/// A unit as programs write it in brackets, or in letters apart: `[n_m]`.
pub(super) fn plain_unit(text: &str) -> Unit {
    let text = text.trim().trim_matches(['[', ']']).replace('_', "");
    if text.starts_with('<') { Unit::None } else { unit_of(&text) }
}
