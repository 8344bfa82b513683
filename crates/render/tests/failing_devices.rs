//! Without a driver, and with a device that goes away, there are errors and never a panic.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering;
use isinglass_core::kernels::layering::parts::{AskedFrame, OnProcessors, PartMarcher};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::kernels::part_rays::MarchedPart;
use isinglass_core::layer::FrameHeader;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{GHOSTS, Split, Volume};
use isinglass_gpu::{Gpu, GpuError, GpuRenderer, GpuReprojector};
use isinglass_render::{Backend, BackendChoice, Devices, GpuCount, PartRenderer};

#[test]
#[cfg(target_os = "linux")]
fn without_a_driver_auto_is_the_cpu() {
    const NO_DRIVER: &str = "ISINGLASS_TEST_NO_DRIVER";
    if std::env::var_os(NO_DRIVER).is_some() {
        assert!(matches!(Gpu::open(), Err(GpuError::NoAdapter(_))));
        assert!(matches!(Backend::open(BackendChoice::Auto), Ok(Backend::Cpu)));
        assert!(Backend::open(BackendChoice::Gpu).is_err());
        return;
    }
    // The loader reads its environment when it is loaded: this test again, in a process of its own.
    let status = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "without_a_driver_auto_is_the_cpu"])
        .envs([(NO_DRIVER, "1"), ("VK_DRIVER_FILES", "/nonexistent"), ("VK_ICD_FILENAMES", "/nonexistent")])
        .status();
    assert!(status.unwrap().success());
}

fn scene(volume: Volume) -> Scene {
    let point = ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.1 };
    let transfer = TransferFunction {
        name: "flat".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point],
    };
    Scene::new(Arc::new(volume), &transfer, Default::default())
}

fn camera() -> Camera {
    let intrinsics = Intrinsics::perspective(32, 32, 0.7);
    let pose = Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0);
    Camera::new(pose, intrinsics, &Builtin::Cloud.volume(16).bounds())
}

#[test]
fn a_part_on_a_lost_device_is_marched_on_the_cpu() {
    let Ok(gpu) = Gpu::open_in_turn(5) else {
        assert!(std::env::var_os("ISINGLASS_STRICT").is_none_or(|v| v != "1"), "no device");
        eprintln!("skipped: no device");
        return;
    };
    let volume = Builtin::Cloud.volume(32);
    let split = Split::evenly([32; 3], 2).unwrap();
    let scene = scene(volume.part(&split.held(1, GHOSTS)).unwrap());
    let part = MarchedPart { scene: &scene, split: &split, rank: 1 };
    let frame = AskedFrame::new(&scene, FrameHeader::alone(camera(), 4), 0.1);
    let rows: Vec<u32> = (0..32).collect();
    let view = View::from(&camera());
    let words = |marcher: &dyn PartMarcher| {
        let pieces = marcher.pieces(&part, &frame, &[&rows]);
        (pieces, marcher.steps(&part, &frame), marcher.seen(&part, &view, 0..32))
    };
    let marcher = PartRenderer::on(&Backend::Gpu(gpu.clone()));
    let (of_cpu, before) = (words(&OnProcessors), words(&marcher));
    assert!(marcher.description().starts_with("gpu: "), "{}", marcher.description());
    // The control: another device rounds otherwise.
    assert_ne!(before, of_cpu);
    gpu.device().destroy();
    assert_eq!(words(&marcher), of_cpu, "to the bit");
    assert_eq!(marcher.description(), "cpu");
    // Only the user chooses a software device.
    let chosen = PartRenderer::open(BackendChoice::Auto, 3).unwrap().description();
    assert_eq!(chosen.starts_with("gpu"), !gpu.info().is_software, "{chosen}");
    assert!(PartRenderer::open(BackendChoice::Gpu, 3).unwrap().description().starts_with("gpu"));
    assert_eq!(PartRenderer::open(BackendChoice::Cpu, 3).unwrap().description(), "cpu");
}

