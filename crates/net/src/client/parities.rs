//! Hands parity datagrams to the tasks that read the streams.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isinglass_core::wire::parity::{ParityError, ParityHead};
use tokio::sync::mpsc;

/// The parity of the streams that are being read. Of other streams it is kept for a while: it may overtake their
/// first packet.
#[derive(Debug, Default)]
pub(super) struct Parities(Mutex<BTreeMap<u64, Mailbox>>);

#[derive(Debug)]
struct Mailbox {
    sender: mpsc::Sender<bytes::Bytes>,
    /// Until somebody listens.
    receiver: Option<mpsc::Receiver<bytes::Bytes>>,
}

/// Gets the parity of one stream.
pub(super) struct Listener {
    stream: u64,
    receiver: mpsc::Receiver<bytes::Bytes>,
    parities: Arc<Parities>,
}

impl Parities {
    /// The parity of a stream that is read from now on.
    pub(super) fn listen(self: &Arc<Self>, stream: u64) -> Listener {
        let early = self.lock().get_mut(&stream).and_then(|mailbox| mailbox.receiver.take());
        let receiver = early.unwrap_or_else(|| {
            let (sender, receiver) = mpsc::channel(MAX_DATAGRAMS);
            self.lock().insert(stream, Mailbox { sender, receiver: None });
            receiver
        });
        Listener { stream, receiver, parities: self.clone() }
    }

    /// Hands a datagram on. Too many of a stream are dropped.
    pub(super) fn pass_on(&self, datagram: bytes::Bytes) -> Result<(), ParityError> {
        let (head, _) = ParityHead::decode(&datagram)?;
        let mut mailboxes = self.lock();
        let mailbox = mailboxes.entry(head.stream).or_insert_with(|| {
            let (sender, receiver) = mpsc::channel(MAX_DATAGRAMS);
            Mailbox { sender, receiver: Some(receiver) }
        });
        let _ = mailbox.sender.try_send(datagram);
        // A stream that was read to its end leaves none, but its parity may come later.
        while mailboxes.values().filter(|mailbox| mailbox.receiver.is_some()).count() > MAX_UNREAD {
            let oldest = mailboxes.iter().find(|(_, mailbox)| mailbox.receiver.is_some()).map(|(id, _)| *id);
            oldest.and_then(|id| mailboxes.remove(&id));
        }
        Ok(())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<u64, Mailbox>> {
        // Every change is one step, so a panic leaves the map in order.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Listener {
    /// The next datagram.
    pub(super) async fn next(&mut self) -> Option<bytes::Bytes> {
        self.receiver.recv().await
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.parities.lock().remove(&self.stream);
    }
}

/// More than the parity of the longest frame.
const MAX_DATAGRAMS: usize = 512;
/// Streams without a reader whose parity is kept.
const MAX_UNREAD: usize = 16;
