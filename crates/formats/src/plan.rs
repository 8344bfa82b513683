//! The contents of a header in the terms of all formats, and the selection of a volume.

use std::ops::Range;
use std::path::{Path, PathBuf};

use isinglass_core::volume::{MAX_CHANNELS, Volume, VolumeLabel};

use crate::axes::{Geometry, Grid};
use crate::collector::Collector;
use crate::decode::VoxelSink;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, malformed, shown};
use crate::hyperslab::Steps;
use crate::levels::{InFinest, LevelGrid};
use crate::outline::{Level, Outline};
use crate::padding::Missing;
use crate::selection::Selection;
use crate::source::{OpenOptions, file_name};
use crate::warning::{Warning, WarningKind};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Axis {
    pub(crate) size: u64,
    pub(crate) role: Role,
}

/// The meaning of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// The first, second or third spatial axis, the fastest first. Each occurs once.
    Space(usize),
    Channel,
    Time,
    /// The reader itself selects this entry.
    Picked(u64),
    /// The axis has one entry and no meaning.
    Single,
}

impl Axis {
    /// Three spatial axes, the fastest first.
    pub(crate) fn in_space(dims: [u64; 3]) -> Vec<Self> {
        dims.into_iter().enumerate().map(|(i, size)| Self { size, role: Role::Space(i) }).collect()
    }
}

/// What a file says that an axis is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum AxisKind {
    /// The axis x, y or z.
    Space(usize),
    Channel,
    Time,
}

#[derive(Clone, Debug)]
pub(crate) struct Plan {
    /// Name and variant of the format, such as `NIfTI-1, gzip`.
    pub(crate) format: String,
    pub(crate) dtype: Dtype,
    pub(crate) endian: Endian,
    /// The axes of the numbers, the fastest first. An axis along which the reader selects may be missing.
    pub(crate) axes: Vec<Axis>,
    pub(crate) geometry: Geometry,
    /// Slope and intercept that turn numbers into values.
    pub(crate) value_map: (f64, f64),
    /// Names of the channels, as far as they are known.
    pub(crate) channel_names: Vec<String>,
    /// Number of channels if no axis has them.
    pub(crate) num_channels: u64,
    pub(crate) channel: u64,
    /// How many of the first channels are parts of one picture, to be shown together. One if they are other things,
    /// such as components of a vector.
    pub(crate) num_joint: u64,
    /// How the file shows each channel, as far as it says so.
    pub(crate) channel_looks: Vec<ChannelLook>,
    /// Number of points in time if no axis has them.
    pub(crate) num_times: u64,
    /// Time from one point in time to the next, seconds, from [`crate::units::time_step`].
    pub(crate) time_step: Option<f64>,
    /// Levels of a pyramid, finest first; empty if there is one.
    pub(crate) levels: Vec<Level>,
    pub(crate) level: usize,
    /// How the selected level lies in the finest one; `None` if it is the finest.
    pub(crate) in_finest: Option<LevelGrid>,
    /// Descriptions of the series of a folder; empty if there is only one.
    pub(crate) series: Vec<String>,
    pub(crate) usual_series: u32,
    pub(crate) modality: Option<String>,
    /// Unit of the values, from [`crate::units::value_unit`].
    pub(crate) value_unit: Option<String>,
    /// Whether the file says that its values are labels.
    pub(crate) are_labels: bool,
    /// What the labels mean, if the file says so.
    pub(crate) labels: Vec<VolumeLabel>,
    /// The warning if neither the file nor the options have a spacing.
    pub(crate) spacing_guess: Option<String>,
    /// The values that stand for none, as far as the file tells them.
    pub(crate) missing: Missing,
    /// Whether a float that is not a number is a voxel without a value. In a raw file, it hints at a wrong type
    /// instead.
    pub(crate) has_gaps: bool,
    pub(crate) warnings: Vec<Warning>,
}

