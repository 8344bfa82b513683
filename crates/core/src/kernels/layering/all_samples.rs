//! Every visible step as a segment of its own: what is left of the error when nothing is merged is that of the
//! reconstruction between lists. For measurement, on the CPU alone.
//!
//! Lists have no greatest length, so the frame breaks that promise of [`crate::layer`] and no codec takes it; `header.k`
//! is then 255. The raycaster does not mind.

use std::sync::atomic::{AtomicUsize, Ordering};

use super::{MIN_UNITS, close_segment, gather_rows};
use crate::kernels::march::{Marcher, Pace, Scene, Sink, Step, Texels, with_texels};
use crate::layer::{DEPTH_UNITS, FrameHeader, LayeredFrame, MAX_K};

/// Why not every sample can be kept.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum AllSamplesError {
    /// Too much memory.
    #[error("the frame has more than {MAX_SEGMENTS} samples; expected a smaller picture or volume")]
    TooMany,
    /// The 16 bits of a depth cannot tell steps apart.
    #[error("a step is {found:.1} depth units thick, expected at least {min}", min = MIN_UNITS + 1)]
    TooThin {
        /// Thickness of the thinnest step.
        found: f32,
    },
}

/// Keeps the steps, to the far side.
#[derive(Default)]
struct All(Vec<Step>);

impl Sink for All {
    fn step(&mut self, step: Step) -> Pace {
        self.0.push(step);
        Pace::Step
    }
}

/// Generates a frame with a segment for every visible step.
///
/// # Errors
/// If there are more than [`MAX_SEGMENTS`], or depths are too coarse for them.
pub fn generate(scene: &Scene, header: FrameHeader) -> Result<LayeredFrame, AllSamplesError> {
    with_texels!(scene, texels => generate_with(scene, &Marcher::new(scene, texels), header))
}

fn generate_with<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    header: FrameHeader,
) -> Result<LayeredFrame, AllSamplesError> {
    let camera = header.camera;
    let basis = camera.basis();
    let num_segments = AtomicUsize::new(0);
    // The corner's ray has the least depth for its length.
    let (_, s_per_depth) = basis.ray(0.5, 0.5);
    let h = scene.settings.step_in_voxels * scene.volume.spacing().min_element();
    let found = h / s_per_depth * (DEPTH_UNITS / (camera.far - camera.near));
    // One more for the rounding of both ends.
    if found < f32::from(MIN_UNITS + 1) {
        return Err(AllSamplesError::TooThin { found });
    }
    let frame = gather_rows(FrameHeader { k: u8::MAX, ..header }, |y, row| {
        let mut all = All::default();
        for x in 0..camera.intrinsics.width {
            let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
            all.0.clear();
            if let Some(lattice) = scene.lattice(&ray, camera.near * s_per_depth) {
                marcher.march(&ray, lattice, &mut all);
            }
            if num_segments.fetch_add(all.0.len(), Ordering::Relaxed) + all.0.len() <= MAX_SEGMENTS {
                let mut last_back = 0;
                for step in &all.0 {
                    let segment = close_segment(&camera, MAX_K, step, s_per_depth, last_back);
                    last_back = segment.back;
                    row.push(&segment);
                }
            }
            row.offsets.push(row.depth.len() as u32);
        }
    });
    if num_segments.into_inner() > MAX_SEGMENTS { Err(AllSamplesError::TooMany) } else { Ok(frame) }
}

/// Most segments of such a frame: 1.6 GB, twice that while its rows are gathered.
pub const MAX_SEGMENTS: usize = 1 << 27;
