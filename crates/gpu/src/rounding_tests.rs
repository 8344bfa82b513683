//! Tests that skipping empty cells leaves nothing out where a device rounds differently from the twin. It runs
//! variants of the kernel's text with other operations and compares them with the twin.
//!
//! A tested stretch begins where the previous one ended and ends where the next begins, whatever the rounding. Depth
//! and row change monotonically along it, so its cells lie between its ends. A row may round by 1e-4 lists, but a
//! list with a nearness below `MIN_NEARNESS` (1e-3) is left out anyway.

use std::sync::Arc;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::kernels::raycast::{CastOptions, Raycaster, Reconstruction};
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::Compositing;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;

use crate::device::Gpu;
use crate::raycast::GpuReprojector;
use crate::shaders::{Frames, Kernel, Purpose};

/// Text of the kernel, and what is put in its place.
type Changes = &'static [(&'static str, &'static str)];

/// Thin, nearly opaque shells: what is left out of them shows.
fn scene() -> Scene {
    let point = |x, opacity| ControlPoint { x, color: [0.9, 0.8, 0.5], opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point(0.1, 0.0), point(0.3, 0.02), point(0.6, 0.9), point(1.0, 0.9)],
    };
    Scene::new(Arc::new(Builtin::Shells.volume(56)), &transfer, MarchSettings::default())
}

fn camera(scene: &Scene, degrees: f32) -> Camera {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(160, 120, 0.6);
    let distance = bounds.radius() * intrinsics.fit_distance();
    Camera::new(Pose::orbit(bounds.center(), degrees.to_radians(), 0.35, distance), intrinsics, &bounds)
}

/// Greatest difference in 1/255.
fn greatest_difference(a: &Picture, b: &Picture) -> u8 {
    let [a, b] = [a, b].map(|p| p.to_srgb8([0.1, 0.2, 0.3]));
    a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

/// By how much a kernel that is changed so differs from the twin, at most, over frames of both projections, turns and
/// reconstructions.
fn difference_from_twin(changes: Changes) -> Option<u8> {
    let gpu = Gpu::open().ok()?;
    for reconstruction in [Reconstruction::Mixed, Reconstruction::Nearest] {
        let options = CastOptions { reconstruction, ..Default::default() };
        let kernel = Kernel::RaycastCompute(Purpose::new(Frames::One, Compositing::Over, &options));
        let changed = changes.iter().fold(kernel.source(), |text, (from, to)| {
            assert!(text.contains(from), "{from}");
            text.replace(from, to)
        });
        gpu.replace(kernel, "raycast", &(changed + OTHER_ROUNDING));
    }
    let scene = scene();
    let bounds = scene.volume.bounds();
    let own = camera(&scene, 25.0);
    let parallel = own.to_orthographic((bounds.center() - own.pose.eye).dot(own.pose.forward()), &bounds);
    let mut greatest = 0;
    for own in [own, parallel] {
        let frame = generate(&scene, FrameHeader::alone(own, 8));
        let mut reprojector = GpuReprojector::new(&gpu, &frame, &bounds).unwrap();
        let caster = Raycaster::new(&frame, &bounds);
        for degrees in [25.0, 25.1, 27.0, 35.0, 115.0] {
            for reconstruction in [Reconstruction::Mixed, Reconstruction::Nearest] {
                let options = CastOptions { reconstruction, ..Default::default() };
                let view = camera(&scene, degrees);
                let found = reprojector.raycast_with(&view, &options).unwrap();
                greatest = greatest.max(greatest_difference(&found, &caster.picture(&view, &options)));
            }
        }
    }
    Some(greatest)
}

#[test]
fn jumps_leave_out_nothing_by_other_rounding() {
    let variants: [(&str, Changes); 4] = [
        ("as it is", &[]),
        ("ends of stretches by fused operations", &[(BORDER, FUSED_BORDER)]),
        (
            "ends of stretches and of columns, each off by up to 1e-6",
            &[(BORDER, NOISY_BORDER), (LEAVE, NOISY_LEAVE)],
        ),
        ("rows off by up to 1e-4 lists", &[(ROW_IN, NOISY_ROW_IN)]),
    ];
    for (what, changes) in variants {
        let Some(difference) = difference_from_twin(changes) else { return };
        // The tolerance of all pictures.
        assert!(difference <= 2, "{what}: {difference}");
    }
    // Negative controls: a stretch whose first half is not tested; and what was met stays met, as it is with a compiler that gives
    // a variable its zeros once only (Tint), which crosses a column twice where the last stretch of a ray is empty.
    let wrong: [(&str, Changes); 2] = [
        ("half a stretch", &[("row_out, enter.depth,", "row_out, 0.5 * (enter.depth + border.depth),")]),
        (
            "met before",
            &[
                ("        var met = Met();\n", ""),
                ("    var bias = 0.0;\n", "    var bias = 0.0;\n    var met = Met();\n"),
            ],
        ),
    ];
    for (what, changes) in wrong {
        let Some(difference) = difference_from_twin(changes) else { return };
        assert!(difference > 2, "{what} was not noticed: {difference}");
    }
}

const BORDER: &str = "let border = at(line, min(column_end(columns, column, num - 1), 1.0));";
const FUSED_BORDER: &str = "let border = fused_at(line, min(fused_end(columns, column, num - 1), 1.0));";
const NOISY_BORDER: &str = "let border = noisy_at(line, min(column_end(columns, column, num - 1), 1.0), 1u);";
const LEAVE: &str = "leave = at(line, max(min(column_t, row_t), enter.t));";
const NOISY_LEAVE: &str = "leave = noisy_at(line, max(min(column_t, row_t), enter.t), 2u);";
const ROW_IN: &str = "let row_in = p_across + d_across * enter.t - 0.5;";
const NOISY_ROW_IN: &str = "let row_in = p_across + d_across * enter.t - 0.5 + 1e-4 * noise(enter.t, 3u);";
const OTHER_ROUNDING: &str = "
// From -1 to 1, another for each bit of a number.
fn noise(x: f32, salt: u32) -> f32 {
    var h = bitcast<u32>(x) * 747796405u + salt * 2891336453u;
    h = ((h >> 16u) ^ h) * 73244475u;
    h = ((h >> 16u) ^ h) * 73244475u;
    return f32(((h >> 16u) ^ h) & 0xffffu) / 32768.0 - 1.0;
}

fn noisy_at(line: Line, t: f32, salt: u32) -> Point {
    let r = (1.0 + 1e-6 * noise(t, salt)) / (line.w1 + t * line.w0_minus_w1);
    let depth = line.depth_over_w * r + line.depth_slope * t;
    return Point(t, (depth - caster.basis.near) * caster.units_per_depth, line.s_w0 * t * r);
}

fn fused_at(line: Line, t: f32) -> Point {
    let r = 1.0 / fma(t, line.w0_minus_w1, line.w1);
    let depth = fma(line.depth_over_w, r, line.depth_slope * t);
    return Point(t, (depth - caster.basis.near) * caster.units_per_depth, line.s_w0 * t * r);
}

fn fused_end(columns: Columns, column: i32, i: i32) -> f32 {
    return fma(f32(column + columns.leaves_by + columns.step * i), columns.slope, columns.offset);
}
";
