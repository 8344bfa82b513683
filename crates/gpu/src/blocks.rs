//! Decodes frames in blocks on the GPU, to the same numbers as the twin (`core/src/codec/blocks/`).
//!
//! `tiles` reads the bits of all streams, a workgroup each, and writes their layers and cells. Two passes of
//! `smooth_borders` smooth what the picture should be, and `factors` gives cells the colours for it. `make_tables` counts
//! the frame's bits, for the next one.

use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::blocks::device::{
    DevicePayload, FrameWords, MotionWords, WORDS_OF_CELL, WORDS_OF_LAYER, motion_words, prior_words,
    scale_words,
};
use isinglass_core::layer::FrameHeader;
use wgpu::BindingType;

use crate::device::{Gpu, READ, UNIFORM, WRITE, bind, buffer, check_binding, compute_pipeline, layout};
use crate::error::GpuError;
use crate::gpu_types::{BLOCK, BlockFrame, LANES_OF_BLOCK};
use crate::readback::Readback;
use crate::shaders::{BlockKernel, Kernel};

/// A decoded frame on a device.
pub struct DeviceFrame {
    header: FrameHeader,
    /// What kernels know of it and of its reference.
    uniform: wgpu::Buffer,
    /// Words of blocks, layers and cells.
    words: wgpu::Buffer,
    room: Room,
    /// How often each context had a zero and a one, and the probabilities that follow.
    counts: wgpu::Buffer,
    probabilities: wgpu::Buffer,
    /// What became of the streams; see `coding.wgsl`.
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
    /// Number of streams that are damaged, or that found no room.
    pub num_damaged: u32,
}

/// Decodes frames on one device.
pub struct BlockDecoder {
    device: wgpu::Device,
    queue: wgpu::Queue,
    tiles: Pass,
    borders: [Pass; 2],
    factors: Pass,
    tables: Pass,
    lists: [Pass; 3],
    scales: wgpu::Buffer,
    prior: wgpu::Buffer,
    /// Counts of nothing.
    no_counts: wgpu::Buffer,
    num_contexts: usize,
}

/// A kernel with the types of its bindings.
struct Pass {
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

impl Pass {
    fn new(device: &wgpu::Device, kernel: BlockKernel, entry: &'static str, types: &[BindingType]) -> Self {
        let layout = layout(device, entry, wgpu::ShaderStages::COMPUTE, types);
        Self { pipeline: compute_pipeline(device, Kernel::Blocks(kernel), entry, &[Some(&layout)]), layout }
    }

    /// Adds a dispatch of so many workgroups, with these bindings.
    fn run(
        &self,
        device: &wgpu::Device,
        pass: &mut wgpu::ComputePass<'_>,
        num_groups: u32,
        resources: &[wgpu::BindingResource<'_>],
    ) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &bind(device, "blocks", &self.layout, resources), &[]);
        let rows = num_groups.div_ceil(MOST_GROUPS).max(1);
        pass.dispatch_workgroups(num_groups.div_ceil(rows), rows, 1);
    }
}

/// The planes of a layered frame on a device, which [`BlockDecoder::write_lists`] fills.
pub(crate) struct ListPlanes<'a> {
    pub(crate) offsets: wgpu::BindingResource<'a>,
    pub(crate) depth: wgpu::BindingResource<'a>,
    pub(crate) c_rg: wgpu::BindingResource<'a>,
    pub(crate) c_b_tau: wgpu::BindingResource<'a>,
}

