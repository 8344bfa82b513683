//! What a peer may send, one function for each kind of input. A function takes any bytes, panics on a broken promise,
//! and returns in a word what became of them.

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::reference_named;
use isinglass_core::codec::{Coding, EncodedFrame, blocks, peek};
use isinglass_core::ids::{FrameId, LookVersion, PoseId, ScreenshotId, SliceId};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::session::chunks::{ChunkPlace, ChunksClient, MAX_FRAME_BYTES, Prediction};
use isinglass_core::session::repair::{RepairedStream, parity};
use isinglass_core::session::{ClientSession, ServerSession};
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Slice, SliceCodes};
use isinglass_core::wire::control::{body_length, decode, encode};
use isinglass_core::wire::parity::ParityHead;
use isinglass_core::wire::screenshot::{screenshot_header, screenshot_id};
use isinglass_core::wire::slice::{decode_slice, encode_slice, slice_id};
use isinglass_core::wire::{ClientMessage, POSE_BYTES, PoseRequest, ServerMessage};

/// One kind of input.
#[derive(Clone, Copy)]
pub(crate) struct Target {
    pub(crate) name: &'static str,
    /// Inputs that are taken.
    pub(crate) seeds: fn() -> Vec<Vec<u8>>,
    pub(crate) take: fn(&[u8]) -> String,
    /// Most bytes that an input may cost.
    pub(crate) most_bytes: usize,
}

pub(crate) const TARGETS: [Target; 6] = [
    Target { name: "viewer-control", seeds: viewer_seeds, take: viewer_control, most_bytes: 64 << 20 },
    Target { name: "server-control", seeds: server_seeds, take: server_control, most_bytes: 64 << 20 },
    Target { name: "poses", seeds: pose_seeds, take: poses, most_bytes: 1 << 20 },
    Target { name: "repair", seeds: repair_seeds, take: repair, most_bytes: 64 << 20 },
    Target { name: "frames", seeds: frame_seeds, take: frames, most_bytes: 64 << 20 },
    Target { name: "slices", seeds: slice_seeds, take: slices, most_bytes: 256 << 20 },
];

/// The control messages of the page of the protocol: eleven kinds of each side, viewers first.
fn vectors() -> Vec<Vec<u8>> {
    let byte = |line: &str, i: usize| u8::from_str_radix(&line[2 * i..2 * i + 2], 16).expect("digits");
    let bytes = |line: &str| (0..line.len() / 2).map(|i| byte(line, i)).collect();
    include_str!("../../src/wire/vectors.hex").lines().map(bytes).collect()
}

fn with_length(body: &[u8]) -> Vec<u8> {
    [&(body.len() as u32).to_le_bytes()[..], body].concat()
}

/// Each message alone, and all of them in a row.
fn streams_of(is_of: impl Fn(&[u8]) -> bool) -> Vec<Vec<u8>> {
    let messages: Vec<_> =
        vectors().into_iter().filter(|body| is_of(body)).map(|b| with_length(&b)).collect();
    let all = messages.concat();
    messages.into_iter().chain([all]).collect()
}

fn viewer_seeds() -> Vec<Vec<u8>> {
    streams_of(|body| decode::<ClientMessage>(body).is_ok())
}

fn server_seeds() -> Vec<Vec<u8>> {
    streams_of(|body| decode::<ServerMessage>(body).is_ok())
}

/// The messages of a control stream, as far as their lengths are right.
fn bodies(mut bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (prefix, rest) = bytes.split_first_chunk::<4>()?;
        let (body, rest) = rest.split_at_checked(body_length(*prefix).ok()?)?;
        bytes = rest;
        Some(body)
    })
}

fn look() -> Look {
    let point = |x| ControlPoint { x, color: [1.0, 0.5, 0.0], opacity: x };
    Look::new(TransferFunction {
        name: "ramp".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point(0.0), point(1.0)],
    })
}

/// The name of a message's or error's kind, without what is in it.
fn kind(debug: &str) -> String {
    debug
        .chars()
        .take_while(|c| c.is_alphanumeric() || *c == ' ')
        .filter(|c| !c.is_ascii_digit())
        .take(40)
        .collect()
}

/// A viewer's control stream at the server.
fn viewer_control(bytes: &[u8]) -> String {
    let mut session = ServerSession::new(0, ViewerId(7), LookVersion(1), look());
    let mut said = String::from("nothing");
    for (i, body) in bodies(bytes).enumerate() {
        let now = 10_000 * i as u64;
        match decode::<ClientMessage>(body) {
            Ok(message) => {
                let again = encode(&message).expect("what was read can be written");
                let again: ClientMessage = decode(&again[4..]).expect("what was written can be read");
                assert_eq!(format!("{again:?}"), format!("{message:?}"));
                said = kind(&format!("{message:?}"));
            }
            Err(e) => said = format!("error {}", kind(&e.to_string())),
        }
        match session.handle_message(body) {
            Ok(_) => {}
            Err(refusal) => return format!("{said} refused {}", kind(&refusal.to_string())),
        }
        for _ in 0..MOST_ANSWERS {
            let Some(answer) = session.poll_message(now) else { break };
            encode(&answer).expect("an answer can be written");
        }
    }
    said
}

