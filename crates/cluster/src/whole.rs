//! What all parts of a volume must know of the whole.

use std::sync::Arc;

use isinglass_core::volume::{Finest, Histogram, Volume, VoxelBox, Whole, sample_places};

use serde::{Deserialize, Serialize};

use crate::exchange::{ClusterError, Exchange, agree, same_everywhere};
use crate::jobs::{from_words, words_from};

/// What a channel of a level takes from the finest level of its pyramid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinestNumbers {
    /// Least and greatest stored number.
    pub stored_range: (f32, f32),
    /// Its histogram.
    pub histogram: Histogram,
}

/// The voxels of a box as a part of a whole of `dims` voxels. `held` is the box of `volume`, and `own` the one inside
/// that no other process has. The numbers are those that process 0 knows of the finest level, by channel; without them
/// a level rests on its own.
///
/// # Errors
/// If the processes have parts of different files.
pub fn in_whole(
    exchange: &dyn Exchange,
    volume: Volume,
    own: &VoxelBox,
    held: &VoxelBox,
    dims: [u32; 3],
    finest: Option<Vec<FinestNumbers>>,
) -> Result<Volume, ClusterError> {
    let others = volume.others().to_vec();
    let known = words_from(&finest.filter(|known| known.len() == 1 + others.len()))?;
    let known: Option<Vec<FinestNumbers>> = from_words(&exchange.broadcast(known)?)?;
    let mut known = known.unwrap_or_default().into_iter();
    let first = agree(exchange, volume.with_others(Vec::new()).map_err(|e| e.to_string()))?;
    let first = channel_in_whole(exchange, first, own, held, dims, known.next())?;
    let others = others.into_iter().map(|other| {
        let other = Arc::unwrap_or_clone(other);
        channel_in_whole(exchange, other, own, held, dims, known.next()).map(Arc::new)
    });
    let joined = first.with_others(others.collect::<Result<_, _>>()?);
    agree(exchange, joined.map_err(|e| e.to_string()))
}

fn channel_in_whole(
    exchange: &dyn Exchange,
    mut volume: Volume,
    own: &VoxelBox,
    held: &VoxelBox,
    dims: [u32; 3],
    known: Option<FinestNumbers>,
) -> Result<Volume, ClusterError> {
    let (spacing, finest) = (volume.spacing(), volume.finest().map(|finest| finest.spacing));
    let facts = format!("{:?} {spacing} {finest:?} {:?}", volume.value_map(), volume.info.dtype);
    same_everywhere(exchange, "values and spacing of the file", &facts)?;
    let fits = agree(
        exchange,
        if volume.dims() == held.dims() {
            Ok(())
        } else {
            Err(format!("found {:?} voxels, expected {:?}", volume.dims(), held.dims()))
        },
    );
    fits?;
    let (lo, hi) = volume.stored_range();
    let ranges = exchange.all_gather(&[lo.to_bits(), hi.to_bits(), u32::from(volume.info.are_labels)])?;
    let number = |words: &[u32], i: usize| words.get(i).map_or(0.0, |word| f32::from_bits(*word));
    let mut stored_range =
        ranges.iter().fold((lo, hi), |(lo, hi), words| (lo.min(number(words, 0)), hi.max(number(words, 1))));
    // Few voxels may look like labels where all of them do not.
    volume.info.are_labels = ranges.iter().all(|words| words.get(2) == Some(&1));
    let inner = VoxelBox {
        first: [0, 1, 2].map(|axis| own.first[axis] - held.first[axis]),
        end: [0, 1, 2].map(|axis| own.end[axis] - held.first[axis]),
    };
    // Only a level takes numbers from the finest one.
    let known = known.filter(|_| volume.finest().is_some());
    let histogram = match &known {
        Some(known) => known.histogram.clone(),
        None => histogram_of_parts(exchange, &volume, &inner, stored_range, dims)?,
    };
    if let Some(known) = known {
        let (lo, hi) = known.stored_range;
        stored_range = (stored_range.0.min(lo), stored_range.1.max(hi));
    }
    let samples = samples(exchange, &volume, own, held, dims)?;
    if let Some(finest) = finest_of_whole(exchange, &volume, held, dims)? {
        volume = volume.with_finest(finest);
    }
    let whole = Whole { dims, first: held.first, stored_range, histogram, samples };
    agree(exchange, volume.in_whole(Arc::new(whole)).map_err(|e| e.to_string()))
}

