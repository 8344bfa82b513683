use std::sync::Arc;

use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Lighting, Lit};
use isinglass_formats::preset;

use super::*;

fn occluded(opacity: f32) -> Look {
    let mut look = Look::new(preset("shells").unwrap());
    look.transfer.points.iter_mut().for_each(|point| point.opacity *= opacity);
    look.lighting = Lighting { ambient_occlusion: 1.0, ..Lighting::default() };
    look
}

/// Two viewers with different looks share the rendering thread. A draft of one shows the shade of its own last look, not
/// that of the other, whoever had the last turn.
#[tokio::test]
async fn a_draft_borrows_the_occlusion_of_its_own_viewer() {
    let (mine, other, edit) = (occluded(1.0), occluded(0.05), occluded(0.9));
    let volume = Arc::new(Builtin::Shells.volume(40));
    let scene = Scene::new(volume, &mine.transfer, mine.march_settings());
    let lights = Lights::new(&scene, &mine);
    let of_other = lights.scene(&other).await.unwrap();
    let mut thread = RenderThread {
        renderer: Renderer::on_cpu(scene.clone()),
        look: mine.clone(),
        scene: SceneNumber::default(),
        lights,
        after_work: AfterWork::default(),
    };
    let number = SceneNumber::default();
    let near = scene.illumination.occlusion();
    let lit = |thread: &RenderThread| thread.renderer.scene().illumination.lit().unwrap().clone();
    let draft = MarchSettings { detail: Detail::Draft, ..edit.march_settings() };
    let drafted = |near: Option<Occlusion>| -> Arc<Lit> {
        scene.with_look_near(&edit.transfer, draft, near.as_ref()).illumination.lit().unwrap().clone()
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
