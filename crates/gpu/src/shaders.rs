//! The text of the kernels: plain concatenations of the parts in `shaders/`, in the order stated here.

use isinglass_core::kernels::layering::parts::Gathered;
use isinglass_core::kernels::raycast::{CastOptions, Reconstruction};
use isinglass_core::mode::{Compositing, Mode};

/// Storage of the voxels as a shader sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TexelKind {
    /// 8- and 16-bit unsigned integers.
    Uint,
    /// Single-precision floats.
    Float,
}

/// Where a march ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Extent {
    /// At opaque matter.
    Opaque,
    /// At the far side.
    Through,
}

/// The frames of a novel view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Frames {
    /// One layered frame, at the cost of one.
    #[default]
    One,
    /// Up to four.
    Several,
}

/// The purpose of a casting pipeline. Its constants (`override` in the text) remove unused code, registers and
/// branches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Purpose {
    pub(crate) frames: Frames,
    pub(crate) compositing: Compositing,
    pub(crate) reconstruction: Reconstruction,
    pub(crate) skips_empty_space: bool,
}

impl Default for Purpose {
    fn default() -> Self {
        Self::new(Frames::One, Compositing::Over, &CastOptions::default())
    }
}

impl Purpose {
    /// The purpose for frames that are cast with these options.
    pub(crate) fn new(frames: Frames, compositing: Compositing, options: &CastOptions) -> Self {
        Self {
            frames,
            compositing,
            reconstruction: options.reconstruction,
            skips_empty_space: options.skips_empty_space,
        }
    }

    fn constants(self) -> Vec<(&'static str, f64)> {
        let is = |condition: bool| f64::from(u8::from(condition));
        vec![
            ("COMPOSITING", f64::from(self.compositing as u32)),
            ("IS_NEAREST", is(self.reconstruction == Reconstruction::Nearest)),
            ("SKIPS_EMPTY_SPACE", is(self.skips_empty_space)),
        ]
    }
}

/// The purpose of a marching kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MarchPurpose {
    /// How the kernel reads the voxels.
    pub(crate) kind: TexelKind,
    pub(crate) mode: Mode,
    /// Whether matter has highlights, for which a march reads 32 voxels a step.
    pub(crate) is_glossy: bool,
    /// Whether there are voxels with nothing in them.
    pub(crate) has_gaps: bool,
    /// Whether the texels are those of pages.
    pub(crate) has_pages: bool,
    /// The channels, if several are marched together or one has labels.
    pub(crate) mixed: Option<MixedPurpose>,
}

/// How channels are marched together. Bit i of a mask is channel i.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MixedPurpose {
    /// At least 1.
    pub(crate) num_channels: u8,
    /// Channels of floats.
    pub(crate) floats: u8,
    /// Channels of labels.
    pub(crate) labels: u8,
    /// Whether media mix.
    pub(crate) is_over: bool,
}

/// What is gathered along rays: see [`Gathered`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GatheredKind {
    Pieces,
    Steps,
    Seen,
}

impl From<Gathered> for GatheredKind {
    fn from(what: Gathered) -> Self {
        match what {
            Gathered::Pieces(_) => Self::Pieces,
            Gathered::Steps => Self::Steps,
            Gathered::Seen => Self::Seen,
        }
    }
}

/// A kernel that decodes frames in blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BlockKernel {
    /// Entry point `tiles`: blocks from their bits.
    Tiles,
    /// Entry point `smooth_borders`: those to lower blocks, or to blocks on the right.
    Borders { is_below: bool },
    /// Entry point `factors`: the corrected colours of cells.
    Factors,
    /// Entry point `make_tables`: the probabilities that follow from a frame.
    Tables,
    /// Entry points `sum_blocks`, `scan_blocks`, `write_lists`: lists from blocks.
    Lists,
}

