//! Small TIFF files of any layout: strips and tiles, packings, predictors, byte orders, and offsets of 64 bits.

use std::io::Write;

/// How the numbers of a page lie in its file.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Layout {
    /// Tiles of so many pixels, or else strips of so many rows.
    pub(crate) tile: Option<[usize; 2]>,
    pub(crate) rows: usize,
    /// Number of the packing; 0 is plain.
    pub(crate) packing: u32,
    /// 0 or 1 is none.
    pub(crate) predictor: u32,
    pub(crate) is_planar: bool,
    pub(crate) is_big_endian: bool,
    /// BigTIFF.
    pub(crate) is_big: bool,
    /// The strip or tile of each page that is not there.
    pub(crate) absent: Option<usize>,
}

/// A page of little-endian numbers, the samples of a pixel together.
#[derive(Clone)]
pub(crate) struct TiffPage {
    pub(crate) sides: [usize; 2],
    pub(crate) samples: usize,
    pub(crate) bytes_each: usize,
    /// 1: unsigned, 2: signed, 3: floats.
    pub(crate) format: u32,
    pub(crate) photometric: u32,
    pub(crate) numbers: Vec<u8>,
    pub(crate) description: Option<String>,
    /// More tags of 16-bit numbers.
    pub(crate) shorts: Vec<(u16, Vec<u16>)>,
}

impl TiffPage {
    pub(crate) fn new(sides: [usize; 2], bytes_each: usize, format: u32, numbers: Vec<u8>) -> Self {
        let samples = numbers.len() / (sides[0] * sides[1] * bytes_each);
        let photometric = if samples == 3 { 2 } else { 1 };
        Self {
            sides,
            samples,
            bytes_each,
            format,
            photometric,
            numbers,
            description: None,
            shorts: Vec::new(),
        }
    }

    /// The numbers of one chunk, little-endian, from a pixel on. `sample` is the one of a plane.
    fn chunk(&self, first: [usize; 2], sides: [usize; 2], sample: Option<usize>) -> Vec<u8> {
        let (size, [width, height]) = (self.bytes_each, self.sides);
        let samples = sample.map_or(0..self.samples, |s| s..s + 1);
        let mut bytes = Vec::new();
        for y in first[1]..first[1] + sides[1] {
            for x in first[0]..first[0] + sides[0] {
                for s in samples.clone() {
                    let at = ((y * width + x) * self.samples + s) * size;
                    let is_inside = x < width && y < height;
                    bytes.extend_from_slice(if is_inside {
                        &self.numbers[at..at + size]
                    } else {
                        &[0; 8][..size]
                    });
                }
            }
        }
        bytes
    }

