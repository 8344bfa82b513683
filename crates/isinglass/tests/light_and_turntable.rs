//! Do the flags of the light and of the turntable do what they say?

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use common::Bench;

const RENDER: &str = "--backend cpu --size 48x48";

#[test]
fn shade_changes_the_picture_and_strengths_of_zero_do_not() {
    let bench = Bench::new();
    let render = |file: &str, flags: &str| {
        bench.ok(&format!("render builtin:cubus@32 -o {file} {flags} {RENDER}"));
    };
    let error = |a: &str, b: &str| {
        let found = bench.json(&format!("compare {a} {b} --json"));
        found["max_abs_255"].as_u64().unwrap_or_default()
    };
    render("bare.png", "");
    render("off.png", "--ambient-occlusion 0 --shadows 0 --occlusion-radius 0.4 --softness 20");
    assert_eq!(error("bare.png", "off.png"), 0);
    for (file, flags) in [
        ("occlusion.png", "--ambient-occlusion 1"),
        ("shadows.png", "--shadows 1"),
        ("light.png", "--light 120,-20"),
        ("unshaded.png", "--shading off --shadows 1"),
        ("glossy.png", "--specular 0.6"),
        ("glossier.png", "--specular 0.6 --shininess 90"),
    ] {
        render(file, flags);
        assert!(error("bare.png", file) > 8, "{flags}");
    }
    assert!(error("glossy.png", "glossier.png") > 8, "the exponent counts");
    // Without strength the exponent does not count, and matter without shading has no highlights.
    for (file, flags, plain) in [
        ("dull.png", "--specular 0 --shininess 90", ""),
        ("flat.png", "--shading off --specular 0.6", "--shading off"),
    ] {
        render(file, flags);
        render("plain.png", plain);
        assert_eq!(error(file, "plain.png"), 0, "{flags}");
    }
    // A shaded frame in layers is the picture with the same shade.
    bench.ok(&format!("layers builtin:cubus@32 --ambient-occlusion 1 --shadows 1 -o a.iglf {RENDER}"));
    bench.ok("reproject a.iglf -o own.png --backend cpu");
    render("both.png", "--ambient-occlusion 1 --shadows 1");
    assert!(error("own.png", "both.png") <= 6, "the codec's rounding");
    assert!(error("own.png", "bare.png") > 8, "negative control");
}

/// Angles are those of the body, in each command, and a turntable goes round its own upright.
#[test]
fn a_body_is_seen_upright_by_each_command() {
    let bench = Bench::new();
    let voxels: Vec<u8> =
        (0..12 * 10 * 14).map(|i| if i % 12 < 5 && i / 120 > 8 { 200 } else { 90 }).collect();
    for (file, space) in
        [("body.nrrd", "space: right-anterior-superior\n"), ("bare.nrrd", "space dimension: 3\n")]
    {
        let header = format!(
            "NRRD0004\ntype: uint8\ndimension: 3\n{space}sizes: 12 10 14\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n\
             encoding: raw\n\n"
        );
        bench.write(file, [header.as_bytes(), &voxels].concat());
    }
    let error = |a: &str, b: &str| {
        bench.json(&format!("compare {a} {b} --json"))["max_abs_255"].as_u64().unwrap_or_default()
    };
    let tf = "--tf ct";
    bench.ok(&format!("render body.nrrd --orbit 20,10 -o body.png {tf} {RENDER}"));
    bench.ok(&format!("render bare.nrrd --orbit 20,10 -o bare.png {tf} {RENDER}"));
    assert!(error("body.png", "bare.png") > 8, "negative control");
    bench.ok(&format!("layers body.nrrd --orbit -30,0 -o a.iglf {tf} {RENDER}"));
    bench.ok("reproject a.iglf --orbit 20,10 -o novel.png --backend cpu");
    assert!(error("novel.png", "body.png") < error("novel.png", "bare.png"));
    bench.ok(&format!("render body.nrrd --orbit 20,10 --turntable 2 -o turn {tf} {RENDER}"));
    bench.ok(&format!("render body.nrrd --orbit 200,10 -o behind.png {tf} {RENDER}"));
    assert_eq!(error("turn/0001.png", "behind.png"), 0);
    assert_eq!(error("turn/0000.png", "body.png"), 0);
    // A shutter that closes where it opens sees no movement.
    bench.ok(&format!(
        "render body.nrrd --orbit 20,10 --shutter 20,10 --samples 2 -o still.png {tf} {RENDER}"
    ));
    assert!(error("still.png", "body.png") <= 1);
    bench
        .ok(&format!("render body.nrrd --orbit 20,10 --shutter 40,10 --samples 2 -o blur.png {tf} {RENDER}"));
    assert!(error("blur.png", "body.png") > 8, "negative control");
}

