//! A saved state: the camera, the look and the view of a volume, as a small TOML file or in a link.
//!
//! ```toml
//! isinglass_state = 1                  # what the file is; the number of its form
//! views = []                           # views with a name
//! measures = []                        # what was measured: a kind, and points in world space
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
//! Everything except the first line may be missing, and then stays unchanged. Numbers read back to the bit, so the
//! same volume gives the same picture. Unknown keys, such as those of a newer program, are ignored and reported.

mod link;
mod marks;
mod slices;
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
use crate::reading::{Meaning, Reading};
use crate::selection::{Flip, Selection};
use crate::source::{read_file, source_exists};
use crate::transfer::rgb_from_hex;
use crate::volume_source::VolumeSource;
use crate::web::{host_of_address, is_address, shown_address};

pub use link::{MAX_LINK_BYTES, state_from_link, state_to_link};
pub use marks::{
    MAX_MEASURE_POINTS, MAX_MEASURES, MAX_VIEWS, MeasureKind, NamedView, SavedMeasure, UpAxis, is_view_name,
};
pub use slices::{SavedPlane, SavedSlices};

/// The camera, look and view of a volume. A missing part stays unchanged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SavedState {
    /// The volume.
    pub volume: Option<SavedVolume>,
    /// The camera.
    pub camera: Option<SavedCamera>,
    /// What is drawn around the picture, and how the viewer shows it.
    pub view: SavedView,
    /// How frames are made.
    pub look: Option<Look>,
    /// Views with a name.
    pub views: Option<Vec<NamedView>>,
    /// What was measured.
    pub measures: Option<Vec<SavedMeasure>>,
}

/// The description of a volume in a state.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedVolume {
    /// File name or name of the built-in volume.
    pub name: String,
    /// The path, `builtin:NAME` or link of a server that opens it, if known.
    pub source: Option<String>,
    /// The address of the server that showed it, as `host:port`.
    pub server: Option<String>,
    /// Channel of the file.
    pub channel: Option<u32>,
    /// Point in time.
    pub time: Option<u32>,
    /// Level of a pyramid.
    pub level: Option<u32>,
    /// Series of a folder.
    pub series: Option<u32>,
    /// Part of the volume, in the form of `--region`.
    pub region: Option<String>,
    /// Axes along which the volume is mirrored, in the form of `--flip`.
    pub flip: Option<String>,
    /// Distances between voxels that replace those of the file.
    pub given_spacing: Option<[f32; 3]>,
    /// Whether slices stay as they are stored, in the form of `--stored-slices`.
    pub stored_slices: Option<bool>,
    /// What the voxels mean, in the form of `--voxels`.
    pub voxels: Option<Meaning>,
    /// One voxel in so many is taken, in the form of `--thin`.
    pub thin: Option<u32>,
    /// The path of a file with labels, in the form of `--labels`.
    pub labels: Option<String>,
    /// The shape of a raw file.
    pub raw: Option<RawShape>,
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Size of a voxel, world units.
    pub spacing: [f32; 3],
    /// Least and greatest value.
    pub range: [f32; 2],
}

impl SavedVolume {
    /// The description of a server's volume.
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

    /// The same volume, opened from `volume`.
    pub fn opened_from(self, volume: &VolumeSource) -> Self {
        let VolumeSource { source, raw, selection, spacing, foreign_files: _, reading } = volume.clone();
        let Reading { stored_slices, voxels, thin, labels } = reading;
        let Selection { channel, time, level, series, region, flip } = selection;
        let (region, given_spacing) = (region.map(|r| r.to_string()), spacing.map(Vec3::into));
        let flip = Some(flip).filter(|f| *f != Flip::default()).map(|f| f.to_string());
        let (source, stored_slices) = (Some(source), stored_slices.then_some(true));
        Self {
            source,
            channel,
            time,
            level,
            series,
            region,
            flip,
            given_spacing,
            stored_slices,
            voxels,
            thin,
            labels,
            raw,
            ..self
        }
    }

