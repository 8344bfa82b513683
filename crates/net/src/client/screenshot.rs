//! Receives screenshots.

use isinglass_core::wire::screenshot::{MAX_SCREENSHOT_BYTES, SCREENSHOT_HEADER_BYTES, screenshot_id};
use quinn::RecvStream;

use super::Shared;
use super::chunks::Budget;
use crate::transport::STOP_UNUSABLE;

/// Reads the rest of a stream that began with `bytes`, unless nobody waits for the picture.
pub(super) async fn read(
    shared: &Shared,
    mut stream: RecvStream,
    mut bytes: Vec<u8>,
    mut budget: Budget,
) -> Result<(), String> {
    let Some(id) = screenshot_id(&bytes) else { return Ok(()) };
    while let Ok(next) = stream.read_chunk(usize::MAX, true).await {
        let Some(part) = next else {
            bytes.drain(..SCREENSHOT_HEADER_BYTES);
            shared.talk.lock().screenshot.handle_png(id, bytes);
            (shared.wake)();
            return Ok(());
        };
        let is_bounded =
            bytes.len() + part.bytes.len() <= MAX_SCREENSHOT_BYTES && budget.take(part.bytes.len());
        if !is_bounded || !shared.talk.lock().screenshot.wants(id) {
            let _ = stream.stop(STOP_UNUSABLE);
            if is_bounded {
                return Ok(());
            }
            let why = format!("a picture of more than {} bytes is not read", bytes.len());
            shared.talk.lock().screenshot.handle_failed(id, why.clone());
            (shared.wake)();
            return Err(why);
        }
        bytes.extend_from_slice(&part.bytes);
    }
    Ok(())
}
