//! `convert`: a pyramid in OME-Zarr of a volume.

use std::cell::{Cell, RefCell};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail};
use clap::Args;
use isinglass_bench::progress::{Progress, note};
use isinglass_client::format_bytes;
use isinglass_formats::{Conversion, FormatError, OpenOptions};
use serde_json::json;

use crate::args::{VolumeArgs, not_an_input, parse_output};
use crate::local::index_folder;
use crate::memory::MemoryArgs;
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct ConvertArgs {
    /// Folder to make, such as a.ome.zarr. It appears when it is whole. After a stop, the same command goes on
    #[arg(value_name = "OUTPUT", index = 2, value_parser = parse_output)]
    output: PathBuf,
    /// Print a summary as JSON
    #[arg(long)]
    json: bool,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    memory: MemoryArgs,
    #[command(flatten)]
    volume: VolumeArgs,
}

pub(crate) fn run(args: &ConvertArgs) -> Result<()> {
    isinglass_formats::share_arena();
    args.volume.refuse_what_leaves_out_voxels()?;
    let source = args.volume.volume_source()?;
    not_an_input(&args.output, [Some(source.source.as_str())])?;
    let request = source.request(args.memory.bytes());
    let cancel = cancel_on_interrupt()?;
    let bar = Bar::new();
    let report = |fraction: f32| bar.show(fraction);
    let (progress, cancel, index_folder): (Option<&dyn Fn(f32)>, _, _) =
        (Some(&report), Some(&*cancel), index_folder());
    let options = OpenOptions { progress, cancel, index_folder, ..request.options() };
    let conversion = Conversion::begin(&request.source, &args.output, &options)?;
    let summary = summary(&conversion);
    bar.start(&conversion, &summary, &args.output);
    let found = conversion.run();
    let percent = bar.finish();
    let found = match found {
        Err(FormatError::Cancelled { .. }) => {
            bail!("stopped at {percent} %; the same command goes on from there")
        }
        found => found?,
    };
    found.notes.iter().for_each(|text| note(&format!("note: {text}")));
    let levels = summary.levels;
    let output = args.output.display().to_string();
    if args.json {
        return print_json(&json!({
            "output": output,
            "levels": levels,
            "dtype": summary.dtype,
            "channels": summary.num_channels,
            "times": summary.num_times,
            "labels": found.are_labels,
            "most_bytes": summary.most_bytes,
        }));
    }
    let [x, y, z] = levels.last().copied().unwrap_or_default();
    let how = if found.are_labels { "labels, by majority" } else { "means" };
    let s = if levels.len() == 1 { "" } else { "s" };
    print(&format!("{output}: {} level{s} down to {x}×{y}×{z}, {how}\n", levels.len()))
}

/// What is made.
struct Summary {
    /// Voxels along x, y and z of each level.
    levels: Vec<[u64; 3]>,
    dtype: &'static str,
    num_channels: u64,
    num_times: u64,
    most_bytes: u64,
}

fn summary(conversion: &Conversion) -> Summary {
    let [num_channels, num_times] = conversion.num_channels_and_times();
    Summary {
        levels: conversion.levels().iter().map(|level| level.dims).collect(),
        dtype: conversion.dtype().name(),
        num_channels,
        num_times,
        most_bytes: conversion.most_bytes(),
    }
}

/// The progress bar, which begins when the size is known.
struct Bar {
    progress: RefCell<Option<Progress>>,
    percent: Cell<u64>,
}

impl Bar {
    fn new() -> Self {
        Self { progress: RefCell::new(None), percent: Cell::new(0) }
    }

    /// Says what is made, how much room it may take, and what an earlier run has done.
    fn start(&self, conversion: &Conversion, summary: &Summary, output: &Path) {
        let [x, y, z] = summary.levels[0];
        let several = |n: u64, what: &str| if n > 1 { format!(", {n} {what}") } else { String::new() };
        let (channels, times) =
            (several(summary.num_channels, "channels"), several(summary.num_times, "times"));
        let levels = several(summary.levels.len() as u64, "levels");
        let most = format_bytes(summary.most_bytes);
        let free = free_bytes(output);
        let told = free.map_or(String::new(), |free| format!("; {} are free", format_bytes(free)));
        note(&format!(
            "{x}×{y}×{z} {}{channels}{times}{levels}: at most {most}, less when packed{told}",
            summary.dtype
        ));
        if free.is_some_and(|free| free < summary.most_bytes) {
            note("note: the disk may be too small");
        }
        conversion.notes().iter().for_each(|text| note(&format!("note: {text}")));
        *self.progress.borrow_mut() = Some(Progress::new("converting", 100));
        if conversion.done() > 0.0 {
            self.show(conversion.done());
            note(&format!("an earlier run has done {} %; this one goes on", self.percent.get()));
        }
    }

    fn show(&self, fraction: f32) {
        let (before, percent) = (self.percent.get(), (fraction * 100.0) as u64);
        if let Some(progress) = self.progress.borrow_mut().as_mut() {
            progress.advance(percent.saturating_sub(before), "%");
            self.percent.set(percent.max(before));
        }
    }

    /// Removes the bar. Returns the percent that are done.
    fn finish(&self) -> u64 {
        if let Some(progress) = self.progress.borrow_mut().take() {
            progress.finish();
        }
        self.percent.get()
    }
}

/// A flag that Ctrl-C sets.
fn cancel_on_interrupt() -> Result<Arc<AtomicBool>> {
    crate::ending::leave_to_command(false);
    let cancel = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&cancel);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.context("cannot wait for Ctrl-C")?;
    std::thread::spawn(move || {
        if runtime.block_on(tokio::signal::ctrl_c()).is_ok() {
            flag.store(true, Ordering::Relaxed);
        }
    });
    Ok(cancel)
}

/// Bytes that a person may write beside `path`, if the system tells.
#[cfg(unix)]
fn free_bytes(path: &Path) -> Option<u64> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let found = rustix::fs::statvfs(folder).ok()?;
    Some(found.f_bavail.saturating_mul(found.f_frsize))
}

/// The same where the system does not tell.
#[cfg(not(unix))]
fn free_bytes(_path: &Path) -> Option<u64> {
    None
}
