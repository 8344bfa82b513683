//! Literal bytes of one of each message and of each variant inside: bincode numbers variants and fields by their
//! order, so reordering one changes the wire without a word. Whoever changes bytes here raises [`PROTOCOL_VERSION`]
//! and reads docs/PROTOCOL.md.

use glam::{Quat, Vec3};

use super::control::{decode, encode};
use super::*;
use crate::camera::{Intrinsics, Pose};
use crate::channels::{Blend, ChannelLook, Channels, Visibility};
use crate::clip::{Clip, Plane};
use crate::ids::{FrameId, LoadId, LookVersion, PoseId, ProbeId, ScreenshotId, SliceId};
use crate::look::Look;
use crate::mode::{Iso, Isos, Mode};
use crate::space::Aabb;
use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use crate::volume::{Lighting, PageProgress, Placement, SlabMode, SlicePlane, SliceSpec, VolumeLabel};

fn transfer() -> TransferFunction {
    let point = |x, opacity| ControlPoint { x, color: [1.0, 0.5, 0.25], opacity };
    TransferFunction {
        name: "t".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point(0.0, 0.125), point(1.0, 0.75)],
    }
}

fn look() -> Look {
    Look {
        transfer: TransferFunction {
            domain: Domain::Values(-1.0, 2.0),
            unit_length: UnitLength::World(3.0),
            ..transfer()
        },
        shaded: false,
        lighting: Lighting {
            ambient_occlusion: 0.5,
            occlusion_radius: 0.125,
            shadows: 0.25,
            softness_degrees: 8.0,
            azimuth_degrees: -30.0,
            elevation_degrees: 40.0,
            specular: 0.75,
            shininess: 64.0,
        },
        k: 5,
        clip: Clip {
            bounds: Some(Aabb { min: Vec3::NEG_ONE, max: Vec3::new(1.0, 2.0, 3.0) }),
            plane: Plane::new(Vec3::Y, 0.5),
        },
        mode: Mode::Iso,
        isos: Isos::new(&[Iso { value: 300.0, opacity: 0.5 }]).unwrap(),
        channels: Channels {
            blend: Blend::Over,
            first: Visibility { is_hidden: true, hidden_labels: vec![] },
            others: vec![ChannelLook {
                transfer: transfer(),
                visibility: Visibility { is_hidden: false, hidden_labels: vec![3, 500] },
            }],
            chosen: 1,
        },
    }
}

fn volume() -> VolumeDescription {
    VolumeDescription {
        name: "v".into(),
        dims: [4, 5, 600],
        spacing: [1.0, 0.5, 2.0],
        unit: Some("mm".into()),
        orientation: None,
        placement: Some(Placement {
            center: [1.0, 2.0, 3.0],
            axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        }),
        value_unit: None,
        value_range: (-1.0, 1.0),
        histogram_range: (-0.5, 1.0),
        histogram: vec![1, 300],
        channels: vec![ChannelDescription {
            name: "c".into(),
            value_range: (0.0, 4.0),
            histogram_range: (0.0, 4.0),
            histogram: vec![7],
            are_labels: true,
            labels: vec![VolumeLabel { value: 3, name: "l".into(), color: Some([1, 2, 255]) }],
        }],
    }
}

fn view() -> PoseRequest {
    PoseRequest {
        id: PoseId(1),
        stamp_micros: 2,
        pose: Pose { eye: Vec3::new(1.0, 2.0, 3.0), world_from_view: Quat::IDENTITY },
        intrinsics: Intrinsics::perspective(40, 30, 0.5),
        newest_complete: Some(FrameId(4)),
        shown_turn_deg: Some(5),
        decode_nanos_per_list: 6,
    }
}

fn part() -> Part {
    Part {
        channel: Some(1),
        time: None,
        level: Some(2),
        series: None,
        region: Some([[0, 1], [2, 3], [4, 5]]),
        flip: [false, true, false],
    }
}

