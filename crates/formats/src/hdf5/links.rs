//! Paths within a file, along links of every kind.

use std::collections::{HashMap, HashSet, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::contents::{ArrayFile, FORMAT, Listed, MAX_KNOWN, problem};
use super::objects::{Link, LinkTarget, ObjectKind};
use crate::error::{FormatError, malformed, quoted, shown};

/// What a path leads to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Place {
    Here(ObjectPlace),
    /// A path in another file.
    Elsewhere(OutsideLink),
}

/// An object of the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ObjectPlace {
    /// A path to it without links to other paths.
    pub(super) path: String,
    /// The byte at which it begins.
    pub(super) at: u64,
}

/// A link to an object of another file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct OutsideLink {
    /// The path of the link itself.
    pub(super) path: String,
    pub(super) file: String,
    /// The path in that file.
    pub(super) inside: String,
}

/// The arrays at a path or below it.
#[derive(Default)]
pub(super) struct Inventory {
    /// In the order of their paths. An array with several paths is here once.
    pub(super) arrays: Vec<Listed>,
    /// Links to other files.
    pub(super) outside: Vec<OutsideLink>,
    seen: HashSet<u64>,
    /// Links to paths, which are followed after all others: the path and the group of the link, and what it says.
    soft: Vec<(String, String, String)>,
}

/// A group whose links are to be listed.
struct NextGroup {
    /// The path for messages, and one without links to other paths.
    name: String,
    place: ObjectPlace,
    depth: usize,
}

impl ArrayFile {
    /// The links of the group at byte `at`, which are read once.
    pub(super) fn links(&self, at: u64) -> Result<Arc<Vec<Link>>, String> {
        if let Some(found) = self.known_links.borrow().get(&at) {
            return Ok(Arc::clone(found));
        }
        let found = Arc::new(self.objects.links(at)?);
        let mut known = self.known_links.borrow_mut();
        if known.len() < MAX_KNOWN {
            known.insert(at, Arc::clone(&found));
        }
        Ok(found)
    }

    /// Follows `path` from the root.
    ///
    /// # Errors
    /// Nothing is there, or its links form a circle.
    pub(super) fn resolve(&self, path: &str) -> Result<Place, String> {
        self.resolve_from("", path)
    }

    /// Follows `path` from the group at `folder`, a path without links to other paths, or from the root if it begins
    /// with a slash.
    fn resolve_from(&self, folder: &str, path: &str) -> Result<Place, String> {
        let folder = if path.starts_with('/') { "" } else { folder };
        let mut todo: VecDeque<String> =
            folder.split('/').chain(path.split('/')).map(str::to_owned).collect();
        // The groups on the way, with the name of each.
        let mut way = vec![(String::new(), self.root)];
        let mut num_hops = 0;
        while let Some(name) = todo.pop_front() {
            if name.is_empty() || name == "." {
                continue;
            }
            let at = way.last().map_or(self.root, |(_, at)| *at);
            let links = self.links(at)?;
            let found = links.binary_search_by(|link| link.name.as_str().cmp(&name)).ok();
            let Some(link) = found.map(|i| &links[i]) else {
                return Err(format!("nothing is at {}", quoted(path)));
            };
            match &link.target {
                LinkTarget::Object(at) => way.push((name, *at)),
                LinkTarget::Path(target) => {
                    num_hops += 1;
                    if num_hops > MAX_HOPS {
                        return Err(format!("the links at {} form a circle", quoted(path)));
                    }
                    if target.starts_with('/') {
                        way.truncate(1);
                    }
                    target.split('/').rev().for_each(|part| todo.push_front(part.to_owned()));
                }
                LinkTarget::File { file, path: target } => {
                    let rest = todo.iter().fold(String::new(), |all, part| all + "/" + part);
                    let inside = format!("{}{rest}", target.trim_end_matches('/'));
                    let (path, file) = (path.to_owned(), file.clone());
                    return Ok(Place::Elsewhere(OutsideLink { path, file, inside }));
                }
            }
        }
        let at = way.last().map_or(self.root, |(_, at)| *at);
        let path = way[1..].iter().fold(String::new(), |all, (name, _)| all + "/" + name);
        Ok(Place::Here(ObjectPlace { path, at }))
    }

    /// All arrays at `inside` or below it, and the links to other files there.
    pub(super) fn inventory(
        &self,
        inside: &str,
        path: &Path,
        cancel: Option<&AtomicBool>,
    ) -> Result<Inventory, FormatError> {
        let bad = malformed(path, FORMAT);
        let mut found = Inventory::default();
        let name = inside.trim_end_matches('/').to_owned();
        match self.resolve(inside).map_err(bad)? {
            Place::Elsewhere(link) => found.outside.push(link),
            Place::Here(place) => match self.objects.kind(place.at).map_err(bad)? {
                ObjectKind::Array => found.add_array(self, name, &place),
                ObjectKind::Group => {
                    found.seen.insert(place.at);
                    found.walk(self, NextGroup { name, place, depth: 0 }, path, cancel)?;
                    // Each of them may lead to a group with further ones.
                    while let Some((name, folder, target)) = found.soft.pop() {
                        found.follow(self, name, (&folder, &target), path, cancel)?;
                    }
                }
                ObjectKind::Other => {}
            },
        }
        found.arrays.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(found)
    }
}

