//! Parses values of arguments; errors say what was expected.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::error::ErrorKind;
use isinglass_core::camera::MAX_SIDE;
use isinglass_core::layer::MAX_K;

/// The path of a file to write, checked before any work is done: its folder must exist.
pub(crate) fn parse_output(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match path.file_name() {
        None => Err("expected the name of a file".into()),
        Some(_) if !folder.is_dir() => Err(format!("there is no folder {}", folder.display())),
        Some(_) if path.is_dir() => Err("found a folder, expected the name of a file".into()),
        Some(_) => Ok(path),
    }
}

/// Bad usage that only shows when several arguments are combined.
pub(crate) fn usage_error(text: impl std::fmt::Display) -> anyhow::Error {
    clap::Error::raw(ErrorKind::ValueValidation, text).into()
}

/// Rejects an output that is an input, or lies in an input folder. Names of inputs need not be files.
pub(crate) fn not_an_input<'a>(
    output: &Path,
    inputs: impl IntoIterator<Item = Option<&'a str>>,
) -> anyhow::Result<()> {
    // A file that does not exist yet is nobody's input.
    let Ok(output) = output.canonicalize() else { return Ok(()) };
    let is_output = |name: &&str| Path::new(name).canonicalize().is_ok_and(|input| output.starts_with(input));
    match inputs.into_iter().flatten().find(is_output) {
        Some(name) => Err(usage_error(format!("{name} would be read and written, expected two files"))),
        None => Ok(()),
    }
}

/// The same for pictures; the name of another format than PNG is rejected.
pub(crate) fn parse_picture(text: &str) -> Result<PathBuf, String> {
    let others = ["avif", "bmp", "exr", "gif", "jpeg", "jpg", "jxl", "tif", "tiff", "webp"];
    let path = parse_output(text)?;
    let says = |extension: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension));
    match others.into_iter().find(|other| says(other)) {
        Some(other) => Err(format!("pictures are PNG files, expected a name ending in .png, found .{other}")),
        None => Ok(path),
    }
}

/// `#rrggbb`.
pub(crate) fn parse_background(text: &str) -> Result<[u8; 3], String> {
    let hex = text.strip_prefix('#').unwrap_or(text);
    let number = (hex.len() == 6 && hex.bytes().all(|b| b.is_ascii_hexdigit()))
        .then(|| u32::from_str_radix(hex, 16).ok())
        .flatten();
    let [_, rgb @ ..] = number.ok_or("expected a colour like #20242c")?.to_be_bytes();
    Ok(rgb)
}

/// `200ms`, `0.2s`, `0`, or a number of milliseconds.
pub(crate) fn parse_duration(text: &str) -> Result<Duration, String> {
    let (number, seconds_per_unit) = match text.strip_suffix("ms") {
        Some(number) => (number, 1e-3),
        None => text.strip_suffix('s').map_or((text, 1e-3), |number| (number, 1.0)),
    };
    let seconds = number.trim().parse::<f64>().ok().map(|n| n * seconds_per_unit);
    match seconds.filter(|s| (0.0..=MAX_SECONDS).contains(s)) {
        Some(seconds) => Ok(Duration::from_secs_f64(seconds)),
        None => Err(format!("expected a time of at most {MAX_SECONDS} s, such as 200ms or 0.2s")),
    }
}

/// Megabits a second.
pub(crate) fn parse_mbit(text: &str) -> Result<f64, String> {
    let rate = text.parse::<f64>().ok().filter(|r| (0.1..=100_000.0).contains(r));
    rate.ok_or_else(|| "expected 0.1 to 100000 megabits a second".into())
}

/// `WxH`.
pub(crate) fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once(['x', 'X', '×']).and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    sides
        .filter(|sides| sides.iter().all(|side| (1..=MAX_SIDE).contains(side)))
        .ok_or_else(|| format!("expected WxH with sides of 1 to {MAX_SIDE}, such as 512x512"))
}

/// Degrees.
pub(crate) fn parse_fov(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| (1.0..=170.0).contains(d));
    degrees.ok_or_else(|| "expected 1 to 170 degrees".into())
}

/// A list length.
pub(crate) fn parse_k(text: &str) -> Result<u8, String> {
    let k = text.parse::<u8>().ok().filter(|&k| (1..=MAX_K).contains(&usize::from(k)));
    k.ok_or_else(|| format!("expected 1 to {MAX_K}"))
}

/// Longer times are typing errors.
const MAX_SECONDS: f64 = 60.0;

/// Pictures a second.
pub(crate) fn parse_rate(text: &str) -> Result<f32, String> {
    let rate = text.parse::<f32>().ok().filter(|r| (1.0..=240.0).contains(r));
    rate.ok_or_else(|| "expected 1 to 240 pictures a second".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_read_and_nonsense_is_refused() {
        assert_eq!(parse_size("640x480"), Ok([640, 480]));
        assert_eq!(parse_duration("200ms"), Ok(Duration::from_millis(200)));
        assert_eq!(parse_duration("0.2s"), parse_duration("200"));
        assert_eq!(parse_background("#0a0B0c"), Ok([10, 11, 12]));
        assert_eq!(parse_k("32"), Ok(32));
        for bad in ["", "0x5", "5x", "x", "-1x4", "9999x1", "4", "4x4x4"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
        for bad in ["", "-1ms", "nan", "1h", "inf", "61s"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
        for bad in ["", "#12345", "#1234567", "#gggggg", "red"] {
            assert!(parse_background(bad).is_err(), "{bad}");
        }
        assert!(parse_k("0").is_err() && parse_k("33").is_err() && parse_fov("180").is_err());
    }
}
