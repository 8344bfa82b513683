//! AV1 by rav1e: still pictures, which is what an AVIF file holds, and sequences. Colours as luma and two full-size
//! chroma planes (BT.601, full range, 4:4:4), one channel as luma alone.
//!
//! Bytes are those of the coded frame without a container. What a decoder gets is the encoder's own reconstruction,
//! which AV1 defines to be the same, so there is no time to decode.

use rav1e::prelude::{
    ChromaSampling, Config, Context, EncoderConfig, EncoderStatus, Frame, Packet, PixelRange,
};

use super::clock::timed;
use super::raster::{Coded, ImageCodec, Raster};
use crate::error::LabError;

/// AV1 stills at a preset of the encoder: 0 is the slowest, 10 the fastest.
pub(crate) struct Av1 {
    /// The preset.
    pub(crate) speed: u8,
}

/// Quantisers of the encoder, coarse to fine.
pub(super) const QUANTIZERS: [usize; 7] = [200, 160, 120, 85, 55, 30, 10];

impl ImageCodec for Av1 {
    fn max_bits(&self) -> u8 {
        12
    }

    fn levels(&self) -> Vec<String> {
        QUANTIZERS.iter().map(|q| format!("q{q}")).collect()
    }

    fn code(&self, raster: &Raster, level: usize) -> Result<Coded, LabError> {
        let encode = || {
            let mut stream = Av1Stream::new(raster, self.speed, QUANTIZERS[level], Kind::Still)?;
            let mut packets = stream.push(raster)?;
            packets.extend(stream.finish()?);
            Ok(packets)
        };
        let (packets, encode_ms) = timed(encode)?;
        let bytes = packets.iter().map(|p| p.bytes).sum();
        let decoded = packets.into_iter().next_back().and_then(|p| p.decoded);
        let decoded = decoded.ok_or_else(|| failed(&"no picture came back"))?;
        Ok(Coded { bytes, decoded, encode_ms, decode_ms: None })
    }
}

/// What an encoder is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// One picture.
    Still,
    /// Pictures that may each refer to those before it; none waits for another.
    Sequence,
}

/// A coded picture of a stream.
#[derive(Clone, Debug)]
pub(crate) struct Picture {
    /// Its place in the sequence.
    pub(crate) index: u64,
    /// Bytes of it.
    pub(crate) bytes: usize,
    /// As it is decoded.
    pub(crate) decoded: Option<Raster>,
}

/// An encoder of pictures of one size.
pub(crate) struct Av1Stream {
    context: Context<u16>,
    /// Shape of the pictures, without samples.
    shape: Raster,
}

impl Av1Stream {
    /// Pictures are to be shaped like `like`.
    pub(crate) fn new(like: &Raster, speed: u8, quantizer: usize, kind: Kind) -> Result<Self, LabError> {
        let mut config = EncoderConfig::with_speed_preset(speed);
        (config.width, config.height) = (like.width as usize, like.height as usize);
        config.bit_depth = coded_bits(like.bits);
        config.chroma_sampling =
            if like.channels == 3 { ChromaSampling::Cs444 } else { ChromaSampling::Cs400 };
        config.pixel_range = PixelRange::Full;
        config.quantizer = quantizer;
        config.low_latency = true;
        match kind {
            Kind::Still => config.still_picture = true,
            Kind::Sequence => {
                config.set_key_frame_interval(0, 0);
                config.speed_settings.rdo_lookahead_frames = 1;
            }
        }
        // Without threads of its own it uses those of the caller, as all codecs here do.
        let config = Config::new().with_encoder_config(config);
        let context = config.new_context().map_err(|e| failed(&e))?;
        Ok(Self { context, shape: Raster { samples: Vec::new(), ..like.clone() } })
    }

    /// Gives it the next picture, and takes what is ready.
    pub(crate) fn push(&mut self, raster: &Raster) -> Result<Vec<Picture>, LabError> {
        let mut frame = self.context.new_frame();
        fill(&mut frame, raster);
        self.context.send_frame(frame).map_err(|e| failed(&e))?;
        self.packets()
    }

    /// Takes the rest.
    pub(crate) fn finish(&mut self) -> Result<Vec<Picture>, LabError> {
        self.context.flush();
        self.packets()
    }

    fn packets(&mut self) -> Result<Vec<Picture>, LabError> {
        let mut pictures = Vec::new();
        loop {
            match self.context.receive_packet() {
                Ok(packet) => pictures.push(self.picture(&packet)),
                Err(EncoderStatus::Encoded) => {}
                Err(EncoderStatus::NeedMoreData | EncoderStatus::LimitReached) => return Ok(pictures),
                Err(e) => return Err(failed(&e)),
            }
        }
    }

    fn picture(&self, packet: &Packet<u16>) -> Picture {
        let decoded = packet.rec.as_ref().map(|frame| raster_from_frame(frame, &self.shape));
        Picture { index: packet.input_frameno, bytes: packet.data.len(), decoded }
    }
}

/// AV1 has 8, 10 and 12 bits.
fn coded_bits(bits: u8) -> usize {
    usize::from(bits.clamp(8, 12)).next_multiple_of(2)
}

