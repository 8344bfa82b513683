use std::sync::Arc;

use isinglass_core::camera::Pose;
use isinglass_core::layer::FrameHeader;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Lighting, Lit};
use isinglass_formats::preset;

use super::*;
use crate::frame_memory::FrameMemory;
use crate::generator::{FrameOrder, Wish};
use crate::paging::in_memory::paged;

fn occluded(opacity: f32) -> Look {
    let mut look = Look::new(preset("shells").unwrap());
    look.transfer.points.iter_mut().for_each(|point| point.opacity *= opacity);
    look.lighting = Lighting { ambient_occlusion: 1.0, ..Lighting::default() };
    look
}

fn thread(scene: &Scene, look: &Look, lights: Lights) -> RenderThread {
    RenderThread {
        pager: None,
        awaits_light: false,
        site: Site::default(),
        renderer: Renderer::on_cpu(scene.clone()),
        look: look.clone(),
        scene: SceneNumber::default(),
        lights,
        after_work: AfterWork::default(),
        company: Company::default(),
        counters: Counters::default(),
    }
}

/// A frame with more matter than the one before takes more of the memory while there is some, and only then becomes
/// smaller.
#[tokio::test]
async fn a_frame_stays_as_large_as_asked_while_there_is_memory() {
    let look = Look { shaded: false, ..Look::new(preset("shells").unwrap()) };
    let scene = Scene::new(Arc::new(Builtin::Shells.volume(24)), &look.transfer, look.march_settings());
    let bounds = scene.volume.bounds();
    let asked = Intrinsics::perspective(96, 64, 0.7);
    let pose = Pose::orbit(bounds.center(), 0.3, 0.2, 3.0 * bounds.radius());
    let made = |limit: u64| {
        let lights = Lights::new(&scene, &look, false);
        let (memory, mut thread) = (FrameMemory::new(limit), thread(&scene, &look, lights));
        let order = FrameOrder {
            rests: false,
            viewer: ViewerId(1),
            scene: SceneNumber::default(),
            look: look.clone(),
            near: None,
            header: FrameHeader::alone(Camera::new(pose, asked, &bounds), 8),
            wish: Wish::default(),
            held: memory.hold(bytes_of_making(500, asked.num_pixels()), 1),
        };
        let (reply, _answer) = oneshot::channel();
        let mut job = FrameJob { order, reply, begun: None, spent_micros: 0 };
        let frame = (0..1000).find_map(|_| thread.advance(&mut job, &|| true).unwrap()).unwrap().frame;
        (frame.header().camera.intrinsics, frame.num_segments())
    };
    let (size, num_segments) = made(1 << 30);
    assert_eq!(size, asked);
    assert!(num_segments > 1000, "{num_segments}");
    // The control: there is nothing more to have.
    let (size, few) = made(bytes_of_making(1000, asked.num_pixels()));
    assert!(size.num_pixels() < asked.num_pixels() && few <= 1000, "{size:?}, {few}");
}

/// Two viewers with different looks share the rendering thread. A draft of one shows the shade of its own last look, not
/// that of the other, whoever had the last turn.
#[tokio::test]
async fn a_draft_borrows_the_occlusion_of_its_own_viewer() {
    let (mine, other, edit) = (occluded(1.0), occluded(0.05), occluded(0.9));
    let volume = Arc::new(Builtin::Shells.volume(40));
    let scene = Scene::new(volume, &mine.transfer, mine.march_settings());
    let lights = Lights::new(&scene, &mine, false);
    let of_other = lights.scene(&other, None).await.unwrap();
    let mut thread = thread(&scene, &mine, lights);
    let number = SceneNumber::default();
    let near = scene.illumination.occlusion();
    let lit = |thread: &RenderThread| thread.renderer.scene().illumination.lit().unwrap().clone();
    let drafted = |near: Option<Occlusion>| -> Arc<Lit> {
        scene.under(&edit, Detail::Draft, near.as_ref()).illumination.lit().unwrap().clone()
    };
    let own = drafted(near.clone());
    let foreign = drafted(of_other.illumination.occlusion());
    assert!(own != foreign && own != drafted(None), "the control");
    for last in [&mine, &other] {
        thread.prepare(number, last, None, None).unwrap();
        thread.prepare(number, &edit, near.as_ref(), None).unwrap();
        assert!(!thread.is_final() && lit(&thread) == own, "after {}", last.transfer.points[1].opacity);
        // A viewer without an occlusion of its own gets none.
        thread.prepare(number, last, None, None).unwrap();
        thread.prepare(number, &edit, None, None).unwrap();
        assert!(lit(&thread) == drafted(None));
    }
}

