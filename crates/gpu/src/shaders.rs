//! The kernels as text: plain concatenations of the parts in `shaders/`, in the order stated here.

use isinglass_core::kernels::layering::Layering;
use isinglass_core::layer::MAX_K;

/// How the voxels are stored, as far as a shader can tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TexelKind {
    /// 8- and 16-bit unsigned integers.
    Uint,
    /// Single-precision floats.
    Float,
}

/// How far a rendering marches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Extent {
    /// To matter that nothing can be seen through.
    Opaque,
    /// To the far side.
    Through,
}

/// What a novel view is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Frames {
    /// One layered frame, at the cost of one.
    One,
    /// Up to four.
    Several,
}

/// A kernel in one of its variants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kernel {
    /// Entry point `render`.
    Render(TexelKind, Extent),
    /// Entry point `generate`: rule and K. With [`Layering::VisibilityMerge`] also `sample_budget` and
    /// `choose_threshold`.
    Generate(TexelKind, Layering, u8),
    /// Entry points `sum_blocks`, `scan_blocks`, `compact`.
    Compact,
    /// Entry point `empty_space`.
    EmptySpace,
    /// Entry point `raycast`.
    RaycastCompute(Frames),
    /// Entry points `view_vertex`, `view_fragment`.
    RaycastView(Frames),
    /// Entry points `upscale_vertex`, `upscale_fragment`.
    Upscale,
}

impl Kernel {
    /// The whole WGSL text.
    pub(crate) fn source(self) -> String {
        let parts: &[&str] = match self {
            Self::Render(kind, extent) => &[TYPES, SPACE, LAYER, kind.part(), MARCH, extent.part(), RENDER],
            Self::Generate(kind, layering, k) => {
                let header;
                let k = usize::from(k).clamp(1, MAX_K);
                // Segments open at once.
                let mut open = k;
                let [shared, rule] = match layering {
                    Layering::VisibilityMerge | Layering::VisibilityMergeFixed => {
                        open = MAX_K;
                        header = format!("const MEAN_K: u32 = {k}u;\n");
                        [&header, VISIBILITY_MERGE]
                    }
                    Layering::EqualTransmittance => ["", EQUAL_TRANSMITTANCE],
                    Layering::EqualLength => [CUTS, EQUAL_LENGTH],
                    Layering::Homogeneity => ["", HOMOGENEITY],
                    Layering::SingleDepth(r) => {
                        header = format!("const REPRESENTATIVE: u32 = {}u;\n", r as u32);
                        [&header, SINGLE_DEPTH]
                    }
                    Layering::Slabs => [CUTS, SLABS],
                };
                let longest = layering.longest_list(k as u8);
                let k = format!("const K: u32 = {longest}u;\nconst OPEN: u32 = {open}u;\n");
                return [TYPES, SPACE, LAYER, kind.part(), MARCH, &k, GENERATE, shared, rule].concat();
            }
            Self::Compact => &[TYPES, COMPACT],
            Self::Upscale => &[TYPES, PICTURE, UPSCALE],
            Self::EmptySpace => &[TYPES, LAYER, EMPTY_SPACE, EMPTY_SPACE_BUILD],
            Self::RaycastCompute(frames) => &[
                TYPES,
                SPACE,
                LAYER,
                EMPTY_SPACE,
                RAYCAST,
                frames.part(),
                frames.sampling(),
                RAYCAST_COMPUTE,
            ],
            Self::RaycastView(frames) => {
                let [part, sampling] = [frames.part(), frames.sampling()];
                &[TYPES, SPACE, LAYER, PICTURE, EMPTY_SPACE, RAYCAST, part, sampling, RAYCAST_VIEW]
            }
        };
        parts.concat()
    }
}

impl Frames {
    fn part(self) -> &'static str {
        match self {
            Self::One => ONE_FRAME,
            Self::Several => COMBINE,
        }
    }

    /// Several frames are cast whole.
    fn sampling(self) -> &'static str {
        match self {
            Self::One => SUBSAMPLE,
            Self::Several => "",
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

const TYPES: &str = include_str!("../../../shaders/shared/types.wgsl");
const SPACE: &str = include_str!("../../../shaders/shared/space.wgsl");
const LAYER: &str = include_str!("../../../shaders/shared/layer.wgsl");
const PICTURE: &str = include_str!("../../../shaders/shared/picture.wgsl");
const TEXELS_UINT: &str = include_str!("../../../shaders/shared/texels_uint.wgsl");
const TEXELS_FLOAT: &str = include_str!("../../../shaders/shared/texels_float.wgsl");
const MARCH: &str = include_str!("../../../shaders/march.wgsl");
const RENDER: &str = include_str!("../../../shaders/render.wgsl");
const GENERATE: &str = include_str!("../../../shaders/layering/generate.wgsl");
const VISIBILITY_MERGE: &str = include_str!("../../../shaders/layering/visibility_merge.wgsl");
const EQUAL_TRANSMITTANCE: &str = include_str!("../../../shaders/layering/equal_transmittance.wgsl");
const CUTS: &str = include_str!("../../../shaders/layering/cuts.wgsl");
const EQUAL_LENGTH: &str = include_str!("../../../shaders/layering/equal_length.wgsl");
const HOMOGENEITY: &str = include_str!("../../../shaders/layering/homogeneity.wgsl");
const SINGLE_DEPTH: &str = include_str!("../../../shaders/layering/single_depth.wgsl");
const SLABS: &str = include_str!("../../../shaders/layering/slabs.wgsl");
const COMPACT: &str = include_str!("../../../shaders/layering/compact.wgsl");
const EMPTY_SPACE: &str = include_str!("../../../shaders/empty_space.wgsl");
const EMPTY_SPACE_BUILD: &str = include_str!("../../../shaders/empty_space_build.wgsl");
const RAYCAST: &str = include_str!("../../../shaders/raycast.wgsl");
const ONE_FRAME: &str = include_str!("../../../shaders/one_frame.wgsl");
const COMBINE: &str = include_str!("../../../shaders/combine.wgsl");
const SUBSAMPLE: &str = include_str!("../../../shaders/subsample.wgsl");
const RAYCAST_COMPUTE: &str = include_str!("../../../shaders/raycast_compute.wgsl");
const UPSCALE: &str = include_str!("../../../shaders/upscale.wgsl");
const RAYCAST_VIEW: &str = include_str!("../../../shaders/raycast_view.wgsl");
