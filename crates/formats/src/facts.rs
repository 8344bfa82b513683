//! The facts that `isinglass info` prints about a volume.

use std::fmt;

use isinglass_core::space::IMAGE_AXES;
use isinglass_core::volume::{Histogram, Volume};
use serde::ser::{SerializeMap, Serializer};

use crate::outline::Outline;

/// Facts about a volume. They serialise to the object of `info --json`.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct VolumeFacts {
    /// File name or name of the built-in volume.
    #[serde(skip)]
    pub name: String,
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Type of a voxel in the file.
    pub dtype: String,
    /// Distances between voxel centres along x, y, z.
    pub spacing: [f32; 3],
    /// Unit of the spacing, if known.
    #[serde(skip)]
    pub unit: Option<String>,
    /// Least and greatest value.
    pub range: [f32; 2],
    /// Unit of the values, if known.
    #[serde(skip)]
    pub value_unit: Option<String>,
    /// Values at [`PERCENTILES`]; in JSON an object such as `{"1": 0.0, …, "99.9": 255.0}`.
    #[serde(serialize_with = "percentile_map")]
    pub percentiles: [f32; PERCENTILES.len()],
    /// Where the axes point, such as `RAS`, if known.
    pub orientation: Option<String>,
    /// Bytes that the voxels and their brightness take in memory and on the GPU.
    pub bytes_in_memory: u64,
    /// Warnings about the file, one sentence each.
    pub warnings: Vec<String>,
    /// What else the file contains; `None` for a built-in volume.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<Outline>,
}

impl VolumeFacts {
    /// The facts about `volume`. `histogram` must be its histogram.
    pub fn of(volume: &Volume, histogram: &Histogram) -> Self {
        let (lo, hi) = volume.value_range();
        Self {
            name: volume.info.name.clone(),
            dims: volume.dims(),
            dtype: volume.info.dtype.clone(),
            spacing: volume.spacing().to_array(),
            unit: volume.info.unit.clone(),
            range: [lo, hi],
            value_unit: volume.info.value_unit.clone(),
            percentiles: PERCENTILES.map(|p| histogram.percentile(p)),
            orientation: volume.info.orientation.clone(),
            bytes_in_memory: volume.bytes_in_memory(),
            warnings: volume.info.warnings.clone(),
            file: None,
        }
    }
}

impl fmt::Display for VolumeFacts {
    /// Prints a few lines for people. Each ends with a line feed.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let ([nx, ny, nz], [sx, sy, sz], [lo, hi]) = (self.dims, self.spacing, self.range);
        let unit = self.unit.as_ref().map_or(String::new(), |u| format!(" {u}"));
        writeln!(f, "{}", self.name)?;
        writeln!(f, "  dimensions   {nx} × {ny} × {nz}")?;
        writeln!(f, "  type         {}", self.dtype)?;
        writeln!(f, "  spacing      {sx} × {sy} × {sz}{unit}")?;
        let value_unit = self.value_unit.as_ref().map_or(String::new(), |u| format!(" {u}"));
        writeln!(f, "  values       {lo} to {hi}{value_unit}")?;
        let pairs: Vec<String> =
            PERCENTILES.iter().zip(self.percentiles).map(|(p, value)| format!("{p} %: {value}")).collect();
        writeln!(f, "  percentiles  {}", pairs.join("   "))?;
        let orientation = match self.orientation.as_deref() {
            Some(IMAGE_AXES) => "of an image: x to the right, y down, z back",
            letters => letters.unwrap_or("unknown"),
        };
        writeln!(f, "  orientation  {orientation}")?;
        let bytes = self.bytes_in_memory as f64;
        let (amount, unit) = if bytes < 1e6 { (bytes / 1e3, "kB") } else { (bytes / 1e6, "MB") };
        writeln!(f, "  memory       {amount:.1} {unit}")?;
        if let Some(outline) = &self.file {
            write!(f, "{outline}")?;
        }
        self.warnings.iter().try_for_each(|warning| writeln!(f, "  note: {warning}"))
    }
}

fn percentile_map<S: Serializer>(
    values: &[f32; PERCENTILES.len()],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(Some(values.len()))?;
    for (percent, value) in PERCENTILES.iter().zip(values) {
        map.serialize_entry(&percent.to_string(), value)?;
    }
    map.end()
}

/// The percentiles that are reported, in percent of the voxels.
pub const PERCENTILES: [f32; 10] = [1.0, 5.0, 10.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0, 99.9];

#[cfg(test)]
mod tests {
    use isinglass_core::volume::procedural::Builtin;

    use super::*;

    #[test]
    fn json_has_the_promised_fields_and_no_others() {
        let volume = Builtin::Shells.volume(16);
        let facts = VolumeFacts::of(&volume, &Histogram::of(&volume));
        let json = serde_json::to_value(&facts).unwrap();
        let mut keys: Vec<&str> = json.as_object().unwrap().keys().map(String::as_str).collect();
        keys.sort_unstable();
        let promised = [
            "bytes_in_memory",
            "dims",
            "dtype",
            "orientation",
            "percentiles",
            "range",
            "spacing",
            "warnings",
        ];
        assert_eq!(keys, promised);
        assert_eq!(json["dims"], serde_json::json!([16, 16, 16]));
        assert_eq!(json["bytes_in_memory"], 2 * 4096);
        assert_eq!(json["percentiles"]["99.9"].as_f64().unwrap() as f32, facts.percentiles[9]);
        assert_eq!(json["orientation"], serde_json::Value::Null);
        assert_eq!(facts.to_string().lines().count(), 8);
    }
}
