//! Boxes of volumes whose planes lie in chunks that are unpacked whole: strips and tiles of TIFF, frames of DICOM.

use std::io;
use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;

use crate::chunk_cache::ChunkCache;
use crate::chunk_grid::covering;
use crate::decode::VoxelSink;
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::plan::{BoxLevel, BoxReader, Plan};

/// The first three axes of a plan are those of a plane, the fastest first.
pub(crate) type PlaneSides = [u64; 3];

/// Planes in chunks.
pub(crate) trait PlaneChunks: Send + Sync {
    /// Numbers of the chunks of a plane along each of its axes; `None` if the plane is not there and has zeros.
    fn sides(&self, plane: usize) -> Option<PlaneSides>;

    /// The numbers of a chunk in the byte order of the plan, the first axis fastest. Rows behind the last one of the
    /// plane may be left out. Chunks count along the first axis first. `None` if the chunk is not there and has zeros.
    fn chunk(&self, plane: usize, chunk: usize) -> Result<Option<Vec<u8>>, FormatError>;

    /// The file of a plane, for messages.
    fn path(&self, plane: usize) -> &Path;
}

/// A level of planes for pages. Neighbouring pages share unpacked chunks.
struct PlaneBoxes<P> {
    planes: P,
    plan: Plan,
    cache: ChunkCache<Option<Arc<Vec<u8>>>>,
    cost: Option<String>,
}

/// The one level of a plan with these `planes`, as many as the plan has. Unpacked chunks may take a share of `max_bytes`.
///
/// # Errors
/// A chunk takes more.
pub(crate) fn plane_level(
    plan: &Plan,
    planes: impl PlaneChunks + 'static,
    max_bytes: u64,
    path: &Path,
) -> Result<Vec<BoxLevel>, FormatError> {
    let most_bytes = (max_bytes / SHARE_OF_CHUNKS).clamp(LEAST_CACHED, MOST_CACHED);
    let size = plan.dtype.num_bytes() as u64;
    let sizes = plane_sizes(plan);
    let num_planes: u64 = plan.axes.iter().skip(3).map(|axis| axis.size).product();
    let sides = || (0..num_planes as usize).filter_map(|plane| planes.sides(plane));
    let bytes = |sides: PlaneSides| sides.iter().fold(size, |n, side| n.saturating_mul(*side));
    let chunk = sides().map(bytes).max().unwrap_or(0);
    if chunk > most_bytes {
        let found = format!("planes in parts of {chunk} bytes, of which {most_bytes} are kept,");
        return Err(FormatError::NotPaged { path: shown(path), found });
    }
    let met = |sides: PlaneSides| {
        let met = (0..3).map(|k| PAGE_SIDE.min(sizes[k]).div_ceil(sides[k]));
        met.fold(bytes(sides).saturating_mul(PAGE_SIDE), u64::saturating_mul)
    };
    let needed = sides().map(met).max().unwrap_or(0);
    let cost = (needed > most_bytes).then(|| {
        let mib = needed >> 20;
        format!(
            "a page takes {mib} MiB of the file, more than are kept; `isinglass convert` makes an image of small chunks"
        )
    });
    let reader = PlaneBoxes { planes, plan: plan.clone(), cache: ChunkCache::new(most_bytes), cost };
    Ok(vec![BoxLevel { plan: plan.clone(), reader: Box::new(reader) }])
}

/// Numbers of a plane along its axes.
fn plane_sizes(plan: &Plan) -> PlaneSides {
    std::array::from_fn(|k| plan.axes[k].size)
}

impl<P: PlaneChunks> BoxReader for PlaneBoxes<P> {
    fn read(&self, selected: &[Steps]) -> Result<VoxelSink, FormatError> {
        let plan = &self.plan;
        let outer = || selected.iter().skip(3).zip(plan.axes.iter().skip(3));
        let inner: [&Steps; 3] = std::array::from_fn(|k| &selected[k]);
        let num_planes: u64 = outer().map(|(steps, _)| steps.len()).product();
        let count: u64 = selected.iter().map(Steps::len).product();
        let path = self.planes.path(0);
        let sink = usize::try_from(count).ok().map(|n| VoxelSink::new(plan.dtype, plan.endian, n));
        let mut sink =
            sink.and_then(Result::ok).ok_or_else(|| io_error(path)(io::ErrorKind::OutOfMemory.into()))?;
        let part = |i: u64| {
            let (mut rest, mut plane, mut stride) = (i, 0, 1);
            for (steps, axis) in outer() {
                plane += steps.at(rest % steps.len()) * stride;
                rest /= steps.len();
                stride *= axis.size;
            }
            let plane = plane as usize;
            let get = |chunk: usize| {
                let bytes = self.planes.sides(plane).map_or(0, |sides| sides.iter().product())
                    * plan.dtype.num_bytes() as u64;
                let read =
                    || -> Result<_, FormatError> { Ok(self.planes.chunk(plane, chunk)?.map(Arc::new)) };
                self.cache.get((plane, vec![chunk as u64]), bytes, read)
            };
            plane_part(&self.planes, plan, plane, inner, &get)
        };
        for first in (0..num_planes).step_by(PLANES_AT_ONCE) {
            let last = num_planes.min(first + PLANES_AT_ONCE as u64);
            let parts: Vec<Vec<u8>> = (first..last).into_par_iter().map(&part).collect::<Result<_, _>>()?;
            parts.iter().for_each(|bytes| sink.push_bytes(bytes));
        }
        Ok(sink)
    }

