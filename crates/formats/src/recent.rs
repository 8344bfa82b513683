//! The list of recently opened servers and volumes, as a small TOML file. It never contains a token or a fingerprint,
//! because a link is for one viewer and one use.

use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::text::{is_control, printable};
use serde::{Deserialize, Serialize};

use crate::error::{FormatError, io_error, shown, syntax_error};
use crate::raw::RawShape;
use crate::reading::{Meaning, Reading};
use crate::selection::{Flip, Region, Selection};
use crate::source::read_file;
use crate::volume_source::VolumeSource;

/// Servers and volumes, the most recent first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Recent {
    /// The last open folder.
    pub folder: Option<PathBuf>,
    /// The entries, at most [`Recent::MAX`].
    pub entries: Vec<RecentEntry>,
}

/// Something that was opened.
#[derive(Clone, Debug, PartialEq)]
pub struct RecentEntry {
    /// Its location.
    pub place: RecentPlace,
    /// The name of the volume that it showed.
    pub shows: String,
    /// When it was last used, in seconds since 1970.
    pub used_at: u64,
}

/// The location of an entry.
#[derive(Clone, Debug, PartialEq)]
pub enum RecentPlace {
    /// A server.
    Server {
        /// Name or address.
        host: String,
        /// UDP and TCP port.
        port: u16,
    },
    /// A volume on another machine, for which a server is started there.
    Remote {
        /// The machine and the path there, as the person wrote them.
        place: String,
    },
    /// A volume on this machine.
    Volume(VolumeSource),
}

impl Recent {
    /// Most entries in the list.
    pub const MAX: usize = 12;

    /// Puts an entry first and removes an older one of the same server or volume.
    pub fn note(&mut self, entry: RecentEntry) {
        let is_same = |other: &RecentEntry| match (&other.place, &entry.place) {
            (RecentPlace::Volume(a), RecentPlace::Volume(b)) => a.source == b.source,
            (a, b) => a == b,
        };
        self.entries.retain(|other| !is_same(other));
        self.entries.insert(0, entry);
        self.entries.truncate(Self::MAX);
    }

    /// Puts all entries of a newer list first.
    pub fn note_all(&mut self, newer: Self) {
        for entry in newer.entries.into_iter().rev() {
            self.note(entry);
        }
        self.folder = newer.folder.or(self.folder.take());
    }

    /// Reads the file at `path`. A missing file is an empty list.
    ///
    /// # Errors
    /// The file cannot be read, or it is not such a list.
    pub fn read(path: &Path) -> Result<Self, FormatError> {
        if !path.try_exists().map_err(io_error(path))? {
            return Ok(Self::default());
        }
        let unsupported = |found| FormatError::Unsupported {
            path: shown(path),
            found,
            expected: "a list of what was opened lately, of at most 64 kB",
        };
        let bytes = read_file(path, MAX_BYTES)?.ok_or_else(|| unsupported("a longer file"))?;
        let text = String::from_utf8(bytes).map_err(|_| unsupported("bytes that are not UTF-8"))?;
        Self::parse(&text).map_err(syntax_error(path, &text))
    }

    fn parse(text: &str) -> Result<Self, toml::de::Error> {
        let stored: Stored<toml::Table> = toml::from_str(text)?;
        let entry = |table: toml::Table| table.try_into::<StoredEntry>().ok()?.entry();
        let entries = stored.recent.into_iter().filter_map(entry).take(Self::MAX).collect();
        Ok(Self { folder: stored.folder.map(PathBuf::from), entries })
    }

    /// The list as TOML for [`Recent::read`]. The last entries and the folder are left out if the text would be too
    /// long.
    pub fn to_toml(&self) -> String {
        // A path that is not UTF-8 is not saved.
        let folder = self.folder.as_ref().and_then(|folder| folder.to_str()).map(str::to_owned);
        let mut stored = Stored { folder, recent: self.entries.iter().map(StoredEntry::of).collect() };
        loop {
            let text = toml::to_string(&stored).expect("a list is a table of texts and numbers");
            if text.len() as u64 <= MAX_BYTES {
                return text;
            }
            // At the end only the folder remains, and it may be too long as well.
            if stored.recent.pop().is_none() {
                stored.folder = None;
            }
        }
    }
}

