//! Interprets the axes of an NRRD header.

use glam::DVec3;
use isinglass_core::text::printable;

use super::header::{NrrdHeader, Space};
use crate::axes::{Geometry, World};
use crate::error::HeaderError;
use crate::plan::{Axis, Role};
use crate::warning::{Warning, WarningKind};

#[derive(Debug, PartialEq)]
pub(super) struct Axes {
    /// Each axis of the file, and a third spatial axis if the file has two.
    pub(super) axes: Vec<Axis>,
    pub(super) geometry: Geometry,
    /// Whether the channels are red, green, blue and perhaps opacity.
    pub(super) are_colors: bool,
    pub(super) warnings: Vec<Warning>,
}

impl Axes {
    pub(super) fn of(header: &NrrdHeader) -> Result<Self, HeaderError> {
        let mut warnings = Vec::new();
        let kept = spatial_axes(header)?;
        if kept.len() == 2 {
            let text = "the file has two dimensions and is read as one slice";
            warnings.push(Warning::new(WarningKind::Geometry, text));
        }
        let mut axes: Vec<Axis> =
            header.sizes.iter().map(|&size| Axis { size, role: Role::Single }).collect();
        for (i, &axis) in kept.iter().enumerate() {
            axes[axis].role = Role::Space(i);
        }
        if kept.len() == 2 {
            axes.push(Axis { size: 1, role: Role::Space(2) });
        }
        let are_colors = other_roles(header, &mut axes, kept[0])?;
        let steps = steps(header, &kept, &mut warnings)?;
        let is_body = header.directions.is_some() && matches!(header.space, Space::Anatomical(_));
        let world = if is_body { World::Body } else { World::Space };
        let has_directions = header.directions.is_some();
        let origin = header.origin.filter(|_| has_directions).map(|o| in_space(header, o));
        let unit = unit(header, &kept, &mut warnings);
        Ok(Self { axes, geometry: Geometry { steps, origin, world, unit }, are_colors, warnings })
    }
}

fn kind(header: &NrrdHeader, axis: usize) -> String {
    header.kinds.as_ref().map_or("???", |k| &k[axis]).to_ascii_lowercase()
}

/// The two or three spatial axes.
fn spatial_axes(header: &NrrdHeader) -> Result<Vec<usize>, HeaderError> {
    let is_spatial = |axis: &usize| {
        let has_direction = header.directions.as_ref().is_none_or(|d| d[*axis].is_some());
        let kind = kind(header, *axis);
        has_direction && matches!(kind.as_str(), "domain" | "space" | "time" | "???" | "none" | "list")
    };
    let mut kept: Vec<usize> = (0..header.sizes.len()).filter(is_spatial).collect();
    while kept.len() > 3 {
        // If there are more than three, axes with one voxel are dropped first. Then come times and lists, then the
        // slowest axis.
        let is_time = |&axis: &usize| matches!(kind(header, axis).as_str(), "time" | "list");
        let least = kept.iter().rposition(|&axis| header.sizes[axis] == 1);
        let i = least.or_else(|| kept.iter().rposition(is_time)).unwrap_or(kept.len() - 1);
        kept.remove(i);
    }
    if !(2..=3).contains(&kept.len()) {
        let sizes: Vec<String> = header.sizes.iter().map(u64::to_string).collect();
        let what =
            format!("sizes {} are no volume, expected three axes longer than one voxel", sizes.join(" "));
        return Err(HeaderError::Contradiction(what));
    }
    Ok(kept)
}

/// Assigns channels and time to the other axes. Returns whether the channels are colours.
fn other_roles(header: &NrrdHeader, axes: &mut [Axis], first_in_space: usize) -> Result<bool, HeaderError> {
    let mut are_colors = false;
    for i in 0..header.sizes.len() {
        if axes[i].role != Role::Single || axes[i].size == 1 {
            continue;
        }
        let has = |role: Role| axes.iter().any(|a| a.role == role);
        let kind = kind(header, i);
        let is_channel = i < first_in_space
            || !matches!(kind.as_str(), "domain" | "space" | "time" | "???" | "none" | "list");
        let role = match (is_channel, has(Role::Channel), has(Role::Time)) {
            (true, false, _) | (false, false, true) => Role::Channel,
            (false, _, false) | (true, true, false) => Role::Time,
            (_, true, true) => {
                let sizes: Vec<String> = header.sizes.iter().map(u64::to_string).collect();
                let what = format!(
                    "sizes {} have more than five axes, expected three in space, one of channels and one of time",
                    sizes.join(" ")
                );
                return Err(HeaderError::Contradiction(what));
            }
        };
        axes[i].role = role;
        are_colors |= role == Role::Channel && matches!(kind.as_str(), "rgb-color" | "rgba-color");
    }
    Ok(are_colors)
}

