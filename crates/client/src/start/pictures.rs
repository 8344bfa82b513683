//! The last picture of what was opened, as small PNG files beside the recent list. Threads write and read them.

use std::collections::{BTreeMap, VecDeque};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use egui::{ColorImage, Context, TextureHandle, TextureOptions};
use isinglass_core::picture::Picture;
use isinglass_formats::{Recent, RecentEntry, RecentPlace, open_file, png};
use isinglass_net::{ReceivedFrame, place_of};

use crate::panels::background::{Background, write_own};
use crate::view::waker_of;

/// A picture that is to be kept.
pub(crate) struct Keepsake {
    pub(crate) frame: Arc<ReceivedFrame>,
    /// Linear.
    pub(crate) background: [f32; 3],
    pub(crate) place: RecentPlace,
}

pub(crate) struct Pictures {
    /// None: pictures are not kept.
    folder: Option<PathBuf>,
    recent_file: Option<PathBuf>,
    /// By the names of their files; none where there is no picture that can be read.
    textures: BTreeMap<String, Option<TextureHandle>>,
    reading: Background<Vec<(String, Option<ColorImage>)>>,
    /// Files are changed one after the other.
    writing: Background<()>,
    due: VecDeque<Change>,
}

enum Change {
    Keep(Keepsake),
    /// Deletes the file of this name.
    Forget(String),
    /// Deletes old pictures of what neither these places nor the file of the recent list name.
    Sweep {
        recent_file: PathBuf,
        names: Vec<String>,
    },
}

impl Pictures {
    /// In a folder beside the file of the recent list.
    pub(crate) fn new(recent_file: Option<&Path>) -> Self {
        let folder = recent_file.and_then(Path::parent).map(|folder| folder.join("pictures"));
        let recent_file = recent_file.map(Path::to_owned);
        let (textures, reading, writing, due) = Default::default();
        Self { folder, recent_file, textures, reading, writing, due }
    }

    /// Begins the next change of a file. Never waits.
    pub(crate) fn go_on(&mut self, ctx: &Context) {
        if let Some(Err(problem)) = self.writing.take() {
            tracing::debug!("{problem}");
        }
        if self.writing.is_busy() {
            return;
        }
        if let (Some(folder), Some(change)) = (self.folder.clone(), self.due.pop_front()) {
            self.writing = Background::run(&waker_of(ctx), move || change.apply(&folder));
        }
    }

    /// Changes all files that are due, at once, for a window that has closed.
    pub(crate) fn finish(&mut self) {
        self.writing.finish();
        let Some(folder) = &self.folder else { return };
        for change in self.due.drain(..) {
            if let Err(problem) = change.apply(folder) {
                tracing::debug!("{problem}");
            }
        }
    }

    /// Takes what was read, and begins to read what the entries lack. Never waits.
    pub(crate) fn poll(&mut self, ctx: &Context, entries: &[RecentEntry]) {
        let Some(folder) = self.folder.clone() else { return };
        if let Some(Ok(found)) = self.reading.take() {
            for (name, image) in found {
                let texture = image.map(|image| ctx.load_texture(&name, image, TextureOptions::LINEAR));
                self.textures.insert(name, texture);
            }
        }
        if self.reading.is_busy() || self.writing.is_busy() || !self.due.is_empty() {
            return;
        }
        let names: Vec<_> = entries.iter().map(|entry| name_of(&entry.place)).collect();
        self.textures.retain(|name, _| names.contains(name));
        let missing: Vec<_> = names.into_iter().filter(|name| !self.textures.contains_key(name)).collect();
        if !missing.is_empty() {
            self.reading = Background::run(&waker_of(ctx), move || {
                let image = |name: String| {
                    let image = read(&folder.join(&name));
                    (name, image)
                };
                Ok(missing.into_iter().map(image).collect())
            });
        }
    }

    pub(crate) fn of(&self, place: &RecentPlace) -> Option<&TextureHandle> {
        self.textures.get(&name_of(place))?.as_ref()
    }

    /// Keeps a picture of a place that the list has.
    pub(crate) fn keep(&mut self, keepsake: Keepsake, entries: &[RecentEntry]) {
        let name = name_of(&keepsake.place);
        if has_name(entries, &name) {
            self.due.push_back(Change::Keep(keepsake));
            self.drop_texture(&name);
        }
    }

    /// Deletes the picture of a place that the list has dropped.
    pub(crate) fn forget(&mut self, place: &RecentPlace, entries: &[RecentEntry]) {
        let name = name_of(place);
        if !has_name(entries, &name) {
            self.drop_texture(&name);
            self.due.push_back(Change::Forget(name));
        }
    }

    /// Deletes pictures that no entry needs any more: another window may have dropped it. Call it when the list is read.
    pub(crate) fn sweep(&mut self, entries: &[RecentEntry]) {
        if let Some(recent_file) = self.recent_file.clone() {
            let names = entries.iter().map(|entry| name_of(&entry.place)).collect();
            self.due.push_back(Change::Sweep { recent_file, names });
        }
    }

    fn drop_texture(&mut self, name: &str) {
        self.textures.remove(name);
        // It may be reading the former file.
        self.reading = Background::default();
    }
}

impl Change {
    fn apply(self, folder: &Path) -> Result<(), String> {
        match self {
            Self::Keep(Keepsake { frame, background, place }) => {
                let (size, rgb) = small(&frame.frame.flatten(), background);
                let png = png::encode(size[0], size[1], &rgb).map_err(|e| e.to_string())?;
                write_own(&folder.join(name_of(&place)), &png)
            }
            Self::Forget(name) => match std::fs::remove_file(folder.join(&name)) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(format!("{name}: {e}")),
                _ => Ok(()),
            },
            Self::Sweep { recent_file, names } => sweep(folder, &recent_file, names),
        }
    }
}

