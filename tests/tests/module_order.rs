//! Checks that a module uses only those above it: in core as docs/ARCHITECTURE.md lists them, in the codec and its folders
//! as their mod.rs do, and in the viewer as its lib.rs does. Checks that the viewer's panels use only what they share,
//! and that no crate has two types of one name.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// A file of a crate: its module and the modules of the crate that it names, each as names from the crate's root.
struct Source {
    module: Vec<String>,
    uses: Vec<Vec<String>>,
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace").to_owned()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The product's files below `folder`: tests may use anything.
fn sources(folder: &Path) -> Vec<Source> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            if path.extension().is_none_or(|extension| extension != "rs") {
                continue;
            }
            let relative = path.strip_prefix(folder).expect("it is below").with_extension("");
            let mut module: Vec<String> =
                relative.iter().map(|part| part.to_string_lossy().into_owned()).collect();
            module.retain(|part| part != "mod" && part != "lib");
            if !module.iter().any(|part| part == "tests" || part == "laws") {
                found.push(Source { uses: uses(&read(&path), &module), module });
            }
        }
    }
    found
}

/// What a text of a module names of its crate, without its comments and the tests at its end.
fn uses(text: &str, module: &[String]) -> Vec<Vec<String>> {
    let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    let code: String = text.lines().map(|line| line.split("//").next().unwrap_or_default()).collect();
    let mut found = Vec::new();
    for (start, parents) in code
        .match_indices("crate::")
        .map(|(i, _)| (i + 7, module.len()))
        .chain(code.match_indices("super::").map(|(i, _)| (i + 7, 1)))
    {
        let begins = |c: char| c.is_alphanumeric() || c == '_' || c == ':' || c == '$';
        let is_inner = code[..start - 7].ends_with(begins);
        let mut base = module[..module.len().saturating_sub(parents)].to_vec();
        let mut rest = &code[start..];
        while let Some(more) = rest.strip_prefix("super::") {
            base.pop();
            rest = more;
        }
        if !is_inner {
            expand(&base, rest, &mut found);
        }
    }
    found
}

/// Adds the paths that `text` begins with to `found`; returns what follows them.
fn expand<'a>(base: &[String], text: &'a str, found: &mut Vec<Vec<String>>) -> &'a str {
    let text = text.trim_start();
    if let Some(mut rest) = text.strip_prefix('{') {
        while !rest.is_empty() && !rest.starts_with('}') {
            rest = expand(base, rest, found).trim_start();
            rest = rest.trim_start_matches([',', ' ']);
        }
        return rest.strip_prefix('}').unwrap_or_default();
    }
    let end = text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len());
    let (name, rest) = text.split_at(end);
    if name.is_empty() {
        return text.get(1..).unwrap_or_default();
    }
    let mut path = base.to_vec();
    path.push(name.to_owned());
    match rest.strip_prefix("::") {
        Some(rest) => expand(&path, rest, found),
        None => {
            found.push(path);
            // A name that is imported under another.
            rest.strip_prefix(" as ")
                .map_or(rest, |alias| alias.trim_start_matches(|c: char| c.is_alphanumeric()))
        }
    }
}

/// The names in backticks in the first column of the table that follows `heading`.
fn order_in(text: &str, heading: &str) -> Vec<String> {
    let after = text.split_once(heading).unwrap_or_else(|| panic!("there is {heading:?}")).1;
    let rows = after.lines().map(|line| line.trim_start_matches("//!").trim());
    let rows = rows.skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    let names = |row: &str| -> Vec<String> {
        let column = row.split('|').nth(1).unwrap_or_default();
        column.split('`').skip(1).step_by(2).map(|name| name.trim_end_matches('/').to_owned()).collect()
    };
    rows.flat_map(names).collect()
}

