//! Cuts pages out of the levels of a file.

use isinglass_core::volume::{
    PAGE_POINTS, PAGE_VOXELS, PageError, PageId, PageSource, PageVoxels, Pyramid, Volume, VoxelKind, Voxels,
};

use super::base::Base;
use super::levels::PageLevel;
use super::means::MeanPlan;
use crate::error::FormatError;
use crate::gap_rule::GapRule;

/// The pages of a file.
pub(super) struct FilePages {
    pyramid: Pyramid,
    levels: Vec<PageLevel>,
    /// Which voxels have no value, for each channel.
    rules: Vec<GapRule>,
    /// The stored number of gaps with nothing beside them, for each channel.
    elsewhere: Vec<f32>,
}

impl FilePages {
    pub(super) fn new(levels: Vec<PageLevel>, base: &Base) -> Self {
        let pyramid = Pyramid {
            levels: levels.iter().map(|level| level.shape).collect(),
            spacing: base.spacing,
            kind: base.kind,
            value_maps: base.volumes.iter().map(Volume::value_map).collect(),
            info: base.volumes.first().map(|volume| volume.info.clone()).unwrap_or_default(),
        };
        let elsewhere = base.volumes.iter().map(|channel| channel.stored_range().0).collect();
        Self { pyramid, levels, rules: base.rules.clone(), elsewhere }
    }

    /// Takes over what the base, as it is shown, knows of the whole file.
    pub(super) fn complete(&mut self, base: &Volume) {
        self.pyramid.info = base.info.clone();
        self.elsewhere = base.channels().map(|channel| channel.stored_range().0).collect();
    }

    /// A level, from the finest on.
    pub(super) fn level(&self, level: usize) -> &PageLevel {
        &self.levels[level]
    }

    /// Which voxels have no value, for each channel.
    pub(super) fn rules(&self) -> &[GapRule] {
        &self.rules
    }

    /// The levels of means that an index keeps: none of a file with levels of its own.
    pub(super) fn mean_plan(&self) -> Option<MeanPlan> {
        let has_levels =
            self.levels.iter().skip(1).any(|level| level.chosen.grid.thin == [1; 3] && !level.is_kept);
        if has_levels { None } else { MeanPlan::of(&self.levels[0]) }
    }

    /// Whether there is a level of means that an index keeps.
    pub(super) fn has_means(&self) -> bool {
        self.levels.iter().any(|level| level.is_kept)
    }

    pub(super) fn num_absent(&self) -> u64 {
        // The levels of an image count for themselves; a thinned level counts as the one that it is read from.
        let files = self.levels.iter().filter(|level| level.chosen.grid.thin == [1; 3]);
        files.map(|level| level.reader.num_absent()).sum()
    }

    fn cut(&self, channel: usize, page: PageId) -> Result<PageVoxels, FormatError> {
        let level = &self.levels[usize::from(page.level)];
        let (dims, first) = (level.shape.dims, level.shape.first_point(page.at));
        let rule = &self.rules[channel];
        let kind = match self.pyramid.kind {
            VoxelKind::F32 => Voxels::F32(Vec::new()),
            _ => Voxels::U8(Vec::new()),
        };
        // Gaps are filled from the voxels beside them.
        let ring = u32::from(rule.may_find(&kind));
        let min = first.map(|n| n.saturating_sub(ring));
        let max: [u32; 3] = std::array::from_fn(|k| (first[k] + PAGE_POINTS + ring).min(dims[k]));
        let grid = level.chosen.grid.part(min.map(u64::from), max.map(u64::from));
        let number = level.chosen.channels.start + channel as u32;
        let sink = level.reader.read(&level.steps(&grid, number))?;
        let mut voxels = grid.reorder(sink.into_voxels());
        let sides: [u32; 3] = std::array::from_fn(|k| max[k] - min[k]);
        let gaps = rule.apply(&mut voxels, sides, self.elsewhere[channel]);
        let gaps =
            gaps.map_err(|problem| FormatError::Data { path: self.pyramid.info.name.clone(), problem })?;
        let inner: [u32; 3] = std::array::from_fn(|k| first[k] - min[k]);
        let cut = PageCut { sides, inner };
        let gaps = gaps.map(|gaps| cut.of(&gaps)).filter(|gaps| gaps.iter().any(|gap| *gap != 0));
        let voxels = match voxels {
            Voxels::U8(v) => Voxels::U8(cut.of(&v)),
            Voxels::U16(v) => Voxels::U16(cut.of(&v)),
            Voxels::F32(v) => Voxels::F32(cut.of(&v)),
        };
        Ok(PageVoxels { voxels, gaps })
    }
}

impl PageSource for FilePages {
    fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    fn read(&self, channel: usize, page: PageId) -> Result<PageVoxels, PageError> {
        let level = usize::from(page.level);
        let is_there = level < self.levels.len()
            && channel < self.rules.len()
            && page.at.iter().zip(self.pyramid.pages(level)).all(|(at, n)| *at < n);
        if !is_there {
            let text = format!("no page {:?} of channel {channel} and level {level} in this volume", page.at);
            return Err(PageError::Damaged(text));
        }
        self.cut(channel, page).map_err(|e| match e {
            FormatError::Io { .. } => PageError::Unreachable(e.to_string()),
            e => PageError::Damaged(e.to_string()),
        })
    }
}

/// A page in a box of voxels.
struct PageCut {
    sides: [u32; 3],
    /// The page's first voxel in the box.
    inner: [u32; 3],
}

impl PageCut {
    /// The page's voxels, of which the last of the box repeat.
    fn of<T: Copy>(&self, voxels: &[T]) -> Vec<T> {
        let [nx, ny, _] = self.sides.map(|n| n as usize);
        let at = |k: usize, i: u32| (self.inner[k] + i).min(self.sides[k] - 1) as usize;
        let inside = (self.sides[0] - self.inner[0]).min(PAGE_POINTS) as usize;
        let mut page = Vec::with_capacity(PAGE_VOXELS);
        for (z, y) in (0..PAGE_POINTS).flat_map(|z| (0..PAGE_POINTS).map(move |y| (z, y))) {
            let row = (at(2, z) * ny + at(1, y)) * nx;
            page.extend_from_slice(&voxels[row + at(0, 0)..][..inside]);
            let last = voxels[row + nx - 1];
            page.extend(std::iter::repeat_n(last, PAGE_POINTS as usize - inside));
        }
        page
    }
}