/// The histogram of the whole, from the voxels of each part's box.
fn histogram_of_parts(
    exchange: &dyn Exchange,
    volume: &Volume,
    inner: &VoxelBox,
    stored_range: (f32, f32),
    dims: [u32; 3],
) -> Result<Histogram, ClusterError> {
    let mut failed = None;
    let num_voxels = VoxelBox::of(dims).count();
    let histogram = Histogram::by(volume, stored_range, num_voxels, &mut |range, with_gaps| {
        let counts = Histogram::counts_in(volume, inner, range, with_gaps);
        exchange.sum(&counts).unwrap_or_else(|e| {
            failed = Some(e);
            counts
        })
    });
    failed.map_or(Ok(histogram), |failed| Err(failed.into()))
}

/// How the whole level of a pyramid lies in the finest one, given how a part of it does. The first part knows where the
/// level begins, and the last one where it ends. What a part says of numbers is of its own part of the finest level.
fn finest_of_whole(
    exchange: &dyn Exchange,
    volume: &Volume,
    held: &VoxelBox,
    dims: [u32; 3],
) -> Result<Option<Finest>, ClusterError> {
    let Some(part) = volume.finest() else { return Ok(None) };
    let first = part.first.to_array().map(f32::to_bits);
    let words = [first, part.dims, held.first, held.end].concat();
    let parts = exchange.all_gather(&words)?;
    let mut whole = Finest { stored_range: None, histogram: None, ..(**part).clone() };
    for axis in 0..3 {
        let of = |part: &Vec<u32>| {
            let [first, dims, begin, end] = [0, 3, 6, 9].map(|i| part.get(i + axis).copied().unwrap_or(0));
            (f64::from(f32::from_bits(first)), dims, begin, end)
        };
        let step = f64::from(volume.spacing()[axis]) / f64::from(part.spacing[axis]);
        let Some((first, ..)) = parts.iter().map(of).find(|(.., begin, _)| *begin == 0) else { continue };
        let last = parts.iter().map(of).find(|(.., end)| *end == dims[axis]);
        let Some((first_of_last, dims_of_last, begin, _)) = last else { continue };
        let start = (first + step * f64::from(begin) - first_of_last).round();
        whole.first[axis] = first as f32;
        whole.dims[axis] = start as u32 + dims_of_last;
    }
    Ok(Some(whole))
}

/// The stored numbers at the sampled places of the whole, each from the process that has it.
fn samples(
    exchange: &dyn Exchange,
    volume: &Volume,
    own: &VoxelBox,
    held: &VoxelBox,
    dims: [u32; 3],
) -> Result<Vec<f32>, ClusterError> {
    let [xs, ys, zs] = dims.map(sample_places);
    let mut bits = Vec::with_capacity(xs.len() * ys.len() * zs.len());
    for (z, y) in zs.iter().flat_map(|z| ys.iter().map(move |y| (*z, *y))) {
        bits.extend(xs.iter().map(|&x| {
            let place = [x, y, z];
            if !own.contains(place) {
                return 0;
            }
            let [x, y, z] = [0, 1, 2].map(|axis| (place[axis] - held.first[axis]) as i32);
            u64::from(volume.stored_at(x, y, z).to_bits())
        }));
    }
    Ok(exchange.sum(&bits)?.into_iter().map(|bits| f32::from_bits(bits as u32)).collect())
}