/// Converts a vector from the space of the header to the world of volumes.
fn in_space(header: &NrrdHeader, v: [f64; 3]) -> DVec3 {
    match header.space {
        Space::Anatomical(signs) => DVec3::from(v) * DVec3::from(signs),
        Space::Cartesian(z) => DVec3::from(v) * DVec3::new(1.0, 1.0, z),
    }
}

/// The step of one voxel along each axis of the file, in the world of volumes.
fn steps(
    header: &NrrdHeader,
    kept: &[usize],
    warnings: &mut Vec<Warning>,
) -> Result<[DVec3; 3], HeaderError> {
    let spacing = |axis: usize| header.spacings.as_ref().map(|s| s[axis]).filter(|s| !s.is_nan());
    let mut steps = Vec::with_capacity(3);
    let mut num_missing = 0;
    for (i, &axis) in kept.iter().enumerate() {
        let direction = header.directions.as_ref().and_then(|d| d[axis]);
        steps.push(match (direction, spacing(axis)) {
            (Some(direction), spacing) => {
                let step = in_space(header, direction);
                if let Some(s) = spacing
                    && (s.abs() - step.length()).abs() > step.length() * 1e-3
                {
                    let length = step.length();
                    let what = format!(
                        "axis {axis} has spacing {s}, but its direction has length {length}; expected one"
                    );
                    return Err(HeaderError::Contradiction(what));
                }
                step
            }
            (None, Some(spacing)) => DVec3::AXES[i] * spacing,
            (None, None) => {
                num_missing += 1;
                DVec3::AXES[i]
            }
        });
    }
    if num_missing > 0 {
        let text = format!("{num_missing} axes have no spacing; it was taken as 1");
        warnings.push(Warning::new(WarningKind::Guess, text));
    }
    if let [a, b] = steps[..] {
        let normal = a.cross(b).normalize_or(DVec3::Z);
        steps.push(normal * a.length().min(b.length()));
    }
    if header.directions.is_some() && header.space == Space::Cartesian(-1.0) {
        let text = "the space is left-handed; its third axis was reversed";
        warnings.push(Warning::new(WarningKind::Geometry, text));
    }
    Ok([steps[0], steps[1], steps[2]])
}

/// The unit of length, if it is the same for all axes.
fn unit(header: &NrrdHeader, kept: &[usize], warnings: &mut Vec<Warning>) -> Option<String> {
    let units: Vec<&String> = match (&header.space_units, &header.units) {
        (Some(units), _) => units.iter().take(3).collect(),
        (None, Some(units)) => kept.iter().map(|&axis| &units[axis]).collect(),
        (None, None) => return None,
    };
    let first = *units.first()?;
    if units.iter().any(|u| *u != first) {
        let text = "the axes have different units; spacings are taken as they are";
        warnings.push(Warning::new(WarningKind::Geometry, text));
        return None;
    }
    let is_name = !first.is_empty() && first != "???" && first != "none";
    is_name.then(|| printable(first, MAX_UNIT_CHARS))
}

