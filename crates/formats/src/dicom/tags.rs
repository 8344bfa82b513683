//! The tags that matter for a volume (PS3.6).

/// Group and element.
pub(super) type Tag = (u16, u16);

macro_rules! tags {
    ($($name:ident $group:literal $element:literal),* $(,)?) => {
        $(pub(super) const $name: Tag = ($group, $element);)*

        /// Whether the value of an element is kept.
        pub(super) fn is_relevant(tag: Tag) -> bool {
            [$($name),*].contains(&tag)
        }
    };
}

tags! {
    FILE_CLASS 0x0002 0x0002,
    TRANSFER_SYNTAX 0x0002 0x0010,
    IMAGE_TYPE 0x0008 0x0008,
    CLASS 0x0008 0x0016,
    ACQUISITION_DATE_TIME 0x0008 0x002a,
    ACQUISITION_TIME 0x0008 0x0032,
    CONTENT_TIME 0x0008 0x0033,
    MODALITY 0x0008 0x0060,
    SERIES_DESCRIPTION 0x0008 0x103e,
    FRAME_TYPE 0x0008 0x9007,
    COMPLEX_COMPONENT 0x0008 0x9208,
    SLICE_THICKNESS 0x0018 0x0050,
    ECHO_TIME 0x0018 0x0081,
    ECHO_NUMBERS 0x0018 0x0086,
    SPACING_BETWEEN_SLICES 0x0018 0x0088,
    TRIGGER_TIME 0x0018 0x1060,
    IMAGER_PIXEL_SPACING 0x0018 0x1164,
    FRAME_ACQUISITION_DATE_TIME 0x0018 0x9074,
    EFFECTIVE_ECHO_TIME 0x0018 0x9082,
    B_VALUE 0x0018 0x9087,
    SIEMENS_NUM_TILES 0x0019 0x100a,
    SERIES_UID 0x0020 0x000e,
    SERIES_NUMBER 0x0020 0x0011,
    ACQUISITION_NUMBER 0x0020 0x0012,
    INSTANCE_NUMBER 0x0020 0x0013,
    IMAGE_POSITION 0x0020 0x0032,
    IMAGE_ORIENTATION 0x0020 0x0037,
    TEMPORAL_POSITION 0x0020 0x0100,
    SLICE_LOCATION 0x0020 0x1041,
    STACK_ID 0x0020 0x9056,
    TEMPORAL_POSITION_INDEX 0x0020 0x9128,
    TRIGGER_DELAY 0x0020 0x9153,
    FRAME_ACQUISITION_NUMBER 0x0020 0x9156,
    DIMENSION_INDEX_VALUES 0x0020 0x9157,
    TEMPORAL_OFFSET 0x0020 0x930d,
    SAMPLES_PER_PIXEL 0x0028 0x0002,
    PHOTOMETRIC 0x0028 0x0004,
    PLANAR_CONFIGURATION 0x0028 0x0006,
    NUMBER_OF_FRAMES 0x0028 0x0008,
    ROWS 0x0028 0x0010,
    COLUMNS 0x0028 0x0011,
    PIXEL_SPACING 0x0028 0x0030,
    BITS_ALLOCATED 0x0028 0x0100,
    BITS_STORED 0x0028 0x0101,
    HIGH_BIT 0x0028 0x0102,
    PIXEL_REPRESENTATION 0x0028 0x0103,
    PIXEL_PADDING 0x0028 0x0120,
    PADDING_LIMIT 0x0028 0x0121,
    FLOAT_PADDING 0x0028 0x0122,
    DOUBLE_PADDING 0x0028 0x0123,
    FLOAT_PADDING_LIMIT 0x0028 0x0124,
    DOUBLE_PADDING_LIMIT 0x0028 0x0125,
    WINDOW_CENTER 0x0028 0x1050,
    WINDOW_WIDTH 0x0028 0x1051,
    RESCALE_INTERCEPT 0x0028 0x1052,
    RESCALE_SLOPE 0x0028 0x1053,
    RESCALE_TYPE 0x0028 0x1054,
    LUT_DESCRIPTOR 0x0028 0x3002,
    LUT_TYPE 0x0028 0x3004,
    LUT_DATA 0x0028 0x3006,
    SIEMENS_HEADER 0x0029 0x1010,
    ROTATION_VECTOR 0x0054 0x0050,
    TIME_SLOT_VECTOR 0x0054 0x0070,
    SLICE_VECTOR 0x0054 0x0080,
    UNITS 0x0054 0x1001,
    FRAME_REFERENCE_TIME 0x0054 0x1300,
    SEGMENTATION_TYPE 0x0062 0x0001,
    SEGMENT_NUMBER 0x0062 0x0004,
    SEGMENT_LABEL 0x0062 0x0005,
    REFERENCED_SEGMENT 0x0062 0x000b,
    SEGMENT_COLOR 0x0062 0x000d,
    MOST_FRACTION 0x0062 0x000e,
    UIH_NUM_TILES 0x0065 0x1050,
    DOSE_UNITS 0x3004 0x0002,
    GRID_FRAME_OFFSETS 0x3004 0x000c,
    DOSE_GRID_SCALING 0x3004 0x000e,
}

/// Whether an element is a sequence with relevant values.
pub(super) fn is_sequence(tag: Tag) -> bool {
    // Frame groups: echo, diffusion, heartbeat and type; content, position, orientation and time; pixels, window and values;
    // segment.
    const INNER: [Tag; 14] = [
        (0x0018, 0x9114),
        (0x0018, 0x9117),
        (0x0018, 0x9118),
        (0x0018, 0x9226),
        (0x0018, 0x9329),
        (0x0018, 0x9751),
        (0x0020, 0x9111),
        (0x0020, 0x9113),
        (0x0020, 0x9116),
        (0x0020, 0x9310),
        (0x0028, 0x9110),
        (0x0028, 0x9132),
        (0x0028, 0x9145),
        (0x0062, 0x000a),
    ];
    [SHARED_GROUPS, PER_FRAME_GROUPS, MODALITY_LUT, DETECTORS, SEGMENTS, UIH_TILES].contains(&tag)
        || INNER.contains(&tag)
}

pub(super) const MODALITY_LUT: Tag = (0x0028, 0x3000);
/// The detectors of nuclear medicine, which have the position of the picture.
pub(super) const DETECTORS: Tag = (0x0054, 0x0022);
pub(super) const SEGMENTS: Tag = (0x0062, 0x0002);
/// The slices of a mosaic by United Imaging.
pub(super) const UIH_TILES: Tag = (0x0065, 0x1051);
pub(super) const SHARED_GROUPS: Tag = (0x5200, 0x9229);
pub(super) const PER_FRAME_GROUPS: Tag = (0x5200, 0x9230);
pub(super) const FLOAT_PIXEL_DATA: Tag = (0x7fe0, 0x0008);
pub(super) const DOUBLE_PIXEL_DATA: Tag = (0x7fe0, 0x0009);
pub(super) const PIXEL_DATA: Tag = (0x7fe0, 0x0010);
pub(super) const ITEM: Tag = (0xfffe, 0xe000);
pub(super) const ITEM_END: Tag = (0xfffe, 0xe00d);
pub(super) const SEQUENCE_END: Tag = (0xfffe, 0xe0dd);
