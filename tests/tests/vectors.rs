//! Do streams that were valid once still decode, and to the same frame?
//!
//! The files of `tests/vectors` are never written again: a format that cannot read one of them is another format
//! with another version, beside this one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::{Reference, References, Settings};
use isinglass_core::codec::{CodecError, Coding, decode_with};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::Mode;
use isinglass_core::volume::Histogram;
use isinglass_formats::iglf::{self, Origin};
use isinglass_formats::{default_preset, load_transfer, open};

/// Name, and checksum of the frame.
const VECTORS: [(&str, u64); 6] = [
    ("exact-4-cloud", 0x1a8c_e645_8a4e_6f53),
    ("exact-4-cubus", 0x7fba_9ff9_4122_3274),
    ("exact-4-shells-long-lists", 0x6fd7_e382_9414_573c),
    ("exact-4-empty", 0xed8c_5c23_6a1c_e039),
    ("exact-4-shells-mip-parallel", 0x9de1_ea95_88f3_0909),
    ("exact-4-bands", 0x7f88_8f10_f80a_f46a),
];

/// Name, the one before that it may be predicted from, and checksum of the frame.
const BLOCKS: [(&str, Option<&str>, u64); 7] = [
    ("blocks-4-shells", None, 0x3ce9_6da1_6ecd_37bc),
    ("blocks-4-shells-turned", Some("blocks-4-shells"), 0x68ef_abff_e61a_a93a),
    ("blocks-4-shells-at-rest", Some("blocks-4-shells-turned"), 0xb507_5284_af58_93aa),
    ("blocks-4-cubus-coarse", None, 0x2134_a664_8104_7a0d),
    ("blocks-4-bands", None, 0x9427_92de_aee0_fbcd),
    ("blocks-4-bands-turned", Some("blocks-4-bands"), 0x67cd_bece_bdee_5c64),
    ("blocks-4-parallel", None, 0xf616_39df_13fd_dd87),
];

fn path(name: &str) -> PathBuf {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/vectors")).join(name).with_extension("iglf")
}

