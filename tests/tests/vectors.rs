//! Do streams that were valid once still decode, and to the same frame?
//!
//! The files of `tests/vectors` are never written again: a format that cannot read one of them is another format
//! with another version, beside this one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::{self, Reference, References};
use isinglass_core::codec::{CodecError, HEADER_BYTES, Settings, assemble, encode, peek};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::Mode;
use isinglass_core::volume::Histogram;
use isinglass_formats::iglf::{self, Origin};
use isinglass_formats::{default_preset, load_transfer, open};

/// Name, and checksum of the frame.
const VECTORS: [(&str, u64); 7] = [
    ("exact-2-cloud-two-groups", 0x2824_1ec8_76dc_77fe),
    ("exact-2-cubus-one-group", 0xf948_5546_4c8b_e75b),
    ("exact-2-shells-8-bit", 0x62a9_29b0_ffc1_72d7),
    ("exact-2-shells-long-lists", 0x0aae_3cd5_7242_60d7),
    ("exact-2-empty", 0xed8c_5c23_6a1c_e039),
    ("exact-2-shells-mip-parallel", 0x4528_46d6_8725_7e5f),
    // It says where bands end; those before have bands of equal height.
    ("exact-2-own-bands", 0x1595_3633_3e5c_9d8d),
];

/// Name, the one before that it may be predicted from, and checksum of the frame.
const BLOCKS: [(&str, Option<&str>, u64); 17] = [
    ("blocks-2-shells", None, 0xf758_9055_db80_deef),
    ("blocks-2-shells-turned", Some("blocks-2-shells"), 0xaad8_48b6_d2a7_46b2),
    ("blocks-2-shells-at-rest", Some("blocks-2-shells-turned"), 0x3777_5adf_b36c_49b3),
    ("blocks-2-cloud-split", None, 0x4d1c_6e0e_748b_a15c),
    ("blocks-2-cubus-coarse", None, 0xa9b9_07db_c481_ed57),
    ("blocks-2-own-bands", None, 0x8932_3ba5_9a25_c0d7),
    ("blocks-2-own-bands-turned", Some("blocks-2-own-bands"), 0xbdf2_38a3_a0e9_f57e),
    ("blocks-2-parallel", None, 0xaee6_6efb_ce56_cf4f),
    // Planes are predicted from the edges of those beside.
    ("blocks-2-edges-shells", None, 0xb0bb_8d83_965f_2a7f),
    ("blocks-2-edges-shells-turned", Some("blocks-2-edges-shells"), 0x4279_4edd_0f99_89c0),
    ("blocks-2-edges-cloud-coarse", None, 0x4411_b561_c260_579b),
    // Borders between blocks of the picture are smoothed.
    ("blocks-2-smooth-shells", None, 0xb3a4_cf3f_81ac_9b2d),
    ("blocks-2-smooth-shells-turned", Some("blocks-2-smooth-shells"), 0xd620_4465_093e_2cf3),
    ("blocks-2-smooth-shells-at-rest", Some("blocks-2-smooth-shells-turned"), 0x558c_ad58_0f5a_320f),
    ("blocks-2-smooth-cloud-in-bands", None, 0x8510_127a_9094_cc3c),
    // As an encoder wrote them that ends no band where it likes, and as the decoder of its time read them.
    ("blocks-2-equal-bands", None, 0x5574_e2d6_3e44_7996),
    ("blocks-2-equal-bands-turned", Some("blocks-2-equal-bands"), 0x1bcc_aea3_f868_f30a),
];

fn path(name: &str) -> PathBuf {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/vectors")).join(name).with_extension("iglf")
}

