//! Arguments for a volume and a part of it, and opening it.

use std::sync::Arc;

use anyhow::{Context, Result, anyhow};
use clap::Args;
use clap::builder::{OsStringValueParser, TypedValueParser};
use glam::Vec3;
use isinglass_bench::progress::Progress;
use isinglass_core::volume::{Lighting, Volume};
use isinglass_formats::{
    Dtype, Endian, Flip, Meaning, OpenOptions, Outline, PageCount, PagedFile, RawShape, Reading, Region,
    Selection, VolumeFacts, VolumeSource, facts_at_once, open, open_paged, outline, page_count,
};
use isinglass_formats::{OpenedScene, open_scene};

use super::{LookArgs, Switch, usage_error};
use crate::library::{FileLoader, OpenedFile};
use crate::local::index_folder;
use crate::memory::MemoryArgs;

/// A volume, and the layout of a raw one.
#[derive(Args, Clone, Debug)]
pub(crate) struct VolumeArgs {
    /// A file or folder, also in gzip or ZIP: DICOM, NIfTI, NRRD, MetaImage, TIFF, OME-TIFF, OME-Zarr, VTK, MRC, MGH,
    /// NumPy, HDF5, NetCDF, Imaris or PNG. An array's path may follow that of an HDF5 file. OME-Zarr may be at http://, https:// or s3://. A raw file needs --dims and --dtype. Built in are builtin:cloud, builtin:cubus and
    /// builtin:shells, with @N for N voxels a side
    #[arg(value_name = "VOLUME", required = true, help_heading = None::<&'static str>, value_parser = any_text())]
    pub(crate) volume: Option<String>,
    #[command(flatten)]
    pub(crate) raw: RawArgs,
    #[command(flatten)]
    pub(crate) part: PartArgs,
}

impl VolumeArgs {
    pub(crate) fn source(&self) -> Result<&str> {
        self.volume.as_deref().context("expected VOLUME")
    }

    pub(crate) fn volume_source(&self) -> Result<VolumeSource> {
        let (source, raw, selection) = (self.source()?.to_owned(), self.raw.shape(), self.part.selection());
        let (spacing, foreign_files) = (self.part.spacing, self.part.has_foreign_files());
        let reading = self.part.reading();
        Ok(VolumeSource { source, raw, selection, spacing, foreign_files, reading })
    }

    /// The volume of a saved state; flags for another part or layout override it.
    pub(crate) fn in_state(&self, saved: VolumeSource) -> Self {
        let of_flags = self.part.selection();
        let VolumeSource { source, raw, selection: saved, spacing, foreign_files: _, reading } = saved;
        let Reading { stored_slices, voxels, thin, labels } = reading;
        let raw = raw.filter(|_| self.raw.shape().is_none());
        let part = PartArgs {
            channel: of_flags.channel.or(saved.channel),
            time: of_flags.time.or(saved.time),
            level: of_flags.level.or(saved.level),
            series: of_flags.series.or(saved.series),
            region: of_flags.region.or(saved.region),
            flip: self.part.flip.or(Some(saved.flip).filter(|flip| *flip != Flip::default())),
            foreign_files: self.part.foreign_files,
            stored_slices: if stored_slices { Switch::On } else { self.part.stored_slices },
            voxels: self.part.voxels.or(voxels),
            thin: self.part.thin.or(thin),
            labels: self.part.labels.clone().or(labels),
            spacing: self.part.spacing.or(spacing).or(raw.map(|r| r.spacing).filter(|s| *s != Vec3::ONE)),
        };
        let raw = raw.map_or_else(|| self.raw.clone(), |raw| RawArgs::of(&raw));
        Self { volume: Some(source), raw, part }
    }

    /// Opens the volume, after printing notes from its header; large files show their progress.
    pub(crate) fn open(&self) -> Result<(Volume, Outline)> {
        let source = self.source()?;
        let reading = self.part.reading();
        let options = self.options(&reading);
        let before = outline(source, &options)?;
        let volume = show_progress(&before, |progress| {
            open(source, &OpenOptions { progress: Some(progress), ..options })
        })?;
        Ok((volume, before))
    }

    /// Opens the volume within a limit of memory, by pages if it does not fit.
    pub(crate) fn open_to_draw(&self, memory: &MemoryArgs) -> Result<Volume> {
        let reading = self.part.reading();
        let options = OpenOptions { by_pages: true, max_bytes: memory.bytes(), ..self.options(&reading) };
        Ok(open(self.source()?, &options)?)
    }

    /// The same volume at another time.
    pub(crate) fn at_time(&self, time: u32) -> Self {
        Self { part: PartArgs { time: Some(time), ..self.part.clone() }, ..self.clone() }
    }

    /// The contents of the file, by its header.
    pub(crate) fn outline(&self) -> Result<Outline> {
        Ok(outline(self.source()?, &self.options(&self.part.reading()))?)
    }

