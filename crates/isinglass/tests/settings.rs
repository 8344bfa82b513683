//! Does each source of settings hold over the one before, and is every mistake told where it stands?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::collections::BTreeMap;

use common::{Bench, assert_failed};

/// `section.key` with value and origin, as `--print-config` prints them.
fn printed(text: &str) -> BTreeMap<String, (String, String)> {
    let mut section = String::new();
    let mut found = BTreeMap::new();
    for line in text.lines() {
        if let Some(name) = line.strip_prefix('[').and_then(|l| l.strip_suffix(']')) {
            section = name.to_owned();
        } else if !line.starts_with('#')
            && let Some((key, rest)) = line.split_once(" = ")
        {
            let (value, origin) = rest.rsplit_once("  # ").unwrap();
            found.insert(format!("{section}.{key}"), (value.to_owned(), origin.to_owned()));
        }
    }
    found
}

fn folders(bench: &Bench) {
    for folder in ["etc", "home", "home/isinglass"] {
        std::fs::create_dir(bench.path(folder)).unwrap();
    }
}

#[test]
fn each_source_holds_over_the_one_before() {
    let bench = Bench::new();
    folders(&bench);
    let file = |name: &str, k: u32| {
        bench.write(name, format!("[look]\n# a comment\nk = {k}\n[network]\nviewers = {k}\n"));
    };
    // Each step adds a source; what was there before stays and is overruled.
    let mut line = "serve --print-config".to_owned();
    let mut variable = None;
    for (step, value, origin) in [
        ("nothing", "8", "default"),
        ("system", "2", "etc/server.toml:3"),
        ("user", "3", "home/isinglass/server.toml:3"),
        ("file", "4", "given.toml:3"),
        ("environment", "5", "ISINGLASS_LOOK_K"),
        ("flag", "6", "flag"),
    ] {
        match step {
            "system" => file("etc/server.toml", 2),
            "user" => file("home/isinglass/server.toml", 3),
            "file" => {
                file("given.toml", 4);
                line += " --config given.toml";
            }
            "environment" => variable = Some("5"),
            "flag" => line += " --k 6",
            _ => {}
        }
        let mut command = bench.command(&line);
        if let Some(k) = variable {
            command.env("ISINGLASS_LOOK_K", k);
        }
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let held = printed(&String::from_utf8(output.stdout).unwrap());
        let (found, from) = &held["look.k"];
        assert_eq!(found, value, "{step}");
        assert!(from.ends_with(origin), "{step}: {from}");
        // Control: a neighbour that only the files set follows them and nothing later.
        let viewers = match step {
            "nothing" => "1",
            "system" => "2",
            "user" => "3",
            _ => "4",
        };
        assert_eq!(held["network.viewers"].0, viewers, "{step}");
        assert_eq!(held["coding.codec"], ("\"auto\"".into(), "default".into()));
        // What a viewer has is none of the server's.
        assert!(!held.contains_key("window.size"));
    }
}

#[test]
fn what_is_printed_is_a_file_of_settings() {
    let bench = Bench::new();
    folders(&bench);
    bench.write(
        "home/isinglass/viewer.toml",
        "[window]\nsize = \"640x480\"\nbox = true\nbackground = \"#102030\"\n[picture]\nstereo = \"red-cyan\"\n\
         [bindings]\norbit = [\"right drag\"]\nzoom = \"left drag\"\nreverse-wheel = true\nnumbers = []\n",
    );
    bench.write("etc/server.toml", "[look]\ntf = \"ct\"\nshading = false\n");
    for command in ["serve", "view", "demo"] {
        let first = bench.ok(&format!("{command} --print-config"));
        let held = printed(&first);
        if command != "serve" {
            for (key, value) in [
                ("window.size", "\"640x480\""),
                ("window.box", "\"on\""),
                ("window.background", "\"#102030\""),
                ("picture.stereo", "\"red-cyan\""),
                ("bindings.orbit", "[\"right drag\"]"),
                ("bindings.zoom", "[\"left drag\"]"),
                ("bindings.reverse-wheel", "true"),
                ("bindings.numbers", "[]"),
            ] {
                assert_eq!(held[key].0, value, "{command} {key}");
                assert!(held[key].1.contains("viewer.toml:"), "{command} {key}: {}", held[key].1);
            }
            assert_eq!(held["bindings.quit"].1, "default");
        }
        if command != "view" {
            assert_eq!(
                (&held["look.tf"].0[..], &held["look.shading"].0[..]),
                ("\"ct\"", "\"off\""),
                "{command}"
            );
        }
        bench.write("again.toml", &first);
        let again = printed(&bench.ok(&format!("{command} --print-config --config again.toml")));
        let values = |held: &BTreeMap<String, (String, String)>| {
            held.iter().map(|(key, (value, _))| (key.clone(), value.clone())).collect::<Vec<_>>()
        };
        assert_eq!(values(&held), values(&again), "{command}");
        assert!(again.values().all(|(_, origin)| origin.contains("again.toml:")), "{again:?}");
    }
}

