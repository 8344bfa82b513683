//! The probe: the point under the pointer, from the depths of the frame on screen, and its value, from the server.

use std::sync::Arc;

use egui::{Align2, Context, Pos2, RichText, vec2};
use glam::Vec3;
use isinglass_core::wire::{Probed, VolumeDescription, Welcome};

use crate::panels::style::pane;

#[derive(Debug, Default)]
pub(crate) struct ValueProbe {
    is_on: bool,
    asked: Option<Vec3>,
    volume: Option<Arc<Welcome>>,
}

impl ValueProbe {
    pub(crate) fn toggle(&mut self) {
        *self = Self { is_on: !self.is_on, ..Self::default() };
    }

    pub(crate) fn is_on(&self) -> bool {
        self.is_on
    }

    /// Sets the volume to probe. For another volume, the point is requested again.
    pub(crate) fn ask_of(&mut self, volume: Option<&Arc<Welcome>>) {
        let is_same = match (volume, &self.volume) {
            (Some(a), Some(b)) => Arc::ptr_eq(a, b) || a.volume == b.volume,
            (a, b) => a.is_none() == b.is_none(),
        };
        if !is_same {
            (self.asked, self.volume) = (None, volume.cloned());
        }
    }

    /// Sets the point under the pointer. Returns the point to request now; a point at rest is requested once.
    pub(crate) fn point_at(&mut self, point: Option<Vec3>) -> Option<Vec3> {
        let before = std::mem::replace(&mut self.asked, point);
        point.filter(|_| before != point)
    }
}

/// The lines beside the pointer: the value, the position in the file's own world, and the voxel. `answer` is the
/// newest; it counts only for the same voxel.
pub(crate) fn lines(point: Vec3, answer: Option<&Probed>, volume: &VolumeDescription) -> [String; 3] {
    let unit = volume.unit.as_deref().map_or(String::new(), |u| format!(" {u}"));
    let place = match &volume.placement {
        Some(placement) => placement.file_from_world(point),
        None => point.to_array().map(f64::from),
    };
    // Nobody can point more finely than a tenth of a voxel.
    let finest = f64::from(volume.spacing.iter().copied().fold(f32::INFINITY, f32::min));
    let decimals = (1.0 - finest.log10()).ceil().clamp(0.0, 6.0) as usize;
    let names = names(volume);
    let told = |i: usize| match names[i] {
        (_, Some(opposite)) if place[i] < 0.0 => format!("{opposite} {:.decimals$}", -place[i]),
        (name, _) => format!("{name} {:.decimals$}", place[i]),
    };
    let coordinates = [0, 1, 2].map(told);
    let index = voxel_at(point, volume);
    let [x, y, z] = index;
    // While the pointer moves, the newest answer is late. It is right while the voxel is the same.
    let found = answer.and_then(|a| a.voxel).filter(|voxel| voxel.index == index);
    let value = found.map_or("…".to_owned(), |found| {
        let unit = volume.value_unit.as_deref().map_or(String::new(), |u| format!(" {u}"));
        let level = if found.level > 0 { format!(" (level {})", found.level) } else { String::new() };
        format!("{}{unit}{level}", found.value)
    });
    [value, format!("{}{unit}", coordinates.join("  ")), format!("voxel {x}, {y}, {z}")]
}

/// The indices of the voxel that holds a point, or of the nearest one.
pub(crate) fn voxel_at(point: Vec3, volume: &VolumeDescription) -> [u32; 3] {
    let from_corner = point - volume.bounds().min;
    std::array::from_fn(|i| {
        ((from_corner[i] / volume.spacing[i]).max(0.0) as u32).min(volume.dims[i].saturating_sub(1))
    })
}

/// The names of the coordinates of the file's world, and their names below zero if there are such. A body's world is
/// right-anterior-superior.
fn names(volume: &VolumeDescription) -> [(&'static str, Option<&'static str>); 3] {
    let is_body = volume.orientation.is_some() && volume.placement.is_some();
    match is_body {
        true => [("R", Some("L")), ("A", Some("P")), ("S", Some("I"))],
        false => [("x", None), ("y", None), ("z", None)],
    }
}

