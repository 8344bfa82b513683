//! Pyramids in memory, and their pages.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::mode::Mode;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{
    Finest, Histogram, Lighting, Page, PageError, PageId, PageRanges, PageSet, PageSource, PageVoxels,
    Paging, Pyramid, PyramidLevel, Volume, VolumeInfo, VoxelKind, Voxels, page_of,
};

/// Waves and balls: nothing is flat or symmetric.
fn stored(x: f32, y: f32, z: f32) -> f32 {
    let wave = (0.11 * x).sin() + (0.07 * y + 0.4).cos() + (0.13 * z + 0.2 * x.sqrt()).sin();
    let ball = (18.0 - (x - 70.0).hypot(y - 40.0).hypot(z - 30.0)).clamp(0.0, 6.0) * 20.0;
    (60.0 + 30.0 * wave + ball).clamp(0.0, 255.0)
}

/// Those of [`volume_of`].
pub fn voxels(dims: [u32; 3], kind: VoxelKind) -> Voxels {
    let [nx, ny, nz] = dims;
    let at = move |i: u32| stored((i % nx) as f32, (i / nx % ny) as f32, (i / nx / ny) as f32);
    let all = 0..nx * ny * nz;
    match kind {
        VoxelKind::U8 => Voxels::U8(all.map(|i| at(i) as u8).collect()),
        VoxelKind::U16 => Voxels::U16(all.map(|i| (at(i) * 250.0) as u16).collect()),
        VoxelKind::F32 => Voxels::F32(all.map(|i| at(i) - 100.0).collect()),
    }
}

/// A volume without any symmetry.
pub fn volume_of(dims: [u32; 3], spacing: Vec3, kind: VoxelKind) -> Volume {
    Volume::new(dims, spacing, voxels(dims, kind), (1.0, 0.0), VolumeInfo::default()).unwrap()
}

/// A channel beside the first of a volume of bytes.
pub fn other_channel(volume: &Volume, factor: u8) -> Arc<Volume> {
    let Voxels::U8(v) = volume.voxels() else { panic!("expected bytes") };
    let voxels = Voxels::U8(v.iter().map(|v| v.wrapping_mul(factor).rotate_left(3)).collect());
    Arc::new(Volume::new(volume.dims(), volume.spacing(), voxels, (1.0, 0.0), VolumeInfo::default()).unwrap())
}