/// See [`Change::Sweep`]. A list that cannot be read keeps everything.
fn sweep(folder: &Path, recent_file: &Path, mut names: Vec<String>) -> Result<(), String> {
    let list = Recent::read(recent_file).map_err(|e| e.to_string())?;
    names.extend(list.entries.iter().map(|entry| name_of(&entry.place)));
    let Ok(files) = std::fs::read_dir(folder) else { return Ok(()) };
    // Another window may write a picture before its entry is in the file.
    let is_old = |file: &std::fs::DirEntry| {
        let age = file.metadata().and_then(|m| m.modified()).ok().and_then(|at| at.elapsed().ok());
        age.is_some_and(|age| age >= LEAST_AGE)
    };
    for file in files.take(MOST_SWEPT).flatten() {
        let name = file.file_name().to_string_lossy().into_owned();
        if is_name(&name) && !names.contains(&name) && is_old(&file) {
            std::fs::remove_file(file.path()).map_err(|e| format!("{name}: {e}"))?;
        }
    }
    Ok(())
}

/// Whether a file has a name as [`name_of`] gives it.
fn is_name(name: &str) -> bool {
    let hash = name.strip_suffix(".png").unwrap_or_default();
    hash.len() == 16 && hash.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

fn has_name(entries: &[RecentEntry], name: &str) -> bool {
    entries.iter().any(|entry| name_of(&entry.place) == name)
}

/// The name of a place's file: 16 digits of a hash, which tell nothing of the place.
pub(super) fn name_of(place: &RecentPlace) -> String {
    let text = match place {
        RecentPlace::Server { host, port } => format!("server {}", place_of(host, *port)),
        RecentPlace::Remote { place } => format!("remote {place}"),
        RecentPlace::Volume(volume) => format!("volume {}", volume.source),
    };
    // FNV-1a, the same in every version of the program.
    let hash = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    format!("{hash:016x}.png")
}

/// A picture of at most [`MOST_SIDE`] pixels a side, in 8-bit sRGB: means of squares.
fn small(picture: &Picture, background: [f32; 3]) -> ([u32; 2], Vec<u8>) {
    let (width, height) = (picture.width.max(1), picture.height.max(1));
    let step = width.max(height).div_ceil(MOST_SIDE);
    let size = [width.div_ceil(step), height.div_ceil(step)];
    let mut mean = Picture::new(size[0], size[1]);
    for (n, pixel) in mean.pixels.iter_mut().enumerate() {
        let (x, y) = (n as u32 % size[0] * step, n as u32 / size[0] * step);
        let mut num = 0.0;
        for y in y..(y + step).min(height) {
            for x in x..(x + step).min(width) {
                let Some(from) = picture.pixels.get((y * width + x) as usize) else { continue };
                (0..4).for_each(|channel| pixel[channel] += from[channel]);
                num += 1.0;
            }
        }
        pixel.iter_mut().for_each(|channel| *channel /= f32::max(num, 1.0));
    }
    (size, mean.to_srgb8(background))
}

/// The picture in a file. Files that are too large, or no such picture, are none.
fn read(path: &Path) -> Option<ColorImage> {
    let file = open_file(path).ok()?;
    let is_small = file.metadata().is_ok_and(|m| m.len() <= MOST_BYTES);
    let mut bytes = Vec::new();
    file.take(MOST_BYTES).read_to_end(&mut bytes).ok().filter(|_| is_small)?;
    let rgb = png::decode(&bytes, u64::from(MOST_SIDE * MOST_SIDE)).ok()?;
    let size = [rgb.width, rgb.height];
    size.iter()
        .all(|side| (1..=MOST_SIDE).contains(side))
        .then(|| ColorImage::from_rgb(size.map(|side| side as usize), &rgb.bytes))
}

/// Files that are looked at when pictures are swept.
const MOST_SWEPT: usize = 4096;
/// Younger pictures are not swept.
const LEAST_AGE: Duration = Duration::from_secs(3600);
/// Width and height of a picture, pixels, at most.
const MOST_SIDE: u32 = 256;
/// A PNG file of that size takes less.
const MOST_BYTES: u64 = 300_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_small_and_keeps_its_colours() {
        let mut picture = Picture::new(1000, 401);
        picture.pixels.iter_mut().for_each(|pixel| *pixel = [0.5, 0.0, 0.0, 0.5]);
        let (size, rgb) = small(&picture, [0.0, 0.0, 1.0]);
        assert_eq!(size, [250, 101]);
        assert_eq!(rgb.len(), 250 * 101 * 3);
        // Half of linear red over half of blue.
        assert!(rgb.chunks(3).all(|pixel| pixel == [188, 0, 188]), "{:?}", &rgb[..3]);
        assert_eq!(small(&Picture::new(9, 7), [0.0; 3]).0, [9, 7], "a small one stays");
    }

    #[test]
    fn hostile_files_are_no_pictures() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("x.png");
        let is_read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            read(&path).is_some()
        };
        let png = |side: u32| png::encode(side, side, &vec![7; (side * side * 3) as usize]).unwrap();
        assert!(is_read(&png(256)), "the control");
        assert!(!is_read(&png(257)), "too large");
        let padded = [png(256), vec![0; MOST_BYTES as usize]].concat();
        assert!(!is_read(&padded), "too long");
        let good = png(64);
        assert!(!is_read(&good[..good.len() / 2]) && !is_read(&[]) && !is_read(b"no picture"));
        // A picture that says it is huge is refused before it is unpacked.
        let mut huge = good.clone();
        huge[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
        assert!(!is_read(&huge));
        assert!(read(folder.path()).is_none() && read(&folder.path().join("none.png")).is_none());
    }
}