fn slices() -> Vec<SliceRequest> {
    let oblique = SlicePlane::Oblique {
        origin: [1.0, 2.0, 3.0],
        column: [0.5, 0.0, 0.0],
        row: [0.0, 0.25, 0.0],
        size: [300, 200],
    };
    let slice = |id, plane, thickness, mode| SliceRequest {
        id: SliceId(id),
        spec: SliceSpec { plane, thickness, mode },
        is_ahead: id > 1,
    };
    vec![
        slice(1, SlicePlane::Axis { axis: 2, index: 300 }, 0.0, SlabMode::Mean),
        slice(2, oblique, 2.5, SlabMode::Max),
        slice(3, oblique, 2.5, SlabMode::Min),
    ]
}

fn client_messages() -> Vec<ClientMessage> {
    let looks = [
        look(),
        Look {
            transfer: TransferFunction {
                domain: Domain::Percentiles(1.0, 99.0),
                unit_length: UnitLength::Radius(0.5),
                ..transfer()
            },
            ..Look::new(transfer())
        },
        Look { mode: Mode::Composite, ..Look::new(transfer()) },
        Look { mode: Mode::Mip, ..Look::new(transfer()) },
        Look { mode: Mode::MinIp, ..Look::new(transfer()) },
        Look { mode: Mode::Average, ..Look::new(transfer()) },
    ];
    let mut messages = vec![ClientMessage::Hello {
        protocol: 3,
        token: Token::new([1; 16]),
        instance: Token::new([2; 16]),
        name: "me".into(),
    }];
    messages.extend(looks.map(ClientMessage::SetLook));
    messages.extend([
        ClientMessage::Stats(ClientStats { frames_per_second: 60.0, age_micros: 1000, novel_view_micros: 2 }),
        ClientMessage::Bye,
        ClientMessage::Select(part()),
        ClientMessage::CancelSelection,
        ClientMessage::Probe(ProbeRequest { id: ProbeId(7), point: [1.0, -2.0, 0.5] }),
        ClientMessage::TakeScreenshot(ScreenshotRequest {
            id: ScreenshotId(8),
            view: view().encode().to_vec(),
            background: Some([1, 2, 3]),
            look: Some(Box::new(look())),
        }),
        ClientMessage::CancelScreenshot,
        ClientMessage::WantSlices(WantedSlices { volume: LookVersion(3), slices: slices() }),
        ClientMessage::Profile(ProfileRequest {
            id: ProbeId(9),
            ends: [[1.0, -2.0, 0.5], [0.0, 0.25, 4.0]],
            num_points: 300,
        }),
        ClientMessage::Follow(Some(3)),
        ClientMessage::Follow(None),
    ]);
    messages
}

fn server_messages() -> Vec<ServerMessage> {
    let load = |state| {
        ServerMessage::Load(LoadStatus {
            load: LoadId(2),
            is_own: true,
            part: part(),
            bytes_needed: 9,
            state,
        })
    };
    let (volume, look_version, look) = (volume(), LookVersion(4), Look::new(transfer()));
    vec![
        ServerMessage::Welcome(Box::new(Welcome {
            ticket: Token::new([3; 16]),
            volume: volume.clone(),
            look_version,
            look: look.clone(),
            max_side: 4096,
            max_poses_per_second: 240,
        })),
        ServerMessage::LookChanged { version: LookVersion(9), look: look.clone(), is_draft: true },
        ServerMessage::Refused(Refusal::UnknownToken),
        ServerMessage::Refused(Refusal::TokenUsed),
        ServerMessage::Refused(Refusal::Version { server: 1, client: 2 }),
        ServerMessage::Refused(Refusal::Full(3)),
        ServerMessage::Refused(Refusal::Protocol("p".into())),
        ServerMessage::Notice("n".into()),
        ServerMessage::Stats(ServerStats {
            frame: FrameId(1),
            pose: PoseId(2),
            pose_stamp_micros: 3,
            generate_micros: 4,
            encode_micros: 5,
            bytes: 1 << 40,
            segments: 7,
        }),
        ServerMessage::VolumeChanged(Box::new(VolumeChange { volume, look_version, look })),
        ServerMessage::Choices(Box::new(Choices {
            shown: part(),
            whole_dims: [1, 2, 3],
            num_channels: 2,
            joins_channels: true,
            channels: vec!["a".into(), "b".into()],
            num_times: 3,
            time_step: Some(0.5),
            levels: vec![[1, 2, 3]],
            num_series: 1,
            series: vec!["s".into()],
            bytes_in_memory: 1000,
        })),
        load(LoadState::Reading { permille: 500 }),
        load(LoadState::Done),
        load(LoadState::Cancelled),
        load(LoadState::Failed("f".into())),
        ServerMessage::Probed(Probed {
            id: ProbeId(5),
            point: [1.0, -2.0, 0.5],
            voxel: Some(ProbedVoxel { index: [1, 2, 3], value: -7.5, level: 2 }),
        }),
        ServerMessage::ScreenshotFailed { id: ScreenshotId(6), why: "w".into() },
        ServerMessage::Profile(Profile { id: ProbeId(9), values: vec![Some(1.5), None, Some(-2.0)] }),
        ServerMessage::Viewers(vec![
            ViewerEntry { number: 0, name: "a".into(), is_own: true, follows: Some(300) },
            ViewerEntry { number: 300, name: String::new(), is_own: false, follows: None },
        ]),
        ServerMessage::Pages(PageProgress {
            num_wanted: 300,
            num_resident: 2,
            num_damaged: 1,
            coarse_share: 0.25,
        }),
    ]
}

