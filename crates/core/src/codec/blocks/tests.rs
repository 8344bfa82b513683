use glam::Vec3;

use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::codec::{assemble, decode, decode_chunk};
use crate::ids::{FrameId, LookVersion, PoseId};
use crate::kernels::layering::{Layering, generate};
use crate::kernels::march::{MarchSettings, Scene};
use crate::space::Aabb;
use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use crate::volume::procedural::Builtin;

fn scene(builtin: Builtin) -> Scene {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "soft".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Radius(1.0),
        points: vec![
            p(0.1, [0.2, 0.3, 0.8], 0.0),
            p(0.5, [0.9, 0.6, 0.3], 0.9),
            p(1.0, [1.0, 0.9, 0.7], 0.999),
        ],
    };
    Scene::new(builtin.volume(48).into(), &transfer, MarchSettings::default())
}

fn header(frame: u32, width: u32, height: u32, degrees: f32) -> FrameHeader {
    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
    let intrinsics = Intrinsics { width, height, fov_y: 0.6 };
    let pose =
        Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.3, bounds.radius() * intrinsics.fit_distance());
    let camera = Camera::new(pose, intrinsics, &bounds);
    FrameHeader { frame: FrameId(frame), pose: PoseId(8), look: LookVersion(9), camera, k: 12 }
}

fn bytes(encoded: &EncodedFrame) -> Vec<&[u8]> {
    encoded.chunks.iter().map(|c| &c.bytes[..]).collect()
}

const ALL: [Builtin; 3] = [Builtin::Cubus, Builtin::Cloud, Builtin::Shells];

#[test]
fn what_decodes_is_what_the_encoder_worked_with() {
    for builtin in ALL {
        let scene = scene(builtin);
        let make = |id, degrees| generate(&scene, header(id, 148, 93, degrees), Layering::VisibilityMerge);
        for quality in [0, 55, 100] {
            let mut references = References::default();
            let mut last: Option<EncodedBlocks> = None;
            for id in 1..4 {
                let frame = make(id, id as f32);
                let reference = last.as_ref().map(|l| if id == 2 { &*l.complete } else { &*l.base });
                let encoded = encode(&frame, quality, reference).unwrap();
                let assembly = assemble(&bytes(&encoded.frame), &references).unwrap();
                let (found, reference) = assembly.to_frame_and_reference();
                found.validate().unwrap();
                assert_eq!(reference.unwrap(), encoded.complete);
                assert_eq!(found, encoded.complete.to_frame());
                let base = encoded.frame.chunks.iter().filter(|c| c.is_base);
                let mut assembly = crate::codec::Assembly::new(&crate::codec::peek(&encoded.frame.chunks[0].bytes).unwrap());
                base.for_each(|c| assembly.insert(decode_chunk(&c.bytes, &references).unwrap()).unwrap());
                assert!(assembly.base_complete() && !assembly.complete());
                let (found, reference) = assembly.to_frame_and_reference();
                found.validate().unwrap();
                assert_eq!(reference.unwrap(), encoded.base);
                println!("{builtin:?} {quality} {id}: {} bytes, {} segments of {}", encoded.frame.num_bytes(), found.num_segments(), frame.num_segments());
                references.insert(encoded.base.clone());
                references.insert(encoded.complete.clone());
                if id > 1 {
                    assert!(matches!(decode(&bytes(&encoded.frame)), Err(CodecError::Reference { .. })));
                }
                last = Some(encoded);
            }
        }
    }
}
