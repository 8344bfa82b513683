//! How the numbers of a variable become values, and which of them stand for none.

use super::AttributeList;
use crate::dtype::Dtype;
use crate::padding::Missing;
use crate::plan::Plan;
use crate::units::value_unit;

/// What the numbers of a variable mean.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct NumberMeaning {
    /// Slope and intercept of the values.
    pub(crate) map: (f64, f64),
    /// The values of voxels without one.
    pub(crate) missing: Vec<f64>,
    /// The least and the greatest value that is one.
    pub(crate) valid: Option<(f64, f64)>,
    pub(crate) unit: Option<String>,
}

impl NumberMeaning {
    /// Reads the attributes of a variable of this type. Ends of what is valid have the type of the numbers, or else
    /// that of the values if there is a slope or intercept (CF 2.5.1, NUG).
    pub(crate) fn of(attributes: &dyn AttributeList, dtype: Dtype) -> Self {
        let finite = |name: &str| -> Vec<f64> {
            attributes.numbers(name).into_iter().take(MOST_NUMBERS).filter(|x| x.is_finite()).collect()
        };
        let number = |name: &str| finite(name).first().copied();
        let slope = number("scale_factor").filter(|slope| *slope != 0.0).unwrap_or(1.0);
        let intercept = number("add_offset").unwrap_or(0.0);
        let value = |number: f64| number * slope + intercept;
        let is_packed = (slope, intercept) != (1.0, 0.0) && dtype.integer_range().is_some();
        let has = |number: f64| {
            dtype.integer_range().is_none_or(|(lo, hi)| number.fract() == 0.0 && (lo..=hi).contains(&number))
        };
        let mut missing = Vec::new();
        for name in ["missing_value", "_FillValue"] {
            let is_value = |x: f64| is_packed && attributes.has_floats(name) && !has(x);
            let found = finite(name).into_iter().map(|x| with_own_sign(x, dtype));
            missing.extend(found.map(|x| if is_value(x) { x } else { value(x) }));
        }
        missing.dedup();
        let told = match finite("valid_range")[..] {
            [least, most] => [Some(("valid_range", least)), Some(("valid_range", most))],
            _ => ["valid_min", "valid_max"].map(|name| Some((name, number(name)?))),
        };
        // A slope below zero turns the ends over.
        let are_turned =
            slope < 0.0 && told.iter().flatten().all(|(name, _)| !(is_packed && attributes.has_floats(name)));
        let in_values = |(name, x): (&str, f64)| match is_packed && attributes.has_floats(name) {
            true => x,
            false => value(with_own_sign(x, dtype)),
        };
        let [least, most] = told.map(|end| end.map(in_values));
        let (least, most) = if are_turned { (most, least) } else { (least, most) };
        let valid = (least.is_some() || most.is_some())
            .then(|| (least.unwrap_or(f64::MIN), most.unwrap_or(f64::MAX)))
            .map(|(a, b)| (a.min(b), a.max(b)));
        Self {
            map: (slope, intercept),
            missing,
            valid,
            unit: attributes.text("units").and_then(|unit| value_unit(&unit)),
        }
    }

    /// Puts it into a plan.
    pub(crate) fn set(self, plan: &mut Plan) {
        plan.value_map = self.map;
        plan.value_unit = self.unit;
        plan.missing = Missing {
            values: self.missing,
            valid: self.valid,
            what: "missing, as the file says",
            ..Missing::default()
        };
    }
}

/// The type of the numbers with the sign that `_Unsigned` tells, as netCDF writes types that it does not have.
pub(crate) fn signed_as_told(dtype: Dtype, attributes: &dyn AttributeList) -> Dtype {
    let told = attributes.text("_Unsigned").unwrap_or_default().trim().to_lowercase();
    match (&told[..], dtype) {
        ("true", Dtype::Int8) => Dtype::Uint8,
        ("true", Dtype::Int16) => Dtype::Uint16,
        ("true", Dtype::Int32) => Dtype::Uint32,
        ("true", Dtype::Int64) => Dtype::Uint64,
        ("false", Dtype::Uint8) => Dtype::Int8,
        ("false", Dtype::Uint16) => Dtype::Int16,
        ("false", Dtype::Uint32) => Dtype::Int32,
        ("false", Dtype::Uint64) => Dtype::Int64,
        _ => dtype,
    }
}

