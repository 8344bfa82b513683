//! Guards of the shaders that need no GPU: every concatenation is valid WGSL, and what it shares with Rust is the same
//! there, names included.

use std::collections::BTreeMap;

use isinglass_core::codec::blocks::device::context_places;
use isinglass_core::kernels::raycast::Reconstruction;
use isinglass_core::mode::{Compositing, Mode};
use wgpu::naga;

use crate::gpu_types::{
    BLOCK, Band, Basis, BlockFrame, Combination, Display, GROUP_HEIGHT, LANES_OF_BLOCK, PageField,
    PartBudget, PartRay, RAYS_IN_GROUP, Raycaster, Scene, WORKGROUP_SIDE,
};
use crate::shaders::{
    BlockKernel, Extent, Frames, GatheredKind, Kernel, MarchPurpose, MixedPurpose, Purpose, TexelKind,
};

/// A struct as (size, fields); a field as (name, offset, size).
type Layout = (usize, Vec<(String, usize, usize)>);

/// The layout of a Rust struct. The pattern is exhaustive: a field cannot be forgotten.
macro_rules! layout {
    ($type:ident { $($field:ident),+ }) => {{
        let $type { $($field),+ } = <$type as bytemuck::Zeroable>::zeroed();
        let fields = vec![$((
            stringify!($field).to_owned(),
            std::mem::offset_of!($type, $field),
            size_of_val(&$field),
        )),+];
        (stringify!($type), (size_of::<$type>(), fields))
    }};
}

fn rust_layouts() -> BTreeMap<&'static str, Layout> {
    [
        layout!(Basis {
            eye,
            near,
            forward,
            far,
            right,
            width,
            up,
            height,
            perspective,
            padding_0,
            padding_1,
            padding_2
        }),
        layout!(Scene {
            bounds_min,
            x_scale,
            bounds_max,
            x_offset,
            voxel_from_world,
            step_length,
            voxel_origin,
            shaded,
            dims,
            ambient,
            brick_dims,
            diffuse,
            clip_normal,
            clip_offset,
            light,
            specular,
            shininess,
            half_gradient,
            open_ambient,
            open_diffuse,
            steepness,
            padding_0,
            page_grid,
            padding_1,
            first_brick,
            padding_2
        }),
        layout!(PartRay { s0, h, first, end, unit, pixel }),
        layout!(PartBudget { threshold, longest, num_rays, capacity }),
        layout!(PageField { scale, ambient, offset, diffuse, first, first_word, last, is_visible }),
        layout!(Band { first_row, num_rows, first_pixel, num_pixels }),
        layout!(Raycaster {
            basis,
            bounds_min,
            units_per_depth,
            bounds_max,
            padding_0,
            clip_normal,
            clip_offset,
            volume_min,
            compositing,
            volume_max,
            padding_1
        }),
        layout!(Combination {
            casters,
            places,
            bounds_min,
            band,
            bounds_max,
            num_frames,
            clip_normal,
            clip_offset
        }),
        layout!(Display { background, padding_0 }),
        layout!(BlockFrame {
            size,
            num_blocks,
            along,
            here,
            shift,
            is_still,
            reference_blocks,
            first_layer,
            first_cell,
            most_layers,
            most_cells,
            reference_first_layer,
            reference_first_cell,
            depth,
            opacity,
            color,
            picture,
            chroma,
            padding_0
        }),
    ]
    .into_iter()
    .collect()
}

/// One of each kind that is cast for, each constant with both of its values.
fn all_purposes() -> Vec<Purpose> {
    let mut purposes = Vec::new();
    for compositing in [Compositing::Over, Compositing::Greatest, Compositing::Mean] {
        let one = Purpose { compositing, ..Purpose::default() };
        purposes.extend([
            one,
            Purpose { reconstruction: Reconstruction::Nearest, ..one },
            Purpose { skips_empty_space: false, ..one },
            Purpose { frames: Frames::Several, ..one },
        ]);
    }
    purposes
}

const PLAIN: MarchPurpose = MarchPurpose {
    kind: TexelKind::Uint,
    mode: Mode::Composite,
    is_glossy: false,
    has_gaps: false,
    has_pages: false,
    mixed: None,
};

