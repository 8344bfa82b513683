//! Highlights against their closed form: their colour, their place, and where there are none.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::layer::COLOR_MAX;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::space::Ray;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::Lighting;
use isinglass_core::volume::fields::Field;

const DARK: [f32; 3] = [0.3, 0.2, 0.1];
const RADIUS: f32 = 0.6;
const BALL: Field = Field::Sphere { peak: 1.0, radius: 0.95 };
const SIDE: u32 = 80;

fn transfer(color: [f32; 3]) -> TransferFunction {
    let p = |x| ControlPoint { x, color, opacity: 0.9 };
    TransferFunction {
        name: "even".into(),
        domain: Domain::Values(0.0, 1.0),
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0), p(1.0)],
    }
}

/// A ball of [`RADIUS`] as a surface of [`BALL`].
fn ball(color: [f32; 3], lighting: Lighting) -> Scene {
    let isos = Isos::new(&[Iso { value: BALL.sigma(Vec3::X * RADIUS), opacity: 1.0 }]).unwrap();
    let settings = MarchSettings { mode: Mode::Iso, isos, ..MarchSettings::of(true, lighting) };
    Scene::new(Arc::new(BALL.volume(SIDE)), &transfer(color), settings)
}

fn camera(scene: &Scene, azimuth_degrees: f32, is_parallel: bool) -> Camera {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(61, 61, 0.5);
    let pose = Pose::orbit(Vec3::ZERO, azimuth_degrees.to_radians(), 0.3, 5.0);
    let camera = Camera::new(pose, intrinsics, &bounds);
    if is_parallel { camera.to_orthographic(5.0, &bounds) } else { camera }
}

/// What a highlight adds where the unit normal is `n`, for a weight of the gradient.
fn highlight(n: Vec3, ray: &Ray, lighting: &Lighting, weight: f32) -> f32 {
    let (eye, light) = (-ray.dir, lighting.direction());
    let lobe = |l: Vec3| {
        let half = (eye + l).normalize_or_zero();
        let x = 0.5 * (1.0 + eye.dot(l));
        x * x * (3.0 - 2.0 * x) * n.dot(half).abs().powf(lighting.shininess)
    };
    lighting.specular * weight * (lobe(light) + lobe(-light))
}

fn weight(gradient_per_world: f32) -> f32 {
    let square = (gradient_per_world * 2.0 / SIDE as f32).powi(2);
    square / (square + 1e-4)
}

/// Each pixel with its ray, and how much brighter it is in `glossy`, which must be white.
fn added<'a>(
    glossy: &'a Picture,
    matte: &'a Picture,
    camera: &'a Camera,
) -> impl Iterator<Item = (Ray, f32)> + 'a {
    glossy.pixels.iter().zip(&matte.pixels).enumerate().map(|(i, (a, b))| {
        let (x, y) = (i as u32 % glossy.width, i as u32 / glossy.width);
        let (ray, _) = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
        let more = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
        assert!(more.iter().all(|m| (m - more[0]).abs() < 1e-5) && a[3] == b[3], "white: {more:?}");
        (ray, more[0])
    })
}

/// Where a ray meets the ball, as a normal; not at the rim.
fn normal_of_ball(ray: &Ray) -> Option<Vec3> {
    let nearest = -ray.origin.dot(ray.dir);
    let square = RADIUS * RADIUS - (ray.origin + ray.dir * nearest).length_squared();
    let n = (ray.origin + ray.dir * (nearest - square.max(0.0).sqrt())) / RADIUS;
    (square > 0.0 && n.dot(ray.dir) < -0.3).then_some(n)
}

/// Greatest difference of a ball's highlight from its closed form under another light, and the greatest highlight with
/// its pixel's ray.
fn compare(lighting: Lighting, azimuth: f32, is_parallel: bool, claimed: &Lighting) -> (f32, f32, Ray) {
    let scene = ball(DARK, lighting);
    let matte = ball(DARK, Lighting { specular: 0.0, ..lighting });
    let camera = camera(&scene, azimuth, is_parallel);
    let (glossy, matte) = (render(&scene, &camera), render(&matte, &camera));
    let (mut worst, mut brightest, mut at) = (0f32, 0f32, None);
    for (ray, found) in added(&glossy, &matte, &camera) {
        let Some(n) = normal_of_ball(&ray) else { continue };
        // The gradient of 1 − r²/R² at the ball's radius.
        let exact = highlight(n, &ray, claimed, weight(2.0 * RADIUS / (0.95 * 0.95)));
        worst = worst.max((found - exact).abs());
        if found > brightest {
            (brightest, at) = (found, Some(ray));
        }
    }
    (worst, brightest, at.unwrap())
}

#[test]
fn a_ball_has_its_highlight_where_the_formula_says() {
    let light = Lighting { specular: 0.8, ..Lighting::default() };
    for shininess in [1.0, 20.0, 60.0] {
        for (azimuth, is_parallel) in [(0.0, false), (-50.0, true), (100.0, false), (170.0, true)] {
            let lighting = Lighting { shininess, ..light };
            let (worst, brightest, at) = compare(lighting, azimuth, is_parallel, &lighting);
            // The surface of trilinear values lies up to 5e-4 beside the ball's, which turns the normal.
            assert!(worst < 0.01, "{shininess} from {azimuth}: {worst}");
            assert!(brightest > 0.3, "{brightest}");
            if shininess > 1.0 && azimuth <= 0.0 {
                let half = (light.direction() - at.dir).normalize();
                let n = normal_of_ball(&at).unwrap();
                assert!(n.dot(half) > 0.995, "{shininess} from {azimuth}: at {n}, expected {half}");
            }
            // Negative controls: another light, another exponent, no highlight.
            for other in [
                Lighting { azimuth_degrees: lighting.azimuth_degrees + 20.0, ..lighting },
                Lighting { shininess: 3.0 * shininess, ..lighting },
                Lighting { specular: 0.0, ..lighting },
            ] {
                let (worst, ..) = compare(lighting, azimuth, is_parallel, &other);
                assert!(worst > 0.05, "{other:?}: {worst}");
            }
        }
    }
}

