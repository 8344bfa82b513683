//! High-throughput JPEG 2000 (ISO/IEC 15444-15) by `openjph-core`, a port of OpenJPH to Rust: the irreversible 9/7 wavelet
//! in stated steps, code blocks of 64×64, one pass each.
//!
//! The port has no colour transform, so three channels go through the standard's irreversible one here. Samples are
//! widened to 16 bits before: steps are in parts of the range, and rounding then shows in none.

use std::panic::{AssertUnwindSafe, catch_unwind};

use openjph_core::codestream::Codestream;
use openjph_core::file::{MemInfile, MemOutfile};
use openjph_core::types::{Point, Size};

use super::raster::{Coded, ImageCodec, Raster, code_through_bytes};
use crate::error::LabError;
use isinglass_core::wire::control::one_line;

/// HTJ2K.
pub(crate) struct Htj2k;

/// Base steps, in parts of the range. With finer ones the port breaks blocks that have much to say: depths at 0.0007.
const STEPS: [f32; 8] = [0.15, 0.1, 0.05, 0.025, 0.0125, 0.006, 0.003, 0.0015];

impl ImageCodec for Htj2k {
    fn max_bits(&self) -> u8 {
        16
    }

    fn levels(&self) -> Vec<String> {
        STEPS.iter().map(|step| format!("step {step}")).collect()
    }

    fn code(&self, raster: &Raster, level: usize) -> Result<Coded, LabError> {
        code_through_bytes(|| encode(raster, STEPS[level]), |bytes| decode(bytes, raster.bits))
    }
}

fn encode(raster: &Raster, step: f32) -> Result<Vec<u8>, LabError> {
    let components = components(raster);
    guarded("encode", || {
        let mut stream = Codestream::new();
        let siz = stream.access_siz_mut();
        siz.set_image_extent(Point::new(raster.width, raster.height));
        siz.set_tile_size(Size::new(raster.width, raster.height));
        siz.set_num_components(raster.channels.into());
        for component in 0..raster.channels.into() {
            siz.set_comp_info(component, Point::new(1, 1), DEPTH, false);
        }
        let cod = stream.access_cod_mut();
        cod.set_reversible(false);
        cod.set_color_transform(false);
        // A wavelet level halves the sides, which must not become nothing.
        cod.set_num_decomposition(raster.width.min(raster.height).max(1).ilog2().min(MOST_WAVELETS));
        cod.set_block_dims(BLOCK_SIDE, BLOCK_SIDE);
        stream.access_qcd_mut().set_delta(step);
        let mut file = MemOutfile::new();
        stream.write_headers(&mut file, &[]).map_err(|e| e.to_string())?;
        let width = raster.width as usize;
        for y in 0..raster.height as usize {
            for (number, samples) in (0..).zip(&components) {
                stream.exchange(&samples[y * width..][..width], number).map_err(|e| e.to_string())?;
            }
        }
        stream.flush(&mut file).map_err(|e| e.to_string())?;
        Ok(file.get_data().to_vec())
    })
}

fn decode(bytes: &[u8], bits: u8) -> Result<Raster, LabError> {
    guarded("decode", || {
        let mut stream = Codestream::new();
        let mut file = MemInfile::new(bytes);
        stream.read_headers(&mut file).map_err(|e| e.to_string())?;
        let extent = stream.access_siz().get_image_extent();
        let num = stream.access_siz().get_num_components();
        stream.create(&mut file).map_err(|e| e.to_string())?;
        let mut components = vec![Vec::new(); num.into()];
        for _ in 0..extent.y {
            for (number, samples) in (0..).zip(&mut components) {
                samples.extend_from_slice(&stream.pull(number).ok_or("a line is missing")?);
            }
        }
        Ok(raster(&components, [extent.x, extent.y], bits))
    })
}

/// The port answers some damage with a panic.
fn guarded<T>(what: &str, run: impl FnOnce() -> Result<T, String>) -> Result<T, LabError> {
    let found = catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|_| Err("panicked".into()));
    found.map_err(|cause| LabError::Rival {
        codec: "htj2k",
        cause: one_line(&format!("cannot {what}: {cause}")),
    })
}

/// The components that are coded, 16 bits each: the one channel, or luma and two differences.
fn components(raster: &Raster) -> Vec<Vec<i32>> {
    let channels = usize::from(raster.channels);
    let mut components = vec![Vec::with_capacity(raster.samples.len() / channels); channels];
    let fixed = |unit: f32| (unit.clamp(0.0, 1.0) * MAX + 0.5) as i32;
    for pixel in 0..raster.samples.len() / channels {
        let unit = |channel: usize| raster.unit(pixel * channels + channel);
        let values = match channels {
            3 => ycc_from_rgb([unit(0), unit(1), unit(2)]),
            _ => [unit(0), 0.0, 0.0],
        };
        for (component, value) in components.iter_mut().zip(values) {
            component.push(fixed(value));
        }
    }
    components
}