/// What uses something below it, and what is not in the order at all.
fn violations(sources: &[Source], order: &[String]) -> BTreeSet<String> {
    let place = |module: &[String]| order.iter().position(|name| module.first() == Some(name));
    let mut found = BTreeSet::new();
    for source in sources.iter().filter(|source| !source.module.is_empty()) {
        let Some(own) = place(&source.module) else {
            found.insert(format!("{} is not in the order", source.module[0]));
            continue;
        };
        for used in source.uses.iter().filter(|used| place(used).is_some_and(|used| used > own)) {
            found.insert(format!("{} uses {}", source.module.join("::"), used.join("::")));
        }
    }
    let exists = |name: &&String| !sources.iter().any(|source| source.module.first() == Some(name));
    found.extend(order.iter().filter(exists).map(|name| format!("{name} does not exist")));
    found
}

fn core() -> (Vec<Source>, Vec<String>) {
    let page = read(&root().join("docs/ARCHITECTURE.md"));
    (sources(&root().join("crates/core/src")), order_in(&page, "## core, top to bottom"))
}

fn client() -> (Vec<Source>, Vec<String>) {
    let folder = root().join("crates/client/src");
    let order = order_in(&read(&folder.join("lib.rs")), "A folder uses only those above it");
    (sources(&folder), order)
}

/// Panels that use others, or anything of them but `shared`.
fn acquaintances(sources: &[Source], shared: &[String]) -> BTreeSet<String> {
    let is_panel =
        |module: &[String]| module.len() > 1 && module[0] == "panels" && !shared.contains(&module[1]);
    let mut found = BTreeSet::new();
    for source in sources.iter().filter(|source| source.module.len() > 1 && source.module[0] == "panels") {
        for used in source.uses.iter().filter(|used| is_panel(used) && used[1] != source.module[1]) {
            found.insert(format!("{} uses {}", source.module.join("::"), used.join("::")));
        }
    }
    found
}

#[test]
fn modules_use_only_those_above_them() {
    for (sources, order) in [core(), client()] {
        assert!(order.len() > 5 && sources.len() > 20, "{order:?}");
        assert_eq!(violations(&sources, &order), BTreeSet::new(), "{order:?}");
        // The control: the other way around hardly anything is right.
        let reversed: Vec<_> = order.iter().rev().cloned().collect();
        assert!(violations(&sources, &reversed).len() > 20);
        assert_eq!(violations(&sources, &order[1..]).len(), 1, "one module is left out");
    }
}

/// What files of a folder of core use below themselves in the order of the folder, or of the folder's own mod.rs.
fn violations_within(sources: &[Source], folder: &[&str], order: &[String]) -> BTreeSet<String> {
    let name = |module: &[String]| {
        let is_inside = module.len() > folder.len() && folder.iter().eq(&module[..folder.len()]);
        is_inside.then(|| module[folder.len()].clone())
    };
    let place = |name: &String| order.iter().position(|other| other == name);
    let mut found = BTreeSet::new();
    for source in sources {
        let Some(own) = name(&source.module) else { continue };
        let Some(own_place) = place(&own) else {
            found.insert(format!("{own} is not in the order"));
            continue;
        };
        for used in &source.uses {
            let Some(used_name) = name(used) else { continue };
            if place(&used_name).is_none_or(|used_place| used_place > own_place) {
                found.insert(format!("{} uses {}", source.module.join("::"), used.join("::")));
            }
        }
    }
    found
}

#[test]
fn files_of_the_codec_use_only_those_above_them() {
    let (sources, _) = core();
    for (folder, least) in [(&["codec"][..], 6), (&["codec", "exact"], 6), (&["codec", "blocks"], 15)] {
        let page = root().join("crates/core/src").join(folder.join("/")).join("mod.rs");
        let order = order_in(&read(&page), "uses only those above it");
        assert!(order.len() > least, "{order:?}");
        assert_eq!(violations_within(&sources, folder, &order), BTreeSet::new(), "{order:?}");
        // The control: the other way around hardly anything is right.
        let reversed: Vec<_> = order.iter().rev().cloned().collect();
        assert!(violations_within(&sources, folder, &reversed).len() > least);
        assert!(!violations_within(&sources, folder, &order[1..]).is_empty());
    }
}