impl Plan {
    /// A plan with one channel at one time, and values equal to the numbers.
    pub(crate) fn new(
        format: impl Into<String>,
        dtype: Dtype,
        endian: Endian,
        axes: Vec<Axis>,
        geometry: Geometry,
    ) -> Self {
        Self {
            format: format.into(),
            dtype,
            endian,
            axes,
            geometry,
            value_map: (1.0, 0.0),
            channel_names: Vec::new(),
            num_channels: 1,
            channel: 0,
            num_joint: 1,
            channel_looks: Vec::new(),
            num_times: 1,
            time_step: None,
            levels: Vec::new(),
            level: 0,
            in_finest: None,
            series: Vec::new(),
            usual_series: 0,
            modality: None,
            value_unit: None,
            are_labels: false,
            labels: Vec::new(),
            spacing_guess: None,
            missing: Missing::default(),
            has_gaps: true,
            warnings: Vec::new(),
        }
    }

    pub(crate) fn warn(&mut self, kind: WarningKind, text: impl Into<String>) {
        self.warnings.push(Warning::new(kind, text));
    }

    /// Notes the descriptions of the arrays of a file, if there are several. `chosen` is the one that the user chose.
    pub(crate) fn set_series(&mut self, names: Vec<String>, usual: usize, chosen: Option<u32>) {
        if names.len() < 2 {
            return;
        }
        if chosen.is_none() {
            let text = format!(
                "the file has {} arrays, of which the largest is shown: {}",
                names.len(),
                names[usual]
            );
            self.warn(WarningKind::Choice, text);
        }
        (self.series, self.usual_series) = (names, usual as u32);
    }

    /// Makes the channels the colours of a picture: red, green, blue and perhaps opacity, which is not shown with them.
    pub(crate) fn set_colors(&mut self) {
        let n = self.channels();
        self.channel_names = ["red", "green", "blue", "alpha"]
            .into_iter()
            .zip(0..n)
            .map(|(name, _)| name.to_owned())
            .collect();
        let pure = [[255, 0, 0], [0, 255, 0], [0, 0, 255]];
        let window = match self.dtype {
            Dtype::Uint8 | Dtype::Uint16 => self.dtype.integer_range(),
            _ => None,
        };
        let look = |color| ChannelLook { window, color: Some(color), is_hidden: false };
        self.channel_looks = pure.map(look).to_vec();
        self.num_joint = n.min(3);
    }

    /// Makes all channels parts of one picture. A colour that all have says nothing.
    pub(crate) fn join_channels(&mut self) {
        self.num_joint = self.channels();
        let colors = || self.channel_looks.iter().map(|look| look.color);
        if colors().count() > 1 && colors().all(|color| color == self.channel_looks[0].color) {
            self.channel_looks.iter_mut().for_each(|look| look.color = None);
        }
    }

    /// Entries along the axis with this role; 1 if there is no such axis.
    pub(crate) fn size(&self, role: Role) -> u64 {
        self.axes.iter().find(|a| a.role == role).map_or(1, |a| a.size)
    }

    /// How many channels the file has.
    pub(crate) fn channels(&self) -> u64 {
        self.size(Role::Channel).max(self.num_channels)
    }

    /// How many points in time it has.
    pub(crate) fn times(&self) -> u64 {
        self.size(Role::Time).max(self.num_times)
    }

    /// Names of the channels, up to the limit of a list.
    fn names(&self) -> Vec<String> {
        let num_shown = self.channels().min(MAX_LISTED) as usize;
        (0..num_shown)
            .map(|i| {
                self.channel_names.get(i).filter(|n| !n.is_empty()).cloned().unwrap_or_else(|| i.to_string())
            })
            .collect()
    }

    /// How many numbers the file holds; `None` if their bytes overflow.
    fn num_elements(&self) -> Option<u64> {
        let count = self.axes.iter().try_fold(1u64, |n, a| n.checked_mul(a.size))?;
        count.checked_mul(self.dtype.num_bytes() as u64).map(|_| count)
    }

    /// Numbers in the file, voxels along its axes, and where these lie as the options want it.
    fn shape(&self, options: &OpenOptions) -> Result<(u64, [u64; 3], Geometry), String> {
        let file_dims = [0, 1, 2].map(|i| self.size(Role::Space(i)));
        let in_file = self.num_elements().filter(|&n| n > 0).ok_or_else(|| {
            let sizes: Vec<String> = self.axes.iter().map(|a| a.size.to_string()).collect();
            format!("sizes {} are zero or too large", sizes.join(" "))
        })?;
        let geometry = match options.spacing {
            Some(spacing) => self.geometry.with_spacing(spacing)?,
            None => self.geometry.clone(),
        };
        Ok((in_file, file_dims, geometry.flipped(options.selection.flip.0, file_dims)?))
    }

