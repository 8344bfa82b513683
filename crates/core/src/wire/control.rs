//! The messages of the control stream.
//!
//! A message is a little-endian `u32` length, at most [`MAX_CONTROL_BYTES`], and that many bytes in bincode 2
//! (standard configuration: variable-length little-endian integers). A message above 1024 bytes (a histogram, a list
//! of parts, a long look) is sent as a Zstandard frame if that is shorter. A reader knows it by the format's magic
//! number, with which no message begins. Both sides call `validate` on every message before using it. A new variant
//! needs a new protocol version, even at the end of an enum.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{
    Choices, LoadStatus, MAX_CONTROL_BYTES, PROTOCOL_VERSION, Part, ProbeRequest, Probed, Profile,
    ProfileRequest, ScreenshotRequest, Token, ViewerEntry, VolumeDescription, WantedSlices,
    version::older_side, viewers,
};
use crate::camera::MAX_SIDE;
use crate::ids::{FrameId, LookVersion, PoseId, ScreenshotId};
use crate::look::{Look, LookError, MAX_NAME_BYTES};
use crate::text;
use crate::volume::PageProgress;

/// A message of the client. [`ClientMessage::Hello`] comes first and once.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there are a few messages at a time, and none is kept")]
pub enum ClientMessage {
    /// Requests admission.
    Hello {
        /// The client's [`PROTOCOL_VERSION`].
        protocol: u32,
        /// The token of the link, or the ticket of the last welcome.
        token: Token,
        /// A secret that this client keeps while it runs. It alone can use its token again.
        instance: Token,
        /// Name of the client, for the server's log.
        name: String,
    },
    /// Asks for another look.
    SetLook(Look),
    /// How the client fares.
    Stats(ClientStats),
    /// The client leaves by its own choice.
    Bye,
    /// Asks for another part of the file, for all viewers.
    Select(Part),
    /// The part that is being read is no longer wanted.
    CancelSelection,
    /// Asks for the value at a point.
    Probe(ProbeRequest),
    /// Asks for a full rendering.
    TakeScreenshot(ScreenshotRequest),
    /// The requested picture is no longer wanted.
    CancelScreenshot,
    /// All slices that are wanted now.
    WantSlices(WantedSlices),
    /// Asks for the values along a line.
    Profile(ProfileRequest),
    /// Asks for the frames of the viewer with this number, or with `None` for own ones.
    Follow(Option<u32>),
}

/// A message of the server. [`ServerMessage::Welcome`] or [`ServerMessage::Refused`] comes first and once.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum ServerMessage {
    /// The client is admitted.
    Welcome(Box<Welcome>),
    /// Frames from now on have this look.
    LookChanged {
        /// Version of the look, which frames name.
        version: LookVersion,
        /// The look.
        look: Look,
        /// Whether frames of this version show a draft of it. Another version, or the same without a draft, follows.
        /// A draft is never the final picture.
        is_draft: bool,
    },
    /// The client is refused or dismissed; the connection closes after this.
    Refused(Refusal),
    /// One line for the person at the viewer.
    Notice(String),
    /// What the newest frame cost.
    Stats(ServerStats),
    /// Frames from now on show another volume.
    VolumeChanged(Box<VolumeChange>),
    /// What the file holds.
    Choices(Box<Choices>),
    /// The progress of reading another part.
    Load(LoadStatus),
    /// The value at a point.
    Probed(Probed),
    /// A requested picture will not come.
    ScreenshotFailed {
        /// The request.
        id: ScreenshotId,
        /// One line for the user.
        why: String,
    },
    /// The values along a line.
    Profile(Profile),
    /// Who is there.
    Viewers(Vec<ViewerEntry>),
    /// How far the pages of a large volume are, for the newest frame.
    Pages(PageProgress),
}

/// Another volume replaces the one that was shown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VolumeChange {
    /// The volume.
    pub volume: VolumeDescription,
    /// Frames of this look version or a later one show this volume, all others the previous one.
    pub look_version: LookVersion,
    /// The look.
    pub look: Look,
}