/// Shows the lines beside the pointer, inside the window.
pub(crate) fn show(ctx: &Context, at: Pos2, lines: &[String; 3]) {
    let screen = ctx.content_rect();
    let right = at.x < screen.right() - 260.0;
    let below = at.y < screen.bottom() - 110.0;
    let pivot = match (right, below) {
        (true, true) => Align2::LEFT_TOP,
        (true, false) => Align2::LEFT_BOTTOM,
        (false, true) => Align2::RIGHT_TOP,
        (false, false) => Align2::RIGHT_BOTTOM,
    };
    let side = |is_after: bool| if is_after { 16.0 } else { -16.0 };
    let place = at + vec2(side(right), side(below));
    let area = egui::Area::new(egui::Id::unique("probe")).fixed_pos(place).pivot(pivot).interactable(false);
    area.order(egui::Order::Tooltip).show(ctx, |ui| {
        pane(ctx).show(ui, |ui| {
            ui.set_max_width(320.0);
            ui.spacing_mut().item_spacing.y = 1.0;
            let [value, place, voxel] = lines;
            ui.label(RichText::new(value).strong().size(15.0));
            ui.label(RichText::new(place).size(11.5));
            ui.label(RichText::new(voxel).weak().size(11.5));
        });
    });
}

#[cfg(test)]
mod tests {
    use isinglass_core::ids::ProbeId;
    use isinglass_core::volume::Placement;
    use isinglass_core::wire::ProbedVoxel;

    use super::*;

    fn volume() -> VolumeDescription {
        VolumeDescription {
            name: "head".into(),
            dims: [10, 10, 10],
            spacing: [0.5, 0.5, 2.0],
            unit: Some("mm".into()),
            orientation: Some("RAS".into()),
            placement: Some(Placement {
                center: [10.0, -20.0, 30.0],
                axes: [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
            }),
            value_unit: Some("HU".into()),
            value_range: (0.0, 1.0),
            histogram_range: (0.0, 1.0),
            histogram: vec![1],
            channels: vec![],
        }
    }

    fn welcome() -> Welcome {
        let source = crate::view::viewing::tests::FakeSource { max_side: Some(1), ..Default::default() };
        let described = crate::view::frame_source::FrameSource::description(&source);
        Arc::unwrap_or_clone(described.unwrap())
    }

    fn probed(point: Vec3) -> Probed {
        let voxel = Some(ProbedVoxel { index: [7, 9, 3], value: -42.5, level: 0 });
        Probed { id: ProbeId(1), point: point.to_array(), voxel }
    }

    #[test]
    fn the_place_is_told_in_the_world_of_the_file() {
        let point = Vec3::new(1.25, 2.0, -3.0);
        let [value, place, voxel] = lines(point, Some(&probed(point)), &volume());
        // x along R, y along S, z against A.
        assert_eq!(place, "R 11.25  P 17.00  S 32.00 mm");
        assert_eq!((&value[..], &voxel[..]), ("-42.5 HU", "voxel 7, 9, 3"));
        let unplaced = VolumeDescription { placement: None, unit: None, value_unit: None, ..volume() };
        let [value, place, _] = lines(point, Some(&probed(point)), &unplaced);
        assert_eq!((&value[..], &place[..]), ("-42.5", "x 1.25  y 2.00  z -3.00"));
        // An answer for another voxel is none for this; one for another point of the same is.
        let other = Vec3::new(1.0, 1.3, -3.0);
        assert_eq!(lines(other, Some(&probed(point)), &volume())[0], "…");
        assert_eq!(lines(point + 0.1, Some(&probed(point)), &volume())[0], "-42.5 HU");
        let voxel = probed(point).voxel.map(|voxel| ProbedVoxel { level: 2, ..voxel });
        let coarse = Probed { voxel, ..probed(point) };
        assert_eq!(lines(point, Some(&coarse), &volume())[0], "-42.5 HU (level 2)");
        assert_eq!(lines(point, Some(&Probed { voxel: None, ..probed(point) }), &volume())[0], "…");
        assert_eq!(lines(point, None, &volume())[2], "voxel 7, 9, 3");
    }

    #[test]
    fn a_point_that_rests_is_asked_for_again_of_another_volume() {
        let volume = |name: &str| {
            let volume = VolumeDescription { name: name.into(), ..volume() };
            Arc::new(Welcome { volume, ..welcome() })
        };
        let (head, heart) = (volume("head"), volume("heart"));
        let mut probe = ValueProbe::default();
        let mut asks = |volume| {
            probe.ask_of(Some(volume));
            probe.point_at(Some(Vec3::ONE)).is_some()
        };
        assert_eq!([asks(&head), asks(&head), asks(&heart), asks(&heart)], [true, false, true, false]);
    }

    #[test]
    fn a_point_that_rests_is_asked_for_once() {
        let mut probe = ValueProbe::default();
        assert!(!probe.is_on());
        probe.toggle();
        assert!(probe.is_on());
        let mut asked = |x: f32| probe.point_at(Some(Vec3::splat(x)));
        assert_eq!([asked(1.0), asked(1.0), asked(2.0)], [Some(Vec3::ONE), None, Some(Vec3::splat(2.0))]);
        assert_eq!(probe.point_at(None), None);
        assert_eq!(probe.point_at(Some(Vec3::ONE)), Some(Vec3::ONE));
    }
}
