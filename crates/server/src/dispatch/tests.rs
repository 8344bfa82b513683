use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::layer::FrameHeader;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::preset;

use super::*;
use crate::frame_memory::{FrameMemory, bytes_of_making};
use crate::generator::{FrameJob, FrameOrder, GenerateError, Generated, Wish};
use crate::paging::in_memory::paged;

/// A server's dispatch with the CPU as its only device.
fn dispatch() -> (Dispatch, Pager) {
    let volume = paged(Builtin::Shells.volume(24));
    let look = Look { shaded: false, ..Look::new(preset("shells").unwrap()) };
    let pager = Pager::of(&volume).unwrap().unwrap();
    let scene = Scene::of_look(Arc::new(volume), &look);
    let lights = Lights::new(&scene, &look, true);
    let number = SceneNumber::default();
    let shown = ShownScene { scene, look, number, lights, pager: Some(pager.clone()) };
    let devices = Backend::Cpu.into();
    let dispatch = Dispatch::start(&devices, shown, AfterWork::default(), Counters::default()).unwrap();
    (dispatch, pager)
}

/// A small frame for a viewer; `None` if no thread is left.
async fn frame(dispatch: &Dispatch, viewer: ViewerId) -> Option<Result<Generated, GenerateError>> {
    let shown = dispatch.0.state().shown.clone();
    let bounds = shown.scene.volume.bounds();
    let pose = Pose::orbit(bounds.center(), 0.3, 0.2, 3.0 * bounds.radius());
    let intrinsics = Intrinsics::perspective(16, 16, 0.7);
    let order = FrameOrder {
        rests: true,
        viewer,
        scene: shown.number,
        look: shown.look,
        near: None,
        header: FrameHeader::alone(Camera::new(pose, intrinsics, &bounds), 8),
        wish: Wish::default(),
        held: FrameMemory::new(1 << 30).hold(bytes_of_making(5000, intrinsics.num_pixels()), 1),
    };
    let (reply, answer) = oneshot::channel();
    let job = Job::Frame(Box::new(FrameJob { order, reply, begun: None, spent_micros: 0 }));
    let limit = Duration::from_secs(120);
    let working = tokio::time::timeout(limit, dispatch.send(viewer, job)).await.expect("no viewer hangs")?;
    let made = tokio::time::timeout(limit, answer).await.expect("no viewer hangs");
    drop(working);
    Some(made.unwrap_or(Err(GenerateError::Moved)))
}

fn panics(_: &Backend, _: Scene) -> Result<Renderer, GpuError> {
    panic!("a defect of a driver")
}

#[tokio::test]
async fn a_device_that_panics_while_it_gets_ready_leaves_its_viewers_to_others() {
    let (dispatch, _) = dispatch();
    let viewer = ViewerId(1);
    dispatch.enter(viewer);
    {
        let mut state = dispatch.0.state();
        let second =
            Slot { backend: Backend::Cpu, jobs: None, company: Company::default(), micros: Arc::default() };
        state.slots.push(second);
        state.placement = Placement::new(2);
        state.placement.set(0, Device::Ready);
        state.placement.set(1, Device::Busy);
    }
    let mut changed = dispatch.0.changed.subscribe();
    changed.borrow_and_update();
    assert!(dispatch.0.make_ready(1, panics), "the other one goes on");
    assert_eq!(dispatch.0.state().placement.state(1), Device::Lost);
    assert!(changed.has_changed().unwrap(), "who waits is told");
    assert!(frame(&dispatch, viewer).await.unwrap().is_ok());
    // The last one gets the CPU.
    {
        let mut state = dispatch.0.state();
        state.slots[0].jobs = None;
        state.placement.set(0, Device::Busy);
    }
    assert!(dispatch.0.make_ready(0, panics));
    assert_eq!(dispatch.0.state().placement.state(0), Device::Ready);
    assert!(frame(&dispatch, viewer).await.unwrap().is_ok());
    // The control: without a panic, a device is ready.
    dispatch.0.state().placement.set(1, Device::Busy);
    assert!(dispatch.0.make_ready(1, Backend::renderer));
    assert_eq!(dispatch.0.state().placement.state(1), Device::Ready);
    dispatch.stop().await;
}

#[tokio::test]
async fn a_thread_that_has_ended_starts_again_unless_the_server_ends() {
    let (dispatch, _) = dispatch();
    let viewer = ViewerId(1);
    dispatch.enter(viewer);
    assert!(frame(&dispatch, viewer).await.unwrap().is_ok());
    dispatch.tell_all(|reply| Job::Stop { reply }).await;
    assert!(frame(&dispatch, viewer).await.unwrap().is_ok(), "it runs again");
    dispatch.stop().await;
    assert!(frame(&dispatch, viewer).await.is_none());
}

#[tokio::test]
async fn a_viewer_that_leaves_while_its_frame_is_made_keeps_no_share() {
    let (dispatch, pager) = dispatch();
    let [stays, gone] = [1, 2].map(ViewerId);
    for viewer in [stays, gone] {
        dispatch.enter(viewer);
    }
    // A second session of the same viewer stays.
    dispatch.enter(stays);
    dispatch.forget(stays);
    dispatch.forget(gone);
    for viewer in [stays, gone] {
        assert!(frame(&dispatch, viewer).await.unwrap().is_ok(), "a last order is done");
    }
    let has_share = |viewer| pager.shown(viewer).is_some();
    let has_place = |viewer| dispatch.0.state().placement.device_of(viewer).is_some();
    assert!(has_share(stays) && has_place(stays), "the control");
    assert!(!has_share(gone) && !has_place(gone));
    dispatch.stop().await;
}
