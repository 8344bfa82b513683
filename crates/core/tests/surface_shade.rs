//! Light where only surfaces are shown: what they hold up, against closed forms.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Detail, LIT_MAX, Lighting, Volume, Voxels};

/// Sides of the volumes; a cell is a voxel up to 128.
const SIDE: u32 = 64;

/// A volume of voxels with sides of 1 around the origin that stores `f` there.
fn volume(f: impl Fn(Vec3) -> f32) -> Arc<Volume> {
    let at = |i: u32| i as f32 + 0.5 - 0.5 * SIDE as f32;
    let point = |i: u32| Vec3::new(at(i % SIDE), at(i / SIDE % SIDE), at(i / SIDE / SIDE));
    let voxels = (0..SIDE.pow(3)).map(|i| f(point(i)));
    let voxels = Voxels::F32(voxels.collect());
    Arc::new(Volume::new([SIDE; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap())
}

/// White; its opacities count for nothing where only surfaces are shown.
fn white(opacity: f32) -> TransferFunction {
    let p = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
    TransferFunction {
        name: "white".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0, opacity), p(1.0, opacity)],
    }
}

/// The light comes from +y, and from +x where it is low.
const OFF: Lighting = Lighting {
    ambient_occlusion: 0.0,
    occlusion_radius: 0.15,
    shadows: 0.0,
    softness_degrees: 0.0,
    azimuth_degrees: 90.0,
    elevation_degrees: 90.0,
    specular: 0.0,
    shininess: 20.0,
};
const OCCLUSION: Lighting = Lighting { ambient_occlusion: 1.0, ..OFF };
const SHADOW: Lighting = Lighting { shadows: 1.0, ..OFF };

fn settings(isos: &[Iso], lighting: Lighting) -> MarchSettings {
    let isos = Isos::new(isos).unwrap();
    MarchSettings { mode: Mode::Iso, isos, ..MarchSettings::of(false, lighting) }
}

fn lit(volume: &Arc<Volume>, isos: &[Iso], lighting: Lighting) -> Scene {
    Scene::new(volume.clone(), &white(0.5), settings(isos, lighting))
}

const OPAQUE: Iso = Iso { value: 0.0, opacity: 1.0 };

/// Brightness at a point, as a march reads it.
fn brightness(scene: &Scene, p: Vec3) -> f32 {
    let lit = scene.illumination.lit().unwrap();
    let u = p + 0.5 * SIDE as f32 - 0.5;
    let corner = u.floor();
    let mut sum = 0.0;
    for i in 0..8 {
        let q = corner + Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32);
        let weight = (Vec3::ONE - (u - q).abs()).to_array().iter().product::<f32>();
        let [x, y, z] = q.to_array().map(|n| (n as i32).clamp(0, SIDE as i32 - 1) as usize);
        let n = SIDE as usize;
        sum += weight * f32::from(lit.shares[(z * n + y) * n + x]);
    }
    lit.ambient + lit.diffuse * sum / LIT_MAX
}

/// Unshaded matter with occlusion alone is as bright as its sky is open; with shadows alone a quarter is ambient.
fn sky(scene: &Scene, p: Vec3) -> f32 {
    brightness(scene, p)
}

fn sun(scene: &Scene, p: Vec3) -> f32 {
    (brightness(scene, p) - 0.25) / 0.75
}

