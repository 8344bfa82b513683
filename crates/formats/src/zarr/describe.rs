//! The attributes of an image as OME-Zarr 0.4 has them, and the map of values as CF conventions have it.

use std::ops::Range;

use isinglass_core::volume::VolumeLabel;
use serde_json::{Map, Value, json};

use super::pyramid::PyramidLevel;
use crate::axes::World;
use crate::padding::GapNumbers;
use crate::plan::{ChannelLook, Plan};
use crate::units::length_unit;

/// What the attributes of an image say.
pub(crate) struct ImageFacts<'a> {
    pub(crate) name: String,
    pub(crate) plan: &'a Plan,
    pub(crate) levels: &'a [PyramidLevel],
    /// The centre of the first voxel along x, y and z, if the file has a position.
    pub(crate) first: Option<[f64; 3]>,
    /// What the axes are of.
    pub(crate) world: World,
    /// Points in time and channels; `None` if there is no such axis.
    pub(crate) num_times: Option<u64>,
    pub(crate) num_channels: Option<u64>,
    /// Which channels of the plan they are.
    pub(crate) channels: Range<u64>,
    pub(crate) are_labels: bool,
    /// The numbers of voxels without a value.
    pub(crate) gaps: &'a GapNumbers,
}

impl ImageFacts<'_> {
    /// The attributes of the group.
    pub(crate) fn of_group(&self) -> Value {
        let datasets: Vec<Value> = (0..self.levels.len()).map(|i| self.dataset(i)).collect();
        let mut all = json!({
            "multiscales": [{
                "version": VERSION,
                "name": self.name,
                "axes": self.axes(),
                "datasets": datasets,
                "type": if self.are_labels { "mode" } else { "mean" },
            }],
        });
        let more = if self.are_labels {
            Some(("image-label", labels(&self.plan.labels)))
        } else {
            self.omero().map(|omero| ("omero", omero))
        };
        let own = self.own();
        let own = (!own.is_empty()).then_some(("isinglass", Value::Object(own)));
        for (key, value) in more.into_iter().chain(own) {
            all[key] = value;
        }
        all
    }

    /// The attributes of each array: how its numbers become values.
    pub(crate) fn of_array(&self) -> Value {
        let mut list = Map::new();
        let (slope, intercept) = self.plan.value_map;
        if (slope, intercept) != (1.0, 0.0) {
            list.insert("scale_factor".into(), slope.into());
            list.insert("add_offset".into(), intercept.into());
        }
        let missing = match &self.gaps.numbers[..] {
            [] => None,
            [one] => Some(Value::from(*one)),
            several => Some(Value::from(several)),
        };
        list.extend(missing.map(|missing| ("missing_value".to_owned(), missing)));
        // The type tells that the ends are numbers of the array, and not values.
        let is_whole = self.plan.dtype.integer_range().is_some();
        let range = |(lo, hi): (f64, f64)| match is_whole {
            true => json!([lo.round() as i64, hi.round() as i64]),
            false => json!([lo, hi]),
        };
        list.extend(self.gaps.valid.map(|ends| ("valid_range".to_owned(), range(ends))));
        list.extend(self.plan.value_unit.clone().map(|unit| ("units".to_owned(), unit.into())));
        Value::Object(list)
    }

    /// What OME-Zarr has no word for.
    fn own(&self) -> Map<String, Value> {
        let mut own = Map::new();
        if self.world == World::Space {
            own.insert("frame".into(), "space".into());
        }
        if self.first.is_none() {
            own.insert("position".into(), false.into());
        }
        own.extend(self.plan.modality.clone().map(|modality| ("modality".to_owned(), modality.into())));
        own
    }

    fn axes(&self) -> Vec<Value> {
        let mut axes = Vec::new();
        if self.num_times.is_some() {
            axes.push(match self.plan.time_step {
                Some(_) => json!({"name": "t", "type": "time", "unit": "second"}),
                None => json!({"name": "t", "type": "time"}),
            });
        }
        if self.num_channels.is_some() {
            axes.push(json!({"name": "c", "type": "channel"}));
        }
        let unit =
            self.plan.geometry.unit.as_deref().and_then(length_unit).and_then(|(_, short)| long(short));
        for (name, toward) in ["z", "y", "x"].into_iter().zip(TOWARD) {
            let mut axis = json!({"name": name, "type": "space"});
            if let Some(unit) = unit {
                axis["unit"] = unit.into();
            }
            if self.world == World::Body {
                axis["orientation"] = json!({"type": "anatomical", "value": toward});
            }
            axes.push(axis);
        }
        axes
    }

    fn dataset(&self, number: usize) -> Value {
        let level = &self.levels[number];
        let first = self.first.unwrap_or([0.0; 3]);
        let mut scale: Vec<f64> =
            self.num_times.map(|_| self.plan.time_step.unwrap_or(1.0)).into_iter().collect();
        scale.extend(self.num_channels.map(|_| 1.0));
        let mut translation = vec![0.0; scale.len()];
        scale.extend(level.spacing.iter().rev());
        translation.extend((0..3).rev().map(|k| first[k] + level.shift[k]));
        json!({
            "path": number.to_string(),
            "coordinateTransformations": [
                {"type": "scale", "scale": scale},
                {"type": "translation", "translation": translation},
            ],
        })
    }

    /// Names, colours and windows of the channels, if any is known.
    fn omero(&self) -> Option<Value> {
        let plan = self.plan;
        let look = |i: u64| plan.channel_looks.get(i as usize).copied().unwrap_or_default();
        let name = |i: u64| plan.channel_names.get(i as usize).map_or("", String::as_str);
        let is_alone = self.channels.end - self.channels.start == 1;
        let is_hidden = |i: u64| look(i).is_hidden || (!is_alone && i >= plan.num_joint);
        let is_known = |i: u64| look(i) != ChannelLook::default() || !name(i).is_empty() || is_hidden(i);
        if !self.channels.clone().any(is_known) {
            return None;
        }
        let channel = |i: u64| {
            let mut channel = json!({"label": name(i), "active": !is_hidden(i)});
            if let Some([red, green, blue]) = look(i).color {
                channel["color"] = format!("{red:02X}{green:02X}{blue:02X}").into();
            }
            if let Some((from, to)) = look(i).window {
                let (slope, intercept) = plan.value_map;
                let number = |value: f64| (value - intercept) / slope;
                let (start, end) = (number(from).min(number(to)), number(from).max(number(to)));
                let (min, max) = plan.dtype.integer_range().unwrap_or((start, end));
                channel["window"] = json!({"start": start, "end": end, "min": min, "max": max});
            }
            channel
        };
        let channels: Vec<Value> = self.channels.clone().map(channel).collect();
        Some(
            json!({"version": VERSION, "name": self.name, "channels": channels, "rdefs": {"model": "color"}}),
        )
    }
}