/// Longest name of a unit, in characters.
const MAX_UNIT_CHARS: usize = 16;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::axes::Grid;

    fn axes(fields: &str) -> Result<Axes, HeaderError> {
        let text = format!("NRRD0005\ntype: uint8\nencoding: raw\n{fields}\n\n");
        Axes::of(&NrrdHeader::read(&mut text.as_bytes()).unwrap())
    }

    fn grid(fields: &str) -> Result<(Grid, Vec<String>), HeaderError> {
        let axes = axes(fields)?;
        let size = |i| axes.axes.iter().find(|a| a.role == Role::Space(i)).unwrap().size;
        let grid = Grid::arrange([size(0), size(1), size(2)], &axes.geometry, None, 1, 2048)
            .map_err(HeaderError::Contradiction)?;
        let warnings = axes.warnings.iter().chain(&grid.warnings).map(ToString::to_string).collect();
        Ok((grid, warnings))
    }

    /// A 4×3×2 file.
    fn small(fields: &str) -> (Grid, Vec<String>) {
        grid(&format!("dimension: 3\nsizes: 4 3 2\n{fields}")).unwrap()
    }

    #[test]
    fn a_body_is_never_mirrored() {
        let identity = "space directions: (1,0,0) (0,1,0) (0,0,1)";
        for (space, flips) in
            [("RAS", [false; 3]), ("LPS", [true, true, false]), ("LAS", [true, false, false])]
        {
            let (g, warnings) = small(&format!("space: {space}\n{identity}"));
            assert_eq!(g.order.map(|o| o.1), flips, "{space}");
            assert_eq!(g.orientation.as_deref(), Some("RAS"));
            assert_eq!(warnings.len(), usize::from(space != "RAS"));
        }
        let (g, _) = small(&format!("space: 3D-left-handed\n{identity}"));
        assert_eq!((g.order[2], g.orientation), ((2, true), None));
        let (g, _) = small("spacings: 1 -2 3");
        assert_eq!((g.order[1], g.spacing), ((1, true), Vec3::new(1.0, 2.0, 3.0)));
        let (g, warnings) = small("space: LPS\nspace directions: (0,0,-3) (2,0,0) (0,1,0)");
        assert_eq!(g.spacing, Vec3::new(2.0, 1.0, 3.0));
        assert_eq!(warnings, ["the axes of the file point to ILP; the voxels were reordered to RAS"]);
    }

    #[test]
    fn turns_and_shears_are_reported_from_one_degree() {
        let turned = |deg: f64| {
            let (s, c) = deg.to_radians().sin_cos();
            small(&format!("space: RAS\nspace directions: ({c},{s},0) ({},{c},0) (0,0,1)", -s))
        };
        assert!(turned(0.9).1.is_empty());
        assert_eq!(
            turned(12.3).1,
            ["the axes are rotated by up to 12.3° from their space, which is not shown"]
        );
        // A rotation keeps a length of 1. The tolerance is the rounding of single precision.
        assert!((turned(12.3).0.spacing - Vec3::ONE).length() < 1e-6);
        let (_, warnings) = small("space: RAS\nspace directions: (1,0,0) (0.2,1,0) (0,0,1)");
        assert!(warnings[1].contains("right angles"), "{warnings:?}");
    }

    #[test]
    fn other_than_three_axes() {
        let g = grid("dimension: 4\nsizes: 1 4 3 2\nspacings: nan 1 2 3\nkinds: vector domain domain domain");
        assert_eq!(g.unwrap().0.file_dims, [4, 3, 2]);
        let g = grid(
            "dimension: 4\nsizes: 4 3 2 1\nspace: RAS-time\nspace directions: (1,0,0,0) (0,1,0,0) (0,0,2,0) none",
        );
        assert_eq!(g.unwrap().0.spacing, Vec3::new(1.0, 1.0, 2.0));
        let (g, _) = grid("dimension: 2\nsizes: 4 3\nspacings: 2 2").unwrap();
        assert_eq!((g.dims(), g.spacing), ([4, 3, 1], Vec3::splat(2.0)));
        for (wrong, what) in [
            ("dimension: 6\nsizes: 2 2 2 3 3 3", "more than five axes"),
            ("dimension: 1\nsizes: 9", "9 are no volume"),
            ("dimension: 3\nsizes: 4 3 99999999999", "axis 2 has 99999999999 voxels"),
            ("dimension: 3\nsizes: 4 3 2\nspacings: 0 1 1", "above zero"),
            ("dimension: 3\nsizes: 4 3 2\nspacings: inf 1 1", "finite"),
            (
                "dimension: 3\nsizes: 4 3 2\nspace: RAS\nspace directions: (1,0,0) (2,0,0) (0,0,1)",
                "one plane",
            ),
            (
                "dimension: 3\nsizes: 4 3 2\nspacings: 2 1 1\nspace: RAS\nspace directions: (1,0,0) (0,1,0) (0,0,1)",
                "has spacing 2, but its direction has length 1",
            ),
        ] {
            let e = grid(wrong).unwrap_err().to_string();
            assert!(e.contains(what), "{wrong:?}: {e}");
        }
    }

    #[test]
    fn channels_and_times_are_axes_of_their_own() {
        use Role::{Channel, Single, Space, Time};
        let roles = |fields: &str| axes(fields).unwrap().axes.iter().map(|a| a.role).collect::<Vec<_>>();
        let space = [Space(0), Space(1), Space(2)];
        let color = "dimension: 4\nsizes: 3 4 3 2\nkinds: RGB-color domain domain domain";
        assert_eq!(roles(color), [&[Channel], &space[..]].concat());
        assert!(axes(color).unwrap().are_colors);
        assert_eq!(roles("dimension: 4\nsizes: 5 4 3 2"), [&space[..], &[Time]].concat());
        assert_eq!(roles("dimension: 4\nsizes: 5 4 3 1"), [&space[..], &[Single]].concat());
        assert_eq!(roles("dimension: 5\nsizes: 5 4 3 2 2"), [&space[..], &[Time, Channel]].concat());
        let list = "dimension: 4\nsizes: 6 4 3 2\nkinds: list domain domain domain";
        assert_eq!(roles(list), [&[Channel], &space[..]].concat());
    }

    /// ITK, Slicer and pynrrd write these.
    #[test]
    fn axes_outside_of_space_stand_first_or_last() {
        use Role::{Channel, Space, Time};
        let space = [Space(0), Space(1), Space(2)];
        let inner = "(1,0,0) (0,2,0) (0,0,3)";
        for none in ["none", "nan", "NaN", "(nan,nan,nan)"] {
            for kind in ["vector", "list", "3-vector", "RGB-color", "3-gradient"] {
                let first = format!(
                    "dimension: 4\nsizes: 3 6 5 4\nspace: RAS\nspace directions: {none} {inner}\n\
                     kinds: {kind} domain domain domain\nspacings: nan nan nan nan"
                );
                let found = axes(&first).unwrap();
                let roles: Vec<Role> = found.axes.iter().map(|a| a.role).collect();
                assert_eq!(roles, [&[Channel], &space[..]].concat(), "{none} {kind}");
                assert_eq!(found.geometry.steps.map(|s| s.length()), [1.0, 2.0, 3.0]);
                let last = format!(
                    "dimension: 4\nsizes: 6 5 4 3\nspace: RAS\nspace directions: {inner} {none}\n\
                     kinds: domain domain domain {kind}"
                );
                let found = axes(&last).unwrap();
                let roles: Vec<Role> = found.axes.iter().map(|a| a.role).collect();
                // A list of volumes is a sequence in time.
                let role = if kind == "list" { Time } else { Channel };
                assert_eq!(roles, [&space[..], &[role]].concat(), "{none} {kind}");
                assert_eq!(found.geometry.steps.map(|s| s.length()), [1.0, 2.0, 3.0]);
            }
        }
        let spacings =
            "dimension: 4\nsizes: 3 6 5 4\nspacings: NaN 1 2 3\nkinds: vector domain domain domain";
        assert_eq!(axes(spacings).unwrap().geometry.steps.map(|s| s.length()), [1.0, 2.0, 3.0]);
    }

    #[test]
    fn units_are_kept_when_they_agree() {
        let unit = |line: &str| axes(&format!("dimension: 3\nsizes: 4 3 2\n{line}")).unwrap().geometry.unit;
        assert_eq!(unit("units: \"mm\" \"mm\" \"mm\"").as_deref(), Some("mm"));
        let directions = "space directions: (1,0,0) (0,1,0) (0,0,1)";
        assert_eq!(
            unit(&format!("space: RAS\nspace units: \"mm\" \"mm\" \"mm\"\n{directions}")).as_deref(),
            Some("mm")
        );
        assert_eq!(unit("units: \"mm\" \"mm\" \"cm\""), None);
    }
}
