//! Measures one codec on one frame: its useful settings with bytes, times and the remaining quality.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::time::Instant;

use isinglass_core::camera::Camera;
use isinglass_core::codec::{self, Coding};
use isinglass_core::image_error::compare;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::space::Aabb;
use isinglass_render::Backend;
use rayon::ThreadPool;
use serde::Serialize;

use super::clock::timed;
use super::contenders::{Contender, Way, ladder};
use super::layout::{Layout, Part};
use super::raster::{Coded, ImageCodec, Raster};
use super::raw::Compressor;
use super::search::{Height, climb};
use crate::error::LabError;
use crate::quality::black_srgb8;
use isinglass_core::orbit::Orbit;

/// The error of the picture after one turn of the camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Distortion {
    pub(crate) angle_deg: f32,
    /// Against the full volume rendering, see [`isinglass_core::image_error::ImageError`].
    pub(crate) dssim: f64,
    pub(crate) dssim_object: f64,
    pub(crate) psnr_db: f64,
    pub(crate) novel_view_ms: f64,
}

/// A frame coded with one setting.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Measured {
    pub(crate) settings: String,
    pub(crate) bytes: usize,
    /// Bytes of colour, opacity and depth, where they are coded apart.
    pub(crate) parts: Option<[usize; 3]>,
    pub(crate) encode_ms: f64,
    pub(crate) decode_ms: Option<f64>,
    pub(crate) distortion: Vec<Distortion>,
}

/// Turn in degrees, camera, and the full volume rendering as 8-bit sRGB on black.
pub(crate) type Truth = (f32, Camera, Vec<u8>);

/// The error of a frame from all turns with a known truth.
pub(crate) fn distortion_of(
    backend: &Backend,
    bounds: &Aabb,
    truths: &[Truth],
    frame: LayeredFrame,
) -> Result<Vec<Distortion>, LabError> {
    let mut caster = backend.reprojector(Arc::new(frame), bounds)?;
    let mut all = Vec::with_capacity(truths.len());
    for (angle_deg, camera, truth) in truths {
        let start = Instant::now();
        let view = caster.raycast_with(camera, &CastOptions::default())?;
        let novel_view_ms = start.elapsed().as_secs_f64() * 1e3;
        let view = black_srgb8(&view);
        let size = camera.intrinsics;
        let error = compare(&view, truth, size.width as usize, size.height as usize, [0; 3])?;
        all.push(Distortion {
            angle_deg: *angle_deg,
            dssim: error.dssim,
            dssim_object: error.dssim_object,
            psnr_db: error.psnr_db,
            novel_view_ms,
        });
    }
    Ok(all)
}

/// Judges frames by the pictures made of them.
pub(crate) struct Judge<'a> {
    pub(crate) backend: &'a Backend,
    pub(crate) bounds: Aabb,
    /// The generating camera's place.
    pub(crate) orbit: Orbit,
    pub(crate) truths: Vec<Truth>,
    /// The pool of one thread on which coding is timed.
    pub(crate) pool: &'a ThreadPool,
}

