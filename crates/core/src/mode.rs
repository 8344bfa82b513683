//! The rendering mode: what a pixel shows of the matter along its ray.
//! - *Composite*: emission and absorption (Max 1995), shaded or not.
//! - *MIP*, *MinIP*: the greatest or the least value along the ray, as the transfer function shows it.
//! - *Average*: the mean of what the transfer function shows, along the ray through the volume's box.
//! - *Isosurface*: the surfaces of given values, each of one opacity, visible from both sides.
//!
//! See [`crate::transfer::TransferFunction::shown`] for what the transfer function shows of a value.

use serde::{Deserialize, Serialize};

/// The modes by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Emission and absorption.
    #[default]
    Composite,
    /// Greatest value.
    Mip,
    /// Least value.
    MinIp,
    /// Mean along the ray.
    Average,
    /// Surfaces of one value each.
    Iso,
}

/// How the pieces along a ray become one colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compositing {
    /// Front to back with *over*.
    Over,
    /// The piece with the greatest key, in any order.
    Greatest,
    /// The sum of shares of the ray, in any order.
    Mean,
}

impl Mode {
    /// Every mode.
    pub const ALL: [Self; 5] = [Self::Composite, Self::Mip, Self::MinIp, Self::Average, Self::Iso];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Composite => "composite",
            Self::Mip => "mip",
            Self::MinIp => "minip",
            Self::Average => "average",
            Self::Iso => "iso",
        }
    }

    /// How pieces of a ray become one colour.
    pub fn compositing(self) -> Compositing {
        match self {
            Self::Composite | Self::Iso => Compositing::Over,
            Self::Mip | Self::MinIp => Compositing::Greatest,
            Self::Average => Compositing::Mean,
        }
    }

    /// Whether matter neither hides nor dims other matter.
    pub fn is_projection(self) -> bool {
        self.compositing() != Compositing::Over
    }

    /// The next mode, cyclically.
    pub fn next(self) -> Self {
        Self::ALL[(self as usize + 1) % Self::ALL.len()]
    }
}

impl std::fmt::Display for Mode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Mode {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|mode| mode.name() == s).ok_or_else(|| {
            format!("unknown mode '{s}', expected one of {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

/// A surface where the values pass `value`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Iso {
    /// A value of the volume.
    pub value: f32,
    /// Opacity of each crossing, 0 to 1.
    #[serde(default = "opaque")]
    pub opacity: f32,
}

/// Up to [`MAX_ISOS`] surfaces. Without any, the value that splits the histogram best is used
/// ([`crate::volume::Histogram::parting_value`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<Iso>", into = "Vec<Iso>")]
pub struct Isos {
    len: usize,
    isos: [Iso; MAX_ISOS],
}

/// Why surfaces cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum IsoError {
    /// There are too many.
    #[error("{0} isosurfaces, expected at most {MAX_ISOS}")]
    Count(usize),
    /// A number is out of its range.
    #[error("an isosurface of value {0} and opacity {1}, expected a finite value and an opacity of 0 to 1")]
    Range(f32, f32),
}

impl Default for Iso {
    fn default() -> Self {
        Self { value: 0.0, opacity: opaque() }
    }
}

fn opaque() -> f32 {
    1.0
}

impl Isos {
    /// Takes surfaces in any order.
    ///
    /// # Errors
    /// If there are more than [`MAX_ISOS`], or a number is out of its range.
    pub fn new(isos: &[Iso]) -> Result<Self, IsoError> {
        let mut these = Self { len: isos.len(), ..Self::default() };
        let room = these.isos.get_mut(..isos.len()).ok_or(IsoError::Count(isos.len()))?;
        room.copy_from_slice(isos);
        let is_usable = |i: &&Iso| i.value.is_finite() && (0.0..=1.0).contains(&i.opacity);
        match isos.iter().find(|i| !is_usable(i)) {
            Some(i) => Err(IsoError::Range(i.value, i.opacity)),
            None => Ok(these),
        }
    }

    /// One opaque surface.
    pub fn one(value: f32) -> Self {
        Self::new(&[Iso { value, ..Iso::default() }]).unwrap_or_default()
    }

    /// The surfaces.
    pub fn as_slice(&self) -> &[Iso] {
        &self.isos[..self.len]
    }
}

impl TryFrom<Vec<Iso>> for Isos {
    type Error = IsoError;

    fn try_from(isos: Vec<Iso>) -> Result<Self, IsoError> {
        Self::new(&isos)
    }
}

impl From<Isos> for Vec<Iso> {
    fn from(isos: Isos) -> Self {
        isos.as_slice().to_vec()
    }
}

/// `V[:OPACITY],…`, as on the command line.
impl std::str::FromStr for Isos {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let number = |text: &str| {
            let found = text.trim().parse::<f32>().ok().filter(|x| x.is_finite());
            found.ok_or_else(|| format!("found '{text}', expected V or V:OPACITY, and commas between"))
        };
        let each = |text: &str| -> Result<Iso, String> {
            let (value, opacity) = text.split_once(':').unwrap_or((text, "1"));
            Ok(Iso { value: number(value)?, opacity: number(opacity)? })
        };
        let isos = s.split(',').map(each).collect::<Result<Vec<_>, _>>()?;
        Self::new(&isos).map_err(|e| e.to_string())
    }
}

/// Most surfaces at once.
pub const MAX_ISOS: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_are_found_by_their_names_and_follow_each_other() {
        let mut mode = Mode::Composite;
        for expected in Mode::ALL {
            assert_eq!((mode, expected.name().parse()), (expected, Ok(expected)));
            mode = mode.next();
        }
        assert_eq!(mode, Mode::Composite);
        assert!("mips".parse::<Mode>().unwrap_err().contains("composite, mip"));
    }

    #[test]
    fn surfaces_are_read_as_they_are_written() {
        let isos: Isos = "-300:0.25, 1200".parse().unwrap();
        assert_eq!(
            isos.as_slice(),
            [Iso { value: -300.0, opacity: 0.25 }, Iso { value: 1200.0, opacity: 1.0 }]
        );
        for bad in ["", "a", "1:2", "1:", "nan", "inf", "1,2,3,4,5,6,7,8,9", "1:-0.1"] {
            assert!(bad.parse::<Isos>().is_err(), "{bad}");
        }
    }

    #[test]
    fn surfaces_of_a_peer_are_bounded() {
        let config = bincode::config::standard();
        let written = |isos: &[Iso]| bincode::serde::encode_to_vec(isos.to_vec(), config).unwrap();
        let read = |bytes: &[u8]| bincode::serde::decode_from_slice::<Isos, _>(bytes, config);
        let isos = [Iso { value: 3.0, opacity: 0.5 }; MAX_ISOS];
        assert_eq!(read(&written(&isos)).unwrap().0.as_slice(), isos);
        assert!(read(&written(&[Iso::default(); MAX_ISOS + 1])).is_err());
        assert!(read(&written(&[Iso { value: f32::NAN, opacity: 1.0 }])).is_err());
        assert!(read(&written(&[Iso { value: 0.0, opacity: 1.5 }])).is_err());
    }
}
