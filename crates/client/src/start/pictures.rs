//! The last picture of what was opened, as small PNG files beside the recent list. Threads write and read them.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use egui::{ColorImage, Context, TextureHandle, TextureOptions};
use isinglass_core::picture::Picture;
use isinglass_formats::{RecentEntry, RecentPlace, png, write_whole};
use isinglass_net::{ReceivedFrame, place_of};

use crate::panels::background::Background;
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
    /// By the names of their files; none where there is no picture that can be read.
    textures: BTreeMap<String, Option<TextureHandle>>,
    reading: Background<Vec<(String, Option<ColorImage>)>>,
    writing: Background<String>,
}

impl Pictures {
    /// In a folder beside the file of the recent list.
    pub(crate) fn new(recent_file: Option<&Path>) -> Self {
        let folder = recent_file.and_then(Path::parent).map(|folder| folder.join("pictures"));
        let (textures, reading, writing) = Default::default();
        Self { folder, textures, reading, writing }
    }

    /// Takes what was read, and begins to read what the entries lack. Never waits.
    pub(crate) fn poll(&mut self, ctx: &Context, entries: &[RecentEntry]) {
        let Some(folder) = self.folder.clone() else { return };
        if let Some(Ok(name)) = self.writing.take() {
            self.textures.remove(&name);
        }
        if let Some(Ok(found)) = self.reading.take() {
            for (name, image) in found {
                let texture = image.map(|image| ctx.load_texture(&name, image, TextureOptions::LINEAR));
                self.textures.insert(name, texture);
            }
        }
        if self.reading.is_busy() || self.writing.is_busy() {
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

    /// Keeps a picture on a thread, and drops those of other places than the entries'.
    pub(crate) fn keep(&mut self, ctx: &Context, keepsake: Keepsake, entries: &[RecentEntry]) {
        if let Some(work) = self.work(keepsake, entries) {
            self.writing = Background::run(&waker_of(ctx), work);
        }
    }

    /// The same at once, for a window that has closed.
    pub(crate) fn keep_now(&self, keepsake: Keepsake, entries: &[RecentEntry]) {
        if let Some(Err(problem)) = self.work(keepsake, entries).map(|work| work()) {
            tracing::debug!("{problem}");
        }
    }

    fn work(
        &self,
        keepsake: Keepsake,
        entries: &[RecentEntry],
    ) -> Option<impl FnOnce() -> Result<String, String> + Send + use<>> {
        let folder = self.folder.clone()?;
        let known: Vec<_> = entries.iter().map(|entry| name_of(&entry.place)).collect();
        Some(move || {
            let Keepsake { frame, background, place } = keepsake;
            let (size, rgb) = small(&frame.frame.flatten(), background);
            write(&folder, &name_of(&place), size, &rgb, &known)
        })
    }
}

/// The name of a place's file: 16 digits of a hash, which tell nothing of the place.
fn name_of(place: &RecentPlace) -> String {
    let text = match place {
        RecentPlace::Server { host, port } => format!("server {}", place_of(host, *port)),
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

/// Writes a picture and removes those that are not known. Returns its name.
fn write(folder: &Path, name: &str, size: [u32; 2], rgb: &[u8], known: &[String]) -> Result<String, String> {
    let png = png::encode(size[0], size[1], rgb).map_err(|e| e.to_string())?;
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    write_whole(&folder.join(name), &png).map_err(|e| e.to_string())?;
    let is_ours = |file: &str| file.len() == 20 && file.ends_with(".png");
    for entry in std::fs::read_dir(folder).map_err(|e| e.to_string())?.flatten().take(MOST_FILES) {
        let file = entry.file_name().to_string_lossy().into_owned();
        if is_ours(&file) && file != name && !known.contains(&file) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
    Ok(name.to_owned())
}

/// The picture in a file. Files that are too large, or no such picture, are none.
fn read(path: &Path) -> Option<ColorImage> {
    let file = std::fs::File::open(path).ok()?;
    let is_small = file.metadata().is_ok_and(|m| m.is_file() && m.len() <= MOST_BYTES);
    let mut bytes = Vec::new();
    file.take(MOST_BYTES).read_to_end(&mut bytes).ok().filter(|_| is_small)?;
    let rgb = png::decode(&bytes, u64::from(MOST_SIDE * MOST_SIDE)).ok()?;
    let size = [rgb.width, rgb.height];
    size.iter()
        .all(|side| (1..=MOST_SIDE).contains(side))
        .then(|| ColorImage::from_rgb(size.map(|side| side as usize), &rgb.bytes))
}

/// Width and height of a picture, pixels, at most.
const MOST_SIDE: u32 = 256;
/// A PNG file of that size takes less.
const MOST_BYTES: u64 = 300_000;
/// Files that are looked at when pictures are removed.
const MOST_FILES: usize = 1000;

#[cfg(test)]
mod tests {
    use isinglass_formats::VolumeSource;

    use super::*;

    fn volume(source: &str) -> RecentPlace {
        RecentPlace::Volume(VolumeSource::new(source))
    }

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
    fn pictures_are_read_back_and_others_than_the_lists_are_removed() {
        let folder = tempfile::TempDir::new().unwrap();
        let [a, b] = ["/a", "/b"].map(|source| name_of(&volume(source)));
        assert!(a != b && a != name_of(&RecentPlace::Server { host: "/a".into(), port: 1 }));
        let rgb = [9, 80, 200].repeat(12);
        write(folder.path(), &a, [4, 3], &rgb, &[]).unwrap();
        std::fs::write(folder.path().join("letter.txt"), "not ours").unwrap();
        write(folder.path(), &b, [4, 3], &rgb, &[a.clone(), b.clone()]).unwrap();
        let image = read(&folder.path().join(&a)).expect("the list has it");
        assert_eq!((image.size, image.pixels[0]), ([4, 3], egui::Color32::from_rgb(9, 80, 200)));
        write(folder.path(), &b, [4, 3], &rgb, std::slice::from_ref(&b)).unwrap();
        assert!(read(&folder.path().join(&a)).is_none(), "the list has it no more");
        assert!(read(&folder.path().join(&b)).is_some() && folder.path().join("letter.txt").exists());
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
