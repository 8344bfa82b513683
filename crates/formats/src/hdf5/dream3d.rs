//! DREAM.3D: cells of an image geometry, in files of version 6 (SIMPL) and of version 7 (DREAM3D-NX).

use super::contents::{ArrayFile, Listed};
use super::dialects::plain_unit;
use crate::cf::{Coordinates, Unit};
use crate::plan::AxisKind;

/// The cells along x, y and z, where the first corner is, and the sides of a cell.
struct CellGrid {
    dims: [f64; 3],
    origin: [f64; 3],
    spacing: [f64; 3],
    unit: Unit,
}

/// The axes of an array of cells: z, y, x and components. Old files have all cells along one axis, and are not known.
pub(super) fn axes(contents: &ArrayFile, array: &Listed) -> Option<Vec<Coordinates>> {
    let (geometry, _) = array.folder().rsplit_once('/')?;
    let grid = old_grid(contents, geometry).or_else(|| new_grid(contents, geometry))?;
    let is_grid = array.shape.iter().zip(grid.dims.iter().rev()).all(|(n, told)| *n as f64 == *told);
    if !is_grid || !matches!(array.shape.len(), 3 | 4) {
        return None;
    }
    let axis = |k: usize| {
        // The origin is a corner of the first cell.
        let line = (grid.origin[k] + grid.spacing[k] / 2.0, grid.spacing[k]);
        Coordinates::told(Some(AxisKind::Space(k)), Some(line), grid.unit.clone()).in_space()
    };
    let mut axes: Vec<Coordinates> = [2, 1, 0].map(axis).into();
    if array.shape.len() == 4 {
        let kind = (array.shape[3] > 1).then_some(AxisKind::Channel);
        axes.push(Coordinates::told(kind, None, Unit::None));
    }
    Some(axes)
}

/// The grid of version 6, in arrays beside the cells.
fn old_grid(contents: &ArrayFile, geometry: &str) -> Option<CellGrid> {
    let folder = format!("{geometry}/_SIMPL_GEOMETRY");
    contents.attributes(&folder)?;
    let three = |name: &str| contents.numbers(&format!("{folder}/{name}"))?.try_into().ok();
    let unit = Unit::None;
    Some(CellGrid { dims: three("DIMENSIONS")?, origin: three("ORIGIN")?, spacing: three("SPACING")?, unit })
}

/// The grid of version 7, in attributes of the geometry.
fn new_grid(contents: &ArrayFile, geometry: &str) -> Option<CellGrid> {
    let found = contents.attributes(geometry)?;
    let three = |name: &str| found.numbers(name).try_into().ok();
    let unit = found.text("_UNITS").or_else(|| found.text("Length Unit"));
    let unit = unit.map_or(Unit::None, |text| plain_unit(&text));
    Some(CellGrid {
        dims: three("_DIMENSIONS")?,
        origin: three("_ORIGIN")?,
        spacing: three("_SPACING")?,
        unit,
    })
}
