//! Decodes frames in blocks on the GPU, to the same numbers as the twin (`core/src/codec/blocks/`).
//!
//! `tiles` reads the bits of all tiles, a workgroup each, and writes their layers and cells. Two passes of
//! `smooth_borders` smooth what the picture should be, and `factors` gives cells the colours for it. `make_tables` counts
//! the frame's bits, for the next one.

use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::blocks::device::{
    DevicePayload, FrameWords, MotionWords, WORDS_OF_CELL, WORDS_OF_LAYER, motion_words, prior_words,
    scale_words,
};
use isinglass_core::layer::FrameHeader;

use crate::device::{Gpu, bind};
use crate::error::GpuError;
use crate::gpu_types::BlockFrame;
use crate::readback::Readback;
use crate::shaders::Kernel;

/// A decoded frame on a device.
pub struct DeviceFrame {
    header: FrameHeader,
    /// Words of blocks, layers and cells.
    words: wgpu::Buffer,
    room: Room,
    /// How often each context had a zero and a one, and the probabilities that follow.
    counts: wgpu::Buffer,
    probabilities: wgpu::Buffer,
    /// What became of the tiles; see `tile.wgsl`.
    tally: wgpu::Buffer,
}

/// Room for layers and cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Most layers.
    pub layers: u32,
    /// Most cells.
    pub cells: u32,
}

/// What a frame on a device has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceFrameWords {
    /// Its blocks, layers and cells, in any order.
    pub words: FrameWords,
    /// See [`Reference::count_words`].
    pub counts: Vec<u32>,
    /// See [`Reference::probability_words`].
    pub probabilities: Vec<u32>,
    /// Number of tiles that are damaged, or that found no room.
    pub num_damaged: u32,
}

/// Decodes frames on one device.
pub struct BlockDecoder {
    gpu: Gpu,
    scales: wgpu::Buffer,
    prior: wgpu::Buffer,
    /// Counts of nothing.
    no_counts: wgpu::Buffer,
    num_contexts: usize,
}

impl BlockDecoder {
    /// A decoder for a device.
    pub fn new(gpu: &Gpu) -> Self {
        let prior = prior_words();
        Self {
            gpu: gpu.clone(),
            scales: filled(gpu, "scales", &scale_words()),
            no_counts: gpu.storage("counts", prior.len() as u64 * BYTES_OF_COUNTS),
            num_contexts: 2 * prior.len(),
            prior: filled(gpu, "prior", &prior),
        }
    }

    /// Decodes a frame, which has this room. `before` is its reference, if it names one.
    ///
    /// # Errors
    /// If the device has too little memory.
    pub fn decode(
        &self,
        payload: &DevicePayload,
        before: Option<&DeviceFrame>,
        room: Room,
    ) -> Result<DeviceFrame, GpuError> {
        let gpu = &self.gpu;
        let frame = self.frame(payload.header, room)?;
        let num_blocks = num_blocks(&payload.header);
        let num_pictures = num_blocks.iter().product::<u32>();
        let picture_bytes = u64::from(num_pictures) * BYTES_OF_PICTURE;
        gpu.check_binding("pictures of blocks in bytes", picture_bytes)?;
        let pictures = gpu.storage("pictures", picture_bytes);
        let uniform = gpu.uniform::<BlockFrame>("frame in blocks");
        gpu.queue().write_buffer(&uniform, 0, bytemuck::bytes_of(&uniform_of(payload, before, room)));
        let bits = filled(gpu, "payload", &payload.words);
        let own;
        let probabilities = match before {
            Some(before) => &before.probabilities,
            None => {
                own = filled(gpu, "probabilities", &payload.probabilities);
                &own
            }
        };
        // Without a reference, nothing of it is read.
        let none = gpu.storage("no reference", 4);
        let words_before = before.map_or(&none, |before| &before.words);
        let counts_before = before.map_or(&self.no_counts, |before| &before.counts);
        let layouts = &gpu.layouts().blocks;
        let group = |label, layout, buffers: &[&wgpu::Buffer]| {
            let resources: Vec<_> = buffers.iter().map(|buffer| buffer.as_entire_binding()).collect();
            bind(gpu.device(), label, layout, &resources)
        };
        let tiles = group(
            "tiles",
            &layouts.tiles,
            &[
                &uniform,
                &self.scales,
                probabilities,
                &bits,
                words_before,
                &frame.words,
                &frame.tally,
                &pictures,
            ],
        );
        let borders = group("borders", &layouts.borders, &[&uniform, &pictures]);
        let factors = group("factors", &layouts.factors, &[&uniform, &pictures, &frame.words]);
        let tables = group(
            "tables",
            &layouts.tables,
            &[&self.prior, counts_before, &frame.tally, &frame.counts, &frame.probabilities],
        );
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let mut run = |kernel, entry, group: &wgpu::BindGroup, num: u32| {
            pass.set_pipeline(&gpu.pipeline(kernel, entry));
            pass.set_bind_group(0, group, &[]);
            let rows = num.div_ceil(MOST_GROUPS).max(1);
            pass.dispatch_workgroups(num.div_ceil(rows), rows, 1);
        };
        run(Kernel::BlockTiles, "tiles", &tiles, payload.num_tiles() as u32);
        let lines = (8 * num_pictures).div_ceil(64);
        for is_below in [false, true] {
            run(Kernel::BlockBorders { is_below }, "smooth_borders", &borders, lines);
        }
        run(Kernel::BlockFactors, "factors", &factors, num_pictures);
        run(Kernel::BlockTables, "make_tables", &tables, (self.num_contexts as u32 / 2).div_ceil(64));
        drop(pass);
        gpu.queue().submit([encoder.finish()]);
        Ok(frame)
    }

