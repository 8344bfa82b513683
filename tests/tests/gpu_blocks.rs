//! Does a device decode a frame in blocks to the numbers of its twin? All of them: layers, cells, counts and
//! probabilities, of frames alone, predicted, at rest, after a zoom, and after hundreds of frames.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::device::{DevicePayload, WORDS_OF_STREAM};
use isinglass_core::codec::blocks::{Reference, References, Settings, encode};
use isinglass_core::codec::{EncodedFrame, decode_with};
use isinglass_core::ids::FrameId;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::FrameHeader;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_gpu::GpuReprojector;
use isinglass_gpu::blocks::{BlockDecoder, DeviceFrame, Room};
use isinglass_tests::twins::{Difference, gpu};

// lavapipe ends all loops of a kernel after 65535 turns together. So frames are small here, and qualities moderate.
const ROOM: Room = Room { layers: 1 << 16, cells: 1 << 20 };

fn scene(builtin: Builtin) -> Scene {
    let point = |x, opacity| ControlPoint { x, color: [0.9, 0.7, 0.4], opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point(0.1, 0.0), point(0.4, 0.05), point(0.7, 0.4), point(1.0, 0.8)],
    };
    Scene::new(Arc::new(builtin.volume(48)), &transfer, MarchSettings::default())
}

/// Frame `id` of an orbit, at a distance of so many times that at which the volume fits.
fn header(scene: &Scene, id: u32, [width, height]: [u32; 2], degrees: f32, distance: f32) -> FrameHeader {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(width, height, 0.6);
    let distance = distance * bounds.radius() * intrinsics.fit_distance();
    let pose = Pose::orbit(bounds.center(), 0.4 + degrees.to_radians(), 0.3, distance);
    FrameHeader { frame: FrameId(id), ..FrameHeader::alone(Camera::new(pose, intrinsics, &bounds), 8) }
}

fn bytes(encoded: &EncodedFrame) -> Vec<&[u8]> {
    encoded.chunks.iter().map(|chunk| &chunk.bytes[..]).collect()
}

/// Whether a device has the numbers of a reference.
fn is_same(decoder: &BlockDecoder, on_device: &DeviceFrame, reference: &Reference) -> bool {
    let found = decoder.read(gpu().unwrap(), on_device).unwrap();
    assert_eq!(found.num_damaged, 0);
    found.words.sorted() == reference.words()
        && found.counts == reference.count_words()
        && found.probabilities == reference.probability_words()
}

#[test]
fn a_device_decodes_to_the_numbers_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    let decoder = BlockDecoder::new(gpu.device(), gpu.queue());
    for builtin in [Builtin::Shells, Builtin::Cloud] {
        let scene = scene(builtin);
        let mut before: Option<(Reference, DeviceFrame)> = None;
        // Turns, a rest, a zoom and a jump.
        let views = [(0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (2.0, 1.0), (2.5, 0.8), (30.0, 1.3)];
        for (id, (degrees, distance)) in (1..).zip(views) {
            let frame = generate(&scene, header(&scene, id, [200, 150], degrees, distance));
            let settings = Settings { max_bands: 1 + id as u8 % 2, ..Settings::of(20 + 6 * id as u8) };
            let (encoded, reference) = encode(&frame, &settings, before.as_ref().map(|(r, _)| r)).unwrap();
            let payload = DevicePayload::read(&bytes(&encoded)).unwrap();
            let on_device = decoder.decode(&payload, before.as_ref().map(|(_, d)| d), ROOM).unwrap();
            assert!(is_same(&decoder, &on_device, &reference), "{builtin:?} {id}");
            // Negative control: another frame's numbers.
            if let Some((other, _)) = &before {
                assert!(!is_same(&decoder, &on_device, other));
            }
            // A reference that was decoded in memory serves as well.
            let uploaded = decoder.upload(encoded.header, &reference).unwrap();
            before = Some((reference, if id % 3 == 0 { uploaded } else { on_device }));
        }
    }
}

