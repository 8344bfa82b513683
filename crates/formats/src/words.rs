//! Numbers and texts at fixed places of a binary header.

use crate::dtype::Endian;

/// A header of bytes. What lies beyond its end reads as zero, so lengths are checked first.
#[derive(Clone, Copy)]
pub(crate) struct Words<'a> {
    pub(crate) bytes: &'a [u8],
    pub(crate) endian: Endian,
}

macro_rules! number {
    ($($name:ident),*) => {$(
        /// The number at byte `at`.
        pub(crate) fn $name(&self, at: usize) -> $name {
            let bytes = self.array(at);
            match self.endian {
                Endian::Little => $name::from_le_bytes(bytes),
                Endian::Big => $name::from_be_bytes(bytes),
            }
        }
    )*};
}

impl Words<'_> {
    number!(u16, i16, u32, i32, i64, u64, f32, f64);

    /// Bytes at `at`.
    pub(crate) fn array<const N: usize>(&self, at: usize) -> [u8; N] {
        self.bytes.get(at..).and_then(|rest| rest.first_chunk()).copied().unwrap_or([0; N])
    }
}
