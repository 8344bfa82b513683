//! Pictures to keep: the way in of the one that is wanted.

use isinglass_core::ids::ShotId;
use isinglass_core::wire::shot::{MAX_SHOT_BYTES, SHOT_HEADER_BYTES, shot_id};
use quinn::RecvStream;

use super::Shared;
use super::chunks::Budget;
use crate::transport::STOP_UNUSABLE;

/// What has become of a picture that was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReceivedShot {
    /// The request.
    pub id: ShotId,
    /// A PNG file of the size that was asked for, or one line of why there is none.
    pub png: Result<Vec<u8>, String>,
}

/// Reads the rest of a stream that began with `bytes`, a picture by its first. One that is not waited for is not read.
pub(super) async fn read(
    shared: &Shared,
    mut stream: RecvStream,
    mut bytes: Vec<u8>,
    mut budget: Budget,
) -> Result<(), String> {
    let Some(id) = shot_id(&bytes) else { return Ok(()) };
    let is_wanted = || shared.shot.borrow().as_ref().is_some_and(|w| w.id == id);
    while let Ok(next) = stream.read_chunk(usize::MAX, true).await {
        let Some(part) = next else {
            bytes.drain(..SHOT_HEADER_BYTES);
            finish(shared, id, bytes);
            return Ok(());
        };
        let is_bounded = bytes.len() + part.bytes.len() <= MAX_SHOT_BYTES && budget.take(part.bytes.len());
        if !is_bounded || !is_wanted() {
            let _ = stream.stop(STOP_UNUSABLE);
            if is_bounded {
                return Ok(());
            }
            let why = format!("a picture of more than {} bytes is not read", bytes.len());
            settle(shared, id, Err(why.clone()));
            return Err(why);
        }
        bytes.extend_from_slice(&part.bytes);
    }
    Ok(())
}

fn finish(shared: &Shared, id: ShotId, png: Vec<u8>) {
    let wanted = shared.shot.borrow().clone().filter(|w| w.id == id);
    let Some(Ok(view)) = wanted.map(|w| w.view()) else { return };
    let expected = [view.intrinsics.width, view.intrinsics.height];
    let png = match png_size(&png) {
        Some(found) if found == expected => Ok(png),
        found => Err(format!("the server sent a picture of {found:?} pixels, expected {expected:?}")),
    };
    settle(shared, id, png);
}

/// The request is answered, if it is the one that waits.
pub(super) fn settle(shared: &Shared, id: ShotId, png: Result<Vec<u8>, String>) {
    let mut is_wanted = false;
    // Nobody has to be told that nothing waits any more.
    shared.shot.send_if_modified(|waiting| {
        is_wanted = waiting.as_ref().is_some_and(|w| w.id == id);
        if is_wanted {
            *waiting = None;
        }
        false
    });
    if is_wanted {
        shared.status.put_shot(ReceivedShot { id, png });
        (shared.wake)();
    }
}

/// Columns and rows, by the first part of a PNG file (signature, then IHDR).
fn png_size(png: &[u8]) -> Option<[u32; 2]> {
    let rest = png.strip_prefix(b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR")?;
    let side = |at: usize| Some(u32::from_be_bytes(rest.get(at..at + 4)?.try_into().ok()?));
    Some([side(0)?, side(4)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_size_is_that_of_the_first_part() {
        let mut png = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x02\x80\0\0\x01\xe0\x08".to_vec();
        assert_eq!(png_size(&png), Some([640, 480]));
        png[0] = 0;
        assert_eq!(png_size(&png), None);
        assert_eq!(png_size(b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0"), None);
    }
}
