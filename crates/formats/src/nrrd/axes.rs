//! From the axes of a file to the axes of a volume: three of them, pointing right, to the front and up where the file
//! knows a body, or along +x, +y, +z of its space, so that nothing is shown mirrored or on its side.
//!
//! World space has the volume's own axes, so a turn that is not a multiple of 90° cannot be kept; it is reported.

use glam::{DVec3, Vec3};
use isinglass_core::volume::{Volume, Voxels};

use super::header::{Header, Space};
use crate::error::{HeaderError, quoted};

/// The grid of a header, and how its voxels must be reordered.
#[derive(Debug, PartialEq)]
pub(super) struct Grid {
    /// Voxels along the axes as they are in the file.
    pub(super) file_dims: [u32; 3],
    /// Which axis of the file becomes x, y and z, and whether it is reversed.
    pub(super) order: [(usize, bool); 3],
    /// Distances along x, y and z.
    pub(super) spacing: Vec3,
    pub(super) unit: Option<String>,
    pub(super) orientation: Option<String>,
    pub(super) warnings: Vec<String>,
}

impl Grid {
    pub(super) fn of(header: &Header) -> Result<Self, HeaderError> {
        let mut warnings = Vec::new();
        let kept = spatial_axes(header)?;
        let mut file_dims = [1; 3];
        for (dim, &axis) in file_dims.iter_mut().zip(&kept) {
            let n = header.sizes[axis];
            let max = Volume::MAX_SIDE;
            *dim = u32::try_from(n).ok().filter(|n| *n <= max).ok_or_else(|| {
                HeaderError::Contradiction(format!("axis {axis} has {n} voxels, expected 1 to {max}"))
            })?;
        }
        if kept.len() == 2 {
            warnings.push("the file has two dimensions and is read as one slice".to_owned());
        }
        let steps = steps(header, &kept, &mut warnings)?;
        let order = order(steps)?;
        let axes = order.map(|(axis, _)| steps[axis].normalize());
        let is_anatomical = header.directions.is_some() && matches!(header.space, Space::Anatomical(_));
        if order != FILE_ORDER {
            let letters = if is_anatomical { BODY_LETTERS } else { SPACE_LETTERS };
            let sign = |axis: usize| {
                let target = order.iter().position(|o| o.0 == axis).unwrap_or(axis);
                letters[target][usize::from(order[target].1)]
            };
            let (from, to) = ((0..3).map(sign), letters.map(|l| l[0]).concat());
            let from: String = from.collect();
            warnings.push(format!("the axes of the file point to {from}; the voxels were reordered to {to}"));
        }
        let tilt = axes.iter().zip(DVec3::AXES).map(|(a, e)| a.dot(e).abs().min(1.0).acos().to_degrees());
        let tilt = tilt.fold(0.0, f64::max);
        if tilt > MAX_TILT_DEG {
            warnings.push(format!(
                "the axes are turned by up to {tilt:.1}° from their space, which is not shown"
            ));
        }
        let [x, y, z] = axes;
        let shear =
            [x.dot(y), y.dot(z), z.dot(x)].map(f64::abs).into_iter().fold(0.0, f64::max).asin().to_degrees();
        if shear > MAX_TILT_DEG {
            warnings.push(format!("the axes are {shear:.1}° away from right angles, which is not shown"));
        }
        let spacing = order.map(|(axis, _)| steps[axis].length() as f32);
        Ok(Self {
            file_dims,
            order,
            spacing: Vec3::from_array(spacing),
            unit: unit(header, &kept, &mut warnings),
            orientation: is_anatomical.then(|| "RAS".to_owned()),
            warnings,
        })
    }

    /// Dimensions after reordering.
    pub(super) fn dims(&self) -> [u32; 3] {
        self.order.map(|(axis, _)| self.file_dims[axis])
    }

    /// Whether reordering needs a second copy of the voxels.
    pub(super) fn is_permuted(&self) -> bool {
        self.order.map(|o| o.0) != FILE_ORDER.map(|o| o.0)
    }

    /// The voxels in the order of the volume.
    pub(super) fn reorder(&self, voxels: Voxels) -> Voxels {
        match voxels {
            Voxels::U8(v) => Voxels::U8(self.reorder_vec(v)),
            Voxels::U16(v) => Voxels::U16(self.reorder_vec(v)),
            Voxels::F32(v) => Voxels::F32(self.reorder_vec(v)),
        }
    }