    /// A chunk as it is stored.
    fn packed(&self, mut bytes: Vec<u8>, row: usize, layout: &Layout) -> Vec<u8> {
        let size = self.bytes_each;
        let step = if layout.is_planar { 1 } else { self.samples };
        let number = |bytes: &[u8]| {
            let mut wide = [0; 8];
            wide[..size].copy_from_slice(bytes);
            u64::from_le_bytes(wide)
        };
        for row in bytes.chunks_exact_mut(row * step * size) {
            if layout.predictor == 2 {
                for i in (step * size..row.len()).step_by(size).rev() {
                    let (a, b) =
                        (number(&row[i..i + size]), number(&row[i - step * size..i + size - step * size]));
                    row[i..i + size].copy_from_slice(&a.wrapping_sub(b).to_le_bytes()[..size]);
                }
            }
            if layout.predictor == 3 {
                let count = row.len() / size;
                let mut parts = vec![0; row.len()];
                for (i, byte) in row.iter().enumerate() {
                    parts[(size - 1 - i % size) * count + i / size] = *byte;
                }
                (step..parts.len()).rev().for_each(|i| parts[i] = parts[i].wrapping_sub(parts[i - step]));
                row.copy_from_slice(&parts);
            }
        }
        if layout.is_big_endian && layout.predictor != 3 {
            bytes.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
        match layout.packing {
            0 | 1 => bytes,
            5 => weezl::encode::Encoder::with_tiff_size_switch(weezl::BitOrder::Msb, 8)
                .encode(&bytes)
                .expect("encodes"),
            8 | 32_946 => {
                let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
                encoder.write_all(&bytes).and_then(|()| encoder.finish()).expect("encodes")
            }
            // Runs of one byte, and literal ones.
            32_773 => bytes
                .chunks(100)
                .flat_map(|part| match part {
                    [first, rest @ ..] if rest.iter().all(|b| b == first) && !rest.is_empty() => {
                        vec![(257 - part.len()) as u8, *first]
                    }
                    part => [&[part.len() as u8 - 1][..], part].concat(),
                })
                .collect(),
            50_000 => zstd::bulk::compress(&bytes, 1).expect("encodes"),
            other => panic!("packing {other}"),
        }
    }
}

/// The file with these pages.
pub(crate) fn tiff_file(pages: &[TiffPage], layout: Layout) -> Vec<u8> {
    let (is_big, is_big_endian) = (layout.is_big, layout.is_big_endian);
    let order = |number: u64, size: usize| -> Vec<u8> {
        let mut bytes = number.to_le_bytes()[..size].to_vec();
        if is_big_endian {
            bytes.reverse();
        }
        bytes
    };
    let word = if is_big { 8 } else { 4 };
    let mut file = if is_big_endian { b"MM".to_vec() } else { b"II".to_vec() };
    file.extend(order(if is_big { 43 } else { 42 }, 2));
    if is_big {
        file.extend([order(8, 2), order(0, 2)].concat());
    }
    let mut link = file.len();
    file.extend(vec![0; word]);
    for page in pages {
        let [width, height] = page.sides;
        let sides = layout.tile.unwrap_or([width, layout.rows.clamp(1, height)]);
        let mut chunks: Vec<Vec<u8>> = Vec::new();
        let planes = if layout.is_planar { (0..page.samples).map(Some).collect() } else { vec![None] };
        for sample in planes {
            for y in (0..height).step_by(sides[1]) {
                for x in (0..width).step_by(sides[0]) {
                    let rows = if layout.tile.is_some() { sides[1] } else { sides[1].min(height - y) };
                    chunks.push(page.packed(page.chunk([x, y], [sides[0], rows], sample), sides[0], &layout));
                }
            }
        }
        let (mut offsets, mut lengths) = (Vec::new(), Vec::new());
        for (i, chunk) in chunks.into_iter().enumerate() {
            if layout.absent == Some(i) {
                offsets.push(0);
                lengths.push(0);
                continue;
            }
            lengths.push(chunk.len() as u64);
            // Parts of a page lie apart.
            file.extend(vec![0; file.len() % 2 + if layout.tile.is_some() { 2 } else { 0 }]);
            offsets.push(file.len() as u64);
            file.extend(chunk);
        }
        // Tag, type, size of a value, values.
        let mut tags: Vec<(u16, u16, usize, Vec<u64>)> = vec![
            (256, 4, 4, vec![width as u64]),
            (257, 4, 4, vec![height as u64]),
            (258, 3, 2, vec![8 * page.bytes_each as u64; page.samples]),
            (259, 3, 2, vec![layout.packing.max(1).into()]),
            (262, 3, 2, vec![page.photometric.into()]),
            (277, 3, 2, vec![page.samples as u64]),
            (284, 3, 2, vec![if layout.is_planar { 2 } else { 1 }]),
            (317, 3, 2, vec![layout.predictor.max(1).into()]),
            (339, 3, 2, vec![page.format.into(); page.samples]),
        ];
        let places = if is_big { (16, 8) } else { (4, 4) };
        if layout.tile.is_some() {
            tags.extend([(322, 4, 4, vec![sides[0] as u64]), (323, 4, 4, vec![sides[1] as u64])]);
            tags.extend([(324, places.0, places.1, offsets), (325, places.0, places.1, lengths)]);
        } else {
            tags.push((278, 4, 4, vec![sides[1] as u64]));
            tags.extend([(273, places.0, places.1, offsets), (279, places.0, places.1, lengths)]);
        }
        if let Some(text) = &page.description {
            tags.push((270, 2, 1, text.bytes().chain([0; 8]).map(u64::from).collect()));
        }
        tags.extend(
            page.shorts.iter().map(|(tag, list)| (*tag, 3, 2, list.iter().map(|x| u64::from(*x)).collect())),
        );
        tags.sort_by_key(|tag| tag.0);
        let mut entries = order(tags.len() as u64, if is_big { 8 } else { 2 });
        for (tag, kind, size, values) in &tags {
            let mut bytes: Vec<u8> = values.iter().flat_map(|value| order(*value, *size)).collect();
            if bytes.len() > word {
                file.extend(vec![0; file.len() % 2]);
                let at = file.len() as u64;
                file.extend(bytes);
                bytes = order(at, word);
            }
            bytes.resize(word, 0);
            entries.extend([order((*tag).into(), 2), order((*kind).into(), 2)].concat());
            entries.extend([order(values.len() as u64, word), bytes].concat());
        }
        file.extend(vec![0; file.len() % 2]);
        let at = order(file.len() as u64, word);
        file[link..link + word].copy_from_slice(&at);
        file.extend(entries);
        link = file.len();
        file.extend(vec![0; word]);
    }
    file
}
