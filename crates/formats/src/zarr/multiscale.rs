//! Interprets the attributes of an image.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use glam::DVec3;
use isinglass_core::volume::VolumeLabel;
use serde_json::Value;

use super::array::Array;
use super::json;
use super::store::Store;
use crate::axes::{Geometry, World};
use crate::cf::NumberMeaning;
use crate::error::{FormatError, malformed, quoted};
use crate::levels::LevelGrid;
use crate::outline::Level;
use crate::plan::{Axis, AxisKind, ChannelLook, Plan, Role};
use crate::pyramid::put_in_finest;
use crate::units::{length_unit, time_step, time_unit};

/// An image of several levels.
pub(super) struct Multiscale {
    version: String,
    /// Slowest first.
    axes: Vec<NamedAxis>,
    pub(super) levels: Vec<LevelPath>,
    /// The transformation after that of each level.
    all: Transform,
    channels: Vec<String>,
    looks: Vec<ChannelLook>,
    /// What the labels mean, if the image has labels.
    labels: Option<Vec<VolumeLabel>>,
    /// Whether the axes are named. A single array is no image.
    pub(super) is_image: bool,
    /// What this program adds to its own images.
    own: OwnWords,
}

/// What isinglass says of an image for which OME-Zarr has no word.
#[derive(Clone, Debug, Default)]
struct OwnWords {
    /// Whether the axes are those of a space with y up, and not of an image.
    is_space: bool,
    /// Whether the translations tell no position.
    has_no_position: bool,
    modality: Option<String>,
}

impl OwnWords {
    fn of(attributes: &Value) -> Self {
        let own = &attributes["isinglass"];
        let modality = own["modality"].as_str().map(|text| quoted(text).trim_matches('"').to_owned());
        Self {
            is_space: own["frame"].as_str() == Some("space"),
            has_no_position: own["position"].as_bool() == Some(false),
            modality,
        }
    }
}

struct NamedAxis {
    kind: AxisKind,
    /// Its unit in metres, and the short name of the unit.
    unit: Option<(f64, &'static str)>,
    /// Its unit in seconds, if it is one of time.
    seconds: Option<f64>,
    /// Where it points in a body, in RAS+, if it says so.
    toward: Option<DVec3>,
}

/// The array of a level and its transformation.
pub(super) struct LevelPath {
    pub(super) path: PathBuf,
    /// Its own transformation; `None` if its size implies it.
    own: Option<Transform>,
}

impl Multiscale {
    /// Reads the image in the folder `path`; `None` if there is none. A single array is an image with one level.
    pub(super) fn read(store: &Store, path: &Path) -> Result<Option<Self>, FormatError> {
        let bad = malformed(path, "OME-Zarr");
        let attributes = match json::read(store, &path.join("zarr.json"))? {
            Some(value) if value["node_type"].as_str() == Some("array") => {
                return Self::of_array(store, path);
            }
            Some(value) => json::attributes_in(&value),
            None if store.has(&path.join(".zarray"))? => return Self::of_array(store, path),
            None => json::read(store, &path.join(".zattrs"))?,
        };
        let Some(attributes) = attributes else { return Ok(None) };
        let images = attributes["multiscales"].as_array();
        let Some(image) = images.and_then(|l| l.first()) else { return Ok(None) };
        Self::of(image, &attributes).map(Some).map_err(bad)
    }

