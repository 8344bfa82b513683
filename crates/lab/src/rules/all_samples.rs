//! Every visible step as a segment of its own: what is left of the error when nothing is merged is that of the
//! reconstruction between lists. For measurement, on the CPU alone.
//!
//! Lists have no greatest length, so the frame breaks that promise of [`isinglass_core::layer`] and no codec takes it; `header.k`
//! is then 255. The raycaster does not mind.

use std::sync::atomic::{AtomicUsize, Ordering};

use isinglass_core::kernels::layering::close::{MIN_UNITS, segment_behind};
use isinglass_core::kernels::layering::gather_rows;
use isinglass_core::kernels::march::{Advance, Marcher, Scene, Sink, Step, Texels, with_texels};
use isinglass_core::layer::{DEPTH_UNITS, FrameHeader, LayeredFrame};
use isinglass_core::mode::Mode;

/// Why not every sample can be kept.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum AllSamplesError {
    /// Too much memory.
    #[error("the frame has more than {0} samples; expected a smaller picture or volume")]
    TooMany(usize),
    /// A projection has no samples to composite.
    #[error("all samples of mode {0}, expected composite or iso")]
    Projection(Mode),
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
    fn step(&mut self, step: Step) -> Advance {
        self.0.push(step);
        Advance::Step
    }
}

/// Generates a frame with a segment for every visible step.
///
/// # Errors
/// If there are more than [`MAX_SEGMENTS`], or depths are too coarse for them.
pub fn generate(scene: &Scene, header: FrameHeader) -> Result<LayeredFrame, AllSamplesError> {
    generate_at_most(scene, header, MAX_SEGMENTS)
}

fn generate_at_most(
    scene: &Scene,
    header: FrameHeader,
    limit: usize,
) -> Result<LayeredFrame, AllSamplesError> {
    with_texels!(scene, texels => generate_with(scene, &Marcher::new(scene, texels), header, limit))
}

fn generate_with<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    header: FrameHeader,
    limit: usize,
) -> Result<LayeredFrame, AllSamplesError> {
    let mode = scene.settings.mode;
    if mode.is_projection() {
        return Err(AllSamplesError::Projection(mode));
    }
    let camera = header.camera;
    let basis = camera.basis();
    let num_steps = AtomicUsize::new(0);
    // The corner's ray has the least depth for its length.
    let (_, s_per_depth) = basis.ray(0.5, 0.5);
    let h = scene.settings.step_in_voxels * scene.volume.spacing().min_element();
    let found = h / s_per_depth * (DEPTH_UNITS / (camera.far - camera.near));
    // One more for the rounding of both ends.
    if found < f32::from(MIN_UNITS + 1) {
        return Err(AllSamplesError::TooThin { found });
    }
    // Nothing more is done for a frame that is refused.
    let is_within = || num_steps.load(Ordering::Relaxed) <= limit;
    let frame = gather_rows(FrameHeader { k: u8::MAX, mode, ..header }, &is_within, |y, row| {
        let mut all = All::default();
        for x in 0..camera.intrinsics.width {
            let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
            all.0.clear();
            if is_within()
                && let Some(lattice) = scene.lattice(&ray, camera.near * s_per_depth)
            {
                marcher.march(&ray, lattice, &mut all);
                num_steps.fetch_add(all.0.len(), Ordering::Relaxed);
            }
            let mut last_back = 0;
            for step in &all.0 {
                let segment = segment_behind(&camera, step, s_per_depth, last_back);
                last_back = segment.back;
                row.push(&segment);
            }
            row.offsets.push(row.depth.len() as u32);
        }
    });
    frame.filter(|_| is_within()).ok_or(AllSamplesError::TooMany(limit))
}