/// Everything that a viewer must know to begin.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Welcome {
    /// Replaces the token for this client's next connection.
    pub ticket: Token,
    /// The volume.
    pub volume: VolumeDescription,
    /// Version of the look.
    pub look_version: LookVersion,
    /// The look.
    pub look: Look,
    /// Largest width and height of a frame, pixels.
    pub max_side: u32,
    /// Pose datagrams beyond this rate are dropped, 1/s.
    pub max_poses_per_second: u32,
}

/// How a client fares, on its own clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClientStats {
    /// Frames shown in the last second.
    pub frames_per_second: f32,
    /// Time from setting the pose to showing its frame, µs, for the newest frame.
    pub age_micros: u64,
    /// Time of one novel view, µs.
    pub novel_view_micros: u64,
}

/// The cost of a frame at the server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ServerStats {
    /// The frame.
    pub frame: FrameId,
    /// The pose it answers.
    pub pose: PoseId,
    /// The stamp of that pose, echoed.
    pub pose_stamp_micros: u64,
    /// Time for marching and layering, µs.
    pub generate_micros: u64,
    /// Time for encoding, µs.
    pub encode_micros: u64,
    /// Length of all encoded chunks, bytes.
    pub bytes: u64,
    /// Number of segments in the frame.
    pub segments: u64,
}

/// Why a client is not admitted. The user at the viewer reads this text.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq, Serialize, Deserialize)]
pub enum Refusal {
    /// The token does not exist.
    #[error("the server does not know the token of this link; copy the link it printed last")]
    UnknownToken,
    /// Another viewer has used the token.
    #[error("this link was used by another viewer already; ask the server for a new one")]
    TokenUsed,
    /// The versions differ.
    #[error(
        "the server speaks protocol version {server}, this viewer {client}: update {}", older_side(*server, *client)
    )]
    Version {
        /// The server's version.
        server: u32,
        /// The client's version.
        client: u32,
    },
    /// No place is free.
    #[error("the server is full: all {0} places are taken")]
    Full(u32),
    /// The client broke the protocol.
    #[error("protocol violation: {0}")]
    Protocol(String),
}

impl Refusal {
    /// Whether the same request may succeed later.
    pub fn is_temporary(&self) -> bool {
        matches!(self, Self::Full(_))
    }
}

