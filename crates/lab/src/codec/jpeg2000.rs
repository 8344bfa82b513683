//! JPEG 2000 by OpenJPEG: the irreversible 9/7 wavelet at a stated signal-to-noise ratio, or the reversible 5/3 one
//! without loss. One tile, one quality layer, code blocks of 64×64, and for three channels the colour transform.
//!
//! OpenJPEG is a C library: this file alone of the crate may call such code. It is built with no threads and used by
//! one.

#![expect(unsafe_code, reason = "OpenJPEG is a C library without a safe binding that can encode")]

use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::ptr;

use openjpeg_sys as sys;

use super::raster::{Coded, ImageCodec, Raster, code_through_bytes};
use crate::error::LabError;

/// JPEG 2000.
pub(crate) struct Jpeg2000;

/// Peak signal-to-noise ratios of the planes, decibels.
const LEVELS_DB: [f32; 8] = [30.0, 34.0, 38.0, 42.0, 46.0, 50.0, 55.0, 62.0];

impl ImageCodec for Jpeg2000 {
    fn max_bits(&self) -> u8 {
        16
    }

    fn levels(&self) -> Vec<String> {
        LEVELS_DB.iter().map(|db| format!("{db:.0} dB")).collect()
    }

    fn code(&self, raster: &Raster, level: usize) -> Result<Coded, LabError> {
        code(raster, LEVELS_DB[level])
    }
}

/// Encodes at a peak signal-to-noise ratio, or without loss for [`LOSSLESS_DB`], and decodes.
fn code(raster: &Raster, psnr_db: f32) -> Result<Coded, LabError> {
    code_through_bytes(|| encode(raster, psnr_db), decode)
}

/// What OpenJPEG takes for the wish that nothing be lost.
const LOSSLESS_DB: f32 = 0.0;

fn encode(raster: &Raster, psnr_db: f32) -> Result<Vec<u8>, LabError> {
    let image = Image::new(raster)?;
    // SAFETY: the function fills every field of the structure, which is plain data.
    let mut parameters = unsafe {
        let mut parameters = MaybeUninit::<sys::opj_cparameters_t>::zeroed();
        sys::opj_set_default_encoder_parameters(parameters.as_mut_ptr());
        parameters.assume_init()
    };
    parameters.tcp_numlayers = 1;
    parameters.cp_fixed_quality = 1;
    parameters.tcp_distoratio[0] = psnr_db;
    parameters.irreversible = i32::from(psnr_db != LOSSLESS_DB);
    parameters.tcp_mct = i8::from(raster.channels == 3) as _;
    // A wavelet level halves the sides, which must not become nothing.
    let levels = raster.width.min(raster.height).max(1).ilog2();
    parameters.numresolution = parameters.numresolution.min(levels as i32 + 1);

    let codec = Codec::new(|| {
        // SAFETY: makes an object from a constant.
        unsafe { sys::opj_create_compress(sys::CODEC_FORMAT::OPJ_CODEC_J2K) }
    })?;
    let mut memory = Memory::default();
    let stream = MemoryStream::new(&mut memory, false)?;
    // SAFETY: codec, image and stream live until the end of this function; each was checked not to be null.
    let is_done = unsafe {
        sys::opj_setup_encoder(codec.0, &mut parameters, image.0) != 0
            && sys::opj_start_compress(codec.0, image.0, stream.0) != 0
            && sys::opj_encode(codec.0, stream.0) != 0
            && sys::opj_end_compress(codec.0, stream.0) != 0
    };
    drop(stream);
    if is_done { Ok(memory.bytes) } else { Err(failed("cannot encode")) }
}

pub(super) fn decode(bytes: &[u8]) -> Result<Raster, LabError> {
    let codec = Codec::new(|| {
        // SAFETY: makes an object from a constant.
        unsafe { sys::opj_create_decompress(sys::CODEC_FORMAT::OPJ_CODEC_J2K) }
    })?;
    // SAFETY: the function fills every field of the structure, which is plain data.
    let mut parameters = unsafe {
        let mut parameters = MaybeUninit::<sys::opj_dparameters_t>::zeroed();
        sys::opj_set_default_decoder_parameters(parameters.as_mut_ptr());
        parameters.assume_init()
    };
    let mut memory = Memory { bytes: bytes.to_vec(), at: 0 };
    let stream = MemoryStream::new(&mut memory, true)?;
    let mut image = Image(ptr::null_mut());
    // SAFETY: codec and stream live until the end of this function; the image is freed by its owner, whether it was made
    // or not.
    let is_done = unsafe {
        sys::opj_setup_decoder(codec.0, &mut parameters) != 0
            && sys::opj_read_header(stream.0, codec.0, &mut image.0) != 0
            && sys::opj_decode(codec.0, stream.0, image.0) != 0
            && sys::opj_end_decompress(codec.0, stream.0) != 0
    };
    let raster = if is_done { image.raster() } else { None };
    raster.ok_or_else(|| failed("cannot decode"))
}

