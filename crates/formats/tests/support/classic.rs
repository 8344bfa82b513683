//! Writes small classic netCDF files (CDF-1).

/// A file.
pub(crate) struct ClassicFile {
    /// Names and lengths.
    pub(crate) dims: Vec<(&'static str, u32)>,
    pub(crate) variables: Vec<ClassicVariable>,
}

pub(crate) struct ClassicVariable {
    pub(crate) name: &'static str,
    /// The places of its dimensions, the slowest first.
    pub(crate) dims: Vec<u32>,
    pub(crate) attributes: Vec<(&'static str, Attribute)>,
    pub(crate) numbers: Numbers,
}

#[derive(Clone, Debug)]
pub(crate) enum Attribute {
    Text(&'static str),
}

pub(crate) enum Numbers {
    Double(Vec<f64>),
}

impl ClassicFile {
    pub(crate) fn bytes(&self) -> Vec<u8> {
        // The length of the header does not depend on the offsets in it.
        let length = self.header(0).len();
        let mut bytes = self.header(length as u32);
        bytes.extend(self.variables.iter().flat_map(|v| v.numbers.bytes()));
        bytes
    }

    fn header(&self, length: u32) -> Vec<u8> {
        let mut out = b"CDF\x01\0\0\0\0".to_vec();
        put_list(&mut out, 10, self.dims.len());
        for (dim, size) in &self.dims {
            put_name(&mut out, dim);
            out.extend(size.to_be_bytes());
        }
        put_list(&mut out, 12, 0);
        put_list(&mut out, 11, self.variables.len());
        let mut begin = length;
        for variable in &self.variables {
            put_name(&mut out, variable.name);
            out.extend((variable.dims.len() as u32).to_be_bytes());
            variable.dims.iter().for_each(|dim| out.extend(dim.to_be_bytes()));
            put_list(&mut out, 12, variable.attributes.len());
            for (name, Attribute::Text(text)) in &variable.attributes {
                put_name(&mut out, name);
                out.extend(2u32.to_be_bytes());
                put_name(&mut out, text);
            }
            let size = variable.numbers.bytes().len() as u32;
            out.extend([6u32, size, begin].iter().flat_map(|n| n.to_be_bytes()));
            begin += size;
        }
        out
    }
}

impl Numbers {
    fn bytes(&self) -> Vec<u8> {
        let Self::Double(list) = self;
        list.iter().flat_map(|x| x.to_be_bytes()).collect()
    }
}

/// The tag and the length of a list; an empty one has no tag.
fn put_list(out: &mut Vec<u8>, tag: u32, count: usize) {
    let tag = if count == 0 { 0 } else { tag };
    out.extend([tag, count as u32].iter().flat_map(|n| n.to_be_bytes()));
}

/// The length and the bytes of a text, up to a multiple of four.
fn put_name(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_be_bytes());
    out.extend(text.bytes());
    out.resize(out.len().next_multiple_of(4), 0);
}
