//! The part of a file that becomes the volume.

use std::fmt;
use std::str::FromStr;

/// The part of a file to read. The default is all channels that can be shown together, or else the first. It is the
/// first time, the finest level that fits into memory and the largest series, as a whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Selection {
    /// Channel, component or array, from 0. `None` is all that can be shown together.
    pub channel: Option<u32>,
    /// Point in time, from 0.
    pub time: Option<u32>,
    /// Level of a pyramid, 0 the finest.
    pub level: Option<u32>,
    /// Series of a folder, from 0.
    pub series: Option<u32>,
    /// Part of the volume.
    pub region: Option<Region>,
    /// Axes of the volume that are mirrored.
    pub flip: Flip,
}

/// The axes of the displayed volume along which it is mirrored, against what the file says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Flip(pub [bool; 3]);

/// Prints the form that [`Flip::from_str`] reads; nothing if nothing is mirrored.
impl fmt::Display for Flip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = ["x", "y", "z"].into_iter().zip(self.0).filter(|(_, is_flipped)| *is_flipped);
        f.write_str(&names.map(|(name, _)| name).collect::<Vec<_>>().join(","))
    }
}

impl FromStr for Flip {
    type Err = String;

    /// Reads one axis or several, such as `y,z`.
    fn from_str(text: &str) -> Result<Self, String> {
        let mut flip = [false; 3];
        for word in text.split(',') {
            let axis = ["x", "y", "z"].iter().position(|name| name.eq_ignore_ascii_case(word.trim()));
            match axis {
                Some(axis) if !flip[axis] => flip[axis] = true,
                _ => return Err("expected axes, each once, such as y or x,z".into()),
            }
        }
        Ok(Self(flip))
    }
}

/// A box of voxels along the axes of the displayed volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Region {
    /// First voxel along x, y, z.
    pub min: [u32; 3],
    /// Voxel after the last; `None` is the end.
    pub max: [Option<u32>; 3],
}

/// Prints the form that [`Region::from_str`] reads.
impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for axis in 0..3 {
            let comma = if axis == 0 { "" } else { "," };
            write!(f, "{comma}{}:", self.min[axis])?;
            self.max[axis].map_or(Ok(()), |max| write!(f, "{max}"))?;
        }
        Ok(())
    }
}

impl FromStr for Region {
    type Err = String;

    /// Reads `FROM:TO,FROM:TO,FROM:TO`. The end is not included. A missing number is the first or the last voxel.
    fn from_str(text: &str) -> Result<Self, String> {
        let bad = || "expected FROM:TO along x, y and z, such as 0:100,50:,:".to_owned();
        let number = |word: &str| match word.trim() {
            "" => Ok(None),
            word => word.parse().map(Some).map_err(|_| bad()),
        };
        let mut ranges = Vec::new();
        for part in text.split(',') {
            let (from, to) = part.split_once(':').ok_or_else(bad)?;
            let (from, to): (Option<u32>, Option<u32>) = (number(from)?, number(to)?);
            if to.is_some_and(|to| to <= from.unwrap_or(0)) {
                return Err(format!("{part} is empty; {}", bad()));
            }
            ranges.push((from.unwrap_or(0), to));
        }
        let ranges: [_; 3] = ranges.try_into().map_err(|_| bad())?;
        Ok(Self { min: ranges.map(|r| r.0), max: ranges.map(|r| r.1) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_are_read_and_nonsense_is_refused() {
        let region = Region { min: [1, 0, 7], max: [Some(5), None, None] };
        assert_eq!("1:5,:,7:".parse(), Ok(region));
        assert_eq!(region.to_string().parse(), Ok(region));
        for flip in ["x", "y,z", "x,y,z"] {
            assert_eq!(flip.parse::<Flip>().map(|f| f.to_string()).as_deref(), Ok(flip));
        }
        assert_eq!(
            (" Z , x".parse(), Flip::default().to_string()),
            (Ok(Flip([true, false, true])), "".into())
        );
        for bad in ["", "w", "x,x", "x,", "xy", "x y"] {
            assert!(bad.parse::<Flip>().is_err(), "{bad}");
        }
        for bad in ["", "1:5", "1:5,:,:,:", "5:5,:,:", "5:1,:,:", ":0,:,:", "a:b,:,:", "1,2,3", "-1:2,:,:"] {
            assert!(bad.parse::<Region>().is_err(), "{bad}");
        }
    }
}