/// An image of OpenJPEG, or none.
struct Image(*mut sys::opj_image_t);

impl Image {
    fn new(raster: &Raster) -> Result<Self, LabError> {
        let &Raster { width: w, height: h, channels, bits, .. } = raster;
        let prec = u32::from(bits);
        let component =
            sys::opj_image_cmptparm_t { dx: 1, dy: 1, w, h, x0: 0, y0: 0, prec, bpp: prec, sgnd: 0 };
        let mut components = [component; 3];
        let num = u32::from(channels);
        let space =
            if channels == 3 { sys::COLOR_SPACE::OPJ_CLRSPC_SRGB } else { sys::COLOR_SPACE::OPJ_CLRSPC_GRAY };
        // SAFETY: `num` is at most 3, the number of components given.
        let image = Self(unsafe { sys::opj_image_create(num, components.as_mut_ptr(), space) });
        if image.0.is_null() {
            return Err(failed("cannot make an image"));
        }
        // SAFETY: not null, and nobody else has it.
        let inner = unsafe { &mut *image.0 };
        (inner.x1, inner.y1) = (w, h);
        for channel in 0..usize::from(channels) {
            // SAFETY: OpenJPEG has made `num` components of w·h samples each.
            let data = unsafe {
                let component = &*inner.comps.add(channel);
                std::slice::from_raw_parts_mut(component.data, w as usize * h as usize)
            };
            let samples = raster.samples.iter().skip(channel).step_by(usize::from(channels));
            for (sample, value) in data.iter_mut().zip(samples) {
                *sample = i32::from(*value);
            }
        }
        Ok(image)
    }

    /// The samples; none if the image is none or its channels differ in size.
    fn raster(&self) -> Option<Raster> {
        if self.0.is_null() {
            return None;
        }
        // SAFETY: not null; made by OpenJPEG, which has filled `numcomps` components.
        let components = unsafe {
            let image = &*self.0;
            if image.comps.is_null() {
                return None;
            }
            std::slice::from_raw_parts(image.comps, image.numcomps as usize)
        };
        let first = components.first()?;
        let (width, height, num) = (first.w, first.h, components.len());
        let max = (1i32 << first.prec.min(16)) - 1;
        let mut samples = vec![0; width as usize * height as usize * num];
        for (channel, component) in components.iter().enumerate() {
            if (component.w, component.h) != (width, height) || component.data.is_null() {
                return None;
            }
            // SAFETY: a component has w·h samples.
            let data =
                unsafe { std::slice::from_raw_parts(component.data, width as usize * height as usize) };
            for (sample, value) in samples.iter_mut().skip(channel).step_by(num).zip(data) {
                *sample = (*value).clamp(0, max) as u16;
            }
        }
        let channels = u8::try_from(num).ok().filter(|n| [1, 3].contains(n))?;
        Some(Raster { width, height, channels, bits: first.prec as u8, samples })
    }
}

impl Drop for Image {
    fn drop(&mut self) {
        if !self.0.is_null() {
            // SAFETY: made by OpenJPEG, and nobody else has it.
            unsafe { sys::opj_image_destroy(self.0) };
        }
    }
}

/// An encoder or decoder.
struct Codec(*mut sys::opj_codec_t);

impl Codec {
    fn new(make: impl Fn() -> *mut sys::opj_codec_t) -> Result<Self, LabError> {
        let codec = make();
        if codec.is_null() { Err(failed("cannot start")) } else { Ok(Self(codec)) }
    }
}

impl Drop for Codec {
    fn drop(&mut self) {
        // SAFETY: not null, and nobody else has it.
        unsafe { sys::opj_destroy_codec(self.0) };
    }
}

/// Bytes that are read or written.
#[derive(Default)]
struct Memory {
    bytes: Vec<u8>,
    at: usize,
}

/// A stream from or to memory. It must be dropped before the memory is looked at again.
struct MemoryStream<'a>(*mut sys::opj_stream_t, std::marker::PhantomData<&'a mut Memory>);

impl<'a> MemoryStream<'a> {
    fn new(memory: &'a mut Memory, is_input: bool) -> Result<Self, LabError> {
        let length = memory.bytes.len() as u64;
        // SAFETY: the memory outlives the stream by the lifetime; the functions below are those of its type.
        unsafe {
            let stream = sys::opj_stream_create(BUFFER_BYTES, i32::from(is_input));
            if stream.is_null() {
                return Err(failed("cannot make a stream"));
            }
            sys::opj_stream_set_user_data(stream, ptr::from_mut(memory).cast(), None);
            sys::opj_stream_set_user_data_length(stream, length);
            sys::opj_stream_set_read_function(stream, Some(read));
            sys::opj_stream_set_write_function(stream, Some(write));
            sys::opj_stream_set_skip_function(stream, Some(skip));
            sys::opj_stream_set_seek_function(stream, Some(seek));
            Ok(Self(stream, std::marker::PhantomData))
        }
    }
}