impl BlockKernel {
    fn parts(self) -> &'static [&'static str] {
        match self {
            Self::Tiles => &[
                BLOCK_FRAME,
                BLOCK_NUMBERS,
                BLOCK_ROOTS,
                BLOCK_SCALES,
                BLOCK_ENTROPY,
                BLOCK_SYNTAX,
                BLOCK_MOTION,
                BLOCK_FETCH,
                BLOCK_DEPTH,
                BLOCK_LAYER,
                BLOCK_CORRECTIONS,
                BLOCK_CODING,
            ],
            Self::Borders { .. } => &[BLOCK_FRAME, BLOCK_ROOTS, BLOCK_SMOOTH],
            Self::Factors => &[BLOCK_FRAME, BLOCK_NUMBERS, BLOCK_ROOTS, BLOCK_FACTORS],
            Self::Tables => &[BLOCK_TABLES],
            Self::Lists => &[
                BLOCK_FRAME,
                BLOCK_NUMBERS,
                BLOCK_ROOTS,
                BLOCK_SCALES,
                TYPES,
                LAYER,
                BLOCK_TO_FRAME,
                OFFSETS,
            ],
        }
    }
}

/// A variant of a kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kernel {
    /// Entry point `render`.
    Render(MarchPurpose, Extent),
    /// Entry points `generate`, `count` and `choose`. K is read from a buffer: drivers take seconds to compile a
    /// kernel.
    Generate(MarchPurpose),
    /// Entry point `gather`: what a process sends about its part of a volume.
    Gather(MarchPurpose, GatheredKind),
    /// Entry points `sum_blocks`, `scan_blocks`, `compact`.
    Compact,
    /// Entry point `empty_space`.
    EmptySpace,
    /// What decodes frames in blocks.
    Blocks(BlockKernel),
    /// Entry point `raycast`.
    RaycastCompute(Purpose),
    /// Entry points `view_vertex`, `view_fragment`, and whether the shader encodes sRGB.
    RaycastView(Purpose, bool),
    /// Entry points `upscale_vertex`, `upscale_fragment`.
    Upscale,
}

impl Kernel {
    /// All `override` constants of the pipeline.
    pub(crate) fn constants(self) -> Vec<(&'static str, f64)> {
        match self {
            Self::RaycastCompute(purpose) => purpose.constants(),
            Self::RaycastView(purpose, encodes_srgb) => {
                let mut constants = purpose.constants();
                constants.push(("ENCODES_SRGB", f64::from(u8::from(encodes_srgb))));
                constants
            }
            Self::Blocks(BlockKernel::Borders { is_below }) => {
                vec![("IS_BELOW", f64::from(u8::from(is_below)))]
            }
            _ => Vec::new(),
        }
    }

    pub(crate) fn source(self) -> String {
        let parts: &[&str] = match self {
            Self::Render(purpose, extent) => {
                return [&purpose.text(), &purpose.seen(extent), RENDER].concat();
            }
            Self::Gather(purpose, kind) => return [&purpose.text(), PARTS, &purpose.gathered(kind)].concat(),
            Self::Generate(purpose) => {
                let mode = purpose.mode;
                let crossings = if mode == Mode::Iso { SURFACES } else { "" };
                let is_mean = format!("const IS_MEAN: bool = {};\n", mode == Mode::Average);
                let list: &[&str] = match mode {
                    Mode::Composite | Mode::Iso => &[VISIBILITY_MERGE, UNITED_OVER],
                    Mode::Mip | Mode::MinIp => &[PROJECTION, PROJECTION_KEYS],
                    Mode::Average => &[PROJECTION, PROJECTION_MEAN],
                };
                let text = purpose.text();
                return [&[&text, crossings, &is_mean, BUDGET, GENERATE, STREAM][..], list].concat().concat();
            }
            Self::Compact => &[TYPES, COMPACT, OFFSETS],
            Self::Blocks(kernel) => kernel.parts(),
            Self::Upscale => &[TYPES, PICTURE, UPSCALE],
            Self::EmptySpace => &[TYPES, SPACE, LAYER, EMPTY_SPACE, WAY, EMPTY_SPACE_BUILD],
            Self::RaycastCompute(Purpose { frames, .. }) => {
                &[TYPES, SPACE, LAYER, EMPTY_SPACE, WAY, RAYCAST, frames.part(), RAYCAST_COMPUTE]
            }
            Self::RaycastView(Purpose { frames, .. }, _) => {
                &[TYPES, SPACE, LAYER, PICTURE, EMPTY_SPACE, WAY, RAYCAST, frames.part(), RAYCAST_VIEW]
            }
        };
        parts.concat()
    }
}

