//! A state as a part of a link: its TOML, deflated, in the sixty-four characters that no shell, mail or address bar changes
//! (base64url, RFC 4648 section 5, without padding).

use std::io::{Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;

use super::{MAX_STATE_BYTES, ReadState, SavedState, state_from_bytes};
use crate::error::FormatError;

/// The characters behind `state=` of a link.
pub fn state_to_link(state: &SavedState) -> String {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    let packed = encoder.write_all(state.to_toml().as_bytes()).and_then(|()| encoder.finish());
    base64url(&packed.expect("a vector takes all bytes"))
}

/// The state behind `state=` of a link.
///
/// # Errors
/// One line, if the characters are none of a state.
pub fn state_from_link(text: &str) -> Result<ReadState, FormatError> {
    let damaged = |problem: &str| FormatError::State { path: NAME.into(), problem: problem.into() };
    if text.len() > MAX_LINK_BYTES {
        return Err(damaged("found more than 64 KiB, expected a saved state"));
    }
    let packed = from_base64url(text).ok_or_else(|| {
        damaged("it may have been cut or changed when it was copied (a shell needs quotes around it)")
    })?;
    let mut bytes = Vec::new();
    let unpacked = DeflateDecoder::new(&packed[..]).take(MAX_STATE_BYTES + 1).read_to_end(&mut bytes);
    unpacked.map_err(|_| damaged("it does not unpack; it may have been cut when it was copied"))?;
    state_from_bytes(&bytes, Path::new(NAME))
}

fn base64url(bytes: &[u8]) -> String {
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let word = (0..3).fold(0u32, |word, i| word << 8 | u32::from(group.get(i).copied().unwrap_or(0)));
        for i in 0..=group.len() {
            out.push(char::from(ALPHABET[(word >> (18 - 6 * i) & 63) as usize]));
        }
    }
    out
}

fn from_base64url(text: &str) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(text.len() / 4 * 3 + 2);
    for group in text.as_bytes().chunks(4) {
        let mut word = 0u32;
        for i in 0..4 {
            let digit = match group.get(i) {
                Some(character) => ALPHABET.iter().position(|a| a == character)?,
                None => 0,
            };
            word = word << 6 | digit as u32;
        }
        let len = group.len().checked_sub(1).filter(|len| *len > 0)?;
        out.extend_from_slice(&word.to_be_bytes()[1..1 + len]);
    }
    Some(out)
}

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
/// Longest state in a link, characters.
pub const MAX_LINK_BYTES: usize = 64 << 10;
/// What messages call it.
const NAME: &str = "the link's state";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn characters_are_those_of_the_standard() {
        // RFC 4648, section 10, without padding.
        for (bytes, text) in [("", ""), ("f", "Zg"), ("fo", "Zm8"), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64url(bytes.as_bytes()), text);
            assert_eq!(from_base64url(text).unwrap(), bytes.as_bytes());
        }
        assert_eq!(base64url(&[0xfb, 0xff]), "-_8");
        for bad in ["Z", "Zm9vY", "Zm+v", "Zg==", "é"] {
            assert_eq!(from_base64url(bad), None, "{bad}");
        }
    }
}
