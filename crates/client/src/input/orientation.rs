//! The directions of the world's axes, and the standard views that follow from them.

use glam::{Mat3, Quat, Vec3};
use isinglass_core::space::{IMAGE_AXES, world_from_upright};
use isinglass_formats::UpAxis;

use crate::input::bindings::{Opposite, Side};

/// The names of the axes' ends, and where front and top of the volume are.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Orientation {
    /// For x, y and z the letter at the positive end, and at the negative end if the volume names it.
    pub(crate) letters: [(char, Option<char>); 3],
    world_from_upright: Quat,
    /// From the space that names the sides. A body keeps its sides where another axis is up.
    world_from_sides: Quat,
    /// The up direction of the view from the top, space of the sides.
    up_from_top: Vec3,
    /// The direction from which the view from the right looks, space of the sides.
    right: Vec3,
}

impl Orientation {
    /// From letters such as `RAS`. Without those of a body the axes are x, y and z, with z towards the viewer and y up.
    /// In an image, z runs back from the viewer and y down.
    pub(crate) fn of(letters: Option<&str>) -> Self {
        let upright = world_from_upright(letters.filter(|letters| *letters == IMAGE_AXES));
        letters.and_then(Self::of_patient).unwrap_or(Self {
            letters: [('x', None), ('y', None), ('z', None)],
            world_from_upright: upright,
            world_from_sides: upright,
            up_from_top: Vec3::NEG_Z,
            right: Vec3::X,
        })
    }

    fn of_patient(letters: &str) -> Option<Self> {
        let ends: Vec<char> = letters.chars().collect();
        let ends: [char; 3] = ends.try_into().ok()?;
        // Without one letter of each pair, the letters mean nothing.
        if ["RL", "AP", "SI"].iter().any(|pair| !ends.iter().any(|&end| pair.contains(end))) {
            return None;
        }
        let world_from_sides = world_from_upright(Some(letters));
        Some(Self {
            letters: ends.map(|end| (end, opposite(end))),
            world_from_upright: world_from_sides,
            world_from_sides,
            // A radiologist's convention: anterior is up in a view along the body.
            up_from_top: Vec3::Z,
            // A patient who faces us has the right side on our left.
            right: Vec3::NEG_X,
        })
    }

    /// The same axes with another one upwards.
    pub(crate) fn with_up(self, axis: UpAxis) -> Self {
        let Some(up) = axis.direction() else { return self };
        let own = |v: Vec3| (self.world_from_upright * v).round();
        let (own_up, front) = (own(Vec3::Y), own(Vec3::Z));
        // An axis that came towards the viewer turns up, and what was up turns away.
        let front = if up.dot(front).abs() > 0.5 { -own_up * up.dot(front).signum() } else { front };
        let upright = Quat::from_mat3(&Mat3::from_cols(up.cross(front), up, front)).normalize();
        let sides = if self.letters[0].1.is_some() { self.world_from_sides } else { upright };
        Self { world_from_upright: upright, world_from_sides: sides, ..self }
    }

    /// The name of a direction along an axis of the world.
    pub(crate) fn name(&self, axis: usize, is_positive: bool) -> String {
        match self.letters[axis] {
            (positive, _) if is_positive => positive.to_string(),
            (_, Some(negative)) => negative.to_string(),
            (positive, None) => format!("-{positive}"),
        }
    }

    /// The name of an axis: its letter, or those of both ends.
    pub(crate) fn axis_name(&self, axis: usize) -> String {
        match self.letters[axis] {
            (positive, Some(negative)) => format!("{positive}–{negative}"),
            (positive, None) => positive.to_string(),
        }
    }

    /// The up direction of a view from the direction `from`, both unit vectors of the world.
    pub(crate) fn up_from(&self, from: Vec3) -> Vec3 {
        let candidates =
            [self.up(), self.world_from_sides * self.up_from_top, self.world_from_sides * Vec3::Y];
        let found = candidates.into_iter().map(Vec3::round).find(|up| up.dot(from).abs() < 0.99);
        found.unwrap_or_else(|| from.any_orthonormal_vector())
    }

    pub(crate) fn world_from_upright(&self) -> Quat {
        self.world_from_upright
    }

    /// Whether the volume names the sides of a body.
    pub(crate) fn is_body(&self) -> bool {
        self.letters[0].1.is_some()
    }

    /// The letter of the side that a direction of world space points to; none if the volume has no name for it.
    pub(crate) fn letter_towards(&self, direction: Vec3) -> Option<char> {
        let axis = (0..3).max_by(|&a, &b| direction[a].abs().total_cmp(&direction[b].abs()))?;
        let (positive, negative) = self.letters[axis];
        if direction[axis] >= 0.0 { Some(positive) } else { negative }
    }

    /// Towards the top of the volume.
    pub(crate) fn up(&self) -> Vec3 {
        self.world_from_upright * Vec3::Y
    }