    /// The source to open, if it is known and not a server.
    ///
    /// # Errors
    /// The region or the flip is invalid.
    pub fn volume_source(&self) -> Result<Option<VolumeSource>, String> {
        let Some(source) = self.source.clone().filter(|_| self.link().is_none()) else { return Ok(None) };
        let (selection, spacing) = (self.selection()?, self.given_spacing.map(Vec3::from));
        let stored_slices = self.stored_slices == Some(true);
        let (voxels, thin, labels) = (self.voxels, self.thin, self.labels.clone());
        Ok(Some(VolumeSource {
            raw: self.raw,
            selection,
            spacing,
            reading: Reading { stored_slices, voxels, thin, labels },
            ..VolumeSource::new(source)
        }))
    }

    /// The same, to open it because a state says so. A state may be anybody's, so it makes the program ask no address
    /// of the web.
    ///
    /// # Errors
    /// The volume or its labels are at an address, or the region or the flip is invalid.
    pub fn source_to_open(&self) -> Result<Option<VolumeSource>, String> {
        let source = self.volume_source().map_err(|e| format!("the state's region: {e}"))?;
        if let Some(address) = self.addresses().next() {
            return Err(format!(
                "the state's volume is at the address {}, which a state alone does not call; name the volume itself: VOLUME --state FILE",
                quoted(shown_address(address))
            ));
        }
        Ok(source)
    }

    /// The addresses of the web that opening the volume and its labels asks.
    fn addresses(&self) -> impl Iterator<Item = &str> {
        [&self.source, &self.labels]
            .into_iter()
            .flatten()
            .map(String::as_str)
            .filter(|place| is_address(place))
    }

    /// The hosts of the web that opening the volume and its labels asks, without repetition.
    pub fn web_hosts(&self) -> Vec<String> {
        let mut hosts: Vec<String> = self.addresses().map(host_of_address).collect();
        hosts.dedup();
        hosts
    }

    /// The part of the file.
    ///
    /// # Errors
    /// The region or the flip is invalid.
    pub fn selection(&self) -> Result<Selection, String> {
        let &Self { channel, time, level, series, .. } = self;
        let region = self.region.as_deref().map(str::parse).transpose()?;
        let flip = self.flip.as_deref().map(str::parse).transpose()?.unwrap_or_default();
        Ok(Selection { channel, time, level, series, region, flip })
    }

    /// The link to a server, if the source is one.
    pub fn link(&self) -> Option<&str> {
        self.source.as_deref().filter(|source| source.trim_start().starts_with(LINK_SCHEME))
    }

    /// The same volume without its source, which may be private.
    pub fn without_place(self) -> Self {
        Self { source: None, server: None, given_spacing: None, labels: None, raw: None, ..self }
    }

    /// Whether the source is a file that exists or a built-in volume. This may wait for a disk.
    pub fn is_here(&self) -> bool {
        let Some(source) = self.source.as_deref().filter(|_| self.link().is_none()) else { return false };
        source_exists(source)
    }

    /// Finds the file of the volume. If it is not at its path, the folder of the state file `state` is searched for
    /// the same name. So both can move together.
    fn found_beside(self, state: &Path) -> Self {
        let Some(folder) = state.parent() else { return self };
        let Some(source) = self.source.as_deref().filter(|_| self.link().is_none()) else { return self };
        let named = Path::new(source);
        let beside = match named.is_relative() {
            true => Some(folder.join(named)),
            false if !source_exists(source) => named.file_name().map(|name| folder.join(name)),
            false => None,
        };
        let found =
            beside.filter(|path| !source.starts_with(BUILTIN) && source_exists(&path.to_string_lossy()));
        let found =
            found.and_then(|path| std::path::absolute(path).ok()?.into_os_string().into_string().ok());
        Self { source: found.or(self.source), ..self }
    }

    /// Describes in one line how another volume differs; `None` if it is the same. Names may differ, because the same
    /// voxels can have another path.
    pub fn difference(&self, other: &Self) -> Option<String> {
        let is_same = self.dims == other.dims && self.spacing == other.spacing && self.range == other.range;
        (!is_same).then(|| format!("the state was made of {self}, and this is {other}"))
    }

    /// As [`SavedVolume::difference`], for an open volume.
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

/// The camera in the form of the viewer's controls, so that it is restored to the bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedCamera {
    /// The point that the camera turns about, world space.
    pub center: [f32; 3],
    /// Rotation from view to world space: x, y, z, w of a quaternion.
    pub rotation: [f32; 4],
    /// The vector from the centre to the eye, view space.
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