    fn cost(&self) -> Option<String> {
        self.cost.clone()
    }
}

/// All numbers of a plane, for whoever reads one plane after the other.
pub(crate) fn whole_plane(
    planes: &impl PlaneChunks,
    plan: &Plan,
    plane: usize,
) -> Result<Vec<u8>, FormatError> {
    let all = plane_sizes(plan).map(|size| Steps::all(0..size));
    let get = |chunk: usize| -> Result<_, FormatError> { Ok(planes.chunk(plane, chunk)?.map(Arc::new)) };
    plane_part(planes, plan, plane, all.each_ref(), &get)
}

/// The selected numbers of a plane, whose chunks `get` brings.
fn plane_part(
    planes: &impl PlaneChunks,
    plan: &Plan,
    plane: usize,
    selected: [&Steps; 3],
    get: &dyn Fn(usize) -> Result<Option<Arc<Vec<u8>>>, FormatError>,
) -> Result<Vec<u8>, FormatError> {
    let size = plan.dtype.num_bytes();
    let count: u64 = selected.iter().map(|steps| steps.len()).product();
    let mut numbers = vec![0; count as usize * size];
    let Some(sides) = planes.sides(plane) else { return Ok(numbers) };
    let sizes = plane_sizes(plan);
    let num_chunks: [u64; 3] = std::array::from_fn(|k| sizes[k].div_ceil(sides[k]));
    let part = PlanePart::new(sizes, sides, selected, size);
    let [xs, ys, zs] = [0, 1, 2].map(|k| covering(&selected[k].range, sides[k]));
    for (z, y) in zs.flat_map(|z| ys.clone().map(move |y| (z, y))) {
        for x in xs.clone() {
            let index = x + num_chunks[0] * (y + num_chunks[1] * z);
            let Some(chunk) = get(index as usize)? else { continue };
            part.copy(&chunk, [x, y, z], &mut numbers).ok_or_else(|| FormatError::Data {
                path: shown(planes.path(plane)),
                problem: format!("part {index} of a plane has {} bytes, expected more", chunk.len()),
            })?;
        }
    }
    Ok(numbers)
}

/// A part of a plane, its first axis with as many numbers in a row as there are.
struct PlanePart {
    sides: PlaneSides,
    selected: [Steps; 3],
    bytes_per_number: usize,
    /// Whether the first axis of the plane, of which all is selected, became a part of the second one.
    is_joined: bool,
}

impl PlanePart {
    fn new(sizes: PlaneSides, sides: PlaneSides, selected: [&Steps; 3], bytes_per_number: usize) -> Self {
        let [a, b, c] = selected;
        let is_joined =
            *a == Steps::all(0..sizes[0]) && sides[0] == sizes[0] && (b.step == 1 || sizes[0] == 1);
        if !is_joined {
            return Self { sides, selected: selected.map(Clone::clone), bytes_per_number, is_joined };
        }
        let range = b.range.start * sizes[0]..b.range.end * sizes[0];
        let first = Steps { range, step: b.step };
        let sides = [sides[0] * sides[1], sides[2], 1];
        Self { sides, selected: [first, c.clone(), Steps::all(0..1)], bytes_per_number, is_joined }
    }

    /// Copies what is selected of the chunk `at` into its place among the numbers of the part. `None` if the chunk is
    /// too short.
    fn copy(&self, chunk: &[u8], at: [u64; 3], numbers: &mut [u8]) -> Option<()> {
        let size = self.bytes_per_number;
        let at = if self.is_joined { [at[1], at[2], 0] } else { at };
        let first: [u64; 3] = std::array::from_fn(|k| at[k] * self.sides[k]);
        let within: [_; 3] =
            std::array::from_fn(|k| self.selected[k].within(first[k]..first[k] + self.sides[k]));
        let lengths = self.selected.each_ref().map(Steps::len);
        let inner = |k: usize, i: u64| self.selected[k].at(i) - first[k];
        let step = self.selected[0].step;
        for (k, j) in within[2].clone().flat_map(|k| within[1].clone().map(move |j| (k, j))) {
            let row = (inner(2, k) * self.sides[1] + inner(1, j)) * self.sides[0];
            let out = (k * lengths[1] + j) * lengths[0];
            let run = within[0].clone();
            if run.is_empty() {
                return Some(());
            }
            if step == 1 {
                let from = (row + inner(0, run.start)) as usize * size;
                let to = (out + run.start) as usize * size;
                let length = (run.end - run.start) as usize * size;
                numbers.get_mut(to..to + length)?.copy_from_slice(chunk.get(from..from + length)?);
                continue;
            }
            for i in run {
                let from = (row + inner(0, i)) as usize * size;
                let to = (out + i) as usize * size;
                numbers.get_mut(to..to + size)?.copy_from_slice(chunk.get(from..from + size)?);
            }
        }
        Some(())
    }
}

/// The chunks in memory take at most this part of the memory.
const SHARE_OF_CHUNKS: u64 = 8;
/// Bytes of chunks in memory, at least and at most.
const LEAST_CACHED: u64 = 32 << 20;
const MOST_CACHED: u64 = 512 << 20;
/// Voxels along the side of a page and of what is read around it.
const PAGE_SIDE: u64 = 68;
/// Planes of a box that are read at once.
const PLANES_AT_ONCE: usize = 64;