#[test]
fn a_lost_device_is_an_error() {
    let Ok(gpu) = Gpu::open() else {
        assert!(std::env::var_os("ISINGLASS_STRICT").is_none_or(|v| v != "1"), "no device");
        eprintln!("skipped: no device");
        return;
    };
    let (scene, camera) = (scene(Builtin::Cloud.volume(16)), camera());
    let bounds = scene.volume.bounds();
    let header = FrameHeader::alone(camera, 4);
    let frame = layering::generate(&scene, header);
    let mut renderer = GpuRenderer::new(&gpu, scene.clone()).unwrap();
    let mut reprojector = GpuReprojector::new(&gpu, &frame, &bounds).unwrap();
    assert!(renderer.render(&camera).is_ok());

    gpu.device().destroy();
    assert!(renderer.render(&camera).is_err());
    assert!(renderer.generate(header).is_err());
    assert!(reprojector.raycast(&camera).is_err());
    assert!(reprojector.set_frame(&frame, &bounds).is_err());
    let error = GpuRenderer::new(&gpu, scene).err().unwrap();
    assert!(matches!(error, GpuError::Lost { .. } | GpuError::Failed { .. }), "{error}");
    eprintln!("{error}");
}

#[test]
fn choices_go_by_their_names() {
    for choice in BackendChoice::ALL {
        assert_eq!(choice.to_string().parse(), Ok(choice));
    }
    assert!("vulkan".parse::<BackendChoice>().unwrap_err().contains("auto, gpu, cpu"));
    assert_eq!(Backend::open(BackendChoice::Cpu).unwrap().description(), "cpu");
}

#[test]
fn numbers_of_gpus_go_by_their_names() {
    for (text, count) in [
        ("all", GpuCount::All),
        ("one", GpuCount::Number(1)),
        ("1", GpuCount::Number(1)),
        ("3", GpuCount::Number(3)),
    ] {
        assert_eq!(text.parse(), Ok(count));
        assert_eq!(count.to_string().parse(), Ok(count));
    }
    for bad in ["", "0", "-1", "two", "65", "1.5"] {
        assert!(bad.parse::<GpuCount>().unwrap_err().contains("all, one, or 1 to 64"), "{bad}");
    }
    // The CPU is one place, and never several.
    let cpu = Devices::open(BackendChoice::Cpu, GpuCount::All).unwrap();
    assert_eq!((cpu.each().len(), cpu.description()), (1, "cpu".into()));
    let few = Devices::open(BackendChoice::Cpu, GpuCount::Number(2)).err().unwrap();
    assert!(few.to_string().contains("found 0") && few.to_string().contains("expected 2"), "{few}");
}

#[test]
fn a_software_device_opens_as_often_as_wanted_and_once_by_default() {
    let Ok(first) = Gpu::open() else {
        assert!(std::env::var_os("ISINGLASS_STRICT").is_none_or(|v| v != "1"), "no device");
        eprintln!("skipped: no device");
        return;
    };
    if !first.info().is_software {
        eprintln!("skipped: a device in hardware is there once");
        return;
    }
    let open = |gpus| Devices::open(BackendChoice::Gpu, gpus).unwrap();
    let two = open(GpuCount::Number(2));
    assert_eq!(two.each().len(), 2);
    assert!(two.description().starts_with("2 gpus: "), "{}", two.description());
    let [Backend::Gpu(one), Backend::Gpu(other)] = two.each() else { panic!("two GPUs") };
    one.device().destroy();
    assert!(!other.is_lost() && other.device() != one.device(), "each is a device of its own");
    // The controls: nobody asked for more than one, or for software at all.
    assert_eq!(open(GpuCount::All).each().len(), 1);
    assert_eq!(Devices::open(BackendChoice::Auto, GpuCount::All).unwrap().description(), "cpu");
    assert!(Devices::open(BackendChoice::Auto, GpuCount::Number(2)).is_err());
}
