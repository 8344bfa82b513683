//! Does every arrow between our crates stand in docs/ARCHITECTURE.md, and does each foreign world have one home?

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use serde_json::Value;

/// A row of the page's table of crates.
struct Row {
    /// Without the prefix of ours.
    name: String,
    /// Our crates that it uses.
    arrows: BTreeSet<String>,
    /// Crates of the outside world that it may use, and no crate of another row.
    worlds: BTreeSet<String>,
}

fn page() -> String {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/ARCHITECTURE.md");
    std::fs::read_to_string(path).expect("the page")
}

/// The table of a text. The crate of these tests uses all that the others use, but for the lab and the binary.
fn plan(page: &str) -> Vec<Row> {
    let table = page.split_once("## Crates and arrows").expect("the section").1;
    let lines = table.lines().skip_while(|line| !line.starts_with("|---")).skip(1);
    let cells =
        lines.take_while(|line| line.starts_with('|')).map(|line| line.split('|').collect::<Vec<_>>());
    let code =
        |cell: &str| -> BTreeSet<String> { cell.split('`').skip(1).step_by(2).map(str::to_owned).collect() };
    let rows: Vec<_> =
        cells.map(|cells| (code(cells[1]), code(cells[4]), cells[5].trim().to_owned())).collect();
    let names: BTreeSet<String> = rows.iter().flat_map(|(name, ..)| name.clone()).collect();
    let mut plan: Vec<Row> = Vec::new();
    for (name, worlds, arrows) in rows {
        let name = name.into_iter().next().expect("the row of a crate");
        let others = || names.iter().filter(|other| **other != name);
        let arrows = match arrows.strip_prefix("all of them but ") {
            Some(but) => others().filter(|other| *other != but).cloned().collect(),
            None if arrows == "nothing of ours" => BTreeSet::new(),
            None => arrows.split_whitespace().map(str::to_owned).collect(),
        };
        plan.push(Row { name, arrows, worlds });
    }
    let arrows = names.into_iter().filter(|name| name != "lab" && name != "isinglass").collect();
    let worlds = ["egui".to_owned()].into();
    plan.push(Row { name: "tests".into(), arrows, worlds });
    plan
}

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

/// Where crates and page differ. Of arrows both ways, and a foreign crate that nobody uses is none.
fn violations(plan: &[Row], dependencies: &BTreeMap<String, BTreeSet<String>>) -> BTreeSet<String> {
    let short = |name: &str| name.strip_prefix("isinglass-").unwrap_or(name).to_owned();
    let is_foreign = |name: &String| plan.iter().any(|row| row.worlds.contains(name));
    let mut found = BTreeSet::new();
    for row in plan {
        let of_row =
            |(name, all): (&String, &BTreeSet<String>)| (short(name) == row.name).then(|| all.clone());
        let Some(all) = dependencies.iter().find_map(of_row) else {
            found.insert(format!("there is no {}", row.name));
            continue;
        };
        let ours: BTreeSet<String> =
            all.iter().filter(|to| dependencies.contains_key(*to)).map(|to| short(to)).collect();
        let is_of_tests = row.name == "tests";
        found.extend(ours.difference(&row.arrows).map(|to| format!("{} -> {to}", row.name)));
        let undrawn = row.arrows.difference(&ours).filter(|_| !is_of_tests);
        found.extend(undrawn.map(|to| format!("no {} -> {to}", row.name)));
        let worlds: BTreeSet<String> = all.into_iter().filter(|name| is_foreign(name)).collect();
        found.extend(worlds.difference(&row.worlds).map(|to| format!("{} names {to}", row.name)));
        found.extend(row.worlds.difference(&worlds).map(|to| format!("{} does not name {to}", row.name)));
    }
    let is_unknown = |name: &&String| !plan.iter().any(|row| short(name) == row.name);
    found.extend(dependencies.keys().filter(is_unknown).map(|name| format!("{name} is not on the page")));
    found
}

#[test]
fn arrows_are_as_drawn() {
    let plan = plan(&page());
    assert!(plan.len() > 10, "the table is read");
    assert_eq!(violations(&plan, &dependencies()), BTreeSet::new());
}

#[test]
fn a_wrong_arrow_is_found_on_the_page_and_among_the_crates() {
    let found = |page: &str, dependencies: &_| Vec::from_iter(violations(&plan(page), dependencies));
    let mut dependencies = dependencies();
    let page = page();
    for (row, changed, expected) in [
        (
            "| `server` |",
            page.replacen("core formats gpu render net |", "core formats gpu net |", 1),
            "server -> render",
        ),
        ("| `net` |", page.replacen("`rcgen` | core |", "`rcgen` | core gpu |", 1), "no net -> gpu"),
        ("| `gpu` |", page.replacen("| `gpu` |", "| `cpu` |", 1), "isinglass-gpu is not on the page"),
        ("`winit`", page.replacen("`winit`", "`glutin`", 1), "client does not name glutin"),
    ] {
        assert!(page.contains(row) && changed != page, "{row}");
        assert!(found(&changed, &dependencies).iter().any(|f| f == expected), "{expected}");
    }
    let core = dependencies.get_mut("isinglass-core").expect("core is a member");
    core.extend(["isinglass-net", "wgpu"].map(str::to_owned));
    assert_eq!(found(&page, &dependencies), ["core -> net", "core names wgpu"]);
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
