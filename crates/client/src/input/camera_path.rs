//! A camera path as text: the viewer writes it, benchmarks play it.
//!
//! One line a refresh: `seconds azimuth elevation [roll distance right up]`. Angles are in degrees: a positive
//! azimuth moves the eye towards +x, a positive elevation towards +y. The roll turns the camera counter-clockwise
//! about its viewing direction, after the other two. The rest is in radii of the volume's bounding sphere: the view
//! depth of its centre, and the shift of the eye to the right and up. Without these four, the camera looks at the
//! centre, upright, from where the sphere just fits the view. Lines that begin with `#` are remarks.

use std::fmt::Write as _;
use std::time::Duration;

use glam::{EulerRot, Quat, Vec3};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::space::Aabb;

/// Positions of a camera at increasing times, for a volume of any size.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraPath {
    keys: Vec<Key>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Key {
    seconds: f32,
    world_from_view: Quat,
    /// Eye from the volume's centre in view space, radii; none: upright in front of the centre, where the sphere
    /// fits.
    place: Option<Vec3>,
}

/// Why a text is not a camera path.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum CameraPathError {
    /// A line is unreadable.
    #[error(
        "line {line}: found {found:?}, expected seconds, azimuth, elevation and perhaps roll, distance, right, up"
    )]
    Line {
        /// Counts from 1.
        line: usize,
        /// The text of the line.
        found: String,
    },
    /// A time is not after the one before.
    #[error("line {0}: the time is not after that of the line before")]
    Order(usize),
    /// Too few positions, or too many.
    #[error("found {0} places of a camera, expected 2 to {MAX_KEYS}")]
    Length(usize),
    /// The path is too long.
    #[error("the path is longer than {MAX_SECONDS} s")]
    Duration,
}

impl CameraPath {
    /// Reads a path.
    ///
    /// # Errors
    /// Names the line.
    pub fn parse(text: &str) -> Result<Self, CameraPathError> {
        let mut keys: Vec<Key> = Vec::new();
        let lines = text.lines().map(str::trim).enumerate();
        for (i, line) in lines.filter(|(_, l)| !l.is_empty() && !l.starts_with('#')) {
            let bad = || CameraPathError::Line { line: i + 1, found: line.chars().take(60).collect() };
            let numbers: Option<Vec<f32>> =
                line.split_whitespace().map(|n| n.parse().ok().filter(|n: &f32| n.abs() < 1e4)).collect();
            let key = Key::from_numbers(&numbers.ok_or_else(bad)?).ok_or_else(bad)?;
            if keys.last().is_some_and(|last| key.seconds <= last.seconds) {
                return Err(CameraPathError::Order(i + 1));
            }
            keys.push(key);
            if keys.len() > MAX_KEYS {
                break;
            }
        }
        let path = Self { keys };
        match path.keys.len() {
            n if !(2..=MAX_KEYS).contains(&n) => Err(CameraPathError::Length(n)),
            _ if path.duration().as_secs_f32() > MAX_SECONDS => Err(CameraPathError::Duration),
            _ => Ok(path),
        }
    }

    /// Adds the present position. A time that does not increase is left out, and so is what exceeds the longest path.
    pub fn record(&mut self, at: Duration, pose: &Pose, bounds: &Aabb) {
        let seconds = at.as_secs_f32();
        let place = pose.world_from_view.inverse() * (pose.eye - bounds.center()) / bounds.radius();
        // A window at rest is not refreshed: the camera stayed until just before.
        if let Some(&last) = self.keys.last()
            && seconds > last.seconds + 2.0 * REFRESH_SECONDS
            && (last.world_from_view, last.place) != (pose.world_from_view, Some(place))
        {
            self.keys.push(Key { seconds: seconds - REFRESH_SECONDS, ..last });
        }
        let is_later = self.keys.last().is_none_or(|last| seconds > last.seconds);
        let is_room = self.keys.len() < MAX_KEYS
            && self.keys.first().is_none_or(|first| seconds - first.seconds <= MAX_SECONDS);
        if is_later && is_room {
            self.keys.push(Key { seconds, world_from_view: pose.world_from_view, place: Some(place) });
        }
    }