/// A whole number with the sign of its type, where an attribute has the other one.
fn with_own_sign(number: f64, dtype: Dtype) -> f64 {
    let Some((lo, hi)) = dtype.integer_range().filter(|_| number.fract() == 0.0) else { return number };
    let turn = 2f64.powi(8 * dtype.num_bytes() as i32);
    match () {
        () if lo == 0.0 && number < 0.0 && number >= -turn / 2.0 => number + turn,
        () if lo < 0.0 && number > hi && number < turn => number - turn,
        () => number,
    }
}

/// Most numbers of an attribute.
const MOST_NUMBERS: usize = 64;

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn numbers_become_values_as_cf_says() {
        let of = |list: Value| NumberMeaning::of(&list, Dtype::Int16);
        let found = of(json!({"scale_factor": 2, "add_offset": -1024.5, "missing_value": 0, "units": "HU"}));
        let unit = Some("HU".to_owned());
        assert_eq!(found, NumberMeaning { map: (2.0, -1024.5), missing: vec![-1024.5], valid: None, unit });
        assert_eq!(of(json!({"_FillValue": 7})).missing, [7.0]);
        let several = of(
            json!({"scale_factor": -2, "missing_value": [1, "x", 3], "_FillValue": 9, "valid_range": [10, 20]}),
        );
        assert_eq!((&several.missing[..], several.valid), (&[-2.0, -6.0, -18.0][..], Some((-40.0, -20.0))));
        assert_eq!(of(json!({"valid_min": 0})).valid, Some((0.0, f64::MAX)));
        assert_eq!(of(json!({"valid_min": 3, "scale_factor": -1})).valid, Some((f64::MIN, -3.0)));
        // The control: what is no number changes nothing.
        let plain = NumberMeaning { map: (1.0, 0.0), missing: vec![], valid: None, unit: None };
        for nothing in [json!(null), json!({"scale_factor": 0, "missing_value": "NaN"}), json!([1])] {
            assert_eq!(of(nothing), plain);
        }
    }

    #[test]
    fn ends_of_what_is_valid_have_the_type_of_numbers_or_of_values() {
        let of = |list: Value, dtype| NumberMeaning::of(&list, dtype).valid;
        let packed = |key: &str, value: Value| json!({"scale_factor": 0.5, "add_offset": 270.0, "_FillValue": -1, key: value});
        assert_eq!(of(packed("valid_range", json!([270.0, 315.0])), Dtype::Int16), Some((270.0, 315.0)));
        assert_eq!(of(packed("valid_range", json!([0, 90])), Dtype::Int16), Some((270.0, 315.0)));
        assert_eq!(of(packed("valid_min", json!(271.5)), Dtype::Int16), Some((271.5, f64::MAX)));
        assert_eq!(of(packed("valid_max", json!(10)), Dtype::Int16), Some((f64::MIN, 275.0)));
        // The controls: without a slope, and of floats, both are the same.
        assert_eq!(of(json!({"valid_range": [3.0, 9.0]}), Dtype::Int16), Some((3.0, 9.0)));
        assert_eq!(of(packed("valid_range", json!([2.0, 4.0])), Dtype::Float), Some((271.0, 272.0)));
        // A marker in the type of values, which no number can be.
        let marker = json!({"scale_factor": 0.5, "missing_value": -999.5});
        assert_eq!(NumberMeaning::of(&marker, Dtype::Int16).missing, [-999.5]);
        let marker = json!({"scale_factor": 0.5, "missing_value": -999.0});
        assert_eq!(NumberMeaning::of(&marker, Dtype::Int16).missing, [-499.5], "control");
    }

    #[test]
    fn markers_have_the_sign_that_the_file_tells() {
        let told = json!({"_Unsigned": "true", "_FillValue": -1, "valid_range": [1, -56]});
        let dtype = signed_as_told(Dtype::Int8, &told);
        let found = NumberMeaning::of(&told, dtype);
        assert_eq!(
            (dtype, &found.missing[..], found.valid),
            (Dtype::Uint8, &[255.0][..], Some((1.0, 200.0)))
        );
        let told = json!({"_Unsigned": "false", "_FillValue": 65535});
        let dtype = signed_as_told(Dtype::Uint16, &told);
        assert_eq!((dtype, &NumberMeaning::of(&told, dtype).missing[..]), (Dtype::Int16, &[-1.0][..]));
        // The controls: nothing is told, and floats have no sign to change.
        assert_eq!(signed_as_told(Dtype::Int8, &json!({})), Dtype::Int8);
        assert_eq!(signed_as_told(Dtype::Float, &json!({"_Unsigned": "true"})), Dtype::Float);
        assert_eq!(NumberMeaning::of(&json!({"_FillValue": -1}), Dtype::Int8).missing, [-1.0]);
    }
}