/// A new variant is given its bytes, too: whoever adds one is led here.
fn is_of(message: &ClientMessage) -> usize {
    match message {
        ClientMessage::Hello { .. } => 0,
        ClientMessage::SetLook(_) => 1,
        ClientMessage::Stats(_) => 2,
        ClientMessage::Bye => 3,
        ClientMessage::Select(_) => 4,
        ClientMessage::CancelSelection => 5,
        ClientMessage::Probe(_) => 6,
        ClientMessage::TakeScreenshot(_) => 7,
        ClientMessage::CancelScreenshot => 8,
        ClientMessage::WantSlices(_) => 9,
        ClientMessage::Profile(_) => 10,
        ClientMessage::Follow(_) => 11,
    }
}

/// The same of the other side.
fn is_of_server(message: &ServerMessage) -> usize {
    match message {
        ServerMessage::Welcome(_) => 0,
        ServerMessage::LookChanged { .. } => 1,
        ServerMessage::Refused(_) => 2,
        ServerMessage::Notice(_) => 3,
        ServerMessage::Stats(_) => 4,
        ServerMessage::VolumeChanged(_) => 5,
        ServerMessage::Choices(_) => 6,
        ServerMessage::Load(_) => 7,
        ServerMessage::Probed(_) => 8,
        ServerMessage::ScreenshotFailed { .. } => 9,
        ServerMessage::Profile(_) => 10,
        ServerMessage::Viewers(_) => 11,
        ServerMessage::Pages(_) => 12,
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[test]
fn every_message_has_its_bytes() {
    let (client, server) = (client_messages(), server_messages());
    let kinds =
        |all: Vec<usize>| all.into_iter().collect::<std::collections::BTreeSet<_>>().into_iter().collect();
    let found: [Vec<usize>; 2] =
        [kinds(client.iter().map(is_of).collect()), kinds(server.iter().map(is_of_server).collect())];
    assert_eq!(found, [(0..12).collect::<Vec<_>>(), (0..13).collect()], "one of each");
    let mut lines: Vec<String> = client.iter().map(|m| hex(&encode(m).unwrap()[4..])).collect();
    lines.extend(server.iter().map(|m| hex(&encode(m).unwrap()[4..])));
    let stored: Vec<&str> = include_str!("vectors.hex").lines().collect();
    for (i, line) in lines.iter().enumerate() {
        assert_eq!(stored.get(i), Some(&line.as_str()), "message {i}; all:\n{}", lines.join("\n"));
    }
    assert_eq!(stored.len(), lines.len());
    // The other way: bytes of an older build are read as what they were.
    let bytes = |line: &str| -> Vec<u8> {
        (0..line.len() / 2).map(|i| u8::from_str_radix(&line[2 * i..2 * i + 2], 16).unwrap()).collect()
    };
    for (message, line) in client.iter().zip(&stored) {
        let read: ClientMessage = decode(&bytes(line)).unwrap();
        assert_eq!(format!("{read:?}"), format!("{message:?}"));
    }
    for (message, line) in server.iter().zip(&stored[client.len()..]) {
        let read: ServerMessage = decode(&bytes(line)).unwrap();
        assert_eq!(format!("{read:?}"), format!("{message:?}"));
    }
}