    /// Distances between voxels along the axes of the file, as the options want them.
    pub(crate) fn spacing_of(&self, options: &OpenOptions) -> Result<[f64; 3], String> {
        Ok(self.shape(options)?.2.steps.map(|step| step.length()))
    }

    /// All voxels, channels and times, or those that the options select. No limit of memory counts.
    pub(crate) fn choose_all(&self, path: &Path, options: &OpenOptions) -> Result<Chosen, FormatError> {
        let bad = malformed(path, &self.format);
        let selection = options.selection;
        let (in_file, file_dims, geometry) = self.shape(options).map_err(bad)?;
        let grid = Grid::whole(file_dims, &geometry, selection.region.as_ref()).map_err(bad)?;
        let entries = |what: &'static str, found: u64, asked: Option<u32>| match asked.map(u64::from) {
            Some(index) if index >= found => {
                Err(FormatError::Selection { path: shown(path), what, asked: index, found })
            }
            Some(index) => Ok(index..index + 1),
            None => Ok(0..found),
        };
        let channels = entries("channel", self.channels(), selection.channel)?;
        let times = entries("time", self.times(), selection.time)?;
        let selected = self.axes.iter().map(|axis| {
            Steps::all(match axis.role {
                Role::Space(i) => grid.ranges[i].clone(),
                Role::Channel => channels.clone(),
                Role::Time => times.clone(),
                Role::Picked(i) => i..i + 1,
                Role::Single => 0..axis.size,
            })
        });
        let selected: Vec<Steps> = selected.collect();
        let num_voxels = selected.iter().map(Steps::len).product();
        let memory = Memory { num_voxels, dtype: self.dtype, is_permuted: false };
        let warnings = [&self.warnings[..], &grid.warnings[..]].concat();
        let channels = channels.start as u32..channels.end as u32;
        let time = times.start as u32;
        let in_finest = None;
        Ok(Chosen { memory, grid, in_finest, channels, time, selected, num_voxels, in_file, warnings })
    }

    /// The part that the options select.
    pub(crate) fn choose(&self, path: &Path, options: &OpenOptions) -> Result<Chosen, FormatError> {
        self.choose_within(path, options, u64::from(Volume::MAX_SIDE))
    }

    /// The same, with sides of at most `max_side` voxels.
    pub(crate) fn choose_within(
        &self,
        path: &Path,
        options: &OpenOptions,
        max_side: u64,
    ) -> Result<Chosen, FormatError> {
        let bad = malformed(path, &self.format);
        let selection = options.selection;
        let (in_file, file_dims, geometry) = self.shape(options).map_err(bad)?;
        let thin = options.reading.thin.unwrap_or(1);
        let grid = Grid::arrange(file_dims, &geometry, selection.region.as_ref(), thin, max_side);
        let mut grid = grid.map_err(bad)?;
        let in_finest = self.in_finest.as_ref().map(|level| level.place(&mut grid, selection.flip.0));
        let mut warnings = [&self.warnings[..], &grid.warnings[..]].concat();
        if let Some(text) = self.spacing_guess.as_ref().filter(|_| options.spacing.is_none()) {
            warnings.insert(0, Warning::new(WarningKind::Guess, text.clone()));
        }
        // The product is at most 2048³.
        let num_voxels = grid.dims().iter().map(|&d| u64::from(d)).product::<u64>();
        let num_channels = self.channels();
        let most_joint = MAX_CHANNELS as u64 - u64::from(options.reading.labels.is_some());
        let num_joint = self.num_joint.min(num_channels).min(most_joint);
        let listed = self.channel_names.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join(", ");
        let listed = if listed.is_empty() { String::new() } else { format!(" ({listed})") };
        let mut pick = |what: &'static str, found: u64, asked: Option<u32>, usual: u64, more: &str| {
            let index = asked.map_or(usual, u64::from);
            if index >= found {
                return Err(FormatError::Selection { path: shown(path), what, asked: index, found });
            }
            if asked.is_none() && found > 1 {
                let listed = if what == "channel" { &listed[..] } else { "" };
                let text = format!("the file has {found} {what}s{listed}, of which {index} is shown{more}");
                warnings.push(Warning::new(WarningKind::Choice, text));
            }
            Ok(index)
        };
        let memory = Memory { num_voxels, dtype: self.dtype, is_permuted: grid.is_permuted() };
        let together = memory.needed(num_joint);
        let is_joint = num_joint > 1 && selection.channel.is_none();
        let channels = if is_joint && together <= options.max_bytes {
            0..num_joint
        } else {
            let more = match is_joint {
                true => format!("; all together need {together} of {} bytes of memory", options.max_bytes),
                false => String::new(),
            };
            let channel = pick("channel", num_channels, selection.channel, self.channel, &more)?;
            channel..channel + 1
        };
        let time = pick("time", self.times(), selection.time, 0, "")?;
        if let Some(level) = selection.level {
            pick("level", self.levels.len().max(1) as u64, Some(level), 0, "")?;
        }
        if let Some(series) = selection.series {
            pick("series", self.series.len().max(1) as u64, Some(series), 0, "")?;
        }
        if channels.end - channels.start > 1 && channels.end < num_channels {
            let n = channels.end;
            let text =
                format!("the file has {num_channels} channels{listed}, of which the first {n} are shown");
            warnings.push(Warning::new(WarningKind::Choice, text));
        }
        let mut selected = self.steps(&grid, channels.clone(), time);
        if let Some(first) = self.axes.first().filter(|axis| axis.role == Role::Channel)
            && channels.end - channels.start > 1
        {
            // Single numbers are skipped more slowly than read.
            selected[0] = Steps::all(0..first.size);
        }
        let (channels, time) = (channels.start as u32..channels.end as u32, time as u32);
        options.check_memory(path, memory.needed(channels.len() as u64))?;
        Ok(Chosen { memory, grid, in_finest, channels, time, selected, num_voxels, in_file, warnings })
    }

    /// The numbers of a grid along each axis, for some channels and a time.
    pub(crate) fn steps(&self, grid: &Grid, channels: Range<u64>, time: u64) -> Vec<Steps> {
        let steps = self.axes.iter().map(|axis| {
            Steps::all(match axis.role {
                Role::Space(i) => return Steps { range: grid.ranges[i].clone(), step: grid.thin[i] },
                Role::Channel => channels.clone(),
                Role::Time => time..time + 1,
                Role::Picked(i) => i..i + 1,
                Role::Single => 0..axis.size,
            })
        });
        steps.collect()
    }

    /// The outline of the file with the selected part.
    pub(crate) fn outline(&self, path: &Path, chosen: &Chosen, options: &OpenOptions) -> Outline {
        let grid = &chosen.grid;
        let level = options.selection.level.unwrap_or(self.level as u32);
        Outline {
            shown: Selection {
                channel: (chosen.channels.len() == 1).then_some(chosen.channels.start),
                time: Some(chosen.time),
                level: Some(level),
                series: Some(options.selection.series.unwrap_or(self.usual_series)),
                region: options.selection.region,
                flip: options.selection.flip,
            },
            name: file_name(path),
            format: self.format.clone(),
            dtype: self.dtype.name().to_owned(),
            dims: grid.dims(),
            spacing: grid.spacing.to_array(),
            unit: self.geometry.unit.clone(),
            orientation: grid.orientation.clone(),
            file_axes: grid.file_axes(),
            whole_dims: grid.whole_dims(),
            channels: if self.channels() > 1 || !self.channel_names.is_empty() {
                self.names()
            } else {
                Vec::new()
            },
            num_channels: self.channels(),
            joins_channels: self.num_joint.min(self.channels()) > 1,
            num_times: self.times(),
            time_step: self.time_step.filter(|_| self.times() > 1),
            levels: self.levels.clone(),
            level,
            series: self.series.clone(),
            modality: self.modality.clone(),
            value_unit: self.value_unit.clone(),
            are_labels: self.are_labels || !self.labels.is_empty(),
            labels: self.labels.clone(),
            center: grid.placement.map(|p| p.center),
            directions: grid.placement.map(|p| p.axes),
            bytes_in_memory: chosen.memory.when_read(chosen.channels.len() as u64),
            bytes_while_reading: chosen.memory.while_reading(chosen.channels.len() as u64),
            pages: None,
            warnings: chosen.warnings.clone(),
        }
    }
}

