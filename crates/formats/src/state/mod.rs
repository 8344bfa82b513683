//! A saved state: what is seen of a volume, and how, as one small TOML file or as a part of a link.
//!
//! ```toml
//! isinglass_state = 1                  # what the file is; the number of its form
//!
//! [volume]                             # which volume, to find it again and to tell another one
//! name = "head.nrrd"
//! dims = [256, 256, 128]
//!
//! [camera]                             # the eye is center + rotation · eye_from_center
//! center = [0.0, 0.0, 0.0]             # what the camera turns about, world space
//! rotation = [0.0, 0.0, 0.0, 1.0]      # quaternion x, y, z, w from view to world space
//! eye_from_center = [0.0, 0.0, 400.0]  # view space
//! fov_degrees = 40.0
//! size = [1100, 760]
//!
//! [view]                               # what is drawn around the picture
//! box = true
//!
//! [look]                               # how frames are made: every field of `Look`, the transfer function among them
//! ```
//!
//! Everything but the first line may be missing: it then stays as it is. Numbers are written so that they read back to the
//! bit, so the same volume gives the same picture. What is not known, as of a newer program, is left out and told.

mod link;
mod text;

use std::fmt;
use std::path::Path;

use glam::{Quat, Vec3};
use isinglass_core::camera::{Intrinsics, MAX_SIDE, Pose};
use isinglass_core::look::Look;
use isinglass_core::volume::Volume;
use isinglass_core::wire::VolumeDescription;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::error::{FormatError, quoted, shown};
use crate::raw::RawShape;
use crate::select::Selection;
use crate::source::read_file;
use crate::volume_source::VolumeSource;

pub use link::{MAX_LINK_BYTES, state_from_link, state_to_link};

/// What is seen of a volume, and how. A part that is missing is left as it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SavedState {
    /// Which volume.
    pub volume: Option<SavedVolume>,
    /// From where.
    pub camera: Option<SavedCamera>,
    /// What is drawn around the picture, and how the viewer shows it.
    pub view: SavedView,
    /// How frames are made.
    pub look: Option<Look>,
}

/// A volume, as far as a state names it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedVolume {
    /// File name or name of the built-in volume.
    pub name: String,
    /// What to open it by, where that is known: a path, `builtin:NAME`, or the link of a server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// The server that showed it, `host:port`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub server: Option<String>,
    /// Channel of the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<u32>,
    /// Point in time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<u32>,
    /// Level of a pyramid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub level: Option<u32>,
    /// Series of a folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub series: Option<u32>,
    /// Part of the volume, as `--region` takes it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub region: Option<String>,
    /// Distances between voxels that were given in place of the file's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub given_spacing: Option<[f32; 3]>,
    /// The shape of a raw file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub raw: Option<RawShape>,
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Size of a voxel, world units.
    pub spacing: [f32; 3],
    /// Least and greatest value.
    pub range: [f32; 2],
}

impl SavedVolume {
    /// What a server tells of its volume.
    pub fn of(volume: &VolumeDescription) -> Self {
        let (lo, hi) = volume.value_range;
        Self {
            name: volume.name.clone(),
            dims: volume.dims,
            spacing: volume.spacing,
            range: [lo, hi],
            ..Self::default()
        }
    }

    /// The same, opened from there.
    pub fn opened_from(self, volume: &VolumeSource) -> Self {
        let VolumeSource { source, raw, selection, spacing } = volume.clone();
        let Selection { channel, time, level, series, region } = selection;
        let (region, given_spacing) = (region.map(|r| r.to_string()), spacing.map(Vec3::into));
        Self { source: Some(source), channel, time, level, series, region, given_spacing, raw, ..self }
    }

    /// What to open it from, if that is known and no server.
    ///
    /// # Errors
    /// If the region is none.
    pub fn volume_source(&self) -> Result<Option<VolumeSource>, String> {
        let Some(source) = self.source.clone().filter(|_| self.link().is_none()) else { return Ok(None) };
        let (selection, spacing) = (self.selection()?, self.given_spacing.map(Vec3::from));
        Ok(Some(VolumeSource { source, raw: self.raw, selection, spacing }))
    }

