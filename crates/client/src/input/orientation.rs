//! The directions of the world's axes, and the standard views that follow from them.

use glam::{Quat, Vec3};
use isinglass_core::space::world_from_upright;

use crate::input::bindings::{Opposite, Side};

/// The names of the axes' ends, and where front and top of the volume are.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Orientation {
    /// For x, y and z the letter at the positive end, and at the negative end if the volume names it.
    pub(crate) letters: [(char, Option<char>); 3],
    world_from_upright: Quat,
    /// The up direction of the view from the top, upright space.
    up_from_top: Vec3,
    /// The direction from which the view from the right looks, upright space.
    right: Vec3,
}

impl Orientation {
    /// From letters such as `RAS`. Without them the axes are x, y and z, with z towards the viewer and y up.
    pub(crate) fn of(letters: Option<&str>) -> Self {
        letters.and_then(Self::of_patient).unwrap_or(Self {
            letters: [('x', None), ('y', None), ('z', None)],
            world_from_upright: Quat::IDENTITY,
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
        Some(Self {
            letters: ends.map(|end| (end, opposite(end))),
            world_from_upright: world_from_upright(Some(letters)),
            // A radiologist's convention: anterior is up in a view along the body.
            up_from_top: Vec3::Z,
            // A patient who faces us has the right side on our left.
            right: Vec3::NEG_X,
        })
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
        let (from, up) = match side {
            Side::Front => (Vec3::Z, Vec3::Y),
            Side::Right => (self.right, Vec3::Y),
            Side::Top => (Vec3::Y, self.up_from_top),
        };
        let in_world = |v: Vec3| (self.world_from_upright * v).round();
        (in_world(if opposite { -from } else { from }), in_world(up))
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