fn fill(frame: &mut Frame<u16>, raster: &Raster) {
    let max = ((1u32 << coded_bits(raster.bits)) - 1) as f32;
    let (width, height) = (raster.width as usize, raster.height as usize);
    let channels = usize::from(raster.channels);
    for (plane, out) in frame.planes.iter_mut().take(channels).enumerate() {
        let stride = out.cfg.stride;
        let rows = out.data_origin_mut().chunks_mut(stride).take(height).enumerate();
        for (y, row) in rows {
            for (x, sample) in row[..width].iter_mut().enumerate() {
                let i = y * width + x;
                let value = if channels == 3 {
                    let rgb = [0, 1, 2].map(|c| raster.unit(3 * i + c));
                    ycc_from_rgb(rgb)[plane]
                } else {
                    raster.unit(i)
                };
                *sample = (value.clamp(0.0, 1.0) * max + 0.5) as u16;
            }
        }
        out.pad(width, height);
    }
}

fn raster_from_frame(frame: &Frame<u16>, shape: &Raster) -> Raster {
    let max = ((1u32 << coded_bits(shape.bits)) - 1) as f32;
    let channels = usize::from(shape.channels);
    let (width, height) = (shape.width as usize, shape.height as usize);
    let unit = |plane: usize, x: usize, y: usize| {
        let plane = &frame.planes[plane];
        f32::from(plane.data_origin()[y * plane.cfg.stride + x]) / max
    };
    let mut values = Vec::with_capacity(width * height * channels);
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        if channels == 3 {
            values.extend(rgb_from_ycc([0, 1, 2].map(|c| unit(c, x, y))));
        } else {
            values.push(unit(0, x, y));
        }
    }
    Raster::from_units([shape.width, shape.height], shape.channels, shape.bits, &values)
}

/// BT.601 with chroma around one half, all of 0 to 1.
fn ycc_from_rgb([r, g, b]: [f32; 3]) -> [f32; 3] {
    let y = 0.299 * r + 0.587 * g + 0.114 * b;
    [y, (b - y) / 1.772 + 0.5, (r - y) / 1.402 + 0.5]
}

fn rgb_from_ycc([y, cb, cr]: [f32; 3]) -> [f32; 3] {
    let (b, r) = (y + 1.772 * (cb - 0.5), y + 1.402 * (cr - 0.5));
    [r, (y - 0.299 * r - 0.114 * b) / 0.587, b]
}

fn failed(cause: &dyn std::fmt::Display) -> LabError {
    LabError::Rival { codec: "av1", cause: cause.to_string() }
}

#[cfg(test)]
mod tests {
    use super::super::raster::tests::{raster, rms};
    use super::*;

    #[test]
    fn finer_settings_are_nearer_and_larger() {
        for (channels, bits) in [(1, 12), (3, 10)] {
            let given = raster(96, 80, channels, bits);
            let codec = Av1 { speed: 10 };
            let coded: Vec<_> = [0, 3, 6].iter().map(|&level| codec.code(&given, level).unwrap()).collect();
            for pair in coded.windows(2) {
                assert!(pair[0].bytes < pair[1].bytes);
                assert!(rms(&pair[0].decoded, &given) > rms(&pair[1].decoded, &given));
            }
            // Quantiser 10 of 255 is near a step of 8 bits.
            assert!(rms(&coded[2].decoded, &given) < 0.01, "{}", rms(&coded[2].decoded, &given));
        }
    }

    #[test]
    fn a_picture_that_stays_costs_next_to_nothing_in_a_sequence() {
        let given = raster(96, 80, 3, 10);
        let mut stream = Av1Stream::new(&given, 10, 85, Kind::Sequence).unwrap();
        let mut pictures: Vec<Picture> = (0..4).flat_map(|_| stream.push(&given).unwrap()).collect();
        pictures.extend(stream.finish().unwrap());
        assert_eq!(pictures.iter().map(|p| p.index).collect::<Vec<_>>(), [0, 1, 2, 3]);
        assert!(pictures[3].bytes * 5 < pictures[0].bytes, "{pictures:?}");
        assert!(pictures.iter().all(|p| p.decoded.is_some()));
        let mut other = Av1Stream::new(&given, 10, 85, Kind::Sequence).unwrap();
        let changed = raster(80, 96, 3, 10);
        let turned = Raster { width: 96, height: 80, ..changed };
        let mut pictures = other.push(&given).unwrap();
        pictures.extend(other.push(&turned).unwrap());
        pictures.extend(other.finish().unwrap());
        assert!(pictures[1].bytes * 5 > pictures[0].bytes, "another picture is not free");
    }

    #[test]
    fn colours_go_there_and_back() {
        for rgb in [[0.0, 0.5, 1.0], [1.0; 3], [0.2, 0.9, 0.1]] {
            let back = rgb_from_ycc(ycc_from_rgb(rgb));
            // Constants of three digits: their rounding.
            assert!(rgb.iter().zip(back).all(|(a, b)| (a - b).abs() < 1e-5), "{rgb:?} {back:?}");
        }
        assert!((ycc_from_rgb([1.0, 0.0, 0.0])[2] - 1.0).abs() < 1e-3);
    }
}