    /// The direction from which a standard view looks at the centre, and its up direction.
    pub(crate) fn standard_view(&self, side: Side, opposite: Opposite) -> (Vec3, Vec3) {
        let from = match side {
            Side::Front => Vec3::Z,
            Side::Right => self.right,
            Side::Top => Vec3::Y,
        };
        let from = (self.world_from_sides * if opposite { -from } else { from }).round();
        (from, self.up_from(from))
    }

    /// The view that shows three sides alike: from the front, above and the viewer's right.
    pub(crate) fn isometric_view(&self) -> (Vec3, Vec3) {
        (self.world_from_upright * Vec3::ONE.normalize(), self.up())
    }
}

fn opposite(letter: char) -> Option<char> {
    Some(match letter {
        'R' => 'L',
        'L' => 'R',
        'A' => 'P',
        'P' => 'A',
        'S' => 'I',
        'I' => 'S',
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patients_are_seen_from_where_the_view_says() {
        let ras = Orientation::of(Some("RAS"));
        assert_eq!(ras.standard_view(Side::Front, false), (Vec3::Y, Vec3::Z));
        assert_eq!(ras.standard_view(Side::Front, true), (Vec3::NEG_Y, Vec3::Z));
        assert_eq!(ras.standard_view(Side::Right, false), (Vec3::X, Vec3::Z), "from the patient's right");
        assert_eq!(ras.standard_view(Side::Top, true), (Vec3::NEG_Z, Vec3::Y), "from the feet, anterior up");
        assert_eq!(ras.letters, [('R', Some('L')), ('A', Some('P')), ('S', Some('I'))]);
        // The same patient in other axes is seen the same way.
        let lps = Orientation::of(Some("LPS"));
        assert_eq!(lps.standard_view(Side::Front, false), (Vec3::NEG_Y, Vec3::Z));
        let sra = Orientation::of(Some("SRA"));
        assert_eq!(sra.standard_view(Side::Front, false), (Vec3::Z, Vec3::X));
    }

    #[test]
    fn an_image_is_seen_as_on_a_page() {
        let image = Orientation::of(Some(IMAGE_AXES));
        assert_eq!(image.standard_view(Side::Front, false), (Vec3::NEG_Z, Vec3::NEG_Y), "the first slice");
        assert_eq!(image.standard_view(Side::Right, false), (Vec3::X, Vec3::NEG_Y));
        assert_eq!(image.standard_view(Side::Top, false), (Vec3::NEG_Y, Vec3::Z), "the first row");
        assert_eq!((image.up(), image.is_body()), (Vec3::NEG_Y, false));
        assert_eq!(image.name(1, false), "-y");
        // Control: what is no image is seen from +z.
        assert_eq!(Orientation::of(None).standard_view(Side::Front, false), (Vec3::Z, Vec3::Y));
    }

    #[test]
    fn another_axis_can_be_up_and_a_body_keeps_its_sides() {
        let plain = Orientation::of(None);
        for axis in UpAxis::ALL {
            let o = plain.clone().with_up(axis);
            let up = axis.direction().unwrap_or(Vec3::Y);
            assert!((o.up() - up).length() < 1e-6, "{axis:?}");
            let top = o.standard_view(Side::Top, false);
            assert!(top.0 == up && top.1.dot(up).abs() < 1e-6, "{axis:?} {top:?}");
            for side in [Side::Front, Side::Right] {
                let (from, above) = o.standard_view(side, true);
                assert!(above == up && from.dot(up).abs() < 1e-6, "{axis:?} {side:?}");
            }
            let (from, above) = o.isometric_view();
            assert!((from.abs() - Vec3::splat(3f32.sqrt().recip())).length() < 1e-6 && above == o.up());
        }
        // With z up the front is where -y points, as in programs that draw z upwards.
        assert_eq!(plain.clone().with_up(UpAxis::Z).standard_view(Side::Front, false).0, Vec3::NEG_Y);
        assert_eq!(plain.clone().with_up(UpAxis::Own), plain);
        let body = Orientation::of(Some("RAS")).with_up(UpAxis::X);
        assert_eq!(body.standard_view(Side::Front, false), (Vec3::Y, Vec3::X), "from anterior, right up");
        assert_eq!(body.standard_view(Side::Right, false), (Vec3::X, Vec3::Y), "up is not along the view");
        assert_eq!((body.name(1, true), body.name(1, false)), ("A".into(), "P".into()));
        assert_eq!((plain.name(1, true), plain.name(1, false)), ("y".into(), "-y".into()));
    }

    #[test]
    fn without_letters_the_first_view_is_the_front() {
        for letters in [None, Some(""), Some("RAR"), Some("xyz"), Some("RASI"), Some("RLA")] {
            let o = Orientation::of(letters);
            assert_eq!(o.letters, [('x', None), ('y', None), ('z', None)], "{letters:?}");
            assert_eq!(o.standard_view(Side::Front, false), (Vec3::Z, Vec3::Y));
            assert_eq!(o.standard_view(Side::Right, false), (Vec3::X, Vec3::Y));
            assert_eq!(o.standard_view(Side::Top, false), (Vec3::Y, Vec3::NEG_Z));
        }
    }
}