impl MarchPurpose {
    /// The text from the types to what handles two samples in a mode: parts and generated lines.
    fn text(self) -> String {
        let sent = if self.is_glossy { GLOSSY } else { MATTE };
        let num_others = self.mixed.map_or(0, |mixed| mixed.num_channels - 1);
        let gaps = match self.has_gaps {
            true => GAPS.replace("BINDING", &(FIRST_CHANNEL_BINDING + num_others).to_string()),
            false => "fn is_gap(p: vec3f) -> bool {\n    return false;\n}\n".into(),
        };
        let field = match self.has_pages {
            true => {
                let table = FIRST_CHANNEL_BINDING + num_others + u8::from(self.has_gaps);
                PAGES.replace("TABLE", &table.to_string()).replace("FIELDS", &(table + 1).to_string())
            }
            false => WHOLE.into(),
        };
        let start = [TYPES, SPACE, LAYER, self.kind.part(), MARCH, &field, &gaps, sent];
        if let Some(mixed) = self.mixed {
            return [&start.concat(), &mixed.text(), MIXED].concat();
        }
        let [generated, takes] = match self.mode {
            Mode::Composite => ["", ABSORPTION],
            Mode::Mip => ["const IS_LEAST: bool = false;\n", KEYS],
            Mode::MinIp => ["const IS_LEAST: bool = true;\n", KEYS],
            Mode::Average => ["", MEAN],
            Mode::Iso => ["", CROSSINGS],
        };
        [&start[..], &[ONE_CHANNEL, generated, takes]].concat().concat()
    }

    /// The parts that say what is seen of a ray.
    fn seen(self, extent: Extent) -> String {
        let crossings = if self.mode == Mode::Iso { BARE } else { "" };
        let [extent, seen] = match self.mode {
            Mode::Composite | Mode::Iso => [extent.part(), SEEN_OVER],
            Mode::Mip | Mode::MinIp => ["", SEEN_GREATEST],
            Mode::Average => ["", SEEN_MEAN],
        };
        [crossings, extent, seen].concat()
    }

    /// The parts that make items of what a ray meets.
    fn gathered(self, kind: GatheredKind) -> String {
        let mode = self.mode;
        if kind == GatheredKind::Seen {
            return [&self.seen(Extent::Opaque), PART_SEEN].concat();
        }
        let is_mean = format!("const IS_MEAN: bool = {};\n", mode == Mode::Average);
        let hides = format!("const HIDES: bool = {};\n", mode == Mode::Composite);
        let parts: &[&str] = match (kind, mode) {
            (GatheredKind::Steps, Mode::Iso) => &[&hides, PART_STEPS, PART_RAW_CROSSINGS],
            (GatheredKind::Steps, _) => &[&hides, PART_STEPS],
            (_, Mode::Composite) => &[STREAM, VISIBILITY_MERGE, PART_MATTER],
            (_, Mode::Iso) => &[PART_CROSSINGS],
            (_, Mode::Mip | Mode::MinIp) => &[&is_mean, STREAM, PROJECTION, PART_GREATEST],
            (_, Mode::Average) => &[&is_mean, STREAM, PROJECTION, PART_MEAN],
        };
        [&[NEVER_BEATEN][..], parts].concat().concat()
    }

    /// The kinds of the voxels from the first channel on.
    pub(crate) fn kinds(self) -> Vec<TexelKind> {
        let others = self.mixed.map_or(0..0, |mixed| 1..mixed.num_channels);
        let is_float = |channel: u8| self.mixed.is_some_and(|mixed| mixed.floats >> channel & 1 == 1);
        let other = |channel| if is_float(channel) { TexelKind::Float } else { TexelKind::Uint };
        std::iter::once(self.kind).chain(others.map(other)).collect()
    }
}