/// The file. Entries are read one by one, so that an invalid one does not affect the others.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored<E> {
    folder: Option<String>,
    #[serde(default)]
    recent: Vec<E>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredEntry {
    server: Option<String>,
    remote: Option<String>,
    volume: Option<String>,
    #[serde(default)]
    shows: String,
    used_at: u64,
    channel: Option<u32>,
    time: Option<u32>,
    level: Option<u32>,
    series: Option<u32>,
    region: Option<String>,
    flip: Option<String>,
    spacing: Option<[f32; 3]>,
    stored_slices: Option<bool>,
    voxels: Option<Meaning>,
    thin: Option<u32>,
    labels: Option<String>,
    raw: Option<RawShape>,
}

impl StoredEntry {
    fn of(entry: &RecentEntry) -> Self {
        let (server, remote, volume) = match &entry.place {
            RecentPlace::Server { host, port } => (Some(format!("{host}:{port}")), None, None),
            RecentPlace::Remote { place } => (None, Some(place.clone()), None),
            RecentPlace::Volume(volume) => (None, None, Some(volume)),
        };
        let selection = volume.map_or(Selection::default(), |v| v.selection);
        let Selection { channel, time, level, series, region, flip } = selection;
        let reading = volume.map_or_else(Reading::default, |v| v.reading.clone());
        Self {
            server,
            remote,
            volume: volume.map(|v| v.source.clone()),
            shows: entry.shows.clone(),
            used_at: entry.used_at,
            channel,
            time,
            level,
            series,
            region: region.map(|r| r.to_string()),
            flip: Some(flip).filter(|f| *f != Flip::default()).map(|f| f.to_string()),
            spacing: volume.and_then(|v| v.spacing).map(Vec3::into),
            stored_slices: reading.stored_slices.then_some(true),
            voxels: reading.voxels,
            thin: reading.thin,
            labels: reading.labels,
            raw: volume.and_then(|v| v.raw),
        }
    }

    /// The entry, or `None` if it is invalid.
    fn entry(self) -> Option<RecentEntry> {
        let Self { channel, time, level, series, spacing, raw, .. } = self;
        let place = match (self.server, self.remote, self.volume) {
            (Some(server), None, None) => {
                let (host, port) = server.rsplit_once(':')?;
                let is_good = !host.is_empty() && !host.chars().any(|c| is_control(c) || c == '#');
                let port = port.parse().ok().filter(|_| is_good)?;
                RecentPlace::Server { host: host.to_owned(), port }
            }
            (None, Some(place), None) if !place.is_empty() && !place.chars().any(is_control) => {
                RecentPlace::Remote { place }
            }
            (None, None, Some(source)) => {
                let region = self.region.and_then(|r| r.parse::<Region>().ok());
                let flip = self.flip.and_then(|f| f.parse().ok()).unwrap_or_default();
                let selection = Selection { channel, time, level, series, region, flip };
                let spacing = spacing.map(Vec3::from);
                let stored_slices = self.stored_slices == Some(true);
                let (voxels, thin, labels) = (self.voxels, self.thin, self.labels);
                let reading = Reading { stored_slices, voxels, thin, labels };
                let volume = VolumeSource { raw, selection, spacing, reading, ..VolumeSource::new(source) };
                RecentPlace::Volume(Some(volume).filter(VolumeSource::is_finite)?)
            }
            _ => return None,
        };
        let shows = printable(&self.shows, MAX_NAME);
        Some(RecentEntry { place, shows, used_at: self.used_at })
    }
}