/// The means of blocks of a level-0 volume: the level with these factors.
pub fn coarser(volume: &Volume, factor: [u32; 3]) -> Volume {
    let dims: [u32; 3] = std::array::from_fn(|i| volume.dims()[i].div_ceil(factor[i]));
    let [nx, ny, nz] = dims;
    let mean = |i: u32| {
        let at = [i % nx, i / nx % ny, i / nx / ny];
        let (mut sum, mut num) = (0.0, 0.0);
        for dz in 0..factor[2] {
            for dy in 0..factor[1] {
                for dx in 0..factor[0] {
                    let p: [u32; 3] = std::array::from_fn(|k| at[k] * factor[k] + [dx, dy, dz][k]);
                    if (0..3).all(|k| p[k] < volume.dims()[k]) {
                        sum += f64::from(volume.stored_at(p[0] as i32, p[1] as i32, p[2] as i32));
                        num += 1.0;
                    }
                }
            }
        }
        sum / num
    };
    let all = 0..nx * ny * nz;
    let voxels = match volume.voxels() {
        Voxels::U8(_) => Voxels::U8(all.map(|i| mean(i).round() as u8).collect()),
        Voxels::U16(_) => Voxels::U16(all.map(|i| mean(i).round() as u16).collect()),
        Voxels::F32(_) => Voxels::F32(all.map(|i| mean(i) as f32).collect()),
    };
    let spacing = volume.spacing() * Vec3::from_array(factor.map(|f| f as f32));
    let level = Volume::new(dims, spacing, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
    // A voxel of a level has nothing where the first voxel of its block has nothing.
    let Some(gaps) = volume.gaps() else { return level };
    let whole = volume.dims();
    let is_gap = |i: u32| {
        let [x, y, z] = [i % nx * factor[0], i / nx % ny * factor[1], i / nx / ny * factor[2]];
        gaps.bytes[((z * whole[1] + y) * whole[0] + x) as usize]
    };
    level.with_gaps((0..nx * ny * nz).map(is_gap).collect())
}

/// The index of the finest level at which the first voxel of such means lies.
pub fn first_of(factor: [u32; 3]) -> [f32; 3] {
    factor.map(|f| (f as f32 - 1.0) * 0.5)
}

/// The level with the look of the finest one.
pub fn pinned(volume: Volume, whole: &Volume, factor: [u32; 3]) -> Volume {
    volume.with_finest(Finest {
        dims: whole.dims(),
        spacing: whole.spacing(),
        first: first_of(factor).into(),
        stored_range: Some(whole.stored_range()),
        histogram: Some(Arc::new(Histogram::of(whole))),
    })
}

/// A pyramid in memory: all its levels.
pub struct Levels {
    /// The levels.
    pub pyramid: Arc<Pyramid>,
    /// The voxels of each.
    pub volumes: Vec<Volume>,
}

impl Levels {
    /// The levels of a volume with these factors, the first of which are ones.
    pub fn of(whole: &Volume, factors: &[[u32; 3]]) -> Self {
        let kind = match whole.voxels() {
            Voxels::U8(_) => VoxelKind::U8,
            Voxels::U16(_) => VoxelKind::U16,
            Voxels::F32(_) => VoxelKind::F32,
        };
        let level_of = |factor: &[u32; 3]| {
            let level = |channel: &Volume| pinned(coarser(channel, *factor), channel, *factor);
            let others = whole.others().iter().map(|other| Arc::new(level(other))).collect();
            level(whole).with_others(others).unwrap()
        };
        let volumes: Vec<Volume> = factors.iter().map(level_of).collect();
        let levels = factors.iter().zip(&volumes);
        let levels =
            levels.map(|(f, v)| PyramidLevel { dims: v.dims(), factor: *f, first: first_of(*f) }).collect();
        let (spacing, info) = (whole.spacing(), VolumeInfo::default());
        let pyramid = Pyramid { levels, spacing, kind, value_maps: vec![(1.0, 0.0)], info };
        Self { pyramid: Arc::new(pyramid), volumes }
    }

    /// A page.
    pub fn page(&self, id: PageId) -> Arc<Page> {
        let volume = &self.volumes[usize::from(id.level)];
        let first = self.pyramid.first_point(id);
        let channels = volume.channels().map(|channel| page_of(channel, first)).collect();
        Arc::new(Page::new(&self.pyramid, id, channels).unwrap())
    }

    /// The coarsest level.
    pub fn base(&self) -> Volume {
        self.volumes.last().unwrap().clone()
    }

    /// All pages of the coarsest level and those that `is_there`.
    pub fn set(&self, is_there: impl Fn(PageId) -> bool) -> Arc<PageSet> {
        let mut pages = self.pyramid.base_pages(&self.base()).unwrap();
        for level in 0..self.pyramid.levels.len() - 1 {
            let [nx, ny, nz] = self.pyramid.pages(level);
            for i in 0..nx * ny * nz {
                let id = PageId { level: level as u8, at: [i % nx, i / nx % ny, i / nx / ny] };
                if is_there(id) {
                    pages.push(self.page(id));
                }
            }
        }
        Arc::new(PageSet::new(self.pyramid.clone(), pages, |_| true))
    }
}

impl Levels {
    /// How their pages are read, with known values.
    pub fn paging(self: &Arc<Self>) -> Paging {
        let ranges = Some(self.clone() as Arc<dyn PageRanges>);
        Paging { source: self.clone(), ranges, max_bytes: 1 << 30, own: None }
    }
}

impl PageSource for Levels {
    fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    fn read(&self, channel: usize, page: PageId) -> Result<PageVoxels, PageError> {
        let level = &self.volumes[usize::from(page.level)];
        let channel = level.channels().nth(channel).ok_or_else(|| PageError::Damaged("no channel".into()))?;
        Ok(page_of(channel, self.pyramid.first_point(page)))
    }
}

impl PageRanges for Levels {
    fn range(&self, channel: usize, at: [u32; 3]) -> Option<(f32, f32)> {
        let voxels = self.read(channel, PageId { level: 0, at }).ok()?.voxels;
        let all = (0..voxels.len()).map(|i| voxels.get(i));
        Some(all.fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), x| (lo.min(x), hi.max(x))))
    }
}

/// Soft and coloured.
pub fn transfer() -> TransferFunction {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![
            p(0.0, [0.1, 0.2, 1.0], 0.0),
            p(0.35, [0.2, 0.4, 1.0], 0.0),
            p(0.5, [0.3, 0.9, 0.5], 0.03),
            p(0.8, [1.0, 0.7, 0.3], 0.3),
        ],
    }
}

/// Shaded, with a light.
pub fn settings(mode: Mode, lighting: Lighting) -> MarchSettings {
    MarchSettings { mode, ..MarchSettings::of(true, lighting) }
}

/// From outside, from inside, and with parallel rays.
pub fn cameras(scene: &Scene) -> Vec<Camera> {
    let bounds = scene.volume.bounds();
    let radius = bounds.radius();
    let orbit = |distance: f32| Pose::orbit(bounds.center(), 0.7, 0.4, distance * radius);
    vec![
        Camera::new(orbit(2.4), Intrinsics::perspective(48, 40, 0.7), &bounds),
        // From inside.
        Camera::new(orbit(0.2), Intrinsics::perspective(40, 30, 1.1), &bounds),
        Camera::new(orbit(2.0), Intrinsics::orthographic(40, 30, 2.0 * radius), &bounds),
    ]
}