/// The selected part of a file.
#[derive(Clone, Debug)]
pub(crate) struct Chosen {
    pub(crate) grid: Grid,
    /// The part in the finest level; `None` if it is a part of that.
    pub(crate) in_finest: Option<InFinest>,
    pub(crate) memory: Memory,
    /// The channels to read, one or several.
    pub(crate) channels: Range<u32>,
    pub(crate) time: u32,
    /// The selection along each axis of the plan.
    pub(crate) selected: Vec<Steps>,
    /// Voxels of a channel.
    pub(crate) num_voxels: u64,
    /// Numbers in the whole file. Their bytes fit into 64 bits.
    pub(crate) in_file: u64,
    pub(crate) warnings: Vec<Warning>,
}

/// The memory of channels on one grid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Memory {
    pub(crate) num_voxels: u64,
    pub(crate) dtype: Dtype,
    /// Whether the file has its axes in another order.
    pub(crate) is_permuted: bool,
}

impl Memory {
    fn of_channel(self) -> u64 {
        self.num_voxels.saturating_mul(self.dtype.num_bytes_in_memory() as u64)
    }

    /// Bytes of the volume. The brightness of each voxel takes one byte more, as in [`Volume::bytes_in_memory`].
    fn when_read(self, num_channels: u64) -> u64 {
        self.of_channel().saturating_mul(num_channels).saturating_add(self.num_voxels)
    }