    fn of(image: &Value, attributes: &Value) -> Result<Self, String> {
        let text = |v: Option<&Value>| v.and_then(Value::as_str).map(str::to_owned);
        let version =
            text(attributes.get("version")).or_else(|| text(image.get("version"))).unwrap_or_default();
        let system = coordinate_system(image);
        let axes = match system.unwrap_or(image)["axes"].as_array() {
            Some(list) if list.len() <= 8 => list.iter().map(NamedAxis::of).collect::<Result<Vec<_>, _>>()?,
            Some(list) => return Err(format!("it has {} axes, expected two to five", list.len())),
            // Versions before 0.3 always have five axes.
            None => ["t", "c", "z", "y", "x"]
                .iter()
                .map(|n| NamedAxis::of(&Value::from(*n)))
                .collect::<Result<_, _>>()?,
        };
        for (i, axis) in axes.iter().enumerate() {
            if axes[..i].iter().any(|a| a.kind == axis.kind) {
                return Err(format!("two of its axes are {:?}, expected each once", axis.kind));
            }
        }
        if !(0..2).all(|k| axes.iter().any(|a| a.kind == AxisKind::Space(k))) {
            return Err("it has no axes x and y".into());
        }
        let datasets = image["datasets"].as_array().filter(|l| (1..=MAX_LEVELS).contains(&l.len()));
        let datasets = datasets.ok_or_else(|| format!("it has no datasets, expected 1 to {MAX_LEVELS}"))?;
        // From version 0.6 on, these lead to other systems.
        let to_all = image.get("coordinateTransformations").filter(|_| system.is_none());
        let all = Transform::of(to_all, axes.len())?;
        let all = all.unwrap_or_else(|| Transform::none(axes.len()));
        let mut levels = Vec::new();
        for dataset in datasets {
            let name = dataset["path"].as_str().unwrap_or_default();
            let path = PathBuf::from(name);
            if name.is_empty() || !path.components().all(|c| matches!(c, Component::Normal(_))) {
                return Err(format!("a level is at {}, expected a folder in it", quoted(name)));
            }
            let own = Transform::of(dataset.get("coordinateTransformations"), axes.len())?;
            levels.push(LevelPath { path, own });
        }
        let omero = attributes.get("omero").or_else(|| image.get("omero"));
        let channels = omero.and_then(|o| o.get("channels")).and_then(Value::as_array);
        let label = |c: &Value| quoted(c["label"].as_str().unwrap_or_default()).trim_matches('"').to_owned();
        let look = |c: &Value| ChannelLook {
            window: c["window"]["start"].as_f64().zip(c["window"]["end"].as_f64()),
            color: c["color"].as_str().and_then(color),
            is_hidden: c["active"].as_bool() == Some(false),
        };
        let channels = channels.map_or(&[][..], |list| &list[..list.len().min(1024)]);
        let looks = channels.iter().map(look).collect();
        let channels = channels.iter().map(label).collect();
        Ok(Self {
            version,
            axes,
            levels,
            all,
            channels,
            looks,
            labels: labels(attributes),
            is_image: true,
            own: OwnWords::of(attributes),
        })
    }

    fn of_array(store: &Store, path: &Path) -> Result<Option<Self>, FormatError> {
        let array = Array::read(store, path)?;
        let n = array.shape.len();
        let names = ["t", "c", "z", "y", "x"];
        let bad = malformed(path, "Zarr array");
        if !(2..=5).contains(&n) {
            return Err(bad(format!("it has {n} axes, expected two to five")));
        }
        let axes = names[5 - n..]
            .iter()
            .map(|n| NamedAxis::of(&Value::from(*n)))
            .collect::<Result<_, _>>()
            .map_err(bad)?;
        let levels = vec![LevelPath { path: PathBuf::new(), own: None }];
        let (version, all) = (String::new(), Transform::none(n));
        Ok(Some(Self {
            version,
            axes,
            levels,
            all,
            channels: vec![],
            looks: vec![],
            labels: None,
            is_image: false,
            own: OwnWords::default(),
        }))
    }

    /// Sizes along x, y and z of an array with this shape.
    pub(super) fn space_of(&self, shape: &[u64]) -> [u64; 3] {
        let size = |k: usize| {
            self.axes.iter().zip(shape).find(|(a, _)| a.kind == AxisKind::Space(k)).map_or(1, |(_, n)| *n)
        };
        [size(0), size(1), size(2)]
    }

    /// Channels of an array with this shape that are parts of one picture.
    pub(super) fn num_channels(&self, shape: &[u64]) -> u64 {
        let is_joint = self.is_image && self.labels.is_none();
        let axis = self.axes.iter().position(|a| a.kind == AxisKind::Channel).filter(|_| is_joint);
        axis.and_then(|axis| shape.get(axis)).copied().unwrap_or(1)
    }

