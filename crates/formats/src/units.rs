//! Units that files name.

/// A unit of length: its size in metres and its short name. Case does not matter.
pub(crate) fn length_unit(name: &str) -> Option<(f64, &'static str)> {
    Some(match name.to_lowercase().as_str() {
        "pm" | "picometer" => (1e-12, "pm"),
        "å" | "\\u00c5" | "angstrom" | "angstroms" => (1e-10, "Å"),
        "nm" | "nanometer" | "nanometers" | "nanometre" => (1e-9, "nm"),
        // Two characters look like µ. The others stand for one that an encoding has lost, or for Java's escape.
        "um" | "\u{b5}m" | "\u{3bc}m" | "\u{fffd}m" | "\\u00b5m" | "micron" | "microns" | "micrometer"
        | "micrometers" | "micrometre" => (1e-6, "µm"),
        "mm" | "millimeter" | "millimeters" | "millimetre" | "millimetres" => (1e-3, "mm"),
        "cm" | "centimeter" | "centimeters" | "centimetre" | "centimetres" => (1e-2, "cm"),
        "m" | "meter" | "meters" | "metre" | "metres" => (1.0, "m"),
        "km" | "kilometer" | "kilometers" | "kilometre" | "kilometres" => (1e3, "km"),
        "in" | "inch" | "inches" => (0.0254, "in"),
        _ => return None,
    })
}

/// A unit of time, as its length in seconds. Case does not matter.
pub(crate) fn time_unit(name: &str) -> Option<f64> {
    Some(match name.to_lowercase().as_str() {
        "ns" | "nsec" | "nanosecond" | "nanoseconds" => 1e-9,
        "us" | "\u{b5}s" | "\u{3bc}s" | "\u{fffd}s" | "\\u00b5s" | "usec" | "microsecond"
        | "microseconds" => 1e-6,
        "ms" | "msec" | "millisecond" | "milliseconds" => 1e-3,
        "s" | "sec" | "secs" | "second" | "seconds" => 1.0,
        "min" | "mins" | "minute" | "minutes" => 60.0,
        "h" | "hr" | "hour" | "hours" => 3600.0,
        "d" | "day" | "days" => 86_400.0,
        _ => return None,
    })
}

/// Seconds that make a step in time; files without one have zeros and worse.
pub(crate) fn time_step(seconds: f64) -> Option<f64> {
    (seconds.is_finite() && seconds > 0.0).then_some(seconds)
}

/// Whether values between these may be Hounsfield units: air is about −1000, and bone exceeds 300.
pub(crate) fn may_be_hounsfield(lo: f32, hi: f32) -> bool {
    (-4096.0..=-500.0).contains(&lo) && hi >= 300.0
}

/// A unit of values as a file writes it, cut to what fits beside a number; `None` if it says that there is none.
pub(crate) fn value_unit(name: &str) -> Option<String> {
    let name = name.trim();
    let is_none =
        ["", "none", "unknown", "relative", "gray value"].contains(&name.to_ascii_lowercase().as_str());
    // The unit of a number alone is a number: `1`, or `0.001` for parts in a thousand.
    let is_one = name.parse() == Ok(1.0);
    let times = if name.parse::<f64>().is_ok() { "×" } else { "" };
    (!is_none && !is_one).then(|| times.to_owned() + &isinglass_core::text::printable(name, MAX_UNIT_CHARS))
}

const MAX_UNIT_CHARS: usize = 24;

#[cfg(test)]
mod tests {
    use super::value_unit;

    #[test]
    fn a_unit_that_is_a_number_is_a_factor() {
        assert_eq!(value_unit("1"), None);
        assert_eq!(value_unit(" none "), None);
        assert_eq!(value_unit("1e-3").as_deref(), Some("×1e-3"));
        assert_eq!(value_unit("degC").as_deref(), Some("degC"), "the control");
    }
}
