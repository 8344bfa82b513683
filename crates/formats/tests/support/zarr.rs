//! Writes small OME-Zarr images, one chunk after the other.

use std::fs;
use std::path::Path;

/// How a chunk is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    Raw,
    Zstd,
    Blosc,
}

/// An array of version 2. Axes are slowest first.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ArrayText<'a> {
    pub(crate) shape: &'a [u64],
    pub(crate) chunk: &'a [u64],
    /// A type of NumPy, such as `<u2`.
    pub(crate) dtype: &'a str,
    pub(crate) packing: Packing,
}

impl ArrayText<'_> {
    /// Writes all chunks into `folder`. `number` are the bytes of the number at an index.
    pub(crate) fn write(&self, folder: &Path, number: impl Fn(&[u64]) -> Vec<u8>) {
        let Self { shape, chunk, dtype, packing } = *self;
        let compressor = match packing {
            Packing::Raw => "null",
            Packing::Zstd => r#"{"id": "zstd", "level": 1}"#,
            Packing::Blosc => r#"{"id": "blosc", "cname": "lz4", "clevel": 0, "shuffle": 0, "blocksize": 0}"#,
        };
        fs::create_dir_all(folder).unwrap();
        let text = format!(
            r#"{{"zarr_format": 2, "shape": {shape:?}, "chunks": {chunk:?}, "dtype": "{dtype}",
                 "compressor": {compressor}, "filters": null, "order": "C", "fill_value": 0,
                 "dimension_separator": "/"}}"#
        );
        fs::write(folder.join(".zarray"), text).unwrap();
        let counts: Vec<u64> = shape.iter().zip(chunk).map(|(n, c)| n.div_ceil(*c)).collect();
        for at in indices(&counts) {
            let mut bytes = Vec::new();
            for inner in indices(chunk) {
                // What is stored beyond the shape is repeated.
                let index = (0..at.len()).map(|i| (at[i] * chunk[i] + inner[i]).min(shape[i] - 1));
                bytes.extend(number(&index.collect::<Vec<_>>()));
            }
            let names: Vec<String> = at.iter().map(u64::to_string).collect();
            let path = folder.join(names.join("/"));
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, packed(&bytes, packing)).unwrap();
        }
    }
}

/// Writes the attributes of an image. Each level has a folder, a scale and a translation.
pub(crate) fn write_image(folder: &Path, axes: &[&str], levels: &[(Vec<f64>, Vec<f64>)], more: &str) {
    fs::create_dir_all(folder).unwrap();
    let axes: Vec<String> = axes
        .iter()
        .map(|name| {
            let kind = match *name {
                "t" => "time",
                "c" => "channel",
                _ => "space",
            };
            format!(r#"{{"name": "{name}", "type": "{kind}"}}"#)
        })
        .collect();
    let datasets: Vec<String> = levels
        .iter()
        .enumerate()
        .map(|(i, (scale, translation))| {
            format!(
                r#"{{"path": "{i}", "coordinateTransformations": [{{"type": "scale", "scale": {scale:?}}},
                     {{"type": "translation", "translation": {translation:?}}}]}}"#
            )
        })
        .collect();
    let text = format!(
        r#"{{"multiscales": [{{"version": "0.4", "axes": [{}], "datasets": [{}]}}]{more}}}"#,
        axes.join(", "),
        datasets.join(", ")
    );
    fs::write(folder.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    fs::write(folder.join(".zattrs"), text).unwrap();
}

/// All indices below `sides`, the last axis fastest.
pub(crate) fn indices(sides: &[u64]) -> impl Iterator<Item = Vec<u64>> {
    let sides = sides.to_vec();
    (0..sides.iter().product::<u64>()).map(move |mut rest| {
        let mut index = vec![0; sides.len()];
        for (i, side) in index.iter_mut().zip(&sides).rev() {
            *i = rest % side;
            rest /= side;
        }
        index
    })
}

fn packed(bytes: &[u8], packing: Packing) -> Vec<u8> {
    match packing {
        Packing::Raw => bytes.to_vec(),
        Packing::Zstd => zstd::bulk::compress(bytes, 1).unwrap(),
        // A container of version 1 whose bytes are stored as they are.
        Packing::Blosc => {
            let size = bytes.len() as u32;
            let mut out = vec![2, 1, 2, 1];
            [size, size, size + 16].iter().for_each(|n| out.extend(n.to_le_bytes()));
            out.extend(bytes);
            out
        }
    }
}