    /// Which part of the file it is.
    ///
    /// # Errors
    /// If the region is none.
    pub fn selection(&self) -> Result<Selection, String> {
        let &Self { channel, time, level, series, .. } = self;
        let region = self.region.as_deref().map(str::parse).transpose()?;
        Ok(Selection { channel, time, level, series, region })
    }

    /// The link to open it by, if it is one.
    pub fn link(&self) -> Option<&str> {
        self.source.as_deref().filter(|source| source.trim_start().starts_with(LINK_SCHEME))
    }

    /// The same without its place, which is not for everyone to know.
    pub fn without_place(self) -> Self {
        Self { source: None, server: None, given_spacing: None, raw: None, ..self }
    }

    /// Whether it is to be opened from a file, and that is there. May wait for a disk.
    pub fn is_here(&self) -> bool {
        let Some(source) = self.source.as_deref().filter(|_| self.link().is_none()) else { return false };
        source.starts_with(BUILTIN) || Path::new(source).exists()
    }

    /// The volume's file where it is now: as it is named; else under the same name beside the state in the file `state`, so that
    /// both can be moved together.
    fn found_beside(self, state: &Path) -> Self {
        let Some(folder) = state.parent() else { return self };
        let Some(source) = self.source.as_deref().filter(|_| self.link().is_none()) else { return self };
        let named = Path::new(source);
        let beside = match named.is_relative() {
            true => Some(folder.join(named)),
            false if !named.exists() => named.file_name().map(|name| folder.join(name)),
            false => None,
        };
        let found = beside.filter(|path| !source.starts_with(BUILTIN) && path.exists());
        let found =
            found.and_then(|path| std::path::absolute(path).ok()?.into_os_string().into_string().ok());
        Self { source: found.or(self.source), ..self }
    }

    /// In one line how another volume differs from the one that the state was made of, if it is another one. Names may
    /// differ: the same voxels can lie elsewhere.
    pub fn difference(&self, other: &Self) -> Option<String> {
        let is_same = self.dims == other.dims && self.spacing == other.spacing && self.range == other.range;
        (!is_same).then(|| format!("the state was made of {self}, and this is {other}"))
    }

    /// See [`SavedVolume::difference`].
    pub fn difference_from(&self, volume: &Volume) -> Option<String> {
        let (lo, hi) = volume.value_range();
        let other = Self {
            name: volume.info.name.clone(),
            dims: volume.dims(),
            spacing: volume.spacing().to_array(),
            range: [lo, hi],
            ..Self::default()
        };
        self.difference(&other)
    }
}

impl fmt::Display for SavedVolume {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([x, y, z], [dx, dy, dz], [lo, hi]) = (self.dims, self.spacing, self.range);
        write!(f, "{} of {x}×{y}×{z} voxels of {dx}×{dy}×{dz}, {lo} to {hi}", quoted(&self.name))
    }
}

/// A camera as the viewer's controls hold it, so that what is restored is the same to the bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedCamera {
    /// What the camera turns about, world space.
    pub center: [f32; 3],
    /// From view to world space: x, y, z, w.
    pub rotation: [f32; 4],
    /// The eye seen from the centre, view space.
    pub eye_from_center: [f32; 3],
    /// Vertical field of view.
    pub fov_degrees: f64,
    /// Columns and rows of the picture.
    pub size: [u32; 2],
}

impl SavedCamera {
    /// The camera whose eye lies at `eye_from_center` from `center`.
    pub fn of(center: Vec3, (rotation, eye_from_center): (Quat, Vec3), intrinsics: Intrinsics) -> Self {
        Self {
            center: center.to_array(),
            rotation: rotation.to_array(),
            eye_from_center: eye_from_center.to_array(),
            fov_degrees: degrees_of(intrinsics.fov_y()),
            size: [intrinsics.width, intrinsics.height],
        }
    }

