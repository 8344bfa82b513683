//! Reads the selected part of a file into a volume.

use std::path::Path;
use std::sync::Arc;

use isinglass_core::volume::{ChannelInfo, Volume, VolumeInfo, Voxels};

use crate::collector::Collector;
use crate::decode::Decoded;
use crate::error::{FormatError, malformed, shown};
use crate::gap_rule::GapRule;
use crate::labels::mark_labels;
use crate::levels::KnownNumbers;
use crate::padding::without_padding;
use crate::paged::IndexPlace;
use crate::plan::{Chosen, Plan, VolumeFile};
use crate::reading::Reading;
use crate::selection::Selection;
use crate::source::{OpenOptions, file_name};

/// Reads the selected part of `file`, the file at `path`.
pub(crate) fn read_volume(
    mut file: Box<dyn VolumeFile + '_>,
    path: &Path,
    options: &OpenOptions,
) -> Result<Volume, FormatError> {
    let chosen = file.plan().choose(path, options)?;
    let mut collector = Collector::new(file.plan(), &chosen, path, options);
    file.read(&mut collector)?;
    let decoded = collector.finish()?;
    let plan = file.plan();
    let (volumes, _) = channel_volumes(plan, &chosen, decoded, path)?;
    let (volumes, word) = pinned(volumes, &*file, &chosen, path, options)?;
    let warnings = chosen.warnings.iter().map(|w| w.text.clone()).chain(word).collect();
    joint(volumes, plan, warnings, path, options)
}

/// The channels of a file as one volume, with warnings about the file before those about the voxels.
pub(crate) fn joint(
    volumes: Vec<Volume>,
    plan: &Plan,
    mut warnings: Vec<String>,
    path: &Path,
    options: &OpenOptions,
) -> Result<Volume, FormatError> {
    let mut volumes = volumes.into_iter();
    let first = volumes.next().ok_or_else(|| malformed(path, &plan.format)("no voxels".into()))?;
    let others: Vec<Arc<Volume>> = volumes.map(Arc::new).collect();
    let mut joint = first
        .with_others(others.clone())
        .map_err(|cause| FormatError::Volume { path: shown(path), cause })?;
    warnings.append(&mut joint.info.warnings);
    for other in others {
        let name = &other.info.channel.name;
        warnings.extend(other.info.warnings.iter().map(|text| format!("channel {name}: {text}")));
    }
    joint.info.warnings = warnings;
    if joint.others().is_empty() && (plan.num_joint == 1 || options.reading.voxels.is_some()) {
        let word = mark_labels(&mut joint, plan, options.reading.voxels, path)?;
        joint.info.warnings.extend(word.map(|word| word.text));
    }
    Ok(joint)
}

/// The channels as levels of their pyramid, and a word if the finest level's numbers are not known.
fn pinned(
    volumes: Vec<Volume>,
    file: &dyn VolumeFile,
    chosen: &Chosen,
    path: &Path,
    options: &OpenOptions,
) -> Result<(Vec<Volume>, Option<String>), FormatError> {
    let Some(in_finest) = &chosen.in_finest else { return Ok((volumes, None)) };
    let maps: Vec<(f32, f32)> = volumes.iter().map(Volume::value_map).collect();
    let held = volumes.iter().map(Volume::bytes_in_memory).sum();
    let known = finest_numbers((&maps, held), file, chosen, path, options)?;
    let word = known.is_none().then(|| UNKNOWN_NUMBERS.to_owned());
    let known = known.unwrap_or_default();
    let volumes = volumes.into_iter().enumerate();
    let pinned = volumes.map(|(i, volume)| volume.with_finest(in_finest.of_channel(known.get(i))));
    Ok((pinned.collect(), word))
}

/// The numbers of each channel in the same part of the finest level, if that is small enough to be read for them beside
/// the `held` bytes. Values mean the same in both, by the `maps` of the channels.
pub(crate) fn finest_numbers(
    (maps, held): (&[(f32, f32)], u64),
    file: &dyn VolumeFile,
    chosen: &Chosen,
    path: &Path,
    options: &OpenOptions,
) -> Result<Option<Vec<KnownNumbers>>, FormatError> {
    let Some(in_finest) = &chosen.in_finest else { return Ok(None) };
    let kept = IndexPlace::of(file, path, in_finest.region, options).and_then(|place| place.read());
    if let Some(index) = kept.filter(|index| index.num_channels() == maps.len()) {
        return Ok(Some(index.known()));
    }
    let Some(finest) = file.finest_level() else { return Ok(None) };
    let max_bytes = options.max_bytes.saturating_sub(held).min(MOST_READ_FOR_NUMBERS);
    let channel = (chosen.channels.len() == 1).then_some(chosen.channels.start);
    let selection = Selection {
        channel,
        time: Some(chosen.time),
        level: Some(0),
        region: in_finest.region,
        ..options.selection
    };
    let reading = Reading { labels: None, thin: None, ..options.reading.clone() };
    let own = OpenOptions { selection, max_bytes, reading: &reading, progress: None, ..*options };
    match read_volume(finest, path, &own) {
        Ok(finest) => {
            let is_alike = finest.channels().map(Volume::value_map).eq(maps.iter().copied());
            Ok(is_alike.then(|| finest.channels().map(KnownNumbers::of).collect()))
        }
        Err(e @ FormatError::Cancelled { .. }) => Err(e),
        Err(_) => Ok(None),
    }
}