/// FNV-1a of all that a frame says: size, k and ids, the mode if it is another than composite, the camera's numbers, then the
/// words of offsets and planes.
fn checksum(frame: &LayeredFrame) -> u64 {
    let FrameHeader { frame: id, pose, look, camera, k, mode } = frame.header;
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
    let (frame, reference) = assemble(&chunks, references)?.to_frame_and_reference(None);
    Ok((frame, reference.expect("all chunks are there")))
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
fn bands_of_both_kinds_are_stored() {
    // Whether the head of every chunk states where bands end, and how many chunks there are.
    let found = |name: &str| {
        let chunks = iglf::read_chunks(&path(name)).unwrap();
        let states = |chunk: &Vec<u8>| chunk[HEADER_BYTES] & 4 != 0;
        (chunks.iter().all(states), chunks.iter().any(states), chunks.len())
    };
    assert_eq!(found("blocks-2-equal-bands"), (false, false, 4));
    assert_eq!(found("blocks-2-equal-bands-turned"), (false, false, 6));
    assert_eq!(found("blocks-2-own-bands"), (true, true, 4));
    let exact = VECTORS.map(|(name, _)| {
        let chunks = iglf::read_chunks(&path(name)).unwrap();
        (name, chunks.iter().all(|chunk| peek(chunk).unwrap().has_borders), chunks.len())
    });
    assert!(
        exact.iter().all(|&(name, has_borders, _)| has_borders == (name == "exact-2-own-bands")),
        "{exact:?}"
    );
    assert!(exact.iter().any(|&(_, has_borders, num_chunks)| !has_borders && num_chunks > 2), "{exact:?}");
}

#[test]
fn edges_are_used_in_frames_that_are_predicted_from_no_other() {
    let uses_edges = |name: &str| iglf::read_chunks(&path(name)).unwrap()[0][HEADER_BYTES] & 8 != 0;
    let found = BLOCKS.map(|(name, before, _)| (name, before.is_none(), uses_edges(name)));
    for (name, is_alone, uses_edges) in found {
        let is_later = name.contains("-edges-") || name.contains("-smooth-");
        assert_eq!(uses_edges, is_alone && is_later, "{name}");
    }
}

#[test]
fn borders_are_smooth_in_the_last_streams_and_as_they_were_in_those_before() {
    for (name, ..) in BLOCKS {
        let chunks = iglf::read_chunks(&path(name)).unwrap();
        let is_smooth = chunks.iter().map(|chunk| chunk[HEADER_BYTES] & 16 != 0);
        assert!(is_smooth.clone().all(|smooth| smooth == name.contains("-smooth-")), "{name}");
    }
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
        generate(&scene, FrameHeader { frame, pose, look, camera, k, mode })
    };
    let frame_at =
        |id, azimuth, source: &str, size, k| frame_of(Mode::Composite, false, id, azimuth, source, size, k);
    let frame = |source: &str, size, k| frame_at(1, 0.5, source, size, k);
    let settings = |color_bits, num_groups| Settings { color_bits, num_groups };
    let cloud = frame("builtin:cloud@32", [40, 40], 4);
    let empty = LayeredFrame::empty(cloud.header);
    let shells = "builtin:shells@32";
    let exact = settings(10, 1);
    for (name, frame, settings) in [
        ("exact-2-cloud-two-groups", cloud, settings(10, 2)),
        ("exact-2-cubus-one-group", frame("builtin:cubus@32", [48, 40], 4), settings(10, 1)),
        ("exact-2-shells-8-bit", frame(shells, [33, 130], 2), settings(8, 2)),
        ("exact-2-shells-long-lists", frame(shells, [24, 24], 16), settings(10, 2)),
        ("exact-2-empty", empty, settings(10, 2)),
        ("exact-2-shells-mip-parallel", frame_of(Mode::Mip, true, 1, 0.5, shells, [30, 24], 4), exact),
        ("exact-2-own-bands", frame(shells, [40, 260], 4), settings(10, 2)),
    ] {
        let path = path(name);
        if !path.exists() {
            iglf::write(&path, &encode(&frame, &settings).unwrap(), &Origin::default()).unwrap();
        }
    }
    let mut references = References::default();
    let turned = |id, azimuth| frame_at(id, azimuth, shells, [90, 70], 8);
    for ((name, before, _), (frame, quality, is_split)) in BLOCKS.into_iter().zip([
        (turned(11, 0.5), 60, false),
        (turned(12, 0.52), 60, false),
        (turned(13, 0.52), 60, false),
        (frame_at(14, 0.5, "builtin:cloud@32", [64, 64], 12), 90, true),
        (frame_at(15, 0.5, "builtin:cubus@32", [50, 81], 4), 10, false),
        (frame_at(16, 0.5, shells, [40, 260], 8), 40, false),
        (frame_at(17, 0.52, shells, [40, 260], 8), 40, true),
        (frame_of(Mode::Composite, true, 20, 0.5, shells, [48, 40], 8), 60, false),
        (turned(21, 0.5), 70, true),
        (turned(22, 0.51), 70, false),
        (frame_at(23, 0.5, "builtin:cloud@32", [61, 75], 8), 20, false),
        (turned(31, 0.5), 50, false),
        (turned(32, 0.51), 70, true),
        (turned(33, 0.51), 70, false),
        (frame_at(34, 0.5, "builtin:cloud@32", [40, 260], 8), 30, true),
        // Behind it are those that are written no more.
    ]) {
        let path = path(name);
        let settings = blocks::Settings { is_split, ..blocks::Settings::of(quality) };
        if !path.exists() {
            let before = before.and(references.newest()).cloned();
            let (encoded, _) = blocks::encode(&frame, &settings, before.as_deref()).unwrap();
            iglf::write(&path, &encoded, &Origin::default()).unwrap();
        }
        references.insert(read_with(name, &references).unwrap().1);
    }
}