/// Inverse of [`components`].
fn raster(components: &[Vec<i32>], size: [u32; 2], bits: u8) -> Raster {
    let unit = |component: usize, pixel: usize| components[component][pixel] as f32 / MAX;
    let mut values = Vec::new();
    for pixel in 0..components.first().map_or(0, Vec::len) {
        match components.len() {
            3 => values.extend(rgb_from_ycc([unit(0, pixel), unit(1, pixel), unit(2, pixel)])),
            _ => values.push(unit(0, pixel)),
        }
    }
    Raster::from_units(size, components.len() as u8, bits, &values)
}

/// The irreversible colour transform of the standard (ISO/IEC 15444-1, annex G), differences from 0 to 1.
fn ycc_from_rgb([r, g, b]: [f32; 3]) -> [f32; 3] {
    let y = RED * r + (1.0 - RED - BLUE) * g + BLUE * b;
    [y, 0.5 + 0.5 * (b - y) / (1.0 - BLUE), 0.5 + 0.5 * (r - y) / (1.0 - RED)]
}

fn rgb_from_ycc([y, cb, cr]: [f32; 3]) -> [f32; 3] {
    let b = y + 2.0 * (1.0 - BLUE) * (cb - 0.5);
    let r = y + 2.0 * (1.0 - RED) * (cr - 0.5);
    [r, (y - RED * r - BLUE * b) / (1.0 - RED - BLUE), b]
}

/// Luma of red and of blue.
const RED: f32 = 0.299;
const BLUE: f32 = 0.114;
/// Bits of a component and its greatest value.
const DEPTH: u32 = 16;
const MAX: f32 = 65535.0;
const MOST_WAVELETS: u32 = 5;
const BLOCK_SIDE: u32 = 64;

#[cfg(test)]
mod tests {
    use super::super::jpeg2000;
    use super::super::raster::tests::{raster, rms};
    use super::*;

    #[test]
    fn finer_settings_are_nearer_and_larger() {
        for (size, channels, bits) in
            [((96, 80), 1, 16), ((96, 80), 3, 8), ((256, 256), 3, 10), ((37, 22), 1, 12)]
        {
            let given = raster(size.0, size.1, channels, bits);
            let coded: Vec<_> = (0..STEPS.len()).map(|level| Htj2k.code(&given, level).unwrap()).collect();
            for pair in coded.windows(2) {
                assert!(pair[0].bytes < pair[1].bytes, "{size:?}");
                assert!(rms(&pair[0].decoded, &given) > rms(&pair[1].decoded, &given), "{size:?}");
            }
            assert_eq!((coded[0].decoded.width, coded[0].decoded.height), size);
            assert_eq!((coded[0].decoded.channels, coded[0].decoded.bits), (channels, bits));
        }
    }

    #[test]
    fn another_decoder_reads_the_same() {
        let given = raster(96, 80, 1, 16);
        for step in [0.05, 0.003] {
            let bytes = encode(&given, step).unwrap();
            let (ours, theirs) = (decode(&bytes, 16).unwrap(), jpeg2000::decode(&bytes).unwrap());
            // Two decoders place a value differently within its step.
            let apart = rms(&ours, &theirs);
            assert!(apart < 0.5 * f64::from(step) && apart < 1.2 * rms(&ours, &given), "{step} {apart}");
        }
    }

    #[test]
    fn colours_come_back_from_their_transform() {
        for rgb in [[0.0, 0.0, 0.0], [1.0, 0.2, 0.7], [0.1, 0.9, 0.3]] {
            let ycc = ycc_from_rgb(rgb);
            assert!(ycc.iter().all(|v| (0.0..=1.0).contains(v)));
            for (found, wanted) in rgb_from_ycc(ycc).into_iter().zip(rgb) {
                assert!((found - wanted).abs() < 1e-6);
            }
        }
        assert!((ycc_from_rgb([0.4; 3])[1] - 0.5).abs() < 1e-6 && ycc_from_rgb([0.4, 0.4, 0.5])[1] > 0.51);
    }

    #[test]
    fn damaged_streams_are_refused() {
        let bytes = encode(&raster(64, 64, 1, 8), 0.01).unwrap();
        assert!(decode(&bytes, 8).is_ok());
        assert!(decode(&bytes[..20], 8).is_err() && decode(&[], 8).is_err());
    }
}