#[test]
fn settings_are_obeyed_and_flags_are_obeyed_more() {
    let bench = Bench::new();
    folders(&bench);
    // A transfer function that is not there is found missing, so it was asked for.
    bench.write("home/isinglass/server.toml", "[look]\ntf = \"absent.toml\"\n");
    let failed = bench.run("serve builtin:shells@16");
    assert_failed("serve", &failed, 1, &["absent.toml"]);
    let failed = bench.run("serve builtin:shells@16 --tf other.toml");
    assert_failed("serve", &failed, 1, &["other.toml"]);
    // Commands that compute have no settings: not even broken ones trouble them.
    bench.write("home/isinglass/server.toml", "[look\n");
    bench.ok("render builtin:shells@16 --size 16x16 --backend cpu -o a.png");
    assert_failed("serve", &bench.run("serve builtin:shells@16"), 1, &["server.toml", "line 1"]);
}

#[test]
fn mistakes_are_one_line_that_names_file_line_and_key() {
    let bench = Bench::new();
    folders(&bench);
    for (text, words) in [
        ("[look]\nk = 99", &["bad.toml:2: look.k", "found \"99\"", "expected 1 to 32"][..]),
        ("[look]\n\ncolour = 1", &["bad.toml:3: found look.colour", "look.{tf, shading, ambient_occlusion"]),
        ("[loook]\nk = 1", &["bad.toml:2: found loook.k", "one of the sections network"]),
        ("k = 1", &["bad.toml: line 1", "outside of a section"]),
        ("[coding]\ncodec = \"best\"", &["bad.toml:2: coding.codec", "expected one of auto, exact, blocks"]),
        ("[look]\nshading = \"maybe\"", &["look.shading", "expected one of on, off"]),
        ("[look]\nk = [1, 2]", &["look.k: found a list"]),
        ("[network]\nviewers = 1000", &["network.viewers", "found \"1000\""]),
        ("[window]\nsize = \"0x5\"", &["bad.toml:2: window.size", "expected WxH"]),
        ("[bindings]\njump = [\"j\"]", &["bad.toml:2: bindings.jump", "first-view"]),
        ("[bindings]\nbox = [\"hyper+x\"]", &["bad.toml:2: bindings.box", "ctrl, shift or alt"]),
        ("[bindings]\nbox = [\"l\"]", &["bad.toml:2: l is bound to look and to box"]),
    ] {
        bench.write("bad.toml", text);
        for command in ["serve", "view"] {
            let line = format!("{command} --print-config --config bad.toml");
            let is_conflict = words[0].contains("is bound to");
            // Keys that collide are the viewer's trouble alone, as only it has them all.
            if command == "view" || !is_conflict {
                assert_failed(&line, &bench.run(&line), 1, words);
            }
        }
    }
    assert_failed("absent", &bench.run("serve --print-config --config absent.toml"), 1, &["absent.toml"]);
    for (name, value, words) in [
        ("ISINGLASS_LOOK_K", "many", &["ISINGLASS_LOOK_K: look.k", "found \"many\""][..]),
        ("ISINGLASS_LOOK_KK", "1", &["ISINGLASS_LOOK_KK", "look.{tf"]),
        ("ISINGLASS_BINDINGS_BOX", "hyper+x", &["ISINGLASS_BINDINGS_BOX"]),
    ] {
        let output = bench.command("demo --print-config").env(name, value).output().unwrap();
        assert_failed(name, &output, 1, words);
    }
    let mut command = bench.command("view --print-config");
    command.env("ISINGLASS_BINDINGS_FIRST_VIEW", "Home, j").env("ISINGLASS_OTHER_THING", "1");
    let held = printed(&String::from_utf8(command.output().unwrap().stdout).unwrap());
    let expected = ("[\"Home\", \"j\"]".to_owned(), "ISINGLASS_BINDINGS_FIRST_VIEW".to_owned());
    assert_eq!(held["bindings.first-view"], expected);
    // What belongs to the other file is told, not ignored.
    bench.write("etc/server.toml", "[window]\nfov = 30\n");
    let words = ["server.toml:2", "window.fov", "viewer.toml"];
    assert_failed("wrong file", &bench.run("serve --print-config"), 1, &words);
}

/// As they are, and with every # taken away: each known setting is there, with its default.
#[test]
fn the_examples_are_settings_and_name_them_all() {
    let bench = Bench::new();
    for (name, command) in [("server.toml", "serve"), ("viewer.toml", "view")] {
        let path = format!("{}/../../configs/{name}", env!("CARGO_MANIFEST_DIR"));
        let text = std::fs::read_to_string(path).unwrap();
        let defaults = printed(&bench.ok(&format!("{command} --print-config")));
        bench.write("as-is.toml", &text);
        let same = bench.ok(&format!("{command} --print-config --config as-is.toml"));
        assert_eq!(printed(&same), defaults, "{name} changes nothing");
        let is_setting = |line: &str| {
            let key = line.strip_prefix("# ").and_then(|l| l.split_once(" = ")).map(|(key, _)| key);
            key.is_some_and(|k| k.chars().all(|c| c.is_ascii_lowercase() || "-_".contains(c)))
        };
        let bare: String =
            text.lines().map(|l| format!("{}\n", if is_setting(l) { &l[2..] } else { l })).collect();
        bench.write("bare.toml", &bare);
        let held = bench.ok(&format!("{command} --print-config --config bare.toml"));
        assert!(!held.contains("# not set"), "{name}: {held}");
        for (key, (value, origin)) in printed(&held) {
            let is_binding = key.starts_with("bindings.");
            assert!(is_binding || origin.contains("bare.toml:"), "{name} lacks {key}");
            // What has no default is an example of its own.
            if let Some((default, _)) = defaults.get(&key) {
                assert_eq!(&value, default, "{key}: the example shows the default");
            }
        }
    }
}
