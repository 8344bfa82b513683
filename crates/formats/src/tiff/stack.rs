//! What the planes of a TIFF mean: their axes, sizes and looks, and the plan of the volume.

use super::PageLocation;
use super::page::{Group, PageShape};
use crate::axes::Geometry;
use crate::dtype::{Dtype, Endian};
use crate::plan::{Axis, ChannelLook, Plan, Role};
use crate::warning::WarningKind;

/// The meaning of the planes.
pub(super) struct Stack {
    /// Axes of the planes and their sizes, the fastest first.
    pub(super) axes: Vec<(PlaneAxis, u64)>,
    /// Distances along x, y and z, as far as they are known.
    pub(super) spacing: [Option<f64>; 3],
    pub(super) unit: Option<String>,
    pub(super) channel_names: Vec<String>,
    pub(super) channel_looks: Vec<ChannelLook>,
    /// Whether the description calls its channels so. Otherwise, an axis is taken for one.
    pub(super) has_channels: bool,
    /// The page of each plane, unless they are in order.
    pub(super) planes: Option<Vec<Option<PageLocation>>>,
    /// Descriptions of the series of the file; empty if there is only one.
    pub(super) series: Vec<String>,
    /// Slope and intercept that turn numbers into values.
    pub(super) value_map: (f64, f64),
    pub(super) value_unit: Option<String>,
    /// Seconds from one point in time to the next.
    pub(super) time_step: Option<f64>,
    /// A warning about assumed axes.
    pub(super) guess: Option<String>,
    pub(super) name: &'static str,
    /// How the planes are divided among files, after the name.
    pub(super) in_files: &'static str,
}

/// An axis of the planes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PlaneAxis {
    Z,
    Channel,
    Time,
}

impl PlaneAxis {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Z => "z",
            Self::Channel => "channels",
            Self::Time => "times",
        }
    }
}

impl Stack {
    /// Pages without a description are slices, from the first to the last.
    pub(super) fn plain(group: &Group) -> Self {
        let spacing = |i: usize| group.unit_mm.zip(group.resolution[i]).map(|(mm, pixels)| mm / pixels);
        Self {
            axes: vec![(PlaneAxis::Z, group.pages.len() as u64)],
            spacing: [spacing(0), spacing(1), None],
            unit: group.unit_mm.map(|_| "mm".to_owned()),
            channel_names: Vec::new(),
            channel_looks: Vec::new(),
            has_channels: false,
            planes: None,
            series: Vec::new(),
            value_map: (1.0, 0.0),
            value_unit: None,
            time_step: None,
            guess: None,
            name: "TIFF",
            in_files: "",
        }
    }

    /// Makes each of the `found` pages a slice, because the description has another number. Returns a warning.
    pub(super) fn read_as_slices(&mut self, num_planes: u64, found: usize) -> String {
        self.axes = vec![(PlaneAxis::Z, found as u64)];
        self.channel_names.clear();
        self.channel_looks.clear();
        format!("the description has {num_planes} planes, the file {found}; they are read as slices")
    }

    /// Number of planes along all axes.
    pub(super) fn num_planes(&self) -> Result<u64, String> {
        let num_planes = self.axes.iter().try_fold(1u64, |n, a| n.checked_mul(a.1));
        num_planes
            .filter(|n| (1..=MAX_PLANES).contains(n))
            .ok_or_else(|| format!("its description has {:?} planes, expected 1 to {MAX_PLANES}", self.axes))
    }
}

/// The plan of a stack whose numbers have this byte order.
pub(super) fn plan(group: &Group, stack: &mut Stack, endian: Endian) -> Result<Plan, String> {
    let PageShape { width, height, samples, is_planar, dtype, is_white } = group.shape;
    let samples = Axis { size: samples.into(), role: if samples > 1 { Role::Channel } else { Role::Single } };
    let mut axes = vec![
        Axis { size: width.into(), role: Role::Space(0) },
        Axis { size: height.into(), role: Role::Space(1) },
    ];
    axes.insert(if is_planar { 2 } else { 0 }, samples);
    for &(axis, size) in &stack.axes {
        let role = match axis {
            PlaneAxis::Z => Role::Space(2),
            PlaneAxis::Channel => Role::Channel,
            PlaneAxis::Time => Role::Time,
        };
        // A single channel beside samples has no meaning.
        let role = if size == 1 && role == Role::Channel { Role::Single } else { role };
        axes.push(Axis { size, role });
    }
    if !axes.iter().any(|a| a.role == Role::Space(2)) {
        axes.push(Axis { size: 1, role: Role::Space(2) });
    }
    if axes.iter().filter(|a| a.role == Role::Channel && a.size > 1).count() > 1 {
        return Err(format!(
            "{} samples a pixel in several channels, expected one or the other",
            group.shape.samples
        ));
    }
    let spacing = stack.spacing.map(|s| s.filter(|s| s.is_finite() && *s > 0.0));
    let in_plane = spacing[0].or(spacing[1]);
    let known = [in_plane, spacing[1].or(in_plane), spacing[2].or(in_plane)].map(|s| s.unwrap_or(1.0));
    let unit = stack.unit.take().filter(|_| in_plane.is_some());
    let geometry = Geometry::of_image(known, unit);
    let mut plan = Plan::new(format!("{}{}", stack.name, stack.in_files), dtype, endian, axes, geometry);
    plan.value_map = stack.value_map;
    plan.channel_names = std::mem::take(&mut stack.channel_names);
    if matches!(samples.size, 3 | 4) && plan.channel_names.len() as u64 != samples.size {
        plan.set_colors();
    } else if stack.has_channels {
        plan.channel_looks = std::mem::take(&mut stack.channel_looks);
        plan.join_channels();
    }
    plan.series = std::mem::take(&mut stack.series);
    if is_white {
        let ((slope, intercept), most) = (plan.value_map, greatest(dtype));
        plan.value_map = (-slope, slope * most + intercept);
        plan.warn(WarningKind::Values, "the least value is white (MinIsWhite); values were inverted");
    }
    if let Some(palette) = group.palette.as_ref().filter(|_| samples.size == 1) {
        palette.apply(&mut plan);
    }
    if let Some(text) = stack.guess.take() {
        plan.warn(WarningKind::Guess, text);
    }
    plan.value_unit = stack.value_unit.take();
    plan.time_step = stack.time_step;
    let depth = stack.axes.iter().find(|a| a.0 == PlaneAxis::Z).map_or(1, |a| a.1);
    plan.spacing_guess = match (in_plane, spacing[2]) {
        (None, _) => Some("the file has no spacing; it was taken as 1".into()),
        (Some(_), None) if depth > 1 => {
            Some("the distance of the slices is not in the file; it was taken as that of the pixels".into())
        }
        _ => None,
    };
    Ok(plan)
}

/// The number of white after inversion: the greatest of an integer type, 1 of floats.
fn greatest(dtype: Dtype) -> f64 {
    dtype.integer_range().map_or(1.0, |(_, most)| most)
}

/// Most planes of a volume with all its channels and times.
pub(super) const MAX_PLANES: u64 = 1 << 18;
