use std::sync::atomic::{AtomicUsize, Ordering};

use isinglass_core::volume::Lighting;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;

use super::*;

fn look(opacity: f32) -> Look {
    let mut look = Look::new(load_transfer("shells").unwrap());
    look.transfer.points.iter_mut().for_each(|point| point.opacity *= opacity);
    look
}

fn lights(side: u32) -> (Scene, Lights) {
    let scene = Scene::of_look(Arc::new(Builtin::Shells.volume(side)), &look(1.0));
    let lights = Lights::new(&scene, &look(1.0), false);
    (scene, lights)
}

fn light(scene: &Scene) -> *const Lit {
    Arc::as_ptr(scene.illumination.lit().unwrap())
}

/// Whatever threads ask for a look, at whatever moment: it is computed once, and they share its arrays.
#[test]
fn threads_share_what_one_of_them_computes() {
    let (scene, lights) = lights(24);
    let num_computed = AtomicUsize::new(0);
    let scene_of = |look: &Look| {
        let from = || {
            num_computed.fetch_add(1, Ordering::SeqCst);
            std::thread::sleep(std::time::Duration::from_millis(20));
            scene.clone()
        };
        lights.clone().known_without_shade(look, from).unwrap()
    };
    let of_threads = |opacity: f32| -> Vec<Scene> {
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(|| scene_of(&look(opacity)))).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        })
    };
    let alike = of_threads(0.5);
    assert_eq!(num_computed.load(Ordering::SeqCst), 1);
    let words = |scene: &Scene| scene.occupancy.words.as_ptr();
    assert!(alike.iter().all(|other| light(other) == light(&alike[0]) && words(other) == words(&alike[0])));
    // The control: another look is computed, but its gradients are those of the volume.
    let others = of_threads(0.25);
    assert_eq!(num_computed.load(Ordering::SeqCst), 2);
    assert!(words(&others[0]) != words(&alike[0]) && light(&others[0]) == light(&alike[0]));
    // A look with shade is computed beside the frames, so no thread waits for it here.
    let shaded = Lighting { ambient_occlusion: 1.0, ..Lighting::default() };
    assert!(lights.known_without_shade(&Look { lighting: shaded, ..look(1.0) }, || scene.clone()).is_none());
}

/// Many looks in use at once are all remembered while they take little memory, and few while they take much.
#[test]
fn looks_are_remembered_within_their_memory() {
    let (scene, lights) = lights(24);
    let looks: Vec<Look> = (1..=16).map(|n| look(n as f32 / 20.0)).collect();
    for look in &looks {
        lights.known_without_shade(look, || scene.clone()).unwrap();
    }
    assert!(looks.iter().all(|look| lights.known(look).is_some()));
    let scenes = lights.scenes().clone();
    assert!(bytes_of(&scenes) <= MAX_BYTES);
    // What scenes share counts once.
    let one = bytes_of(&scenes[..1]) - TABLE_BYTES;
    assert!(bytes_of(&scenes) < one + 17 * (TABLE_BYTES + 1024), "{one}");
    // The control: with light of its own, each look takes a byte per voxel, and the oldest go.
    let volume = Arc::new(Builtin::Shells.volume(24));
    let mut known = Vec::new();
    for look in &looks {
        let mut own = Scene::of_look(volume.clone(), look);
        own.occupancy.peaks = vec![0; MAX_BYTES / 16].into();
        remember(&mut known, look.clone(), own);
    }
    assert!((MIN_KNOWN..5).contains(&known.len()), "{}", known.len());
    assert!(known.last().unwrap().0 == looks[15]);
}