impl Inventory {
    fn add_array(&mut self, contents: &ArrayFile, name: String, place: &ObjectPlace) {
        // An array that cannot be read hides no other one.
        if let Ok(dataset) = contents.metadata.dataset(&place.path) {
            self.arrays.extend(Listed::of(name, place.at, dataset));
        }
    }

    /// Follows a link to a path from the group at `folder`.
    fn follow(
        &mut self,
        contents: &ArrayFile,
        name: String,
        (folder, target): (&str, &str),
        path: &Path,
        cancel: Option<&AtomicBool>,
    ) -> Result<(), FormatError> {
        match contents.resolve_from(folder, target) {
            Ok(Place::Elsewhere(link)) => self.outside.push(OutsideLink { path: name, ..link }),
            Ok(Place::Here(place)) if self.seen.insert(place.at) => match contents.objects.kind(place.at) {
                Ok(ObjectKind::Array) => self.add_array(contents, name, &place),
                Ok(ObjectKind::Group) => {
                    self.walk(contents, NextGroup { name, place, depth: 0 }, path, cancel)?;
                }
                Ok(ObjectKind::Other) | Err(_) => {}
            },
            // It is there already, or leads nowhere.
            Ok(Place::Here(_)) | Err(_) => {}
        }
        Ok(())
    }

    /// Lists a group and those below it, the nearest first, so that an array has its shortest path.
    fn walk(
        &mut self,
        contents: &ArrayFile,
        first: NextGroup,
        path: &Path,
        cancel: Option<&AtomicBool>,
    ) -> Result<(), FormatError> {
        let bad = malformed(path, FORMAT);
        let mut waiting = VecDeque::from([first]);
        while let Some(group) = waiting.pop_front() {
            if cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
                return Err(FormatError::Cancelled { path: shown(path) });
            }
            let groups = self.list(contents, &group).map_err(bad)?;
            let groups = groups.into_iter().filter(|_| group.depth < MAX_DEPTH);
            let depth = group.depth + 1;
            waiting.extend(groups.map(|(name, place)| NextGroup { name, place, depth }));
            if self.arrays.len() + self.soft.len() + self.outside.len() > MAX_ARRAYS {
                return Err(bad(format!("it has more than {MAX_ARRAYS} arrays, expected fewer")));
            }
        }
        Ok(())
    }

    /// Adds the arrays of a group and notes its links. Returns the groups in it that are new.
    fn list(
        &mut self,
        contents: &ArrayFile,
        group: &NextGroup,
    ) -> Result<Vec<(String, ObjectPlace)>, String> {
        let links = contents.links(group.place.at)?;
        let own = contents.metadata.group(&group.place.path).map_err(|e| problem(&e))?;
        let are_objects = links.iter().all(|link| matches!(link.target, LinkTarget::Object(_)));
        // The reader of metadata lists groups at once, but only those without links to paths. An array that it cannot
        // read hides all others from it.
        let mut at_once: Option<HashMap<_, _>> =
            own.iter_datasets().ok().filter(|_| are_objects).map(Iterator::collect);
        let mut groups = Vec::new();
        for link in links.iter() {
            let name = format!("{}/{}", group.name, link.name);
            match &link.target {
                LinkTarget::Object(at) if self.seen.insert(*at) => {
                    let dataset = match &mut at_once {
                        Some(datasets) => datasets.remove(&link.name),
                        None => own.dataset(&link.name).ok(),
                    };
                    match dataset {
                        Some(dataset) => self.arrays.extend(Listed::of(name, *at, dataset)),
                        None => {
                            let path = format!("{}/{}", group.place.path, link.name);
                            groups.push((name, ObjectPlace { path, at: *at }));
                        }
                    }
                }
                LinkTarget::Object(_) => {}
                LinkTarget::Path(target) => {
                    self.soft.push((name, group.place.path.clone(), target.clone()));
                }
                LinkTarget::File { file, path } => {
                    let (file, inside) = (file.clone(), path.clone());
                    self.outside.push(OutsideLink { path: name, file, inside });
                }
            }
        }
        groups.retain(|(_, place)| matches!(contents.objects.kind(place.at), Ok(ObjectKind::Group)));
        Ok(groups)
    }
}

/// Deepest group.
const MAX_DEPTH: usize = 32;
const MAX_ARRAYS: usize = 1 << 16;
/// Most links to paths on the way to an object.
const MAX_HOPS: usize = 64;
