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
    /// Which voxels range and percentiles are of.
    pub values_of: ValuesOf,
    /// Least and greatest value; `None` if no voxel was read.
    pub range: Option<[f32; 2]>,
    /// Unit of the values, if known.
    #[serde(skip)]
    pub value_unit: Option<String>,
    /// Values at [`PERCENTILES`]; in JSON an object such as `{"1": 0.0, …, "99.9": 255.0}`.
    #[serde(serialize_with = "percentile_map")]
    pub percentiles: Option<[f32; PERCENTILES.len()]>,
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

/// The voxels that range and percentiles are of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ValuesOf {
    /// All of the part that is described.
    All,
    /// All of it, as its index knows them.
    Index,
    /// All of this level of a pyramid.
    Level(u32),
    /// So many, evenly spread.
    Sample(u64),
    /// So many, the first of the file.
    First(u64),
    /// None.
    Nothing,
}

impl fmt::Display for ValuesOf {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::All => write!(f, "all voxels"),
            Self::Index => write!(f, "all voxels, by the index"),
            Self::Level(level) => write!(f, "all voxels of level {level}"),
            Self::Sample(n) => write!(f, "a sample of {n} voxels"),
            Self::First(n) => write!(f, "the first {n} voxels"),
            Self::Nothing => write!(f, "no voxels"),
        }
    }
}

impl serde::Serialize for ValuesOf {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl VolumeFacts {
    /// What a header says, without values.
    pub(crate) fn of_header(outline: &Outline) -> Self {
        Self {
            name: outline.name.clone(),
            dims: outline.dims,
            dtype: outline.dtype.clone(),
            spacing: outline.spacing,
            unit: outline.unit.clone(),
            values_of: ValuesOf::Nothing,
            range: None,
            value_unit: outline.value_unit.clone(),
            percentiles: None,
            orientation: outline.orientation.clone(),
            bytes_in_memory: outline.bytes_in_memory,
            warnings: outline.warnings.iter().map(|warning| warning.text.clone()).collect(),
            file: Some(outline.clone()),
        }
    }

    /// The same with the values of a histogram.
    pub(crate) fn with_values(self, values_of: ValuesOf, histogram: &Histogram) -> Self {
        let range = [0.0, 100.0].map(|p| histogram.percentile(p));
        let percentiles = PERCENTILES.map(|p| histogram.percentile(p));
        Self { values_of, range: Some(range), percentiles: Some(percentiles), ..self }
    }

    /// The facts about `volume`. `histogram` must be its histogram.
    pub fn of(volume: &Volume, histogram: &Histogram) -> Self {
        let (lo, hi) = volume.value_range();
        Self {
            name: volume.info.name.clone(),
            dims: volume.dims(),
            dtype: volume.info.dtype.clone(),
            spacing: volume.spacing().to_array(),
            unit: volume.info.unit.clone(),
            values_of: ValuesOf::All,
            range: Some([lo, hi]),
            value_unit: volume.info.value_unit.clone(),
            percentiles: Some(PERCENTILES.map(|p| histogram.percentile(p))),
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
        let ([nx, ny, nz], [sx, sy, sz]) = (self.dims, self.spacing);
        let unit = self.unit.as_ref().map_or(String::new(), |u| format!(" {u}"));
        writeln!(f, "{}", self.name)?;
        writeln!(f, "  dimensions   {nx} × {ny} × {nz}")?;
        writeln!(f, "  type         {}", self.dtype)?;
        writeln!(f, "  spacing      {sx} × {sy} × {sz}{unit}")?;
        let value_unit = self.value_unit.as_ref().map_or(String::new(), |u| format!(" {u}"));
        let of = match self.values_of {
            ValuesOf::All => String::new(),
            ValuesOf::Nothing => "not read; --values reads them".to_owned(),
            of => format!(" (of {of}; --values reads all)"),
        };
        let range = self.range.map_or(String::new(), |[lo, hi]| format!("{lo} to {hi}{value_unit}"));
        writeln!(f, "  values       {range}{of}")?;
        if let Some(percentiles) = self.percentiles {
            let pairs = PERCENTILES.iter().zip(percentiles).map(|(p, value)| format!("{p} %: {value}"));
            writeln!(f, "  percentiles  {}", pairs.collect::<Vec<_>>().join("   "))?;
        }
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
    values: &Option<[f32; PERCENTILES.len()]>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    let Some(values) = values else { return serializer.serialize_none() };
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
            "values_of",
            "warnings",
        ];
        assert_eq!(keys, promised);
        assert_eq!(json["dims"], serde_json::json!([16, 16, 16]));
        assert_eq!(json["bytes_in_memory"], 2 * 4096);
        assert_eq!(json["percentiles"]["99.9"].as_f64().unwrap() as f32, facts.percentiles.unwrap()[9]);
        assert_eq!(json["values_of"], "all voxels");
        assert_eq!(json["orientation"], serde_json::Value::Null);
        assert_eq!(facts.to_string().lines().count(), 8);
    }
}
