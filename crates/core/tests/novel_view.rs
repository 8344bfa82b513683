//! Novel views of layered frames from anywhere: equal to a brute-force reference that intersects every segment. The
//! view from a frame's own pose is the matter of `tests/tests/same_pose.rs`.

#[path = "common/brute_force.rs"]
mod brute_force;
mod common;
#[path = "common/frames.rs"]
mod frames;

use glam::{Quat, Vec3};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::Clip;
use isinglass_core::kernels::empty_space::{CELL_UNITS, DEPTH_CELLS, EmptySpace};
use isinglass_core::kernels::layering::budget;
use isinglass_core::kernels::march::TRANSMITTANCE_MIN;
use isinglass_core::kernels::raycast::{CastOptions, Raycaster, Reconstruction, raycast};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::volume::procedural::Builtin;

use self::brute_force::brute_force;
use self::common::scene;
use self::frames::{frame_of, max_difference};

fn camera(pose: Pose, size: u32, bounds: &Aabb) -> Camera {
    Camera::new(pose, Intrinsics::perspective(size, size - 3, 0.8), bounds)
}

/// Cameras from which rays run along, across and against the old ones. The odd hundredths keep rays off the borders
/// between columns of lists, where either neighbour is right.
fn poses_from_anywhere() -> Vec<(&'static str, Pose)> {
    let eye = Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0);
    let turned = |pose: Pose, q: Quat| Pose { world_from_view: pose.world_from_view * q, ..pose };
    let back = Vec3::Z;
    vec![
        ("10 degrees on", Pose::orbit(Vec3::ZERO, 0.475, 0.2, 4.0)),
        ("90 degrees on", Pose::orbit(Vec3::ZERO, 0.31 + std::f32::consts::FRAC_PI_2, 0.21, 4.0)),
        ("180 degrees on", Pose::orbit(Vec3::ZERO, 0.31 + std::f32::consts::PI, -0.21, 4.0)),
        ("inside the volume", Pose::orbit(Vec3::ZERO, 1.3, 0.4, 0.3)),
        ("inside, looking at the old eye", Pose::look_at(Vec3::new(0.01, 0.02, 0.0), eye.eye, Vec3::Y)),
        (
            "behind the old eye",
            Pose { eye: eye.eye + eye.world_from_view * (back * 2.0 + Vec3::X * 0.013), ..eye },
        ),
        (
            "behind the old eye and beside",
            Pose::look_at(eye.eye + eye.world_from_view * Vec3::new(1.5, 1.0, 2.0), Vec3::ZERO, Vec3::Y),
        ),
        ("at the old eye, looking away", turned(eye, Quat::from_rotation_y(3.1))),
        ("at the old eye, turned", turned(eye, Quat::from_rotation_y(0.3) * Quat::from_rotation_z(0.7))),
        (
            "along the old image plane",
            turned(Pose::orbit(Vec3::ZERO, 0.3 + std::f32::consts::FRAC_PI_2, 0.01, 1.2), Quat::IDENTITY),
        ),
    ]
}

#[test]
fn rays_from_anywhere_match_brute_force() {
    for builtin in Builtin::ALL {
        let scene = scene(builtin);
        let bounds = scene.volume.bounds();
        let whole = Clip::default().region(&bounds);
        for old_distance in [4.0, 0.5] {
            let old = camera(Pose::orbit(Vec3::ZERO, 0.3, 0.2, old_distance), 28, &bounds);
            let frame = frame_of(&scene, old, 6);
            let caster = Raycaster::new(&frame, &bounds);
            for (name, pose) in poses_from_anywhere() {
                let new = camera(pose, 15, &bounds);
                let picture = |reconstruction| {
                    let options = CastOptions { reconstruction, ..Default::default() };
                    (reconstruction, caster.picture(&new, &options))
                };
                for (reconstruction, found) in [Reconstruction::Nearest, Reconstruction::Mixed].map(picture) {
                    let mut truth = Picture::new(found.width, found.height);
                    for (i, pixel) in truth.pixels.iter_mut().enumerate() {
                        let (x, y) = (i as u32 % found.width, i as u32 / found.width);
                        let (ray, _) = new.ray(x as f32 + 0.5, y as f32 + 0.5);
                        *pixel = brute_force(&frame, &whole, &ray, reconstruction).map(|v| v as f32);
                    }
                    assert!(found.pixels.iter().flatten().all(|v| v.is_finite()), "{name}");
                    let difference = max_difference(&found, &truth);
                    assert!(
                        difference <= 1,
                        "{} {name}, {reconstruction:?}: {difference}/255",
                        builtin.name()
                    );
                }
            }
        }
    }
}

/// Jumping over empty cells leaves out only lists without a segment in the ray's way: equal to the bit.
#[test]
fn empty_space_changes_nothing() {
    for builtin in Builtin::ALL {
        let scene = scene(builtin);
        let bounds = scene.volume.bounds();
        for old_distance in [4.0, 0.5] {
            let old = camera(Pose::orbit(Vec3::ZERO, 0.3, 0.2, old_distance), 60, &bounds);
            let frame = frame_of(&scene, old, 6);
            let caster = Raycaster::new(&frame, &bounds);
            for (name, pose) in poses_from_anywhere() {
                let new = camera(pose, 40, &bounds);
                for reconstruction in [Reconstruction::Nearest, Reconstruction::Mixed] {
                    let picture = |skips_empty_space| {
                        let options = CastOptions { reconstruction, skips_empty_space, ..Default::default() };
                        caster.picture(&new, &options)
                    };
                    assert_eq!(picture(true).pixels, picture(false).pixels, "{} {name}", builtin.name());
                }
            }
        }
    }
}