/// Shading that is switched on lights no page on the rendering thread: frames are without light until it is there.
#[tokio::test]
async fn pages_without_light_are_lit_beside_the_frames() {
    let dark = Look { shaded: false, ..Look::new(preset("shells").unwrap()) };
    let bright = Look { shaded: true, ..dark.clone() };
    let volume = paged(Builtin::Shells.volume(140));
    let pager = Pager::of(&volume).unwrap().unwrap();
    let scene = Scene::of_look(Arc::new(volume), &dark);
    let lights = Lights::new(&scene, &dark, true);
    let mut thread = RenderThread { pager: Some(pager.clone()), ..thread(&scene, &dark, lights.clone()) };
    let bounds = scene.volume.bounds();
    let pose = Pose::orbit(bounds.center(), 0.3, 0.2, 3.0 * bounds.radius());
    let camera = Camera::new(pose, Intrinsics::perspective(16, 16, 0.7), &bounds);
    let view = PageView { camera, region: scene.region(), rests: true };
    let pages = pager.settled(ViewerId(1), &view, &scene, &|| true);
    let number = SceneNumber::default();
    thread.show(Some(&pages)).unwrap();
    assert!(thread.is_final(), "the control: without shading there is no light to wait for");
    let lit = |scene: &Scene| -> Vec<Option<Arc<Lit>>> {
        scene.pages.as_ref().unwrap().looks.iter().map(|look| look.lit().cloned()).collect()
    };
    let draw = |thread: &mut RenderThread| {
        thread.prepare(number, &bright, None, None).unwrap();
        thread.show(Some(&pages)).unwrap();
        thread.is_final()
    };
    assert!(!draw(&mut thread) && lit(thread.renderer.scene()).iter().all(Option::is_none));
    // The light comes in pieces, and frames stay as they are.
    let shown = lights.scene(&bright, None).await.unwrap();
    let (mut made, mut num_lit) = (Vec::new(), 0);
    loop {
        let next = lights.pages_to_light(&shown, &made);
        thread.light(&shown, &made).unwrap();
        assert!(!thread.is_final() && lit(thread.renderer.scene()).iter().all(Option::is_none));
        if next.is_empty() {
            break;
        }
        made = shown.light_pages(next);
        num_lit += made.len();
    }
    assert!(num_lit > 8, "{num_lit}");
    // Then they have the light that was made beside them.
    let beside = lit(&lights.with_pages(&shown, &pages.set));
    assert!(draw(&mut thread));
    let same = |(a, b): (&Option<Arc<Lit>>, &Option<Arc<Lit>>)| {
        a.as_ref().map(Arc::as_ptr) == b.as_ref().map(Arc::as_ptr)
    };
    assert!(lit(thread.renderer.scene()).iter().zip(&beside).all(same));
    assert!(beside.iter().flatten().count() > 8);
}

/// After the device turned out to have too little memory, a frame is planned again while plans can become smaller.
#[tokio::test]
async fn a_frame_is_planned_again_while_there_may_be_fewer_pages() {
    let look = Look { shaded: false, ..Look::new(preset("shells").unwrap()) };
    let volume = paged(Builtin::Shells.volume(40));
    let pager = Pager::of(&volume).unwrap().unwrap();
    let scene = Scene::of_look(Arc::new(volume), &look);
    let lights = Lights::new(&scene, &look, true);
    let thread = RenderThread { pager: Some(pager), ..thread(&scene, &look, lights) };
    let too_many = |most| GenerateError::Gpu(GpuError::Pages { most });
    let answers = [100, 100, 75, 75, 90].map(|most| thread.may_plan_fewer(&too_many(most)));
    assert_eq!(answers, [true, false, true, false, false]);
    assert!(!thread.may_plan_fewer(&GenerateError::Panicked), "the control");
}
