//! Laws, and which method keeps which: every method keeps another set, so a test fails if one is replaced by another,
//! and every law is broken by some method, which shows that it can fail.

use std::sync::Arc;

use glam::{Quat, Vec3};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::layer::{DEPTH_UNITS, FrameHeader, LayeredFrame, Segment};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_render::Backend;

use super::*;

const SIDE: u32 = 64;
const K: u8 = 4;
const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
/// The box that layers are clipped to: it holds all that the frames of these tests have, so slabs are cut between
/// near and far.
const ROOM: Aabb = Aabb { min: Vec3::splat(-8.0), max: Vec3::splat(8.0) };
const OPAQUE: f32 = 100.0;
const RED: Vec3 = Vec3::X;
const BLUE: Vec3 = Vec3::Z;

fn camera() -> Camera {
    let pose = Pose { eye: Vec3::new(0.0, 0.0, 5.0), world_from_view: Quat::IDENTITY };
    Camera::new(pose, Intrinsics::perspective(SIDE, SIDE, 0.7), &BOUNDS)
}

/// The view depth at a share of the way from near to far.
fn depth(share: f32) -> f32 {
    let camera = camera();
    camera.near + share * (camera.far - camera.near)
}

/// How far the eye must move to the right for matter at a depth to move to the left by so many pixels.
fn step_for(pixels: f32, depth: f32) -> f32 {
    let (tan_x, _) = camera().intrinsics.half_size_at(1.0);
    pixels * depth * 2.0 * tan_x / SIDE as f32
}

fn moved(step: Vec3) -> Camera {
    let mut pose = camera().pose;
    pose.eye += step;
    Camera::new(pose, camera().intrinsics, &BOUNDS)
}

/// The thinnest segment around a depth.
fn thin(share: f32, color: Vec3, tau: f32) -> Segment {
    let middle = (share * DEPTH_UNITS).round() as u16;
    Segment { front: middle - 2, back: middle + 2, c: color * (1.0 - (-tau).exp()), tau }
}

fn frame(list: impl Fn(u32, u32) -> Vec<Segment>) -> Arc<LayeredFrame> {
    let header = FrameHeader::alone(camera(), K);
    let mut frame = LayeredFrame::empty(header);
    frame.offsets.truncate(1);
    for i in 0..SIDE * SIDE {
        for segment in list(i % SIDE, i / SIDE) {
            frame.push(&segment);
        }
        frame.offsets.push(frame.depth.len() as u32);
    }
    frame.validate().unwrap();
    Arc::new(frame)
}

fn view(method: Method, frame: &Arc<LayeredFrame>, camera: &Camera) -> Picture {
    method.prepare(&Backend::Cpu, frame.clone(), &ROOM).unwrap().view(camera).unwrap()
}