    /// What the camera turns about, world space.
    pub fn center(&self) -> Vec3 {
        Vec3::from_array(self.center)
    }

    /// The rotation from view to world space, and the eye seen from the centre in view space.
    pub fn placement(&self) -> (Quat, Vec3) {
        (Quat::from_array(self.rotation), Vec3::from_array(self.eye_from_center))
    }

    /// Where it is.
    pub fn pose(&self) -> Pose {
        let (rotation, eye_from_center) = self.placement();
        Pose::around(self.center(), rotation, eye_from_center)
    }

    /// Size and field of view.
    pub fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics::perspective(width, height, self.fov_y())
    }

    /// Vertical field of view, radians.
    pub fn fov_y(&self) -> f32 {
        self.fov_degrees.to_radians() as f32
    }

    fn problem(&self) -> Option<String> {
        if !self.pose().is_valid() {
            return Some("the camera is no place and rotation of finite numbers".into());
        }
        if !(1.0..=170.0).contains(&self.fov_degrees) {
            return Some(format!("fov_degrees is {}, expected 1 to 170", self.fov_degrees));
        }
        let [width, height] = self.size;
        let is_size = [width, height].iter().all(|side| (1..=MAX_SIDE).contains(side));
        (!is_size).then(|| format!("size is {width}×{height}, expected sides of 1 to {MAX_SIDE}"))
    }
}

/// The angle in degrees that reads back as `radians`, short where that is enough.
fn degrees_of(radians: f32) -> f64 {
    let exact = f64::from(radians).to_degrees();
    let short = (exact * 1e4).round() * 1e-4;
    if short.to_radians() as f32 == radians { short } else { exact }
}

/// How the viewer shows a picture.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedView {
    /// Whether the volume's edges are drawn.
    #[serde(default, rename = "box", skip_serializing_if = "Option::is_none")]
    pub shows_box: Option<bool>,
    /// Whether axes and scale bar are.
    #[serde(default, rename = "axes", skip_serializing_if = "Option::is_none")]
    pub shows_axes: Option<bool>,
    /// Whether the numbers are shown.
    #[serde(default, rename = "numbers", skip_serializing_if = "Option::is_none")]
    pub shows_numbers: Option<bool>,
    /// Behind the volume.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub background: Option<Srgb>,
    /// Of the panels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub theme: Option<Theme>,
    /// The picture for two eyes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stereo: Option<StereoPicture>,
    /// Whether rays are parallel: the picture then shows what the camera turns about as large as with the field of view.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orthographic: Option<bool>,
    /// The angle between the eyes, degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eye_angle_degrees: Option<f32>,
    /// Size of the server's frames in units of the picture's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame_scale: Option<f32>,
    /// How frames become pictures.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub method: Option<String>,
}

impl SavedView {
    fn problem(&self) -> Option<String> {
        let in_range = |what, value: Option<f32>, least: f32, most: f32| {
            let value = value.filter(|v| !(least..=most).contains(v))?;
            Some(format!("{what} is {value}, expected {least} to {most}"))
        };
        in_range("eye_angle_degrees", self.eye_angle_degrees, 0.0, 90.0)
            .or_else(|| in_range("frame_scale", self.frame_scale, 0.01, 1.0))
    }
}

/// A colour, `#rrggbb` in text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Srgb(pub [u8; 3]);

impl Serialize for Srgb {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let [r, g, b] = self.0;
        serializer.serialize_str(&format!("#{r:02x}{g:02x}{b:02x}"))
    }
}

impl<'de> Deserialize<'de> for Srgb {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let hex = text.strip_prefix('#').filter(|h| h.len() == 6 && h.bytes().all(|b| b.is_ascii_hexdigit()));
        let number = hex.and_then(|h| u32::from_str_radix(h, 16).ok());
        let expected = || format!("found {}, expected a colour like \"#20242c\"", quoted(&text));
        let [_, rgb @ ..] = number.ok_or_else(|| serde::de::Error::custom(expected()))?.to_be_bytes();
        Ok(Self(rgb))
    }
}