    /// The same from the first movement to the last; none if nothing moves.
    pub(crate) fn without_rests(&self) -> Option<Self> {
        let (first, last) = (self.keys.first()?, self.keys.last()?);
        let is_at = |key: &Key, of: &Key| (key.world_from_view, key.place) == (of.world_from_view, of.place);
        let begin = self.keys.iter().position(|key| !is_at(key, first))?.checked_sub(1)?;
        let end = self.keys.iter().rposition(|key| !is_at(key, last))? + 1;
        Some(Self { keys: self.keys.get(begin..=end)?.to_vec() })
    }

    /// From the first position to the last.
    pub fn duration(&self) -> Duration {
        match (self.keys.first(), self.keys.last()) {
            (Some(first), Some(last)) => Duration::from_secs_f32((last.seconds - first.seconds).max(0.0)),
            _ => Duration::ZERO,
        }
    }

    /// The pose at a time after the first position, in front of a volume in `bounds`. Between two positions the
    /// camera moves like a trackball. The first and last positions hold before and after.
    pub fn pose_at(&self, at: Duration, intrinsics: &Intrinsics, bounds: &Aabb) -> Option<Pose> {
        let seconds = self.keys.first()?.seconds + at.as_secs_f32();
        let after = self.keys.partition_point(|k| k.seconds <= seconds).min(self.keys.len() - 1);
        let (a, b) = (self.keys[after.saturating_sub(1)], self.keys[after]);
        let t = ((seconds - a.seconds) / (b.seconds - a.seconds).max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
        let fit = Vec3::Z * intrinsics.fit_distance();
        let place = a.place.unwrap_or(fit).lerp(b.place.unwrap_or(fit), t);
        // A camera at rest keeps its rotation to the bit.
        let world_from_view = match a.world_from_view == b.world_from_view {
            true => a.world_from_view,
            false => a.world_from_view.slerp(b.world_from_view, t).normalize(),
        };
        Some(Pose { eye: bounds.center() + world_from_view * (place * bounds.radius()), world_from_view })
    }
}

impl Key {
    fn from_numbers(numbers: &[f32]) -> Option<Self> {
        let (&[seconds, azimuth, elevation], more) = numbers.split_first_chunk::<3>()?;
        let (roll, place) = match *more {
            [] => (0.0, None),
            [roll, distance, right, up] => (roll, Some(Vec3::new(right, up, distance))),
            _ => return None,
        };
        let [y, x, z] = [azimuth, -elevation, roll].map(f32::to_radians);
        Some(Self { seconds, world_from_view: Quat::from_euler(EulerRot::YXZ, y, x, z).normalize(), place })
    }
}

/// The text that [`CameraPath::parse`] reads; times start at 0.
impl std::fmt::Display for CameraPath {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut text = "# seconds azimuth elevation roll distance right up\n".to_owned();
        let start = self.keys.first().map_or(0.0, |k| k.seconds);
        for key in &self.keys {
            let (y, x, z) = key.world_from_view.to_euler(EulerRot::YXZ);
            let [azimuth, elevation, roll] = [y, -x, z].map(f32::to_degrees);
            write!(text, "{:.4} {azimuth:.3} {elevation:.3}", key.seconds - start)?;
            if let Some(Vec3 { x, y, z }) = key.place {
                write!(text, " {roll:.3} {z:.4} {x:.4} {y:.4}")?;
            }
            text.push('\n');
        }
        f.write_str(&text)
    }
}

