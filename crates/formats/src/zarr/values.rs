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
    /// The value of voxels without one.
    pub(super) missing: Option<f64>,
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
        let number = |key: &str| attributes[key].as_f64().filter(|x| x.is_finite());
        let slope = number("scale_factor").filter(|slope| *slope != 0.0).unwrap_or(1.0);
        let intercept = number("add_offset").unwrap_or(0.0);
        let missing = number("missing_value").or_else(|| number("_FillValue"));
        Self {
            map: (slope, intercept),
            missing: missing.map(|number| slope * number + intercept),
            unit: attributes["units"].as_str().and_then(value_unit),
        }
    }
}

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
        assert_eq!(found, ArrayValues { map: (2.0, -1024.5), missing: Some(-1024.5), unit });
        assert_eq!(ArrayValues::of(&json!({"_FillValue": 7})).missing, Some(7.0));
        // The control: what is no number changes nothing.
        let plain = ArrayValues { map: (1.0, 0.0), missing: None, unit: None };
        for nothing in [json!(null), json!({"scale_factor": 0, "missing_value": "NaN"}), json!([1])] {
            assert_eq!(ArrayValues::of(&nothing), plain);
        }
    }
}