/// Most segments of such a frame: 1.6 GB, twice that while its rows are gathered.
pub const MAX_SEGMENTS: usize = 1 << 27;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::Vec3;

    use super::super::Rule;
    use super::*;
    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::kernels::march::{MarchSettings, render};
    use isinglass_core::kernels::raycast::raycast;
    use isinglass_core::picture::Picture;
    use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use isinglass_core::volume::procedural::Builtin;

    fn scene(builtin: Builtin, side: u32, step_in_voxels: f32) -> Scene {
        let p = |x, color, opacity| ControlPoint { x, color, opacity };
        let transfer = TransferFunction {
            name: "test".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Voxel,
            points: vec![p(0.1, [0.2, 0.4, 1.0], 0.0), p(1.0, [1.0, 0.7, 0.3], 0.4)],
        };
        let settings = MarchSettings { step_in_voxels, ..Default::default() };
        Scene::new(Arc::new(builtin.volume(side)), &transfer, settings)
    }

    fn header(scene: &Scene, azimuth: f32, (width, height): (u32, u32), k: u8) -> FrameHeader {
        let bounds = scene.volume.bounds();
        let intrinsics = Intrinsics::perspective(width, height, 0.6);
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * intrinsics.fit_distance());
        let camera = Camera::new(pose, intrinsics, &bounds);
        FrameHeader::alone(camera, k)
    }

    /// Mean and greatest difference in 8-bit sRGB.
    fn difference(a: &Picture, b: &Picture) -> (f64, u8) {
        let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
        let each = a.iter().zip(&b).map(|(x, y)| x.abs_diff(*y));
        (each.clone().map(f64::from).sum::<f64>() / a.len() as f64, each.max().unwrap())
    }

    #[test]
    fn nothing_is_merged_and_nothing_is_lost() {
        for builtin in Builtin::ALL {
            let scene = scene(builtin, 48, 0.5);
            let bounds = scene.volume.bounds();
            let size = (72, 64);
            let own = header(&scene, 0.5, size, 8);
            let all = generate(&scene, own).unwrap();
            assert_eq!(all.header, FrameHeader { k: u8::MAX, ..own });
            assert!(all.validate().is_err(), "lists without a bound are no frame for the wire");
            let depths_ascend = (0..all.offsets.len() - 1).all(|i| {
                let segments: Vec<_> = all.list(i).map(|j| all.segment(j)).collect();
                segments.iter().all(|s| s.front < s.back)
                    && segments.windows(2).all(|w| w[0].back <= w[1].front)
            });
            assert!(depths_ascend);
            // Half floats of two hundred segments a ray, each of which rounds by 2^−11 of itself.
            let (_, greatest) =
                difference(&raycast(&all, &bounds, &own.camera), &render(&scene, &own.camera));
            assert!(greatest <= 1, "{}: {greatest}", builtin.name());

            let beside = header(&scene, 0.8, size, 8).camera;
            let truth = render(&scene, &beside);
            let error = |frame| difference(&raycast(frame, &bounds, &beside), &truth).0;
            let merged = Rule::EqualLength.frame_of(&scene, own);
            assert!(all.num_segments() > 3 * merged.num_segments());
            // Opaque cubes are as good in a few segments; soft matter is not.
            let is_nearer = error(&all) < 0.9 * error(&merged);
            assert!(is_nearer || builtin != Builtin::Cloud, "{} {}", error(&all), error(&merged));
        }
    }

    #[test]
    fn what_is_too_much_is_refused() {
        let scene_of = |step| scene(Builtin::Cloud, 32, step);
        let fine = scene_of(0.002);
        let error = generate(&fine, header(&fine, 0.5, (16, 16), 8)).unwrap_err();
        assert!(matches!(error, AllSamplesError::TooThin { found } if found < 3.0), "{error}");
        let scene = scene_of(0.5);
        let own = header(&scene, 0.5, (32, 32), 8);
        let fits = generate(&scene, own).unwrap().num_segments();
        assert!(generate_at_most(&scene, own, fits).is_ok());
        assert_eq!(generate_at_most(&scene, own, fits - 1), Err(AllSamplesError::TooMany(fits - 1)));
    }
}