    fn reorder_vec<T: Copy>(&self, mut voxels: Vec<T>) -> Vec<T> {
        let [nx, ny, nz] = self.dims().map(|d| d as usize);
        if self.is_permuted() {
            let file = self.file_dims.map(|d| d as usize);
            let file_strides = [1, file[0], file[0] * file[1]];
            let strides = self.order.map(|(axis, _)| file_strides[axis]);
            voxels = (0..nz)
                .flat_map(|z| (0..ny).map(move |y| y * strides[1] + z * strides[2]))
                .flat_map(|start| (0..nx).map(move |x| start + x * strides[0]))
                .map(|i| voxels[i])
                .collect();
        }
        let [flip_x, flip_y, flip_z] = self.order.map(|o| o.1);
        if flip_x {
            voxels.chunks_exact_mut(nx).for_each(<[T]>::reverse);
        }
        if flip_y {
            voxels.chunks_exact_mut(nx * ny).for_each(|slice| reverse_blocks(slice, nx));
        }
        if flip_z {
            reverse_blocks(&mut voxels, nx * ny);
        }
        voxels
    }
}

/// Reverses the order of blocks of `n`, not what is in them.
fn reverse_blocks<T>(list: &mut [T], n: usize) {
    let num_blocks = list.len() / n;
    for i in 0..num_blocks / 2 {
        let (head, tail) = list.split_at_mut((num_blocks - 1 - i) * n);
        head[i * n..(i + 1) * n].swap_with_slice(&mut tail[..n]);
    }
}