/// Of the viewer's panels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Theme {
    /// Bright on dark.
    Dark,
    /// Dark on bright.
    Light,
    /// As the system has it.
    System,
}

/// How a picture for two eyes reaches them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StereoPicture {
    /// One picture for both.
    Off,
    /// The left eye's picture in the left half.
    SideBySide,
    /// Red from the left eye, green and blue from the right.
    RedCyan,
}

/// A state that was read, and what of it is not known here.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadState {
    /// What is known.
    pub state: SavedState,
    /// In one line the keys that were left out, if there were any.
    pub note: Option<String>,
}

impl SavedState {
    /// The text of a file that reads back as this state, to the bit.
    pub fn to_toml(&self) -> String {
        text::write(self)
    }

    fn problem(&self) -> Option<String> {
        let volume = || {
            let volume = self.volume.as_ref()?;
            let given = [volume.given_spacing, volume.raw.map(|raw| raw.spacing.to_array())];
            let given = given.iter().flatten().flatten();
            let odd = volume.spacing.iter().chain(&volume.range).chain(given).find(|x| !x.is_finite());
            odd.map(|x| format!("the volume's spacing or range is {x}, expected finite numbers"))
        };
        let selection = || self.volume.as_ref()?.selection().err().map(|e| format!("region: {e}"));
        let look = || self.look.as_ref()?.validate().err().map(|e| e.to_string());
        self.camera
            .as_ref()
            .and_then(SavedCamera::problem)
            .or_else(|| self.view.problem())
            .or_else(volume)
            .or_else(selection)
            .or_else(look)
    }
}

/// The state in a file. A volume that is not where the state says, but beside it, is said to be there.
///
/// # Errors
/// If there is no such file, or no state of a known form in it: one line that says where.
pub fn read_state(path: &Path) -> Result<ReadState, FormatError> {
    let bytes = read_file(path, MAX_STATE_BYTES)?.ok_or_else(|| too_long(path))?;
    let ReadState { state, note } = state_from_bytes(&bytes, path)?;
    let volume = state.volume.map(|volume| volume.found_beside(path));
    Ok(ReadState { state: SavedState { volume, ..state }, note })
}

/// The state in the bytes of a file. `path` is for messages.
///
/// # Errors
/// As [`read_state`].
pub fn state_from_bytes(bytes: &[u8], path: &Path) -> Result<ReadState, FormatError> {
    if bytes.len() as u64 > MAX_STATE_BYTES {
        return Err(too_long(path));
    }
    let text = std::str::from_utf8(bytes).map_err(|_| unsupported(path, "bytes that are not UTF-8"))?;
    let read = text::read(text, path)?;
    match read.state.problem() {
        Some(problem) => Err(FormatError::State { path: shown(path), problem }),
        None => Ok(read),
    }
}

fn too_long(path: &Path) -> FormatError {
    unsupported(path, "more than 1 MiB")
}

fn unsupported(path: &Path, found: &'static str) -> FormatError {
    FormatError::Unsupported { path: shown(path), found, expected: "a saved state" }
}

/// Whether these bytes, the first of a file, are those of a state.
pub fn is_state(bytes: &[u8]) -> bool {
    let key = VERSION_KEY.as_bytes();
    bytes.len() as u64 <= MAX_STATE_BYTES && bytes.split(|b| *b == b'\n').any(|line| line.starts_with(key))
}

/// A state larger than this is none: the longest transfer function takes 16 KiB.
pub const MAX_STATE_BYTES: u64 = 1 << 20;
/// The key that tells a state from other files of TOML.
const VERSION_KEY: &str = "isinglass_state";
/// The form that is written and read here.
const VERSION: i64 = 1;
/// How links begin.
const LINK_SCHEME: &str = "isinglass://";
/// How built-in volumes do.
const BUILTIN: &str = "builtin:";

#[cfg(test)]
mod tests;