impl BlockDecoder {
    /// A decoder for a device. It compiles kernels, for which some drivers take a minute.
    pub fn new(device: &wgpu::Device, queue: &wgpu::Queue) -> Self {
        use BlockKernel::{Borders, Factors, Lists, Tables, Tiles};
        let borders = |is_below| Pass::new(device, Borders { is_below }, "smooth_borders", &[UNIFORM, WRITE]);
        let lists = |entry| {
            let types = [UNIFORM, READ, READ, WRITE, WRITE, WRITE, WRITE, WRITE];
            Pass::new(device, Lists, entry, &types)
        };
        let prior = prior_words();
        let filled = |label, words: &[u32]| filled(device, queue, label, words);
        Self {
            tiles: Pass::new(device, Tiles, "tiles", &[UNIFORM, READ, READ, READ, READ, WRITE, WRITE, WRITE]),
            borders: [false, true].map(borders),
            factors: Pass::new(device, Factors, "factors", &[UNIFORM, READ, WRITE]),
            tables: Pass::new(device, Tables, "make_tables", &[READ, READ, READ, WRITE, WRITE]),
            lists: ["sum_blocks", "scan_blocks", "write_lists"].map(lists),
            scales: filled("scales", &scale_words()),
            no_counts: storage(device, "counts", prior.len() as u64 * BYTES_OF_COUNTS),
            num_contexts: 2 * prior.len(),
            prior: filled("prior", &prior),
            device: device.clone(),
            queue: queue.clone(),
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
        let Self { device, queue, .. } = self;
        let frame = self.frame(payload.header, room)?;
        queue.write_buffer(&frame.uniform, 0, bytemuck::bytes_of(&uniform_of(payload, before, room)));
        let num_blocks = num_blocks(&payload.header).iter().product::<u32>();
        let picture_bytes = u64::from(num_blocks) * BYTES_OF_PICTURE;
        check_binding(device, "pictures of blocks in bytes", picture_bytes)?;
        let pictures = storage(device, "pictures", picture_bytes);
        let bits = filled(device, queue, "payload", &payload.words);
        let own;
        let probabilities = match before {
            Some(before) => &before.probabilities,
            None => {
                own = filled(device, queue, "probabilities", &payload.probabilities);
                &own
            }
        };
        // Without a reference, nothing of it is read.
        let none = storage(device, "no reference", 4);
        let words_before = before.map_or(&none, |before| &before.words);
        let counts_before = before.map_or(&self.no_counts, |before| &before.counts);
        let DeviceFrame { uniform, words, tally, counts, .. } = &frame;
        let mut encoder = device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let mut run = |kernel: &Pass, num_groups, buffers: &[&wgpu::Buffer]| {
            let resources: Vec<_> = buffers.iter().map(|buffer| buffer.as_entire_binding()).collect();
            kernel.run(device, &mut pass, num_groups, &resources);
        };
        let of_tiles = [uniform, &self.scales, probabilities, &bits, words_before, words, tally, &pictures];
        run(&self.tiles, payload.num_streams as u32, &of_tiles);
        for borders in &self.borders {
            run(borders, (8 * num_blocks).div_ceil(LANES_OF_BLOCK), &[uniform, &pictures]);
        }
        run(&self.factors, num_blocks, &[uniform, &pictures, words]);
        let of_tables = [&self.prior, counts_before, tally, counts, &frame.probabilities];
        run(&self.tables, (self.num_contexts as u32 / 2).div_ceil(LANES_OF_BLOCK), &of_tables);
        drop(pass);
        queue.submit([encoder.finish()]);
        Ok(frame)
    }

    /// Adds what writes the lists of a frame to planes, which have room for all of its cells.
    pub(crate) fn write_lists(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        frame: &DeviceFrame,
        planes: &ListPlanes<'_>,
    ) {
        let num_blocks = (frame.header.camera.intrinsics.num_pixels() as u32).div_ceil(BLOCK);
        let sums = storage(&self.device, "block_sums", u64::from(num_blocks) * 4);
        let [uniform, scales, words, sums] =
            [&frame.uniform, &self.scales, &frame.words, &sums].map(|buffer| buffer.as_entire_binding());
        let ListPlanes { offsets, depth, c_rg, c_b_tau } = planes;
        let resources =
            [uniform, scales, words, sums, offsets.clone(), depth.clone(), c_rg.clone(), c_b_tau.clone()];
        for (kernel, num_groups) in self.lists.iter().zip([num_blocks, 1, num_blocks]) {
            kernel.run(&self.device, pass, num_groups, &resources);
        }
    }

    /// A frame without anything in it. New buffers have zeros.
    fn frame(&self, header: FrameHeader, room: Room) -> Result<DeviceFrame, GpuError> {
        let device = &self.device;
        let [_, first_cell] = first_words(&header, room);
        let bytes = 4 * (u64::from(first_cell) + u64::from(room.cells) * WORDS_OF_CELL as u64);
        check_binding(device, "a frame in blocks in bytes", bytes)?;
        let uniform = buffer(device, "frame", size_of::<BlockFrame>() as u64, wgpu::BufferUsages::UNIFORM);
        Ok(DeviceFrame {
            header,
            uniform,
            words: storage(device, "frame in blocks", bytes),
            room,
            counts: storage(device, "counts", self.num_contexts as u64 / 2 * BYTES_OF_COUNTS),
            probabilities: storage(device, "probabilities", self.num_contexts as u64 * 2),
            tally: storage(device, "tally", (2 * self.num_contexts + 4) as u64 * 4),
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
        let queue = &self.queue;
        queue.write_buffer(&frame.words, 0, bytemuck::cast_slice(&[blocks, layers, cells].concat()));
        queue.write_buffer(&frame.counts, 0, bytemuck::cast_slice(reference.count_words()));
        queue.write_buffer(&frame.probabilities, 0, bytemuck::cast_slice(&reference.probability_words()));
        Ok(frame)
    }

    /// Reads a frame back.
    ///
    /// # Errors
    /// If the device is lost.
    pub fn read(&self, gpu: &Gpu, frame: &DeviceFrame) -> Result<DeviceFrameWords, GpuError> {
        let [mut words, mut counts, mut probabilities, mut tally] = [const { Vec::<u32>::new() }; 4];
        let size = |buffer: &wgpu::Buffer| (buffer.size() / 4) as usize;
        Readback::default().read(
            gpu,
            self.device.create_command_encoder(&Default::default()),
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

/// A buffer that kernels read and write, and that copies can read and write. It begins with zeros.
fn storage(device: &wgpu::Device, label: &str, bytes: u64) -> wgpu::Buffer {
    buffer(device, label, bytes, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC)
}

/// A buffer with words.
fn filled(device: &wgpu::Device, queue: &wgpu::Queue, label: &str, words: &[u32]) -> wgpu::Buffer {
    let buffer = storage(device, label, 4 * words.len() as u64);
    queue.write_buffer(&buffer, 0, bytemuck::cast_slice(words));
    buffer
}

impl DeviceFrame {
    /// Its header.
    pub fn header(&self) -> &FrameHeader {
        &self.header
    }

    /// Room for its layers and cells.
    pub fn room(&self) -> Room {
        self.room
    }
}

/// Bytes of the counts of two contexts.
const BYTES_OF_COUNTS: u64 = 16;
/// A block has a word that says whether it is corrected, and five for each of its lists.
const BYTES_OF_PICTURE: u64 = 4 * (1 + 5 * 64);
/// Most workgroups along an axis of a dispatch.
const MOST_GROUPS: u32 = 65_535;