fn labels(labels: &[VolumeLabel]) -> Value {
    let colors: Vec<Value> = labels
        .iter()
        .filter_map(|label| {
            let [red, green, blue] = label.color?;
            Some(json!({"label-value": label.value, "rgba": [red, green, blue, 255]}))
        })
        .collect();
    let named = labels.iter().filter(|label| !label.name.is_empty());
    let properties: Vec<Value> =
        named.map(|label| json!({"label-value": label.value, "name": label.name})).collect();
    let mut all = json!({"version": VERSION});
    for (key, list) in [("colors", colors), ("properties", properties)] {
        if !list.is_empty() {
            all[key] = list.into();
        }
    }
    all
}

/// The name of a unit in OME-Zarr, which takes them from UDUNITS.
fn long(short: &str) -> Option<&'static str> {
    Some(match short {
        "pm" => "picometer",
        "Å" => "angstrom",
        "nm" => "nanometer",
        "µm" => "micrometer",
        "mm" => "millimeter",
        "cm" => "centimeter",
        "m" => "meter",
        "km" => "kilometer",
        "in" => "inch",
        _ => return None,
    })
}

const VERSION: &str = "0.4";
/// Where z, y and x of RAS+ point.
const TOWARD: [&str; 3] = ["inferior-to-superior", "posterior-to-anterior", "left-to-right"];
