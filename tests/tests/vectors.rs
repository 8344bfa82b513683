//! Do streams that were valid once still decode, and to the same frame?
//!
//! The files of `tests/vectors` are never written again: a format that cannot read one of them is another format
//! with another version, beside this one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::{Settings, encode};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::layering::{Layering, generate};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::volume::Histogram;
use isinglass_formats::{default_preset, iglf, load_transfer, open};

/// Name, and checksum of the frame.
const VECTORS: [(&str, u64); 5] = [
    ("exact-2-cloud-two-groups", 0x2824_1ec8_76dc_77fe),
    ("exact-2-cubus-one-group", 0xf948_5546_4c8b_e75b),
    ("exact-2-shells-8-bit", 0x62a9_29b0_ffc1_72d7),
    ("exact-2-shells-long-lists", 0x0aae_3cd5_7242_60d7),
    ("exact-2-empty", 0xed8c_5c23_6a1c_e039),
];

fn path(name: &str) -> PathBuf {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/vectors")).join(name).with_extension("iglf")
}

/// FNV-1a of all that a frame says: size, k and ids, the camera's numbers, then the words of offsets and planes.
fn checksum(frame: &LayeredFrame) -> u64 {
    let FrameHeader { frame: id, pose, look, camera, k } = frame.header;
    let Camera { pose: Pose { eye, world_from_view: q }, intrinsics, near, far } = camera;
    let integers = [id.0, pose.0, look.0, intrinsics.width, intrinsics.height, u32::from(k)];
    let floats = [eye.x, eye.y, eye.z, q.x, q.y, q.z, q.w, intrinsics.fov_y, near, far].map(f32::to_bits);
    let planes = [&frame.offsets, &frame.depth, &frame.c_rg, &frame.c_b_tau].into_iter().flatten().copied();
    let bytes = integers.into_iter().chain(floats).chain(planes).flat_map(u32::to_le_bytes);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

#[test]
fn every_stored_stream_decodes_to_its_frame() {
    let found = VECTORS.map(|(name, _)| {
        let frame = iglf::read(&path(name)).unwrap();
        frame.validate().unwrap();
        (name, checksum(&frame))
    });
    assert!(found == VECTORS, "{found:#018x?}");
    let stored = std::fs::read_dir(path(VECTORS[0].0).parent().unwrap()).unwrap().count();
    assert_eq!(stored, VECTORS.len(), "files that no line names");
}

#[test]
fn another_frame_has_another_checksum() {
    let mut frame = iglf::read(&path(VECTORS[0].0)).unwrap();
    let before = checksum(&frame);
    frame.c_rg[7] ^= 1;
    assert_ne!(checksum(&frame), before);
    frame.c_rg[7] ^= 1;
    frame.header.k += 1;
    assert_ne!(checksum(&frame), before);
}

/// Writes those that are missing. How they were made; not meant to be run again for a version that is out.
#[test]
#[ignore = "writes files into the repository"]
fn make_missing_vectors() {
    let frame = |source: &str, [width, height]: [u32; 2], k, layering: Layering| {
        let volume = open(source, &Default::default()).unwrap();
        let preset = default_preset(source, &volume, &Histogram::of(&volume)).to_string();
        let bounds = volume.bounds();
        let scene = Scene::new(Arc::new(volume), &load_transfer(&preset).unwrap(), MarchSettings::default());
        let intrinsics = Intrinsics { width, height, fov_y: 0.7 };
        let pose = Pose::orbit(bounds.center(), 0.5, 0.35, bounds.radius() * intrinsics.fit_distance());
        let camera = Camera::new(pose, intrinsics, &bounds);
        let header = FrameHeader { frame: FrameId(1), pose: PoseId(2), look: LookVersion(3), camera, k };
        generate(&scene, header, layering)
    };
    let settings = |color_bits, num_groups| Settings { color_bits, num_groups };
    let merge = Layering::VisibilityMerge;
    let cloud = frame("builtin:cloud@32", [40, 40], 4, merge);
    let empty = LayeredFrame::empty(cloud.header);
    let shells = "builtin:shells@32";
    for (name, frame, settings) in [
        ("exact-2-cloud-two-groups", cloud, settings(10, 2)),
        ("exact-2-cubus-one-group", frame("builtin:cubus@32", [48, 40], 4, merge), settings(10, 1)),
        ("exact-2-shells-8-bit", frame(shells, [33, 130], 2, Layering::EqualTransmittance), settings(8, 2)),
        ("exact-2-shells-long-lists", frame(shells, [24, 24], 16, Layering::EqualLength), settings(10, 2)),
        ("exact-2-empty", empty, settings(10, 2)),
    ] {
        let path = path(name);
        if !path.exists() {
            iglf::write(&path, &encode(&frame, &settings).unwrap()).unwrap();
        }
    }
}