/// A server's control stream at the viewer.
fn server_control(bytes: &[u8]) -> String {
    let mut session = ClientSession::default();
    let mut said = String::from("nothing");
    for (i, body) in bodies(bytes).enumerate() {
        let now = 10_000 * i as u64;
        let message = match decode::<ServerMessage>(body) {
            Ok(message) => message,
            Err(e) => return format!("error {}", kind(&e.to_string())),
        };
        let again = encode(&message).expect("what was read can be written");
        let again: ServerMessage = decode(&again[4..]).expect("what was written can be read");
        assert_eq!(format!("{again:?}"), format!("{message:?}"));
        said = kind(&format!("{message:?}"));
        match message {
            // The connection reads the first.
            ServerMessage::Welcome(welcome) if session.link.description().is_none() => {
                session.handle_welcome(now, *welcome);
                session.probe.ask([0.1; 3]);
            }
            message => {
                if session.handle_message(now, message).is_err() {
                    return format!("{said} ends");
                }
            }
        }
        for _ in 0..MOST_ANSWERS {
            let Some(answer) = session.poll_message(now) else { break };
            encode(&answer).expect("an answer can be written");
        }
    }
    said
}

fn pose_seeds() -> Vec<Vec<u8>> {
    let pose = |turn: f32| Pose::orbit(Vec3::ZERO, turn, 0.1, 5.0);
    let datagram = |i: u32, intrinsics| {
        let view = PoseRequest::of_view(pose(i as f32), intrinsics);
        PoseRequest { id: PoseId(i), stamp_micros: u64::from(i) * 4000, ..view }.encode().to_vec()
    };
    let perspective = |i| datagram(i, Intrinsics::perspective(640, 480, 0.6));
    vec![
        perspective(1),
        datagram(2, Intrinsics::orthographic(64, 48, 2.0)),
        (1..9).flat_map(perspective).collect(),
    ]
}

/// Pose datagrams at the server.
fn poses(bytes: &[u8]) -> String {
    let mut session = ServerSession::new(0, ViewerId(7), LookVersion(1), look());
    let mut said = String::from("nothing");
    for (i, datagram) in bytes.chunks(POSE_BYTES).enumerate() {
        said = match session.handle_datagram(4000 * i as u64, datagram) {
            Ok(is_new) => format!("new {is_new}"),
            Err(e) => format!("error {}", kind(&e.to_string())),
        };
        if let Some(newest) = session.pose.newest() {
            assert!(newest.validate().is_ok(), "{newest:?}");
        }
        if let Ok(read) = PoseRequest::decode(datagram) {
            assert_eq!(read.encode()[..], *datagram);
        }
    }
    said
}

fn record(kind: u8, at: u32, bytes: &[u8]) -> Vec<u8> {
    [&[kind][..], &at.to_le_bytes(), &(bytes.len() as u16).to_le_bytes(), bytes].concat()
}

/// Each a kind, a number and bytes.
fn records(mut bytes: &[u8]) -> impl Iterator<Item = (u8, u32, &[u8])> {
    std::iter::from_fn(move || {
        let (&[kind, a, b, c, d, low, high], rest) = bytes.split_first_chunk::<7>()?;
        let (part, rest) = rest.split_at(usize::from(u16::from_le_bytes([low, high])).min(rest.len()));
        bytes = rest;
        Some((kind, u32::from_le_bytes([a, b, c, d]), part))
    })
}

/// Streams of 700 bytes without some packets, with their parity before, behind and in between.
fn repair_seeds() -> Vec<Vec<u8>> {
    let stream: Vec<u8> = (0..700u32).map(|i| (i * i / 7) as u8).collect();
    let parities = parity(4, &stream, 0.03, 150);
    let parts = |lost: &[usize]| -> Vec<Vec<u8>> {
        let kept = stream.chunks(100).enumerate().filter(|(i, _)| !lost.contains(i));
        kept.map(|(i, part)| record(0, 100 * i as u32, part)).collect()
    };
    let parity = |n: usize| parities.iter().take(n).map(|p| record(1, 0, p)).collect::<Vec<_>>().concat();
    let end = record(2, 0, &[]);
    vec![
        [parts(&[2]).concat(), parity(9), end.clone()].concat(),
        [parity(2), parts(&[0, 6]).concat(), parity(9), end.clone()].concat(),
        [parts(&[]).concat(), end.clone()].concat(),
        [parity(9), end].concat(),
    ]
}

/// Parts of a stream and parity datagrams at the viewer.
fn repair(bytes: &[u8]) -> String {
    let mut stream = RepairedStream::default();
    let mut said = String::from("nothing");
    for (i, (kind_of, at, part)) in records(bytes).enumerate() {
        let now = 100 * i as u64;
        match kind_of % 3 {
            // The connection refuses longer streams, and counts what a stream takes.
            0 if at as usize + part.len() > MOST_OF_STREAM => return format!("{said} too long"),
            0 => stream.handle_part(now, at as usize, part),
            1 => match ParityHead::decode(part) {
                Ok((head, symbols)) => stream.handle_parity(now, head, symbols),
                Err(e) => said = format!("error {}", kind(&e.to_string())),
            },
            _ => {
                let is_due = stream.repair_due().is_some();
                let is_whole = stream.repair();
                assert!(is_due || !is_whole || stream.prefix().len() == stream.num_bytes());
                said = format!("due {is_due} whole {is_whole}");
            }
        }
        assert!(stream.prefix().len() <= stream.num_bytes());
    }
    said
}

