//! The section about the light: shading, highlights, ambient occlusion, shadows and direction.

use std::ops::RangeInclusive;

use egui::{Color32, Rect, Response, Sense, Stroke, Ui, Vec2, pos2, vec2};
use glam::{Quat, Vec3};
use isinglass_core::look::Look;
use isinglass_core::volume::{
    Lighting, OCCLUSION_RADIUS_MAX, OCCLUSION_RADIUS_MIN, SHININESS_MAX, SOFTNESS_MAX_DEGREES,
};

use super::controls::{self, percent, row};
use super::style::named;

/// Shows the section and changes the light. `world_from_view` is the rotation of the camera.
pub(crate) fn show(ui: &mut Ui, look: &mut Look, world_from_view: Quat) {
    let Look { shaded, lighting, .. } = look;
    ui.vertical(|ui| {
        row(ui, "shading", "shows surfaces by how they face the light", |ui| {
            controls::checkbox(ui, shaded, "")
        });
        let hint = "Strength of highlights on shaded surfaces";
        row(ui, "specular", hint, |ui| {
            ui.add_enabled_ui(*shaded, |ui| percent(ui, &mut lighting.specular, 0.0..=100.0)).inner
        });
        row(ui, "shininess", "Higher values make highlights smaller", |ui| {
            let is_on = *shaded && lighting.specular > 0.0;
            let slider =
                controls::slider(ui, &mut lighting.shininess, 1.0..=SHININESS_MAX, |v| format!("{v:.0}"));
            ui.add_enabled(is_on, slider.logarithmic(true).fixed_decimals(0))
        });
        row(ui, "ambient occlusion", "Darkens crevices", |ui| {
            percent(ui, &mut lighting.ambient_occlusion, 0.0..=100.0)
        });
        let hint = "how far matter takes the sky from other matter, in radii of the volume";
        row(ui, "reach", hint, |ui| {
            let range = OCCLUSION_RADIUS_MIN..=OCCLUSION_RADIUS_MAX;
            let is_on = lighting.ambient_occlusion > 0.0;
            slider(ui, is_on, &mut lighting.occlusion_radius, range, (2, ""))
        });
        row(ui, "shadows", "how much of the light comes from one place", |ui| {
            percent(ui, &mut lighting.shadows, 0.0..=100.0)
        });
        row(ui, "softness", "angular radius of the light", |ui| {
            let is_on = lighting.shadows > 0.0;
            slider(ui, is_on, &mut lighting.softness_degrees, 0.0..=SOFTNESS_MAX_DEGREES, (0, "°"))
        });
        let hint = "where the light comes from, around the volume; ctrl+right drag in the picture";
        row(ui, "azimuth", hint, |ui| {
            slider(ui, true, &mut lighting.azimuth_degrees, -180.0..=180.0, (0, "°"))
        });
        row(ui, "elevation", "and how high it stands", |ui| {
            slider(ui, true, &mut lighting.elevation_degrees, -90.0..=90.0, (0, "°"))
        });
    });
    ui.horizontal(|ui| {
        ball(ui, lighting, world_from_view);
        ui.vertical(|ui| {
            ui.label("drag the light; beyond the rim it is behind");
            if ui.button("reset the light").clicked() {
                *lighting = usual_lighting();
            }
        });
    });
}

/// The light of a volume for which nobody chose another.
pub(crate) fn usual_lighting() -> Lighting {
    Lighting { ambient_occlusion: 0.5, ..Lighting::default() }
}

/// The light after a drag in a picture of `height` pixels. A drag over the whole height is half a turn.
pub(crate) fn turned(lighting: Lighting, [x, y]: [f32; 2], height: f32, world_from_view: Quat) -> Lighting {
    let angle = std::f32::consts::PI / height.max(1.0);
    let in_view = Quat::from_rotation_y(x * angle) * Quat::from_rotation_x(y * angle);
    let turn = world_from_view * in_view * world_from_view.inverse();
    lighting.towards(turn * lighting.direction())
}

fn slider(
    ui: &mut Ui,
    is_on: bool,
    number: &mut f32,
    range: RangeInclusive<f32>,
    (decimals, unit): (usize, &str),
) -> Response {
    let slider = controls::slider(ui, number, range, move |v| format!("{v:.decimals$}"));
    ui.add_enabled(is_on, slider.fixed_decimals(decimals).suffix(unit))
}