    /// The transformation of a level. A level without one has the extent of the finest level.
    fn transform(&self, arrays: &[Array], level: usize) -> Transform {
        let own = self.levels[level].own.clone().unwrap_or_else(|| {
            let finest = &self.levels[0].own;
            let mut own = finest.clone().unwrap_or_else(|| Transform::none(self.axes.len()));
            for (i, axis) in self.axes.iter().enumerate().filter(|_| level > 0) {
                let (whole, here) = (arrays[0].shape[i], arrays[level].shape[i]);
                if matches!(axis.kind, AxisKind::Space(_)) && whole != here && here > 0 {
                    // Writers cut or pad sizes that do not divide. The step is then the power of two.
                    let ratio = whole as f64 / here as f64;
                    let step = ratio.log2().round().exp2();
                    let ratio = if whole.div_ceil(here) as f64 == step || (whole / here) as f64 == step {
                        step
                    } else {
                        ratio
                    };
                    // The first voxel is the mean of several, so its centre is further inside.
                    own.translation[i] += own.scale[i] * (ratio - 1.0) / 2.0;
                    own.scale[i] *= ratio;
                }
            }
            own
        });
        own.then(&self.all)
    }

    /// Where x, y and z point in a body, if the axes say so and are at right angles.
    fn directions(&self) -> Option<[DVec3; 3]> {
        let toward = |k: usize| self.axes.iter().find(|a| a.kind == AxisKind::Space(k))?.toward;
        let directions = [toward(0)?, toward(1)?, toward(2)?];
        let [x, y, z] = directions;
        (x.dot(y.cross(z)).abs() > 0.5).then_some(directions)
    }