impl MixedPurpose {
    /// The parts of the channels, and the lines that read and classify each by its number.
    fn text(self) -> String {
        let (mut text, mut samples, mut sums) = (String::new(), [const { String::new() }; 8], String::new());
        for channel in 0..self.num_channels {
            let (is_first, are_labels) = (channel == 0, self.labels >> channel & 1 == 1);
            if !is_first {
                let texel = if self.floats >> channel & 1 == 1 { "f32" } else { "u32" };
                let part = CHANNEL.replace("CHANNEL", &channel.to_string()).replace("TEXEL", texel);
                text += &part.replace("BINDING", &(FIRST_CHANNEL_BINDING + channel - 1).to_string());
            }
            let i = usize::from(channel);
            let stored = if is_first { "stored".into() } else { format!("stored_{channel}") };
            samples[i] = match (are_labels, is_first) {
                (true, _) => format!("label_position({channel}u, {stored}(nearest_voxel(p)))"),
                (false, true) => "domain_at(p)".into(),
                (false, false) => format!("domain_{channel}(p)"),
            };
            let classify = if are_labels { "classify_labels" } else { "classify" };
            let at = format!("{}.{}", ["a", "b"][i / 4], ["x", "y", "z", "w"][i % 4]);
            sums +=
                &format!("    mixed = with_channel(mixed, {classify}({channel}u, x0.{at}, x1.{at}, h));\n");
        }
        let sample = |i: usize| if samples[i].is_empty() { "0.0" } else { &*samples[i] };
        let half = |first: usize| [0, 1, 2, 3].map(|i| sample(first + i)).join(", ");
        text += &format!("const IS_OVER: bool = {};\n", self.is_over);
        text += &format!(
            "fn at_point(p: vec3f) -> At {{\n    return At(vec4f({}), vec4f({}));\n}}\n",
            half(0),
            half(4)
        );
        text += &format!(
            "fn mixed_between(x0: At, x1: At, h: f32) -> Mixed {{\n    var mixed = Mixed();\n{sums}    return mixed;\n}}\n"
        );
        text
    }
}

/// Binding of the second channel's voxels.
const FIRST_CHANNEL_BINDING: u8 = 5;

impl Frames {
    fn part(self) -> &'static str {
        match self {
            Self::One => ONE_FRAME,
            Self::Several => COMBINE,
        }
    }
}

impl Extent {
    fn part(self) -> &'static str {
        match self {
            Self::Opaque => "const STOP_AT: f32 = TRANSMITTANCE_MIN;\n",
            Self::Through => "const STOP_AT: f32 = -1.0;\n",
        }
    }
}

impl TexelKind {
    fn part(self) -> &'static str {
        match self {
            Self::Uint => TEXELS_UINT,
            Self::Float => TEXELS_FLOAT,
        }
    }
}

