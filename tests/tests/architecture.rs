//! Does every arrow between our crates stand in docs/ARCHITECTURE.md, and does each foreign world have one home?

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use serde_json::Value;

/// Who may use whom, among our own crates.
const ARROWS: [(&str, &[&str]); 11] = [
    ("isinglass-core", &[]),
    ("isinglass-formats", &["core"]),
    ("isinglass-gpu", &["core"]),
    ("isinglass-render", &["core", "gpu"]),
    ("isinglass-net", &["core"]),
    ("isinglass-server", &["core", "formats", "gpu", "render", "net"]),
    ("isinglass-client", &["core", "formats", "gpu", "net"]),
    ("isinglass-bench", &["core", "formats", "gpu", "render", "net", "server", "client"]),
    ("isinglass-lab", &["core", "formats", "gpu", "render", "net", "server", "client", "bench"]),
    ("isinglass", &["core", "formats", "gpu", "render", "net", "server", "client", "bench"]),
    ("isinglass-tests", &["core", "formats", "gpu", "render", "net", "server", "client", "bench"]),
];

/// Crates of the outside world, and who may name them.
const WORLDS: [(&str, &[&str]); 12] = [
    ("wgpu", &["isinglass-gpu", "isinglass-client", "isinglass-tests"]),
    ("quinn", &["isinglass-net"]),
    ("rustls", &["isinglass-net"]),
    ("rcgen", &["isinglass-net"]),
    ("eframe", &["isinglass-client"]),
    ("egui", &["isinglass-client", "isinglass-tests"]),
    ("winit", &["isinglass-client"]),
    ("flate2", &["isinglass-formats"]),
    ("toml", &["isinglass-formats"]),
    ("clap", &["isinglass", "isinglass-lab"]),
    ("openjpeg-sys", &["isinglass-lab"]),
    ("rav1e", &["isinglass-lab"]),
];

/// What cargo says, asked with these arguments.
fn metadata(args: &[&str]) -> Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--offline"])
        .args(args)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("cargo writes JSON")
}

/// What cargo says of each of our crates.
fn packages() -> Vec<Value> {
    metadata(&["--no-deps"])["packages"].as_array().expect("packages").clone()
}

fn name(v: &Value) -> String {
    v["name"].as_str().expect("a name").to_owned()
}

/// Dependencies of each of our crates, development ones of `isinglass-tests` included.
fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    packages()
        .iter()
        .map(|p| {
            let dependencies = p["dependencies"].as_array().expect("dependencies").iter();
            let counted = dependencies.filter(|d| name(p) == "isinglass-tests" || d["kind"] != "dev");
            (name(p), counted.map(name).collect())
        })
        .collect()
}

/// The arrows that are not drawn.
fn violations(dependencies: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let mut found = Vec::new();
    for (from, all) in dependencies {
        let Some((_, allowed)) = ARROWS.iter().find(|(name, _)| name == from) else {
            found.push(format!("{from} is not on the plan"));
            continue;
        };
        for to in all {
            let ours = to.strip_prefix("isinglass-");
            if ours.is_some_and(|short| !allowed.contains(&short)) {
                found.push(format!("{from} -> {to}"));
            }
            if let Some((_, homes)) = WORLDS.iter().find(|(world, _)| world == to)
                && !homes.contains(&from.as_str())
            {
                found.push(format!("{from} names {to}"));
            }
        }
    }
    found
}

#[test]
fn arrows_are_as_drawn() {
    let dependencies = dependencies();
    assert_eq!(dependencies.len(), ARROWS.len(), "{:?}", dependencies.keys());
    assert_eq!(violations(&dependencies), Vec::<String>::new());
}

#[test]
fn a_wrong_arrow_is_found() {
    let mut dependencies = dependencies();
    let core = dependencies.get_mut("isinglass-core").expect("core is a member");
    core.insert("isinglass-net".into());
    core.insert("wgpu".into());
    assert_eq!(violations(&dependencies), ["isinglass-core -> isinglass-net", "isinglass-core names wgpu"]);
}

/// The codecs of others that a build without features carries.
fn carried(packages: &[Value]) -> Vec<String> {
    const RIVALS: [&str; 4] = ["image-webp", "lz4_flex", "openjpeg-sys", "rav1e"];
    let mut found = Vec::new();
    for package in packages {
        let defaults = package["features"].get("default").and_then(Value::as_array);
        found.extend(defaults.into_iter().flatten().map(|feature| format!("{}: {feature}", name(package))));
        for dependency in package["dependencies"].as_array().expect("dependencies") {
            // Volumes in OME-Zarr may lie in LZ4.
            let is_for_files = name(package) == "isinglass-formats" && name(dependency) == "lz4_flex";
            if RIVALS.contains(&&name(dependency)[..]) && dependency["optional"] != true && !is_for_files {
                found.push(name(dependency));
            }
        }
    }
    found
}

#[test]
fn the_product_carries_no_codec_of_others() {
    let mut packages = packages();
    assert_eq!(carried(&packages), Vec::<String>::new());
    let lab = packages.iter_mut().find(|p| name(p) == "isinglass-lab").expect("the lab is a member");
    lab["features"]["default"] = serde_json::json!(["rivals"]);
    for dependency in lab["dependencies"].as_array_mut().expect("dependencies") {
        dependency["optional"] = Value::Bool(false);
    }
    assert_eq!(carried(&packages).len(), 5);
}

/// Which of the crates that are built for a window ask for a library of the system that a fresh machine lacks.
#[cfg(target_os = "linux")]
fn asking(resolved: &Value) -> Vec<String> {
    // Its build script asks pkg-config for libwayland unless it is told to load it at run time.
    let asks = |node: &&Value| {
        let id = node["id"].as_str().expect("an id");
        let has = |feature: &str| node["features"].as_array().expect("features").iter().any(|f| f == feature);
        id.contains("wayland-sys") && (has("client") || has("cursor") || has("egl")) && !has("dlopen")
    };
    let nodes = resolved["resolve"]["nodes"].as_array().expect("nodes");
    nodes.iter().filter(asks).map(|node| node["id"].to_string()).collect()
}

#[cfg(target_os = "linux")]
#[test]
fn a_window_is_built_without_libraries_of_the_system() {
    let target = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let mut resolved = metadata(&["--filter-platform", &target]);
    assert_eq!(asking(&resolved), Vec::<String>::new());
    // The control: as it would be without the feature that the client asks winit for.
    for node in resolved["resolve"]["nodes"].as_array_mut().expect("nodes") {
        node["features"].as_array_mut().expect("features").retain(|feature| feature != "dlopen");
    }
    assert_eq!(asking(&resolved).len(), 1, "wayland-sys is among what is built");
}