    pub(super) fn plan(
        &self,
        arrays: &[Array],
        level: usize,
        values: &NumberMeaning,
    ) -> Result<Plan, String> {
        let array = &arrays[level];
        if let Some(other) = arrays.iter().find(|a| a.shape.len() != self.axes.len()) {
            return Err(format!("an array has shape {:?}, expected {} axes", other.shape, self.axes.len()));
        }
        let (place, finest) = (self.transform(arrays, level), self.transform(arrays, 0));
        let unit = self.axes.iter().find(|a| a.kind == AxisKind::Space(0)).and_then(|a| a.unit);
        // Converts a length to the unit of x.
        let length = |i: usize, number: f64| match (self.axes[i].unit, unit) {
            (Some((own, _)), Some((x, _))) => number * own / x,
            _ => number,
        };
        let (mut axes, mut steps, mut origin) = (Vec::new(), Vec::new(), DVec3::ZERO);
        let mut seen = [false; 3];
        let mut in_finest = LevelGrid::finest([1; 3]);
        let directions = self.directions();
        let along = directions.unwrap_or(DVec3::AXES);
        for i in (0..self.axes.len()).rev() {
            let role = match self.axes[i].kind {
                AxisKind::Space(k) => {
                    steps.push(along[k] * length(i, place.scale[i]));
                    origin += along[k] * length(i, place.translation[i]);
                    seen[k] = true;
                    let axis = steps.len() - 1;
                    in_finest.finest_dims[axis] = arrays[0].shape[i];
                    in_finest.step[axis] = place.scale[i] / finest.scale[i];
                    in_finest.first[axis] = (place.translation[i] - finest.translation[i]) / finest.scale[i];
                    Role::Space(axis)
                }
                AxisKind::Channel => Role::Channel,
                AxisKind::Time => Role::Time,
            };
            axes.push(Axis { size: array.shape[i], role });
        }
        if let Some(k) = seen.iter().position(|s| !s) {
            axes.push(Axis { size: 1, role: Role::Space(2) });
            steps.push(DVec3::AXES[k] * steps[0].length());
        }
        let geometry = Geometry {
            steps: [steps[0], steps[1], steps[2]],
            origin: (self.is_image && !self.own.has_no_position).then_some(origin),
            world: match directions {
                Some(_) => World::Body,
                None if self.own.is_space => World::Space,
                None => World::Image,
            },
            unit: unit.map(|u| u.1.to_owned()),
        };
        let name = if self.is_image {
            format!("OME-Zarr {}", quoted(&self.version).trim_matches('"'))
        } else {
            "Zarr array".into()
        };
        let format = format!("{}, Zarr {}", name.trim_end(), array.version);
        let mut plan = Plan::new(format, array.dtype, array.codecs.endian, axes, geometry);
        plan.channel_names.clone_from(&self.channels);
        let (slope, intercept) = values.map;
        let in_values = |(start, end): (f64, f64)| {
            let (from, to) = (slope * start + intercept, slope * end + intercept);
            (from.min(to), from.max(to))
        };
        let look = |look: &ChannelLook| ChannelLook { window: look.window.map(in_values), ..*look };
        plan.channel_looks = self.looks.iter().map(look).collect();
        plan.value_map = values.map;
        plan.missing.values.extend(&values.missing);
        plan.missing.valid = values.valid;
        plan.value_unit.clone_from(&values.unit);
        plan.modality.clone_from(&self.own.modality);
        if self.is_image && self.labels.is_none() {
            plan.join_channels();
        }
        plan.are_labels = self.labels.is_some();
        plan.labels = self.labels.clone().unwrap_or_default();
        let in_time = self.axes.iter().zip(&place.scale).find(|(axis, _)| axis.kind == AxisKind::Time);
        plan.time_step = in_time.and_then(|(axis, scale)| time_step(scale * axis.seconds?));
        plan.level = level;
        if level > 0 {
            put_in_finest(&mut plan, in_finest);
        }
        if arrays.len() > 1 {
            let spacing = |place: &Transform, k: usize| {
                let i = self.axes.iter().position(|a| a.kind == AxisKind::Space(k));
                i.map_or(1.0, |i| length(i, place.scale[i]))
            };
            plan.levels = arrays
                .iter()
                .enumerate()
                .map(|(i, a)| {
                    let place = self.transform(arrays, i);
                    Level { dims: self.space_of(&a.shape), spacing: [0, 1, 2].map(|k| spacing(&place, k)) }
                })
                .collect();
        }
        if self.is_image
            && self.levels.iter().all(|l| l.own.is_none())
            && self.all == Transform::none(self.axes.len())
        {
            plan.spacing_guess = Some("the image has no spacing; it was taken as 1".into());
        }
        if !self.is_image {
            plan.spacing_guess = Some("an array has no spacing; it was taken as 1".into());
        }
        Ok(plan)
    }
}

/// The system of coordinates into which the levels are transformed; `None` before version 0.6.
fn coordinate_system(image: &Value) -> Option<&Value> {
    let systems = image["coordinateSystems"].as_array()?;
    let output = &image["datasets"][0]["coordinateTransformations"][0]["output"];
    let name = output["name"].as_str().or(output.as_str());
    let named = systems.iter().find(|system| name.is_some() && system["name"].as_str() == name);
    named.or(systems.first())
}

/// What an `image-label` says about its labels; `None` if there is none.
fn labels(attributes: &Value) -> Option<Vec<VolumeLabel>> {
    let told = attributes.get("image-label").filter(|told| told.is_object())?;
    let list = |key: &str| told[key].as_array().map_or(&[][..], |list| &list[..list.len().min(MAX_LABELS)]);
    let value = |entry: &Value| entry["label-value"].as_u64().and_then(|n| u32::try_from(n).ok());
    let mut found = BTreeMap::<u32, (String, Option<[u8; 3]>)>::new();
    for entry in list("colors") {
        let part = |i: usize| entry["rgba"][i].as_u64().and_then(|n| u8::try_from(n).ok());
        let color = part(0).zip(part(1)).zip(part(2)).map(|((r, g), b)| [r, g, b]);
        if let Some(value) = value(entry) {
            found.entry(value).or_default().1 = color;
        }
    }
    for entry in list("properties") {
        let name = ["name", "label", "class"].iter().find_map(|key| entry[*key].as_str());
        if let (Some(value), Some(name)) = (value(entry), name) {
            found.entry(value).or_default().0 = quoted(name).trim_matches('"').to_owned();
        }
    }
    let label = |(value, (name, color))| VolumeLabel { value, name, color };
    Some(found.into_iter().filter(|(value, _)| *value > 0).map(label).collect())
}

/// The direction in RAS+ of an axis with this anatomical orientation.
fn toward(orientation: &str) -> Option<DVec3> {
    Some(match orientation {
        "left-to-right" => DVec3::X,
        "right-to-left" => DVec3::NEG_X,
        "posterior-to-anterior" => DVec3::Y,
        "anterior-to-posterior" => DVec3::NEG_Y,
        "inferior-to-superior" => DVec3::Z,
        "superior-to-inferior" => DVec3::NEG_Z,
        _ => return None,
    })
}

/// A colour in six hexadecimal digits, perhaps after a number sign.
fn color(text: &str) -> Option<[u8; 3]> {
    let digits = text.trim().trim_start_matches('#');
    let number = u32::from_str_radix(digits, 16).ok().filter(|_| digits.len() == 6)?;
    let [_, red, green, blue] = number.to_be_bytes();
    Some([red, green, blue])
}

impl NamedAxis {
    /// Parses a name, or an object with a name.
    fn of(value: &Value) -> Result<Self, String> {
        let name = value.as_str().or_else(|| value["name"].as_str()).unwrap_or_default();
        let kind = value["type"].as_str();
        let kind = match (name, kind) {
            ("x", _) => AxisKind::Space(0),
            ("y", _) => AxisKind::Space(1),
            ("z", _) => AxisKind::Space(2),
            ("t", _) | (_, Some("time")) => AxisKind::Time,
            ("c", _) | (_, Some("channel")) => AxisKind::Channel,
            _ => return Err(format!("an axis is called {}, expected t, c, z, y or x", quoted(name))),
        };
        let unit = value["unit"].as_str();
        let toward = value["orientation"]["value"].as_str().and_then(toward);
        Ok(Self { kind, unit: unit.and_then(length_unit), seconds: unit.and_then(time_unit), toward })
    }
}

/// The scale and translation of a list of transformations.
#[derive(Clone, Debug, PartialEq)]
struct Transform {
    scale: Vec<f64>,
    translation: Vec<f64>,
}

impl Transform {
    fn none(num_axes: usize) -> Self {
        Self { scale: vec![1.0; num_axes], translation: vec![0.0; num_axes] }
    }