/// No brick is useless because of what is in front of it.
const NEVER_BEATEN: &str = "fn is_beaten(brick: u32) -> bool {\n    return false;\n}\n";
const TYPES: &str = include_str!("../../../shaders/shared/types.wgsl");
const SPACE: &str = include_str!("../../../shaders/shared/space.wgsl");
const LAYER: &str = include_str!("../../../shaders/shared/layer.wgsl");
const PICTURE: &str = include_str!("../../../shaders/shared/picture.wgsl");
const TEXELS_UINT: &str = include_str!("../../../shaders/shared/texels_uint.wgsl");
const TEXELS_FLOAT: &str = include_str!("../../../shaders/shared/texels_float.wgsl");
const MARCH: &str = include_str!("../../../shaders/march.wgsl");
const WHOLE: &str = include_str!("../../../shaders/march/whole.wgsl");
const PAGES: &str = include_str!("../../../shaders/march/pages.wgsl");
const ONE_CHANNEL: &str = include_str!("../../../shaders/march/one.wgsl");
const MIXED: &str = include_str!("../../../shaders/march/mixed.wgsl");
const GAPS: &str = include_str!("../../../shaders/march/gaps.wgsl");
const CHANNEL: &str = include_str!("../../../shaders/march/channel.wgsl");
const MATTE: &str = include_str!("../../../shaders/march/matte.wgsl");
const GLOSSY: &str = include_str!("../../../shaders/march/glossy.wgsl");
const ABSORPTION: &str = include_str!("../../../shaders/march/absorption.wgsl");
const KEYS: &str = include_str!("../../../shaders/march/keys.wgsl");
const MEAN: &str = include_str!("../../../shaders/march/mean.wgsl");
const CROSSINGS: &str = include_str!("../../../shaders/march/crossings.wgsl");
const SURFACES: &str = include_str!("../../../shaders/march/surfaces.wgsl");
const BARE: &str = include_str!("../../../shaders/march/bare.wgsl");
const SEEN_OVER: &str = include_str!("../../../shaders/render/over.wgsl");
const SEEN_GREATEST: &str = include_str!("../../../shaders/render/greatest.wgsl");
const SEEN_MEAN: &str = include_str!("../../../shaders/render/mean.wgsl");
const WAY: &str = include_str!("../../../shaders/shared/way.wgsl");
const BUDGET: &str = include_str!("../../../shaders/layering/budget.wgsl");
const STREAM: &str = include_str!("../../../shaders/layering/stream.wgsl");
const PROJECTION: &str = include_str!("../../../shaders/layering/projection.wgsl");
const PROJECTION_KEYS: &str = include_str!("../../../shaders/layering/projection_keys.wgsl");
const PROJECTION_MEAN: &str = include_str!("../../../shaders/layering/projection_mean.wgsl");
const RENDER: &str = include_str!("../../../shaders/render.wgsl");
const GENERATE: &str = include_str!("../../../shaders/layering/generate.wgsl");
const UNITED_OVER: &str = include_str!("../../../shaders/layering/united_over.wgsl");
const VISIBILITY_MERGE: &str = include_str!("../../../shaders/layering/visibility_merge.wgsl");
const PARTS: &str = include_str!("../../../shaders/layering/parts.wgsl");
const PART_MATTER: &str = include_str!("../../../shaders/layering/parts/matter.wgsl");
const PART_CROSSINGS: &str = include_str!("../../../shaders/layering/parts/crossings.wgsl");
const PART_GREATEST: &str = include_str!("../../../shaders/layering/parts/greatest.wgsl");
const PART_MEAN: &str = include_str!("../../../shaders/layering/parts/mean.wgsl");
const PART_STEPS: &str = include_str!("../../../shaders/layering/parts/steps.wgsl");
const PART_RAW_CROSSINGS: &str = include_str!("../../../shaders/layering/parts/raw_crossings.wgsl");
const PART_SEEN: &str = include_str!("../../../shaders/layering/parts/seen.wgsl");
const OFFSETS: &str = include_str!("../../../shaders/shared/offsets.wgsl");
const COMPACT: &str = include_str!("../../../shaders/layering/compact.wgsl");
const EMPTY_SPACE: &str = include_str!("../../../shaders/empty_space.wgsl");
const EMPTY_SPACE_BUILD: &str = include_str!("../../../shaders/empty_space_build.wgsl");
const RAYCAST: &str = include_str!("../../../shaders/raycast.wgsl");
const ONE_FRAME: &str = include_str!("../../../shaders/one_frame.wgsl");
const COMBINE: &str = include_str!("../../../shaders/combine.wgsl");
const RAYCAST_COMPUTE: &str = include_str!("../../../shaders/raycast_compute.wgsl");
const UPSCALE: &str = include_str!("../../../shaders/upscale.wgsl");
const RAYCAST_VIEW: &str = include_str!("../../../shaders/raycast_view.wgsl");
const BLOCK_FRAME: &str = include_str!("../../../shaders/blocks/frame.wgsl");
const BLOCK_NUMBERS: &str = include_str!("../../../shaders/blocks/numbers.wgsl");
const BLOCK_ROOTS: &str = include_str!("../../../shaders/blocks/roots.wgsl");
const BLOCK_SCALES: &str = include_str!("../../../shaders/blocks/scales.wgsl");
const BLOCK_ENTROPY: &str = include_str!("../../../shaders/blocks/entropy.wgsl");
const BLOCK_SYNTAX: &str = include_str!("../../../shaders/blocks/syntax.wgsl");
const BLOCK_MOTION: &str = include_str!("../../../shaders/blocks/motion.wgsl");
const BLOCK_FETCH: &str = include_str!("../../../shaders/blocks/fetch.wgsl");
const BLOCK_DEPTH: &str = include_str!("../../../shaders/blocks/depth.wgsl");
const BLOCK_LAYER: &str = include_str!("../../../shaders/blocks/layer.wgsl");
const BLOCK_CORRECTIONS: &str = include_str!("../../../shaders/blocks/corrections.wgsl");
const BLOCK_CODING: &str = include_str!("../../../shaders/blocks/coding.wgsl");
const BLOCK_SMOOTH: &str = include_str!("../../../shaders/blocks/smooth.wgsl");
const BLOCK_FACTORS: &str = include_str!("../../../shaders/blocks/factors.wgsl");
const BLOCK_TABLES: &str = include_str!("../../../shaders/blocks/tables.wgsl");
const BLOCK_TO_FRAME: &str = include_str!("../../../shaders/blocks/to_frame.wgsl");