impl Drop for MemoryStream<'_> {
    fn drop(&mut self) {
        // SAFETY: not null, and nobody else has it.
        unsafe { sys::opj_stream_destroy(self.0) };
    }
}

/// SAFETY: `memory` is the [`Memory`] of the stream, `buffer` has room for `num` bytes.
unsafe extern "C" fn read(buffer: *mut c_void, num: usize, memory: *mut c_void) -> usize {
    // SAFETY: as above.
    let memory = unsafe { &mut *memory.cast::<Memory>() };
    let left = &memory.bytes[memory.at.min(memory.bytes.len())..];
    let num = num.min(left.len());
    if num == 0 {
        return usize::MAX;
    }
    // SAFETY: both have at least `num` bytes, and are not the same memory.
    unsafe { ptr::copy_nonoverlapping(left.as_ptr(), buffer.cast(), num) };
    memory.at += num;
    num
}

/// SAFETY: `memory` is the [`Memory`] of the stream, `buffer` holds `num` bytes.
unsafe extern "C" fn write(buffer: *mut c_void, num: usize, memory: *mut c_void) -> usize {
    // SAFETY: as above.
    let (memory, from) =
        unsafe { (&mut *memory.cast::<Memory>(), std::slice::from_raw_parts(buffer.cast::<u8>(), num)) };
    let end = memory.at + num;
    if memory.bytes.len() < end {
        memory.bytes.resize(end, 0);
    }
    memory.bytes[memory.at..end].copy_from_slice(from);
    memory.at = end;
    num
}

/// SAFETY: `memory` is the [`Memory`] of the stream.
unsafe extern "C" fn skip(num: i64, memory: *mut c_void) -> i64 {
    // SAFETY: as above.
    let memory = unsafe { &mut *memory.cast::<Memory>() };
    match memory.at.checked_add_signed(num as isize) {
        Some(at) => {
            memory.at = at;
            num
        }
        None => -1,
    }
}

/// SAFETY: `memory` is the [`Memory`] of the stream.
unsafe extern "C" fn seek(to: i64, memory: *mut c_void) -> i32 {
    // SAFETY: as above.
    let memory = unsafe { &mut *memory.cast::<Memory>() };
    match usize::try_from(to) {
        Ok(to) => {
            memory.at = to;
            1
        }
        Err(_) => 0,
    }
}

fn failed(cause: &str) -> LabError {
    LabError::Rival { codec: "jpeg2000", cause: cause.to_owned() }
}

/// OpenJPEG's own choice for streams of memory.
const BUFFER_BYTES: usize = 1 << 20;

#[cfg(test)]
mod tests {
    use super::super::raster::tests::{raster, rms};
    use super::*;

    #[test]
    fn without_loss_it_gives_back_what_it_was_given() {
        for (size, channels, bits) in
            [((37, 22), 1, 8), ((37, 22), 3, 8), ((64, 64), 1, 16), ((5, 9), 1, 12), ((1, 1), 1, 8)]
        {
            let given = raster(size.0, size.1, channels, bits);
            assert_eq!(code(&given, LOSSLESS_DB).unwrap().decoded, given);
        }
        let given = raster(64, 64, 1, 8);
        assert_ne!(code(&given, 40.0).unwrap().decoded, given, "a loss shows");
    }

    #[test]
    fn finer_settings_are_nearer_and_larger() {
        for (channels, bits) in [(1, 16), (3, 8)] {
            let given = raster(96, 80, channels, bits);
            let coded: Vec<_> =
                (0..LEVELS_DB.len()).map(|level| Jpeg2000.code(&given, level).unwrap()).collect();
            for pair in coded.windows(2) {
                assert!(pair[0].bytes < pair[1].bytes);
                assert!(rms(&pair[0].decoded, &given) > rms(&pair[1].decoded, &given));
            }
            let psnr = -20.0 * rms(&coded[2].decoded, &given).log10();
            // What it promises of all channels together is within a decibel or two: it estimates in the wavelet's domain.
            assert!((psnr - f64::from(LEVELS_DB[2])).abs() < 3.0, "{psnr}");
        }
    }

    #[test]
    fn damaged_streams_are_refused() {
        let bytes = encode(&raster(64, 64, 1, 8), 40.0).unwrap();
        assert!(decode(&bytes).is_ok());
        assert!(decode(&bytes[..20]).is_err() && decode(&[]).is_err());
    }
}