#[test]
fn a_plane_sees_half_of_the_sky_a_groove_a_quarter_and_a_corner_an_eighth() {
    // A block without the part where so many coordinates are above a plane, which lies between the voxels' middles at any
    // place; with noise in the matter behind, as a scan has.
    let mut flats = Vec::new();
    for (shift, depth) in [(0.0, 1.0), (0.3, 1.0), (0.5, 4.0), (0.8, 4.0)] {
        let walls = |num: usize| {
            let f = move |p: Vec3| {
                let away = p.to_array()[..num].iter().map(|x| x - shift).fold(99.0, f32::min);
                let inside = (24.0 - p.abs().max_element()).min(-away);
                let noise = 0.2 * p.dot(Vec3::new(3.1, 5.7, 9.3)).sin();
                inside.clamp(-depth, depth) + if inside > 2.0 { noise } else { 0.0 }
            };
            lit(&volume(f), &[OPAQUE], OCCLUSION)
        };
        let on = |num: usize| {
            let mut p = Vec3::splat(12.0);
            // Half a voxel off all of them: a place in a groove, and not its very bottom.
            p.as_mut()[..num].fill(shift + 0.5);
            sky(&walls(num), p)
        };
        let flat = on(1);
        // A line that grazes a wall runs where its cells are mixed with air.
        assert!((0.9..=1.0).contains(&flat), "{shift}: {flat}");
        flats.push(flat);
        for (num, expected) in [(2, 0.5), (3, 0.25)] {
            let found = on(num) / flat;
            assert!((found - expected).abs() < 0.08, "{shift}, {num} walls: {found} for {expected}");
        }
    }
    // Wherever the plane lies: no bands where a surface runs askew.
    let [least, most] = [f32::min, f32::max].map(|f| flats.iter().copied().reduce(f).unwrap());
    assert!(most - least < 0.06, "{flats:?}");
}

#[test]
fn a_ball_throws_its_shadow_on_the_floor_where_the_light_says() {
    let (center, radius, floor) = (Vec3::new(4.0, 2.0, 0.0), 9.0, -20.0);
    let f = |p: Vec3| (radius - p.distance(center)).max(floor - p.y);
    for elevation_degrees in [90.0, 60.0] {
        let lighting = Lighting { elevation_degrees, ..SHADOW };
        let scene = lit(&volume(f), &[OPAQUE], lighting);
        let light = lighting.direction();
        let (mut num_dark, mut num_bright) = (0, 0);
        for x in -28..28 {
            for z in -28..28 {
                let p = Vec3::new(x as f32 + 0.5, floor, z as f32 + 0.5);
                let beside = (center - p).reject_from(light).length();
                let found = sun(&scene, p);
                // Cells are mixed with their neighbours, of matter and along lines: two of them are neither.
                if beside < radius - 2.0 {
                    assert!(found < 0.05, "{elevation_degrees}, {p}: {found} in the shadow");
                    num_dark += 1;
                } else if beside > radius + 2.0 {
                    assert!(found > 0.9, "{elevation_degrees}, {p}: {found} in the light");
                    num_bright += 1;
                }
            }
        }
        assert!(num_dark > 100 && num_bright > 1000, "{num_dark} {num_bright}");
        // The ball's own sides, seen from the light and from behind.
        assert!(sun(&scene, center + light * radius) > 0.95 && sun(&scene, center - light * radius) < 0.05);
    }
    // In the picture: straight from above under a slanting light the floor's shadow is seen.
    let lighting = Lighting { elevation_degrees: 45.0, ..SHADOW };
    let scene = lit(&volume(f), &[OPAQUE], lighting);
    let bounds = scene.volume.bounds();
    let middle = |target: Vec3| {
        let eye = target + Vec3::new(0.0, 300.0, 0.1);
        let camera =
            Camera::new(Pose::look_at(eye, target, Vec3::Z), Intrinsics::perspective(1, 1, 0.001), &bounds);
        render(&scene, &camera).pixels[0][0]
    };
    let shadow = center - lighting.direction() * (center.y - floor) / lighting.direction().y;
    assert!((middle(shadow) - 0.25).abs() < 0.02, "{}", middle(shadow));
    assert!(middle(Vec3::new(20.0, floor, 0.0)) > 0.95);
}

