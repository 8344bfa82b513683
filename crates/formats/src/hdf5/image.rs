//! An image whose levels, points in time and channels are arrays of their own.

use std::path::Path;

use glam::DVec3;
use isinglass_core::volume::MAX_CHANNELS;

use crate::dtype::Dtype;
use crate::error::FormatError;
use crate::levels::LevelGrid;
use crate::outline::Level;
use crate::plan::{Axis, Plan, Role};
use crate::pyramid;
use crate::source::OpenOptions;
use crate::warning::WarningKind;

/// An image of several arrays.
#[derive(Clone)]
pub(super) struct ArrayImage {
    /// The plan of the finest level. Its last two axes are the channels and the points in time.
    plan: Plan,
    levels: Vec<PartLevel>,
    names: PartNames,
}

/// A level of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PartLevel {
    /// Voxels along the axes of the file in space, the fastest first.
    pub(super) dims: [u64; 3],
    /// Voxels of the finest level from one voxel to the next. All levels have the corners of the finest.
    pub(super) step: [f64; 3],
}

/// The paths of the arrays of an image.
#[derive(Clone, Debug)]
pub(super) enum PartNames {
    /// The numbers in the names of the levels, points in time and channels below `root`.
    Imaris { root: String, levels: Vec<u32>, times: Vec<u32>, channels: Vec<u32> },
    /// The numbers of the levels, points in time and setups.
    BigDataViewer { levels: Vec<u32>, times: Vec<u32>, setups: Vec<u32> },
    /// Those of the first level, by point in time and then by channel, and so on for each level.
    Paths { paths: Vec<String>, num_times: usize, num_channels: usize },
}

impl PartNames {
    /// The array of a level, a point in time and a channel, each counted from 0.
    pub(super) fn path(&self, level: usize, time: usize, channel: usize) -> String {
        let number = |numbers: &[u32], i: usize| numbers.get(i).copied().unwrap_or(u32::MAX);
        match self {
            Self::Imaris { root, levels, times, channels } => format!(
                "/{root}/ResolutionLevel {}/TimePoint {}/Channel {}/Data",
                number(levels, level),
                number(times, time),
                number(channels, channel)
            ),
            Self::BigDataViewer { levels, times, setups } => {
                let (time, setup) = (number(times, time), number(setups, channel));
                format!("/t{time:05}/s{setup:02}/{}/cells", number(levels, level))
            }
            Self::Paths { paths, num_times, num_channels } => {
                paths.get((level * num_times + time) * num_channels + channel).cloned().unwrap_or_default()
            }
        }
    }

    /// The type that the numbers of the arrays have, which are stored as `stored`.
    pub(super) fn dtype(&self, stored: Dtype) -> Dtype {
        match (self, stored) {
            // Java has no numbers of 16 bits without sign.
            (Self::BigDataViewer { .. }, Dtype::Int16) => Dtype::Uint16,
            _ => stored,
        }
    }
}

impl ArrayImage {
    /// The image with the plan of an array, which gets the axes of channels and times. `levels` has the finest first.
    pub(super) fn new(
        mut plan: Plan,
        (num_channels, num_times): (usize, usize),
        levels: Vec<PartLevel>,
        names: PartNames,
    ) -> Self {
        plan.axes.push(Axis { size: num_channels as u64, role: Role::Channel });
        plan.axes.push(Axis { size: num_times as u64, role: Role::Time });
        if levels.len() > 1 {
            let spacing = plan.geometry.steps.map(|step| step.length());
            let level = |level: &PartLevel| Level {
                dims: level.dims,
                spacing: [0, 1, 2].map(|i| spacing[i] * level.step[i]),
            };
            plan.levels = levels.iter().map(level).collect();
        }
        Self { plan, levels, names }
    }

    /// The same image, whose channels are parts of one picture.
    pub(super) fn with_joint_channels(mut self) -> Self {
        self.plan.join_channels();
        self
    }

    /// The same image as one of `series`, of which `usual` is shown by default. The warning says that it was chosen.
    pub(super) fn with_series(mut self, series: Vec<String>, usual: usize, warning: Option<String>) -> Self {
        (self.plan.series, self.plan.usual_series) = (series, usual as u32);
        warning.into_iter().for_each(|text| self.plan.warn(WarningKind::Choice, text));
        self
    }

    /// Voxels of the finest level.
    pub(super) fn num_voxels(&self) -> u64 {
        self.levels[0].dims.iter().fold(1, |n, side| n.saturating_mul(*side))
    }

    pub(super) fn names(&self) -> &PartNames {
        &self.names
    }

    pub(super) fn num_levels(&self) -> usize {
        self.levels.len()
    }

    /// The level that the options select, or that fits.
    pub(super) fn level(&self, path: &Path, options: &OpenOptions) -> Result<usize, FormatError> {
        let num_channels = match options.selection.channel {
            Some(_) => 1,
            None => self.plan.num_joint.clamp(1, MAX_CHANNELS as u64),
        };
        let dims: Vec<[u64; 3]> = self.levels.iter().map(|level| level.dims).collect();
        pyramid::level_to_show(path, &dims, num_channels, self.plan.dtype, options)
    }

    /// The plan of a level.
    pub(super) fn plan(&self, level: usize) -> Plan {
        let mut plan = self.plan.clone();
        let PartLevel { dims, step } = self.levels[level];
        for axis in &mut plan.axes {
            if let Role::Space(i) = axis.role {
                axis.size = dims[i];
            }
        }
        plan.level = level;
        if level == 0 {
            return plan;
        }
        let first = step.map(|step| (step - 1.0) / 2.0);
        let geometry = &mut plan.geometry;
        let shift: DVec3 = (0..3).map(|i| geometry.steps[i] * first[i]).sum();
        geometry.origin = geometry.origin.map(|origin| origin + shift);
        (0..3).for_each(|i| geometry.steps[i] *= step[i]);
        let in_finest = LevelGrid { finest_dims: self.levels[0].dims, step, first };
        pyramid::put_in_finest(&mut plan, in_finest);
        plan
    }
}
