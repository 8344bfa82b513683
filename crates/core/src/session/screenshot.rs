//! A picture that the server renders in full, for the viewer to keep or to show beside a preset.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::TakeScreenshot`], [`ClientMessage::CancelScreenshot`] | the view, or its withdrawal; at most 30 a second |
//! | [`ServerMessage::ScreenshotFailed`] | why there is no picture |
//! | stream `IGLS` | the picture as PNG; see [`crate::wire::screenshot`] |
//!
//! Only one picture is wanted at a time: a later request replaces the one before.

use std::sync::Arc;

use super::pace::Pace;
use crate::camera::{Intrinsics, Pose};
use crate::ids::ScreenshotId;
use crate::look::Look;
use crate::wire::control::one_line;
use crate::wire::{ClientMessage, PoseRequest, ScreenshotRequest, ServerMessage};

/// The outcome of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReceivedScreenshot {
    /// The request.
    pub id: ScreenshotId,
    /// A PNG file of the requested size, or one line that says why there is none.
    pub png: Result<Vec<u8>, String>,
}

/// The client's half: the wanted picture, and its outcome.
#[derive(Debug)]
pub struct ScreenshotClient {
    newest: ScreenshotId,
    wanted: Option<ScreenshotRequest>,
    /// The request that the server works on, as far as this connection has told it.
    asked: Option<ScreenshotId>,
    /// The next thing to send; its inner `None` cancels.
    outbox: Pace<Option<ScreenshotRequest>>,
    outcome: Option<Arc<ReceivedScreenshot>>,
}

impl Default for ScreenshotClient {
    fn default() -> Self {
        let outbox = Pace::new(PERIOD_MICROS);
        Self { newest: ScreenshotId(0), wanted: None, asked: None, outbox, outcome: None }
    }
}

impl ScreenshotClient {
    /// Requests a picture with this look, or with the viewer's own; transparent without a background (sRGB). A view that cannot be rendered fails at once.
    pub fn request(
        &mut self,
        pose: Pose,
        intrinsics: Intrinsics,
        background: impl Into<Option<[u8; 3]>>,
        look: Option<Look>,
    ) -> ScreenshotId {
        self.newest = self.newest.next();
        let view = PoseRequest::of_view(pose, intrinsics).encode().to_vec();
        let (background, look) = (background.into(), look.map(Box::new));
        let request = ScreenshotRequest { id: self.newest, view, background, look };
        let of_look = request.look.as_deref().and_then(|look| look.validate().err()).map(Into::into);
        let problem = request.view().err().or(of_look);
        self.wanted = Some(request.clone());
        self.outbox.offer(Some(problem.is_none().then_some(request)));
        if let Some(problem) = problem {
            self.handle_failed(self.newest, problem.to_string());
        }
        self.newest
    }

    /// Withdraws the request.
    pub fn cancel(&mut self) {
        self.wanted = None;
        self.outbox.offer(Some(None));
    }

    /// Whether the picture of this request is still wanted, so that its stream is worth reading.
    pub fn wants(&self, id: ScreenshotId) -> bool {
        self.wanted.as_ref().is_some_and(|wanted| wanted.id == id)
    }

    /// Takes the outcome of the newest request.
    pub fn take_outcome(&mut self) -> Option<Arc<ReceivedScreenshot>> {
        self.outcome.take()
    }

    /// A connection is up: a picture that is still wanted is requested again.
    pub fn handle_welcome(&mut self) {
        self.asked = None;
        self.outbox.offer(self.wanted.clone().map(Some));
    }

    /// A message has arrived.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        if let ServerMessage::ScreenshotFailed { id, why } = message {
            self.handle_failed(*id, why.clone());
        }
    }

    /// The stream of a picture has ended.
    pub fn handle_png(&mut self, id: ScreenshotId, png: Vec<u8>) {
        let Some(Ok(view)) = self.wanted.as_ref().filter(|w| w.id == id).map(ScreenshotRequest::view) else {
            return;
        };
        let expected = [view.intrinsics.width, view.intrinsics.height];
        let png = match png_size(&png) {
            Some(found) if found == expected => Ok(png),
            found => Err(format!("the server sent a picture of {found:?} pixels, expected {expected:?}")),
        };
        self.settle(id, png);
    }

    /// The picture does not come.
    pub fn handle_failed(&mut self, id: ScreenshotId, why: String) {
        self.settle(id, Err(why));
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        let wanted = self.outbox.poll(now_micros)?;
        let before = std::mem::replace(&mut self.asked, wanted.as_ref().map(|w| w.id));
        match wanted {
            Some(shot) => Some(ClientMessage::TakeScreenshot(shot)),
            None => before.map(|_| ClientMessage::CancelScreenshot),
        }
    }

    /// When to poll again, µs.
    pub fn due(&self) -> Option<u64> {
        self.outbox.due()
    }

    fn settle(&mut self, id: ScreenshotId, png: Result<Vec<u8>, String>) {
        if self.wanted.take_if(|wanted| wanted.id == id).is_some() {
            self.outcome = Some(Arc::new(ReceivedScreenshot { id, png }));
            // The server has nothing left to do and knows it.
            self.asked.take_if(|asked| *asked == id);
        }
    }
}

