//! One opacity per voxel in place of several channels, by which their matter is lit and throws shade.

use rayon::prelude::*;

use super::grid::{Volume, Voxels};
use super::pyramid::Finest;
use crate::channels::Blend;
use crate::transfer::{ControlPoint, Domain, TransferFunction, TransferTable, UnitLength};

/// The opacity of each voxel of one or more channels with the same grid, in units of 1/255. `None` without a channel.
pub fn opacity_volume(channels: &[(&Volume, &TransferTable)], blend: Blend) -> Option<Volume> {
    let (first, _) = *channels.first()?;
    let side = first.voxel_side();
    let [nx, ny, _] = first.dims().map(|d| d as usize);
    let extinctions: Vec<Extinctions<'_>> = channels.iter().map(|c| Extinctions::of(c.0, c.1)).collect();
    let mut codes = vec![0u8; first.voxels().len()];
    codes.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
        let mut sums = vec![0f32; nx * ny];
        for channel in &extinctions {
            channel.add(z * nx * ny, &mut sums, blend);
        }
        for (code, sigma) in slice.iter_mut().zip(&sums) {
            *code = ((1.0 - (-sigma * side).exp()) * 255.0 + 0.5) as u8;
        }
        if let Some(gaps) = first.gaps() {
            let gaps = &gaps.bytes[z * nx * ny..];
            slice.iter_mut().zip(gaps).filter(|(_, gap)| **gap != 0).for_each(|(code, _)| *code = 0);
        }
    });
    let map = (1.0, 0.0);
    let volume =
        Volume::new(first.dims(), first.spacing(), Voxels::U8(codes), map, Default::default()).ok()?;
    let volume = match first.finest() {
        Some(finest) => {
            volume.with_finest(Finest { stored_range: None, histogram: None, ..(**finest).clone() })
        }
        None => volume,
    };
    match first.whole() {
        Some(whole) => volume.in_whole(whole.clone()).ok(),
        None => Some(volume),
    }
}

/// The table by which an [`opacity_volume`] attenuates light.
pub fn opacity_table(opacities: &Volume) -> TransferTable {
    let ramp = [0.0, 1.0].map(|x| ControlPoint { x, color: [1.0; 3], opacity: x });
    let transfer = TransferFunction {
        name: String::new(),
        domain: Domain::Values(0.0, 255.0),
        unit_length: UnitLength::Voxel,
        points: ramp.into(),
    };
    transfer.tabulate(opacities.voxel_side(), (1.0 / 255.0, 0.0))
}

/// Voxels with their extinctions: by number, or worked out.
enum Extinctions<'a> {
    U8(&'a [u8], Vec<f32>),
    U16(&'a [u16], Vec<f32>),
    F32(&'a [f32], &'a TransferTable),
}

impl<'a> Extinctions<'a> {
    fn of(volume: &'a Volume, table: &'a TransferTable) -> Self {
        let by_number = |count: u32| (0..count).map(|stored| table.extinction_of(stored as f32)).collect();
        match volume.voxels() {
            Voxels::U8(v) => Self::U8(v, by_number(1 << 8)),
            Voxels::U16(v) => Self::U16(v, by_number(1 << 16)),
            Voxels::F32(v) => Self::F32(v, table),
        }
    }

    /// Adds the extinctions of the voxels from `first` on.
    fn add(&self, first: usize, sums: &mut [f32], blend: Blend) {
        let add = |sum: &mut f32, sigma: f32| match blend {
            Blend::Additive => *sum = sum.max(sigma),
            Blend::Over => *sum += sigma,
        };
        let last = first + sums.len();
        match self {
            Self::U8(v, of) => {
                sums.iter_mut().zip(&v[first..last]).for_each(|(s, &v)| add(s, of[usize::from(v)]));
            }
            Self::U16(v, of) => {
                sums.iter_mut().zip(&v[first..last]).for_each(|(s, &v)| add(s, of[usize::from(v)]));
            }
            Self::F32(v, table) => {
                sums.iter_mut().zip(&v[first..last]).for_each(|(s, &v)| add(s, table.extinction_of(v)));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn opacities_of_channels_follow_the_blend() {
        let volume =
            |voxels| Volume::new([2, 1, 1], Vec3::splat(0.5), voxels, (1.0, 0.0), Default::default());
        let a = volume(Voxels::U8(vec![0, 200])).unwrap();
        let b = volume(Voxels::F32(vec![0.0, 100.0])).unwrap();
        let table = opacity_table(&a);
        let opacities = |channels: &[(&Volume, &TransferTable)], blend| {
            let Some(volume) = opacity_volume(channels, blend) else { return Vec::new() };
            (0..2).map(|x| volume.stored_at(x, 0, 0)).collect()
        };
        // One channel keeps its own opacities.
        assert_eq!(opacities(&[(&a, &table)], Blend::Over), [0.0, 200.0]);
        let both = [(&a, &table), (&b, &table)];
        assert_eq!(opacities(&both, Blend::Additive), [0.0, 200.0]);
        let over = 255.0 * (1.0 - (1.0 - 200.0 / 255.0) * (1.0 - 100.0 / 255.0));
        assert_eq!(opacities(&both, Blend::Over), [0.0, f32::round(over)]);
        assert!(opacities(&[], Blend::Over).is_empty());
    }
}
