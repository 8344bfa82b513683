//! Which way the world's axes point, and the standard views that follow from it.

use glam::Vec3;

use crate::bindings::{Opposite, Side};

/// The names of the axes' ends, and where the front and the top of the volume are.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Orientation {
    /// For x, y and z the letter at the positive end, and that at the negative one where the volume knows it.
    pub(crate) letters: [(char, Option<char>); 3],
    front: Vec3,
    up: Vec3,
    /// What is up in the view from the top.
    up_from_top: Vec3,
}

impl Orientation {
    /// From letters such as `RAS`; without them the axes are x, y and z, z towards the viewer and y up.
    pub(crate) fn of(letters: Option<&str>) -> Self {
        letters.and_then(Self::of_patient).unwrap_or(Self {
            letters: [('x', None), ('y', None), ('z', None)],
            front: Vec3::Z,
            up: Vec3::Y,
            up_from_top: Vec3::NEG_Z,
        })
    }

    fn of_patient(letters: &str) -> Option<Self> {
        let ends: Vec<char> = letters.chars().collect();
        let ends: [char; 3] = ends.try_into().ok()?;
        let towards = |wanted: char| -> Option<Vec3> {
            ends.iter().zip(Vec3::AXES).find_map(|(&end, axis)| match end {
                end if end == wanted => Some(axis),
                end if opposite(end)? == wanted => Some(-axis),
                _ => None,
            })
        };
        // One of each pair, or the letters say nothing.
        let (front, up) = (towards('A')?, towards('S')?);
        towards('R')?;
        let letters =
            [(ends[0], opposite(ends[0])), (ends[1], opposite(ends[1])), (ends[2], opposite(ends[2]))];
        // As radiologists have it: anterior is up when one looks along the body.
        Some(Self { letters, front, up, up_from_top: front })
    }

    /// Towards the top of the volume.
    pub(crate) fn up(&self) -> Vec3 {
        self.up
    }

    /// From where a standard view looks at the centre, and what is up in it.
    pub(crate) fn standard_view(&self, side: Side, opposite: Opposite) -> (Vec3, Vec3) {
        let (from, up) = match side {
            Side::Front => (self.front, self.up),
            Side::Right => (self.up.cross(self.front), self.up),
            Side::Top => (self.up, self.up_from_top),
        };
        (if opposite { -from } else { from }, up)
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
        assert_eq!(ras.standard_view(Side::Right, false), (Vec3::NEG_X, Vec3::Z), "from the patient's left");
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