/// Ten minutes at 60 Hz.
const MAX_KEYS: usize = 36_000;
const MAX_SECONDS: f32 = 600.0;
/// Seconds between refreshes of a window whose camera moves.
const REFRESH_SECONDS: f32 = 1.0 / 60.0;

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::new(-1.0, 0.0, -3.0), max: Vec3::new(2.0, 5.0, 1.0) };
    const INTRINSICS: Intrinsics = Intrinsics::perspective(64, 48, 0.7);

    fn at(path: &CameraPath, seconds: f32) -> Pose {
        path.pose_at(Duration::from_secs_f32(seconds), &INTRINSICS, &BOUNDS).unwrap()
    }

    fn distance(a: &Pose, b: &Pose) -> f32 {
        (a.eye - b.eye).length() + 1.0 - a.world_from_view.dot(b.world_from_view).abs()
    }

    #[test]
    fn a_recorded_path_survives_its_text() {
        let mut path = CameraPath::default();
        let pose = |i: u32| {
            let turn = Quat::from_euler(EulerRot::YXZ, 0.1 * i as f32, -0.04 * i as f32, 0.02 * i as f32);
            let place = Vec3::new(0.1, -0.02 * i as f32, 9.0 - 0.3 * i as f32);
            Pose { eye: BOUNDS.center() + turn * place, world_from_view: turn }
        };
        for i in 0..30 {
            path.record(Duration::from_millis(4000 + u64::from(i) * 33), &pose(i), &BOUNDS);
        }
        path.record(Duration::from_secs(4), &pose(99), &BOUNDS);
        let mut rested = path.clone();
        rested.record(Duration::from_secs(9), &pose(3), &BOUNDS);
        assert_eq!(at(&rested, 4.9), at(&rested, 2.0), "while nothing was recorded, nothing moved");
        rested.record(Duration::from_secs(10), &pose(3), &BOUNDS);
        rested.record(Duration::from_secs(11), &pose(3), &BOUNDS);
        let bare = rested.without_rests().unwrap();
        assert_eq!(bare.duration(), Duration::from_secs(5), "nothing moves after nine seconds");
        assert_eq!(path.without_rests().as_ref(), Some(&path), "the control");
        let mut still = CameraPath::default();
        assert_eq!(still.without_rests(), None);
        (1..4).for_each(|second| still.record(Duration::from_secs(second), &pose(3), &BOUNDS));
        assert_eq!(still.without_rests(), None);
        let again = CameraPath::parse(&path.to_string()).unwrap();
        assert_eq!(again.keys.len(), 30);
        assert!((again.duration().as_secs_f32() - 29.0 * 0.033).abs() < 1e-3);
        for i in [0, 7, 29] {
            // Thousandths of a degree and ten thousandths of a radius, at 9 units; half of them at worst.
            assert!(distance(&at(&again, i as f32 * 0.033), &pose(i)) < 2e-3, "{i}");
        }
        assert!(distance(&at(&again, 0.5), &pose(0)) > 0.1, "places differ");
        assert_eq!(at(&again, 99.0), at(&again, 29.0 * 0.033), "the last place holds");
    }

    #[test]
    fn three_numbers_are_an_orbit_and_between_them_the_way_is_steady() {
        let path = CameraPath::parse("# a turn\n0 170 20\n\n 1 190 20\n2 190 20\n").unwrap();
        let orbit = |azimuth: f32| {
            let distance = INTRINSICS.fit_distance() * BOUNDS.radius();
            Pose::orbit(BOUNDS.center(), azimuth.to_radians(), 20f32.to_radians(), distance)
        };
        assert!(distance(&at(&path, 0.0), &orbit(170.0)) < 1e-4);
        assert!(distance(&at(&path, 0.5), &orbit(180.0)) < 0.03, "slerp is a great circle, not a parallel");
        assert_eq!(at(&path, 1.0), at(&path, 1.7), "rests to the bit");
    }

    #[test]
    fn what_is_no_path_is_named() {
        let error = |text: &str| CameraPath::parse(text).unwrap_err();
        assert_eq!(error(""), CameraPathError::Length(0));
        assert_eq!(error("0 1 2"), CameraPathError::Length(1));
        assert_eq!(error("0 1 2\n0 1 2"), CameraPathError::Order(2));
        for bad in ["0 1", "0 1 2 3", "0 nan 2", "0 1 inf", "a b c", "0 1 2 3 4 5 6 7", "1e9 0 0"] {
            let e = error(&format!("# first\n{bad}"));
            assert_eq!(e, CameraPathError::Line { line: 2, found: bad.into() });
        }
        assert_eq!(error("0 0 0\n601 0 0"), CameraPathError::Duration);
        assert_eq!(
            error(&(0..40_000).map(|i| format!("{} 0 0\n", i as f64 / 100.0)).collect::<String>()),
            CameraPathError::Length(MAX_KEYS + 1)
        );
    }
}
