//! How the numbers of an array become values: attributes of the CF conventions, which xarray reads and writes too.

use std::path::Path;

use serde_json::Value;

use super::json;
use super::store::Store;
use crate::error::FormatError;
use crate::units::value_unit;

/// The attributes of an array.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ArrayValues {
    /// Slope and intercept of the values.
    pub(super) map: (f64, f64),
    /// The values of voxels without one.
    pub(super) missing: Vec<f64>,
    /// The least and the greatest value that is one.
    pub(super) valid: Option<(f64, f64)>,
    pub(super) unit: Option<String>,
}

impl ArrayValues {
    /// Reads the attributes of the array in the folder `path`, of this version of Zarr.
    pub(super) fn read(store: &Store, path: &Path, version: u8) -> Result<Self, FormatError> {
        let attributes = match version {
            3 => json::read(store, &path.join("zarr.json"))?.and_then(|all| all.get("attributes").cloned()),
            _ => json::read(store, &path.join(".zattrs"))?,
        };
        Ok(Self::of(&attributes.unwrap_or_default()))
    }

    fn of(attributes: &Value) -> Self {
        let is_finite = |x: &f64| x.is_finite();
        let number = |key: &str| attributes[key].as_f64().filter(is_finite);
        let numbers = |key: &str| -> Vec<f64> {
            let list = attributes[key]
                .as_array()
                .map(|list| list.iter().take(MOST_NUMBERS).filter_map(Value::as_f64));
            list.map_or_else(|| number(key).into_iter().collect(), |list| list.filter(is_finite).collect())
        };
        let slope = number("scale_factor").filter(|slope| *slope != 0.0).unwrap_or(1.0);
        let intercept = number("add_offset").unwrap_or(0.0);
        let value = |number: f64| slope * number + intercept;
        let mut missing: Vec<f64> =
            ["missing_value", "_FillValue"].into_iter().flat_map(numbers).map(value).collect();
        missing.dedup();
        let range = numbers("valid_range");
        let end = |i: usize, key: &str| range.get(i).copied().or_else(|| number(key));
        let ends = (end(0, "valid_min"), end(1, "valid_max"));
        let valid = (ends != (None, None)).then(|| {
            let (lo, hi) = (value(ends.0.unwrap_or(f64::MIN)), value(ends.1.unwrap_or(f64::MAX)));
            (lo.min(hi), lo.max(hi))
        });
        Self {
            map: (slope, intercept),
            missing,
            valid,
            unit: attributes["units"].as_str().and_then(value_unit),
        }
    }
}

/// Most numbers of an attribute.
const MOST_NUMBERS: usize = 64;

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn numbers_become_values_as_cf_says() {
        let found = ArrayValues::of(
            &json!({"scale_factor": 2, "add_offset": -1024.5, "missing_value": 0, "units": "HU"}),
        );
        let unit = Some("HU".to_owned());
        assert_eq!(found, ArrayValues { map: (2.0, -1024.5), missing: vec![-1024.5], valid: None, unit });
        assert_eq!(ArrayValues::of(&json!({"_FillValue": 7})).missing, [7.0]);
        let several = json!({"scale_factor": -2, "missing_value": [1, "x", 3], "_FillValue": 9, "valid_range": [10, 20]});
        let several = ArrayValues::of(&several);
        assert_eq!((&several.missing[..], several.valid), (&[-2.0, -6.0, -18.0][..], Some((-40.0, -20.0))));
        assert_eq!(ArrayValues::of(&json!({"valid_min": 0})).valid, Some((0.0, f64::MAX)));
        // The control: what is no number changes nothing.
        let plain = ArrayValues { map: (1.0, 0.0), missing: vec![], valid: None, unit: None };
        for nothing in [json!(null), json!({"scale_factor": 0, "missing_value": "NaN"}), json!([1])] {
            assert_eq!(ArrayValues::of(&nothing), plain);
        }
    }
}
