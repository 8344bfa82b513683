//! Messages on the control stream.

use isinglass_core::wire::control::{self, ControlError, Message};
use quinn::{ReadExactError, RecvStream, SendStream, WriteError};

/// Why no message arrived.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ReceiveError {
    /// The stream or the connection ended.
    #[error("the control stream ended: {0}")]
    Ended(String),
    /// The bytes are no message.
    #[error(transparent)]
    Control(#[from] ControlError),
}

/// The bytes of the next message, without its length. Not cancellation safe.
pub(crate) async fn receive_body(stream: &mut RecvStream) -> Result<Vec<u8>, ReceiveError> {
    let ended = |e: ReadExactError| ReceiveError::Ended(e.to_string());
    let mut prefix = [0; 4];
    stream.read_exact(&mut prefix).await.map_err(ended)?;
    let mut body = vec![0; control::body_length(prefix)?];
    stream.read_exact(&mut body).await.map_err(ended)?;
    Ok(body)
}

/// The next message. Not cancellation safe.
pub(crate) async fn receive<M: Message>(stream: &mut RecvStream) -> Result<M, ReceiveError> {
    Ok(control::decode(&receive_body(stream).await?)?)
}

/// Why a message was not sent.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SendError {
    /// The stream or the connection ended.
    #[error("the control stream ended: {0}")]
    Ended(#[from] WriteError),
    /// The message is not valid.
    #[error(transparent)]
    Control(#[from] ControlError),
}

/// Writes a message. Not cancellation safe.
pub(crate) async fn send<M: Message>(stream: &mut SendStream, message: &M) -> Result<(), SendError> {
    Ok(stream.write_all(&control::encode(message)?).await?)
}