/// Why bytes are not a control message.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// The length is zero or above the limit.
    #[error("a control message of {0} bytes, expected 1 to {MAX_CONTROL_BYTES}")]
    Length(usize),
    /// The bytes do not decode.
    #[error("a control message that does not decode: {0}")]
    Decode(#[from] bincode::error::DecodeError),
    /// A message could not be written.
    #[error("a control message that does not encode: {0}")]
    Encode(#[from] bincode::error::EncodeError),
    /// The Zstandard frame does not decode, or holds more than a message may.
    #[error("a control message that does not unpack: {0}")]
    Packing(#[from] std::io::Error),
    /// Bytes are left after the message.
    #[error("a control message with {0} bytes too many")]
    Trailing(usize),
    /// A text is too long or holds control characters.
    #[error("a control message with an unusable {0}")]
    Text(&'static str),
    /// A number is out of range.
    #[error("a control message with an unusable {0}")]
    Value(&'static str),
    /// The look cannot be used.
    #[error("a control message with an unusable look: {0}")]
    Look(#[from] LookError),
}

/// A message that can be checked.
pub trait Message: Serialize + DeserializeOwned {
    /// Checks what the types cannot express.
    ///
    /// # Errors
    /// The first rule that it breaks.
    fn validate(&self) -> Result<(), ControlError>;
}

impl Message for ClientMessage {
    fn validate(&self) -> Result<(), ControlError> {
        match self {
            Self::Hello { name, .. } => check_text("name", name, MAX_NAME_BYTES),
            Self::SetLook(look) => Ok(look.validate()?),
            Self::Stats(s) if !s.frames_per_second.is_finite() => Err(ControlError::Value("frame rate")),
            Self::Select(part) => part.validate(),
            Self::Stats(_) | Self::Bye | Self::CancelSelection | Self::CancelScreenshot | Self::Follow(_) => {
                Ok(())
            }
            Self::Probe(probe) => probe.validate(),
            Self::WantSlices(list) => list.validate(),
            Self::Profile(line) => line.validate(),
            Self::TakeScreenshot(shot) => {
                shot.view()?;
                Ok(shot.look.as_deref().map_or(Ok(()), Look::validate)?)
            }
        }
    }
}

impl Message for ServerMessage {
    fn validate(&self) -> Result<(), ControlError> {
        match self {
            Self::Welcome(w) => {
                w.volume.validate()?;
                w.look.validate()?;
                if !(1..=MAX_SIDE).contains(&w.max_side) || w.max_poses_per_second == 0 {
                    return Err(ControlError::Value("limit"));
                }
                Ok(())
            }
            Self::LookChanged { look, .. } => Ok(look.validate()?),
            Self::Refused(Refusal::Protocol(s)) => check_text("reason", s, MAX_NOTICE_BYTES),
            Self::Notice(s) => check_text("notice", s, MAX_NOTICE_BYTES),
            Self::VolumeChanged(change) => {
                change.volume.validate()?;
                Ok(change.look.validate()?)
            }
            Self::Choices(choices) => choices.validate(),
            Self::Load(status) => status.validate(),
            Self::ScreenshotFailed { why, .. } => check_text("reason", why, MAX_NOTICE_BYTES),
            Self::Probed(probed) => probed.validate(),
            Self::Profile(profile) => profile.validate(),
            Self::Viewers(list) => viewers::validate(list),
            Self::Pages(progress) if !(0.0..=1.0).contains(&progress.coarse_share) => {
                Err(ControlError::Value("share of coarse pages"))
            }
            Self::Pages(progress)
                if progress
                    .num_resident
                    .checked_add(progress.num_damaged)
                    .is_none_or(|n| n > progress.num_wanted) =>
            {
                Err(ControlError::Value("number of pages"))
            }
            Self::Pages(_) => Ok(()),
            Self::Refused(_) | Self::Stats(_) => Ok(()),
        }
    }
}

/// A message with its length in front.
///
/// # Errors
/// If the message is invalid or too long: the peer would hang up.
pub fn encode<M: Message>(message: &M) -> Result<Vec<u8>, ControlError> {
    message.validate()?;
    let mut body = bincode::serde::encode_to_vec(message, bincode::config::standard())?;
    check_length(body.len())?;
    if body.len() > PACKED_ABOVE_BYTES {
        let packed = zstd::bulk::compress(&body, 0)?;
        if packed.len() < body.len() {
            body = packed;
        }
    }
    let mut out = Vec::with_capacity(4 + body.len());
    out.extend_from_slice(&(body.len() as u32).to_le_bytes());
    out.extend_from_slice(&body);
    Ok(out)
}

/// The length of the message that follows these four bytes.
///
/// # Errors
/// If it is zero or above [`MAX_CONTROL_BYTES`].
pub fn body_length(prefix: [u8; 4]) -> Result<usize, ControlError> {
    check_length(u32::from_le_bytes(prefix) as usize)
}

/// Reads a message without its length.
///
/// # Errors
/// If the bytes are no message, are too many, or break a rule of the message.
pub fn decode<M: Message>(body: &[u8]) -> Result<M, ControlError> {
    check_length(body.len())?;
    let is_packed = body.starts_with(&zstd::zstd_safe::MAGICNUMBER.to_le_bytes());
    let unpacked = is_packed.then(|| zstd::bulk::decompress(body, MAX_CONTROL_BYTES)).transpose()?;
    let body = unpacked.as_deref().unwrap_or(body);
    let config = bincode::config::standard().with_limit::<MAX_CONTROL_BYTES>();
    let (message, used): (M, usize) = bincode::serde::decode_from_slice(body, config)?;
    if used != body.len() {
        return Err(ControlError::Trailing(body.len() - used));
    }
    message.validate()?;
    Ok(message)
}

/// Makes a text fit for a [`ServerMessage::Notice`]: one line, cut if too long.
pub fn one_line(text: &str) -> String {
    text::one_line(text, MAX_NOTICE_BYTES / 4)
}

/// The first message of this client.
pub fn hello(token: Token, instance: Token, name: &str) -> ClientMessage {
    let name = text::printable(name, MAX_NAME_BYTES / 4);
    ClientMessage::Hello { protocol: PROTOCOL_VERSION, token, instance, name }
}

fn check_length(length: usize) -> Result<usize, ControlError> {
    if (1..=MAX_CONTROL_BYTES).contains(&length) { Ok(length) } else { Err(ControlError::Length(length)) }
}

/// Texts of a peer reach a terminal, where control characters could rewrite the screen.
pub(super) fn check_text(what: &'static str, s: &str, max_bytes: usize) -> Result<(), ControlError> {
    if s.len() > max_bytes || s.chars().any(text::is_control) {
        Err(ControlError::Text(what))
    } else {
        Ok(())
    }
}

/// Longest message that is sent as it is, bytes.
const PACKED_ABOVE_BYTES: usize = 1024;
/// Longest notice, bytes.
pub(super) const MAX_NOTICE_BYTES: usize = 2000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::ProbeId;
    use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use crate::volume::Histogram;
    use crate::wire::{MAX_BINS, ProbedVoxel};

    fn look() -> Look {
        let p = |x| ControlPoint { x, color: [1.0, 0.5, 0.0], opacity: x };
        let transfer = TransferFunction {
            name: "ramp".into(),
            domain: Domain::Values(-5.0, 7.0),
            unit_length: UnitLength::Radius(0.1),
            points: vec![p(0.0), p(1.0)],
        };
        Look { k: 5, ..Look::new(transfer) }
    }

    fn messages() -> Vec<ServerMessage> {
        let volume = VolumeDescription {
            name: "ramp".into(),
            dims: [4, 5, 6],
            spacing: [1.0, 0.5, 2.0],
            unit: Some("mm".into()),
            orientation: None,
            placement: None,
            value_unit: None,
            value_range: (-1.0, 1.0),
            histogram_range: (-0.5, 1.0),
            histogram: (0..256).collect(),
            channels: vec![],
        };
        let welcome = Welcome {
            ticket: Token::new([3; 16]),
            volume,
            look_version: LookVersion(4),
            look: look(),
            max_side: 4096,
            max_poses_per_second: 240,
        };
        vec![
            ServerMessage::Welcome(Box::new(welcome)),
            ServerMessage::LookChanged { version: LookVersion(9), look: look(), is_draft: true },
            ServerMessage::Refused(Refusal::Full(3)),
            ServerMessage::Notice("rendering on the CPU".into()),
            ServerMessage::Stats(ServerStats { bytes: 1 << 40, ..Default::default() }),
            ServerMessage::Probed(Probed {
                id: ProbeId(5),
                point: [1.0, -2.0, 0.5],
                voxel: Some(ProbedVoxel { index: [1, 2, 3], value: -7.5, level: 2 }),
            }),
            ServerMessage::ScreenshotFailed { id: ScreenshotId(6), why: "too large".into() },
        ]
    }

    #[test]
    fn decoding_inverts_encoding() {
        for m in messages() {
            let bytes = encode(&m).unwrap();
            let length = body_length(bytes[..4].try_into().unwrap()).unwrap();
            assert_eq!(length, bytes.len() - 4);
            let again: ServerMessage = decode(&bytes[4..]).unwrap();
            assert_eq!(encode(&again).unwrap(), bytes);
        }
        let hello = hello(Token::new([1; 16]), Token::new([2; 16]), "me\n\u{1b}[2J");
        let bytes = encode(&hello).unwrap();
        assert!(matches!(decode(&bytes[4..]), Ok(ClientMessage::Hello { name, .. }) if name == "me[2J"));
    }

    #[test]
    fn cut_extended_and_flipped_messages_never_panic_and_decode_only_to_valid_ones() {
        for m in messages() {
            let good = encode(&m).unwrap()[4..].to_vec();
            for len in 0..good.len() {
                assert!(decode::<ServerMessage>(&good[..len]).is_err());
            }
            let longer = [&good[..], &[0]].concat();
            assert!(matches!(decode::<ServerMessage>(&longer), Err(ControlError::Trailing(1))));
            for bit in 0..good.len() * 8 {
                let mut bytes = good.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                if let Ok(m) = decode::<ServerMessage>(&bytes) {
                    assert!(m.validate().is_ok());
                }
                let _ = decode::<ClientMessage>(&bytes);
            }
        }
    }

    /// A histogram packs, short messages stay readable as they are, and a small frame cannot claim much memory.
    #[test]
    fn long_messages_are_packed_within_bounds() {
        let magic = zstd::zstd_safe::MAGICNUMBER.to_le_bytes();
        let ServerMessage::Welcome(mut w) = messages().swap_remove(0) else { panic!("no welcome") };
        w.volume.histogram = (0..2000).map(|i| 100_000 / (i % 100 + 1)).collect();
        let plain =
            bincode::serde::encode_to_vec(ServerMessage::Welcome(w.clone()), bincode::config::standard());
        let bytes = encode(&ServerMessage::Welcome(w.clone())).unwrap();
        assert!(bytes[4..].starts_with(&magic) && bytes.len() * 2 < plain.unwrap().len());
        let again = decode(&bytes[4..]).unwrap();
        assert!(matches!(again, ServerMessage::Welcome(again) if again.volume == w.volume));
        let empty = zstd::bulk::compress(&[], 3).unwrap();
        assert!(matches!(decode::<ServerMessage>(&empty), Err(ControlError::Decode(_))));
        assert!(messages().iter().all(|m| !encode(m).unwrap()[4..].starts_with(&magic)));
        let bomb = zstd::bulk::compress(&vec![0; 100 * MAX_CONTROL_BYTES], 3).unwrap();
        assert!(bomb.len() < MAX_CONTROL_BYTES);
        assert!(matches!(decode::<ServerMessage>(&bomb), Err(ControlError::Packing(_))));
    }

    #[test]
    fn lengths_and_texts_are_bounded() {
        assert!(body_length([0; 4]).is_err());
        assert!(body_length([0xff; 4]).is_err());
        assert!(body_length((MAX_CONTROL_BYTES as u32).to_le_bytes()).is_ok());
        // A string that claims 2^40 bytes: variant 3 (Notice), then a nine-byte length.
        let mut lie = vec![3u8, 253];
        lie.extend_from_slice(&(1u64 << 40).to_le_bytes());
        assert!(matches!(decode::<ServerMessage>(&lie), Err(ControlError::Decode(_))));
        let escape = ServerMessage::Notice("\u{1b}[2J".into());
        assert!(matches!(encode(&escape), Err(ControlError::Text("notice"))));
        assert!(encode(&ServerMessage::Notice(one_line("\u{1b}[2J"))).is_ok());
        let mut bad = look();
        bad.k = 0;
        assert!(matches!(encode(&ClientMessage::SetLook(bad)), Err(ControlError::Look(LookError::K(0)))));
    }

    #[test]
    fn the_longest_welcome_fits_a_message() {
        let ServerMessage::Welcome(mut w) = messages().swap_remove(0) else { panic!("no welcome") };
        w.volume.histogram = vec![u64::MAX; MAX_BINS];
        w.volume.name = "n".repeat(MAX_NAME_BYTES);
        (w.volume.unit, w.volume.orientation) =
            (Some("u".repeat(MAX_NAME_BYTES)), Some("o".repeat(MAX_NAME_BYTES)));
        w.look.transfer.name = "t".repeat(MAX_NAME_BYTES);
        w.look.transfer.points = vec![w.look.transfer.points[0]; crate::transfer::MAX_POINTS];
        let mut longer = w.clone();
        let bytes = encode(&ServerMessage::Welcome(w)).unwrap();
        assert!(decode::<ServerMessage>(&bytes[4..]).is_ok());
        longer.volume.histogram.push(0);
        assert!(matches!(encode(&ServerMessage::Welcome(longer)), Err(ControlError::Value("histogram"))));
    }

    #[test]
    fn a_description_keeps_every_voxel_in_few_bins() {
        let volume = crate::volume::procedural::Builtin::Cloud.volume(24);
        let d = VolumeDescription::of(&volume, &Histogram::of(&volume));
        assert_eq!(d.histogram.iter().sum::<u64>(), d.dims.iter().map(|&n| u64::from(n)).product::<u64>());
        assert!(d.histogram.len() <= MAX_BINS);
        assert_eq!(d.bounds(), volume.bounds());
    }
}