/// FNV-1a of all that a frame says: size, k and ids, the mode if it is another than composite, the camera's numbers, then the
/// words of offsets and planes.
fn checksum(frame: &LayeredFrame) -> u64 {
    let FrameHeader { frame: id, pose, look, camera, k, mode, fineness: _ } = frame.header;
    let Camera { pose: Pose { eye, world_from_view: q }, intrinsics, near, far } = camera;
    let integers = [id.0, pose.0, look.0, intrinsics.width, intrinsics.height, u32::from(k)];
    let floats = [eye.x, eye.y, eye.z, q.x, q.y, q.z, q.w, intrinsics.projection.to_number(), near, far]
        .map(f32::to_bits);
    let planes = [&frame.offsets, &frame.depth, &frame.c_rg, &frame.c_b_tau].into_iter().flatten().copied();
    let mode = (mode != Mode::Composite).then_some(mode as u32);
    let bytes = integers.into_iter().chain(mode).chain(floats).chain(planes).flat_map(u32::to_le_bytes);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

#[test]
fn every_stored_stream_decodes_to_its_frame() {
    let found = VECTORS.map(|(name, _)| {
        let frame = iglf::read(&path(name)).unwrap().frame;
        frame.validate().unwrap();
        (name, checksum(&frame))
    });
    assert!(found == VECTORS, "{found:#018x?}");
    let stored = std::fs::read_dir(path(VECTORS[0].0).parent().unwrap()).unwrap().count();
    assert_eq!(stored, VECTORS.len() + BLOCKS.len(), "files that no line names");
}

/// The frame of a file, predicted from those before if it is, and what later ones may be predicted from.
fn read_with(name: &str, references: &References) -> Result<(LayeredFrame, Arc<Reference>), CodecError> {
    let chunks = iglf::read_chunks(&path(name)).expect("the file is there");
    let chunks: Vec<&[u8]> = chunks.iter().map(|c| &c[..]).collect();
    let (frame, reference) = decode_with(&chunks, references, None)?;
    Ok((frame, reference.expect("it is in blocks")))
}

#[test]
fn every_stored_stream_in_blocks_decodes_to_its_frame() {
    let mut references = References::default();
    let found = BLOCKS.map(|(name, before, _)| {
        // No other than the one that it names is asked for, and it cannot do without.
        assert_eq!(read_with(name, &References::default()).is_err(), before.is_some());
        let (frame, reference) = read_with(name, &references).unwrap();
        frame.validate().unwrap();
        references.insert(reference);
        (name, before, checksum(&frame))
    });
    assert!(found == BLOCKS, "{found:#018x?}");
}

#[test]
fn another_frame_has_another_checksum() {
    let mut frame = iglf::read(&path(VECTORS[0].0)).unwrap().frame;
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
    let frame_of = |mode, is_parallel, id, azimuth, source: &str, [width, height]: [u32; 2], k| {
        let volume = open(source, &Default::default()).unwrap();
        let preset = default_preset(source, &volume, &Histogram::of(&volume)).to_string();
        let bounds = volume.bounds();
        let settings = MarchSettings { mode, ..MarchSettings::default() };
        let scene = Scene::new(Arc::new(volume), &load_transfer(&preset).unwrap(), settings);
        let intrinsics = Intrinsics::perspective(width, height, 0.7);
        let distance = bounds.radius() * intrinsics.fit_distance();
        let pose = Pose::orbit(bounds.center(), azimuth, 0.35, distance);
        let camera = Camera::new(pose, intrinsics, &bounds);
        let camera = if is_parallel { camera.to_orthographic(distance, &bounds) } else { camera };
        let (frame, pose, look) = (FrameId(id), PoseId(2), LookVersion(3));
        generate(&scene, FrameHeader { frame, pose, look, mode, ..FrameHeader::alone(camera, k) })
    };
    let frame_at =
        |id, azimuth, source: &str, size, k| frame_of(Mode::Composite, false, id, azimuth, source, size, k);
    let frame = |source: &str, size, k| frame_at(1, 0.5, source, size, k);
    let cloud = frame("builtin:cloud@32", [40, 40], 4);
    let empty = LayeredFrame::empty(cloud.header);
    let shells = "builtin:shells@32";
    let write = |name: &str, coding: Coding, frame: &LayeredFrame, reference: Option<&Reference>| {
        let path = path(name);
        if !path.exists() {
            let (encoded, _) = coding.encode(frame, reference).unwrap();
            iglf::write(&path, &encoded, &Origin::default()).unwrap();
        }
    };
    for ((name, _), frame) in VECTORS.into_iter().zip([
        cloud,
        frame("builtin:cubus@32", [48, 40], 4),
        frame(shells, [24, 24], 16),
        empty,
        frame_of(Mode::Mip, true, 1, 0.5, shells, [30, 24], 4),
        frame(shells, [40, 260], 4),
    ]) {
        write(name, Coding::Exact, &frame, None);
    }
    let mut references = References::default();
    let turned = |id, azimuth| frame_at(id, azimuth, shells, [90, 70], 8);
    for ((name, before, _), (frame, quality)) in BLOCKS.into_iter().zip([
        (turned(11, 0.5), 60),
        (turned(12, 0.52), 60),
        (turned(13, 0.52), 60),
        (frame_at(15, 0.5, "builtin:cubus@32", [50, 81], 4), 10),
        (frame_at(16, 0.5, shells, [40, 260], 8), 40),
        (frame_at(17, 0.52, shells, [40, 260], 8), 40),
        (frame_of(Mode::Composite, true, 20, 0.5, shells, [48, 40], 8), 60),
    ]) {
        let before = before.and(references.newest()).cloned();
        let max_bands = if name.contains("bands") { 4 } else { 1 };
        let settings = Settings { max_bands, ..Settings::of(quality) };
        write(name, Coding::Blocks(settings), &frame, before.as_deref());
        references.insert(read_with(name, &references).unwrap().1);
    }
}
