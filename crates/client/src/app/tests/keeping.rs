//! The light, the value under the pointer, and pictures to keep.

use isinglass_core::volume::Lighting;

use super::*;
use crate::panels::light::usual_lighting;

/// Runs until what is being made is on the disk: files are written on a thread.
fn finish(w: &mut Harness<'_, ViewerApp<HereSource>>) {
    let patience = std::time::Instant::now() + Duration::from_secs(60);
    while w.state().screenshots.is_busy() {
        assert!(std::time::Instant::now() < patience, "the picture never was on the disk");
        w.run_steps(1);
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A folder of its own, gone at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("isinglass-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    fn files(&self) -> Vec<(String, Vec<u8>)> {
        let mut found = Vec::new();
        let mut folders = vec![self.0.clone()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    let name = path.file_name().unwrap().to_string_lossy().into_owned();
                    found.push((name, std::fs::read(path).unwrap()));
                }
            }
        }
        found.sort();
        found
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The file of what the window shows.
fn expected(w: &Harness<'_, ViewerApp<HereSource>>, pose: Pose, (width, height): (u32, u32)) -> Vec<u8> {
    let app = w.state();
    let here = app.viewing.source().here();
    let scene = &here.scene;
    let intrinsics = Intrinsics::perspective(width, height, app.options.fov_y);
    let camera = Camera::new(pose, intrinsics, &scene.volume.bounds());
    let rgb = render(scene, &camera).to_srgb8(app.aids.linear_background());
    isinglass_formats::png::encode(width, height, &rgb).unwrap()
}

/// The size of the picture, pixels.
fn size(w: &Harness<'_, ViewerApp<HereSource>>) -> (u32, u32) {
    let window = w.state().window.unwrap();
    (window.width, window.height)
}

#[test]
fn f12_saves_the_picture_of_the_view_and_says_where() {
    let folder = Folder::new("f12");
    let mut w = window([320.0, 240.0]);
    w.state_mut().screenshots.folder = folder.0.display().to_string();
    w.state_mut().aids.background = [40, 80, 120];
    press(&mut w, Modifiers::NONE, Key::F12);
    finish(&mut w);
    let files = folder.files();
    let [(name, bytes)] = &files[..] else { panic!("{} files", files.len()) };
    assert!(name.contains("shells") && name.ends_with(".png"), "{name}");
    assert!(*bytes == expected(&w, pose(&w), size(&w)), "another picture");
    w.run_steps(2);
    assert!(w.query_by_label_contains(name).is_some(), "the path is shown");
    // Negative control: another view, another picture.
    drag(&mut w, egui::pos2(150.0, 150.0), vec2(30.0, 0.0), Modifiers::NONE);
    press(&mut w, Modifiers::NONE, Key::F12);
    finish(&mut w);
    let files = folder.files();
    assert!(files.len() == 2 && files[0].1 != files[1].1);
}

#[test]
fn a_turntable_is_as_many_pictures_as_asked_for_and_can_be_given_up() {
    let folder = Folder::new("turntable");
    let mut w = window([640.0, 480.0]);
    w.state_mut().screenshots.folder = folder.0.display().to_string();
    press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
    assert_eq!(w.unnamed_widgets(), Vec::<String>::new());
    for (name, value) in [("width", "40"), ("height", "30"), ("pictures", "5")] {
        w.state_mut().screenshots.set_for_test(name, value.parse().unwrap());
    }
    w.run_steps(2);
    w.get_by_label("Make the turntable").click();
    w.run_steps(2);
    finish(&mut w);
    let files = folder.files();
    let names: Vec<_> = files.iter().map(|(name, _)| &name[..]).collect();
    assert_eq!(names, ["0000.png", "0001.png", "0002.png", "0003.png", "0004.png"]);
    assert!(files[0].1 == expected(&w, pose(&w), (40, 30)), "the first is the window's view");
    let center = w.state().controls.as_ref().unwrap().1.center();
    let turn = glam::Quat::from_rotation_y(std::f32::consts::TAU * 2.0 / 5.0);
    let first = pose(&w);
    let third = Pose {
        eye: center + turn * (first.eye - center),
        world_from_view: (turn * first.world_from_view).normalize(),
    };
    assert!(files[2].1 == expected(&w, third, (40, 30)), "turned about the vertical");
    // A server that takes its time: the window goes on, and the rest is given up.
    w.state().viewing.source().here().sleeps = true;
    press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
    w.get_by_label("Make the turntable").click();
    w.run_steps(4);
    assert!(w.query_by_label_contains("picture 1 of 5").is_some());
    let before = pose(&w);
    drag(&mut w, egui::pos2(100.0, 400.0), vec2(50.0, 0.0), Modifiers::NONE);
    assert_ne!(pose(&w), before, "a drag goes on meanwhile");
    w.get_by_label("Cancel").click();
    w.run_steps(4);
    assert!(!w.state().screenshots.is_busy());
    assert_eq!(w.state().viewing.source().here().num_cancelled, 1);
    assert_eq!(folder.files().len(), 5);
}

#[test]
fn the_probe_shows_the_voxel_under_the_pointer() {
    let mut w = window([640.0, 480.0]);
    let at = egui::pos2(330.0, 235.0);
    w.event(Event::PointerMoved(at));
    rest(&mut w);
    assert!(w.query_by_label_contains("voxel ").is_none(), "off at first");
    assert_eq!(w.state().viewing.source().here().num_probes, 0);
    press(&mut w, Modifiers::NONE, Key::P);
    let found = w.state().viewing.source().talk().probe.answer().unwrap().voxel.unwrap();
    let [x, y, z] = found.index.map(|i| i as i32);
    {
        let here = w.state().viewing.source().here();
        assert_eq!(here.num_probes, 1, "a pointer that rests asks once");
        let volume = &here.scene.volume;
        assert_eq!(found.value, volume.value_from_stored(volume.stored_at(x, y, z)));
    }
    assert!(w.query_by_label_contains(&format!("voxel {x}, {y}, {z}")).is_some());
    assert!(w.query_by_label(&format!("{}", found.value)).is_some());
    // A dialog that a key opens takes its place at once.
    for (modifiers, key) in [(Modifiers::NONE, Key::H), (Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S)] {
        w.key_press_modifiers(modifiers, key);
        w.run_steps(1);
        assert!(w.query_by_label_contains("voxel ").is_none(), "{key:?}");
        w.key_press_modifiers(modifiers, key);
        rest(&mut w);
        assert!(w.query_by_label_contains("voxel ").is_some(), "{key:?}");
    }
    // Beside the volume nothing is under the pointer.
    w.event(Event::PointerMoved(egui::pos2(30.0, 440.0)));
    rest(&mut w);
    assert!(w.query_by_label_contains("voxel ").is_none());
    press(&mut w, Modifiers::NONE, Key::P);
    w.event(Event::PointerMoved(at));
    rest(&mut w);
    assert!(w.query_by_label_contains("voxel ").is_none(), "off again");
}

#[test]
fn the_light_can_be_moved_in_the_picture_and_shade_changes_it() {
    let mut w = window([1280.0, 720.0]);
    open_panel(&mut w);
    let before = picture(&w);
    let button = |pos, pressed| Event::PointerButton {
        pos,
        button: PointerButton::Secondary,
        pressed,
        modifiers: Modifiers::COMMAND,
    };
    let (from, to) = (egui::pos2(500.0, 400.0), egui::pos2(700.0, 380.0));
    let camera = pose(&w);
    w.event(Event::PointerMoved(from));
    w.event(button(from, true));
    w.event(Event::PointerMoved(to));
    w.event(button(to, false));
    rest(&mut w);
    let lighting = w.state().viewing.source().here().look.1.lighting;
    assert_ne!(lighting, Lighting::default());
    assert_eq!(pose(&w), camera, "the camera stays");
    let moved = picture(&w);
    assert_ne!(moved, before);
    w.get_by_label("Light").scroll_to_me();
    rest(&mut w);
    w.get_by_label("Light").click();
    rest(&mut w);
    w.get_by_label("reset the light").scroll_to_me();
    rest(&mut w);
    w.get_by_label("reset the light").click();
    rest(&mut w);
    assert_eq!(w.state().viewing.source().here().look.1.lighting, usual_lighting());
    let before = picture(&w);
    // The ball, and the slider of the shadows.
    let ball = w.get_by_label("light direction").rect().center();
    drag(&mut w, ball, vec2(20.0, 0.0), Modifiers::NONE);
    assert_ne!(w.state().viewing.source().here().look.1.lighting, usual_lighting());
    let slider = w.get_by_role_and_label(egui::Role::Slider, "shadows").rect();
    drag(&mut w, slider.left_center() + vec2(4.0, 0.0), vec2(60.0, 0.0), Modifiers::NONE);
    assert!(w.state().viewing.source().here().look.1.lighting.shadows > 0.3);
    assert_ne!(picture(&w), before);
}

#[test]
fn a_picture_can_be_transparent_and_have_scale_and_legend() {
    let folder = Folder::new("marks");
    let mut w = window([900.0, 600.0]);
    w.state_mut().screenshots.folder = folder.0.display().to_string();
    press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
    w.get_by_label("transparent").click();
    rest(&mut w);
    let mut pixels = Vec::new();
    for has_marks in [false, true] {
        if has_marks {
            press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
            w.get_by_label("scale bar").click();
            w.get_by_label("colour legend").click();
            rest(&mut w);
        }
        w.get_by_label("Take the picture").click();
        w.step();
        finish(&mut w);
        let (_, png) = folder.files().pop().unwrap();
        pixels.push(isinglass_formats::png::decode_rgba(&png, 1 << 22).unwrap().1);
        std::fs::remove_dir_all(&folder.0).unwrap();
    }
    let opacity = |pixels: &[u8], is: fn(u8) -> bool| pixels.chunks(4).filter(|p| is(p[3])).count();
    assert!(opacity(&pixels[0], |a| a == 0) > 1000 && opacity(&pixels[0], |a| a > 100) > 1000);
    let differ = pixels[0].chunks(4).zip(pixels[1].chunks(4)).filter(|(a, b)| a != b).count();
    assert!((500..60_000).contains(&differ), "{differ} pixels of bar and legend");
    std::fs::create_dir_all(&folder.0).unwrap();
}

#[test]
fn a_turntable_can_be_a_movie_and_a_cancelled_one_leaves_nothing() {
    let folder = Folder::new("movie");
    let mut w = window([320.0, 240.0]);
    w.state_mut().screenshots.folder = folder.0.display().to_string();
    for (form, begins) in [("GIF", &b"GIF89a"[..]), ("APNG", b"\x89PNG\r\n\x1a\n")] {
        w.state_mut().screenshots.set_for_test("width", 40);
        w.state_mut().screenshots.set_for_test("height", 30);
        w.state_mut().screenshots.set_for_test("pictures", 4);
        press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
        w.get_by_label(form).click();
        rest(&mut w);
        w.get_by_label("Make the turntable").click();
        w.step();
        finish(&mut w);
        let files = folder.files();
        let [(name, bytes)] = &files[..] else { panic!("one file: {}", files.len()) };
        assert!(name.ends_with(&form.to_lowercase()) && bytes.starts_with(begins), "{name}");
        assert!(w.state().notice().contains(name.as_str()), "{}", w.state().notice());
        std::fs::remove_file(folder.0.join(name)).unwrap();
    }
    // Stopped after the first picture.
    press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
    w.get_by_label("Make the turntable").click();
    w.run_steps(2);
    w.state().viewing.source().here().sleeps = true;
    for _ in 0..100 {
        w.step();
        std::thread::sleep(Duration::from_millis(1));
    }
    w.get_by_label("Cancel").click();
    rest(&mut w);
    assert!(folder.files().is_empty(), "{:?}", folder.files().len());
    assert!(w.state().notice().contains("No movie"), "{}", w.state().notice());
}

#[test]
fn a_recorded_path_becomes_pictures_along_it_and_a_file() {
    let folder = Folder::new("path");
    let mut w = window([640.0, 480.0]);
    w.state_mut().screenshots.folder = folder.0.display().to_string();
    let record = |w: &mut Harness<'_, ViewerApp<HereSource>>| press(w, Modifiers::COMMAND, Key::R);
    record(&mut w);
    assert!(w.query_by_label_contains("recording, ").is_some());
    w.get_by_label("Stop").click();
    rest(&mut w);
    assert!(w.state().notice().contains("did not move") && !w.state().screenshots.has_path());
    // It begins and ends with the movement, not with the rests around it.
    rest(&mut w);
    let first = pose(&w);
    record(&mut w);
    for by in [vec2(120.0, 0.0), vec2(0.0, 60.0)] {
        drag(&mut w, egui::pos2(260.0, 240.0), by, Modifiers::NONE);
    }
    let last = pose(&w);
    record(&mut w);
    for (name, value) in [("width", 40), ("height", 30)] {
        w.state_mut().screenshots.set_for_test(name, value);
    }
    rest(&mut w);
    assert_eq!(w.unnamed_widgets(), Vec::<String>::new());
    w.get_by_label("files").click();
    rest(&mut w);
    w.get_by_label("Save the path").click();
    rest(&mut w);
    w.get_by_label("Take the pictures").click();
    w.run_steps(2);
    finish(&mut w);
    let mut files = folder.files();
    let (name, text) = files.remove(files.iter().position(|(name, _)| name.ends_with(".txt")).unwrap());
    assert!(name.contains("-path"), "{name}");
    let path = crate::CameraPath::parse(std::str::from_utf8(&text).unwrap()).unwrap();
    let expected_num = (path.duration().as_secs_f32() * 25.0).ceil() as usize + 1;
    assert!(files.len() == expected_num && files.len() > 3, "{} of {expected_num}", files.len());
    assert!(files[0].1 == expected(&w, first, (40, 30)), "it begins where the camera was");
    let end = isinglass_formats::png::decode(&files[files.len() - 1].1, 1 << 20).unwrap();
    let of_last = isinglass_formats::png::decode(&expected(&w, last, (40, 30)), 1 << 20).unwrap();
    let apart = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
    let of_first = isinglass_formats::png::decode(&files[0].1, 1 << 20).unwrap();
    // Its own place is rounded.
    assert!(apart(&end.bytes, &of_last.bytes) * 4 < apart(&of_first.bytes, &of_last.bytes));
    // The menu asks for it again, as a movie.
    w.get_by_label("Picture").click();
    rest(&mut w);
    w.get_by_label("Movie of the path…").click();
    rest(&mut w);
    w.get_by_label("GIF").click();
    rest(&mut w);
    w.get_by_label("Make the movie").click();
    w.run_steps(2);
    finish(&mut w);
    assert!(folder.files().iter().any(|(name, _)| name.ends_with("-path.gif")));
}