/// Negative control: a grid that says "empty" of what is not changes the picture.
#[test]
fn a_wrong_grid_is_noticed() {
    let scene = scene(Builtin::Cloud);
    let bounds = scene.volume.bounds();
    let old = camera(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0), 60, &bounds);
    let frame = frame_of(&scene, old, 6);
    let new = camera(Pose::orbit(Vec3::ZERO, 0.475, 0.2, 4.0), 40, &bounds);
    let mut caster = Raycaster::new(&frame, &bounds);
    let right = caster.picture(&new, &CastOptions::default());
    let grid = caster.empty_space();
    assert!(grid.empty_share() > 0.2 && grid.empty_share() < 0.95, "{}", grid.empty_share());
    // The fullest tile and all cells of it.
    let mut wrong = grid.clone();
    let fullest = (0..wrong.occupied.len()).max_by_key(|&tile| wrong.occupied[tile].count_ones()).unwrap();
    wrong.occupied[fullest] = 0;
    caster.set_empty_space(wrong);
    assert!(max_difference(&caster.picture(&new, &CastOptions::default()), &right) > 1);
}

/// A cell is occupied if a segment reaches into it, by another way to find out.
#[test]
fn cells_hold_their_segments() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let old = camera(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0), 28, &bounds);
    let frame = frame_of(&scene, old, 6);
    let grid = EmptySpace::new(&frame);
    assert_eq!(grid.tiles, [4, 4]);
    for (tile, &occupied) in grid.occupied.iter().enumerate() {
        for cell in 0..DEPTH_CELLS {
            let (near, far) = (f64::from(cell * CELL_UNITS), f64::from((cell + 1) * CELL_UNITS));
            let lists = (0..28 * 25).filter(|i| i % 28 / 8 == tile % 4 && i / 28 / 8 == tile / 4);
            let reaches = |i: &usize| {
                let segment = frame.segment(*i);
                f64::from(segment.front) < far && f64::from(segment.back) > near
            };
            assert_eq!(occupied >> cell & 1 == 1, lists.flat_map(|i| frame.list(i)).any(|i| reaches(&i)));
        }
    }
}

#[test]
fn brute_force_can_tell_a_wrong_answer() {
    let scene = scene(Builtin::Cloud);
    let bounds = scene.volume.bounds();
    let old = camera(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0), 28, &bounds);
    let frame = frame_of(&scene, old, 6);
    let mut thinner = frame.clone();
    for i in 0..thinner.num_segments() {
        let segment = thinner.segment(i);
        let half = isinglass_core::layer::Segment { tau: segment.tau * 0.9, ..segment };
        thinner.c_b_tau[i] = half.pack()[2];
    }
    let new = camera(Pose::orbit(Vec3::ZERO, 0.475, 0.2, 4.0), 15, &bounds);
    assert!(max_difference(&raycast(&frame, &bounds, &new), &raycast(&thinner, &bounds, &new)) > 1);
}

#[test]
fn k_segments_mean_k_segments() {
    let scene = scene(Builtin::Cloud);
    let bounds = scene.volume.bounds();
    let old = camera(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0), 28, &bounds);
    for k in [1u8, 3, 16, 32] {
        let frame = frame_of(&scene, old, k);
        let longest = (0..frame.offsets.len() - 1).map(|i| frame.list(i).len()).max().unwrap();
        let bound = budget::longest_list(k.into());
        assert_eq!(usize::from(frame.header.k), bound);
        let mean = frame.segments_mean() as f32;
        // The threshold comes from one ray in sixteen: 49 of this frame's. A list's length differs from the mean by about
        // its square root.
        let tolerance = 3.0 * (f32::from(k) / 49.0).sqrt();
        assert!(longest <= bound && mean <= f32::from(k) + tolerance, "{k}: {mean}");
        // Rays of more steps than K use the budget up, and unevenly.
        assert!(k > 3 || mean >= f32::from(k) - tolerance, "{k}: {mean}");
        assert!(k != 3 || longest > usize::from(k), "{k}: {longest}");
    }
}

#[test]
fn matter_behind_opaque_matter_is_kept() {
    let scene = scene(Builtin::Cubus);
    let bounds = scene.volume.bounds();
    let old = camera(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 4.0), 28, &bounds);
    let frame = frame_of(&scene, old, 8);
    // The list in the middle looks through three cubes.
    let list: Vec<_> = frame.list(12 * 28 + 14).map(|j| frame.segment(j)).collect();
    let mut transmittance = 1.0;
    let hides = list.iter().find(|s| {
        transmittance *= 1.0 - s.alpha();
        transmittance < TRANSMITTANCE_MIN
    });
    // A rendering ends there. A quarter of the frame's depth is a cube and more.
    assert!(list.last().unwrap().back > hides.expect("cubes are opaque").back + 5000);
}