#[test]
fn numbers_are_the_same_after_hundreds_of_predicted_frames() {
    let Some(gpu) = gpu() else { return };
    let decoder = BlockDecoder::new(gpu.device(), gpu.queue());
    let scene = scene(Builtin::Shells);
    let mut before: Option<(Arc<Reference>, DeviceFrame)> = None;
    let mut references = References::default();
    for id in 1..=301 {
        let frame = generate(&scene, header(&scene, id, [72, 64], 0.5 * id as f32, 1.0));
        let (encoded, _) = encode(&frame, &Settings::of(45), before.as_ref().map(|(r, _)| &**r)).unwrap();
        let (_, reference) = decode_with(&bytes(&encoded), &references, None).unwrap();
        let reference = reference.unwrap();
        references.insert(reference.clone());
        let payload = DevicePayload::read(&bytes(&encoded)).unwrap();
        let on_device = decoder.decode(&payload, before.as_ref().map(|(_, d)| d), ROOM).unwrap();
        if id % 50 == 1 {
            assert!(is_same(&decoder, &on_device, &reference), "{id}");
        }
        before = Some((reference, on_device));
    }
}

/// What the device makes of a frame's blocks is what memory makes, and uploads: the same picture from another pose.
#[test]
fn a_frame_that_stays_on_the_device_is_cast_as_one_that_is_uploaded() {
    let Some(gpu) = gpu() else { return };
    let decoder = BlockDecoder::new(gpu.device(), gpu.queue());
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    // Neither side is a multiple of a block.
    let size = [203, 149];
    let frame = generate(&scene, header(&scene, 1, size, 0.0, 1.0));
    let (encoded, reference) = encode(&frame, &Settings::of(45), None).unwrap();
    let payload = DevicePayload::read(&bytes(&encoded)).unwrap();
    let on_device = decoder.decode(&payload, None, ROOM).unwrap();
    let in_memory = reference.to_frame();
    let mut caster = GpuReprojector::new(gpu, &in_memory, &bounds).unwrap();
    for turn in [0.0, 6.0] {
        let camera = header(&scene, 1, size, turn, 1.0).camera;
        caster.set_frame(&in_memory, &bounds).unwrap();
        let expected = caster.raycast(&camera).unwrap();
        caster.set_blocks(&decoder, &on_device, &bounds).unwrap();
        let found = caster.raycast(&camera).unwrap();
        // C may be rounded otherwise where it lies half-way between two half floats.
        assert!(Difference::of(&found, &expected).is_tolerable(), "{turn}");
        // Negative control: another pose.
        let other = caster.raycast(&header(&scene, 1, size, turn + 1.0, 1.0).camera).unwrap();
        assert!(!Difference::of(&other, &expected).is_tolerable());
    }
}

/// Damaged bytes end, and are named as such; nothing outside of a frame is touched.
#[test]
fn damaged_bytes_end_and_are_told() {
    let Some(gpu) = gpu() else { return };
    let decoder = BlockDecoder::new(gpu.device(), gpu.queue());
    let scene = scene(Builtin::Shells);
    let frames =
        [0.0, 1.0].map(|turn| generate(&scene, header(&scene, 1 + turn as u32, [136, 80], turn, 1.0)));
    let (alone, reference) = encode(&frames[0], &Settings::of(50), None).unwrap();
    let (next, after) = encode(&frames[1], &Settings::of(50), Some(&reference)).unwrap();
    let before = decoder.upload(alone.header, &reference).unwrap();
    let sound = DevicePayload::read(&bytes(&next)).unwrap();
    let first_stream = WORDS_OF_STREAM * sound.num_streams;
    let mut seed = 7u64;
    let mut random = |n: usize| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as usize % n
    };
    let mut num_told = 0;
    for _ in 0..40 {
        let mut payload = sound.clone();
        for _ in 0..1 + random(4) {
            let at = first_stream + random(payload.words.len() - first_stream);
            payload.words[at] ^= 1 << random(32);
        }
        let found = decoder.read(gpu, &decoder.decode(&payload, Some(&before), ROOM).unwrap()).unwrap();
        num_told += usize::from(found.num_damaged > 0);
    }
    // A changed bit leaves the state off its end, but for one in 2^16.
    assert_eq!(num_told, 40);
    // Too little room is told as well, and what is sound still decodes.
    let small = decoder.decode(&sound, Some(&before), Room { layers: 20, cells: 500 }).unwrap();
    assert!(decoder.read(gpu, &small).unwrap().num_damaged > 0);
    assert!(is_same(&decoder, &decoder.decode(&sound, Some(&before), ROOM).unwrap(), &after));
}
