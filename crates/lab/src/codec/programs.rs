//! Image codecs that are programs of their own and run only where they are installed: JPEG XL by `cjxl` and `djxl` of
//! libjxl, and AVIF by `avifenc` and `avifdec` of libavif with libaom's encoder. Both go through PNG files of 16 bits.
//!
//! Bytes are those of the coded picture without its container. Times are those of whole programs with one thread, from
//! start to end, files included: more than what coding takes, and not to be compared with those of other codecs.

use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use super::raster::{Coded, ImageCodec, Raster, png_from_raster, raster_from_png};
use crate::error::LabError;
use isinglass_core::wire::control::one_line;

/// A codec that is a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Program {
    /// JPEG XL at effort 3, by blocks of its discrete cosine transform.
    JpegXl,
    /// JPEG XL at effort 3, by its wavelet-like squeeze ("modular").
    JpegXlModular,
    /// AVIF at speed 9, by libaom.
    Avif,
}

/// Of 9.
const JXL_EFFORT: &str = "3";
/// Of 10.
const AVIF_SPEED: &str = "9";
/// Distances of JPEG XL, coarse to fine.
const DISTANCES: [f32; 8] = [12.0, 7.0, 4.0, 2.2, 1.2, 0.6, 0.25, 0.08];
/// Quantisers of AVIF, of 63, coarse to fine.
const QUANTIZERS: [u32; 8] = [60, 50, 40, 30, 21, 14, 8, 3];

impl Program {
    /// All of them, with their names in reports.
    pub(crate) const ALL: [(&str, Self); 3] = [
        ("jpegxl-planes", Self::JpegXl),
        ("jpegxl-modular-planes", Self::JpegXlModular),
        ("avif-aom-planes", Self::Avif),
    ];

    /// Whether it can be run here.
    pub(crate) fn is_installed(self) -> bool {
        self.commands().iter().all(|command| {
            let version = Command::new(command).arg("--version").stdin(Stdio::null()).output();
            version.is_ok_and(|output| output.status.success())
        })
    }

    /// Encoder and decoder.
    fn commands(self) -> [&'static str; 2] {
        match self {
            Self::JpegXl | Self::JpegXlModular => ["cjxl", "djxl"],
            Self::Avif => ["avifenc", "avifdec"],
        }
    }

    /// Encodes the picture `from` into `to`; milliseconds.
    fn encode(self, level: usize, channels: u8, from: &Path, to: &Path) -> Result<f64, LabError> {
        let [encoder, _] = self.commands();
        let mut args: Vec<String> = match self {
            Self::JpegXl | Self::JpegXlModular => {
                let modular = u8::from(self == Self::JpegXlModular);
                vec![format!("--distance={}", DISTANCES[level]), format!("--modular={modular}")]
            }
            Self::Avif => {
                let format = if channels == 1 { "400" } else { "444" };
                let q = QUANTIZERS[level].to_string();
                ["--min", &q, "--max", &q, "--yuv", format].map(str::to_owned).to_vec()
            }
        };
        let fixed: &[&str] = match self {
            Self::JpegXl | Self::JpegXlModular => {
                &["--effort", JXL_EFFORT, "--container=0", "--num_threads=0", "--quiet"]
            }
            Self::Avif => &["--codec", "aom", "--speed", AVIF_SPEED, "--depth", "12", "--jobs", "1"],
        };
        args.extend(fixed.iter().map(|&arg| arg.to_owned()));
        self.run(encoder, &args, [from, to])
    }

    /// Decodes `from` into the picture `to`; milliseconds.
    fn decode(self, from: &Path, to: &Path) -> Result<f64, LabError> {
        let [_, decoder] = self.commands();
        let args: &[&str] = match self {
            Self::JpegXl | Self::JpegXlModular => &["--num_threads=1", "--quiet"],
            Self::Avif => &["--jobs", "1", "--depth", "16"],
        };
        self.run(decoder, args, [from, to])
    }

    fn run<A: AsRef<OsStr>>(self, command: &str, args: &[A], files: [&Path; 2]) -> Result<f64, LabError> {
        let start = Instant::now();
        let output = Command::new(command).args(args).args(files).stdin(Stdio::null()).output();
        let ms = start.elapsed().as_secs_f64() * 1e3;
        let output = output.map_err(|e| self.failed(&format!("{command}: {e}")))?;
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr);
            return Err(self.failed(&format!("{command}: {}", one_line(message.trim()))));
        }
        Ok(ms)
    }

    /// Bytes of the picture in a file.
    fn picture_bytes(self, file: &[u8]) -> Result<usize, LabError> {
        match self {
            // Written without a container.
            Self::JpegXl | Self::JpegXlModular => Ok(file.len()),
            Self::Avif => media_bytes(file).ok_or_else(|| self.failed(&"not a file of boxes")),
        }
    }

    fn failed(self, cause: &dyn std::fmt::Display) -> LabError {
        let codec = if self == Self::Avif { "avif" } else { "jpegxl" };
        LabError::Rival { codec, cause: cause.to_string() }
    }
}