    /// The rotation from view to world space, and the vector from the centre to the eye in view space.
    pub fn placement(&self) -> (Quat, Vec3) {
        (Quat::from_array(self.rotation), Vec3::from_array(self.eye_from_center))
    }

    /// Its pose.
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

/// The angle in degrees that reads back as `radians`, with few digits if possible.
fn degrees_of(radians: f32) -> f64 {
    let exact = f64::from(radians).to_degrees();
    let short = (exact * 1e4).round() * 1e-4;
    if short.to_radians() as f32 == radians { short } else { exact }
}

/// How the viewer shows a picture.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedView {
    /// Whether the volume's edges are drawn.
    #[serde(rename = "box")]
    pub shows_box: Option<bool>,
    /// Whether axes and scale bar are drawn.
    #[serde(rename = "axes")]
    pub shows_axes: Option<bool>,
    /// Whether the key to the colours is shown.
    #[serde(rename = "legend")]
    pub shows_legend: Option<bool>,
    /// Whether the numbers are shown.
    #[serde(rename = "numbers")]
    pub shows_numbers: Option<bool>,
    /// Colour behind the volume.
    pub background: Option<Srgb>,
    /// Colours of the panels.
    pub theme: Option<Theme>,
    /// The form of a picture for two eyes.
    pub stereo: Option<StereoPicture>,
    /// Whether rays are parallel. The point that the camera turns about then has the same size as with the field of
    /// view.
    pub orthographic: Option<bool>,
    /// The angle between the eyes, degrees.
    pub eye_angle_degrees: Option<f32>,
    /// Size of the server's frames, relative to the picture.
    pub frame_scale: Option<f32>,
    /// The slices beside the picture.
    pub slices: Option<SavedSlices>,
    /// The axis that points up.
    pub up: Option<UpAxis>,
}

impl SavedView {
    pub(crate) fn problem(&self) -> Option<String> {
        let in_range = |what, value: Option<f32>, least: f32, most: f32| {
            let value = value.filter(|v| !(least..=most).contains(v))?;
            Some(format!("{what} is {value}, expected {least} to {most}"))
        };
        in_range("eye_angle_degrees", self.eye_angle_degrees, 0.0, 90.0)
            .or_else(|| in_range("frame_scale", self.frame_scale, 0.01, 1.0))
            .or_else(|| self.slices.as_ref().and_then(SavedSlices::problem))
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
        let expected = || format!("found {}, expected a colour like \"#20242c\"", quoted(&text));
        rgb_from_hex(&text).map(Self).ok_or_else(|| serde::de::Error::custom(expected()))
    }
}

/// Colours of the viewer's panels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Theme {
    /// Bright text on dark panels.
    Dark,
    /// Dark text on bright panels.
    Light,
    /// The setting of the system.
    System,
}

/// How a picture shows the views of two eyes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StereoPicture {
    /// Both eyes see one picture.
    Off,
    /// The left half shows the view of the left eye.
    SideBySide,
    /// Red shows the view of the left eye, green and blue that of the right.
    RedCyan,
}

/// A state that was read, and a note about its unknown parts.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadState {
    /// The known parts.
    pub state: SavedState,
    /// The keys that were ignored, in one line.
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
            .or_else(|| marks::problem(self.views.as_deref(), self.measures.as_deref()))
    }
}

/// Reads the state in a file. If the volume is not at its path but beside the state, its path is corrected.
///
/// # Errors
/// There is no such file, or it does not contain a known form of state. The message is one line.
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

/// Whether a file that begins with these bytes is a state.
pub fn is_state(bytes: &[u8]) -> bool {
    let key = VERSION_KEY.as_bytes();
    bytes.len() as u64 <= MAX_STATE_BYTES && bytes.split(|b| *b == b'\n').any(|line| line.starts_with(key))
}

/// Longest state in bytes. The longest transfer function takes 16 KiB.
pub const MAX_STATE_BYTES: u64 = 1 << 20;
/// The key that marks a TOML file as a state.
const VERSION_KEY: &str = "isinglass_state";
const VERSION: i64 = 1;
const LINK_SCHEME: &str = "isinglass://";
/// The beginning of built-in volumes.
const BUILTIN: &str = "builtin:";

#[cfg(test)]
mod tests;
