//! A state as a part of a link. Its TOML is deflated and written in base64url without padding (RFC 4648, section 5).
//! Shells, mail and address bars leave these characters alone.

use std::io::{Read, Write};
use std::path::Path;

use base64::prelude::{BASE64_URL_SAFE_NO_PAD, Engine};
use flate2::Compression;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;

use super::{MAX_STATE_BYTES, ReadState, SavedState, state_from_bytes};
use crate::error::FormatError;

/// The text after `state=` in a link.
pub fn state_to_link(state: &SavedState) -> String {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    let packed = encoder.write_all(state.to_toml().as_bytes()).and_then(|()| encoder.finish());
    BASE64_URL_SAFE_NO_PAD.encode(packed.expect("a vector takes all bytes"))
}

/// The state in the text after `state=` in a link.
///
/// # Errors
/// The text is not a state. The message is one line.
pub fn state_from_link(text: &str) -> Result<ReadState, FormatError> {
    let damaged = |problem: &str| FormatError::State { path: NAME.into(), problem: problem.into() };
    if text.len() > MAX_LINK_BYTES {
        return Err(damaged("found more than 64 KiB, expected a saved state"));
    }
    let packed = BASE64_URL_SAFE_NO_PAD.decode(text).map_err(|_| {
        damaged("it may have been cut or changed when it was copied (a shell needs quotes around it)")
    })?;
    let mut bytes = Vec::new();
    let unpacked = DeflateDecoder::new(&packed[..]).take(MAX_STATE_BYTES + 1).read_to_end(&mut bytes);
    unpacked.map_err(|_| damaged("it does not unpack; it may have been cut when it was copied"))?;
    state_from_bytes(&bytes, Path::new(NAME))
}

/// Longest text of a state in a link, in characters.
pub const MAX_LINK_BYTES: usize = 64 << 10;
const NAME: &str = "the link's state";
