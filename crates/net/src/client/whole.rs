//! Receives screenshots and slices, whose streams count only as a whole.

use isinglass_core::session::repair::RepairedStream;
use isinglass_core::volume::Slice;
use isinglass_core::wire::screenshot::{MAX_SCREENSHOT_BYTES, SCREENSHOT_HEADER_BYTES, screenshot_id};
use isinglass_core::wire::slice::{MAX_SLICE_BYTES, decode_slice, slice_id};
use quinn::RecvStream;

use super::Shared;
use super::chunks::Budget;
use crate::transport::STOP_UNUSABLE;

/// Reads the rest of a screenshot's stream, unless nobody waits for the picture.
pub(super) async fn read_screenshot(
    shared: &Shared,
    stream: RecvStream,
    begun: RepairedStream,
    budget: Budget,
) -> Result<(), String> {
    let Some(id) = screenshot_id(begun.prefix()) else { return Ok(()) };
    let is_wanted = || shared.talk.lock_quietly().screenshot.wants(id);
    match read(stream, begun, budget, MAX_SCREENSHOT_BYTES, is_wanted).await {
        Ok(None) => {}
        Ok(Some(mut bytes)) => {
            bytes.drain(..SCREENSHOT_HEADER_BYTES);
            shared.talk.lock().screenshot.handle_png(id, bytes);
            (shared.wake)();
        }
        Err(why) => {
            shared.talk.lock().screenshot.handle_failed(id, why.clone());
            (shared.wake)();
            return Err(why);
        }
    }
    Ok(())
}

/// Reads the rest of a slice's stream, unless nobody waits for the slice.
pub(super) async fn read_slice(
    shared: &Shared,
    stream: RecvStream,
    begun: RepairedStream,
    budget: Budget,
) -> Result<(), String> {
    let Some(id) = slice_id(begun.prefix()) else { return Ok(()) };
    let Some(size) = shared.talk.lock_quietly().slices.begin(id) else { return Ok(()) };
    let is_wanted = || shared.talk.lock_quietly().slices.wants(id);
    let unpacked = match read(stream, begun, budget, MAX_SLICE_BYTES, is_wanted).await {
        Ok(None) => return Ok(()),
        Ok(Some(bytes)) => unpack(shared, bytes, size).await,
        Err(why) => Err(why),
    };
    let read = {
        let mut talk = shared.talk.lock_quietly();
        match unpacked {
            Ok((slice, is_draft)) => {
                talk.slices.handle_slice(id, slice, is_draft);
                Ok(())
            }
            Err(why) => {
                talk.slices.handle_failed(id);
                Err(why)
            }
        }
    };
    (shared.wake)();
    read
}

/// Unpacks a slice on a thread that may block, because it takes longer than the network should wait.
async fn unpack(shared: &Shared, bytes: Vec<u8>, size: [u32; 2]) -> Result<(Slice, bool), String> {
    let _turn = shared.unpacking.acquire().await.map_err(|e| e.to_string())?;
    let unpacked = tokio::task::spawn_blocking(move || decode_slice(&bytes, size)).await;
    unpacked.map_err(|e| e.to_string())?.map_err(|e| e.to_string())
}

/// The whole stream; `None` if nobody waits for it any more, or if it was reset.
async fn read(
    mut stream: RecvStream,
    mut read: RepairedStream,
    mut budget: Budget,
    most: usize,
    is_wanted: impl Fn() -> bool,
) -> Result<Option<Vec<u8>>, String> {
    while let Ok(next) = stream.read_chunk(usize::MAX, false).await {
        let Some(part) = next else { return Ok(Some(read.into_bytes())) };
        let end = part.offset as usize + part.bytes.len();
        let is_bounded = end <= most && budget.grow_to(end);
        if !is_bounded || !is_wanted() {
            let _ = stream.stop(STOP_UNUSABLE);
            return match is_bounded {
                true => Ok(None),
                false => Err(format!("a stream of more than {} bytes is not read", read.num_bytes())),
            };
        }
        read.handle_part(0, part.offset as usize, &part.bytes);
    }
    Ok(None)
}
