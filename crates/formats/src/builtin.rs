//! The built-in volumes, as files that are made while they are read.

use isinglass_core::volume::Volume;
use isinglass_core::volume::procedural::Builtin;

use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, quoted};
use crate::plan::{Axis, Plan, VolumeFile};

/// A built-in volume with a number of voxels along each side.
pub(crate) struct BuiltinFile {
    plan: Plan,
    pub(crate) builtin: Builtin,
    pub(crate) side: u32,
}

impl BuiltinFile {
    /// The volume that is called `cloud`, `cubus` or `shells`, perhaps with `@N` for N voxels a side.
    pub(crate) fn named(name: &str) -> Result<Self, FormatError> {
        let (builtin, side) = builtin(name)?;
        let axes = Axis::in_space([u64::from(side); 3]);
        let geometry = Geometry::along_axes([2.0 / f64::from(side); 3], None);
        let plan = Plan::new("built-in volume", Dtype::Uint8, Endian::Little, axes, geometry);
        Ok(Self { plan, builtin, side })
    }
}

impl VolumeFile for BuiltinFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let in_plane = u64::from(self.side).pow(2);
        for z in (0..self.side).step_by(PLANES) {
            let planes = z..self.side.min(z + PLANES as u32);
            let num = in_plane * planes.len() as u64;
            if collector.is_done() {
                break;
            }
            if collector.gap() >= num {
                collector.pass(num);
                continue;
            }
            collector.push(&self.builtin.planes(self.side, planes))?;
        }
        Ok(())
    }
}

/// A built-in volume and the number of voxels along its side.
fn builtin(name: &str) -> Result<(Builtin, u32), FormatError> {
    let (kind, side) = name.split_once('@').map_or((name, None), |(kind, side)| (kind, Some(side)));
    let side = match side {
        Some(text) => text.parse().ok().filter(|n| (MIN_SIDE..=Volume::MAX_SIDE).contains(n)),
        None => Some(Builtin::DEFAULT_SIDE),
    };
    let (Some(builtin), Some(side)) = (Builtin::from_name(kind), side) else {
        let names = Builtin::ALL.map(|b| format!("builtin:{}", b.name())).join(", ");
        let expected =
            format!("{names}, or with @N for N = {MIN_SIDE} to {} voxels a side", Volume::MAX_SIDE);
        return Err(FormatError::Builtin { found: quoted(name), expected });
    };
    Ok((builtin, side))
}

/// Planes that are made at once.
const PLANES: usize = 4;
/// Fewest voxels along the side of a built-in volume.
const MIN_SIDE: u32 = 8;