/// The two or three axes along which voxels lie in space.
fn spatial_axes(header: &Header) -> Result<Vec<usize>, HeaderError> {
    let is_spatial = |axis: usize| {
        let has_direction = header.directions.as_ref().is_none_or(|d| d[axis].is_some());
        let kind = header.kinds.as_ref().map_or("domain", |k| &k[axis]).to_ascii_lowercase();
        has_direction && matches!(kind.as_str(), "domain" | "space" | "time" | "???" | "none" | "list")
    };
    let mut kept = Vec::new();
    for (axis, &n) in header.sizes.iter().enumerate() {
        if is_spatial(axis) {
            kept.push(axis);
        } else if n > 1 {
            let kind = header.kinds.as_ref().map_or("none", |k| &k[axis]);
            let kind = quoted(kind);
            let what = format!("axis {axis} holds {n} values for each voxel (kind {kind}), expected one");
            return Err(HeaderError::Contradiction(what));
        }
    }
    while kept.len() > 3 {
        let Some(i) = kept.iter().rposition(|&axis| header.sizes[axis] == 1) else { break };
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

/// The step of one voxel along each axis of the file, in the space whose axes a volume should have.
fn steps(header: &Header, kept: &[usize], warnings: &mut Vec<String>) -> Result<[DVec3; 3], HeaderError> {
    let spacing = |axis: usize| header.spacings.as_ref().map(|s| s[axis]).filter(|s| !s.is_nan());
    let mut steps = Vec::with_capacity(3);
    let mut num_missing = 0;
    for (i, &axis) in kept.iter().enumerate() {
        let direction = header.directions.as_ref().and_then(|d| d[axis]);
        steps.push(match (direction, spacing(axis)) {
            (Some(direction), spacing) => {
                let step = match header.space {
                    Space::Anatomical(signs) => DVec3::from(direction) * DVec3::from(signs),
                    Space::Cartesian(z) => DVec3::from(direction) * DVec3::new(1.0, 1.0, z),
                };
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
        warnings.push(format!("{num_missing} axes have no spacing; it was taken as 1"));
    }
    if let [a, b] = steps[..] {
        let normal = a.cross(b).normalize_or(DVec3::Z);
        steps.push(normal * a.length().min(b.length()));
    }
    if header.directions.is_some() && header.space == Space::Cartesian(-1.0) {
        warnings.push("the space is left-handed; its third axis was reversed".to_owned());
    }
    let what = || format!("steps between voxels are {steps:?}, expected finite lengths above zero");
    <[DVec3; 3]>::try_from(steps.as_slice())
        .ok()
        .filter(|s| s.iter().all(|v| v.length().is_finite() && v.length() > 0.0))
        .ok_or_else(|| HeaderError::Contradiction(what()))
}

/// For x, y and z the axis of the file that points nearest to it or away from it: of the six assignments the one
/// with the largest sum of cosines.
fn order(steps: [DVec3; 3]) -> Result<[(usize, bool); 3], HeaderError> {
    let units = steps.map(DVec3::normalize);
    if units[0].dot(units[1].cross(units[2])).abs() < MIN_BOX_VOLUME {
        let what = "\"space directions\" lie in one plane, expected three independent directions";
        return Err(HeaderError::Contradiction(what.into()));
    }
    let score = |p: &[usize; 3]| (0..3).map(|k| units[p[k]][k].abs()).sum::<f64>();
    // The order of the file comes last: of equal scores `max_by` takes the last.
    const ASSIGNMENTS: [[usize; 3]; 6] = [[2, 1, 0], [2, 0, 1], [1, 2, 0], [1, 0, 2], [0, 2, 1], [0, 1, 2]];
    let best = ASSIGNMENTS.iter().max_by(|a, b| score(a).total_cmp(&score(b))).expect("there are six");
    Ok(std::array::from_fn(|k| (best[k], units[best[k]][k] < 0.0)))
}

/// The unit of length, if all axes have the same.
fn unit(header: &Header, kept: &[usize], warnings: &mut Vec<String>) -> Option<String> {
    let units: Vec<&String> = match (&header.space_units, &header.units) {
        (Some(units), _) => units.iter().take(3).collect(),
        (None, Some(units)) => kept.iter().map(|&axis| &units[axis]).collect(),
        (None, None) => return None,
    };
    let first = *units.first()?;
    if units.iter().any(|u| *u != first) {
        warnings.push("the axes have different units; spacings are taken as they are".to_owned());
        return None;
    }
    let is_name = !first.is_empty() && first != "???" && first != "none";
    is_name.then(|| first.chars().filter(|c| !c.is_control()).take(MAX_UNIT_CHARS).collect())
}

const FILE_ORDER: [(usize, bool); 3] = [(0, false), (1, false), (2, false)];
const BODY_LETTERS: [[&str; 2]; 3] = [["R", "L"], ["A", "P"], ["S", "I"]];
const SPACE_LETTERS: [[&str; 2]; 3] = [["+x", "-x"], ["+y", "-y"], ["+z", "-z"]];
/// Below one degree a turn cannot be seen, and many scanners report such.
const MAX_TILT_DEG: f64 = 1.0;
/// Directions whose unit box is flatter than this are taken for dependent.
const MIN_BOX_VOLUME: f64 = 0.01;
/// Longest name of a unit that is kept.
const MAX_UNIT_CHARS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(fields: &str) -> Result<Grid, HeaderError> {
        let text = format!("NRRD0005\ntype: uint8\nencoding: raw\n{fields}\n\n");
        Grid::of(&Header::read(&mut text.as_bytes()).unwrap())
    }

    /// Voxels of a 4×3×2 file numbered in the order of the file.
    fn reordered(directions: &str) -> (Grid, Vec<u8>) {
        let g = grid(&format!("dimension: 3\nsizes: 4 3 2\n{directions}")).unwrap();
        let v = g.reorder_vec((0..24).collect());
        (g, v)
    }

    /// The law: a voxel keeps its place in space. Each is looked up by the position it had in the file.
    #[test]
    fn every_assignment_of_axes_keeps_every_voxel_in_place() {
        let lengths = [1.5, 2.0, 3.0];
        let file = [4usize, 3, 2];
        for p in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
            for signs in 0..8 {
                // Axis k of the file runs along axis p[k] of the space.
                let is_negative = |k: usize| signs >> k & 1 == 1;
                let vector = |k: usize| {
                    let step = DVec3::AXES[p[k]] * lengths[p[k]] * if is_negative(k) { -1.0 } else { 1.0 };
                    format!("({},{},{})", step.x, step.y, step.z)
                };
                let vectors: Vec<String> = (0..3).map(vector).collect();
                let (g, v) = reordered(&format!("space: RAS\nspace directions: {}", vectors.join(" ")));
                assert_eq!(g.spacing.to_array(), lengths.map(|l| l as f32), "{vectors:?}");
                let dims = g.dims().map(|d| d as usize);
                for i in 0..24 {
                    let at = [i % file[0], i / file[0] % file[1], i / file[0] / file[1]];
                    let mut to = [0; 3];
                    for k in 0..3 {
                        to[p[k]] = if is_negative(k) { file[k] - 1 - at[k] } else { at[k] };
                    }
                    assert_eq!(v[(to[2] * dims[1] + to[1]) * dims[0] + to[0]], i as u8, "{vectors:?}");
                }
            }
        }
    }

    #[test]
    fn a_body_is_never_mirrored() {
        let identity = "space directions: (1,0,0) (0,1,0) (0,0,1)";
        for (space, flips) in
            [("RAS", [false; 3]), ("LPS", [true, true, false]), ("LAS", [true, false, false])]
        {
            let (g, _) = reordered(&format!("space: {space}\n{identity}"));
            assert_eq!(g.order.map(|o| o.1), flips, "{space}");
            assert_eq!(g.orientation.as_deref(), Some("RAS"));
            assert_eq!(g.warnings.len(), usize::from(space != "RAS"));
        }
        let (g, _) = reordered(&format!("space: 3D-left-handed\n{identity}"));
        assert_eq!((g.order[2], g.orientation), ((2, true), None));
        let (g, _) = reordered("spacings: 1 -2 3");
        assert_eq!((g.order[1], g.spacing), ((1, true), Vec3::new(1.0, 2.0, 3.0)));
        let (g, _) = reordered("space: LPS\nspace directions: (0,0,-3) (2,0,0) (0,1,0)");
        assert_eq!(g.spacing, Vec3::new(2.0, 1.0, 3.0));
        assert_eq!(g.warnings, ["the axes of the file point to ILP; the voxels were reordered to RAS"]);
    }

    #[test]
    fn turns_and_shears_are_reported_from_one_degree() {
        let turned = |deg: f64| {
            let (s, c) = deg.to_radians().sin_cos();
            reordered(&format!("space: RAS\nspace directions: ({c},{s},0) ({},{c},0) (0,0,1)", -s)).0
        };
        assert!(turned(0.9).warnings.is_empty());
        assert_eq!(
            turned(12.3).warnings,
            ["the axes are turned by up to 12.3° from their space, which is not shown"]
        );
        // A unit length survives the turn: 1e-6 is the rounding of a single-precision length.
        assert!((turned(12.3).spacing - Vec3::ONE).length() < 1e-6);
        let (g, _) = reordered("space: RAS\nspace directions: (1,0,0) (0.2,1,0) (0,0,1)");
        assert!(g.warnings[1].contains("right angles"), "{:?}", g.warnings);
    }

    #[test]
    fn other_than_three_axes() {
        let g = grid("dimension: 4\nsizes: 1 4 3 2\nspacings: nan 1 2 3\nkinds: vector domain domain domain");
        assert_eq!(g.unwrap().file_dims, [4, 3, 2]);
        let g = grid(
            "dimension: 4\nsizes: 4 3 2 1\nspace: RAS-time\nspace directions: (1,0,0,0) (0,1,0,0) (0,0,2,0) none",
        );
        assert_eq!(g.unwrap().spacing, Vec3::new(1.0, 1.0, 2.0));
        let g = grid("dimension: 2\nsizes: 4 3\nspacings: 2 2").unwrap();
        assert_eq!((g.dims(), g.spacing), ([4, 3, 1], Vec3::splat(2.0)));
        for (wrong, what) in [
            (
                "dimension: 4\nsizes: 3 4 3 2\nkinds: RGB-color domain domain domain",
                "3 values for each voxel",
            ),
            ("dimension: 4\nsizes: 5 4 3 2", "5 4 3 2 are no volume"),
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
    fn units_are_kept_when_they_agree() {
        let unit = |line: &str| reordered(line).0.unit;
        assert_eq!(unit("units: \"mm\" \"mm\" \"mm\"").as_deref(), Some("mm"));
        let directions = "space directions: (1,0,0) (0,1,0) (0,0,1)";
        assert_eq!(
            unit(&format!("space: RAS\nspace units: \"mm\" \"mm\" \"mm\"\n{directions}")).as_deref(),
            Some("mm")
        );
        assert_eq!(unit("units: \"mm\" \"mm\" \"cm\""), None);
    }
}