const BLOCK_KERNELS: [BlockKernel; 6] = [
    BlockKernel::Tiles,
    BlockKernel::Borders { is_below: false },
    BlockKernel::Borders { is_below: true },
    BlockKernel::Factors,
    BlockKernel::Tables,
    BlockKernel::Lists,
];

const GATHERED: [GatheredKind; 3] = [GatheredKind::Pieces, GatheredKind::Steps, GatheredKind::Seen];

fn all_kernels() -> Vec<Kernel> {
    let mut kernels = vec![Kernel::Compact, Kernel::EmptySpace, Kernel::Upscale];
    kernels.extend(BLOCK_KERNELS.map(Kernel::Blocks));
    for purpose in all_purposes() {
        kernels.extend([Kernel::RaycastCompute(purpose), Kernel::RaycastView(purpose, true)]);
    }
    for kind in [TexelKind::Uint, TexelKind::Float] {
        for mode in Mode::ALL {
            for (is_glossy, has_pages) in [(false, false), (true, false), (false, true), (true, true)] {
                let purpose =
                    MarchPurpose { kind, mode, is_glossy, has_gaps: is_glossy, has_pages, mixed: None };
                let extents = [Extent::Opaque, Extent::Through];
                kernels.extend(extents.map(|extent| Kernel::Render(purpose, extent)));
                kernels.push(Kernel::Generate(purpose));
                if !has_pages {
                    kernels.extend(GATHERED.map(|kind| Kernel::Gather(purpose, kind)));
                }
            }
        }
        for (num_channels, floats, labels, is_over) in
            [(1, 0, 1, false), (2, 0, 0, true), (3, 2, 4, false), (8, 0b1010_1010, 0b1000_0001, true)]
        {
            let mixed = Some(MixedPurpose { num_channels, floats, labels, is_over });
            let purpose = MarchPurpose { kind, mixed, has_gaps: is_over, has_pages: floats != 0, ..PLAIN };
            kernels.extend([Kernel::Render(purpose, Extent::Opaque), Kernel::Generate(purpose)]);
            kernels.extend(GATHERED.map(|kind| Kernel::Gather(purpose, kind)));
        }
    }
    kernels
}

fn parse(source: &str) -> Result<naga::Module, String> {
    naga::front::wgsl::parse_str(source).map_err(|e| e.emit_to_string(source))
}

/// Parses and validates with what wgpu's default features allow.
fn check(source: &str) -> Result<naga::Module, String> {
    let module = parse(source)?;
    let mut validator =
        naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty());
    validator.validate(&module).map_err(|e| e.emit_to_string(source))?;
    Ok(module)
}

fn wgsl_layout(module: &naga::Module, name: &str) -> Option<Layout> {
    let context = module.to_ctx();
    module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name)).and_then(|(_, ty)| match &ty.inner {
        naga::TypeInner::Struct { members, span } => {
            let field = |m: &naga::StructMember| {
                let size = module.types[m.ty].inner.size(context) as usize;
                (m.name.clone().unwrap_or_default(), m.offset as usize, size)
            };
            Some((*span as usize, members.iter().map(field).collect()))
        }
        _ => None,
    })
}

fn wgsl_constants(module: &naga::Module) -> BTreeMap<String, f64> {
    let value = |constant: &naga::Constant| match module.global_expressions[constant.init] {
        naga::Expression::Literal(naga::Literal::F32(x)) => Some(f64::from(x)),
        naga::Expression::Literal(naga::Literal::U32(x)) => Some(f64::from(x)),
        naga::Expression::Literal(naga::Literal::I32(x)) => Some(f64::from(x)),
        _ => None,
    };
    module.constants.iter().filter_map(|(_, c)| Some((c.name.clone()?, value(c)?))).collect()
}