/// Greatest difference of any channel of any pixel in 8-bit sRGB.
fn max_difference(a: &Picture, b: &Picture) -> u8 {
    a.to_srgb8([0.0; 3]).iter().zip(&b.to_srgb8([0.0; 3])).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

/// Mean column of a channel in the middle row, in pixel space; none if it is dark.
fn column_of(picture: &Picture, channel: usize) -> Option<f32> {
    let row = &picture.pixels[(SIDE / 2 * SIDE) as usize..][..SIDE as usize];
    let sum: f32 = row.iter().map(|p| p[channel]).sum();
    let weighted: f32 = row.iter().enumerate().map(|(x, p)| p[channel] * (x as f32 + 0.5)).sum();
    (sum > 0.05).then(|| weighted / sum)
}

/// A square of matter in the middle of an empty frame, 20 pixels wide.
fn square(list: Vec<Segment>) -> Arc<LayeredFrame> {
    let inside = 22..42;
    frame(|x, y| if inside.contains(&x) && inside.contains(&y) { list.clone() } else { vec![] })
}

fn busy_frame() -> Arc<LayeredFrame> {
    frame(|x, y| {
        let mut state = (y * SIDE + x).wrapping_mul(2_654_435_761);
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let mut list = Vec::new();
        let mut at = 0.0;
        for _ in 0..(random() * 5.0) as u32 {
            let front = at + random() * 0.2;
            at = front + 0.001 + random() * 0.2;
            let tau = random() * random() * 8.0;
            let color = Vec3::new(random(), random(), random()) * (1.0 - (-tau).exp());
            let units = |share: f32| (share * 0.8 * DEPTH_UNITS) as u16;
            list.push(Segment { front: units(front), back: units(at), c: color, tau });
        }
        list
    })
}

/// From the frame's own camera the picture is the frame itself.
fn keeps_own_pose(method: Method) -> bool {
    let frame = busy_frame();
    // Half-float colours are the same in both; sums differ by rounding, and bilinear weights are 0 or 1 to 1e-4.
    max_difference(&view(method, &frame, &camera()), &frame.flatten()) <= 1
}

/// How far a thin square at a depth appears to have moved to the left when it ought to by 8 pixels.
fn shift(method: Method, share: f32) -> f32 {
    let frame = square(vec![thin(share, RED, OPAQUE)]);
    let turned = view(method, &frame, &moved(Vec3::X * step_for(8.0, depth(share))));
    column_of(&frame.flatten(), 0).unwrap() - column_of(&turned, 0).unwrap_or(f32::NAN)
}

/// A square moves as far as it should; the mean column of 20 pixels is known to a tenth of a pixel or better.
fn moves_matter(method: Method, share: f32) -> bool {
    (shift(method, share) - 8.0).abs() < 0.1
}

/// Whether red matter in front and blue matter behind, in the same pixels, come apart as they should when the eye
/// moves.
fn separates(method: Method, front: f32, back: f32) -> bool {
    // So thin that red does not dim the part of blue behind it.
    let frame = square(vec![thin(front, RED, 0.01), thin(back, BLUE, 0.01)]);
    let turned = view(method, &frame, &moved(Vec3::X * step_for(16.0, depth(front))));
    let apart = column_of(&turned, 2).unwrap_or(f32::NAN) - column_of(&turned, 0).unwrap_or(f32::NAN);
    let right = 16.0 * (1.0 - depth(front) / depth(back));
    assert!(right > 2.0, "too small to tell");
    // Along a ray the ray cast takes the nearest list: half a pixel, and a little for the columns' means.
    (apart - right).abs() < 0.6
}

/// The middles of the second and the third of four slabs.
const MIDDLES: [f32; 2] = [0.375, 0.625];
/// Shares of depth just inside the faces of the second slab.
const FACES: [f32; 2] = [0.251, 0.499];

type Law = (&'static str, fn(Method) -> bool);
const LAWS: [Law; 5] = [
    ("own pose", keeps_own_pose),
    ("matter in the middle of a slab moves", |m| moves_matter(m, MIDDLES[0])),
    ("matter at the face of a slab moves", |m| FACES.iter().all(|&f| moves_matter(m, f))),
    ("two slabs in a pixel come apart", |m| separates(m, MIDDLES[0], MIDDLES[1])),
    ("two depths in a slab come apart", |m| separates(m, FACES[0], FACES[1])),
];

#[test]
fn every_method_keeps_its_own_set_of_laws() {
    let expected = |method| match method {
        Method::Layers => [true, true, true, true, true],
        Method::PointWarp => [true, true, true, false, false],
        Method::SlabsPlanar => [true, true, false, true, false],
        Method::SlabsMesh => [true, true, true, true, false],
        Method::LastImage => [true, false, false, false, false],
    };
    for method in Method::ALL {
        for ((name, law), expected) in LAWS.iter().zip(expected(method)) {
            assert_eq!(law(method), expected, "{method}: {name}");
        }
        let same = Method::ALL.into_iter().filter(|m| expected(*m) == expected(method));
        assert_eq!(same.count(), 1, "another method keeps the same laws as {method}");
    }
}

/// The first law must be able to fail too.
#[test]
fn a_picture_shifted_by_a_pixel_is_not_the_frame() {
    let frame = busy_frame();
    for method in Method::ALL {
        let mut shifted = view(method, &frame, &camera());
        shifted.pixels.rotate_right(1);
        assert!(max_difference(&shifted, &frame.flatten()) > 100, "{method}");
    }
}

/// A plane parallel to the picture: whole steps move it by whole pixels and change nothing else; half steps, a nearer
/// or farther eye and a rolled camera open no crack.
#[test]
fn points_of_a_plane_are_watertight() {
    // Translucent, so that a pixel drawn twice shows as well.
    let segment = thin(0.4, Vec3::new(0.9, 0.5, 0.2), 0.7);
    let plane = frame(|_, _| vec![segment]);
    let own = plane.flatten();
    let alpha = own.pixels[0][3];
    let step = |pixels: f32| Vec3::X * step_for(pixels, depth(0.4));
    let shifted = view(Method::PointWarp, &plane, &moved(step(5.0)));
    for (i, pixel) in shifted.pixels.iter().enumerate() {
        let is_covered = i as u32 % SIDE < SIDE - 5;
        assert_eq!(*pixel, if is_covered { own.pixels[i] } else { [0.0; 4] }, "pixel {i}");
    }
    let (nearer, farther) = (Vec3::NEG_Z * 1.7, Vec3::Z * 2.3);
    let mut rolled = camera();
    rolled.pose.world_from_view *= Quat::from_rotation_z(0.6) * Quat::from_rotation_y(0.1);
    let eyes = [step(0.5), step(-2.4), step(1.0 / 3.0), nearer, nearer + step(3.4), farther];
    // Opacities of the middle, away from the rim of a plane that may be smaller than the picture.
    let middle = |picture: &Picture| -> Vec<f32> {
        let of = |i: u32| (20..44).contains(&(i % SIDE)) && (20..44).contains(&(i / SIDE));
        (0..SIDE * SIDE).filter(|i| of(*i)).map(|i| picture.pixels[i as usize][3]).collect()
    };
    for camera in eyes.map(moved).into_iter().chain([rolled]) {
        let opacities = middle(&view(Method::PointWarp, &plane, &camera));
        assert!(opacities.iter().all(|a| *a >= alpha), "{:?}", camera.pose);
        // Points overlap between whole steps, which is seen in a translucent plane.
        assert!(opacities.iter().any(|a| *a > 1.2 * alpha), "{:?}", camera.pose);
    }
    // Negative control: every other point has cracks.
    let sparse = frame(|x, _| if x % 2 == 0 { vec![segment] } else { vec![] });
    assert!(middle(&view(Method::PointWarp, &sparse, &moved(nearer))).contains(&0.0));
}

/// Points are drawn so that near ones hide far ones, on every side of the epipole, from nearer and from farther away.
#[test]
fn near_points_hide_far_ones_without_a_sort() {
    // A near red grid over a far blue plane: neighbours in the picture that meet after the eye has moved.
    let near_and_far = frame(|x, y| {
        let is_near = x % 4 < 2 && y % 4 < 2;
        vec![if is_near { thin(0.1, RED, OPAQUE) } else { thin(0.9, BLUE, OPAQUE) }]
    });
    for eye in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::NEG_Z, Vec3::Z, Vec3::ONE, -Vec3::ONE] {
        let (old, camera) = (camera(), moved(eye * 0.5));
        let picture = view(Method::PointWarp, &near_and_far, &camera);
        // The truth by a depth buffer: every pixel that a near point covers is red.
        let new = camera.basis();
        for i in 0..SIDE * SIDE {
            let (x, y) = (i % SIDE, i / SIDE);
            if x % 4 >= 2 || y % 4 >= 2 {
                continue;
            }
            let (ray, s_per_depth) = old.ray(x as f32 + 0.5, y as f32 + 0.5);
            let h = new.pixel_from_point(ray.at(depth(0.1) * s_per_depth));
            let (px, py) = (h.x / h.z, h.y / h.z);
            // The middle of a point of which the rim may round either way.
            let (cx, cy) = (px - px.floor() - 0.5, py - py.floor() - 0.5);
            let is_inside = (0.0..SIDE as f32).contains(&px) && (0.0..SIDE as f32).contains(&py);
            if is_inside && cx.abs() < 0.4 && cy.abs() < 0.4 {
                let pixel = picture.pixels[py as usize * SIDE as usize + px as usize];
                assert!(pixel[0] > 0.99 && pixel[2] < 0.01, "eye {eye}, point {x}, {y}: {pixel:?}");
            }
        }
    }
}

/// Matter off its plane by d moves as the plane does: by 8·depth/middle pixels where it ought to move by 8.
#[test]
fn billboards_are_off_by_half_a_slab() {
    for face in FACES {
        let predicted = 8.0 * depth(face) / depth(MIDDLES[0]);
        assert!((predicted - 8.0).abs() > 0.3, "too small to tell");
        let planar = shift(Method::SlabsPlanar, face);
        assert!((planar - predicted).abs() < 0.1, "{planar} {predicted}");
        assert!((shift(Method::SlabsMesh, face) - 8.0).abs() < 0.1);
    }
}

/// A point has one depth: a translucent sheet of some thickness keeps its width, where layers show its side.
#[test]
fn points_show_no_volume() {
    let thick = Segment { front: 10_000, back: 50_000, c: RED * (1.0 - (-1f32).exp()), tau: 1.0 };
    let frame = square(vec![thick]);
    let eye = moved(Vec3::X * step_for(12.0, depth(0.45)));
    let width = |method| {
        let picture = view(method, &frame, &eye);
        let row = &picture.pixels[(SIDE / 2 * SIDE) as usize..][..SIDE as usize];
        row.iter().filter(|p| p[3] > 0.02).count()
    };
    // Its 20 points, and half a pixel to either side.
    assert!(width(Method::PointWarp) <= 21);
    assert!(width(Method::Layers) > 22, "{}", width(Method::Layers));
}

/// The mean of the light in a segment, against the sum over many thin ones.
#[test]
fn a_thick_segment_is_one_point_at_its_mean_light() {
    for tau in [0.001f32, 0.0101, 0.5, 3.0, 40.0] {
        let whole = Segment { front: 8_192, back: 57_344, c: RED * (1.0 - (-tau).exp()), tau };
        let n = 3000;
        let (mut sum, mut weights, mut seen) = (0.0f64, 0.0f64, 1.0f64);
        let part = f64::from(tau) / f64::from(n);
        for i in 0..n {
            let weight = seen * -(-part).exp_m1();
            sum += weight * (8_192.0 + 49_152.0 * (f64::from(i) + 0.5) / f64::from(n));
            weights += weight;
            seen *= (-part).exp();
        }
        let mean = (sum / weights) as f32 / DEPTH_UNITS;
        // A thin square at the mean must move as the thick one does: the same pixels to rounding.
        let eye = moved(Vec3::X * step_for(8.3, depth(0.5)) + Vec3::NEG_Z);
        let thick = view(Method::PointWarp, &square(vec![whole]), &eye);
        let thin = view(Method::PointWarp, &square(vec![Segment { tau, ..thin(mean, RED, tau) }]), &eye);
        assert!(max_difference(&thick, &thin) <= 1, "{tau}");
    }
}

/// What is cut at planes and put together again is what was there; a slab holds what lies in it.
#[test]
fn slabs_partition_the_lists() {
    let frame = busy_frame();
    let slabs = Slabs::new(&frame, &ROOM);
    let flat = frame.flatten();
    for i in 0..(SIDE * SIDE) as usize {
        let at = [i as u32 % SIDE, i as u32 / SIDE].map(|p| p as f32 + 0.5);
        let mut acc = [0.0f32; 4];
        for slab in 0..usize::from(K) {
            let transmittance = 1.0 - acc[3];
            let color = slabs.sample(slab, at);
            acc.iter_mut().zip(color).for_each(|(a, c)| *a += c * transmittance);
        }
        for (a, b) in acc.iter().zip(flat.pixels[i]) {
            // Rounding of a few exponentials and sums of the order of 1.
            assert!((a - b).abs() < 1e-5, "{acc:?} {:?}", flat.pixels[i]);
        }
    }
    // Half of the optical depth on either side of the plane between the second and the third slab.
    let middle = (0.5 * DEPTH_UNITS).round() as u16;
    let across = Segment { front: middle - 8000, back: middle + 8000, c: RED * 0.5, tau: 2.0 };
    let slabs = Slabs::new(&square(vec![across]), &ROOM);
    let at = [SIDE as f32 / 2.0 + 0.5; 2];
    let alpha = |slab| slabs.sample(slab, at)[3];
    let half = 1.0 - (-1f32).exp();
    // A depth unit of 16000 may be rounded away.
    assert!((alpha(1) - half).abs() < 1e-3 && (alpha(2) - half).abs() < 1e-3);
    assert!(alpha(0) == 0.0 && alpha(3) == 0.0);
    // A segment that ends at a plane but for rounding is not cut.
    let to_plane = Segment { front: middle - 8000, back: middle + 3, c: RED, tau: 1000.0 };
    let slabs = Slabs::new(&square(vec![to_plane]), &ROOM);
    assert!(slabs.sample(1, at)[3] > 0.999 && slabs.sample(2, at)[3] == 0.0);
}

/// A frame of the rule `slabs` is cut where the rule has cut it: one segment a slab.
#[test]
fn frames_of_slabs_are_not_cut_again() {
    let options = isinglass_formats::OpenOptions::default();
    let scene =
        isinglass_formats::open_scene("builtin:shells@24", None, Default::default(), &options).unwrap().scene;
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(32, 32, 0.7);
    let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.5, 0.3, 4.0 * bounds.radius()), intrinsics, &bounds);
    let header = FrameHeader::alone(camera, 6);
    let count = |rule: Rule| {
        let frame = rule.frame_of(&scene, header);
        let slabs = Slabs::new(&frame, &bounds);
        let centers = (0..32 * 32).map(|i| [(i % 32) as f32 + 0.5, (i / 32) as f32 + 0.5]);
        let pieces = centers.flat_map(|at| (0..6).map(move |slab| (slab, at)));
        (pieces.filter(|&(slab, at)| slabs.sample(slab, at)[3] > 0.0).count(), frame.num_segments())
    };
    let (pieces, segments) = count(Rule::Slabs);
    assert!(segments > 200 && pieces == segments, "{pieces} {segments}");
    let (pieces, segments) = count(Rule::EqualLength);
    assert!(pieces != segments, "another rule cuts at other planes: {pieces} {segments}");
}