    /// What no command can do that keeps all voxels of a file as they are.
    pub(crate) fn refuse_what_leaves_out_voxels(&self) -> Result<()> {
        let PartArgs { thin, labels, .. } = &self.part;
        let found = [("--thin", thin.is_some()), ("--labels", labels.is_some())];
        match found.into_iter().find(|(_, is_given)| *is_given) {
            Some((flag, _)) => Err(usage_error(format!("{flag}: found it, expected a volume as it is"))),
            None => Ok(()),
        }
    }

    /// Options for opening. The memory limit is the default of `serve`, so that both choose the same level of a
    /// pyramid.
    pub(crate) fn options<'a>(&self, reading: &'a Reading) -> OpenOptions<'a> {
        let PartArgs { spacing, .. } = self.part;
        OpenOptions {
            raw: self.raw.shape(),
            selection: self.part.selection(),
            spacing,
            max_bytes: MemoryArgs::default().bytes(),
            foreign_files: self.part.has_foreign_files(),
            reading,
            index_folder: index_folder(),
            ..OpenOptions::default()
        }
    }

    /// The volume to be read by pages, within a limit of memory; reading its coarsest level shows progress.
    pub(crate) fn open_paged(&self, memory: &MemoryArgs) -> Result<PagedFile> {
        let (source, reading) = (self.source()?, self.part.reading());
        let options = OpenOptions { max_bytes: memory.bytes(), ..self.options(&reading) };
        with_percent("reading the coarsest level", |progress| {
            Ok(open_paged(source, &OpenOptions { progress: Some(progress), ..options })?)
        })
    }

    /// What is known of a large file at once; `None` if it is small enough to be read.
    pub(crate) fn facts_at_once(&self) -> Result<Option<VolumeFacts>> {
        Ok(facts_at_once(self.source()?, &self.options(&self.part.reading()))?)
    }

    /// The pages that it can be read by, if it can.
    pub(crate) fn page_count(&self) -> Result<Option<PageCount>> {
        Ok(page_count(self.source()?, &self.options(&self.part.reading())))
    }
}

/// Accepts any name of a file. What is no UTF-8 becomes �, as [`open`] takes it.
pub(crate) fn any_text() -> impl TypedValueParser<Value = String> {
    OsStringValueParser::new().map(|name| name.to_string_lossy().into_owned())
}

/// Runs `read` with a progress display that names the size of the volume.
fn show_progress<T>(outline: &Outline, read: impl FnOnce(&dyn Fn(f32)) -> T) -> T {
    let [x, y, z] = outline.dims;
    let megabytes = outline.bytes_in_memory as f64 / 1e6;
    with_percent(&format!("reading {x}×{y}×{z} {}, {megabytes:.1} MB", outline.dtype), read)
}

/// Runs `read` with a display of its progress.
pub(crate) fn with_percent<T>(text: &str, read: impl FnOnce(&dyn Fn(f32)) -> T) -> T {
    let progress = std::cell::RefCell::new(Progress::new(text, 100));
    let done = std::cell::Cell::new(0);
    let report = |fraction: f32| {
        let percent = (fraction * 100.0) as u64;
        progress.borrow_mut().advance(percent.saturating_sub(done.get()), "%");
        done.set(percent.max(done.get()));
    };
    let result = read(&report);
    progress.into_inner().finish();
    result
}

/// The part of a file that becomes the volume.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Choices of a file")]
pub(crate) struct PartArgs {
    /// Channel, component or array of the file, from 0 [default: all that can be shown together]
    #[arg(long, value_name = "N")]
    channel: Option<u32>,
    /// Point in time, from 0
    #[arg(long, value_name = "N")]
    time: Option<u32>,
    /// Level of a pyramid, 0 the finest [default: the finest that fits into memory]
    #[arg(long, value_name = "N")]
    level: Option<u32>,
    /// Series of a folder, from 0 [default: the largest]
    #[arg(long, value_name = "N")]
    series: Option<u32>,
    /// Voxels to take along the axes that `info` shows, without the end, such as 0:100,50:,:
    #[arg(long, value_name = "X,Y,Z")]
    region: Option<Region>,
    /// Axes along which the volume is mirrored, where the file says it wrongly, such as y or x,z
    #[arg(long, value_name = "X,Y,Z")]
    flip: Option<Flip>,
    /// Distances between voxels that replace those of the file
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_spacing, allow_hyphen_values = true)]
    pub(crate) spacing: Option<Vec3>,
    /// Whether a header may name data files outside its own folder, and links in a folder may lead outside
    #[arg(long, value_name = "on|off", value_enum, num_args = 0..=1, require_equals = true)]
    #[arg(default_value_t, default_missing_value = "on", hide_possible_values = true)]
    foreign_files: Switch,
    /// Whether uneven, missing or tilted slices of DICOM stay as they are stored, instead of being resampled
    #[arg(long, value_name = "on|off", value_enum, num_args = 0..=1, require_equals = true)]
    #[arg(default_value_t, default_missing_value = "on", hide_possible_values = true)]
    stored_slices: Switch,
    /// What the voxels mean: values or labels [default: as the file says, or as they look]
    #[arg(long, value_name = "MEANING")]
    voxels: Option<Meaning>,
    /// Take one voxel in so many along each axis [default: only where a side has more than 2048]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    thin: Option<u32>,
    /// A file with a volume of labels that is shown over the volume
    #[arg(long, value_name = "FILE", value_parser = any_text())]
    labels: Option<String>,
}