    /// This transformation followed by another.
    fn then(self, after: &Self) -> Self {
        let numbers =
            |a: &[f64], f: &dyn Fn(usize, f64) -> f64| a.iter().enumerate().map(|(i, x)| f(i, *x)).collect();
        Self {
            scale: numbers(&self.scale, &|i, x| x * after.scale[i]),
            translation: numbers(&self.translation, &|i, x| x * after.scale[i] + after.translation[i]),
        }
    }

    /// Combines the transformations of a list; `None` if all are the identity.
    fn of(value: Option<&Value>, num_axes: usize) -> Result<Option<Self>, String> {
        let mut all = None;
        for step in value.and_then(Value::as_array).into_iter().flatten() {
            // A sequence has no sequences in it.
            match step["type"].as_str() {
                Some("sequence") => {
                    let steps = step["transformations"].as_array().into_iter().flatten();
                    steps.into_iter().try_for_each(|step| Self::add(&mut all, step, num_axes))?;
                }
                _ => Self::add(&mut all, step, num_axes)?,
            }
        }
        Ok(all)
    }

    /// Adds one transformation after the others.
    fn add(all: &mut Option<Self>, step: &Value, num_axes: usize) -> Result<(), String> {
        let kind = step["type"].as_str().unwrap_or_default();
        let numbers = || {
            let list: Option<Vec<f64>> = step.get(kind)?.as_array()?.iter().map(Value::as_f64).collect();
            list.filter(|l| l.len() == num_axes)
        };
        let mut next = Self::none(num_axes);
        let field = match kind {
            "identity" => return Ok(()),
            "scale" => &mut next.scale,
            "translation" => &mut next.translation,
            _ => {
                return Err(format!("a transformation is {}, expected scale or translation", quoted(kind)));
            }
        };
        let problem = || format!("{kind} is {}, expected {num_axes} numbers", quoted(&step.to_string()));
        *field = numbers().ok_or_else(problem)?;
        *all = Some(all.take().unwrap_or_else(|| Self::none(num_axes)).then(&next));
        Ok(())
    }
}

const MAX_LEVELS: usize = 64;
/// Most labels with a name or colour.
const MAX_LABELS: usize = 1 << 16;
