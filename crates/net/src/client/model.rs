//! A client for virtual time: its network task runs on the caller's runtime, and frames are not decoded.

use std::sync::Arc;

use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::codec;
use isinglass_core::session::ledger::Life;
use quinn::{AsyncUdpSocket, EndpointConfig};

use super::dial::Dialer;
use super::{ClientOptions, Shared, connection};
use crate::clock::Clock;
use crate::link::Link;

/// A handle on it. The connection ends when it is dropped.
pub(crate) struct ModelClient(Arc<Shared>);

impl ModelClient {
    pub(crate) fn connect<S: AsyncUdpSocket>(
        link: &Link,
        clock: Clock,
        config: EndpointConfig,
        socket: impl Fn() -> Arc<S> + Send + Sync + 'static,
    ) -> Self {
        let options = ClientOptions { clock, ..ClientOptions::default() };
        let mut dialer = Dialer::new(link.clone(), &options).expect("random numbers");
        dialer.sockets = Some(Box::new(move || (socket(), config.clone())));
        let shared = Arc::new(Shared::new(options));
        tokio::spawn(connection::run(shared.clone(), dialer));
        Self(shared)
    }

    pub(crate) fn is_connected(&self) -> bool {
        self.0.status.read().state == super::State::Connected
    }

    pub(crate) fn now_micros(&self) -> u64 {
        self.0.clock.now_micros()
    }

    pub(crate) fn set_pose(&self, pose: Pose, intrinsics: Intrinsics) {
        let now = self.now_micros();
        self.0.talk.lock().pose.set(now, pose, intrinsics).expect("a pose");
    }

    /// Takes all frames that could be decoded, and whether they are exact.
    pub(crate) fn decode(&self) -> Vec<(Life, bool)> {
        let mut shown = vec![];
        let mut chunks = self.0.chunks();
        let now = self.now_micros();
        while let Some(job) = chunks.poll_decode(now) {
            let is_exact = codec::peek(&job.chunks[0]).is_ok_and(|header| header.is_exact);
            shown.extend(chunks.handle_decoded(now, job.connection, job.frame).map(|life| (life, is_exact)));
        }
        shown
    }
}

impl Drop for ModelClient {
    fn drop(&mut self) {
        self.0.stop();
    }
}
