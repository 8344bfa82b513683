//! What the bits of a chunk are for: each costs what its estimate says that it is worth (Shannon 1948), so that the sum is
//! what the coder takes, but for a few bytes at its end.

use super::super::header::ChunkHeader;
use super::super::spent::{Spent, TileClass, whole_bytes};
use super::super::{CodecError, HEADER_BYTES};
use super::chunk::read;
use super::entropy::{Coder, Decoder, Model, Reader};
use super::model::BLOCK;
use super::reference::References;

/// What a bit is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum About {
    /// Which blocks have planes, and where from.
    Blocks,
    /// How many layers, and the depths between them.
    Cuts,
    /// Which lists have matter in a layer, and whether it is predicted from the frame before.
    Lists,
    Opacity,
    Brightness,
    Color,
    /// Of the picture at the frame's own pose.
    Correction,
}

impl About {
    const ALL: [Self; 7] = [
        Self::Blocks,
        Self::Cuts,
        Self::Lists,
        Self::Opacity,
        Self::Brightness,
        Self::Color,
        Self::Correction,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Blocks => "blocks",
            Self::Cuts => "cuts",
            Self::Lists => "lists",
            Self::Opacity => "opacity",
            Self::Brightness => "brightness",
            Self::Color => "colour",
            Self::Correction => "correction",
        }
    }
}

/// What a block is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BlockClass {
    Empty,
    /// Its planes are coded.
    Fresh,
    /// Its planes are those of a block beside it, continued.
    Continued,
    /// Its planes are those of the frame before, moved.
    Kept,
    /// All of it is that of the frame before.
    Copied,
}

impl BlockClass {
    const ALL: [Self; 5] = [Self::Empty, Self::Fresh, Self::Continued, Self::Kept, Self::Copied];

    fn name(self) -> &'static str {
        match self {
            Self::Empty => "empty",
            Self::Fresh => "own cuts",
            Self::Continued => "cuts from beside",
            Self::Kept => "cuts from before",
            Self::Copied => "copied",
        }
    }
}

/// Reads, and counts.
#[derive(Debug)]
pub(super) struct Meter<'a> {
    decoder: Decoder<'a>,
    about: About,
    /// Bits of each matter.
    bits: [f64; About::ALL.len()],
    /// Of the block that is being read, of those of each class, and how many these are.
    block_bits: f64,
    class_bits: [f64; BlockClass::ALL.len()],
    nums: [usize; BlockClass::ALL.len()],
}

impl<'a> Meter<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self {
            decoder: Decoder::new(bytes),
            about: About::Blocks,
            bits: [0.0; About::ALL.len()],
            block_bits: 0.0,
            class_bits: [0.0; BlockClass::ALL.len()],
            nums: [0; BlockClass::ALL.len()],
        }
    }

    fn count(&mut self, bits: f64) {
        self.bits[self.about as usize] += bits;
        self.block_bits += bits;
    }
}

impl Coder for Meter<'_> {
    const ENCODES: bool = false;

    fn bit(&mut self, model: &mut Model, _: bool) -> bool {
        let before = *model;
        let bit = self.decoder.bit(model, false);
        self.count(before.bits(bit));
        bit
    }

    fn raw(&mut self, count: u32, _: u32) -> u32 {
        self.count(count.into());
        self.decoder.raw(count, 0)
    }

    fn is_overrun(&self) -> bool {
        self.decoder.is_overrun()
    }

    fn about(&mut self, about: About) {
        self.about = about;
    }

    fn end_block(&mut self, class: BlockClass) {
        self.class_bits[class as usize] += std::mem::take(&mut self.block_bits);
        self.nums[class as usize] += 1;
    }
}

impl Reader for Meter<'_> {
    fn is_at_end(&self) -> bool {
        self.decoder.is_at_end()
    }
}

/// What a chunk of the rate mode spends its bytes on.
pub(in super::super) fn spent(
    header: ChunkHeader,
    bytes: &[u8],
    references: &References,
) -> Result<Spent, CodecError> {
    let mut coded = 0;
    let begin = |bytes| {
        let meter = Meter::new(bytes);
        coded = bytes.len();
        meter
    };
    let (meter, _) = read(header, bytes, references, begin)?;
    let mut parts = vec![("header", HEADER_BYTES), ("head", bytes.len() - HEADER_BYTES - coded)];
    let matters = whole_bytes(coded, meter.bits);
    parts.extend(About::ALL.map(|about| (about.name(), matters[about as usize])));
    // What follows the blocks is their correction.
    let in_blocks = coded - matters[About::Correction as usize];
    let tiles = whole_bytes(in_blocks, meter.class_bits);
    let tiles = BlockClass::ALL.map(|class| TileClass {
        name: class.name(),
        num: meter.nums[class as usize],
        bytes: tiles[class as usize],
    });
    Ok(Spent { parts, tile_side: BLOCK, tiles: tiles.to_vec() })
}

#[cfg(test)]
mod tests {
    use super::super::entropy::Encoder;
    use super::*;

    /// The law: what is counted is what the coder takes, but for the bytes that it ends with.
    #[test]
    fn the_bits_that_are_counted_are_those_of_the_stream() {
        let walk = |coder: &mut dyn FnMut(&mut Model, bool, u32)| {
            let mut models = [Model::START; 3];
            for i in 0..30_000u32 {
                coder(&mut models[i as usize % 3], i.is_multiple_of([2, 11, 97][i as usize % 3]), i);
            }
        };
        let mut encoder = Encoder::new();
        walk(&mut |model, bit, i| {
            encoder.bit(model, bit);
            encoder.raw(i % 3, i % 2);
        });
        let bytes = encoder.finish();
        let mut meter = Meter::new(&bytes);
        walk(&mut |model, _, i| {
            meter.about(if i % 2 == 0 { About::Cuts } else { About::Color });
            meter.bit(model, false);
            meter.raw(i % 3, 0);
        });
        assert!(meter.is_at_end());
        let [cuts, color] = [About::Cuts, About::Color].map(|a| meter.bits[a as usize] / 8.0);
        let sum = cuts + color;
        assert!((sum - bytes.len() as f64).abs() < 8.0, "{sum} counted, {} taken", bytes.len());
        assert!(cuts > 0.2 * sum && color > 0.2 * sum, "{cuts} {color}");
    }
}