/// Longest file in bytes.
const MAX_BYTES: u64 = 64 << 10;
/// Longest name of a volume, in characters.
const MAX_NAME: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dtype::{Dtype, Endian};

    fn server(port: u16, used_at: u64) -> RecentEntry {
        let place = RecentPlace::Server { host: "::1".into(), port };
        RecentEntry { place, shows: "head.nrrd".into(), used_at }
    }

    fn volume(source: &str, time: Option<u32>) -> RecentEntry {
        let selection = Selection { time, region: "1:5,:,7:".parse().ok(), ..Selection::default() };
        let place = RecentPlace::Volume(VolumeSource { selection, ..VolumeSource::new(source) });
        RecentEntry { place, shows: "a \"b\"".into(), used_at: 7 }
    }

    #[test]
    fn a_list_survives_its_file() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("recent.toml");
        assert_eq!(Recent::read(&path).unwrap(), Recent::default(), "none is there yet");
        let mut list = Recent { folder: Some("/data/µ".into()), entries: vec![] };
        list.note(volume("/data/a b.nii", Some(3)));
        list.note(raw_volume("/data/scan.raw"));
        list.note(server(4433, u64::from(u32::MAX)));
        list.note(remote());
        std::fs::write(&path, list.to_toml()).unwrap();
        assert_eq!(Recent::read(&path).unwrap(), list);
    }

    fn remote() -> RecentEntry {
        let place = RecentPlace::Remote { place: "me@gpu:/data/a b.nrrd".into() };
        RecentEntry { place, shows: "a b.nrrd".into(), used_at: 9 }
    }

    fn raw_volume(source: &str) -> RecentEntry {
        let raw = RawShape {
            dims: [5, 6, 7],
            dtype: Dtype::Half,
            spacing: Vec3::ONE,
            endian: Endian::Big,
            offset: 512,
        };
        let spacing = Some(Vec3::new(0.1, 0.2, 3.0));
        let place = RecentPlace::Volume(VolumeSource {
            raw: Some(raw),
            spacing,
            selection: Selection { flip: Flip([false, true, false]), ..Selection::default() },
            reading: Reading { stored_slices: true, thin: Some(2), ..Reading::default() },
            ..VolumeSource::new(source)
        });
        RecentEntry { place, shows: "a scan".into(), used_at: 8 }
    }

    #[test]
    fn a_list_that_is_too_long_loses_its_oldest_entries_and_nothing_else() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("recent.toml");
        let far = |i: usize| volume(&format!("/{i}/{}", "\u{1b}".repeat(3000)), None);
        let list = Recent { folder: Some("/data".into()), entries: (0..Recent::MAX).map(far).collect() };
        std::fs::write(&path, list.to_toml()).unwrap();
        let read = Recent::read(&path).unwrap();
        assert!((2..Recent::MAX).contains(&read.entries.len()), "{}", read.entries.len());
        assert_eq!((&read.folder, &read.entries[..]), (&list.folder, &list.entries[..read.entries.len()]));
        // The folder alone is too long, or it is not UTF-8.
        let list = Recent { folder: Some("/".repeat(1 << 17).into()), entries: vec![server(1, 2)] };
        assert_eq!(Recent::parse(&list.to_toml()), Ok(Recent::default()));
        #[cfg(unix)]
        {
            use std::os::unix::ffi::OsStringExt;
            let odd = PathBuf::from(std::ffi::OsString::from_vec(vec![b'/', 0xff]));
            let list = Recent { folder: Some(odd), entries: vec![server(1, 2)] };
            assert_eq!(Recent::parse(&list.to_toml()), Ok(Recent { folder: None, ..list }));
        }
    }

    #[test]
    fn a_newer_list_goes_before_an_older_one() {
        let mut list = Recent { folder: Some("/old".into()), entries: vec![server(1, 1), server(2, 1)] };
        list.note_all(Recent { folder: None, entries: vec![server(2, 9), server(3, 8)] });
        let expected = vec![server(2, 9), server(3, 8), server(1, 1)];
        assert_eq!(list, Recent { folder: Some("/old".into()), entries: expected });
    }

    #[test]
    fn the_newest_is_first_and_nothing_is_there_twice() {
        let mut list = Recent::default();
        for i in 0..40 {
            list.note(server(1 + i % 20, u64::from(i)));
            assert!(list.entries.len() <= Recent::MAX);
            assert_eq!(list.entries[0], server(1 + i % 20, u64::from(i)));
        }
        list.note(volume("/a", Some(1)));
        list.note(server(9, 99));
        list.note(volume("/a", Some(2)));
        let volumes: Vec<_> =
            list.entries.iter().filter(|e| matches!(e.place, RecentPlace::Volume(_))).collect();
        assert_eq!(volumes, [&volume("/a", Some(2))], "another time of the same volume takes its place");
    }

    #[test]
    fn a_damaged_list_is_an_error_or_loses_what_makes_no_sense() {
        let kept = [server(1, 2), volume("/a", None), raw_volume("/b")];
        let good = Recent { folder: None, entries: kept[..2].to_vec() }.to_toml();
        let other = Recent { folder: None, entries: kept[2..].to_vec() }.to_toml();
        for length in 0..good.len() {
            let _ = Recent::parse(&good[..length]);
        }
        let error = |text| syntax_error(Path::new("a"), text)(Recent::parse(text).unwrap_err()).to_string();
        assert!(error("recent = 3").starts_with("a: line 1: "));
        assert!(Recent::parse("token = \"00\"").is_err(), "nothing else is in it");
        for bad in [
            "server = \"h\"",
            "server = \":1\"",
            "server = \"h:99999\"",
            "server = \"h#token=1:1\"",
            "remote = \"\"",
            "remote = \"h:/a\\u001b\"",
            "remote = \"h:/a\"\nserver = \"h:1\"",
            "",
            "volume = \"/a\"\nspacing = [1.0, nan, 1.0]",
            "volume = \"/a\"\nspacing = [1.0, 1.0]",
            "volume = \"/a\"\ntime = -1",
            "volume = \"/a\"\nlater = 1",
            "volume = \"/a\"\nraw = 3",
            "volume = \"/a\"\nraw.dims = [5, 6, 7]\nraw.dtype = \"uint7\"",
            "volume = \"/a\"\nraw.dtype = \"uint8\"",
            "volume = \"/a\"\nraw.dims = [5, 6]\nraw.dtype = \"uint8\"",
            "volume = \"/a\"\nraw.dims = [5, 6, 7]\nraw.dtype = \"uint8\"\nraw.offset = -1",
            "volume = \"/a\"\nraw.dims = [5, 6, 7]\nraw.dtype = \"uint8\"\nraw.spacing = [1.0, inf, 1.0]",
        ] {
            let text = format!("{good}\n[[recent]]\nused_at = 1\n{bad}\n\n{other}");
            assert_eq!(Recent::parse(&text).unwrap().entries, kept, "{bad}");
        }
        // Control: a valid shape is kept.
        let raw = "volume = \"/a\"\nraw.dims = [5, 6, 7]\nraw.dtype = \"uint8\"";
        let read = Recent::parse(&format!("[[recent]]\nused_at = 1\n{raw}\n")).unwrap();
        let RecentPlace::Volume(VolumeSource { raw: Some(raw), .. }) = &read.entries[0].place else {
            panic!("{read:?}")
        };
        assert_eq!((raw.dims, raw.dtype, raw.offset), ([5, 6, 7], Dtype::Uint8, 0));
        let message = error(&format!("\"{}\" = 1", "\\u001b".repeat(5000)));
        assert!(message.len() < 400 && !message.contains(char::is_control), "{message:?}");
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("recent.toml");
        std::fs::write(&path, vec![b'#'; 1 << 17]).unwrap();
        let message = Recent::read(&path).unwrap_err().to_string();
        assert!(message.contains("recent.toml") && message.contains("64 kB"), "{message}");
    }
}