/// Constants with a literal value in Rust text, private ones too, as the `f32` they are.
fn rust_constants(text: &str) -> BTreeMap<String, f64> {
    let parse_line = |line: &str| {
        let line = line
            .trim()
            .trim_start_matches("pub(super) ")
            .trim_start_matches("pub ")
            .strip_prefix("const ")?;
        let (name, rest) = line.split_once(':')?;
        let (ty, value) = rest.trim_end_matches(';').split_once('=')?;
        let value = value.trim().replace('_', "");
        let value = match value.split_once(" << ") {
            Some((one, bits)) => one.parse::<f64>().ok()? * 2f64.powi(bits.parse().ok()?),
            None if ty.trim() == "f32" => f64::from(value.parse::<f32>().ok()?),
            None => value.parse().ok()?,
        };
        Some((name.trim().to_owned(), value))
    };
    text.lines().filter_map(parse_line).collect()
}

/// The Rust twins of the parts of the shaders.
const TWINS: [&str; 26] = [
    include_str!("atlas.rs"),
    include_str!("../../core/src/mode.rs"),
    include_str!("../../core/src/space.rs"),
    include_str!("../../core/src/layer.rs"),
    include_str!("../../core/src/transfer.rs"),
    include_str!("../../core/src/volume/bricks.rs"),
    include_str!("../../core/src/volume/lit.rs"),
    include_str!("../../core/src/volume/pyramid.rs"),
    include_str!("../../core/src/kernels/march.rs"),
    include_str!("../../core/src/kernels/march/glossy.rs"),
    include_str!("../../core/src/kernels/march/mixed.rs"),
    include_str!("../../core/src/kernels/march/modes.rs"),
    include_str!("../../core/src/kernels/march/surfaces.rs"),
    include_str!("../../core/src/kernels/empty_space.rs"),
    include_str!("../../core/src/kernels/raycast.rs"),
    include_str!("../../core/src/kernels/raycast/line.rs"),
    include_str!("../../core/src/kernels/raycast/pieces.rs"),
    include_str!("../../core/src/kernels/raycast/projected.rs"),
    include_str!("../../core/src/kernels/combine.rs"),
    include_str!("../../core/src/kernels/layering/mod.rs"),
    include_str!("../../core/src/kernels/layering/close.rs"),
    include_str!("../../core/src/kernels/layering/projection.rs"),
    include_str!("../../core/src/kernels/layering/visibility_merge.rs"),
    include_str!("../../core/src/kernels/layering/stream.rs"),
    include_str!("../../core/src/kernels/layering/budget.rs"),
    include_str!("../../core/src/kernels/layering/parts/forms.rs"),
];

/// The Rust twins of the kernels that decode blocks. Some names mean other things there than in the others.
const BLOCK_TWINS: [&str; 13] = [
    include_str!("blocks.rs"),
    include_str!("../../core/src/layer.rs"),
    include_str!("../../core/src/codec/blocks/model.rs"),
    include_str!("../../core/src/codec/blocks/scales.rs"),
    include_str!("../../core/src/codec/blocks/entropy.rs"),
    include_str!("../../core/src/codec/blocks/tables.rs"),
    include_str!("../../core/src/codec/blocks/motion.rs"),
    include_str!("../../core/src/codec/blocks/tile.rs"),
    include_str!("../../core/src/codec/blocks/residual.rs"),
    include_str!("../../core/src/codec/blocks/corrections.rs"),
    include_str!("../../core/src/codec/blocks/smooth.rs"),
    include_str!("../../core/src/codec/blocks/coding/layer.rs"),
    include_str!("../../core/src/codec/blocks/device.rs"),
];

/// Constants of the shaders that the twins express otherwise.
const SHADER_ONLY: [&str; 24] = [
    "HIDES",
    "ITEM_WORDS",
    "RAYS_IN_GROUP",
    "LANES",
    "PIECE_WORDS",
    "IS_MEAN",
    "IS_LEAST",
    "IS_OVER",
    "X_LEAST",
    "X_GREATEST",
    "NO_STEP",
    "UNBOUNDED",
    "STOP_AT",
    "BLOCK",
    "HALF_NORMAL_MIN",
    "HALF_SUBNORMAL",
    "NEVER",
    "OUT_OF_REACH",
    "MIXED",
    "NONE",
    "HALF_SCALE",
    "LIST_CELLS",
    "NOTHING",
    "FAR",
];