/// The volume of each channel, with the warnings about its voxels, and which of them have no value. A channel without
/// any value is empty and hidden beside others.
pub(crate) fn channel_volumes(
    plan: &Plan,
    chosen: &Chosen,
    decoded: Vec<Decoded>,
    path: &Path,
) -> Result<(Vec<Volume>, Vec<GapRule>), FormatError> {
    let are_empty: Vec<bool> = decoded.iter().map(|channel| !has_values(&channel.voxels)).collect();
    let is_any_full = are_empty.contains(&false);
    let (mut volumes, mut rules) = (Vec::new(), Vec::new());
    for ((channel, mut decoded), is_empty) in chosen.channels.clone().zip(decoded).zip(are_empty) {
        let is_empty = is_empty && is_any_full;
        if is_empty {
            decoded.empty();
        }
        let (mut volume, rule) = channel_volume(plan, chosen, channel, decoded, path)?;
        volume.info.channel.is_hidden |= is_empty;
        volumes.push(volume);
        rules.push(GapRule { is_empty, ..rule });
    }
    Ok((volumes, rules))
}

/// Whether any voxel is a number.
fn has_values(voxels: &Voxels) -> bool {
    match voxels {
        Voxels::F32(v) => v.iter().any(|x| x.is_finite()),
        _ => true,
    }
}

fn channel_volume(
    plan: &Plan,
    chosen: &Chosen,
    channel: u32,
    decoded: Decoded,
    path: &Path,
) -> Result<(Volume, GapRule), FormatError> {
    let look = plan.channel_looks.get(channel as usize).copied().unwrap_or_default();
    let name = match plan.channel_names.get(channel as usize) {
        Some(name) if !name.is_empty() => name.clone(),
        _ if chosen.channels.len() > 1 => channel.to_string(),
        _ => String::new(),
    };
    let info = VolumeInfo {
        name: file_name(path),
        dtype: plan.dtype.name().to_owned(),
        unit: plan.geometry.unit.clone(),
        orientation: chosen.grid.orientation.clone(),
        placement: chosen.grid.placement,
        modality: plan.modality.clone(),
        value_unit: plan.value_unit.clone(),
        window: look.window.and_then(window),
        are_labels: false,
        labels: plan.labels.clone(),
        channel: ChannelInfo { name, color: look.color, is_hidden: look.is_hidden },
        warnings: decoded.warnings.into_iter().map(|w| w.text).collect(),
    };
    let ((slope, intercept), offset) = (plan.value_map, f64::from(decoded.value_map.1));
    let value_map = (slope as f32, (slope * offset + intercept) as f32);
    let grid = &chosen.grid;
    let gaps = decoded.gaps.map(|gaps| grid.reorder(Voxels::U8(gaps)));
    let volume = Volume::new(grid.dims(), grid.spacing, grid.reorder(decoded.voxels), value_map, info)
        .map_err(|cause| FormatError::Volume { path: shown(path), cause })?;
    let volume = match gaps {
        Some(Voxels::U8(gaps)) => volume.with_gaps(gaps),
        _ => volume,
    };
    let (volume, missing) = without_padding(volume, &plan.missing);
    let rule = GapRule { has_gaps: plan.has_gaps, mark: decoded.mark, missing, is_empty: false };
    Ok((volume, rule))
}

/// A window with finite ends in order; files without one often have zeros.
fn window((from, to): (f64, f64)) -> Option<(f32, f32)> {
    let (from, to) = (from as f32, to as f32);
    (from < to && from.is_finite() && to.is_finite()).then_some((from, to))
}

/// What is said of a level that is shown by its own numbers.
pub(crate) const UNKNOWN_NUMBERS: &str = "the finest level's values are not known, so colours may differ between levels; `isinglass index` reads them";
/// 256 MiB: a finest level of at most this size is read for its numbers.
pub(crate) const MOST_READ_FOR_NUMBERS: u64 = 256 << 20;