#[test]
fn panels_do_not_know_each_other() {
    let (sources, _) = client();
    let page = read(&root().join("crates/client/src/panels/mod.rs"));
    let sentence = page.split_once("What they share is in").expect("it says so").1;
    let sentence = sentence.split_once('.').expect("a sentence").0;
    let shared: Vec<String> = sentence.split('`').skip(1).step_by(2).map(str::to_owned).collect();
    assert_eq!(acquaintances(&sources, &shared), BTreeSet::new(), "{shared:?}");
    assert!(acquaintances(&sources, &[]).len() > 10, "they do use what they share");
}

/// The type or trait that a line defines.
fn type_in(line: &str) -> Option<&str> {
    let mut words = line.split_whitespace().skip_while(|word| word.starts_with("pub") || word.ends_with(')'));
    let kind = words.next()?;
    let name = words.next().filter(|_| matches!(kind, "struct" | "enum" | "trait" | "union"))?;
    Some(name.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default())
}

/// The names that several files of a crate define a type by, with those files.
fn types_defined_twice(files: &[(String, String)]) -> BTreeMap<&str, BTreeSet<&str>> {
    let mut found = BTreeMap::<_, BTreeSet<_>>::new();
    for (path, text) in files {
        let product = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
        for name in product.lines().filter_map(type_in) {
            found.entry(name).or_default().insert(path.as_str());
        }
    }
    found.retain(|_, paths| paths.len() > 1);
    found
}

/// Paths and texts of the product's files in a crate.
fn product_files(crate_folder: &Path) -> Vec<(String, String)> {
    let folder = crate_folder.join("src");
    let modules = sources(&folder).into_iter().map(|source| source.module.join("/"));
    let file = |module: String| {
        let candidates =
            [format!("{module}.rs"), format!("{module}/mod.rs"), "lib.rs".into(), "main.rs".into()];
        let path = candidates.iter().map(|name| folder.join(name)).find(|path| path.exists());
        let text = read(&path.expect("the module has a file"));
        (module, text)
    };
    modules
        .map(file)
        .filter(|(module, _)| !IS_TEST.contains(&module.rsplit('/').next().unwrap_or_default()))
        .collect()
}

/// Modules that exist only in tests.
const IS_TEST: [&str; 3] = ["pair", "vectors", "whole_marches"];

#[test]
fn a_crate_defines_no_type_twice() {
    for entry in fs::read_dir(root().join("crates")).expect("crates") {
        let folder = entry.expect("a crate").path();
        let mut files = product_files(&folder);
        assert!(!files.is_empty(), "{}", folder.display());
        assert_eq!(types_defined_twice(&files), BTreeMap::new(), "{}", folder.display());
        // The control: copies of the files define all of their types twice.
        let copies: Vec<_> = files.iter().map(|(path, text)| (format!("{path}2"), text.clone())).collect();
        files.extend(copies);
        assert!(!types_defined_twice(&files).is_empty(), "{}", folder.display());
    }
    let types = "struct A;\npub(crate) enum B {\n    pub trait C<T> {\npub(in crate::x) struct D(u8);\n// struct E;\nfn f() {}";
    assert_eq!(types.lines().filter_map(type_in).collect::<Vec<_>>(), ["A", "B", "C", "D"]);
}

#[test]
fn paths_are_read_as_the_compiler_reads_them() {
    let text = "use crate::a::{self, b::{C, D as E}, f};\nuse super::g;\nuse super::super::h::I;\n// crate::no\nfn x() { crate::j::k() }";
    let module = ["one", "two"].map(str::to_owned);
    let found: Vec<String> = uses(text, &module).iter().map(|path| path.join("::")).collect();
    assert_eq!(found, ["a::self", "a::b::C", "a::b::D", "a::f", "j::k", "one::g", "h::I"]);
}