/// The way around is even: the light is two-sided, and no side begins with a jump.
#[test]
fn a_highlight_moves_evenly_as_the_eye_goes_around() {
    let lighting =
        Lighting { specular: 1.0, azimuth_degrees: 0.0, elevation_degrees: 0.0, ..Lighting::default() };
    let (scene, matte) = (ball(DARK, lighting), ball(DARK, Lighting { specular: 0.0, ..lighting }));
    let brightest = |azimuth: f32| {
        let camera = camera(&scene, azimuth, true);
        let (glossy, matte) = (render(&scene, &camera), render(&matte, &camera));
        added(&glossy, &matte, &camera).map(|(_, more)| more).fold(0.0, f32::max)
    };
    let turn: Vec<f32> = (0..=12).map(|i| brightest(15.0 * i as f32)).collect();
    for pair in turn.windows(2) {
        assert!((pair[0] - pair[1]).abs() < 0.2, "{turn:?}");
    }
    assert!((turn[0] - turn[12]).abs() < 0.02, "the same from both sides: {turn:?}");
}

#[test]
fn a_medium_shines_by_its_gradient() {
    let lighting = Lighting {
        specular: 0.9,
        shininess: 4.0,
        azimuth_degrees: 90.0,
        elevation_degrees: 0.0,
        ..Lighting::default()
    };
    let slope = 0.4;
    let scene = |lighting| {
        let volume = Field::Ramp { at_zero: 0.5, slope }.volume(SIDE);
        Scene::new(Arc::new(volume), &transfer(DARK), MarchSettings::of(true, lighting))
    };
    let (glossy, matte) = (scene(lighting), scene(Lighting { specular: 0.0, ..lighting }));
    let camera = camera(&glossy, 0.0, false);
    let (glossy, matte) = (render(&glossy, &camera), render(&matte, &camera));
    let (mut num, mut greatest) = (0, 0f32);
    for (i, (ray, found)) in added(&glossy, &matte, &camera).enumerate() {
        // Through the front face, away from the faces across x, where half of a difference is missing.
        let p = ray.origin + ray.dir * ((1.0 - ray.origin.z) / ray.dir.z);
        if p.x.abs() > 0.8 || p.y.abs() > 0.8 {
            continue;
        }
        let exact = highlight(Vec3::X, &ray, &lighting, weight(slope)) * glossy.pixels[i][3];
        assert!((found - exact).abs() < 1e-3, "{found}, expected {exact}");
        let flat = highlight(Vec3::X, &ray, &lighting, 1.0);
        (num, greatest) = (num + 1, greatest.max((found - flat).abs()));
    }
    assert!(num > 100 && greatest > 0.05, "negative control: without the weight {greatest} off");
}

#[test]
fn shade_takes_the_highlight_with_the_light() {
    let behind = Lighting {
        specular: 0.8,
        azimuth_degrees: 180.0,
        elevation_degrees: 0.0,
        softness_degrees: 0.0,
        ..Lighting::default()
    };
    let brightest = |lighting| {
        let (scene, matte) = (ball(DARK, lighting), ball(DARK, Lighting { specular: 0.0, ..lighting }));
        let camera = camera(&scene, 0.0, true);
        let (glossy, matte) = (render(&scene, &camera), render(&matte, &camera));
        added(&glossy, &matte, &camera).map(|(_, more)| more).fold(0.0, f32::max)
    };
    // Some light comes around the rim.
    let shadowed = brightest(Lighting { shadows: 1.0, ..behind });
    assert!(shadowed < 0.03, "{shadowed}");
    // Negative controls: without shadows, and with the light on the eye's side.
    assert!(brightest(behind) > 0.5);
    assert!(brightest(Lighting { shadows: 1.0, azimuth_degrees: 0.0, ..behind }) > 0.5);
}

#[test]
fn no_highlight_is_brighter_than_the_wire_carries() {
    let lighting = Lighting { specular: 1.0, ..Lighting::default() };
    let scene = ball([1.0, 0.5, 0.0], lighting);
    let picture = render(&scene, &camera(&scene, -30.0, false));
    let greatest = |channel: usize| picture.pixels.iter().map(|p| p[channel]).fold(0.0, f32::max);
    assert!(greatest(0) <= COLOR_MAX && greatest(0) > 0.99 * COLOR_MAX, "{}", greatest(0));
    assert!(greatest(2) > 0.5 && greatest(2) < 1.0, "negative control: {}", greatest(2));
}

#[test]
fn where_nothing_shines_not_a_bit_changes() {
    let volume = Arc::new(BALL.volume(40));
    let picture = |settings: MarchSettings| {
        let scene = Scene::new(volume.clone(), &transfer([0.9, 0.6, 0.3]), settings);
        render(&scene, &camera(&scene, 20.0, false))
    };
    let shiny = Lighting { specular: 0.7, shininess: 90.0, ..Lighting::default() };
    for mode in Mode::ALL {
        for (shaded, specular) in [(true, 0.0), (false, 0.7), (true, 0.7)] {
            let with = |lighting| MarchSettings { mode, ..MarchSettings::of(shaded, lighting) };
            let plain = picture(with(Lighting::default()));
            let found = picture(with(Lighting { specular, ..shiny }));
            let shines = shaded && specular > 0.0 && !mode.is_projection();
            assert_eq!(found == plain, !shines, "{mode}, shaded {shaded}, specular {specular}");
        }
    }
}
