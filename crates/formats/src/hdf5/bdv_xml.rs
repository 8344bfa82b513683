//! The description that BigDataViewer keeps beside an HDF5 file: its name, and what each setup is (SpimData 0.2).

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use crate::units::length_unit;

/// What the description says.
#[derive(Debug, Default, PartialEq)]
pub(super) struct BdvXml {
    /// The kind of files that have the images, such as `bdv.hdf5`.
    pub(super) format: String,
    /// The path of the HDF5 file from the folder of the description.
    pub(super) file: String,
    pub(super) setups: Vec<Setup>,
    /// Numbers and names of channels.
    channels: Vec<(u32, String)>,
}

/// What is said of a setup, which is a channel from an angle.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Setup {
    pub(super) id: u32,
    name: String,
    channel: Option<u32>,
    /// Everything but the channel: angle, illumination, tile.
    pub(super) view: Vec<(String, String)>,
    /// Distances of voxels along x, y and z, above zero.
    pub(super) spacing: Option<[f64; 3]>,
    pub(super) unit: Option<&'static str>,
}

impl BdvXml {
    /// Reads a description.
    ///
    /// # Errors
    /// It is no XML, or names no file.
    pub(super) fn from_text(text: &str) -> Result<Self, String> {
        let mut reader = Reader::from_str(text);
        let config = reader.config_mut();
        (config.check_end_names, config.allow_unmatched_ends) = (false, true);
        let (mut found, mut path, mut word) = (Self::default(), Vec::new(), String::new());
        let mut base = String::new();
        loop {
            match reader.read_event().map_err(|e| e.to_string())? {
                Event::Start(tag) => {
                    if path.len() >= MAX_DEPTH || found.setups.len() > MAX_SETUPS {
                        return Err("it has too many parts".into());
                    }
                    found.begin(&tag);
                    path.push(name_of(&tag));
                    word.clear();
                }
                Event::Text(text) => word.push_str(&String::from_utf8_lossy(&text)),
                Event::GeneralRef(name) if &*name == b"amp" => word.push('&'),
                Event::End(_) => {
                    let names: Vec<&str> = path.iter().map(String::as_str).collect();
                    match names[..] {
                        [.., "BasePath"] => base = word.trim().to_owned(),
                        _ => found.set(&names, word.trim()),
                    }
                    path.pop();
                    word.clear();
                }
                Event::Eof => break,
                _ => {}
            }
        }
        if !["", "."].contains(&&*base) && !found.file.is_empty() {
            found.file = format!("{base}/{}", found.file);
        }
        if found.file.is_empty() && found.format.is_empty() {
            return Err("it names no file with images, expected <ImageLoader>".into());
        }
        Ok(found)
    }

    fn begin(&mut self, tag: &BytesStart) {
        match name_of(tag).as_str() {
            "ImageLoader" => {
                let format = tag.try_get_attribute("format").ok().flatten();
                self.format =
                    format.map(|a| String::from_utf8_lossy(&a.value).into_owned()).unwrap_or_default();
            }
            "ViewSetup" => self.setups.push(Setup::default()),
            "Channel" => self.channels.push((u32::MAX, String::new())),
            _ => {}
        }
    }

    /// Takes the text of the element that ends.
    fn set(&mut self, path: &[&str], word: &str) {
        match path {
            [.., "ImageLoader", "hdf5"] => word.clone_into(&mut self.file),
            [.., "Channel", "id"] => {
                if let (Some(channel), Ok(id)) = (self.channels.last_mut(), word.parse()) {
                    channel.0 = id;
                }
            }
            [.., "Channel", "name"] => {
                if let Some(channel) = self.channels.last_mut() {
                    word.clone_into(&mut channel.1);
                }
            }
            _ => {
                let within = path.iter().position(|name| *name == "ViewSetup").map(|i| &path[i + 1..]);
                if let (Some(rest), Some(setup)) = (within, self.setups.last_mut()) {
                    setup.set(rest, word);
                }
            }
        }
    }

    /// What is said of the setup with this number.
    pub(super) fn setup(&self, id: u32) -> Option<&Setup> {
        self.setups.iter().find(|setup| setup.id == id)
    }

    /// The name of the channel that a setup is, or else its own.
    pub(super) fn channel_name(&self, setup: &Setup) -> String {
        let channel = self.channels.iter().find(|(id, _)| Some(*id) == setup.channel);
        // Names of channels are often only their numbers.
        let name =
            channel.map(|(_, name)| name).filter(|name| name.parse::<u32>().is_err() && !name.is_empty());
        name.unwrap_or(&setup.name).clone()
    }
}

impl Setup {
    fn set(&mut self, path: &[&str], word: &str) {
        match path {
            ["id"] => self.id = word.parse().unwrap_or(u32::MAX),
            ["name"] => word.clone_into(&mut self.name),
            ["voxelSize", "unit"] => self.unit = length_unit(word).map(|(_, name)| name),
            ["voxelSize", "size"] => {
                let numbers: Vec<f64> =
                    word.split_whitespace().filter_map(|number| number.parse().ok()).collect();
                let spacing = <[f64; 3]>::try_from(numbers).ok();
                self.spacing =
                    spacing.filter(|steps| steps.iter().all(|step| *step > 0.0 && step.is_finite()));
            }
            ["attributes", "channel"] => self.channel = word.parse().ok(),
            ["attributes", name] => self.view.push(((*name).to_owned(), word.to_owned())),
            _ => {}
        }
    }
}

fn name_of(tag: &BytesStart) -> String {
    String::from_utf8_lossy(tag.local_name().as_ref()).into_owned()
}

/// Deepest element, and most setups.
const MAX_DEPTH: usize = 32;
const MAX_SETUPS: usize = 1 << 16;