/// Frames as they are written to streams: exact, in blocks, and predicted from each other.
fn frame_seeds() -> Vec<Vec<u8>> {
    let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
    let coding = Coding::Blocks(blocks::Settings::of(60));
    let mut frames = vec![];
    let mut last = None;
    for i in 1..5u32 {
        let pose = Pose::orbit(Vec3::ZERO, 0.02 * i as f32, 0.3, 5.0);
        let camera = Camera::new(pose, Intrinsics::perspective(24, 20, 0.6), &bounds);
        let header = FrameHeader { frame: FrameId(i), ..FrameHeader::alone(camera, 4) };
        let frame = LayeredFrame::empty(header);
        let (encoded, reference) = coding.encode(&frame, last.as_deref()).expect("valid bytes");
        let exact = Coding::Exact.encode(&frame, None).expect("valid bytes").0;
        let bytes =
            |e: EncodedFrame| e.chunks.iter().flat_map(|chunk| chunk.bytes.clone()).collect::<Vec<u8>>();
        frames.extend([encoded, exact].map(bytes));
        last = reference;
    }
    let all = frames.iter().map(|f| record(0, 0, f)).collect::<Vec<_>>().concat();
    frames.iter().map(|f| record(0, 0, f)).chain([all]).collect()
}

/// Streams of frames at the viewer: which are put together, decoded and shown.
fn frames(bytes: &[u8]) -> String {
    let mut chunks = ChunksClient::default();
    chunks.handle_connected();
    let mut said = String::from("nothing");
    for (i, (kind_of, at, stream)) in records(bytes).enumerate() {
        let now = 1000 * i as u64;
        chunks.handle_pose(now, PoseId(at));
        let mut rest = stream;
        while let Ok(header) = peek(rest) {
            let Some((chunk, after)) = rest.split_at_checked(header.chunk_bytes()) else { break };
            let prediction = (!header.is_exact).then(|| Prediction { reference: reference_named(chunk) });
            let place = ChunkPlace {
                prediction,
                frame: header.frame.frame,
                pose: header.frame.pose,
                index: header.index,
                num_chunks: header.num_chunks.into(),
            };
            said = match chunks.handle_chunk(now, now, place, chunk.to_vec()) {
                Ok(()) => "taken".into(),
                Err(e) => format!("error {}", kind(&format!("{e:?}"))),
            };
            rest = after;
        }
        while let Some(job) = chunks.poll_decode(now) {
            assert!(job.chunks.iter().map(Vec::len).sum::<usize>() <= MAX_FRAME_BYTES);
            if kind_of & 1 == 0 {
                let is_shown = chunks.handle_decoded(now, job.connection, job.frame).is_some();
                said = format!("shown {is_shown}");
            } else {
                chunks.handle_broken(job.connection, job.frame);
                said = "broken".into();
            }
        }
    }
    said
}

fn slice_seeds() -> Vec<Vec<u8>> {
    let slice = |codes, size| Slice { size, lo: -3.0, step: 0.5, codes };
    let eight = slice(SliceCodes::U8((0..=255).collect()), [16, 16]);
    let sixteen = slice(SliceCodes::U16((0..600).map(|i| i * 97).collect()), [30, 20]);
    let mut seeds: Vec<_> = [eight, sixteen]
        .iter()
        .map(|slice| encode_slice(SliceId(9), slice, false).expect("it can be packed"))
        .collect();
    seeds.push([&screenshot_header(ScreenshotId(3))[..], b"\x89PNG"].concat());
    seeds
}

/// The streams that count as a whole, at a viewer who asked for the size that the stream names.
fn slices(bytes: &[u8]) -> String {
    if screenshot_id(bytes).is_some() {
        return "screenshot".into();
    }
    let Some(id) = slice_id(bytes) else { return "nothing".into() };
    let side = |at: usize| bytes.get(at..at + 2).map_or(0, |b| u32::from(u16::from_le_bytes([b[0], b[1]])));
    match decode_slice(bytes, [side(8), side(10)]) {
        Ok((slice, is_draft)) => {
            let again = encode_slice(id, &slice, is_draft).expect("what was read can be packed");
            let again = decode_slice(&again, slice.size).expect("what was packed can be read");
            assert_eq!(format!("{again:?}"), format!("{:?}", (&slice, is_draft)));
            format!("slice {}", matches!(slice.codes, SliceCodes::U8(_)))
        }
        Err(e) => format!("error {}", kind(&e.to_string())),
    }
}

/// A session that answers without end is a finding, but these are polled once for each message.
const MOST_ANSWERS: usize = 64;
const MOST_OF_STREAM: usize = 4 << 20;