/// The server's half: the newest request, and failures.
#[derive(Debug, Default)]
pub struct ScreenshotServer {
    changed: Option<Option<ScreenshotRequest>>,
    failed: Option<(ScreenshotId, String)>,
}

impl ScreenshotServer {
    /// A message has arrived. Only the newest request remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        match message {
            ClientMessage::TakeScreenshot(request) => self.changed = Some(Some(request.clone())),
            ClientMessage::CancelScreenshot => self.changed = Some(None),
            _ => {}
        }
    }

    /// Takes the newest request, which replaces any picture in progress; its inner `None` cancels.
    pub fn poll_request(&mut self) -> Option<Option<ScreenshotRequest>> {
        self.changed.take()
    }

    /// A picture cannot be made.
    pub fn handle_failed(&mut self, id: ScreenshotId, why: &str) {
        self.failed = Some((id, one_line(why)));
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        self.failed.take().map(|(id, why)| ServerMessage::ScreenshotFailed { id, why })
    }
}

/// Columns and rows, from the start of a PNG file (signature, then IHDR).
fn png_size(png: &[u8]) -> Option<[u32; 2]> {
    let rest = png.strip_prefix(b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR")?;
    let side = |at: usize| Some(u32::from_be_bytes(rest.get(at..at + 4)?.try_into().ok()?));
    Some([side(0)?, side(4)?])
}

/// Requests go out at most 30 times a second.
const PERIOD_MICROS: u64 = 33_334;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::session::pair::{Pair, look};

    const VIEW: Intrinsics = Intrinsics::perspective(640, 480, 0.5);

    fn pose() -> Pose {
        Pose::orbit(Vec3::ZERO, 0.3, 0.1, 3.0)
    }

    fn png() -> Vec<u8> {
        b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x02\x80\0\0\x01\xe0\x08".to_vec()
    }

    #[test]
    fn the_size_is_that_of_the_first_part() {
        assert_eq!(png_size(&png()), Some([640, 480]));
        assert_eq!(png_size(&png()[1..]), None);
        assert_eq!(png_size(&png()[..20]), None);
    }

    #[test]
    fn the_newest_request_is_made_under_the_newest_look_and_settled_once() {
        for (loss, seed) in [(0.0, 1), (0.3, 2)] {
            let mut pair = Pair::new(80_000, loss, seed);
            pair.run(1_000_000);
            for name in ["a", "b"] {
                let now = pair.now();
                pair.client.look.set(now, look(name)).unwrap();
            }
            pair.client.screenshot.request(pose(), VIEW, [0; 3], None);
            let id = pair.client.screenshot.request(pose(), VIEW, [0; 3], None);
            pair.run(2_000_000);
            assert_eq!(pair.shots, [(id, "b".to_owned())]);
            pair.client.screenshot.handle_png(ScreenshotId(1), png());
            assert_eq!(pair.client.screenshot.take_outcome(), None, "it was replaced");
            pair.client.screenshot.handle_png(id, png());
            pair.client.screenshot.handle_failed(id, "late".into());
            let outcome = pair.client.screenshot.take_outcome();
            assert!(outcome.is_some_and(|o| o.id == id && o.png.is_ok()));
            assert_eq!(pair.client.screenshot.take_outcome(), None);
        }
    }

    #[test]
    fn a_wrong_size_a_view_that_is_too_large_and_a_look_that_is_invalid_fail() {
        let mut client = ScreenshotClient::default();
        let id = client.request(pose(), Intrinsics { width: 641, ..VIEW }, [0; 3], None);
        client.handle_png(id, png());
        assert!(client.take_outcome().unwrap().png.is_err());
        client.request(pose(), Intrinsics { width: 1 << 13, height: 1 << 13, ..VIEW }, [0; 3], None);
        assert!(client.take_outcome().unwrap().png.is_err());
        client.request(pose(), VIEW, [0; 3], Some(Look { k: 0, ..look("a") }));
        assert!(client.take_outcome().unwrap().png.is_err());
        assert!(client.poll_message(0).is_none(), "nothing was asked for");
    }

    #[test]
    fn what_is_wanted_is_asked_for_again_and_what_is_cancelled_is_not() {
        let mut client = ScreenshotClient::default();
        let id = client.request(pose(), VIEW, [0; 3], None);
        assert!(matches!(client.poll_message(0), Some(ClientMessage::TakeScreenshot(s)) if s.id == id));
        client.handle_welcome();
        assert!(matches!(client.poll_message(100_000), Some(ClientMessage::TakeScreenshot(s)) if s.id == id));
        client.cancel();
        assert!(!client.wants(id));
        assert!(matches!(client.poll_message(200_000), Some(ClientMessage::CancelScreenshot)));
        client.handle_welcome();
        assert!(client.poll_message(300_000).is_none());
        // Cancelled before the server heard of it.
        client.request(pose(), VIEW, [0; 3], None);
        client.cancel();
        assert!(client.poll_message(400_000).is_none());
    }
}
