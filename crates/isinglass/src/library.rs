//! The file of a server's volume: its parts, and how to open another one.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Result;
use isinglass_core::channels::Channels;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::{Histogram, Volume};
use isinglass_core::wire::{Choices, Part};
use isinglass_formats::{
    Flip, FormatError, LoadRequest, OpenOptions, Outline, Region, Selection, default_channels,
    default_transfer, load_transfer, open, outline,
};
use isinglass_server::{Library, Loaded, Loader, Survey};

use crate::local::index_folder;
use crate::memory;

pub(crate) struct FileLoader {
    /// The file. The memory limit is that of all volumes.
    request: LoadRequest,
    /// The transfer function in place of the one that suits each part.
    transfer: Option<TransferFunction>,
}

pub(crate) struct OpenedFile {
    pub(crate) volume: Arc<Volume>,
    pub(crate) transfer: TransferFunction,
    pub(crate) channels: Channels,
    pub(crate) library: Library,
}

impl FileLoader {
    /// A loader for the file of `request`, whose memory limit covers all volumes. `transfer` is a preset or a file,
    /// or `None` for the one that suits each part.
    pub(crate) fn new(request: &LoadRequest, transfer: Option<&str>) -> Result<Self> {
        let transfer = transfer.map(load_transfer).transpose()?;
        Ok(Self { request: request.clone(), transfer })
    }

    /// The header of a part, if there is room for it beside the `held` bytes.
    pub(crate) fn outline(&self, selection: Selection, held: u64) -> Result<Outline, String> {
        let options = self.options(selection, held);
        let found = match outline(&self.request.source, &options) {
            // The error must tell everything that it needs, not only the needs of reading.
            Err(FormatError::TooLarge { .. }) => {
                outline(&self.request.source, &OpenOptions { max_bytes: u64::MAX, ..options })
            }
            found => found,
        };
        let found = found.map_err(|e| e.to_string())?;
        memory::check(&found.name, found.bytes_beside(), held, self.request.max_bytes)?;
        Ok(found)
    }

    /// A server's library that first shows `volume`, of this outline.
    pub(crate) fn opened(self, volume: Arc<Volume>, outline: &Outline) -> Result<OpenedFile> {
        let transfer = self.transfer_of(&volume);
        let (parts, channels) = (parts_of(outline), default_channels(&volume));
        let volume_memory = self.request.max_bytes;
        let library = Library { parts, loader: Arc::new(self), volume_memory };
        Ok(OpenedFile { volume, transfer, channels, library })
    }

    fn transfer_of(&self, volume: &Volume) -> TransferFunction {
        let suitable = || default_transfer(&self.request.source, volume, &Histogram::of(volume));
        self.transfer.clone().unwrap_or_else(suitable)
    }

    fn options(&self, selection: Selection, held: u64) -> OpenOptions<'_> {
        OpenOptions { selection, held, index_folder: index_folder(), ..self.request.options() }
    }
}

impl Loader for FileLoader {
    fn survey(&self, part: &Part, held: u64) -> Result<Survey, String> {
        let outline = self.outline(selection_of(part), held)?;
        Ok(Survey { parts: parts_of(&outline), bytes_needed: outline.bytes_beside() })
    }

    fn load(
        &self,
        part: &Part,
        held: u64,
        progress: &dyn Fn(f32),
        cancel: &AtomicBool,
    ) -> Result<Loaded, String> {
        let options = OpenOptions {
            progress: Some(progress),
            cancel: Some(cancel),
            ..self.options(selection_of(part), held)
        };
        let volume = open(&self.request.source, &options).map_err(|e| e.to_string())?;
        let transfer = self.transfer_of(&volume);
        let channels = default_channels(&volume);
        Ok(Loaded { volume, transfer, channels })
    }
}

/// The choices in a file, as viewers are told.
fn parts_of(outline: &Outline) -> Choices {
    let count = |n: u64| u32::try_from(n).unwrap_or(u32::MAX).max(1);
    Choices {
        shown: part_of(&outline.shown),
        whole_dims: outline.whole_dims,
        num_channels: count(outline.num_channels),
        joins_channels: outline.joins_channels,
        channels: outline.channels.clone(),
        num_times: count(outline.num_times),
        time_step: outline.time_step.map(|seconds| seconds as f32).filter(|s| s.is_finite() && *s > 0.0),
        levels: outline.levels.iter().map(|level| level.dims).collect(),
        num_series: count(outline.series.len() as u64),
        series: outline.series.clone(),
        bytes_in_memory: outline.bytes_in_memory,
    }
}

