//! Small DICOM files: elements as bytes, explicit and little-endian.

/// Bytes of an element of a type with a length of 16 bits, padded to even.
pub(crate) fn element((group, number): (u16, u16), vr: &str, value: &[u8]) -> Vec<u8> {
    let padding = if vr == "UI" { 0 } else { b' ' };
    let value = [value, &[padding][..value.len() % 2]].concat();
    let head = [&group.to_le_bytes()[..], &number.to_le_bytes(), vr.as_bytes()].concat();
    let length = match vr {
        "OW" | "OB" | "SQ" => [&[0, 0][..], &(value.len() as u32).to_le_bytes()].concat(),
        _ => (value.len() as u16).to_le_bytes().to_vec(),
    };
    [head, length, value].concat()
}

/// Text.
pub(crate) fn text(tag: (u16, u16), vr: &str, value: &str) -> Vec<u8> {
    element(tag, vr, value.as_bytes())
}

/// Numbers as text, with a backslash between.
pub(crate) fn decimals(tag: (u16, u16), values: &[f64]) -> Vec<u8> {
    text(tag, "DS", &values.iter().map(f64::to_string).collect::<Vec<_>>().join("\\"))
}

/// A sequence of items, each of these elements.
pub(crate) fn sequence(tag: (u16, u16), items: &[Vec<Vec<u8>>]) -> Vec<u8> {
    let item = |elements: &Vec<Vec<u8>>| {
        let bytes = elements.concat();
        [&[0xfe, 0xff, 0x00, 0xe0][..], &(bytes.len() as u32).to_le_bytes(), &bytes].concat()
    };
    element(tag, "SQ", &items.iter().flat_map(item).collect::<Vec<u8>>())
}

/// A file of these elements, which are put in order, and of frames of 2×2 pixels of 16 bits, each frame of one value.
pub(crate) fn file(syntax: &str, mut elements: Vec<Vec<u8>>, frames: &[u16]) -> Vec<u8> {
    elements.push(text((0x0028, 0x0008), "IS", &frames.len().to_string()));
    let pixels: Vec<u8> = frames.iter().flat_map(|v| [v.to_le_bytes(); 4].concat()).collect();
    with_pixels(syntax, elements, &element((0x7fe0, 0x0010), "OW", &pixels))
}

/// A file of these elements, which are put in order, and of this element with its pixels. Frames have 2×2 pixels of
/// 16 bits, unless the elements say otherwise.
pub(crate) fn with_pixels(syntax: &str, mut elements: Vec<Vec<u8>>, pixels: &[u8]) -> Vec<u8> {
    let short = |number, value: u16| element((0x0028, number), "US", &value.to_le_bytes());
    elements.extend([
        text((0x0008, 0x0060), "CS", "MR"),
        text((0x0020, 0x000e), "UI", "1.2.3"),
        text((0x0020, 0x0011), "IS", "7"),
        text((0x0008, 0x103e), "LO", "made"),
        text((0x0028, 0x0004), "CS", "MONOCHROME2"),
    ]);
    elements.extend([(0x02, 1), (0x10, 2), (0x11, 2), (0x100, 16), (0x103, 0)].map(|(n, v)| short(n, v)));
    // What was named first counts.
    elements.sort_by_key(|e| {
        let word = |i: usize| u16::from_le_bytes([e[i], e[i + 1]]);
        (word(0), word(2))
    });
    let meta = text((0x0002, 0x0010), "UI", syntax);
    [&[0; 128][..], b"DICM", &meta, &elements.concat(), pixels].concat()
}

/// Elements and bytes as they are.
pub(crate) const PLAIN: &str = "1.2.840.10008.1.2.1";
