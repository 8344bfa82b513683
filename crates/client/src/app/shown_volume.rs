//! What is known of the shown volume, and what happens to points in it when another part of the file is shown.

use std::sync::Arc;
use std::time::Duration;

use glam::{DMat3, DVec3, Vec3};
use isinglass_core::wire::{VolumeDescription, Welcome};

use super::ViewerApp;
use crate::panels::value_scale::ValueScale;
use crate::view::frame_source::FrameSource;

/// The volume of the last refresh.
pub(super) struct ShownVolume {
    of: Arc<Welcome>,
    /// Of each channel.
    scales: Vec<Arc<ValueScale>>,
}

impl<S: FrameSource> ViewerApp<S> {
    /// Notes which volume is shown. Points that were set in the one before stay where they are in the file, or go.
    pub(super) fn follow_volume(&mut self, now: Duration) {
        let Some(of) = self.viewing.source().description() else { return };
        if self.shown_volume.as_ref().is_some_and(|shown| Arc::ptr_eq(&shown.of, &of)) {
            return;
        }
        let bounds = of.volume.bounds();
        let of_channels = of.volume.channels.iter().map(ValueScale::of_channel);
        let mut scales: Vec<_> = of_channels.map(Arc::new).collect();
        if scales.is_empty() {
            scales.push(Arc::new(ValueScale::of(&of.volume)));
        }
        let after = of.clone();
        let Some(before) = self.shown_volume.replace(ShownVolume { of, scales }) else { return };
        match shift(&before.of.volume, &after.volume) {
            Some(by) => {
                self.measures.shift(by);
                self.slices.point += by;
                for view in &mut self.named_views {
                    view.center = (Vec3::from_array(view.center) + by).to_array();
                }
            }
            None => {
                let has_any = !self.measures.measures().is_empty() || !self.named_views.is_empty();
                self.measures.set(Vec::new());
                self.named_views.clear();
                self.slices.point = bounds.center();
                if has_any {
                    self.tell(now, "Measurements and named views were of another volume, and are gone");
                }
            }
        }
        self.slices.point = self.slices.point.clamp(bounds.min, bounds.max);
    }

    /// The values of the first channel, which slices show.
    pub(super) fn scale_of_slices(&self) -> Option<Arc<ValueScale>> {
        self.shown_volume.as_ref()?.scales.first().cloned()
    }

    /// The values of the chosen channel.
    pub(super) fn value_scale(&self) -> Option<Arc<ValueScale>> {
        let chosen = self.viewing.look().map_or(0, |look| usize::from(look.channels.chosen));
        let scales = &self.shown_volume.as_ref()?.scales;
        scales.get(chosen).or(scales.first()).cloned()
    }
}

/// How far points move that stay where they are in the file; none if that is unknown.
fn shift(before: &VolumeDescription, after: &VolumeDescription) -> Option<Vec3> {
    match (&before.placement, &after.placement) {
        (Some(a), Some(b)) => {
            let [from, to] = [a, b].map(|p| DMat3::from_cols_array_2d(&p.axes));
            let by = from.inverse() * (DVec3::from_array(a.center) - DVec3::from_array(b.center));
            let is_parallel = from.abs_diff_eq(to, 1e-6) && before.unit == after.unit;
            Some(by.as_vec3()).filter(|by| is_parallel && by.is_finite())
        }
        (None, None) => {
            // Levels of one image differ by the rounding of their sizes.
            let slack = Vec3::from_array(before.spacing).max(Vec3::from_array(after.spacing));
            let apart = (before.bounds().max - after.bounds().max).abs();
            apart.cmple(slack).all().then_some(Vec3::ZERO)
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use isinglass_core::volume::Placement;

    use super::*;
    use crate::view::viewing::tests::FakeSource;

    fn volume(dims: [u32; 3], center: Option<[f64; 3]>) -> VolumeDescription {
        let of = FakeSource { max_side: Some(1), ..Default::default() }.description().unwrap();
        let axes = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let placement = center.map(|center| Placement { center, axes });
        VolumeDescription { dims, placement, ..of.volume.clone() }
    }

    #[test]
    fn a_point_stays_where_it_is_in_the_file() {
        let whole = volume([100; 3], Some([10.0, 20.0, 30.0]));
        let region = volume([40; 3], Some([12.5, 21.0, 27.0]));
        let by = shift(&whole, &region).unwrap();
        let point = Vec3::new(3.0, -4.0, 5.0);
        let [a, b] = [(&whole, point), (&region, point + by)]
            .map(|(volume, point)| volume.placement.unwrap().file_from_world(point));
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5), "{a:?} {b:?}");
        assert!(by.length() > 1.0, "control");
        let mut turned = region.clone();
        turned.placement.as_mut().unwrap().axes.swap(0, 1);
        assert_eq!(shift(&whole, &turned), None);
        // Without a place in a world, only the whole of an image is known to lie where it did.
        let whole = volume([101; 3], None);
        let level = VolumeDescription { spacing: [2.0; 3], ..volume([50; 3], None) };
        assert_eq!(shift(&whole, &level), Some(Vec3::ZERO));
        assert_eq!(shift(&whole, &volume([40; 3], None)), None);
    }
}