/// A mesh has no seams: where all vertices are at one depth it is the billboard at that depth, from anywhere.
#[test]
fn a_flat_mesh_is_its_billboard() {
    let segments = vec![thin(MIDDLES[0], RED, 0.6), thin(MIDDLES[1], BLUE, 0.9)];
    let textured = frame(|x, y| {
        let mut list = segments.clone();
        list.iter_mut().for_each(|s| s.c *= 0.5 + 0.5 * ((x * 7 + y * 3) % 11) as f32 / 10.0);
        list
    });
    let mut turned = moved(Vec3::new(0.7, -0.4, -0.6));
    turned.pose.world_from_view = Quat::from_rotation_y(0.2) * Quat::from_rotation_z(0.4);
    for camera in [moved(Vec3::X * 0.3), turned, moved(Vec3::Z * 2.0)] {
        let planar = view(Method::SlabsPlanar, &textured, &camera);
        let mesh = view(Method::SlabsMesh, &textured, &camera);
        // The rim is inside for one and outside for the other where it runs through a pixel's centre; a thousandth of
        // the pixels cannot hide a seam, which runs through the whole picture.
        let is_other = |(a, b): (&[f32; 4], &[f32; 4])| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 4e-3);
        let num_other = planar.pixels.iter().zip(&mesh.pixels).filter(|p| is_other(*p)).count();
        assert!(num_other <= 4, "{num_other}");
    }
    // Negative control: off their planes, mesh and billboards differ in many pixels.
    let off = frame(|x, _| if x % 8 < 4 { vec![thin(FACES[0], RED, 0.6)] } else { vec![] });
    let camera = moved(Vec3::X * step_for(8.0, depth(FACES[0])));
    assert!(
        max_difference(&view(Method::SlabsPlanar, &off, &camera), &view(Method::SlabsMesh, &off, &camera))
            > 50
    );
}