impl Judge<'_> {
    pub(crate) fn distortion(&self, frame: LayeredFrame) -> Result<Vec<Distortion>, LabError> {
        distortion_of(self.backend, &self.bounds, &self.truths, frame)
    }

    /// A codec on a frame of its rule.
    pub(crate) fn measure(
        &self,
        contender: &Contender,
        frame: &LayeredFrame,
    ) -> Result<Vec<Measured>, LabError> {
        match &contender.way {
            Way::Product(settings) => settings.iter().map(|(n, s)| self.product(n, s, frame)).collect(),
            Way::Raw(compressor) => Ok(vec![self.raw(*compressor, frame)?]),
            Way::Planes(layout, codec) => self.planes(*layout, &**codec, frame),
        }
    }

    /// Codes a frame with one setting, each part's for itself: bytes, and the frame as it is decoded.
    pub(crate) fn code(
        &self,
        contender: &Contender,
        frame: &LayeredFrame,
        at: [usize; 3],
    ) -> Result<(usize, LayeredFrame), LabError> {
        match &contender.way {
            Way::Product(settings) => {
                let (encoded, _) = settings[at[0]].1.encode(frame, None)?;
                let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
                Ok((encoded.num_bytes(), codec::decode(&chunks)?))
            }
            Way::Raw(compressor) => {
                let bytes = compressor.encode(frame)?;
                let decoded = compressor.decode(&bytes, frame.header, frame.num_segments())?;
                Ok((bytes.len(), decoded))
            }
            Way::Planes(layout, codec) => {
                let num_levels = codec.levels().len();
                let mut parts = Vec::with_capacity(at.len());
                for (part, rung) in Part::ALL.into_iter().zip(at) {
                    let (divisor, level) = ladder(*layout, part, num_levels, false)[rung];
                    let rasters = layout.split(frame, part, codec.max_bits(), divisor);
                    parts.push(code_part(&**codec, &rasters, level)?);
                }
                let decoded =
                    layout.join(frame.header, &parts[0].decoded, &parts[1].decoded, &parts[2].decoded);
                Ok((parts.iter().map(|p| p.bytes).sum(), decoded))
            }
        }
    }

    fn product(&self, name: &str, coding: &Coding, frame: &LayeredFrame) -> Result<Measured, LabError> {
        let (encoded, encode_ms) = self.pool.install(|| timed(|| Ok(coding.encode(frame, None)?.0)))?;
        let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
        let (decoded, decode_ms) = self.pool.install(|| timed(|| Ok(codec::decode(&chunks)?)))?;
        Ok(Measured {
            settings: name.to_owned(),
            bytes: encoded.num_bytes(),
            parts: None,
            encode_ms,
            decode_ms: Some(decode_ms),
            distortion: self.distortion(decoded)?,
        })
    }

    fn raw(&self, compressor: Compressor, frame: &LayeredFrame) -> Result<Measured, LabError> {
        let (bytes, encode_ms) = self.pool.install(|| timed(|| compressor.encode(frame)))?;
        let decode = || compressor.decode(&bytes, frame.header, frame.num_segments());
        let (decoded, decode_ms) = self.pool.install(|| timed(decode))?;
        Ok(Measured {
            settings: compressor.setting().to_owned(),
            bytes: bytes.len(),
            parts: None,
            encode_ms,
            decode_ms: Some(decode_ms),
            distortion: self.distortion(decoded)?,
        })
    }

    fn planes(
        &self,
        layout: Layout,
        codec: &(dyn ImageCodec + Send + Sync),
        frame: &LayeredFrame,
    ) -> Result<Vec<Measured>, LabError> {
        let levels = codec.levels();
        let mut coded: [HashMap<Rung, CodedPart>; 3] = Default::default();
        let mut places: HashMap<[Rung; 3], usize> = HashMap::new();
        let mut all: Vec<Measured> = Vec::new();
        // With planes of half the size and without, as a climb that begins with them may never find what is best
        // without; and for all turns together and for each, as depths matter at some only.
        for (has_half, aim) in
            [false, true].into_iter().flat_map(|h| aims(self.truths.len()).map(move |a| (h, a)))
        {
            let ladders = Part::ALL.map(|part| ladder(layout, part, levels.len(), has_half));
            climb(ladders.each_ref().map(|rungs| rungs.len() - 1), |at| {
                let rungs = [0, 1, 2].map(|i| ladders[i][at[i]]);
                if let Some(&place) = places.get(&rungs) {
                    return Ok(height(&all[place], aim));
                }
                for (i, part) in Part::ALL.into_iter().enumerate() {
                    if let Entry::Vacant(place) = coded[i].entry(rungs[i]) {
                        let (divisor, level) = rungs[i];
                        let rasters = layout.split(frame, part, codec.max_bits(), divisor);
                        place.insert(self.pool.install(|| code_part(codec, &rasters, level))?);
                    }
                }
                let [Some(color), Some(opacity), Some(depth)] = [0, 1, 2].map(|i| coded[i].get(&rungs[i]))
                else {
                    unreachable!("all three were coded above")
                };
                let three = [color, opacity, depth];
                let joined = layout.join(frame.header, &color.decoded, &opacity.decoded, &depth.decoded);
                let measured = Measured {
                    settings: settings_name(rungs, &levels),
                    bytes: three.iter().map(|p| p.bytes).sum(),
                    parts: Some(three.map(|p| p.bytes)),
                    encode_ms: three.iter().map(|p| p.encode_ms).sum(),
                    decode_ms: three.iter().map(|p| p.decode_ms).sum(),
                    distortion: self.distortion(joined)?,
                };
                let height = height(&measured, aim);
                places.insert(rungs, all.len());
                all.push(measured);
                Ok::<_, LabError>(height)
            })?;
        }
        Ok(all)
    }
}

/// Divisor of the planes' size, and the level of their codec.
type Rung = (u32, usize);

struct CodedPart {
    bytes: usize,
    decoded: Vec<Raster>,
    encode_ms: f64,
    decode_ms: Option<f64>,
}

fn code_part(
    codec: &(dyn ImageCodec + Send + Sync),
    rasters: &[Raster],
    level: usize,
) -> Result<CodedPart, LabError> {
    let coded: Vec<Coded> =
        rasters.iter().map(|raster| codec.code(raster, level)).collect::<Result<_, _>>()?;
    Ok(CodedPart {
        bytes: coded.iter().map(|c| c.bytes).sum(),
        encode_ms: coded.iter().map(|c| c.encode_ms).sum(),
        decode_ms: coded.iter().map(|c| c.decode_ms).sum(),
        decoded: coded.into_iter().map(|c| c.decoded).collect(),
    })
}

fn settings_name(rungs: [Rung; 3], levels: &[String]) -> String {
    let part = |name: &str, (divisor, level): Rung| {
        let smaller = if divisor > 1 { format!(" at 1/{divisor}") } else { String::new() };
        format!("{name} {}{smaller}", levels[level])
    };
    [part("C", rungs[0]), part("α", rungs[1]), part("D", rungs[2])].join(", ")
}

/// Aims of climbs: all turns together (`None`), and each alone if there are several.
fn aims(num_turns: usize) -> impl Iterator<Item = Option<usize>> {
    let each = if num_turns > 1 { num_turns } else { 0 };
    std::iter::once(None).chain((0..each).map(Some))
}

fn height(measured: &Measured, aim: Option<usize>) -> Height {
    let seen = measured.distortion.iter().enumerate().filter(|(turn, _)| aim.is_none_or(|aim| aim == *turn));
    Height { bytes: measured.bytes as f64, distortion: seen.map(|(_, d)| d.dssim).sum() }
}
