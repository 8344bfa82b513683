//! Numbers at fixed offsets of a binary header.

use crate::dtype::Endian;

/// The bytes of a header. Numbers beyond its end are zero, so callers check lengths first.
#[derive(Clone, Copy)]
pub(crate) struct HeaderBytes<'a> {
    pub(crate) bytes: &'a [u8],
    pub(crate) endian: Endian,
}

macro_rules! number {
    ($($name:ident),*) => {$(
        /// The number at offset `at`.
        pub(crate) fn $name(&self, at: usize) -> $name {
            let bytes = self.array(at);
            match self.endian {
                Endian::Little => $name::from_le_bytes(bytes),
                Endian::Big => $name::from_be_bytes(bytes),
            }
        }
    )*};
}

impl HeaderBytes<'_> {
    number!(u16, i16, u32, i32, i64, u64, f32, f64);

    /// The bytes at offset `at`.
    pub(crate) fn array<const N: usize>(&self, at: usize) -> [u8; N] {
        self.bytes.get(at..).and_then(|rest| rest.first_chunk()).copied().unwrap_or([0; N])
    }
}