/// Any valid camera gives a picture of its size: inside the volume, behind it, looking away, of another size.
#[test]
fn every_camera_gives_a_picture() {
    let frame = busy_frame();
    let intrinsics = Intrinsics::perspective(37, 21, 1.2);
    let mut poses: Vec<Pose> = (0..12).map(|i| Pose::orbit(Vec3::ZERO, i as f32 * 0.6, 0.3, 3.0)).collect();
    poses.extend([0.0, 0.3, 1.0, 1e6].map(|d| Pose::orbit(Vec3::ZERO, 0.1, -0.2, d)));
    poses.push(Pose { eye: camera().pose.eye, world_from_view: Quat::from_rotation_y(std::f32::consts::PI) });
    for method in Method::ALL {
        for pose in &poses {
            let picture = view(method, &frame, &Camera::new(*pose, intrinsics, &BOUNDS));
            assert_eq!((picture.width, picture.height), (37, 21));
            let is_sane = |p: &[f32; 4]| p.iter().all(|c| (0.0..=1.001).contains(c));
            assert!(picture.pixels.iter().all(is_sane), "{method} from {pose:?}");
        }
        let mut views = method.prepare(&Backend::Cpu, frame.clone(), &ROOM).unwrap();
        let mut invalid = camera();
        invalid.pose.eye.x = f32::NAN;
        assert!(views.view(&invalid).is_err());
    }
}

/// A frame with a margin around the picture, seen from its own pose, is its middle by every method.
#[test]
fn a_margin_is_not_shown() {
    let frame = busy_frame();
    let margin = 7;
    let shown = Intrinsics { width: SIDE - 2 * margin, height: SIDE - 2 * margin, ..camera().intrinsics };
    let tan = camera().intrinsics.half_size_at(1.0).1 * shown.height as f32 / SIDE as f32;
    let inner = Camera { intrinsics: shown.with_fov_y(2.0 * tan.atan()), ..camera() };
    let whole_view = Camera { intrinsics: shown, ..camera() };
    let middle = frame.flatten().cropped(margin);
    for method in Method::ALL {
        // The least differences of the angle turn weights of 0 into 1e-4 or less.
        assert!(max_difference(&view(method, &frame, &inner), &middle) <= 1, "{method}");
        assert!(max_difference(&view(method, &frame, &whole_view), &middle) > 50, "{method}");
    }
}

#[test]
fn names_are_read_and_others_refused() {
    for method in Method::ALL {
        assert_eq!(method.name().parse(), Ok(method));
    }
    assert!("pointwarp".parse::<Method>().unwrap_err().contains("point-warp"));
}