fn part_of(selection: &Selection) -> Part {
    let &Selection { channel, time, level, series, region, flip } = selection;
    let ends = |r: Region| std::array::from_fn(|i| [r.min[i], r.max[i].unwrap_or(u32::MAX)]);
    Part { channel, time, level, series, region: region.map(ends), flip: flip.0 }
}

fn selection_of(part: &Part) -> Selection {
    let &Part { channel, time, level, series, region, flip } = part;
    let region = region.map(|r| Region {
        min: r.map(|[from, _]| from),
        max: r.map(|[_, to]| (to != u32::MAX).then_some(to)),
    });
    Selection { channel, time, level, series, region, flip: Flip(flip) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_selection_survives_the_wire() {
        for region in [None, Some(":,5:,1:7")] {
            let region = region.map(|r| r.parse().unwrap());
            let flip = Flip([false, region.is_some(), true]);
            let selection =
                Selection { channel: Some(3), time: None, level: Some(0), series: Some(9), region, flip };
            assert_eq!(selection_of(&part_of(&selection)), selection);
        }
    }

    #[test]
    fn what_is_held_leaves_less_room() {
        let request = LoadRequest { max_bytes: 10_000, ..LoadRequest::new("builtin:shells@16") };
        let loader = FileLoader::new(&request, None).unwrap();
        // 4096 voxels of one byte, and as much for their brightness.
        let survey = loader.survey(&Part::default(), 0).unwrap();
        assert_eq!((survey.bytes_needed, survey.parts.has_choice()), (8192, false));
        let line = loader.survey(&Part::default(), 8192).unwrap_err();
        assert!(line.contains("8 kB of memory beside 8 kB of what is shown"), "{line}");
        assert!(loader.survey(&Part { time: Some(1), ..Part::default() }, 0).unwrap_err().contains("time 1"));
    }

    /// A NIfTI file of three times, of which each is a hole of 420³ words.
    fn write_film(path: &std::path::Path) {
        let mut header = vec![0; 352];
        let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, &348i32.to_le_bytes());
        for (i, dim) in [4i16, 420, 420, 420, 3, 1, 1, 1].iter().enumerate() {
            put(40 + 2 * i, &dim.to_le_bytes());
        }
        put(70, &512i16.to_le_bytes());
        put(72, &16i16.to_le_bytes());
        (0..4).for_each(|i| put(76 + 4 * i, &1f32.to_le_bytes()));
        put(108, &352f32.to_le_bytes());
        put(344, b"n+1\0");
        std::fs::write(path, header).unwrap();
        let file = std::fs::File::options().write(true).open(path).unwrap();
        file.set_len(352 + 3 * 2 * 420u64.pow(3)).unwrap();
    }

    #[test]
    fn another_time_by_pages_needs_memory_for_its_coarsest_level_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.nii");
        write_film(&path);
        let loader = |max_bytes: u64| {
            let request = LoadRequest { max_bytes, ..LoadRequest::new(path.to_str().unwrap()) };
            FileLoader::new(&request, None).unwrap()
        };
        let little = loader(128 << 20);
        let first = little.survey(&Part::default(), 0).unwrap();
        assert_eq!((first.parts.num_times, first.parts.bytes_in_memory), (3, 128 << 20));
        let second = Part { time: Some(1), ..first.parts.shown };
        let found = little.survey(&second, 30 << 20).unwrap();
        assert_eq!((found.parts.shown, found.bytes_needed), (second, first.bytes_needed));
        // What fits alone is read by pages where it does not fit beside what is shown, which then makes room.
        let whole = loader(300 << 20).survey(&second, 0).unwrap();
        assert_eq!(whole.parts.bytes_in_memory, 3 * 420u64.pow(3));
        let beside = loader(300 << 20).survey(&second, 150 << 20).unwrap();
        assert_eq!((beside.parts.shown, beside.parts.bytes_in_memory), (second, 300 << 20));
        // The control: without room for the coarsest level it is refused.
        let line = little.survey(&second, 100 << 20).unwrap_err();
        assert!(line.contains("of what is shown") && line.contains("--max-memory"), "{line}");
    }
}