/// The same of the kernels that decode blocks. A wrong place of a table decodes to other numbers, which
/// `tests/tests/gpu_blocks.rs` notices.
const BLOCK_SHADER_ONLY: [&str; 30] = [
    "WORDS_OF_BLOCK",
    "WORDS_OF_PICTURE",
    "NUM_LOGS",
    "NUM_BELOWS",
    "CODES_OF_LOGS",
    "LOGS_OF_MANTISSAS",
    "LOGS_OF_SUMS",
    "PER_ROOTS",
    "WAVES",
    "ZIGZAG",
    "ALPHAS",
    "HALVES_OF_TAU",
    "NO_CLASS",
    "SIGNED",
    "TOO_FAR",
    "WORDS_OF_NOTE",
    "OWN",
    "NOWHERE",
    "FRESH",
    "LEFT",
    "ABOVE",
    "KEPT",
    "COPIED",
    "NUM_LAYERS_SO_FAR",
    "NUM_CELLS_SO_FAR",
    "NUM_DAMAGED",
    "NUM_DEPTH_CONTEXTS",
    "IS_THERE",
    "ONE",
    "ONE_SQUARED",
];

/// The same with the constants of a pipeline in their places: each that the text asks for, and no other.
fn check_with(source: &str, constants: &[(&'static str, f64)]) -> Result<(), String> {
    let module = parse(source)?;
    let mut validator =
        naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty());
    let info = validator.validate(&module).map_err(|e| e.emit_to_string(source))?;
    let constants = constants.iter().map(|&(name, value)| (name.to_owned(), value)).collect();
    let (module, _) = naga::back::pipeline_constants::process_overrides(&module, &info, None, &constants)
        .map_err(|e| e.to_string())?;
    validator.validate_resolved_overrides(&module).map_err(|e| e.emit_to_string(source))?;
    Ok(())
}

#[test]
fn every_concatenation_is_valid() {
    for kernel in all_kernels() {
        if let Err(e) = check_with(&kernel.source(), &kernel.constants()) {
            panic!("{kernel:?}: {e}");
        }
    }
    // Negative controls: a constant that is not given, and one that the text does not have.
    let kernel = Kernel::RaycastCompute(Purpose::default());
    assert!(check_with(&kernel.source(), &kernel.constants()[1..]).is_err());
    let one_more = [&kernel.constants()[..], &[("IS_ANOTHER", 0.0)]].concat();
    assert!(check_with(&kernel.source(), &one_more).is_err());
    // Negative control: a call of a function that a missing part would define.
    let without_sink =
        Kernel::Render(PLAIN, Extent::Opaque).source().replace("fn sink_step", "fn other_step");
    assert!(check(&without_sink).is_err());
}

/// The first variable of a function that begins without a value.
fn variable_without_value(source: &str) -> Option<&str> {
    let is_bare =
        |line: &&str| line.starts_with(' ') && line.trim().starts_with("var ") && !line.contains('=');
    source.lines().find(is_bare)
}

/// In a loop, some compilers give such a variable its zeros once only, and later turns find what the turn before left.
#[test]
fn variables_begin_with_a_value() {
    for kernel in all_kernels() {
        assert_eq!(variable_without_value(&kernel.source()), None, "{kernel:?}");
    }
    // Negative control.
    let source = Kernel::RaycastCompute(Purpose::default()).source();
    assert!(variable_without_value(&source.replace("var met = Met();", "var met: Met;")).is_some());
}

#[test]
fn shared_structs_have_the_layout_of_their_mirrors() {
    let mut seen = BTreeMap::new();
    for kernel in all_kernels() {
        let module = check(&kernel.source()).unwrap();
        for (name, expected) in rust_layouts() {
            if let Some(found) = wgsl_layout(&module, name) {
                assert_eq!(found, expected, "struct {name} in {kernel:?}");
                seen.insert(name, ());
            }
        }
        // Every uniform is one of the mirrored structs.
        for (_, variable) in module.global_variables.iter() {
            if variable.space == naga::AddressSpace::Uniform {
                let name = module.types[variable.ty].name.as_deref().unwrap_or_default();
                assert!(rust_layouts().contains_key(name), "uniform {:?} of type {name}", variable.name);
            }
        }
    }
    assert_eq!(seen.len(), rust_layouts().len());
}

#[test]
fn a_shifted_or_renamed_field_is_noticed() {
    let source = Kernel::Render(PLAIN, Extent::Opaque).source();
    let layouts = rust_layouts();
    for (from, to) in [
        ("    x_scale: f32,\n    bounds_max: vec3f,\n", "    bounds_max: vec3f,\n    x_scale: f32,\n"),
        ("    step_length: f32,\n", ""),
        ("    ambient: f32,\n", "    brightness: f32,\n"),
        ("    dims: vec3i,\n", "    dims: vec2i,\n"),
    ] {
        assert!(source.contains(from), "{from}");
        let module = parse(
            &source
                .replacen(from, to, 1)
                .replace("scene.step_length", "1.0")
                .replace("scene.ambient", "1.0")
                .replace("scene.dims", "vec3i(1)"),
        )
        .unwrap();
        assert_ne!(wgsl_layout(&module, "Scene").as_ref(), Some(&layouts["Scene"]), "{from}");
    }
}

/// The constants of all texts, which agree on them.
fn constants_of(texts: &[&str]) -> BTreeMap<String, f64> {
    let mut all = BTreeMap::new();
    for (name, value) in texts.iter().flat_map(|text| rust_constants(text)) {
        assert!(all.insert(name.clone(), value).is_none_or(|v| v == value), "two values of {name} in core");
    }
    all
}

#[test]
fn shared_constants_have_the_values_of_the_twins() {
    let mut twin = constants_of(&TWINS);
    let mut of_blocks = constants_of(&BLOCK_TWINS);
    of_blocks.extend(context_places().map(|(name, place)| (name.to_owned(), f64::from(place))));
    for compositing in [Compositing::Over, Compositing::Greatest, Compositing::Mean] {
        twin.insert(format!("BY_{compositing:?}").to_uppercase(), f64::from(compositing as u32));
    }
    let mut compared = 0;
    for kernel in all_kernels() {
        let constants = wgsl_constants(&check(&kernel.source()).unwrap());
        let of_kernel = matches!(kernel, Kernel::Blocks(_)).then_some(&of_blocks);
        let is_compared = |name: &str| {
            let is_of_blocks = of_kernel.is_some() && BLOCK_SHADER_ONLY.contains(&name);
            !is_of_blocks && !SHADER_ONLY.contains(&name)
        };
        for (name, value) in constants.iter().filter(|(name, _)| is_compared(name)) {
            let expected = of_kernel
                .and_then(|own| own.get(name))
                .or_else(|| twin.get(name))
                .unwrap_or_else(|| panic!("no constant {name} in the twins of {kernel:?}"));
            // Bricks and bins are integers on one side and floats on the other; all are exact as f32.
            assert_eq!(value, expected, "{name} in {kernel:?}");
            compared += 1;
        }
    }
    assert!(compared > 0);
    // Negative control: the reader of constants reads them.
    assert_eq!(twin["TRANSMITTANCE_MIN"], f64::from(1e-4f32));
    assert_ne!(twin["TAU_MIN"], twin["MIN_SLOPE"]);
    let compact = wgsl_constants(&check(&Kernel::Compact.source()).unwrap());
    assert_eq!(compact["BLOCK"], f64::from(BLOCK));
}

#[test]
fn workgroups_are_those_that_the_host_dispatches() {
    for kernel in all_kernels() {
        for entry in check(&kernel.source()).unwrap().entry_points {
            let expected = match (kernel, entry.stage) {
                (_, naga::ShaderStage::Vertex | naga::ShaderStage::Fragment) => continue,
                (Kernel::Compact, _) => [BLOCK, 1, 1],
                (Kernel::Blocks(BlockKernel::Lists), _) => [BLOCK, 1, 1],
                (Kernel::Blocks(_), _) => [LANES_OF_BLOCK, 1, 1],
                (Kernel::Gather(..), _) => [RAYS_IN_GROUP, 1, 1],
                _ if entry.name == "choose" => [1, 1, 1],
                (Kernel::RaycastCompute(_) | Kernel::Generate(..), _) => [WORKGROUP_SIDE, GROUP_HEIGHT, 1],
                _ => [WORKGROUP_SIDE, WORKGROUP_SIDE, 1],
            };
            assert_eq!(entry.workgroup_size, expected, "{}", entry.name);
        }
    }
}