/// A ball that is lit as in the picture, with a mark for the light.
fn ball(ui: &mut Ui, lighting: &mut Lighting, world_from_view: Quat) {
    let (rect, response) = ui.allocate_exact_size(Vec2::splat(BALL_SIDE), Sense::click_and_drag());
    let response = response.on_hover_text("where the light is, as seen from here");
    named(&response, egui::Role::Slider, "light direction");
    if let Some(at) = response.interact_pointer_pos() {
        let in_view = light_at((at - rect.center()) / (0.5 * BALL_SIDE));
        *lighting = lighting.towards(world_from_view * in_view);
    }
    paint_ball(ui, rect, world_from_view.inverse() * lighting.direction());
}

/// The direction of the light for the position of its mark, in radii from the ball's middle, y down. At two radii the
/// light is behind the ball.
fn light_at(place: Vec2) -> Vec3 {
    let out = place.length().min(2.0);
    let flat = if out > 1.0 { 2.0 - out } else { out };
    let depth = (1.0 - flat * flat).max(0.0).sqrt();
    let side = if place.length() > 1e-6 { place.normalized() * flat } else { Vec2::ZERO };
    Vec3::new(side.x, -side.y, if out > 1.0 { -depth } else { depth })
}

fn paint_ball(ui: &Ui, rect: Rect, light: Vec3) {
    let (center, radius) = (rect.center(), 0.5 * BALL_SIDE - 1.0);
    let mut mesh = egui::Mesh::default();
    // |n·l| would hide which side is lit.
    let color = |n: Vec3| {
        let lit = 0.18 + 0.8 * n.dot(light).max(0.0);
        Color32::from_gray((255.0 * lit.powf(1.0 / 2.2)).min(255.0) as u8)
    };
    let at = |ring: usize, part: usize| {
        let (sin, cos) = (std::f32::consts::TAU * part as f32 / NUM_PARTS as f32).sin_cos();
        let out = (ring as f32 / NUM_RINGS as f32 * std::f32::consts::FRAC_PI_2).sin();
        (vec2(out * cos, out * sin), Vec3::new(out * cos, -out * sin, (1.0 - out * out).max(0.0).sqrt()))
    };
    for ring in 0..=NUM_RINGS {
        for part in 0..NUM_PARTS {
            let (place, n) = at(ring, part);
            mesh.colored_vertex(center + place * radius, color(n));
        }
    }
    let index = |ring: usize, part: usize| (ring * NUM_PARTS + part % NUM_PARTS) as u32;
    for ring in 0..NUM_RINGS {
        for part in 0..NUM_PARTS {
            let (a, b) = (index(ring, part), index(ring, part + 1));
            let (c, d) = (index(ring + 1, part), index(ring + 1, part + 1));
            mesh.add_triangle(a, b, c);
            mesh.add_triangle(b, d, c);
        }
    }
    ui.painter().add(mesh);
    let mark = center + vec2(light.x, -light.y) * radius;
    let yellow = Color32::from_rgb(255, 205, 90);
    let pen = Stroke::new(1.5, Color32::from_gray(25));
    if light.z >= 0.0 {
        ui.painter().circle(mark, 4.5, yellow, pen);
    } else {
        ui.painter().circle_stroke(mark, 4.5, Stroke::new(1.5, yellow));
    }
    let rim = Stroke::new(1.0, ui.visuals().weak_text_color());
    ui.painter().circle_stroke(pos2(center.x, center.y), radius, rim);
}

const BALL_SIDE: f32 = 76.0;
const NUM_RINGS: usize = 8;
const NUM_PARTS: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mark_is_where_the_light_is() {
        for (place, expected) in [
            (vec2(0.0, 0.0), Vec3::Z),
            (vec2(1.0, 0.0), Vec3::X),
            (vec2(0.0, -1.0), Vec3::Y),
            (vec2(0.6, 0.0), Vec3::new(0.6, 0.0, 0.8)),
            (vec2(1.4, 0.0), Vec3::new(0.6, 0.0, -0.8)),
            (vec2(0.0, 5.0), -Vec3::Z),
        ] {
            assert!((light_at(place) - expected).length() < 1e-5, "{place:?}: {}", light_at(place));
        }
    }

    #[test]
    fn the_light_follows_the_hand_in_the_view() {
        let world_from_view = Quat::from_rotation_y(0.7) * Quat::from_rotation_x(-0.4);
        let start = Lighting::default().towards(world_from_view * Vec3::Z);
        // To the right, and up.
        let right = turned(start, [50.0, 0.0], 100.0, world_from_view);
        let in_view = |l: Lighting| world_from_view.inverse() * l.direction();
        assert!((in_view(right) - Vec3::X).length() < 1e-4, "{}", in_view(right));
        let up = turned(start, [0.0, -50.0], 100.0, world_from_view);
        assert!((in_view(up) - Vec3::Y).length() < 1e-4, "{}", in_view(up));
        assert_eq!(up.validate(), Ok(()));
    }
}