    /// Bytes during reading. One channel after the other is reordered.
    fn while_reading(self, num_channels: u64) -> u64 {
        self.of_channel().saturating_mul(num_channels + u64::from(self.is_permuted))
    }

    /// The larger of both.
    pub(crate) fn needed(self, num_channels: u64) -> u64 {
        self.when_read(num_channels).max(self.while_reading(num_channels))
    }
}

/// How a file shows a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ChannelLook {
    /// The values that are shown darkest and brightest.
    pub(crate) window: Option<(f64, f64)>,
    /// Its colour, sRGB.
    pub(crate) color: Option<[u8; 3]>,
    pub(crate) is_hidden: bool,
}

/// A file whose header was read.
pub(crate) trait VolumeFile {
    fn plan(&self) -> &Plan;

    /// Whether the file consists of chunks, whose numbers [`VolumeFile::read`] places in any order. A part is then read
    /// at no cost of the rest.
    fn is_chunked(&self) -> bool {
        false
    }

    /// Passes the selected voxels to `collector`, in the order of the file.
    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError>;

    /// Files and folders beside the one that was opened whose change changes the voxels.
    fn data_files(&self) -> Vec<PathBuf> {
        Vec::new()
    }

    /// Readers of boxes of its levels, finest first.
    ///
    /// # Errors
    /// Its numbers can only be read one after the other.
    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        Err(FormatError::NotPaged { path: shown(path), found: self.plan().format.clone() })
    }

    /// The finest level of the pyramid, if this is another one.
    fn finest_level(&self) -> Option<Box<dyn VolumeFile>> {
        None
    }
}

/// A level whose boxes can be read in any order.
pub(crate) struct BoxLevel {
    pub(crate) plan: Plan,
    pub(crate) reader: Box<dyn BoxReader>,
}

/// Reads boxes of an array of numbers, on several threads at once.
pub(crate) trait BoxReader: Send + Sync {
    /// The numbers that are selected along each axis of the plan, the fastest first.
    fn read(&self, selected: &[Steps]) -> Result<VoxelSink, FormatError>;

    /// The same in the type of the file, little-endian. A reader that does not have its bytes gives wide numbers as exact
    /// as single precision is.
    fn read_numbers(&self, selected: &[Steps]) -> Result<Vec<u8>, FormatError> {
        self.read(selected).map(VoxelSink::into_numbers)
    }

    /// Parts of the file that are not there and have their fill value, as far as they were met.
    fn num_absent(&self) -> u64 {
        0
    }

    /// A warning about parts of the file that are not there, if that can be told without reading them.
    fn absence(&self) -> Option<String> {
        None
    }

    /// A word about what reading a page costs, if that is much.
    fn cost(&self) -> Option<String> {
        None
    }
}

/// Most channels in a list.
const MAX_LISTED: u64 = 256;
/// Most channels in a warning.
const MAX_NAMED: usize = 8;