impl PartArgs {
    pub(crate) fn selection(&self) -> Selection {
        let &Self { channel, time, level, series, region, .. } = self;
        Selection { channel, time, level, series, region, flip: self.flip.unwrap_or_default() }
    }

    /// Whether data files may be outside the folder of their header.
    pub(crate) fn has_foreign_files(&self) -> bool {
        self.foreign_files == Switch::On
    }

    /// How numbers become voxels.
    pub(crate) fn reading(&self) -> Reading {
        let stored_slices = self.stored_slices == Switch::On;
        Reading { stored_slices, voxels: self.voxels, thin: self.thin, labels: self.labels.clone() }
    }
}

/// Layout of a raw file.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Raw volumes")]
pub(crate) struct RawArgs {
    /// Voxels along x, y and z of a raw file
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_dims, requires = "dtype")]
    dims: Option<[u32; 3]>,
    /// Type of its voxels: uint8, int16, float, …
    #[arg(long, value_name = "TYPE", requires = "dims")]
    dtype: Option<Dtype>,
    /// Order of its bytes: little or big
    #[arg(long, value_name = "ORDER", requires = "dims")]
    endian: Option<Endian>,
    /// Bytes before its first voxel
    #[arg(long, value_name = "BYTES", requires = "dims")]
    offset: Option<u64>,
}

impl RawArgs {
    /// The flags for a layout, without its spacing.
    fn of(shape: &RawShape) -> Self {
        let &RawShape { dims, dtype, spacing: _, endian, offset } = shape;
        Self { dims: Some(dims), dtype: Some(dtype), endian: Some(endian), offset: Some(offset) }
    }

    /// The layout, if given.
    pub(crate) fn shape(&self) -> Option<RawShape> {
        Some(RawShape {
            dims: self.dims?,
            dtype: self.dtype?,
            spacing: Vec3::ONE,
            endian: self.endian.unwrap_or_default(),
            offset: self.offset.unwrap_or(0),
        })
    }
}

/// Opens a volume with its look; large files show their progress.
pub(crate) fn open_volume(
    volume: &VolumeArgs,
    look: &LookArgs,
    lighting: Lighting,
    memory: &MemoryArgs,
) -> Result<OpenedScene> {
    let settings = look.march_settings(lighting)?;
    let source = volume.source()?;
    let reading = volume.part.reading();
    let options = OpenOptions { by_pages: true, max_bytes: memory.bytes(), ..volume.options(&reading) };
    let before = outline(source, &options)?;
    let opened = show_progress(&before, |progress| {
        let options = OpenOptions { progress: Some(progress), ..options };
        open_scene(source, look.tf.as_deref(), settings, &options)
    });
    Ok(opened?)
}

/// Opens a volume to serve within a memory limit, with the rest of its file; large files show their progress.
pub(crate) fn open_to_serve(volume: &VolumeArgs, look: &LookArgs, memory: &MemoryArgs) -> Result<OpenedFile> {
    let request = volume.volume_source()?.request(memory.bytes());
    let options = OpenOptions { index_folder: index_folder(), ..request.options() };
    let loader = FileLoader::new(&request, look.tf.as_deref())?;
    let before = loader.outline(request.selection, 0).map_err(|e| anyhow!(e))?;
    let opened = show_progress(&before, |progress| {
        open(&request.source, &OpenOptions { progress: Some(progress), ..options })
    });
    loader.opened(Arc::new(opened?), &before)
}

fn parse_dims(text: &str) -> Result<[u32; 3], String> {
    parse_three(text).filter(|dims| dims.iter().all(|d| (1..=RawShape::MAX_SIDE).contains(d))).ok_or_else(
        || format!("expected three numbers of voxels, 1 to {}, such as 256,256,128", RawShape::MAX_SIDE),
    )
}

fn parse_spacing(text: &str) -> Result<Vec3, String> {
    parse_three::<f32>(text)
        .filter(|spacing| spacing.iter().all(|s| s.is_finite() && *s > 0.0))
        .map(Vec3::from_array)
        .ok_or_else(|| "expected three positive numbers, such as 1,1,2.5".into())
}

/// Parses three values between commas or crosses.
fn parse_three<T: std::str::FromStr>(text: &str) -> Option<[T; 3]> {
    let parts =
        text.split([',', 'x', 'X', '×']).map(|p| p.trim().parse().ok()).collect::<Option<Vec<T>>>()?;
    parts.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_read_and_nonsense_is_refused() {
        assert_eq!(parse_dims("1,2,3"), Ok([1, 2, 3]));
        assert_eq!(parse_spacing("1,2,0.5"), Ok(Vec3::new(1.0, 2.0, 0.5)));
        for bad in ["1,2", "0,1,1", "1,2,3,4", "1,2,99999"] {
            assert!(parse_dims(bad).is_err(), "{bad}");
        }
        assert!(parse_spacing("1,0,1").is_err() && parse_spacing("1,nan,1").is_err());
    }
}
