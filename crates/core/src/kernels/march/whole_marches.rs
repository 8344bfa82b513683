//! Whole marches with the processor's widest instructions and with portable ones take the same steps, to the bit.

use std::sync::Arc;

use super::*;
use crate::camera::{Intrinsics, Pose};
use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use crate::volume::procedural::Builtin;
use crate::volume::{Volume, VolumeInfo, Voxels};

/// All steps of a march; strides behind a transmittance, or stops there.
struct Steps {
    steps: Vec<Step>,
    over: Over,
    stops: bool,
}

impl Sink for Steps {
    fn step(&mut self, step: Step) -> Advance {
        self.steps.push(step);
        self.over.add(step.c, step.tau);
        match Advance::behind(self.over.transmittance) {
            Advance::Stride if self.stops => Advance::Stop,
            pace => pace,
        }
    }
}

fn march<T: Texels>(marcher: &Marcher<'_, T>, ray: &Ray, near: f32, stops: bool) -> Vec<Step> {
    let mut sink = Steps { steps: Vec::new(), over: Over::default(), stops };
    if let Some(lattice) = marcher.scene.lattice(ray, near) {
        marcher.march(ray, lattice, &mut sink);
    }
    sink.steps
}

fn bits(steps: &[Step]) -> Vec<[u32; 7]> {
    let each = |s: &Step| [s.s0, s.s1, s.c.x, s.c.y, s.c.z, s.tau, s.alpha].map(f32::to_bits);
    steps.iter().map(each).collect()
}

fn scene(voxels: Voxels, side: u32, shading: Option<Shading>) -> Scene {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![
            p(0.1, [0.2, 0.4, 1.0], 0.0),
            p(0.4, [0.3, 0.9, 0.5], 0.05),
            p(0.9, [1.0, 0.7, 0.3], 0.6),
        ],
    };
    let spacing = Vec3::new(0.02, 0.031, 0.027);
    let volume = Volume::new([side; 3], spacing, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
    Scene::new(Arc::new(volume), &transfer, MarchSettings { shading, ..Default::default() })
}

#[test]
fn avx2_and_portable_marches_take_the_same_steps() {
    if !has_avx2() {
        return;
    }
    let side = 28;
    for builtin in Builtin::ALL {
        let whole = builtin.volume(side);
        let stored =
            |i: u32| whole.stored_at((i % side) as i32, (i / side % side) as i32, (i / side / side) as i32);
        let stored: Vec<f32> = (0..side.pow(3)).map(stored).collect();
        for voxels in [
            Voxels::U8(stored.iter().map(|x| *x as u8).collect()),
            Voxels::U16(stored.iter().map(|x| (x * 251.0) as u16).collect()),
            Voxels::F32(stored.iter().map(|x| x * 0.37 - 11.0).collect()),
        ] {
            for shading in [None, Some(Shading::default())] {
                let scene = scene(voxels.clone(), side, shading);
                with_texels!(scene, texels => compare(&scene, texels));
            }
        }
    }
}

fn compare<'a, T: TexelsOf<'a>>(scene: &'a Scene, texels: T) {
    let wide = Marcher::new(scene, texels);
    assert!(wide.has_avx2);
    let portable = Marcher { has_avx2: false, ..Marcher::new(scene, texels) };
    let bounds = scene.volume.bounds();
    let (mut num_steps, mut num_noticed, mut num_rays) = (0, 0, 0);
    // From outside and from within.
    for distance in [2.2, 0.3] {
        let intrinsics = Intrinsics::perspective(17, 13, 0.8);
        let pose = Pose::orbit(bounds.center(), 0.5, 0.3, distance * bounds.radius());
        let camera = Camera::new(pose, intrinsics, &bounds);
        for i in 0..intrinsics.num_pixels() as u32 {
            let (x, y) = ((i % 17) as f32 + 0.5, (i / 17) as f32 + 0.5);
            let (ray, _) = camera.ray(x, y);
            for stops in [false, true] {
                let expected = bits(&march(&portable, &ray, camera.near, stops));
                assert_eq!(bits(&march(&wide, &ray, camera.near, stops)), expected, "pixel {x}, {y}");
                // Negative control: a ray a millionth of the volume beside is another one.
                let mut beside = ray;
                beside.origin += Vec3::splat(1e-6 * bounds.radius());
                let beside = bits(&march(&wide, &beside, camera.near, stops));
                num_noticed += usize::from(beside != expected);
                num_rays += usize::from(!expected.is_empty());
                num_steps += expected.len();
            }
        }
    }
    assert!(num_steps > 1000 && num_rays > 50, "{num_steps} steps on {num_rays} rays");
    assert!(num_noticed > num_rays / 2, "{num_noticed} of {num_rays}");
}