    /// A frame without anything in it. New buffers have zeros.
    fn frame(&self, header: FrameHeader, room: Room) -> Result<DeviceFrame, GpuError> {
        let gpu = &self.gpu;
        let bytes = first_words(&header, room).into_iter().map(u64::from).max().unwrap_or(0) * 4
            + u64::from(room.cells) * WORDS_OF_CELL as u64 * 4;
        gpu.check_binding("a frame in blocks in bytes", bytes)?;
        Ok(DeviceFrame {
            header,
            words: gpu.storage("frame in blocks", bytes),
            room,
            counts: gpu.storage("counts", self.num_contexts as u64 / 2 * BYTES_OF_COUNTS),
            probabilities: gpu.storage("probabilities", self.num_contexts as u64 * 2),
            tally: gpu.storage("tally", (2 * self.num_contexts + 4) as u64 * 4),
        })
    }

    /// A frame that was decoded in memory, for the next one on the device.
    ///
    /// # Errors
    /// If the device has too little memory.
    pub fn upload(&self, header: FrameHeader, reference: &Reference) -> Result<DeviceFrame, GpuError> {
        let FrameWords { blocks, layers, cells } = reference.words();
        let room = Room {
            layers: (layers.len() / WORDS_OF_LAYER) as u32,
            cells: (cells.len() / WORDS_OF_CELL) as u32,
        };
        let frame = self.frame(header, room)?;
        let queue = self.gpu.queue();
        queue.write_buffer(&frame.words, 0, bytemuck::cast_slice(&[blocks, layers, cells].concat()));
        queue.write_buffer(&frame.counts, 0, bytemuck::cast_slice(reference.count_words()));
        queue.write_buffer(&frame.probabilities, 0, bytemuck::cast_slice(&reference.probability_words()));
        Ok(frame)
    }

    /// Reads a frame back.
    ///
    /// # Errors
    /// If the device is lost.
    pub fn read(&self, frame: &DeviceFrame) -> Result<DeviceFrameWords, GpuError> {
        let [mut words, mut counts, mut probabilities, mut tally] = [const { Vec::<u32>::new() }; 4];
        let size = |buffer: &wgpu::Buffer| (buffer.size() / 4) as usize;
        Readback::default().read(
            &self.gpu,
            self.gpu.device().create_command_encoder(&Default::default()),
            [&frame.words, &frame.counts, &frame.probabilities, &frame.tally].map(|b| (b, size(b))),
            [&mut words, &mut counts, &mut probabilities, &mut tally],
        )?;
        let [first_layer, first_cell] = first_words(&frame.header, frame.room).map(|word| word as usize);
        let [num_layers, num_cells, num_damaged] = [0, 1, 2].map(|i| tally[2 * self.num_contexts + i]);
        let num_layers = num_layers.min(frame.room.layers) as usize;
        let num_cells = num_cells.min(frame.room.cells) as usize;
        let words = FrameWords {
            blocks: words[..first_layer].to_vec(),
            layers: words[first_layer..][..num_layers * WORDS_OF_LAYER].to_vec(),
            cells: words[first_cell..][..num_cells * WORDS_OF_CELL].to_vec(),
        };
        Ok(DeviceFrameWords { words, counts, probabilities, num_damaged })
    }
}

/// What the kernels know of a frame and its reference.
fn uniform_of(payload: &DevicePayload, before: Option<&DeviceFrame>, room: Room) -> BlockFrame {
    let intrinsics = payload.header.camera.intrinsics;
    let [first_layer, first_cell] = first_words(&payload.header, room);
    let [depth, opacity, color, picture, chroma] = payload.steps;
    let mut frame = BlockFrame {
        size: [intrinsics.width, intrinsics.height],
        num_blocks: num_blocks(&payload.header),
        first_layer,
        first_cell,
        most_layers: room.layers,
        most_cells: room.cells,
        depth: depth.into(),
        opacity: opacity.into(),
        color: color.into(),
        picture: picture.into(),
        chroma: chroma.into(),
        ..bytemuck::Zeroable::zeroed()
    };
    if let Some(before) = before {
        let MotionWords { along, here, shift, is_still } =
            motion_words(&payload.header.camera, &before.header.camera);
        let row = |[x, y, constant]: [i32; 3]| [x, y, constant, 0];
        (frame.along, frame.here) = (along.map(row), here.map(row));
        (frame.shift, frame.is_still) = (shift, is_still.into());
        frame.reference_blocks = num_blocks(&before.header);
        [frame.reference_first_layer, frame.reference_first_cell] = first_words(&before.header, before.room);
    }
    frame
}

/// The first words of layers and of cells.
fn first_words(header: &FrameHeader, room: Room) -> [u32; 2] {
    let first_layer = 2 * num_blocks(header).iter().product::<u32>();
    [first_layer, first_layer + room.layers * WORDS_OF_LAYER as u32]
}

/// Columns and rows of blocks.
fn num_blocks(header: &FrameHeader) -> [u32; 2] {
    let intrinsics = header.camera.intrinsics;
    [intrinsics.width, intrinsics.height].map(|side| side.div_ceil(8))
}

/// A buffer with words.
fn filled(gpu: &Gpu, label: &'static str, words: &[u32]) -> wgpu::Buffer {
    let buffer = gpu.storage(label, 4 * words.len() as u64);
    gpu.queue().write_buffer(&buffer, 0, bytemuck::cast_slice(words));
    buffer
}

/// Bytes of the counts of two contexts.
const BYTES_OF_COUNTS: u64 = 16;
/// A block has a word that says whether it is corrected, and five for each of its lists.
const BYTES_OF_PICTURE: u64 = 4 * (1 + 5 * 64);
/// Most workgroups along an axis of a dispatch.
const MOST_GROUPS: u32 = 65_535;
