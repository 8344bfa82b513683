//! The keys that distinguish the volumes of a series.

use super::element::Elements;
use super::tags;

/// A number by which slices at the same position may differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Key {
    EchoNumber,
    /// Milliseconds.
    EchoTime,
    /// Number of the point in time, or its distance from the first.
    TemporalPosition,
    /// Milliseconds since the heartbeat.
    TriggerTime,
    /// Seconds per square millimetre.
    BValue,
    /// Milliseconds since the start of a series of PET.
    ReferenceTime,
    AcquisitionNumber,
    /// A number of the order of frames in an enhanced file.
    Dimension(usize),
    /// Digits of a time, or of date and time.
    AcquisitionTime,
    ContentTime,
}

impl Key {
    /// The keys for points in time, the most reliable first.
    pub(super) const TIMES: [Self; 7 + NUM_DIMENSIONS] = [
        Self::TemporalPosition,
        Self::TriggerTime,
        Self::BValue,
        Self::ReferenceTime,
        Self::AcquisitionNumber,
        Self::Dimension(0),
        Self::Dimension(1),
        Self::Dimension(2),
        Self::Dimension(3),
        Self::Dimension(4),
        Self::AcquisitionTime,
        Self::ContentTime,
    ];

    /// The value in `fields`.
    fn of(self, fields: &Elements) -> Option<f64> {
        let time = |tag| fields.text(tag).and_then(|t| digits(&t));
        match self {
            Self::EchoNumber => fields.decimal(tags::ECHO_NUMBERS),
            Self::EchoTime => fields
                .decimal(tags::ECHO_TIME)
                .or_else(|| fields.double(tags::EFFECTIVE_ECHO_TIME))
                // Scanners round in different ways.
                .map(|ms| (ms * 1e3).round() / 1e3),
            Self::TemporalPosition => fields
                .decimal(tags::TEMPORAL_POSITION)
                .or_else(|| fields.longs(tags::TEMPORAL_POSITION_INDEX).next().map(f64::from))
                .or_else(|| fields.double(tags::TEMPORAL_OFFSET)),
            Self::TriggerTime => {
                fields.decimal(tags::TRIGGER_TIME).or_else(|| fields.double(tags::TRIGGER_DELAY))
            }
            Self::BValue => fields.double(tags::B_VALUE),
            Self::ReferenceTime => fields.decimal(tags::FRAME_REFERENCE_TIME),
            Self::AcquisitionNumber => fields
                .decimal(tags::ACQUISITION_NUMBER)
                .or_else(|| fields.short(tags::FRAME_ACQUISITION_NUMBER).map(f64::from)),
            Self::Dimension(i) => fields.longs(tags::DIMENSION_INDEX_VALUES).nth(i).map(f64::from),
            Self::AcquisitionTime => time(tags::FRAME_ACQUISITION_DATE_TIME)
                .or_else(|| time(tags::ACQUISITION_DATE_TIME))
                .or_else(|| time(tags::ACQUISITION_TIME)),
            Self::ContentTime => time(tags::CONTENT_TIME),
        }
    }

    fn index(self) -> usize {
        match self {
            Self::EchoNumber => 0,
            Self::EchoTime => 1,
            Self::TemporalPosition => 2,
            Self::TriggerTime => 3,
            Self::BValue => 4,
            Self::ReferenceTime => 5,
            Self::AcquisitionNumber => 6,
            Self::AcquisitionTime => 7,
            Self::ContentTime => 8,
            Self::Dimension(i) => 9 + i,
        }
    }
}

/// The keys of a slice, or of all slices of a file.
#[derive(Clone, Debug, Default)]
pub(super) struct Keys {
    /// HeaderBytes of the type of the picture, such as `ORIGINAL\PRIMARY\M`.
    pub(super) image_type: Option<String>,
    /// Values by the index of the key.
    numbers: [Option<f64>; NUM_NUMBERS],
}

impl Keys {
    pub(super) fn of(fields: &Elements) -> Self {
        let mut image_type = fields.text(tags::FRAME_TYPE).or_else(|| fields.text(tags::IMAGE_TYPE));
        if let (Some(words), Some(component)) = (&mut image_type, fields.text(tags::COMPLEX_COMPONENT)) {
            words.push('\\');
            words.push_str(&component);
        }
        let mut numbers = [None; NUM_NUMBERS];
        for key in [Key::EchoNumber, Key::EchoTime].into_iter().chain(Key::TIMES) {
            numbers[key.index()] = key.of(fields);
        }
        Self { image_type, numbers }
    }

    /// These keys, with missing ones from `file`.
    pub(super) fn or(self, file: &Self) -> Self {
        Self {
            image_type: self.image_type.or_else(|| file.image_type.clone()),
            numbers: std::array::from_fn(|i| self.numbers[i].or(file.numbers[i])),
        }
    }

    /// These keys at another point in time.
    pub(super) fn at_time(&self, number: f64) -> Self {
        let mut keys = self.clone();
        keys.numbers[Key::TemporalPosition.index()] = Some(number);
        keys
    }

    /// The value of a key. A missing one comes before all others.
    pub(super) fn number(&self, key: Key) -> f64 {
        self.numbers[key.index()].unwrap_or(f64::NEG_INFINITY)
    }

    /// Whether the picture is a mosaic of slices, as Siemens scanners write them.
    pub(super) fn is_mosaic(&self) -> bool {
        self.image_type.as_ref().is_some_and(|t| t.split('\\').any(|word| word.trim() == "MOSAIC"))
    }
}

/// The digits of a time, or of date and time, without its zone.
fn digits(time: &str) -> Option<f64> {
    let time: String =
        time.chars().filter(|c| *c != ':').take_while(|c| c.is_ascii_digit() || *c == '.').collect();
    time.parse().ok()
}

/// Numbers of the order in an enhanced file that are used.
const NUM_DIMENSIONS: usize = 5;
const NUM_NUMBERS: usize = 9 + NUM_DIMENSIONS;