impl ImageCodec for Program {
    fn max_bits(&self) -> u8 {
        16
    }

    fn levels(&self) -> Vec<String> {
        match self {
            Self::JpegXl | Self::JpegXlModular => DISTANCES.iter().map(|d| format!("distance {d}")).collect(),
            Self::Avif => QUANTIZERS.iter().map(|q| format!("q{q}")).collect(),
        }
    }

    fn code(&self, raster: &Raster, level: usize) -> Result<Coded, LabError> {
        let failed = |e: std::io::Error| self.failed(&e);
        let folder = tempfile::tempdir().map_err(failed)?;
        let path = |name: &str| folder.path().join(name);
        let coded = path(if *self == Self::Avif { "coded.avif" } else { "coded.jxl" });
        let (given, found) = (path("given.png"), path("found.png"));
        fs::write(&given, png_from_raster(&scaled(raster, 16, raster.channels))?).map_err(failed)?;
        let encode_ms = self.encode(level, raster.channels, &given, &coded)?;
        let decode_ms = self.decode(&coded, &found)?;
        let bytes = self.picture_bytes(&fs::read(&coded).map_err(failed)?)?;
        let found = fs::read(&found).map_err(failed)?;
        // The byte that tells the bits of a sample.
        if found.get(PNG_BITS_AT) != Some(&16) {
            return Err(self.failed(&"not a picture of 16 bits came back"));
        }
        let decoded = raster_from_png(&found, 16)?;
        if (decoded.width, decoded.height) != (raster.width, raster.height) {
            return Err(self.failed(&"a picture of another size came back"));
        }
        let decoded = scaled(&decoded, raster.bits, raster.channels);
        Ok(Coded { bytes, decoded, encode_ms, decode_ms: Some(decode_ms) })
    }
}

/// Where a PNG file says how many bits a sample has.
const PNG_BITS_AT: usize = 24;

/// The raster with another number of bits a sample, and of its channels the first `channels`.
fn scaled(raster: &Raster, bits: u8, channels: u8) -> Raster {
    let (had, kept) = (usize::from(raster.channels), usize::from(channels));
    let num = raster.samples.len() / had;
    let units = (0..num).flat_map(|i| (0..kept).map(move |c| raster.unit(i * had + c.min(had - 1))));
    Raster::from_units([raster.width, raster.height], channels, bits, &units.collect::<Vec<_>>())
}

/// Bytes within the media boxes ("mdat") of an ISO base media file; none where it is no such file.
fn media_bytes(mut file: &[u8]) -> Option<usize> {
    let mut sum = 0;
    while !file.is_empty() {
        let size = u32::from_be_bytes(file.get(..4)?.try_into().ok()?) as usize;
        let kind = file.get(4..8)?;
        // A size of 0 is the rest of the file.
        let size = if size == 0 { file.len() } else { size };
        let body = file.get(8..size)?;
        if kind == b"mdat" {
            sum += body.len();
        }
        file = &file[size..];
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::raster::tests::{raster, rms};
    use super::*;

    #[test]
    fn finer_settings_are_nearer_and_larger() {
        for (name, program) in Program::ALL {
            if !program.is_installed() {
                println!("skipped: no {:?} for {name}", program.commands());
                continue;
            }
            for (channels, bits) in [(1, 16), (3, 10)] {
                let given = raster(96, 80, channels, bits);
                let coded: Vec<_> = [0, 4, 7].map(|level| program.code(&given, level).unwrap()).into();
                for pair in coded.windows(2) {
                    assert!(pair[0].bytes < pair[1].bytes, "{name}");
                    assert!(rms(&pair[0].decoded, &given) > rms(&pair[1].decoded, &given), "{name}");
                }
                let last = rms(&coded[2].decoded, &given);
                assert!(last < 0.01, "{name} of {channels} channels: {last}");
                // Eight bits on the way would leave no more.
                let values: BTreeSet<u16> = coded[2].decoded.samples.iter().copied().collect();
                assert!(values.len() > 300, "{name} of {channels} channels: {} values", values.len());
            }
        }
    }

    #[test]
    fn only_media_boxes_are_counted() {
        let file = |kind: &[u8; 4], size: u32| [&size.to_be_bytes(), &kind[..], &[0; 5]].concat();
        let [head, body] = [file(b"meta", 13), file(b"mdat", 13)];
        assert_eq!(media_bytes(&[&head[..], &body, &head, &body].concat()), Some(10));
        assert_eq!(media_bytes(&file(b"mdat", 0)), Some(5));
        assert_eq!(media_bytes(&file(b"mdat", 7)), None);
        assert_eq!(media_bytes(&file(b"mdat", 14)), None);
        assert_eq!(media_bytes(&body[..6]), None);
    }
}
