//! Numbers and messages as people read them.

use std::time::Duration;

use isinglass_core::mode::Mode;

/// An error message as a sentence.
pub(crate) fn sentence(problem: &impl std::fmt::Display) -> String {
    let mut text = problem.to_string();
    if let Some(first) = text.get_mut(..1) {
        first.make_ascii_uppercase();
    }
    if !text.ends_with(['.', '?', '!']) {
        text.push('.');
    }
    text
}

/// A duration with two or three figures: `0.8 ms`, `42 ms`, `1.3 s`.
pub fn format_duration(d: Duration) -> String {
    let ms = d.as_secs_f64() * 1e3;
    match ms {
        ms if ms < 9.95 => format!("{ms:.1} ms"),
        ms if ms < 999.5 => format!("{ms:.0} ms"),
        ms if ms < 99_950.0 => format!("{:.1} s", ms / 1e3),
        ms => format!("{:.0} min", ms / 6e4),
    }
}

/// Bytes per second with two or three figures, in decimal units.
pub fn format_rate(bytes_per_second: f64) -> String {
    match bytes_per_second {
        b if b < 1e3 => format!("{b:.0} B/s"),
        b if b < 999.5e3 => format!("{:.0} kB/s", b / 1e3),
        b if b < 9.95e6 => format!("{:.1} MB/s", b / 1e6),
        b => format!("{:.0} MB/s", b / 1e6),
    }
}

/// Bytes with two or three figures, in decimal units.
pub fn format_bytes(bytes: u64) -> String {
    match bytes as f64 {
        b if b < 999.5 => format!("{bytes} bytes"),
        b if b < 999.5e3 => format!("{:.0} kB", b / 1e3),
        b if b < 9.95e6 => format!("{:.1} MB", b / 1e6),
        b if b < 999.5e6 => format!("{:.0} MB", b / 1e6),
        b if b < 99.5e9 => format!("{:.1} GB", b / 1e9),
        b => format!("{:.0} GB", b / 1e9),
    }
}

/// A value with about four figures.
pub(crate) fn format_value(value: f32) -> String {
    format_in(value, 0.0)
}

/// The same with enough figures to distinguish values in a range that is `span` wide.
pub(crate) fn format_in(value: f32, span: f32) -> String {
    let size = value.abs();
    if size == 0.0 {
        return "0".into();
    }
    let power = size.log10().floor() as i32;
    let wanted = if span > 0.0 { 3 - span.log10().floor() as i32 } else { -power };
    // Single precision has no more figures.
    let wanted = wanted.clamp(-power, 7 - power);
    let decimals = match size {
        // A large number that is exact to the unit is written out.
        a if (1e6..1e9).contains(&a) && span > 0.0 && wanted >= 0 => 0,
        a if !(1e-3..1e6).contains(&a) => {
            let figures = (wanted + power).max(2) as usize;
            return format!("{value:.figures$e}");
        }
        a if a >= 1000.0 => 0,
        a if a >= 100.0 => 1,
        a if a >= 1.0 => 2,
        _ => 4,
    };
    let decimals = wanted.max(decimals) as usize;
    let text = format!("{value:.decimals$}");
    match text.split_once('.') {
        Some((whole, part)) => {
            let part = part.trim_end_matches('0');
            if part.is_empty() { whole.to_owned() } else { format!("{whole}.{part}") }
        }
        None => text,
    }
}

/// The mode in the person's words.
pub(crate) fn mode_name(mode: Mode) -> &'static str {
    match mode {
        Mode::Composite => "composite",
        Mode::Mip => "MIP: greatest value",
        Mode::MinIp => "MinIP: least value",
        Mode::Average => "average (X-ray)",
        Mode::Iso => "isosurface",
    }
}

/// A preset's name as people write it. A preset of a file keeps its own.
pub(crate) fn preset_title(name: &str) -> &str {
    match name {
        "angio" => "Angiography",
        "cloud" => "Cloud",
        "ct" => "CT",
        "ct-body" => "CT body",
        "ct-bone" => "CT bone",
        "ct-lung" => "CT lung",
        "ct-vessels" => "CT vessels",
        "ct-windowed" => "CT windowed",
        "cubus" => "Cubes",
        "dark" => "Dark in bright",
        "fluorescence" => "Fluorescence",
        "industrial" => "Industrial",
        "mri" => "MR",
        "mri-skin" => "MR skin",
        "shells" => "Shells",
        "signed" => "Signed map",
        "smooth" => "Smooth",
        other => other,
    }
}

/// A name as the beginning of a file's name.
pub(crate) fn file_stem(name: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    name.chars().map(|c| if is_plain(c) { c } else { '_' }).take(80).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_has_a_title() {
        for name in isinglass_formats::preset_names() {
            assert_ne!(preset_title(name), name);
        }
        assert_eq!(preset_title("seen.toml"), "seen.toml");
    }

    #[test]
    fn a_sentence_begins_and_ends_as_one() {
        assert_eq!(sentence(&"connection lost: closed"), "Connection lost: closed.");
        assert_eq!(sentence(&"ärger?"), "ärger?");
        assert_eq!(sentence(&""), ".");
    }

    #[test]
    fn durations_and_rates_keep_two_or_three_figures() {
        let ms = |x: f64| format_duration(Duration::from_secs_f64(x / 1e3));
        assert_eq!([ms(0.04), ms(9.94), ms(9.96), ms(999.0)], ["0.0 ms", "9.9 ms", "10 ms", "999 ms"]);
        assert_eq!([ms(999.6), ms(61_000.0), ms(600_000.0)], ["1.0 s", "61.0 s", "10 min"]);
        assert_eq!(
            [0.0, 999.0, 4_300.0, 1.04e6, 12.3e6].map(format_rate),
            ["0 B/s", "999 B/s", "4 kB/s", "1.0 MB/s", "12 MB/s"]
        );
        assert_eq!(
            [999, 4_300, 1_040_000, 12_300_000_000, 250_000_000_000].map(format_bytes),
            ["999 bytes", "4 kB", "1.0 MB", "12.3 GB", "250 GB"]
        );
    }

    #[test]
    fn values_are_short() {
        let text = [0.0, 113.25, -1000.0, 1234567.0, 0.25, 0.00001, 12.0, 2.3456].map(format_value);
        assert_eq!(text, ["0", "113.2", "-1000", "1.23e6", "0.25", "1.00e-5", "12", "2.35"]);
    }

    #[test]
    fn values_of_a_narrow_range_are_told_apart() {
        for (lo, hi) in [(1.2e6, 1.2006e6), (3e-4, 3.001e-4), (50_000.0, 50_000.5), (-2e9, -1.999e9)] {
            let texts: Vec<_> =
                (0..=8).map(|i| format_in(lo + (hi - lo) * i as f32 / 8.0, hi - lo)).collect();
            let mut unlike = texts.clone();
            unlike.dedup();
            assert_eq!(texts, unlike);
        }
        assert_eq!(format_in(1_200_300.0, 600.0), "1200300");
        assert_eq!(format_in(2.345_67e-4, 1e-5), "2.3457e-4");
        for value in [0.0, 113.25, -1000.0, 0.25, 12.0, 2.3456] {
            assert_eq!(format_in(value, 4000.0), format_value(value), "no more than is needed");
        }
        for (value, span) in [
            (1.0, f32::NAN),
            (f32::INFINITY, 1.0),
            (1.0, f32::INFINITY),
            (1e-6, f32::INFINITY),
            (1e-40, 1e-42),
        ] {
            assert!(!format_in(value, span).is_empty());
        }
    }
}