#[test]
fn what_is_not_seen_makes_no_difference() {
    let f = |p: Vec3| 12.0 - p.length() + 0.3 * (p.x * 0.9).sin();
    let ball = volume(f);
    let both = Lighting { ambient_occlusion: 1.0, shadows: 1.0, softness_degrees: 10.0, ..OFF };
    let scene = lit(&ball, &[OPAQUE], both);
    let shares = |scene: &Scene| scene.illumination.lit().unwrap().shares.clone();
    // Neither the transfer function,
    let thin = Scene::new(ball.clone(), &white(0.001), settings(&[OPAQUE], both));
    assert_eq!(shares(&scene), shares(&thin));
    // nor what opaque surfaces enclose,
    let inner = [Iso { value: 5.0, opacity: 1.0 }, OPAQUE];
    assert_eq!(shares(&scene), shares(&lit(&ball, &inner, both)));
    let hollow = volume(|p| if p.length() < 6.0 { 20.0 } else { f(p) });
    assert_eq!(shares(&scene), shares(&lit(&hollow, &[OPAQUE], both)));
    // nor which side has the greater values, if that around is the lesser or the greater all over.
    let turned = volume(|p| -f(p));
    let apart = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    // A voxel that has the value itself counts for the greater side.
    assert!(apart(&shares(&scene), &shares(&lit(&turned, &[OPAQUE], both))) <= 2);
    // Negative controls: with matter as a medium the function makes a difference; another value is another surface; and
    // what is cut away throws no shade.
    let medium = |opacity| {
        let settings = MarchSettings { mode: Mode::Composite, ..settings(&[], both) };
        shares(&Scene::new(ball.clone(), &white(opacity), settings))
    };
    assert_ne!(medium(0.5), medium(0.001));
    assert!(apart(&shares(&scene), &medium(0.5)) > 50);
    assert!(apart(&shares(&scene), &shares(&lit(&ball, &[Iso { value: 5.0, opacity: 1.0 }], both))) > 50);
    let clip = Clip { plane: Plane::new(Vec3::NEG_Y, 0.0), ..Clip::default() };
    let cut = Scene::new(ball, &white(0.5), MarchSettings { clip, ..settings(&[OPAQUE], SHADOW) });
    assert!(sun(&cut, Vec3::new(0.0, -4.0, 0.0)) < 0.05, "within the ball");
    assert!(sun(&cut, Vec3::new(0.0, 0.0, 0.0)) > 0.3, "where it is cut open");
}

#[test]
fn a_translucent_sheet_lets_through_what_its_opacity_leaves() {
    for opacity in [0.3, 0.7] {
        let sheets = volume(|p| p.y);
        let isos = [Iso { value: 3.2, opacity }, Iso { value: -8.0, opacity: 0.5 }];
        for detail in [Detail::Final, Detail::Draft] {
            let settings = MarchSettings { detail, ..settings(&isos, SHADOW) };
            let scene = Scene::new(sheets.clone(), &white(0.5), settings);
            for (y, expected) in [(20.0, 1.0), (-2.5, 1.0 - opacity), (-20.0, (1.0 - opacity) * 0.5)] {
                let found = sun(&scene, Vec3::new(1.0, y, -2.0));
                // A brightness is a byte; cells of a draft are two voxels wide, and mixed.
                let tolerance = if detail == Detail::Final { 0.006 } else { 0.015 };
                assert!(
                    (found - expected).abs() < tolerance,
                    "{detail:?}, {opacity}, {y}: {found} for {expected}"
                );
            }
        }
    }
    // A tilted sheet: as a layer, by 1/cos more. Its crossings are counted in steps of a voxel.
    let normal = Vec3::new(0.5, 1.0, 0.2).normalize();
    let tilted = volume(|p| normal.dot(p));
    let scene = lit(&tilted, &[Iso { value: 0.0, opacity: 0.5 }], SHADOW);
    let found = sun(&scene, Vec3::new(0.0, -15.0, 0.0));
    let expected = 0.5f32.powf(1.0 / normal.y);
    assert!((found - expected).abs() < 0.06, "{found} for {expected}");
}
