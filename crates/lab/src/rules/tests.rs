//! What holds for all rules: from its own pose a frame is the rendering.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::march::{MarchSettings, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::mode::Isos;
use isinglass_core::picture::Picture;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;

use super::*;

fn max_difference(a: &Picture, b: &Picture) -> u8 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

#[test]
fn own_pose_is_the_rendering_by_every_rule() {
    for builtin in Builtin::ALL {
        let name = builtin.name();
        let whole =
            Scene::new(Arc::new(builtin.volume(48)), &load_transfer(name).unwrap(), MarchSettings::default());
        let bounds = whole.volume.bounds();
        let intrinsics = Intrinsics::perspective(48, 45, 0.8);
        let near = bounds.radius() * intrinsics.fit_distance();
        let camera_at =
            |azimuth| Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, near), intrinsics, &bounds);
        let plane = Plane::new(Vec3::new(0.3, 1.0, 0.6), 0.05 * bounds.radius());
        let clip = Clip { bounds: None, plane };
        let isos = MarchSettings { mode: Mode::Iso, isos: Isos::default(), ..whole.settings };
        let looks = [whole.settings, MarchSettings { clip, ..whole.settings }, isos];
        for (settings, rule) in looks.into_iter().flat_map(|look| Rule::ALL.map(|rule| (look, rule))) {
            let scene = whole.with_look(&load_transfer(name).unwrap(), settings);
            let own = camera_at(0.3);
            for camera in [own, own.to_orthographic(near, &bounds)] {
                let truth = render(&scene, &camera);
                let at = format!("{name}, {rule}, {:?}, {:?}", settings.mode, camera.intrinsics.projection);
                for k in [1, 8] {
                    let frame = rule.frame_of(&scene, FrameHeader::alone(camera, k));
                    frame.validate().unwrap();
                    let longest = frame.offsets.windows(2).map(|w| w[1] - w[0]).max().unwrap();
                    assert!(rule == Rule::VisibilityMerge || rule == Rule::AllSamples || longest <= k.into());
                    assert!(max_difference(&frame.flatten(), &truth) <= 1, "{at}");
                    assert!(max_difference(&raycast(&frame, &bounds, &camera), &truth) <= 1, "{at}");
                }
            }
            // Negative control: a frame from aside is another picture.
            let aside = rule.frame_of(&scene, FrameHeader::alone(camera_at(0.5), 8));
            assert!(max_difference(&aside.flatten(), &render(&scene, &own)) > 8, "{name}, {rule}");
        }
    }
}

/// Projections have one rule, whichever is asked for.
#[test]
fn ours_stands_for_the_others_in_a_projection() {
    let transfer = load_transfer("shells").unwrap();
    let settings = MarchSettings { mode: Mode::Mip, ..MarchSettings::default() };
    let scene = Scene::new(Arc::new(Builtin::Shells.volume(24)), &transfer, settings);
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(40, 32, 0.6);
    let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.2, bounds.radius() * intrinsics.fit_distance());
    let header = |k| FrameHeader::alone(Camera::new(pose, intrinsics, &bounds), k);
    let ours = Rule::VisibilityMerge.frame_of(&scene, header(8));
    for rule in Rule::ALL {
        assert_eq!(rule.frame_of(&scene, header(8)), ours, "{rule}");
    }
    assert_ne!(Rule::VisibilityMerge.frame_of(&scene, header(4)), ours, "another K");
}