#[test]
fn a_turntable_is_so_many_pictures_and_each_is_that_of_render() {
    let bench = Bench::new();
    let turntable = "render builtin:cubus@32 --orbit 10,15 --turntable 4";
    bench.ok(&format!("{turntable} -o turn {RENDER}"));
    bench.ok(&format!("{turntable} -o turn/at-###-degrees.png {RENDER}"));
    let mut all = Vec::new();
    for (number, azimuth) in [10, 100, 190, 280].into_iter().enumerate() {
        bench.ok(&format!("render builtin:cubus@32 --orbit {azimuth},15 -o one.png {RENDER}"));
        for name in [format!("turn/{number:04}.png"), format!("turn/at-{number:03}-degrees.png")] {
            let same = bench.json(&format!("compare one.png {name} --json"));
            assert_eq!(same["max_abs_255"].as_u64(), Some(0), "{name}");
            all.push(name);
        }
    }
    let other = bench.json(&format!("compare {} {} --json", all[0], all[2]));
    assert!(other["max_abs_255"].as_u64() > Some(8), "negative control: {other}");
    // The same as a movie, whose first picture any reader of PNG files sees.
    bench.ok(&format!("{turntable} -o turn.apng {RENDER}"));
    let first = bench.json("compare turn.apng turn/0000.png --json");
    assert_eq!(first["max_abs_255"].as_u64(), Some(0));
    bench.ok(&format!("{turntable} -o turn.gif {RENDER}"));
    assert!(std::fs::read(bench.path("turn.gif")).unwrap().starts_with(b"GIF89a"));
    bench.write("path.txt", "0 10 15\n0.08 20 15\n");
    bench.ok(&format!("render builtin:cubus@32 --path path.txt -o along {RENDER}"));
    let same = bench.json("compare along/0000.png turn/0000.png --json");
    assert!(same["max_abs_255"].as_u64() <= Some(1) && bench.path("along/0002.png").exists(), "{same}");
    assert!(!bench.path("along/0003.png").exists());
    let both = "render builtin:cubus@32 --turntable 2 --path path.txt -o both";
    bench.fails(&format!("{both} {RENDER}"), 2, &["--turntable and --path"]);
    bench.fails(&format!("{turntable} -o one.webm {RENDER}"), 2, &["GIF or APNG", ".webm"]);
    // A folder is no file, and one picture is no turntable.
    bench.fails(&format!("render builtin:cubus@32 -o turn {RENDER}"), 2, &["found a folder"]);
    bench.fails(&format!("render builtin:cubus@32 --turntable 1 -o turn {RENDER}"), 2, &["turntable"]);
}

/// A NIfTI file of five times, each a brighter bar farther to the right.
fn film() -> Vec<u8> {
    let mut header = vec![0; 352];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    for (i, dim) in [4i16, 10, 10, 10, 5, 1, 1, 1].iter().enumerate() {
        put(40 + 2 * i, &dim.to_le_bytes());
    }
    put(70, &2i16.to_le_bytes());
    for i in 0..4 {
        put(76 + 4 * i, &1f32.to_le_bytes());
    }
    put(92, &500f32.to_le_bytes());
    put(108, &352f32.to_le_bytes());
    put(123, &[2 + 16]);
    put(344, b"n+1\0");
    let voxels = (0..5000).map(|i| if i % 10 == 2 * (i / 1000) { 50 * (1 + i / 1000) as u8 } else { 0 });
    header.into_iter().chain(voxels).collect()
}

#[test]
fn times_are_pictures_and_a_movie_under_the_look_of_the_first() {
    let bench = Bench::new();
    bench.write("film.nii", film());
    let info = &bench.json("info film.nii --json")["file"];
    assert_eq!((info["num_times"].as_u64(), info["time_step"].as_f64()), (Some(5), Some(0.5)), "{info}");
    let error = |a: &str, b: &str| {
        bench.json(&format!("compare {a} {b} --json"))["max_abs_255"].as_u64().unwrap_or_default()
    };
    let told = bench.json(&format!("render film.nii --times 1:5:2 -o some --json {RENDER}"));
    assert_eq!((told["pictures"].as_u64(), &told["times"]), (Some(2), &serde_json::json!([1, 3])));
    assert!(!bench.path("some/0000.png").exists() && !bench.path("some/0002.png").exists());
    bench.ok(&format!("render film.nii --time 1 -o one.png {RENDER}"));
    bench.ok(&format!("render film.nii --time 3 -o three.png {RENDER}"));
    assert_eq!(error("some/0001.png", "one.png"), 0);
    // Alone, the time has a look of its own values: it is as bright as any.
    assert!(error("some/0003.png", "three.png") > 8);
    bench.ok(&format!("render film.nii --times : -o all-##.png {RENDER}"));
    assert!((0..5).all(|i| bench.path(&format!("all-0{i}.png")).exists()));
    assert!(error("all-01.png", "all-03.png") > 8, "negative control");
    // A movie is of all times by itself, and at their speed.
    bench.ok(&format!("render film.nii -o film.apng {RENDER}"));
    assert_eq!(error("film.apng", "all-00.png"), 0);
    bench.ok(&format!("render film.nii --movie film.gif {RENDER}"));
    let gif = std::fs::read(bench.path("film.gif")).unwrap();
    let delay = |hundredths: u8| [0x21, 0xf9, 4, 4, hundredths, 0];
    let count = |hundredths| {
        gif.windows(6).filter(|w| w[..3] == [0x21, 0xf9, 4] && w[4..] == delay(hundredths)[4..]).count()
    };
    assert_eq!((count(50), count(4)), (5, 0));
    // Of one time it is a turn.
    bench.ok("render builtin:cubus@16 --orbit 10,15 -o turn.apng --backend cpu --size 16x16");
    let turn = std::fs::read(bench.path("turn.apng")).unwrap();
    let animation = turn.windows(8).find(|w| w[..4] == *b"acTL").unwrap();
    assert_eq!(u32::from_be_bytes(animation[4..].try_into().unwrap()), 100);
    for (range, words) in [
        ("0:6", "found 0:6, expected a part of 0:5"),
        ("5:", "found 5:5, expected a part of 0:5"),
        ("3:3", "is empty"),
        ("3", "A:B:STEP"),
        ("0:5:0", "is empty"),
        ("a:b", "A:B:STEP"),
    ] {
        let code = if words.starts_with("found") { 1 } else { 2 };
        bench.fails(&format!("render film.nii --times {range} -o bad {RENDER}"), code, &["--times", words]);
    }
    let both = "render film.nii --times : --turntable 3 -o both";
    bench.fails(&format!("{both} {RENDER}"), 2, &["--turntable and --times"]);
}
