//! The visible point under the pointer, from the depths of the frame on screen.

use glam::Vec3;
use isinglass_core::camera::Camera;
use isinglass_core::clip::Region;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::mode::Compositing;

/// The point on a pixel's ray with half of the visible opacity in front of it, world space. On an opaque surface that
/// is the surface, in a cloud its visible middle. `None` where almost nothing is visible.
pub(crate) fn visible_point(
    frame: &LayeredFrame,
    region: &Region,
    camera: &Camera,
    [x, y]: [f32; 2],
) -> Option<Vec3> {
    let (ray, _) = camera.ray(x, y);
    let (s0, s1) = region.clip(&ray)?;
    let step = (s1 - s0) / NUM_STEPS as f32;
    let mut transmittance = 1.0;
    let mut opacities = [0.0; NUM_STEPS];
    for (i, opacity) in opacities.iter_mut().enumerate() {
        let s = s0 + step * i as f32;
        transmittance *= (-optical_depth(frame, ray.at(s), ray.at(s + step))).exp();
        *opacity = 1.0 - transmittance;
    }
    let total = opacities[NUM_STEPS - 1];
    if total < LEAST_OPACITY {
        return None;
    }
    let half = opacities.partition_point(|opacity| *opacity < 0.5 * total);
    Some(ray.at(s0 + step * (half as f32 + 0.5)))
}

/// The optical depth between two near points, in the list under their middle.
fn optical_depth(frame: &LayeredFrame, from: Vec3, to: Vec3) -> f32 {
    let camera = &frame.header.camera;
    let basis = camera.basis();
    let middle = basis.pixel_from_point((from + to) * 0.5);
    let (column, row) = ((middle.x / middle.z).floor(), (middle.y / middle.z).floor());
    let is_inside = (0.0..basis.width).contains(&column) && (0.0..basis.height).contains(&row);
    if middle.z <= 0.0 || !is_inside {
        return 0.0;
    }
    let list = row as usize * camera.intrinsics.width as usize + column as usize;
    // World distance per unit of view depth along the list's own ray.
    let slant = basis.direction(column + 0.5, row + 0.5).length();
    let level_depth = (camera.far - camera.near) / f32::from(u16::MAX);
    let level = |p: Vec3| ((p - basis.eye).dot(basis.forward) - camera.near) / level_depth;
    let (a, b) = (level(from), level(to));
    // A line across the lists has the same depth at both ends.
    let (a, b) = (a.min(b), a.max(b).max(a.min(b) + 1e-2));
    let mut tau = 0.0;
    for i in frame.list(list) {
        let s = frame.segment(i);
        let (front, back) = (f32::from(s.front), f32::from(s.back));
        let share = (b.min(back) - a.max(front)).max(0.0) / (b - a);
        let length = (back - front) * level_depth * slant;
        // In a projection, what shows most stands for the densest matter.
        let dense = match frame.header.mode.compositing() {
            Compositing::Over => s.tau,
            Compositing::Greatest => s.tau * s.tau * s.tau,
            Compositing::Mean => s.c.max_element(),
        };
        tau += dense / length * share * (to - from).length();
    }
    tau
}

const NUM_STEPS: usize = 512;
const LEAST_OPACITY: f32 = 0.02;

#[cfg(test)]
mod tests {
    use isinglass_core::camera::{Intrinsics, Pose};

    use isinglass_core::layer::{FrameHeader, Segment};

    use isinglass_core::clip::{Clip, Plane};
    use isinglass_core::space::Aabb;

    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::splat(-2.0), max: Vec3::splat(2.0) };

    fn whole() -> Region {
        Clip::default().region(&BOUNDS)
    }

    fn camera(azimuth: f32) -> Camera {
        let intrinsics = Intrinsics::perspective(60, 40, 0.7);
        Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.0, 9.0), intrinsics, &BOUNDS)
    }

    /// A slab between two depths, as fractions of near to far, in every list.
    fn slab(front: f32, back: f32, tau: f32) -> LayeredFrame {
        let header = FrameHeader::alone(camera(0.0), 2);
        let mut frame = LayeredFrame::empty(header);
        let level = |x: f32| (x * 65535.0) as u16;
        for i in 0..header.camera.intrinsics.num_pixels() {
            frame.push(&Segment { front: level(front), back: level(back), c: Vec3::ONE, tau });
            frame.offsets[i + 1] = i as u32 + 1;
        }
        frame
    }

    /// A step of the ray through the box: 4·√2 at most, over the number of steps.
    const TOLERANCE: f32 = 0.012;

    #[test]
    fn on_a_surface_it_is_the_surface_from_any_side() {
        // From depth 9 − r + 0.4·2r on, r the radius: a plane at z = r·(1 − 0.8).
        let frame = slab(0.4, 0.6, 12.0);
        let z = BOUNDS.radius() * (1.0 - 2.0 * 0.4);
        for (azimuth, at) in
            [(0.0, [30.0, 20.0]), (0.0, [40.5, 12.5]), (0.3, [30.0, 20.0]), (-0.5, [25.0, 26.0])]
        {
            let p = visible_point(&frame, &whole(), &camera(azimuth), at).unwrap();
            // The first twentieth of the slab has half of the opacity: −ln(1/2)/12 of 0.2·2r.
            let behind = z - p.z;
            let half = 0.5f32.ln() / -12.0 * 0.2 * 2.0 * BOUNDS.radius();
            assert!((behind - half).abs() < TOLERANCE, "{azimuth} {at:?}: {behind} behind the surface");
            let back = camera(azimuth).basis();
            let h = back.pixel_from_point(p);
            assert!((h.x / h.z - at[0]).abs() < 1e-2 && (h.y / h.z - at[1]).abs() < 1e-2, "on the ray");
        }
        // Control: another slab, another point.
        let p = visible_point(&slab(0.5, 0.6, 12.0), &whole(), &camera(0.0), [30.0, 20.0]).unwrap();
        assert!(z - p.z > 0.5);
    }

    #[test]
    fn what_is_cut_away_is_not_meant() {
        // Opaque from z = 0.2 r down to −0.2 r; all above z = 0 is cut away.
        let frame = slab(0.4, 0.6, 400.0);
        let cut = Clip { bounds: None, plane: Plane::new(Vec3::NEG_Z, 0.0) }.region(&BOUNDS);
        for camera in [camera(0.2), camera(0.2).to_orthographic(9.0, &BOUNDS)] {
            let p = visible_point(&frame, &cut, &camera, [30.0, 20.0]).unwrap();
            assert!(p.z.abs() < TOLERANCE, "on the cut: {p}");
            let p = visible_point(&frame, &whole(), &camera, [30.0, 20.0]).unwrap();
            assert!((p.z - 0.2 * BOUNDS.radius()).abs() < TOLERANCE, "on the surface: {p}");
        }
    }

    #[test]
    fn where_nothing_is_seen_there_is_no_point() {
        assert_eq!(visible_point(&slab(0.4, 0.6, 0.01), &whole(), &camera(0.0), [30.0, 20.0]), None);
        assert_eq!(visible_point(&slab(0.4, 0.6, 9.0), &whole(), &camera(0.0), [-500.0, 20.0]), None);
        let thin = visible_point(&slab(0.3, 0.7, 0.5), &whole(), &camera(0.0), [30.0, 20.0]).unwrap();
        assert!(thin.z.abs() < 0.3, "in a cloud about its middle: {thin}");
    }
}
